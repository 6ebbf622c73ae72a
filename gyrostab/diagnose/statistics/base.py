"""What every statistic of the diagnosis defines, or inherits as a step without work."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypedDict

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.diagnose.evidence.held_out import LinearModel, linear_model_factors
from gyrostab.diagnose.evidence.mixture import Mixture
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.predict.average_sizes import Size, average_sizes
from gyrostab.diagnose.predict.candidates import (
    Candidate,
    CandidateEvidence,
    Component,
    Prospect,
    Variant,
)
from gyrostab.diagnose.predict.linear_model import State, simulate_noise
from gyrostab.diagnose.predict.search import Trial, collect_evidence
from gyrostab.diagnose.predict.sizes import linear_mixture
from gyrostab.diagnose.predict.windows import distinct_variants, weigh_by_time
from gyrostab.diagnose.settings import Settings
from gyrostab.physics.base import Effect
from gyrostab.physics.prediction import Windows

#: Keys are ``name``, or ``name.axis`` for a size of each of several axes.
Sizes = Mapping[str, Size]


class Region(TypedDict):
    """A place where recording and simulation differ."""

    statistic: str  # name
    view: str
    axes: str  # separated by blanks
    quantity: str  # that is scored, such as "avar", "level", "line" or "outliers"
    begin: float  # s since the start
    end: float
    tau_min_s: float
    tau_max_s: float
    frequency: float  # Hz
    sign: int  # 0 for a mean that wanders
    z: float
    p_value: float
    ratio: float  # observed over expected; for means and restarts the number of standard deviations
    estimate: float  # depends on the statistic


class NullDraw(NamedTuple):
    """Some null records, of which means, powers, lines and cross-spectra are drawn."""

    #: The recording, for its blocks, gaps and channels, and the noise.
    blocks: xr.Dataset
    baseline: xr.Dataset
    record_count: int
    rng: np.random.Generator
    #: (record, axis, block, band): expected and drawn powers [degree2 hour-2 Hz-1].
    expected: Array
    power: Array
    #: (axis, 2): standard deviations of a sample and of a difference of neighbours [degree hour-1].
    sample_sd: Array


@dataclass(frozen=True)
class SizeFit:
    """What the sizes of an effect are estimated from."""

    components: Sequence[Component]  # of one effect, all in one statistic
    axes: tuple[str, ...]
    state: State  # with all other effects in the model
    count_evidence: CountEvidence  # expected sample counts
    #: Filled by an estimate that averages over a grid: the values at its likeliest point.
    likeliest: dict[str, float | str] = field(default_factory=dict)

    def key(self, name: str, axis: str) -> str:
        """Return the key of a size in `Sizes`."""
        return name if len(self.axes) == 1 else f"{name}.{axis}"


class Competitor(NamedTuple):
    """Another form of an effect that competes with it."""

    name: str  # in words, for what beats an effect
    nats: float  # by how much it explains more [nats]
    needed: float  # that it must exceed [nats]


class Statistic:
    """One way to look at a recording, with all steps of the diagnosis in which it takes part.

    A subclass sets the attributes and overrides the methods of the steps in which it takes part.
    The registry `gyrostab.diagnose.statistics.STATISTICS` has one instance of each.
    """

    name: str  # unique
    view: str  # the key ``view`` of its mismatches in diagnosis.json
    #: `view` of each mismatch that an effect in it can explain.
    explained_views: tuple[str, ...] = ()
    #: `view` of each mismatch whose score against the baseline with effects contains what an effect
    #: in this statistic contributes.
    containing_views: tuple[str, ...] = ()
    #: `view` of each mismatch for which `predict_baseline` includes what an effect adds.
    modelled_views: tuple[str, ...] = ()
    #: Nuisance alternative as which an effect is reported on the axes where it shows in this
    #: statistic and its size may be zero (`gyrostab.diagnose.result.finish.keep_supported`).
    unsupported_as = "~S(f)"
    #: Other statistics that show an error of the form of an effect.
    error_shows_in: tuple[str, ...] = ()
    #: Variable of the null records that the evidence uses; "" to draw noise of the linear model.
    null_variable = ""
    # what an effect does
    is_in_means = False  # effects move the block means
    is_linear_in_means = False  # effects move the block means by columns of a linear model
    is_switching = False  # effects move the block means between two levels of free course
    is_random_bias = False  # effects add a bias of random course, which no other data predict
    is_power = False  # effects add power
    is_pairwise = False  # effects add a covariance of two axes
    is_rotation = False  # effects add amplitudes at multiples of the rotation
    is_phase_locked = False  # effects are locked to the rotation of the tool or to the ramp
    is_transfer = False  # effects add what follows a reference channel
    is_line = False  # effects add a spectral line
    is_count = False  # effects cause anomalous samples
    takes_noise = True  # an effect takes a share of the noise of an axis
    # how effects are searched and fitted
    has_course = False  # designs are by block, so that an effect may act in part of the record
    has_size = True  # the size follows from a linear model
    is_power_weighted = False  # the expected powers give the weights of the data
    is_tried_last = False  # an effect explains only what no other statistic does
    # how mismatches are scored
    uses_line_spectra = False  # the score is of the spectrum at full resolution
    is_ratio = False  # the score is of a variance divided by the expected one
    grows_in_time = True  # adjacent regions of a mismatch are one

    def __repr__(self) -> str:
        return f"<{self.name}>"

    # ---------------------------------------------------------------------- measurement and noise

    def null(self, draw: NullDraw) -> Mapping[str, Array]:
        """Draw what noise alone produces, by variable with the record first.

        By default nothing: the powers, means and cross-spectra of a null record, from which most
        statistics follow, are drawn together. Values that the recording lacks are left out later.
        """
        return {}

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
        """Score windows of blocks against the baseline; None where there is nothing to score."""
        return None

    def prepare(
        self, blocks: xr.Dataset, baseline: xr.Dataset, regions: Sequence[Region]
    ) -> xr.Dataset:
        """Return the blocks to score, when these mismatches are known."""
        return blocks

    # ---------------------------------------------------------------------- candidates

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield what an effect does to the statistic; by default nothing."""
        yield from ()

    def candidates(
        self,
        kind: type[Effect],
        driver: tuple[str, ...],
        prospects: Sequence[Prospect],
        windows: Windows,
        blocks: xr.Dataset,
    ) -> list[Candidate]:
        """Return the candidates of an effect that follows these channels."""
        variants = distinct_variants(
            [variant for prospect in prospects for variant in self.design(prospect)]
        )
        if not variants:
            return []
        candidate = Candidate(kind.name, self, driver, weigh_by_time(variants, windows))
        return [self.complete_candidate(candidate, kind, windows)]

    def complete_candidate(
        self, candidate: Candidate, kind: type[Effect], windows: Windows
    ) -> Candidate:
        """Return a candidate with what its statistic adds to it; by default nothing."""
        return candidate

    def nuisance_alternatives(self, blocks: xr.Dataset) -> list[Candidate]:
        """Return generic changes of noise and bias that compete with effects in this statistic."""
        return []

    # ---------------------------------------------------------------------- evidence

    def rows(self, candidate: Candidate, state: State) -> list[tuple[str, ...]]:
        """Return the axes of each row; by default one axis."""
        return [(axis,) for axis in state.axes]

    def model(
        self, candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
    ) -> LinearModel:
        """Build the linear model of one row, with the designs of all variants in order."""
        raise NotImplementedError(f"{self.name} has no linear model")

    def evidence(self, group: Sequence[Candidate], trial: Trial) -> list[CandidateEvidence]:
        """Compute the held-out evidence of candidates; by default from the linear model.

        The candidates have the same rows and reference channel.
        """
        rows = self.rows(group[0], trial.state)
        if not rows:  # pairs of a single axis
            return []
        factors = [self.row_factors(group, row, trial)[:, 1:] for row in range(len(rows))]
        variant_count = sum(len(candidate.variants) for candidate in group)
        return collect_evidence(group, rows, factors, factors[-1].shape[1] // variant_count)

    def row_factors(self, group: Sequence[Candidate], row: int, trial: Trial) -> Array:
        """Return the factors of all variants in one row, as `linear_model_factors` does."""
        state = trial.state
        is_drawn = trial.rng is not None and self.null_variable not in trial.data
        data = state.blocks if is_drawn else trial.data

        def compute_factors() -> Array:
            model = self.model(group, row, data, state)
            if is_drawn and trial.rng is not None:
                model = simulate_noise(model, trial.rng, trial.data.sizes["record"])
            return linear_model_factors(model, trial.folds)

        if trial.is_null:
            return compute_factors()
        bare = self.model([replace(group[0], variants=())], row, data, state)
        inputs = bare.values, bare.weight, bare.given, bare.precision
        return trial.recall(compute_factors, group, np.array(row), *inputs)

    def competitors(
        self, components: Sequence[Component], state: State, error: float
    ) -> Iterator[Competitor]:
        """Yield other forms of an effect with these components in the statistic, on all axes.

        The state has all other effects in the model; errors of their form may leave `error` [nats].
        """
        yield from ()

    def axis_competitors(self, component: Component, state: State) -> Iterator[Competitor]:
        """Yield other forms of a component on its axis alone."""
        yield from ()

    # ---------------------------------------------------------------------- in the model

    def is_filter(self, variant: Variant) -> bool:
        """Return whether a variant multiplies the spectrum rather than adds to it."""
        return False

    def condition(self, state: State, component: Component) -> State:
        """Put a component into the state; by default there is nothing to put in."""
        return state

    def noise_shares(
        self, component: Component, axis: str, state: State, expected_power: Array
    ) -> tuple[Array | float, list[Array], list[Array]]:
        """Return what a component takes from the noise of an axis.

        These are a power of known size (block, band), and powers and means of free size. The state
        is that without any effect, `expected_power` (axis, block, band) that with all effects.
        """
        if not self.takes_noise:
            return 0.0, [], []
        with_component = self.condition(state, component)
        return 0.0, with_component.power_columns(axis), with_component.given.get(("mean", axis), [])

    def moves_means(self, component: Component) -> bool:
        """Return whether a component without columns in the means moves them all the same."""
        return False

    def has_power_of_effect(self, component: Component, state: State) -> bool:
        """Return whether only the effect itself, and no column, gives the power of a component."""
        return False

    def is_only_in_phase(self, component: Component, blocks: xr.Dataset) -> bool:
        """Return whether the band powers show only a small part of the evidence of a component."""
        return self.is_phase_locked

    # ---------------------------------------------------------------------- sizes

    def mixture(self, component: Component, state: State, variant: Variant) -> Mixture:
        """Compute the sizes of a component's columns; by default from the linear model."""
        return linear_mixture(component, state, variant)

    def estimate(self, fit: SizeFit) -> Sizes:
        """Estimate parameters with their standard errors; by axis if there are several."""
        out: dict[str, Size] = {}
        points: list[dict[str, float | str]] = []
        # of a parameter that the axes share, the value on the strongest comes last and stays
        for component in sorted(fit.components, key=lambda component: component.evidence_nats):
            if component.variant.columns[:1] == ("any",):
                continue
            averaged = average_sizes(component, fit.state)
            for number, name in enumerate(component.variant.columns):
                value = float(averaged.mean[number])
                sd = float(np.sqrt(averaged.covariance[number, number]))
                ends = averaged.ends[:, number]
                size: Size = (value, sd, *ends.tolist())
                likeliest = float(averaged.likeliest_sizes[number])
                if component.variant.squared:
                    size = (*_square_root(value, sd), *np.sqrt(np.maximum(ends, 0.0)))
                    likeliest = float(np.sqrt(max(likeliest, 0.0)))
                key = fit.key(name, component.row[0])
                out[key], fit.likeliest[key] = size, likeliest
            out |= averaged.nuisance
            points.append(dict(averaged.likeliest_variant.values))
        if all(point == points[0] for point in points):
            fit.likeliest.update(points[0] if points else {})
        else:  # axes that differ in a common parameter
            fit.likeliest.clear()
        return out

    # ---------------------------------------------------------------------- explanation

    def can_explain(
        self, component: Component, region: Region, blocks: xr.Dataset, settings: Settings
    ) -> bool:
        """Return whether a component of an effect can show in a mismatch."""
        return region["view"] in self.explained_views

    def is_modelled_in(self, region: Region, *, together: bool) -> bool:
        """Return whether the baseline with the effects contains what an effect does to a mismatch.

        `together` says whether several axes of the effect wander together there.
        """
        return region["view"] in self.modelled_views

    def averaging_times(self, component: Component, blocks: xr.Dataset) -> tuple[float, float]:
        """Return the averaging times [s] at which a component shows; by default within a block."""
        return 1.0 / float(blocks.attrs["sampling_rate_hz"]), float(blocks.attrs["block_s"])

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        """Describe a mismatch in a sentence without its full stop; `when` is its time.

        The mismatch is a `Region`, but with a list of axes.
        """
        raise NotImplementedError(f"{self.name} locates no mismatches")


def _square_root(square: float, sd: float) -> tuple[float, float]:
    """Return a size and its error from those of its square."""
    value = float(np.sqrt(max(square, 0.0)))
    return value, sd / (2.0 * value) if square > sd else float(
        np.sqrt(max(square, 0.0) + sd)
    ) - value


def choose_columns(
    values: dict[str, Any], designs: Mapping[str, Array], *, squared: bool = False
) -> Iterator[Variant]:
    """Yield a variant with each parameter alone, and one with all together."""
    for chosen in [*((name,) for name in designs), *([(*designs,)] if len(designs) > 1 else [])]:
        design = np.stack([designs[name] for name in chosen])
        yield Variant(values, chosen, design, squared=squared)

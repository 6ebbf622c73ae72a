"""Random walks in the block means that follow a channel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.diagnose.baseline.axis_means import MAX_SCATTER
from gyrostab.diagnose.baseline.posterior import visible_coefficients
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.evidence.held_out import Tier, mean_factors, mean_residual
from gyrostab.diagnose.evidence.wandering import expected_processes, with_process
from gyrostab.diagnose.predict.average_sizes import Size, plain_places
from gyrostab.diagnose.predict.candidates import (
    Candidate,
    CandidateEvidence,
    Component,
    Prospect,
    Variant,
)
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import Trial
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics.base import Region, SizeFit, Sizes
from gyrostab.diagnose.statistics.mean import BlockMeanStatistic, mean_inputs
from gyrostab.units import HOUR

#: Sizes of a walk that are tried, and those that its size is estimated from: decades above the walk
#: that the means just show, of the first, and between two. Design choice: half decades, and 12 %.
_WALK_DECADES = (0.0, 0.5)
_FINE_DECADES = (-0.5, 0.05)
_LAST_DECADE = 3.0  # of sizes, where the means scatter less; design choice


class RandomProcess(BlockMeanStatistic):
    """A random walk in the block means, present only while its channel is active or far too strong.

    No null record or score is its own. The flicker and random walk of the noise are free in its
    evidence, within their grid, so that a steady walk shows only beyond the grid.
    """

    name = "random_process"
    explained_views = ("mean", "davar", "restart", "cross_axis")
    containing_views = ()
    unsupported_as = "~red"
    null_variable = "mean"
    has_course = True
    has_size = False
    takes_noise = False

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield random walks whose strength changes in time."""
        for name, (time, variance) in prospect.prediction.wander.items():
            if np.isinf(time) and np.ptp(variance) > 0.0:
                yield Variant(prospect.values, (name,), np.asarray(variance)[None], squared=True)

    def nuisance_alternatives(self, blocks: xr.Dataset) -> list[Candidate]:
        """Return a steady random walk beyond that of the calibration."""
        steady = Variant({}, ("walk",), np.ones((1, blocks.sizes["block"])), squared=True)
        return [Candidate("~red", self, (), (steady,))]

    def evidence(self, group: Sequence[Candidate], trial: Trial) -> list[CandidateEvidence]:
        """Compute the Bayes factor of random walks that follow a channel, of any size.

        It needs no held-out data: the walk has no course that could be fitted to the record.
        """
        out = []
        for candidate in group:
            prior = np.array([variant.weight for variant in candidate.variants])
            evidence_nats, best = [], []
            for axis in trial.state.axes:
                compute = partial(_factors_by_variant, candidate, axis, trial)
                of_sizes = trial.recall(compute, [candidate], *mean_inputs(trial, axis))
                # (variant, record)
                factors = np.stack(
                    [
                        np.logaddexp.reduce(by_size, axis=0) - np.log(len(by_size))
                        for _, by_size in of_sizes
                    ]
                )
                factors = factors + np.log(prior / prior.sum())[:, None]
                evidence_nats.append(np.logaddexp.reduce(factors, axis=0))
                variant = _plain_or_best(candidate, factors[:, 0], trial.state.settings)
                if not candidate.driver:
                    size, _ = _average_size(*of_sizes[0])
                    variant = replace(variant, design=size**2 * variant.design)
                best.append(variant)
            rows = self.rows(candidate, trial.state)
            out.append(
                CandidateEvidence(candidate, rows, np.stack(evidence_nats, axis=-1), tuple(best))
            )
        return out

    def condition(self, state: State, component: Component) -> State:
        """Put a random walk into the noise of the means.

        A steady one keeps the size that it was found with: without another effect of that time, it
        would take the course of this effect as well, and leave it nothing.
        """
        walk = component.variant.design[0]
        if component.candidate.driver:
            size, _ = _walk_size(component, state)
            walk = size**2 * walk
        return replace(state, baseline=with_process(state.baseline, component.row[0], walk))

    def estimate(self, fit: SizeFit) -> Sizes:
        """Estimate the size of a random walk that follows a channel, for its best exponent."""
        out: dict[str, Size] = {}
        for component in fit.components:
            (name,) = component.variant.columns
            key = fit.key(name, component.row[0])
            out[key] = _walk_size(component, fit.state)
        return out

    def is_modelled_in(self, region: Region, *, together: bool) -> bool:
        """Return whether the baseline contains it: axes that wander together are in no model."""
        return not together


def _plain_or_best(candidate: Candidate, evidence_nats: Array, settings: Settings) -> Variant:
    """Return the variant with the default exponent, unless another explains clearly more."""
    best = int(evidence_nats.argmax())
    if len(candidate.variants) == 1:
        return candidate.variants[0]
    plain = [
        place
        for place in plain_places(candidate.effect, candidate.variants)
        if evidence_nats[place] > evidence_nats[best] - settings.ambiguous_nats
    ]
    return candidate.variants[plain[0] if plain else best]


def _factors_by_variant(candidate: Candidate, axis: str, trial: Trial) -> list[tuple[Array, Array]]:
    """Return the sizes (size,) and factors (size, record) of each variant."""
    return [
        _walk_factors(variant, axis, trial.data, trial.state, _WALK_DECADES)
        for variant in candidate.variants
    ]


def _walk_factors(
    variant: Variant,
    axis: str,
    data: xr.Dataset,
    state: State,
    decades: tuple[float, float],
    *,
    tier: Tier = "free",
) -> tuple[Array, Array]:
    """Return sizes of a walk (size,), and the log Bayes factors of each (size, record).

    They are those where the channel is most active, up to one as large as the scatter of the means.
    `decades` are those of the first above a walk that the means just show, and between two.
    """
    baseline, folds = state.baseline, fold_blocks(data).isel(length=slice(0, 0))
    processes = expected_processes(baseline, axis)
    block, count = float(data.attrs["block_s"]), data.sizes["block"]
    density = block * float(np.nanmedian(baseline["mean_variance"].sel(axis=axis)))
    visible, _ = visible_coefficients(density, block * count)
    means = mean_residual(state.blocks, baseline, axis)[:, 0]
    scatter = np.diff(means[np.isfinite(means)]).std() * np.sqrt(HOUR / block)
    first, step = decades
    last = max(_LAST_DECADE, np.log10(max(MAX_SCATTER * scatter / visible, 1.0)))
    sizes = visible * 10.0 ** np.arange(first, last + step, step)
    sizes /= np.sqrt(HOUR * variant.design.max())

    def log_evidence(walk: Array) -> Array:
        factors = mean_factors(
            data,
            baseline,
            [],
            axis=axis,
            tier=tier,
            given=state.given_to("mean", axis),
            folds=folds,
            wander=processes._replace(walk=processes.walk + walk),
        )
        return np.asarray(factors[0, 0])

    without = log_evidence(np.zeros(count))
    return sizes, np.stack([log_evidence(size**2 * variant.design[0]) - without for size in sizes])


def _walk_size(component: Component, state: State) -> tuple[float, float]:
    """Return the size of a walk that follows a channel in calibrated noise, and its error."""
    sizes, factors = _walk_factors(
        component.variant, component.row[0], state.blocks, state, _FINE_DECADES, tier="calibrated"
    )
    return _average_size(sizes, factors)


def _average_size(sizes: Array, factors: Array) -> tuple[float, float]:
    """Return mean and standard deviation of a size (size,) by its factors (size, record)."""
    weight = np.exp(factors[:, 0] - np.logaddexp.reduce(factors[:, 0]))
    mean = float(weight @ sizes)
    return mean, float(np.sqrt(weight @ (sizes - mean) ** 2))

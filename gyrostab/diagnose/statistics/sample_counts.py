"""Score of sample counts unlike Gaussian noise: outliers, repeats, clipping, zeros, tails."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.folds import fold_subsets
from gyrostab.diagnose.evidence.sample_counts import (
    CountEvidence,
    excess_extremes,
    hidden_by_grid,
    kurtosis_evidence,
    kurtosis_moments,
    sample_count_evidence,
)
from gyrostab.diagnose.predict.candidates import (
    Candidate,
    CandidateEvidence,
    Component,
    Prospect,
    Variant,
)
from gyrostab.diagnose.predict.condition import free_shape
from gyrostab.diagnose.predict.linear_model import State, cross_without
from gyrostab.diagnose.predict.search import Trial
from gyrostab.diagnose.reduce.label_statistics import MIN_MEAN_SHARE
from gyrostab.diagnose.reduce.zero_bin import sticking_axes
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics.base import NullDraw, Region, SizeFit, Sizes, Statistic
from gyrostab.diagnose.statistics.null_counts import null_counts
from gyrostab.diagnose.statistics.sample_sizes import estimate_from_counts
from gyrostab.diagnose.statistics.scores import (
    Array,
    statistic_dataset,
    sum_over_windows,
    window_set,
)
from gyrostab.diagnose.statistics.wording import subject

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (1, 5, 15)
#: Counts of samples.
COUNTS = ("outliers", "repeats", "extremes", "zeros")
_SAMPLES = {
    "outliers": "outliers",
    "repeats": "more repeated samples than noise produces",
    "extremes": "many samples at the same smallest or largest value",
    "zeros": "samples that are exactly zero",
    "kurtosis": "a sample distribution that is not normal",
    "lattice": "values on a coarse quantization grid",
}
_NEAR_ZERO = ("stuck", "filled")  # anomalous samples that differ from a rate far from zero
_MAX_BLOCK_SIGMA = 4.0  # of the kurtosis of one block: the counts judge single outliers
#: Least scatter of the scores: if null records never have one, a single one is not a mismatch.
_MIN_SCATTER = (0.35, 0.35, 0.35, 0.35, 0.2)


class SampleCounts(Statistic):
    """Sample counts unlike Gaussian noise: outliers, repeats, clipping, zeros, tails."""

    name = "sample_counts"
    view = "distribution"
    explains = ("distribution", "davar", "spectrum", "cross_axis")
    contained_in = ("davar", "mean", "restart", "cross_axis")
    nuisance_alternative = "~outliers"
    error_shows_in = ("sample_counts",)
    is_count = True
    has_size = False
    takes_noise = False

    def nuisance_alternatives(self, blocks: xr.Dataset) -> list[Candidate]:
        """Return a distribution with heavy tails."""
        return [Candidate("~outliers", self, (), (Variant({}, ("kurtosis",), np.empty(0)),))]

    def null(self, draw: NullDraw) -> Mapping[str, NDArray[Any]]:
        return null_counts(draw.blocks, draw.sample_sd, draw.record_count, draw.rng)

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
        """Score counts and kurtosis in windows of three lengths and of the whole record.

        Anscombe's root makes the scatter of the counts equal; null records define their
        expectation. With a coarse quantization grid, counts that the grid alone changes are left
        out. ``ratio`` and ``estimate`` are the count, or the mean kurtosis.
        """
        windows = window_set(blocks.sizes["block"], LENGTHS)
        samples = blocks["samples"].values.astype(float)
        counts_by_block = {
            name: np.nan_to_num(blocks[name].values.astype(float)) for name in COUNTS
        }
        counts_by_block["extremes"] = excess_extremes(counts_by_block["extremes"])
        counts = sum_over_windows(
            np.stack([counts_by_block[name] for name in COUNTS], axis=-1), windows
        )
        tail_score, used = _kurtosis_score(blocks["kurtosis"].values, samples)
        # Rounding has no tails, so that the noise itself may differ from 0.
        usual = np.median(tail_score, axis=-1, keepdims=True)
        tail_score = np.where(
            used > 0, usual + np.clip(tail_score - usual, -_MAX_BLOCK_SIGMA, _MAX_BLOCK_SIGMA), 0.0
        )
        excess = np.where(used > 0, np.nan_to_num(blocks["kurtosis"].values), 0.0)
        n, tail_sum, excess_sum = (
            sum_over_windows(values[..., None], windows) for values in (used, tail_score, excess)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            tails, mean = np.where(n > 0, tail_sum / np.sqrt(n), np.nan), excess_sum / n
        rate = float(blocks.attrs["sampling_rate_hz"])
        number = np.concatenate([counts, np.broadcast_to(mean, tails.shape)], axis=-1)
        z = np.concatenate([2.0 * np.sqrt(counts + 0.375), tails], axis=-1)
        hidden = np.stack([hidden_by_grid(blocks, name) for name in (*COUNTS, "kurtosis")], axis=-1)
        z = np.where(hidden[:, None, :], np.nan, z)
        return statistic_dataset(
            blocks,
            windows=windows,
            columns={
                "what": [*COUNTS, "kurtosis"],
                "tau_min_s": 1.0 / rate,
                "tau_max_s": 1.0 / rate,
                "floor": _MIN_SCATTER,
            },
            z=z,
            ratio=number,
            estimate=number,
        )

    def design(self, case: Prospect) -> Iterator[Variant]:
        """Yield the counts that the effect raises."""
        if case.prediction.marks:
            yield Variant(case.values, case.prediction.marks, np.empty(0))

    def evidence(self, group: Sequence[Candidate], trial: Trial) -> list[CandidateEvidence]:
        if trial.counts is None:
            return []
        subsets = fold_subsets(trial.folds)
        rows = self.rows(group[0], trial.state)
        sticks = sticking_axes(trial.state.blocks)  # repeats of one value are not held samples
        out = []
        for candidate in group:
            evidence_nats = []
            for variant in candidate.variants:
                by_name = [
                    np.where(
                        hidden_by_grid(trial.state.blocks, name) | (sticks & (name == "repeats")),
                        0.0,
                        _count_evidence(name, trial.data, trial.state, subsets, trial.counts),
                    )
                    for name in variant.columns
                ]
                evidence_nats.append(np.max(by_name, axis=0))
            place = np.argmax([by_axis[0] for by_axis in evidence_nats], axis=0)
            best = tuple(candidate.variants[int(number)] for number in place)
            out.append(CandidateEvidence(candidate, rows, np.max(evidence_nats, axis=0), best))
        return out

    def condition(self, state: State, component: Component) -> State:
        """Leave out blocks with anomalous samples; if too many, free the shape of the spectrum."""
        if _is_everywhere(component):
            return state
        blocks = mask_anomalous_blocks(state.blocks, [component], state.settings)
        if blocks is state.blocks:
            return free_shape(state, component.row[0])
        return replace(state, blocks=blocks)

    def moves_means(self, component: Component) -> bool:
        """Return whether samples are zero; outliers move only the means of blocks with outliers."""
        return component.variant.columns[0] in _NEAR_ZERO

    def has_power_of_effect(self, component: Component, state: State) -> bool:
        """Return whether no block is left out: with the blocks their power may be left out too."""
        return not find_anomalous_blocks(component, state.blocks, state.settings).any()

    def estimate(self, fit: SizeFit) -> Sizes:
        return estimate_from_counts(
            fit.components[0].candidate.effect,
            fit.components[0].variant.columns[0],
            fit.components[0].row[0],
            fit.state.blocks,
            fit.counts,
            fit.state.settings,
        )

    def is_modelled_in(self, region: Region, *, together: bool) -> bool:
        """Return whether the mismatch is of several axes: anomalous blocks are left out there."""
        return bool(region["view"] == "cross_axis")

    def describe(self, region: Region, when: str) -> str:
        samples = _SAMPLES.get(str(region["what"]), "an unusual distribution of its samples")
        verb = "has" if len(region["axes"]) == 1 else "have"
        return f"{subject(region)} {verb} {samples} {when}"


def _kurtosis_score(excess: Array, samples: Array) -> tuple[Array, Array]:
    """Return the normal score of the excess kurtosis of Gaussian samples, and 1 where known.

    Anscombe and Glynn (1983), doi:10.1093/biomet/70.1.227.

    Examples
    --------
    >>> z, used = _kurtosis_score(np.array([0.0, 0.5]), np.array([2000.0, 2000.0]))
    >>> z.round(1)
    array([0.1, 3.8])
    """
    n = np.maximum(samples, 4.0)
    mean, variance, a = kurtosis_moments(n)
    used = np.isfinite(excess) & (samples >= 20)
    with np.errstate(invalid="ignore"):
        x = np.where(used, (excess - mean) / np.sqrt(variance), 0.0)
        base = 1.0 + x * np.sqrt(2.0 / (a - 4.0))
        z = ((1.0 - 2.0 / (9.0 * a)) - np.cbrt((1.0 - 2.0 / a) / np.maximum(base, 1e-9))) / np.sqrt(
            2.0 / (9.0 * a)
        )
    return np.where(used, z, 0.0), used.astype(float)


def _count_evidence(
    name: str,
    data: xr.Dataset,
    state: State,
    subsets: NDArray[np.bool_],
    count_evidence: CountEvidence,
) -> Array:
    """Return the evidence of a raised count, (record, axis)."""
    records = data.sizes.get("record", 1)
    if name == "lattice":
        # one nat for each sample of a rounded rate: unrounded noise is never on the grid
        is_rounded = count_evidence.rounded.size > 0 and "record" not in data.dims
        samples = state.blocks["samples"].values.sum(axis=1).astype(np.float64)
        nats = np.where(count_evidence.rounded, samples, 0.0) if is_rounded else 0.0
        return np.broadcast_to(nats, (records, len(state.axes)))
    if name not in count_evidence.of:
        return np.zeros((records, len(state.axes)))
    values = data[name].values.astype(np.float64)
    values = values if values.ndim == 3 else values[None]
    values = excess_extremes(values) if name == "extremes" else values
    if name == "kurtosis":  # that of a block with a moving mean is not that of noise
        values = np.where(state.masked, np.nan, values)
    compute = kurtosis_evidence if name == "kurtosis" else sample_count_evidence
    return compute(values, *count_evidence.of[name], subsets)


def _is_everywhere(component: Component) -> bool:
    """Return whether the samples are anomalous in all blocks alike."""
    return (
        component.candidate.effect == "rate_quantization"
        or component.candidate.effect.startswith("~")
    )


def find_anomalous_blocks(
    component: Component, blocks: xr.Dataset, settings: Settings = DEFAULTS
) -> NDArray[np.bool_]:
    """Return the blocks left out for anomalous samples; none if all are alike.

    None either if fewer than the least quiescent share of the blocks would be left.
    """
    samples = blocks["samples"].sel(axis=component.row[0]).values
    has_samples = samples > MIN_MEAN_SHARE * samples.max(initial=0)
    if _is_everywhere(component) or not has_samples.any():
        return np.zeros(has_samples.size, np.bool_)
    count = blocks[component.variant.columns[0]].sel(axis=component.row[0]).values
    # The noise has a negligible number of outliers.
    usual = (
        0.0 if component.variant.columns[0] == "outliers" else float(np.median(count[has_samples]))
    )
    anomalous = count > usual + settings.clear_sigma * np.sqrt(max(usual, 0.0))
    return np.asarray(anomalous & (anomalous[has_samples].mean() <= 1.0 - settings.quiescent_share))


def mask_anomalous_blocks(
    blocks: xr.Dataset, components: Iterable[Component], settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Leave out blocks with named anomalous samples, whose powers have no model."""
    axes = [str(axis) for axis in blocks["axis"].values]
    anomalous = np.zeros((len(axes), blocks.sizes["block"]), np.bool_)
    for component in (component for component in components if component.statistic.is_count):
        anomalous[axes.index(component.row[0])] |= find_anomalous_blocks(
            component, blocks, settings
        )
    if not anomalous.any():
        return blocks
    usable = xr.DataArray(~anomalous, dims=("axis", "block"))
    return blocks.assign(
        mean=blocks["mean"].where(usable),
        power=blocks["power"].where(usable),
        cross=cross_without(blocks, anomalous),
    )

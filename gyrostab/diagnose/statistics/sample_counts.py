"""Score of sample counts unlike Gaussian noise: outliers, repeats, clipping, zeros, tails."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from scipy.special import ndtr

from gyrostab.arrays import Array, Bools, Floats, Ints
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
    is_nuisance,
)
from gyrostab.diagnose.predict.condition import free_shape
from gyrostab.diagnose.predict.linear_model import State, cross_without
from gyrostab.diagnose.predict.search import Trial
from gyrostab.diagnose.predict.windows import fill_linearly
from gyrostab.diagnose.reduce.label_statistics import MIN_MEAN_SHARE
from gyrostab.diagnose.reduce.outliers import (
    EXPECTED_FALSE_OUTLIERS,
    probability_all_zero,
    zeros_beyond_chance,
)
from gyrostab.diagnose.reduce.zero_bin import sticking_axes, truncated_axes
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics.base import NullDraw, SizeFit, Sizes, Statistic
from gyrostab.diagnose.statistics.mismatch_wording import capitalise_axes
from gyrostab.diagnose.statistics.sample_sizes import estimate_from_counts
from gyrostab.diagnose.statistics.scores import statistic_dataset, sum_over_windows, window_set

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (1, 5, 15)
#: Counts whose mismatches are located.
SCORED_COUNTS = ("outliers", "repeats", "extremes", "zeros")
_COUNT_TEXTS = {
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
#: Standard deviations in a quantization step from which the values have few levels. Design choice.
COARSE_STEP_SIGMA = 1.5
_FINE_STEP = 0.3  # / scatter of differences; the next term is 3e-5 of the probability there
_QUADRATURE_NODES = 12  # over a bin: exact to 1e-6 up to 4 standard deviations of a step
_MAX_LEVELS = 400  # on either side of the mean; more than any step above `_FINE_STEP` needs
_MAX_CORRELATION = 0.9999
_TRUNCATION_ROUNDS = 20  # of an iteration that halves its error
#: Error of the expected share of repeats and zeros: noise is not exactly normal, and its scatter
#: varies within a block. Design choice.
_CHANCE_ERROR_SHARE = 0.03


class SampleCounts(Statistic):
    """Sample counts unlike Gaussian noise: outliers, repeats, clipping, zeros, tails."""

    name = "sample_counts"
    view = "distribution"
    explained_views = ("distribution", "davar", "spectrum", "cross_axis")
    containing_views = ("davar", "mean", "restart", "cross_axis")
    modelled_views = ("cross_axis",)  # anomalous blocks are left out there
    unsupported_as = "~outliers"
    is_count = True
    has_size = False
    takes_noise = False

    def nuisance_alternatives(self, blocks: xr.Dataset) -> list[Candidate]:
        """Return a distribution with heavy tails."""
        return [Candidate("~outliers", self, (), (Variant({}, ("kurtosis",), np.empty(0)),))]

    def null(self, draw: NullDraw) -> Mapping[str, Array]:
        return _draw_null_counts(draw.blocks, draw.sample_sd, draw.record_count, draw.rng)

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
        """Score counts and kurtosis in windows of three lengths and of the whole record.

        Anscombe's root makes the scatter of the counts equal; null records define their
        expectation. With a coarse quantization grid, counts that the grid alone changes are left
        out. ``ratio`` and ``estimate`` are the count, or the mean kurtosis.
        """
        windows = window_set(blocks.sizes["block"], LENGTHS)
        samples = blocks["samples"].values.astype(float)
        counts_by_block = {
            name: np.nan_to_num(blocks[name].values.astype(float)) for name in SCORED_COUNTS
        }
        counts_by_block["extremes"] = excess_extremes(counts_by_block["extremes"])
        counts = sum_over_windows(
            np.stack([counts_by_block[name] for name in SCORED_COUNTS], axis=-1), windows
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
        hidden = np.stack(
            [hidden_by_grid(blocks, name) for name in (*SCORED_COUNTS, "kurtosis")], axis=-1
        )
        z = np.where(hidden[:, None, :], np.nan, z)
        return statistic_dataset(
            blocks,
            windows=windows,
            columns={
                "quantity": [*SCORED_COUNTS, "kurtosis"],
                "tau_min_s": 1.0 / rate,
                "tau_max_s": 1.0 / rate,
                "floor": _MIN_SCATTER,
            },
            z=z,
            ratio=number,
            estimate=number,
        )

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield the counts that the effect raises."""
        if prospect.prediction.marks:
            yield Variant(prospect.values, prospect.prediction.marks, np.empty(0))

    def evidence(self, group: Sequence[Candidate], trial: Trial) -> list[CandidateEvidence]:
        if trial.count_evidence is None:
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
                        _count_evidence(
                            name, trial.data, trial.state, subsets, trial.count_evidence
                        ),
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
            fit.count_evidence,
            fit.state.settings,
        )

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        samples = _COUNT_TEXTS.get(region["quantity"], "an unusual distribution of its samples")
        verb = "has" if len(region["axes"]) == 1 else "have"
        return f"{capitalise_axes(region['axes'])} {verb} {samples} {when}"


def _kurtosis_score(excess: Floats, samples: Floats) -> tuple[Floats, Floats]:
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
    name: str, data: xr.Dataset, state: State, subsets: Bools, count_evidence: CountEvidence
) -> Floats:
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
    return component.candidate.effect == "rate_quantization" or is_nuisance(
        component.candidate.effect
    )


def find_anomalous_blocks(
    component: Component, blocks: xr.Dataset, settings: Settings = DEFAULTS
) -> Bools:
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


def _draw_null_counts(
    blocks: xr.Dataset, sd: Floats, count: int, rng: np.random.Generator
) -> dict[str, Ints]:
    """Draw outliers, repeats, extremes and zeros of Gaussian noise on the quantization grid.

    Repeats and zeros (record, axis, block) follow from the scatter of each block, and from the
    correlation of neighbouring samples that its band powers give. The standard deviations (axis, 2)
    are of a sample and of a difference of neighbours [degree hour-1].
    """
    samples = blocks["samples"].values.astype(np.int64)
    adjacent = blocks["adjacent"].values.astype(np.int64)
    mean = [np.nan_to_num(fill_linearly(row)) for row in blocks["mean"].values]
    scatter, correlation = _neighbour_statistics(blocks, sd)
    truncated = truncated_axes(blocks)
    nothing = np.zeros(samples.shape[1])
    chances = [
        _grid_chance(mean[axis], float(step), scatter[axis], correlation[axis], truncated[axis])
        if step > 0.0
        else (nothing, nothing, nothing)
        for axis, step in enumerate(blocks["quantization_step"].values)
    ]
    has_zeros = blocks["zeros"].values.any(axis=1, keepdims=True)
    zero, zero_again, repeat = (np.stack(part) for part in zip(*chances, strict=True))
    size = (count, *samples.shape)
    outliers = EXPECTED_FALSE_OUTLIERS * samples / np.maximum(samples.sum(axis=1, keepdims=True), 1)
    # an error of the probabilities is common to all blocks of an axis
    error = 1.0 + _CHANCE_ERROR_SHARE * rng.standard_normal((count, len(samples), 1))
    zeros = rng.binomial(samples, np.clip(np.where(has_zeros, zero, 0.0) * error, 0.0, 1.0))
    filled = _filled_zeros(blocks, zeros, samples, zero_again, rng)
    return {
        "outliers": rng.poisson(np.broadcast_to(outliers, size)),
        "repeats": rng.binomial(adjacent, np.clip(repeat * error, 0.0, 1.0)),
        "zeros": zeros,
        "stuck": zeros - filled,
        "filled": filled,
        "extremes": _draw_extremes(blocks, sd, samples, count, rng),
    }


def _neighbour_statistics(blocks: xr.Dataset, sd: Floats) -> tuple[Floats, Floats]:
    """Measure the scatter of the samples of each block, and the correlation of neighbours.

    Both (axis, block) are interpolated over blocks with losses or outliers. The standard deviations
    are as in `_draw_null_counts`, for axes without measured powers.
    """
    rate = float(blocks.attrs["sampling_rate_hz"])
    low, high = blocks["band_low"].values, blocks["band_high"].values
    cosine = np.cos(2.0 * np.pi * blocks["line_frequency"].values / rate)
    lines = np.nan_to_num(blocks["line_power"].values).mean(axis=1)
    band = np.searchsorted(high, blocks["line_frequency"].values).clip(0, high.size - 1)
    scatter, correlation = np.empty((2, *blocks["power"].shape[:2]))
    for axis, power in enumerate(blocks["power"].values):
        total = np.bincount(band, weights=lines[axis], minlength=high.size)
        shape = np.bincount(band, weights=lines[axis] * cosine, minlength=high.size)
        centre = np.cos(np.pi * (low + high) / rate)
        in_band = np.divide(shape, total, out=centre, where=total > 0.0)
        variance = 2.0 * power @ (high - low)
        lagged = 2.0 * power @ ((high - low) * in_band)
        good = np.isfinite(variance) & (variance > 0.0)
        typical = good & (blocks["outliers"].values[axis] == 0)
        good = typical if typical.any() else good
        if good.any():
            scatter[axis] = np.sqrt(fill_linearly(np.where(good, variance, np.nan)))
            with np.errstate(divide="ignore", invalid="ignore"):
                correlation[axis] = fill_linearly(np.where(good, lagged / variance, np.nan))
        else:
            scatter[axis] = sd[axis, 0]
            correlation[axis] = 1.0 - 0.5 * (sd[axis, 1] / sd[axis, 0]) ** 2
    return scatter, np.clip(correlation, -_MAX_CORRELATION, _MAX_CORRELATION)


def _filled_zeros(
    blocks: xr.Dataset, zeros: Ints, samples: Ints, zero_again: Floats, rng: np.random.Generator
) -> Ints:
    """Return the zeros (record, axis, block) that look filled because they coincide by chance.

    On a single axis these are zeros next to another one, whose probability is `zero_again`.
    """
    subset = blocks["axes_at_once"].values.astype(bool)
    number = blocks["at_once"].values.astype(np.int64)
    share = zeros / np.maximum(samples, 1)
    if len(samples) == 1:
        # rare ones come in pairs, and rare zeros alone exclude each other: variance 2 z p (1 - p)^2
        chance = 1.0 - (1.0 - zero_again) ** 2
        scatter = np.sqrt(2.0 * zeros * chance) * (1.0 - chance)
        drawn = np.rint(zeros * chance + scatter * rng.standard_normal(zeros.shape))
        coinciding = np.clip(drawn, 0, zeros).astype(np.int64)
    elif not zeros.any():
        coinciding = np.zeros_like(zeros)
    else:
        at_once = rng.binomial(number, probability_all_zero(share, subset))
        coinciding = np.minimum(np.einsum("sa,rsb->rab", subset.astype(np.int64), at_once), zeros)
    return zeros_beyond_chance(coinciding, zeros, samples, subset, number)


def _grid_chance(
    mean: Floats, step: float, scatter: Floats, correlation: Floats, truncated: bool
) -> tuple[Floats, Floats, Floats]:
    """Return the probabilities, by block, of correlated normal noise on a grid.

    They are those of zero, of zero again after a zero, and of a repeat at another value. The values
    before rounding are normal, and so are pairs of neighbours. A pair is in one bin with the
    integral of its normal density over the square of that bin: by Gauss-Legendre quadrature, bin by
    bin. Fine grids have many bins; the difference of neighbours then decides, with a triangular
    weight, P = s / (sqrt(2 pi) d) (1 - s^2 / (12 d^2)) for the step s and the standard deviation d
    of differences.
    """
    variance = np.maximum(scatter**2 - step**2 / 12.0, (0.05 * step) ** 2)
    # rounding errors of coarse grids are independent: the correlation is that before rounding
    inner = np.sqrt(variance)
    rho = np.clip(correlation * scatter**2 / variance, -_MAX_CORRELATION, _MAX_CORRELATION)
    centre = _before_truncation(mean, step, inner) if truncated else mean
    half_zero = step if truncated else 0.5 * step
    zero, both_zero = _chance_in_bin(-centre, half_zero, inner, rho)
    zero_again = np.divide(both_zero, zero, out=np.zeros_like(zero), where=zero > 0.0)
    difference = inner * np.sqrt(2.0 - 2.0 * rho)
    ratio = step / difference
    if (ratio < _FINE_STEP).all():
        any_bin = ratio / np.sqrt(2.0 * np.pi) * (1.0 - ratio**2 / 12.0)
        plain_zero = _chance_in_bin(-centre, 0.5 * step, inner, rho)[1]
        repeat = any_bin - plain_zero
    else:
        reach = int(min(np.ceil(6.0 * inner.max() / step) + 1, _MAX_LEVELS))
        nearest = np.round(centre / step)
        repeat = np.zeros(mean.size)
        for level in range(-reach, reach + 1):
            place = nearest + level
            pair_chance = _chance_in_bin(place * step - centre, 0.5 * step, inner, rho)[1]
            repeat += np.where(np.abs(place * step) < half_zero, 0.0, pair_chance)
    return zero, zero_again, np.clip(repeat, 0.0, 1.0)


def _chance_in_bin(
    middle: Floats, half: float, scatter: Floats, correlation: Floats
) -> tuple[Floats, Floats]:
    """Return the probabilities that a sample, and a pair of neighbours, are in a bin.

    The middle of the bin is relative to the mean of the samples; `half` is half of its width.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE_NODES)
    value = middle[:, None] + half * nodes
    density = np.exp(-0.5 * (value / scatter[:, None]) ** 2) / np.sqrt(2.0 * np.pi)
    density *= half * weights / scatter[:, None]
    conditional_scatter = (scatter * np.sqrt(1.0 - correlation**2))[:, None]
    shift = middle[:, None] - correlation[:, None] * value
    pair_density = density * (
        ndtr((shift + half) / conditional_scatter) - ndtr((shift - half) / conditional_scatter)
    )
    chance = ndtr((middle + half) / scatter) - ndtr((middle - half) / scatter)
    return np.asarray(chance), np.asarray(pair_density.sum(axis=1))


def _before_truncation(mean: Floats, step: float, scatter: Floats) -> Floats:
    """Return means before truncation, which shifts them by up to half a step towards zero."""
    out = mean
    for _ in range(_TRUNCATION_ROUNDS):
        out = mean + step * (ndtr(out / scatter) - 0.5)
    return out


def _draw_extremes(
    blocks: xr.Dataset, sd: Floats, samples: Ints, count: int, rng: np.random.Generator
) -> Ints:
    """Draw the blocks of the smallest and largest value; each is repeated on a coarse grid."""
    out = np.zeros((count, *samples.shape), np.int64)
    for axis, step in enumerate(blocks["quantization_step"].values):
        total = int(samples[axis].sum())
        if not total:
            continue
        share = samples[axis] / total
        many = np.ones((count, 2), np.int64)
        ratio = float(step) / float(sd[axis, 0])
        if ratio > 1e-3:
            edges = np.arange(8.0, 0.0, -ratio)[:, None, None] + ratio * rng.random((count, 2))
            in_bins = rng.poisson(total * (ndtr(ratio - edges) - ndtr(-edges)))
            first = np.argmax(in_bins > 0, axis=0)
            many = np.maximum(np.take_along_axis(in_bins, first[None], axis=0)[0], 1)
        out[:, axis] = rng.multinomial(many.sum(axis=1), share)
    return out

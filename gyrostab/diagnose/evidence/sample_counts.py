"""Evidence from counts of anomalous samples, which are not linear in a few designs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from scipy.special import gammaln

from gyrostab.arrays import Array, Bools, Floats
from gyrostab.diagnose.evidence.folds import FOLDS

#: Counts that effects raise.
RAISED_COUNTS = ("outliers", "repeats", "extremes", "stuck", "filled")
#: What null records have by chance.
EXPECTED = (*RAISED_COUNTS, "kurtosis")
#: Statistics of the distribution that a coarse quantization grid changes.
GRID_COUNTS = ("repeats", "extremes", "zeros", "stuck", "filled", "kurtosis")
#: Counts of `GRID_COUNTS` whose number by chance follows from the scatter of normal noise.
_PREDICTED_COUNTS = ("repeats", "zeros", "stuck", "filled")
_MAX_PREDICTED_SCATTERS = 1.5  # quantization step / scatter of these samples; design choice
#: Excess kurtosis below which 90 % of the blocks of normal noise are, in standard deviations of
#: that of independent normal samples, sqrt(24 / n): 1.3, more with correlated ones. Design choice.
_MAX_NORMAL_KURTOSIS, _NORMAL_SHARE = 2.0, 0.9
_MIN_COARSE_SCATTERS = 0.2  # quantization step / scatter of the samples; design choice
_QUIESCENT_QUANTILE = 0.1  # of the block variances, taken as that at rest; design choice
_CERTAIN_EXTREMES = 2  # the smallest and the largest sample of any record
# Gamma prior of the factor by which a count is raised: nearly flat over its logarithm.
_PRIOR_SHAPE, _PRIOR_RATE = 0.5, 0.05


def has_coarse_grid(blocks: xr.Dataset) -> Bools:
    """Find the axes (axis,) with so coarse a quantization grid that it alone causes `GRID_COUNTS`.

    Examples
    --------
    >>> one = {
    ...     "quantization_step": ("axis", [3.0, 0.1]),
    ...     "power": (("axis", "block", "band"), np.full((2, 9, 1), 0.5)),
    ... }
    >>> bands = {"band_low": ("band", [0.0]), "band_high": ("band", [100.0])}
    >>> has_coarse_grid(xr.Dataset(one, coords=bands))
    array([ True, False])
    """
    return np.asarray(
        blocks["quantization_step"].values > _MIN_COARSE_SCATTERS * quiescent_scatter(blocks)
    )


def hidden_by_grid(blocks: xr.Dataset, name: str) -> Bools:
    """Find the axes (axis,) on which a coarse grid alone causes a count or the kurtosis.

    Repeats and zeros remain usable where noise is normal: null records then have as many.
    """
    coarse = has_coarse_grid(blocks)
    if name not in _PREDICTED_COUNTS or not coarse.any():
        return coarse & (name in GRID_COUNTS)
    in_errors = blocks["kurtosis"].values * np.sqrt(blocks["samples"].values / 24.0)
    by_axis = np.moveaxis(in_errors, -2, 0).reshape(coarse.size, -1)
    is_normal = _finite_quantile(by_axis, _NORMAL_SHARE) < _MAX_NORMAL_KURTOSIS
    step = blocks["quantization_step"].values
    return np.asarray(
        coarse & ~(is_normal & (step < _MAX_PREDICTED_SCATTERS * quiescent_scatter(blocks)))
    )


def quiescent_scatter(blocks: xr.Dataset) -> Floats:
    """Return the scatter of the samples of every axis at rest [degree hour-1]; inf if unknown."""
    width = blocks["band_high"].values - blocks["band_low"].values
    power = blocks["power"].transpose("axis", ..., "band").values
    square = 2.0 * (power @ width).reshape(len(power), -1)
    return np.sqrt(_finite_quantile(square, _QUIESCENT_QUANTILE))


def _finite_quantile(values: Array, share: float) -> Floats:
    """Return the quantile of the finite values of each row, inf without any."""
    finite = [row[np.isfinite(row)] for row in values]
    return np.array([np.quantile(row, share) if row.size else np.inf for row in finite])


def excess_extremes(values: Array) -> Array:
    """Count samples at the ends of the range, without the first two of the record.

    Every record has a smallest and a largest sample. A count of which two are certain is not
    Poisson distributed; without a quantization grid there is never a third one by chance. Counts
    are by (..., block).

    Examples
    --------
    >>> excess_extremes(np.array([[0, 1, 0, 1], [1, 3, 0, 2]]))
    array([[0, 0, 0, 0],
           [0, 2, 0, 2]])
    """
    beyond = np.maximum(np.cumsum(values, axis=-1) - _CERTAIN_EXTREMES, 0)
    return np.asarray(np.diff(beyond, axis=-1, prepend=0))


def kurtosis_moments(n: Array) -> tuple[Array, Array, Array]:
    """Return mean, variance, degrees of freedom of the kurtosis of n samples (Anscombe, Glynn).

    Excess kurtosis of Gaussian samples; Biometrika 70 (1983), doi:10.1093/biomet/70.1.227.
    """
    mean = -6.0 / (n + 1.0)
    variance = 24.0 * n * (n - 2.0) * (n - 3.0) / ((n + 1.0) ** 2 * (n + 3.0) * (n + 5.0))
    skew = (
        6.0
        * (n * n - 5.0 * n + 2.0)
        / ((n + 7.0) * (n + 9.0))
        * np.sqrt(6.0 * (n + 3.0) * (n + 5.0) / (n * (n - 2.0) * (n - 3.0)))
    )
    return mean, variance, 6.0 + 8.0 / skew * (2.0 / skew + np.sqrt(1.0 + 4.0 / skew**2))


def expected_counts(values: Array) -> tuple[Array, Array]:
    """Return the mean count (axis, block) and the overdispersion (axis,) of null records.

    Blocks with few samples, and those far from a counted value, have few. One record with equal
    counts in all blocks is added, so that no mean is 0.
    """
    records, _, block_count = values.shape
    total = values.sum(axis=2)
    mean = np.maximum(total.mean(axis=0), 1.0 / records)
    spread = np.maximum(total.var(axis=0) / mean, 1.0)
    equal_counts = np.broadcast_to(mean[:, None] / block_count, values.shape[1:])
    observed = np.where(total.any(axis=0)[:, None], values.mean(axis=0), equal_counts)
    return (records * observed + equal_counts) / (records + 1.0), spread


@dataclass(frozen=True)
class CountEvidence:
    """Expected sample counts from null records, and the axes with a quantized rate.

    Mean (axis, block) and spread (axis,) by name; of the kurtosis of a block both (axis,).
    """

    of: dict[str, tuple[Array, Array]]
    rounded: Bools = field(default_factory=lambda: np.zeros(0, np.bool_))

    @classmethod
    def gathered(cls, nulls: Sequence[xr.Dataset], rounded: Bools) -> CountEvidence:
        """Compute the expected counts from all null records."""
        moments = {}
        for name in EXPECTED:
            counts = [chunk[name].values.astype(np.float64) for chunk in nulls]
            values = np.concatenate(counts)  # (record, axis, block)
            if name == "kurtosis":
                good = np.isfinite(values)
                clean = np.where(good, values, np.nan)
                moments[name] = (np.nanmean(clean, axis=(0, 2)), np.nanstd(clean, axis=(0, 2)))
            else:
                moments[name] = expected_counts(
                    excess_extremes(values) if name == "extremes" else values
                )
        return cls(moments, rounded)


def _log_ratio(count: Array, mean: Array) -> Array:
    """Return the log Bayes factor of a count raised by an unknown factor."""
    a, b = _PRIOR_SHAPE, _PRIOR_RATE
    raised = (
        gammaln(count + a)
        - gammaln(a)
        + a * np.log(b)
        - (count + a) * np.log(b + mean)
        + count * np.log(mean)
    )
    expected_log = -mean + count * np.log(mean)
    return np.asarray(
        np.where(count > mean, raised - expected_log, np.minimum(raised - expected_log, 0.0))
    )


def _best_held_out(evidence: Array) -> Array:
    """Return the largest over the lengths of the sum over folds, of evidence (..., subset)."""
    gain = evidence[..., :1] - evidence[..., 1:]
    return np.asarray(gain.reshape(*gain.shape[:-1], -1, FOLDS).sum(axis=-1).max(axis=-1))


def sample_count_evidence(values: Array, mean: Array, spread: Array, subsets: Bools) -> Array:
    """Compute the held-out evidence (record, axis) of a raised count (record, axis, block).

    Mean (axis, block) and spread (axis,) are from `expected_counts`, subsets from `fold_subsets`.
    """
    count, expected = ((part @ subsets.T) / spread[:, None] for part in (values, mean))
    return _best_held_out(_log_ratio(count, expected))


def kurtosis_evidence(values: Array, mean: Array, spread: Array, subsets: Bools) -> Array:
    """Compute the held-out evidence of a higher kurtosis, as `sample_count_evidence`.

    `mean` and `spread` are those of a block, (axis,).
    """
    z = np.clip(
        np.where(np.isfinite(values), (values - mean[:, None]) / spread[:, None], 0.0), -8.0, 8.0
    )
    total = (z @ subsets.T) / np.sqrt(subsets.sum(axis=1))
    size = 100.0  # prior variance of the total of the whole record
    prior = size * subsets.mean(axis=1)
    evidence = 0.5 * total**2 * prior / (1.0 + prior) * (total > 0) - 0.5 * np.log1p(prior)
    return _best_held_out(evidence)

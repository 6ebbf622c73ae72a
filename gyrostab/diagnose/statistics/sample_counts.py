"""Score of sample counts unlike Gaussian noise: outliers, repeats, clipping, zeros, tails."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.sample_counts import GRID_COUNTS, excess_extremes, has_coarse_grid
from gyrostab.diagnose.statistics.scores import (
    Array,
    statistic_dataset,
    sum_over_windows,
    values_in_order,
    window_set,
)

__all__ = ["COUNTS", "LENGTHS", "score"]

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (1, 5, 15)
#: Counts of samples.
COUNTS = ("outliers", "repeats", "extremes", "zeros")
_MAX_BLOCK_SIGMA = 4.0  # of the kurtosis of one block: the counts judge single outliers
#: Least scatter of the scores: if null records never have one, a single one is not a mismatch.
_MIN_SCATTER = (0.35, 0.35, 0.35, 0.35, 0.2)


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
    """Score counts and kurtosis in windows of three lengths and of the whole record.

    Anscombe's root makes the scatter of the counts equal; null records define their expectation.
    With a coarse quantization grid, counts that the grid alone changes are left out.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records; the baseline is not used.

    Returns
    -------
    xarray.Dataset
        See `gyrostab.diagnose.statistics.scores.statistic_dataset`. ``ratio`` and ``estimate`` are
        the count, or the mean kurtosis.
    """
    windows = window_set(blocks.sizes["block"], LENGTHS)
    samples = values_in_order(blocks, "samples", "axis", "block").astype(float)
    counts_by_block = {
        name: np.nan_to_num(values_in_order(blocks, name, "axis", "block").astype(float))
        for name in COUNTS
    }
    counts_by_block["extremes"] = excess_extremes(counts_by_block["extremes"])
    counts = sum_over_windows(
        np.stack([counts_by_block[name] for name in COUNTS], axis=-1), windows
    )
    tail_score, used = kurtosis_score(values_in_order(blocks, "kurtosis", "axis", "block"), samples)
    # Rounding has no tails, so that the noise itself may differ from 0.
    usual = np.median(tail_score, axis=-1, keepdims=True)
    tail_score = np.where(
        used > 0, usual + np.clip(tail_score - usual, -_MAX_BLOCK_SIGMA, _MAX_BLOCK_SIGMA), 0.0
    )
    n = sum_over_windows(used[..., None], windows)
    with np.errstate(divide="ignore", invalid="ignore"):
        tails = np.where(
            n > 0, sum_over_windows(tail_score[..., None], windows) / np.sqrt(n), np.nan
        )
        excess = np.where(
            used > 0, np.nan_to_num(values_in_order(blocks, "kurtosis", "axis", "block")), 0.0
        )
        mean = sum_over_windows(excess[..., None], windows) / n
    rate = float(blocks.attrs["sampling_rate_hz"])
    number = np.concatenate([counts, np.broadcast_to(mean, tails.shape)], axis=-1)
    z = np.concatenate([2.0 * np.sqrt(counts + 0.375), tails], axis=-1)
    is_grid_count = np.array([name in GRID_COUNTS for name in (*COUNTS, "kurtosis")])
    z = np.where(has_coarse_grid(blocks)[:, None, None] & is_grid_count, np.nan, z)
    return statistic_dataset(
        "distribution",
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


def kurtosis_score(excess: Array, samples: Array) -> tuple[Array, Array]:
    """Return the normal score of the excess kurtosis of Gaussian samples, and 1 where known.

    Anscombe and Glynn (1983), doi:10.1093/biomet/70.1.227.

    Examples
    --------
    >>> z, used = kurtosis_score(np.array([0.0, 0.5]), np.array([2000.0, 2000.0]))
    >>> z.round(1)
    array([0.1, 3.8])
    """
    n = np.maximum(samples, 4.0)
    mean = -6.0 / (n + 1.0)
    variance = 24.0 * n * (n - 2.0) * (n - 3.0) / ((n + 1.0) ** 2 * (n + 3.0) * (n + 5.0))
    skew = (
        6.0
        * (n * n - 5.0 * n + 2.0)
        / ((n + 7.0) * (n + 9.0))
        * np.sqrt(6.0 * (n + 3.0) * (n + 5.0) / (n * (n - 2.0) * (n - 3.0)))
    )
    a = 6.0 + 8.0 / skew * (2.0 / skew + np.sqrt(1.0 + 4.0 / skew**2))
    used = np.isfinite(excess) & (samples >= 20)
    with np.errstate(invalid="ignore"):
        x = np.where(used, (excess - mean) / np.sqrt(variance), 0.0)
        base = 1.0 + x * np.sqrt(2.0 / (a - 4.0))
        z = ((1.0 - 2.0 / (9.0 * a)) - np.cbrt((1.0 - 2.0 / a) / np.maximum(base, 1e-9))) / np.sqrt(
            2.0 / (9.0 * a)
        )
    return np.where(used, z, 0.0), used.astype(float)

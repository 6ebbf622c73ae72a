"""Samples that Gaussian noise does not have: outliers, repeats, clipped or empty values, heavy or missing tails."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.sample_counts import GRID_COUNTS, excess_extremes, has_coarse_grid
from gyrostab.diagnose.statistics.scores import (
    Array,
    over_windows,
    statistic_dataset,
    values_of,
    window_set,
)

__all__ = ["COUNTS", "LENGTHS", "score"]

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (1, 5, 15)
#: What is counted.
COUNTS = ("outliers", "repeats", "extremes", "zeros")
_MOST = (
    4.0  # that the kurtosis of one block may stand out: a single outlier is for the counts to judge
)
#: Least scatter of the scores: where null records never count one, a single one is no mismatch.
_FLOOR = (0.35, 0.35, 0.35, 0.35, 0.2)


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
    """Score counts and kurtosis in windows of three lengths and of the whole record.

    The counts are made to scatter alike by Anscombe's root; what is to be expected of them the null
    records say, so that only differences between records of one kind mean something. On a coarse
    lattice most of them are those of the lattice, and are left out.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records; nothing of the baseline is used.

    Returns
    -------
    xarray.Dataset
        See `gyrostab.diagnose.statistics.scores.statistic_dataset`. ``ratio`` and ``estimate`` are
        the count, or the mean kurtosis.
    """
    windows = window_set(blocks.sizes["block"], LENGTHS)
    samples = values_of(blocks, "samples", "axis", "block").astype(float)
    each = {
        name: np.nan_to_num(values_of(blocks, name, "axis", "block").astype(float))
        for name in COUNTS
    }
    each["extremes"] = excess_extremes(each["extremes"])
    counts = over_windows(np.stack([each[name] for name in COUNTS], axis=-1), windows)
    heavy, used = kurtosis_score(values_of(blocks, "kurtosis", "axis", "block"), samples)
    usual = np.median(
        heavy, axis=-1, keepdims=True
    )  # rounding has no tails, so that the noise itself may be away from 0
    heavy = np.where(used > 0, usual + np.clip(heavy - usual, -_MOST, _MOST), 0.0)
    n = over_windows(used[..., None], windows)
    with np.errstate(divide="ignore", invalid="ignore"):
        tails = np.where(n > 0, over_windows(heavy[..., None], windows) / np.sqrt(n), np.nan)
        excess = np.where(
            used > 0, np.nan_to_num(values_of(blocks, "kurtosis", "axis", "block")), 0.0
        )
        mean = over_windows(excess[..., None], windows) / n
    rate = float(blocks.attrs["sampling_rate_hz"])
    number = np.concatenate([counts, np.broadcast_to(mean, tails.shape)], axis=-1)
    z = np.concatenate([2.0 * np.sqrt(counts + 0.375), tails], axis=-1)
    of_lattice = np.array([name in GRID_COUNTS for name in (*COUNTS, "kurtosis")])
    z = np.where(has_coarse_grid(blocks)[:, None, None] & of_lattice, np.nan, z)
    return statistic_dataset(
        "distribution",
        blocks,
        windows=windows,
        columns={
            "what": [*COUNTS, "kurtosis"],
            "tau_min_s": 1.0 / rate,
            "tau_max_s": 1.0 / rate,
            "floor": _FLOOR,
        },
        z=z,
        ratio=number,
        estimate=number,
    )


def kurtosis_score(excess: Array, samples: Array) -> tuple[Array, Array]:
    """Normal score of the excess kurtosis of so many Gaussian samples (Anscombe and Glynn 1983), and 1 where there is one.

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

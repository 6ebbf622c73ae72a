"""The slow twins: every fast path of the package written once more, plainly, in extended precision."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def direct_surface(
    x: NDArray[np.float64], window: int, step: int, ks: list[int], *, shifts: list[int] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Allan variance and number of terms of every window of a rate record, by the definition; NaN is a gap."""
    n_windows = (x.size - window) // step + 1
    avar = np.full((n_windows, len(ks)), np.nan)
    count = np.zeros((n_windows, len(ks)), dtype=np.int64)
    for j in range(n_windows):
        rate = x[j * step : j * step + window].astype(np.longdouble)
        here = np.isfinite(rate)
        if not here.any():
            continue
        rate = np.where(here, rate - rate[here].mean(), 0)
        theta = np.concatenate(([0], np.cumsum(rate)))
        lost = np.concatenate(([0], np.cumsum(~here)))
        for i, k in enumerate(ks):
            d = theta[2 * k :] - 2 * theta[k:-k] + theta[: -2 * k]
            keep = lost[2 * k :] == lost[: -2 * k]
            if shifts is not None:
                keep &= (j * step + np.arange(keep.size)) % 2 ** shifts[i] == 0
            count[j, i] = keep.sum()
            if count[j, i]:
                avar[j, i] = float((d[keep] ** 2).sum() / (2 * np.longdouble(k) ** 2 * count[j, i]))
    return avar, count


def direct_angle_surface(
    theta: NDArray[np.float64], window: int, step: int, ks: list[int], interval: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The same for a record of cumulative angles, `window` intervals and so ``window + 1`` angles to a window."""
    n_windows = (theta.size - 1 - window) // step + 1
    avar = np.full((n_windows, len(ks)), np.nan)
    count = np.zeros((n_windows, len(ks)), dtype=np.int64)
    for j in range(n_windows):
        part = theta[j * step : j * step + window + 1].astype(np.longdouble)
        for i, k in enumerate(ks):
            d = part[2 * k :] - 2 * part[k:-k] + part[: -2 * k]
            d = d[np.isfinite(d)]
            count[j, i] = d.size
            if d.size:
                avar[j, i] = float((d**2).mean() / (2 * (k * interval) ** 2))
    return avar, count


def cluster_variance(x: NDArray[np.float64], k: int, stride: int) -> tuple[float, int]:
    """Weighted mean of half squared differences of adjacent cluster means, each at least half full."""
    total, weight, count = 0.0, 0.0, 0
    for m in range(0, x.size - 2 * k + 1, stride):
        first, second = x[m : m + k], x[m + k : m + 2 * k]
        n1, n2 = np.isfinite(first).sum(), np.isfinite(second).sum()
        if 2 * n1 < k or 2 * n2 < k:
            continue
        total += n1 * n2 * (np.nanmean(second) - np.nanmean(first)) ** 2 / 2
        weight += n1 * n2
        count += 1
    return total / weight if weight else np.nan, count

"""Score of the window means, which the Allan variance does not show, against the simulation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.wandering import block_mean_variance, expected_processes
from gyrostab.diagnose.statistics.scores import (
    Array,
    Windows,
    statistic_dataset,
    sum_over_windows,
    values_in_order,
    window_set,
)
from gyrostab.kernels.regression.boxcars import (
    boxcar_information,
    filter_gains,
    precision_times,
    remaining_information,
)
from gyrostab.kernels.regression.state_space import flicker_states
from gyrostab.noise import HOUR

__all__ = [
    "LENGTHS",
    "MeanNoise",
    "apply_precision",
    "mean_noise",
    "region_mean",
    "score",
    "window_means",
]

#: Lengths of the windows [blocks].
LENGTHS = (1, 5, 15, 45)


class MeanNoise(NamedTuple):
    """Covariance of the block means of one axis, as the filters need it."""

    present: Array
    innovation: Array
    gain: Array
    decay: Array
    remaining: Array


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
    """Score the mean of windows of four lengths against the rest of the record.

    The score is that of a constant added only in the window, by generalised least squares with the
    noise of the simulation and a constant of the record. For white noise it is the window's mean
    minus that of the rest, over its standard deviation; for slow noise, neighbours count more.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records, and the expectation of the simulation.

    Returns
    -------
    xarray.Dataset
        See `gyrostab.diagnose.statistics.scores.statistic_dataset`; ``estimate`` is the constant
        [degree hour-1].
    """
    windows = window_set(blocks.sizes["block"], LENGTHS, whole=False)
    amount, information = window_means(blocks, baseline, windows)
    with np.errstate(divide="ignore", invalid="ignore"):
        z, estimate = (amount / np.sqrt(information))[..., None], (amount / information)[..., None]
    block = float(blocks.attrs["block_s"])
    return statistic_dataset(
        "mean",
        blocks,
        windows=windows,
        columns={
            "what": "mean",
            "tau_min_s": [block],
            "tau_max_s": [block * max(windows.length, default=1)],
        },
        z=z,
        ratio=np.abs(z),
        estimate=estimate,
        units="degree hour-1",
    )


def window_means(blocks: xr.Dataset, baseline: xr.Dataset, windows: Windows) -> tuple[Array, Array]:
    """Compute matched filter and information of every window; their ratio is the constant in it.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        As for `score`.
    windows : Windows
        Windows other than the whole record, whose constant is free.

    Returns
    -------
    amount, information : ndarray ((record,) axis, window), (axis, window)
        [degree-1 hour], [degree-2 hour2]; NaN if too little of the window is present.
    """
    residual = values_in_order(blocks, "mean", "axis", "block") - values_in_order(
        baseline, "known_mean", "axis", "block"
    )
    amount = np.full((*residual.shape[:-1], windows.first.size), np.nan)
    information = np.full((residual.shape[-2], windows.first.size), np.nan)
    for axis in range(residual.shape[-2]):
        present = np.isfinite(residual[..., axis, :]).reshape(-1, residual.shape[-1]).any(axis=0)
        noise = mean_noise(blocks, baseline, axis, present)
        amount[..., axis, :], information[axis] = _matched_filter(
            residual[..., axis, :], noise, windows
        )
    return amount, information


def _matched_filter(residual: Array, noise: MeanNoise, windows: Windows) -> tuple[Array, Array]:
    """Return filter output and information of each window, both independent of a constant."""
    weighted = apply_precision(residual, noise)
    one = apply_precision(np.ones(residual.shape[-1]), noise)
    total = one.sum()
    weighted = weighted - one * (weighted.sum(axis=-1, keepdims=True) / total)
    own = np.empty(windows.first.size)
    boxcar_information(
        windows.first, windows.stop, noise.innovation, noise.gain, noise.decay, noise.remaining, own
    )
    across = sum_over_windows(one[:, None], windows)[:, 0]
    count = sum_over_windows(noise.present[:, None], windows)[:, 0]
    information = own - across**2 / total
    enough = (count >= 0.25 * windows.length) & (information > 1e-3 * own)
    return sum_over_windows(weighted[..., None], windows)[..., 0], np.where(
        enough, information, np.nan
    )


def mean_noise(blocks: xr.Dataset, baseline: xr.Dataset, axis: int, present: Array) -> MeanNoise:
    """Return the covariance of the block means of an axis, with all known random processes.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        As for `score`.
    axis : int
        Index of the axis.
    present : ndarray of bool (block,)
        Blocks with a mean.
    """
    terms = [str(term) for term in baseline["term"].values]
    b, k = (
        float(np.nan_to_num(baseline["coefficient"].values[axis, terms.index(term)]))
        for term in ("B", "K")
    )
    begin, end = blocks["begin"].values, blocks["end"].values
    step = np.diff((begin + end) / 2.0, append=end[-1])
    block, span = float(blocks.attrs["block_s"]), float(end[-1] - begin[0])
    share, times, white = flicker_states(block, span)
    known = expected_processes(baseline, axis)
    slow, times = (
        np.append(b**2 * share, known.square * block_mean_variance(block, known.time)),
        np.append(times, known.time),
    )
    decay = np.exp(-step[:, None] / times)
    variance = baseline["mean_variance"].transpose(..., "axis", "block").values[axis] + b**2 * white
    present = present & np.isfinite(variance) & (variance > 0)
    n = variance.size
    innovation, gain = np.empty(n), np.empty((n, times.size + 1))
    remaining = np.empty((n + 1, times.size + 1, times.size + 1))
    filter_gains(
        variance, present, (k**2 / HOUR + known.walk) * step, slow, decay, innovation, gain
    )
    remaining_information(innovation, gain, decay, remaining)
    return MeanNoise(present.astype(float), innovation, gain, decay, remaining)


def apply_precision(series: Array, noise: MeanNoise) -> Array:
    """Multiply each series (..., block) by the inverse covariance; zero at missing blocks."""
    rows = np.ascontiguousarray(series.reshape(-1, series.shape[-1]), dtype=np.float64)
    out = np.empty_like(rows)
    precision_times(rows, noise.innovation, noise.gain, noise.decay, out)
    return out.reshape(series.shape)


def region_mean(blocks: xr.Dataset, baseline: xr.Dataset, axis: int, inside: Array) -> float:
    """Return the constant added only in some blocks of a recording [degree hour-1].

    By generalised least squares with a constant of the record.
    """
    residual = (
        values_in_order(blocks, "mean", "axis", "block")[axis]
        - values_in_order(baseline, "known_mean", "axis", "block")[axis]
    )
    noise = mean_noise(blocks, baseline, axis, np.isfinite(residual))
    rows = apply_precision(np.stack([np.ones(residual.size), inside.astype(float)]), noise)
    columns = np.stack([np.ones(residual.size), inside.astype(float)])
    solved = np.linalg.lstsq(rows @ columns.T, rows @ np.nan_to_num(residual), rcond=None)[0]
    return float(solved[1])

"""The dynamic Allan variance of the reduced recording against that of the simulation."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.statistics.scores import (
    Array,
    Windows,
    cube_root_score,
    over_windows,
    statistic_dataset,
    values_of,
    window_set,
)
from gyrostab.noise import LAWS

__all__ = ["LENGTHS", "allan_surface", "score", "transfer"]

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (1, 5, 15)
_FINE = 256  # points of the integral of the transfer function in one band


def transfer(low: Array, high: Array, tau: Array, rate: float) -> Array:
    """Allan variance per unit of two-sided density in each band.

    Parameters
    ----------
    low, high : ndarray (band,)
        Edges of the bands [Hz].
    tau : ndarray (tau,)
        Averaging times, whole numbers of samples [s].
    rate : float
        Sampling rate [Hz].

    Returns
    -------
    ndarray (tau, band)
        Integral of ``4 sin(pi f tau)^4 / (k sin(pi f / rate))^2``, k = tau rate, over the band
        [Hz].

    Examples
    --------
    >>> weights = transfer(np.array([0.0, 1.0]), np.array([1.0, 50.0]), np.array([0.01, 0.1]), 100.0)
    >>> (weights.sum(axis=1) * 0.2**2).round(4)              # white noise of 0.2 (deg/h)/sqrt(Hz): N^2 / tau
    array([4. , 0.4])
    """
    points = max(_FINE, round(8 * float(np.max((high - low)[:, None] * tau))))
    share = (np.arange(points) + 0.5) / points
    out = np.empty((tau.size, low.size))
    for band in range(low.size):
        f = low[band] + share * (high[band] - low[band])
        angle = np.pi * f / rate
        k = np.rint(tau * rate)[:, None]
        out[:, band] = np.mean(4.0 * np.sin(angle * k) ** 4 / (k * np.sin(angle)) ** 2, axis=1) * (
            high[band] - low[band]
        )
    return out


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
    """Score the Allan variance in windows of three lengths and of the whole record.

    Inside a block it is taken from the powers of the bands, at octaves of the sampling interval up
    to a quarter of a block; the column ``level`` weighs all bands alike, as the likelihood does.
    From a block on it is taken from the block means.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records, and what the simulation expects.

    Returns
    -------
    xarray.Dataset
        See `gyrostab.diagnose.statistics.scores.statistic_dataset`.
    """
    surface = allan_surface(blocks, baseline)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = surface["observed"] / surface["expected"]
    return statistic_dataset(
        "davar",
        blocks,
        windows=surface["windows"],
        columns=surface["columns"],
        z=cube_root_score(ratio, surface["shape"]),
        ratio=ratio,
    )


def allan_surface(
    blocks: xr.Dataset, baseline: xr.Dataset, windows: Windows | None = None
) -> dict[str, Any]:
    """Observed and expected Allan variance [degree2 hour-2] by (record), axis, window, tau, and the shape of their gamma law.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        As for `score`; the known mean is taken off before.
    windows : Windows, optional
        Those of `score` by default.

    Returns
    -------
    dict
        ``observed``, ``expected``, ``shape``; ``windows``; ``columns`` as for `statistic_dataset`.
    """
    windows = window_set(blocks.sizes["block"], LENGTHS) if windows is None else windows
    components = [_inside(blocks, baseline, windows), _beyond(blocks, baseline, windows)]
    joined: dict[str, Any] = {"windows": windows}
    for name in ("observed", "expected", "shape"):
        joined[name] = np.concatenate([component[name] for component in components], axis=-1)
    joined["columns"] = {
        name: np.concatenate([component["columns"][name] for component in components])
        for name in components[0]["columns"]
    }
    return joined


def _inside(blocks: xr.Dataset, baseline: xr.Dataset, windows: Windows) -> dict[str, Any]:
    rate, block = float(blocks.attrs["sampling_rate_hz"]), float(blocks.attrs["block_s"])
    power, shape = (
        values_of(blocks, "power", "axis", "block", "band"),
        values_of(blocks, "shape", "axis", "block", "band"),
    )
    spectrum = values_of(baseline, "spectrum", "axis", "block", "band")
    k = 2 ** np.arange(max(1, int(np.log2(block * rate / 4.0)) + 1))
    weights = transfer(blocks["band_low"].values, blocks["band_high"].values, k / rate, rate).T
    there = np.isfinite(power) & np.isfinite(spectrum) & (shape > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(there, 1.0 / shape, 0.0)
        relative = np.where(there, power / spectrum * shape, 0.0).sum(axis=-1, keepdims=True)
    power, spectrum, each = (
        np.where(there, power, 0.0),
        np.where(there, spectrum, 0.0),
        np.where(there, shape, 0.0),
    )
    total = each.sum(axis=-1, keepdims=True)
    observed = over_windows(np.concatenate([power @ weights, relative], axis=-1), windows)
    expected = over_windows(np.concatenate([spectrum @ weights, total], axis=-1), windows)
    variance = over_windows(
        np.concatenate([(spectrum**2 * inverse) @ weights**2, total], axis=-1), windows
    )
    count = over_windows(there.any(axis=-1, keepdims=True).astype(float), windows)
    with np.errstate(divide="ignore", invalid="ignore"):
        gamma = np.where(count >= 0.25 * windows.length[:, None], expected**2 / variance, np.nan)
        return {
            "observed": observed / count,
            "expected": expected / count,
            "shape": gamma,
            "columns": {
                "what": np.array(["avar"] * k.size + ["level"], dtype="<U8"),
                "tau_min_s": np.append(k / rate, 1.0 / rate),
                "tau_max_s": np.append(k / rate, k[-1] / rate),
            },
        }


def _beyond(blocks: xr.Dataset, baseline: xr.Dataset, windows: Windows) -> dict[str, Any]:
    """Averaging times of whole blocks: second differences of the block means, all that overlap."""
    block, block_count = float(blocks.attrs["block_s"]), blocks.sizes["block"]
    means = values_of(blocks, "mean", "axis", "block") - values_of(
        baseline, "known_mean", "axis", "block"
    )
    white = values_of(baseline, "mean_variance", "axis", "block")
    sizes = [k for k in (1, 2, 4, 8, 16, 32) if 4 * k <= block_count]
    components: dict[str, list[Array]] = {"observed": [], "expected": [], "shape": []}
    for k in sizes:
        d2 = _differences(means, k) ** 2 / 2.0
        expected = _pair_variance(white, k) / 2.0 + _slow(blocks, baseline, k * block)[:, None]
        there = np.isfinite(d2) & np.isfinite(expected)
        pairs = Windows(windows.first, np.maximum(windows.stop - 2 * k + 1, windows.first))
        count = over_windows(there[..., None].astype(float), pairs)[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            fits = (count >= 0.5 * pairs.length) & (pairs.length > 0) & (windows.length >= 4 * k)
            components["observed"].append(
                over_windows(np.where(there, d2, 0.0)[..., None], pairs)[..., 0] / count
            )
            components["expected"].append(
                over_windows(np.where(there, expected, 0.0)[..., None], pairs)[..., 0] / count
            )
            table = _shape(np.arange(int(count.max(initial=0)) + 1), k)
            components["shape"].append(np.where(fits, table[count.astype(np.int64)], np.nan))
    if not sizes:
        nothing = np.empty((*means.shape[:-1], windows.first.size, 0))
        joined: dict[str, Any] = dict.fromkeys(components, nothing)
    else:
        joined = {
            name: np.stack(np.broadcast_arrays(*values), axis=-1)
            for name, values in components.items()
        }
    tau = np.array(sizes, dtype=float) * block
    joined["columns"] = {
        "what": np.array(["avar"] * tau.size, dtype="<U8"),
        "tau_min_s": tau,
        "tau_max_s": tau,
    }
    return joined


def _differences(means: Array, k: int) -> Array:
    """Mean of k blocks less that of the k before, all starts; NaN where one is missing. As long as the record."""
    total = np.concatenate(
        [
            np.zeros((*means.shape[:-1], 1)),
            np.cumsum(np.where(np.isfinite(means), means, 0.0), axis=-1),
        ],
        axis=-1,
    )
    lost = np.concatenate(
        [np.zeros((*means.shape[:-1], 1)), np.cumsum(~np.isfinite(means), axis=-1)], axis=-1
    )
    difference = (total[..., 2 * k :] - 2.0 * total[..., k:-k] + total[..., : -2 * k]) / k
    difference[lost[..., 2 * k :] > lost[..., : -2 * k]] = np.nan
    return _padded(difference, means.shape[-1])


def _pair_variance(white: Array, k: int) -> Array:
    total = np.concatenate(
        [
            np.zeros((*white.shape[:-1], 1)),
            np.cumsum(np.where(np.isfinite(white), white, 0.0), axis=-1),
        ],
        axis=-1,
    )
    return _padded((total[..., 2 * k :] - total[..., : -2 * k]) / k**2, white.shape[-1])


def _padded(values: Array, size: int) -> Array:
    rest = np.full((*values.shape[:-1], size - values.shape[-1]), np.nan)
    return np.concatenate([values, rest], axis=-1)


def _slow(blocks: xr.Dataset, baseline: xr.Dataset, tau: float) -> Array:
    """Allan variance of the slow terms by axis [degree2 hour-2]; a ramp is in the known mean."""
    coefficient = values_of(baseline.transpose(..., "axis", "term"), "coefficient", "axis", "term")
    total = np.zeros(blocks.sizes["axis"])
    for place, term in enumerate(baseline["term"].values):
        if str(term) in ("B", "K"):
            total = total + LAWS[str(term)].avar(tau) * np.nan_to_num(coefficient[..., place]) ** 2
    return np.asarray(total)


def _shape(count: Any, k: int) -> Array:
    """Shape of the gamma law of the mean of `count` overlapping terms in white noise."""
    region = np.concatenate([-np.ones(k), np.ones(k)])
    r2 = (np.correlate(region, region, mode="full")[2 * k - 1 :] / (2 * k)) ** 2
    lag = np.arange(r2.size)
    n = np.maximum(count, 1.0)[..., None]
    pairs = np.where(lag == 0, n, 2.0 * np.maximum(n - lag, 0.0)) * r2
    return np.asarray(0.5 * n[..., 0] ** 2 / pairs.sum(axis=-1))

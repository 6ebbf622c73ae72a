"""Dynamic Allan variance of block statistics, with the shape of its distribution."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.diagnose.evidence.wandering import expected_processes, process_allan_variance
from gyrostab.diagnose.statistics.scores import (
    BlockWindows,
    cumulative,
    sum_over_windows,
    window_set,
)
from gyrostab.noise import LAWS

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (1, 5, 15)
_INTEGRATION_POINTS = 256  # of the transfer function in one band, at least


def allan_transfer(low: Floats, high: Floats, tau: Floats, rate: float) -> Floats:
    """Return the Allan variance (tau, band) per unit of two-sided density in each band [Hz].

    It is the integral of ``4 sin(pi f tau)^4 / (k sin(pi f / rate))^2``, k = tau rate, over the
    band. Edges of the bands and sampling rate are in Hz; averaging times are whole numbers of
    samples [s].

    Examples
    --------
    >>> low, high, tau = np.array([0.0, 1.0]), np.array([1.0, 50.0]), np.array([0.01, 0.1])
    >>> weights = allan_transfer(low, high, tau, 100.0)
    >>> (weights.sum(axis=1) * 0.2**2).round(4)  # white noise of 0.2 (deg/h)/sqrt(Hz): N^2 / tau
    array([4. , 0.4])
    """
    points = max(_INTEGRATION_POINTS, round(8 * float(np.max((high - low)[:, None] * tau))))
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


def allan_surface(
    blocks: xr.Dataset, baseline: xr.Dataset, windows: BlockWindows | None = None
) -> dict[str, Any]:
    """Compute observed and expected Allan variances, and the shape of their gamma distribution.

    By (record), axis, window, tau [degree2 hour-2], without the known mean: ``observed``,
    ``expected``, ``shape``; with ``windows``, and ``columns`` as for `statistic_dataset`.
    """
    windows = window_set(blocks.sizes["block"], LENGTHS) if windows is None else windows
    surfaces = [
        _surface_within_blocks(blocks, baseline, windows),
        _surface_of_means(blocks, baseline, windows),
    ]
    joined: dict[str, Any] = {"windows": windows}
    for name in ("observed", "expected", "shape"):
        joined[name] = np.concatenate([surface[name] for surface in surfaces], axis=-1)
    joined["columns"] = {
        name: np.concatenate([surface["columns"][name] for surface in surfaces])
        for name in surfaces[0]["columns"]
    }
    return joined


@np.errstate(divide="ignore", invalid="ignore")
def _surface_within_blocks(
    blocks: xr.Dataset, baseline: xr.Dataset, windows: BlockWindows
) -> dict[str, Any]:
    """Compute the surface within blocks, from band powers."""
    rate, block = float(blocks.attrs["sampling_rate_hz"]), float(blocks.attrs["block_s"])
    power, shape = blocks["power"].values, blocks["shape"].values
    spectrum = baseline["spectrum"].values
    k = 2 ** np.arange(max(1, int(np.log2(block * rate / 4.0)) + 1))
    weights = allan_transfer(
        blocks["band_low"].values, blocks["band_high"].values, k / rate, rate
    ).T
    present = np.isfinite(power) & np.isfinite(spectrum) & (shape > 0)
    inverse = np.where(present, 1.0 / shape, 0.0)
    relative = np.where(present, power / spectrum * shape, 0.0).sum(axis=-1, keepdims=True)
    power = np.where(present, power, 0.0)
    spectrum = np.where(present, spectrum, 0.0)
    used_shape = np.where(present, shape, 0.0)
    total = used_shape.sum(axis=-1, keepdims=True)
    observed = sum_over_windows(np.concatenate([power @ weights, relative], axis=-1), windows)
    expected = sum_over_windows(np.concatenate([spectrum @ weights, total], axis=-1), windows)
    variance = sum_over_windows(
        np.concatenate([(spectrum**2 * inverse) @ weights**2, total], axis=-1), windows
    )
    count = sum_over_windows(present.any(axis=-1, keepdims=True).astype(float), windows)
    gamma = np.where(count >= 0.25 * windows.length[:, None], expected**2 / variance, np.nan)
    return {
        "observed": observed / count,
        "expected": expected / count,
        "shape": gamma,
        "columns": {
            "quantity": np.array(["avar"] * k.size + ["level"], dtype="<U8"),
            "tau_min_s": np.append(k / rate, 1.0 / rate),
            "tau_max_s": np.append(k / rate, k[-1] / rate),
        },
    }


def _surface_of_means(
    blocks: xr.Dataset, baseline: xr.Dataset, windows: BlockWindows
) -> dict[str, Any]:
    """Compute the surface at whole blocks, from all overlapping differences of block means."""
    block, block_count = float(blocks.attrs["block_s"]), blocks.sizes["block"]
    means = blocks["mean"].values - baseline["known_mean"].values
    white = baseline["mean_variance"].values
    walk = block * np.stack([expected_processes(baseline, row).walk for row in range(len(white))])
    sizes = [k for k in (1, 2, 4, 8, 16, 32) if 4 * k <= block_count]
    surfaces: dict[str, list[Floats]] = {"observed": [], "expected": [], "shape": []}
    for k in sizes:
        d2 = _mean_differences(means, k) ** 2 / 2.0
        expected = (
            _pair_variance(white, k) + _walk_variance(walk, k)
        ) / 2.0 + _slow_allan_variance(blocks, baseline, k * block)[:, None]
        present = np.isfinite(d2) & np.isfinite(expected)
        pairs = BlockWindows(windows.first, np.maximum(windows.stop - 2 * k + 1, windows.first))
        count = sum_over_windows(present.astype(float), pairs, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            for name, values in (("observed", d2), ("expected", expected)):
                total = sum_over_windows(np.where(present, values, 0.0), pairs, axis=-1)
                surfaces[name].append(total / count)
        fits = (count >= 0.5 * pairs.length) & (pairs.length > 0) & (windows.length >= 4 * k)
        table = _gamma_shape(np.arange(int(count.max(initial=0)) + 1), k)
        surfaces["shape"].append(np.where(fits, table[count.astype(np.int64)], np.nan))
    joined: dict[str, Any] = {
        name: np.stack(np.broadcast_arrays(*values), axis=-1) for name, values in surfaces.items()
    }
    tau = np.array(sizes, dtype=float) * block
    joined["columns"] = {
        "quantity": np.array(["avar"] * tau.size, dtype="<U8"),
        "tau_min_s": tau,
        "tau_max_s": tau,
    }
    return joined


def _mean_differences(means: Floats, k: int) -> Floats:
    """Return the mean of k blocks minus that of the k before; NaN if incomplete."""
    total = cumulative(np.where(np.isfinite(means), means, 0.0))
    lost = cumulative(~np.isfinite(means))
    difference = (total[..., 2 * k :] - 2.0 * total[..., k:-k] + total[..., : -2 * k]) / k
    difference[lost[..., 2 * k :] > lost[..., : -2 * k]] = np.nan
    return _pad_end(difference, means.shape[-1])


def _pair_variance(white: Floats, k: int) -> Floats:
    """Return the white variance of the differences of means of k blocks."""
    total = cumulative(np.where(np.isfinite(white), white, 0.0))
    return _pad_end((total[..., 2 * k :] - total[..., : -2 * k]) / k**2, white.shape[-1])


def _walk_variance(walk: Floats, k: int) -> Floats:
    """Return what random walks add to the variance of the differences of means of k blocks.

    `walk` (axis, block) is the growth of their variance in each block.
    """
    rising = np.diff(np.arange(k + 1.0) ** 3) / (3.0 * k**2)
    weight = np.concatenate([rising, rising[::-1]])
    added = np.stack([np.correlate(row, weight, mode="valid") for row in walk])
    return _pad_end(added, walk.shape[-1])


def _pad_end(values: Floats, size: int) -> Floats:
    """Append NaN up to the size of the record."""
    sides = [*[(0, 0)] * (values.ndim - 1), (0, size - values.shape[-1])]
    return np.pad(values, sides, constant_values=np.nan)


def _slow_allan_variance(blocks: xr.Dataset, baseline: xr.Dataset, tau: float) -> Floats:
    """Return the Allan variance of all but white noise, by axis, without walks of effects.

    In degree2 hour-2. Angle noise has the law of quantization.
    """
    coefficient = baseline["coefficient"]
    processes = (expected_processes(baseline, row) for row in range(blocks.sizes["axis"]))
    total = np.array(
        [
            part.square @ process_allan_variance(tau, part.time) + 3.0 * part.angle / tau**2
            for part in processes
        ]
    )
    for term in ("B", "K"):
        total += LAWS[term].avar(tau) * coefficient.sel(term=term).values ** 2
    return total


def _gamma_shape(count: Any, k: int) -> Floats:
    """Return the gamma shape of the mean of `count` overlapping terms in white noise."""
    region = np.concatenate([-np.ones(k), np.ones(k)])
    r2 = (np.correlate(region, region, mode="full")[2 * k - 1 :] / (2 * k)) ** 2
    lag = np.arange(r2.size)
    n = np.maximum(count, 1.0)[..., None]
    pairs = np.where(lag == 0, n, 2.0 * np.maximum(n - lag, 0.0)) * r2
    return np.asarray(0.5 * n[..., 0] ** 2 / pairs.sum(axis=-1))

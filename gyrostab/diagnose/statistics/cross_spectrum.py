"""Score of the coherency between axes, which the Allan variance of one axis does not show."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.statistics.scores import (
    Array,
    Windows,
    cube_root_score,
    statistic_dataset,
    sum_over_windows,
    values_in_order,
    window_set,
)

__all__ = ["LENGTHS", "correlation_score", "score"]

Complex = NDArray[np.complex128]

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (5, 15, 45)
_MIN_FREQUENCIES = 8.0  # complex frequencies, for a meaningful coherency; design choice


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
    """Score the coherency of every pair of axes, in bands and in total, against independent axes.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records, and the expectation of the simulation: its spectrum weights the
        bands, and its ``cross`` (pair, block, band) is subtracted.

    Returns
    -------
    xarray.Dataset or None
        None with one axis. Columns ``in phase`` and ``in quadrature``; ``ratio`` and ``estimate``
        are the coherency. Three axes or more have a row of all pairs together, over all bands in
        phase.
    """
    if "cross" not in blocks or blocks.sizes.get("pair", 0) == 0:
        return None
    axes = [str(axis) for axis in blocks["axis"].values]
    left = [axes.index(str(axis)) for axis in blocks["first"].values]
    right = [axes.index(str(axis)) for axis in blocks["second"].values]
    windows = window_set(blocks.sizes["block"], LENGTHS)
    coherency, count = _pair_coherency(blocks, baseline, left, right, windows)
    parts = [coherency.real, coherency.imag]
    r = np.concatenate(parts, axis=-1)
    z = correlation_score(r, np.concatenate([2.0 * count] * 2, axis=-1))
    rows = [f"{axes[a]} {axes[b]}" for a, b in zip(left, right, strict=True)]
    bands = blocks.sizes["band"]
    if len(rows) > 1:
        z, r = (
            np.concatenate(
                [part, np.full((*part.shape[:-3], 1, *part.shape[-2:]), np.nan)],
                axis=-3,
            )
            for part in (z, r)
        )
        broad = z[..., :-1, :, bands]
        mean_square = (broad**2).mean(axis=-2)
        z[..., -1, :, bands] = cube_root_score(
            mean_square, np.full(mean_square.shape, len(rows) / 2.0)
        )
        r[..., -1, :, bands] = np.sqrt((r[..., :-1, :, bands] ** 2).mean(axis=-2))
        rows = [*rows, " ".join(axes)]
    low, high = blocks["band_low"].values, blocks["band_high"].values
    low = np.maximum(low, 0.5 / float(blocks.attrs["block_s"]))
    f_min, f_max = np.append(low, low[0]), np.append(high, high[-1])
    return statistic_dataset(
        "cross_axis",
        blocks,
        rows=rows,
        windows=windows,
        columns={
            "what": np.repeat(
                ["in phase", "all in phase", "in quadrature", "all in quadrature"],
                [bands, 1, bands, 1],
            ),
            "tau_min_s": np.tile(0.5 / f_max, 2),
            "tau_max_s": np.tile(0.5 / f_min, 2),
            "frequency": np.tile(np.append(blocks["frequency"].values, np.nan), 2),
        },
        z=z,
        ratio=np.abs(r),
        estimate=r,
    )


def _pair_coherency(
    blocks: xr.Dataset, baseline: xr.Dataset, left: list[int], right: list[int], windows: Windows
) -> tuple[Complex, Array]:
    """Compute the coherency and the number of complex frequencies by (record), pair, window, band.

    The last band is that of all bands together. If both axes are noisy in only a few blocks, these
    dominate: the number is that of equal blocks with the same scatter.
    """
    cross = values_in_order(blocks, "cross", "pair", "block", "band")
    if "cross" in baseline:
        cross = cross - values_in_order(baseline, "cross", "pair", "block", "band")
    power, shape = (
        values_in_order(blocks, "power", "axis", "block", "band"),
        values_in_order(blocks, "shape", "axis", "block", "band"),
    )
    spectrum = values_in_order(baseline, "spectrum", "axis", "block", "band")
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = power / spectrum
        cross = cross / np.sqrt(spectrum[left] * spectrum[right])
        weight = np.minimum(shape[..., left, :, :], shape[..., right, :, :])
    present = (
        np.isfinite(cross)
        & np.isfinite(flat[..., left, :, :])
        & np.isfinite(flat[..., right, :, :])
        & (weight > 0)
    )
    weight = np.where(present, weight, 0.0)

    def summed(values: Complex) -> Complex:
        sums = sum_over_windows(np.where(present, values, 0.0) * weight, windows)
        return np.concatenate([sums, sums.sum(axis=-1, keepdims=True)], axis=-1)

    one, other = flat[..., left, :, :], flat[..., right, :, :]
    product = summed(one).real * summed(other).real
    with np.errstate(divide="ignore", invalid="ignore"):
        sums = summed(cross) / np.sqrt(product)
        count = np.fmin(summed(np.ones_like(one)).real, product / summed(one * other).real)
    return np.where(count >= _MIN_FREQUENCIES, sums, complex(np.nan, np.nan)), count


def correlation_score(r: Array, samples: Array) -> Array:
    """Return the normal score of a correlation of independent samples of known mean (Wallace 1959).

    Examples
    --------
    >>> correlation_score(np.array([0.0, 0.1]), np.array([400.0, 400.0])).round(2)
    array([0., 2.])
    """
    freedom = np.maximum(samples - 1.0, 1.0)
    size = np.sqrt(-freedom * np.log1p(-np.minimum(r**2, 1.0 - 1e-12)))
    return np.asarray(np.sign(r) * size * (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0))

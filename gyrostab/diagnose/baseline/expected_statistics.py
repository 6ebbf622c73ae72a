"""Expected block statistics of stationary noise, given taper, blocks and gaps of a record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.linear_model import average_in_bands, spread_by_gaps
from gyrostab.kernels.spectra.expected import expected_powers
from gyrostab.kernels.spectra.periodogram import ordinates, taper
from gyrostab.noise import LAWS

Array = NDArray[np.float64]
#: Random noise terms, in the order of the dimension `noise`.
NOISE = ("Q", "N", "B", "K")


def line_columns(blocks: xr.Dataset) -> Array:
    """Return the expected power (line, term) of a full block for unit squares of Q, N, B, K.

    In degree2 hour-2 Hz-1 per squared unit of the noise table.
    """
    size, rate = int(blocks.attrs["block_samples"]), float(blocks.attrs["sampling_rate_hz"])
    powers = expected_powers(taper(size), rate, ordinates(size)).T
    return np.asarray(powers * np.array([LAWS[term].seconds_factor for term in NOISE]))


def band_columns(blocks: xr.Dataset) -> Array:
    """Return the means (band, term) of `line_columns` over the bands."""
    return average_in_bands(line_columns(blocks).T, blocks).T


def noise_powers(blocks: xr.Dataset, response: Array | None = None) -> Array:
    """Return `band_columns` with the gaps of each block, (axis, block, band, term).

    The response (band, term) is that of a filter before samples were lost.
    """
    columns = band_columns(blocks) * (1.0 if response is None else response)
    return np.stack([spread_by_gaps(power[None, None], blocks) for power in columns.T], axis=-1)


def sum_noise(columns: Array, squares: Array | Sequence[Array]) -> Array:
    """Return the power (axis, block, band) of noise with these squares, from `noise_powers`."""
    return np.asarray(np.einsum("abfn,an->abf", columns, np.asarray(squares)))


def common_variance(blocks: xr.Dataset) -> tuple[Array, Array]:
    """Return the relative variance (axis, block) common to all bands of a block by random gaps.

    Returned with it is the shape (axis, block, band) of the gamma distribution of each power, given
    the common factor.
    """
    shape = blocks["shape"].values
    neighbours = blocks["neighbours"].values
    samples = np.maximum(blocks["samples"].values, 1)
    scattered = np.clip(1.0 - np.where(np.isfinite(neighbours), neighbours, 1.0), 0.0, 1.0)
    weights = taper(int(blocks.attrs["block_samples"]))
    scattered = np.maximum(
        scattered - (1.0 - float((weights[1:] * weights[:-1]).sum() / (weights**2).sum())), 0.0
    )
    common = 2.0 * scattered / samples
    common = np.minimum(
        common, 0.8 / np.where(np.isfinite(shape), shape, 0.0).max(axis=2, initial=1e-9)
    )
    return common, np.asarray(1.0 / (1.0 / shape - common[..., None]))


def separate_share(shape: Array, shape_alone: Array, common: Array) -> float:
    """Return the share of the shapes (block, band) of an axis that its average powers have.

    The rest is lost to the scatter that all bands of a block have in common; see `common_variance`.
    """
    block_shape = np.nansum(shape_alone, axis=1)
    separate = float((block_shape / (1.0 + common * block_shape)).sum())
    return min(1.0, separate / max(float(np.nansum(shape)), 1e-300))


def white_variance(blocks: xr.Dataset, square: Array) -> Array:
    """Return the variance of block means due to Q and N (axis, block) [degree2 hour-2].

    The squares have the shape (axis or 1, 4).
    """
    samples = blocks["samples"].values.astype(np.float64)
    neighbours = blocks["neighbours"].values
    rate, count = float(blocks.attrs["sampling_rate_hz"]), np.maximum(samples, 1.0)
    apart = 1.0 - np.where(
        np.isfinite(neighbours), neighbours, samples / float(blocks.attrs["block_samples"])
    )
    # Each run of samples leaves a rounding of the angle at either end.
    runs = np.maximum(apart, 0.0) * count + 1.0
    return np.asarray(
        LAWS["N"].seconds_factor * rate * square[:, 1:2] / count
        + 2.0 * LAWS["Q"].seconds_factor * rate**2 * square[:, :1] * runs / count**2
    )

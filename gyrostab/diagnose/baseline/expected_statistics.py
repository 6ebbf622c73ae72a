"""Expected block statistics of stationary noise, given taper, blocks and gaps of a record.

And what effects that change each sample for itself do to the scatter of normal noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import ndtri

from gyrostab.arrays import Floats
from gyrostab.diagnose.predict.linear_model import average_in_bands, spread_by_gaps
from gyrostab.kernels.spectra.expected import expected_powers
from gyrostab.kernels.spectra.periodogram import ordinates, taper
from gyrostab.noise import LAWS

#: Random noise terms, in the order of the dimension `noise`.
NOISE = ("Q", "N", "B", "K")
#: Their places in it.
Q_TERM, N_TERM, B_TERM, K_TERM = range(len(NOISE))
_NORMAL = ndtri((np.arange(1001) + 0.5) / 1001)  # equally likely values
_NORMAL /= _NORMAL.std()
_MAX_MEANS = 200  # of blocks, or of equal groups of blocks with similar means; limits time
_TRANSFER_ROUNDS = 100  # of a fixed-point iteration; limits time
_MIN_SHARE = 1e-3  # of a variance that is left; a power of zero has no likelihood
#: Largest scatter that random gaps may give all bands of a block together, divided by that
#: of the steadiest band; the rest is that of the band alone. Design choice.
_MAX_GAP_SCATTER_SHARE = 0.8


def line_columns(blocks: xr.Dataset) -> Floats:
    """Return the expected power (line, term) of a full block for unit squares of Q, N, B, K.

    In degree2 hour-2 Hz-1 per squared unit of the noise table.
    """
    size, rate = int(blocks.attrs["block_samples"]), float(blocks.attrs["sampling_rate_hz"])
    powers = expected_powers(taper(size), rate, ordinates(size)).T
    return np.asarray(powers * np.array([LAWS[term].seconds_factor for term in NOISE]))


def band_columns(blocks: xr.Dataset) -> Floats:
    """Return the means (band, term) of `line_columns` over the bands."""
    return average_in_bands(line_columns(blocks).T, blocks).T


def noise_powers(blocks: xr.Dataset, response: Floats | None = None) -> Floats:
    """Return `band_columns` with the gaps of each block, (axis, block, band, term).

    The response (band, term) is that of a filter before samples were lost.
    """
    columns = band_columns(blocks) * (1.0 if response is None else response)
    return np.stack([spread_by_gaps(power[None, None], blocks) for power in columns.T], axis=-1)


def sum_noise(columns: Floats, squares: Floats | Sequence[Floats]) -> Floats:
    """Return the power (axis, block, band) of noise with these squares, from `noise_powers`."""
    return np.asarray(np.einsum("abfn,an->abf", columns, np.asarray(squares)))


def common_variance(blocks: xr.Dataset) -> tuple[Floats, Floats]:
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
    largest_shape = np.where(np.isfinite(shape), shape, 0.0).max(axis=2, initial=1e-9)
    common = np.minimum(common, _MAX_GAP_SCATTER_SHARE / largest_shape)
    return common, np.asarray(1.0 / (1.0 / shape - common[..., None]))


def reduced_shape(blocks: xr.Dataset) -> Floats:
    """Return the shapes (axis, block, band) of powers as if those of a block were independent.

    They are reduced by the scatter that all bands of a block have in common; see `common_variance`.
    """
    shape = blocks["shape"].values
    common, shape_alone = common_variance(blocks)
    block_shape = np.nansum(shape_alone, axis=2)
    separate = block_shape / (1.0 + common * block_shape)
    share = np.minimum(separate / np.maximum(np.nansum(shape, axis=2), 1e-300), 1.0)
    return np.asarray(shape * share[..., None])


def white_variance(blocks: xr.Dataset, square: Floats) -> Floats:
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
        LAWS["N"].seconds_factor * rate * square[:, [N_TERM]] / count
        + 2.0 * LAWS["Q"].seconds_factor * rate**2 * square[:, [Q_TERM]] * runs / count**2
    )


class PassedNoise(NamedTuple):
    """Normal noise before an effect, and what the effect leaves of it."""

    mean: Floats  # (block,): before the effect
    variance: float  # before the effect
    share: Floats  # (block,): of the variance that is left
    gain: float  # of slow changes of the rate


def undo_transfer(
    transfer: Callable[[Floats], Any],
    mean: Floats,
    variance: float,
    *,
    variance_is_before: bool = False,
) -> PassedNoise:
    """Find the normal noise that has these block means and this variance after an effect.

    Parameters
    ----------
    transfer : callable
        The output of the effect for each rate.
    mean : ndarray, shape (block,)
        Means after the effect, NaN where a block is missing, whose share is 1.
    variance : float
        Variance of the samples about their means, after the effect, or before it
        if `variance_is_before`.

    Examples
    --------
    >>> x = np.random.default_rng(1).normal(0.7, 1.5, 1_000_000)
    >>> passed = undo_transfer(np.trunc, np.array([np.trunc(x).mean()]), np.trunc(x).var())
    >>> passed.mean.round(2), round(passed.variance, 2)
    (array([0.7]), 2.24)
    """
    order = np.argsort(mean, kind="stable")[: np.count_nonzero(np.isfinite(mean))]
    groups = np.array_split(order, max(min(_MAX_MEANS, order.size), 1))
    after = np.array([mean[group].mean() if group.size else 0.0 for group in groups])
    weight = np.array([group.size for group in groups], np.float64) / max(order.size, 1)
    before, square = after.copy(), max(variance, 1e-300)
    for _ in range(_TRANSFER_ROUNDS):
        noise = np.sqrt(square) * _NORMAL
        passed = transfer(before[:, None] + noise)
        spread = passed.var(axis=1)
        gain = (passed * noise).mean(axis=1) / square
        before += after - passed.mean(axis=1)
        if not variance_is_before:
            left = float(weight @ spread) / square
            square *= np.clip(variance / max(left * square, 1e-300), 0.5, 2.0)
    share, moved = np.ones(mean.size), np.zeros(mean.size)
    for number, group in enumerate(groups):
        share[group] = max(spread[number] / square, _MIN_SHARE)
        moved[group] = before[number] - after[number]
    return PassedNoise(mean + moved, float(square), share, float(weight @ gain))

"""What values tell beside their spectrum: how many jump out, where they stick, and the lattice that they stand on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyrostab.kernels.spectra.outliers import HISTOGRAM, departures, histogram_edge, peaks

__all__ = [
    "CHANCE",
    "Peaks",
    "beyond_chance",
    "chance_of_all",
    "count_outliers",
    "find_peaks",
    "outlier_limit",
    "quantization_step",
    "samples_at_once",
    "zeros_together",
]

Array = NDArray[np.float64]
#: Outliers that a record of Gaussian noise has on average, by axis.
CHANCE = 0.02
_LOWEST = 4.0  # deviations of the block's own from which on a sample may be an outlier
_SWELLS = np.linspace(0.0, 0.6, 61)  # scatter of the logarithm of a level within blocks
_FAIR = (
    2.5,
    3.7,
)  # deviations between which departures tell how much the level swells, and outliers hardly count
_CLEAR = 64.0  # a lattice is as many times coarser than the last digit
_RARE = 0.01  # of the values, which may stand off a lattice that is coarse
_TAILS = 0.1  # of the values, where spikes may be as common as those of the lattice
_NEAR = 2  # blocks on either side that help to tell a block's own noise
_LOUDER = 1.5  # times, that a block beside counts as louder
_MEDIAN = 0.6745  # of the absolute value of a standard normal number


class Peaks(NamedTuple):
    """Samples that stand alone, far from those about them: `gyrostab.kernels.spectra.outliers.peaks` of an axis."""

    block: NDArray[np.int64]
    size: Array
    level: Array


def find_peaks(values: Array, histogram: NDArray[np.uint32]) -> Peaks:
    """Peaks of some blocks of an axis that may be outliers; the histogram of the departures is added to.

    Parameters
    ----------
    values : ndarray, shape (block, sample)
        NaN where missing.
    histogram : ndarray, shape (block, `HISTOGRAM`)

    Examples
    --------
    >>> x = np.random.default_rng(1).standard_normal((50, 200))
    >>> x[7, 100] += 30.0
    >>> found = find_peaks(x, np.zeros((50, HISTOGRAM), np.uint32))
    >>> int(found.block[found.size.argmax()]), float(found.size.max().round())
    (7, 29.0)
    """
    away = np.empty_like(values)
    departures(values, away, histogram)
    return Peaks(*peaks(values, away, _deviation(histogram.astype(np.int64)), _LOWEST))


def outlier_limit(samples: float) -> float:
    """Standard deviations beyond which so many normal numbers have `CHANCE` on average, four at least.

    Examples
    --------
    >>> round(outlier_limit(18_000), 2), round(outlier_limit(8_640_000), 2)
    (4.87, 5.97)
    """
    from scipy.special import ndtri

    return float(max(-ndtri(CHANCE / (2.0 * max(samples, 1.0))), _LOWEST))


def count_outliers(
    histogram: NDArray[np.uint32], found: Sequence[Sequence[Peaks]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Samples that jump out, and their count for evidence: one that does by twice the limit has three, since no chance makes it.

    The limit is so many standard deviations of the departures that Gaussian noise as long as the
    record has `CHANCE` beyond. The deviation is from the median: the larger of the block's own and
    of that which it has together with two neighbours on either side, that of the next one where
    this is louder by half, for the noise may have risen within the block, at least a tenth of the
    record's, and at least what the noise right before or after the sample has. Where departures of
    2.5 to 3.7 deviations are more than those of Gaussian noise, the level swells faster than that
    can follow: the limit is moved out to where a level of a log-normal law with as many of them has
    `CHANCE` beyond.

    Parameters
    ----------
    histogram : ndarray, shape (axis, block, `HISTOGRAM`)
        Number of departures by size.
    found : sequence of sequence of Peaks
        Of each axis, with the numbers of the blocks in the record.

    Returns
    -------
    peaks, outliers : ndarray of int64, shape (axis, block)

    Examples
    --------
    >>> x = np.random.default_rng(1).standard_normal((50, 200))
    >>> x[7, 100] += 30.0
    >>> x[9, 100] += 7.0
    >>> histogram = np.zeros((1, 50, HISTOGRAM), np.uint32)
    >>> number, outliers = count_outliers(histogram, [[find_peaks(x, histogram[0])]])
    >>> number[0, [7, 9]], outliers[0, [7, 9]], int(number.sum())
    (array([1, 1]), array([3, 1]), 2)
    """
    sums = np.concatenate(
        [
            np.zeros_like(histogram[:, :1], dtype=np.int64),
            np.cumsum(histogram, axis=1, dtype=np.int64),
        ],
        axis=1,
    )
    block_count = np.arange(histogram.shape[1])
    near = (
        sums[:, np.minimum(block_count + _NEAR + 1, block_count.size)]
        - sums[:, np.maximum(block_count - _NEAR, 0)]
    )
    own, wide = _deviation(np.diff(sums, axis=1)), _deviation(near)
    beside = np.pad(own, ((0, 0), (1, 1)))
    beside = np.maximum(beside[:, :-2], beside[:, 2:])
    usual = np.maximum(np.maximum(own, wide), 0.1 * _deviation(sums[:, -1:]))
    scale = np.where(beside > _LOUDER * usual, beside, usual)
    number, outliers = np.zeros((2, *scale.shape), np.int64)
    for axis, components in enumerate(found):
        limit = _swollen_limit(histogram[axis], scale[axis])
        for one in components:
            away = one.size / np.maximum(scale[axis, one.block], one.level)
            np.add.at(number[axis], one.block, away > limit)
            np.add.at(
                outliers[axis], one.block, np.where(away > 2.0 * limit, 3, 1) * (away > limit)
            )
    return number, outliers


def _swollen_limit(histogram: NDArray[np.uint32], scale: Array) -> float:
    """Limit in deviations for an axis whose level may swell within its blocks."""
    from scipy.special import ndtr

    total = float(histogram.sum())
    limit = outlier_limit(total)
    low, high = _FAIR
    fair = 2.0 * (ndtr(-low) - ndtr(-high))
    surplus = _number_between(histogram, scale, low, high) / max(total * fair, 1e-300)
    place, weight = np.polynomial.hermite_e.hermegauss(31)
    weight = weight / weight.sum()
    level = np.exp(_SWELLS[:, None] * place)
    more = 2.0 * ((ndtr(-low / level) - ndtr(-high / level)) @ weight) / fair
    level = np.exp(np.interp(surplus, more, _SWELLS) * place)
    tried = np.geomspace(limit, 3.0 * limit, 200)
    beyond = np.log(2.0 * (ndtr(-tried[:, None] / level) @ weight))
    return float(np.interp(-np.log(2.0 * ndtr(-limit)), -beyond, tried))


def _number_between(histogram: NDArray[np.uint32], scale: Array, low: float, high: float) -> float:
    """Departures from `low` to `high` deviations, those of a bin shared out as normal ones."""
    from scipy.special import ndtr

    edges = (
        np.concatenate([[0.0], histogram_edge(np.arange(1, HISTOGRAM + 1))])
        / np.where(scale > 0.0, scale, np.inf)[:, None]
    )
    tail = ndtr(-edges)
    inside = ndtr(-np.clip(edges, low, high))
    whole = tail[:, :-1] - tail[:, 1:]
    share = np.divide(
        inside[:, :-1] - inside[:, 1:], whole, out=np.zeros_like(whole), where=whole > 0.0
    )
    return float((histogram * share).sum())


def _deviation(histogram: NDArray[np.int64]) -> Array:
    """Standard deviation from the median of those that are not 0, which held samples make."""
    total = np.cumsum(histogram[..., 1:], axis=-1)
    wanted = total[..., -1] / 2.0
    number = np.argmax(total >= np.maximum(wanted, 1)[..., None], axis=-1)
    inside = np.take_along_axis(histogram, number[..., None] + 1, axis=-1)[..., 0]
    before = np.take_along_axis(total, number[..., None], axis=-1)[..., 0] - inside
    share = np.divide(wanted - before, inside, out=np.ones(wanted.shape), where=inside > 0)
    return np.asarray(
        np.where(total[..., -1] > 0, histogram_edge(number + 1 + share) / _MEDIAN, 0.0)
    )


def zeros_together(values: Array) -> NDArray[np.int64]:
    """Exact zeros that all axes have at once; on a single axis those that have another one beside them.

    That is how lost samples look which were filled with zeros. A loop that sticks at zero does it
    in each axis by itself, whenever its rate goes by.

    Parameters
    ----------
    values : ndarray, shape (axis, block, sample)

    Returns
    -------
    ndarray of int64, shape (axis, block)

    Examples
    --------
    >>> zeros_together(np.array([[[0.0, 0.0, 0.0, 1.0]], [[0.0, 2.0, np.nan, 0.0]]]))
    array([[1],
           [1]])
    >>> zeros_together(np.array([[[0.0, 0.0, 1.0, 0.0]]]))
    array([[2]])
    """
    zero = values == 0.0
    if not zero.any():
        return np.zeros(zero.shape[:2], np.int64)
    if len(zero) == 1:
        pair = zero[..., 1:] & zero[..., :-1]
        found = zero & (
            np.pad(pair, ((0, 0), (0, 0), (1, 0))) | np.pad(pair, ((0, 0), (0, 0), (0, 1)))
        )
    else:
        gone = np.isnan(values)
        found = zero & (zero | gone).all(axis=0) & (zero.sum(axis=0) > 1)
    return np.asarray(found.sum(axis=-1))


def samples_at_once(present: NDArray[np.bool_]) -> dict[tuple[bool, ...], NDArray[np.int64]]:
    """How many samples of each block two axes or more have at once, by which axes these are.

    Parameters
    ----------
    present : ndarray of bool, shape (axis, block, sample)

    Returns
    -------
    dict of tuple of bool to ndarray of int64, shape (block,)
        The axes that have a sample, and no other one -> number of instants.

    Examples
    --------
    >>> samples_at_once(np.array([[[True, True, True]], [[True, False, True]], [[True, True, False]]]))
    {(True, False, True): array([1]), (True, True, False): array([1]), (True, True, True): array([1])}
    """
    axes, block_count = present.shape[:2]
    if axes < 2:
        return {}
    if (present == present[:1]).all():
        return {(True,) * axes: np.asarray(np.count_nonzero(present[0], axis=-1), np.int64)}
    code = (present * (1 << np.arange(axes, dtype=np.int64))[:, None, None]).sum(axis=0)
    kinds, place = np.unique(code, return_inverse=True)
    each = np.arange(block_count)[:, None] * kinds.size + place.reshape(code.shape)
    number = np.bincount(each.ravel(), minlength=block_count * kinds.size).reshape(
        block_count, kinds.size
    )
    found = {
        tuple(bool(kind >> axis & 1) for axis in range(axes)): number[:, k]
        for k, kind in enumerate(kinds.tolist())
    }
    return {kind: found[kind] for kind in sorted(found) if sum(kind) > 1}


def beyond_chance(
    together: NDArray[Any],
    zeros: NDArray[Any],
    samples: NDArray[Any],
    subset: NDArray[np.bool_],
    at_once: NDArray[Any],
) -> NDArray[np.int64]:
    """Zeros of `zeros_together` less those that independent zeros of the axes, or of a single axis, would bring together.

    Parameters
    ----------
    together, zeros, samples : ndarray of int, shape (..., axis, block)
    subset : ndarray of bool, shape (subset, axis)
        Which axes have samples at once; nothing is asked of it where there is a single axis.
    at_once : ndarray of int, shape (subset, block)
        Number of samples that these axes have at once, and no other one.

    Returns
    -------
    ndarray of int64, shape (..., axis, block)

    Examples
    --------
    >>> both = np.array([[True, True]])
    >>> beyond_chance(np.array([[30], [30]]), np.array([[40], [50]]), np.array([[100], [100]]), both, np.array([[100]]))
    array([[10],
           [10]])
    """
    share = zeros / np.maximum(samples, 1)
    if zeros.shape[-2] == 1:
        chance = zeros * (1.0 - (1.0 - share) ** 2)
    else:
        all_zero = chance_of_all(share, subset)
        chance = np.moveaxis(
            np.tensordot(subset.T.astype(np.float64), all_zero * at_once, axes=(1, -2)), 0, -2
        )
    return np.asarray(np.maximum(together - np.rint(chance), 0), np.int64)


def chance_of_all(share: Array, subset: NDArray[np.bool_]) -> Array:
    """Chance that all axes of each subset are zero at once, (..., subset, block), from the shares (..., axis, block) of zeros."""
    return np.asarray(
        np.stack([np.prod(share[..., np.flatnonzero(one), :], axis=-2) for one in subset], axis=-2)
    )


def quantization_step(values: Array) -> float:
    """Step of the lattice that values stand on, whatever its offset; 0 when there is none, or when it is too fine to matter.

    Parameters
    ----------
    values : ndarray
        Some thousand values; NaN is passed over.

    Examples
    --------
    >>> noise = np.random.default_rng(1).standard_normal(5000)
    >>> lattice_step(noise), round(lattice_step(np.round(noise / 0.3) * 0.3 + 0.1), 9)
    (0.0, 0.3)
    >>> round(lattice_step(np.append(np.round(noise / 0.3) * 0.3, [17.77, -23.91])), 9)  # two spikes off the lattice
    0.3
    """
    finite = values[np.isfinite(values)]
    if finite.size < 32:
        return 0.0
    levels, times = np.unique(finite, return_counts=True)
    size = float(np.abs(levels).max())
    kept = [_common_levels(levels, times, rare) for rare in (_RARE, _TAILS)]
    for several in (one for one in kept if one.size) if kept[0].size else (levels,):
        for resolution in (2.0**-23, 2.0**-52):  # as written in single and in double precision
            fine = 8.0 * resolution * size
            apart = np.diff(several)
            apart = apart[apart > fine]
            if 0 < apart.size <= 0.8 * finite.size:
                step = _common(apart, fine)
                if step > 0.0 and (
                    several is levels or _share_off(levels, times, step, fine) <= _RARE
                ):
                    return step
    return 0.0


def _common_levels(levels: Array, times: NDArray[np.int64], rare: float) -> Array:
    """Levels without the rarest, which hold this share of the values: spikes, off the lattice; empty where those left are no coarse one."""
    order = np.argsort(times, kind="stable")
    common = np.sort(order[np.cumsum(times[order]) > rare * times.sum()])
    return levels[common] if common.size and times[common].min() > 1 else levels[:0]


def _share_off(levels: Array, times: NDArray[np.int64], step: float, fine: float) -> float:
    """Share of the values that do not stand on the lattice of this step on which the most common one stands."""
    away = np.abs(levels - levels[times.argmax()]) / step
    whole = np.round(away)
    off = np.abs(away - whole) * step > 2.0 * fine * (1.0 + whole)
    return float(times[off].sum() / times.sum())


def _common(apart: Array, fine: float) -> float:
    """Largest number of which all distances are multiples, but for `fine` errors; 0 when there is none well above these."""
    step = float(apart.min())
    while step > _CLEAR * fine:
        whole = np.round(apart / step)
        near = whole < step / (
            16.0 * fine
        )  # farther ones may be off by their number times the error of the step
        rest = np.abs(apart - whole * step)
        wrong = near & (rest > 2.0 * fine * (1.0 + whole))
        if not near.any():
            return 0.0
        if not wrong.any():
            return float(apart[near].sum() / whole[near].sum())
        step = float(rest[wrong].min())
    return 0.0

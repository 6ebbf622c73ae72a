"""How much better the insides of blocks are explained by two levels than by noise: for a bias that hops within blocks.

The means of blocks tell no levels where the bias hops several times in each of them; means over
sixteenths of a block may. They know less of the noise, since what its spectrum has between both
lengths was not calibrated by means. So noise has a free white level here, and two levels have to do
better too than normal noise of any spectrum, which includes Gauss-Markov noise of the same second
order, and lines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.products import WIDTHS, mean_products, take_out
from gyrostab.diagnose.evidence.telegraph import (
    MEAN_SWITCHES,
    TelegraphCourses,
    course_evidence,
    telegraph_courses,
    usual_courses,
    waves,
)
from gyrostab.kernels.spectra.periodogram import (
    band_edges,
    band_powers,
    gap_spectra,
    ordinates,
    taper,
)
from gyrostab.physics.lorentz import lorentz_density

__all__ = ["SwitchingEvidence", "switching_evidence", "switching_powers"]

Array = NDArray[np.float64]
#: Nats by which two levels must be better than normal noise of any spectrum.
NORMAL, _SURE = 10.0, 20.0
_ORDERS = (0, 1, 2, 4, 8, 16, 32)  # of the autoregression that stands for it
_MOST = (
    12_000  # means that a course is sought in; where there are more of them they are put together
)
_PARTS = 64  # of a piece, each on one level
_BETWEEN = 0.1  # share of a piece
_DRAWN, _BELOW, _SHAPE = (
    16,
    4.0,
    0.2,
)  # records drawn; deviations below their likelihood, and nats for each hop, that are let pass
_LEAST = 0.5  # of the samples of a mean that must be there
_QUIETEST = 1e-4  # of the expected white variance
_OF_SQUARE, _NEXT = (
    0.455,
    1.15,
)  # median of the square of a normal number; between white levels that are tried
_TOLD = 0.4  # periods of a wave in a piece, up to which pieces tell it
_AT_ONCE = 500  # blocks whose spectra are worked out at once
# quantiles of the means that may be levels: excursions may be rare
_STARTS = ((0.05, 0.95), (0.25, 0.75), (0.25, 0.99), (0.01, 0.75), (0.5, 0.999), (0.001, 0.5))


@dataclass(frozen=True)
class SwitchingEvidence:
    """A bias of two levels that hops within blocks.

    Attributes
    ----------
    evidence_nats : float
        Lower bound of the log Bayes factor against noise [nats]; -inf where there are fewer than
        `MEAN_SWITCHES` hops, or where normal noise of any spectrum does as well but for `NORMAL`
        nats.
    share : ndarray, shape (block, piece)
        Of each piece on the upper level.
    times : ndarray, shape (2,)
        Mean times on the lower and on the upper level [s].
    hops : float
        Expected number.
    refuted : bool
        The pieces do better with two levels than with white noise and a walk, but it is not two
        levels that they have.
    """

    evidence_nats: float
    share: Array
    times: Array
    hops: float
    refuted: bool = False


def switching_evidence(
    data: xr.Dataset, baseline: xr.Dataset, *, axis: str, given: Array | None = None
) -> SwitchingEvidence | None:
    """What two levels gain in means over pieces of blocks.

    Parameters
    ----------
    data : xarray.Dataset
        One reduced record with ``piece_mean`` (axis block inner) [degree hour-1] and
        ``piece_samples``.
    baseline : xarray.Dataset
        As for `gyrostab.diagnose.evidence.telegraph.telegraph_evidence`.
    axis : str
    given : ndarray, shape (block, piece, column), optional
        Columns that are in the model with and without it.

    Returns
    -------
    Hops or None
        None where the record has no such means, or too few of them.
    """
    if "piece_mean" not in data or "record" in data.dims:
        return None
    values, variance, together = _pieces(data, baseline, axis)
    shape = values.shape
    present = (np.isfinite(values) & np.isfinite(variance)).ravel()
    if present.sum() < 10.0 * MEAN_SWITCHES or np.ptp(values.ravel()[present]) == 0.0:
        return None
    step = float(data.attrs["block_s"]) / shape[1]
    n = present.size
    flat = np.where(present, values.ravel(), 0.0)[:, None]
    variance = np.where(present, variance.ravel(), 1.0)
    own = np.empty((n, 0)) if given is None else _grouped(given, together).reshape(n, -1)
    best: SwitchingEvidence | None = None
    for count in (0, 8):
        beside = np.concatenate([waves(n, count), own], axis=1)
        found = telegraph_courses(
            flat, variance, present, beside, starts=_STARTS, least=_QUIETEST, components=_PARTS
        )
        evidence_nats, beyond = _worth(
            found, flat, variance, present, own, step, baseline.sel(axis=axis)
        )
        evidence_nats -= np.log(2.0)
        share = np.repeat(found.share[0].reshape(shape), together, axis=1)
        seen = found.hops[0] >= MEAN_SWITCHES and evidence_nats > 0.0
        alike = seen and _like_two_levels(found, variance, present)
        good, refuted = (
            alike and beyond > NORMAL,
            seen and evidence_nats > _SURE and (not alike or beyond < -_SURE),
        )
        one = SwitchingEvidence(
            evidence_nats if good else -np.inf,
            share,
            found.times[0] * step,
            float(found.hops[0]),
            bool(refuted),
        )
        best = (
            one
            if best is None or one.evidence_nats > best.evidence_nats
            else replace(best, refuted=best.refuted and one.refuted)
        )
    return best


def _like_two_levels(found: TelegraphCourses, variance: Array, present: NDArray[np.bool_]) -> bool:
    """Whether the bias is between the levels as rarely as one is that hops like this.

    More levels, or a wave, are followed as well by hops that are fast enough; but shares of
    neighbouring pieces are not alike then.
    """
    log, share = usual_courses(
        found, variance, present, components=_PARTS, count=_DRAWN, rng=np.random.default_rng(0)
    )
    alike = _alike(share)
    return bool(
        found.log[0] > log.mean() - _BELOW * log.std() - _SHAPE * float(found.hops[0])
        and _alike(found.share)[0] < alike.mean() + _BELOW * max(float(alike.std()), 1.0)
    )


def _alike(share: Array) -> Array:
    """Number of neighbouring pieces (record,) that are as long on the upper level, and neither always nor never."""
    between = (share > _BETWEEN) & (share < 1.0 - _BETWEEN)
    return np.asarray(
        (between[:, 1:] & between[:, :-1] & (np.abs(np.diff(share, axis=1)) < _BETWEEN)).sum(axis=1)
    )


def _pieces(data: xr.Dataset, baseline: xr.Dataset, axis: str) -> tuple[Array, Array, int]:
    """Means over pieces, their white variance, and how many pieces are together in each."""
    one, known = data.sel(axis=axis), baseline.sel(axis=axis)
    samples = one["piece_samples"].transpose("block", "inner").values.astype(np.float64)
    mean = one["piece_mean"].transpose("block", "inner").values
    together = 1
    while samples.size // together > _MOST and together < samples.shape[1]:
        together *= 2
    count = samples.reshape(len(samples), -1, together).sum(axis=2)
    total = (
        np.where(samples > 0, np.nan_to_num(mean) * samples, 0.0)
        .reshape(len(samples), -1, together)
        .sum(axis=2)
    )
    enough = (count >= _LEAST * max(np.median(count), 1.0)) & np.isfinite(one["mean"].values)[
        :, None
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.where(enough, total / count, np.nan) - known["known_mean"].values[:, None]
        variance = (known["mean_variance"].values * one["samples"].values)[:, None] / count
    return values, np.where(enough, variance, np.nan), together


def _grouped(given: Array, together: int) -> Array:
    """Columns (block, piece, column) as means over the pieces that are together, of size one at most."""
    out = np.nan_to_num(given).reshape(given.shape[0], -1, together, given.shape[2]).mean(axis=2)
    most = np.abs(out).max(axis=(0, 1))
    return np.asarray(out / np.where(most > 0.0, most, 1.0))


def _worth(
    found: TelegraphCourses,
    values: Array,
    variance: Array,
    present: NDArray[np.bool_],
    given: Array,
    step: float,
    baseline: xr.Dataset,
) -> tuple[float, float]:
    """Evidence of the course over that of white noise with a walk, and over that of normal noise of any spectrum [nats]."""
    K, B, prior = _slow(baseline)
    base = {"step": step, "K": K, "B": B, "present": present}
    columns = np.concatenate([found.share.T, given], axis=1)
    beside = given.shape[1]
    logs: dict[str, list[float]] = {"none": [], "two": []}
    scales = _scales(found, values[:, 0], variance, present)
    for scale in scales:
        white = {**base, "variance": variance * scale}
        plain = mean_products(values, columns, **white)
        wide = np.diag(np.maximum(np.diagonal(plain.gram[0])[1:], 1e-300)) / WIDTHS[-1] ** 2
        scatter = float(found.spread[0] @ np.where(present, 1.0 / white["variance"], 0.0))
        usual = found.share[0][present]
        unit = float(((usual - usual.mean()) ** 2 / white["variance"][present]).sum())
        none, two = course_evidence(take_out(plain, beside, wide), 0, scatter, prior, unit=unit)
        logs["none"].append(none)
        logs["two"].append(two)
    none, two = (
        float(np.logaddexp.reduce(logs[name])) - np.log(scales.size) for name in ("none", "two")
    )
    two -= float(found.cost[0])
    return two - none, two - _normal_log(values[:, 0], variance, present, given)


def _normal_log(values: Array, variance: Array, present: NDArray[np.bool_], given: Array) -> float:
    """Logarithm of the likelihood of normal noise of any spectrum, as autoregression has it, in the units of `course_evidence`.

    Coefficients have the price of Schwarz, half of the logarithm of the number of data each.
    """
    beside = np.concatenate([np.ones((present.size, 1)), given], axis=1)
    size, *_ = np.linalg.lstsq(beside[present], values[present], rcond=None)
    y = np.where(present, values - beside @ size, 0.0)
    n = int(present.sum())
    constant = 0.5 * np.log(np.median(variance[present]) / n)  # that of a free constant
    best = -np.inf
    for order in (order for order in _ORDERS if order < n / 10):
        lags = (
            np.stack([np.roll(y, lag) for lag in range(1, order + 1)], axis=1)
            if order
            else np.empty((y.size, 0))
        )
        there = present & np.all([np.roll(present, lag) for lag in range(order + 1)], axis=0)
        there[:order] = False
        used, others = int(there.sum()), present & ~there
        if used < n / 2:
            continue
        factor, *_ = np.linalg.lstsq(lags[there], y[there], rcond=None)
        log = -0.5 * used * (1.0 + np.log(np.mean((y[there] - lags[there] @ factor) ** 2)))
        log -= 0.5 * others.sum() * (1.0 + np.log(np.mean(y[others] ** 2))) if others.any() else 0.0
        best = max(best, float(log) - 0.5 * order * np.log(n))
    return float(best + constant)


def _slow(baseline: xr.Dataset) -> tuple[Array, Array, Array]:
    """Random walks of the grid without flicker, and the least flicker without a walk, with the logarithms of their weights.

    Which of them is likely is left open: what was calibrated may be mostly the hops.
    """
    K, B, free = (baseline[f"grid_{name}"].values for name in ("K", "B", "prior"))
    least = np.min(B, where=B > 0.0, initial=np.inf)
    chosen = (B == 0.0) | ((K == 0.0) & (least == B))
    return K[chosen], B[chosen], free[chosen] - np.logaddexp.reduce(free[chosen])


def _scales(
    found: TelegraphCourses, values: Array, variance: Array, present: NDArray[np.bool_]
) -> Array:
    """White levels that are tried, over the expected one: that, more, and what differences of neighbours say with a course and without."""
    both = present[1:] & present[:-1]
    seen = [1.0, 2.0, 4.0]
    for left in (values, values - found.step[0] * found.share[0]):
        square = np.diff(left)[both] ** 2 / (variance[1:] + variance[:-1])[both]
        seen += [
            float(np.mean(square)),
            *(float(np.median(square)) / _OF_SQUARE * np.array([1.0 / _NEXT, 1.0, _NEXT])),
        ]
    return np.unique(np.maximum(seen, 1e-12))


def switching_powers(share: Array, low: float, high: float, size: int, rate: float) -> Array:
    """Band powers within blocks of a bias of two levels, for a step of one.

    At frequencies that pieces tell, those of the course; beyond, those of hops at random instants,
    as many as each block has.

    Parameters
    ----------
    share : ndarray, shape (block, piece)
        Of each piece on the upper level.
    low, high : float
        Mean times on both levels [s].
    size : int
        Samples of a block.
    rate : float
        Sampling rate [Hz].

    Returns
    -------
    ndarray, shape (block, band)
        Two-sided density [Hz-1].

    Examples
    --------
    >>> share = np.repeat([[0.0, 1.0], [1.0, 1.0]], 8, axis=1)
    >>> hop_powers(share, 20.0, 20.0, 200, 10.0).round(2)[:, 0] > 1.0
    array([ True, False])
    """
    weights, edges = taper(size), band_edges(size)
    expected, _, _ = gap_spectra(np.ones((1, size), bool), weights)
    out = np.empty((len(share), edges.size - 1))
    for first in range(0, len(share), _AT_ONCE):
        wave = _wave(share, slice(first, first + _AT_ONCE), size)
        wave -= wave.mean(axis=1, keepdims=True)
        spectra = np.fft.rfft(wave * weights, axis=1)[:, 1 : ordinates(size) + 1]
        place = np.zeros(len(spectra), np.int64)
        out[first : first + len(spectra)] = band_powers(
            spectra, spectra, expected, place, edges, rate
        ).real
    frequency = (edges[:-1] + edges[1:] - 1) / 2.0 * rate / size
    moves = np.abs(np.diff(share.ravel(), prepend=share[0, 0])).reshape(share.shape).sum(axis=1)
    usual = (
        low * high / (low + high) ** 2 * lorentz_density(frequency, low * high / (low + high), rate)
    )
    beyond = moves[:, None] / max(float(moves.mean()), 1e-300) * usual
    return np.where(frequency < _TOLD * rate * share.shape[1] / size, out, beyond)


def _wave(share: Array, block_count: slice, size: int) -> Array:
    """The course of some blocks, sample by sample: within a piece the bias hops so that it meets the levels at both ends."""
    pieces = share.shape[1]
    flat = np.clip(share.ravel(), 0.0, 1.0)
    ends = np.concatenate([flat[:1], (flat[1:] + flat[:-1]) / 2.0, flat[-1:]]) > 0.5
    before, after = (one.reshape(share.shape)[block_count] for one in (ends[:-1], ends[1:]))
    component = flat.reshape(share.shape)[block_count]
    outer = before & after
    long = np.where(outer, 1.0 - component, component)
    begin = np.where(before == after, 0.5 - long / 2.0, np.where(before, 0.0, 1.0 - long))
    place = np.arange(size + 1) / size * pieces
    which = np.minimum(place[:-1].astype(np.int64), pieces - 1)
    low, high = place[:-1] - which, place[1:] - which
    start, stop = begin[:, which], (begin + long)[:, which]
    inside = np.maximum(np.minimum(high, stop) - np.maximum(low, start), 0.0) / (high - low)
    return np.asarray(np.where(outer[:, which], 1.0 - inside, inside))

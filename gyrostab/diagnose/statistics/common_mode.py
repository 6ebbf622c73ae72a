"""Slow motion that axes share: waveforms that each axis by itself takes for its own random walk."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.wandering import expected_processes
from gyrostab.diagnose.statistics.cross_spectrum import correlation_score
from gyrostab.diagnose.statistics.scores import (
    Array,
    Windows,
    cube_root_score,
    over_windows,
    statistic_dataset,
    values_of,
    window_set,
)
from gyrostab.kernels.regression.state_space import flicker_states, whiten
from gyrostab.noise import HOUR

__all__ = ["LENGTHS", "SPANS", "score"]

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (60,)
#: Blocks over which the increments are averaged.
SPANS = (1, 2, 4, 8, 16, 32, 64)
_FEWEST = 8.0  # independent averages; with fewer a correlation is no number to judge by
_OVERLAP = (
    1.5  # independent averages that overlapping ones are worth, for each that lies beside the next
)
_SINGULAR = -27.0  # logarithm of a determinant that is as good as zero
_PROBES, _SEED = (
    64,
    20,
)  # series of white noise that tell what a known covariance makes of the increments


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
    """Score the correlation of what is new in the block means of every pair of axes, against axes that wander independently.

    The block means of each axis are whitened by its noise: what is left of each is what the ones
    before do not foretell, the increment of a random walk or the mean of white noise. The noise of
    the sensors is new on every axis by itself, however much of it there is; hence the correlation
    is scored, which no error of the calibration changes. The increments are averaged over several
    blocks, since what the axes share may be slow.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records, and what the simulation expects; white noise that the axes share
        by its ``cross`` is taken off.

    Returns
    -------
    xarray.Dataset or None
        None with one axis, or where the record is too short. A row for each pair, whose ``ratio``
        and ``estimate`` are the correlation. Three axes or more have a row of all together, by the
        determinant of their correlations; its ``estimate`` is the root of the mean square of them.
    """
    axes = [str(axis) for axis in blocks["axis"].values]
    block_count = blocks.sizes["block"]
    spans = [span for span in SPANS if _OVERLAP * block_count / span >= _FEWEST]
    if len(axes) < 2 or not spans:
        return None
    windows = window_set(block_count, LENGTHS)
    residual = values_of(blocks, "mean", "axis", "block") - values_of(
        baseline, "known_mean", "axis", "block"
    )
    there = np.isfinite(residual).reshape(-1, *residual.shape[-2:]).all(axis=0)
    new = _increments(residual, there, blocks, baseline)
    pairs = list(combinations(range(len(axes)), 2))
    shared = _shared(there, pairs, blocks, baseline) if "cross" in baseline else None
    found = [_correlations(new, there, pairs, windows, span, shared) for span in spans]
    r, count = (
        np.stack([one for one, _ in found], axis=-1),
        np.stack([one for _, one in found], axis=-1),
    )
    z = correlation_score(r, np.broadcast_to(count, r.shape))
    rows = [f"{axes[a]} {axes[b]}" for a, b in pairs]
    if len(rows) > 1:
        z = np.concatenate([z, _together(r, count, pairs, len(axes))[..., None, :, :]], axis=-3)
        r = np.concatenate([r, np.sqrt((r**2).mean(axis=-3, keepdims=True))], axis=-3)
        rows = [*rows, " ".join(axes)]
    block = float(blocks.attrs["block_s"])
    return statistic_dataset(
        "cross_axis",
        blocks,
        rows=rows,
        windows=windows,
        columns={
            "what": "slow",
            "tau_min_s": block * np.array(spans, dtype=float),
            "tau_max_s": block * block_count / 2.0,
        },
        z=z,
        ratio=np.abs(r),
        estimate=r,
    )


def _increments(
    residual: Array, there: NDArray[np.bool_], blocks: xr.Dataset, baseline: xr.Dataset
) -> Array:
    """Whitened block means by (record), axis, block; zero where there is none."""
    terms = [str(term) for term in baseline["term"].values]
    white = baseline["mean_variance"].transpose("axis", "block").values
    begin, end, block = (
        blocks["begin"].values,
        blocks["end"].values,
        float(blocks.attrs["block_s"]),
    )
    share, times, faster = flicker_states(block, float(end[-1] - begin[0]))
    new = np.empty_like(residual)
    for axis in range(residual.shape[-2]):
        b, k = (
            float(np.nan_to_num(baseline["coefficient"].values[axis, terms.index(term)]))
            for term in ("B", "K")
        )
        present = there[axis] & np.isfinite(white[axis]) & (white[axis] > 0)
        variance = np.where(present, white[axis] + b**2 * faster, 1.0)
        series = residual[..., axis, :].reshape(-1, residual.shape[-1])
        columns = np.ascontiguousarray(np.where(present, series, 0.0).T)
        known = expected_processes(baseline, axis)
        states = np.append(b**2 * share, known.square), np.append(times, known.time)
        made, _ = whiten(columns, variance, end - begin, present, k**2 / HOUR + known.walk, *states)
        new[..., axis, :] = made.T.reshape(new[..., axis, :].shape)
    return new


def _shared(
    there: NDArray[np.bool_],
    pairs: list[tuple[int, int]],
    blocks: xr.Dataset,
    baseline: xr.Dataset,
) -> tuple[Array, Array]:
    """Increments of one white noise on all axes by probe, axis, block, and the part of it that each pair is known to share."""
    series = np.random.default_rng(_SEED).standard_normal((_PROBES, 1, there.shape[1]))
    series = series * np.sqrt(
        np.nan_to_num(baseline["mean_variance"].transpose("axis", "block").values)
    )
    spectrum = baseline["spectrum"].transpose("axis", "block", "band").values[..., 0]
    cross = baseline["cross"].transpose("pair", "block", "band").values[..., 0].real
    one, other = ([pair[side] for pair in pairs] for side in (0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = cross / np.sqrt(spectrum[one] * spectrum[other])
    return _increments(series, there, blocks, baseline), np.nan_to_num(np.nanmean(share, axis=-1))


def _correlations(
    new: Array,
    there: NDArray[np.bool_],
    pairs: list[tuple[int, int]],
    windows: Windows,
    span: int,
    shared: tuple[Array, Array] | None,
) -> tuple[Array, Array]:
    """Correlation of each pair by (record), pair, window, of averages over so many blocks, and the independent averages in each."""
    one, other = ([pair[side] for pair in pairs] for side in (0, 1))

    def over(values: Array) -> Array:
        return np.asarray(over_windows(values[..., None], windows)[..., 0])

    def products(values: Array) -> Array:
        return over(values[..., one, :] * values[..., other, :])

    summed = _moving(new, span)
    square, product = over(summed**2), products(summed)
    if shared is not None:
        product = product - shared[1][:, None] * products(_moving(shared[0], span)).mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        r = np.clip(product / np.sqrt(square[..., one, :] * square[..., other, :]), -1.0, 1.0)
    count = over((there[one] & there[other]).astype(float)) * (_OVERLAP / span if span > 1 else 1.0)
    remembered = _memory(summed, one, other)[..., None] * (_OVERLAP / span if span > 1 else 1.0)
    return np.where(count >= _FEWEST, r, np.nan), count / np.maximum(remembered, 1.0)


def _memory(summed: Array, one: list[int], other: list[int]) -> Array:
    """Blocks that an independent value takes in each pair: the sum of the products of their autocorrelations (Bartlett 1935)."""
    n = summed.shape[-1]
    power = np.abs(np.fft.rfft(summed, 2 * n, axis=-1)) ** 2
    own = np.fft.irfft(power, 2 * n, axis=-1)[..., : n // 4]
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.nan_to_num(own / own[..., :1])
    return np.asarray(2.0 * (own[..., one, :] * own[..., other, :]).sum(axis=-1) - 1.0)


def _moving(values: Array, span: int) -> Array:
    """Sums over so many blocks about each."""
    total = np.pad(np.cumsum(values, axis=-1), [(0, 0)] * (values.ndim - 1) + [(1, 0)])
    place = np.arange(values.shape[-1])
    low, high = np.maximum(place - span // 2, 0), np.minimum(place - span // 2 + span, place.size)
    return np.asarray(total[..., high] - total[..., low])


def _together(r: Array, count: Array, pairs: list[tuple[int, int]], axes: int) -> Array:
    """Score of all correlations by (record), window, span: likelihood ratio against independent axes (Bartlett 1954)."""
    matrix = np.broadcast_to(np.eye(axes), (*r.shape[:-3], *r.shape[-2:], axes, axes)).copy()
    for place, (a, b) in enumerate(pairs):
        matrix[..., a, b] = matrix[..., b, a] = r[..., place, :, :]
    known = np.asarray(np.isfinite(matrix).all(axis=(-2, -1)))
    sign, logarithm = np.linalg.slogdet(np.where(known[..., None, None], matrix, np.eye(axes)))
    samples = np.maximum(count.min(axis=-3) - (2.0 * axes + 5.0) / 6.0, 1.0)
    freedom = len(pairs)
    value = -samples * np.where(sign > 0, np.maximum(logarithm, _SINGULAR), _SINGULAR) / freedom
    return np.where(known, cube_root_score(value, np.full(value.shape, freedom / 2.0)), np.nan)

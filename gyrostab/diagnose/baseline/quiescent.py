"""Blocks in which nothing happens: what the noise is calibrated on."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import OptionError
from gyrostab.time.grid import stamp_ns

__all__ = ["LEVEL_SPANS", "find_quiescent_blocks", "find_quiescent_spans", "loudness"]

Array = NDArray[np.float64]
#: Blocks over which the level is averaged.
LEVEL_SPANS = (1, 5, 15)
_LEAST_SHARE, _LEAST = 0.25, 16  # of the blocks; below, the calmest are taken
_LEAST_SAMPLES = (
    100  # of quiet time: the shortest block of its own choice; N is known to 7 % from them
)
_AFTER_RESTART_S = 900.0
_LOUD = 4.5  # standard deviations


def _running(values: Array, count: int) -> Array:
    """Sum over `count` neighbouring rows, fewer at the ends."""
    total = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    half = count // 2
    n = values.shape[0]
    place = np.arange(n)
    return np.asarray(total[np.minimum(place + half + 1, n)] - total[np.maximum(place - half, 0)])


def _restlessness(blocks: xr.Dataset) -> dict[str, Array]:
    """Channel -> how far each block is from rest, 1 at the limit."""
    found: dict[str, Array] = {}
    step = float(blocks["end"][0] - blocks["begin"][0])
    for name in (str(name) for name in blocks.data_vars):
        if not name.startswith("channel_"):
            continue
        values = blocks[name].values.astype(np.float64)
        good = np.isfinite(values)
        if good.sum() < max(_LEAST, values.size // 4):
            continue
        place = np.arange(values.size)
        filled = np.interp(place, place[good], values[good])
        if name.startswith("channel_vibration") or name == "channel_rotation_rate":
            size = np.abs(filled)
            found[name] = size / max(
                2.0 * float(np.quantile(size, 0.2)), 0.05 * float(size.max()), np.finfo(float).tiny
            )
        elif name.startswith("channel_temperature"):
            smooth = (
                _running(filled[:, None], 5)[:, 0] / _running(np.ones((values.size, 1)), 5)[:, 0]
            )
            slope = np.abs(np.gradient(smooth, step))
            scatter = float(np.median(np.abs(np.diff(filled, 2)))) / (
                5.0 * step
            )  # of the slope, by noise and by digits
            found[name] = slope / max(
                0.3 * float(np.quantile(slope, 0.95)), 3.0 * scatter, np.finfo(float).tiny
            )
    if "moving" in blocks:
        found["motion"] = np.where(
            blocks["moving"].values.any(axis=0), 2.0, 0.0
        )  # more than 1: not at rest
    if blocks.sizes.get("restart", 0):
        since = blocks["begin"].values[:, None] - blocks["restart_end"].values
        since = np.where(since < -step, np.inf, np.maximum(since, 1.0)).min(axis=1)
        found["restarts"] = min(_AFTER_RESTART_S, _span(blocks) / 10.0) / since
    return found


def _span(blocks: xr.Dataset) -> float:
    """Length of the record [s]."""
    return float(blocks["end"][-1] - blocks["begin"][0])


def loudness(residual: Array, weight: Array) -> tuple[Array, Array]:
    """Level of every block against what is expected, over the smallest neighbourhood in which it stands out.

    Parameters
    ----------
    residual : ndarray, shape (block, band)
        Power over the expected power, less 1; NaN where missing.
    weight : ndarray, shape (block, band)
        Shape of the gamma distribution.

    Returns
    -------
    level : ndarray, shape (block,)
        Expected 1.
    deviation : ndarray, shape (block,)
        How far it lies above 1 where it does most [standard deviations].
    """
    use = np.where(np.isfinite(residual) & np.isfinite(weight), weight, 0.0)
    total = (use * np.nan_to_num(residual)).sum(axis=1, keepdims=True)
    count = use.sum(axis=1, keepdims=True)
    level, deviation = np.ones(len(use)), np.full(len(use), -np.inf)
    for span in LEVEL_SPANS:
        excess, shape = _running(total, span)[:, 0], _running(count, span)[:, 0]
        z = excess / np.sqrt(np.maximum(shape, 1e-9))
        better = (z > deviation) & (deviation < _LOUD)
        level[better] = 1.0 + (excess / np.maximum(shape, 1e-9))[better]
        deviation = np.maximum(deviation, z)
    own, spread = (
        1.0 + total[:, 0] / np.maximum(count[:, 0], 1e-9),
        3.0 / np.sqrt(np.maximum(count[:, 0], 1e-9)),
    )
    level = np.clip(
        level, own / (1.0 + spread), np.maximum(own, 0.0) * (1.0 + spread) + spread
    )  # a neighbour's noise is not its own
    return level, deviation


def _typical(power: Array, shape: Array) -> Array | None:
    """Spectrum (band,) of the block of median level, or None where there is none."""
    use = np.where(np.isfinite(power), shape, 0.0)
    if not (use.sum(axis=0) > 0.0).all():
        return None
    mean = (use * np.nan_to_num(power)).sum(axis=0) / use.sum(axis=0)
    filled = use.sum(axis=1) > 0.0
    level = (use * np.nan_to_num(power / mean)).sum(axis=1)[filled] / use.sum(axis=1)[filled]
    return np.asarray(mean * np.median(level))


def _calm_level(blocks: xr.Dataset, start: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Blocks of each axis, (axis, block), whose spectrum is not louder than that of the typical block of `start`."""
    power, shape = (
        blocks["power"].transpose("axis", "block", "band").values,
        blocks["shape"].transpose("axis", "block", "band").values,
    )
    calm = np.broadcast_to(start, power.shape[:2]).copy()
    for row in range(len(power)):
        for _ in range(3):
            typical = _typical(power[row][calm[row]], shape[row][calm[row]])
            if typical is None:
                break
            _, deviation = loudness(power[row] / typical - 1.0, shape[row])
            kept = start & (deviation < _LOUD)
            if kept.sum() < max(_LEAST, 0.3 * start.sum()) or (kept == calm[row]).all():
                break
            calm[row] = kept
    return calm


def find_quiescent_blocks(blocks: xr.Dataset, quiet: Any = None) -> tuple[NDArray[np.bool_], str]:
    """Find the blocks to calibrate on.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `reduce_log`.
    quiet : array_like of bool (block,), or sequence of (start, end), optional
        What the user knows to be quiet; spans are in seconds since the start, or ISO times.

    Returns
    -------
    quiet : ndarray of bool, shape (axis, block)
    reason : str
        What it was judged by, for people.

    Raises
    ------
    OptionError
        When the quiet time of the user holds fewer than 100 samples in whole blocks.
    """
    n, axes = blocks.sizes["block"], blocks.sizes["axis"]
    if quiet is not None:
        given = _given(blocks, quiet)
        return np.broadcast_to(given, (axes, n)).copy(), "the time that was named as quiet"
    restless = _restlessness(blocks)
    worst = np.max([*restless.values(), np.zeros(n)], axis=0)
    start = worst <= 1.0
    names = [name.removeprefix("channel_") for name in restless]
    reason = f"calm {', '.join(names)}" if names else "the level of each block (no channel tells)"
    least = max(_LEAST, int(_LEAST_SHARE * n))
    if start.sum() < least:
        start = worst <= np.sort(worst)[min(least, n) - 1]
        reason = f"nothing is calm by {', '.join(names)}: the calmest blocks"
    return _calm_level(blocks, start), reason


def _given(blocks: xr.Dataset, quiet: Any) -> NDArray[np.bool_]:
    n = blocks.sizes["block"]
    array = np.asarray(quiet)
    if array.dtype == np.bool_:
        if array.shape != (n,):
            raise OptionError(
                f"quiet has the shape {array.shape}; give one bool for each of the {n} blocks, or (start, end) pairs"
            )
        chosen = array.copy()
    else:
        begin, end = blocks["begin"].values, blocks["end"].values
        chosen = np.zeros(n, np.bool_)
        pairs = [quiet] if array.ndim == 1 else list(quiet)
        for pair in pairs:
            low, high = (_seconds(blocks, edge) for edge in pair)
            chosen |= (begin >= low - 1e-6) & (end <= high + 1e-6)
    _check_size(blocks, int(chosen.sum()))
    return np.asarray(chosen)


def _check_size(blocks: xr.Dataset, count: int) -> None:
    """Refuse too few quiet blocks to tell a noise level from, and warn where they say little of slow noise."""
    step, size = float(blocks.attrs["block_s"]), int(blocks.attrs["block_samples"])
    if count * size < _LEAST_SAMPLES:
        least = -(-_LEAST_SAMPLES // size)
        raise OptionError(
            f"quiet holds {count} whole blocks of {step:g} s, {count * size} samples; calibration needs {_LEAST_SAMPLES} samples, from "
            f"which N is known to {_white_error(_LEAST_SAMPLES):.0%}: name {(least + 1) * step:g} s or more within the "
            f"{_span(blocks):g} s of the record, or give a shorter block"
        )
    if count < _LEAST:
        warnings.warn(
            f"the quiet time holds {count} block{'' if count == 1 else 's'} of {step:g} s: N is known to {_white_error(count * size):.1%} "
            f"at best, and drift slower than {count * step:g} s not at all, so that slow mismatches may be missed; "
            f"{_LEAST * step:g} s or more are better",
            stacklevel=2,
        )


def _white_error(samples: int) -> float:
    """Relative standard error of N from white noise: the variance of n samples scatters by sqrt(2 / n), N by half of that."""
    return math.sqrt(0.5 / samples)


def _seconds(blocks: xr.Dataset, edge: Any) -> float:
    if isinstance(edge, int | float | np.integer | np.floating):
        return float(edge)
    start = np.datetime64(str(blocks.attrs["start"]).removesuffix("Z"), "ns")
    instant = np.datetime64(stamp_ns(str(edge), "quiet:"), "ns")
    return float((instant - start) / np.timedelta64(1, "ns")) / 1e9


def find_quiescent_spans(blocks: xr.Dataset, quiet: NDArray[np.bool_]) -> list[list[str]]:
    """Spans of time in which any axis is quiet, [start, end] as ISO times."""
    start = np.datetime64(str(blocks.attrs["start"]).removesuffix("Z"), "ms")
    some = np.concatenate([[False], quiet.any(axis=0), [False]])
    edges = np.flatnonzero(some[1:] != some[:-1]).reshape(-1, 2)
    begin, end = blocks["begin"].values, blocks["end"].values

    def iso(seconds: float) -> str:
        return str(start + np.timedelta64(round(seconds * 1e3), "ms")) + "Z"

    return [[iso(begin[first]), iso(end[last - 1])] for first, last in edges]

"""Quiescent blocks, on which the noise is calibrated."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.predict.windows import fill_linearly
from gyrostab.diagnose.reduce.schema import format_time, weighted_mean
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.errors import OptionError
from gyrostab.ingest.uniform import parse_instant
from gyrostab.time.stamps import stamp_ns

#: Blocks over which the noise level is averaged. Design choice.
LEVEL_SPANS = (1, 5, 15)
_MIN_GIVEN_SAMPLES = 100  # as in the shortest default block; they give N to 7 %
_MIN_GIVEN_BANDS = 4  # with a spectrum: as many as noise terms are fitted to them
_TYPICAL_ROUNDS = 3  # in which the typical spectrum is found again without noisy blocks
_MIN_RECORD_SETTLINGS = 10.0  # length of the record, over the time after a restart that is left out


def _running_sum(values: Floats, count: int) -> Floats:
    """Sum over `count` neighbouring values, fewer at the ends."""
    return np.asarray(np.convolve(values, np.ones(count), "same"), np.float64)


def _distance_from_rest(blocks: xr.Dataset, settings: Settings) -> list[Floats]:
    """Return for each channel how far each block is from rest, 1 at the limit."""
    distances: list[Floats] = []
    step = float(blocks["end"][0] - blocks["begin"][0])
    for name in (str(name) for name in blocks.data_vars):
        if not name.startswith("channel_"):
            continue
        values = blocks[name].values.astype(np.float64)
        good = np.isfinite(values)
        if good.sum() < max(settings.min_quiescent_blocks, settings.quiescent_share * values.size):
            continue
        filled = fill_linearly(values)
        if name.startswith("channel_vibration") or name == "channel_rotation_rate":
            size = np.abs(filled)
            limit = max(
                settings.calm_ratio * float(np.quantile(size, settings.calm_share)),
                settings.rest_share * float(size.max()),
                np.finfo(float).tiny,
            )
            distances.append(size / limit)
        elif name.startswith("channel_temperature"):
            smooth = _running_sum(filled, 5) / _running_sum(np.ones(values.size), 5)
            slope = np.abs(np.gradient(smooth, step))
            # Scatter of the slope by noise and digits.
            scatter = float(np.median(np.abs(np.diff(filled, 2)))) / (5.0 * step)
            limit = max(
                settings.calm_slope_share * float(np.quantile(slope, 1.0 - settings.rest_share)),
                settings.clear_sigma * scatter,
                np.finfo(float).tiny,
            )
            distances.append(slope / limit)
    if "moving" in blocks:
        # More than 1: not at rest.
        distances.append(np.where(blocks["moving"].values.any(axis=0), 2.0, 0.0))
    if blocks.sizes.get("restart", 0):
        since = blocks["begin"].values[:, None] - blocks["restart_end"].values
        since = np.where(since < -step, np.inf, np.maximum(since, 1.0)).min(axis=1)
        settling = min(settings.after_restart_s, _record_length(blocks) / _MIN_RECORD_SETTLINGS)
        distances.append(settling / since)
    return distances


def _record_length(blocks: xr.Dataset) -> float:
    """Return the length of the record [s]."""
    return float(blocks["end"][-1] - blocks["begin"][0])


def noise_level_excess(
    residual: Floats, weight: Floats, *, settings: Settings = DEFAULTS
) -> tuple[Floats, Floats]:
    """Measure the noise level of every block over the smallest span in which it is significant.

    The level (block,) is expected to be 1; its largest deviation above 1 over all spans is in
    standard deviations.

    Parameters
    ----------
    residual, weight : ndarray, shape (block, band)
        Power over expected power, minus 1, NaN where missing; shape of its gamma distribution.
    """
    use = np.where(np.isfinite(residual) & np.isfinite(weight), weight, 0.0)
    total, count = (use * np.nan_to_num(residual)).sum(axis=1), use.sum(axis=1)
    level, deviation = np.ones(len(use)), np.full(len(use), -np.inf)
    for span in LEVEL_SPANS:
        excess, shape = _running_sum(total, span), np.maximum(_running_sum(count, span), 1e-9)
        z = excess / np.sqrt(shape)
        better = (z > deviation) & (deviation < settings.noisy_sigma)
        level[better] = 1.0 + (excess / shape)[better]
        deviation = np.maximum(deviation, z)
    block_level = 1.0 + total / np.maximum(count, 1e-9)
    spread = 3.0 / np.sqrt(np.maximum(count, 1e-9))
    # The noise of a neighbour is not that of the block.
    level = np.clip(
        level, block_level / (1.0 + spread), np.maximum(block_level, 0.0) * (1.0 + spread) + spread
    )
    return level, deviation


def significant_level(residual: Floats, weight: Floats, settings: Settings) -> Floats:
    """Return the noise level (block,) of `noise_level_excess`; 1 if not significant."""
    level, deviation = noise_level_excess(residual, weight, settings=settings)
    return np.where(deviation > settings.excess_sigma, level, 1.0)


def _typical_spectrum(power: Floats, shape: Floats) -> Floats | None:
    """Return the spectrum (band,) of the block with the median level, or None without data."""
    mean, total = weighted_mean(power, shape)
    if not (total > 0.0).all():
        return None
    level, total_of_block = weighted_mean(power / mean, shape, axis=1)
    return np.asarray(mean * np.median(level[total_of_block > 0.0]))


def _drop_noisy_blocks(blocks: xr.Dataset, start: Bools, settings: Settings) -> Bools:
    """Return blocks (axis, block) that are not noisier than the typical block of `start`."""
    power, shape = blocks["power"].values, blocks["shape"].values
    quiescent = np.broadcast_to(start, power.shape[:2]).copy()
    for row in range(len(power)):
        for _ in range(_TYPICAL_ROUNDS):
            typical = _typical_spectrum(power[row][quiescent[row]], shape[row][quiescent[row]])
            if typical is None:
                break
            _, deviation = noise_level_excess(
                power[row] / typical - 1.0, shape[row], settings=settings
            )
            still_quiescent = start & (deviation < settings.noisy_sigma)
            if (
                still_quiescent.sum()
                < max(settings.min_quiescent_blocks, settings.steady_share * start.sum())
                or (still_quiescent == quiescent[row]).all()
            ):
                break
            quiescent[row] = still_quiescent
    return quiescent


def find_quiescent_blocks(
    blocks: xr.Dataset, quiet: Any = None, *, settings: Settings = DEFAULTS
) -> Bools:
    """Find the quiescent blocks (axis, block), to calibrate on.

    Without `quiet` these are the blocks at rest, or the quietest where too few are.

    Parameters
    ----------
    quiet : (start, end) or several of these, optional
        Quiescent time given by the user: seconds since the start, or ISO times.
    """
    n = blocks.sizes["block"]
    given_blocks = given_quiescent_blocks(blocks, quiet, settings=settings)
    if given_blocks is not None:
        return given_blocks
    worst = np.max([*_distance_from_rest(blocks, settings), np.zeros(n)], axis=0)
    start = worst <= 1.0
    min_blocks = max(settings.min_quiescent_blocks, int(settings.quiescent_share * n))
    if start.sum() < min_blocks:
        start = worst <= np.sort(worst)[min(min_blocks, n) - 1]
    return _drop_noisy_blocks(blocks, start, settings)


def given_quiescent_blocks(
    blocks: xr.Dataset, quiet: Any, *, settings: Settings = DEFAULTS
) -> Bools | None:
    """Return the blocks (axis, block) given as quiescent by the user, if they can be used.

    None without `quiet`, and, with a warning, where its whole blocks hold fewer than 100 samples or
    no spectrum: the diagnosis then continues without it. A span that extends beyond the record by a
    block or more is used as far as the record goes, with a warning.

    Raises
    ------
    OptionError
        If a span lies outside the record or ends before it begins.
    """
    if quiet is None:
        return None
    n = blocks.sizes["block"]
    array = np.asarray(quiet)
    if array.ndim not in (1, 2) or array.shape[-1] != 2:
        raise OptionError(f"quiet={quiet!r}: give (start, end), or a list of such pairs")
    begin, end = blocks["begin"].values, blocks["end"].values
    record_end = _seconds_since_start(blocks, blocks.attrs["end"])
    step = float(blocks.attrs["block_s"])
    chosen = np.zeros(n, np.bool_)
    for pair in [quiet] if array.ndim == 1 else list(quiet):
        low, high = (_seconds_since_start(blocks, edge) for edge in pair)
        if not (low < high and high > begin[0] and low < end[-1]):
            raise OptionError(
                f"quiet: {low:g} s to {high:g} s after the start is outside of the "
                f"{_record_length(blocks):g} s of the record, or ends before it starts"
            )
        if low <= -step or high >= record_end + step:
            warnings.warn(
                f"the time given with --quiet, {low:g} s to {high:g} s after the start, extends "
                f"beyond the record, which goes from {blocks.attrs['start']} to "
                f"{blocks.attrs['end']} ({record_end:g} s); it is used as far as the record goes",
                stacklevel=2,
            )
        chosen |= (begin >= low - 1e-6) & (end <= high + 1e-6)
    if not _is_usable(blocks, chosen, settings.min_quiescent_blocks):
        return None
    return np.broadcast_to(chosen, (blocks.sizes["axis"], n)).copy()


def _is_usable(blocks: xr.Dataset, chosen: Bools, better_count: int) -> bool:
    """Return whether given blocks hold enough to calibrate on; warn where that is little."""
    step, size = float(blocks.attrs["block_s"]), int(blocks.attrs["block_samples"])
    count = int(chosen.sum())
    spectra = np.isfinite(blocks["power"].values[:, chosen]).any(axis=1).sum(axis=1)
    enough = count * size >= _MIN_GIVEN_SAMPLES
    if enough and spectra.min() >= _MIN_GIVEN_BANDS:
        error = math.sqrt(0.5 / (count * size))  # of N in white noise, half that of its variance
        lack = (
            f"N is known to {100 * error:.1f} % at best, and drift slower "
            f"than {count * step:g} s not at all, so that slow mismatches may be missed; "
            f"{better_count * step:g} s or more are better"
        )
        usable = True
    else:
        lack = (
            "too few samples without losses for a spectrum"
            if enough
            else f"{count * size} samples, and calibration needs {_MIN_GIVEN_SAMPLES}"
        )
        lack += f"; it is ignored. Give {better_count * step:g} s or more, or give a shorter block"
        usable = False
    if count < better_count or not usable:
        warnings.warn(
            f"the time given with --quiet holds {count} whole block{'' if count == 1 else 's'} "
            f"of {step:g} s: {lack}",
            stacklevel=2,
        )
    return usable


def _seconds_since_start(blocks: xr.Dataset, edge: Any) -> float:
    """Return a time in seconds since the start of the record."""
    instant = parse_instant(edge, "quiet:")
    if isinstance(instant, float):
        return instant
    return (instant - stamp_ns(str(blocks.attrs["start"]))) / 1e9


def find_quiescent_spans(blocks: xr.Dataset, quiescent: Bools) -> list[list[str]]:
    """Return the spans in which any axis is quiescent, [start, end] as ISO times."""
    edges = np.flatnonzero(np.diff(quiescent.any(axis=0), prepend=False, append=False)).reshape(
        -1, 2
    )
    begin, end = blocks["begin"].values, blocks["end"].values
    return [
        [format_time(blocks, begin[first]), format_time(blocks, end[last - 1])]
        for first, last in edges
    ]

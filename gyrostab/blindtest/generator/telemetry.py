"""Telemetry errors: lost frames and bursts, power cuts, flipped bits and repeated frames."""

from __future__ import annotations

import math

import numpy as np

from gyrostab.arrays import Bools, Floats, Ints

#: Shortest power cut [s]; telemetry losses are shorter where an effect depends on restarts.
MIN_POWER_CUT_S = 6.0


def draw_losses(
    rng: np.random.Generator, size: int, *, share: float, frame: int, burst: float = 1.0
) -> Bools:
    """Draw which of `size` samples are lost, in whole frames and bursts of frames.

    `share`, below 1, is the mean share lost, `frame` the samples of a frame, and `burst` the mean
    number of frames lost in a row; with 1 the frames are lost independently.
    """
    frames = math.ceil(size / frame)
    if share <= 0:
        return np.zeros(size, dtype=bool)
    if burst <= 1:
        bad = rng.random(frames) < share
    else:
        burst = max(burst, share / (1 - share))  # at least one frame comes between two bursts
        count = max(1, math.ceil(2 * frames * share / burst) + 10)
        down = rng.geometric(1 / burst, count)
        up = rng.geometric(min(1.0, share / ((1 - share) * burst)), count)
        turns = np.stack([up, down], axis=1).ravel()
        bad = np.resize(np.repeat(np.tile([False, True], count), turns), frames)
    return np.asarray(np.repeat(bad, frame)[:size])


def list_spans(mask: Bools) -> Ints:
    """List the first index and one past the last of every run in a mask, shape (run, 2)."""
    return np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2)


def limit_losses(lost: Bools, *, longest: int) -> Bools:
    """Split losses longer than `longest` samples by restoring short pieces.

    Examples
    --------
    >>> limit_losses(np.ones(10, bool), longest=4).astype(int).tolist()
    [1, 1, 1, 1, 0, 1, 1, 1, 1, 0]
    """
    out = lost.copy()
    back = max(1, longest // 4)
    edges = list_spans(lost)
    for begin, end in edges[edges[:, 1] - edges[:, 0] > longest].tolist():
        for first in range(begin + longest, end, longest + back):
            out[first : min(first + back, end)] = False
    return out


def draw_power_cuts(rng: np.random.Generator, seconds: float, *, number: int) -> Floats:
    """Draw begin and end [s] of `number` power cuts, spread over the record, shape (number, 2).

    Examples
    --------
    >>> cuts = draw_power_cuts(np.random.default_rng(1), 3600.0, number=3)
    >>> bool((np.diff(cuts.ravel()) > 0).all())
    True
    """
    part = seconds / (number + 0.5)
    begin = (np.arange(number) + rng.uniform(0.45, 0.75, number)) * part
    off = np.maximum(rng.uniform(0.01, 0.12, number) * part, MIN_POWER_CUT_S)
    return np.stack([begin, begin + off], axis=1)


def mark_power_cuts(cuts: Floats, size: int, rate: float) -> Bools:
    """Mark the samples without power, shape (size,)."""
    t = np.arange(size) / rate
    off = np.zeros(size, dtype=bool)
    for begin, end in cuts:
        off |= (t >= begin) & (t < end)
    return off


def flip_bits(
    rng: np.random.Generator, values: Floats, *, number: int, lsb: float, bit: int
) -> tuple[Floats, Ints]:
    """Flip one bit in `number` samples of two's complement code in steps of `lsb`.

    Bit 0 is the lowest; a flip changes a sample by ``lsb * 2**bit``. Return the samples after the
    flips, and the positions of the flips.

    Examples
    --------
    >>> after, where = flip_bits(np.random.default_rng(0), np.zeros(100), number=3, lsb=0.5, bit=4)
    >>> sorted(set(abs(after[where]).tolist()))
    [8.0]
    """
    after = values.copy()
    where = np.sort(rng.choice(np.flatnonzero(np.isfinite(values)), number, replace=False))
    words = np.rint(values[where] / lsb).astype(np.int64)
    flipped = np.bitwise_xor(words, np.int64(1) << np.int64(bit))
    after[where] = values[where] + (flipped - words) * lsb
    return after, where


def choose_frames(rng: np.random.Generator, missing: Bools, *, number: int, frame: int) -> Ints:
    """Choose at most `number` frames of `frame` samples that are complete, like the one before.

    At most one frame in eight is chosen. Return the first sample of each.

    Examples
    --------
    >>> missing = np.arange(80) < 30
    >>> choose_frames(np.random.default_rng(0), missing, number=1, frame=5) >= 35
    array([ True])
    """
    whole = ~np.any(missing[: missing.size // frame * frame].reshape(-1, frame), axis=1)
    frames = np.flatnonzero(whole[1:] & whole[:-1]) + 1
    chosen = rng.choice(frames, min(number, max(1, frames.size // 8)), replace=False)
    return np.sort(chosen) * frame


def repeat_frames(values: Floats, starts: Ints, *, frame: int, hold: bool) -> Floats:
    """Overwrite frames of values (axis, time), at their first samples `starts`, by earlier values.

    They repeat the previous frame, or if `hold`, its last sample.

    Examples
    --------
    >>> repeat_frames(np.arange(8.0)[None], np.array([4]), frame=2, hold=True)
    array([[0., 1., 2., 3., 3., 3., 6., 7.]])
    """
    after = values.copy()
    for start in starts:
        past = after[:, start - 1 : start] if hold else after[:, start - frame : start]
        after[:, start : start + frame] = past
    return after

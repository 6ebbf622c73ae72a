"""What the way to the surface does to samples: lost frames, lost bursts, power cuts, flipped bits, repeated frames."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["flip_bits", "lose", "power_cuts", "repeat_frames", "shortened"]

Array = NDArray[np.float64]

#: Shortest power cut [s]; what comes from the line alone is shorter where an effect hangs on the
#: starts.
SHORTEST = 6.0


def lose(
    rng: np.random.Generator, size: int, *, share: float, frame: int, burst: float = 1.0
) -> NDArray[np.bool_]:
    """Which of `size` samples are lost, in whole frames, by a line that is good or bad.

    Parameters
    ----------
    rng : numpy.random.Generator
    size : int
        Samples.
    share : float
        Share lost, on the average, 0 to below 1.
    frame : int
        Samples of a frame.
    burst : float
        Mean number of frames lost in a row; 1 loses every frame by itself.

    Examples
    --------
    >>> lost = lose(np.random.default_rng(1), 400_000, share=0.2, frame=10, burst=5.0)
    >>> bool(abs(lost.mean() - 0.2) < 0.02)
    True
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


def shortened(lost: NDArray[np.bool_], *, longest: int) -> NDArray[np.bool_]:
    """The same losses, none of them longer than `longest` samples: of longer ones every so often a piece came through.

    Examples
    --------
    >>> shortened(np.ones(10, bool), longest=4).astype(int).tolist()
    [1, 1, 1, 1, 0, 1, 1, 1, 1, 0]
    """
    out = lost.copy()
    back = max(1, longest // 4)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]))).reshape(-1, 2)
    for begin, end in edges[edges[:, 1] - edges[:, 0] > longest].tolist():
        for first in range(begin + longest, end, longest + back):
            out[first : min(first + back, end)] = False
    return out


def power_cuts(rng: np.random.Generator, seconds: float, *, number: int) -> Array:
    """Begin and end [s] of `number` power cuts, each in a part of the record of its own, shape (number, 2).

    Examples
    --------
    >>> cuts = power_cuts(np.random.default_rng(1), 3600.0, number=3)
    >>> bool((np.diff(cuts.ravel()) > 0).all())
    True
    """
    part = seconds / (number + 0.5)
    begin = (np.arange(number) + rng.uniform(0.45, 0.75, number)) * part
    off = np.maximum(rng.uniform(0.01, 0.12, number) * part, SHORTEST)
    return np.stack([begin, begin + off], axis=1)


def flip_bits(
    rng: np.random.Generator, values: Array, *, number: int, lsb: float, bit: int
) -> tuple[Array, NDArray[np.int64]]:
    """Flip one bit in `number` samples; the words are two's complement in steps of `lsb`.

    Parameters
    ----------
    rng : numpy.random.Generator
    values : ndarray, shape (time,)
        Samples [deg/h].
    number : int
        Flips.
    lsb : float
        Step of the words [deg/h].
    bit : int
        The bit, 0 for the lowest; a flip changes the sample by ``lsb * 2**bit`` up or down.

    Returns
    -------
    values, where
        The samples with flips, and which ones they are.

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


def repeat_frames(
    rng: np.random.Generator, values: Array, *, number: int, frame: int, hold: bool
) -> tuple[Array, NDArray[np.int64]]:
    """Send `number` frames twice, in the place of the next one, or hold their last sample through it.

    Parameters
    ----------
    rng : numpy.random.Generator
    values : ndarray, shape (axis, time)
    number : int
        Frames concerned.
    frame : int
        Samples of a frame.
    hold : bool
        Whether the last sample is held, instead of the frame repeated.

    Returns
    -------
    values, where
        And the first sample of every frame that was overwritten.

    Examples
    --------
    >>> after, where = repeat_frames(np.random.default_rng(0), np.arange(40.0)[None], number=1, frame=5, hold=True)
    >>> len(set(after[0, where[0]: where[0] + 5].tolist()))
    1
    """
    after = values.copy()
    frames = np.sort(rng.choice(np.arange(1, values.shape[1] // frame), number, replace=False))
    for k in frames:
        past = (
            after[:, k * frame - 1 : k * frame] if hold else after[:, (k - 1) * frame : k * frame]
        )
        after[:, k * frame : (k + 1) * frame] = past
    return after, frames * frame

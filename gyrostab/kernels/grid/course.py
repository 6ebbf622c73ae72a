"""The most likely sequence of samples along noisy stamps: next samples, and missing ones.

A stamp is the time of its sample plus jitter. How far the stamps are ahead of the row count, in
samples, is then a whole number (the samples lost so far) plus jitter, plus a slow phase of the
clock. The whole number changes rarely. `trace` finds its most likely course: hypotheses are kept
until later rows decide between them (a Viterbi search), so no single stamp is decisive.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER, KERNEL

#: Largest number of simultaneous hypotheses: each late row is the possible end of a loss.
_MOST = 64
#: Costs, in nats. A stamp beyond 5 standard deviations (12.5 nats) is an outlier, whatever its
#: size. One row in 150 (5 nats) comes after
#: a loss; a loss of k samples is k times less likely than that of one. A row that has no sample on
#: the grid is as unlikely as 1e-13,
#: much more than an outlier: rows that are late by many samples for a while are kept.
_OUTLIER_NATS, LOSS_NATS, _DROP_NATS = 12.5, 5.0, 30.0
#: Standard deviations within which the end of a loss is looked for.
_REACH_SIGMA = 2.5
#: Cost of 1000 consecutive outliers; more late rows are not outliers, but follow a loss.
_LATE_NATS = 12_500.0
#: Samples lost between the first rows, at most, and rows that a first phase is worth.
_EARLY_LOSSES, _FIRST_ROWS = 3, 8
#: Rows that decide whether the clock was set back, or a stamp is damaged.
_PERSIST_ROWS = 16


@njit(**INNER)
def _keep_hypothesis(table, n, level, phase, cost, parent):  # type: ignore[no-untyped-def]
    """Add a hypothesis to the first `n` of a table, each level once; returns the new number.

    The one with the fewest losses is kept at any cost: while rows are late, all others are cheaper.
    """
    lowest, worst = np.int64(0), np.int64(-1)
    for h in range(n):
        if table[h, 0] == level:
            if cost < table[h, 2]:
                table[h, 1], table[h, 2], table[h, 3] = phase, cost, parent
            return n
        if table[h, 0] < table[lowest, 0]:
            lowest = np.int64(h)
    at = n
    if n == _MOST:
        for h in range(n):
            if h != lowest and (worst < 0 or table[h, 2] > table[worst, 2]):
                worst = np.int64(h)
        if cost >= table[worst, 2]:
            return n
        at, n = worst, n - 1
    table[at, 0], table[at, 1], table[at, 2], table[at, 3] = level, phase, cost, parent
    return n + 1


@njit(**INNER)
def _switch_nats(jump, loss_nats):  # type: ignore[no-untyped-def]
    """Compute the cost of going `jump` samples ahead (a loss), or back (rows without a sample)."""
    if jump > 0:
        return loss_nats + np.log(jump)
    return min(-_DROP_NATS * jump, _LATE_NATS)


@njit(**INNER)
def _stamp_nats(off, weight):  # type: ignore[no-untyped-def]
    """Compute the cost of a stamp `off` samples from its course; nearer outliers cost less."""
    nats = weight * off * off
    return nats if nats < _OUTLIER_NATS else _OUTLIER_NATS + 0.05 * np.log(nats / _OUTLIER_NATS)


@njit(**INNER)
def _prune_hypotheses(table, n, loss_nats):  # type: ignore[no-untyped-def]
    """Drop hypotheses that the best one can still reach at less cost; returns the number left."""
    best = np.int64(0)
    for h in range(n):
        if table[h, 2] < table[best, 2]:
            best = np.int64(h)
    level, cost = table[best, 0], table[best, 2]
    size = np.int64(0)
    for h in range(n):
        jump = table[h, 0] - level
        if jump == 0.0 or table[h, 2] < cost + _switch_nats(jump, loss_nats):
            for c in range(4):
                table[size, c] = table[h, c]
            size += 1
    return size


@njit(**INNER)
def _extend_hypothesis(  # type: ignore[no-untyped-def]
    new, size, old, h, position, following, sigma, gain, hold, max_lost, loss_nats
):
    """Add the successors of hypothesis h for a row at `position`, and the next at `following`."""
    level, phase, cost = old[h, 0], old[h, 1], old[h, 2]
    weight = 0.5 / sigma**2
    if phase > hold:
        level, phase = level + 1.0, phase - 1.0
    elif phase < -hold:
        level, phase = level - 1.0, phase + 1.0
    off = position - level - phase
    step = gain * off if weight * off * off < _OUTLIER_NATS else 0.0
    size = _keep_hypothesis(new, size, level, phase + step, cost + _stamp_nats(off, weight), h)
    low = np.rint(off - _REACH_SIGMA * sigma)
    jump = min(np.rint(off + _REACH_SIGMA * sigma), max_lost)
    while jump >= low:  # a loss whose end this row may be, or a row too many
        if jump > 0.0 or (jump < 0.0 and jump == np.rint(off)):
            residual = off - jump
            dear = cost + _switch_nats(jump, loss_nats) + _stamp_nats(residual, weight)
            size = _keep_hypothesis(new, size, level + jump, phase + gain * residual, dear, h)
        jump -= 1.0
    ahead = np.rint(following - level - phase)
    # a loss of which the next row shows the end
    if 1.0 <= ahead <= max_lost and abs(ahead - off) > _REACH_SIGMA * sigma + 0.5:
        dear = cost + _switch_nats(ahead, loss_nats) + _stamp_nats(off - ahead, weight)
        size = _keep_hypothesis(new, size, level + ahead, phase, dear, h)
    return size


@njit(**INNER)
def _seed_hypotheses(table, level, phase, first, max_lost):  # type: ignore[no-untyped-def]
    """Start with a hypothesis; samples may be lost between the first rows of a piece."""
    table[0, 0], table[0, 1], table[0, 2] = level, phase, 0.0
    size = np.int64(1)
    if not np.isnan(first):
        for lost in range(1, 1 + _EARLY_LOSSES):
            size = _keep_hypothesis(table, size, level - lost, phase, 0.0, np.int64(0))
        many = np.rint(first - phase)  # or just after the first
        if many <= max_lost:
            size = _keep_hypothesis(table, size, many, phase, LOSS_NATS, np.int64(0))
    return size


@njit(**KERNEL)
def trace(  # type: ignore[no-untyped-def]
    count, stamps, count0, stamp0, period, sigma, gain, hold, max_lost, loss_nats, level0, phase0,
    averaged_rows, levels, phases,
):  # fmt: skip
    """Find the most likely course of the stamps of rows.

    Parameters
    ----------
    count, stamps : ndarray of int64, shape (n,)
        Row count, rising, and stamp [ns].
    count0, stamp0 : int
        Count and stamp [ns] of sample 0.
    period : float
        Sampling period [ns].
    sigma : float
        Standard deviation of the jitter [samples].
    gain : float
        Share of a deviation that the phase takes over: it averages the jitter of the last ``1 /
        gain`` rows.
    hold : float
        A phase further from zero than this is turned into a sample left out, or a row dropped
        [samples].
    max_lost : float
        Samples that may be lost at one time: damaged stamps far ahead are outliers, and not the end
        of a loss.
    loss_nats : float
        Cost of a loss of one sample [nats].
    level0, phase0 : int, float
        Samples lost so far, and phase of the clock [samples].
    averaged_rows : int
        Rows that `phase0` averages; 0 at the beginning, where `level0` and fewer by up to 3 are all
        as likely.
    levels, phases : ndarray of int64 and float64, shape (n,)
        Filled with the samples lost up to each row, and the phase after it.

    Returns
    -------
    float
        Cost of the course [nats].
    """
    n = len(count)
    old, new = np.empty((_MOST, 4)), np.empty((_MOST, 4))
    parents = np.empty((n, _MOST), dtype=np.int8)
    table = np.empty((n, _MOST, 2))
    first = (
        (stamps[0] - stamp0) / period - (count[0] - count0)
        if averaged_rows == 0 and n > 0
        else np.nan
    )
    size = _seed_hypotheses(old, level0, phase0, first, max_lost)
    for i in range(n):
        position = (stamps[i] - stamp0) / period - (count[i] - count0)
        next_row = min(i + 1, n - 1)
        following = (stamps[next_row] - stamp0) / period - (count[next_row] - count0)
        follows = max(gain, 1.0 / (max(averaged_rows, _FIRST_ROWS) + i + 1.0))
        new_size = np.int64(0)
        for h in range(size):
            new_size = _extend_hypothesis(
                new, new_size, old, h, position, following, sigma, follows, hold, max_lost,
                loss_nats,
            )  # fmt: skip
        size = _prune_hypotheses(new, new_size, loss_nats) if new_size > 1 else new_size
        for h in range(size):
            table[i, h, 0], table[i, h, 1], parents[i, h] = new[h, 0], new[h, 1], np.int8(new[h, 3])
        old, new = new, old
    best = np.int64(0)
    for other in range(size):
        if old[other, 2] < old[best, 2]:
            best = np.int64(other)
    total = old[best, 2]
    for i in range(n - 1, -1, -1):
        levels[i], phases[i] = np.int64(table[i, best, 0]), table[i, best, 1]
        best = np.int64(parents[i, best])
    return total


@njit(**KERNEL)
def find_breaks(stamps, n, latest, reach, longest):  # type: ignore[no-untyped-def]
    """Find the rows at which the clock is set back, or ahead by more than a gap may last.

    Parameters
    ----------
    stamps : ndarray of int64
        Stamps [ns], all readable; some more than `n`.
    n : int
        Stamps to check; the others follow them.
    latest : int
        Latest stamp before [ns].
    reach : float
        How far a stamp may lie behind the latest one by jitter [ns].
    longest : float
        Longest gap [ns].

    Returns
    -------
    breaks : ndarray of int64, shape (m, 2)
        Row and latest stamp before it [ns].
    latest : int
        Latest stamp of the first `n` [ns].
    """
    breaks = np.empty((n, 2), dtype=np.int64)
    count = np.int64(0)
    for j in range(n):
        end = min(len(stamps), j + 1 + _PERSIST_ROWS)
        if stamps[j] < latest - reach or stamps[j] > latest + longest:
            back = stamps[j] < latest
            lasting = j + 1 < end
            for m in range(j + 1, end):
                if (back and stamps[m] > latest) or (not back and stamps[m] < latest + longest):
                    lasting = False
                    break
            if not lasting:
                continue
            breaks[count, 0], breaks[count, 1] = j, latest
            count += 1
            latest = stamps[j]
        elif stamps[j] > latest:
            later_stamp = stamps[j]  # a damaged stamp is ahead of all that follow
            if j + 1 < end and stamps[j + 1] < later_stamp - reach:
                later_stamp = stamps[j + 1]
                if j + 2 < end:
                    later_stamp = max(later_stamp, stamps[j + 2])
            latest = max(latest, min(stamps[j], later_stamp))
    return breaks[:count].copy(), latest


@njit(**KERNEL)
def find_phase(count, stamps, period, sigma):  # type: ignore[no-untyped-def]
    """Find how far the first stamps are ahead of the row count [samples].

    Lost samples and late rows put stamps ahead, so of up to 33 stamps those count that are least
    ahead; they have three rows at least, as the stamp of one may be damaged.
    """
    n = min(len(count), 33)
    ahead = np.empty(n)
    for i in range(n):
        ahead[i] = (stamps[i] - stamps[0]) / period - (count[i] - count[0])
    order = np.argsort(ahead, kind="mergesort")
    ahead = ahead[order]
    for i in range(n):
        end, rows = i, 0
        while end < n and ahead[end] < ahead[i] + 1.0 + 4.0 * sigma:
            stamp = order[end]
            rows += count[stamp + 1] - count[stamp] if stamp + 1 < n else 1
            end += 1
        if rows >= 3:
            return np.median(ahead[i:end])
    return np.median(ahead)


@njit(**KERNEL)
def follow(count, stamps, period, sigma, gain, longest, loss_nats, block):  # type: ignore[no-untyped-def]
    """Count the samples along noisy stamps, as `track` of `stamps` does along exact ones.

    Parameters
    ----------
    count, stamps : ndarray of int64, shape (n,)
        Row count, rising, and stamp [ns].
    period : float
        Approximate sampling period [ns].
    sigma : float
        Standard deviation of the jitter [samples].
    gain : float
        As for `trace`.
    longest : float
        A longer step starts a new piece [ns].
    loss_nats : float
        As for `trace`.
    block : int
        Rows traced at one time, at most.

    Returns
    -------
    sample, piece : ndarray of int64, shape (n,)
        Sample number within the piece, and number of the piece.
    off : ndarray, shape (n,)
        Deviation of each stamp from the course [samples].
    cost : float
        Cost of the course [nats].
    """
    n = len(stamps)
    sample, piece = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    off = np.empty(n)
    number, total = np.int64(0), 0.0
    begin = np.int64(0)
    while begin < n:
        end = begin + 1
        while end < n and end - begin < block and abs(stamps[end] - stamps[end - 1]) <= longest:
            end += 1
        phase = find_phase(count[begin:end], stamps[begin:end], period, sigma)
        level = sample[begin:end]
        total += trace(
            count[begin:end], stamps[begin:end], count[begin], stamps[begin], period, sigma, gain,
            np.inf, longest / period, loss_nats,
            np.int64(0), phase, np.int64(0), level, off[begin:end],
        )  # fmt: skip
        for i in range(begin, end):
            sample[i] += count[i] - count[begin]
            off[i] = (stamps[i] - stamps[begin]) / period - sample[i] - off[i]
            piece[i] = number
        number += 1
        begin = end
    return sample, piece, off, total

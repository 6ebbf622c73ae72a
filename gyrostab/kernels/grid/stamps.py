"""From stamps to samples: which row belongs to which sample of a uniform grid.

The rows come in blocks; the state between two blocks is in three arrays (`new_state`), so the
result does not depend on where a block ends. A run is an unbroken sequence of rows that fills an
unbroken part of the grid: ``(first sample, first row, length)``.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER, KERNEL

#: Value of a stamp that could not be read (numpy's NaT as an integer).
NO_STAMP = np.iinfo(np.int64).min

#: Rows that `place` may look ahead; hand it that many more than it is to place.
LOOK_AHEAD = 64
_ORDER = 16  # rows within which an out-of-order row is followed by one past the latest stamp
_EXCHANGED = 0.25  # of the stamp of an exchanged row from its sample: half of what places a row

# what happened to a row, numbered as in schema.GAP_CAUSES
_ON_TIME, _BY_COUNT, DUPLICATE, OUT_OF_ORDER, STEP, RESTART = 0, 1, 2, 3, 5, 6

#: Columns of the events: what happened to a row, its sample, the row, the stamp of the row before
#: and its own stamp [ns].
EVENT_CAUSE, EVENT_SAMPLE, EVENT_ROW, EVENT_BEFORE, EVENT_STAMP = range(5)
EVENT_COLUMNS = 5

# places in the state: integers and stamps
_HEAD, _ROW, _RUN_GRID, _RUN_ROW, _RUN_LENGTH, _PENDING, _PENDING_ROW = range(7)
_GRID0, _STAMP0, _LATEST, FIRST, STARTED, _PHASE = range(7, 13)
#: Where the state keeps the run that is still open: first sample, first row, length.
OPEN_RUN = slice(_RUN_GRID, _RUN_LENGTH + 1)
_RING = 1 << 14
_GAIN = 0.05  # of the phase: it follows the clock's course and not the jitter of single stamps
_UNIT = 1e-9  # samples, of the phase in the state


def new_state() -> tuple[np.ndarray, np.ndarray]:
    """Make the state of `place` between two blocks: counters, and the last samples taken."""
    return np.zeros(13, dtype=np.int64), np.zeros(_RING, dtype=np.bool_)


@njit(**KERNEL)
def track(stamps, period, gain, longest):  # type: ignore[no-untyped-def]
    """Count the samples between stamps that lie near multiples of `period`.

    The phase follows the stamps with `gain`, so that neither jitter nor a slightly wrong period
    breaks the count.

    Parameters
    ----------
    stamps : ndarray of int64, shape (n,)
        Stamps [ns], in the order of the rows.
    period : float
        Approximate sampling period [ns].
    gain : float
        Share of a stamp's deviation that the phase takes over.
    longest : float
        A longer step, or one backwards by as much, starts a new piece [ns].

    Returns
    -------
    count : ndarray of int64, shape (n,)
        Sample number within the piece.
    piece : ndarray of int64, shape (n,)
        Number of the piece.
    """
    n = len(stamps)
    count = np.zeros(n, dtype=np.int64)
    piece = np.zeros(n, dtype=np.int64)
    phase = 0.0  # of the latest sample, behind its stamp [ns]
    for i in range(1, n):
        step = float(stamps[i] - stamps[i - 1])
        piece[i] = piece[i - 1]
        if abs(step) > longest:
            piece[i] += 1
            phase = 0.0
            continue
        moved = step + phase
        k = int(np.rint(moved / period))
        count[i] = count[i - 1] + k
        phase = (1.0 - gain) * (moved - k * period)
    return count, piece


@njit(**KERNEL)
def piece_sums(stamps, count, piece, period):  # type: ignore[no-untyped-def]
    """Sum the straight lines through the pieces of a block, stamp over count.

    Parameters
    ----------
    stamps, count, piece : ndarray of int64, shape (n,)
        Stamps [ns]; sample numbers and numbers of the piece, from `track`.
    period : float
        Slope [ns] of a piece of one stamp.

    Returns
    -------
    ndarray, shape (pieces, 6)
        Stamps in the piece, mean count, mean stamp [ns from the first of the block], sums of
        squares of the counts and of counts times stamps about their means, and of the residuals.
    """
    n = len(stamps)
    pieces = np.int64(n > 0)
    for i in range(1, n):
        pieces += piece[i] != piece[i - 1]
    table = np.empty((pieces, 6))
    begin = np.int64(0)
    for row in range(pieces):
        end = begin + 1
        while end < n and piece[end] == piece[begin]:
            end += 1
        count0, stamp0, size = count[begin], stamps[begin], end - begin
        mean_count = mean_stamp = 0.0
        for i in range(begin, end):
            mean_count += count[i] - count0
            mean_stamp += stamps[i] - stamp0
        mean_count, mean_stamp = mean_count / size, mean_stamp / size
        squares = products = residuals = 0.0
        for i in range(begin, end):
            c, t = count[i] - count0 - mean_count, stamps[i] - stamp0 - mean_stamp
            squares += c * c
            products += c * t
        slope = products / squares if squares > 0.0 else period
        for i in range(begin, end):
            residuals += (
                stamps[i] - stamp0 - mean_stamp - slope * (count[i] - count0 - mean_count)
            ) ** 2
        table[row, 0] = size
        table[row, 1] = mean_count + count0
        table[row, 2] = mean_stamp + (stamp0 - stamps[0])
        table[row, 3], table[row, 4], table[row, 5] = squares, products, residuals
        begin = end
    return table


@njit(**INNER)
def _fits_counting(stamps, j, expected, period, state):  # type: ignore[no-untyped-def]
    """Check whether the next readable stamps after row j agree with unbroken counting."""
    count = 0
    zero = state[_GRID0] - state[_PHASE] * _UNIT
    for m in range(j + 1, min(len(stamps), j + 1 + LOOK_AHEAD)):
        if stamps[m] == NO_STAMP:
            continue
        position = zero + (stamps[m] - state[_STAMP0]) / period
        if abs(position - (expected + (m - j))) > 0.5:
            return False
        count += 1
        if count == 2:
            return True
    return False


@njit(**INNER)
def _has_late_row(stamps, j, expected, period, state):  # type: ignore[no-untyped-def]
    """Check whether a row soon after row j has the stamp of the sample that is due at row j."""
    zero = state[_GRID0] - state[_PHASE] * _UNIT
    for m in range(j + 1, min(len(stamps), j + 1 + _ORDER)):
        if stamps[m] != NO_STAMP:
            position = zero + (stamps[m] - state[_STAMP0]) / period
            if abs(position - expected) <= _EXCHANGED:
                return True
    return False


@njit(**INNER)
def _stays_behind(stamps, j, n, latest):  # type: ignore[no-untyped-def]
    """Check whether the stamps after row j stay behind the latest one: the clock was set back."""
    count = 0
    for m in range(j + 1, min(n, j + 1 + LOOK_AHEAD)):
        if stamps[m] == NO_STAMP:
            continue
        if stamps[m] > latest:
            return False
        count += 1
        if count == _ORDER:
            break
    return count > 1


@njit(**INNER)
def _estimate_origin(stamps, j, period):  # type: ignore[no-untyped-def]
    """Estimate the true stamp [ns] of sample j from later stamps, so that its jitter is removed."""
    total, count = 0.0, 0
    for m in range(j, min(len(stamps), j + 32)):
        if stamps[m] == NO_STAMP:
            continue
        position = (stamps[m] - stamps[j]) / period
        if abs(position) < 500:
            total += position - np.rint(position)
            count += 1
    return stamps[j] + np.int64(np.rint(total / count * period))


@njit(**INNER)
def _occupy_sample(ring, head, sample):  # type: ignore[no-untyped-def]
    """Mark `sample`, past the head, as taken and all between as free."""
    for g in range(max(head + 1, sample - len(ring) + 1), sample):
        ring[g % len(ring)] = False
    ring[sample % len(ring)] = True


@njit(**INNER)
def _is_free(ring, state, target):  # type: ignore[no-untyped-def]
    """Check whether a recent sample before the head, of the same piece, has no row yet."""
    lowest = max(state[_GRID0], state[_HEAD] - len(ring) + 1)
    return lowest <= target <= state[_HEAD] and not ring[target % len(ring)]


@njit(**INNER)
def _settle_rows(row, position, state, ring):  # type: ignore[no-untyped-def]
    """Place the rows without a stamp just before `row`, if there is exactly space for them."""
    pending = state[_PENDING]
    state[_PENDING] = 0
    if (
        pending > 0
        and state[_ROW] + 1 + pending == row
        and abs(position - (state[_HEAD] + 1 + pending)) <= 0.5
    ):
        for sample in range(state[_HEAD] + 1, state[_HEAD] + 1 + pending):
            _occupy_sample(ring, sample - 1, sample)
        state[_RUN_LENGTH] += pending
        state[_ROW] += pending
        state[_HEAD] += pending


@njit(**INNER)
def _judge_ahead(stamps, j, position, period, max_gap, state):  # type: ignore[no-untyped-def]
    """Judge row j, whose stamp is later than the next sample: verdict and sample."""
    expected = state[_HEAD] + 1
    soon = position - expected < 1.5
    # a late stamp stands apart from the one after it; of a doubled row, which follows a missing
    # one, both are the same
    apart = j + 1 < len(stamps) and stamps[j + 1] > stamps[j] + 0.05 * period
    if (apart or not soon) and _fits_counting(stamps, j, expected, period, state):
        # the stamp of a row that was exchanged with a later one is right
        is_near = position - expected <= _ORDER + 0.5
        if not (is_near and _has_late_row(stamps, j, expected, period, state)):
            return _BY_COUNT, expected
    if (stamps[j] - state[_LATEST]) / period > max_gap:
        return STEP, expected + 1
    return _ON_TIME, np.int64(np.rint(position))


@njit(**INNER)
def _judge_behind(stamps, j, position, period, state, ring):  # type: ignore[no-untyped-def]
    """Judge row j, whose stamp is earlier than the next sample: verdict and sample."""
    expected = state[_HEAD] + 1
    target = np.int64(np.rint(position))
    if _stays_behind(stamps, j, len(stamps), state[_LATEST]):
        elapsed = state[_LATEST] - state[_STAMP0]
        begins_again = (
            stamps[j] <= state[FIRST] + 0.1 * elapsed or 2 * (state[_LATEST] - stamps[j]) > elapsed
        )
        return RESTART if begins_again else STEP, expected + 1
    if _is_free(ring, state, target):
        return OUT_OF_ORDER, target
    stray = position - expected < -2.5
    if stray and _fits_counting(stamps, j, expected, period, state):
        return _BY_COUNT, expected
    return DUPLICATE if target >= state[_HEAD] else OUT_OF_ORDER, max(target, state[_GRID0])


@njit(**INNER)
def _judge_row(stamps, j, position, period, hold, max_gap, state, ring):  # type: ignore[no-untyped-def]
    """Judge row j, whose stamp lies at `position` on the grid: verdict and sample."""
    expected = state[_HEAD] + 1
    phase = state[_PHASE] * _UNIT
    if position - expected > 0.5:
        return _judge_ahead(stamps, j, position, period, max_gap, state)
    if position - expected < -0.5:
        return _judge_behind(stamps, j, position, period, state, ring)
    if phase > hold:  # the clock has come to lie nearer to the sample after
        state[_PHASE] -= int(1 / _UNIT)
        return _ON_TIME, expected + 1
    if phase < -hold:
        state[_PHASE] += int(1 / _UNIT)
        return DUPLICATE, expected - 1
    state[_PHASE] += int(_GAIN * (position - expected) / _UNIT)
    return _ON_TIME, expected


@njit(**INNER)
def _add_run(runs, n, sample, row, length):  # type: ignore[no-untyped-def]
    runs[n, 0], runs[n, 1], runs[n, 2] = sample, row, length
    return n + 1


@njit(**INNER)
def _note_event(events, n, cause, sample, row, before, stamp):  # type: ignore[no-untyped-def]
    events[n, EVENT_CAUSE] = cause
    events[n, EVENT_SAMPLE] = sample
    events[n, EVENT_ROW] = row
    events[n, EVENT_BEFORE] = before
    events[n, EVENT_STAMP] = stamp
    return n + 1


@njit(**INNER)
def _on_time(rows, stamps, j, n, period, hold, state, ring):  # type: ignore[no-untyped-def]
    """Place rows while each follows the last one on time; returns the first that does not."""
    head, row, latest, phase = state[_HEAD], state[_ROW], state[_LATEST], state[_PHASE]
    grid0, stamp0, begin = state[_GRID0], state[_STAMP0], j
    if not state[STARTED] or state[_PENDING]:
        return j
    while j < n and rows[j] == row + 1 and stamps[j] != NO_STAMP:
        ahead = grid0 - phase * _UNIT + (stamps[j] - stamp0) / period - (head + 1)
        if abs(ahead) > 0.5 or abs(phase * _UNIT) > hold:
            break
        phase += int(_GAIN * ahead / _UNIT)
        head, row, latest = head + 1, row + 1, max(latest, stamps[j])
        ring[head & (len(ring) - 1)] = True
        j += 1
    state[_HEAD], state[_ROW], state[_LATEST], state[_PHASE] = head, row, latest, phase
    state[_RUN_LENGTH] += j - begin
    return j


@njit(**KERNEL)
def place(rows, stamps, n, period, hold, max_gap, state, ring):  # type: ignore[no-untyped-def]
    """Assign rows to samples.

    The next row takes the next sample while its stamp is within half a sample of it; otherwise the
    sample is computed from the stamp, counted from the start of the piece, so errors do not
    accumulate. Stamps are compared with their slow course along the grid (the phase), so that
    jitter with a slightly wrong rate does not double or skip samples; only if the course is more
    than `hold` off, one sample is left out, or one row.

    Parameters
    ----------
    rows, stamps : ndarray of int64
        Row numbers, rising, and stamps [ns] or `NO_STAMP`; up to `LOOK_AHEAD` more than `n`.
    n : int
        Rows to place; the others are only read ahead.
    period : float
        Sampling period [ns].
    hold : float
        Tolerance of the phase [samples].
    max_gap : float
        A longer step ahead is a step of the clock [samples].
    state, ring : ndarray
        From `new_state`, changed in place.

    Returns
    -------
    runs : ndarray of int64, shape (n_runs, 3)
        First sample, first row, length; the last run stays open in the state.
    events : ndarray of int64, shape (n_events, 5)
        Cause, sample, row, stamp before [ns], stamp [ns].
    """
    runs, events = np.empty((2 * n + 2, 3), np.int64), np.empty((2 * n + 2, 5), np.int64)
    n_runs, n_events = np.int64(0), np.int64(0)
    j = np.int64(-1)
    while True:
        j = _on_time(rows, stamps, j + 1, n, period, hold, state, ring)
        if j >= n:
            break
        row, stamp = rows[j], stamps[j]
        if stamp == NO_STAMP:
            if state[STARTED] and (state[_ROW] + 1 + state[_PENDING] == row):
                state[_PENDING] += 1
            continue
        if not state[STARTED]:
            state[STARTED] = 1
            state[FIRST] = state[_LATEST] = stamp
            state[_STAMP0] = _estimate_origin(stamps, j, period)
            state[_ROW] = state[_RUN_ROW] = row
            state[_RUN_LENGTH] = 1
            ring[0] = True
            continue
        position = state[_GRID0] - state[_PHASE] * _UNIT + (stamp - state[_STAMP0]) / period
        _settle_rows(row, position, state, ring)
        head = state[_HEAD]
        verdict, target = _judge_row(stamps, j, position, period, hold, max_gap, state, ring)
        if verdict > _BY_COUNT:
            sample = head + 1 if verdict >= STEP else target
            n_events = _note_event(events, n_events, verdict, sample, row, state[_LATEST], stamp)
        if verdict >= STEP:
            state[_GRID0] = target
            state[_STAMP0] = _estimate_origin(stamps, j, period)
            state[_LATEST] = stamp
            state[_PHASE] = 0
        elif verdict == OUT_OF_ORDER and _is_free(ring, state, target):
            ring[target % len(ring)] = True
            n_runs = _add_run(runs, n_runs, target, row, np.int64(1))
            continue
        elif verdict > _BY_COUNT:
            continue
        if target == head + 1 and row == state[_ROW] + 1:
            state[_RUN_LENGTH] += 1
        else:
            n_runs = _add_run(runs, n_runs, state[_RUN_GRID], state[_RUN_ROW], state[_RUN_LENGTH])
            state[_RUN_GRID], state[_RUN_ROW], state[_RUN_LENGTH] = target, row, 1
        _occupy_sample(ring, head, target)
        state[_HEAD], state[_ROW] = target, row
        if verdict != _BY_COUNT:
            state[_LATEST] = max(state[_LATEST], stamp)
    return runs[:n_runs].copy(), events[:n_events].copy()

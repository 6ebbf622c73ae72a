"""Continue cumulative angles where they wrap around, or where their counter begins again."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Floats, Ints
from gyrostab.ingest.columns.stamps import read_stamps
from gyrostab.ingest.grid.scan_pass import BLOCK_ROWS, file_of
from gyrostab.store.lazy import RowSource, make_dask, read_into, read_slice
from gyrostab.store.write import pack_counts

#: A circle [degree], and the counts of counters of 8 to 32 bits.
_CIRCLE, _COUNTERS = 360.0, tuple(2**bits for bits in range(8, 33))
#: Longest step, in usual steps, from the angle at which a wrapped angle or a counter begins again.
_REACH = 5.0
#: Shortest period of a counter [usual steps]: noise of the angle has no such steps. A range of that
#: size is also needed for a step over more than half of it to be a jump.
_MIN_PERIOD = 16.0
#: Shortest step that is a jump [usual steps], and the longest time between two rows over which a
#: counter that was set to zero is continued [usual times].
_MIN_JUMP, _MAX_PAUSE = 100.0, 2.0
#: Largest motion of a wrapped angle over missing samples, in periods and at its usual steps, at
#: which the nearest turn is taken: it may move twice as fast.
_MAX_UNSEEN = 0.25


class TurningAngle:
    """Find where the angle of an axis begins again, over successive blocks of rows.

    `count` is the angle of one count [degree], or None if the angles are not whole numbers.

    Examples
    --------
    >>> angle = TurningAngle(None)
    >>> angle.find_turns(np.array([357.0, 358.0, 359.0, 1.0, 2.0]), np.arange(5))
    >>> angle.rows, angle.added
    ([3], [360.0])
    """

    def __init__(self, count: float | None):
        self.counters = [] if count is None else [size * abs(count) for size in _COUNTERS]
        self.last: tuple[float, int] | None = None  # angle as it is written [degree], stamp [ns]
        self.low, self.high = np.inf, -np.inf
        self.period = np.inf  # [degree]; infinite without a turn
        self.usual = 0.0  # largest usual step [degree]
        self.first = 0  # row of the next block
        #: Rows from which on angles [degree] are added, and rows of jumps that are not explained.
        self.rows: list[int] = []
        self.added: list[float] = []
        self.jumps: list[int] = []

    def find_turns(self, angles: Floats, stamps: Ints) -> None:
        """Look through the angles [degree] and stamps [ns] of the next block."""
        places = np.flatnonzero(np.isfinite(angles))
        if places.size:
            written, times = angles[places], stamps[places]
            self.low = min(self.low, float(written.min()))
            self.high = max(self.high, float(written.max()))
            angle, time = (written[0], times[0]) if self.last is None else self.last
            steps, pauses = np.diff(written, prepend=angle), np.diff(times, prepend=time)
            self._find_in_steps(written, steps, pauses, self.first + places)
            self.last = float(written[-1]), int(times[-1])
        self.first += angles.size

    def _find_in_steps(self, written: Floats, steps: Floats, pauses: Ints, rows: Ints) -> None:
        sizes, span = np.abs(steps), self.high - self.low
        usual = float(np.quantile(sizes[sizes > 0], 0.9)) if (sizes > 0).any() else 0.0
        counters = [size for size in self.counters if size > _MIN_PERIOD * usual]
        period = min((p for p in [*counters, _CIRCLE] if span <= p * (1 + 1e-9)), default=np.inf)
        forward = pauses[pauses > 0]
        waits = pauses / float(np.median(forward)) if forward.size else np.ones(pauses.size)
        times = np.maximum(waits, 1.0)
        reach = _REACH * usual * times
        is_turn = (sizes > period / 2) & (np.abs(sizes - period) <= np.minimum(reach, period / 2))
        if period != _CIRCLE and is_turn.any():
            # steps less the motion before them are the period: 1000 counts do not pass for 10 bits
            periods = np.abs(steps - np.roll(steps / times, 1) * times)[is_turn]
            error = abs(float(np.median(periods)) - period)
            is_turn &= error <= _REACH * usual / np.sqrt(periods.size)
        is_large = sizes > _MIN_JUMP / _REACH * reach
        is_over_half = (2 * sizes > span) & (span > _MIN_PERIOD / _REACH * reach)
        is_jump = (is_large | is_over_half) & ~is_turn
        # motion and a wrong value have several such steps in succession
        is_quiet = sizes <= reach
        is_jump &= np.append(True, is_quiet[:-1]) & np.append(is_quiet[1:], True)
        is_reset = is_jump & is_large & (np.abs(written) <= reach) & (waits <= _MAX_PAUSE)
        is_reset &= np.cumsum(is_jump & ~is_reset) == 0  # otherwise it may be the way back
        if self.jumps:
            is_reset[:] = False
        added = np.where(
            is_reset, written - steps, -np.sign(steps) * (period if is_turn.any() else 0.0)
        )
        motion = (sizes / times)[(sizes > 0) & ~is_turn]
        self.usual = max(self.usual, float(np.quantile(motion, 0.9)) if motion.size else 0.0)
        if is_turn.any():
            self.period = period
        is_found = is_turn | is_reset
        self.rows += rows[is_found].tolist()
        self.added += added[is_found].tolist()
        self.jumps += rows[is_jump & ~is_reset].tolist()


class _Continued(RowSource):
    """Angles to which turns are added."""

    def __init__(self, array: Any, turns: list[TurningAngle]):
        self.parts, self.shape, self.dtype = (array,), array.shape, np.dtype(np.float64)
        self.rows = [np.array(turn.rows, dtype=np.int64) for turn in turns]
        self.added = [np.cumsum([0.0, *turn.added]) for turn in turns]

    def read_into(self, row: int, begin: int, out: Array) -> None:
        read_into(self.parts[0], row, begin, out)
        turns = np.searchsorted(self.rows[row], np.arange(begin, begin + out.size), side="right")
        out += self.added[row][turns]


def _pack_continued(encoding: dict[Any, Any], turns: list[TurningAngle]) -> dict[Any, Any]:
    """Return the encoding of continued angles: counts if they remain whole numbers."""
    count = encoding.get("scale_factor")
    added = np.concatenate([turn.added for turn in turns])
    if count is None or np.abs(added / count - np.rint(added / count)).max(initial=0) > 1e-6:
        return {}
    reach = max(
        max(abs(turn.low), abs(turn.high)) + np.abs(np.cumsum(turn.added)).max(initial=0)
        for turn in turns
    )
    return pack_counts(reach / count, count)


def continue_angles(raw: xr.Dataset) -> tuple[xr.Dataset, list[str], float]:
    """Continue the cumulative angles of a raw log where they begin again.

    An angle that wraps around (360 degree) or a counter of 8 to 32 bits that is full gets its
    period, and a counter that was set to zero the angle that it had.

    Returns the raw log, notes, and the steps between samples over which the number of turns is
    known.
    """
    variable = raw["angle"]
    count = variable.encoding.get("scale_factor")
    turns = [TurningAngle(count) for _ in range(variable.sizes["axis"])]
    for begin in range(0, raw.sizes["row"], BLOCK_ROWS):
        end = min(begin + BLOCK_ROWS, raw.sizes["row"])
        angles = np.asarray(read_slice(variable.data, begin, end), dtype=np.float64)
        rows = np.arange(begin, end)
        stamps = read_stamps(raw, begin, end) if "time" in raw.variables else rows
        for turn, values in zip(turns, angles, strict=True):
            turn.find_turns(values, stamps)
    notes = []
    for axis, turn in zip(raw["axis"].values, turns, strict=True):
        for rows_of, text in (
            (turn.rows, "begins again (it wraps around, or its counter does) and is continued"),
            (turn.jumps, "jumps; variances over these rows are wrong: split the log there"),
        ):
            if rows_of:
                file, row = file_of(raw, rows_of[0])
                places = "1 place" if len(rows_of) == 1 else f"{len(rows_of)} places"
                notes.append(f"{file}: the angle of axis {axis} {text}: {places}, first row {row}")
    if not any(turn.rows for turn in turns):
        return raw, notes, np.inf
    moving = [turn for turn in turns if turn.usual > 0]
    known_steps = min((_MAX_UNSEEN * turn.period / turn.usual for turn in moving), default=np.inf)
    source = _Continued(variable.data, turns)
    is_plain = isinstance(variable.data, np.ndarray)
    data = source[:, :] if is_plain else make_dask(source, variable.chunks)
    packing = _pack_continued(variable.encoding, turns)
    return raw.assign(angle=(variable.dims, data, variable.attrs, packing)), notes, known_steps


class _Differences(RowSource):
    """Angles less those of the sample before, times a factor; NaN for the first sample."""

    dtype = np.dtype(np.float64)

    def __init__(self, array: Any, factor: float):
        self.parts, self.shape, self.factor = (array,), array.shape, factor

    def read_into(self, row: int, begin: int, out: Array) -> None:
        angles = np.full(out.size + 1, np.nan)
        read_into(self.parts[0], row, max(begin - 1, 0), angles[int(begin == 0) :])
        np.multiply(np.diff(angles), self.factor, out=out)


def differentiate_angles(angles: Any, factor: float) -> Any:
    """Return the steps of angles (axis, sample) since the sample before, times a factor.

    Examples
    --------
    >>> differentiate_angles(np.array([[1.0, 3.0, np.nan, 8.0, 9.0]]), 10.0)
    array([[nan, 20., nan, nan, 10.]])
    """
    source = _Differences(angles, factor)
    return source[:, :] if isinstance(angles, np.ndarray) else make_dask(source, angles.chunks)

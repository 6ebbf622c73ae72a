"""Place rows in order along the most likely sequence of samples of jittered stamps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from gyrostab.arrays import Ints
from gyrostab.ingest.gap_table import break_cause
from gyrostab.ingest.grid.jitter import GAIN, MIN_SIGMA, TRACE_ROWS, JitterModel, observe_rows
from gyrostab.ingest.grid.place import HOLD, Placement, append_runs, make_placement
from gyrostab.ingest.grid.starting_period import SECOND, Stamps, recut_blocks
from gyrostab.kernels.grid.course import find_breaks, find_phase, trace
from gyrostab.kernels.grid.stamps import DUPLICATE
from gyrostab.time.grid import period_ns

_AHEAD_ROWS = 1 << 12

_MAX_ROWS, _MAX_AHEAD_ROWS = 1 << 20, 1 << 18

#: Largest delay of a row that is not taken as a clock set back [samples].
_LATE_SAMPLES = 16.0


class _Placer:
    """Assign samples to rows, stretch by stretch."""

    def __init__(self, jitter: JitterModel, period: float, max_gap_ns: float):
        self.jitter, self.period, self.max_gap_ns = jitter, period, max_gap_ns
        self.sigma = max(jitter.sigma, MIN_SIGMA)
        #: Constants of `trace`, and its state: lost samples, phase and number of used rows.
        self.law = period, self.sigma, GAIN, HOLD, max_gap_ns / period, jitter.loss_nats
        self.state = 0, 0.0, 0
        self.start: int | None = None
        self.latest = 0
        self.last = -1  # sample of the latest row
        self.runs: list[Ints] = []
        self.events: list[Ints] = []

    def add(self, rows: Ints, count: Ints, stamps: Ints, n: int) -> None:
        """Place the first `n` rows of a stretch; the others are look-ahead."""
        at = observe_rows(stamps, self.jitter.observe, self.period)
        if len(at) == 0:
            return
        if self.start is None:
            self.latest = int(stamps[at[0]])
        reach = _LATE_SAMPLES * max(self.period, self.jitter.group * self.period)
        breaks, self.latest = find_breaks(
            stamps[at], int(np.searchsorted(at, n)), self.latest, reach, self.max_gap_ns
        )
        cuts = [0, *at[breaks[:, 0]].tolist(), n]
        for number, (begin, end) in enumerate(pairwise(cuts)):
            beyond = len(rows) if end == n else end
            if number > 0:
                self._add_break(int(rows[begin]), int(breaks[number - 1, 1]), int(stamps[begin]))
            if begin < end:
                self._place_stretch(
                    rows[begin:beyond],
                    count[begin:beyond],
                    stamps[begin:beyond],
                    end - begin,
                    begins=number > 0,
                )

    def _add_break(self, row: int, previous_stamp: int, stamp: int) -> None:
        cause = break_cause(self.origin, self.origin, previous_stamp, stamp)
        event = [cause, self.last + 1, row, previous_stamp, stamp]
        self.events.append(np.array([event], dtype=np.int64))

    def _begin_piece(self, count: Ints, stamps: Ints, at: Ints) -> None:
        """Begin a piece; its first row is the next sample but one, or the first of the log."""
        ahead = find_phase(count[at], stamps[at], self.period, self.sigma)
        self.origin = int(stamps[at[0]]) + int(np.rint(ahead * self.period))
        self.count0, self.state = int(count[at[0]]), (0, 0.0, 0)
        self.base = int(count[at[0]] - count[0])

    def _leave_out_first(self, at: Ints, stamps: Ints) -> Ints:
        """Leave out the first row if it may be within a group of rows with one stamp, not first."""
        if self.jitter.observe != "first" or len(at) < 2:
            return at
        step = stamps[at[1]] - stamps[at[0]]
        return at[1:] if step < 1.5 * self.jitter.group * self.period else at

    def _set_first_sample(self, level: int) -> None:
        """Set the first sample of the piece, whose first row has lost `level` samples."""
        self.state = level, *self.state[1:]
        self.base -= level
        if self.start is None:
            self.start = self.origin - int(np.rint(self.base * self.period))
        else:
            self.base += self.last + 2

    def _place_stretch(
        self, rows: Ints, count: Ints, stamps: Ints, n: int, *, begins: bool
    ) -> None:
        at = observe_rows(stamps, self.jitter.observe, self.period)
        begins = begins or self.start is None
        if begins:
            at = self._leave_out_first(at, stamps)
            self._begin_piece(count, stamps, at)
        levels, phases = np.empty(len(at), dtype=np.int64), np.empty(len(at))
        if len(at):
            piece = count[at], stamps[at], self.count0, self.origin
            trace(*piece, *self.law, *self.state, levels, phases)
        if begins:
            self._set_first_sample(int(levels[0]))
        nearest = np.searchsorted(
            at, np.arange(n), side="left" if self.jitter.observe == "last" else "right"
        )
        nearest -= self.jitter.observe != "last"
        first_level, _, observed = self.state
        padded_levels = np.append(levels, first_level if len(at) == 0 else levels[-1])
        level = np.where(nearest < 0, first_level, padded_levels[np.clip(nearest, 0, len(at))])
        done = int(np.searchsorted(at, n))
        if done:
            self.state = int(levels[done - 1]), float(phases[done - 1]), observed + done
        self._add_rows(rows[:n], count[:n] - self.count0 + level + self.base, stamps[:n])

    def _add_rows(self, rows: Ints, sample: Ints, stamps: Ints) -> None:
        """Add runs of rows; a row on or before the sample of the previous row is a duplicate."""
        previous_sample = np.maximum.accumulate(np.concatenate([[self.last], sample[:-1]]))
        is_new = sample > previous_sample
        if not is_new.all():
            lost = np.flatnonzero(~is_new)
            same = np.full(len(lost), DUPLICATE)
            self.events.append(
                np.stack(
                    [same, np.maximum(sample[lost], 0), rows[lost], stamps[lost], stamps[lost]],
                    axis=1,
                )
            )
            rows, sample = rows[is_new], sample[is_new]
        if len(rows):
            self.last = int(sample[-1])
            append_runs(self.runs, sample, rows)


def place_in_order(
    stamps: Stamps, jitter: JitterModel, rate: float, *, max_gap: float, by_row: bool
) -> Placement:
    """Place rows in order, for stamps with jitter: see `gyrostab.ingest.grid.jitter`.

    Some stamps are readable. A step ahead above `max_gap` [s] is a step of the clock. With
    `by_row`, rows that `stamps` leaves out occupy samples.
    """
    ahead = int(min(_AHEAD_ROWS * np.ceil(jitter.group), _MAX_AHEAD_ROWS))
    size = int(min(TRACE_ROWS * np.ceil(jitter.group), _MAX_ROWS))
    placer = _Placer(jitter, sum(period_ns(rate)), max_gap * SECOND)
    for number, (rows, values) in enumerate(recut_blocks(stamps, size, ahead)):
        count = rows if by_row else np.arange(number * size, number * size + len(rows))
        placer.add(rows, count, values, size if len(rows) == size + ahead else len(rows))
    assert placer.start is not None
    return make_placement(placer.start, rate, placer.runs, placer.events)

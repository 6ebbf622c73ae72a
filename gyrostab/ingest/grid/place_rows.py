"""Place the rows of a raw log: by their stamps, in order, or by their count."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xarray as xr

from gyrostab.arrays import Ints
from gyrostab.errors import TimeError
from gyrostab.ingest.columns.pieces import find_even, find_line
from gyrostab.ingest.columns.stamps import read_stamps
from gyrostab.ingest.concat.place import Match, count_alike
from gyrostab.ingest.grid.jitter import MIN_SIGMA, JitterModel
from gyrostab.ingest.grid.notes import describe_rate
from gyrostab.ingest.grid.place import Placement, make_placement, place_by_count, place_by_stamp
from gyrostab.ingest.grid.place_in_order import place_in_order
from gyrostab.ingest.grid.rate import (
    DeviatingStretch,
    RateEstimate,
    deviating_stretches,
    estimate_near,
    estimate_rate,
    is_far_worse,
)
from gyrostab.ingest.grid.scan_pass import BLOCK_ROWS, ScanPass, file_of, stamp_blocks
from gyrostab.ingest.grid.starting_period import SECOND, Stamps
from gyrostab.kernels.grid.stamps import (
    DUPLICATE,
    EVENT_BEFORE,
    EVENT_ROW,
    EVENT_SAMPLE,
    EVENT_STAMP,
    NO_STAMP,
)
from gyrostab.schema import signal_name
from gyrostab.store.lazy import find_source, read_slice
from gyrostab.time.grid import period_ns
from gyrostab.time.stamps import stamp_ns

_MAX_RATE_DIFFERENCE = 0.02  # relative, between declared and estimated rate
_MANY_ROWS = 1000  # whose stamps suffice for the rate, whichever rows have no number
# Largest jitter at which stamps give the samples of 99 % of the rows; placing by stamp is then
# tried first [samples].
_SHARP_SIGMA = 0.2
_MIN_DROPPED_ROWS = 10  # rows without a sample for which placing in order is tried
_LATE_SHARE = 0.9  # share of the dropped rows that placing in order must recover
_MAX_CANDIDATES = 8  # earlier rows with the stamp of a set-back that are compared
_FIRST_ROWS = 256  # rows that are compared first
_MIN_SAME_SHARE = 0.5  # smaller share of equal values at which the comparison ends
_MIN_ROWS = 16  # shorter repetitions are found by their stamps alone
_MAX_ROUNDS = 4  # a repetition within another is found after the latter is removed


@dataclass(frozen=True)
class RowPlacer:
    """The rows of a raw log, and how to place them."""

    raw: xr.Dataset
    scanned: ScanPass
    declared: float | None  # sampling rate [Hz]; found from the stamps if None
    max_gap: float  # a longer step ahead is a step of the clock [s]

    def place(self) -> tuple[Placement, list[str]]:
        """Return the placement and notes."""
        return self._place_even() or self._place_all()

    @property
    def where(self) -> str:
        """File of the first row, for messages."""
        return file_of(self.raw)[0]

    def _place_even(self) -> tuple[Placement, list[str]] | None:
        """Place rows with evenly spaced stamps of a plain rate, without reading the stamps.

        Returns None if the stamps are not even, a row has no sample, or another rate is given.
        """
        scanned = self.scanned
        clock = find_source(self.raw["time"].data) if "time" in self.raw.variables else None
        line = None if clock is None else find_line(clock.parts)
        if line is None or line[1] <= 0 or scanned.absent_count or scanned.repeated_count:
            return None
        start, step = line
        rate = float(f"{SECOND / step:.13g}")
        if period_ns(rate) != (step, 0.0) or self.declared not in (None, rate):
            return None
        runs = [np.array([[0, 0, scanned.row_count]], dtype=np.int64)]
        return make_placement(start, rate, runs, []), []

    def _place_all(self) -> tuple[Placement, list[str]]:
        """Estimate the rate from the stamps, and place the rows by count, by stamp or in order.

        Rows that repeat others are marked in `scanned`.
        """
        raw, scanned, declared = self.raw, self.scanned, self.declared
        if "time" not in raw.variables:
            return self._place_without_time()
        # single unreadable rows still occupy samples
        count_all_rows = scanned.absent_count <= 0.01 * scanned.row_count
        stamps: Stamps = partial(stamp_blocks, raw, scanned)
        doubled = find_doubled(raw)
        scanned.leave_out(doubled[:, 0])
        try:
            estimate = estimate_rate(stamps, where=self.where)
        except TimeError:
            if declared is None or scanned.present_count > 1:
                raise
            estimate = RateEstimate(
                declared, 0.0, places_by_count=False, stamps_are_shared=False, unrounded=declared
            )
        if declared is None:
            estimate = self._estimate_by_rows(stamps, estimate)
        rate, notes = estimate.rate, list[str]()
        if declared is not None:
            if abs(declared / estimate.unrounded - 1) > _MAX_RATE_DIFFERENCE:
                estimate, note = self._estimate_declared(stamps, estimate, declared)
                notes.append(note)
            # a given rate settles the question
            rate = declared
            estimate = replace(estimate, rate_with_losses=None, rate_without_losses=None)
        deviating: list[DeviatingStretch] = []
        if estimate.places_by_count:
            stamps_to_count = partial(stamp_blocks, raw, scanned, all_rows=count_all_rows)
            placement = place_by_count(stamps_to_count, estimate, rate, max_gap=self.max_gap)
        else:
            placement = self._place_stamped(stamps, estimate.jitter, rate, count_all_rows)
            if _is_sharp(estimate.jitter):
                deviating = deviating_stretches(stamps, 1e9 / rate)
        in_longer = np.isin(doubled[:, 0], placement.events[:, EVENT_ROW])
        placement = _add_duplicates(placement, [doubled[~in_longer]])
        notes += describe_rate(raw, estimate, deviating, placement)
        changes = tuple(
            end[1]
            for stretch in deviating
            if abs(stretch.rate / rate - 1) > _MAX_RATE_DIFFERENCE
            for end in stretch[:2]
        )
        return replace(placement, rate_changes=changes), notes

    def _place_without_time(self) -> tuple[Placement, list[str]]:
        """Place rows without stamps from the given start."""
        if self.declared is None:
            raise TimeError(
                f"{self.where}: the file has no time column; give the sampling rate with --rate HZ"
            )
        text = self.raw.attrs.get("start")
        note = (
            f"{self.where}: no time in the file and no --start: the log is said to start at "
            "1970-01-01T00:00:00"
        )
        runs = [np.array([[0, 0, self.scanned.row_count]], dtype=np.int64)]
        placement = make_placement(stamp_ns(text) if text else 0, self.declared, runs, [])
        return placement, [] if text else [note]

    def _estimate_by_rows(self, stamps: Stamps, estimate: RateEstimate) -> RateEstimate:
        """Estimate the rate of a short log that has rows without a number at even stamps.

        If successive rows have numbers, the rate is that of all rows. The stamps of a few hundred
        rows with random losses between them also fit other rates, with jitter.
        """
        if not self.scanned.absent_count or self.scanned.row_count > _MANY_ROWS:
            return estimate
        present = np.flatnonzero(self.scanned.mask(0, self.scanned.row_count))
        all_stamps = read_stamps(self.raw, int(present[0]), int(present[-1]) + 1)
        line = find_line([find_even(all_stamps.view("datetime64[ns]"))])
        rate = SECOND / line[1] if line is not None and line[1] > 0 else estimate.unrounded
        if abs(rate / estimate.unrounded - 1) <= _MAX_RATE_DIFFERENCE:
            return estimate
        by_rows = estimate_near(stamps, rate)
        return by_rows if by_rows is not None and by_rows.jitter is None else estimate

    def _estimate_declared(
        self, stamps: Stamps, estimate: RateEstimate, declared: float
    ) -> tuple[RateEstimate, str]:
        """Estimate the rate near a declared one that the stamps alone do not say, with a note."""
        near_estimate = estimate_near(stamps, declared)
        lower = estimate.rate_without_losses or np.inf  # without the recurring losses
        named = abs(declared / lower - 1) <= _MAX_RATE_DIFFERENCE
        if (
            near_estimate is None
            or abs(declared / near_estimate.unrounded - 1) > _MAX_RATE_DIFFERENCE
            or (not named and is_far_worse(stamps, near_estimate, estimate))
        ):
            raise TimeError(
                f"{self.where}: the sampling rate given is {declared:.10g} Hz, but the time stamps "
                f"say {estimate.unrounded:.6g} Hz, and neither "
                "lost samples nor jitter explain the difference; "
                "leave out --rate to use the stamps, or correct --rate, --epoch or the unit of "
                "the time column"
            )
        return near_estimate, (
            f"{self.where}: the stamps alone say {estimate.unrounded:.6g} Hz; they fit the rate "
            f"given, {declared:.10g} Hz, which is used"
        )

    def _place_stamped(
        self, stamps: Stamps, jitter: JitterModel | None, rate: float, count_all_rows: bool
    ) -> Placement:
        """Place rows by their stamps, or in order if stamps have jitter."""
        scanned, max_gap = self.scanned, self.max_gap

        def place_along(jitter: JitterModel) -> Placement:
            def place() -> Placement:  # repetitions occupy no samples
                by_row = count_all_rows and not scanned.repeated_count
                return place_in_order(stamps, jitter, rate, max_gap=max_gap, by_row=by_row)

            return self._place_once(place)

        if jitter is not None and not _is_sharp(jitter):
            return place_along(jitter)
        repeated_before = scanned.repeated_count
        placement = self._place_once(
            partial(place_by_stamp, stamps, rate, max_gap=max_gap, where=self.where)
        )
        dropped = scanned.present_count - scanned.repeated_count - placement.placed_count
        has_repeats = scanned.repeated_count > repeated_before
        if not has_repeats and (dropped >= _MIN_DROPPED_ROWS or placement.has_late_rows):
            # placing in order may recover them
            along = place_along(jitter or JitterModel(1e9 / rate, MIN_SIGMA, "all", 1.0, 0.5))
            if along.placed_count - placement.placed_count >= _LATE_SHARE * dropped:
                placement = along
        return placement

    def _place_once(self, place: Callable[[], Placement]) -> Placement:
        """Place each sample once; repeated stretches of rows are duplicates, not clock restarts."""
        placement, all_repeats = place(), list[Ints]()
        for _ in range(_MAX_ROUNDS):
            repeats = find_repeats(self.raw, placement)
            if not repeats:
                break
            self.scanned.leave_out(np.concatenate(repeats)[:, 0])
            all_repeats += repeats
            placement = place()
        return _add_duplicates(placement, all_repeats)


def _is_sharp(jitter: JitterModel | None) -> bool:
    return jitter is None or jitter.sigma <= _SHARP_SIGMA


def find_repeats(raw: xr.Dataset, placement: Placement) -> list[Ints]:
    """Find the rows after each set-back of the clock that repeat rows before it.

    Rows are equal if their stamps and values are. A clock that restarts may write the same stamps
    again, but with other values; values that never change are not taken as a repetition.

    Returns a table for each repetition, (n, 3): row, the row that it repeats, and its stamp [ns].
    """
    breaks = placement.breaks
    back = breaks[breaks[:, EVENT_STAMP] < breaks[:, EVENT_BEFORE]]
    repeats: list[Ints] = []
    for row, stamp in sorted(back[:, [EVENT_ROW, EVENT_STAMP]].tolist()):
        if repeats and row <= repeats[-1][-1, 0]:
            continue
        for source in _rows_at(raw, stamp, row):
            length = _count_repeated(raw, source, row)
            if length >= _MIN_ROWS:
                rows, stamps = np.arange(length), read_stamps(raw, row, row + length)
                repeats.append(np.stack([rows + row, rows + source, stamps], axis=1))
                break
    return repeats


def _growing_blocks(rows: int) -> Iterator[tuple[int, int]]:
    """Yield begin and end of blocks, first small ones, as most comparisons end soon."""
    begin, size = 0, _FIRST_ROWS
    while begin < rows:
        yield begin, min(begin + size, rows)
        begin, size = begin + size, min(2 * size, BLOCK_ROWS)


def _rows_at(raw: xr.Dataset, stamp: int, end_row: int) -> list[int]:
    """Return the first few rows with a stamp."""
    rows: list[int] = []
    for begin, end in _growing_blocks(end_row):
        rows += (np.flatnonzero(read_stamps(raw, begin, end) == stamp) + begin).tolist()
        if len(rows) >= _MAX_CANDIDATES:
            break
    return rows[:_MAX_CANDIDATES]


def _count_repeated(raw: xr.Dataset, source: int, row: int) -> int:
    """Return how many rows from `row` on repeat those from `source` on, 0 if none do.

    Their stamps are equal, and their values where both are known, but not constant.
    """
    signal = raw[signal_name(raw)].data
    compared = same = length = 0
    changes = False
    for begin, end in _growing_blocks(min(raw.sizes["row"] - row, row - source)):
        differ = read_stamps(raw, source + begin, source + end) != read_stamps(
            raw, row + begin, row + end
        )
        length = begin + int(differ.argmax()) if differ.any() else end
        left, right = (read_slice(signal, first + begin, first + length) for first in (source, row))
        known, equal_rows = count_alike(left, right)
        compared, same = compared + int(known), same + int(equal_rows)
        changes = changes or bool((np.abs(np.diff(left, axis=1)) > 0).any())
        if differ.any() or same < _MIN_SAME_SHARE * compared:
            break
    return length if changes and Match(compared, same).alike else 0


def find_doubled(raw: xr.Dataset) -> Ints:
    """Find the rows that were written twice: they repeat stamp and values of the row before.

    Rows that share a stamp because the clock is coarse have other values. Values that are
    equal in most other rows too are not taken as a repetition.

    Returns (n, 3): row, the row that it repeats, and its stamp [ns].
    """
    signal = raw[signal_name(raw)].data
    tables: list[Ints] = []
    shared = same = apart = constant = 0
    for begin, end in _growing_blocks(raw.sizes["row"] - 1):
        stamps = read_stamps(raw, begin, end + 1)
        is_shared = (stamps[1:] == stamps[:-1]) & (stamps[1:] != NO_STAMP)
        if not is_shared.any():
            continue
        cells = read_slice(signal, begin, end + 1)
        before, after = cells[:, :-1], cells[:, 1:]
        is_equal = (before == after) | (np.isnan(before) & np.isnan(after))
        is_same = is_equal.all(axis=0) & ~np.isnan(after).all(axis=0)
        rows = np.flatnonzero(is_shared & is_same) + 1
        tables.append(np.stack([rows + begin, stamps[rows]]))
        shared, same = shared + int(is_shared.sum()), same + len(rows)
        apart = apart + int((~is_shared).sum())
        constant = constant + int((~is_shared & is_same).sum())
        if shared >= _MIN_ROWS and same < _MIN_SAME_SHARE * shared:
            break
    is_certain = shared >= _MIN_ROWS and Match(shared, same).alike
    if not is_certain or constant >= _MIN_SAME_SHARE * apart:
        return np.empty((0, 3), dtype=np.int64)
    rows, stamps = np.concatenate(tables, axis=1)
    is_first = np.diff(rows, prepend=-1) > 1
    source = np.maximum.accumulate(np.where(is_first, rows - 1, 0))
    return np.stack([rows, source, stamps], axis=1)


def _add_duplicates(placement: Placement, repeats: Sequence[Ints]) -> Placement:
    """Add stamped rows that repeat others as duplicates to the events of a placement without them.

    The tables are those of `find_repeats` and `find_doubled`.
    """
    events = [placement.events]
    for row, source, stamp in (table.T for table in repeats):
        sample = np.maximum.accumulate(np.maximum(placement.samples_of(source), 0))
        table = np.stack([np.full_like(row, DUPLICATE), sample, row, stamp, stamp], axis=1)
        events.append(table[stamp != NO_STAMP])
    table = np.concatenate(events)
    return replace(placement, events=table[np.argsort(table[:, EVENT_SAMPLE], kind="stable")])

"""Assign rows to samples by their stamps or by their count; runs of rows, and events."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.arrays import Array, Floats, Ints
from gyrostab.errors import TimeError
from gyrostab.ingest.columns.stamps import read_stamps
from gyrostab.ingest.gap_table import break_cause
from gyrostab.ingest.grid.rate import RateEstimate
from gyrostab.ingest.grid.scan_pass import file_of
from gyrostab.ingest.grid.starting_period import Stamps, readable_stamps, recut_blocks
from gyrostab.ingest.limits import describe_limit, is_absurd_grid
from gyrostab.kernels.grid import stamps as kernel
from gyrostab.time.durations import format_measured_duration
from gyrostab.time.grid import period_ns
from gyrostab.time.stamps import format_stamp
from gyrostab.wording import format_rounded

#: Largest distance of the smoothed stamps from the grid before a sample is skipped [samples].
HOLD = 0.75

#: Rows that the placement kernel processes at one time.
_STRETCH_ROWS = 1 << 18

#: Stamps with which the first one is compared, itself included, and the ratio of its distance from
#: them to their largest distance from each other at which it is corrected.
_FIRST_STAMPS, _MIN_DELAY_RATIO = 32, 4.0


@dataclass(frozen=True)
class Placement:
    """Rows placed on the samples of a uniform grid."""

    start: int  # stamp of sample 0 [ns since 1970]
    rate: float  # sampling rate [Hz]
    #: (n, 3): first sample, first row, length; sorted by sample, without overlap.
    runs: Ints
    #: (n, 5): `EVENT_CAUSE` to `EVENT_STAMP` of `gyrostab.kernels.grid.stamps`; sorted by sample.
    events: Ints
    #: Largest distance of the smoothed stamps from the grid [samples]; only for counted rows.
    wander: float = 0.0
    #: Stamps from which the rate of the rows deviates from that of the grid [ns since 1970].
    rate_changes: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        """Number of samples from the first to the last placed row."""
        return int(self.runs[-1, 0] + self.runs[-1, 2]) if len(self.runs) else 0

    @property
    def placed_count(self) -> int:
        """Number of rows that have a sample."""
        return int(self.runs[:, 2].sum())

    def samples_of(self, rows: Ints) -> Ints:
        """Return the sample of each row, -1 where the row was not placed."""
        runs = self.runs[np.argsort(self.runs[:, 1], kind="stable")]
        which = np.searchsorted(runs[:, 1], rows, side="right") - 1
        inside = (which >= 0) & (rows < runs[which, 1] + runs[which, 2])
        return np.where(inside, runs[which, 0] + rows - runs[which, 1], -1)

    def events_of(self, *causes: int) -> Ints:
        """Return the events of some causes."""
        return self.events[np.isin(self.events[:, kernel.EVENT_CAUSE], causes)]

    @property
    def breaks(self) -> Ints:
        """Events at which the clock restarts or steps."""
        return self.events_of(kernel.STEP, kernel.RESTART)

    @property
    def has_late_rows(self) -> bool:
        """Whether three consecutive rows were dropped, as happens after a pause."""
        rows = np.sort(self.events_of(kernel.DUPLICATE, kernel.OUT_OF_ORDER)[:, kernel.EVENT_ROW])
        rows = rows[self.samples_of(rows) < 0]
        return bool((rows[2:] - rows[:-2] == 2).any())


def make_placement(
    start: int, rate: float, runs: list[Ints], events: list[Ints], wander: float = 0.0
) -> Placement:
    """Make a placement of lists of runs and events, sorted by sample."""
    table = np.concatenate(runs)
    happened = np.concatenate([*events, np.empty((0, kernel.EVENT_COLUMNS), dtype=np.int64)])
    table = table[np.argsort(table[:, 0], kind="stable")]
    happened = happened[np.argsort(happened[:, kernel.EVENT_SAMPLE], kind="stable")]
    return Placement(start, rate, table, happened, wander)


def check_grid(
    raw: xr.Dataset, placement: Placement, max_gap: float, limits: Mapping[str, float]
) -> None:
    """Refuse a grid with far more samples than rows, before it is allocated."""
    if not is_absurd_grid(placement.size, placement.placed_count, limits):
        return
    runs = placement.runs
    holes = runs[1:, 0] - runs[:-1, 0] - runs[:-1, 2]
    widest = int(np.argmax(holes))
    rows = [int(runs[widest, 1] + runs[widest, 2] - 1), int(runs[widest + 1, 1])]
    places = [
        f"{format_stamp(int(read_stamps(raw, row, row + 1)[0]))} (row {file_of(raw, row)[1]})"
        for row in rows
    ]
    gap = holes[widest] / placement.rate
    if gap >= 1.0:
        fix = (
            "correct the stamp or the unit of the time column, or give --max-gap "
            f"{format_rounded(min(max_gap, gap) / 2)}s to take it for a clock step"
        )
    else:
        fix = (
            f"other stamps are {format_measured_duration(1.0 / placement.rate)} apart, too close "
            "for a log of that length: correct them or the unit of time"
        )
    raise TimeError(
        f"{file_of(raw, rows[0])[0]}: from {places[0]} to {places[1]} there are "
        f"{format_measured_duration(gap)} without samples, and the grid of "
        f"{placement.rate:.10g} Hz would have {placement.size:.4g} samples for "
        f"{placement.placed_count:,} rows; {fix}. If the stamps are right: "
        f"{describe_limit('grid_samples', placement.size, limits)}"
    )


def append_runs(runs: list[Ints], sample: Ints, rows: Ints) -> None:
    """Append runs of rows and samples to `runs`; extend the last run if they continue it."""
    new = np.flatnonzero((np.diff(sample) != 1) | (np.diff(rows) != 1)) + 1
    first = np.concatenate([[0], new])
    table = np.stack([sample[first], rows[first], np.diff(np.append(first, len(rows)))], axis=1)
    last_run = runs[-1][-1] if runs else None
    if last_run is not None and (last_run[:2] + last_run[2] == table[0, :2]).all():
        last_run[2] += table[0, 2]
        table = table[1:]
    if len(table):
        runs.append(table)


def place_by_stamp(stamps: Stamps, rate: float, *, max_gap: float, where: str) -> Placement:
    """Place rows by their stamps; the result does not depend on the size of their blocks.

    A step ahead above `max_gap` [s] is a step of the clock.
    """
    period = sum(period_ns(rate))
    state, ring = kernel.new_state()
    runs: list[Ints] = []
    events: list[Ints] = []
    first = np.empty(0, dtype=np.int64)
    for rows, values in recut_blocks(stamps, _STRETCH_ROWS, kernel.LOOK_AHEAD):
        if len(first) == 0:
            first = readable_stamps(values)[:_FIRST_STAMPS]
        n = _STRETCH_ROWS if len(rows) == _STRETCH_ROWS + kernel.LOOK_AHEAD else len(rows)
        new, happened = kernel.place(rows, values, n, period, HOLD, max_gap * rate, state, ring)
        runs.append(new)
        events.append(happened)
    if not state[kernel.STARTED]:
        raise TimeError(
            f"{where}: no row has a readable stamp; check the time column and its unit (--map), "
            "or give --rate HZ for a log without time"
        )
    runs.append(state[kernel.OPEN_RUN][None])
    return make_placement(_find_start(first, period), rate, runs, events)


def _find_start(stamps: Ints, period: float) -> int:
    """Return the first stamp [ns], corrected if it disagrees with all others, which agree."""
    samples = (stamps[1:] - stamps[0]) / period
    off = samples - np.rint(samples)
    if len(off) < _FIRST_STAMPS - 1:
        return int(stamps[0])
    delay = float(np.median(off))
    is_certain = abs(delay) > _MIN_DELAY_RATIO * np.abs(off - delay).max()
    return int(stamps[0]) + (int(np.rint(delay * period)) if is_certain else 0)


class _Windows(NamedTuple):
    """Lead of the stamps over the row count in windows of equal length [samples]."""

    low: Floats
    high: Floats
    reach: Floats
    up: Ints
    down: Ints


def _make_windows(stamps: Stamps, period: float, width: int) -> tuple[_Windows, int]:
    """Make windows of `width` rows; also return the first stamp [ns]."""
    blocks = (readable_stamps(values) for _, values in stamps())
    zero = next((int(readable[0]) for readable in blocks if len(readable)), 0)
    parts: list[tuple[Array, ...]] = []
    last: list[float] = []  # lead at the end of the previous window
    done = 0
    for _, values in recut_blocks(stamps, max(1, _STRETCH_ROWS // width) * width):
        table = values[: len(values) // width * width].reshape(-1, width)
        rest = values[table.size :]  # only the last block has one
        tables = [table, rest[None]] if len(rest) >= width // 2 else [table]
        for window in tables if parts or table.size else [values[None]]:
            if not window.size:
                continue
            ahead = (window - zero) / period - (np.arange(window.size) + done).reshape(window.shape)
            ahead[window == kernel.NO_STAMP] = np.nan
            # a row without a readable stamp has the lead of the last one before it
            leads = pd.Series(np.concatenate([last, ahead.ravel()])).ffill().bfill().fillna(0.0)
            filled = leads.to_numpy()[len(last) :].reshape(window.shape)
            step = np.diff(filled.ravel(), prepend=leads.iloc[0]).reshape(window.shape)
            last = [filled[-1, -1]]
            at = np.arange(len(window)) * window.shape[1] + done
            low, high = filled.min(axis=1), filled.max(axis=1)
            reach = np.quantile(filled, 0.9, axis=1) - low
            parts.append((low, high, reach, at + step.argmax(axis=1), at + step.argmin(axis=1)))
            done += window.size
    return _Windows(*map(np.concatenate, zip(*parts, strict=True))), zero


def _find_jumps(windows: _Windows) -> tuple[list[tuple[int, float, float]], float]:
    """Find lasting shifts of the lower envelope (row count, size, level) and the wander."""
    low = windows.low
    change = np.abs(np.diff(low))
    noise = 1.4826 * float(np.median(change)) if len(change) else 0.0
    min_size = max(6 * noise, float(np.median(windows.reach)), 3.0)
    jumps: list[tuple[int, float, float]] = []
    level, placed, wander = float(low[0]), float(low[0]), 0.0
    for b in range(1, len(low)):
        next_lows = low[b : b + 3]
        usual = float(np.median(next_lows))
        size = usual - level
        if (
            abs(size) > min_size
            and abs(low[b] - level) > min_size
            and (next_lows - level > min_size).all() | (next_lows - level < -min_size).all()
        ):
            # a loss late in a window does not change the lowest point of that window
            rows = (windows.up if size > 0 else windows.down)[b - 1 : b + 1]
            tops = windows.high[b - 1] - level if size > 0 else level - low[b - 1]
            row = int(rows[0]) if size > 0 and tops > 0.7 * size else int(rows[-1])
            jumps.append((row, size, level))
            level, placed = usual, placed + size
        else:
            level += 0.2 * (float(low[b]) - level)
            wander = max(wander, abs(level - placed))
    return jumps, wander


def place_by_count(
    stamps: Stamps, estimate: RateEstimate, rate: float, *, max_gap: float
) -> Placement:
    """Place rows by their count, for stamps that are times of arrival; a lasting delay is a loss.

    A loss longer than `max_gap` [s] is taken as a step of the clock.
    """
    period = sum(period_ns(rate))
    width = max(64, int(4 * rate))
    windows, first = _make_windows(stamps, period, width)
    jumps, wander = _find_jumps(windows)
    edge = windows.high[0] if estimate.stamps_are_shared else windows.low[0]
    start = first + int(np.rint(edge * period)) if abs(edge) < 2 * width else first
    shifts, cuts, events = [0], [0], []
    begun = 0.0
    for row, size, level in jumps:
        extra = int(np.rint(size))
        stamp_before = first + int((row - 1 + level) * period)
        if size < 0 or size > max_gap * rate:
            before, after = row + level, row + level + size
            cause = break_cause(0.0, begun, before, after)
            stamp = stamp_before + int((size + 1) * period)
            events.append((cause, row + shifts[-1], len(cuts), stamp_before, stamp))
            extra, begun = 1, after
        shifts.append(shifts[-1] + extra)
        cuts.append(row)
    runs, cut_rows = _counted_runs(stamps, np.array(cuts), np.array(shifts))
    numbers = np.array(events, dtype=np.int64).reshape(-1, kernel.EVENT_COLUMNS)
    numbers[:, 2] = cut_rows[numbers[:, 2]]
    return make_placement(start, rate, runs, [numbers], wander)


def _counted_runs(stamps: Stamps, cuts: Ints, shifts: Ints) -> tuple[list[Ints], Ints]:
    """Make runs of rows by count; from count ``cuts[i]`` on, sample = count + ``shifts[i]``.

    Also return the row number of each cut.
    """
    runs: list[Ints] = []
    cut_rows, done = cuts.copy(), 0
    for rows, _ in stamps():
        if len(rows):
            count = np.arange(done, done + len(rows))
            append_runs(runs, count + shifts[np.searchsorted(cuts, count, side="right") - 1], rows)
            is_inside = (cuts >= done) & (cuts < done + len(rows))
            cut_rows[is_inside] = rows[cuts[is_inside] - done]
            done += len(rows)
    return runs, cut_rows

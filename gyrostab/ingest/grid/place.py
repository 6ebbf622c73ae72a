"""Which row becomes which sample: runs of rows, and what happened on the way."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import TimeError
from gyrostab.ingest.gap_table import format_duration, format_stamp
from gyrostab.ingest.grid.jitter import JitterModel, place_rows
from gyrostab.ingest.grid.rate import SECOND, RateEstimate, Stamps
from gyrostab.ingest.grid.scan_pass import file_of
from gyrostab.ingest.limits import describe_limit, is_absurd_grid
from gyrostab.kernels.grid import stamps as kernel
from gyrostab.kernels.grid.stamps import DUPLICATE, LOOK, NO_STAMP, OUT_OF_ORDER, RESTART, STEP
from gyrostab.store.lazy_slices import read_slice
from gyrostab.time.grid import period_ns

__all__ = [
    "Placement",
    "check_grid",
    "place_by_count",
    "place_by_stamp",
    "place_in_order",
    "place_without_time",
]

_NO_STAMPS = "{where}: no row has a readable stamp; check the time column and its unit (--map), or give --rate HZ for a log without time"
#: Rows that the placement kernel takes at a time.
_STRETCH_ROWS = 1 << 18


@dataclass(frozen=True)
class Placement:
    """Samples of a uniform grid and the rows that fill them.

    Attributes
    ----------
    start : int
        Stamp of sample 0 [ns since 1970].
    runs : ndarray of int64, shape (n, 3)
        First sample, first row, length; sorted by sample, without overlap.
    events : ndarray of int64, shape (n, 5)
        Cause (number in schema.GAP_CAUSES), sample, row, stamp before [ns], stamp [ns]; sorted by
        sample.
    wander : float
        Largest distance of a stamp's long-term course from the grid [samples]; only where rows are
        counted.
    """

    start: int
    runs: NDArray[np.int64]
    events: NDArray[np.int64]
    wander: float = 0.0

    @property
    def size(self) -> int:
        """Samples from the first to the last row that was placed."""
        return int(self.runs[-1, 0] + self.runs[-1, 2]) if len(self.runs) else 0

    @property
    def placed(self) -> int:
        """Rows that have a sample."""
        return int(self.runs[:, 2].sum())

    @property
    def has_late_rows(self) -> bool:
        """Whether three rows one after the other were dropped, as rows that arrive together after a pause are."""
        rows = np.sort(self.events[np.isin(self.events[:, 0], (DUPLICATE, OUT_OF_ORDER)), 2])
        return bool((rows[2:] - rows[:-2] == 2).any())


def make_placement(
    start: int, runs: list[NDArray[np.int64]], events: list[NDArray[np.int64]], wander: float = 0.0
) -> Placement:
    table = np.concatenate([part for part in runs if len(part)])
    happened = np.concatenate([*events, np.empty((0, 5), dtype=np.int64)])
    table = table[np.argsort(table[:, 0], kind="stable")]
    return Placement(start, table, happened[np.argsort(happened[:, 1], kind="stable")], wander)


def check_grid(
    raw: xr.Dataset, placement: Placement, rate: float, max_gap: float, limits: Mapping[str, float]
) -> None:
    """Refuse a grid that is out of proportion to the rows, before anything is done for each of its samples.

    Parameters
    ----------
    raw : xarray.Dataset
        Raw log.
    placement : Placement
        Its rows on the grid.
    rate, max_gap : float
        Sampling rate [Hz] and longest gap [s].
    limits : mapping of str to float
        Limits that the user set.

    Raises
    ------
    TimeError
        With the two stamps that make the grid so long, and the options that help.
    """
    if not is_absurd_grid(placement.size, placement.placed, limits):
        return
    runs = placement.runs
    holes = runs[1:, 0] - runs[:-1, 0] - runs[:-1, 2]
    widest = int(np.argmax(holes))
    rows = [int(runs[widest, 1] + runs[widest, 2] - 1), int(runs[widest + 1, 1])]
    stamps = [
        int(read_slice(raw["time"].data, row, row + 1).astype("datetime64[ns]").view(np.int64)[0])
        for row in rows
    ]
    places = [
        f"{format_stamp(stamp)} (row {file_of(raw, row)[1]})"
        for stamp, row in zip(stamps, rows, strict=True)
    ]
    gap = holes[widest] / rate
    if gap >= 1.0:
        fix = f"correct the stamp or the unit of the time column, or give --max-gap {min(max_gap, gap) / 2:.2g}s to take it for a clock step"
    else:
        fix = f"other stamps are {format_duration(1.0 / rate)} apart, too close for a log of that length: correct them or the unit of time"
    raise TimeError(
        f"{file_of(raw, rows[0])[0]}: from {places[0]} to {places[1]} there are {format_duration(gap)} without samples, and the grid of "
        f"{rate:.10g} Hz would have {placement.size:.4g} samples for {placement.placed:,} rows; {fix}. If the stamps are right: "
        f"{describe_limit('grid_samples', placement.size, limits)}"
    )


def place_without_time(rows: int, start: int) -> Placement:
    """Rows without stamps: every row is the next sample."""
    return make_placement(start, [np.array([[0, 0, rows]], dtype=np.int64)], [])


def _look_ahead_stretches(
    stamps: Stamps,
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], int]]:
    """Rows and stamps in stretches, each with `LOOK` more rows to look at than the number that is to be placed."""
    rest_rows, rest_stamps = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    for rows, values in stamps():
        rest_rows, rest_stamps = (
            np.concatenate([rest_rows, rows]),
            np.concatenate([rest_stamps, values]),
        )
        at = 0
        while len(rest_rows) - at > LOOK:
            n = min(_STRETCH_ROWS, len(rest_rows) - at - LOOK)
            yield rest_rows[at : at + n + LOOK], rest_stamps[at : at + n + LOOK], n
            at += n
        rest_rows, rest_stamps = rest_rows[at:], rest_stamps[at:]
    if len(rest_rows):
        yield rest_rows, rest_stamps, len(rest_rows)


def place_by_stamp(
    stamps: Stamps, rate: float, *, tolerance: float, max_gap: float, where: str
) -> Placement:
    """Place rows by their stamps.

    Parameters
    ----------
    stamps : callable
        Gives an iterator over blocks of (row numbers, stamps [ns]); the size of the blocks makes no
        difference.
    rate : float
        Sampling rate [Hz].
    tolerance : float
        How much further than half a sample the slow course of the stamps may depart from the grid
        before a sample is left out [samples].
    max_gap : float
        A longer step ahead is a step of the clock [s].
    where : str
        The file, for messages.

    Raises
    ------
    TimeError
        When no stamp can be read.
    """
    whole, fraction = period_ns(rate)
    period = whole + fraction
    state, ring = kernel.new_state()
    runs: list[NDArray[np.int64]] = []
    events: list[NDArray[np.int64]] = []
    for rows, values, n in _look_ahead_stretches(stamps):
        new, happened = kernel.place(
            rows, values, n, period, 0.5 + tolerance, max_gap * rate, state, ring
        )
        runs.append(new)
        events.append(happened)
    if not state[kernel.STARTED]:
        raise TimeError(_NO_STAMPS.format(where=where))
    runs.append(state[kernel.OPEN_RUN][None])
    return make_placement(int(state[kernel.FIRST]), runs, events)


@dataclass
class _Windows:
    """Stretches of as many rows: how far the stamps are ahead of the row count [samples]."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    reach: NDArray[np.float64]
    up: NDArray[np.int64]
    down: NDArray[np.int64]


def _make_windows(stamps: Stamps, period: float, width: int) -> tuple[_Windows, int]:
    """Windows of `width` rows, and the first stamp [ns]."""
    parts: list[tuple[NDArray[np.float64], ...]] = []
    rest = np.empty(0, dtype=np.int64)
    first: int | None = None
    last: list[float] = []  # of the window before
    done = 0

    def summarise(values: NDArray[np.int64], before: int, zero: int) -> None:
        table = values.reshape(-1, width) if len(values) >= width else values[None]
        ahead = (table - zero) / period - (np.arange(values.size) + before).reshape(table.shape)
        ahead[table == NO_STAMP] = np.nan
        known = np.where(
            np.isnan(ahead), np.nanmedian(ahead) if np.isfinite(ahead).any() else 0.0, ahead
        )
        step = np.diff(known.ravel(), prepend=last[0] if last else known[0, 0]).reshape(known.shape)
        last[:] = [known[-1, -1]]
        at = np.arange(len(table)) * width + before
        low, high = known.min(axis=1), known.max(axis=1)
        parts.append(
            (
                low,
                high,
                np.quantile(known, 0.9, axis=1) - low,
                at + step.argmax(axis=1),
                at + step.argmin(axis=1),
            )
        )

    for _, values in stamps():
        rest = np.concatenate([rest, values])
        if first is None and (rest != NO_STAMP).any():
            first = int(rest[rest != NO_STAMP][0])
        n = len(rest) // width * width
        if n and first is not None:
            summarise(rest[:n], done, first)
            rest, done = rest[n:], done + n
    if first is not None and (len(rest) >= width // 2 or not parts) and len(rest):
        summarise(rest, done, first)
    low, high, reach, up, down = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _Windows(low, high, reach, up.astype(np.int64), down.astype(np.int64)), int(first or 0)


def _find_jumps(windows: _Windows) -> tuple[list[tuple[int, float, int, float]], float]:
    """Lasting shifts of the lower envelope: counted row, size [samples], window, envelope before; and the wander."""
    low = windows.low
    change = np.abs(np.diff(low))
    noise = 1.4826 * float(np.median(change)) if len(change) else 0.0
    least = max(6 * noise, float(np.median(windows.reach)), 3.0)
    found: list[tuple[int, float, int, float]] = []
    course, placed, wander, b = float(low[0]), float(low[0]), 0.0, 1
    while b < len(low):
        after = low[b : b + 3]
        size = float(np.median(after)) - course
        if (
            abs(size) > least
            and abs(low[b] - course) > least
            and (after - course > least).all() | (after - course < -least).all()
        ):
            # a loss late in the window before leaves that window's lowest point where it was
            rows = (windows.up if size > 0 else windows.down)[b - 1 : b + 1]
            tops = windows.high[b - 1] - course if size > 0 else course - low[b - 1]
            row = int(rows[0]) if size > 0 and tops > 0.7 * size else int(rows[-1])
            found.append((row, size, b, course))
            course = float(np.median(after))
            placed += course - found[-1][3]
            b += 1
            continue
        course += 0.2 * (float(low[b]) - course)
        wander = max(wander, abs(course - placed))
        b += 1
    return found, wander


def place_by_count(
    stamps: Stamps, estimate: RateEstimate, rate: float, *, max_gap: float
) -> Placement:
    """Place rows by their count, where stamps only tell when they arrived; a lasting delay is a loss of samples.

    Parameters
    ----------
    stamps : callable
        Gives an iterator over blocks of (row numbers, stamps [ns]).
    estimate : RateEstimate
        How the stamps behave.
    rate : float
        Sampling rate [Hz].
    max_gap : float
        A longer loss is a step of the clock [s].
    """
    whole, fraction = period_ns(rate)
    period = whole + fraction
    width = max(64, int(4 * rate))
    windows, first = _make_windows(stamps, period, width)
    jumps, wander = _find_jumps(windows)
    edge = windows.high[0] if estimate.coarse else windows.low[0]
    start = first + int(np.rint(edge * period)) if abs(edge) < 2 * width else first
    shifts, cuts, events = [0], [0], []
    begun = 0.0
    for row, size, _window, course in jumps:
        extra = int(np.rint(size))
        before = first + int((row - 1 + course) * period)
        if size < 0 or size > max_gap * rate:
            back = -size
            elapsed = row + course - begun
            cause = (
                RESTART
                if size < 0 and (2 * back > elapsed or row + course + size < 0.1 * elapsed)
                else STEP
            )
            events.append((cause, row + shifts[-1], row, before, before + int((size + 1) * period)))
            extra, begun = 1, row + course + size
        shifts.append(shifts[-1] + extra)
        cuts.append(row)
    runs = _counted_runs(stamps, np.array(cuts), np.array(shifts))
    numbers = np.array(events, dtype=np.int64).reshape(-1, 5)
    if len(numbers):
        numbers[:, 2] = _rows_at(stamps, numbers[:, 2])
    return make_placement(start, runs, [numbers], wander)


def place_in_order(
    stamps: Stamps,
    course: JitterModel,
    rate: float,
    *,
    tolerance: float,
    max_gap: float,
    by_row: bool,
    where: str,
) -> Placement:
    """Place rows in order where single stamps do not tell the sample: see `gyrostab.ingest.grid.jitter`.

    Parameters
    ----------
    stamps, rate, tolerance, max_gap, where
        As for `place_by_stamp`.
    course : Course
        How the stamps scatter.
    by_row : bool
        Rows that `stamps` leaves out took their time all the same.

    Raises
    ------
    TimeError
        When no stamp can be read.
    """
    whole, fraction = period_ns(rate)
    start, runs, events = place_rows(
        stamps(),
        course,
        whole + fraction,
        hold=0.5 + tolerance,
        max_gap_ns=max_gap * SECOND,
        by_row=by_row,
    )
    if start is None:
        raise TimeError(_NO_STAMPS.format(where=where))
    return make_placement(start, runs, events)


def _rows_at(stamps: Stamps, counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Row numbers of the rows with the given counts."""
    found, done = counts.copy(), 0
    for rows, _ in stamps():
        here = (counts >= done) & (counts < done + len(rows))
        found[here] = rows[counts[here] - done]
        done += len(rows)
    return found


def _counted_runs(
    stamps: Stamps, cuts: NDArray[np.int64], shifts: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """Make runs of rows by count, where from count ``cuts[i]`` on the sample is the count plus ``shifts[i]``."""
    runs: list[NDArray[np.int64]] = []
    done = 0
    for rows, _ in stamps():
        if len(rows) == 0:
            continue
        count = np.arange(done, done + len(rows))
        grid = count + shifts[np.searchsorted(cuts, count, side="right") - 1]
        new = np.flatnonzero((np.diff(grid) != 1) | (np.diff(rows) != 1)) + 1
        first = np.concatenate([[0], new])
        last = np.append(new, len(rows))
        table = np.stack([grid[first], rows[first], last - first], axis=1)
        if (
            runs
            and runs[-1][-1, 0] + runs[-1][-1, 2] == table[0, 0]
            and runs[-1][-1, 1] + runs[-1][-1, 2] == table[0, 1]
        ):
            runs[-1][-1, 2] += table[0, 2]
            table = table[1:]
        if len(table):
            runs.append(table)
        done += len(rows)
    return runs

"""Assign rows to samples by their stamps; runs of rows and events such as clock steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import TimeError
from gyrostab.ingest.gap_table import format_duration, format_stamp
from gyrostab.ingest.grid.scan_pass import file_of
from gyrostab.ingest.grid.starting_period import Stamps
from gyrostab.ingest.limits import describe_limit, is_absurd_grid
from gyrostab.kernels.grid import stamps as kernel
from gyrostab.kernels.grid.stamps import DUPLICATE, LOOK_AHEAD, OUT_OF_ORDER
from gyrostab.store.lazy_slices import read_slice
from gyrostab.time.grid import period_ns

__all__ = [
    "NO_STAMPS",
    "Placement",
    "check_grid",
    "make_placement",
    "place_by_stamp",
    "place_without_time",
]


NO_STAMPS = (
    "{where}: no row has a readable stamp; check the time column and its unit (--map), "
    "or give --rate HZ for a log without time"
)


#: Rows that the placement kernel processes at one time.
_STRETCH_ROWS = 1 << 18


@dataclass(frozen=True)
class Placement:
    """Rows placed on the samples of a uniform grid.

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
        Largest distance of the smoothed stamps from the grid [samples]; only for counted rows.
    """

    start: int
    runs: NDArray[np.int64]
    events: NDArray[np.int64]
    wander: float = 0.0

    @property
    def size(self) -> int:
        """Number of samples from the first to the last placed row."""
        return int(self.runs[-1, 0] + self.runs[-1, 2]) if len(self.runs) else 0

    @property
    def placed(self) -> int:
        """Number of rows that have a sample."""
        return int(self.runs[:, 2].sum())

    @property
    def has_late_rows(self) -> bool:
        """Whether three consecutive rows were dropped, as happens after a pause."""
        rows = np.sort(self.events[np.isin(self.events[:, 0], (DUPLICATE, OUT_OF_ORDER)), 2])
        return bool((rows[2:] - rows[:-2] == 2).any())


def make_placement(
    start: int, runs: list[NDArray[np.int64]], events: list[NDArray[np.int64]], wander: float = 0.0
) -> Placement:
    """Make a placement of lists of runs and events, sorted by sample."""
    table = np.concatenate([part for part in runs if len(part)])
    happened = np.concatenate([*events, np.empty((0, 5), dtype=np.int64)])
    table = table[np.argsort(table[:, 0], kind="stable")]
    return Placement(start, table, happened[np.argsort(happened[:, 1], kind="stable")], wander)


def check_grid(
    raw: xr.Dataset, placement: Placement, rate: float, max_gap: float, limits: Mapping[str, float]
) -> None:
    """Refuse a grid with far more samples than rows, before it is allocated.

    Parameters
    ----------
    raw : xarray.Dataset
        Raw log.
    placement : Placement
        Rows of the log on the grid.
    rate, max_gap : float
        Sampling rate [Hz] and longest gap [s].
    limits : mapping of str to float
        Limits that the user set.

    Raises
    ------
    TimeError
        With the two stamps around the longest gap, and the options that help.
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
        fix = (
            "correct the stamp or the unit of the time column, or give --max-gap "
            f"{min(max_gap, gap) / 2:.2g}s to take it for a clock step"
        )
    else:
        fix = (
            f"other stamps are {format_duration(1.0 / rate)} apart, too close for a log of "
            "that length: correct them or the unit of time"
        )
    raise TimeError(
        f"{file_of(raw, rows[0])[0]}: from {places[0]} to {places[1]} there are "
        f"{format_duration(gap)} without samples, and the grid of "
        f"{rate:.10g} Hz would have {placement.size:.4g} samples for {placement.placed:,} rows; "
        f"{fix}. If the stamps are right: "
        f"{describe_limit('grid_samples', placement.size, limits)}"
    )


def place_without_time(rows: int, start: int) -> Placement:
    """Place rows without stamps: every row is the next sample."""
    return make_placement(start, [np.array([[0, 0, rows]], dtype=np.int64)], [])


def _look_ahead_stretches(
    stamps: Stamps,
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], int]]:
    """Yield stretches of rows and stamps with `LOOK_AHEAD` more rows, and the rows to place."""
    rest_rows, rest_stamps = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    for rows, values in stamps():
        rest_rows, rest_stamps = (
            np.concatenate([rest_rows, rows]),
            np.concatenate([rest_stamps, values]),
        )
        at = 0
        while len(rest_rows) - at > LOOK_AHEAD:
            n = min(_STRETCH_ROWS, len(rest_rows) - at - LOOK_AHEAD)
            end = at + n + LOOK_AHEAD
            yield rest_rows[at:end], rest_stamps[at:end], n
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
        Returns an iterator over blocks of (row numbers, stamps [ns]); the result does not depend
        on the size of the blocks.
    rate : float
        Sampling rate [Hz].
    tolerance : float
        Largest distance of the smoothed stamps from the grid, beyond half a sample, before a sample
        is skipped [samples].
    max_gap : float
        A longer step ahead is taken as a step of the clock [s].
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
        raise TimeError(NO_STAMPS.format(where=where))
    runs.append(state[kernel.OPEN_RUN][None])
    return make_placement(int(state[kernel.FIRST]), runs, events)

"""Place rows by their count, for stamps that are times of arrival or shared by many rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gyrostab.ingest.grid.place import Placement, make_placement
from gyrostab.ingest.grid.rate import RateEstimate
from gyrostab.ingest.grid.starting_period import Stamps
from gyrostab.kernels.grid.stamps import NO_STAMP, RESTART, STEP
from gyrostab.time.grid import period_ns

__all__ = ["place_by_count"]


@dataclass
class _Windows:
    """Lead of the stamps over the row count in windows of equal length [samples]."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    reach: NDArray[np.float64]
    up: NDArray[np.int64]
    down: NDArray[np.int64]


def _make_windows(stamps: Stamps, period: float, width: int) -> tuple[_Windows, int]:
    """Make windows of `width` rows; also return the first stamp [ns]."""
    parts: list[tuple[NDArray[np.float64], ...]] = []
    rest = np.empty(0, dtype=np.int64)
    first: int | None = None
    last: list[float] = []  # lead at the end of the previous window
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
    """Find lasting shifts of the lower envelope (row count, size, window, level) and the wander."""
    low = windows.low
    change = np.abs(np.diff(low))
    noise = 1.4826 * float(np.median(change)) if len(change) else 0.0
    least = max(6 * noise, float(np.median(windows.reach)), 3.0)
    found: list[tuple[int, float, int, float]] = []
    level, placed, wander, b = float(low[0]), float(low[0]), 0.0, 1
    while b < len(low):
        after = low[b : b + 3]
        size = float(np.median(after)) - level
        if (
            abs(size) > least
            and abs(low[b] - level) > least
            and (after - level > least).all() | (after - level < -least).all()
        ):
            # a loss late in a window does not change the lowest point of that window
            rows = (windows.up if size > 0 else windows.down)[b - 1 : b + 1]
            tops = windows.high[b - 1] - level if size > 0 else level - low[b - 1]
            row = int(rows[0]) if size > 0 and tops > 0.7 * size else int(rows[-1])
            found.append((row, size, b, level))
            level = float(np.median(after))
            placed += level - found[-1][3]
            b += 1
            continue
        level += 0.2 * (float(low[b]) - level)
        wander = max(wander, abs(level - placed))
        b += 1
    return found, wander


def place_by_count(
    stamps: Stamps, estimate: RateEstimate, rate: float, *, max_gap: float
) -> Placement:
    """Place rows by their count, for stamps that are times of arrival; a lasting delay is a loss.

    Parameters
    ----------
    stamps : callable
        Returns an iterator over blocks of (row numbers, stamps [ns]).
    estimate : RateEstimate
        Sampling rate and kind of the stamps.
    rate : float
        Sampling rate [Hz].
    max_gap : float
        A longer loss is taken as a step of the clock [s].
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
    for row, size, _window, level in jumps:
        extra = int(np.rint(size))
        before = first + int((row - 1 + level) * period)
        if size < 0 or size > max_gap * rate:
            back = -size
            elapsed = row + level - begun
            cause = (
                RESTART
                if size < 0 and (2 * back > elapsed or row + level + size < 0.1 * elapsed)
                else STEP
            )
            events.append((cause, row + shifts[-1], row, before, before + int((size + 1) * period)))
            extra, begun = 1, row + level + size
        shifts.append(shifts[-1] + extra)
        cuts.append(row)
    runs = _counted_runs(stamps, np.array(cuts), np.array(shifts))
    numbers = np.array(events, dtype=np.int64).reshape(-1, 5)
    if len(numbers):
        numbers[:, 2] = _rows_at(stamps, numbers[:, 2])
    return make_placement(start, runs, [numbers], wander)


def _rows_at(stamps: Stamps, counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the row numbers of the rows with the given counts."""
    found, done = counts.copy(), 0
    for rows, _ in stamps():
        here = (counts >= done) & (counts < done + len(rows))
        found[here] = rows[counts[here] - done]
        done += len(rows)
    return found


def _counted_runs(
    stamps: Stamps, cuts: NDArray[np.int64], shifts: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """Make runs of rows by count; from count ``cuts[i]`` on, sample = count + ``shifts[i]``."""
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

"""Convert rows to samples: lazy arrays on the grid, NaN where no row was placed."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.ingest.columns.stamps import read_stamps
from gyrostab.ingest.concat.lazy import place_in_memory, place_on_grid
from gyrostab.ingest.grid.place import Placement
from gyrostab.ingest.grid.scan_pass import BLOCK_ROWS
from gyrostab.kernels.grid.stamps import NO_STAMP, RESTART, STEP
from gyrostab.store.lazy import read_slice
from gyrostab.time.grid import grid_times

#: Largest array that is held in memory instead of being computed when needed [numbers].
MAX_PLAIN_NUMBERS = 2_000_000


def _scale_samples(out: NDArray[np.float64], *, scale: float, unit: float | None) -> None:
    """Scale samples in place, and set infinite ones to NaN."""
    out[np.isinf(out)] = np.nan
    if scale != 1.0:
        out[...] = out * scale if unit is None else np.rint(out / unit) * (unit * scale)


def rows_on_grid(
    rows: Any, placement: Placement, *, chunk: int, scale: float = 1.0, unit: float | None = None
) -> Any:
    """Convert an array by row to an array by sample, float64, NaN where missing or infinite.

    If the values are whole multiples of `unit`, the result has exact whole multiples of ``unit *
    scale``. A small result is a numpy array; chunks of others without any sample take no memory
    until they are computed.
    """
    size, lead, runs = placement.size, rows.shape[:-1], placement.runs
    convert = partial(_scale_samples, scale=scale, unit=unit)
    if size * max(1, int(np.prod(lead))) <= MAX_PLAIN_NUMBERS:
        out = place_in_memory(np.asarray(rows), runs, size)
        convert(out)
        return out
    placed = [[(rows, row if lead else None, runs)] for row in range(lead[0] if lead else 1)]
    return place_on_grid(placed, size, chunk, flat=not lead, convert=convert)


def samples_of(placement: Placement, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the sample of each row, -1 where the row was not placed."""
    runs = placement.runs[np.argsort(placement.runs[:, 1], kind="stable")]
    which = np.searchsorted(runs[:, 1], rows, side="right") - 1
    inside = (which >= 0) & (rows < runs[which, 1] + runs[which, 2])
    return np.where(inside, runs[which, 0] + rows - runs[which, 1], -1)


def count_placed(channel: Any, placement: Placement) -> int:
    """Count the rows with a sample in which a channel has a value."""
    count = 0
    for begin in range(0, channel.shape[0], BLOCK_ROWS):
        end = min(begin + BLOCK_ROWS, channel.shape[0])
        rows = np.flatnonzero(np.isfinite(read_slice(channel, begin, end))) + begin
        count += int(np.count_nonzero(samples_of(placement, rows) >= 0))
    return count


def gather_channel(
    raw: xr.Dataset, name: str, placement: Placement, rate: float
) -> tuple[NDArray[np.datetime64], NDArray[np.float64]]:
    """Return stamps and values of the filled rows of a slow channel."""
    channel = raw[name].data
    breaks = placement.events[np.isin(placement.events[:, 0], (STEP, RESTART))]
    breaks = breaks[np.argsort(breaks[:, 2], kind="stable")]
    moved = np.concatenate(
        [[0], grid_times(placement.start, rate, breaks[:, 1] + 1) - breaks[:, 4]]
    )
    stamps, values = [], []
    for begin in range(0, channel.shape[0], BLOCK_ROWS):
        end = min(begin + BLOCK_ROWS, channel.shape[0])
        block = read_slice(channel, begin, end).astype(np.float64, copy=False)
        rows = np.flatnonzero(np.isfinite(block))
        sample = samples_of(placement, rows + begin)
        has_time = sample >= 0
        when = grid_times(placement.start, rate, sample)
        if "time" in raw.variables and not has_time.all():
            written = read_stamps(raw, begin, end)[rows]
            moved_stamps = (
                written + moved[np.searchsorted(breaks[:, 2], rows + begin, side="right")]
            )
            when = np.where(has_time, when, moved_stamps)
            has_time |= written != NO_STAMP
        stamps.append(when[has_time])
        values.append(block[rows][has_time])
    time, first = np.unique(np.concatenate(stamps), return_index=True)
    return time.view("datetime64[ns]"), np.concatenate(values)[first]

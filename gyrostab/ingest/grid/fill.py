"""Convert rows to samples: lazy arrays on the grid, NaN where no row was placed."""

from __future__ import annotations

from functools import partial
from typing import Any

import dask.array as da
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.ingest.grid.place import Placement
from gyrostab.ingest.grid.scan_pass import BLOCK_ROWS
from gyrostab.kernels.grid.stamps import NO_STAMP, RESTART, STEP
from gyrostab.store.lazy_slices import (
    can_read_into,
    make_lazy,
    read_into,
    read_slice,
    with_row_reader,
)
from gyrostab.store.threads import map_in_order
from gyrostab.time.grid import grid_times

__all__ = ["MAX_PLAIN_NUMBERS", "count_present", "gather_channel", "rows_on_grid", "samples_of"]

#: Largest array that is held in memory instead of being computed when needed [numbers].
MAX_PLAIN_NUMBERS = 2_000_000


def _rows_to_samples(
    rows: NDArray[Any],
    *,
    runs: NDArray[np.int64],
    size: int,
    scale: float,
    unit: float | None = None,
) -> NDArray[np.float64]:
    """Place rows (last dimension) on samples; `runs` count both from 0."""
    out = np.full((*rows.shape[:-1], size), np.nan)
    for sample, row, length in runs:
        out[..., sample : sample + length] = rows[..., row : row + length]
    return _scale_samples(out, scale, unit)


def _scale_samples(
    out: NDArray[np.float64], scale: float, unit: float | None
) -> NDArray[np.float64]:
    """Scale samples in place, and set infinite ones to NaN."""
    out[np.isinf(out)] = np.nan
    if scale != 1.0:
        out[...] = out * scale if unit is None else np.rint(out / unit) * (unit * scale)
    return out


def _read_samples_into(
    rows: Any, runs: NDArray[np.int64], ends: NDArray[np.int64], scale: float, unit: float | None,
    row: int, begin: int, out: NDArray[np.float64],
) -> None:  # fmt: skip
    """Read samples of one axis from `begin` on into `out`, as `_rows_to_samples` does."""
    done = 0
    for sample, first, length in _clip_runs(runs, ends, begin, begin + out.size).tolist():
        out[done:sample] = np.nan
        done = sample + length
        read_into(rows, row, first, out[sample:done])
    out[done:] = np.nan
    _scale_samples(out, scale, unit)


def _clip_runs(
    runs: NDArray[np.int64], ends: NDArray[np.int64], begin: int, end: int
) -> NDArray[np.int64]:
    """Clip the runs to the samples from `begin` to `end`."""
    part = runs[
        np.searchsorted(ends, begin, side="right") : np.searchsorted(runs[:, 0], end, side="left")
    ]
    first = np.maximum(part[:, 0], begin)
    last = np.minimum(part[:, 0] + part[:, 2], end)
    return np.stack([first - begin, part[:, 1] + first - part[:, 0], last - first], axis=1)


def rows_on_grid(
    rows: Any, placement: Placement, *, chunk: int, scale: float = 1.0, unit: float | None = None
) -> Any:
    """Convert an array by row to an array by sample, float64, NaN where missing or infinite.

    Parameters
    ----------
    rows : array, shape (..., n_rows)
        numpy, memmap or dask.
    placement : Placement
    chunk : int
        Samples of a chunk of the result.
    scale : float
        Factor on the values.
    unit : float, optional
        Unit of which the values are whole multiples; the result has exact whole multiples of
        ``unit * scale``.

    Returns
    -------
    ndarray or dask.array.Array, shape (..., n_samples)
        A numpy array if the result is small; chunks without any sample take no memory until they
        are computed.
    """
    size, lead = placement.size, rows.shape[:-1]
    if size * max(1, int(np.prod(lead))) <= MAX_PLAIN_NUMBERS:
        return _rows_to_samples(
            np.asarray(rows), runs=placement.runs, size=size, scale=scale, unit=unit
        )
    lazy = rows if isinstance(rows, da.Array) else make_lazy(np.asarray(rows), BLOCK_ROWS)
    ends = placement.runs[:, 0] + placement.runs[:, 2]
    parts, empty = [], 0
    filled: list[tuple[int, int]] = []  # chunks with at least one sample

    def flush() -> None:
        nonlocal empty
        if empty:
            parts.append(da.full((*lead, empty), np.nan, chunks=(*lead, chunk), dtype=np.float64))
        empty = 0

    for begin in range(0, size, chunk):
        end = min(size, begin + chunk)
        runs = _clip_runs(placement.runs, ends, begin, end)
        if len(runs) == 0:
            empty += end - begin
            continue
        flush()
        filled.append((begin, end))
        first, last = int(runs[:, 1].min()), int((runs[:, 1] + runs[:, 2]).max())
        runs[:, 1] -= first
        source = lazy[..., first:last].rechunk(-1)
        shape = (*((n,) for n in lead), (end - begin,))
        parts.append(
            source.map_blocks(
                _rows_to_samples,
                runs=runs,
                size=end - begin,
                scale=scale,
                unit=unit,
                dtype=np.float64,
                chunks=shape,
            )
        )
    flush()
    placed = da.concatenate(parts, axis=-1)
    placed.gyrostab_filled = filled
    if not can_read_into(lazy) or lazy.dtype != np.float64:
        return placed
    return with_row_reader(
        placed, partial(_read_samples_into, lazy, placement.runs, ends, scale, unit)
    )


def count_present(array: Any) -> int:
    """Count the samples of an array on the grid that are not NaN, without chunks in gaps.

    Examples
    --------
    >>> count_present(np.array([[1.0, np.nan, 2.0]]))
    2
    """
    filled = getattr(
        array,
        "gyrostab_filled",
        [(begin, begin + BLOCK_ROWS) for begin in range(0, array.shape[-1], BLOCK_ROWS)],
    )

    def count(ends: tuple[int, int]) -> int:
        return int(np.count_nonzero(~np.isnan(read_slice(array, *ends))))

    return sum(map_in_order(count, ((begin, min(end, array.shape[-1])) for begin, end in filled)))


def samples_of(placement: Placement, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the sample of each row, -1 where the row was not placed."""
    runs = placement.runs[np.argsort(placement.runs[:, 1], kind="stable")]
    which = np.searchsorted(runs[:, 1], rows, side="right") - 1
    inside = (which >= 0) & (rows < runs[which, 1] + runs[which, 2])
    return np.where(inside, runs[which, 0] + rows - runs[which, 1], -1)


def gather_channel(
    raw: xr.Dataset, name: str, placement: Placement, rate: float
) -> tuple[NDArray[np.datetime64], NDArray[np.float64]]:
    """Return stamps and values of the filled rows of a slow channel."""
    channel = raw[name].data
    clock = raw["time"].data if "time" in raw.variables else None
    breaks = placement.events[np.isin(placement.events[:, 0], (STEP, RESTART))]
    breaks = breaks[np.argsort(breaks[:, 2], kind="stable")]
    moved = np.concatenate(
        [[0], grid_times(placement.start, rate, breaks[:, 1] + 1) - breaks[:, 4]]
    )
    stamps, values = [], []
    for begin in range(0, channel.shape[0], BLOCK_ROWS):
        block = read_slice(channel, begin, min(begin + BLOCK_ROWS, channel.shape[0])).astype(
            np.float64, copy=False
        )
        rows = np.flatnonzero(np.isfinite(block))
        sample = samples_of(placement, rows + begin)
        known = sample >= 0
        when = grid_times(placement.start, rate, sample)
        if clock is not None and not known.all():
            written = (
                read_slice(clock, begin, min(begin + BLOCK_ROWS, channel.shape[0]))
                .astype("datetime64[ns]")
                .view(np.int64)[rows]
            )
            own = written + moved[np.searchsorted(breaks[:, 2], rows + begin, side="right")]
            when = np.where(known, when, own)
            known |= written != NO_STAMP
        stamps.append(when[known])
        values.append(block[rows][known])
    time, first = np.unique(np.concatenate(stamps), return_index=True)
    return time.view("datetime64[ns]"), np.concatenate(values)[first]

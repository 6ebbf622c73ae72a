"""Place the samples of a log on another range of the grid, NaN where missing."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.ingest.concat.lazy import chunk_of, place_on_grid
from gyrostab.schema import texts
from gyrostab.store.lazy_slices import make_lazy
from gyrostab.time.grid import time_coordinate

__all__ = ["place_samples"]

Runs = NDArray[np.int64]

#: Largest variable that stays in memory after placing [numbers]; 16 MB.
SMALL_SIZE = 2**21
#: Chunk length of variables that were in memory [samples].
CHUNK_SAMPLES = 2**20


def place_samples(log: xr.Dataset, runs: Runs, start: int, rate: float, size: int) -> xr.Dataset:
    """Place the samples of a log on a grid, NaN where missing; lazy variables stay lazy.

    Parameters
    ----------
    log : xarray.Dataset
        Log whose variables along ``time`` are placed; others stay.
    runs : ndarray of int64, shape (n, 3)
        First sample of the grid, first sample of the log, length.
    start, rate, size : int, float, int
        First stamp [ns since 1970], sampling rate [Hz] and samples of the grid.

    Returns
    -------
    xarray.Dataset
        Log with a computed time axis. Variables without numbers are left out, with a note.
    """
    moved = {name: variable for name, variable in log.variables.items() if "time" in variable.dims}
    placed, left_out = {}, []
    for name, variable in moved.items():
        if name not in log.data_vars:
            continue
        if variable.dtype.kind not in "biuf" or variable.ndim > 2:
            left_out.append(str(name))
            continue
        turned = variable.transpose(..., "time")
        array = _place_array(turned.data, runs, size)
        placed[name] = xr.Variable(turned.dims, array, variable.attrs, variable.encoding).transpose(
            *variable.dims
        )
    whole = (
        log.drop_vars(list(moved)).assign(placed).assign_coords(time_coordinate(start, rate, size))
    )
    whole = whole[[name for name in log.data_vars if name in whole.data_vars]]
    whole.set_close(log._close)
    if left_out:
        note = f"left out, as missing samples of it could not be marked: {', '.join(left_out)}"
        whole = whole.assign_attrs(notes=[*texts(log, "notes"), note])
    return whole


def _place_array(array: Any, runs: Runs, size: int) -> Any:
    lead = int(np.prod(array.shape[:-1], dtype=np.int64))
    if isinstance(array, np.ndarray) and size * lead <= max(SMALL_SIZE, 2 * array.size):
        out = np.full((*array.shape[:-1], size), np.nan)
        length = runs[:, 2]
        within = np.arange(int(length.sum())) - np.repeat(np.cumsum(length) - length, length)
        out[..., np.repeat(runs[:, 0], length) + within] = array[
            ..., np.repeat(runs[:, 1], length) + within
        ]
        return out
    lazy = make_lazy(array, CHUNK_SAMPLES) if isinstance(array, np.ndarray) else array
    rows = (
        [[(lazy, None, runs)]]
        if array.ndim == 1
        else [[(lazy, row, runs)] for row in range(array.shape[0])]
    )
    return place_on_grid(rows, size, chunk_of([lazy]), flat=array.ndim == 1)

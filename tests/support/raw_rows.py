"""Raw logs with stamps of known samples, for the tests of the regular time axis."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import ArrayLike

from gyrostab import regularise
from gyrostab.arrays import Floats, Ints
from gyrostab.ingest.grid import scan_pass

START = 1_773_226_800_000_000_000  # 2026-03-11T11:00:00


def raw_log(
    stamps: Any,
    values: Any = None,
    *,
    kind: str = "rate",
    name: str = "tool.csv",
    **channels: ArrayLike,
) -> xr.Dataset:
    """Make a raw log; `stamps` [ns] or None without time; values by row, or axis and row."""
    n = len(stamps) if stamps is not None else np.shape(values)[-1]
    values = np.atleast_2d(np.arange(1.0, n + 1) if values is None else values)
    signal = "rate" if kind == "rate" else "angle"
    units = "degree hour-1" if kind == "rate" else "degree"
    data: dict[str, Any] = {signal: (("axis", "row"), values, {"units": units})}
    data |= {
        key: ("row", np.asarray(column), {"units": "degree_Celsius"})
        for key, column in channels.items()
    }
    coords: dict[str, Any] = {"axis": list("xyz"[: len(values)])}
    if stamps is not None:
        coords["time"] = ("row", np.asarray(stamps, dtype=np.int64).view("datetime64[ns]"))
    return xr.Dataset(
        data, coords, {"kind": kind, "source_files": [name], "row_start": [0], "notes": ["read"]}
    )


def stamps_of(samples: ArrayLike, rate: float) -> Ints:
    """Return the stamps of samples [ns], from the start on."""
    return START + np.rint(np.asarray(samples) * (1e9 / rate)).astype(np.int64)


def expected(samples: ArrayLike) -> Floats:
    """Return the signal on the grid if row i has sample ``samples[i]``, negative if dropped."""
    of = np.asarray(samples)
    out = np.full(of.max() + 1, np.nan)
    out[of[of >= 0]] = np.flatnonzero(of >= 0) + 1.0
    return out


def regularise_in_parts(
    raw: xr.Dataset, *, block: int = scan_pass.BLOCK_ROWS, chunk: int | None = None, **options: Any
) -> xr.Dataset:
    """Regularise with other numbers of rows in memory and of samples in a chunk."""
    module = sys.modules["gyrostab.ingest.grid.regularise"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scan_pass, "BLOCK_ROWS", block)
        if chunk is not None:
            patch.setattr(module, "chunk_samples", lambda rate: chunk)
        return regularise(raw, **options)

"""Logs of a run: files in any format, read and put on a uniform time axis."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from gyrostab.jobs.job import format_option


def load_log(
    paths: Sequence[str | Path],
    *,
    max_gap: str = "10D",
    time_from: Any = None,
    time_to: Any = None,
    exclude: Sequence[Any] = (),
    **reading: Any,
) -> xr.Dataset:
    """Read logs in any format and put them on a uniform time axis.

    Parameters
    ----------
    paths : sequence of path
        Files, in any order; NetCDF and Zarr logs that gyrostab wrote are concatenated without
        loading them.
    max_gap : str
        Longest gap; a larger step of the stamps is treated as a step of the clock.
    time_from, time_to : str, datetime or duration, optional
        First time to use, and the time up to which (exclusive): dates and times (ISO 8601, UTC), or
        durations after the start of the log.
    exclude : sequence of str or pairs
        Spans ``"START/END"`` whose samples are treated as missing; see
        `gyrostab.ingest.uniform.cut_log`.
    **reading
        Options of `gyrostab.ingest.read_log`: ``rate``, ``start``, ``epoch``, ``map``, ``unit``,
        ``kind``, ``channel``, ``strict``, ``limits``, ``on_file``, ``read``.

    Returns
    -------
    xarray.Dataset
        Log of `gyrostab.schema`.
    """
    from gyrostab.ingest import read_log
    from gyrostab.ingest.grid.notes import describe_channels
    from gyrostab.ingest.grid.regularise import regularise
    from gyrostab.ingest.uniform import cut_log

    log = read_log(paths, max_gap=max_gap, **reading)
    if "sampling_rate_hz" not in log.attrs:
        log = regularise(
            log, rate=reading.get("rate"), max_gap=max_gap, limits=reading.get("limits")
        )
        options = "; ".join(
            f"{name}: {format_option(value)}"
            for name, value in reading.items()
            if value and name not in ("on_file", "read")
        )
        if options:
            log.attrs["history"] += f" (read with {options})"
    elif reading.get("channel"):
        log = log.assign_attrs(notes=[*log.attrs.get("notes", []), *describe_channels(log)])
    log = cut_log(log, time_from=time_from, time_to=time_to, exclude=exclude)
    for note in log.attrs.get("notes", []):
        warnings.warn(note, stacklevel=2)
    return log


def count_samples(log: xr.Dataset) -> int:
    """Count the samples of a log over all its axes."""
    return int(log.sizes["axis"] * log.sizes["time"])

"""Regularise raw logs whose axes have separate stamps, and combine them on one grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import xarray as xr

from gyrostab.ingest.concat import concatenate_logs, split_axes
from gyrostab.schema import texts
from gyrostab.time.grid import first_stamp
from gyrostab.wording import list_some


def regularise_axes(
    raw: xr.Dataset,
    regularise: Callable[[xr.Dataset], xr.Dataset],
    *,
    max_gap: str | float,
    limits: Mapping[str, float] | None,
) -> xr.Dataset:
    """Regularise each group of axes separately, and place the samples on the grid of the first.

    Parameters
    ----------
    raw : xarray.Dataset
        Raw log with the attribute ``axis_rows``: lists of axes, first row, row after the last.
    """
    parts = [part.assign_attrs(notes=[]) for part in split_axes(raw)]
    logs = [regularise(part) for part in parts]
    labels = [list_some(texts(part, "source_files")) for part in parts]
    if len(set(labels)) < len(labels):
        labels = [
            f"{label} ({', '.join(axes)})"
            for label, (axes, _, _) in zip(labels, raw.attrs["axis_rows"], strict=True)
        ]
    log = concatenate_logs(logs, labels, max_gap=max_gap, limits=limits)
    starts = [first_stamp(log) for log in logs]
    members = []
    for label, start, (axes, _, _) in zip(labels, starts, raw.attrs["axis_rows"], strict=True):
        later = (start - min(starts)) / 1e9 * log.attrs["sampling_rate_hz"]
        members.append(
            f"{', '.join(axes)} in {label}"
            + (f" (begins {later:.3g} samples later)" if start > min(starts) else "")
        )
    note = (
        f"the axes have separate stamps over the same time and form one log: {'; '.join(members)}"
    )
    return log.assign_attrs(notes=[*texts(raw, "notes"), *texts(log, "notes"), note])

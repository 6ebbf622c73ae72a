"""Regularise raw rows: uniform time, NaN at every missing sample, a table of gaps.

No value is ever interpolated, averaged or moved by a fraction of a sample: a sample is a row of the
file, bit for bit, or NaN. Only cumulative angles that begin again get whole turns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.arrays import Floats, Ints
from gyrostab.ingest.columns.stamps import read_stamps
from gyrostab.ingest.concat.core import concatenate_logs
from gyrostab.ingest.concat.grid import split_axes
from gyrostab.ingest.concat.lazy import place_array
from gyrostab.ingest.gap_table import (
    CAUSE,
    CLOCK_STEP,
    END,
    FIRST,
    MISSING,
    RESTART,
    SAMPLES,
    make_dataset,
    name_lost,
    sort_gaps,
)
from gyrostab.ingest.grid.angles import continue_angles, differentiate_angles
from gyrostab.ingest.grid.gaps import find_gaps
from gyrostab.ingest.grid.notes import describe_angles, describe_channels, describe_placement
from gyrostab.ingest.grid.place import Placement, check_grid
from gyrostab.ingest.grid.place_rows import RowPlacer
from gyrostab.ingest.grid.scan_pass import BLOCK_ROWS, ScanPass, file_of, record_name, scan_rows
from gyrostab.ingest.limits import check_limits
from gyrostab.ingest.uniform import as_uniform, check_same_rate
from gyrostab.kernels.grid.stamps import EVENT_ROW, EVENT_SAMPLE, EVENT_STAMP, NO_STAMP
from gyrostab.schema import SIGNAL_UNITS, check_raw, signal_name, texts
from gyrostab.store.lazy import read_slice
from gyrostab.store.write import chunk_samples
from gyrostab.time.durations import duration_seconds
from gyrostab.time.grid import check_rate, check_span, first_stamp, grid_times
from gyrostab.time.stamps import extend_history, format_stamp
from gyrostab.units import HOUR
from gyrostab.wording import list_some

# Share of the values of a channel that may be lost with rows that have no sample.
_MAX_UNPLACED_SHARE = 0.1
#: Largest array that is held in memory instead of being computed when needed [numbers].
MAX_PLAIN_NUMBERS = 2_000_000
_OWN_ATTRIBUTES = (
    "declared_rate_hz",
    "start",
    "local_time",
    "clock_zero",
    "row_start",
    "kind",
    "notes",
    "history",
    "unreadable_spans",
)


def _is_on_grid(channel: Any, n_filled: int, scanned: ScanPass, placement: Placement) -> bool:
    """Whether a channel has values for most samples, and few in rows without a gyro value."""
    if n_filled <= 0.5 * scanned.present_count:
        return False
    if scanned.absent_count <= _MAX_UNPLACED_SHARE * n_filled:
        return True  # without reading the channel
    dropped = max(0, scanned.present_count - placement.placed_count)  # they lose their channels too
    placed = 0
    for begin in range(0, channel.shape[0], BLOCK_ROWS):
        block = read_slice(channel, begin, min(begin + BLOCK_ROWS, channel.shape[0]))
        rows = np.flatnonzero(np.isfinite(block)) + begin
        placed += int(np.count_nonzero(placement.samples_of(rows) >= 0))
    return n_filled - placed - dropped <= _MAX_UNPLACED_SHARE * n_filled


def _place_channels(
    raw: xr.Dataset, scanned: ScanPass, placement: Placement, chunk: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the channels on the grid, and time coordinates of slow channels."""
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {}
    for name, rows in scanned.filled_counts.items():
        channel = raw[name]
        if _is_on_grid(channel.data, rows, scanned, placement):
            variables[name] = (
                "time",
                rows_on_grid(channel.data, placement, chunk=chunk),
                channel.attrs,
                channel.encoding,
            )
        elif rows:
            time, values = gather_channel(raw, name, placement)
            variables[name] = (f"time_{name}", values, channel.attrs, channel.encoding)
            coordinates[f"time_{name}"] = time
    for key, variable in raw.data_vars.items():
        if variable.dims == (f"time_{key}",):
            variables[str(key)] = (variable.dims, variable.data, variable.attrs)
            coordinates[f"time_{key}"] = raw[f"time_{key}"].variable
    return variables, coordinates


def _log_attributes(
    raw: xr.Dataset, kind: str, rate: float, done: str, notes: list[str]
) -> dict[str, Any]:
    attributes = {key: value for key, value in raw.attrs.items() if key not in _OWN_ATTRIBUTES}
    return {
        "source_files": [],
        **attributes,
        "kind": kind,
        "sampling_rate_hz": rate,
        "history": extend_history(raw, f"gyrostab.regularise: {done}"),
        "notes": [*texts(raw, "notes"), *notes],
    }


def _has_unknown_turns(table: Ints, known_steps: float) -> bool:
    """Return whether a gap is longer than the steps over which the turns of angles are known."""
    lengths = np.where(
        np.isin(table[:, CAUSE], (CLOCK_STEP, RESTART)), np.inf, table[:, END] - table[:, FIRST]
    )
    return bool(lengths.max(initial=0.0) + 1 > known_steps)


def _end_gaps_later(table: Ints, size: int) -> Ints:
    """Return a table of gaps of steps since the sample before, which the first sample lacks."""
    later = np.concatenate([[[0, 0, 0, 0, MISSING]], table])
    is_gap = later[:, END] > later[:, FIRST]
    is_gap[0] = True
    later[is_gap, END] = np.minimum(later[is_gap, END] + 1, size)
    later[is_gap, SAMPLES] = (later[:, END] - later[:, FIRST])[is_gap]
    return later


def _drop_empty_channels(parts: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Drop the channels on ``row`` of each part that hold no number there, but do in another."""
    filled_names = [
        {
            key
            for key, variable in part.data_vars.items()
            if variable.dims == ("row",)
            and any(
                np.isfinite(read_slice(variable.data, begin, begin + BLOCK_ROWS)).any()
                for begin in range(0, part.sizes["row"], BLOCK_ROWS)
            )
        }
        for part in parts
    ]
    known_names = set().union(*filled_names)
    return [
        part.drop_vars((known_names - names) & set(part.data_vars))
        for part, names in zip(parts, filled_names, strict=True)
    ]


def _describe_axes(
    axis_rows: Sequence[Any], parts: Sequence[xr.Dataset], logs: Sequence[xr.Dataset]
) -> tuple[list[str], str]:
    """Return labels of logs of groups of axes with separate stamps, and a note on these."""
    labels = [list_some(texts(part, "source_files")) for part in parts]
    names = [", ".join(axes) for axes, _, _ in axis_rows]
    if len(set(labels)) < len(labels):
        labels = [f"{label} ({axes})" for label, axes in zip(labels, names, strict=True)]
    starts = [first_stamp(log) for log in logs]
    rate = logs[starts.index(min(starts))].attrs["sampling_rate_hz"]
    members = [
        f"{axes} in {label}"
        + f" (begins {(start - min(starts)) / 1e9 * rate:.3g} samples later)"
        * (start > min(starts))
        for axes, label, start in zip(names, labels, starts, strict=True)
    ]
    return labels, (
        f"the axes have separate stamps over the same time and form one log: {'; '.join(members)}"
    )


def regularise(
    raw: xr.Dataset,
    *,
    rate: float | None = None,
    max_gap: str | float = "10D",
    limits: Mapping[str, float] | None = None,
) -> xr.Dataset:
    """Place the rows of a raw log on a uniform time axis, NaN where missing, with a table of gaps.

    Parameters
    ----------
    raw : xarray.Dataset
        From `gyrostab.read_log`: ``rate(axis, row)`` [degree hour-1] or ``angle(axis, row)``
        [degree], ``time(row)``, channels. A regular log is returned as it is, or brought back onto
        its uniform time by `gyrostab.ingest.uniform.as_uniform`.
    rate : float, optional
        Sampling rate [Hz]; estimated from the stamps by default, and checked against them if given.
    max_gap : str or float
        A longer step of the stamps ahead is taken as a step of the clock, not as a gap; a number
        is in seconds.
    limits : mapping of str to float, optional
        Limits of `gyrostab.ingest.limits` with other values; ``grid_samples`` bounds the samples of
        an axis.

    Returns
    -------
    xarray.Dataset
        ``rate(axis, time)`` [degree hour-1] or ``angle(axis, time)`` [degree], channels,
        ``gap_start``, ``gap_end``, ``gap_samples``, ``gap_rows``, ``gap_cause`` on ``gap``;
        attributes ``sampling_rate_hz``, ``kind``, ``source_files``, ``history``, ``notes``.

    Raises
    ------
    TimeError
        When no sampling rate can be found, the given rate differs by more than 2 % from that of the
        stamps, or the grid has far more samples than rows.
    FormatError
        When no row holds a number.
    OptionError, SchemaError
        For invalid options or datasets.

    Notes
    -----
    Angle increments (kind "increment") become the mean rate over their sampling interval, increment
    times sampling rate. The steps of cumulative angles that wrap around become rates too, if a gap
    may hold more than half a turn.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.array([0, 10, 20, 50, 60], dtype="datetime64[ms]").astype("datetime64[ns]")
    >>> values = ("axis", "row"), np.array([[1.0, 2.0, 3.0, 6.0, 7.0]]), {"units": "degree hour-1"}
    >>> log = regularise(xr.Dataset({"rate": values}, {"axis": ["z"], "time": ("row", time)}))
    >>> log.rate.values
    array([[ 1.,  2.,  3., nan, nan,  6.,  7.]])
    >>> log.attrs["sampling_rate_hz"]
    100.0
    """
    if rate is not None:
        check_rate(rate, "rate")
    longest_gap, limits = duration_seconds(max_gap, "max_gap"), check_limits(limits)
    is_log = isinstance(raw, xr.Dataset) and "row" not in raw.dims
    if is_log and "sampling_rate_hz" in raw.attrs:
        log = as_uniform(raw)
        if rate is not None:
            check_same_rate(log, rate, ", ".join(texts(log, "source_files")) or "this")
        return log
    check_raw(raw)
    if "axis_rows" in raw.attrs:
        options: dict[str, Any] = {"max_gap": longest_gap, "limits": limits}
        parts = [part.assign_attrs(notes=[]) for part in _drop_empty_channels(split_axes(raw))]
        logs = [regularise(part, rate=rate, **options) for part in parts]
        labels, note = _describe_axes(raw.attrs["axis_rows"], parts, logs)
        log = concatenate_logs(logs, labels, **options)
        return log.assign_attrs(notes=[*texts(raw, "notes"), *texts(log, "notes"), note])
    given = rate if rate is not None else raw.attrs.get("declared_rate_hz")
    declared = None if given is None else float(given)
    return _place_log(raw, declared, longest_gap, limits)


def _place_log(
    raw: xr.Dataset, declared: float | None, max_gap: float, limits: Mapping[str, float]
) -> xr.Dataset:
    """Place a raw log whose axes share their stamps; its rate [Hz] is found unless `declared`."""
    name = signal_name(raw)
    turns, known_steps = list[str](), np.inf
    if name == "angle" and raw.attrs.get("kind") == "angle":
        raw, turns, known_steps = continue_angles(raw)
    scanned = scan_rows(raw, name)
    placement, notes = RowPlacer(raw, scanned, declared, max_gap).place()
    check_grid(raw, placement, max_gap, limits)
    start, hertz, size = placement.start, placement.rate, placement.size
    check_span(start, hertz, size, file_of(raw)[0])
    chunk = chunk_samples(hertz)
    lost_spans = raw.attrs.get("unreadable_spans", ())
    table = name_lost(find_gaps(placement, scanned), lost_spans, start, hertz)
    notes += describe_placement(raw, scanned, placement, table)
    if name == "angle":
        notes += [*turns, *describe_angles(raw)]

    is_increment = raw.attrs.get("kind") == "increment"
    kind = "rate" if is_increment else name
    to_rate = hertz * HOUR  # degree a sample to degree an hour
    unit, scale = raw[name].encoding.get("scale_factor"), to_rate if is_increment else 1.0
    data = rows_on_grid(raw[name].data, placement, chunk=chunk, scale=scale, unit=unit)
    packing = {**raw[name].encoding, "scale_factor": unit * scale} if unit else {}
    if _has_unknown_turns(table, known_steps):
        data, packing, kind = differentiate_angles(data, to_rate), {}, "rate"
        table = _end_gaps_later(table, size)
        notes.append(
            f"{record_name(raw)}: an angle wraps around, and how often it does while samples are "
            "missing is not known; so the log holds rates, each the mean since the sample before, "
            "and none directly after missing samples"
        )
    attributes = {**raw[name].attrs, "units": SIGNAL_UNITS[kind]}
    variables, channel_times = _place_channels(raw, scanned, placement, chunk)
    rows = f"{placement.placed_count} of {scanned.row_count} rows"
    done = f"{rows} on {size} samples at {hertz:.10g} Hz"
    log = make_dataset(
        {kind: (("axis", "time"), data, attributes, packing), **variables},
        {"axis": raw["axis"].variable, **channel_times},
        sort_gaps(table),
        (start, hertz, size),
        _log_attributes(raw, kind, hertz, done, notes),
    )
    if placement.rate_changes:
        log.attrs["rate_changes"] = list(map(format_stamp, placement.rate_changes))
    return log.assign_attrs(notes=[*log.attrs["notes"], *describe_channels(log)])


def _scale_samples(out: Floats, *, scale: float, unit: float | None) -> None:
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
    return place_array(
        rows,
        placement.runs,
        placement.size,
        chunk,
        most_in_memory=MAX_PLAIN_NUMBERS,
        convert=partial(_scale_samples, scale=scale, unit=unit),
    )


def gather_channel(
    raw: xr.Dataset, name: str, placement: Placement
) -> tuple[NDArray[np.datetime64], Floats]:
    """Return stamps and values of the filled rows of a slow channel."""
    channel = raw[name].data
    breaks = placement.breaks
    breaks = breaks[np.argsort(breaks[:, EVENT_ROW], kind="stable")]
    grid_stamps = grid_times(placement.start, placement.rate, breaks[:, EVENT_SAMPLE] + 1)
    moved = np.concatenate([[0], grid_stamps - breaks[:, EVENT_STAMP]])
    stamps, values = [], []
    for begin in range(0, channel.shape[0], BLOCK_ROWS):
        end = min(begin + BLOCK_ROWS, channel.shape[0])
        block = read_slice(channel, begin, end).astype(np.float64, copy=False)
        rows = np.flatnonzero(np.isfinite(block))
        sample = placement.samples_of(rows + begin)
        has_time = sample >= 0
        when = grid_times(placement.start, placement.rate, sample)
        if "time" in raw.variables and not has_time.all():
            written = read_stamps(raw, begin, end)[rows]
            moved_stamps = (
                written + moved[np.searchsorted(breaks[:, EVENT_ROW], rows + begin, side="right")]
            )
            when = np.where(has_time, when, moved_stamps)
            has_time |= written != NO_STAMP
        stamps.append(when[has_time])
        values.append(block[rows][has_time])
    time, first = np.unique(np.concatenate(stamps), return_index=True)
    return time.view("datetime64[ns]"), np.concatenate(values)[first]

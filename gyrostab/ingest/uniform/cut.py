"""Cut a log to a range of time, and exclude spans."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Ints
from gyrostab.errors import OptionError, SchemaError
from gyrostab.ingest.gap_table import OUTSIDE_RANGE, clip_table, read_gaps
from gyrostab.ingest.uniform.core import add_spans, grid_of, merge_spans, place_samples, with_table
from gyrostab.ingest.uniform.grid import UniformGrid
from gyrostab.schema import check_log
from gyrostab.time.durations import duration_seconds
from gyrostab.time.grid import grid_index, grid_times
from gyrostab.time.stamps import extend_history, stamp_ns, to_nanoseconds

_EXAMPLE = "2026-11-20T14:00 (UTC) or 10min after the start"
_SPAN_EXAMPLE = "2026-11-20T14:00/2026-11-20T14:05 or 10min/15min after the start"

_DATE = re.compile(r"\d{4}-\d|\d{8}(?:$|[T ]\d)")

#: Ends of a span: one text "START/END", or a pair.
Span = str | tuple[Any, Any]


def parse_instant(value: Any, option: str, *, example: str = _EXAMPLE) -> int | float:
    """Parse an instant: a date [ns since 1970, int], or a duration after the start [s, float].

    Dates are ISO 8601 text (UTC unless it says otherwise) or datetimes; durations are such as
    ``"10min"`` or a number of seconds.

    Examples
    --------
    >>> parse_instant("1970-01-01T00:00:02", "--from"), parse_instant("2min", "--from")
    (2000000000, 120.0)
    """
    text = value.strip() if isinstance(value, str) else value
    try:
        is_date = isinstance(text, date | np.datetime64) or (
            isinstance(text, str) and bool(_DATE.match(text))
        )
        if is_date:
            return stamp_ns(text, option)
        if isinstance(text, str) and ":" in text:  # a time of day without a date
            raise OptionError(text)
        return duration_seconds(text, option, example=example, zero=True)
    except OptionError as error:
        raise OptionError(
            f"{option} {value!r} is neither a time nor a duration; write {example}"
        ) from error


def cut_log(
    log: xr.Dataset,
    *,
    time_from: Any = None,
    time_to: Any = None,
    exclude: Span | Sequence[Span] = (),
) -> xr.Dataset:
    """Cut a log to the samples from `time_from` to before `time_to`, without excluded spans.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log, in memory or lazy; lazy variables stay lazy.
    time_from, time_to : str, datetime or duration, optional
        Ends of the kept part: a date and time (ISO 8601, UTC), or a duration after the
        first sample of the log.
    exclude : span or sequence of spans
        Each ``"START/END"`` or a pair of instants as above. The samples from START up to, but not
        including, END become NaN on every axis and in every channel.

    Returns
    -------
    xarray.Dataset
        The part, with its table of gaps. An excluded span is a gap of the cause
        "outside_range".

    Raises
    ------
    OptionError
        When an end cannot be read, lies outside the record, comes before the other end, or nothing
        is left.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> log = make_log([np.arange(10.0)], rate=1.0, unit="deg/h")
    >>> cut_log(log, time_from="2s", time_to="8s", exclude="3s/5s").rate.values
    array([[ 2., nan, nan,  5.,  6.,  7.]])
    """
    spans = _parse_spans(exclude)
    if time_from is None and time_to is None and not spans:
        return log
    check_log(log)
    grid, computed = grid_of(log)
    if not computed:
        raise SchemaError(
            "the time axis of this log is not computed; bring it onto one first, with "
            "gyrostab.ingest.uniform.as_uniform"
        )
    low = 0 if time_from is None else _sample_of(grid, time_from, "--from", last=grid.size - 1)
    high = grid.size if time_to is None else _sample_of(grid, time_to, "--to", last=grid.size)
    if low >= high:
        ends = (("--from", time_from), ("--to", time_to))
        named = " and ".join(f"{option} {end}" for option, end in ends if end is not None)
        raise OptionError(f"{named} leaves no sample of the log; {_describe_record(grid)}")
    given = [_span_of(grid, span, low, high) for span in spans]
    excluded = merge_spans([np.array([span]) for span in given if span[1] > span[0]])
    kept_spans = np.concatenate([[low], excluded.ravel(), [high]]).reshape(-1, 2)
    kept_spans = kept_spans[kept_spans[:, 1] > kept_spans[:, 0]]
    if not len(kept_spans):
        raise OptionError(f"--exclude leaves nothing of the log; {_describe_record(grid)}")
    first, end = kept_spans.T
    runs = np.stack([first - low, first, end - first], axis=1)
    start = int(grid_times(grid.start, grid.rate, low))
    kept_grid = UniformGrid(start, grid.rate, high - low, runs)
    part = _cut_samples(log, kept_grid, low)
    part = _cut_channels(part, grid_times(grid.start, grid.rate, kept_spans.ravel()))
    if "gap" in log.dims or len(excluded):
        part = with_table(part, _cut_table(log, grid, low, kept_spans, excluded), kept_grid)
    options = [
        *([f"from {time_from}"] if time_from is not None else []),
        *([f"to {time_to}"] if time_to is not None else []),
        *(f"without {first}/{end}" for first, end in spans),
    ]
    done = f"gyrostab.cut_log: {', '.join(options)}: {kept_grid.size} samples"
    return part.assign_attrs(history=extend_history(log, done))


def check_cut(
    *, time_from: Any = None, time_to: Any = None, exclude: Span | Sequence[Span] = (), **other: Any
) -> None:
    """Check options of `cut_log` as far as they do not depend on the log; ignore others.

    Examples
    --------
    >>> check_cut(exclude="1min")
    Traceback (most recent call last):
    gyrostab.errors.OptionError: --exclude '1min': write START/END, for instance ...
    """
    for option, value in (("--from", time_from), ("--to", time_to)):
        if value is not None:
            parse_instant(value, option)
    for ends in _parse_spans(exclude):
        for value in ends:
            parse_instant(value, "--exclude", example=_SPAN_EXAMPLE)


def _parse_spans(exclude: Any) -> list[tuple[Any, Any]]:
    """Return the two ends of each excluded span; `exclude` is one or several."""
    is_pair = isinstance(exclude, tuple) and len(exclude) == 2
    is_single = isinstance(exclude, str) or (is_pair and not any("/" in str(e) for e in exclude))
    spans = []
    for span in [exclude] if is_single else exclude:
        ends = [end.strip() for end in span.split("/")] if isinstance(span, str) else list(span)
        if len(ends) != 2 or not all(str(end) for end in ends):
            text = "/".join(map(str, ends))
            raise OptionError(f"--exclude {text!r}: write START/END, for instance {_SPAN_EXAMPLE}")
        spans.append((ends[0], ends[1]))
    return spans


def _describe_record(grid: UniformGrid) -> str:
    """Describe the time range of a log."""
    edges = grid_times(grid.start, grid.rate, [0, grid.size]).view("datetime64[ns]")
    first, end = (str(edge).rstrip("0").rstrip(".") for edge in edges)
    return f"the record goes from {first} to {end} ({grid.size / grid.rate:.6g} s)"


def _sample_of(grid: UniformGrid, value: Any, option: str, *, last: int) -> int:
    """Return the first sample at or after an instant, which must lie in the record."""
    sample = _first_at(grid, value, option)
    if sample < 0 or sample > last:
        raise OptionError(f"{option} {value} lies outside the record; {_describe_record(grid)}")
    return sample


def _first_at(grid: UniformGrid, value: Any, option: str, *, example: str = _EXAMPLE) -> int:
    """Return the first grid sample at or after an instant, even outside the record."""
    stamp = parse_instant(value, option, example=example)
    if isinstance(stamp, float):  # keep it within 64-bit nanoseconds
        stamp = grid.start + round(min(stamp, (grid.size + 1) / grid.rate) * 1e9)
    # rounding may be one too high
    sample = int(np.ceil(grid_index(grid.start, grid.rate, stamp))) - 1
    while int(grid_times(grid.start, grid.rate, sample)) < stamp:
        sample += 1
    return sample


def _span_of(grid: UniformGrid, ends: tuple[Any, Any], low: int, high: int) -> tuple[int, int]:
    """Return the samples of an excluded span within the kept part."""
    text = f"{ends[0]}/{ends[1]}"
    first, end = (_first_at(grid, value, "--exclude", example=_SPAN_EXAMPLE) for value in ends)
    if end < first:
        raise OptionError(
            f"--exclude {text}: its end comes before its start; write START/END, for "
            f"instance {_SPAN_EXAMPLE}"
        )
    if first >= grid.size or end <= 0:
        raise OptionError(f"--exclude {text} lies outside the record; {_describe_record(grid)}")
    return max(first, low), min(end, high)


def _cut_samples(log: xr.Dataset, kept_grid: UniformGrid, low: int) -> xr.Dataset:
    """Return the part of a log on `kept_grid`, which begins at sample `low`; NaN where excluded."""
    lazy = any(
        variable.chunks is not None
        for variable in log.data_vars.values()
        if "time" in variable.dims
    )
    is_contiguous = len(kept_grid.runs) == 1 and kept_grid.runs[0, 2] == kept_grid.size
    if is_contiguous and (kept_grid.size == log.sizes["time"] or not lazy):
        return log.isel(time=slice(low, low + kept_grid.size))
    return place_samples(log, kept_grid)


def _cut_channels(part: xr.Dataset, edges: Ints) -> xr.Dataset:
    """Cut the channels with separate time coordinates to kept spans, whose `edges` are in order."""
    for dim in [dim for dim in part.dims if str(dim).startswith("time_") and dim in part.coords]:
        stamps = to_nanoseconds(part.variables[dim].values)
        keep = np.searchsorted(edges, stamps, side="right") % 2 == 1
        if not keep.all():
            part = part.isel({dim: np.flatnonzero(keep)})
    return part


def _cut_table(
    log: xr.Dataset, grid: UniformGrid, low: int, kept_spans: Ints, excluded: Ints
) -> Ints:
    table = read_gaps(log, grid.start, grid.rate) if "gap" in log.dims else None
    if table is None:
        table = np.empty((0, 5), dtype=np.int64)
    pieces = [clip_table(table, first, end) for first, end in kept_spans.tolist()]
    cut = add_spans(np.concatenate(pieces), excluded, OUTSIDE_RANGE)
    cut[:, :2] -= low
    return cut

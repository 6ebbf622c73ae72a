"""Regularise raw rows: uniform time, NaN at every missing sample, a table of gaps.

No value is ever interpolated, averaged or moved by a fraction of a sample: a sample is a row of the
file, bit for bit, or NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import OptionError, TimeError
from gyrostab.ingest.columns.pieces import PiecewiseColumn
from gyrostab.ingest.gap_table import gap_variables, name_lost, sort_gaps
from gyrostab.ingest.grid.axes import regularise_axes
from gyrostab.ingest.grid.fill import count_placed, gather_channel, rows_on_grid
from gyrostab.ingest.grid.gaps import find_gaps
from gyrostab.ingest.grid.jitter import JitterModel
from gyrostab.ingest.grid.notes import (
    describe_angles,
    describe_channels,
    describe_placement,
    describe_rate,
)
from gyrostab.ingest.grid.place import (
    Placement,
    check_grid,
    place_by_count,
    place_by_stamp,
    place_without_time,
)
from gyrostab.ingest.grid.place_in_order import place_in_order
from gyrostab.ingest.grid.rate import (
    RateEstimate,
    deviating_stretches,
    estimate_near,
    estimate_rate,
    is_far_worse,
)
from gyrostab.ingest.grid.repeats import find_repeats, with_repeats
from gyrostab.ingest.grid.scan_pass import BLOCK_ROWS, ScanPass, file_of, scan_rows, stamp_blocks
from gyrostab.ingest.grid.starting_period import Stamps
from gyrostab.ingest.limits import check_limits
from gyrostab.ingest.uniform import as_uniform, check_same_rate
from gyrostab.schema import SIGNAL_UNITS, check_raw, signal_name, texts
from gyrostab.store.lazy import find_source, read_slice
from gyrostab.store.write import chunk_samples
from gyrostab.time.clock import extend_history
from gyrostab.time.durations import duration_seconds
from gyrostab.time.grid import check_rate, check_span, period_ns, stamp_ns, time_coordinate
from gyrostab.time.stamps import format_stamp
from gyrostab.units import HOUR

_MAX_RATE_DIFFERENCE = 0.02  # relative, between declared and estimated rate
_EVEN_ROWS = 2**18  # rows at the beginning that give the rate of a log with even stamps
# Largest jitter at which stamps give the samples of 99 % of the rows; placing by stamp is then
# tried first [samples].
_SHARP_SIGMA = 0.2
_MIN_DROPPED_ROWS = 10  # rows without a sample for which placing in order is tried
_LATE_SHARE = 0.9  # share of the dropped rows that placing in order must recover
# Share of the values of a channel that may be lost with rows that have no sample.
_MAX_UNPLACED_SHARE = 0.1
_MAX_ROUNDS = 4  # a repetition within another is found after the latter is removed
_OWN_ATTRIBUTES = (
    "declared_rate_hz",
    "start",
    "local_time",
    "row_start",
    "kind",
    "notes",
    "history",
    "unreadable_spans",
)


def _check_options(*, rate: float | None, tolerance: float, chunk: int | None, block: int) -> None:
    if rate is not None:
        check_rate(rate, "rate")
    if not 0 <= tolerance < 0.5:
        raise OptionError(f"tolerance={tolerance!r} must be at least 0 and below 0.5 samples")
    if (chunk is not None and chunk < 1) or block < 64:
        raise OptionError(
            f"chunk={chunk!r} and block={block!r} count samples and rows; give at least 1 and 64"
        )


def _declared_rate(raw: xr.Dataset, rate: float | None) -> float | None:
    value = rate if rate is not None else raw.attrs.get("declared_rate_hz")
    return None if value is None else float(value)


def _start_stamp(raw: xr.Dataset, notes: list[str]) -> int:
    text = raw.attrs.get("start")
    if not text:
        notes.append(
            f"{file_of(raw)[0]}: no time in the file and no --start: the log is said to start at "
            "1970-01-01T00:00:00"
        )
        return 0
    return stamp_ns(text)


def _place_rows(
    raw: xr.Dataset,
    scanned: ScanPass,
    declared: float | None,
    *,
    tolerance: float,
    max_gap: float,
    block: int,
    notes: list[str],
) -> tuple[Placement, float]:
    where = file_of(raw)[0]
    if "time" not in raw.variables:
        if declared is None:
            raise TimeError(
                f"{where}: the file has no time column; give the sampling rate with --rate HZ"
            )
        return place_without_time(scanned.rows, _start_stamp(raw, notes)), declared
    count_all_rows = (
        scanned.absent <= 0.01 * scanned.rows
    )  # single unreadable rows still occupy samples
    stamps: Stamps = partial(stamp_blocks, raw, scanned, block=block)
    counted: Stamps = partial(stamp_blocks, raw, scanned, block=block, all_rows=count_all_rows)
    try:
        estimate = estimate_rate(stamps, where=where)
    except TimeError:
        if declared is None or scanned.rows - scanned.absent > 1:
            raise
        estimate = RateEstimate(declared, 0.0, counted=False, coarse=False, raw=declared)
    if declared is not None and abs(declared / estimate.raw - 1) > _MAX_RATE_DIFFERENCE:
        near_estimate = estimate_near(stamps, declared)
        named = (
            estimate.even is not None and abs(declared / estimate.even - 1) <= _MAX_RATE_DIFFERENCE
        )  # without the recurring losses
        if (
            near_estimate is None
            or abs(declared / near_estimate.raw - 1) > _MAX_RATE_DIFFERENCE
            or (not named and is_far_worse(stamps, near_estimate, estimate))
        ):
            raise TimeError(
                f"{where}: the sampling rate given is {declared:.10g} Hz, but the time stamps "
                f"say {estimate.raw:.6g} Hz, and neither "
                "lost samples nor jitter explain the difference; "
                "leave out --rate to use the stamps, or correct --rate, --epoch or the unit of "
                "the time column"
            )
        notes.append(
            f"{where}: the stamps alone say {estimate.raw:.6g} Hz; they fit the rate given, "
            f"{declared:.10g} Hz, which is used"
        )
        estimate = near_estimate
    rate = estimate.rate
    if declared is not None:
        rate, estimate = (
            declared,
            replace(estimate, finer=None, even=None),
        )  # a given rate settles the question
    if estimate.counted:
        placement = place_by_count(counted, estimate, rate, max_gap=max_gap)
        deviating: list[tuple[int, int, float]] = []
    else:
        placement, deviating = _place_stamped(
            raw,
            scanned,
            stamps,
            estimate,
            rate,
            count_all_rows=count_all_rows,
            tolerance=tolerance,
            max_gap=max_gap,
            where=where,
        )
    notes += describe_rate(raw, estimate, rate, deviating, placement)
    return replace(placement, rate_changes=tuple(stamp for _, stamp, _ in deviating)), rate


def _place_even(
    raw: xr.Dataset, scanned: ScanPass, place: Callable[..., tuple[Placement, float]]
) -> tuple[Placement, float] | None:
    """Place the rows of a long log with evenly spaced stamps, from its beginning alone.

    Returns None if the stamps are not even, a row has no sample, or the beginning has notes.
    """
    clock = find_source(raw["time"].data) if "time" in raw.variables else None
    line = clock.find_line() if isinstance(clock, PiecewiseColumn) else None
    if line is None or scanned.absent or scanned.repeated or scanned.rows <= _EVEN_ROWS:
        return None
    start, step = line
    stamps = (start + step * np.arange(_EVEN_ROWS)).view("datetime64[ns]")
    signal = signal_name(raw)
    values = read_slice(raw[signal].data, 0, _EVEN_ROWS)
    head = xr.Dataset(
        {signal: (("axis", "row"), values)},
        {"time": ("row", stamps), "axis": raw["axis"].values},
        raw.attrs,
    )
    present = replace(scanned, rows=_EVEN_ROWS, present=scanned.present[: _EVEN_ROWS // 8].copy())
    notes: list[str] = []
    placement, rate = place(head, present, notes=notes)
    nanoseconds, fraction = period_ns(rate)
    if (
        notes
        or fraction
        or nanoseconds != step
        or placement.runs.tolist() != [[0, 0, _EVEN_ROWS]]
        or len(placement.events)
    ):
        return None
    return replace(placement, runs=np.array([[0, 0, scanned.rows]], dtype=np.int64)), rate


def _place_stamped(
    raw: xr.Dataset,
    scanned: ScanPass,
    stamps: Stamps,
    estimate: RateEstimate,
    rate: float,
    *,
    count_all_rows: bool,
    **options: Any,
) -> tuple[Placement, list[tuple[int, int, float]]]:
    """Place rows by their stamps, or in order if stamps have jitter; return deviating stretches."""
    jitter = estimate.jitter

    def place_along(jitter: JitterModel) -> Placement:
        def place() -> Placement:  # repetitions occupy no samples
            by_row = count_all_rows and not scanned.repeated
            return place_in_order(stamps, jitter, rate, by_row=by_row, **options)

        return _place_once(raw, scanned, place)

    if jitter is not None and jitter.sigma > _SHARP_SIGMA:
        return place_along(jitter), []
    placement = _place_once(raw, scanned, partial(place_by_stamp, stamps, rate, **options))
    dropped = scanned.rows - scanned.absent - scanned.repeated - placement.placed
    if not scanned.repeated and (
        dropped >= _MIN_DROPPED_ROWS or placement.has_late_rows
    ):  # placing in order may recover them
        along = place_along(jitter or JitterModel.of_sharp(1e9 / rate))
        if along.placed - placement.placed >= _LATE_SHARE * dropped:
            placement = along
    return placement, deviating_stretches(stamps, 1e9 / rate)


def _place_once(raw: xr.Dataset, scanned: ScanPass, place: Callable[[], Placement]) -> Placement:
    """Place each sample once; repeated stretches of rows are duplicates, not clock restarts."""
    placement, all_repeats = place(), np.empty((0, 3), dtype=np.int64)
    for _ in range(_MAX_ROUNDS):
        repeats = find_repeats(raw, signal_name(raw), placement)
        if not len(repeats):
            break
        for row, _source, length in repeats.tolist():
            scanned.leave_out(row, row + length)
        all_repeats = np.concatenate([all_repeats, repeats])
        placement = place()
    return with_repeats(placement, raw, all_repeats) if len(all_repeats) else placement


def _is_on_grid(channel: Any, n_filled: int, scanned: ScanPass, placement: Placement) -> bool:
    """Whether a channel has values for most samples, and few in rows without a gyro value."""
    present = scanned.rows - scanned.absent
    if n_filled <= 0.5 * present:
        return False
    if scanned.absent <= _MAX_UNPLACED_SHARE * n_filled:
        return True  # without reading the channel
    dropped = max(0, present - placement.placed)  # they lose their channels too
    unplaced = n_filled - count_placed(channel, placement)
    return unplaced - dropped <= _MAX_UNPLACED_SHARE * n_filled


def _place_channels(
    raw: xr.Dataset, scanned: ScanPass, placement: Placement, rate: float, chunk: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the channels on the grid, and time coordinates of slow channels."""
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {}
    for name, rows in scanned.filled.items():
        channel = raw[name]
        if _is_on_grid(channel.data, rows, scanned, placement):
            variables[name] = (
                "time",
                rows_on_grid(channel.data, placement, chunk=chunk),
                channel.attrs,
                channel.encoding,
            )
        elif rows:
            time, values = gather_channel(raw, name, placement, rate)
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


def regularise(
    raw: xr.Dataset,
    *,
    rate: float | None = None,
    tolerance: float = 0.25,
    max_gap: str | float = "10D",
    chunk: int | None = None,
    block: int = BLOCK_ROWS,
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
    tolerance : float
        Largest distance of the smoothed stamps from the grid, beyond half a sample, before a sample
        is skipped [samples].
    max_gap : str or float
        A longer step of the stamps ahead is taken as a step of the clock, not as a gap; a number
        is in seconds.
    chunk : int, optional
        Samples in a chunk of the lazy arrays; about 20 minutes by default, as in a stored log.
    block : int
        Rows in memory at one time; does not affect the result.
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
    times sampling rate.

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
    _check_options(rate=rate, tolerance=tolerance, chunk=chunk, block=block)
    is_log = isinstance(raw, xr.Dataset) and "row" not in raw.dims
    if is_log and "sampling_rate_hz" in raw.attrs:
        log = as_uniform(raw)
        if rate is not None:
            check_same_rate(log, rate, ", ".join(texts(log, "source_files")) or "this")
        return log
    check_raw(raw)
    if "axis_rows" in raw.attrs:
        regularise_group = partial(
            regularise,
            rate=rate,
            tolerance=tolerance,
            max_gap=max_gap,
            chunk=chunk,
            block=block,
            limits=limits,
        )
        return regularise_axes(raw, regularise_group, max_gap=max_gap, limits=limits)
    gap_limit = duration_seconds(max_gap, "max_gap")
    name = signal_name(raw)
    allowed = check_limits(limits)
    scanned = scan_rows(raw, name, block=block)
    notes: list[str] = []
    place = partial(
        _place_rows,
        declared=_declared_rate(raw, rate),
        tolerance=tolerance,
        max_gap=gap_limit,
        block=block,
    )
    placement, hertz = _place_even(raw, scanned, place) or place(raw, scanned, notes=notes)
    check_grid(raw, placement, hertz, gap_limit, allowed)
    check_span(placement.start, hertz, placement.size, file_of(raw)[0])
    chunk = chunk or chunk_samples(hertz)
    table = name_lost(
        find_gaps(placement, scanned), raw.attrs.get("unreadable_spans", ()), placement.start, hertz
    )
    notes += describe_placement(raw, scanned, placement, table, hertz)
    if name == "angle" and raw.attrs.get("kind") == "angle":
        notes += describe_angles(raw)

    increments = raw.attrs.get("kind") == "increment"
    signal = "rate" if increments else name
    scale = hertz * HOUR if increments else 1.0  # degree a sample to degree an hour
    attributes = {**raw[name].attrs, "units": SIGNAL_UNITS[signal]}
    unit = raw[name].encoding.get("scale_factor")
    packing = {**raw[name].encoding, "scale_factor": unit * scale} if unit else {}
    variables, channel_times = _place_channels(raw, scanned, placement, hertz, chunk)
    variables = {
        signal: (
            ("axis", "time"),
            rows_on_grid(raw[name].data, placement, chunk=chunk, scale=scale, unit=unit),
            attributes,
            packing,
        ),
        **variables,
        **gap_variables(sort_gaps(table), placement.start, hertz),
    }
    coordinates = (
        xr.Coordinates({"axis": raw["axis"].variable, **channel_times})
        .merge(time_coordinate(placement.start, hertz, placement.size))
        .coords
    )
    done = (
        f"{placement.placed} of {scanned.rows} rows on {placement.size} samples at {hertz:.10g} Hz"
    )
    log = xr.Dataset(variables, coordinates, _log_attributes(raw, signal, hertz, done, notes))
    if placement.rate_changes:
        log.attrs["rate_changes"] = list(map(format_stamp, placement.rate_changes))
    return log.assign_attrs(notes=[*log.attrs["notes"], *describe_channels(log)])

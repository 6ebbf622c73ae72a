"""Notes on what regularising did to a log."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.arrays import Floats, Ints
from gyrostab.ingest.gap_table import MISSING, describe_break, describe_clock_change
from gyrostab.ingest.grid.jitter import MIN_SIGMA
from gyrostab.ingest.grid.place import Placement
from gyrostab.ingest.grid.rate import DeviatingStretch, RateEstimate
from gyrostab.ingest.grid.scan_pass import ScanPass, file_of, record_name
from gyrostab.kernels.grid.stamps import DUPLICATE, EVENT_ROW, OUT_OF_ORDER
from gyrostab.schema import log_channels
from gyrostab.time.durations import format_measured_duration
from gyrostab.time.grid import grid_times
from gyrostab.time.stamps import format_stamp, to_nanoseconds
from gyrostab.wording import format_rounded

#: Scatter of stamps [samples] above which, and share of rows without a sample above which, the
#: rate may be wrong if many samples are missing.
_UNCERTAIN_SIGMA, _MANY_SHARE = 0.3, 0.05
_IF_HIGHER = "; if many samples are missing, the sampling rate may be higher: give it with --rate"
_MAX_ZONE_HOURS = 14  # largest offset of local time from UTC
_MAX_NAMED = 5  # events of one kind that are listed one by one
_MAX_WANDER = 0.02  # relative deviation of a sampling rate that wanders
#: Rows of which the steps of angles are taken, and the least number.
_STEP_ROWS, _MIN_STEP_ROWS = 2**14, 100
#: Angles are like increments if their steps, over sqrt(2), are more than this share of their
#: standard deviation: white increments have 1, and a random walk of 100 rows or more 0.2 or less.
_INCREMENT_STEP_SHARE = 0.5
#: Increments are like angles if a larger share of their steps over one of these numbers of rows
#: have one direction: over one row, an angle that wraps around; over many, a noisy angle.
_ONE_WAY_SHARE, _LAG_ROWS = 0.98, (1, 64)


def describe_channels(log: xr.Dataset) -> list[str]:
    """Return notes on channels with separate stamps without a value within the gyro record."""
    notes = []
    start, end = log["time"][[0, -1]].values  # computed, not loaded
    for name in log_channels(log):
        if f"time_{name}" not in log.coords:
            continue
        stamps = log[f"time_{name}"].values
        if not ((stamps >= start) & (stamps <= end)).any():
            of = (
                f"{_count_of(len(stamps), 'value')}, {_format_span(stamps.min(), stamps.max())}"
                if len(stamps)
                else "0 values"
            )
            advice = _find_zone(stamps, start, end) or "check its time column, its unit and --epoch"
            notes.append(
                f"channel {name}: none of its {of}, lies within the log, "
                f"{_format_span(start, end)}; {advice}"
            )
    return notes


def _find_zone(stamps: NDArray[np.datetime64], start: np.datetime64, end: np.datetime64) -> str:
    """Ask for the time zone if a shift by whole hours places stamps within a log; "" otherwise."""
    if not len(stamps):
        return ""
    hour = np.timedelta64(1, "h")
    shift = round(float((stamps.min() - start) / hour))
    moved = stamps - shift * hour
    if not 1 <= abs(shift) <= _MAX_ZONE_HOURS or not ((moved >= start) & (moved <= end)).any():
        return ""
    return (
        f"it begins about {_count_of(abs(shift), 'hour')} {'late' if shift > 0 else 'early'}: is "
        "one of the files in local time? If so, write its offset from UTC into the stamps (-05:00)"
    )


def describe_angles(raw: xr.Dataset) -> list[str]:
    """Return a note if cumulative angles look like increments, or increments like angles."""
    values = np.asarray(raw["angle"].isel(row=slice(0, _STEP_ROWS)).values, dtype=np.float64)
    finite = values[:, np.isfinite(values).all(axis=0)]
    if finite.shape[1] <= _MIN_STEP_ROWS:
        return []
    if raw.attrs.get("kind") == "increment":
        share = max(_one_way_share(finite, lag) for lag in _LAG_ROWS)
        return [
            f"{record_name(raw)}: with --kind rate each row is an increment, but the values rise "
            "or fall throughout like cumulative angles; if they are, give --kind angle"
        ] * (share > _ONE_WAY_SHARE)
    steps = np.diff(finite, axis=1)
    shares = steps.std(axis=1) / np.sqrt(2.0) / np.maximum(finite.std(axis=1), 1e-300)
    return [
        f"{record_name(raw)}: with --kind angle the angles are cumulative, but they change from "
        "row to row like increments; if each row is an increment, give --kind rate"
    ] * bool((shares > _INCREMENT_STEP_SHARE).all())


def _one_way_share(values: Floats, lag: int) -> float:
    """Return the share of steps over `lag` rows in one direction, on the axis with the largest."""
    steps = values[:, lag:] - values[:, :-lag]
    return float(max((steps > 0).mean(axis=1).max(), (steps < 0).mean(axis=1).max()))


def _format_span(first: np.datetime64, last: np.datetime64) -> str:
    return " to ".join(format_stamp(int(to_nanoseconds(stamp))) for stamp in (first, last))


def _count_of(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def describe_rate(
    raw: xr.Dataset, estimate: RateEstimate, deviating: list[DeviatingStretch], placement: Placement
) -> list[str]:
    """Return notes on the sampling rate."""
    where = record_name(raw)
    return [
        *_describe_method(where, estimate, placement),
        *_describe_other_rates(where, estimate, placement),
        *_describe_deviating(raw, deviating, placement.rate),
    ]


def _describe_method(where: str, estimate: RateEstimate, placement: Placement) -> list[str]:
    """Say how rows are placed whose single stamps do not give the sample."""
    notes, rate = [], placement.rate
    reason = (
        "many rows share one stamp"
        if estimate.stamps_are_shared
        else "the stamps come in bursts, as rows arrive and not as they are sampled"
    )
    if estimate.places_by_count:
        reach = (
            "; stamps and samples differ by up to "
            f"{format_measured_duration(placement.wander / rate)} in the long run"
            if placement.wander >= 1
            else ""
        )
        notes.append(
            f"{where}: {reason}: rows are placed by their count at {rate:.10g} Hz{reach}"
            f"{_IF_HIGHER}"
        )
    jitter = estimate.jitter
    if jitter is not None and (jitter.group >= 2 or jitter.sigma < MIN_SIGMA):
        notes.append(
            f"{where}: {reason}: rows are placed in their order at {rate:.10g} Hz; samples are "
            f"missing where a group comes late{_IF_HIGHER}"
        )
    elif jitter is not None:
        notes.append(
            f"{where}: the stamps scatter by {format_measured_duration(jitter.sigma / rate)}, "
            f"{jitter.sigma:.2g} of a sampling interval, "
            f"as times of arrival do: rows keep their order at {rate:.10g} Hz, and a missing "
            f"sample is located to a few rows{_IF_HIGHER * (jitter.sigma > _UNCERTAIN_SIGMA)}"
        )
    return notes


def _describe_other_rates(where: str, estimate: RateEstimate, placement: Placement) -> list[str]:
    """Say which other rates fit the stamps, and how far the rate is from the estimated one."""
    notes, rate = [], placement.rate
    lower, higher = estimate.rate_without_losses, estimate.rate_with_losses
    if lower is not None:
        notes.append(
            f"{where}: the steps between stamps recur, or the rows come in packets: the stamps fit "
            f"{rate:.10g} Hz with a share of "
            f"{1 - lower / rate:.2g} missing, and {lower:g} Hz with none; "
            f"{rate:.10g} Hz is used: "
            f"if no rows are missing, give --rate {lower:g}"
        )
    if higher is not None:
        notes.append(
            f"{where}: the stamps lie near multiples of the period of {higher:g} Hz, as if "
            "rows of a log at that rate were missing; they are read as even samples at "
            f"{rate:.10g} Hz: if rows are missing, give --rate {higher:g}"
        )
    off = abs(estimate.unrounded / rate - 1)
    if off * placement.size > 1 and off > 2 * estimate.error / rate:
        notes.append(
            f"{where}: the stamps say {estimate.unrounded:.10g} Hz, {1e6 * off:.1f} parts per "
            f"million from {rate:.10g} Hz"
        )
    return notes


def _describe_deviating(
    raw: xr.Dataset, deviating: list[DeviatingStretch], rate: float
) -> list[str]:
    """Name the stretches with another rate, or its range if there are many of nearly this rate."""
    if len(deviating) > 2 and all(
        abs(stretch.rate / rate - 1) < _MAX_WANDER for stretch in deviating
    ):
        rates = [stretch.rate for stretch in deviating]
        return [
            f"{record_name(raw)}: the sampling rate is not {rate:.6g} Hz throughout, but wanders "
            f"from {min(rates):.6g} to {max(rates):.6g} Hz, as without a stable clock; by their "
            "stamps samples are missing or dropped"
        ]
    notes = []
    for stretch in deviating[:_MAX_NAMED]:
        (file, first), (_, last) = (file_of(raw, row) for row, _ in (stretch.first, stretch.last))
        begin, end = (format_stamp(stamp) for _, stamp in (stretch.first, stretch.last))
        notes.append(
            f"{file}: from about {begin} (row {first}) to {end} (row {last}) the samples come at "
            f"{stretch.rate:.6g} Hz and not at {rate:.6g} Hz; by their stamps samples are missing "
            "or dropped there; split the log at these rows and run the parts separately"
        )
    return notes


def _describe_breaks(raw: xr.Dataset, placement: Placement) -> list[str]:
    notes = []
    events = placement.breaks
    for cause, _sample, row, before, after in events[:_MAX_NAMED].tolist():
        file, local = file_of(raw, row)
        text = describe_break(f" at row {local}", cause, before, after, "rows")
        notes.append(f"{file}: {text}{_describe_local(raw, (after - before) / 1e9)}")
    if len(events) > _MAX_NAMED:
        notes.append(
            f"{record_name(raw)}: {len(events) - _MAX_NAMED} more restarts and steps of the clock "
            "are in the table of gaps"
        )
    return notes


def _describe_local(raw: xr.Dataset, jump: float) -> str:
    """Name a step of local stamps [s] that daylight saving time may cause."""
    return describe_clock_change(jump) if raw.attrs.get("local_time") else ""


def _describe_missing(raw: xr.Dataset, placement: Placement, table: Ints) -> list[str]:
    holes = table[(table[:, 4] == MISSING) & (table[:, 2] > 0)]
    if len(holes) == 0:
        return []
    notes, rate = [], placement.rate
    longest = holes[np.argsort(-holes[:, 2], kind="stable")]
    longest = longest[longest[:, 2] >= max(2, rate)][:_MAX_NAMED]
    ends = placement.runs[:, 0] + placement.runs[:, 2]
    for first, _end, samples, _rows, _cause in longest.tolist():
        last_run = placement.runs[np.searchsorted(ends, first)]
        row = int(last_run[1] + last_run[2] - 1)
        file, local = file_of(raw, row)
        since = format_stamp(int(grid_times(placement.start, rate, first)))
        notes.append(
            f"{file}: {format_measured_duration(samples / rate)} without samples from {since} "
            f"(after row {local}){_describe_local(raw, samples / rate)}"
        )
    if len(holes) > len(longest):
        total = int(holes[:, 2].sum())
        share = total / placement.size
        notes.append(
            f"{record_name(raw)}: missing: {_count_of(total, 'sample')} "
            f"({format_measured_duration(total / rate)}, {format_rounded(100 * share)} % of the "
            f"log) in {_count_of(len(holes), 'place')}; all are in the table of gaps"
        )
    return notes


def _name_row(raw: xr.Dataset, row: int) -> str:
    """Name a row by its number, and by its file if the record has several."""
    file, local = file_of(raw, row)
    return f"row {local}" if file == record_name(raw) else f"row {local} of {file}"


def describe_placement(
    raw: xr.Dataset, scanned: ScanPass, placement: Placement, table: Ints
) -> list[str]:
    """Return notes on gaps, restarts, and rows and cells that were dropped or moved."""
    where = record_name(raw)
    notes = [*_describe_breaks(raw, placement), *_describe_missing(raw, placement, table)]
    twice = placement.events_of(DUPLICATE)
    if len(twice):
        first = _name_row(raw, int(twice[:, EVENT_ROW].min()))
        notes.append(
            f"{where}: dropped, because another row holds their sample: "
            f"{_count_of(len(twice), 'row')}, first {first}"
            + _IF_HIGHER
            * (len(twice) > _MANY_SHARE * scanned.row_count)
        )
    late = placement.events_of(OUT_OF_ORDER)
    n_placed = int((placement.samples_of(late[:, EVENT_ROW]) >= 0).sum())
    if len(late):
        notes.append(
            f"{where}: out of order: {_count_of(len(late), 'row')}, first "
            f"{_name_row(raw, int(late[:, EVENT_ROW].min()))}; "
            f"{n_placed} were put in their place, {len(late) - n_placed} dropped"
        )
    dropped = len(twice) + len(late) - n_placed
    lost = scanned.present_count - placement.placed_count - dropped
    if lost > 0:
        notes.append(
            f"{where}: dropped without a readable time stamp: {_count_of(lost, 'row')} whose "
            "neighbours do not determine their samples"
        )
    infinite = int((scanned.infinite[:, 1] - scanned.infinite[:, 0]).sum())
    if infinite:
        notes.append(f"{where}: infinite values in {_count_of(infinite, 'row')}, taken as missing")
    notes += [
        f"{where}: axis {axis} never changes its value; is the sensor dead, or the column the "
        "wrong one?"
        for axis in scanned.constant
    ]
    nothing = "no row holds a number for"
    notes += [
        f"{where}: {nothing} axis {axis}; is its column empty, or the wrong one? --map HEADER=- "
        "drops a column"
        for axis in scanned.empty
    ]
    notes += [
        f"{where}: {nothing} channel {channel}, which is left out; check its column"
        for channel, count in scanned.filled_counts.items()
        if count == 0
    ]
    return notes

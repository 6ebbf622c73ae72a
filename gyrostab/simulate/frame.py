"""Grid of time and axes of a simulated log, with the channels and gaps that belong to it."""

from __future__ import annotations

import inspect
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Ints
from gyrostab.errors import OptionError, SchemaError
from gyrostab.physics.registry import is_model_number
from gyrostab.schema import GAP_CAUSES, log_channels
from gyrostab.simulate.channels import MAX_DURATION_S, combine, convert_units
from gyrostab.simulate.model import PROFILES, Model
from gyrostab.simulate.noise import stream
from gyrostab.time.durations import duration_seconds
from gyrostab.time.grid import (
    TimeGridIndex,
    check_span,
    first_stamp,
    grid_index,
    grid_times,
    time_coordinate,
)
from gyrostab.time.stamps import format_stamp, stamp_ns, to_nanoseconds

#: Largest number of samples of the instrument: a year at 300 Hz.
MAX_SAMPLES = 10**10
#: Cause of a gap in which the gyro was switched off.
RESTART = GAP_CAUSES.index("restart")


@dataclass(frozen=True)
class Frame:
    """Grid of time and axes of the log."""

    rate: float
    size: int
    start: int
    seed: int
    axes: tuple[str, ...]
    oversampling: int


def make_frame(
    model: Model,
    *,
    duration: Any,
    rate: float | None,
    start: Any,
    seed: int | None,
    like: xr.Dataset | None,
) -> Frame:
    """Make the frame of a log from the options of `simulate`, or from the recording `like`."""
    chosen = model.log.get("seed", 0) if seed is None else seed
    if not isinstance(chosen, int | np.integer) or chosen < 0:
        raise OptionError(f"seed={seed!r}: give a whole number from 0 up")
    chosen = int(chosen)
    factor = int(model.log.get("oversampling", 1))
    if like is not None:
        grid_options = {"duration": duration, "rate": rate, "start": start}
        extra = [name for name, value in grid_options.items() if value is not None]
        if extra:
            raise OptionError(
                f"{extra[0]} is taken from the recording given as like; "
                f"leave out {extra[0]} or like"
            )
        recorded = tuple(str(axis) for axis in like["axis"].values)
        axes = tuple(axis for axis in recorded if axis in model.axes) or recorded
        like_rate, size = float(like.attrs["sampling_rate_hz"]), like.sizes["time"]
        return Frame(like_rate, size, first_stamp(like), chosen, axes, factor)
    hertz = model.log.get("rate") if rate is None else rate
    length = model.log.get("duration") if duration is None else duration
    for name, value, example in (("rate", hertz, "100 (Hz)"), ("duration", length, "1h")):
        if value is None:
            raise OptionError(
                f"{model.source}: there is no {name}; give {name} = {example} in [log], "
                f"--{name}, or --like RECORDING"
            )
    if not (is_model_number(hertz) and math.isfinite(hertz) and 0 < hertz <= 1e6):
        raise OptionError(
            f"{model.source}: rate {hertz!r} is not a number of Hz above 0 and up to 1e6"
        )
    if isinstance(length, bool) or duration_seconds(length, "duration") > MAX_DURATION_S:
        raise OptionError(
            f"{model.source}: the duration {length} is not valid; "
            f"give for instance 1h, at most {MAX_DURATION_S:g} s"
        )
    size = round(duration_seconds(length, "duration") * hertz)
    if size < 1:
        raise OptionError(
            f"{model.source}: a duration of {length} is shorter than one sample at {hertz:g} Hz"
        )
    if size * factor > MAX_SAMPLES:
        raise OptionError(
            f"{model.source}: a duration of {length} at {hertz * factor:g} Hz has more than "
            f"{MAX_SAMPLES:.0e} samples; give a shorter duration or a lower rate or oversampling"
        )
    begin = stamp_ns(start if start is not None else model.log.get("start", "1970-01-01"))
    check_span(begin, hertz, size, model.source)
    return Frame(float(hertz), size, begin, chosen, model.axes or ("x", "y", "z"), factor)


def check_axes(model: Model, frame: Frame) -> None:
    """Check that the log has the axes that a model names."""
    named = [
        *(axis for axis in model.noise if axis),
        *model.bias,
        *(axis for effect in model.effects for axis in effect.axes),
    ]
    for axis in named:
        if axis not in frame.axes:
            raise OptionError(
                f"{model.source}: there is no axis {axis!r} in this log; "
                f"it has {', '.join(frame.axes)}"
            )


def take_environment(like: xr.Dataset) -> xr.Dataset:
    """Channels and gaps of a recording."""
    names = {
        *log_channels(like),
        *(name for name, variable in like.variables.items() if variable.dims == ("gap",)),
    }
    environment = like[[name for name in like.variables if name in names]]
    return environment.drop_vars("axis", errors="ignore")


def add_environment(
    model: Model, frame: Frame, like: xr.Dataset | None, environment: xr.Dataset | None
) -> xr.Dataset:
    """Channels and gaps of the model and of `environment`, without those of a recording."""
    parts = []
    counts: dict[str, int] = {}
    common = {"duration": frame.size / frame.rate, "start": np.datetime64(frame.start, "ns")}
    for name, values in model.environment:
        function = PROFILES[name][0]
        counts[name] = counts.get(name, 0) + 1
        arguments = {**common, **values}
        if "seed" in inspect.signature(function).parameters:
            arguments.setdefault("seed", _number_seed(frame.seed, name, counts[name]))
        parts.append(function(**arguments))
    if environment is not None:
        _check_environment(environment, frame)
        if "time" in environment.dims:
            grid = (
                time_coordinate(frame.start, frame.rate, frame.size)
                if like is None
                else xr.Coordinates.from_xindex(like.xindexes["time"])
            )
            environment = environment.drop_vars("time", errors="ignore").assign_coords(grid)
        parts.append(convert_units(environment))
    return combine(*parts)


def _number_seed(seed: int, name: str, number: int) -> int:
    """Return the seed of a profile: that of the log for the first one of its name."""
    return seed if number == 1 else int(stream(seed, "profile", name, number).integers(2**63))


def _check_environment(environment: Any, frame: Frame) -> None:
    """Raise `SchemaError` unless channels and gaps have times that belong to the log."""
    if not isinstance(environment, xr.Dataset):
        raise SchemaError(
            f"environment is a {type(environment).__name__}, not an xarray.Dataset; the functions "
            "of gyrostab.simulate.environment make one"
        )
    for name, variable in environment.data_vars.items():
        if variable.dims == ("gap",):
            continue
        on_samples = variable.dims == ("time",) and variable.size == frame.size
        if not on_samples and variable.dims != (f"time_{name}",):
            raise SchemaError(
                f"channel {name!r} of the environment has dimensions "
                f"{dict(environment[name].sizes)}, expected 'time_{name}', with a coordinate of "
                "times; gyrostab.simulate.environment.ramps makes such a channel"
            )
        if not on_samples or "time" in environment.coords:
            _check_times(environment, str(variable.dims[0]), frame)
    columns = [name for name in ("gap_start", "gap_end", "gap_cause") if name in environment]
    if len(columns) == 3:
        begin, end = (to_nanoseconds(environment[name].values) for name in columns[:2])
        if begin.size and not _is_inside(int(begin.min()), int(end.max()), frame):
            raise _outside_error("every gap", int(begin.min()), int(end.max()), frame)
    elif columns:
        raise SchemaError(
            f"the environment has {', '.join(columns)} of a table of gaps, which needs gap_start, "
            "gap_end and gap_cause; gyrostab.simulate.losses.gaps makes one"
        )


def _check_times(environment: xr.Dataset, dim: str, frame: Frame) -> None:
    """Raise `SchemaError` unless the coordinate of a channel has times that belong to the log."""
    index, size = environment.xindexes.get(dim), environment.sizes[dim]
    if index is None or not size or environment[dim].dtype.kind != "M":
        raise SchemaError(
            f"the dimension {dim!r} of the environment has no coordinate of times (datetime64); "
            "gyrostab.simulate.environment.ramps makes a channel with its times"
        )
    # a computed axis is not read as a whole
    places = np.array([0, size - 1]) if isinstance(index, TimeGridIndex) else np.arange(size)
    stamps = to_nanoseconds(environment[dim][places].values)
    if dim == "time":
        if np.any(np.abs(grid_index(frame.start, frame.rate, stamps) - places) > 1e-3):
            raise SchemaError(
                "the times of the environment are not those of the log, which begins at "
                f"{format_stamp(frame.start)} with {frame.rate:.10g} Hz; leave the coordinate "
                "'time' out, or give the channel a dimension time_<name> with its own times"
            )
    elif np.any(np.diff(stamps) < 0):
        raise SchemaError(f"the times {dim!r} of the environment do not rise; sort them")
    elif not _is_inside(int(stamps[0]), int(stamps[-1]), frame):
        raise _outside_error(repr(dim.removeprefix("time_")), stamps[0], stamps[-1], frame)


def _is_inside(first: int, last: int, frame: Frame) -> bool:
    """Whether a span of time [ns since 1970] shares some of that of the log."""
    return last >= frame.start and first <= int(grid_times(frame.start, frame.rate, frame.size))


def _outside_error(item: str, first: int, last: int, frame: Frame) -> SchemaError:
    return SchemaError(
        f"{item} of the environment is outside of the log, which begins at "
        f"{format_stamp(frame.start)}: from {format_stamp(first)} to {format_stamp(last)}; "
        "give the start of the log to the function that makes it"
    )


def convert_gaps(environment: xr.Dataset, frame: Frame, *, only: int | None = None) -> Ints:
    """Convert and merge gaps: first missing, first present after, samples, rows, cause.

    With the cause `only`, others are left out.
    """
    if "gap_start" not in environment:
        return np.empty((0, 5), np.int64)
    first, end = (
        np.ceil(
            grid_index(frame.start, frame.rate, to_nanoseconds(environment[name].values)) - 1e-3
        )
        for name in ("gap_start", "gap_end")
    )
    first, end = (np.clip(edge, 0, frame.size).astype(np.int64) for edge in (first, end))
    rows: list[list[int]] = []
    for begin, until, cause in sorted(
        zip(first.tolist(), end.tolist(), environment["gap_cause"].values.tolist(), strict=True)
    ):
        if until <= begin or only not in (None, cause):
            continue
        if rows and begin < rows[-1][1]:
            rows[-1][1] = max(rows[-1][1], until)
            rows[-1][4] = RESTART if RESTART in (rows[-1][4], cause) else rows[-1][4]
        else:
            rows.append([begin, until, 0, 0, int(cause)])
    table = np.array(rows, dtype=np.int64).reshape(-1, 5)
    table[:, 2] = table[:, 1] - table[:, 0]
    return table

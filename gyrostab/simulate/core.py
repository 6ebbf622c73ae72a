"""Model to log: the frame of time, the plan, and the lazy blocks."""

from __future__ import annotations

import contextlib
import inspect
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import OptionError, SchemaError, UnitError
from gyrostab.ingest.convert import as_log
from gyrostab.ingest.gap_table import gap_variables
from gyrostab.noise import TERMS
from gyrostab.physics.base import STAGES, Effect, Setup, driver_error
from gyrostab.physics.registry import is_number
from gyrostab.schema import (
    GAP_CAUSES,
    SIGNAL_LONG_NAMES,
    SIGNAL_UNITS,
    attributes,
    check_log,
    log_channels,
    signal_name,
)
from gyrostab.simulate.block import BlockState, Plan, Step
from gyrostab.simulate.channels import combine, convert_units
from gyrostab.simulate.drivers import Source, make_course, make_source
from gyrostab.simulate.lazy import lazy_rates
from gyrostab.simulate.model import PROFILES, Model, naming_of, read_model
from gyrostab.simulate.noise import begin_noise, stream
from gyrostab.time.clock import time_of_day
from gyrostab.time.durations import duration_seconds
from gyrostab.time.grid import (
    TimeGridIndex,
    check_span,
    first_stamp,
    grid_index,
    grid_times,
    stamp_ns,
    time_coordinate,
)
from gyrostab.time.stamps import format_stamp, to_nanoseconds
from gyrostab.units import parse_unit

#: Samples of the instrument in one block of the lazy log.
BLOCK = 2**17
#: Largest number of samples of the instrument: a year at 300 Hz.
MAX_SAMPLES = 10**10
_RECORDED = "recorded rate of "  # source of an effect, in front of the name of the axis
_COURSE = "course of "  # source of an effect, in front of the name of a recorded channel
_RESTART = GAP_CAUSES.index("restart")


def simulate(
    model: str | os.PathLike[str] | Mapping[str, Any] | Model,
    *,
    duration: Any = None,
    rate: float | None = None,
    start: Any = None,
    seed: int | None = None,
    like: xr.Dataset | None = None,
    environment: xr.Dataset | None = None,
    chunk: int | None = None,
) -> xr.Dataset:
    """Simulate a gyro log.

    Parameters
    ----------
    model : path, mapping or Model
        Noise, effects, environment and frame of the log; see docs/simulate.md.
    duration : str or float, optional
        Length of the log ("200h"); a number is in seconds. Without it that of the model, or of
        `like`.
    rate : float, optional
        Sampling rate [Hz].
    start : str, optional
        Time of the first sample, ISO 8601, UTC.
    seed : int, optional
        The same seed gives the same bits, whatever the chunks; with and without effects it gives
        the same noise. 0 by default.
    like : xarray.Dataset, optional
        Regular log whose stamps, gaps and channels are taken; rate, start and axes are then its
        own.
    environment : xarray.Dataset, optional
        More channels and gaps, from the functions of `gyrostab.simulate.environment` and
        `gyrostab.simulate.losses`.
    chunk : int, optional
        Samples of a chunk of the lazy log.

    Returns
    -------
    xarray.Dataset
        ``rate(axis, time)`` [degree hour-1], lazy, NaN at every missing sample; the channels; the
        table of gaps. Its chunks are made one after the other and remember how to go on; a late one
        alone needs those before it, once.

    Raises
    ------
    OptionError, FormatError
        When the model or an option makes no sense.
    SchemaError
        When an effect lacks its channel, or `like` is not a log.

    Examples
    --------
    >>> log = simulate({"noise": {"N": 0.01}}, duration="1min", rate=100.0, seed=4)
    >>> log.rate.shape, log.rate.units
    ((3, 6000), 'degree hour-1')
    >>> warm = {"profile": "steps", "channel": "temperature", "unit": "degC", "points": [[0, 35]]}
    >>> effect = {"name": "temperature_bias", "sensitivity": 0.1}
    >>> biased = {"noise": {"N": 0.01}, "effect": [effect], "environment": [warm]}
    >>> difference = simulate(biased, duration="1min", rate=100.0, seed=4).rate - log.rate
    >>> float(difference.min().round(6)), float(difference.max().round(6))
    (1.0, 1.0)
    """
    made = model if isinstance(model, Model) else read_model(model)
    like = None if like is None else as_log(like)
    if chunk is not None and chunk < 1:
        raise OptionError(f"chunk={chunk!r}: give at least 1 sample")
    frame = _make_frame(made, duration=duration, rate=rate, start=start, seed=seed, like=like)
    _check_axes(made, frame)
    with naming_of(made.source):
        added = _add_environment(made, frame, like, environment)
        environment = combine(*([] if like is None else [_take_environment(like)]), added)
        environment = environment.drop_attrs(deep=False)
        table = _gap_table(environment, frame)
        lost = _gap_table(added, frame)
        plan = _make_plan(made, frame, environment, (table, lost), like)
        starts = [
            begin_noise(
                frame.seed,
                axis,
                rate=frame.rate * frame.oversampling,
                terms=_noise_terms(plan, row),
                flicker_band=made.flicker_band,
            )
            for row, axis in enumerate(frame.axes)
        ]
        state = _begin_states(plan, frame.seed)
    data = lazy_rates(
        plan,
        state,
        starts,
        frame.size,
        chunk=chunk or max(1, BLOCK // frame.oversampling),
    )
    if like is not None:
        data = _mark_missing(data, like[signal_name(like)].transpose("axis", "time").data)
    return _label_log(made, frame, environment, table, data)


@dataclass(frozen=True)
class _Frame:
    """Grid of time and axes of the log."""

    rate: float
    size: int
    start: int
    seed: int
    axes: tuple[str, ...]
    oversampling: int


def _make_frame(
    model: Model,
    *,
    duration: Any,
    rate: float | None,
    start: Any,
    seed: int | None,
    like: xr.Dataset | None,
) -> _Frame:
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
        axes = tuple(str(axis) for axis in like["axis"].values)
        like_rate, size = float(like.attrs["sampling_rate_hz"]), like.sizes["time"]
        return _Frame(like_rate, size, first_stamp(like), chosen, axes, factor)
    hertz = model.log.get("rate") if rate is None else rate
    length = model.log.get("duration") if duration is None else duration
    for name, value, example in (("rate", hertz, "100 (Hz)"), ("duration", length, "1h")):
        if value is None:
            raise OptionError(
                f"{model.source}: there is no {name}; give {name} = {example} in [log], "
                f"--{name}, or --like RECORDING"
            )
    if not (is_number(hertz) and math.isfinite(hertz) and 0 < hertz <= 1e6):
        raise OptionError(
            f"{model.source}: rate {hertz!r} is not a number of Hz above 0 and up to 1e6"
        )
    if isinstance(length, bool) or duration_seconds(length, "duration") > 1e9:
        raise OptionError(
            f"{model.source}: the duration {length} is not valid; "
            "give for instance 1h, at most 1e9 s"
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
    return _Frame(float(hertz), size, begin, chosen, model.axes or ("x", "y", "z"), factor)


def _check_axes(model: Model, frame: _Frame) -> None:
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


def _take_environment(like: xr.Dataset) -> xr.Dataset:
    """Channels and gaps of a recording."""
    names = {
        *log_channels(like),
        *(name for name, variable in like.variables.items() if variable.dims == ("gap",)),
    }
    environment = like[[name for name in like.variables if name in names]]
    return environment.drop_vars("axis", errors="ignore")


def _add_environment(
    model: Model, frame: _Frame, like: xr.Dataset | None, environment: xr.Dataset | None
) -> xr.Dataset:
    """Channels and gaps of the model and of `environment`, without those of a recording."""
    parts = []
    for name, values in model.environment:
        function = PROFILES[name][0]
        arguments = {"duration": frame.size / frame.rate, "start": frame.start, **values}
        if "seed" in inspect.signature(function).parameters:
            arguments.setdefault("seed", frame.seed)
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


def _check_environment(environment: Any, frame: _Frame) -> None:
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


def _check_times(environment: xr.Dataset, dim: str, frame: _Frame) -> None:
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


def _is_inside(first: int, last: int, frame: _Frame) -> bool:
    """Whether a span of time [ns since 1970] shares some of that of the log."""
    return last >= frame.start and first <= int(grid_times(frame.start, frame.rate, frame.size))


def _outside_error(item: str, first: int, last: int, frame: _Frame) -> SchemaError:
    return SchemaError(
        f"{item} of the environment is outside of the log, which begins at "
        f"{format_stamp(frame.start)}: from {format_stamp(first)} to {format_stamp(last)}; "
        "give the start of the log to the function that makes it"
    )


def _gap_table(environment: xr.Dataset, frame: _Frame) -> NDArray[np.int64]:
    """Convert and merge gaps: first missing, first present after, samples, rows, cause."""
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
        if until <= begin:
            continue
        if rows and begin < rows[-1][1]:
            rows[-1][1] = max(rows[-1][1], until)
            rows[-1][4] = _RESTART if _RESTART in (rows[-1][4], cause) else rows[-1][4]
        else:
            rows.append([begin, until, 0, 0, int(cause)])
    table = np.array(rows, dtype=np.int64).reshape(-1, 5)
    table[:, 2] = table[:, 1] - table[:, 0]
    return table


def _make_setup(
    model: Model, frame: _Frame, table: NDArray[np.int64], effect: Effect, rows: tuple[int, ...]
) -> Setup:
    """Make the setup of an effect; its parameters with one number per axis must fit the rows."""
    factor = 1 if effect.stage == "logger" else frame.oversampling
    axes = tuple(frame.axes[row] for row in rows)
    noise = [model.coefficients(axis) for axis in axes]
    for item in effect.parameters():
        if item.many and getattr(effect, item.name):
            effect.expand_to_axes(item.name, axes)
    return Setup(
        rate=frame.rate * factor,
        size=frame.size * factor,
        start=frame.start,
        axes=axes,
        noise={term: np.array([coefficients[term] for coefficients in noise]) for term in TERMS},
        gaps=table[:, :2] * factor,
        restarts=table[table[:, 4] == _RESTART, :2] * factor,
        oversampling=frame.oversampling,
    )


def _convert_units(effect: Effect, environment: xr.Dataset, present: list[str]) -> dict[str, float]:
    """Compute the unit conversion of an effect's channels; `SchemaError` for a wrong one."""
    factors = {}
    names = effect.channel_names()
    for role in effect.needs():
        if names[role] not in present:
            raise driver_error(effect, role, present)
        expected, units = effect.channels[role], str(environment[names[role]].attrs.get("units"))
        if units == expected:
            continue
        with contextlib.suppress(UnitError):
            source, target = parse_unit(units), parse_unit(expected)
            if source.quantity == target.quantity and source.offset == target.offset:
                factors[role] = source.factor / target.factor
                continue
        raise SchemaError(
            f"effect {effect.name!r} needs {names[role]!r} in {expected}; "
            f"the channel is in {units!r}"
        )
    return factors


def _make_plan(
    model: Model,
    frame: _Frame,
    environment: xr.Dataset,
    tables: tuple[NDArray[np.int64], NDArray[np.int64]],
    like: xr.Dataset | None,
) -> Plan:
    """Make the plan from the tables of all gaps, and of those that a recording does not have."""
    table, lost = tables
    present = log_channels(environment)
    measured = [] if like is None else log_channels(like)
    steps = []
    for effect in sorted(model.effects, key=lambda effect: STAGES.index(effect.stage)):
        rows = tuple(frame.axes.index(axis) for axis in effect.axes or frame.axes)
        setup = _make_setup(model, frame, table, effect, rows)
        factors = _convert_units(effect, environment, present)
        steps.append(Step(effect, setup, rows, factors, _choose_sources(effect, measured)))
    needed = {name for step in steps for name in step.sources.values()}
    turning = ""
    if "rotation_rate" in present:
        turning = str(environment["rotation_rate"].attrs.get("rotation_axis", ""))
    if turning and turning not in frame.axes:
        raise OptionError(
            f"{model.source}: the tool rotates about the axis {turning!r}, which the log "
            f"does not have; it has {', '.join(frame.axes)}"
        )
    if turning:
        needed.add("rotation_rate")
    recorded = _recorded_rates(model, frame, steps, like)
    return Plan(
        rate=frame.rate,
        oversampling=frame.oversampling,
        start=frame.start,
        axes=frame.axes,
        coefficients=tuple(model.coefficients(axis) for axis in frame.axes),
        steps=tuple(steps),
        sources={
            **{
                name: make_course(environment, name.removeprefix(_COURSE))
                if name.startswith(_COURSE)
                else make_source(environment, name)
                for name in sorted(needed)
            },
            **{f"{_RECORDED}{axis}": source for axis, source in recorded.items()},
        },
        turning=turning,
        gaps=lost[:, :2],
        recorded={axis: f"{_RECORDED}{axis}" for axis in recorded},
        bias=tuple(model.bias.get(axis, 0.0) for axis in frame.axes),
    )


def _choose_sources(effect: Effect, measured: list[str]) -> dict[str, str]:
    """Return the source of each channel that an effect needs: a measured one without its noise."""
    names = effect.channel_names()
    return {
        role: f"{_COURSE}{names[role]}"
        if role in effect.courses() and names[role] in measured
        else names[role]
        for role in effect.needs()
    }


def _recorded_rates(
    model: Model, frame: _Frame, steps: list[Step], like: xr.Dataset | None
) -> dict[str, Source]:
    """The recorded rates that effects need, by axis."""
    sources: dict[str, Source] = {}
    for effect in (step.effect for step in steps):
        for axis in effect.recorded_axes():
            if like is None or signal_name(like) != "rate":
                raise SchemaError(
                    f"effect {effect.name!r} follows the recorded rate of axis {axis!r}; give a "
                    "recording of rates as like (--like RECORDING), or a model with the motion and "
                    'motion = "true"'
                )
            if axis not in frame.axes:
                raise SchemaError(
                    f"{model.source}: effect {effect.name!r} needs the rate of axis {axis!r}, "
                    f"which the log does not have; it has {', '.join(frame.axes)}"
                )
            sources[axis] = make_source(like["rate"].sel(axis=axis).to_dataset(name="rate"), "rate")
    return sources


def _noise_terms(plan: Plan, row: int) -> str:
    """Noise terms of an axis that some stretch may hold."""
    changed = "".join(
        step.effect.terms
        for step in plan.steps
        if step.effect.stage == "noise" and row in step.rows
    )
    return "".join(term for term in "QNBK" if plan.coefficients[row][term] > 0.0 or term in changed)


def _begin_states(plan: Plan, seed: int) -> BlockState:
    counts: dict[str, int] = {}
    states = []
    for step in plan.steps:
        name = step.effect.name
        counts[name] = counts.get(name, 0) + 1
        states.append(step.effect.begin(step.setup, stream(seed, "effect", name, counts[name])))
    return BlockState(states)


def _mark_missing(data: Any, signal: Any) -> Any:
    """The samples that are NaN in `signal` are lost here too."""
    import dask.array as da

    return da.where(da.isnan(da.asarray(signal)).rechunk(data.chunks), np.nan, data)


def _label_log(
    model: Model, frame: _Frame, environment: xr.Dataset, table: NDArray[np.int64], data: Any
) -> xr.Dataset:
    gaps = [name for name, variable in environment.variables.items() if variable.dims == ("gap",)]
    log = environment.drop_vars(gaps).assign(
        {
            "rate": (
                ("axis", "time"),
                data,
                {"units": SIGNAL_UNITS["rate"], "long_name": SIGNAL_LONG_NAMES["rate"]},
            ),
            **gap_variables(table, frame.start, frame.rate),
        }
    )
    log = log.assign_coords(axis=("axis", list(frame.axes), attributes("axis")))
    if "time" not in log.coords:
        log = log.assign_coords(time_coordinate(frame.start, frame.rate, frame.size))
    now = time_of_day()
    log.attrs = {
        "sampling_rate_hz": frame.rate,
        "kind": "rate",
        "source_files": [model.source],
        "history": f"{now} gyrostab.simulate: {frame.size} samples "
        f"at {frame.rate:.10g} Hz, seed {frame.seed}",
        "notes": [],
        "simulation_model": model.text,
        "simulation_seed": frame.seed,
    }
    check_log(log)
    return log

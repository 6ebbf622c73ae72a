"""Model to log: the plan of a simulation, and the lazy blocks."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Ints
from gyrostab.errors import OptionError, SchemaError, UnitError
from gyrostab.ingest.convert import as_log
from gyrostab.ingest.gap_table import gap_variables
from gyrostab.noise import TERMS
from gyrostab.physics.base import STAGES, Effect, Setup, driver_error
from gyrostab.physics.registry import close_to
from gyrostab.schema import (
    SIGNAL_LONG_NAMES,
    SIGNAL_UNITS,
    attributes,
    check_log,
    log_channels,
    signal_name,
)
from gyrostab.schema.delays import move_channels
from gyrostab.simulate.block import BlockState, SimulationPlan, Step, lazy_rates
from gyrostab.simulate.channels import combine
from gyrostab.simulate.drivers import DriverChannel, make_course, make_source
from gyrostab.simulate.frame import (
    RESTART,
    Frame,
    add_environment,
    check_axes,
    convert_gaps,
    make_frame,
    take_environment,
)
from gyrostab.simulate.model import Model, naming_of, read_model
from gyrostab.simulate.noise import begin_noise, stream
from gyrostab.time.grid import time_coordinate
from gyrostab.time.stamps import time_of_day
from gyrostab.units import parse_unit

#: Samples of the instrument in one block of the lazy log.
BLOCK = 2**17
_RECORDED = "recorded rate of "  # source of an effect, in front of the name of the axis
_COURSE = "course of "  # source of an effect, in front of the name of a recorded channel


class GapTables(NamedTuple):
    """Gaps of the log by `convert_gaps`, in which gaps that overlap are one."""

    all: Ints
    restarts: Ints  # losses of power, without other gaps that overlap them
    added: Ints  # gaps that a recording does not have


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
        Sampling rate [Hz]; that of the model by default.
    start : str or datetime, optional
        Time of the first sample; text is ISO 8601, UTC unless it has an offset. That of the model
        by default, or 1970-01-01.
    seed : int, optional
        The same seed gives the same bits, whatever the chunks; with and without effects it gives
        the same noise. That of the model by default, or 0.
    like : xarray.Dataset, optional
        Regular log whose stamps, gaps and channels are taken; rate and start are then its own, and
        its axes those that the model names, or all.
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
    if chunk is not None and not (isinstance(chunk, int | np.integer) and chunk >= 1):
        raise OptionError(f"chunk={chunk!r}: give a whole number of samples, at least 1")
    frame = make_frame(made, duration=duration, rate=rate, start=start, seed=seed, like=like)
    check_axes(made, frame)
    with naming_of(made.source):
        added = add_environment(made, frame, like, environment)
        environment = combine(*([] if like is None else [take_environment(like)]), added)
        environment = environment.drop_attrs(deep=False)
        tables = GapTables(
            convert_gaps(environment, frame),
            convert_gaps(environment, frame, only=RESTART),
            convert_gaps(added, frame),
        )
        plan = _make_plan(made, frame, environment, tables, like)
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
        plan, state, starts, frame.size, chunk=chunk or max(1, BLOCK // frame.oversampling)
    )
    if like is not None:
        import dask.array as da

        signal = like[signal_name(like)].sel(axis=list(frame.axes)).transpose("axis", "time")
        recorded = da.asarray(signal.data)
        data = da.where(da.isnan(recorded).rechunk(data.chunks), np.nan, data)
    return _label_log(made, frame, environment, tables.all, data)


def _make_setup(
    model: Model, frame: Frame, tables: GapTables, effect: Effect, rows: tuple[int, ...]
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
        axes=axes,
        noise={term: np.array([coefficients[term] for coefficients in noise]) for term in TERMS},
        gaps=tables.all[:, :2] * factor,
        restarts=tables.restarts[:, :2] * factor,
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
    model: Model, frame: Frame, environment: xr.Dataset, tables: GapTables, like: xr.Dataset | None
) -> SimulationPlan:
    present = log_channels(environment)
    for name in model.delay:
        if name not in present:
            raise OptionError(
                f"{model.source}: [delay]: the log has no channel {name!r}"
                f"{close_to(name, present)}; it has {', '.join(present) or 'none'}"
            )
    environment = move_channels(environment, model.delay)
    measured = [] if like is None else log_channels(like)
    steps = []
    for effect in sorted(model.effects, key=lambda effect: STAGES.index(effect.stage)):
        rows = tuple(frame.axes.index(axis) for axis in effect.axes or frame.axes)
        setup = _make_setup(model, frame, tables, effect, rows)
        factors = _convert_units(effect, environment, present)
        steps.append(Step(effect, setup, rows, factors, _choose_sources(effect, measured)))
    needed = {name for step in steps for name in step.sources.values()}
    turning = ""
    if "rotation_rate" in present:
        turning = str(environment["rotation_rate"].attrs.get("rotation_axis", ""))
    if turning and turning not in frame.axes and "rotation_rate" not in measured:
        raise OptionError(
            f"{model.source}: the tool rotates about the axis {turning!r}, which the log "
            f"does not have; it has {', '.join(frame.axes)}"
        )
    if turning:
        needed.add("rotation_rate")
    recorded = _recorded_rates(model, steps, like)
    return SimulationPlan(
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
        gaps=tables.added[:, :2],
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
    model: Model, steps: list[Step], like: xr.Dataset | None
) -> dict[str, DriverChannel]:
    """The recorded rates that effects need, by axis."""
    sources: dict[str, DriverChannel] = {}
    for effect in (step.effect for step in steps):
        for axis in effect.recorded_axes():
            if like is None or signal_name(like) != "rate":
                raise SchemaError(
                    f"effect {effect.name!r} follows the recorded rate of axis {axis!r}; give a "
                    "recording of rates as like (--like RECORDING), or a model with the motion and "
                    'motion = "true"'
                )
            if axis not in like["axis"].values:
                raise SchemaError(
                    f"{model.source}: effect {effect.name!r} needs the rate of axis {axis!r}, "
                    f"which the log does not have; it has {', '.join(like['axis'].values)}"
                )
            sources[axis] = make_source(like["rate"].sel(axis=axis).to_dataset(name="rate"), "rate")
    return sources


def _noise_terms(plan: SimulationPlan, row: int) -> str:
    """Noise terms of an axis that some stretch may hold."""
    changed = "".join(
        step.effect.terms
        for step in plan.steps
        if step.effect.stage == "noise" and row in step.rows
    )
    return "".join(term for term in "QNBK" if plan.coefficients[row][term] > 0.0 or term in changed)


def _begin_states(plan: SimulationPlan, seed: int) -> BlockState:
    counts: dict[str, int] = {}
    states = []
    for step in plan.steps:
        name = step.effect.name
        counts[name] = counts.get(name, 0) + 1
        states.append(step.effect.begin(step.setup, stream(seed, "effect", name, counts[name])))
    return BlockState(states)


def _label_log(
    model: Model, frame: Frame, environment: xr.Dataset, table: Ints, data: Any
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

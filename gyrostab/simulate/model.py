"""Model of a log (noise, effects, environment, frame) from TOML or a dict; see docs/simulate.md."""

from __future__ import annotations

import inspect
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gyrostab.errors import FormatError, GyrostabError, OptionError
from gyrostab.noise import LAWS, TERMS
from gyrostab.physics.base import Effect
from gyrostab.physics.registry import amount, close_to, is_model_number, make_effect
from gyrostab.simulate import environment, losses
from gyrostab.simulate.noise import FLICKER_LOW
from gyrostab.simulate.turning import rotation
from gyrostab.store.toml import parse_toml, read_toml_text
from gyrostab.time.durations import duration_seconds
from gyrostab.time.stamps import stamp_ns
from gyrostab.units import DAY

#: Largest noise coefficient: its square, and sums of squares, stay within the range of numbers.
_MAX_COEFFICIENT = 1e100
#: Largest bias [deg/h], and largest delay [s]: a day.
_LARGEST = {"bias": _MAX_COEFFICIENT, "delay": DAY}

#: Function of the environment -> (the function, unit of each number).
PROFILES: dict[str, tuple[Callable[..., Any], dict[str, str]]] = {
    "steps": (environment.steps, {"sensor_rate": "Hz"}),
    "ramps": (environment.ramps, {"sensor_rate": "Hz"}),
    "vibration": (environment.vibration, {"band": "Hz", "sensor_rate": "Hz"}),
    "chamber": (
        environment.chamber,
        {
            "low": "degC",
            "high": "degC",
            "speed": "degC/min",
            "hold": "s",
            "lag": "s",
            "sensor_rate": "Hz",
        },
    ),
    "trip": (
        environment.trip,
        {
            "surface": "degC",
            "gradient": "degC/km",
            "cooling": "1",
            "response": "s",
            "sensor_rate": "Hz",
        },
    ),
    "rotation": (
        rotation,
        {
            "stick_slip": "1",
            "period": "s",
            "inclination": "deg",
            "toolface": "deg",
            "sensor_rate": "Hz",
        },
    ),
    "supply": (environment.supply, {"full": "V", "empty": "V", "life": "s", "sensor_rate": "Hz"}),
    "light_power": (environment.light_power, {"power": "W", "loss": "dB", "sensor_rate": "Hz"}),
    "gaps": (losses.gaps, {}),
    "losses": (
        losses.losses,
        {"per_hour": "1", "mean": "s", "bursts_per_hour": "1", "burst": "s", "within": "1"},
    ),
    "power_cuts": (losses.power_cuts, {"per_day": "1", "mean": "s"}),
}
_GIVEN = ("duration", "start")  # by the log, not by the table of a profile
_WORDS = ("channel", "unit", "axis", "first")
_LISTS = ("points", "spans", "cuts", "depths", "circulation", "loads", "band")
_LOG = ("rate", "duration", "start", "seed", "axes", "oversampling")


@dataclass(frozen=True)
class Model:
    """Model from which `gyrostab.simulate` makes a log."""

    axes: tuple[str, ...] = ()  # axes that the model names; empty when it names none
    #: Axis (or "" for all others) -> symbol -> coefficient [unit of the noise table].
    noise: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    #: Lowest and highest frequency of B [Hz]
    flicker_band: tuple[float, float] = (FLICKER_LOW, math.inf)
    #: Constant rate of axes [deg/h]; 0 for others
    bias: Mapping[str, float] = field(default_factory=dict)
    #: Channel -> by how much its time stamps are late [s]; 0 for others
    delay: Mapping[str, float] = field(default_factory=dict)
    effects: tuple[Effect, ...] = ()  #
    #: Function of `PROFILES` and its arguments
    environment: tuple[tuple[str, Mapping[str, Any]], ...] = ()
    #: What the model gives of rate [Hz], duration [s], start, seed and oversampling.
    log: Mapping[str, Any] = field(default_factory=dict)
    source: str = "model"  # where the model came from
    text: str = ""  # the model as it was written

    def coefficients(self, axis: str) -> dict[str, float]:
        """Noise coefficients of an axis, all five."""
        return {**dict.fromkeys(TERMS, 0.0), **self.noise.get("", {}), **self.noise.get(axis, {})}


@contextmanager
def naming_of(source: str) -> Iterator[None]:
    """Name the model in errors of functions that take its numbers."""
    try:
        yield
    except GyrostabError as error:
        if str(error).startswith(source):
            raise
        raise type(error)(f"{source}: {error}") from error


def read_model(model: str | os.PathLike[str] | Mapping[str, Any]) -> Model:
    """Read a model from a TOML file or from the same tables as a dict.

    Parameters
    ----------
    model : path-like or mapping
        The file, or its tables ``log``, ``noise``, ``bias``, ``environment``, ``effect`` as in
        ``docs/simulate.md``. Numbers are in the units of the coefficients (Q [urad], N
        [deg/sqrt(h)], B [deg/h], K [deg/h^1.5], R [deg/h^2]) and of the parameters of the effects;
        text carries its unit.

    Returns
    -------
    Model
        What `gyrostab.simulate` takes, with all numbers in those units.

    Raises
    ------
    FormatError
        When the file is not TOML or cannot be read.
    OptionError
        When `model` is neither, or a name, a parameter or a unit is unknown or missing; the message
        names it and lists what exists.

    Examples
    --------
    >>> read_model({"noise": {"N": 0.003, "z": {"N": "0.005 deg/sqrt(h)"}}}).coefficients("z")["N"]
    0.005
    """
    where, tables, text = _read_tables(model)
    _check_sections(tables, where)
    noise, band = _read_noise(tables.get("noise", {}), where)
    effects = [
        make_effect(table, where=f"{where}, effect {number}")
        for number, table in enumerate(tables.get("effect", []), start=1)
    ]
    profiles = [
        _read_profile(table, f"{where}, environment {number}")
        for number, table in enumerate(tables.get("environment", []), start=1)
    ]
    log = _read_log_section(tables.get("log", {}), where)
    axes = tuple(log.pop("axes", ())) or _list_axes(noise, effects)
    parsed_model = Model(
        axes,
        noise,
        band,
        _read_numbers("bias", tables, "deg/h", "an axis of the log", where),
        _read_numbers("delay", tables, "s", "a channel of the log", where),
        tuple(effects),
        tuple(profiles),
        log,
        source=where,
        text=text,
    )
    _check_axes(parsed_model)
    return parsed_model


def _read_tables(
    model: str | os.PathLike[str] | Mapping[str, Any],
) -> tuple[str, dict[str, Any], str]:
    """Read the tables of a model; return what to call it in messages, the tables and their text."""
    if isinstance(model, Mapping):
        try:
            return "model", dict(model), json.dumps(model, default=str)
        except (TypeError, ValueError) as error:
            raise OptionError(
                f"the mapping of the model cannot be kept as text ({error}); "
                "give the tables of docs/simulate.md, with names as text"
            ) from error
    if not isinstance(model, str | os.PathLike):
        raise OptionError(
            f"the model is of type {type(model).__name__}; give a TOML file, a mapping of its "
            "tables, such as that of a diagnosis (diagnosis.model), or what gyrostab.read_model "
            "returns"
        )
    path = Path(model)
    try:
        text = read_toml_text(path)
        return str(model), parse_toml(text), text
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not a TOML file ({error})") from error


def _check_sections(tables: Mapping[str, Any], where: str) -> None:
    """Raise `OptionError` for an unknown section, and for one that is not a table or a list."""
    sections = ("log", "noise", "bias", "delay", "effect", "environment")
    for key, table in tables.items():
        if key not in sections:
            raise OptionError(
                f"{where}: there is no section {key!r}{close_to(key, sections)}; "
                "there are [log], [noise], [bias], [delay], [[effect]], [[environment]]"
            )
        if not isinstance(table, list if key in ("effect", "environment") else Mapping):
            raise OptionError(
                f"{where}: write {key} as "
                f"{'[[' + key + ']]' if key in ('effect', 'environment') else '[' + key + ']'}"
            )
    for key in ("effect", "environment"):
        for number, table in enumerate(tables.get(key, []), start=1):
            if not isinstance(table, Mapping):
                raise OptionError(
                    f"{where}: {key} {number} is {table!r}, not a table; "
                    f"write [[{key}]] and its parameters below"
                )


def _read_noise(
    table: Mapping[str, Any], where: str
) -> tuple[dict[str, dict[str, float]], tuple[float, float]]:
    noise: dict[str, dict[str, float]] = {}
    band = (FLICKER_LOW, math.inf)
    for key, value in table.items():
        if key == "flicker_band":
            edges = amount(value, "Hz", f"{where}: flicker_band")
            if not (
                isinstance(edges, list)
                and len(edges) == 2
                and all(isinstance(edge, int | float) for edge in edges)
            ):
                raise OptionError(
                    f"{where}: flicker_band is {value!r}; write [lowest, highest] frequency in Hz"
                )
            band = (float(edges[0]), float(edges[1]))
        elif isinstance(value, Mapping):
            noise[key] = {
                term: _read_coefficient(term, number, f"{where}, [noise.{key}]")
                for term, number in value.items()
            }
        else:
            noise.setdefault("", {})[key] = _read_coefficient(key, value, f"{where}, [noise]")
    return noise, band


def _read_numbers(
    section: str, tables: Mapping[str, Any], unit: str, owner: str, where: str
) -> dict[str, float]:
    """Read a section with one number for each axis or channel."""
    numbers = {}
    for name, value in tables.get(section, {}).items():
        number = amount(value, unit, f"{where}: {section} of {name}")
        if not is_model_number(number) or not abs(number) <= _LARGEST[section]:
            raise OptionError(
                f"{where}, [{section}]: {name} = {value!r} is not a number up to "
                f"{_LARGEST[section]:g}; give one in {unit} for {owner}"
            )
        numbers[name] = float(number)
    return numbers


def _read_coefficient(term: str, value: Any, where: str) -> float:
    if term not in LAWS:
        listed = ", ".join(f"{symbol} [{law.label}]" for symbol, law in LAWS.items())
        raise OptionError(
            f"{where}: there is no noise term {term!r}; "
            f"there are {listed}, and flicker_band in [noise]"
        )
    number = amount(value, LAWS[term].label, f"{where}: {term}")
    if (
        not is_model_number(number)
        or not abs(number) <= _MAX_COEFFICIENT
        or (number < 0 and term != "R")
    ):
        raise OptionError(
            f"{where}: {term} = {value!r} is not a number from 0 to {_MAX_COEFFICIENT:g}; give one "
            f"in {LAWS[term].label}"
        )
    return float(number)


def _read_log_section(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    section: dict[str, Any] = {}
    for key, value in table.items():
        if key not in _LOG:
            raise OptionError(
                f"{where}, [log]: there is no {key!r}{close_to(key, _LOG)}; "
                f"there are {', '.join(_LOG)}"
            )
        section[key] = (
            amount(value, {"rate": "Hz", "duration": "s"}[key], f"{where}: {key}")
            if key in ("rate", "duration")
            else value
        )
    for key in ("seed", "oversampling"):
        if key in section and (
            not isinstance(section[key], int)
            or isinstance(section[key], bool)
            or section[key] < (key == "oversampling")
        ):
            raise OptionError(
                f"{where}, [log]: {key} = {section[key]!r} is not a whole number "
                f"{'above 0' if key != 'seed' else 'from 0 up'}"
            )
    axes = section.get("axes", ["x"])
    if (
        not isinstance(axes, list | tuple)
        or not axes
        or not all(isinstance(axis, str) and axis for axis in axes)
        or len(set(axes)) < len(axes)
    ):
        raise OptionError(
            f"{where}, [log]: axes = {axes!r} is not a list of different names; "
            'write for instance axes = ["x", "y", "z"]'
        )
    if section.get("oversampling", 1) > 1000:
        raise OptionError(
            f"{where}, [log]: oversampling = {section['oversampling']!r} is more than 1000"
        )
    with naming_of(where):
        if "start" in section:
            section["start"] = str(section["start"])
            stamp_ns(section["start"])
        if "duration" in section:
            duration_seconds(section["duration"], "duration")
    return section


def _list_axes(noise: Mapping[str, Any], effects: list[Effect]) -> tuple[str, ...]:
    if "" in noise or not noise:
        return ()
    named = [axis for axis in noise if axis] + [axis for effect in effects for axis in effect.axes]
    return tuple(dict.fromkeys(named))


def _check_axes(model: Model) -> None:
    if not model.axes:
        return
    for effect in model.effects:
        unknown = [axis for axis in effect.axes if axis not in model.axes]
        if unknown:
            raise OptionError(
                f"{model.source}: effect {effect.name!r}: the log has no axis {unknown[0]!r}; "
                f"it has {', '.join(model.axes)}"
            )


def _read_profile(table: Mapping[str, Any], where: str) -> tuple[str, Mapping[str, Any]]:
    name = table.get("profile")
    if not isinstance(name, str) or name not in PROFILES:
        problem = (
            "an environment has no profile"
            if name is None
            else f"there is no profile {name!r}{close_to(name, list(PROFILES))}"
        )
        raise OptionError(f"{where}: {problem}; there are {', '.join(PROFILES)}")
    function, units = PROFILES[str(name)]
    arguments = {
        key: item
        for key, item in inspect.signature(function).parameters.items()
        if key not in _GIVEN
    }
    values = {key: value for key, value in table.items() if key != "profile"}
    _check_arguments(str(name), values, arguments, where)
    converted = {
        key: amount(value, units[key], f"{where}: {key}") if key in units else value
        for key, value in values.items()
    }
    for key, unit in units.items():
        number = converted.get(key, 0.0)
        if key != "band" and not (is_model_number(number) and math.isfinite(number)):
            raise OptionError(f"{where}: {key} = {number!r} is not a number; give one in {unit}")
    return str(name), converted


def _check_arguments(
    name: str,
    values: Mapping[str, Any],
    arguments: Mapping[str, inspect.Parameter],
    where: str,
) -> None:
    """Raise `OptionError` for parameters that are unknown, missing, or of a wrong type."""
    units = PROFILES[name][1]
    listed = ", ".join(f"{item} [{units[item]}]" if item in units else item for item in arguments)
    for key in values:
        if key not in arguments:
            raise OptionError(
                f"{where}: profile {name!r} has no parameter {key!r}"
                f"{close_to(key, list(arguments))}; it has {listed}"
            )
    for key, item in arguments.items():
        if item.default is inspect.Parameter.empty and key not in values:
            raise OptionError(
                f"{where}: profile {name!r} lacks the parameter {key!r}; it has {listed}; "
                "see docs/simulate.md"
            )
    for key, value in values.items():
        kind, expected = (
            (str, "text")
            if key in _WORDS
            else (list | tuple, "a list")
            if key in _LISTS
            else (bool, "true or false")
            if isinstance(arguments[key].default, bool)
            else (object, "")
        )
        if not isinstance(value, kind) or value == "":
            raise OptionError(f"{where}: {key} = {value!r} is not {expected or 'a value'}")

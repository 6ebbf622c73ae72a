"""Registry of the effects that the modules of this package define."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import pkgutil
import re
from collections.abc import Mapping, Sequence
from functools import cache
from numbers import Real
from types import MappingProxyType
from typing import Any, TypeGuard

import pandas as pd

from gyrostab.errors import OptionError, UnitError
from gyrostab.physics.base import Effect
from gyrostab.units import DAY, HOUR, parse_unit


@cache
def effects() -> Mapping[str, type[Effect]]:
    """Map the name of every effect in `gyrostab.physics` to its class, sorted by name.

    Examples
    --------
    >>> effects()["temperature_bias"].short
    'bias follows T'
    """
    package = importlib.import_module("gyrostab.physics")
    classes: dict[str, type[Effect]] = {}
    for module in pkgutil.iter_modules(package.__path__):
        home = f"{package.__name__}.{module.name}"
        for item in vars(importlib.import_module(home)).values():
            if not (
                isinstance(item, type)
                and issubclass(item, Effect)
                and item.__module__ == home
                and item.name
            ):
                continue
            if item.name in classes:
                raise TypeError(
                    f"two effects have the name {item.name!r}: "
                    f"{classes[item.name].__module__} and {home}"
                )
            classes[item.name] = item
    return MappingProxyType(dict(sorted(classes.items())))


def make_effect(table: Mapping[str, Any], *, where: str = "effect") -> Effect:
    """Make an effect from its table in a model.

    Parameters
    ----------
    table : mapping
        ``name``, ``axes``, ``driver``, and the parameters: numbers in the unit of the reference, or
        text with a unit ("3 min").
    where : str
        Beginning of a message, for instance the file.

    Raises
    ------
    OptionError
        When a name is unknown, a required parameter is missing, or a value, its unit or its range
        is wrong; it lists what exists.

    Examples
    --------
    >>> make_effect({"name": "temperature_bias", "sensitivity": 0.002}).reference
    25.0
    >>> make_effect({"name": "temperature_bais"})  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    gyrostab.errors.OptionError: effect: there is no effect 'temperature_bais' (did you mean ...
    """
    name = table.get("name")
    if name is None:
        raise OptionError(
            f"{where}: an effect has no name; write name = ... with one of {', '.join(effects())}"
        )
    if not isinstance(name, str) or name not in effects():
        raise OptionError(
            f"{where}: there is no effect {name!r}{close_to(name, list(effects()))}; "
            f"there are {', '.join(effects())}"
        )
    kind = effects()[name]
    parameters = {item.name: item for item in kind.parameters()}
    values = {key: value for key, value in table.items() if key != "name"}
    for key in values:
        if key not in parameters and key not in ("axes", "driver"):
            listed = ", ".join(f"{item.name} [{item.unit}]" for item in parameters.values())
            raise OptionError(
                f"{where}: effect {name!r} has no parameter "
                f"{key!r}{close_to(key, list(parameters))}; "
                f"it has {listed}, and axes and driver"
            )
    for key in ("axes", "driver"):
        names = values.get(key, [])
        if not isinstance(names, str) and not (
            isinstance(names, list | tuple) and all(isinstance(entry, str) for entry in names)
        ):
            raise OptionError(f"{where}: effect {name!r}: {key} = {names!r} is not a list of names")
    for key in kind.required():
        if key not in values:
            item = parameters[key]
            raise OptionError(
                f"{where}: effect {name!r} lacks the parameter {key!r} ({item.meaning}); "
                f"give a number in {item.unit}, for instance {item.typical}"
            )
    try:
        return kind(
            **{
                key: amount(value, definition.unit, f"parameter {key!r}", definition.difference)
                if (definition := parameters.get(key)) and not definition.choices
                else value
                for key, value in values.items()
            }
        )
    except OptionError as error:
        raise OptionError(f"{where}: {error}") from error


def close_to(word: Any, words: Sequence[str]) -> str:
    """Suggest the nearest known word for the end of a message, if there is one."""
    close = difflib.get_close_matches(str(word), words, 1)
    return f" (did you mean {close[0]!r}?)" if close else ""


_SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": HOUR, "d": DAY}
_HERTZ = {"mHz": 1e-3, "Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "1/min": 1 / 60}


def is_model_number(value: Any) -> TypeGuard[float]:
    """Test whether a value of a model is a number, which true and false are not."""
    return isinstance(value, Real) and not isinstance(value, bool)


def amount(value: Any, unit: str, where: str, difference: bool = False) -> Any:
    """Read a value of a model in `unit`: a number, text such as ``"3 min"``, or a list of these.

    A `difference` is converted without the zero point of its scale.

    Raises
    ------
    OptionError
        When the text is not a number with a matching unit.

    Examples
    --------
    >>> amount("3 min", "s", "lag"), amount("300 K", "degC", "reference")
    (180.0, 26.85...)
    """
    if isinstance(value, list | tuple):
        return [amount(entry, unit, where, difference) for entry in value]
    if not isinstance(value, str):
        return value
    match = re.fullmatch(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*", value)
    if match is None:
        raise OptionError(
            f"{where}: {value!r} is not a number with a unit; write for instance '1 {unit}'"
        )
    number, symbol = float(match.group(1)), match.group(2)
    if symbol in ("", unit):
        return number
    for table in (_SECONDS, _HERTZ):
        if symbol in table and unit in table:
            return number * table[symbol] / table[unit]
    with contextlib.suppress(UnitError):
        source, target = parse_unit(symbol), parse_unit(unit)
        if source.quantity == target.quantity:
            offset = 0.0 if difference else source.offset - target.offset
            return (number * source.factor + offset) / target.factor
    raise OptionError(f"{where}: the unit {symbol!r} is not known here; give the number in {unit}")


def effect_table() -> pd.DataFrame:
    """Tabulate the parameters of all effects.

    Returns
    -------
    pandas.DataFrame
        Columns effect, parameter, unit, required, default, typical, low, high, meaning, source.

    Examples
    --------
    >>> table = effect_table()
    >>> table[table.effect == "temperature_bias"][["parameter", "unit", "required"]].head(1)
         parameter        unit  required
    ...  sensitivity  deg/h/degC      True
    """
    attributes = ("default", "typical", "low", "high", "meaning", "source")
    return pd.DataFrame(
        {
            "effect": name,
            "parameter": item.name,
            "unit": item.unit,
            "required": item.name in kind.required(),
            **{attribute: getattr(item, attribute) for attribute in attributes},
        }
        for name, kind in effects().items()
        for item in kind.parameters()
    )

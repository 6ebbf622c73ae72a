"""All effects by name: every `Effect` that a module of this package defines."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import pkgutil
from collections.abc import Mapping, Sequence
from functools import cache
from types import MappingProxyType
from typing import Any

import pandas as pd

from gyrostab.errors import OptionError, UnitError
from gyrostab.physics.base import Effect, Parameter
from gyrostab.units import parse_unit

__all__ = ["effect_table", "effects", "make_effect"]


@cache
def effects() -> Mapping[str, type[Effect]]:
    """Name -> class, of every effect in the modules of `gyrostab.physics`, sorted by name.

    Examples
    --------
    >>> effects()["temperature_bias"].short
    'bias follows T'
    """
    package = importlib.import_module("gyrostab.physics")
    found: dict[str, type[Effect]] = {}
    for module in pkgutil.iter_modules(package.__path__):
        home = f"{package.__name__}.{module.name}"
        for item in vars(importlib.import_module(home)).values():
            if not (isinstance(item, type) and issubclass(item, Effect) and item.__module__ == home and item.name):
                continue
            if item.name in found:
                raise TypeError(f"two effects have the name {item.name!r}: {found[item.name].__module__} and {home}")
            found[item.name] = item
    return MappingProxyType(dict(sorted(found.items())))


def make_effect(table: Mapping[str, Any], *, where: str = "effect") -> Effect:
    """Make an effect from its table in a model.

    Parameters
    ----------
    table : mapping
        ``name``, ``axes``, ``driver``, and the parameters: numbers in the unit of the reference, or text with a unit ("3 min").
    where : str
        Beginning of a message, for instance the file.

    Raises
    ------
    OptionError
        When a name is unknown, a required parameter is missing, or a value, its unit or its range is wrong; it lists what exists.

    Examples
    --------
    >>> make_effect({"name": "temperature_bias", "sensitivity": 0.002}).reference
    25.0
    >>> make_effect({"name": "temperature_bais"})
    Traceback (most recent call last):
    ...
    gyrostab.errors.OptionError: effect: there is no effect 'temperature_bais' (did you mean 'temperature_bias'?); there are ...
    """
    name = table.get("name")
    if name is None:
        raise OptionError(f"{where}: an effect has no name; write name = ... with one of {', '.join(effects())}")
    if name not in effects():
        raise OptionError(f"{where}: there is no effect {name!r}{_close(name, list(effects()))}; there are {', '.join(effects())}")
    kind = effects()[name]
    known = {item.name: item for item in kind.parameters()}
    values = {key: value for key, value in table.items() if key != "name"}
    for key in values:
        if key not in known and key not in ("axes", "driver"):
            listed = ", ".join(f"{item.name} [{item.unit}]" for item in known.values())
            raise OptionError(
                f"{where}: effect {name!r} has no parameter {key!r}{_close(key, list(known))}; it has {listed}, and axes and driver"
            )
    for key in kind.required():
        if key not in values:
            item = known[key]
            raise OptionError(
                f"{where}: effect {name!r} lacks the parameter {key!r} ({item.meaning}); give a number in {item.unit}, {_typical(item)}"
            )
    try:
        return kind(**{key: _number(value, known[key]) if key in known else value for key, value in values.items()})
    except OptionError as error:
        raise OptionError(f"{where}: {error}") from error


def _typical(item: Parameter) -> str:
    return f"for instance {item.typical}"


def _close(word: Any, words: Sequence[str]) -> str:
    close = difflib.get_close_matches(str(word), words, 1)
    return f" (did you mean {close[0]!r}?)" if close else ""


_SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
_HERTZ = {"mHz": 1e-3, "Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "1/min": 1 / 60}


def _number(value: Any, item: Parameter) -> Any:
    """A value of a model: numbers as they are, text "3 min" converted to the parameter's unit."""
    if isinstance(value, list):
        return [_number(one, item) for one in value]
    if not isinstance(value, str) or item.choices:
        return value
    number, _, unit = value.strip().partition(" ")
    try:
        amount = float(number)
    except ValueError:
        raise OptionError(f"parameter {item.name!r}: {value!r} is not a number with a unit; write for instance '1 {item.unit}'") from None
    unit = unit.strip()
    if unit in ("", item.unit):
        return amount
    for table in (_SECONDS, _HERTZ):
        if unit in table and item.unit in table:
            return amount * table[unit] / table[item.unit]
    with contextlib.suppress(UnitError):
        given, wanted = parse_unit(unit), parse_unit(item.unit)
        if given.quantity == wanted.quantity:
            return (amount * given.factor + given.offset - wanted.offset) / wanted.factor
    raise OptionError(f"parameter {item.name!r}: the unit {unit!r} is not known here; give the number in {item.unit}")


def effect_table() -> pd.DataFrame:
    """The reference of the effects: one row for each parameter.

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
    rows = []
    for name, kind in effects().items():
        must = kind.required()
        for item in kind.parameters():
            rows.append({"effect": name, "parameter": item.name, "unit": item.unit, "required": item.name in must} | _columns(item))
    return pd.DataFrame(rows)


def _columns(item: Parameter) -> dict[str, Any]:
    return {key: getattr(item, key) for key in ("default", "typical", "low", "high", "meaning", "source")}

"""Alarms of a live view: limits on the windows of a product, each said when it begins and ends."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import OptionError, UnitError
from gyrostab.noise import LAWS
from gyrostab.schema import split_coefficient
from gyrostab.units import INNER, Unit, parse_unit

_SYNTAX = re.compile(
    r"\s*(?:(?P<axis>\w+)\s*:)?\s*(?P<name>[A-Za-z]\w*)\s*(?P<sign>[<>])\s*"
    r"(?P<limit>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?P<unit>.*?)\s*"
)
_EXAMPLES = '"N>0.01 deg/sqrt(h)", "x:B>0.5 deg/h", "misfit>3", "loss>5 %", "temperature>125 degC"'
#: Quantities of every window, by their names in alarms, and their units.
_MISFIT, _LOSS = "misfit", "loss"
_UNITS = {**{symbol: law.label for symbol, law in LAWS.items()}, _MISFIT: "", _LOSS: "%"}


@dataclass
class Alarm:
    """A limit, and where it is exceeded now."""

    text: str  # as the user wrote it
    axis: str | None  # None for every axis
    name: str  # of the quantity
    sign: str  # < or >
    limit: float
    unit: str
    #: Axes on which it has begun; "" for a channel.
    active: set[str] = field(default_factory=set)

    def update(self, window: Mapping[str, Any]) -> list[dict[str, str]]:
        """Compare a window of `describe_windows`; return what begins or ends with it.

        A missing value, such as a coefficient that the window does not observe, changes nothing.
        """
        events = []
        for axis, value in self._find_values(window).items():
            if value is None:
                continue
            beyond = value > self.limit if self.sign == ">" else value < self.limit
            if beyond == (axis in self.active):
                continue
            (self.active.add if beyond else self.active.remove)(axis)
            where = f" of axis {axis}" if axis else ""
            unit = f" {self.unit}" if self.unit else ""
            state = "begins" if beyond else "ends"
            text = f"alarm {state}: {self.name}{where} is {value:.4g}{unit} ({self.text})"
            events.append({"time": str(window["time"]), "state": state, "text": text})
        return events

    def _find_values(self, window: Mapping[str, Any]) -> dict[str, float | None]:
        """Find the values of a window by axis."""
        if self.name in _UNITS:
            return {
                axis: values[self.name]
                for axis, values in window["axes"].items()
                if self.axis in (None, axis)
            }
        value, units = window["channels"][self.name]
        if value is None:
            return {"": None}
        unit = _find_unit(self.unit, units)
        return {"": None if unit is None else (value - unit.offset) / unit.factor}


def parse_alarm(text: str) -> Alarm:
    """Parse an alarm: ``[AXIS:]NAME>LIMIT UNIT`` or with ``<``.

    Parameters
    ----------
    text : str
        NAME is a coefficient (Q, N, B, K, R), ``misfit`` (chi2/dof), ``loss`` (share of the samples
        that are missing) or a channel.

    Raises
    ------
    OptionError
        When the text cannot be read, or the unit is not that of the quantity.

    Examples
    --------
    >>> alarm = parse_alarm("x: N > 0.01 deg/sqrt(h)")
    >>> alarm.axis, alarm.name, alarm.sign, alarm.limit, alarm.unit
    ('x', 'N', '>', 0.01, 'deg/sqrt(h)')
    """
    match = _SYNTAX.fullmatch(text)
    if match is None:
        raise OptionError(f"--alarm {text!r}: write NAME>LIMIT UNIT, for instance {_EXAMPLES}")
    axis, name, sign, limit, unit = match.group("axis", "name", "sign", "limit", "unit")
    if not math.isfinite(float(limit)):
        raise OptionError(f"--alarm {text!r}: the limit is not a finite number")
    expected = _UNITS.get(name)
    if expected is not None and unit.replace(" ", "") != expected:
        raise OptionError(
            f"--alarm {text!r}: the limit of {name} needs the unit {expected!r}; "
            + (f"convert it from {unit}" if unit else f"write {name}{sign}{limit} {expected}")
            if expected
            else f"--alarm {text!r}: {name} has no unit; write {name}{sign}{limit}"
        )
    if expected is None and axis is not None:
        raise OptionError(f"--alarm {text!r}: the channel {name} has no axis")
    return Alarm(" ".join(text.split()), axis, name, sign, float(limit), unit)


def check_alarms(alarms: Sequence[Alarm], window: Mapping[str, Any]) -> None:
    """Refuse alarms on axes, channels and units that a window of `describe_windows` lacks."""
    for alarm in alarms:
        if alarm.axis is not None and alarm.axis not in window["axes"]:
            raise OptionError(
                f"--alarm {alarm.text!r}: there is no axis {alarm.axis}; there are "
                f"{', '.join(window['axes'])}"
            )
        if alarm.name in _UNITS:
            continue
        if alarm.name not in window["channels"]:
            known_names = ", ".join([*_UNITS, *window["channels"]])
            raise OptionError(
                f"--alarm {alarm.text!r}: {alarm.name} is not one of {known_names}; a channel has "
                "the name that it has in the product, not that of its column"
            )
        units = window["channels"][alarm.name][1]
        if _find_unit(alarm.unit, units) is None:
            raise OptionError(
                f"--alarm {alarm.text!r}: {alarm.name} is in {units}; "
                f"write {alarm.name}{alarm.sign}{alarm.limit:g} {units}, or a unit that converts"
            )


def _find_unit(text: str, units: str) -> Unit | None:
    """Find how the unit of a limit converts to that of a channel; None if it does not."""
    if text == units:
        return Unit(text, "", 1.0)  # also of a quantity that gyrostab does not know
    quantity = next((quantity for quantity, unit in INNER.items() if unit == units), None)
    with suppress(UnitError):
        unit = parse_unit(text or "1", quantity)
        return unit if unit.quantity == quantity else None
    return None


def describe_windows(part: xr.Dataset) -> list[dict[str, Any]]:
    """Describe the windows of a part of a product, in memory, by plain numbers.

    Each has ``time``, ``end`` (ISO 8601), ``axes`` (axis to a dict of the coefficients, ``N_upper``
    ..., ``misfit``, ``loss`` [%]) and ``channels`` (name to value and unit). Missing values are
    None, and so is a coefficient that is not observed.
    """
    axes = [str(axis) for axis in part["axis"].values]
    fields = {}
    for symbol in map(str, part["term"].values):
        fields[symbol], fields[f"{symbol}_upper"] = split_coefficient(part, symbol)
    with np.errstate(invalid="ignore", divide="ignore"):
        fields[_MISFIT] = part["fit_chi2"].values / part["fit_dof"].values
    fields[_LOSS] = 100.0 * (1.0 - part["window_coverage"].values)
    channels = {
        str(name): (variable.values, str(variable.attrs.get("units", "1")))
        for name, variable in part.data_vars.items()
        if variable.dims == ("time",)
    }
    stamps = part["time"].values.astype("datetime64[ms]").astype(str)
    ends = part["time_bounds"].values[:, 1].astype("datetime64[ms]").astype(str)
    return [
        {
            "time": str(stamps[j]),
            "end": str(ends[j]),
            "axes": {
                axis: {name: _finite_or_none(values[i, j]) for name, values in fields.items()}
                for i, axis in enumerate(axes)
            },
            "channels": {
                name: (_finite_or_none(values[j]), units)
                for name, (values, units) in channels.items()
            },
        }
        for j in range(part.sizes["time"])
    ]


def _finite_or_none(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None

"""Unit strings that gyrostab reads and writes, and their factors.

Inside, every quantity has one unit (`INNER`). Readers convert at the door with `parse_unit`; nothing else converts.
The strings in `INNER` and `ON_DISK` are fixed constants: UDUNITS refuses ``deg`` and reads fractional powers wrongly,
so no unit string is ever built at run time.

References
----------
UDUNITS-2 unit database; CF conventions 1.11, section 3.1.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from gyrostab.errors import UnitError

__all__ = ["INNER", "ON_DISK", "Unit", "known_units", "on_disk", "parse_unit"]

#: Quantity -> the unit that every array of that quantity has in memory.
INNER = {
    "rate": "degree hour-1",
    "angle": "degree",
    "temperature": "degree_Celsius",
    "acceleration": "g",
    "rotation_rate": "degree s-1",
    "voltage": "V",
    "power": "W",
    "pressure": "Pa",
    "magnetic": "uT",
    "number": "1",
}

#: Units whose in-memory spelling UDUNITS would misread (``g`` is the gram) -> the spelling used in files.
ON_DISK = {"g": "9.80665 m s-2"}

_DEGREE = math.pi / 180.0
_RATE = 3600.0  # deg/s -> deg/h

# spelling -> (quantity, factor to the inner unit, offset in the inner unit)
_SPELLINGS: dict[str, tuple[str, float, float]] = {}


def _add(quantity: str, factor: float, *spellings: str, offset: float = 0.0) -> None:
    for spelling in spellings:
        _SPELLINGS[spelling] = (quantity, factor, offset)


_add("rate", 1.0, "deg/h", "deg/hr", "degree/hour", "degree hour-1", "degree h-1", "deg h-1", "dph", "°/h", "deg/hour")
_add("rate", _RATE, "deg/s", "deg/sec", "degree/second", "degree s-1", "deg s-1", "dps", "°/s", "degree/s")
_add("rate", _RATE / _DEGREE, "rad/s", "rad s-1", "radian s-1", "radian/s", "rad/sec")
_add("rate", 1e-3 * _RATE / _DEGREE, "mrad/s", "mrad s-1", "milliradian s-1")
_add("rate", 1e-6 * _RATE / _DEGREE, "urad/s", "urad s-1", "µrad/s", "μrad/s", "microradian s-1")
_add("rate", 1e-9 * _RATE / _DEGREE, "nrad/s", "nrad s-1", "nanoradian s-1")
_add("rate", 1.0, "arcsec/s", "arcsec s-1", "arcsecond s-1")  # 1 arcsec/s = 3600 arcsec/h = 1 deg/h
_add("rate", 6.0 * _RATE, "rpm", "RPM", "r/min", "rev/min")
_add("angle", 1.0, "deg", "degree", "degrees", "°")
_add("angle", 1.0 / 3600.0, "arcsec", "arcsecond", '"')
_add("angle", 1.0 / _DEGREE, "rad", "radian")
_add("angle", 1e-3 / _DEGREE, "mrad", "milliradian")
_add("angle", 1e-6 / _DEGREE, "urad", "microradian")
_add("temperature", 1.0, "degC", "C", "°C", "celsius", "degree_Celsius", "degrees_Celsius", "deg_C")
_add("temperature", 1.0, "K", "kelvin", offset=-273.15)
_add("temperature", 5.0 / 9.0, "degF", "F", "°F", "degree_Fahrenheit", offset=-160.0 / 9.0)
_add("acceleration", 1.0, "g", "gn", "gee", "9.80665 m s-2")
_add("acceleration", 1e-3, "mg", "milli-g")
_add("acceleration", 1.0 / 9.80665, "m/s^2", "m/s2", "m s-2", "m/s/s", "m/s²")
_add("voltage", 1.0, "V", "volt")
_add("voltage", 1e-3, "mV")
_add("power", 1.0, "W", "watt")
_add("power", 1e-3, "mW")
_add("power", 1e-6, "uW", "µW", "μW")
_add("pressure", 1.0, "Pa", "pascal")
_add("pressure", 1e2, "hPa", "mbar")
_add("pressure", 1e3, "kPa")
_add("pressure", 1e5, "bar")
_add("pressure", 1e6, "MPa")
_add("pressure", 6894.757293168361, "psi")
_add("magnetic", 1.0, "uT", "µT", "μT", "microtesla")
_add("magnetic", 1e-3, "nT", "nanotesla")
_add("magnetic", 1e6, "T", "tesla")
_add("magnetic", 100.0, "G", "gauss", "Gauss")
_add("number", 1.0, "1", "-", "count", "counts", "")

_NUMBER = re.compile(r"^([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*\*?\s*(.+)$")


@dataclass(frozen=True)
class Unit:
    """How a unit string converts: ``inner = value * factor + offset``, in ``INNER[quantity]``."""

    text: str
    quantity: str
    factor: float
    offset: float = 0.0


def _normal(text: str) -> str:
    """One spelling for ``rad s^-1``, ``rad*s**-1`` and ``rad s-1``."""
    text = text.strip().replace("**", "^").replace("^-", "-")
    return re.sub(r"\s+", " ", text)


def parse_unit(text: str) -> Unit:
    """Read a unit string, with an optional factor in front.

    Parameters
    ----------
    text : str
        For instance ``"deg/h"``, ``"rad s^-1"``, ``"0.1 arcsec/s"`` (a count of 0.1 arcsec/s).

    Returns
    -------
    Unit
        Quantity and the linear conversion to the inner unit.

    Raises
    ------
    UnitError
        When the string is not known; the message lists what is.

    Examples
    --------
    >>> parse_unit("deg/s").factor
    3600.0
    >>> parse_unit("0.1 arcsec/s").factor
    0.1
    >>> parse_unit("9.80665 m s-2").quantity
    'acceleration'
    """
    name = _normal(text)
    if name in _SPELLINGS:
        quantity, factor, offset = _SPELLINGS[name]
        return Unit(text, quantity, factor, offset)
    match = _NUMBER.match(name)
    if match and _normal(match.group(2)) in _SPELLINGS:
        quantity, factor, offset = _SPELLINGS[_normal(match.group(2))]
        scale = float(match.group(1))
        if scale == 0.0 or not math.isfinite(scale):
            raise UnitError(f"unit {text!r}: the factor {match.group(1)} is not usable; give a finite number other than 0")
        return Unit(text, quantity, factor * scale, offset)
    raise UnitError(f"unit {text!r} is not known; known are, for instance, {known_units('rate')} for gyro axes")


def known_units(quantity: str) -> str:
    """The spellings understood for a quantity, for messages.

    Examples
    --------
    >>> known_units("pressure")
    'Pa, hPa, kPa, bar, MPa, psi'
    """
    seen: dict[tuple[float, float], str] = {}
    for spelling, (name, factor, offset) in _SPELLINGS.items():
        if name == quantity:
            seen.setdefault((factor, offset), spelling)
    if quantity == "rate":
        seen[(1.0, 0.0)] = "deg/h, arcsec/s"
    return ", ".join(seen.values())


def on_disk(units: str) -> str:
    """The spelling of an inner unit that UDUNITS reads rightly."""
    return ON_DISK.get(units, units)

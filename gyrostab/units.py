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
import unicodedata
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
# (quantity, plain form of a spelling) -> the same; None where two spellings of a quantity differ in their case only
_PLAIN: dict[tuple[str, str], tuple[str, float, float] | None] = {}

# Words of unit strings -> the one form that `_plain` gives them.
_WORDS = {
    word: short
    for short, words in {
        "deg": "degree degrees degs",
        "rad": "radian radians",
        "mrad": "milliradian milliradians",
        "arcsec": "arcsecond arcseconds arcsecs asec",
        "s": "second seconds sec secs",
        "h": "hour hours hr hrs",
        "min": "minute minutes",
        "rev": "revolution revolutions revs turn turns",
        "celsius": "centigrade celcius",
        "gauss": "gausses",
        "count": "counts lsb",
    }.items()
    for word in words.split()
}


def _normal(text: str) -> str:
    """One spelling for ``rad s^-1``, ``rad*s**-1``, ``rad s⁻¹`` and ``rad s-1``; letters keep their case."""
    text = re.sub("[º˚]", "°", text.strip())  # ordinal sign and ring, often typed for the degree sign
    text = unicodedata.normalize("NFKC", text).replace("\N{MINUS SIGN}", "-")
    text = text.replace("**", "^").replace("^-", "-").replace("·", " ").replace("*", " ")
    return re.sub(r"\s+", " ", text)


def _plain(text: str) -> str:
    """The form in which spellings are compared where case, blanks and words such as `seconds` make no difference."""
    text = _normal(text).casefold().replace("°", "deg ").replace(" per ", "/").replace("^", "")
    text = re.sub(r"[a-zμ]+", lambda word: _WORDS.get(word[0], word[0]), text.replace("_", " "))
    text = re.sub(r"\s*/\s*", "/", text)
    text = re.sub(r"[ .]?\b([a-z]+)-([12])\b", lambda part: f"/{part[1]}{part[2].replace('1', '')}", text)
    return text.replace(" ", "")


def _add(quantity: str, factor: float, *spellings: str, offset: float = 0.0) -> None:
    known = (quantity, factor, offset)
    for spelling in spellings:
        _SPELLINGS[_normal(spelling)] = known
        key = quantity, _plain(spelling)
        _PLAIN[key] = known if _PLAIN.get(key, known) == known else None


_add("rate", 1.0, "deg/h", "dph")
_add("rate", _RATE, "deg/s", "dps")
_add("rate", 1e-3 * _RATE, "mdeg/s", "mdps")
_add("rate", _RATE / _DEGREE, "rad/s")
_add("rate", 1e-3 * _RATE / _DEGREE, "mrad/s")
_add("rate", 1e-6 * _RATE / _DEGREE, "urad/s", "µrad/s", "microradian s-1")
_add("rate", 1e-9 * _RATE / _DEGREE, "nrad/s", "nanoradian s-1")
_add("rate", 1.0, "arcsec/s")  # 1 arcsec/s = 3600 arcsec/h = 1 deg/h
_add("rate", 6.0 * _RATE, "rpm", "r/min", "rev/min")
_add("rate", 360.0 * _RATE, "rev/s", "r/s")
_add("rate", 6.0, "deg/min")
_add("angle", 1.0, "deg")
_add("angle", 1.0 / 3600.0, "arcsec", '"')
_add("angle", 1.0 / _DEGREE, "rad")
_add("angle", 1e-3 / _DEGREE, "mrad")
_add("angle", 1e-6 / _DEGREE, "urad", "µrad", "microradian")
_add("temperature", 1.0, "degC", "C", "celsius", "deg celsius")
_add("temperature", 1.0, "K", "kelvin", "degK", offset=-273.15)
_add("temperature", 5.0 / 9.0, "degF", "F", "fahrenheit", "deg fahrenheit", offset=-160.0 / 9.0)
_add("acceleration", 1.0, "g", "gn", "gee", "gs", "g0", "g_n", "9.80665 m s-2")
_add("acceleration", 1e-3, "mg", "milli-g", "milli g", "millig", "mgee")
_add("acceleration", 1e-6, "ug", "µg", "micro-g", "microg")
_add("acceleration", 1.0 / 9.80665, "m/s2", "m/s/s", "mps2", "meter/s2", "metre/s2", "meters/s2", "m/sec^2")
_add("acceleration", 1e-2 / 9.80665, "gal", "cm/s2")
_add("acceleration", 0.3048 / 9.80665, "ft/s2")
_add("voltage", 1.0, "V", "volt", "volts", "Vdc")
_add("voltage", 1e-3, "mV", "millivolt", "millivolts")
_add("power", 1.0, "W", "watt", "watts")
_add("power", 1e-3, "mW")
_add("power", 1e-6, "uW", "µW")
_add("pressure", 1.0, "Pa", "pascal", "pascals")
_add("pressure", 1e2, "hPa", "mbar", "millibar", "mb", "hectopascal")
_add("pressure", 1e3, "kPa", "kilopascal")
_add("pressure", 1e4, "dbar", "decibar")
_add("pressure", 1e5, "bar", "bars", "bara")
_add("pressure", 1e6, "MPa")
_add("pressure", 1e-3, "mPa")
_add("pressure", 6894.757293168361, "psi", "psia", "lbf/in2")
_add("pressure", 101325.0, "atm")
_add("magnetic", 1.0, "uT", "µT", "microtesla", "microteslas")
_add("magnetic", 1e-3, "nT", "nanotesla", "gamma")
_add("magnetic", 1e3, "mT", "millitesla")
_add("magnetic", 1e6, "T", "tesla")
_add("magnetic", 100.0, "G", "gauss", "Gs")
_add("magnetic", 0.1, "mG", "milligauss", "mgauss")
_add("number", 1.0, "1", "-", "count", "")

_NUMBER = re.compile(r"^([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*\*?\s*(.+)$")


@dataclass(frozen=True)
class Unit:
    """How a unit string converts: ``inner = value * factor + offset``, in ``INNER[quantity]``."""

    text: str
    quantity: str
    factor: float
    offset: float = 0.0


def parse_unit(text: str, quantity: str | None = None) -> Unit:
    """Read a unit string, with an optional factor in front.

    Case, blanks and written-out words (``DEG/HR``, ``degrees per second``) make no difference where the unit stays clear.

    Parameters
    ----------
    text : str
        For instance ``"deg/h"``, ``"rad s^-1"``, ``"0.1 arcsec/s"`` (a count of 0.1 arcsec/s).
    quantity : str, optional
        A key of `INNER` that is expected; it decides between spellings such as ``G``, gauss or the acceleration.

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
    >>> parse_unit("DEG/HR").factor, parse_unit("G", "acceleration").quantity
    (1.0, 'acceleration')
    """
    found = _find(text, quantity)
    if found is not None:
        return Unit(text, *found)
    match = _NUMBER.match(_normal(text))
    found = _find(match.group(2), quantity) if match else None
    if match and found is not None:
        kind, factor, offset = found
        scale = float(match.group(1))
        if scale == 0.0 or not math.isfinite(scale):
            raise UnitError(f"unit {text!r}: the factor {match.group(1)} is not usable; give a finite number other than 0")
        return Unit(text, kind, factor * scale, offset)
    raise UnitError(f"unit {text!r} is not known; known are, for instance, {known_units('rate')} for gyro axes")


def _find(text: str, quantity: str | None) -> tuple[str, float, float] | None:
    """Quantity, factor and offset of a spelling: as it is written, then with its case and blanks ignored."""
    exact = _SPELLINGS.get(_normal(text))
    if exact is not None and quantity in (None, exact[0]):
        return exact
    plain = _plain(text)
    if quantity is not None and (found := _PLAIN.get((quantity, plain))):
        return found
    if exact is not None or len(plain) < 2:  # a single letter means what its case says
        return exact
    candidates = {known for kind in INNER if (known := _PLAIN.get((kind, plain)))}
    return candidates.pop() if len(candidates) == 1 else None


def known_units(quantity: str) -> str:
    """The spellings understood for a quantity, for messages.

    Examples
    --------
    >>> known_units("pressure")
    'Pa, hPa, kPa, dbar, bar, MPa, mPa, psi, atm'
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

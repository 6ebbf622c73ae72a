"""Unit strings that gyrostab reads and writes, and their factors.

Inside, every quantity has one unit (`INNER`). Readers convert at the door with `parse_unit`;
nothing else converts. The strings in `INNER` and `ON_DISK` are fixed constants: UDUNITS refuses
``deg`` and reads fractional powers wrongly, so no unit string is ever built at run time.

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

#: Units whose in-memory spelling UDUNITS would misread (``g`` is the gram) -> the spelling used in
#: files.
ON_DISK = {"g": "9.80665 m s-2"}

_DEGREE = math.pi / 180.0
#: Seconds in an hour and in a day; an hour is also the factor from deg/s to deg/h.
HOUR, DAY = 3600.0, 86400.0

# spelling -> (quantity, factor to the inner unit, offset in the inner unit)
_SPELLINGS: dict[str, tuple[str, float, float]] = {}
# (quantity, plain form of a spelling) -> the same; None where two spellings of a quantity differ in
# their case only
_PLAIN: dict[tuple[str, str], tuple[str, float, float] | None] = {}

# Words of unit strings -> the one form that `_fold_spelling` gives them.
_WORDS = {
    word: short
    for short, words in {
        "deg": "degree degrees degs dega",
        "rad": "radian radians",
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


def _normalize_text(text: str) -> str:
    """Unify ``rad s^-1``, ``rad*s**-1``, ``rad s⁻¹`` and ``rad s-1``; letters keep their case."""
    text = re.sub(
        "[º˚]", "°", text.strip()
    )  # ordinal sign and ring, often typed for the degree sign
    text = unicodedata.normalize("NFKC", text).replace("\N{MINUS SIGN}", "-")
    text = text.replace("**", "^").replace("^-", "-").replace("·", " ").replace("*", " ")
    return re.sub(r"\s+", " ", text)


def _fold_spelling(text: str) -> str:
    """Remove the differences of case, blanks and words such as `seconds` from a spelling."""
    text = (
        _normalize_text(text).casefold().replace("°", "deg ").replace(" per ", "/").replace("^", "")
    )
    text = re.sub(r"[a-zμ]+", lambda word: _WORDS.get(word[0], word[0]), text.replace("_", " "))
    text = re.sub(r"\s*/\s*", "/", text)
    text = re.sub(
        r"[ .]?\b([a-z]+)-([12])\b", lambda part: f"/{part[1]}{part[2].replace('1', '')}", text
    )
    return text.replace(" ", "")


def _add_unit(quantity: str, factor: float, *spellings: str, offset: float = 0.0) -> None:
    definition = (quantity, factor, offset)
    for spelling in spellings:
        _SPELLINGS[_normalize_text(spelling)] = definition
        key = quantity, _fold_spelling(spelling)
        _PLAIN[key] = definition if _PLAIN.get(key, definition) == definition else None


_add_unit("rate", 1.0, "dph")
_add_unit("rate", HOUR, "dps")
_add_unit("rate", 1e-3 * HOUR, "mdps")
_add_unit("rate", 6.0 * HOUR, "rpm", "r/min")
_add_unit("temperature", 1.0, "degC", "C", "celsius", "deg celsius")
_add_unit("temperature", 1.0, "K", "kelvin", "degK", offset=-273.15)
_add_unit(
    "temperature", 5.0 / 9.0, "degF", "F", "fahrenheit", "deg fahrenheit", offset=-160.0 / 9.0
)
_add_unit("acceleration", 1.0, "g", "gn", "gee", "gs", "g0", "g_n", "g rms", "9.80665 m s-2")
_add_unit("acceleration", 1e-3, "mg", "milli-g", "milli g", "millig", "mgee")
_add_unit("acceleration", 1e-6, "ug", "µg", "micro-g", "microg")
_add_unit("acceleration", 1.0 / 9.80665, "mps2")
_add_unit("acceleration", 1e-2 / 9.80665, "gal")
_add_unit("acceleration", 0.3048 / 9.80665, "ft/s2")
_add_unit("voltage", 1.0, "V", "volt", "volts", "Vdc")
_add_unit("voltage", 1e-3, "mV", "millivolt", "millivolts")
_add_unit("power", 1.0, "W", "watt", "watts")
_add_unit("power", 1e-3, "mW")
_add_unit("power", 1e-6, "uW", "µW")
_add_unit("pressure", 1.0, "Pa", "pascal", "pascals")
_add_unit("pressure", 1e2, "hPa", "mbar", "millibar", "mb", "hectopascal")
_add_unit("pressure", 1e3, "kPa", "kilopascal")
_add_unit("pressure", 1e4, "dbar", "decibar")
_add_unit("pressure", 1e5, "bar", "bars", "bara")
_add_unit("pressure", 1e6, "MPa")
_add_unit("pressure", 1e-3, "mPa")
_add_unit("pressure", 6894.757293168361, "psi", "psia", "lbf/in2")
_add_unit("pressure", 101325.0, "atm")
_add_unit("magnetic", 1.0, "uT", "µT", "microtesla", "microteslas")
_add_unit("magnetic", 1e-3, "nT", "nanotesla", "gamma")
_add_unit("magnetic", 1e3, "mT", "millitesla")
_add_unit("magnetic", 1e6, "T", "tesla")
_add_unit("magnetic", 100.0, "G", "gauss", "Gs")
_add_unit("magnetic", 0.1, "mG", "milligauss", "mgauss")
_add_unit("magnetic", 1e-4, "uG", "µG", "microgauss")
_add_unit("number", 1.0, "1", "-", "count", "")

# Products of powers of angle, time and length: name -> (dimension, numerator, denominator), in
# degree, s and m. Other words for a name are in `_WORDS`.
_BASES: dict[str, tuple[str, float, float]] = {
    **dict.fromkeys(("deg", "°", "arcdeg", "angular_degree"), ("angle", 1.0, 1.0)),
    "rad": ("angle", 1.0, _DEGREE),
    **dict.fromkeys(
        ("arcmin", "arcminute", "arcminutes", "arc_minute", "arc_minutes"), ("angle", 1.0, 60.0)
    ),
    **dict.fromkeys(("arcsec", "arc_second", "arc_seconds", '"'), ("angle", 1.0, HOUR)),
    **dict.fromkeys(("rev", "cycle", "cycles"), ("angle", 360.0, 1.0)),
    "s": ("time", 1.0, 1.0),
    "min": ("time", 60.0, 1.0),
    "h": ("time", HOUR, 1.0),
    **dict.fromkeys(("d", "day", "days"), ("time", DAY, 1.0)),
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), ("length", 1.0, 1.0)),
}
_PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2}
_PREFIX_NAMES = {"nano": 1e-9, "micro": 1e-6, "milli": 1e-3, "centi": 1e-2}
#: Powers of angle, time and length -> quantity, and the factor of degree, s and m to its inner
#: unit.
_SIGNATURES = {
    (1, -1, 0): ("rate", HOUR, 1.0),
    (1, 0, 0): ("angle", 1.0, 1.0),
    (0, -2, 1): ("acceleration", 1.0, 9.80665),
}
_LISTED = {
    "rate": "deg/h, arcsec/s, deg/s, rad/s, mrad/s, urad/s, nrad/s, rpm",
    "rotation_rate": "deg/s, rad/s, mrad/s, urad/s, nrad/s, rpm, deg/h, arcsec/s",
    "angle": "deg, arcsec, rad, mrad, urad",
    "acceleration": "g, mg, m/s^2",
}
#: Spellings of rates, as `_fold_spelling` returns them, that programs use for different units.
_AMBIGUOUS = ("r/s", "rps")
_TOKEN = re.compile(r'\s*(/|per\b)?\s*\(?\s*([A-Za-zµμ°"_]+)([+-]?\d)?\s*\)?', re.IGNORECASE)
#: A factor in front of a unit, not followed by further digits of its number.
_NUMBER = re.compile(r"^([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)(?![\d.])\s*\*?\s*(.+)$")


@dataclass(frozen=True)
class Unit:
    """How a unit string converts: ``inner = value * factor + offset``, in ``INNER[quantity]``."""

    text: str
    quantity: str
    factor: float
    offset: float = 0.0


def parse_unit(text: str, quantity: str | None = None) -> Unit:
    """Read a unit string, with an optional factor in front.

    Case, blanks and written-out words (``DEG/HR``, ``degrees per second``) make no difference where
    the unit stays clear.

    Parameters
    ----------
    text : str
        For instance ``"deg/h"``, ``"rad s^-1"``, ``"0.1 arcsec/s"`` (a count of 0.1 arcsec/s).
    quantity : str, optional
        A key of `INNER` that is expected; it decides between spellings such as ``G``, gauss or the
        acceleration.

    Returns
    -------
    Unit
        Quantity and the linear conversion to the inner unit.

    Raises
    ------
    UnitError
        When the string is not known, or ambiguous; the message lists what is known.

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
    >>> parse_unit("rpm", "rotation_rate").factor
    6.0
    """
    if quantity == "rotation_rate":  # in the units of rates
        unit = parse_unit(text, "rate")
        is_rate = unit.quantity == "rate"
        return Unit(text, quantity, unit.factor / HOUR) if is_rate else unit
    definition = _find_unit(text, quantity)
    if definition is not None:
        return Unit(text, *definition)
    match = _NUMBER.match(_normalize_text(text))
    if _fold_spelling(match.group(2) if match else text) in _AMBIGUOUS:
        raise UnitError(
            f"unit {text!r} may be revolutions or radians per second; write rev/s or rad/s"
        )
    definition = _find_unit(match.group(2), quantity) if match else None
    if match and definition is not None:
        kind, factor, offset = definition
        factor *= float(match.group(1))
        if factor == 0.0 or not math.isfinite(factor):
            raise UnitError(
                f"unit {text!r}: the factor {match.group(1)} is not usable; "
                "give a finite number other than 0"
            )
        return Unit(text, kind, factor, offset)
    raise UnitError(
        f"unit {text!r} is not known; known are, for instance, {known_units('rate')} for gyro axes"
    )


def find_conversion(text: str, target: str) -> tuple[float, float] | None:
    """Return factor and offset from one unit to another; None if they do not convert.

    Examples
    --------
    >>> find_conversion("V", "mV"), find_conversion("degC", "V"), find_conversion("l/min", "l/min")
    ((1000.0, 0.0), None, (1.0, 0.0))
    """
    if text == target:
        return 1.0, 0.0
    try:
        units = parse_unit(text), parse_unit(target)
    except UnitError:
        return None
    if units[0].quantity != units[1].quantity:
        return None
    factor = units[1].factor
    return units[0].factor / factor, (units[0].offset - units[1].offset) / factor


def _parse_base(name: str) -> tuple[str, float, float] | None:
    """Return dimension, numerator and denominator of a name with or without a prefix.

    Upper and lower case are alike but for prefixes of one letter: ``MRAD`` may be milli or mega,
    and is refused.
    """
    if (base_unit := _find_base(name)) is not None:
        return base_unit
    for prefixes, head, base in (
        (_PREFIXES, name[:1], name[1:]),
        *(
            (_PREFIX_NAMES, prefix, name[len(prefix) :])
            for prefix in _PREFIX_NAMES
            if name.lower().startswith(prefix)
        ),
    ):
        if head.lower() != head and prefixes is _PREFIXES:
            continue
        if head in prefixes and (base_unit := _find_base(base.lstrip("_"))) is not None:
            dimension, numerator, denominator = base_unit
            return dimension, prefixes[head] * numerator, denominator
    return None


def _find_base(name: str) -> tuple[str, float, float] | None:
    word = name.lower()
    return _BASES.get(_WORDS.get(word, word))


def _parse_product(text: str) -> tuple[str, float, float] | None:
    """Parse a product of powers as UDUNITS writes it (``rad.s-1``, ``degree per second``)."""
    text = re.sub(r"\s*[.⋅×]\s*(?=[^\s\d])", " ", _normalize_text(text).replace("^", ""))
    text = re.sub(r"_?\bper\b_?|_per_", "/", text, flags=re.IGNORECASE)
    powers = {"angle": 0, "time": 0, "length": 0}
    up = down = 1.0
    end = 0
    while end < len(text):
        match = _TOKEN.match(text, end)
        base = _parse_base(match.group(2)) if match else None
        if match is None or base is None:
            return None
        end = match.end()
        dimension, numerator, denominator = base
        power = int(match.group(3) or 1) * (-1 if match.group(1) else 1)
        powers[dimension] += power
        if power < 0:
            numerator, denominator = denominator, numerator
        up, down = up * numerator ** abs(power), down * denominator ** abs(power)
    signature = _SIGNATURES.get((powers["angle"], powers["time"], powers["length"]))
    return (
        None
        if signature is None
        else (signature[0], up * signature[1] / (down * signature[2]), 0.0)
    )


def _find_unit(text: str, quantity: str | None) -> tuple[str, float, float] | None:
    """Find quantity, factor and offset of a spelling, as written or without case and blanks."""
    exact = _SPELLINGS.get(_normalize_text(text)) or _parse_product(text)
    if exact is not None and quantity in (None, exact[0]):
        return exact
    plain = _fold_spelling(text)
    if quantity is not None and (definition := _find_plain(text, plain, quantity)):
        return definition
    if exact is not None or len(plain) < 2:  # a single letter means what its case says
        return exact
    candidates = {candidate for kind in INNER if (candidate := _find_plain(text, plain, kind))}
    return candidates.pop() if len(candidates) == 1 else None


def _find_plain(text: str, plain: str, quantity: str) -> tuple[str, float, float] | None:
    """Find a spelling without case and blanks; ``MW`` may be milli or mega, and is refused."""
    is_prefixed = text.strip().startswith("M") and (quantity, plain[1:]) in _PLAIN
    return None if is_prefixed else _PLAIN.get((quantity, plain))


def known_units(quantity: str) -> str:
    """The spellings understood for a quantity, for messages.

    Examples
    --------
    >>> known_units("pressure")
    'Pa, hPa, kPa, dbar, bar, MPa, mPa, psi, atm'
    """
    if quantity in _LISTED:
        return _LISTED[quantity]
    spellings: dict[tuple[float, float], str] = {}
    for spelling, (name, factor, offset) in _SPELLINGS.items():
        if name == quantity:
            spellings.setdefault((factor, offset), spelling)
    return ", ".join(spellings.values())


def on_disk(units: str) -> str:
    """The spelling of an inner unit that UDUNITS reads rightly."""
    return ON_DISK.get(units, units)

"""Find the columns that may be channels which effects follow, by their names and units."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from gyrostab.errors import UnitError
from gyrostab.ingest.columns.headers import (
    QUANTITIES,
    TEMPERATURE_PATTERN,
    is_named_after,
    is_unit_of,
)
from gyrostab.units import parse_unit

#: Channel -> words in the name of its column; a unit of temperature or pressure in the header needs
#: no word.
_WORDS = {
    "temperature": TEMPERATURE_PATTERN.pattern,
    "pressure": r"press|baro",
    "vibration": r"vib|(^|[^a-z])rms",
    "rotation_rate": r"rpm|rotat|rotary|turntable",
    "supply_voltage": r"batt|supply|volt|(^|[^a-z])(v?bus|vcc|vdd|vin)",
    "light_power": r"light|optic|laser|sld|source",
}
_KNOWN_BY_UNIT = ("temperature", "pressure")
_RMS_UNIT = re.compile(r"\brms\b", re.IGNORECASE)  # of an acceleration: that of a vibration
#: Channels of three axes, known by their unit -> word in their names, if the unit has two meanings.
_VECTORS = {"accel": "acc", "mag": "mag"}


class LikelyChannel(NamedTuple):
    """A column that may be a channel."""

    place: int  # of the column
    unit: str  # in its header or its name
    in_header: bool


def find_likely_channels(
    columns: Sequence[tuple[str, str | None]],
) -> dict[str, list[LikelyChannel]]:
    """Find the columns that may be each channel of a known name, given names and units of headers.

    A channel that a column is named after is left out, and so are accelerations and magnetic fields
    of which there are more than three axes.

    Examples
    --------
    >>> likely = find_likely_channels([("Tool Temp", "degF"), ("RPM", None), ("Vib (raw)", None)])
    >>> {channel: [column.unit for column in columns] for channel, columns in likely.items()}
    {'temperature': ['degF'], 'rotation_rate': ['RPM']}
    >>> list(find_likely_channels([("Shock", "g RMS"), ("Sensor", "volts")]))
    ['vibration']
    """
    likely: defaultdict[str, list[LikelyChannel]] = defaultdict(list)
    for place, (name, unit) in enumerate(columns):
        for channel, words in _WORDS.items():
            has_word = re.search(words, name.lower()) is not None or (
                channel == "vibration" and _RMS_UNIT.search(unit or "") is not None
            )
            if not has_word and (unit is None or channel not in _KNOWN_BY_UNIT):
                continue
            column = _read_unit(place, name, unit, QUANTITIES[channel])
            if column is not None and (has_word or column.in_header):
                likely[channel].append(column)
    for vector, word in _VECTORS.items():
        trios = _find_trios(columns, QUANTITIES[vector], word)
        if len(trios) == 1:
            likely |= {f"{vector}_{axis}": [column] for axis, column in trios[0].items()}
    names = [name.lower() for name, _ in columns]
    named = {stem for stem in QUANTITIES for name in names if is_named_after(name, stem)}
    return {
        channel: likely_columns
        for channel, likely_columns in likely.items()
        if not any(is_named_after(channel, stem) for stem in named)
    }


def _find_trios(
    columns: Sequence[tuple[str, str | None]], quantity: str, word: str
) -> list[Mapping[str, LikelyChannel]]:
    """Return the columns of three axes whose names differ only in the axis, without vibrations.

    A unit has the quantity that it means alone (``g``, ``G``), or that of the `word` in a name.
    """
    templates: defaultdict[str, dict[str, LikelyChannel]] = defaultdict(dict)
    for place, (name, unit) in enumerate(columns):
        column = _read_unit(place, name, unit, quantity)
        if column is None or re.search(_WORDS["vibration"], name.lower()):
            continue
        words = [known for known in _VECTORS.values() if known in name.lower()]
        if word not in words and (words or not _means_alone(column.unit, quantity)):
            continue
        for match in re.finditer("[xyz]", name.lower()):
            template = f"{name[: match.start()]}*{name[match.end() :]}"
            templates[template][match[0]] = column
    return [axes for axes in templates.values() if len(axes) == 3]


def _means_alone(unit: str, quantity: str) -> bool:
    """Return whether a unit has a quantity if nothing says which is meant."""
    try:
        return parse_unit(unit).quantity == quantity
    except UnitError:
        return False


def _read_unit(place: int, name: str, unit: str | None, quantity: str) -> LikelyChannel | None:
    """Return the unit of a quantity in a header or a name, which may be no more than the unit."""
    if unit is not None and is_unit_of(unit, (quantity,)):
        return LikelyChannel(place, unit, in_header=True)
    in_name = name if is_unit_of(name, (quantity,)) else find_unit_in_name(name, quantity)
    return None if in_name is None else LikelyChannel(place, in_name, in_header=False)


def find_unit_in_name(name: str, quantity: str) -> str | None:
    """Return the unit of a quantity at the end of the name of a column.

    Examples
    --------
    >>> find_unit_in_name("gx_deg_per_h", "rate"), find_unit_in_name("supply", "voltage")
    ('deg/h', None)
    """
    tokens = [token for token in re.split(r"[\s_./\-]+", re.sub(r"\[\d+\]$", "", name)) if token]
    for count in range(min(4, len(tokens) - 1), 0, -1):
        last = tokens[-count:]
        for text in (" ".join(last), "/".join(last)):
            if len(text) > 1 or text in ("C", "K", "F", "g", "V", "T", "G"):
                text = {"degs": "deg/s", "rads": "rad/s"}.get(text, text)
                if is_unit_of(text, (quantity,)) and text not in ("1", "-"):
                    return parse_unit(text, quantity).text.replace(" per ", "/")
    return None

"""Decode stored numbers by the CF conventions: packing, fill values and valid ranges.

References
----------
CF conventions 1.11, sections 2.5.1 (missing data, valid ranges) and 8.1 (packed data); NetCDF users
guide, appendix A (``_Unsigned``, and the units of valid ranges).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from gyrostab.arrays import Array, Bools, Floats
from gyrostab.errors import FormatError
from gyrostab.ingest.columns.plan import Column, Plan
from gyrostab.ingest.columns.stamps import TimeUnit

#: Stored numbers -> counts or values.
Decoder = Callable[[Any], Any]

_PACKING = (
    "_Unsigned",
    "_FillValue",
    "missing_value",
    "valid_range",
    "valid_min",
    "valid_max",
    "scale_factor",
    "add_offset",
)
#: Attributes of a variable that define how its numbers are read.
ATTRIBUTES = (*_PACKING, "units", "calendar")


@dataclass(frozen=True)
class Packing:
    """Packing of one variable, from its attributes."""

    dtype: np.dtype[Any]  # type of the stored numbers; unsigned if ``_Unsigned`` is "true"
    missing: tuple[Any, ...] = ()  # stored numbers that mark missing values, in `dtype`
    #: Stored numbers outside this range are invalid.
    low: float = -np.inf
    high: float = np.inf
    #: ``value = stored * scale + offset``.
    scale: float = 1.0
    offset: float = 0.0

    @classmethod
    def from_attributes(cls, where: str, dtype: Any, attributes: Mapping[str, Any]) -> Packing:
        """Parse the attributes of a variable that stores numbers of `dtype`, in any byte order.

        Examples
        --------
        >>> attributes = {"_Unsigned": "true", "scale_factor": 0.5, "_FillValue": np.int8(-1)}
        >>> packing = Packing.from_attributes("gyro_x", "i1", attributes)
        >>> packing.read_values(np.array([-2, -1, 4], dtype="i1")).tolist()
        [127.0, nan, 2.0]
        """
        stored: np.dtype[Any] = np.dtype(dtype).newbyteorder("=")
        declared = {key: attributes[key] for key in _PACKING if key in attributes}
        if stored.kind in "iu" and (text := attribute_text(declared.get("_Unsigned"))):
            stored = np.dtype(f"{'u' if text.lower() == 'true' else 'i'}{stored.itemsize}")
        wraps = "_Unsigned" in declared
        numbers = {
            key: _attribute_numbers(where, key, value, stored, wraps=wraps)
            for key, value in declared.items()
            if key != "_Unsigned"
        }
        scale, offset = (
            float(numbers[key][0]) if key in numbers else neutral
            for key, neutral in (("scale_factor", 1.0), ("add_offset", 0.0))
        )
        if not (np.isfinite([scale, offset]).all() and scale != 0.0):
            raise FormatError(
                f"{where}: scale_factor {scale:g} and add_offset {offset:g} are not usable; "
                "correct them"
            )
        missing = [
            value for key in ("_FillValue", "missing_value") for value in numbers.get(key, ())
        ]
        low, high = _valid_range(where, numbers, stored, scale, offset)
        return cls(stored, tuple(_representable_values(missing, stored)), low, high, scale, offset)

    @property
    def is_plain(self) -> bool:
        """Whether the stored numbers are the values."""
        return self.scale == 1.0 and self.offset == 0.0

    def read_counts(self, stored: Any) -> Any:
        """Return stored numbers with their sign; missing ones are masked, or NaN in floats."""
        array = np.asarray(stored)
        native = array.astype(array.dtype.newbyteorder("="), copy=False)
        counts = native.view(self.dtype) if native.dtype.itemsize == self.dtype.itemsize else native
        invalid = self._find_invalid(counts)
        if invalid is None or not invalid.any():
            return counts
        return (
            np.where(invalid, self.dtype.type(np.nan), counts)
            if self.dtype.kind == "f"
            else np.ma.array(counts, mask=invalid)
        )

    def read_values(self, stored: Any) -> Floats:
        """Return unpacked values, NaN where missing."""
        counts = self.read_counts(stored)
        values: Floats = np.ma.filled(counts.astype(np.float64), np.nan)
        return values if self.is_plain else values * self.scale + self.offset

    def _find_invalid(self, counts: Array) -> Bools | None:
        masks = [counts == value for value in self.missing]
        if np.isfinite(self.low):
            masks.append(counts < self.low)
        if np.isfinite(self.high):
            masks.append(counts > self.high)
        return np.logical_or.reduce(masks) if masks else None


def attribute_text(value: Any) -> str | None:
    """Return an attribute if it is text, otherwise None."""
    value = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
    value = value.decode(errors="replace") if isinstance(value, bytes) else value
    return value if isinstance(value, str) else None


def _attribute_numbers(
    where: str, key: str, value: Any, stored: np.dtype[Any], *, wraps: bool
) -> Array:
    """Return the numbers of an attribute; with `wraps`, signed ones become unsigned."""
    array = np.atleast_1d(np.asarray(value)).ravel()
    if array.dtype.kind not in "iuf" or not array.size:
        raise FormatError(
            f"{where}: the attribute {key} is {value!r}, not a number; correct it or remove it"
        )
    native = array.astype(array.dtype.newbyteorder("="))
    if not wraps or native.dtype.kind == "f" or key in ("scale_factor", "add_offset"):
        return native
    # Reinterpreted by value, not by type: attributes of Zarr stores are JSON, whose whole numbers
    # have no type.
    if stored.itemsize == 8:
        return native.view(stored)
    wide, bits = native.astype(np.int64), 8 * stored.itemsize
    return np.where((wide >= -(1 << bits - 1)) & (wide < 1 << bits), wide.astype(stored), wide)


def _representable_values(missing: Iterable[Any], stored: np.dtype[Any]) -> Iterable[Any]:
    """Yield the numbers that the type of a variable can hold, except NaN."""
    for value in missing:
        with np.errstate(all="ignore"):
            number = np.asarray(value).astype(stored)[()]
        if number == number and (stored.kind == "f" or number.item() == value.item()):
            yield number


def _valid_range(
    where: str, numbers: Mapping[str, Array], stored: np.dtype[Any], scale: float, offset: float
) -> tuple[float, float]:
    """Return the range of valid stored numbers.

    The attributes are in packed units, unless the variable holds integers and both the attributes
    and the scale factor are floats: then they are in unpacked units (users guide), and half a count
    on either side is allowed for rounding.
    """
    pair = numbers.get("valid_range")
    if pair is not None and len(pair) != 2:
        raise FormatError(
            f"{where}: the attribute valid_range has {len(pair)} numbers, not 2; correct it or "
            "remove it"
        )
    ends = {"low": pair[0], "high": pair[1]} if pair is not None else {}
    ends |= {
        end: numbers[key][0]
        for end, key in (("low", "valid_min"), ("high", "valid_max"))
        if key in numbers
    }
    ends = {end: value for end, value in ends.items() if not np.isnan(value)}
    low, high = float(ends.get("low", -np.inf)), float(ends.get("high", np.inf))
    law = numbers.get("scale_factor", numbers.get("add_offset"))
    if stored.kind == "f":
        return float(stored.type(low)), float(stored.type(high))
    if (
        law is None
        or law.dtype.kind != "f"
        or not all(value.dtype.kind == "f" for value in ends.values())
    ):
        return low, high
    low, high = sorted(((low - offset) / scale, (high - offset) / scale))
    return low - 0.5, high + 0.5


def fold_packing(plan: Plan, stored: Sequence[Any]) -> tuple[Plan, dict[int, Decoder]]:
    """Fold the packing of variables into the factors of the plan, so that counts stay integers.

    `stored` has, by source, the type and the attributes of each variable; those without attributes
    are not packed. Also return, by source, the functions from stored numbers to counts, or to
    values for a time variable whose counts are not whole nanoseconds.
    """
    columns: list[Column] = []
    decoders: dict[int, Decoder] = {}
    for column in plan.columns:
        variable = stored[column.source]
        if variable.attributes is not None:
            where = f"{plan.path.name}: variable {column.header!r}"
            packing = Packing.from_attributes(where, variable.dtype, variable.attributes)
            column, decoders[column.source] = _fold_column(column, packing)
        columns.append(column)
    return replace(plan, columns=columns), decoders


def _fold_column(column: Column, packing: Packing) -> tuple[Column, Decoder]:
    if column.role != "time":
        offset = column.factor * packing.offset + column.offset
        factor = column.factor * packing.scale
        return replace(column, factor=factor, offset=offset), packing.read_counts
    if packing.is_plain or column.time_unit is None:
        return column, packing.read_counts
    unit = _fold_time(column.time_unit, packing)
    if unit is None:
        return column, packing.read_values
    return replace(column, time_unit=unit), packing.read_counts


def _fold_time(unit: TimeUnit, packing: Packing) -> TimeUnit | None:
    """Return the unit of the counts of a packed time variable; None if not whole nanoseconds."""
    step, shift = unit.ns * Fraction(repr(packing.scale)), unit.ns * Fraction(repr(packing.offset))
    if (
        packing.dtype.kind == "f"
        or step.denominator != 1
        or step <= 0
        or shift.denominator != 1
        or (shift and unit.epoch is None)
    ):
        return None
    return replace(unit, ns=step, epoch=None if unit.epoch is None else unit.epoch + int(shift))

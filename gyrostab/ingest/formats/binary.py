"""Raw binary files with a layout file: ``run7.bin.toml``, ``run7.toml`` or ``layout.toml``.

The layout names the fields of a record in order, with units as in header cells::

    header_bytes = 512          # before the first record; 0 by default
    byte_order = "little"       # or "big"
    fields = [
        {name = "time [us]", type = "uint32"},
        {name = "gyro_x [0.1 arcsec/s]", type = "int32"},
        {skip = 4},             # bytes
    ]
"""

from __future__ import annotations

import tomllib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import FormatError, OptionError
from gyrostab.ingest.formats.tables import Table, read_tables, scan_tables
from gyrostab.ingest.options import FileSummary, ReadOptions

__all__ = ["has_layout", "matches", "read", "scan"]

SUFFIXES = (".bin", ".raw")
TYPES = (
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "int64",
    "uint64",
    "float32",
    "float64",
)


def matches(path: Path) -> bool:
    """Return whether the file has a layout file, or its suffix is ``.bin`` or ``.raw``."""
    return (
        path.is_file()
        and path.suffix.lower() != ".toml"
        and (path.suffix.lower() in SUFFIXES or has_layout(path))
    )


def has_layout(path: Path) -> bool:
    """Return whether a file has a layout file named after it."""
    return _layout_path(path).is_file()


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Summarise fields, number of records, and first and last stamps."""
    table, notes = _make_table(path)
    return scan_tables(path, "binary", [table], options, notes)


def read(path: Path, options: ReadOptions) -> xr.Dataset:
    """Return the raw log of a binary file; see `gyrostab.ingest.read_log`."""
    table, notes = _make_table(path)
    return read_tables(path, [table], options, notes=notes)


def _layout_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.toml")


def _read_layout(path: Path) -> tuple[Path, dict[str, Any]]:
    places = [_layout_path(path), path.with_suffix(".toml"), path.with_name("layout.toml")]
    place = next((place for place in places if place.is_file()), None)
    if place is None:
        example = (
            'fields = [{name = "time [us]", type = "uint32"}, {name = "gyro_x [deg/h]", '
            'type = "int32"}]'
        )
        raise OptionError(
            f"{path.name}: the layout of its records is unknown; write {places[0].name} next to "
            f"it, for instance: {example}"
        )
    try:
        return place, tomllib.loads(place.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise OptionError(
            f"{place.name}: this layout is not valid TOML ({error}); correct it"
        ) from error


def _record_type(path: Path) -> tuple[np.dtype[Any], int]:
    """Return the type of a record, and the number of bytes before the first."""
    place, layout = _read_layout(path)
    known = {"header_bytes", "byte_order", "fields"}
    if unknown := sorted(set(layout) - known):
        raise OptionError(
            f"{place.name}: {unknown[0]!r} is not a key of a layout; known are "
            f"{', '.join(sorted(known))}"
        )
    order = {"little": "<", "big": ">"}.get(layout.get("byte_order", "little"))
    header = layout.get("header_bytes", 0)
    if order is None or not isinstance(header, int) or header < 0:
        raise OptionError(
            f'{place.name}: byte_order is "little" or "big", and header_bytes a whole number; '
            "correct the layout"
        )
    names, types, offsets, size = [], [], [], 0
    for number, field in enumerate(layout.get("fields", ()), 1):
        if (
            isinstance(field, dict)
            and set(field) == {"skip"}
            and isinstance(field["skip"], int)
            and field["skip"] > 0
        ):
            size += field["skip"]
            continue
        if (
            not isinstance(field, dict)
            or set(field) != {"name", "type"}
            or field["type"] not in TYPES
        ):
            what = (
                f'is {{name = "...", type = "..."}} or {{skip = BYTES}}, the types are '
                f"{', '.join(TYPES)}"
            )
            raise OptionError(f"{place.name}: field {number} {what}; correct the layout")
        names.append(str(field["name"]))
        types.append(np.dtype(order + np.dtype(field["type"]).str[1:]))
        offsets.append(size)
        size += types[-1].itemsize
    if not names or len(set(names)) < len(names):
        raise OptionError(f"{place.name}: a layout needs fields with different names; correct it")
    given = path.stat().st_size
    if header + size > given:
        raise FormatError(
            f"{path.name}: it holds no record by the layout {place.name} ({given} bytes, but "
            f"{header} of header and {size} a record); copy it again, or correct the layout"
        )
    record = np.dtype({"names": names, "formats": types, "offsets": offsets, "itemsize": size})
    return record, header


def _make_table(path: Path) -> tuple[Table, list[str]]:
    record, header = _record_type(path)
    rows, rest = divmod(path.stat().st_size - header, record.itemsize)
    notes = (
        [
            f"the last {rest} bytes are not a whole record of {record.itemsize} bytes; is the "
            "layout right?"
        ]
        if rest
        else []
    )
    names = tuple(record.names or ())
    columns = tuple(partial(_read_field, path, record, header, name) for name in names)
    return Table(rows, names, (None,) * len(names), columns), notes


def _read_field(
    path: Path, record: np.dtype[Any], header: int, name: str, start: int, stop: int
) -> Any:
    records = np.memmap(
        path, dtype=record, mode="r", offset=header + start * record.itemsize, shape=(stop - start,)
    )
    values = np.array(records[name])
    return values.astype(values.dtype.newbyteorder("="))

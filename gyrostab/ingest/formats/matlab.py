"""MATLAB 5 and 7.3 and HDF5 files: vectors by name, matrix columns as ``name/3`` (from 0).

The rows of a matrix run along its longer side. Fields of a structure are called ``name.field``, as
are variables of tables and timetables, which the library mat-io reads. Arrays of MATLAB 5 files are
read here, as the compiled reader of scipy may crash on damaged sizes.

References
----------
MAT-File Format, The MathWorks (level 5 MAT-files: data elements, array subelements).
"""

from __future__ import annotations

import math
import os
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd

from gyrostab.arrays import Array
from gyrostab.errors import FormatError, OptionError
from gyrostab.ingest.columns.headers import (
    AXIS_PATTERN,
    KNOWN_CHANNEL_PATTERN,
    TIME_PATTERN,
    is_time_unit,
    split_header,
    time_suffix,
)
from gyrostab.ingest.columns.plan import describe_left_out
from gyrostab.ingest.formats.packing import ATTRIBUTES, attribute_text
from gyrostab.ingest.formats.recognise import read_head
from gyrostab.ingest.formats.tables import (
    MAX_COLUMNS,
    StoredArray,
    Table,
    TableColumn,
    TablesOfFile,
    first_texts,
    library,
    make_reader,
)
from gyrostab.ingest.limits import check_chunk, check_packed
from gyrostab.ingest.options import ReadOptions
from gyrostab.store.damage import check_global_heaps

HDF_SUFFIXES = (".h5", ".hdf5")
_PLAIN_ARRAYS = (
    "of a timeseries ts: s.time = ts.Time; s.data = ts.Data; save('log.mat', '-struct', 's'); "
    "of a table or timetable: writetable(T, 'log.csv') or writetimetable(T, 'log.csv')"
)
_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
#: Numeric data type -> code of numpy.
_TYPES = {
    **{1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4"},
    **{7: "f4", 9: "f8", 12: "i8", 13: "u8"},
}
_STRUCT, _OBJECT, _OPAQUE, _NUMERIC, _CLASSES = 2, 3, 17, range(6, 16), range(1, 18)
_DAMAGE = (KeyError, ValueError, OverflowError, RecursionError, struct.error, zlib.error)

Arrays = Iterator[tuple[str, Array]]


def matches(path: Path) -> bool:
    """Return whether the suffix is ``.mat``, ``.h5`` or ``.hdf5`` (MATLAB 7.3 files are HDF5)."""
    return path.is_file() and path.suffix.lower() in (".mat", *HDF_SUFFIXES)


@contextmanager
def _open_tables(path: Path, options: ReadOptions) -> Iterator[TablesOfFile]:
    with ExitStack() as stack:
        yield _make_tables(path, options, stack)


scan, read = make_reader(
    lambda path: "hdf5" if path.suffix.lower() in HDF_SUFFIXES else "matlab", _open_tables
)


def _make_tables(path: Path, options: ReadOptions, stack: ExitStack) -> TablesOfFile:
    """Return a table of the variables as long as the gyro axes, and those of others with a time.

    Without known gyro axes, the first table has the longest variables.
    """
    objects: list[str] = []
    sized_columns = [
        (max(array.shape), column)
        for name, array in _find_arrays(path, stack, objects, options.limits)
        for column in _columns_of(path, name, array, options)
    ]
    try:
        sized_columns += _read_tables(path, objects)
    except OptionError:  # without the library, the arrays are read
        if not sized_columns:
            raise
    if not sized_columns and objects:
        problem = f"it holds {', '.join(dict.fromkeys(objects))}, which MATLAB alone can read"
        raise FormatError(f"{path.name}: {problem}; save plain arrays instead: {_PLAIN_ARRAYS}")
    if not sized_columns:
        raise FormatError(
            f"{path.name}: there is no vector or matrix of numbers in it; save plain arrays"
        )
    by_rows: dict[int, list[TableColumn]] = {}
    for size, column in sized_columns:
        by_rows.setdefault(int(size), []).append(column)
    rows = max(by_rows, key=lambda size: (_holds_axes(by_rows[size], options), size))
    columns = by_rows.pop(rows)
    has_clock = _find_clock(columns) is not None
    tables = [Table(rows, _name_fields(columns))]
    left_out: list[str] = []
    for size, columns in by_rows.items():
        clock = _find_clock(columns) if has_clock else None
        if clock is None:
            left_out += [column.name[0] for column in columns]
            continue
        stamps = replace(columns.pop(clock), name=("",))
        named = [column.target for table in tables for column in table.columns]
        tables.append(Table(size, _name_fields(columns, named), stamps))
    notes = describe_left_out(
        f"they do not have the {rows} rows of the others, nor a time with a unit", left_out
    )
    if objects:
        notes.append(
            f"left out, as MATLAB alone can read it: {', '.join(dict.fromkeys(objects))}; to "
            f"keep it, {_PLAIN_ARRAYS}"
        )
    return tables, notes


def _holds_axes(columns: Sequence[TableColumn], options: ReadOptions) -> bool:
    """Return whether a column is a gyro axis by its name, as a field, or by ``--map``."""
    mapped = {key.strip().lower(): target for key, target in options.map.items()}
    names = [mapped.get(c.name[0].lower()) or c.target or c.name[0] for c in _name_fields(columns)]
    return any(AXIS_PATTERN.match(split_header(name)[0].lower()) for name in names)


def _find_clock(columns: Sequence[TableColumn]) -> int | None:
    """Return the only column with name and unit of a time."""
    clocks = [
        place
        for place, column in enumerate(columns)
        if TIME_PATTERN.match(column.name[0].rpartition(".")[2].lower())
        and (column.cells or is_time_unit(column.unit or ""))
    ]
    return clocks[0] if len(clocks) == 1 else None


def _name_fields(
    columns: Sequence[TableColumn], named: Sequence[str | None] = ()
) -> list[TableColumn]:
    """Name structure fields by unique known names, ``gyro_x`` of ``S.gyro_x``, if not `named`."""
    names = [column.name[0].rpartition(".")[2].lower() for column in columns]
    counts, times = Counter(names), list(filter(TIME_PATTERN.match, names))
    fields = []
    for column, name in zip(columns, names, strict=True):
        target = None
        if times == [name]:
            suffix = time_suffix(name)
            target = f"time [{suffix}]" if suffix and is_time_unit(suffix) else "time"
        elif counts[name] == 1 and (AXIS_PATTERN.match(name) or KNOWN_CHANNEL_PATTERN.match(name)):
            target = name
        is_field = "." in column.name[0] and target not in named
        fields.append(replace(column, target=target if is_field else None))
    return fields


def _columns_of(path: Path, name: str, array: Any, options: ReadOptions) -> Iterator[TableColumn]:
    shape = array.shape
    if len(shape) not in (1, 2) or max(shape, default=0) <= 1:
        return
    if chunks := getattr(array, "chunks", None):
        check_chunk(path, name, array.dtype.itemsize * math.prod(chunks), options.limits)
    along, size = int(np.argmax(shape)), min(shape) if len(shape) == 2 else 1
    stored = getattr(array, "attrs", {})
    attributes = {key: stored[key] for key in ATTRIBUTES if key in stored}
    if size <= MAX_COLUMNS:
        names = [name] if size == 1 else [f"{name}/{place}" for place in range(size)]
        yield from StoredArray(array, along).make_columns(names, attributes)


def _find_arrays(
    path: Path, stack: ExitStack, objects: list[str], limits: Mapping[str, float]
) -> Iterable[tuple[str, Any]]:
    """Find names and arrays of numbers; descriptions of MATLAB objects are added to `objects`."""
    head = read_head(path)[:1024]
    if b"MATLAB 7.3" in head[:128] or b"\x89HDF" in head or path.suffix.lower() in HDF_SUFFIXES:
        return _find_hdf_arrays(path, stack, objects)
    return read_arrays(path, objects, limits)


def _find_hdf_arrays(path: Path, stack: ExitStack, objects: list[str]) -> list[tuple[str, Any]]:
    import h5py

    check_global_heaps(path)
    _add_filters()
    file = stack.enter_context(h5py.File(path, "r"))
    arrays: list[tuple[str, Any]] = []

    def visit(name: str | bytes, item: Any) -> None:
        if isinstance(name, bytes):  # h5py leaves a name that is not UTF-8 as it is
            name = name.decode("utf-8", "backslashreplace")
        kind = attribute_text(item.attrs.get("MATLAB_class", b"double"))
        if "MATLAB_object_decode" in item.attrs and not name.startswith("#"):
            objects.append(f"a {kind} {name!r}")
            return
        if (
            isinstance(item, h5py.Dataset)
            and item.dtype.kind in "iuf"
            and kind != "char"
            and not name.startswith("#")
        ):
            arrays.append((name.replace("/", "."), item))

    file.visititems(visit)
    return arrays


@cache
def _add_filters() -> None:
    """Let h5py find the filters that netCDF4 brings with it, such as zstd."""
    import h5py
    import netCDF4

    h5py.h5pl.append(os.fsencode(Path(netCDF4.__file__).with_name("plugins")))


@contextmanager
def keep_pandas_options() -> Iterator[None]:
    """Set back the option of pandas that mat-io sets when it is imported; ignore warnings."""
    option = "future.infer_string"
    with warnings.catch_warnings(), ExitStack() as stack:
        warnings.simplefilter("ignore")
        with suppress(pd.errors.OptionError):  # pandas 4 does not have it
            stack.enter_context(pd.option_context(option, pd.get_option(option)))
        yield


def _read_tables(path: Path, objects: list[str]) -> Iterator[tuple[int, TableColumn]]:
    """Yield length and column for all tables and timetables; row times are columns too.

    `objects` describes what the file holds, such as "a table 'log'"; tables are removed from it.
    MATLAB stores dates with a time zone in UTC. mat-io warns of them without naming the variable,
    so they let all dates of a file be in UTC.
    """
    if not any(text.startswith(("a table", "a timetable")) for text in objects):
        return
    with keep_pandas_options(), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        matio = library("matio", path, extra="matlab")
        content = matio.load_from_mat(str(path), add_table_attrs=True)
    zone = "Z" if any("timezone" in str(warning.message) for warning in caught) else ""
    for name, table in content.items():
        if not isinstance(table, pd.DataFrame):
            continue
        objects[:] = [text for text in objects if not text.endswith(f" {name!r}")]
        units = table.attrs.get("VariableUnits") or table.attrs.get("varUnits") or []
        if table.index.dtype.kind in "mM":
            times = table.index.to_numpy()
            yield from _make_column(f"{name}.{table.index.name or 'Time'}", times, zone)
        for place, variable in enumerate(table.columns):
            unit = str(units[place]) if place < len(units) else ""
            yield from _make_column(f"{name}.{variable}", table[variable].to_numpy(), zone, unit)


def _make_column(
    header: str, values: Array, zone: str, unit: str = ""
) -> Iterator[tuple[int, TableColumn]]:
    """Yield length and column of numbers or of dates in a zone; durations become nanoseconds."""
    if values.dtype.kind == "M":
        cells = [text and text + zone for text in first_texts(values)]
        yield len(values), TableColumn((header,), values, cells=cells)
    if values.dtype.kind == "m":
        values, unit = values.astype("timedelta64[ns]").view(np.int64), "ns"
    if values.dtype.kind in "biuf":
        yield len(values), TableColumn((header,), values, unit, dtype=values.dtype)


def read_arrays(
    path: Path, objects: list[str], limits: Mapping[str, float] | None = None
) -> Arrays:
    """Yield names and arrays of numbers; descriptions of MATLAB objects are added to `objects`.

    Fields of a structure are called ``name.field``. Files of other levels are left to scipy.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES or 0 in head[:4]:
            from scipy.io import loadmat

            for name, value in loadmat(path).items():
                if not name.startswith("__") and value.dtype.kind in "iuf":
                    yield name, value
            return
        order = "<" if head[126:128] == b"IM" else ">"
        try:
            for elements in _find_variables(file, order, path, limits):
                yield from elements.find_numbers("", objects)
        except _DAMAGE as error:
            problem = f"this MATLAB file is damaged or cut off ({error}); copy it again"
            raise FormatError(f"{path.name}: {problem}") from error


def _find_variables(
    file: BinaryIO, order: str, path: Path, limits: Mapping[str, float] | None
) -> Iterator[_Elements]:
    place, size, unpacked = _HEADER_BYTES, path.stat().st_size, 0
    while place < size:
        file.seek(place)
        kind, length = struct.unpack(order + "II", file.read(8))
        if kind not in (_MATRIX, _COMPRESSED):
            raise ValueError(f"at byte {place} there is an element of type {kind}, not an array")
        place += 8 + length
        if place > size:
            raise ValueError(f"an array ends {place - size} bytes behind the file")
        data = file.read(length)
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            kind, length = struct.unpack(order + "II", unpacker.decompress(data, 8))
            if kind != _MATRIX:
                raise ValueError("a compressed element does not hold an array")
            unpacked += length
            check_packed(path, size, unpacked, limits)
            # one more byte, so that the checksum behind the last one is read
            data = unpacker.decompress(unpacker.unconsumed_tail, length + 1)
            if len(data) < length:
                raise ValueError(f"a compressed array of {length} bytes is cut off")
            data = data[:length]
        yield _Elements(data, order)


class _Elements:
    """The data elements within an array, in sequence."""

    def __init__(self, data: bytes | memoryview, order: str):
        self.data, self.order, self.place = memoryview(data), order, 0

    def _take_element(self) -> tuple[int, memoryview]:
        """Take type and bytes of the next element; raise an error if it is cut off."""
        word = struct.unpack_from(self.order + "I", self.data, self.place)[0]
        if word >> 16:  # a small element holds its data in the tag
            kind, length, begin, end = word & 0xFFFF, word >> 16, self.place + 4, self.place + 8
            if length > 4:
                raise ValueError(f"a small element of {length} bytes")
        else:
            kind, length = word, struct.unpack_from(self.order + "I", self.data, self.place + 4)[0]
            begin = self.place + 8
            end = begin + length + (-length % 8)
        if begin + length > len(self.data):
            raise ValueError(f"an element of {length} bytes in an array of {len(self.data)}")
        self.place = min(end, len(self.data))
        return kind, self.data[begin : begin + length]

    def _take_text(self) -> str:
        return bytes(self._take_element()[1]).decode("latin-1")

    def _take_array(self) -> Array:
        kind, data = self._take_element()
        return np.frombuffer(data, self.order + _TYPES[kind])

    def _take_number(self) -> int:
        numbers = self._take_array()
        if not numbers.size:
            raise ValueError("an element without its number")
        return int(numbers[0])

    def find_numbers(self, field: str, objects: list[str]) -> Arrays:
        """Yield the array that consists of these elements, or those in the fields of a structure.

        `field` is the name of a member of a structure, which carries none.
        """
        if not self.data:
            return  # an empty array within a structure
        flags = self._take_number()
        array, is_complex = flags & 0xFF, bool(flags & 0x800)
        if array not in _CLASSES:
            raise ValueError(f"there is no array of class {array}")
        if array == _OPAQUE:
            name, _, kind = (self._take_text() for _ in range(3))
            objects.append(f"a {kind} {field or name!r}")
            return
        shape = self._take_array().astype(np.int64).tolist()
        name = self._take_text() or field  # without a name: data of MATLAB objects
        if array in _NUMERIC and not is_complex and name:
            yield name, self._take_array().reshape(shape, order="F")
        elif array == _OBJECT:
            objects.append(f"an object of class {self._take_text()!r}")
        elif array == _STRUCT:
            yield from self._find_members(name, math.prod(shape), objects)

    def _find_members(self, name: str, count: int, objects: list[str]) -> Arrays:
        """Yield the arrays in the fields of a structure, or scalars of many structures as one."""
        length, names = self._take_number(), bytes(self._take_element()[1])
        if length <= 0 or len(names) % length or count * len(names) // length > len(self.data):
            raise ValueError("the names of the fields of a structure are damaged")
        parts = (names[at : at + length] for at in range(0, len(names), length))
        fields = [part.split(b"\0")[0].decode("latin-1") for part in parts]
        columns: dict[str, list[list[Array]]] = {field: [] for field in fields}
        for _ in range(count):
            for field in fields:
                kind, data = self._take_element()
                if kind != _MATRIX:
                    raise ValueError("a member of a structure is not an array")
                arrays = _Elements(data, self.order).find_numbers(
                    f"{name}.{field}", objects if count == 1 else []
                )
                if count == 1:
                    yield from arrays
                else:  # table2struct: one structure a row
                    columns[field].append([value for _, value in arrays])
        for field, rows in columns.items():
            if rows and all(len(row) == 1 and row[0].size == 1 for row in rows):
                yield f"{name}.{field}", np.array([row[0].item() for row in rows])

"""Layouts of binary records in TOML: of a user, or of known sensors in the folder ``layouts``.

A layout names the fields of a record in order, with units as in header cells::

    header_bytes = 512          # before the first record; 0 by default
    byte_order = "little"       # or "big"
    fields = [
        {name = "time [us]", type = "uint32"},
        {name = "gyro_x [0.1 arcsec/s]", type = "int32"},
        {skip = 4},             # bytes
    ]

With ``sync = "FE81FF55"`` the records are messages that begin with these bytes and end with the
CRC-32/MPEG-2 of all bytes before it (polynomial 0x04C11DB7, start 0xFFFFFFFF, not reflected),
padded with zeros to a multiple of four bytes, most significant byte first. Neither is listed as a
field. A field ``{counter = 128, type = "uint8"}`` numbers the messages, from 0 again after 127. A
``note`` is shown with every file of the layout.

References
----------
KVH Industries, 1775 IMU technical manual 56-0298, section 5; Sensonor, STIM300 datasheet TS1524.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gyrostab.arrays import Array, Ints
from gyrostab.errors import OptionError
from gyrostab.store.toml import load_toml_folder, parse_toml, read_toml_text

CRC_BYTES = 4
_POLYNOMIAL = np.uint32(0x04C11DB7)
#: Bytes that are searched at one time.
_BLOCK = 2**18
#: Name of a type -> code of numpy; 24 bits are read as three bytes.
TYPES = {
    **{
        f"{kind}{bits}": f"{kind[0]}{bits // 8}"
        for kind in ("int", "uint")
        for bits in (8, 16, 32, 64)
    },
    "int24": "V3",
    "float32": "f4",
    "float64": "f8",
}
_KEYS = ("byte_order", "fields", "header_bytes", "note", "sync")
#: Bytes at the beginning of a file, and messages in them, that decide on a known sensor.
_HEAD_BYTES, _HEAD_MESSAGES = 2**16, 3


@dataclass(frozen=True)
class Field:
    """A field of a record; `turn` is the number of values of a counter, 0 for other fields."""

    name: str
    dtype: np.dtype[Any]
    offset: int
    turn: int = 0


@dataclass(frozen=True)
class RecordLayout:
    """Fields of a record of `size` bytes, in a byte order of numpy; messages have `sync` bytes."""

    place: str
    order: str
    header: int
    size: int
    fields: tuple[Field, ...]
    counter: Field | None = None
    sync: bytes = b""
    note: str = ""


def layout_path(path: Path) -> Path:
    """Return the layout file that is named after a file."""
    return path.with_name(f"{path.name}.toml")


def find_layout_file(path: Path) -> Path | None:
    """Return the layout file of a file; None without one."""
    places = [layout_path(path), path.with_suffix(".toml"), path.with_name("layout.toml")]
    return next((place for place in places if place.is_file()), None)


def find_record_layout(path: Path) -> RecordLayout:
    """Return the layout of a layout file, or of the sensor whose messages a file holds."""
    place = find_layout_file(path)
    if place is None:
        return _find_known(path, layout_path(path).name)
    try:
        content = parse_toml(read_toml_text(place))
    except (ValueError, RecursionError) as error:
        raise OptionError(
            f"{place.name}: this layout is not valid TOML ({error}); correct it"
        ) from error
    return _parse_layout(place.name, content)


def _find_known(path: Path, name: str) -> RecordLayout:
    with path.open("rb") as file:
        head = np.frombuffer(file.read(_HEAD_BYTES), dtype=np.uint8)
    for layout in _known_layouts():
        if len(find_messages(head, layout.sync, layout.size)) >= _HEAD_MESSAGES:
            return layout
    fields = '{name = "time [us]", type = "uint32"}, {name = "gyro_x [deg/h]", type = "int32"}'
    raise OptionError(
        f"{path.name}: the layout of its records is unknown; write {name} next to it, for "
        f"instance: fields = [{fields}]"
    )


@cache
def _known_layouts() -> list[RecordLayout]:
    layouts = load_toml_folder("gyrostab.ingest.formats", "layouts")
    return [_parse_layout(name, content) for name, content in layouts.items()]


def _parse_layout(place: str, content: Mapping[str, Any]) -> RecordLayout:
    for key in content:
        if key not in _KEYS:
            raise OptionError(
                f"{place}: {key!r} is not a key of a layout; known are {', '.join(_KEYS)}"
            )
    order = {"little": "<", "big": ">"}.get(str(content.get("byte_order", "little")))
    header = content.get("header_bytes", 0)
    if order is None or type(header) is not int or header < 0:
        raise OptionError(
            f'{place}: byte_order is "little" or "big", and header_bytes a whole number; '
            "correct the layout"
        )
    try:
        sync = bytes.fromhex(content.get("sync", ""))
    except (TypeError, ValueError) as error:
        raise OptionError(f'{place}: sync is written as in "FE81FF55"; correct it') from error
    items = content.get("fields", ())
    parts: list[Field] = []
    size = len(sync)
    for number, item in enumerate(items if isinstance(items, list) else (), 1):
        field = _parse_field(item, order, size)
        if field is None:
            raise OptionError(
                f'{place}: field {number} is {{name = "...", type = "..."}}, {{counter = TURN, '
                f'type = "..."}} or {{skip = BYTES}}, the types are {", ".join(TYPES)}; correct '
                "the layout"
            )
        size = field.offset + field.dtype.itemsize
        parts.append(field)
    fields = tuple(field for field in parts if field.name)
    counters = [field for field in parts if field.turn]
    if not fields or len({field.name for field in fields}) < len(fields) or len(counters) > 1:
        raise OptionError(
            f"{place}: a layout needs fields with different names, and one counter at most; "
            "correct it"
        )
    size += CRC_BYTES if sync else 0
    counter = next(iter(counters), None)
    return RecordLayout(
        place, order, header, size, fields, counter, sync, str(content.get("note", ""))
    )


def _parse_field(item: Any, order: str, offset: int) -> Field | None:
    """Return a field, with neither name nor turn for skipped bytes; None if it is not usable."""
    keys = set(item) if isinstance(item, dict) else set()
    if keys == {"skip"} and type(item["skip"]) is int and 0 < item["skip"] < 2**31:
        return Field("", np.dtype(f"V{item['skip']}"), offset)
    code = TYPES.get(str(item["type"])) if "type" in keys else None
    if code is None:
        return None
    stored = np.dtype(code if code == "V3" else order + code)
    if keys == {"name", "type"}:
        return Field(str(item["name"]), stored, offset)
    turn = item.get("counter")
    usable = keys == {"counter", "type"} and isinstance(turn, int) and stored.kind == "u"
    most = 2 ** min(8 * stored.itemsize, 32)
    return Field("", stored, offset, turn) if usable and 1 < turn <= most else None


@cache
def _crc_table() -> Array:
    remainders = np.arange(256, dtype=np.uint32) << 24
    for _ in range(8):
        remainders = remainders << 1 ^ (remainders >> 31) * _POLYNOMIAL
    return remainders


def crc32_mpeg2(rows: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Return the checksum of each row of bytes, padded with zeros to a multiple of four bytes.

    Examples
    --------
    >>> rows = np.frombuffer(b"12345678", np.uint8)[None]
    >>> hex(crc32_mpeg2(rows)[0])
    '0x49e3c2fb'
    """
    table, checksums = _crc_table(), np.full(len(rows), 0xFFFFFFFF, dtype=np.uint32)
    for column in np.pad(rows, ((0, 0), (0, -rows.shape[1] % 4))).T:
        checksums = checksums << 8 ^ table[checksums >> 24 ^ column]
    return checksums


def find_messages(raw: NDArray[np.uint8], sync: bytes, size: int) -> Ints:
    """Return the first byte of each message that is complete and whose checksum is right.

    `raw` is the stream, such as a memory map of a file; a message begins with `sync` and has `size`
    bytes with sync bytes and checksum.
    """
    message_starts = [np.empty(0, dtype=np.int64)]
    for begin in range(0, max(len(raw) - size + 1, 0), _BLOCK):
        part = np.asarray(raw[begin : begin + _BLOCK + size - 1])
        starts = np.flatnonzero(part[: len(part) - size + 1] == sync[0])
        for place, byte in enumerate(sync[1:], 1):
            starts = starts[part[starts + place] == byte]
        rows = sliding_window_view(part, size)[starts]
        sums = np.ascontiguousarray(rows[:, -CRC_BYTES:]).view(">u4")[:, 0]
        message_starts.append(starts[crc32_mpeg2(rows[:, :-CRC_BYTES]) == sums] + begin)
    return np.concatenate(message_starts)


def unwrap_counter(counter: Array, modulus: int) -> Ints:
    """Return the sum of the steps of a counter that restarts from 0 after `modulus` - 1.

    A loss of a whole turn of the counter is not visible.

    Examples
    --------
    >>> unwrap_counter(np.array([126, 127, 0, 3]), 128).tolist()
    [0, 1, 2, 5]
    """
    steps = np.diff(counter.astype(np.int64), prepend=counter[:1].astype(np.int64))
    return np.cumsum(np.remainder(steps, modulus), dtype=np.int64)

"""Refuse formats that are recognised but not read, with advice on conversion."""

from __future__ import annotations

import bz2
import lzma
import re
import zlib
from collections.abc import Callable
from pathlib import Path

from gyrostab.errors import FormatError

__all__ = ["refuse_unread"]

HEAD_BYTES = 4096
_NOVATEL_TEXT = re.compile(rb"^(?:#|%)[A-Z0-9]{3,}A,[^\r\n]*;", re.MULTILINE)
_ARDUPILOT_TEXT = re.compile(rb"^FMT, ?128, ?89, ?FMT,", re.MULTILINE)

#: Name, test of the first bytes, advice.
_FORMATS: list[tuple[str, Callable[[bytes], bool], str]] = [
    (
        "an ArduPilot DataFlash log",
        lambda head: head.startswith(b"\xa3\x95\x80") or bool(_ARDUPILOT_TEXT.search(head)),
        "convert it to CSV with pymavlink: mavlogdump.py --format csv --types IMU FILE > "
        "imu.csv, and read that with "
        "--map GyrX=gyro_x --map GyrY=gyro_y --map GyrZ=gyro_z --unit gyro=rad/s --map "
        "TimeUS=time --unit time=us",
    ),
    (
        "a WITSML document",
        lambda head: (
            head.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"<")
            and bool(re.search(rb"(?i)witsml", head))
        ),
        "export the log as LAS or CSV from the WITSML server or its client",
    ),
    (
        "a NovAtel log",
        lambda head: (
            head.startswith((b"\xaa\x44\x12", b"\xaa\x44\x13")) or bool(_NOVATEL_TEXT.search(head))
        ),
        "convert its RAWIMU or CORRIMU messages to CSV with NovAtel Convert; the scale of a "
        "count is in the manual of the IMU, "
        'and is given as --unit "gyro=FACTOR deg/s"',
    ),
    (
        "a file of R data",
        lambda head: _decompress(head).startswith(
            (b"RDX2\n", b"RDX3\n", b"RDA2\n", b"RDA3\n", b"X\n\0\0\0")
        ),
        "save it as CSV in R: write.csv(as.data.frame(x), 'log.csv', row.names = FALSE)",
    ),
    (
        "a ROS bag",
        lambda head: head.startswith(b"#ROSBAG V"),
        "convert it to CSV: rostopic echo -b FILE -p /imu/data > imu.csv",
    ),
    (
        "an MCAP file",
        lambda head: head.startswith(b"\x89MCAP0\r\n"),
        "convert its IMU topic to CSV or Parquet, for instance with the Python packages rosbags "
        "or mcap",
    ),
    (
        "an SQLite database, perhaps a ROS 2 bag",
        lambda head: head.startswith(b"SQLite format 3\0"),
        "convert its IMU topic to CSV or Parquet, for instance with the Python package rosbags",
    ),
]


def refuse_unread(path: Path) -> None:
    """Raise an error for a file of a format that is recognised but not read."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    for name, is_one, advice in _FORMATS:
        if is_one(head):
            raise FormatError(
                f"{path.name}: this is {name}, which is not read yet; "
                f"{advice.replace('FILE', path.name)}"
            )


def _decompress(head: bytes) -> bytes:
    """Decompress the first bytes, or return them if they are not compressed."""
    try:
        if head.startswith(b"\x1f\x8b"):
            return zlib.decompressobj(wbits=31).decompress(head, 16)
        if head.startswith(b"BZh"):
            return bz2.BZ2Decompressor().decompress(head, 16)
        if head.startswith(b"\xfd7zXZ"):
            return lzma.LZMADecompressor().decompress(head, 16)
    except (OSError, EOFError, lzma.LZMAError, zlib.error):
        return b""
    return head

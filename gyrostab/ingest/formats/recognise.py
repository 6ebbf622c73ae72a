"""Recognise formats by first bytes and suffixes, and refuse those that are not read."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from gyrostab.errors import FormatError

#: Bytes at the beginning of a file that decide its format.
_HEAD_BYTES = 8192

_R_DATA = (".rdata", ".rda", ".rds")
_PACKED = (b"PK\x03\x04", b"7z\xbc\xaf\x27\x1c", b"Rar!", b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd")
_NUMPY = b"\x93NUMPY"
_OLD_OFFICE = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"
_SHEETS = (".xls", ".xlsx", ".xlsm", ".xlsb", ".ods")


def read_head(path: Path) -> bytes:
    """Read the first bytes of a file; empty for a folder."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        return file.read(_HEAD_BYTES)


def make_matcher(pattern: bytes, *suffixes: str) -> Callable[[Path], bool]:
    """Make the function `matches` of a format whose files begin with a regular expression.

    Files with one of the suffixes match too; these are in lower case, with a dot. A folder never
    matches.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "log.bin")
    ...     _ = path.write_bytes(b"PAR1...")
    ...     make_matcher(b"PAR1")(path), make_matcher(b"TDSm", ".bin")(path)
    (True, True)
    """

    def matches(path: Path) -> bool:
        """Return whether the file has this format."""
        is_named = path.suffix.lower() in suffixes
        return path.is_file() and (is_named or bool(re.match(pattern, read_head(path))))

    return matches


def refuse_unread(path: Path) -> None:
    """Raise an error for a file of a format that is recognised but not read."""
    head = read_head(path)
    if path.suffix.lower() in _R_DATA or head.startswith((b"RDX", b"RDA")):
        raise FormatError(
            f"{path.name}: this is a file of R data, which is not read; save it as CSV in R: "
            "write.csv(as.data.frame(x), 'log.csv', row.names = FALSE)"
        )
    if head.startswith(_NUMPY) or (head.startswith(_PACKED) and path.suffix.lower() == ".npz"):
        raise FormatError(
            f"{path.name}: numpy files state neither units nor times and are not read; in Python: "
            "gyrostab.make_log(numpy.load(...), rate=HZ, unit='deg/s'), then gyrostab.to_netcdf"
        )
    if head.startswith((*_PACKED, _OLD_OFFICE)) and path.suffix.lower() in _SHEETS:
        raise FormatError(
            f"{path.name}: spreadsheets are not read; save the sheet with the log as CSV, with all "
            "decimals of the time"
        )
    if head.startswith(_PACKED):
        raise FormatError(f"{path.name}: this file is packed; unpack it and give the files in it")

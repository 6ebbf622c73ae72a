"""Refuse formats that are recognised but not read, with advice on conversion."""

from __future__ import annotations

import bz2
import lzma
import zlib
from collections.abc import Callable
from pathlib import Path

from gyrostab.errors import FormatError

__all__ = ["refuse_unread"]

HEAD_BYTES = 4096

#: Name, test of the first bytes, advice.
_FORMATS: list[tuple[str, Callable[[bytes], bool], str]] = [
    (
        "a file of R data",
        lambda head: _decompress(head).startswith(
            (b"RDX2\n", b"RDX3\n", b"RDA2\n", b"RDA3\n", b"X\n\0\0\0")
        ),
        "save it as CSV in R: write.csv(as.data.frame(x), 'log.csv', row.names = FALSE)",
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

"""Recognition of files by their first bytes and suffixes."""

from __future__ import annotations

import re
from pathlib import Path

__all__ = ["begins_like", "read_head"]

#: Bytes at the beginning of a file that decide its format.
_HEAD_BYTES = 8192


def read_head(path: Path) -> bytes:
    """Read the first bytes of a file; empty for a folder."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        return file.read(_HEAD_BYTES)


def begins_like(path: Path, pattern: bytes | re.Pattern[bytes], *suffixes: str) -> bool:
    """Return whether a file begins with a regular expression or has one of the suffixes.

    Parameters
    ----------
    path : Path
        File; a folder never matches.
    pattern : bytes or re.Pattern
        Regular expression for the beginning of the file.
    *suffixes : str
        Suffixes in lower case, with a dot.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "log.bin")
    ...     _ = path.write_bytes(b"PAR1...")
    ...     begins_like(path, b"PAR1"), begins_like(path, b"TDSm", ".bin")
    (True, True)
    """
    if not path.is_file():
        return False
    return path.suffix.lower() in suffixes or bool(re.match(pattern, read_head(path)))

"""Recognition of foreign items in a folder: only a Zarr store without them may be replaced."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gyrostab.store.remote import find_url, read_object

__all__ = ["FindForeign", "find_foreign_item", "is_store", "read_json"]

#: Function that returns the name of an item of a folder that must not be removed, or None.
FindForeign = Callable[[Path], str | None]

_METADATA = {".zgroup", ".zarray", ".zattrs", ".zmetadata", "zarr.json"}
#: Keys of chunks of formats 2 and 3, ``1.0``, ``c.1.0``, or one level of ``c/1/0``, and chunks that
#: a killed process left.
_CHUNK = re.compile(r"(c|(c\.)?\d+(\.\d+)*)(\.[0-9a-f]{32}\.partial)?")


def read_json(path: Path) -> Any:
    """Read a JSON file, also at an address; None when it cannot be read."""
    url = find_url(path)
    try:
        return json.loads(read_object(url) if url else path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def _find_node(folder: str) -> str | None:
    """Find the Zarr metadata of a folder: ``array``, ``group`` or None."""
    for name, kind in ((".zarray", "array"), (".zgroup", "group"), ("zarr.json", None)):
        content = read_json(Path(folder, name))
        if isinstance(content, dict) and content.get("zarr_format") in (2, 3):
            return kind or ("array" if content.get("node_type") == "array" else "group")
    return None


def is_store(folder: Path) -> bool:
    """Whether a folder is a Zarr store, of gyrostab or another program."""
    return folder.is_dir() and _find_node(str(folder)) is not None


def find_foreign_item(folder: Path) -> str | None:
    """Find an item in a folder that is not part of a Zarr store.

    Returns
    -------
    str or None
        Path of the first such item inside the folder; None for a pure Zarr store and for an empty
        folder.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as name:
    ...     _ = Path(name, "tide.jpg").write_bytes(b"")
    ...     find_foreign_item(Path(name))
    'tide.jpg'
    """
    foreign_item = _find_in_node(str(folder))
    return None if foreign_item is None else os.path.relpath(foreign_item, folder)


def _find_in_node(folder: str) -> str | None:
    """Do the work of `find_foreign_item` for a group or an array; return the full path."""
    node = _find_node(folder)
    for entry in _list_entries(folder):
        if node is None or entry.is_symlink():
            return entry.path
        chunk = node == "array" and _CHUNK.fullmatch(entry.name)
        if entry.is_dir():
            foreign_item = _find_in_chunks(entry.path) if chunk else _find_in_node(entry.path)
            if foreign_item is not None:
                return foreign_item
        elif not entry.is_file() or not (chunk or entry.name in _METADATA):
            return entry.path
    return None


def _find_in_chunks(folder: str) -> str | None:
    for entry in _list_entries(folder):
        if (
            entry.is_symlink()
            or not _CHUNK.fullmatch(entry.name)
            or not (entry.is_dir() or entry.is_file())
        ):
            return entry.path
        if entry.is_dir() and (foreign_item := _find_in_chunks(entry.path)) is not None:
            return foreign_item
    return None


def _list_entries(folder: str) -> list[os.DirEntry[str]]:
    with os.scandir(folder) as entries:
        return sorted(entries, key=lambda entry: entry.name)

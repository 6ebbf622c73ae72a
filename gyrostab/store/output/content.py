"""Recognition of foreign items in a folder: only a Zarr store without them may be replaced."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gyrostab.store.remote import ROOT_METADATA, read_bytes

#: Function that returns the name of an item of a folder that must not be removed, or None.
FindForeign = Callable[[Path], str | None]

#: Names of the metadata of Zarr stores.
METADATA = {".zarray", *ROOT_METADATA}
#: Keys of chunks of formats 2 and 3, ``1.0``, ``c.1.0``, or one level of ``c/1/0``.
_CHUNK = re.compile(r"c|(c\.)?\d+(\.\d+)*")
#: How the name of a file ends that the library is writing, or that a killed process left.
UNFINISHED = re.compile(r"\.[0-9a-f]{32}\.partial$")


def read_json(path: Path) -> Any:
    """Read a JSON file, local or at an address, in any encoding; None if it cannot be read."""
    try:
        return json.loads(read_bytes(path))
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
    foreign_item = _find_in_node(str(folder), _find_node(str(folder)))
    return None if foreign_item is None else os.path.relpath(foreign_item, folder)


def _find_in_node(folder: str, node: str | None) -> str | None:
    """Find the full path of a foreign item in a group, an array or a folder of its chunks."""
    with os.scandir(folder) as entries:
        sorted_entries = sorted(entries, key=lambda entry: entry.name)
    for entry in sorted_entries:
        name = UNFINISHED.sub("", entry.name)
        is_chunk = node in ("array", "chunks") and _CHUNK.fullmatch(name)
        if node is None or entry.is_symlink() or (node == "chunks" and not is_chunk):
            return entry.path
        if entry.is_dir():
            inner_node = "chunks" if is_chunk else _find_node(entry.path)
            foreign_item = _find_in_node(entry.path, inner_node)
            if foreign_item is not None:
                return foreign_item
        elif not entry.is_file() or not (is_chunk or name in METADATA):
            return entry.path
    return None

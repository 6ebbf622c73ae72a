"""Check the Blosc chunks of a Zarr store; the library reads beyond the end of a cut one.

A Blosc chunk states its length in bytes 12 to 16. numcodecs does not compare it with the bytes that
it is given (seen in 0.16), so a chunk that was cut short, or whose header is damaged, can end the
process.

References
----------
C-Blosc, README_CHUNK_FORMAT.rst: header of a chunk.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from gyrostab.errors import FormatError
from gyrostab.store.output.content import METADATA, UNFINISHED

_HEADER_BYTES = 16


def is_blosc_cut(header: bytes, size: int) -> bool:
    """Whether a Blosc chunk of `size` bytes is shorter than its header says.

    Examples
    --------
    >>> is_blosc_cut(bytes(12) + (100).to_bytes(4, "little"), 99)
    True
    """
    if len(header) < _HEADER_BYTES:
        return True
    return size < max(int.from_bytes(header[12:16], "little"), _HEADER_BYTES)


def check_blosc_chunks(folder: Path, *, skip: Collection[Any] = ()) -> None:
    """Check the length of every Blosc chunk of a Zarr store (about 15 us a chunk).

    Parameters
    ----------
    folder : Path
        Store of format 2 or 3.
    skip : collection of str
        Variables that the library does not read.

    Raises
    ------
    FormatError
        When a chunk is cut short.
    """
    for array in _find_blosc_arrays(folder):
        if array.name in skip:
            continue
        for path in _find_chunks(array):
            # another process may replace or remove a chunk meanwhile
            with suppress(FileNotFoundError), path.open("rb") as file:
                header = file.read(_HEADER_BYTES)
                if is_blosc_cut(header, os.fstat(file.fileno()).st_size):
                    raise FormatError(
                        f"{folder.name}: is damaged: the chunk {path.relative_to(folder)} is cut "
                        "short; copy it again"
                    )


def _find_blosc_arrays(folder: Path) -> Iterator[Path]:
    """Find the arrays whose chunks are compressed with Blosc by their own metadata or the store's.

    The library prefers the consolidated metadata of the store, which may differ if it is damaged.
    """
    consolidated = _read_consolidated(folder)
    for place, _, names in os.walk(folder):
        metadata = [consolidated.get(Path(place).relative_to(folder).as_posix())]
        metadata += [_read_json(Path(place, name)) for name in {".zarray", "zarr.json"} & {*names}]
        if any(map(_uses_blosc, metadata)):
            yield Path(place)


def _read_consolidated(folder: Path) -> dict[str, Any]:
    """Return the consolidated metadata of the arrays in a store of format 2 or 3."""
    try:
        if (folder / ".zmetadata").exists():
            entries = _read_json(folder / ".zmetadata")["metadata"]
            return {name.removesuffix("/.zarray"): entry for name, entry in entries.items()}
        return dict(_read_json(folder / "zarr.json")["consolidated_metadata"]["metadata"])
    except (LookupError, TypeError, ValueError, AttributeError):
        return {}


def _read_json(path: Path) -> Any:
    """Read JSON in any encoding that the library reads; None if it refuses it."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None


def _uses_blosc(metadata: Any) -> bool:
    """Whether chunks of an array with these metadata are compressed with Blosc."""
    try:
        if "compressor" in metadata:
            return bool(metadata["compressor"]["id"] == "blosc")
        return bool(metadata["codecs"][-1]["name"] == "blosc")
    except (LookupError, TypeError):
        return False


def _find_chunks(array: Path) -> Iterator[Path]:
    for place, _, names in os.walk(array):
        finished_names = (name for name in names if not UNFINISHED.search(name))
        yield from (Path(place, name) for name in finished_names if name not in METADATA)

"""Protection of input files.

No output may replace or contain an input, and no input may change before the output is complete.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from gyrostab.errors import FormatError
from gyrostab.store.output.content import is_store
from gyrostab.store.remote import describe_address, find_url

#: Inputs of the current command, each with its first `describe_file`; None where a change does not
#: matter.
_PROTECTED: ContextVar[dict[Path, dict[str, Any] | None] | None] = ContextVar(
    "_PROTECTED", default=None
)


def describe_file(path: Path) -> dict[str, Any]:
    """Describe a file by size [bytes] and time of change; a folder (Zarr) by those of its files.

    Objects at addresses are described by `gyrostab.store.remote.describe_address`.
    """
    if url := find_url(path):
        return describe_address(url)
    try:
        if not path.is_dir():
            status = path.stat()
            return {"bytes": status.st_size, "changed_ns": status.st_mtime_ns}
        listing = sorted(_list_files(str(path), ""))
    except OSError:
        return {"bytes": None, "changed_ns": None}
    return {
        "bytes": sum(size for _, size, _ in listing),
        "changed_ns": max((changed for *_, changed in listing), default=0),
        "files": len(listing),
        "listing": hashlib.sha256(json.dumps(listing).encode()).hexdigest(),
    }


def _list_files(folder: str, inside: str) -> Iterator[tuple[str, int, int]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            name = f"{inside}{entry.name}"
            if entry.is_dir():
                yield from _list_files(entry.path, f"{name}/")
            else:
                status = entry.stat()
                yield name, status.st_size, status.st_mtime_ns


def match_files(paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Path]:
    """Find the files and folders that exist under names or patterns."""
    files: dict[Path, None] = {}
    for path in [paths] if isinstance(paths, str | os.PathLike) else paths:
        item = os.fspath(path)
        names = (
            [item]
            if os.path.lexists(item) or not glob.has_magic(item)
            else glob.glob(item, recursive=True)
        )
        files.update((Path(name), None) for name in names if os.path.lexists(name))
    return list(files)


@contextlib.contextmanager
def protect_inputs(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], *, growing: bool = False
) -> Iterator[None]:
    """Refuse, in the ``with`` block, outputs that would replace an input or a folder around it.

    An output is also refused when an input has changed before the output is complete, except for
    TOML files, which are read at the start. With `growing`, all inputs may change.

    Examples
    --------
    >>> import tempfile
    >>> from gyrostab.store.output import check_output
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = Path(folder, "log.nc")
    ...     _ = log.write_text("samples")
    ...     with protect_inputs([log]):
    ...         check_output(log, overwrite=True)
    Traceback (most recent call last):
    gyrostab.errors.OptionError: output '...log.nc' is also an input and would be destroyed; give...
    """
    protected = _PROTECTED.get() or {}
    files: dict[Path, dict[str, Any] | None] = {}
    for path in match_files(paths):
        is_data = path.suffix.lower() != ".toml" and (path.is_file() or is_store(path))
        is_fixed = is_data and not growing and path not in protected
        files[path] = describe_file(path) if is_fixed else None
    files |= protected
    token = _PROTECTED.set(dict.fromkeys(files) if growing else files)
    try:
        yield
    finally:
        _PROTECTED.reset(token)


def protected_inputs() -> list[Path]:
    """List the inputs of the current command."""
    return list(_PROTECTED.get() or ())


def check_unchanged() -> None:
    """Raise `FormatError` when an input of the current command has changed since the start."""
    for path, description in (_PROTECTED.get() or {}).items():
        if description is not None and describe_file(path) != description:
            change = "has changed" if path.exists() else "has vanished"
            raise FormatError(
                f"{path}: {change} while it was read, so nothing was written; "
                "start again once it is complete"
            )


def find_sources(dataset: Any) -> list[Path]:
    """Find the known files that a lazy `xarray.Dataset` still reads from.

    Examples
    --------
    >>> import xarray as xr
    >>> find_sources(xr.Dataset({"rate": ("time", [1.0])}))
    []
    """
    from gyrostab.store.lazy import find_files
    from gyrostab.store.private import is_in_memory

    lazy = [variable for variable in dataset.variables.values() if not is_in_memory(variable)]
    named = [variable.encoding.get("source") for variable in lazy] + [
        dataset.encoding.get("source") if lazy else None
    ]
    files = {Path(path) for path in named if path is not None}
    return sorted(files.union(*(find_files(v.data) for v in lazy if v.chunks is not None)))

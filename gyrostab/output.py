"""Files that take their name only once they are complete."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from gyrostab.errors import OutputError

__all__ = ["make_folder", "new_output"]

#: Looks, 20 ms apart, after which what has gone stays gone: a busy machine may hold a thread up that long.
_LOOKS = 15


@contextlib.contextmanager
def new_output(path: str | os.PathLike[str], *, overwrite: bool = False, directory: bool = False) -> Iterator[Path]:
    """Give a temporary name beside `path` to write to; rename it to `path` when the block succeeds, remove it when not.

    Parameters
    ----------
    path : path-like
        The final name.
    overwrite : bool
        Replace what has this name.
    directory : bool
        The output is a directory.

    Yields
    ------
    pathlib.Path
        Name to write to, in the same directory.

    Raises
    ------
    OutputError
        When `path` exists and `overwrite` is not given, or when the block fails to write.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with new_output(folder + "/note.txt") as temporary:
    ...         _ = temporary.write_text("complete")
    ...     os.listdir(folder)
    ['note.txt']
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        _check_target(path, overwrite=overwrite, directory=directory)
        if directory:
            temporary.mkdir()
        else:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        _sync(temporary)
        if directory and path.exists():
            old = temporary.with_suffix(".old")
            path.rename(old)
            temporary.rename(path)
            shutil.rmtree(old)
        else:
            os.replace(temporary, path)
        _sync(path.parent)
    except (OSError, RuntimeError) as error:
        if isinstance(error, OutputError) or (isinstance(error, RuntimeError) and not str(error).startswith("NetCDF:")):
            raise
        raise OutputError(f"{path}: cannot be written: {_reason(error, path)}") from error
    finally:
        _remove(temporary)


def make_folder(folder: Path) -> None:
    """Make a folder, with those above it, unless it is there; raise `OutputError` when that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"folder {str(folder)!r} cannot be made ({error.strerror}); give another one with -o") from error


def _check_target(path: Path, *, overwrite: bool, directory: bool) -> None:
    if not path.parent.is_dir():
        raise OutputError(f"{path}: cannot be written: there is no directory {path.parent}; make it first or choose another")
    if not os.path.lexists(path):
        return
    if path.is_dir() != directory:
        kind = "a directory" if path.is_dir() else "a file"
        raise OutputError(f"{path}: cannot be written: {kind} has this name already; choose another name")
    if not overwrite:
        raise OutputError(f"{path} exists already; give --overwrite (overwrite=True) to replace it, or choose another name")


def _sync(path: Path) -> None:
    """Ask the system to bring a file (or the entries of a directory) to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _remove(path: Path) -> None:
    """Remove what was written; a thread that still writes its piece of a directory may bring it back, so look again."""
    if not path.is_dir():
        with contextlib.suppress(OSError):
            path.unlink()
        return
    gone = 0
    for _ in range(100):
        shutil.rmtree(path, ignore_errors=True)
        gone = 0 if path.exists() else gone + 1
        if gone == _LOOKS:
            return
        time.sleep(0.02)


def _reason(error: Exception, path: Path) -> str:
    if isinstance(error, PermissionError):
        return f"no permission to write in {path.parent}; choose another directory"
    number = (error.errno or 0) if isinstance(error, OSError) else 0
    text = os.strerror(number) if number > 0 else str(error)  # the NetCDF and HDF5 libraries say no more than "HDF error"
    with contextlib.suppress(OSError):
        free = shutil.disk_usage(path.parent).free / 2**20
        text += f"; {free:,.0f} MiB are free there: is the disk full, or a quota or size limit reached?"
    return text

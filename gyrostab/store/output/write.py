"""Writing files and folders under a temporary name, renamed once they are complete."""

from __future__ import annotations

import contextlib
import errno
import glob
import hashlib
import os
import re
import secrets
import shutil
import stat
import time
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

from gyrostab.errors import GyrostabError, OutputError
from gyrostab.store.output.check import check_folder, check_target
from gyrostab.store.output.content import FindForeign
from gyrostab.store.output.inputs import check_unchanged
from gyrostab.store.remote import find_url, upload, upload_file
from gyrostab.store.system import exchange_paths, rename_new, sync_path

#: Number of checks, 20 ms apart, after which a removed folder counts as gone: on a busy machine, a
#: thread may be delayed that long before it writes again.
_MIN_ABSENT_CHECKS = 15
_MAX_NAME_BYTES = 255  # of one file name on the usual file systems
_LEFTOVER = re.compile(r"\.(.*\.)?gyrostab-[0-9a-f]{8}\.part")


@contextlib.contextmanager
def new_output(
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    find_foreign: FindForeign | None = None,
    inputs: Iterable[str | os.PathLike[str]] = (),
) -> Iterator[Path]:
    """Provide a temporary name to write to, and rename it to `path` if the block succeeds.

    If the block fails, the temporary file is removed.

    Parameters
    ----------
    path : path-like
        The final name; a symbolic link means its target.
    overwrite, find_foreign, inputs
        As for `gyrostab.store.output.check_target`.

    Yields
    ------
    pathlib.Path
        Name to write to, in the same directory.

    Raises
    ------
    OptionError
        When `path` is an input or contains one.
    OutputError
        When `path` exists and may not be replaced, or when the block fails to write.
    FormatError
        When an input has changed in the meantime.

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

    def check() -> Path:
        return check_target(path, overwrite=overwrite, inputs=inputs, find_foreign=find_foreign)

    target = check()
    url = find_url(path)
    if url is not None:
        with upload(url) as temporary:
            yield temporary
            check_unchanged()
        return
    for leftover in _find_leftovers(target):
        warnings.warn(
            f"{leftover} is being written now, or was left by a process that was killed: "
            "then delete it",
            stacklevel=3,
        )
    hidden = target.with_name(hide_name(target.name, _make_mark()))
    with _temporary_output(target, hidden, make_folder=find_foreign is not None) as temporary:
        yield temporary
        _sync_tree(temporary)
        check_unchanged()
        check()
        if find_foreign is not None and target.is_dir():
            _replace_folder(temporary, target, find_foreign)
        elif overwrite and find_foreign is None:
            os.replace(temporary, target)
            sync_path(target.parent)
        else:
            _rename_new(temporary, target)


@contextlib.contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Write a file inside a folder of gyrostab like `new_output`, and replace an existing one."""
    if find_url(path):
        with upload_file(path) as temporary:
            yield temporary
        return
    hidden = path.with_name(hide_name(path.name, _make_mark()))
    with _temporary_output(path, hidden, make_folder=False) as temporary:
        yield temporary
        _sync_tree(temporary)
        os.replace(temporary, path)
        sync_path(path.parent)


def write_text(path: Path, text: str) -> Path:
    """Write a text file like `replace_file`."""
    with replace_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


@contextlib.contextmanager
def new_folder(folder: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Provide a temporary folder, and move its files to `folder` if the block succeeds.

    If the block fails, they are removed. Other files in `folder` stay unchanged.

    Parameters
    ----------
    folder : path-like
        The folder; it is made, with its parents, if it does not exist.

    Yields
    ------
    pathlib.Path
        Folder to write to.

    Raises
    ------
    OutputError
        When the folder cannot be made or written to, or holds a file of one of the names and
        `overwrite` is not given.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as name:
    ...     with new_folder(name + "/figures") as temporary:
    ...         _ = (temporary / "davar.png").write_bytes(b"")
    ...     os.listdir(name + "/figures")
    ['davar.png']
    """
    folder = Path(folder)
    made = _make_folder(folder)
    try:
        with _temporary_output(folder, folder / _make_mark(), make_folder=True) as temporary:
            yield temporary
            _sync_tree(temporary)
            check_unchanged()
            check_folder(folder, os.listdir(temporary), overwrite=overwrite)
            for name in sorted(os.listdir(temporary)):
                target = check_target(folder / name, overwrite=overwrite)
                (os.replace if overwrite else _rename_new)(temporary / name, target)
            temporary.rmdir()
    except BaseException:
        for level in made:
            with contextlib.suppress(OSError):  # another process has put something there
                level.rmdir()
        raise


def _make_folder(folder: Path) -> list[Path]:
    """Make a folder and its parents; return the ones that were made, the innermost first."""
    missing = [level for level in (folder, *folder.parents) if not level.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"folder {str(folder)!r} cannot be made ({error.strerror}); give another one with -o"
        ) from error
    return missing


@contextlib.contextmanager
def _temporary_output(target: Path, temporary: Path, *, make_folder: bool) -> Iterator[Path]:
    """Make a hidden file or folder, and remove it if the block fails; explain write errors.

    It has the permissions of an existing target, and can be written.
    """
    complete = False
    try:
        if make_folder:
            temporary.mkdir()
        else:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        with contextlib.suppress(OSError):  # without an output to be replaced
            mode = stat.S_IMODE(target.stat().st_mode)
            temporary.chmod(mode | (0o700 if make_folder else 0o600))
        yield temporary
        complete = True
    except (OSError, RuntimeError) as error:
        if isinstance(error, GyrostabError) or (
            isinstance(error, RuntimeError) and not str(error).startswith("NetCDF:")
        ):
            raise
        raise OutputError(
            f"{target}: cannot be written: {_describe_reason(error, target)}"
        ) from error
    finally:
        if not complete:
            _remove_until_gone(temporary)


def hide_name(name: str, suffix: str) -> str:
    """Make the hidden name of a file or folder for an output, shorter where the name is too long.

    Examples
    --------
    >>> hide_name("log.nc", ".job"), hide_name("n" * 255, ".job")
    ('.log.nc.job', '.3bb555e4.job')
    """
    hidden = f".{name}{suffix}"
    if len(os.fsencode(hidden)) <= _MAX_NAME_BYTES:
        return hidden
    return f".{hashlib.sha256(os.fsencode(name)).hexdigest()[:8]}{suffix}"


def _make_mark() -> str:
    """Make a unique suffix for a file or folder that is being written."""
    return f".gyrostab-{secrets.token_hex(4)}.part"


def is_leftover(name: str) -> bool:
    """Whether a file name marks an incomplete output.

    Examples
    --------
    >>> is_leftover(".log.nc.gyrostab-0123abcd.part"), is_leftover(".log.nc.part")
    (True, False)
    """
    return _LEFTOVER.fullmatch(name) is not None


def _find_leftovers(target: Path) -> list[Path]:
    mark = f".gyrostab-{8 * '?'}.part"
    hidden = hide_name(target.name, mark).removesuffix(mark)
    names = glob.glob(glob.escape(hidden) + mark, root_dir=target.parent)
    return [target.parent / name for name in sorted(names) if is_leftover(name)]


def remove_leftovers(output: Path) -> None:
    """Remove what a killed process left under a hidden name.

    Only for a process that holds the lock of the output, so that no other writes it.
    """
    for path in _find_leftovers(output):
        _remove_tree(path)


def _replace_folder(temporary: Path, target: Path, find_foreign: FindForeign) -> None:
    """Exchange a complete folder with an older one, and remove the older one."""
    if exchange_paths(temporary, target):
        if find_foreign(temporary) is not None:  # something was added since the check
            exchange_paths(temporary, target)
            raise OutputError(
                f"{target}: has changed while the new one was written, so it is not replaced; "
                "give another name with -o"
            )
    else:
        aside = target.with_name(hide_name(target.name, _make_mark()))
        target.rename(aside)
        try:
            temporary.rename(target)
        except BaseException:
            aside.rename(target)
            raise
        temporary = aside
    sync_path(target.parent)
    _remove_tree(temporary)
    if temporary.exists():
        warnings.warn(
            f"{temporary}: the folder that was replaced cannot be removed; delete it", stacklevel=4
        )


def _rename_new(source: Path, target: Path) -> None:
    """Rename a file or folder unless the name is taken."""
    try:
        rename_new(source, target)
    except FileExistsError:
        raise OutputError(
            f"output {str(target)!r} exists already: another process has made it meanwhile; "
            "give --overwrite (overwrite=True) to replace it"
        ) from None
    sync_path(target.parent)


def _sync_tree(path: Path) -> None:
    """Bring a file, or a folder with its content, to the disk."""
    for folder, _, names in os.walk(path):
        for name in names:
            sync_path(Path(folder, name))
        sync_path(Path(folder))
    if not path.is_dir():
        sync_path(path)


def _remove_until_gone(path: Path) -> None:
    """Remove an output until it stays removed: a thread that still writes may make it again."""
    folder, gone = path.is_dir(), 0
    for _ in range(100):
        _remove_tree(path)
        gone = 0 if path.exists() else gone + 1
        if gone == _MIN_ABSENT_CHECKS or not folder:
            return
        time.sleep(0.02)


def _remove_tree(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


_SHARING_VIOLATION = 32  # of Windows
_DISK_FULL_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def _describe_reason(error: Exception, path: Path) -> str:
    if getattr(error, "winerror", None) == _SHARING_VIOLATION:
        return "it is open in another program; close it there"
    if isinstance(error, PermissionError):
        return f"no permission to write in {path.parent}; choose another directory"
    number = (error.errno or 0) if isinstance(error, OSError) else 0
    text = os.strerror(number) if number > 0 else str(error)
    if number > 0 and number not in _DISK_FULL_ERRNOS:
        return text
    with contextlib.suppress(OSError):  # the NetCDF and HDF5 libraries say no more than "HDF error"
        free = shutil.disk_usage(path.parent).free / 2**20
        text += (
            f"; {free:,.0f} MiB are free there: is the disk full, or a quota or size limit reached?"
        )
    return text

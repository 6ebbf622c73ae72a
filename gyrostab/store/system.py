"""Calls of the operating system that not every system has, each with a fallback.

docs/durability.md lists what Linux, macOS and Windows guarantee.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import importlib
import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def _import_if_present(name: str) -> Any:
    return importlib.import_module(name) if find_spec(name) else None


_FCNTL = _import_if_present("fcntl")  # absent on Windows
_MSVCRT = _import_if_present("msvcrt")  # present on Windows only
#: Byte that is locked on Windows, where no other process can read a locked byte.
_LOCKED_BYTE = 2**30

NO_REPLACE, EXCHANGE = "no replace", "exchange"
#: Function of the C library that renames with a flag, and its flags: linux/fs.h (Linux 3.15) and
#: sys/stdio.h (macOS 10.12).
_FLAGGED_RENAMES = {
    "linux": ("renameat2", {NO_REPLACE: 1, EXCHANGE: 2}),
    "darwin": ("renamex_np", {NO_REPLACE: 4, EXCHANGE: 2}),
}
_AT_FDCWD = -100
_UNSUPPORTED_ERRNOS = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM)

_M_MMAP_THRESHOLD = -3  # of malloc.h of glibc
_LARGE_BYTES = 2**17  # its first value, which it raises up to 32 MiB unless it is set


def sync_path(path: Path) -> None:
    """Bring a file, or the entries of a folder, to the disk.

    Windows cannot open a folder, and its file system keeps a journal of the entries; a file must
    be open for writing there. On macOS, `os.fsync` leaves the cache of the drive alone.
    """
    can_open_folders = hasattr(os, "O_DIRECTORY")
    if path.is_dir() and not can_open_folders:
        return
    handle = os.open(path, os.O_RDONLY if can_open_folders else os.O_RDWR)
    try:
        if hasattr(_FCNTL, "F_FULLFSYNC"):
            with contextlib.suppress(OSError):  # a file system without this command
                _FCNTL.fcntl(handle, _FCNTL.F_FULLFSYNC)
        os.fsync(handle)
    finally:
        os.close(handle)


def rename_with_flag(source: Path, target: Path, flag: str) -> bool:
    """Rename with `NO_REPLACE` or `EXCHANGE`, in one step; False where the system cannot do so."""
    name, flags = _FLAGGED_RENAMES.get(sys.platform, ("", {}))
    call = getattr(ctypes.CDLL(None, use_errno=True), name, None) if name else None
    if call is None:
        return False
    names = os.fsencode(source), os.fsencode(target)
    if name == "renameat2":
        failed = call(_AT_FDCWD, names[0], _AT_FDCWD, names[1], flags[flag])
    else:
        failed = call(*names, flags[flag])
    if not failed:
        return True
    number = ctypes.get_errno()
    if number in _UNSUPPORTED_ERRNOS:
        return False
    raise OSError(number, os.strerror(number), str(target))


def exchange_paths(first: Path, second: Path) -> bool:
    """Let two paths change places, in one step; False where the system cannot do so."""
    return rename_with_flag(first, second, EXCHANGE)


def rename_new(source: Path, target: Path) -> None:
    """Rename a file or folder unless the new name is taken, in one step where the system can.

    Without a flagged rename, a file gets the new name as a hard link, which also fails when the
    name is taken. A folder, or a file on a file system without links, is looked up first.
    """
    if rename_with_flag(source, target, NO_REPLACE):
        return
    if not source.is_dir():
        try:
            os.link(source, target)
        except FileExistsError:
            raise
        except (AttributeError, NotImplementedError, OSError):
            pass
        else:
            os.unlink(source)
            return
    if os.path.lexists(target):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target))
    os.rename(source, target)


def lock_file(handle: int) -> bool:
    """Lock an open file until it is closed; False when another process holds the lock.

    True without any effect on a system or a file system that has no locks.
    """
    held_elsewhere: type[OSError] = BlockingIOError if _FCNTL is not None else PermissionError
    try:
        if _FCNTL is not None:
            _FCNTL.flock(handle, _FCNTL.LOCK_EX | _FCNTL.LOCK_NB)
        elif _MSVCRT is not None:
            os.lseek(handle, _LOCKED_BYTE, os.SEEK_SET)
            _MSVCRT.locking(handle, _MSVCRT.LK_NBLCK, 1)
    except held_elsewhere:
        return False
    except OSError:  # a file system without locks
        return True
    return True


def return_large_arrays() -> None:
    """Let glibc return each large array to the system when it is freed, not only at first."""
    with contextlib.suppress(TypeError, AttributeError):  # on Windows and without glibc
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)


def release_memory() -> None:
    """Return memory that is free in the C library to the system; glibc alone keeps it."""
    with contextlib.suppress(TypeError, AttributeError):  # on Windows and without glibc
        ctypes.CDLL(None).malloc_trim(0)

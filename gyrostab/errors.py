"""Exceptions of gyrostab.

Each one also inherits from the builtin exception that a Python user would expect, so that ``except
ValueError`` works. A message names the place (file, line or time), what is wrong and what to do.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

#: Errors of the operating system that concern the process or the path, not the content of a file.
SYSTEM_ERRNOS = (
    errno.EACCES, errno.EDQUOT, errno.EFBIG, errno.EINTR, errno.EISDIR, errno.ELOOP, errno.EMFILE,
    errno.ENAMETOOLONG, errno.ENFILE, errno.ENOENT, errno.ENOMEM, errno.ENOSPC,
    errno.ENOTDIR, errno.EPERM, errno.ESTALE,
)  # fmt: skip


class GyrostabError(Exception):
    """Base class: bad input or usage, explained in one message."""


class FormatError(GyrostabError, ValueError):
    """A file cannot be read as the format it claims to be, or holds no usable rows."""


class FailedRunsError(FormatError):
    """Runs of a fleet failed; all others are complete."""


class DamageError(FormatError):
    """A library failed while it read a file; ``__cause__`` is the exception that it raised."""


class UnitError(GyrostabError, ValueError):
    """A unit is unknown, or does not fit its quantity."""


class MissingUnitError(UnitError):
    """A column carries no unit and none was given."""


class TimeError(GyrostabError, ValueError):
    """The time stamps contradict each other or the declared sampling rate."""


class OptionError(GyrostabError, ValueError):
    """An option of a function or command makes no sense, alone or with this input."""


class SchemaError(GyrostabError, ValueError):
    """A dataset lacks a variable, dimension or unit that the function needs."""


class OutputError(GyrostabError, OSError):
    """A result cannot be written; nothing half-written is left behind."""


class ResumeError(GyrostabError, ValueError):
    """An unfinished run cannot be continued, or not by this process."""


class WorkerError(GyrostabError, RuntimeError):
    """Worker processes cannot be reached, cannot see the files, or have died."""


@contextmanager
def reading_of(path: str | PathLike[str]) -> Iterator[None]:
    """Convert exceptions of a library that reads a file to a `DamageError` that names the file.

    Format libraries raise exceptions of any type on damaged bytes. Opening a file and every later
    read of lazy data run in this context, so that callers need not know those types.

    Raises
    ------
    DamageError
        When the block raises anything but a `GyrostabError` or an error of the operating system,
        such as a missing permission.

    Examples
    --------
    >>> with reading_of("/data/log.nc"):
    ...     raise RuntimeError("NetCDF: HDF error")
    Traceback (most recent call last):
    gyrostab.errors.DamageError: log.nc: is damaged, or not of its format (RuntimeError: ...
    """
    try:
        yield
    except GyrostabError:
        raise
    except OSError as error:
        if error.errno in SYSTEM_ERRNOS:
            raise
        raise _describe_damage(path, error) from error
    except Exception as error:
        raise _describe_damage(path, error) from error


def _describe_damage(path: str | PathLike[str], error: Exception) -> DamageError:
    name, text = Path(path).name, " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return DamageError(
            f"{name}: reading it takes more memory than there is{f' ({text})' if text else ''}; "
            "is it damaged?"
        )
    reason = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return DamageError(f"{name}: is damaged, or not of its format ({reason:.300}); copy it again")

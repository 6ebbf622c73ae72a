"""Errors that gyrostab raises on purpose.

Each one also inherits the builtin that a Python user would expect, so ``except ValueError`` keeps working.
A message says what was read (file, line or time), what is wrong with it and what to do.
"""

from __future__ import annotations

__all__ = [
    "FormatError",
    "GyrostabError",
    "MissingUnitError",
    "OptionError",
    "OutputError",
    "ResumeError",
    "SchemaError",
    "TimeError",
    "UnitError",
    "WorkerError",
]


class GyrostabError(Exception):
    """Root of the family: bad input or usage, explained in one message."""


class FormatError(GyrostabError, ValueError):
    """A file cannot be read as the format it claims to be, or holds no usable rows."""


class UnitError(GyrostabError, ValueError):
    """A unit is unknown, or does not fit the quantity it stands for."""


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
    """A run that was begun cannot be continued, or not by this process."""


class WorkerError(GyrostabError, RuntimeError):
    """The processes that were to do the work cannot be reached, cannot see the files, or have died."""

"""Import format libraries that are optional."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from gyrostab.errors import OptionError

__all__ = ["library"]


def library(name: str, path: Path, *, extra: str) -> Any:
    """Import a format library.

    Raises
    ------
    OptionError
        When it is not installed; the message names the extra that installs it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise OptionError(
            f"{path.name}: reading it needs {name}; install it with pip install 'gyrostab[{extra}]'"
        ) from error

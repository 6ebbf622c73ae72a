"""TOML files of users: models, layouts and options."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any


def read_toml_text(path: Path) -> str:
    """Read the text of a TOML file: UTF-8, with or without the byte order mark of some editors.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it is not text in UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError("it is not text in UTF-8; save it as UTF-8") from error


def load_toml_folder(package: str, folder: str) -> dict[str, dict[str, Any]]:
    """Load the TOML files in a folder of a package, by name and in order of their names."""
    places = sorted(files(package).joinpath(folder).iterdir(), key=lambda place: place.name)
    return {
        place.name.removesuffix(".toml"): tomllib.loads(place.read_text(encoding="utf-8"))
        for place in places
        if place.name.endswith(".toml")
    }


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML 1.0, in which integers have at most 64 bits.

    Raises
    ------
    ValueError, RecursionError
        If the text is not TOML.

    Examples
    --------
    >>> parse_toml("a = [1, 2.5]")
    {'a': [1, 2.5]}
    """
    content = tomllib.loads(text)
    _check_integers(content)
    return content


def _check_integers(value: Any) -> None:
    """Raise ValueError for an integer of more than 64 bits in nested tables and lists."""
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            _check_integers(item)
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ValueError(f"an integer of {value.bit_length()} bits, where 64 are the most")

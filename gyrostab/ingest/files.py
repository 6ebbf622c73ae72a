"""Find the readers of files, and read or scan single files."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Sequence
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol, cast

import xarray as xr

from gyrostab.errors import FormatError, OptionError, reading_of
from gyrostab.ingest.formats.binary import has_layout
from gyrostab.ingest.formats.recognise import refuse_unread
from gyrostab.ingest.options import FileSummary, ReadOptions
from gyrostab.store.remote import fetch_file, find_remote_kind, find_url, list_urls

GROUP = "gyrostab.readers"


class Reader(Protocol):
    """Interface of a reader module."""

    def matches(self, path: Path) -> bool:
        """Return whether the file has this format."""

    def scan(self, path: Path, options: ReadOptions) -> FileSummary:
        """Summarise the file without reading its data."""

    def read(self, path: Path, options: ReadOptions) -> xr.Dataset:
        """Read the file into a raw log, or open a regular log."""


@cache
def _entry_points() -> dict[str, Any]:
    return {point.name: point for point in entry_points(group=GROUP)}


def readers() -> tuple[str, ...]:
    """Return the names of the formats that can be read.

    Examples
    --------
    >>> "text" in readers()
    True
    """
    return tuple(sorted(_entry_points()))


def find_reader(path: Path) -> Reader:
    """Find the reader of a file; binary and text are tried last, as they match most files."""
    if find_url(path):
        return cast(Reader, _entry_points()["netcdf"].load())
    if not path.exists():
        raise FormatError(f"{path}: there is no such file")
    if not (path.is_file() or path.is_dir()):
        raise FormatError(
            f"{path}: is a pipe or a device, which can be read only once; write its content to a "
            "file and give that"
        )
    first = "binary" if has_layout(path) else None
    if first is None:
        refuse_unread(path)
    order = {"netcdf": -1, "binary": 1, "text": 2}  # archives of many files are NetCDF
    names = sorted(_entry_points(), key=lambda name: (name != first, order.get(name, 0), name))
    for name in names:
        reader = cast(Reader, _entry_points()[name].load())
        if reader.matches(path):
            return reader
    if path.is_dir():
        raise FormatError(
            f"{path}: no reader takes this directory; name the files in it, for instance "
            f"{path / '*.csv'}"
        )
    problem = f"no reader takes this file with the suffix {path.suffix!r}, and it is not text"
    raise FormatError(
        f"{path}: {problem}; formats are {', '.join(readers())}: save it as one of these"
    )


def expand(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """Return the files that paths and patterns name, each once.

    They are in the order given, and those of a pattern in alphabetical order; but files whose names
    differ only in numbers are in the order of these: run_9 comes before run_10.
    """
    files: dict[Path, None] = {}
    is_single = isinstance(paths, str | bytes) or hasattr(paths, "read")
    items: Any = [paths] if is_single or not isinstance(paths, Iterable) else paths
    for item in items:
        if not isinstance(item, str | os.PathLike):
            raise OptionError(f"{item!r} is not the name of a file; give a text or a pathlib.Path")
        text = str(item)
        url = find_url(item)
        if not glob.has_magic(text) or Path(text).exists():
            matching = [Path(text)]
        elif url is not None:
            matching = [Path(match) for match in list_urls(url)]
        else:
            matching = [Path(match) for match in sorted(glob.glob(text, recursive=True))]
        if not matching:
            raise FormatError(f"{url or text}: no file fits this pattern")
        files.update(dict.fromkeys(matching))
    if not files:
        raise OptionError("no file was given; name at least one log")
    return _order_by_numbers(list(files))


def _order_by_numbers(paths: Sequence[Path]) -> list[Path]:
    """Exchange paths that differ only in numbers so that these rise."""
    same_words: dict[str, list[Path]] = {}
    for path in sorted(paths, key=name_key, reverse=True):
        same_words.setdefault(re.sub(r"\d+", "0", str(path)), []).append(path)
    return [same_words[re.sub(r"\d+", "0", str(path))].pop() for path in paths]


def name_key(path: Path) -> list[tuple[int, int, str]]:
    """Return a sort key by which run_9 comes before run_10."""
    return [
        (0, int(piece), "") if piece.isdigit() else (1, 0, piece)
        for piece in re.split(r"(\d+)", str(path))
        if piece
    ]


def scan_file(path: str | Path, options: ReadOptions | None = None) -> FileSummary:
    r"""Summarise a file without reading its data.

    Parameters
    ----------
    options : ReadOptions, optional
        Reading options; what remains unclear is in the notes.

    Returns
    -------
    FileSummary
        Format, columns, axes, channels; stamps and number of rows where they are cheap to find.

    Raises
    ------
    FormatError
        When no reader accepts the file, or it cannot be read at all.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = Path(mkdtemp()) / "log.csv"
    >>> _ = path.write_text("time [s],gyro_x [deg/h]\n0.0,1.5\n0.5,1.25\n")
    >>> summary = scan_file(path)
    >>> summary.axes, summary.n_rows, summary.last
    (('x',), 2, np.datetime64('1970-01-01T00:00:00.500000000'))
    """
    path = _fetch_remote(Path(path))
    reader = find_reader(path)
    with reading_of(path):
        return reader.scan(path, options or ReadOptions())


def _fetch_remote(path: Path) -> Path:
    """Return a temporary copy of a file at an address; other paths and Zarr stores as they are."""
    url = find_url(path)
    return path if url is None or find_remote_kind(url) == "store" else fetch_file(url)


def read_file(path: Path, options: ReadOptions) -> xr.Dataset:
    """Read one file into a raw log, or open it as a regular log."""
    path = _fetch_remote(path)
    reader = find_reader(path)
    with reading_of(path):
        return reader.read(path, options)

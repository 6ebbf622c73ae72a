"""Files of a live view, the rows of standard input, and which samples have changed."""

from __future__ import annotations

import hashlib
import itertools
import re
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import xarray as xr

from gyrostab.errors import FormatError
from gyrostab.ingest.columns.pieces import Spool
from gyrostab.ingest.combine import move_to_disk
from gyrostab.ingest.concat.lazy import GridSource, clip_runs
from gyrostab.ingest.files import read_file
from gyrostab.ingest.options import ReadOptions
from gyrostab.schema import log_channels, signal_name
from gyrostab.store.lazy import find_source, read_slice
from gyrostab.store.output.inputs import describe_file, match_files
from gyrostab.time.grid import first_stamp, grid_times
from gyrostab.time.stamps import to_nanoseconds

#: Files written this long [s] before the newest one, or later, may still grow.
_GROWING_SECONDS = 60.0
#: Size of the files in which rows of standard input are kept [bytes].
_MAX_ROW_FILE_BYTES = 2**26
_READ_BYTES = 2**16
_DATA_ROW = re.compile(rb'\s*"?[-+.\d]')
_ROW_FILE = "rows-{}.csv"


#: Files with their states, as from `describe_file`.
FileStates = dict[Path, dict[str, Any]]


def list_files(source: str) -> FileStates:
    """List the files of a folder, of a pattern, or a single file, with their states.

    Hidden files, empty files and folders are left out.
    """
    paths = Path(source).iterdir() if Path(source).is_dir() else match_files(source)
    states = {
        path: describe_file(path)
        for path in sorted(paths)
        if path.is_file() and not path.name.startswith(".")
    }
    return {path: state for path, state in states.items() if state["bytes"]}


class FileMemory:
    """Reads files, and remembers those that have not changed since, on disk."""

    def __init__(self) -> None:
        self.files: FileStates = {}
        self.ended = False  # whether no file grows any more
        self._spool = Spool()
        self._kept: dict[Path, tuple[dict[str, Any], bool, xr.Dataset]] = {}

    def is_growing(self, path: Path) -> bool:
        """Whether a file may still grow."""
        newest = max(state["changed_ns"] for state in self.files.values())
        age = (newest - self.files[path]["changed_ns"]) / 1e9
        return not self.ended and age < _GROWING_SECONDS

    def update(self, files: FileStates) -> bool:
        """Take over a new list of files; return whether an earlier file was replaced or cut."""
        earlier_files, self.files = self.files, files
        for path in self._kept.keys() - files.keys():
            del self._kept[path]
        return any(
            path not in files or files[path]["bytes"] < state["bytes"]
            for path, state in earlier_files.items()
        )

    def read(self, path: Path, options: ReadOptions) -> xr.Dataset:
        """Read a file, or return what was read of it before."""
        if path not in self.files:  # a channel
            return read_file(path, options)
        state, growing = self.files[path], self.is_growing(path)
        if path in self._kept and self._kept[path][:2] == (state, growing):
            return self._kept[path][2].copy(deep=False)
        log = read_file(path, replace(options, growing=growing))
        if "row" not in log.dims:
            raise FormatError(
                f"{path}: is a regular log, which does not grow; analyse it with gyrostab run"
            )
        if not growing:
            log = move_to_disk(log, self._spool)
        self._kept[path] = state, growing, log
        return log.copy(deep=False)


class RowKeeper:
    """Keeps the rows of a stream in files of a folder, which a restart and a later run read.

    Rows without a header get that of an earlier stream.
    """

    def __init__(self, stream: IO[bytes], folder: Path):
        self.folder, self.ended = folder, False
        self.error: Exception | None = None  # that ended the copying
        folder.mkdir(exist_ok=True)
        self._files = sorted(folder.glob(_ROW_FILE.format("*")))
        numbers = re.findall(r"\d+", " ".join(path.stem for path in self._files))
        self._last_number = max(map(int, numbers), default=0)
        threading.Thread(target=self._copy_stream, args=(stream,), daemon=True).start()

    def _copy_stream(self, stream: Any) -> None:
        read = getattr(stream, "read1", stream.read)
        try:
            piece = read(_READ_BYTES)
            while piece:
                piece = self._write_file(piece, read)
        except Exception as error:  # shown by the main thread
            self.error = error
        finally:
            self.ended = True

    def _write_file(self, piece: bytes, read: Callable[[int], bytes]) -> bytes:
        """Write rows to a new file as they come, until it is full; return what follows."""
        has_header = not (_DATA_ROW.match(piece) and self._files)
        header = b"" if has_header else _read_header(self._files[0])
        self._last_number += 1
        path = self.folder / _ROW_FILE.format(f"{self._last_number:06d}")
        size = 0
        with path.open("xb") as file:
            self._files.append(path)
            file.write(header)
            while piece:
                end = piece.rfind(b"\n") + 1
                if size + len(piece) > _MAX_ROW_FILE_BYTES and end:
                    file.write(piece[:end])
                    return piece[end:] or read(_READ_BYTES)
                size += file.write(piece)
                file.flush()
                piece = read(_READ_BYTES)
        return b""


def _read_header(path: Path) -> bytes:
    """Read the lines before the first data row of a file of rows."""
    with path.open("rb") as file:
        return b"".join(itertools.takewhile(lambda line: not _DATA_ROW.match(line), file))


def hash_samples(log: xr.Dataset, span: tuple[int, int], common: str) -> bytes:
    """Hash what determines the samples of a span: where rows of text lie, or else the values.

    Rows that were read are taken not to change; which row a sample comes from may change when late
    rows come.
    """
    total = hashlib.sha256(repr((common, span)).encode())
    start, rate = first_stamp(log), float(log.attrs["sampling_rate_hz"])
    for name in [signal_name(log), *log_channels(log)]:
        variable, (begin, end) = log.variables[name], span
        if variable.dims[-1] != "time":
            stamps = to_nanoseconds(log.variables[f"time_{name}"].values)
            begin, end = np.searchsorted(stamps, grid_times(start, rate, np.array(span))).tolist()
            total.update(stamps[begin:end].tobytes())
        source = find_source(variable.data)
        if isinstance(source, GridSource):
            for _, _, runs in (part for row in source.rows for part in row):
                total.update(np.array(clip_runs(runs, begin, end), dtype=np.int64).tobytes())
        else:
            total.update(read_slice(variable.data, begin, end).tobytes())
    return total.digest()

"""Logs in an archive: a table of its files, and the runs that they make."""

from __future__ import annotations

import glob
import itertools
import json
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from gyrostab.diagnose.result.content import SCHEMA, check_diagnosis
from gyrostab.errors import DamageError, FormatError, GyrostabError, OptionError, SchemaError
from gyrostab.ingest.files import scan_file
from gyrostab.ingest.formats.binary import list_layouts
from gyrostab.ingest.options import ReadOptions
from gyrostab.jobs.schedule import Pool, run_calls
from gyrostab.progress import Stage
from gyrostab.schema import escape_text
from gyrostab.store.output import describe_file, read_json
from gyrostab.store.output.content import METADATA, is_store
from gyrostab.store.remote import (
    find_remote_kind,
    find_url,
    full_name,
    list_urls,
    read_bytes,
    remove_copies,
    walk_address,
)

#: File that marks a folder of `gyrostab.jobs.fleet`.
FLEET_MARK = "fleet.json"
FLEET_SCHEMA = "gyrostab.fleet/1"
#: Names inside such a folder that are not runs.
RESERVED_NAMES = (
    FLEET_MARK, "effects.parquet", "files.parquet", "index.html", "index.parquet", "reports",
    "trends.parquet",
)  # fmt: skip
#: Names of devices, which files and folders of Windows cannot have, also before a suffix.
_DEVICE_NAME = re.compile(r"(?i)^(con|prn|aux|nul|(?:com|lpt)[1-9])(?=\.|$)")
#: Format of a folder that ``gyrostab diagnose`` wrote, in the table of files.
DIAGNOSIS = "diagnosis"
#: Bytes at the beginning of a diagnosis that contain the name of its schema, its first entry.
_SCHEMA_BYTES = 256


@dataclass(frozen=True)
class Archive:
    """Files of an archive."""

    base: Path  # folder that the names of runs are relative to
    files: list[Path]  # files and Zarr stores that may be logs, sorted
    diagnoses: list[Path]  # folders that ``gyrostab diagnose`` wrote


@dataclass(frozen=True)
class LogRun:
    """Logs that are analysed as one record."""

    name: str  # path of the run in the archive, with slashes
    tool: str  # tool that recorded it
    files: tuple[Path, ...]  # absolute, or at addresses
    bytes: int  # of all files
    diagnosis: Path | None  # folder
    verdict: str  # empty without a diagnosis, ``not readable`` of a damaged one


def find_archive(paths: Sequence[str | Path]) -> Archive:
    """List the files of an archive, in one pass over its folders.

    Parameters
    ----------
    paths : sequence of path
        Folders, which are searched with all folders below, files, Zarr stores and patterns, or
        addresses of them. Hidden items and fleets that gyrostab wrote are left out.

    Raises
    ------
    FormatError
        When a path does not exist, or nothing is found.
    """
    files: dict[Path, None] = {}
    diagnoses: dict[Path, None] = {}
    visited: set[str] = set()
    bases = []
    is_remote = any(map(find_url, paths))
    if is_remote and not all(map(find_url, paths)):
        raise OptionError("an archive is either at addresses or in folders; give one of them")
    for item in map(str, paths):
        url = find_url(item)
        is_pattern = glob.has_magic(item) and not os.path.lexists(item)
        if not is_pattern:
            matching = [item]
        else:
            matching = list_urls(url) if url else sorted(glob.iglob(item, recursive=True))
        for path in map(Path, matching):
            inside: Iterable[tuple[str, Path]] = ()
            if url:
                is_file = find_remote_kind(find_url(path) or url) == "file"
                inside = [("file", path)] if is_file else _walk_folder(path, visited)
            elif not path.exists():
                raise FormatError(f"{path}: there is no such file or folder")
            elif path.is_dir() and not (is_store(path) or is_fleet(path)):
                inside = _walk_folder(path, visited)
            elif not (is_pattern and _is_inside_output(path)):
                inside = [("file", path)]
            for kind, item_inside in inside:
                (diagnoses if kind == DIAGNOSIS else files)[item_inside] = None
        bases.append(_find_base(item, is_pattern=is_pattern, is_only_path=len(paths) == 1))
    if not files:
        raise FormatError(f"{', '.join(map(str, paths))}: there are no files")
    base = os.path.commonpath([base if is_remote else os.path.abspath(base) for base in bases])
    return Archive(Path(base), sorted(files), sorted(diagnoses))


def _find_base(item: str, *, is_pattern: bool, is_only_path: bool) -> Path:
    """Find the folder that names are relative to: the fixed part of a pattern, or a lone folder."""
    path = Path(item)
    if is_pattern:
        fixed = itertools.takewhile(lambda part: not glob.has_magic(part), path.parts)
        return Path(*fixed)
    url = find_url(item)
    is_archive = find_remote_kind(url) == "folder" if url else path.is_dir() and not is_store(path)
    return path if is_only_path and is_archive else path.parent


def _walk_folder(folder: Path, visited: set[str]) -> Iterator[tuple[str, Path]]:
    """Yield the files, stores and diagnoses in a folder or at an address, each folder once."""
    url = find_url(folder)
    for place, folders, names in walk_address(url) if url else os.walk(folder):
        current = Path(place)
        kind = "visited" if place in visited else _find_kind(current, set(names))
        visited.add(place)
        if kind in ("file", DIAGNOSIS):
            yield kind, current
        elif not kind:
            yield from (("file", Path(current, name)) for name in names if not name.startswith("."))
        for name in list(folders):
            path = Path(current, name)
            if kind or name.startswith("."):
                folders.remove(name)
            elif path.is_symlink() and _find_kind(path, set(os.listdir(path))) == "file":
                yield "file", path  # os.walk does not follow links


def _find_kind(folder: Path, names: set[str]) -> str:
    """Find what a folder with files of these names is as a whole; empty for an ordinary one."""
    if FLEET_MARK in names and is_fleet(folder):
        return FLEET_MARK
    if "diagnosis.json" in names and _is_diagnosis(folder):
        return DIAGNOSIS
    return "file" if names & METADATA and (find_url(folder) or is_store(folder)) else ""


def _is_diagnosis(folder: Path) -> bool:
    """Whether gyrostab wrote the diagnosis in a folder, even if a later part is damaged."""
    try:
        return SCHEMA.encode() in read_bytes(folder / "diagnosis.json", _SCHEMA_BYTES)
    except OSError:
        return False


def is_fleet(path: Path) -> bool:
    """Whether `gyrostab.jobs.fleet` wrote a folder."""
    content = read_json(path / FLEET_MARK)
    return isinstance(content, dict) and content.get("schema") == FLEET_SCHEMA


def _is_inside_output(path: Path) -> bool:
    """Whether a path is part of a Zarr store or of a fleet."""
    return is_fleet(path) or any(is_store(f) or is_fleet(f) for f in path.parents)


def index_files(
    archive: Archive,
    *,
    reading: Mapping[str, Any],
    known: pd.DataFrame | None,
    pool: Pool,
    stage: Stage,
) -> pd.DataFrame:
    """Tabulate the files of an archive; those unchanged since the table `known` are not opened.

    Returns
    -------
    pandas.DataFrame
        One row a file: file, base (of the archive), bytes, changed_ns, listing (digest of the files
        of a Zarr store), options (of reading, as JSON), is_log, format, start, end (UTC), rate
        [Hz], axes, channels, rows, note. A file in which no gyro is found is not a log; a damaged
        one counts as a log, whose time is a gap of its run.
    """
    options = json.dumps(dict(reading), sort_keys=True, default=str)
    records: Any = [] if known is None else known.to_dict("records")
    old_rows = {
        row["file"]: {key: None if value is pd.NA else value for key, value in row.items()}
        for row in records
    }
    rows: dict[str, dict[str, Any]] = {}
    changed: list[str] = []
    for path in [*archive.files, *archive.diagnoses]:
        state = describe_file(path)
        layouts = [describe_file(layout)["changed_ns"] for layout in list_layouts([path])]
        name = full_name(path)
        row = {
            "file": escape_text(name),
            "base": escape_text(str(archive.base)),
            "bytes": state["bytes"],
            "changed_ns": max([state["changed_ns"], *layouts]),
            "listing": state.get("listing", ""),
            "options": options,
        }
        old = old_rows.get(row["file"], {})
        is_same = all(old.get(key) == value for key, value in row.items())
        rows[row["file"]] = old if is_same else row
        if row["file"] != name:
            rows[row["file"]] |= {
                "is_log": False,
                "format": None,
                "note": "its name is not UTF-8, as a table needs; rename the file or its folder",
            }
        elif not is_same:
            changed.append(name)
    diagnosed = {full_name(path) for path in archive.diagnoses}.intersection(rows)
    for name in diagnosed:
        rows[name] |= {"is_log": False, "format": DIAGNOSIS, "note": ""}
    names = [name for name in changed if name not in diagnosed]
    calls = ((_describe_log, name, dict(reading)) for name in names)
    for done, (call, described) in enumerate(run_calls(pool, calls), 1):
        rows[call[1]].update(described)
        stage("indexing", len(names), done, "files")
    whole_numbers = {  # also where a file has none, as a link to nothing; floats would round them
        key: pd.array([row[key] for row in rows.values()], dtype="Int64")
        for key in ("bytes", "changed_ns")
    }
    return pd.DataFrame(list(rows.values())).assign(**whole_numbers)


def _describe_log(name: str, reading: Mapping[str, Any]) -> dict[str, Any]:
    """Describe a file by its columns and its first and last stamps, without reading its data."""
    read_options = {
        key: value for key, value in reading.items() if key in ReadOptions.__annotations__
    }
    row: dict[str, Any] = dict.fromkeys(
        ("format", "start", "end", "rate [Hz]", "axes", "channels", "rows")
    )
    try:
        with remove_copies():
            summary = scan_file(name, ReadOptions(**read_options))
    except FormatError as error:
        return {**row, "is_log": isinstance(error, DamageError), "note": str(error)}
    except (GyrostabError, OSError) as error:
        return {**row, "is_log": True, "note": str(error)}
    rate = None
    if summary.first is not None and summary.last is not None and (summary.n_rows or 0) > 1:
        seconds = (summary.last - summary.first).astype("timedelta64[ns]").astype(int) / 1e9
        rate = ((summary.n_rows or 0) - 1) / seconds if seconds > 0 else None
    return {
        "is_log": bool(summary.axes),
        "format": summary.format,
        "start": summary.first,
        "end": summary.last,
        "rate [Hz]": rate,
        "axes": " ".join(summary.axes),
        "channels": " ".join(summary.channels),
        "rows": summary.n_rows,
        "note": "; ".join(summary.notes if summary.axes else summary.notes[-1:]),
    }


def find_runs(
    archive: Archive, table: pd.DataFrame, *, per: str = "folder", tool: str | None = None
) -> list[LogRun]:
    """Group the logs of an archive, in a table of `index_files`, into runs, sorted by name.

    The options are the same as in `gyrostab.jobs.fleet.run_fleet`.

    Raises
    ------
    FormatError
        When no file is a log, with the reason of the first.
    OptionError
        When `tool` is not a regular expression.
    """
    try:
        pattern = re.compile(tool) if tool else None
    except re.error as error:
        raise OptionError(f"--tool {tool!r}: is not a regular expression ({error})") from error
    logs = table[table["is_log"].astype(bool)]
    if not len(logs):
        raise FormatError(f"no file is a log: {table['note'].iloc[0]}")
    sizes = {Path(name): int(size) for name, size in zip(logs["file"], logs["bytes"], strict=True)}
    groups: dict[Path, list[Path]] = defaultdict(list)
    for path in sizes:
        groups[path.parent if per == "folder" else path].append(path)
    diagnoses = _read_diagnosed_files(archive.diagnoses)
    runs = []
    for name, files in _name_groups(groups, archive.base, per).items():
        match = pattern.search(name) if pattern else None
        above = name.rpartition("/")[0]
        runs.append(
            LogRun(
                name,
                (match[0] if match else "") if pattern else above,
                tuple(files),
                sum(sizes[path] for path in files),
                *_find_diagnosis(files, diagnoses),
            )
        )
    return sorted(runs, key=lambda run: run.name)


def _name_groups(groups: Mapping[Path, list[Path]], base: Path, per: str) -> dict[str, list[Path]]:
    """Name runs by their place below `base`; no run is inside another one.

    Windows and macOS can hold them: names differ by more than case, and are not names of devices.
    """
    bare = {path: path.with_name(path.name.split(".")[0] or path.name) for path in groups}
    is_shared = len({str(path).casefold() for path in bare.values()}) < len(bare)
    names: dict[Path, str] = {}
    for path in groups:
        shown = bare[path] if per == "file" and not is_shared else path
        parts = list(Path(os.path.relpath(shown, base)).parts) or [base.name or "run"]
        if parts[0] == "..":
            raise FormatError(
                f"{path}: is not inside {base}, the folder of the table of files; "
                "make the table again with gyrostab index"
            )
        names[path] = "/".join(_DEVICE_NAME.sub(r"\1_", part.replace("\\", "_")) for part in parts)
    above = {
        "/".join(name.split("/")[:depth])
        for name in names.values()
        for depth in range(1, name.count("/") + 1)
    }
    folders = {name.casefold() for name in (*above, *RESERVED_NAMES)}
    used_names, named = set(folders), {}
    for path, name in sorted(names.items(), key=lambda item: item[1].casefold() in folders):
        if name.casefold() in folders:  # around other runs
            name = f"{name}/files"
        while name.casefold() in used_names:
            name += "_"
        used_names.add(name.casefold())
        named[name] = groups[path]
    return named


def read_diagnosis(folder: Path) -> Mapping[str, Any] | None:
    """Read the diagnosis in a folder; None when it cannot be read or is damaged."""
    content = read_json(folder / "diagnosis.json")
    try:
        check_diagnosis(content)
    except SchemaError:
        return None
    return dict(content)


def _read_diagnosed_files(folders: Sequence[Path]) -> list[tuple[Path, set[str] | None, str]]:
    """Read files and verdict of each diagnosis; no files, at the end, for those damaged."""
    diagnoses: list[tuple[Path, set[str] | None, str]] = []
    for folder in folders:
        content = read_diagnosis(folder)
        if content is None:
            diagnoses.append((folder, None, "not readable"))
        else:
            names = {Path(name).name for name in content["recording"]["files"]}
            diagnoses.append((folder, names, str(content["verdict"])))
    return sorted(diagnoses, key=lambda item: item[1] is None)


def _find_diagnosis(
    files: Sequence[Path], diagnoses: Sequence[tuple[Path, set[str] | None, str]]
) -> tuple[Path | None, str]:
    """Find the diagnosis of these files in their folder or below; a damaged one may be of any."""
    names, folder = {path.name for path in files}, files[0].parent
    for place, diagnosed, verdict in diagnoses:
        is_of_files = diagnosed is None or diagnosed & names
        if is_of_files and folder in Path(full_name(place)).parents:
            return place, verdict
    return None, ""

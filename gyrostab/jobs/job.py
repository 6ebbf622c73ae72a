"""The job folder of a run: its inputs and options, finished parts, and a lock.

``.PRODUCT.nc.job/``, next to the output, holds ``job.json`` (inputs, options, versions), a file for
each finished block (`gyrostab.jobs.checkpoint`) and ``lock``. ``job.json`` is written before the
first block and removed first, so that blocks without it are leftovers.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import re
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from gyrostab.errors import OutputError, ResumeError
from gyrostab.store.attributes import find_version
from gyrostab.store.output import (
    describe_file,
    hide_name,
    is_leftover,
    remove_leftovers,
    resolve_link,
    write_text,
)
from gyrostab.store.output.content import read_json
from gyrostab.store.remote import find_url, full_name
from gyrostab.store.system import lock_file

_SCHEMA = "gyrostab.job/1"
_REMOVES_OPEN_FILES = os.name != "nt"
#: Names of the files of a run; ``log.sha256`` is of an earlier version.
_JOB_FILE = re.compile(r"lock|job\.json|log\.zarr|log\.sha256|windows-\d{10}\.block")
_MAX_DIFFERENCES = 4  # differences that a message lists


def job_folder(output: Path) -> Path:
    """Return the job folder of an output; that of an output at an address is in this directory.

    Examples
    --------
    >>> job_folder(Path("s3://bucket/run7.zarr")) == job_folder(Path("s3://other/run7.zarr"))
    False
    """
    if url := find_url(output):
        mark = hashlib.sha256(url.encode()).hexdigest()[:8]
        return Path(hide_name(f"{output.name}-{mark}", ".job"))
    return output.with_name(hide_name(output.name, ".job"))


def check_job_folder(folder: Path) -> None:
    """Raise `OutputError` when the name of the job folder is taken by something that no run made.

    A run would write into it and remove it. Files of a run have fixed names, and ``lock`` or
    ``job.json`` identifies them.
    """
    if not os.path.lexists(folder):
        return
    names = _list_names(folder) if folder.is_dir() and not folder.is_symlink() else [""]
    foreign = [name for name in names if not (_JOB_FILE.fullmatch(name) or is_leftover(name))]
    if not foreign and names and not any(_is_marked(folder / name) for name in names):
        foreign = names
    if foreign:
        raise OutputError(
            f"{folder / min(foreign)}: the run keeps its finished parts under this name, "
            "and gyrostab did not make what is there; "
            "move it, or give the output another name with -o"
        )


def _is_marked(path: Path) -> bool:
    """Whether a file of a job folder shows that a run made the folder."""
    if path.name == "lock":
        return is_lock(path)
    if path.name == "job.json":
        content = read_json(path)
        return isinstance(content, dict) and str(content.get("schema")).startswith("gyrostab.job/")
    return False


def is_lock(path: Path) -> bool:
    """Whether `lock_job` made a file."""
    if not path.is_file() or path.is_symlink():
        return False
    with path.open("rb") as file:
        return b"process ".startswith(file.read(8))


def describe_inputs(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Describe each input by path, size [bytes] and time of change; a Zarr folder as a whole."""
    return [{"path": full_name(path), **describe_file(path)} for path in paths]


def make_fingerprint(paths: Sequence[Path], options: Mapping[str, Any]) -> dict[str, Any]:
    """Collect all that a product depends on: inputs in order, options, versions and machine.

    `gyrostab.jobs.load.check_run_options` describes the options; fitting is None without a fit.
    """
    plain = {**options["reading"], **options["windows"]}
    plain |= {f"fit {name}": value for name, value in (options["fitting"] or {}).items()}
    plain["fit"] = "left out" if options["fitting"] is None else None
    versions = {name: find_version(name) for name in ("gyrostab", "numpy", "numba")}
    return {
        "inputs": describe_inputs(paths),
        "options": json.loads(
            json.dumps(
                {name: value for name, value in plain.items() if value is not None}, default=str
            )
        ),
        "versions": {
            **versions,
            "byte order": sys.byteorder,
            "float": np.dtype(float).str,
            "processor": platform.machine(),
        },
    }


def hash_fingerprint(fingerprint: Mapping[str, Any]) -> str:
    """Hash a fingerprint; name, size and time of the inputs matter, but not their folder."""
    inputs = [{**item, "path": os.path.basename(item["path"])} for item in fingerprint["inputs"]]
    return "sha256:" + _hash_json({**fingerprint, "inputs": inputs})


def describe_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Describe the differences between two fingerprints in one line; empty if there are none.

    Examples
    --------
    >>> before = [{"path": "/run7/b.csv", "bytes": 120, "changed_ns": 0}]
    >>> now = [{"path": "/run7/b.csv", "bytes": 100, "changed_ns": 5}]
    >>> describe_differences(
    ...     {"inputs": before, "options": {"window": "10min"}, "versions": {}},
    ...     {"inputs": now, "options": {"window": "5min"}, "versions": {}},
    ... )
    'run7/b.csv has changed: 100 bytes, was 120; window is 5min, was 10min'
    """
    differences = _describe_input_changes(before["inputs"], now["inputs"])
    for kind in ("options", "versions"):
        old, new = before[kind], now[kind]
        differences += [
            f"{name} is {format_option(new.get(name))}, was {format_option(old.get(name))}"
            for name in {**old, **new}
            if old.get(name) != new.get(name)
        ]
    return "; ".join(differences[:_MAX_DIFFERENCES]) + (
        f"; and {len(differences) - _MAX_DIFFERENCES} more"
        if len(differences) > _MAX_DIFFERENCES
        else ""
    )


def format_option(value: Any) -> str:
    """Format the value of an option in one line."""
    if value is None:
        return "not given"
    if isinstance(value, Mapping):
        return ", ".join(f"{key}={setting}" for key, setting in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _describe_input_changes(before: list[dict[str, Any]], now: list[dict[str, Any]]) -> list[str]:
    old, new = ({item["path"]: item for item in items} for items in (before, now))
    changes = [
        f"{_shorten_path(path)} is given now and was not before" for path in new if path not in old
    ]
    changes += [
        f"{_shorten_path(path)} was given before and is not now" for path in old if path not in new
    ]
    for path in [path for path in new if path in old and new[path] != old[path]]:
        size, was = new[path]["bytes"], old[path]["bytes"]
        if size is None:
            changes.append(f"{_shorten_path(path)} has vanished")
        elif size != was:
            changes.append(
                f"{_shorten_path(path)} has changed: {size} bytes, "
                f"was {'missing' if was is None else was}"
            )
        elif new[path]["changed_ns"] != old[path]["changed_ns"]:
            changes.append(
                f"{_shorten_path(path)} has changed: "
                f"written {_format_change_time(new[path])}, was {_format_change_time(old[path])}"
            )
        else:
            changes.append(f"{_shorten_path(path)} has changed: other files are in it")
    if not changes and list(old) != list(new):
        changes.append("the logs are given in another order")
    return changes


def _shorten_path(path: str) -> str:
    """Return the last folder and the name of a file."""
    return os.path.join(*Path(path).parts[-2:])


def _format_change_time(item: Mapping[str, Any]) -> str:
    return f"{datetime.fromtimestamp(item['changed_ns'] / 1e9, UTC):%Y-%m-%dT%H:%M:%S.%f}Z"


@contextlib.contextmanager
def lock_job(folder: Path) -> Iterator[None]:
    """Lock a job folder for this process; make it if it does not exist.

    The lock ends with the process, even if it is killed.

    Raises
    ------
    ResumeError
        When another process holds the lock.
    """
    handle = _open_lock(folder)
    try:
        os.ftruncate(handle, 0)
        owner = f"process {os.getpid()} on {platform.node()}\n"
        os.lseek(handle, 0, os.SEEK_SET)
        os.write(handle, owner.encode("ascii", "replace"))
        yield
    finally:
        os.close(handle)
        if not _REMOVES_OPEN_FILES:
            _remove_lock(folder)


def _open_lock(folder: Path) -> int:
    """Open and lock the lock file of a job folder."""
    while True:
        folder.mkdir(exist_ok=True)
        # the process that held the lock may remove it at any moment
        with contextlib.suppress(FileNotFoundError):
            handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o666)
            try:
                if not lock_file(handle):
                    owner = (folder / "lock").read_text("ascii", "replace").strip()
                    raise ResumeError(
                        f"{folder.name}: {owner or 'another process'} is making this product now; "
                        "wait for it, or stop it first"
                    )
                if not os.path.samestat(os.fstat(handle), os.stat(folder / "lock")):
                    raise FileNotFoundError
            except BaseException:
                os.close(handle)
                raise
            return handle


def _remove_lock(folder: Path) -> None:
    """Remove a lock that `remove_job` could not: Windows does not remove a file that is open."""
    if _list_names(folder) == ["lock"]:
        with contextlib.suppress(OSError):  # another process has opened it
            (folder / "lock").unlink()
            folder.rmdir()


def read_job(folder: Path) -> dict[str, Any] | None:
    """Read inputs and options of an unfinished run; None without one, or if the file is damaged."""
    job = read_json(folder / "job.json")
    if not isinstance(job, dict) or job.get("schema") != _SCHEMA:
        return None
    return job if job.pop("sha256", None) == _hash_json(job) else None


def _hash_json(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def begin_job(folder: Path, fingerprint: Mapping[str, Any], *, parts: int, overwrite: bool) -> None:
    """Write inputs and options of a run, before its first block."""
    job = {"schema": _SCHEMA, "overwrite": overwrite, "parts": parts, **fingerprint}
    write_text(folder / "job.json", json.dumps({**job, "sha256": _hash_json(job)}, indent=1))


def remove_remains(folder: Path) -> None:
    """Remove incomplete files of a killed run, and its stored log, which is written again."""
    for name in _list_names(folder):
        if is_leftover(name) or name == "log.zarr":
            _remove_path(folder / name)


def _remove_path(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def count_finished_parts(folder: Path) -> int:
    """Count the finished parts in a job folder."""
    return sum(name.endswith(".block") for name in _list_names(folder))


def has_finished_work(folder: Path) -> bool:
    """Whether a job folder holds finished parts of a run."""
    return (folder / "job.json").exists() and count_finished_parts(folder) > 0


def _list_names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except FileNotFoundError:
        return []


def check_unfinished_run(folder: Path, *, output: Path) -> None:
    """Raise `ResumeError` when another command would remove the finished parts of a run."""
    if (job := read_job(folder)) and has_finished_work(folder):
        raise ResumeError(
            f"{output}: a run of it was begun and not finished; "
            f"{count_finished_parts(folder)} of {job['parts']} parts are kept, and gyrostab run "
            "with --resume continues it; give another name with -o, or --overwrite to discard them"
        )


@contextlib.contextmanager
def lock_output(output: Path, *, overwrite: bool) -> Iterator[None]:
    """Lock the job folder of an output that is made without block files, and remove it at the end.

    Raises
    ------
    OutputError
        As for `check_job_folder`.
    ResumeError
        When there is an unfinished run of the output without `overwrite`, or another process works
        on it.
    """
    target = resolve_link(output)
    folder = job_folder(target)
    check_job_folder(folder)
    with lock_job(folder):
        if not overwrite:
            check_unfinished_run(folder, output=output)
        try:
            yield
        finally:
            remove_job(folder, output=target)


def clear_job(folder: Path) -> None:
    """Remove everything from a job folder but the lock."""
    (folder / "job.json").unlink(missing_ok=True)
    for name in _list_names(folder):
        if name != "lock":
            _remove_path(folder / name)


def remove_job(folder: Path, *, output: Path) -> None:
    """Remove a job folder, and incomplete outputs of killed runs."""
    clear_job(folder)
    remove_leftovers(output)
    with contextlib.suppress(OSError):  # Windows does not remove a file that is open
        (folder / "lock").unlink(missing_ok=True)
        folder.rmdir()

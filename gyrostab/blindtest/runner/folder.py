"""Folder of a benchmark: its options, the code versions used, and the finished parts.

``benchmark.json`` is written first, then ``recordings/`` and ``truth/``. ``SHA256SUMS`` commits the
truths before the first file of ``diagnoses/``; ``comparisons/`` follow last.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gyrostab.blindtest.generator.scenario import STREAM_LABELS
from gyrostab.errors import FormatError, OptionError, OutputError, ResumeError
from gyrostab.jobs import is_lock
from gyrostab.store.output import check_target, is_leftover, read_json, write_text

#: Seeds below this one are for tuning; published runs use others.
FIRST_PUBLIC_SEED = 1_000_000

_SCHEMA = "gyrostab.prove/3"
_SUMS = "SHA256SUMS"
_FOLDERS = ("recordings", "truth", "diagnoses", "comparisons", "failed")
_FILE = re.compile(
    r"benchmark\.json|SHA256SUMS|scores\.csv|table\.md"
    r"|(completeness|reliability|calibration|ranks|roc)\.png"
    rf"|({'|'.join(_FOLDERS)})/[0-9a-f]{{12}}\.(nc|json|txt)"
)


def write_json(path: Path, content: Any) -> Path:
    """Write a JSON file that gets its name once it is complete."""
    return write_text(path, json.dumps(content, indent=1) + "\n")


def case_name(seed: int, index: int, copy: str = "") -> str:
    """Name the files of a case, or of a copy of a real recording, without revealing the content.

    Examples
    --------
    >>> len(case_name(1, 0)), case_name(1, 0) == case_name(1, 1)
    (12, False)
    """
    label = STREAM_LABELS.get(copy, copy)
    return hashlib.sha256(f"name of case {index} of seed {seed}{label}".encode()).hexdigest()[:12]


def fingerprint_code() -> str:
    """Compute a short fingerprint of the source of the package."""
    import gyrostab

    root = Path(gyrostab.__file__).parent
    listing = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        listing.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return listing.hexdigest()[:12]


def read_request(directory: Path) -> dict[str, Any] | None:
    """Read the options of the benchmark in a folder; None when there is no benchmark."""
    try:
        content = json.loads((directory / "benchmark.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise FormatError(
            f"{directory / 'benchmark.json'}: cannot be read ({error}); "
            "begin again with --overwrite"
        ) from error
    if not isinstance(content, dict) or content.get("schema") != _SCHEMA:
        raise FormatError(
            f"{directory / 'benchmark.json'}: is not a benchmark of this version; "
            "begin again in another folder with -o"
        )
    content.setdefault("counterparts", 0)  # runs of earlier versions had none
    return content


def inspect_folder(
    directory: Path,
    requested: Mapping[str, int | None],
    usual: Mapping[str, int],
    *,
    resume: bool,
    overwrite: bool,
) -> dict[str, Any]:
    """Find the run to continue in a folder, or plan a new one. Changes nothing.

    Options that are not `requested` (None) are the `usual` ones. Return the content of
    ``benchmark.json``; that of a new run has no versions of the code yet. See
    `gyrostab.prove` for the errors.
    """
    previous = read_request(directory) if directory.is_dir() and (resume or not overwrite) else None
    check_target(
        directory,
        overwrite=True,
        find_foreign=find_foreign_file if previous is None else lambda _: None,
    )
    given = {name: value for name, value in requested.items() if value is not None}
    if previous is None:
        chosen = {**usual, **given}
        _check_request(chosen)
        _check_is_empty(directory, overwrite=overwrite)
        return {
            "schema": _SCHEMA,
            **chosen,
            "code": [],
            "begun": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
            "machine": f"{platform.machine()}, Python {platform.python_version()}",
        }
    if not resume:
        raise OutputError(
            f"{directory} holds a benchmark already: --resume continues it, "
            "--overwrite replaces it; or give another -o"
        )
    differences = [
        f"{name} {previous[name]}, not {value}"
        for name, value in given.items()
        if value != previous[name]
    ]
    if differences:
        raise ResumeError(
            f"{directory}: was begun with {', '.join(differences)}; leave that out, "
            "or begin again with --overwrite"
        )
    return previous


def begin_run(directory: Path, job: dict[str, Any]) -> None:
    """Create the folder of a run, or continue it; add the version of the code to its options."""
    if job["code"]:
        # files of a run that was killed
        for leftover in (*directory.glob(".*.part"), *directory.glob("*/.*.part")):
            if is_leftover(leftover.name):
                _remove_path(leftover)
    else:
        directory.mkdir(exist_ok=True)
        # benchmark.json last, as it shows that the rest may be replaced if this is interrupted
        for item in sorted(directory.iterdir(), key=lambda item: item.name == "benchmark.json"):
            if item.name != "lock":
                _remove_path(item)
        for name in _FOLDERS:
            (directory / name).mkdir()
    state = fingerprint_code()
    if job["code"][-1:] != [state]:
        job["code"].append(state)
        write_json(directory / "benchmark.json", job)


def _remove_path(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _check_request(chosen: Mapping[str, int]) -> None:
    if chosen["cases"] < 1:
        raise OptionError(
            f"cases={chosen['cases']}: give at least one case; 20 include every kind, "
            "400 give the published figures"
        )
    if chosen["seed"] < 0:
        raise OptionError(f"seed={chosen['seed']}: give a whole number from 0 up")
    if chosen["counterparts"] < 0:
        raise OptionError(
            f"counterparts={chosen['counterparts']}: give 4 for one in four cases, or 0 for none"
        )
    if chosen["nulls"] < 100:
        raise OptionError(
            f"nulls={chosen['nulls']}: a diagnosis needs at least 100 null records; "
            "give 400, or 200 for a quick look"
        )


def _check_is_empty(directory: Path, *, overwrite: bool) -> None:
    names = (
        [item.name for item in directory.iterdir() if item.name != "lock"]
        if directory.is_dir()
        else []
    )
    if names and not overwrite:
        raise OutputError(
            f"output {str(directory)!r} is not empty; give --overwrite to replace its content, "
            "or another name with -o"
        )


def find_foreign_file(directory: Path) -> str | None:
    """Find an item in a folder that is not part of a benchmark; None without such an item.

    A damaged ``benchmark.json`` is that of a benchmark.
    """
    marker = directory / "benchmark.json"
    content = read_json(marker)
    ours = marker.is_file() and (
        content is None
        or (isinstance(content, dict) and str(content.get("schema")).startswith("gyrostab.prove/"))
    )
    for path in sorted(directory.rglob("*")):
        place = path.relative_to(directory)
        if ours and any(is_leftover(part) for part in place.parts):
            continue
        name = place.as_posix()
        if path.is_dir():
            is_known = name in _FOLDERS
        elif name == "lock":
            is_known = path.is_file() and is_lock(path)
        else:
            is_known = path.is_file() and ours and _FILE.fullmatch(name) is not None
        if path.is_symlink() or not is_known:
            return str(place)
    return None


def write_sums(directory: Path, sums: Mapping[str, str]) -> str:
    """Commit all truths: write ``SHA256SUMS`` for ``sha256sum -c``; return the SHA-256 of it."""
    text = "".join(f"{value}  truth/{name}.json\n" for name, value in sorted(sums.items()))
    write_text(directory / _SUMS, text)
    return hashlib.sha256(text.encode()).hexdigest()


def read_sums(directory: Path) -> tuple[dict[str, str], str] | None:
    """Read the SHA-256 of each truth by name, and that of the list; None when not committed yet."""
    try:
        text = (directory / _SUMS).read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    lines = [line.split("  truth/") for line in text.splitlines()]
    return {name.removesuffix(".json"): value for value, name in lines}, hashlib.sha256(
        text.encode()
    ).hexdigest()

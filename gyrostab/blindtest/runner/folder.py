"""The folder of a benchmark: what it was asked for, which code has worked on it, and what is finished.

``benchmark.json`` comes first; then ``recordings/`` and ``truth/`` grow together, ``SHA256SUMS``
seals the truths before the first file of ``diagnoses/``, and ``comparisons/`` follow once the seal
is open.
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

from gyrostab.errors import FormatError, OptionError, OutputError, ResumeError
from gyrostab.jobs.job import is_lock
from gyrostab.store.output import is_leftover, replace_file
from gyrostab.store.output.check import check_target
from gyrostab.store.output.content import read_json

__all__ = [
    "TUNING",
    "asked",
    "begin",
    "case_name",
    "code_state",
    "look",
    "read_sums",
    "write_json",
    "write_sums",
    "write_text",
]

#: Seeds below this one are for tuning; what is published uses others.
TUNING = 1_000_000

_SCHEMA = "gyrostab.prove/2"
_SUMS = "SHA256SUMS"
_FOLDERS = ("recordings", "truth", "diagnoses", "comparisons", "failed")
_CASE_FILE = re.compile(r"[0-9a-f]{12}\.(nc|json|txt)")
_FILES = (
    "benchmark.json",
    _SUMS,
    "scores.csv",
    "table.md",
    "completeness.png",
    "reliability.png",
    "lock",
)


def write_text(path: Path, text: str) -> Path:
    """Write a file that has its name only once it is complete."""
    with replace_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def write_json(path: Path, content: Any) -> Path:
    """As `write_text`, of JSON."""
    return write_text(path, json.dumps(content, indent=1) + "\n")


def case_name(seed: int, index: int, copy: str = "") -> str:
    """Name of the files of a case, or of a copy of a real recording; who does not know the seed learns nothing from it.

    Examples
    --------
    >>> case_name(1, 0) == case_name(1, 0), case_name(1, 0) == case_name(1, 1), len(case_name(1, 0))
    (True, False, 12)
    """
    return hashlib.sha256(f"name of case {index} of seed {seed}{copy}".encode()).hexdigest()[:12]


def code_state() -> str:
    """Short fingerprint of the source of the package."""
    import gyrostab

    root = Path(gyrostab.__file__).parent
    listing = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        listing.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return listing.hexdigest()[:12]


def asked(directory: Path) -> dict[str, Any] | None:
    """What a benchmark that was begun in this folder was asked for; None when none was."""
    try:
        content = json.loads((directory / "benchmark.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise FormatError(
            f"{directory / 'benchmark.json'}: cannot be read ({error}); begin again with --overwrite"
        ) from error
    if not isinstance(content, dict) or content.get("schema") != _SCHEMA:
        raise FormatError(
            f"{directory / 'benchmark.json'}: is no benchmark of this version; begin again in another folder with -o"
        )
    return content


def look(
    directory: Path,
    wanted: Mapping[str, int | None],
    usual: Mapping[str, int],
    *,
    resume: bool,
    overwrite: bool,
) -> tuple[dict[str, Any] | None, dict[str, int]]:
    """What was begun in a folder and is to go on, or None, and what is to be done; see `begin`. Changes nothing."""
    before = asked(directory) if directory.is_dir() and (resume or not overwrite) else None
    check_target(
        directory,
        overwrite=True,
        find_foreign=find_foreign_file if before is None else lambda _: None,
    )
    if before is None:
        chosen = dict(usual) | {name: value for name, value in wanted.items() if value is not None}
        _check_wishes(chosen)
        _check_content(directory, overwrite=overwrite)
        return None, chosen
    if not resume:
        raise OutputError(
            f"{directory} holds a benchmark already: --resume goes on with it, --overwrite replaces it; or give another -o"
        )
    other = [
        f"{name} {before[name]}, not {value}"
        for name, value in wanted.items()
        if value is not None and value != before[name]
    ]
    if other:
        raise ResumeError(
            f"{directory}: was begun with {', '.join(other)}; leave that out, or begin again with --overwrite"
        )
    return before, {name: before[name] for name in wanted}


def begin(
    directory: Path,
    wanted: Mapping[str, int | None],
    usual: Mapping[str, int],
    *,
    resume: bool,
    overwrite: bool,
) -> dict[str, Any]:
    """Make the folder, or take up what was begun in it.

    Parameters
    ----------
    directory : pathlib.Path
        The folder; its parent must exist.
    wanted : mapping
        ``cases``, ``seed`` and ``nulls``, None where it was not said.
    usual : mapping
        What stands where nothing was said; more than is in `wanted` is written down as it is.
    resume, overwrite : bool
        Go on where a run stopped; forget one.

    Returns
    -------
    dict
        Content of ``benchmark.json``.

    Raises
    ------
    OutputError
        When the folder cannot be made, or holds something.
    OptionError
        When a number makes no sense.
    ResumeError
        When what was begun was asked for something else.
    """
    before, chosen = look(directory, wanted, usual, resume=resume, overwrite=overwrite)
    state = code_state()
    if before is not None:
        for left in (
            *directory.glob(".*.part"),
            *directory.glob("*/.*.part"),
        ):  # of a run that was killed
            if is_leftover(left.name):
                _remove(left)
        if state != before["code"][-1]:
            before["code"].append(state)
            write_json(directory / "benchmark.json", before)
        return before
    directory.mkdir(exist_ok=True)
    for item in directory.iterdir():
        if item.name != "lock":
            _remove(item)
    for name in _FOLDERS:
        (directory / name).mkdir()
    content = {
        "schema": _SCHEMA,
        **chosen,
        "code": [state],
        "begun": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
        "machine": f"{platform.machine()}, Python {platform.python_version()}",
    }
    write_json(directory / "benchmark.json", content)
    return content


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _check_wishes(chosen: Mapping[str, int]) -> None:
    if chosen["cases"] < 1:
        raise OptionError(
            f"cases={chosen['cases']}: give at least one case; 20 hold every kind, 400 give the published figures"
        )
    if chosen["seed"] < 0:
        raise OptionError(f"seed={chosen['seed']}: give a whole number from 0 up")
    if chosen["nulls"] < 100:
        raise OptionError(
            f"nulls={chosen['nulls']}: a diagnosis needs 100 null records at least; give 400, or 200 for a quick look"
        )


def _check_content(directory: Path, *, overwrite: bool) -> None:
    found = (
        [item.name for item in directory.iterdir() if item.name != "lock"]
        if directory.is_dir()
        else []
    )
    if found and not overwrite:
        raise OutputError(
            f"output {str(directory)!r} is not empty; give --overwrite to replace what is in it, or another name with -o"
        )


def find_foreign_file(directory: Path) -> str | None:
    """Find an item in a folder that is not part of a benchmark; None for the folder of a benchmark, and for one without files."""
    content = read_json(directory / "benchmark.json")
    ours = isinstance(content, dict) and str(content.get("schema")).startswith("gyrostab.prove/")
    for path in sorted(directory.rglob("*")):
        place = path.relative_to(directory)
        if path.is_symlink() or not (path.is_file() or place.as_posix() in _FOLDERS):
            return str(place)
        known = is_lock(path) if str(place) == "lock" else ours and _is_of_benchmark(place)
        if path.is_file() and not known:
            return str(place)
    return None


def _is_of_benchmark(place: Path) -> bool:
    if is_leftover(place.name):
        return True
    return (
        place.name in _FILES
        if len(place.parts) == 1
        else _CASE_FILE.fullmatch(place.name) is not None
    )


def write_sums(directory: Path, sums: Mapping[str, str]) -> str:
    """Seal all truths: write ``SHA256SUMS`` as ``sha256sum -c`` reads it; its own SHA-256."""
    text = "".join(f"{value}  truth/{name}.json\n" for name, value in sorted(sums.items()))
    write_text(directory / _SUMS, text)
    return hashlib.sha256(text.encode()).hexdigest()


def read_sums(directory: Path) -> tuple[dict[str, str], str] | None:
    """Name of each case to the SHA-256 of its truth, and the SHA-256 of the list; None where nothing was sealed yet."""
    try:
        text = (directory / _SUMS).read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    lines = [line.split("  truth/") for line in text.splitlines()]
    return {name.removesuffix(".json"): value for value, name in lines}, hashlib.sha256(
        text.encode()
    ).hexdigest()

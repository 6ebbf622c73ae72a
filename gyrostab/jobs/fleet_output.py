"""The output of a fleet: its folder, or groups of a Zarr store, local or at an address."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pandas as pd

from gyrostab.errors import OptionError, OutputError
from gyrostab.jobs.archive import FLEET_MARK, FLEET_SCHEMA, Archive
from gyrostab.jobs.fleet_table import is_zarr
from gyrostab.jobs.job import describe_differences
from gyrostab.store.output import read_json, write_text
from gyrostab.store.remote import exists, find_remote_kind, find_url, full_name

REQUESTS = 16  # to an object store at a time
_GROUP = {"zarr_format": 2}  # metadata of a Zarr group
PLOTLY_FILE = "plotly.js"  # in the folder of the reports, which share it


def check_address(url: str, suffix: str, *, is_own: bool) -> None:
    """Check the address of an output: what another program wrote is never replaced."""
    if not url.lower().endswith(suffix):
        raise OptionError(f"output {url!r} must end in {suffix}; give another name with -o")
    if not is_own and find_remote_kind(url, required=False, error=OutputError):
        raise OutputError(
            f"output {url!r} exists already, and gyrostab fleet or index did not make it; remove "
            "it first, or give another name with -o"
        )


def check_update(
    output: str | Path,
    archive: Archive,
    options: Mapping[str, Any],
    *,
    known_table: pd.DataFrame | None,
    known_options: Mapping[str, Any],
) -> None:
    """Check that an earlier output is of this archive and these options, to bring it up to date.

    Files that are gone, or new, still belong to the same archive.

    Raises
    ------
    OutputError
        When the earlier output lists a file that still exists and is not in the archive, or has
        other options.
    """
    listed = {full_name(path) for path in [*archive.files, *archive.diagnoses]}
    known_names: Any = [] if known_table is None else known_table["file"]
    other = next((name for name in known_names if name not in listed and exists(name)), None)
    plain = json.loads(json.dumps(options, default=str))
    same: dict[str, Any] = {"inputs": [], "versions": {}}
    changes = (
        f"it has results of {other}, which is not among the files given"
        if other
        else describe_differences({**same, "options": known_options}, {**same, "options": plain})
    )
    if changes:
        raise OutputError(
            f"output {str(output)!r} exists already, and {changes}; give the same archive and "
            "options to bring it up to date, --overwrite (overwrite=True) to replace its results, "
            "or another name with -o"
        )


def read_options(target: Path) -> dict[str, Any]:
    """Read the options of an earlier call from the mark of a fleet."""
    return dict((read_json(target / FLEET_MARK) or {}).get("options", {}))


def begin_output(target: Path, options: Mapping[str, Any], *, reports: bool) -> None:
    """Mark the output as a fleet of these options, and write what its reports share."""
    from gyrostab.report.charts import plotly_script

    if not find_url(target):
        target.mkdir(exist_ok=True)
    write_text(target / FLEET_MARK, json.dumps({"schema": FLEET_SCHEMA, "options": options}))
    if is_zarr(target):
        write_text(target / ".zgroup", json.dumps(_GROUP))
    if reports:
        make_folder(target / "reports")
        write_text(target / "reports" / PLOTLY_FILE, plotly_script())


def make_folder(folder: Path) -> None:
    """Make a folder, with those above it; an address needs none."""
    if not find_url(folder):
        folder.mkdir(parents=True, exist_ok=True)


def make_folders(target: Path, folder: Path) -> None:
    """Make the folders between the output and a run, in a Zarr store as groups."""
    make_folder(folder)
    for group in [folder, *folder.parents] if is_zarr(target) else ():
        if group == target:
            break
        if not exists(group / ".zgroup"):
            write_text(group / ".zgroup", json.dumps(_GROUP))


def consolidate_metadata(target: Path, names: Sequence[str]) -> None:
    """Write the metadata of all groups in one file, from those that each group has."""
    metadata: dict[str, Any] = {".zgroup": _GROUP}
    with ThreadPoolExecutor(REQUESTS if find_url(target) else 1) as threads:
        contents = list(threads.map(lambda name: read_json(target / name / ".zmetadata"), names))
    for name, content in zip(names, contents, strict=True):
        if content is None:
            continue
        parts = name.split("/")
        for depth in range(1, len(parts)):
            metadata["/".join([*parts[:depth], ".zgroup"])] = _GROUP
        metadata |= {f"{name}/{key}": value for key, value in content["metadata"].items()}
    content = {"zarr_consolidated_format": 1, "metadata": metadata}
    write_text(target / ".zmetadata", json.dumps(content))

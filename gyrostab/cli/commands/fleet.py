"""Commands that work on an archive of many runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from gyrostab.cli.console import Output, OutputFolder, app, show_stages
from gyrostab.cli.options import Common, Fitting, Reading, Windowing
from gyrostab.store.remote import find_url
from gyrostab.wording import list_some

if TYPE_CHECKING:
    import pandas as pd

Archives = Annotated[list[Path], Parameter(name="ARCHIVE...", negative=())]
Scheduler = Annotated[str, Parameter(metavar="ADDRESS")]


@app.command(sort_key=2, help_epilogue="")
def index(
    archive: Archives,
    /,
    *,
    output: Output,
    scheduler: Scheduler = "processes",
    reading: Reading = Reading(),
    common: Common = Common(),
) -> None:
    """List the logs of an archive in a table: span, rate, axes, channels and rows of each file.

    When repeated, the command continues its table without --overwrite: files that have not changed
    are not opened again. --overwrite is needed to replace a table of other files or options.
    gyrostab fleet accepts the table in place of the archive, and opens only the logs it computes.

    Example: gyrostab index /archive -o files.parquet

    Parameters
    ----------
    archive
        Folders (searched with all their subfolders), files, or quoted patterns.
    output
        Parquet file to write, which may be at an address (s3://bucket/files.parquet).
    scheduler
        Where to open the files: processes, or the address of a dask scheduler.
    """
    from gyrostab.jobs.fleet import write_file_table

    with show_stages(common) as stage:
        table = write_file_table(
            archive,
            output,
            reading=reading.options(),
            overwrite=common.overwrite,
            scheduler=scheduler,
            workers=common.workers,
            stage=stage,
        )
    _print_left_out(table, output)
    print(find_url(output) or output)


@app.command(sort_key=5, help_epilogue="")
def fleet(
    archive: Archives,
    /,
    *,
    output: OutputFolder,
    per: Literal["folder", "file"] = "folder",
    tool: Annotated[str | None, Parameter(metavar="REGEX")] = None,
    reports: bool = True,
    windows: Windowing = Windowing(),
    fitting: Fitting = Fitting(),
    reading: Reading = Reading(),
    scheduler: Scheduler = "processes",
    common: Common = Common(),
) -> None:
    """Analyse many runs: a product for each, a table of all, reports, and an overview page.

    The logs of a folder are one run. When repeated, the command continues its output without
    --overwrite, even after an interruption: it computes only runs that are new, have changed or
    have failed. --overwrite is needed to replace results of other files or options, and computes
    all runs.

    Example: gyrostab fleet /archive -o fleet --window 10min

    Parameters
    ----------
    archive
        Folders (searched with all their subfolders), files, or quoted patterns; or a table written
        by gyrostab index.
    output
        Folder to write: products, index.parquet, index.html and reports. FLEET.zarr makes the
        products groups of a Zarr store, which may be at an address (s3://bucket/fleet.zarr).
    per
        What a run is: all logs of a folder, or each file.
    tool
        Regular expression for the part of a run's name that names the tool (default: the folders
        above the run).
    reports
        Write a report for each run.
    scheduler
        Where to compute: processes, the workers of a dask scheduler, given by its address,
        tcp://cluster:8786, or threads: one run after the other in this process.
    """
    from gyrostab.errors import FailedRunsError
    from gyrostab.jobs.fleet import run_fleet
    from gyrostab.jobs.fleet_table import FILES, read_table

    failure = None
    with show_stages(common) as stage:
        try:
            table = run_fleet(
                archive,
                output,
                per=per,
                tool=tool,
                reading=reading.options(),
                windows=windows.options(),
                fitting=fitting.options(),
                reports=reports,
                overwrite=common.overwrite,
                scheduler=scheduler,
                workers=common.workers,
                stage=stage,
            )
        except FailedRunsError as error:
            failure = error
    files = read_table(output / "files.parquet", content=FILES)
    if files is not None:
        _print_left_out(files, output / "files.parquet")
    if failure is not None:
        raise failure
    tools = table["tool"].nunique()
    print(f"{len(table)} run{'s'[: len(table) != 1]} of {tools} tool{'s'[: tools != 1]}")
    for path in (output / "index.html", output):
        print(find_url(path) or path)


def _print_left_out(table: pd.DataFrame, path: Path) -> None:
    """Print on stderr how many files of a table are logs, and which are not."""
    print(f"{int(table['is_log'].sum())} of {len(table)} files are logs", file=sys.stderr)
    left_out: Any = table[~table["is_log"].astype(bool) & (table["format"] != "diagnosis")]
    if len(left_out):
        names = list_some(
            [
                file.removeprefix(base).lstrip("/") or file
                for file, base in zip(left_out["file"], left_out["base"], strict=True)
            ]
        )
        print(
            f"note: not logs, or not without options: {names}; {find_url(path) or path} lists "
            "them with the reasons, and gyrostab scan FILE prints the options that a file needs",
            file=sys.stderr,
        )

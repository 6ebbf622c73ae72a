"""Many runs of many tools: one product for each, a table of all, and a page to look at them.

The output is a folder with a NetCDF file for each run, or a Zarr store with a group for each run.
It also holds ``files.parquet`` (the files of the archive), ``index.parquet`` (one row a run),
``effects.parquet`` (effects that diagnoses name), ``trends.parquet`` (changes with age and
temperature), ``index.html`` and ``reports``. A run is computed by `gyrostab.jobs.run.run`, so that
its finished parts survive a stop as well.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from gyrostab.errors import FailedRunsError, GyrostabError, WorkerError
from gyrostab.io.opening import open_dataset
from gyrostab.jobs.archive import LogRun, find_archive, find_runs, index_files, is_fleet
from gyrostab.jobs.fleet_output import (
    PLOTLY_FILE,
    REQUESTS,
    begin_output,
    check_address,
    check_update,
    consolidate_metadata,
    make_folder,
    make_folders,
    read_options,
)
from gyrostab.jobs.fleet_table import (
    FILES,
    RUNS,
    find_trends,
    is_zarr,
    list_effects,
    make_table,
    open_archive,
    product_path,
    read_fleet_rows,
    read_table,
    summarise_run,
    write_table,
)
from gyrostab.jobs.job import lock_output, make_fingerprint
from gyrostab.jobs.load import check_run_options
from gyrostab.jobs.run import find_job_name, read_job_name, run
from gyrostab.jobs.schedule import Pool, check_scheduler, open_pool, run_calls
from gyrostab.progress import Stage, no_stage
from gyrostab.store.output import check_output, protect_inputs, resolve_link
from gyrostab.store.remote import (
    exists,
    find_url,
    full_name,
    remove_address,
    remove_copies,
    upload_file,
)

#: Time after which the table of runs is written again [s]; a killed call loses rows of this time,
#: which are made again from the products.
_SAVE_SECONDS = 30.0
_MAX_NAMES = 3  # runs that an error message names


def write_file_table(
    paths: Sequence[str | Path],
    output: str | Path,
    *,
    reading: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    scheduler: str = "processes",
    workers: int | None = None,
    stage: Stage = no_stage,
) -> pd.DataFrame:
    """Write the table of the files of an archive, which `run_fleet` takes in place of the archive.

    The table of `gyrostab.jobs.archive.index_files` is stored in a Parquet file, which may be at an
    address. An earlier table of the same archive and options is brought up to date: files that have
    not changed are not opened again, except with `overwrite`, which replaces any table of files.
    The other options, and the errors, are the same as in `run_fleet`.
    """
    scheduler = check_scheduler(scheduler)
    known_table = read_table(Path(output), content=FILES)
    if url := find_url(output):
        check_address(url, ".parquet", is_own=known_table is not None)
    else:
        check_output(output, suffixes=[".parquet"], overwrite=overwrite or known_table is not None)
    archive = find_archive(paths)
    if known_table is not None and known_table["is_log"].any() and not overwrite:
        known_options = json.loads(known_table["options"].iloc[0])
        check_update(
            output, archive, reading or {}, known_table=known_table, known_options=known_options
        )
    with _open_workers(scheduler, workers, archive.files[:1]) as pool:
        table = index_files(
            archive,
            reading=reading or {},
            known=None if overwrite else known_table,
            pool=pool,
            stage=stage,
        )
    write_table(table, Path(output), content=FILES, overwrite=overwrite or known_table is not None)
    return table


def run_fleet(
    paths: Sequence[str | Path],
    output: str | Path,
    *,
    per: str = "folder",
    tool: str | None = None,
    reading: Mapping[str, Any] | None = None,
    windows: Mapping[str, Any] | None = None,
    fitting: Mapping[str, Any] | None = None,
    reports: bool = True,
    overwrite: bool = False,
    scheduler: str = "processes",
    workers: int | None = None,
    stage: Stage = no_stage,
) -> pd.DataFrame:
    """Analyse the runs of an archive: a product for each, a table of all, reports and an overview.

    Runs are independent: one that fails is a row with its error. A second call of the same archive
    and options computes only runs whose files or versions have changed, and those that failed. A
    call that was stopped or killed is continued in the same way.

    Parameters
    ----------
    paths : sequence of path
        Folders, files, Zarr stores and patterns, or addresses of them; or one table of
        `write_file_table`.
    output : path
        Folder to write, or to bring up to date; a Zarr store if its name ends in ``.zarr``, which
        may be at an address.
    per : {"folder", "file"}
        Whether the logs of a folder together, or each log, are a run.
    tool : str, optional
        Regular expression whose first match in the name of a run is its tool; by default, the
        folders above the run.
    reading, windows, fitting : mapping
        Options as for `gyrostab.jobs.run.run`.
    reports : bool
        Whether each run gets a report.
    overwrite : bool
        Compute all runs again, even with other options or for another archive. The table then has
        the runs of this call only.
    scheduler : str
        ``processes``, the address of a dask.distributed scheduler, whose workers must see the
        archive and the output under the same names, or ``threads``: one run after the other in this
        process. Each worker computes one run at a time.
    workers : int, optional
        Number of processes; one for each core by default.
    stage : callable
        Called with the number of files and runs that are done.

    Returns
    -------
    pandas.DataFrame
        One row a run, see docs/how-to/fleet.md.

    Raises
    ------
    FailedRunsError
        At the end, when a run has failed.
    WorkerError, KeyboardInterrupt
        When the workers fail, or at an interruption; the message says how much is done.
    ResumeError
        When there is an unfinished run of the output without `overwrite`, or another process works
        on it.
    OutputError, OptionError
        When the output or an option is wrong, or the output has results of other files or options.
    """
    scheduler = check_scheduler(scheduler)
    options = check_run_options(reading=reading, windows=windows, fitting=fitting)
    if url := find_url(output):
        check_address(url, ".zarr", is_own=is_fleet(Path(output)))
    else:
        check_output(output, overwrite=True, find_foreign=_find_foreign)
    target = resolve_link(output)
    with protect_inputs(paths), lock_output(target, overwrite=overwrite):
        archive, known_table = open_archive(paths, target)
        given_options = {**make_fingerprint([], options)["options"], "per": per}
        if not overwrite and any(not row["error"] for row in read_fleet_rows(target).values()):
            check_update(
                output,
                archive,
                given_options,
                known_table=read_table(target / "files.parquet", content=FILES),
                known_options=read_options(target),
            )
        begin_output(target, given_options, reports=reports)
        with _open_workers(scheduler, workers, [target, *archive.files[:1]]) as pool:
            table = index_files(
                archive, reading=options["reading"], known=known_table, pool=pool, stage=stage
            )
            write_table(table, target / "files.parquet", content=FILES, overwrite=True)
            runs = find_runs(archive, table, per=per, tool=tool)
            rows = _compute_runs(
                target,
                runs,
                options,
                reports=reports,
                overwrite=overwrite,
                pool=pool,
                stage=stage,
            )
    failed = rows[rows["error"] != ""]
    for row in failed.to_dict("records"):
        warnings.warn(f"{row['run']}: {row['error']}", stacklevel=2)
    if len(failed):
        names = ", ".join(failed["run"][:_MAX_NAMES])
        page = Path(output) / "index.html"
        more = f" and {len(failed) - _MAX_NAMES} more" if len(failed) > _MAX_NAMES else ""
        raise FailedRunsError(
            f"{len(failed)} of {len(rows)} runs failed: {names}{more}; "
            f"{find_url(page) or page} lists the reasons"
        )
    return rows


def _open_workers(
    scheduler: str, workers: int | None, paths: Sequence[Path]
) -> contextlib.AbstractContextManager[Pool]:
    """Open processes or a cluster; one thread, as the file libraries do not share a process."""
    count = 1 if scheduler == "threads" else workers
    return open_pool(scheduler, workers=count, files=[path for path in paths if not find_url(path)])


def _find_foreign(folder: Path) -> str | None:
    """Return an item of a folder that is not a fleet; None for a fleet and an empty folder."""
    return None if is_fleet(folder) else min(os.listdir(folder), default=None)


def _compute_runs(
    target: Path,
    runs: Sequence[LogRun],
    options: Mapping[str, Any],
    *,
    reports: bool,
    overwrite: bool,
    pool: Pool,
    stage: Stage,
) -> pd.DataFrame:
    """Compute the runs that are new or changed, and write the table and the page of all runs."""
    old_rows = read_fleet_rows(target)
    with ThreadPoolExecutor(REQUESTS if find_url(target) else 1) as threads:
        is_current = threads.map(
            lambda item: (
                not overwrite
                and _is_current(old_rows.get(item.name), target, item, options, reports)
            ),
            runs,
        )
        waiting = [item for item, is_done in zip(runs, is_current, strict=True) if not is_done]
    waiting.sort(key=lambda item: -item.bytes)  # a long run at the end would leave workers idle
    left_out = {item.name for item in waiting} | _find_renamed(old_rows, runs)
    rows = {
        name: row
        for name, row in old_rows.items()
        if not overwrite and name not in left_out and _has_product(target, name)
    }
    work = partial(
        process_run, full_name(target), json.dumps(options, default=str), reports, overwrite
    )
    done, saved, index = 0, time.monotonic(), target / "index.parquet"
    stage("computing", len(waiting), 0, "runs")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # notes on single logs are in the table
            for _, row in run_calls(pool, ((work, item) for item in waiting)):
                rows[row["run"]] = row
                done += 1
                stage("computing", len(waiting), done, "runs")
                if time.monotonic() - saved > _SAVE_SECONDS:
                    write_table(make_table(rows, runs), index, content=RUNS, overwrite=True)
                    saved = time.monotonic()
    except (KeyboardInterrupt, WorkerError) as error:
        reason = str(error) or "interrupted"
        raise type(error)(
            f"{reason}; {done} of {len(waiting)} runs are done, and the same command continues"
        ) from error
    finally:
        stage("writing", 0)
        table = make_table(rows, runs)
        write_table(table, index, content=RUNS, overwrite=True)
        _write_overview(table, target)
        if is_zarr(target):
            consolidate_metadata(target, list(rows))
    return table


def _find_renamed(rows: Mapping[str, Mapping[str, Any]], runs: Sequence[LogRun]) -> set[str]:
    """Find rows of an earlier call whose logs belong to runs of other names now."""
    names = {item.name for item in runs}
    logs = {full_name(path) for item in runs for path in item.files}
    return {
        name
        for name, row in rows.items()
        if name not in names and not logs.isdisjoint(json.loads(row.get("logs") or "[]"))
    }


def _is_current(
    row: Mapping[str, Any] | None,
    target: Path,
    item: LogRun,
    options: Mapping[str, Any],
    reports: bool,
) -> bool:
    """Whether row, product and report of a run were made from its files with its options."""
    if row is None or row["error"]:
        return False
    if reports and not (row["report"] and exists(target / str(row["report"]))):
        return False
    made_by = read_job_name(product_path(target, item.name))
    return bool(row.get("job") == made_by == find_job_name(item.files, **options))


def _has_product(target: Path, name: str) -> bool:
    path = product_path(target, name)
    return bool(read_job_name(path)) if find_url(path) else path.exists()


def process_run(
    target: str, options: str, reports: bool, overwrite: bool, item: LogRun
) -> dict[str, Any]:
    """Compute a run in this thread, write its product and report, and return its row.

    The options of reading, windows and fitting are JSON. In the row, ``error`` is empty unless the
    run failed.
    """
    import dask

    name, product = item.name, product_path(Path(target), item.name)
    row: dict[str, Any] = {
        "run": name,
        "tool": item.tool,
        "error": "",
        "files": len(item.files),
        "report": f"reports/{name}.html" if reports else "",
    }
    run_options = json.loads(options)
    try:
        make_folders(Path(target), product.parent)
        row["job"] = find_job_name(item.files, **run_options)
        if (url := find_url(product)) and (overwrite or read_job_name(product) != row["job"]):
            remove_address(url)  # a run replaces nothing at an address
        with dask.config.set(scheduler="synchronous"), remove_copies():
            run(
                item.files,
                product,
                **run_options,
                workers=1,
                resume=not overwrite,  # which does nothing if the product is complete
                overwrite=True,
                zarr=is_zarr(Path(target)),
            )
            report = Path(target, row["report"]) if reports else None
            row |= _finish_run(product, report, "../" * name.count("/") + PLOTLY_FILE)
    except (GyrostabError, OSError) as error:
        row |= {"error": " ".join(str(error).split()), "report": ""}
    except Exception as error:  # one run must not stop the others
        row |= {"error": f"unexpected {type(error).__name__}: {error}", "report": ""}
    return row


def _finish_run(path: Path, report: Path | None, plotly: str) -> dict[str, Any]:
    """Write the report of a product, and return what the table says of it."""
    from gyrostab.report import write_report

    with open_dataset(path) as product:
        product.load()
    if report is not None:
        make_folder(report.parent)
        with upload_file(report) as place:
            write_report(product, place, overwrite=True, plotly=plotly)
    return summarise_run(product)


def _write_overview(table: pd.DataFrame, target: Path) -> None:
    from gyrostab.report.fleet import write_overview

    effects = list_effects(table)
    trends = find_trends(table, effects)
    write_table(effects, target / "effects.parquet", content="effects", overwrite=True)
    write_table(trends, target / "trends.parquet", content="trends", overwrite=True)
    write_overview(table, target / "index.html", effects=effects, trends=trends, overwrite=True)

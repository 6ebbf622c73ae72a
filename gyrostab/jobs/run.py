"""The whole analysis: logs -> regular log -> dynamic Allan variance -> coefficients -> file."""

from __future__ import annotations

import pickle
import warnings
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr

from gyrostab.errors import FormatError, GyrostabError, OutputError, ResumeError
from gyrostab.io.datasets import to_netcdf, to_zarr
from gyrostab.jobs.checkpoint import assemble_blocks, find_blocks
from gyrostab.jobs.engine import Blocks, compute_blocks, compute_part, find_record_bands
from gyrostab.jobs.job import (
    begin_job,
    check_job_folder,
    clear_job,
    count_finished_parts,
    describe_differences,
    describe_inputs,
    has_finished_work,
    hash_fingerprint,
    job_folder,
    lock_job,
    make_fingerprint,
    read_job,
    remove_job,
    remove_remains,
)
from gyrostab.jobs.load import check_run_options
from gyrostab.jobs.load import count_axis_samples as count_axis_samples
from gyrostab.jobs.load import load_log as load_log
from gyrostab.jobs.schedule import Pool, check_scheduler, open_pool
from gyrostab.kernels.workspace import Workspaces
from gyrostab.progress import Stage, no_stage
from gyrostab.store.attributes import read_attribute
from gyrostab.store.output import (
    check_output,
    find_foreign_item,
    protect_inputs,
    remove_leftovers,
    resolve_link,
)
from gyrostab.store.remote import find_url
from gyrostab.store.system import return_large_arrays

#: Options of `check_output` for a NetCDF file and for a Zarr group.
_FORMS: dict[bool, dict[str, Any]] = {
    False: {"suffixes": [".nc", ".zarr"]},
    True: {"find_foreign": find_foreign_item},
}


def run(
    paths: Sequence[str | Path],
    output: str | Path,
    *,
    reading: Mapping[str, Any] | None = None,
    windows: Mapping[str, Any] | None = None,
    fitting: Mapping[str, Any] | None = None,
    surface_only: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    scheduler: str = "threads",
    workers: int | None = None,
    stage: Stage = no_stage,
    zarr: bool = False,
) -> Path:
    """Compute the product of some logs and write it, in parts that can be continued.

    The log is never held in memory as a whole. Each finished part is kept in the folder
    ``.PRODUCT.nc.job``, next to the output, until the product is complete. A run that was stopped
    or killed is continued with `resume`; its product is the same, bit for bit.

    Parameters
    ----------
    paths : sequence of path
        Logs.
    output : path
        NetCDF file, or Zarr store (``.zarr``), to be written; a Zarr store may be at an address,
        ``s3://bucket/product.zarr``, where nothing is replaced.
    reading, windows, fitting : mapping
        Options of `gyrostab.ingest.read_log`, `gyrostab.allan.davar.davar` and
        `gyrostab.allan.fit.fit_noise`.
    surface_only : bool
        Write the dynamic Allan variance without fitting it.
    overwrite : bool
        Whether an existing output may be replaced, and an unfinished run of it discarded.
    resume : bool
        Continue an unfinished run of the same inputs and options, or begin one; do nothing when the
        product is complete. With `overwrite`, what belongs to other inputs or options is replaced.
    scheduler : str
        ``threads``, ``processes``, or the address of a dask.distributed scheduler, whose workers
        must see the same files.
    workers : int, optional
        Threads or processes; one for each core by default.
    stage : callable
        Called with the name of each stage, how much is to be done in it, and how much is done.
    zarr : bool
        Write a Zarr group instead of a NetCDF file.

    Returns
    -------
    Path
        The file or group written.

    Raises
    ------
    ResumeError
        When there is an unfinished run without `resume` or `overwrite`, or it cannot be continued
        as asked, or another process works on it.
    WorkerError
        When the workers fail.
    OutputError, OptionError, FormatError
        When an output, an option or an input is wrong; the message says whether finished parts are
        kept.
    KeyboardInterrupt
        When interrupted; the message says how much is done.
    """
    scheduler = check_scheduler(scheduler)
    options = check_run_options(reading=reading, windows=windows, fitting=fitting)
    if surface_only:
        options["fitting"] = None
    with protect_inputs(paths), protect_inputs(options["reading"].get("channel", ())):
        zarr = zarr or Path(output).suffix.lower() == ".zarr"
        job = _describe_job(paths, resolve_link(output), options, zarr=zarr)
        if not (resume and _is_complete(job)):
            check_output(output, overwrite=True, **_FORMS[zarr])
        check_job_folder(job.folder)
        pool = partial(open_pool, scheduler, workers=workers, files=job.files)
        _run_job(job, paths, pool, resume=resume, overwrite=overwrite, stage=stage)
    return Path(output)


class _Job(NamedTuple):
    """Target, inputs and options of a run."""

    target: Path
    folder: Path
    files: list[Path]
    fingerprint: dict[str, Any]
    name: str
    options: dict[str, Any]
    zarr: bool


def _run_job(
    job: _Job,
    paths: Sequence[str | Path],
    open_workers: Callable[[], AbstractContextManager[Pool]],
    *,
    resume: bool,
    overwrite: bool,
    stage: Stage,
) -> None:
    """Compute what is missing of a job, under its lock."""
    blocks: Blocks = {}
    with lock_job(job.folder):
        try:
            if resume and _is_complete(job):
                warnings.warn(f"{job.target} is complete already", stacklevel=2)
            else:
                fresh, overwrite = _inspect_job(job, resume=resume, overwrite=overwrite)
                with open_workers() as pool:
                    if fresh:
                        clear_job(job.folder)
                    _compute_missing(
                        job, blocks, paths, overwrite=overwrite, pool=pool, stage=stage
                    )
                _write_product(job, blocks, overwrite=overwrite, stage=stage)
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(_add_resume_advice(job, "interrupted")) from stop
        except GyrostabError as error:
            if has_finished_work(job.folder) and not isinstance(error, ResumeError):
                raise type(error)(_add_resume_advice(job, str(error))) from error
            raise
        finally:
            if not has_finished_work(job.folder):
                remove_job(job.folder, output=job.target)
        remove_job(job.folder, output=job.target)


def find_job_name(
    paths: Sequence[str | Path],
    *,
    reading: Mapping[str, Any],
    windows: Mapping[str, Any],
    fitting: Mapping[str, Any] | None,
) -> str:
    """Hash inputs, options and versions of a run; `read_job_name` finds the hash in a product."""
    options = {"reading": dict(reading), "windows": dict(windows), "fitting": fitting}
    return _describe_job(paths, Path("product"), options).name


def _describe_job(
    paths: Sequence[str | Path], target: Path, options: dict[str, Any], *, zarr: bool = False
) -> _Job:
    from gyrostab.ingest.files import expand
    from gyrostab.ingest.formats.binary import list_layouts

    extra = options["reading"].get("channel", ())
    channel_files = expand(extra) if extra else []
    files = expand(paths) + channel_files
    files += list_layouts(files)
    names = [path.name for path in channel_files] or None  # without folders, as in the hash
    fingerprint = make_fingerprint(
        files, {**options, "reading": {**options["reading"], "channel": names}}
    )
    name = hash_fingerprint(fingerprint)
    return _Job(target, job_folder(target), files, fingerprint, name, options, zarr)


def _inspect_job(job: _Job, *, resume: bool, overwrite: bool) -> tuple[bool, bool]:
    """Find whether a job begins anew, and may replace its output.

    It refuses to destroy an output or to mix two jobs.
    """
    earlier_job, has_work = read_job(job.folder), has_finished_work(job.folder)
    if earlier_job and has_work and not (resume or overwrite):
        raise ResumeError(
            _add_resume_advice(job, f"{job.target}: a run of it was begun and not finished")
            + ", --overwrite starts again"
        )
    changes = describe_differences(earlier_job, job.fingerprint) if earlier_job else ""
    if resume and has_work and changes and not overwrite:
        raise ResumeError(
            f"{job.target}: the run that was begun cannot be continued, because {changes}; "
            "put that back, or give --overwrite in place of --resume to start again"
        )
    is_continued = bool(resume and earlier_job and not changes)
    overwrite = overwrite or bool(earlier_job and is_continued and earlier_job["overwrite"])
    if job.target.exists() and resume and not overwrite:
        raise OutputError(
            f"output {str(job.target)!r} exists already, "
            "and is not the product of these logs and options; "
            "give --overwrite to replace it, or another name with -o"
        )
    check_output(job.target, overwrite=overwrite, **_FORMS[job.zarr])
    return not is_continued, overwrite


def _is_complete(job: _Job) -> bool:
    return read_job_name(job.target) == job.name


def read_job_name(path: Path) -> str:
    """Read the hash of the job that made a product; empty for anything else."""
    return read_attribute(path, "gyrostab_job")


def _add_resume_advice(job: _Job, message: str) -> str:
    """Add to a message how much is done and how to continue."""
    n_finished, earlier_job = count_finished_parts(job.folder), read_job(job.folder)
    if not earlier_job or not has_finished_work(job.folder):
        return (
            f"{message}; nothing was written under the name of the output. "
            "Start the same command again."
        )
    parts = earlier_job["parts"]
    return (
        f"{message}; {n_finished} of {parts} parts ({100 * n_finished / parts:.0f} %) are kept, "
        "and the same command with --resume continues"
    )


def _compute_missing(
    job: _Job,
    blocks: Blocks,
    paths: Sequence[str | Path],
    *,
    overwrite: bool,
    pool: Pool,
    stage: Stage,
) -> None:
    """Compute the missing parts of a job."""
    from gyrostab.allan.davar import davar_parts
    from gyrostab.allan.plan import choose_window

    reading, windows, fitting = (job.options[name] for name in ("reading", "windows", "fitting"))
    remove_remains(job.folder)
    remove_leftovers(job.target)
    if any(map(find_url, paths)):
        return_large_arrays()  # chunks arrive in new arrays, which no thread reuses
    stage("reading", 0)

    def show_file(number: int, count: int, path: Path) -> None:
        stage("reading", count, number - 1, "files")

    log = load_log(paths, **reading, on_file=show_file)
    if "window" not in windows:
        windows = {**windows, "window": choose_window(log)}
        warnings.warn(f"the window is {windows['window']}; --window gives another", stacklevel=2)
    parts = davar_parts(log, **windows)
    begin_job(job.folder, job.fingerprint, parts=len(parts), overwrite=overwrite)
    blocks.update(find_blocks(job.folder, parts, job=job.name))
    total = _count_analysed(log, windows.get("axis"))

    def advance() -> None:
        done = sum(block.part.stop - block.part.start for block in blocks.values())
        stage("computing", total, total * done // parts[-1].stop)

    if len(blocks) < len(parts):
        fitting = find_record_bands(log, windows, fitting)
    spaces = Workspaces()

    def compute_own_part(part: slice) -> xr.Dataset:
        return compute_part(log, part, windows, fitting, spaces.own)

    call: tuple[Any, ...] = (compute_own_part,)
    if pool.remote and len(blocks) < len(parts):
        copy = pool.share(_pack_log(job, log, stage))
        call = (_compute_part_of_copy, copy, windows, fitting)
    advance()
    compute_blocks(
        job.folder,
        parts,
        blocks,
        job=job.name,
        pool=pool,
        call=call,
        check=partial(_check_inputs, job),
        advance=advance,
    )


def _count_analysed(log: xr.Dataset, axis: str | Sequence[str] | None) -> int:
    """Count the samples of the axes that are analysed; None means all axes."""
    n_axes = log.sizes["axis"] if axis is None else 1 if isinstance(axis, str) else len(axis)
    return int(log.sizes["time"] * n_axes)


def _pack_log(job: _Job, log: xr.Dataset, stage: Stage) -> bytes:
    """Pack a log for workers in other processes, which can open logs of gyrostab.

    Other logs are first stored in the folder of the job.
    """
    # logs of gyrostab do not mix with others
    kinds = (read_attribute(path, "gyrostab_content") for path in job.files)
    if "log" not in kinds:
        stage("storing", 0)
        log = load_log([to_zarr(log, job.folder / "log.zarr", stamps=False)])
    return zlib.compress(pickle.dumps(log), level=1)  # holds names and places, not samples


def _check_inputs(job: _Job) -> None:
    now = {**job.fingerprint, "inputs": describe_inputs(job.files)}
    if differences := describe_differences(job.fingerprint, now):
        raise FormatError(f"{differences}; a log must not change while it is read: put it back")


def _compute_part_of_copy(
    copy: bytes, windows: Mapping[str, Any], fitting: Mapping[str, Any] | None, part: slice
) -> xr.Dataset:
    """Compute a part in another process, which opens only the files of this part."""
    return compute_part(_unpack_log(copy), part, windows, fitting)


@lru_cache(maxsize=1)
def _unpack_log(copy: bytes) -> xr.Dataset:
    log: xr.Dataset = pickle.loads(zlib.decompress(copy))
    return log


def _write_product(job: _Job, blocks: Blocks, *, overwrite: bool, stage: Stage) -> None:
    """Write all blocks as the product, and warn of windows in which an axis is constant.

    An axis that is constant throughout has a note in the log.
    """
    import dask

    product = assemble_blocks([blocks[number] for number in sorted(blocks)])
    product = product.assign_attrs(gyrostab_job=job.name)
    n_lazy = sum(variable.chunks is not None for variable in product.variables.values())

    def tell(share: float) -> None:
        stage("writing", n_lazy, int(share * n_lazy), "variables")

    tell(0.0)
    with dask.config.set(scheduler="synchronous"):  # which holds one chunk at a time
        write = to_zarr if job.zarr else to_netcdf
        write(product, job.target, overwrite=overwrite, progress=tell)
    stage("checking", 0)
    is_constant = (product["avar"].isel(tau=[0, -1]) == 0.0).all("tau")  # at both end tau
    shares = is_constant.mean("time").compute(scheduler="synchronous")
    for axis, share in shares.to_series().items():
        if 0.0 < share < 1.0:
            warnings.warn(
                f"gyro axis {axis} is constant in {100 * share:.0f} % of the windows: "
                "check for a stuck sensor or a filler column",
                stacklevel=2,
            )

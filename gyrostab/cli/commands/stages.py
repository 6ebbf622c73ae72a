"""Commands that compute the product: the whole analysis, or one stage of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from gyrostab.cli.console import Logs, Output, OutputFolder, app, show_stages
from gyrostab.cli.options import Common, Fitting, Flag, Reading, Running, Windowing


@app.command(sort_key=0, help_epilogue="")
def demo(*, output: OutputFolder = Path("gyrostab-demo"), common: Common = Common()) -> None:
    """Run the whole analysis on the log shipped with gyrostab, a simulated day.

    Writes the product, the log, a report and figures to a folder, and prints the noise coefficients
    for warm-up, rest, vibration and rest.

    Example: gyrostab demo -o demo-output

    Parameters
    ----------
    output
        Folder to write to.
    """
    _compile_fit_ahead()
    with show_stages(common) as stage:
        stage("loading the libraries")
        from gyrostab.jobs.demo import format_summary, run_demo

        product, files = run_demo(output, overwrite=common.overwrite, stage=stage)
    print("written:", *(f"  {file}" for file in files), sep="\n", end="\n\n")
    print(format_summary(product))


@app.command(sort_key=3, help_epilogue="")
def run(
    logs: Logs,
    /,
    *,
    output: Output,
    windows: Windowing = Windowing(),
    fitting: Fitting = Fitting(),
    reading: Reading = Reading(),
    running: Running = Running(),
    dry_run: Flag = False,
    common: Common = Common(),
) -> None:
    """Analyse logs: dynamic Allan variance and noise coefficients of every window.

    Reads the logs, puts them on a uniform time axis, computes the dynamic Allan variance, fits the
    noise coefficients and writes the product, one file. The logs may be larger than memory, and
    may be Zarr logs in an object store: s3://bucket/run7.zarr.
    An interrupted run is continued with --resume.

    Example: gyrostab run run7/*.csv -o product.nc --window 10min --step 1min

    Parameters
    ----------
    logs
        One or more logs, in any order: files, patterns (run7/*.csv), addresses, and folders that
        are one log (Zarr, ROS 2 bags).
    output
        NetCDF file or Zarr store (.zarr) to write; a Zarr store may be at an address, s3://...
    dry_run
        Print the windows and averaging times, estimate time, memory and output size from the first
        part, and write nothing.
    """
    _compile_fit_ahead()
    if dry_run:
        from gyrostab.jobs.estimate import estimate_run

        options = {"reading": reading.options(), "windows": windows.options()}
        shown = estimate_run(logs, **options, fitting=fitting.options(), workers=common.workers)
        for step in ("reading", "estimating"):
            with show_stages(common) as stage:
                stage(step, 0)
                text = next(shown)
            print(text, flush=True)
        return
    target = _run_job(logs, output, windows, reading, running, common, fitting=fitting.options())
    _print_product(target)


@app.command(sort_key=4, help_epilogue="")
def davar(
    logs: Logs,
    /,
    *,
    output: Output,
    windows: Windowing = Windowing(),
    reading: Reading = Reading(),
    running: Running = Running(),
    common: Common = Common(),
) -> None:
    """Compute the dynamic Allan variance of logs, without fitting noise coefficients.

    Example: gyrostab davar run7.nc -o davar.nc --window 10min --step 1min

    Parameters
    ----------
    logs
        Log written by gyrostab ingest, or logs in any supported format.
    output
        NetCDF file or Zarr store (.zarr) to write.
    """
    print(_run_job(logs, output, windows, reading, running, common, surface_only=True))


@app.command(sort_key=5, help_epilogue="")
def fit(
    surface: Annotated[Path, Parameter(name="DAVAR")],
    /,
    *,
    output: Output,
    fitting: Fitting = Fitting(),
    common: Common = Common(),
) -> None:
    """Fit the noise coefficients Q, N, B, K and R to every window of a dynamic Allan variance.

    Example: gyrostab fit davar.nc -o product.nc

    Parameters
    ----------
    surface
        File written by gyrostab davar.
    output
        NetCDF file or Zarr store (.zarr) to write.
    """
    from gyrostab.allan.fit import fit_noise
    from gyrostab.io.datasets import to_netcdf, to_zarr
    from gyrostab.io.opening import open_surface
    from gyrostab.store.output import check_output

    target = check_output(output, suffixes=[".nc", ".zarr"], overwrite=common.overwrite)
    write = to_zarr if target.suffix.lower() == ".zarr" else to_netcdf
    with show_stages(common) as stage:
        stage("fitting", 0)
        product = fit_noise(open_surface(surface), **fitting.options())
        write(product, target, overwrite=common.overwrite)
    _print_product(target)


def _compile_fit_ahead() -> None:
    """Compile the kernels of the fit in another process, unless they are compiled already.

    Imports only what shows whether they are, so that it compiles while this process imports.
    """
    from gyrostab.kernels.compile_ahead import start_compilation
    from gyrostab.kernels.fit.least_squares import fit_windows

    start_compilation("gyrostab.allan.compile_fit", fit_windows)


def _print_product(target: Path) -> None:
    """Print the summary of a product, the command to run next, and the file name."""
    from shlex import quote

    from gyrostab.allan.summary import format_product
    from gyrostab.ingest.scan_output import print_next
    from gyrostab.io.opening import open_product
    from gyrostab.store.remote import find_url, given_name

    with open_product(target) as product:
        print(format_product(product), end="\n\n")
    name, page = given_name(target), target.with_suffix(".html")
    page = Path(page.name) if find_url(target) else page
    print_next(f"gyrostab report {quote(name)} -o {quote(given_name(page))}", apart=True)
    print(name)


def _run_job(
    logs: list[Path],
    output: Path,
    windows: Windowing,
    reading: Reading,
    running: Running,
    common: Common,
    **more: Any,
) -> Path:
    """Run the analysis with the options of a command."""
    from gyrostab.jobs.run import run as run_job

    with show_stages(common) as stage:
        return run_job(
            logs,
            output,
            reading=reading.options(),
            windows=windows.options(),
            overwrite=common.overwrite,
            resume=running.resume,
            scheduler=running.scheduler,
            workers=common.workers,
            stage=stage,
            **more,
        )

"""Commands on the way from logs to the product."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from gyrostab.cli.frame import Logs, Output, app, show_stages
from gyrostab.cli.options import Common, Fitting, Reading, Running, Windows

__all__ = ["davar", "fit", "run"]


@app.command(sort_key=3, help_epilogue="")
def run(
    logs: Logs,
    /,
    *,
    output: Output,
    windows: Windows = Windows(),
    fitting: Fitting = Fitting(),
    reading: Reading = Reading(),
    running: Running = Running(),
    common: Common = Common(),
) -> None:
    """Go the whole way from logs to the product: uniform time, dynamic Allan variance, noise coefficients, NetCDF.

    The log may be larger than the memory. A run that was stopped goes on with --resume.

    Example: gyrostab run run7/*.csv -o product.nc --window 10min --step 1min

    Parameters
    ----------
    logs
        One or more logs, in any order.
    output
        NetCDF file to write.
    """
    target = _run_job(logs, output, windows, reading, running, common, fitting=fitting.options())
    _print_product(target)


@app.command(sort_key=4, help_epilogue="")
def davar(
    logs: Logs,
    /,
    *,
    output: Output,
    windows: Windows = Windows(),
    reading: Reading = Reading(),
    running: Running = Running(),
    common: Common = Common(),
) -> None:
    """Compute the dynamic Allan variance of a log.

    Example: gyrostab davar run7.nc -o davar.nc --window 10min --step 1min

    Parameters
    ----------
    logs
        Log that gyrostab ingest wrote, or logs in any format.
    output
        NetCDF file to write.
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
    """Fit the noise coefficients Q, N, B, K and R in every window of a dynamic Allan variance.

    Example: gyrostab fit davar.nc -o product.nc

    Parameters
    ----------
    surface
        File that gyrostab davar wrote.
    output
        NetCDF file to write.
    """
    from gyrostab.allan.fit import fit_noise
    from gyrostab.io.datasets import open_surface, to_netcdf
    from gyrostab.store.output import check_output

    target = check_output(output, suffixes=[".nc"], overwrite=common.overwrite)
    with show_stages(common) as stage:
        stage("fitting", 0)
        to_netcdf(
            fit_noise(open_surface(surface), **fitting.options()),
            target,
            overwrite=common.overwrite,
        )
    _print_product(target)


def _print_product(target: Path) -> None:
    """Print what a product says, the command to run next, and the file."""
    from shlex import quote

    from gyrostab.allan.summary import format_product
    from gyrostab.io.datasets import open_product

    with open_product(target) as product:
        print(format_product(product))
    print(
        f"\nNext: gyrostab report {quote(str(target))} -o {quote(str(target.with_suffix('.html')))}"
    )
    print(target)


def _run_job(
    logs: list[Path],
    output: Path,
    windows: Windows,
    reading: Reading,
    running: Running,
    common: Common,
    **more: Any,
) -> Path:
    """Run the main job with what all its commands let the user choose."""
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

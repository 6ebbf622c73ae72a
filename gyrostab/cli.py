"""The command line: parse, call, print.

Exit codes: 0 done; 2 bad input or usage, with one message on stderr; 3 interrupted; 1 anything else. No traceback unless ``--debug``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter

from gyrostab.console import complain, explain, plain_notes, read_config, stoppable
from gyrostab.errors import FormatError, OptionError
from gyrostab.options import ChannelFile, Common, Fitting, Reading, Running, Windows

__all__ = ["app", "main"]

Logs = Annotated[list[Path], Parameter(name="LOG...", negative=())]
Output = Annotated[Path, Parameter(name=["--output", "-o"], metavar="FILE")]

app = App(
    name="gyrostab",
    help="Dynamic Allan variance of gyro logs: from raw logs of drilling tools to noise coefficients that vary with time.",
    help_epilogue="First try: gyrostab demo -o demo-output. Each command explains itself: gyrostab run --help.",
    version_flags=["--version"],
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
)


@contextmanager
def _work(common: Common) -> Iterator[Any]:
    """Set the number of cores, and show the stages of the work."""
    import dask

    from gyrostab.progress import show_progress

    chosen = {"num_workers": common.workers} if common.workers else {}
    with dask.config.set(scheduler="threads", **chosen), show_progress(quiet=common.quiet_progress) as stage:
        yield stage


@app.command(sort_key=0, help_epilogue="")
def demo(*, output: Output = Path("gyrostab-demo"), common: Common = Common()) -> None:
    """Run the main job on the simulated log that comes with gyrostab.

    Writes the product, the regular log, a report and figures into a folder, and prints the noise coefficients
    before, during and after the vibration.

    Example: gyrostab demo -o demo-output

    Parameters
    ----------
    output
        Folder to write into.
    """
    from gyrostab.demo import format_summary, run_demo

    with _work(common) as stage:
        summary, files = run_demo(output, overwrite=common.overwrite, stage=stage)
    print(format_summary(summary))
    print("\nwritten:", *(f"  {file}" for file in files), sep="\n")


@app.command(sort_key=1, help_epilogue="")
def scan(logs: Logs, /, *, reading: Reading = Reading(), common: Common = Common()) -> None:
    """Say what is in some logs: span, sampling rate, axes, channels, gaps, and what is odd.

    Example: gyrostab scan run7/*.csv

    Parameters
    ----------
    logs
        One or more logs, in any format that gyrostab reads.
    """
    from gyrostab.scan import print_scan
    from gyrostab.scan import scan as scan_logs

    table = scan_logs(logs, **reading.options())
    print_scan(table)
    lost = table[table["format"].isna()]
    if len(lost):
        raise FormatError(f"{len(lost)} of {len(table)} files cannot be read: {', '.join(lost['file'])}; the table says why")


@app.command(sort_key=2, help_epilogue="")
def ingest(
    logs: Logs,
    /,
    *,
    output: Output,
    compression: Literal["zstd", "zlib"] | None = None,
    reading: Reading = Reading(),
    common: Common = Common(),
) -> None:
    """Put logs on one uniform time axis, with the gaps marked, and write them as NetCDF or Zarr.

    Integer counts stay integers. The logs may be larger than the memory.

    Example: gyrostab ingest run7/*.csv -o run7.nc

    Parameters
    ----------
    logs
        One or more logs, in any order.
    output
        File to write, LOG.nc or LOG.zarr.
    compression
        Of a NetCDF file: zstd is fast, zlib is read by programs that lack zstd, such as Octave and R on many systems (default: zstd).
    """
    from gyrostab.export import to_netcdf, to_zarr
    from gyrostab.run import check_output, load_log, samples_of

    target = check_output(output, suffixes=[".nc", ".zarr"], overwrite=common.overwrite, inputs=logs)
    zarr = target.suffix.lower() == ".zarr"
    if zarr and compression:
        raise OptionError(f"--compression {compression} is for NetCDF, and {output} is Zarr; leave it out")
    with _work(common) as stage:
        stage("reading", 0)
        log = load_log(logs, **reading.options())
        samples = samples_of(log)
        stage("writing", samples)

        def tell(share: float) -> None:
            stage("writing", samples, round(share * samples))

        if zarr:
            to_zarr(log, target, overwrite=common.overwrite, progress=tell)
        else:
            to_netcdf(log, target, overwrite=common.overwrite, compression=compression, progress=tell)
    print(target)


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
    from gyrostab.run import run as run_job

    with _work(common) as stage:
        target = run_job(
            logs,
            output,
            reading=reading.options(),
            windows=windows.options(),
            fitting=fitting.options(),
            overwrite=common.overwrite,
            resume=running.resume,
            scheduler=running.scheduler,
            workers=common.workers,
            stage=stage,
        )
    print(target)


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
    from gyrostab.run import run as run_job

    with _work(common) as stage:
        target = run_job(
            logs,
            output,
            reading=reading.options(),
            windows=windows.options(),
            surface_only=True,
            overwrite=common.overwrite,
            resume=running.resume,
            scheduler=running.scheduler,
            workers=common.workers,
            stage=stage,
        )
    print(target)


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
    from gyrostab.export import open_surface, to_netcdf
    from gyrostab.fit import fit_noise
    from gyrostab.run import check_output

    target = check_output(output, suffixes=[".nc"], overwrite=common.overwrite, inputs=[surface])
    with _work(common) as stage:
        stage("fitting", 0)
        to_netcdf(fit_noise(open_surface(surface), **fitting.options()), target, overwrite=common.overwrite)
    print(target)


@app.command(sort_key=6, help_epilogue="")
def report(
    product: Annotated[Path, Parameter(name="PRODUCT")],
    /,
    *,
    output: Output,
    log: Path | None = None,
    common: Common = Common(),
) -> None:
    """Make one self-contained HTML page of a product, with figures.

    Example: gyrostab report product.nc -o report.html --log run7.nc

    Parameters
    ----------
    product
        File that gyrostab run or gyrostab fit wrote.
    output
        HTML file to write.
    log
        Log that the product was made of, to show the signal too.
    """
    from gyrostab.export import open_log, open_product
    from gyrostab.report import write_report
    from gyrostab.run import check_output

    target = check_output(output, suffixes=[".html", ".htm"], overwrite=common.overwrite, inputs=[product])
    with _work(common) as stage:
        stage("drawing", 0)
        write_report(open_product(product), target, log=open_log(log) if log else None, overwrite=common.overwrite)
    print(target)


@app.command(sort_key=7, help_epilogue="")
def correlate(
    product: Annotated[Path, Parameter(name="PRODUCT")],
    /,
    *,
    with_: Annotated[str, Parameter(name="--with", metavar="CHANNEL")] = "temperature",
    max_lag: Annotated[str | None, Parameter(metavar="DURATION")] = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"], metavar="FILE")] = None,
    other: ChannelFile = ChannelFile(),
    common: Common = Common(),
) -> None:
    """Say whether noise coefficients and window means follow temperature or another channel, how much and how late.

    Example: gyrostab correlate product.nc --with temperature --max-lag 2h -o coupling.nc

    Parameters
    ----------
    product
        File that gyrostab run or gyrostab fit wrote.
    with_
        Channel of the product, or of the file given by --channel.
    max_lag
        Longest time by which the gyro may follow the channel (default: a tenth of the record; 0s for none).
    output
        NetCDF file to write: the product with the correlation beside it; a figure of the same name in PNG stands beside it.
    """
    from gyrostab.correlate import correlate as compute
    from gyrostab.correlate import format_correlation, join
    from gyrostab.export import open_product, to_netcdf
    from gyrostab.output import new_output
    from gyrostab.plot.correlation import plot_correlation
    from gyrostab.plot.style import save_png
    from gyrostab.read.channel import read_channel
    from gyrostab.run import check_output

    given, file = other.options(), other.channel
    inputs = [product, file] if file else [product]
    target = check_output(output, suffixes=[".nc"], overwrite=common.overwrite, inputs=inputs) if output else None
    picture = check_output(target.with_suffix(".png"), overwrite=common.overwrite) if target else None
    with _work(common) as stage:
        stage("correlating", 0)
        dataset = open_product(product)
        found = compute(dataset, channel=read_channel(file, with_, **given) if file else with_, max_lag=max_lag)
        if target and picture:
            to_netcdf(join(dataset, found), target, overwrite=common.overwrite)
            with new_output(picture, overwrite=common.overwrite) as temporary:
                save_png(plot_correlation(found), temporary)
    print(format_correlation(found))
    if target:
        print(f"\n{target}\n{picture}")


@app.command(sort_key=8, help_epilogue="")
def plot(
    product: Annotated[Path, Parameter(name="PRODUCT")],
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], metavar="DIR")],
    common: Common = Common(),
) -> None:
    """Draw all the figures of a product as PNG: coefficients, also against temperature, dynamic Allan deviation as map and surface.

    Example: gyrostab plot product.nc -o figures

    Parameters
    ----------
    product
        File that gyrostab run or gyrostab fit wrote.
    output
        Folder to write into.
    """
    from gyrostab.export import open_product
    from gyrostab.plot.figures import save_figures

    with _work(common) as stage:
        stage("drawing", 0)
        files = save_figures(open_product(product), output, overwrite=common.overwrite)
    print(*files, sep="\n")


@app.command(sort_key=9, help_epilogue="")
def export(
    product: Annotated[Path, Parameter(name="PRODUCT")],
    /,
    *,
    output: Output,
    format: Literal["kalibr", "zarr"],
    common: Common = Common(),
) -> None:
    """Hand a product over to other programs: the noise for Kalibr and the ROS tools (YAML), or the whole product as Zarr.

    Example: gyrostab export product.nc -o imu.yaml --format kalibr

    Parameters
    ----------
    product
        File that gyrostab run or gyrostab fit wrote.
    output
        File to write (YAML), or directory (Zarr).
    format
        kalibr: N, K and B in radians, the worst axis and each of them; zarr: everything.
    """
    from gyrostab.export import open_product, to_zarr
    from gyrostab.kalibr import to_kalibr
    from gyrostab.run import check_output

    writers: dict[str, tuple[Any, list[str]]] = {"kalibr": (to_kalibr, [".yaml", ".yml"]), "zarr": (to_zarr, [".zarr"])}
    write, suffixes = writers[format]
    target = check_output(output, suffixes=suffixes, overwrite=common.overwrite, inputs=[product])
    with _work(common) as stage:
        stage("writing", 0)
        write(open_product(product), target, overwrite=common.overwrite)
    print(target)


@app.command(sort_key=10, help_epilogue="")
def simulate(
    model: Annotated[Path, Parameter(name="MODEL")],
    /,
    *,
    output: Output,
    duration: Annotated[str | None, Parameter(metavar="DURATION")] = None,
    like: Annotated[list[Path] | None, Parameter(metavar="RECORDING", negative=())] = None,
    seed: Annotated[int | None, Parameter(metavar="N")] = None,
    reading: Reading = Reading(),
    common: Common = Common(),
) -> None:
    """Simulate a gyro log from a model of its noise, its environment and physical effects.

    Every other command takes the log. It may be larger than the memory.

    Example: gyrostab simulate model.toml -o log.nc --duration 1h --rate 100 --seed 1

    Parameters
    ----------
    model
        TOML file with [noise], [[effect]], [[environment]] and [log]; see docs/simulate.md.
    output
        File to write, LOG.nc or LOG.zarr.
    duration
        Length of the log: 1h, 200h. --rate and --start give sampling rate and first time; all three may stand in the model.
    like
        Recording whose time stamps, gaps and channels are taken instead. Repeat for more files of it.
    seed
        Seed of the random numbers: the same log for the same seed, the same noise with and without effects (default: the model's, or 0).
    """
    from gyrostab.export import to_netcdf, to_zarr
    from gyrostab.run import check_output, load_log, samples_of
    from gyrostab.simulate import simulate as make

    target = check_output(output, suffixes=[".nc", ".zarr"], overwrite=common.overwrite, inputs=[model, *(like or [])])
    with _work(common) as stage:
        stage("reading", 0)
        if like:
            log = make(model, like=load_log(like, **reading.options()), duration=duration, seed=seed)
        else:
            log = make(model, duration=duration, rate=reading.rate, start=reading.start, seed=seed)
        stage("simulating", samples_of(log))
        write = to_zarr if target.suffix == ".zarr" else to_netcdf
        write(log, target, overwrite=common.overwrite)
    print(target)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments after the program's name; those of the process when absent.

    Returns
    -------
    int
        Exit code.

    Examples
    --------
    >>> main(["fit", "davar.nc"])
    2
    """
    tokens = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in tokens
    try:
        app.config = read_config(tokens, [command for command in app if not command.startswith("-")])
        with plain_notes(), stoppable():
            app(tokens, exit_on_error=False, print_error=False, result_action="return_value")
    except KeyboardInterrupt as stop:
        said = str(stop) or "interrupted; nothing was written under the name of the output. Start the same command again."
        return complain(said, 3)
    except BrokenPipeError:  # the reader of our output, for instance `head`, has left
        sys.stderr.close()
        return 0
    except Exception as error:
        if debug:
            raise
        return explain(error)
    return 0

"""Commands that read a product."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from gyrostab.cli.console import Output, OutputFolder, Product, app, show_stages
from gyrostab.cli.options import ChannelFile, Common, Survey
from gyrostab.errors import OptionError


@app.command(sort_key=6, help_epilogue="")
def report(
    product: Product,
    /,
    *,
    output: Output,
    log: Annotated[Path | None, Parameter(metavar="LOG.nc")] = None,
    common: Common = Common(),
) -> None:
    """Write a self-contained HTML report of a product or a diagnosis, with figures.

    Example: gyrostab report product.nc -o report.html --log run7.nc

    Parameters
    ----------
    product
        File written by gyrostab run or gyrostab fit, or folder written by gyrostab diagnose.
    output
        HTML file to write.
    log
        Log of the product, written by gyrostab ingest; adds a figure of the signal.
    """
    from gyrostab.io.opening import open_log, open_product
    from gyrostab.report import write_diagnosis_report, write_report
    from gyrostab.report.diagnosis import open_diagnosis
    from gyrostab.store.output import check_output

    target = check_output(output, suffixes=[".html", ".htm"], overwrite=common.overwrite)
    with show_stages(common) as stage:
        stage("drawing", 0)
        if product.is_dir() and (product / "diagnosis.json").exists():
            if log is not None:
                raise OptionError(
                    "--log is for the report of a product; a diagnosis holds what its report shows"
                )
            write_diagnosis_report(open_diagnosis(product), target, overwrite=common.overwrite)
        else:
            signal = open_log(log) if log else None
            write_report(open_product(product), target, log=signal, overwrite=common.overwrite)
    print(target)


@app.command(sort_key=7, help_epilogue="")
def correlate(
    product: Product,
    /,
    *,
    with_: Annotated[
        list[str] | None, Parameter(name="--with", metavar="CHANNEL,...", negative=())
    ] = None,
    max_lag: Annotated[str | None, Parameter(metavar="DURATION")] = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"], metavar="FILE")] = None,
    other: ChannelFile = ChannelFile(),
    common: Common = Common(),
) -> None:
    """Correlate noise coefficients and window means with temperature or other channels.

    Prints which quantities follow the channel or its rate of change, how strongly, and with what
    lag, and the effect of each of these drivers given the others.

    Example: gyrostab correlate product.nc --with temperature,vibration --max-lag 2h -o coupling.nc

    Parameters
    ----------
    product
        File written by gyrostab run or gyrostab fit.
    with_
        Channels to compare with, separated by commas (default: temperature). With --channel, a
        single channel is read from that file; if you give several, those that the product lacks
        are. A single channel is compared together with its rate of change; if you give several,
        name the rate too (temperature_rate).
    max_lag
        Longest lag of the gyro behind the channel (default: one tenth of the record; 0s for none).
    output
        NetCDF file to write: the product with the correlation added. A figure with the same name is
        written as PNG.
    """
    from gyrostab.correlate import correlate as compute
    from gyrostab.correlate import format_correlation, join
    from gyrostab.ingest.reading import read_channel
    from gyrostab.io.datasets import to_netcdf
    from gyrostab.io.opening import open_product
    from gyrostab.plot.correlation import plot_correlation
    from gyrostab.plot.style import save_png
    from gyrostab.store.output import check_output, new_output

    options, file = other.options(), other.channel
    target = check_output(output, suffixes=[".nc"], overwrite=common.overwrite) if output else None
    picture = (
        check_output(target.with_suffix(".png"), overwrite=common.overwrite) if target else None
    )
    with show_stages(common) as stage:
        stage("correlating", 0)
        dataset = open_product(product)
        names = [name.strip() for part in with_ or ["temperature"] for name in part.split(",")]
        from_file = {
            name
            for name in names
            if len(names) == 1
            or not (name in dataset or (name.removesuffix("_rate") in {*names} - {name}))
        }
        channels = [
            read_channel(file, name, **options) if file and name in from_file else name
            for name in names
        ]
        correlation = compute(dataset, channel=channels, max_lag=max_lag)
        if target and picture:
            with new_output(picture, overwrite=common.overwrite) as temporary:
                save_png(plot_correlation(correlation), temporary)
                to_netcdf(join(dataset, correlation), target, overwrite=common.overwrite)
    print(format_correlation(correlation))
    if target:
        print(f"\n{target}\n{picture}")


@app.command(sort_key=8, help_epilogue="")
def plot(
    product: Product,
    /,
    *,
    output: OutputFolder,
    width: Annotated[float, Parameter(metavar="MM")] = 180.0,
    common: Common = Common(),
) -> None:
    """Draw the figures of a product as PNG files.

    The figures show the coefficients over time and against temperature, and the dynamic Allan
    deviation as a map and as a surface.

    Example: gyrostab plot product.nc -o figures

    Parameters
    ----------
    product
        File written by gyrostab run or gyrostab fit.
    output
        Folder to write to.
    width
        Width of the figures in millimetres: 180 for a page, 85 for a column.
    """
    from gyrostab.io.opening import open_product
    from gyrostab.plot.figures import save_figures

    with show_stages(common) as stage:
        stage("drawing", 0)
        files = save_figures(open_product(product), output, width=width, overwrite=common.overwrite)
    print(*files, sep="\n")


@app.command(sort_key=9, help_epilogue="")
def export(
    product: Product,
    /,
    *,
    output: Output,
    format: Literal["csv", "iscwsa", "kalibr", "zarr"],
    log: Annotated[Path | None, Parameter(metavar="LOG.nc")] = None,
    survey: Survey = Survey(),
    common: Common = Common(),
) -> None:
    """Export a product: as CSV, a survey error model, YAML for Kalibr and ROS, or Zarr.

    Example: gyrostab export product.nc -o imu.yaml --format kalibr

    Parameters
    ----------
    product
        File written by gyrostab run or gyrostab fit; for iscwsa, also a folder written by gyrostab
        fleet, or a folder of runs in it.
    output
        File or, for zarr, folder to write.
    format
        csv: a table for spreadsheets, with a row for each window and axis. iscwsa: gyro terms of an
        ISCWSA tool error model, as a table (.csv), as JSON for welleng (.json) or as a WITSML
        ToolErrorModel (.xml), to be confirmed by a survey engineer. kalibr: N, K and B in radians,
        for the worst axis and for each axis. zarr: the whole product.
    log
        Log of the product, for kalibr: adds the noise of the channels accel_x, accel_y and accel_z.
    """
    from gyrostab.io.datasets import to_csv, to_zarr
    from gyrostab.io.kalibr import to_kalibr
    from gyrostab.io.opening import open_log, open_product
    from gyrostab.io.survey_files import SUFFIXES, to_iscwsa
    from gyrostab.jobs.fleet_table import open_fleet
    from gyrostab.store.output import check_output

    writers: dict[str, tuple[Any, list[str]]] = {
        "csv": (to_csv, [".csv"]),
        "iscwsa": (to_iscwsa, list(SUFFIXES)),
        "kalibr": (to_kalibr, [".yaml", ".yml"]),
        "zarr": (to_zarr, [".zarr"]),
    }
    write, suffixes = writers[format]
    target = check_output(output, suffixes=suffixes, overwrite=common.overwrite)
    options = survey.options()
    if options and format != "iscwsa":
        raise OptionError(f"survey options are for --format iscwsa, not for {format}")
    if log:
        if format != "kalibr":
            raise OptionError(f"--log is for --format kalibr, not for {format}")
        options = {"log": open_log(log)}
    with show_stages(common) as stage:
        stage("writing", 0)
        opened = open_fleet(product) if format == "iscwsa" else None
        if opened is None:
            opened = open_product(product)
        written = write(opened, target, overwrite=common.overwrite, **options)
    print(*([written, ""] if format == "iscwsa" else []), target, sep="\n")

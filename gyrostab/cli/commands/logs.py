"""Commands that inspect and convert logs."""

from __future__ import annotations

import math
import sys
from functools import partial
from typing import TYPE_CHECKING, Literal

from gyrostab.cli.console import Logs, Output, app, show_stages
from gyrostab.cli.options import Common, Reading
from gyrostab.errors import FormatError, OptionError

if TYPE_CHECKING:
    import pandas as pd


@app.command(sort_key=1, help_epilogue="")
def scan(logs: Logs, /, *, reading: Reading = Reading(), common: Common = Common()) -> None:
    """Summarise logs: time span, sampling rate, axes, channels, gaps and anomalies.

    Prints a table, the command to run next, and what windows of each length can observe. The table
    counts the gaps within each file, not those between files, and always describes whole files,
    even with --from, --to or --exclude. A file that cannot be read without further options is shown
    too: every column, with a guess at the gyro axes, their unit and the time column.

    Example: gyrostab scan run7/*.csv

    Parameters
    ----------
    logs
        One or more logs, in any supported format.
    """
    from gyrostab.ingest.scan import add_channel_files, scan_and_inspect
    from gyrostab.ingest.scan_output import next_command, print_inspection, print_next, print_scan

    options = reading.given()
    examined = scan_and_inspect(logs, **options)
    table = examined.table
    lost = table[table["format"].isna()]
    if len(lost) < len(table):
        print_scan(table)
    readable = table[table["rate_hz"].notna()]
    if len(readable):
        complete = add_channel_files(options, examined.inspected)
        print_next(next_command(list(readable["file"]), complete), apart=True)
        _print_suggestions(readable, examined.white_noise)
    for inspection in examined.inspected:
        print_inspection(inspection, [str(error) for error in examined.errors])
        if inspection.row is not None:
            complete = add_channel_files(inspection.options, examined.inspected)
            print_next(next_command(inspection.paths, complete))
    if examined.errors and (options or len(lost) == len(table)):
        raise examined.errors[0]
    if len(lost):
        raise FormatError(
            f"{len(lost)} of {len(table)} files cannot be read: {', '.join(lost['file'])}; "
            "the table says why"
        )


def _print_suggestions(readable: pd.DataFrame, noise: list[dict[str, float]]) -> None:
    """Print on stderr what windows of each length can observe on the axis with the least noise."""
    from gyrostab.allan.judgement import suggest_windows

    levels = [level for axes in noise for level in axes.values() if 0 < level < math.inf]
    # as numbers, because pandas has no difference of more than 292 years
    span = readable["end"].max().timestamp() - readable["start"].min().timestamp()
    if levels:
        print(*suggest_windows(span, min(levels)), sep="\n", file=sys.stderr)


@app.command(sort_key=2, help_epilogue="")
def ingest(
    logs: Logs,
    /,
    *,
    output: Output,
    compression: Literal["zstd", "zlib"] | None = None,
    stamps: bool | None = None,
    reading: Reading = Reading(),
    common: Common = Common(),
) -> None:
    """Convert logs to one log on a uniform time axis, with gaps marked (NetCDF or Zarr).

    Integer counts are stored as integers. The logs may be larger than memory.

    Example: gyrostab ingest run7/*.csv -o run7.nc

    Parameters
    ----------
    logs
        One or more logs, in any order.
    output
        File to write: LOG.nc or LOG.zarr.
    compression
        Compression of a NetCDF file. Every program reads zlib; zstd is faster, but Octave, MATLAB
        and h5netcdf cannot read it (default: zlib).
    stamps
        Store the time of every sample, which programs other than gyrostab need (default: yes, below
        10 000 000 samples).
    """
    from gyrostab.io.datasets import to_netcdf, to_zarr
    from gyrostab.jobs.run import count_axis_samples, load_log
    from gyrostab.progress import follow_share
    from gyrostab.store.output import check_output

    target = check_output(output, suffixes=[".nc", ".zarr"], overwrite=common.overwrite)
    zarr = target.suffix.lower() == ".zarr"
    if zarr and compression:
        raise OptionError(
            f"--compression {compression} is for NetCDF, and {output} is Zarr; leave it out"
        )
    with show_stages(common) as stage:
        stage("reading", 0)
        log = load_log(logs, **reading.options())
        tell = follow_share(stage, "writing", count_axis_samples(log))
        write = to_zarr if zarr else partial(to_netcdf, compression=compression)
        write(log, target, overwrite=common.overwrite, stamps=stamps, progress=tell)
    print(target)

"""Command that simulates a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gyrostab.cli.console import Output, app, show_stages
from gyrostab.cli.options import Common, Reading, whole_number
from gyrostab.errors import OptionError


@app.command(sort_key=10, help_epilogue="")
def simulate(
    model: Annotated[Path, Parameter(name="MODEL")],
    /,
    *,
    output: Output,
    duration: Annotated[str | None, Parameter(metavar="DURATION")] = None,
    like: Annotated[list[Path] | None, Parameter(metavar="RECORDING", negative=())] = None,
    seed: Annotated[int | None, whole_number(0)] = None,
    stamps: bool | None = None,
    reading: Reading = Reading(),
    common: Common = Common(),
) -> None:
    """Simulate a gyro log from a model of noise, environment and physical effects.

    Every command that reads logs also reads simulated ones. The log may be larger than memory.

    Example: gyrostab simulate model.toml -o log.nc --duration 1h --rate 100 --seed 1

    Parameters
    ----------
    model
        TOML file with the tables [noise], [[effect]], [[environment]] and [log]; see
        docs/simulate.md.
    output
        File to write: LOG.nc or LOG.zarr.
    duration
        Length of the log: 1h, 200h. --rate and --start set its sampling rate and first time. All
        three may be set in the model instead.
    like
        Recording whose time stamps, gaps and channels the log copies. Its axes are those of
        the recording that the model names. Repeat for a recording in several files.
    seed
        Seed of the random numbers. The same seed gives the same log, and the same noise with and
        without effects (default: the seed in the model, or 0).
    stamps
        Store the time of every sample, which programs other than gyrostab need (default: yes, below
        10 000 000 samples).
    """
    from gyrostab.io.datasets import to_netcdf, to_zarr
    from gyrostab.jobs.run import count_axis_samples, load_log
    from gyrostab.progress import follow_share
    from gyrostab.simulate import simulate as make
    from gyrostab.store.output import check_output

    target = check_output(output, suffixes=[".nc", ".zarr"], overwrite=common.overwrite)
    with show_stages(common) as stage:
        stage("reading", 0)
        if like:
            log = make(
                model, like=load_log(like, **reading.options()), duration=duration, seed=seed
            )
        else:
            if reading.given().keys() - {"rate", "start"}:
                raise OptionError(
                    "reading options except --rate and --start say how to read the recording of "
                    "--like; give that recording too, or leave them out"
                )
            log = make(model, duration=duration, rate=reading.rate, start=reading.start, seed=seed)
        tell = follow_share(stage, "simulating", count_axis_samples(log))
        write = to_zarr if target.suffix.lower() == ".zarr" else to_netcdf
        write(log, target, overwrite=common.overwrite, stamps=stamps, progress=tell)
    print(target)

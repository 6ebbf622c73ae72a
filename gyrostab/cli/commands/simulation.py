"""Commands that simulate a log, and that compare a recording with a simulation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

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
    from gyrostab.jobs.run import count_samples, load_log
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
        tell = follow_share(stage, "simulating", count_samples(log))
        write = to_zarr if target.suffix.lower() == ".zarr" else to_netcdf
        write(log, target, overwrite=common.overwrite, stamps=stamps, progress=tell)
    print(target)


@app.command(sort_key=11, help_epilogue="")
def diagnose(
    recording: Annotated[list[Path], Parameter(name="RECORDING...", negative=())],
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], metavar="DIR")] = Path("diagnosis"),
    simulation: Annotated[Path | None, Parameter(metavar="MODEL.toml|SIM.nc")] = None,
    quiet: Annotated[list[str] | None, Parameter(metavar="START/END", negative=())] = None,
    block: Annotated[str | None, Parameter(metavar="DURATION")] = None,
    axis: Annotated[list[str] | None, Parameter(metavar="NAME", negative=())] = None,
    level: Annotated[float, Parameter(validator=Number(gt=0, lt=0.5))] = 0.01,
    nulls: Annotated[int, whole_number(100)] = 400,
    seed: Annotated[int, whole_number(0)] = 0,
    reading: Reading = Reading(),
    common: Common = Common(),
) -> None:
    """Compare a recording with its simulation and identify missing physical effects.

    Finds where the recording differs from its simulation, identifies the effects that explain the
    difference, and adds them to the model. Writes diagnosis.json, model.toml (input of gyrostab
    simulate), diagnosis.nc and report.html to a folder, and prints the verdict.

    Example: gyrostab diagnose run7.nc -o run7-diagnosis

    Parameters
    ----------
    recording
        One or more logs of the recording, with its channels, in any supported format.
    output
        Folder to write.
    simulation
        Simulation to compare with: a model, or a simulated log with the same time stamps, of which
        only the noise is compared, not what effects do to its mean rate (default: noise calibrated
        on quiescent stretches of the recording).
    quiet
        Quiescent stretch of the recording, on which the noise is calibrated:
        2026-03-14T08:00/2026-03-14T08:30, or 0s/30min after the start. Repeat for more (default:
        detected automatically). With --simulation, it calibrates the level of the simulated noise
        by one factor per axis.
    block
        Length of the blocks in which statistics are computed (default: 20s, less in short
        records, more in records above 5.6h).
    axis
        Diagnose this gyro axis only: x. Repeat for more. Effects that axes have in common need
        several.
    level
        False-alarm probability: how often anything is reported for a recording of noise alone.
    nulls
        Number of null records (simulated noise) from which the thresholds are computed.
    seed
        Seed of the null records.
    """
    import xarray as xr

    from gyrostab.allan.plan import select_axes
    from gyrostab.diagnose.core import diagnose as run_diagnosis
    from gyrostab.diagnose.task import parse_quiescent_span
    from gyrostab.jobs.run import load_log
    from gyrostab.report.diagnosis import find_foreign_file, write_diagnosis
    from gyrostab.store.output import check_output

    check_output(output, overwrite=common.overwrite, find_foreign=find_foreign_file)
    spans = [parse_quiescent_span(text) for text in quiet or ()]
    with show_stages(common) as stage:
        stage("reading", 0)
        log = load_log(recording, **reading.options())
        expected = (
            load_log([simulation])
            if simulation and simulation.suffix.lower() != ".toml"
            else simulation
        )
        if axis:
            log = select_axes(log, axis)
            expected = select_axes(expected, axis) if isinstance(expected, xr.Dataset) else expected
        diagnosis = run_diagnosis(
            log,
            simulation=expected,
            quiet=spans or None,
            block=block,
            false_alarm_level=level,
            nulls=nulls,
            seed=seed,
            progress=stage,
        )
        stage("drawing", 0)
        files = write_diagnosis(diagnosis, output, overwrite=common.overwrite)
    print(diagnosis)
    print("\nwritten:", *(f"  {file}" for file in files), sep="\n")

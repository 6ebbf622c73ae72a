"""Command that compares a recording with its simulation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from gyrostab.cli.console import OutputFolder, app, show_stages
from gyrostab.cli.options import Common, Reading, whole_number


@app.command(sort_key=11, help_epilogue="")
def diagnose(
    recording: Annotated[list[Path], Parameter(name="RECORDING...", negative=())],
    /,
    *,
    output: OutputFolder = Path("diagnosis"),
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
        compared_with = (
            load_log([simulation])
            if simulation and simulation.suffix.lower() != ".toml"
            else simulation
        )
        if axis:
            log = select_axes(log, axis)
            if isinstance(compared_with, xr.Dataset):
                compared_with = select_axes(compared_with, axis)
        diagnosis = run_diagnosis(
            log,
            simulation=compared_with,
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

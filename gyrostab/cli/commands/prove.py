"""The benchmark of concealed effects."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from cyclopts.validators import Number

from gyrostab.cli.frame import app, show_stages
from gyrostab.cli.options import Common, Flag
from gyrostab.units import HOUR

__all__ = ["prove"]

_EVERY = 60.0  # seconds between two lines of progress where there is no terminal


@app.command(sort_key=14, help_epilogue="")
def prove(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], metavar="DIR")] = Path("proof"),
    cases: Annotated[int | None, Parameter(metavar="N", validator=Number(gte=1))] = None,
    seed: Annotated[int | None, Parameter(metavar="N", validator=Number(gte=0))] = None,
    nulls: Annotated[int | None, Parameter(metavar="N", validator=Number(gte=100))] = None,
    real: Annotated[Path | None, Parameter(metavar="DIR", env_var="GYROSTAB_RECORDINGS")] = None,
    resume: Flag = False,
    common: Common = Common(),
) -> None:
    """Try the diagnosis on recordings whose hidden effects it is not told, and count how often it is right.

    Draws cases by physics that the diagnosis does not share, prints the SHA-256 that seals their
    truths, diagnoses the recordings, opens the seal, and writes scores.csv, table.md and figures,
    failures included. About half a minute a case and core.

    Example: gyrostab prove --cases 20 --nulls 200 -o proof

    Parameters
    ----------
    output
        Folder to make.
    cases
        Number of cases (default: 40); every 20 hold all kinds.
    seed
        Of the draws (default: a fresh one, which is printed). Seeds below 1000000 are for tuning;
        figures that are published use others.
    nulls
        Null records of each diagnosis (default: 400; 200 for a quick look).
    real
        Folder of real recordings (default: $GYROSTAB_RECORDINGS); one is salted for every 40 cases.
        Without it none is.
    resume
        Continue a run that was stopped or killed; begin one where there is none.
    """
    from gyrostab.blindtest.runner.benchmark import prove as run_benchmark
    from gyrostab.blindtest.runner.folder import FIRST_PUBLIC_SEED
    from gyrostab.blindtest.scoring.table import markdown

    def say(text: str) -> None:
        print(text, flush=True)

    if seed is not None and seed < FIRST_PUBLIC_SEED:
        print(
            f"note: seed {seed} is below {FIRST_PUBLIC_SEED}: such seeds are for tuning, and their figures are not for publication",
            file=sys.stderr,
        )
    try:
        with show_stages(common) as stage, _lines(stage, quiet=common.quiet_progress) as told:
            proof = run_benchmark(
                output,
                cases=cases,
                seed=seed,
                nulls=nulls,
                workers=common.workers,
                real=real,
                resume=resume,
                overwrite=common.overwrite,
                progress=told,
                say=say,
            )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; what is finished is kept: gyrostab prove --resume -o {output} goes on"
        ) from None
    print(markdown(proof.table))
    print("\ntargets missed:", *(f"  {line}" for line in proof.missed or ["none"]), sep="\n")
    if proof.failed:
        print(
            "\ndiagnoses that failed:",
            *(f"  {name}: {why}" for name, why in proof.failed.items()),
            sep="\n",
        )
    print("\nwritten:", *(f"  {file}" for file in proof.files), sep="\n")


@contextmanager
def _lines(stage: Any, *, quiet: bool) -> Iterator[Any]:
    """Say how far the work is, now and then, where no bar can be drawn."""
    if quiet or sys.stderr.isatty():
        yield stage
        return
    now: dict[str, Any] = {"label": "", "first": 0, "begun": 0.0, "said": 0.0}

    def told(label: str, total: int = 0, done: int | None = None, unit: str = "samples") -> None:
        stage(label, total, done, unit)
        clock = time.monotonic()
        if label != now["label"]:
            now.update(label=label, first=done or 0, begun=clock, said=clock)
        worked = (done or 0) - now["first"]
        if worked and total and clock - now["said"] > _EVERY:
            now["said"] = clock
            left = (clock - now["begun"]) / worked * (total - (done or 0))
            print(
                f"{label} {done} of {total} {unit}, {_length(left)} left",
                file=sys.stderr,
                flush=True,
            )

    yield told


def _length(seconds: float) -> str:
    return (
        f"{seconds / HOUR:.1f} h"
        if seconds > 5400
        else f"{seconds / 60:.0f} min"
        if seconds > 90
        else f"{seconds:.0f} s"
    )

"""Command `prove`: the blind test of the diagnosis."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gyrostab.cli.console import OutputFolder, app, show_stages
from gyrostab.cli.options import Common, Flag, whole_number


@app.command(sort_key=14, help_epilogue="")
def prove(
    *,
    output: OutputFolder = Path("proof"),
    cases: Annotated[int | None, whole_number(1)] = None,
    seed: Annotated[int | None, whole_number(0)] = None,
    nulls: Annotated[int | None, whole_number(100)] = None,
    counterparts: Annotated[int | None, whole_number(0)] = None,
    real: Annotated[Path | None, Parameter(metavar="DIR", env_var="GYROSTAB_RECORDINGS")] = None,
    resume: Flag = False,
    common: Common = Common(),
) -> None:
    """Test the diagnosis blindly on recordings with known effects, and score it.

    Draws cases with physics that the diagnosis does not share, prints the SHA-256 of their ground
    truths, diagnoses the recordings, scores the diagnoses, and writes scores.csv, table.md and
    figures, failures included. Takes about half a minute per case and core.

    Example: gyrostab prove --cases 20 --nulls 200 -o proof

    Parameters
    ----------
    output
        Folder to create.
    cases
        Number of cases (default: 40); every 20 include all kinds.
    seed
        Seed of the draws (default: a random one, which is printed). Seeds below 1000000 are for
        tuning; published figures use others.
    nulls
        Null records of each diagnosis (default: 400; 200 for a quick look).
    counterparts
        One in N cases with effects is diagnosed without its effects too (default: 4; 0 for none).
    real
        Folder of real recordings (default: $GYROSTAB_RECORDINGS); one injection is made for every
        20 cases. Without the folder there are no injections.
    resume
        Continue a run that was stopped or killed, or start one.
    """
    from gyrostab.blindtest.runner.benchmark import prove as run_benchmark
    from gyrostab.blindtest.runner.folder import FIRST_PUBLIC_SEED
    from gyrostab.blindtest.scoring.table import markdown

    def say(text: str) -> None:
        print(text, flush=True)

    if seed is not None and seed < FIRST_PUBLIC_SEED:
        print(
            f"note: seed {seed} is below {FIRST_PUBLIC_SEED}: such seeds are for tuning, "
            "and their figures are not for publication",
            file=sys.stderr,
        )
    try:
        with show_stages(common) as stage:
            proof = run_benchmark(
                output,
                cases=cases,
                seed=seed,
                nulls=nulls,
                counterparts=counterparts,
                workers=common.workers,
                real=real,
                resume=resume,
                overwrite=common.overwrite,
                progress=stage,
                say=say,
            )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; finished parts are kept: gyrostab prove --resume -o {output} continues"
        ) from None
    print(markdown(proof.table))
    print("\nmissed targets:", *(f"  {line}" for line in proof.missed or ["none"]), sep="\n")
    if proof.failed:
        print(
            "\nfailed diagnoses:",
            *(f"  {name}: {reason}" for name, reason in proof.failed.items()),
            sep="\n",
        )
    print("\nwritten:", *(f"  {file}" for file in proof.files), sep="\n")

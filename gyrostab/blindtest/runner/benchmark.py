"""Run the benchmark from the draw to the table."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from gyrostab.blindtest.runner.folder import (
    FIRST_PUBLIC_SEED,
    begin_run,
    case_name,
    inspect_folder,
    read_sums,
    write_sums,
)
from gyrostab.blindtest.runner.steps import compare_case, diagnose_case, draw_case, run_in_processes
from gyrostab.errors import OptionError, ResumeError
from gyrostab.store.output import resolve_link

if TYPE_CHECKING:
    import pandas as pd

    from gyrostab.progress import Stage

T = TypeVar("T")
#: Runs a step: takes its label, the function of a case, the jobs, and the number of cases done.
RunStep = Callable[..., list[Any]]

_DEFAULTS = {"cases": 40, "nulls": 400, "counterparts": 4}

_CASES_PER_INJECTION = 20  # each injection makes four more cases


class Proof(NamedTuple):
    """Result of a benchmark."""

    #: Seed of all draws.
    seed: int
    #: SHA-256 of the list of committed truths.
    commitment: str
    #: Figures with 95 % intervals and targets.
    table: pd.DataFrame
    #: One sentence for each missed target.
    missed: list[str]
    #: Name of each case whose diagnosis failed -> reason.
    failed: dict[str, str]
    #: Files written.
    files: list[Path]


def prove(
    directory: str | os.PathLike[str],
    *,
    cases: int | None = None,
    seed: int | None = None,
    nulls: int | None = None,
    counterparts: int | None = None,
    workers: int | None = None,
    real: str | os.PathLike[str] | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Stage | None = None,
    say: Callable[[str], None] | None = None,
) -> Proof:
    """Test the diagnosis blindly on recordings with known effects, and score it.

    The generator of the cases shares no physics with the diagnosis. The SHA-256 of all ground
    truths is committed before the first recording is diagnosed, and each diagnosis gets one
    recording and nothing else.

    Parameters
    ----------
    directory : path-like
        Folder to create: recordings, truths, diagnoses, ``scores.csv``, ``table.md`` and figures.
    cases : int
        Number of cases, 40 by default; every 20 include all kinds.
    seed : int
        Seed of the draws; a random one by default. Seeds below 1 000 000 are for tuning.
    nulls : int
        Null records of each diagnosis, 400 by default.
    counterparts : int
        One in so many cases with effects gets a counterpart, the same record without its effects: 4
        by default, 1 for all cases, 0 for none.
    workers : int
        Number of processes: one per core by default, 0 to work in this process.
    real : path-like
        Folder of real recordings; one injection is made for every 20 cases. Without it there are no
        injections. See `gyrostab.blindtest.scenarios.injection`.
    resume : bool
        Continue an interrupted run in the folder, or start one.
    overwrite : bool
        Replace an existing run in the folder.
    progress : Stage
        Progress display.
    say : callable
        Receives messages: the seed before the draw, and the hash before the first diagnosis.

    Returns
    -------
    Proof

    Raises
    ------
    OptionError
        When a number is out of range.
    OutputError
        When the folder is not empty, or cannot be created.
    ResumeError
        When the folder holds a run with other options, or another process uses it.
    FormatError
        When a truth is not the one that was committed, or a real recording cannot be read.
    WorkerError
        When a process dies.

    Examples
    --------
    >>> proof = gyrostab.prove("proof", cases=20)  # doctest: +SKIP
    >>> print(proof.table)  # doctest: +SKIP
    """
    from gyrostab.blindtest.runner.outcome import score_rows, write_outcome
    from gyrostab.blindtest.scenarios.case import open_truth
    from gyrostab.blindtest.scenarios.injection import check_recordings
    from gyrostab.blindtest.scoring.table import list_missed, score_table
    from gyrostab.jobs import lock_job
    from gyrostab.progress import no_stage

    if workers is not None and workers < 0:
        raise OptionError(f"workers={workers}: give a number of processes, or 0 for this process")
    folder, stage, tell = resolve_link(directory), progress or no_stage, say or (lambda text: None)
    injected = 0 if real is None else (cases or _DEFAULTS["cases"]) // _CASES_PER_INJECTION
    new_seed = FIRST_PUBLIC_SEED + secrets.randbelow(10**9)
    usual = {**_DEFAULTS, "seed": new_seed, "injected": injected}
    requested = {"cases": cases, "seed": seed, "nulls": nulls, "counterparts": counterparts}
    job = inspect_folder(folder, requested, usual, resume=resume, overwrite=overwrite)
    if real is not None and job["injected"]:
        check_recordings(Path(real))
    with lock_job(folder):
        begin_run(folder, job)
        tell(_describe_run(job, folder))
        plans = _plan_all(job)

        def run_step(
            label: str, function: Callable[..., T], jobs: Sequence[tuple[Any, ...]], done: int = 0
        ) -> list[T]:
            def report(number: int) -> None:
                stage(label, done + len(jobs), done + number, "cases")

            report(0)
            return run_in_processes(function, jobs, workers=workers, report=report)

        sums, commitment = read_sums(folder) or _draw_and_commit(
            folder, plans, run_step, None if real is None else Path(real)
        )
        # another version may have drawn other cases
        names = [name for name in plans if name in sums] + sorted(sums.keys() - plans.keys())
        tell(f"committed: {len(names)} truths, SHA-256 of their list {commitment}")
        failed = _diagnose_all(folder, job, names, run_step)
        truths = {
            name: open_truth(folder / "truth" / f"{name}.json", sha256=sums[name]) for name in names
        }
        baseline_scores = _compare_all(folder, truths, run_step)
        stage("counting", 0)
        diagnoses = {
            name: json.loads((folder / "diagnoses" / f"{name}.json").read_text(encoding="utf-8"))
            for name in names
            if name not in failed
        }
        rows = score_rows(diagnoses, truths, baseline_scores)
        table = score_table(rows)
        files = write_outcome(folder, rows, table, job=job, commitment=commitment, failed=failed)
        return Proof(job["seed"], commitment, table, list_missed(table), failed, files)


def _plan_all(job: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Plan all cases, counterparts and injections; return name -> plan."""
    from gyrostab.blindtest.scenarios.injection import plan_injections
    from gyrostab.blindtest.scenarios.plan import plan_cases, plan_counterparts

    drawn = plan_cases(job["cases"], seed=job["seed"])
    copies = plan_counterparts(drawn, job["counterparts"])
    injections = plan_injections(job["injected"], seed=job["seed"])
    return {
        case_name(job["seed"], plan["index"], plan.get("copy", "")): plan
        for plan in (*drawn, *copies, *injections)
    }


def _describe_run(job: dict[str, Any], folder: Path) -> str:
    text = f"{job['cases']} cases of seed {job['seed']}; to repeat: "
    text += f"gyrostab prove --cases {job['cases']} --seed {job['seed']}"
    for name in ("nulls", "counterparts"):
        text += f" --{name} {job[name]}" if job[name] != _DEFAULTS[name] else ""
    if job["injected"]:
        text += " --real DIR"
        text += f"\nand {job['injected']} injections into real recordings, with three controls each"
    else:
        few = job["cases"] < _CASES_PER_INJECTION
        text += "\nno injections into real recordings: "
        text += "too few cases" if few else "their folder was not given (--real DIR)"
        text += f"; there is one for every {_CASES_PER_INJECTION} cases"
    done = len(list((folder / "diagnoses").glob("*.json")))
    return text + (f"\n{done} cases are diagnosed already" if done else "")


def _draw_and_commit(
    folder: Path, plans: dict[str, dict[str, Any]], run_step: RunStep, real: Path | None
) -> tuple[dict[str, str], str]:
    """Draw the missing cases and commit all truths."""
    if real is None and any("recording" in plan for plan in plans.values()):
        raise ResumeError(
            f"{folder}: was begun with real recordings that are not drawn yet; "
            "give their folder again with --real DIR"
        )
    jobs = [(folder, name, plan, real) for name, plan in plans.items()]
    sums = dict(zip(plans, run_step("drawing", draw_case, jobs), strict=True))
    return sums, write_sums(folder, sums)


def _diagnose_all(
    folder: Path, job: dict[str, Any], names: list[str], run_step: RunStep
) -> dict[str, str]:
    """Diagnose the remaining cases; return the name of each that fails -> reason."""
    remaining = [name for name in names if not (folder / "diagnoses" / f"{name}.json").exists()]
    jobs = [
        (
            folder / "recordings" / f"{name}.nc",
            folder / "diagnoses" / f"{name}.json",
            folder / "failed" / f"{name}.txt",
            job["nulls"],
        )
        for name in remaining
    ]
    good = run_step("diagnosing", diagnose_case, jobs, len(names) - len(remaining))
    lost = [name for name, flag in zip(remaining, good, strict=True) if not flag]
    return {
        name: (folder / "failed" / f"{name}.txt").read_text(encoding="utf-8").splitlines()[0]
        for name in lost
    }


def _compare_all(
    folder: Path, truths: dict[str, dict[str, Any]], run_step: RunStep
) -> dict[str, dict[str, float]]:
    """Score the drawn cases with other detectors; the noise of a real recording is unknown."""
    drawn = [name for name, truth in truths.items() if "recording" not in truth["plan"]]
    jobs = [
        (
            folder / "recordings" / f"{name}.nc",
            truths[name],
            folder / "comparisons" / f"{name}.json",
        )
        for name in drawn
    ]
    return dict(zip(drawn, run_step("comparing", compare_case, jobs), strict=True))

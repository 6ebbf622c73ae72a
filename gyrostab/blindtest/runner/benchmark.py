"""The benchmark from the draw to the table."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gyrostab.blindtest.runner.folder import TUNING, begin, case_name, look, read_sums, write_sums
from gyrostab.blindtest.runner.pool import each_in_processes
from gyrostab.blindtest.runner.steps import compare_case, diagnose_case, draw_case
from gyrostab.errors import ResumeError
from gyrostab.store.output import resolve_link

if TYPE_CHECKING:
    import pandas as pd

    from gyrostab.progress import Stage

__all__ = ["Proof", "prove"]

_USUAL = {"cases": 40, "nulls": 400}

_SALTED = 40  # drawn cases to a salted real recording, which makes four more


class Proof(NamedTuple):
    """What a benchmark gave."""

    #: Of all draws.
    seed: int
    #: SHA-256 of the list of sealed truths.
    sealed: str
    #: Figures with 95 % intervals and targets.
    table: pd.DataFrame
    #: A sentence on every target that was missed.
    missed: list[str]
    #: Name of each case whose diagnosis failed, and why.
    failed: dict[str, str]
    #: Files written.
    files: list[Path]


def prove(
    directory: str | os.PathLike[str],
    *,
    cases: int | None = None,
    seed: int | None = None,
    nulls: int | None = None,
    workers: int | None = None,
    real: str | os.PathLike[str] | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Stage | None = None,
    say: Callable[[str], None] | None = None,
) -> Proof:
    """Try the diagnosis on recordings with concealed effects, and count how often it is right.

    The cases are drawn by a generator that shares no physics with the diagnosis. All truths are
    sealed by their SHA-256 before the first recording is diagnosed; each diagnosis is given one
    recording and nothing else.

    Parameters
    ----------
    directory : path-like
        The folder to make: recordings, truths, diagnoses, ``scores.csv``, ``table.md`` and figures.
    cases : int
        Number of cases, 40 by default; every 20 hold all kinds.
    seed : int
        Of the draws; a fresh one by default. Seeds below 1 000 000 are for tuning.
    nulls : int
        Null records of each diagnosis, 400 by default.
    workers : int
        Processes; as many as there are cores by default, 0 for none but this one.
    real : path-like
        Folder of real recordings to be salted, one for every 40 cases; none are without it. See
        `gyrostab.blindtest.scenarios.real`.
    resume : bool
        Go on with what was begun in the folder; begin where nothing was.
    overwrite : bool
        Forget what was begun in the folder.
    progress : Stage
        Is told of the progress.
    say : callable
        Is told the seed before the draw, and the hash before the first diagnosis.

    Returns
    -------
    Proof

    Raises
    ------
    OutputError
        When the folder holds something, or cannot be made.
    ResumeError
        When other cases were begun in it, or another process works on it.
    FormatError
        When a truth is not the one that was sealed, or a real recording cannot be read.
    WorkerError
        When a process dies.

    Examples
    --------
    >>> proof = gyrostab.prove("proof", cases=20)                                                         # doctest: +SKIP
    >>> print(proof.table)                                                                                # doctest: +SKIP
    """
    from gyrostab.jobs.job import lock_job
    from gyrostab.progress import no_stage

    folder, stage, tell = resolve_link(directory), progress or no_stage, say or (lambda text: None)
    salted = 0 if real is None else (cases or _USUAL["cases"]) // _SALTED
    fresh = {**_USUAL, "seed": TUNING + secrets.randbelow(10**9), "salted": salted}
    wanted = {"cases": cases, "seed": seed, "nulls": nulls}
    look(folder, wanted, fresh, resume=resume, overwrite=overwrite)
    with lock_job(folder):
        job = begin(folder, wanted, fresh, resume=resume, overwrite=overwrite)
        tell(_opening(job, folder))
        number = (
            len(os.sched_getaffinity(0))
            if hasattr(os, "sched_getaffinity")
            else os.cpu_count() or 1
        )
        number = number if workers is None else workers
        plans = _plans(job)
        names = list(plans)
        sums, sealed = _drawn(folder, plans, number, stage, None if real is None else Path(real))
        tell(f"sealed: {len(names)} truths, SHA-256 of their list {sealed}")
        failed = _diagnosed(folder, job, names, number, stage)
        return _opened(folder, job, names, sums, sealed, failed, number, stage)


def _plans(job: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Name of each case, drawn or salted, to its plan."""
    from gyrostab.blindtest.scenarios.plan import plan_cases
    from gyrostab.blindtest.scenarios.real import plan_injections

    drawn = {
        case_name(job["seed"], plan["index"]): plan
        for plan in plan_cases(job["cases"], seed=job["seed"])
    }
    return drawn | {
        case_name(job["seed"], plan["index"], plan["copy"]): plan
        for plan in plan_injections(job["salted"], seed=job["seed"])
    }


def _opening(job: dict[str, Any], folder: Path) -> str:
    said = f"{job['cases']} cases of seed {job['seed']}; the same again: gyrostab prove --cases {job['cases']} --seed {job['seed']}"
    said += f" --nulls {job['nulls']}" if job["nulls"] != _USUAL["nulls"] else ""
    if job["salted"]:
        said += f"\nand {job['salted']} real recordings, each with salt and three times without"
    else:
        said += f"\nno real recordings are salted: one is for every {_SALTED} cases, where their folder is known"
    done = len(list((folder / "diagnoses").glob("*.json")))
    return said + (f"\n{done} of them are diagnosed already" if done else "")


def _counter(stage: Stage, label: str, total: int, first: int = 0) -> Callable[[int], None]:
    stage(label, total, first, "cases")
    return lambda done: stage(label, total, first + done, "cases")


def _drawn(
    folder: Path, plans: dict[str, dict[str, Any]], workers: int, stage: Stage, real: Path | None
) -> tuple[dict[str, str], str]:
    """Draw what is not drawn, and seal; what was sealed once is never drawn again."""
    kept = read_sums(folder)
    if kept is not None:
        return kept
    if real is None and any("copy" in plan for plan in plans.values()):
        raise ResumeError(
            f"{folder}: was begun with real recordings, which are not drawn yet; say again where they are with --real DIR"
        )
    jobs = [(folder, name, plan, real) for name, plan in plans.items()]
    found = each_in_processes(
        draw_case, jobs, workers=workers, told=_counter(stage, "drawing", len(jobs))
    )
    sums = dict(zip(plans, found, strict=True))
    return sums, write_sums(folder, sums)


def _diagnosed(
    folder: Path, job: dict[str, Any], names: list[str], workers: int, stage: Stage
) -> dict[str, str]:
    """Diagnose what is not diagnosed; the name of each case that fails, and why."""
    left = [name for name in names if not (folder / "diagnoses" / f"{name}.json").exists()]
    jobs = [
        (
            folder / "recordings" / f"{name}.nc",
            folder / "diagnoses" / f"{name}.json",
            folder / "failed" / f"{name}.txt",
            job["nulls"],
        )
        for name in left
    ]
    told = _counter(stage, "diagnosing", len(names), len(names) - len(left))
    good = each_in_processes(diagnose_case, jobs, workers=workers, told=told)
    lost = [name for name, flag in zip(left, good, strict=True) if not flag]
    return {
        name: (folder / "failed" / f"{name}.txt").read_text(encoding="utf-8").splitlines()[0]
        for name in lost
    }


def _opened(
    folder: Path,
    job: dict[str, Any],
    names: list[str],
    sums: dict[str, str],
    sealed: str,
    failed: dict[str, str],
    workers: int,
    stage: Stage,
) -> Proof:
    """Open the seal, count, and write."""
    from gyrostab.blindtest.runner.outcome import score_rows, write_outcome
    from gyrostab.blindtest.scenarios.commitment import open_truth
    from gyrostab.blindtest.scoring.table import missed, score_table

    truths = {
        name: open_truth(folder / "truth" / f"{name}.json", sha256=sums[name]) for name in names
    }
    drawn = [
        name for name in names if "copy" not in truths[name]["plan"]
    ]  # of real noise no truth says how much it is
    jobs = [
        (
            folder / "recordings" / f"{name}.nc",
            truths[name],
            folder / "comparisons" / f"{name}.json",
        )
        for name in drawn
    ]
    naive = each_in_processes(
        compare_case, jobs, workers=workers, told=_counter(stage, "comparing", len(drawn))
    )
    found = {
        name: json.loads((folder / "diagnoses" / f"{name}.json").read_text(encoding="utf-8"))
        for name in names
        if name not in failed
    }
    stage("counting", 0)
    rows = score_rows(found, truths, dict(zip(drawn, naive, strict=True)))
    table = score_table(rows)
    files = write_outcome(folder, rows, table, job=job, sealed=sealed, failed=failed)
    return Proof(job["seed"], sealed, table, missed(table), failed, files)

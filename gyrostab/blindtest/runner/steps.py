"""Steps of one case, in processes: draw and commit, diagnose, compare.

Each writes a complete file or none.
"""

from __future__ import annotations

import json
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gyrostab.blindtest.runner.folder import write_json
from gyrostab.errors import GyrostabError
from gyrostab.store.output import write_text

if TYPE_CHECKING:
    import xarray as xr
import contextlib
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from gyrostab.errors import WorkerError
from gyrostab.jobs import open_pool, run_calls


def draw_case(directory: Path, name: str, plan: dict[str, Any], real: Path | None = None) -> str:
    """Write recording and truth of a plan unless they exist; return the SHA-256 of the truth.

    `real` is the folder of the real recordings.
    """
    from gyrostab.blindtest.scenarios.case import commit_case, fingerprint, make_case
    from gyrostab.blindtest.scenarios.injection import make_injection_case

    truth = directory / "truth" / f"{name}.json"
    if truth.exists():  # written after the recording
        return fingerprint(truth.read_text(encoding="utf-8"))
    log, content = (
        make_injection_case(plan, real)
        if real is not None and "recording" in plan
        else make_case(plan)
    )
    return commit_case(log, content, directory, name=name)


def diagnose_case(recording: Path, target: Path, failed: Path, nulls: int) -> bool:
    """Diagnose a recording; return whether that succeeded, else write the reason to `failed`.

    The diagnosis is written with the check of its model, if that has an effect.
    """
    from gyrostab import diagnose
    from gyrostab.jobs import load_log

    try:
        log = load_log([recording])
        diagnosis = diagnose(log, nulls=nulls, seed=int(recording.stem[:7], 16))
        checked = _check_model(log, diagnosis) if diagnosis.model.get("effect") else None
        write_json(target, json.loads(diagnosis.to_json()) | {"model_check": checked})
    except Exception as error:  # a case that breaks the diagnosis is reported as a result
        lines = traceback.format_exc() if not isinstance(error, GyrostabError) else ""
        write_text(failed, f"{type(error).__name__}: {error}\n{lines}")
        return False
    failed.unlink(missing_ok=True)
    return True


def _check_model(log: xr.Dataset, diagnosis: Any) -> dict[str, Any]:
    """Compare a recording with its model and with the noise that was calibrated first."""
    from gyrostab.blindtest.scoring.resimulation import check_model

    try:
        calibrated = {
            axis: {term: entry["value"] for term, entry in terms.items()}
            for axis, terms in diagnosis.content["baseline"]["noise"].items()
        }
        return check_model(log.compute(), diagnosis.model, calibrated)
    except Exception as error:  # the diagnosis is good, but not its model
        return {"runs": False, "reason": f"{type(error).__name__}: {error}"}


def compare_case(recording: Path, truth: dict[str, Any], target: Path) -> dict[str, float]:
    """Apply the detectors to compare with; above 0, a score is a detection."""
    import numpy as np

    from gyrostab.blindtest.scoring.baseline_detectors import (
        LEVEL,
        RANDOM,
        allan_detector,
        channel_detector,
    )
    from gyrostab.blindtest.scoring.stepwise import stepwise_detector
    from gyrostab.jobs import load_log

    if target.exists():
        stored: dict[str, float] = json.loads(target.read_text(encoding="utf-8"))
        if RANDOM in stored:  # earlier versions did not keep scores
            return stored
    log = load_log([recording]).compute()
    rng = np.random.default_rng(int(recording.stem[:7], 16))
    scores = {
        "Allan plot": allan_detector(np.asarray(log["rate"].values), truth, rng=rng),
        "correlation with channels": channel_detector(log),
        "stepwise regression": stepwise_detector(log),
        RANDOM: LEVEL - rng.random(),
    }
    write_json(target, scores)
    return scores


T = TypeVar("T")

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def run_in_processes(
    function: Callable[..., T],
    jobs: Sequence[tuple[Any, ...]],
    *,
    workers: int | None,
    report: Callable[[int], None] = lambda done: None,
) -> list[T]:
    """Call a module-level function with each of `jobs`; return the results in their order.

    There are as many processes as `workers`, by default one per core, and none for 0. `report`
    receives the number of finished jobs. If a process dies, a `WorkerError` is raised.

    Examples
    --------
    >>> run_in_processes(divmod, [(7, 2), (9, 4)], workers=0)
    [(3, 1), (2, 1)]
    """
    results: dict[int, T] = {}
    if workers == 0 or not jobs:
        for place, job in enumerate(jobs):
            results[place] = function(*job)
            report(len(results))
        return list(results.values())
    calls = [(_call_quietly, place, function, *job) for place, job in enumerate(jobs)]
    with _limit_threads(), open_pool("processes", workers=workers) as pool:
        try:
            for (_, place, *_), result in run_calls(pool, calls):
                results[place] = result
                report(len(results))
        except WorkerError as error:
            raise WorkerError(
                "a process that worked on a case has died, perhaps for want of memory; "
                "continue with --resume and fewer --workers"
            ) from error
    return [results[place] for place in range(len(jobs))]


@contextlib.contextmanager
def _limit_threads() -> Iterator[None]:
    """Limit libraries in processes started inside to one thread; they read this when loaded."""
    previous = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _call_quietly(place: int, function: Callable[..., T], *arguments: Any) -> T:
    """Call a function in one thread and without warnings; `place` numbers the call."""
    import dask

    with warnings.catch_warnings(), dask.config.set(scheduler="synchronous"):
        warnings.simplefilter("ignore")
        return function(*arguments)

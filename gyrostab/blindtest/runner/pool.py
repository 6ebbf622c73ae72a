"""Run jobs in single-threaded processes that end with their parent."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from gyrostab.errors import WorkerError
from gyrostab.jobs import open_pool, run_calls

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

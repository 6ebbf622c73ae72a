"""Run jobs in single-threaded processes that end with their parent."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import Any, TypeVar

from gyrostab.errors import WorkerError

T = TypeVar("T")

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def run_in_processes(
    function: Callable[..., T],
    jobs: Sequence[tuple[Any, ...]],
    *,
    workers: int,
    report: Callable[[int], None] | None = None,
) -> list[T]:
    """Call `function` with each of `jobs`, and return the results in the order of the jobs.

    Parameters
    ----------
    function : callable
        Module-level function.
    jobs : sequence of tuple
        Arguments of each call.
    workers : int
        Number of processes; 0 to work in this process.
    report : callable, optional
        Receives the number of finished jobs.

    Raises
    ------
    WorkerError
        When a process dies.

    Examples
    --------
    >>> run_in_processes(divmod, [(7, 2), (9, 4)], workers=0)
    [(3, 1), (2, 1)]
    """
    report = report or (lambda done: None)
    if workers == 0 or not jobs:
        done: list[T] = []
        for job in jobs:
            done.append(function(*job))
            report(len(done))
        return done
    with _limit_threads(), _open_executor(min(workers, len(jobs))) as executor:
        places = {executor.submit(function, *job): place for place, job in enumerate(jobs)}
        results: dict[int, T] = {}
        try:
            for future in as_completed(places):
                results[places[future]] = future.result()
                report(len(results))
        except BrokenProcessPool as error:
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


@contextlib.contextmanager
def _open_executor(workers: int) -> Iterator[ProcessPoolExecutor]:
    other_processes = set(multiprocessing.active_children())
    executor = ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_prepare_process
    )
    try:
        yield executor
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - other_processes:
            process.terminate()
        raise
    executor.shutdown()


def _prepare_process() -> None:
    """Prepare a process: leave Ctrl-C to its parent, end with it, and keep dask to one thread."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    warnings.simplefilter("ignore")
    import dask

    dask.config.set(scheduler="synchronous")


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)

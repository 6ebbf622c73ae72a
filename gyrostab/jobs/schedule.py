"""Pools of workers: threads, processes, or the workers of a dask.distributed scheduler."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from gyrostab.errors import GyrostabError, OptionError, WorkerError
from gyrostab.store.remote import full_name

_CONNECT_TIMEOUT_S = 20.0  # s, for a scheduler to answer and for a first worker to come
_NO_WORKER_TIMEOUT_S = 60.0  # s without any worker


class Pool(NamedTuple):
    """A pool of workers."""

    submit: Callable[..., Future[Any]]  # takes a function and its arguments
    width: Callable[[], int]  # number of calls that can run in parallel now
    remote: bool  # whether calls run in other processes, with pickled functions and arguments
    #: Replaces an argument of many calls by a reference, so that it is sent once.
    share: Callable[[Any], Any]


def check_scheduler(scheduler: str) -> str:
    """Check the name of a scheduler; add the protocol to an address without one.

    Examples
    --------
    >>> check_scheduler("cluster.example:8786")
    'tcp://cluster.example:8786'
    """
    if scheduler in ("threads", "processes") or "://" in scheduler:
        return scheduler
    if ":" in scheduler:
        return f"tcp://{scheduler}"
    raise OptionError(
        f"--scheduler {scheduler!r}: give threads, processes, "
        "or the address of a dask scheduler such as tcp://127.0.0.1:8786"
    )


def open_pool(
    scheduler: str, *, workers: int | None = None, files: Sequence[Path] = ()
) -> contextlib.AbstractContextManager[Pool]:
    """Open threads, processes, or a connection to a scheduler for the ``with`` block.

    Waiting calls are cancelled at the end of the block. An interruption ends processes at once.

    Parameters
    ----------
    scheduler : str
        From `check_scheduler`.
    workers : int, optional
        Number of threads or processes (default: one per core). Not used with a dask.distributed
        scheduler.
    files : sequence of Path
        Files that every worker of dask.distributed must see under the same name.

    Raises
    ------
    WorkerError
        When the scheduler does not answer, has no workers, or a worker lacks gyrostab or the files.
    OptionError
        When dask.distributed is not installed.
    """
    from dask.system import CPU_COUNT

    if scheduler == "threads":
        return _open_threads(workers or CPU_COUNT)
    if scheduler == "processes":
        return _open_processes(workers or CPU_COUNT)
    return _connect_cluster(scheduler, files)


@contextlib.contextmanager
def _open_threads(count: int) -> Iterator[Pool]:
    executor = ThreadPoolExecutor(count)
    try:
        yield Pool(executor.submit, lambda: count, False, _identity)
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _open_processes(count: int) -> Iterator[Pool]:
    """Open processes, which end when the block is interrupted or this process is killed."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    spawn = multiprocessing.get_context("spawn")
    watched_end, own_end = spawn.Pipe(duplex=False)
    executor = ProcessPoolExecutor(
        count, mp_context=spawn, initializer=_begin_process, initargs=(watched_end,)
    )
    try:
        submit: Any = executor.submit
        yield Pool(partial(submit, _call_with_warnings), lambda: count, True, _identity)
    except KeyboardInterrupt:
        own_end.close()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
        own_end.close()


def _begin_process(watched_end: Any) -> None:
    """Ignore Ctrl-C, which the parent handles, and end when its end of the pipe is closed."""
    import dask

    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_pipe() -> None:
        watched_end.poll(None)
        os._exit(1)

    threading.Thread(target=end_with_pipe, daemon=True).start()
    dask.config.set(num_workers=1)  # each process has one core
    # the parent opens the same files and shows the same warnings
    warnings.showwarning = lambda message, *_: None


class _ResultWithWarnings(NamedTuple):
    """Result and warnings of a call in another process."""

    result: Any
    notes: list[str]


def _call_with_warnings(function: Callable[..., Any], *arguments: Any) -> _ResultWithWarnings:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", UserWarning)
        result = function(*arguments)
    return _ResultWithWarnings(result, [str(item.message) for item in caught])


@contextlib.contextmanager
def _connect_cluster(address: str, files: Sequence[Path]) -> Iterator[Pool]:
    try:
        from distributed import Client
    except ImportError:
        advice = "install it with pip install 'gyrostab[distributed]'"
        raise OptionError(f"--scheduler {address}: this needs dask.distributed; {advice}") from None
    try:
        client = Client(address, timeout=_CONNECT_TIMEOUT_S, set_as_default=False, name="gyrostab")
    except (OSError, ValueError, TimeoutError) as error:
        raise WorkerError(
            f"--scheduler {address}: no dask scheduler answers there ({error}); "
            "start one with 'dask scheduler', or correct the address"
        ) from error
    with contextlib.closing(client):
        try:
            client.wait_for_workers(1, timeout=_CONNECT_TIMEOUT_S)
        except TimeoutError as error:
            raise WorkerError(
                f"--scheduler {address}: the scheduler has no workers; "
                f"start some with 'dask worker {address} --nthreads 1'"
            ) from error
        _check_workers(client, address, files)
        executor = client.get_executor(pure=False)
        try:
            reach = partial(_reach_scheduler, address)
            yield Pool(
                partial(reach, executor.submit),
                lambda: sum(reach(client.nthreads).values()),
                True,
                partial(reach, client.submit, _identity, pure=False),
            )
        finally:
            with contextlib.suppress(Exception):  # of a lost scheduler, which has been explained
                executor.shutdown(wait=False)


def _reach_scheduler(
    address: str, request: Callable[..., Any], *arguments: Any, **options: Any
) -> Any:
    """Call a scheduler; `WorkerError` for any exception, as distributed raises many kinds."""
    try:
        return request(*arguments, **options)
    except Exception as error:
        raise WorkerError(_describe_loss(address, error)) from error


def _describe_loss(address: str, error: BaseException) -> str:
    reason = " ".join(str(error).split()) or type(error).__name__
    scheduler = f"the dask scheduler {address}".strip()
    return f"{scheduler} has died or cannot be reached ({reason}); start it again"


def _identity(value: Any) -> Any:
    return value


def _check_workers(client: Any, address: str, files: Sequence[Path]) -> None:
    """Check that every worker has the same files and the same gyrostab."""
    sizes = {full_name(path): _find_size(path) for path in files}
    answers = _reach_scheduler(address, client.run, _inspect_files, list(sizes), on_error="return")
    from gyrostab import __version__

    for worker, answer in answers.items():
        if isinstance(answer, BaseException):
            raise WorkerError(
                f"--scheduler {address}: worker {worker} cannot run gyrostab "
                f"({type(answer).__name__}: {answer}); "
                f"install gyrostab {__version__} there too"
            )
        version, worker_sizes = answer
        if version != __version__:
            raise WorkerError(
                f"--scheduler {address}: worker {worker} has gyrostab {version}, "
                f"here it is {__version__}; install the same"
            )
        for path, size in sizes.items():
            if worker_sizes[path] != size:
                problem = (
                    "does not see"
                    if worker_sizes[path] is None
                    else "sees another file under the name of"
                )
                raise WorkerError(
                    f"--scheduler {address}: worker {worker} {problem} {path}; "
                    "all workers need the same file system under the same names"
                )


def _inspect_files(paths: Sequence[str]) -> tuple[str, dict[str, int | None]]:
    from gyrostab import __version__

    return __version__, {path: _find_size(path) for path in paths}


def _find_size(path: str | Path) -> int | None:
    """Find the size of a file; 0 for a folder; None when it does not exist."""
    try:
        return 0 if os.path.isdir(path) else os.stat(path).st_size
    except OSError:
        return None


def run_calls(
    pool: Pool, calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Run calls in parallel, and yield each with its result as it finishes.

    Only a few more calls are submitted than can run at a time.

    Raises
    ------
    WorkerError
        When the workers or the scheduler have died. Exceptions of a call are raised unchanged.
    """
    waiting: dict[Future[Any], tuple[Any, ...]] = {}
    remaining_calls = iter(calls)
    idle_since = time.monotonic()
    try:
        while True:
            max_waiting = 2 * pool.width() if pool.remote else pool.width() + 1
            for call in itertools.islice(remaining_calls, max(0, max_waiting - len(waiting))):
                waiting[pool.submit(*call)] = call
            if not waiting and max_waiting:
                return
            done, _ = wait(waiting, timeout=1.0, return_when=FIRST_COMPLETED)
            if done or pool.width():
                idle_since = time.monotonic()
            elif time.monotonic() - idle_since > _NO_WORKER_TIMEOUT_S:
                raise WorkerError(
                    f"the scheduler has had no worker for {_NO_WORKER_TIMEOUT_S:.0f} s; "
                    "start workers again"
                )
            for future in done:
                yield waiting.pop(future), _unpack_result(future)
    finally:
        for future in waiting:
            future.cancel()


def _unpack_result(future: Future[Any]) -> Any:
    try:
        outcome = future.result()
        if not isinstance(outcome, _ResultWithWarnings):
            return outcome
        for note in outcome.notes:
            warnings.warn(note, stacklevel=2)
        return outcome.result
    except GyrostabError:
        raise
    except BrokenProcessPool as error:
        raise WorkerError(
            "a worker process has died, perhaps for lack of memory; give fewer --workers"
        ) from error
    except CancelledError as error:
        raise WorkerError(_describe_loss("", error)) from error
    except Exception as error:
        if type(error).__name__ == "KilledWorker":
            raise WorkerError(
                f"the workers died repeatedly on the same part ({error}), perhaps for "
                "lack of memory"
            ) from error
        # not an error of the call, but of the connection
        if type(error).__module__.startswith("distributed."):
            raise WorkerError(_describe_loss("", error)) from error
        raise

"""Parallel work in a few threads, with results in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

#: Limit of the number of threads, for any number of cores.
MAX_WORKERS = 4

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_order(
    work: Callable[[Item], Result], items: Iterable[Item], *, workers: int | None = None
) -> Iterator[Result]:
    """Apply a function to items in several threads, and yield the results in order.

    Parameters
    ----------
    work : callable
        Function of one item. It should spend its time in code that releases the GIL.
    items : iterable
        Items, fetched in a separate thread, one ahead of the work.
    workers : int, optional
        Number of threads (default: ``num_workers`` of the configuration of dask, which the command
        option ``--workers`` sets, otherwise one per core; at most `MAX_WORKERS`).

    Examples
    --------
    >>> list(map_in_order(lambda n: n * n, range(5)))
    [0, 1, 4, 9, 16]
    """
    if workers is None:
        import dask
        from dask.system import CPU_COUNT

        workers = min(dask.config.get("num_workers", None) or CPU_COUNT, MAX_WORKERS)
    source = iter(items)
    nothing = object()
    with (
        ThreadPoolExecutor(1, thread_name_prefix="gyrostab-fetch") as fetcher,
        ThreadPoolExecutor(workers) as pool,
    ):
        waiting: deque[Future[Result]] = deque()
        try:
            following = fetcher.submit(next, source, nothing)
            while (item := following.result()) is not nothing:
                following = fetcher.submit(next, source, nothing)
                waiting.append(pool.submit(work, item))  # type: ignore[arg-type]
                if len(waiting) > workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()

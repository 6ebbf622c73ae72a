"""Work on many pieces in a few threads, results in the order of the pieces."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

__all__ = ["MAX_WORKERS", "map_in_order"]

#: Threads at most, however many cores there are.
MAX_WORKERS = 4

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_order(
    work: Callable[[Item], Result], items: Iterable[Item], *, workers: int | None = None
) -> Iterator[Result]:
    """Do the work on the items, a few at a time, and give the results in the order of the items.

    Parameters
    ----------
    work : callable
        Called in a thread with each item; it should spend its time where Python's lock is let go.
    items : iterable
        Fetched in a thread of its own, one ahead of the work.
    workers : int, optional
        Threads; one for each core by default, `MAX_WORKERS` at most.

    Examples
    --------
    >>> list(in_order(lambda n: n * n, range(5)))
    [0, 1, 4, 9, 16]
    """
    workers = workers or min(os.cpu_count() or 1, MAX_WORKERS)
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
            for one in waiting:
                one.cancel()

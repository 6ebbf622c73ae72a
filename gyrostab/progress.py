"""What a long command shows while it works: a bar on a terminal, one plain line elsewhere; always on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["Stage", "no_stage", "show_progress"]

#: Called as ``stage("computing", samples)`` when a stage begins; `samples` (over all axes) gives the rate.
Stage = Callable[[str, int], None]


def no_stage(label: str, samples: int = 0) -> None:
    """Show nothing."""


@contextmanager
def show_progress(*, quiet: bool = False) -> Iterator[Stage]:
    """Show the stages of the work inside the ``with`` block.

    Parameters
    ----------
    quiet : bool
        Show nothing at all.

    Yields
    ------
    Stage
        To be called with a label and the number of samples that the stage works through (0 when it has none).

    Examples
    --------
    >>> with show_progress(quiet=True) as stage:
    ...     stage("reading", 0)
    """
    if quiet:
        yield no_stage
    elif sys.stderr.isatty():
        with _bar() as stage:
            yield stage
    else:
        with _line() as stage:
            yield stage


@contextmanager
def _line() -> Iterator[Stage]:
    """One line when the work is done."""
    begun = since = time.perf_counter()
    current, worked = ("", 0), ""

    def stage(label: str, samples: int = 0) -> None:
        nonlocal since, current, worked
        now, (before, count) = time.perf_counter(), current
        if count:
            seconds = max(now - since, 1e-9)
            worked = f" ({before}: {count:,} samples in {seconds:.1f} s, {count / seconds / 1e6:.2f} Msamples/s)"
        since, current = now, (label, samples)

    yield stage
    stage("", 0)
    print(f"done in {time.perf_counter() - begun:.1f} s{worked}", file=sys.stderr)


@contextmanager
def _bar() -> Iterator[Stage]:
    """One bar per stage, moved by the tasks that dask finishes."""
    from dask.callbacks import Callback
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        now: dict[str, Any] = {"task": None, "samples": 0, "total": 0, "done": 0, "begun": 0.0}

        def finish() -> None:
            if now["task"] is not None:
                progress.update(now["task"], total=1.0, completed=1.0)

        def stage(label: str, samples: int = 0) -> None:
            finish()
            task = progress.add_task(f"{label:<10}", total=None, speed="")
            now.update(task=task, samples=samples, total=0, done=0, begun=time.perf_counter())

        def start(graph: Any, state: dict[str, Any]) -> None:
            now["total"] += len(state["waiting"]) + len(state["ready"])

        def after(key: Any, result: Any, graph: Any, state: Any, worker: Any) -> None:
            now["done"] += 1
            if now["task"] is None or not now["total"]:
                return
            share = min(now["done"] / now["total"], 1.0)
            seconds = time.perf_counter() - now["begun"]
            speed = f"{share * now['samples'] / seconds / 1e6:.1f} Msamples/s" if now["samples"] and seconds > 0 else ""
            progress.update(now["task"], total=1.0, completed=share, speed=speed)

        with Callback(start_state=start, posttask=after):
            yield stage
        finish()

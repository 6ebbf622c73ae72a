"""Progress of long commands on stderr: bars on a terminal, a plain line per stage elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from gyrostab.time.durations import format_duration

#: Time between two lines of progress away from a terminal [s].
_LINE_INTERVAL_S = 60.0
_COMPILING = "compiling, once after installation"
#: Events of numba: it compiles, or `gyrostab.kernels.compile_ahead` waits for another process.
_COMPILER_EVENTS = ("numba:compile", "gyrostab:compile")


class Stage(Protocol):
    """Callback for the progress of a long function."""

    def __call__(
        self, label: str, total: int = 0, done: int | None = None, unit: str = "samples"
    ) -> None:
        """Begin a stage (a new label), or report how much of it is done.

        Parameters
        ----------
        total : int
            Amount of work: samples over all axes, files, ...; 0 when unknown.
        done : int, optional
            Amount that is done.
        """


def no_stage(label: str, total: int = 0, done: int | None = None, unit: str = "samples") -> None:
    """Show nothing."""


@contextmanager
def show_progress(*, quiet: bool = False) -> Iterator[Stage]:
    """Show the stages of the work inside the ``with`` block.

    Yields
    ------
    Stage
        Function to call with a label and the number of samples of the stage (0 without any).

    Examples
    --------
    >>> with show_progress(quiet=True) as stage:
    ...     stage("reading", 12, 3, "files")
    """
    if quiet:
        yield no_stage
    else:
        with _show_bar() if sys.stderr.isatty() else _show_lines() as stage:
            yield stage


@contextmanager
def watch_compiler(show: Callable[[bool], None]) -> Iterator[Callable[[], None]]:
    """Call `show` when numba starts to compile, here or in another process, and when it ends.

    Yields
    ------
    callable
        Function to call at every stage; it begins to watch once numba is imported, which takes too
        long for commands that do not need it.
    """
    installed: list[Any] = []

    def watch() -> None:
        if installed or "numba.core.event" not in sys.modules:
            return
        from numba.core import event

        class Compiler(event.Listener):  # type: ignore[misc]
            depth = 0

            def on_start(self, _: Any) -> None:
                self.depth += 1
                if self.depth == 1:
                    show(True)

            def on_end(self, _: Any) -> None:
                self.depth -= 1
                if self.depth == 0:
                    show(False)

        installed.append(Compiler())
        for kind in _COMPILER_EVENTS:
            event.register(kind, installed[0])

    try:
        yield watch
    finally:
        if installed:
            from numba.core import event

            for kind in _COMPILER_EVENTS:
                event.unregister(kind, installed[0])


def follow_share(stage: Stage, label: str, total: int) -> Callable[[float], None]:
    """Begin a stage of so many samples; return a function that reports the share that is done."""
    stage(label, total)
    return lambda share: stage(label, total, round(share * total))


def _format_speed(samples: float, seconds: float) -> str:
    return f"{samples / seconds / 1e6:.2f} Msamples/s" if seconds > 0 else ""


@contextmanager
def _show_lines() -> Iterator[Stage]:
    """Show a line at the beginning of each stage, one per minute within it, and one at the end."""
    begun = since = printed = time.perf_counter()
    current, first, amount, worked = "", 0, 0, ""
    announced = False

    def announce(begins: bool) -> None:
        nonlocal announced
        if begins and not announced:
            announced = True
            print(f"{_COMPILING} ...", file=sys.stderr, flush=True)

    def stage(label: str, total: int = 0, done: int | None = None, unit: str = "samples") -> None:
        nonlocal since, printed, current, first, amount, worked
        now = time.perf_counter()
        watch()
        if label != current:
            if label:
                print(f"{label} ...", file=sys.stderr, flush=True)
            if amount:
                seconds = max(now - since, 1e-9)
                speed = _format_speed(amount, seconds)
                worked = f" ({current}: {amount:,} samples in {seconds:.1f} s, {speed})"
            since, printed, current, first, amount = now, now, label, done or 0, 0
        if done is not None and first < done and now - printed > _LINE_INTERVAL_S:
            printed = now
            left = format_duration(round((now - since) / (done - first) * (total - done)), " ")
            print(f"{label} {done:,} of {total:,} {unit}, {left} left", file=sys.stderr, flush=True)
        if unit == "samples":
            amount = total - first  # without what an earlier run has done

    with watch_compiler(announce) as watch:
        yield stage
    stage("", 0)
    print(f"done in {time.perf_counter() - begun:.1f} s{worked}", file=sys.stderr)


@contextmanager
def _show_bar() -> Iterator[Stage]:
    """Show one bar per stage, with throughput and the time left."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskID,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    current, begun = "", 0.0
    first: int | None = None
    task: TaskID | None = None

    def finish() -> None:
        if task is not None:
            progress.update(task, total=1.0, completed=1.0)

    def announce(begins: bool) -> None:
        progress.update(task or TaskID(0), speed=_COMPILING if begins else "")

    def stage(label: str, total: int = 0, done: int | None = None, unit: str = "samples") -> None:
        nonlocal current, begun, first, task
        watch()
        if label != current:
            finish()
            task = progress.add_task(f"{label:<10}", total=None, speed="") if label else None
            current, begun, first = label, time.perf_counter(), done
        if done is not None and total and task is not None:
            first = done if first is None else first
            speed = f"{unit[:-1]} {done} of {total}"
            if unit == "samples":
                speed = _format_speed(done - first, time.perf_counter() - begun)
            progress.update(task, total=1.0, completed=done / total, speed=speed)

    with Progress(*columns, console=Console(stderr=True)) as progress:
        with watch_compiler(announce) as watch:
            yield stage
        finish()

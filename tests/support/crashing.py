"""Kill and continue runs many times in a forked process, which imports and compiles only once.

python -m tests.support.crashing FOLDER LOG SEED CALLS KILLS

prints, as JSON, what became of kills before calls that change the disk (so many of them, drawn at
random; 0 for every one), and of kills at random moments. The runs make a surface without a fit,
which takes the same way and less time.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

CALLS = ("replace", "rename", "fsync", "unlink", "rmdir", "mkdir")
WINDOW = {"window": "4000samples", "step": "4000samples", "taus": "12"}
#: The same on the command line, without progress.
WINDOW_OPTIONS = (
    *(word for name, value in WINDOW.items() for word in (f"--{name}", value)),
    "--quiet-progress",
)


def small_parts() -> None:
    """Make parts of one unit of work, as a long log would be cut into many."""
    from gyrostab.allan.davar import davar_parts

    davar_parts.__kwdefaults__["samples"] = 1


def make(log: Path, output: Path, **options: object) -> None:
    from gyrostab.jobs.run import run

    run([log], output, windows=WINDOW, workers=2, surface_only=True, **options)


def forked(action: Callable[[], object], *, after: float | None = None) -> int:
    """Run in a child process, killed after some seconds; return the exit status (< 0: signal)."""
    child = os.fork()
    if child == 0:
        try:
            action()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    if after is not None:
        time.sleep(after)
        os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def armed(number: int, count_file: Path) -> Callable[[], None]:
    """Kill this process before its call `number` that changes the disk; write the count."""
    count = 0

    def arm() -> None:
        for name in CALLS:
            setattr(os, name, wrapped(getattr(os, name)))

    def wrapped(function: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: object, **options: object) -> object:
            nonlocal count
            if count == number:
                os.kill(os.getpid(), signal.SIGKILL)
            count += 1
            count_file.write_text(str(count))
            return function(*arguments, **options)

        return call

    return arm


def main(folder: Path, log: Path, seed: int, points: int, kills: int) -> dict[str, object]:
    small_parts()
    make(log, folder / "whole.nc")
    begun = time.perf_counter()
    make(log, folder / "whole.nc", overwrite=True)
    seconds = time.perf_counter() - begun
    whole = (folder / "whole.nc").read_bytes()
    wrong: list[str] = []

    def outcome(output: Path, case: str) -> None:
        status = forked(lambda: make(log, output, resume=True))
        if status or output.read_bytes() != whole:
            wrong.append(
                f"{case}: exit {status}, {'another product' if output.exists() else 'no product'}"
            )
        left = [
            path.name for path in folder.iterdir() if output.name in path.name and path != output
        ]
        if left:
            wrong.append(f"{case}: left {left}")

    def killed_before(number: int, output: Path) -> bool:
        def doomed() -> None:
            armed(number, folder / "count")()
            make(log, output)

        return forked(doomed) == -signal.SIGKILL

    killed_before(10**9, folder / "counted.nc")
    calls = int((folder / "count").read_text())
    draw, landed = random.Random(seed), 0
    for number in sorted(draw.sample(range(calls), points) if points else range(calls)):
        output = folder / f"call{number}.nc"
        landed += killed_before(number, output)
        outcome(output, f"killed before call {number}")

    for kill in range(kills):
        output = folder / f"kill{kill % 3}.nc"  # the same output is killed again and again
        moment = draw.uniform(0.0, 1.05 * seconds)
        is_begun = output.with_name(f".{output.name}.job").exists()
        if output.exists():
            output.unlink()
        landed += (
            forked(
                lambda output=output, is_begun=is_begun: make(log, output, resume=is_begun),
                after=moment,
            )
            == -signal.SIGKILL
        )
        if kill % 3 != 1:
            outcome(output, f"killed after {moment:.3f} s")
    return {"calls": calls, "kills": landed, "seconds": seconds, "wrong": wrong}


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))))

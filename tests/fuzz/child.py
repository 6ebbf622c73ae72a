"""Serve many calls of the command line in one process, so that nothing is loaded twice.

Each line of its standard input is the arguments of a call as JSON; each line of its answer says
what became of it. It shares the limits of memory and time with nobody: its parent stops and
replaces it.
"""

from __future__ import annotations

import contextlib
import faulthandler
import io
import json
import os
import resource
import shutil
import sys
import time
import traceback
from pathlib import Path
from typing import Any

#: Address space that a call may take in addition to the loaded program [bytes].
SPACE_BYTES = 3 * 2**29


def innermost_is_ours(error: BaseException, package: str) -> bool:
    """Return whether gyrostab itself raised an exception, not a library that it called."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and frames[-1].filename.startswith(package)


def own_fault(error: BaseException | None, package: str) -> str:
    """Return where our own code raised an error reported as a damaged file, or ""."""
    from gyrostab.errors import DamageError
    from gyrostab.store.layout import ChunkDamage

    while error is not None:
        cause = error.__cause__
        if (
            isinstance(error, DamageError)
            and cause is not None
            and not isinstance(
                cause, MemoryError | SystemError | ChunkDamage
            )  # a SystemError comes out of compiled code
            and innermost_is_ours(cause, package)
        ):
            last = traceback.extract_tb(cause.__traceback__)[-1]
            return f"{type(cause).__name__} at {Path(last.filename).name}:{last.name}: {cause}"
        error = cause
    return ""


def unexpected(error: BaseException | None) -> str:
    """Return the last frames of an error with exit code 1."""
    if error is None:
        return ""
    frames = [
        f"{Path(frame.filename).name}:{frame.name}:{frame.lineno}"
        for frame in traceback.extract_tb(error.__traceback__)[-3:]
    ]
    return f"{type(error).__name__}: {str(error)[:200]} ({' > '.join(frames)})"


def peak_bytes(*, reset: bool = False) -> int:
    """Return the largest resident memory since the last reset [bytes]."""
    if reset:
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
        return 0
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def space_bytes() -> int:
    """Return the address space in use [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def call(arguments: list[str], state: dict[str, Any]) -> dict[str, Any]:
    """Run the command line once."""
    from gyrostab import cli

    state["error"] = None
    out, err = io.StringIO(), io.StringIO()
    peak_bytes(reset=True)
    before = peak_bytes()
    begun, worked = time.perf_counter(), time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code: int | str = cli.main(arguments)
        except BaseException as error:
            code, state["error"] = "traceback", error
    seconds = time.perf_counter() - begun
    text = err.getvalue()
    error = state["error"]
    package = str(Path(cli.__file__).parent.parent)
    return {
        "code": "traceback" if "Traceback (most recent" in text else code,
        "seconds": seconds,
        "worked": time.process_time() - worked,
        "bytes": max(0, peak_bytes() - before),
        "fault": own_fault(error, package)
        or (unexpected(error) if code in (1, "traceback") else ""),
        "said": text[-400:],
    }


def serve() -> None:
    """Answer requests until the input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    faulthandler.enable(open(sys.argv[1], "w"))  # noqa: SIM115
    os.fsync = lambda handle: None  # the disk is not under test
    from gyrostab import cli

    state: dict[str, Any] = {"error": None}
    describe_error = cli.describe_error

    def spy(error: Exception) -> int:
        state["error"] = error
        return describe_error(error)

    cli.describe_error = spy
    warm = json.loads(sys.stdin.readline())
    for arguments in warm:
        call(arguments, state)
    limit = space_bytes() + SPACE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    print(json.dumps({"ready": True}), file=answers)
    for line in sys.stdin:
        print(json.dumps(call(json.loads(line), state)), file=answers)
    shutil.rmtree(Path(sys.argv[1]).parent, ignore_errors=True)  # the parent has gone


if __name__ == "__main__":
    serve()

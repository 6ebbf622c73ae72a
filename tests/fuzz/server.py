"""Start `tests.fuzz.child`, send it calls, and replace it when it hangs, crashes or is old."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.seeds import CHANGED_NS, FOLDER, WINDOWS, move_job, text_seeds

#: A log on which the kernels for windows with gaps are compiled before the time is measured.
_LOG_WITH_GAPS = b"time [ms],gyro_x [deg/h]\n" + b"".join(
    b"%d,%d\n" % (1_000_000 * min(row, 25) + 7 * max(row - 25, 0), row % 3) for row in range(63)
)
#: Limit of processor time [s]; the limit of elapsed time is `PATIENCE` times as much.
LIMIT_SECONDS = 20.0
PATIENCE = 6
LIMIT_BYTES = 2**30
#: Calls after which a child is replaced, so that memory kept by libraries does not accumulate.
CALLS = 4000
#: The windows of the harness are a second apart; a gap of days, easily made by a damaged stamp,
#: would contain a million of them.
MAX_GAP = ("--max-gap", "1h")


@dataclass(frozen=True)
class Outcome:
    """Result for one input."""

    code: int | str  # exit code, "signal 11", "hang", "memory", "traceback", "own fault"
    seconds: float
    worked: float  # seconds of the processor
    bytes: int
    text: str

    def is_right(self, *, may_be_interrupted: bool = False) -> bool:
        """Return whether the contract allows the exit code here."""
        return self.code in ((0, 2, 3) if may_be_interrupted else (0, 2))


class Server:
    """A child that answers calls of the command line."""

    def __init__(self) -> None:
        self.folder = Path(
            tempfile.mkdtemp(
                prefix="gyrostab-fuzz-", dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None
            )
        )
        self.child: subprocess.Popen[bytes] | None = None
        self.calls = 0
        self.number = 0

    def close(self) -> None:
        """Stop the child and remove its files."""
        import shutil

        self._stop()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _stop(self) -> None:
        if self.child is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.child.pid, signal.SIGKILL)
            self.child.wait()
            self.child = None

    def _start(self) -> None:
        threads = ("OMP", "NUMBA", "OPENBLAS", "MKL", "NUMEXPR", "BLOSC")
        environment = {
            **os.environ,
            **{f"{name}_NUM_THREADS": "1" for name in threads},
            "MALLOC_ARENA_MAX": "2",
            "PYTHONHASHSEED": "0",
        }
        self.child = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-m", "tests.fuzz.child", str(self.folder / "crash")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,
            cwd=Path(__file__).parents[2],
        )
        warm = self.folder / "warm"
        warm.mkdir(exist_ok=True)
        calls = []
        for number, seed in enumerate(text_seeds()):
            place = warm / f"{number}-{seed.main}"
            place.write_bytes(seed.files[seed.main])
            calls.append(["scan", str(place), *seed.options])
            calls.append(
                [
                    "run",
                    str(place),
                    "-o",
                    str(warm / "warm.nc"),
                    "--overwrite",
                    *WINDOWS,
                    *seed.options,
                ]
            )
        gaps = warm / "gaps.csv"
        gaps.write_bytes(_LOG_WITH_GAPS)
        calls.append(["run", str(gaps), "-o", str(warm / "warm.nc"), "--overwrite"])
        self.calls = 0
        if self._ask(calls, 300.0) is None:
            raise RuntimeError("the child does not start")

    def _ask(self, request: object, seconds: float) -> dict | None:
        """Return the answer, or None if it does not come in time."""
        assert self.child is not None
        assert self.child.stdin is not None
        assert self.child.stdout is not None
        try:
            self.child.stdin.write(json.dumps(request).encode() + b"\n")
            self.child.stdin.flush()
        except BrokenPipeError:
            return None
        begun, ready = self._worked(), []
        for _ in range(int(4 * PATIENCE)):  # on a busy machine the child gets little processor time
            ready, _, _ = select.select([self.child.stdout], [], [], seconds / 4)
            if ready or self._worked() - begun > seconds:
                break
        line = self.child.stdout.readline() if ready else b""
        return json.loads(line) if line.endswith(b"\n") else None

    def _worked(self) -> float:
        """Return the processor time of the child [s], or elapsed time if that is unavailable."""
        assert self.child is not None
        try:
            fields = Path(f"/proc/{self.child.pid}/stat").read_text().rpartition(")")[2].split()
            return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        except OSError:
            return time.monotonic()

    def call(self, arguments: Sequence[str]) -> Outcome:
        """Run the command line in the child."""
        if self.child is not None and self.calls >= CALLS:
            self._stop()
        if self.child is None:
            self._start()
        assert self.child is not None
        self.calls += 1
        answer = self._ask(list(arguments), LIMIT_SECONDS)
        if answer is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.child.wait(0.5)
            status = self.child.poll()
            self._stop()
            cause = (
                "hang"
                if status is None
                else f"signal {-status}"
                if status < 0
                else f"exit {status}"
            )
            crash = (self.folder / "crash").read_text()[:600]
            return Outcome(
                cause,
                LIMIT_SECONDS if status is None else 0.0,
                LIMIT_SECONDS if status is None else 0.0,
                0,
                crash,
            )
        if answer["bytes"] > LIMIT_BYTES:
            self._stop()
            return Outcome(
                "memory", answer["seconds"], answer["worked"], answer["bytes"], answer["said"]
            )
        ours = answer["fault"] and answer["code"] == 2
        code = "own fault" if ours else answer["code"]
        return Outcome(
            code,
            answer["seconds"],
            answer["worked"],
            answer["bytes"],
            answer["fault"] or answer["said"],
        )

    @contextlib.contextmanager
    def written(self, files: dict[str, bytes]) -> Iterator[Path]:
        """Write the files of an input to a new folder, which is removed afterwards."""
        import shutil

        self.number += 1
        place = self.folder / str(self.number)
        for name, data in files.items():
            path = place / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(
                move_job(data, FOLDER, str(place)) if name.endswith("job.json") else data
            )
            os.utime(path, ns=(CHANGED_NS, CHANGED_NS))
        try:
            yield place
        finally:
            shutil.rmtree(place, ignore_errors=True)

    def try_input(
        self, files: dict[str, bytes], command: str, main: str, options: Sequence[str] = ()
    ) -> Outcome:
        """Pass an input to a command."""
        with self.written(files) as place:
            return self.call(arguments_of(command, place, main, options))


def arguments_of(command: str, place: Path, main: str, options: Sequence[str]) -> list[str]:
    """Return the command line for an input in `place`."""
    path, output = str(place / main), str(place / "out.nc")
    given = [option.replace(FOLDER, str(place)) for option in options]
    if command == "scan":
        return ["scan", path, *given]
    if command in ("ingest", "simulate"):
        gap = (
            MAX_GAP
            if command == "ingest" and not any("max-gap" in option for option in given)
            else ()
        )
        return [command, path, "-o", output, "--quiet-progress", *given, *gap]
    if command == "davar":
        return ["davar", path, "-o", output, "--quiet-progress", "--workers", "1", *WINDOWS]
    resume = ["--resume"] if command == "resume" else []
    windows = [] if "--config" in given else WINDOWS
    gap = () if any("max-gap" in option for option in given) or resume else MAX_GAP
    return [
        "run",
        path,
        "-o",
        output,
        "--quiet-progress",
        "--workers",
        "1",
        *windows,
        *given,
        *gap,
        *resume,
    ]

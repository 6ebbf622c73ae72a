"""Kill, damage, starve and disturb the commands that write, and count the losses.

    python benchmarks/durability.py --output docs/durability.md

Every trial is a child of this process, which has loaded and compiled all that it needs. A kill is
SIGKILL, also of worker processes, at a moment drawn evenly over the time that an undisturbed
command takes. The log is short; `gyrostab run` cuts it into parts of one unit of work, and stores
each at once, so that it has as many as a long log. Needs root, for the full disk and the locked
folder.
"""

from __future__ import annotations

import contextlib
import io
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from page import make_parser, renew, table

QUIET = "--quiet-progress"
WINDOW = ("--window", "4000samples", "--step", "4000samples", "--taus", "12", "--workers", "1")
DIAGNOSE = ("--nulls", "100", "--seed", "1", "--workers", "1")
PROCESSES = ("--scheduler", "processes")
COMMANDS = {
    "run": (["run", "log.nc", *WINDOW, QUIET], "product.nc"),
    "ingest": (["ingest", "log.csv", QUIET], "log.nc"),
    "diagnose": (["diagnose", "short.nc", *DIAGNOSE, QUIET], "found"),
}


class Outcome(NamedTuple):
    """How a child ended: its exit code, negative for a signal, and what it wrote to stderr."""

    code: int
    message: str


class Trials:
    """Counts of the trials of one kind."""

    def __init__(self, action: str, expected: str):
        self.what, self.expected, self.count, self.wrong = action, expected, 0, list[str]()

    def add(self, good: bool, detail: str = "") -> None:
        self.count += 1
        if not good:
            self.wrong.append(detail)

    def row(self) -> list[object]:
        return [self.what, self.count, self.expected, self.count - len(self.wrong)]


def write_inputs(folder: Path) -> None:
    """Write logs: one axis at 100 Hz, the same as text, and ten minutes at 10 Hz."""
    from gyrostab import make_log, to_netcdf

    rng = np.random.default_rng(3)
    rate = 5.0 + rng.standard_normal((1, 1_270_000))
    rate[:, 400_000:405_000] = np.nan
    to_netcdf(make_log(rate, rate=100.0, unit="deg/h", start="2026-05-01"), folder / "log.nc")
    to_netcdf(
        make_log(rng.standard_normal((1, 6000)), rate=10.0, unit="deg/h", start="2026-05-01"),
        folder / "short.nc",
    )
    rows = "\n".join(
        f"{i / 100:.2f},{value:.4f}" for i, value in enumerate(rate[0, 500_000:800_000])
    )
    (folder / "log.csv").write_text(f"time [s],gyro_x [deg/h]\n{rows}\n")


def begin(*arguments: object, before: Callable[[], object] | None = None) -> tuple[int, Path]:
    """Start a command in a separate process group; return its process and its stderr file."""
    import dask.threaded

    from gyrostab.cli import main

    handle, name = tempfile.mkstemp()
    child = os.fork()
    if child == 0:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(handle, 2)
        code = 1
        try:
            dask.threaded.default_pool = None  # its threads are those of the parent
            dask.threaded.pools.clear()
            if before is not None:
                before()
            code = main([str(argument) for argument in arguments])
        finally:
            sys.stderr.flush()
            os._exit(code)
    os.close(handle)
    return child, Path(name)


def finish(begun: tuple[int, Path]) -> Outcome:
    """Wait for a command."""
    child, output = begun
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    message = output.read_text(errors="replace")
    output.unlink()
    return Outcome(code, message)


def call(*arguments: object, before: Callable[[], object] | None = None) -> Outcome:
    return finish(begin(*arguments, before=before))


def read_tree(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def is_hidden(name: str) -> bool:
    """Whether what lies next to an output is a leftover or the folder of a run."""
    from gyrostab.store.output import is_leftover

    return is_leftover(name) or name.endswith(".job")


class Bench:
    """The inputs, undisturbed outputs, and how long they took."""

    def __init__(self, folder: Path, seed: int):
        from gyrostab.cli import main

        self.inputs, self.folder = folder / "inputs", folder / "trials"
        self.draw, self.reused = random.Random(seed), 0
        self.inputs.mkdir()
        self.folder.mkdir()
        write_inputs(self.inputs)
        self.commands, self.whole, self.seconds = {}, {}, {}
        for name, ((word, log, *options), output) in COMMANDS.items():
            command = [word, self.inputs / log, *options]
            self.commands[name] = command, output
            with contextlib.redirect_stdout(io.StringIO()):  # loads and compiles
                first = folder / f"first-{name}{Path(output).suffix}"
                assert main([*map(str, command), "-o", str(first)]) == 0
            begun = time.perf_counter()
            outcome = call(*command, "-o", folder / f"{name}-{output}")
            self.seconds[name] = time.perf_counter() - begun
            assert outcome.code == 0, outcome.message
            self.whole[name] = self.content(name, folder / f"{name}-{output}")
        begun = time.perf_counter()
        assert call(*self.commands["run"][0], *PROCESSES, "-o", folder / "processes.nc").code == 0
        self.seconds["processes"] = time.perf_counter() - begun

    def content(self, name: str, output: Path) -> object:
        """Return what is compared of an output: all bytes, but of a diagnosis only its content."""
        if not os.path.lexists(output):
            return None
        if name != "diagnose":
            return output.read_bytes()
        import json

        diagnosis = json.loads((output / "diagnosis.json").read_text())
        diagnosis.pop("seconds")
        return (
            json.dumps(diagnosis),
            (output / "model.toml").read_text(),
            sorted(path.name for path in output.iterdir()),
        )

    @contextlib.contextmanager
    def trial(self) -> Iterator[Path]:
        folder = Path(tempfile.mkdtemp(dir=self.folder))
        yield folder
        shutil.rmtree(folder)

    def kill(self, name: str, kills: int) -> Trials:
        """Kill a command at random moments; then let it finish, and compare.

        Two of three runs are killed again when they continue; one in three has worker processes.
        """
        command, output = self.commands[name]
        after_kill = " with `--resume`" if name == "run" else ""
        trials = Trials(
            f"`kill -9` of `{name}` at random moments, then the same command{after_kill}",
            "no output or the whole one after the kill, inputs unchanged, the same output in the "
            "end",
        )
        inputs = read_tree(self.inputs)
        while trials.count < kills:
            seconds, options, flags = self.seconds[name], (), []
            if name == "run":
                flags = ["--resume"]
                if trials.count % 3 == 2:
                    seconds, options = self.seconds["processes"], PROCESSES
            with self.trial() as folder:
                target = folder / output
                for _ in range(1 + trials.count % 3 if name == "run" else 1):
                    begun = begin(*command, "-o", target, *options, *flags)
                    time.sleep(self.draw.uniform(0.0, seconds))
                    with contextlib.suppress(ProcessLookupError):
                        os.killpg(begun[0], signal.SIGKILL)
                    is_killed = finish(begun).code == -signal.SIGKILL
                    if not is_killed:
                        break
                if not is_killed:
                    continue  # it was faster
                self.reused += len(list(folder.glob(".*.job/*.block")))
                after = self.content(name, target)
                names = {item.name for item in folder.iterdir()} - {output}
                strange = [item for item in names if not is_hidden(item)]
                if after is not None and name != "run":
                    flags = ["--overwrite"]
                outcome = call(*command, "-o", target, *options, *flags)
                trials.add(
                    after in (None, self.whole[name])
                    and not strange
                    and read_tree(self.inputs) == inputs
                    and outcome.code == 0
                    and self.content(name, target) == self.whole[name]
                    and (name != "run" or len(list(folder.iterdir())) == 1),
                    f"{name}: left {strange}, {outcome}",
                )
        return trials

    def interrupted_run(self, folder: Path, parts: int = 3) -> Path:
        """A run that is killed once some of its parts are on the disk."""
        target = folder / "product.nc"

        def arm() -> None:
            from gyrostab.jobs import checkpoint, engine

            done = []

            def write(*arguments: object, **options: object) -> object:
                if len(done) == parts:
                    os.kill(os.getpid(), signal.SIGKILL)
                done.append(checkpoint.write_block(*arguments, **options))
                return done[-1]

            engine.write_block = write

        outcome = call(*self.commands["run"][0], "-o", target, before=arm)
        assert outcome.code == -signal.SIGKILL, outcome
        return target

    def damage(self, count: int) -> list[Trials]:
        """Cut or flip the files of a killed run, and continue it."""
        kinds = []
        for fault in ("cut short", "with one bit flipped"):
            trials = Trials(
                f"a file of a killed run {fault}, then `--resume`", "the same product, bit for bit"
            )
            for _ in range(count):
                with self.trial() as folder:
                    target = self.interrupted_run(folder)
                    path = self.draw.choice(sorted(folder.glob(".product.nc.job/*[!k]")))
                    content = bytearray(path.read_bytes())
                    place = self.draw.randrange(len(content))
                    if fault == "cut short":
                        del content[place:]
                    else:
                        content[place] ^= 1 << self.draw.randrange(8)
                    path.write_bytes(content)
                    outcome = call(*self.commands["run"][0], "-o", target, "--resume")
                    trials.add(
                        outcome.code == 0 and target.read_bytes() == self.whole["run"],
                        f"{path.name} {fault}: {outcome}",
                    )
            kinds.append(trials)
        return kinds

    def full_disk(self, count: int) -> Trials:
        """Write to a full file system, a small tmpfs."""
        mount = self.folder / "small"
        mount.mkdir()
        trials = Trials(
            "disk full (tmpfs of random size), `run` and `ingest`",
            "exit code 2, one message, no output, the old output unchanged",
        )
        for number in range(count):
            name = ("run", "ingest")[number % 2]
            command, output = self.commands[name]
            room = int(len(self.whole[name]) * self.draw.uniform(0.1, 0.9)) // 4096 * 4096 + 4096
            subprocess.run(
                ["mount", "-t", "tmpfs", "-o", f"size={room}", "tmpfs", mount], check=True
            )
            old, has_old = mount / output, number % 4 > 1
            if has_old:
                old.write_text("old")
            outcome = call(*command, "-o", old, "--overwrite")
            is_kept = old.read_text() == "old" if has_old else not old.exists()
            names = {item.name for item in mount.iterdir()} - {output}
            left = [name for name in names if not name.endswith(".job")]
            lines = [line for line in outcome.message.splitlines() if not line.startswith("note: ")]
            trials.add(
                outcome.code == 2
                and is_kept
                and not left
                and len(lines) == 1
                and "cannot be written" in outcome.message,
                f"{name}: {left}, {outcome}",
            )
            subprocess.run(["umount", mount], check=True)
        return trials

    def read_only(self) -> Trials:
        """Write, as another user, into a folder without permission."""
        trials = Trials(
            "output in a folder without permission to write",
            "exit code 2, one message, nothing written",
        )
        for name, (command, output) in self.commands.items():
            with self.trial() as folder:
                locked = folder / "locked"
                locked.mkdir(mode=0o555)
                self.folder.parent.chmod(0o755), self.folder.chmod(0o755), folder.chmod(0o755)
                outcome = call(*command, "-o", locked / output, before=lambda: os.seteuid(65534))
                trials.add(
                    outcome.code == 2 and not list(locked.iterdir()),
                    f"{name}: {outcome}",
                )
        return trials

    def changed_input(self, count: int) -> list[Trials]:
        """Change or remove the input of a command while it works."""
        kinds = []
        for change in ("changes", "vanishes"):
            trials = Trials(
                f"an input that {change} during `run` or `ingest`",
                "exit code 2 and no output, or the whole output of the old input",
            )
            for number in range(count):
                name = ("run", "ingest")[number % 2]
                command, output = self.commands[name]
                with self.trial() as folder:
                    own = folder / Path(command[1]).name
                    shutil.copy2(command[1], own)
                    begun = begin(command[0], own, *command[2:], "-o", folder / output)
                    time.sleep(self.draw.uniform(0.2, 0.8) * self.seconds[name])
                    if change == "vanishes":
                        own.unlink()
                    else:
                        with own.open("r+b") as file:
                            file.seek(own.stat().st_size // 2)
                            file.write(b"9" * 64)
                    outcome = finish(begun)
                    content = self.content(name, folder / output)
                    good = (outcome.code == 2 and content is None) or (
                        outcome.code == 0 and content == self.whole[name]
                    )
                    trials.add(
                        good and "please report" not in outcome.message,
                        f"{name}, {change}: {outcome}",
                    )
            kinds.append(trials)
        return kinds

    def two_at_once(self, count: int) -> list[Trials]:
        """Begin the same command twice for one output."""
        kinds = []
        for name in ("run", "ingest"):
            command, output = self.commands[name]
            trials = Trials(
                f"two `{name}` of one output at once",
                "one is done, the other refused (exit code 2), one whole output",
            )
            for _ in range(count):
                with self.trial() as folder:
                    begun = [begin(*command, "-o", folder / output)]
                    time.sleep(self.draw.uniform(0.0, 0.5) * self.seconds[name])
                    begun.append(begin(*command, "-o", folder / output))
                    outcomes = [finish(process) for process in begun]
                    left = [item.name for item in folder.iterdir()]
                    codes = sorted(outcome.code for outcome in outcomes)
                    good = (
                        codes == [0, 2]
                        and left == [output]
                        and self.content(name, folder / output) == self.whole[name]
                    )
                    trials.add(good, f"{name}: {left}, {outcomes}")
            kinds.append(trials)
        return kinds


def main() -> int:
    parser = make_parser(__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    os.environ["SOURCE_DATE_EPOCH"] = "1700000000"
    from gyrostab.allan.davar import davar_parts
    from gyrostab.jobs import engine

    davar_parts.__kwdefaults__["samples"] = 1
    engine._MAX_HELD_SECONDS = 0.0
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(Path(name), given.seed)
        times = [f"`{command}` {seconds:.1f} s" for command, seconds in bench.seconds.items()]
        print(*times, flush=True)
        trials: list[Trials] = []
        steps: list[Callable[[], Trials | list[Trials]]] = [
            *(partial(bench.kill, command, given.kills) for command in bench.commands),
            lambda: bench.damage(10),
            lambda: bench.full_disk(12),
            bench.read_only,
            lambda: bench.changed_input(10),
            lambda: bench.two_at_once(10),
        ]
        for step in steps:
            result = step()
            for kind in result if isinstance(result, list) else [result]:
                trials.append(kind)
                print(*kind.row(), *kind.wrong, sep="\n", flush=True)
    head = ["what was done", "trials", "what must follow", "so it was"]
    text = (
        f"Made by `python benchmarks/durability.py --kills {given.kills} --seed {given.seed}`;\n"
        f"undisturbed, {', '.join(times)}. The killed runs reused {bench.reused} finished parts."
        f"\n\n{table(head, [kind.row() for kind in trials])}"
    )
    renew(given.output, "durability", text)
    return 1 if any(kind.wrong for kind in trials) else 0


if __name__ == "__main__":
    sys.exit(main())

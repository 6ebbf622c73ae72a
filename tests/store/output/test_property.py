"""However a command ends, nothing in the folder changes but its output."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from gyrostab.io.opening import open_dataset
from gyrostab.store import system
from gyrostab.store.output import is_leftover
from tests.support.command_line import call
from tests.support.outputs import read_tree, write_inputs

#: Calls that change the disk.
CALLS = ("replace", "rename", "link", "fsync", "unlink", "rmdir", "mkdir", "open", "ftruncate")
COMMANDS = {
    "ingest": (["ingest", "log.csv"], ["nc", "zarr"]),
    "ingest again": (["ingest", "log.zarr"], ["nc", "zarr"]),
    "ingest a pattern": (["ingest", "l*g.nc"], ["nc", "zarr"]),
    "run": (["run", "log.nc", "--window", "1s", "--step", "1s", "--taus", "4"], ["nc"]),
    "simulate": (["simulate", "model.toml", "--duration", "2s", "--rate", "10"], ["nc", "zarr"]),
    "export a store": (["export", "product.nc", "--format", "zarr"], ["zarr"]),
    "export for a survey": (
        ["export", "product.nc", "--format", "iscwsa"],
        ["csv", "json", "xml"],
    ),
    "export for Kalibr": (["export", "product.nc", "--format", "kalibr"], ["yaml"]),
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    return write_inputs(folder, seconds=4.0, window="1s", step="1s", taus=4)


#: What may lie under the name of an output, and what may be put into it.
KINDS = (
    "nothing",
    "file",
    "folder",
    "photos",
    "store",
    "store with notes",
    "link to file",
    "link to store",
    "link to nothing",
    "an input",
)


def put(folder: Path, name: str, kind: str, *, source: str = "") -> None:
    """Put something under a name; `source` is the input of the command."""
    path = folder / name
    if kind == "file":
        path.write_text("old")
    elif kind in ("folder", "photos"):
        path.mkdir()
        if kind == "photos":
            (path / "tide.jpg").write_text("the sea")
    elif kind.startswith("store"):
        shutil.copytree(folder / "log.zarr", path)
        if "notes" in kind:
            (path / "rate" / "notes.txt").write_text("mine")
    elif kind.startswith("link"):
        path.symlink_to(
            {"file": "precious.nc", "store": "elsewhere", "nothing": "nowhere"}[
                kind.rpartition(" ")[2]
            ]
        )
    elif kind == "an input":
        path.symlink_to(source.replace("*", "o"))


def named_output(folder: Path, name: str) -> str:
    """Where the output goes: the target of a link."""
    path = folder / name
    return os.readlink(path) if path.is_symlink() else name


class Interruption(BaseException):
    """Ends a command in the midst of its work."""


@contextmanager
def calls_of_the_disk(act: Callable[[int], None], folder: Path) -> Iterator[None]:
    """Call `act` with a running number before each call that changes the disk in a folder."""
    count = 0

    def wrap(function: Callable[..., object]) -> Callable[..., object]:
        def wrapped(*arguments: object, **options: object) -> object:
            nonlocal count
            if any(
                str(argument).startswith(str(folder)) or "part" in str(argument)
                for argument in arguments[:2]
            ):
                count += 1
                act(count)
            return function(*arguments, **options)

        return wrapped

    with pytest.MonkeyPatch.context() as patch:
        for name in CALLS:
            patch.setattr(os, name, wrap(getattr(os, name)))
        patch.setattr(system, "rename_with_flag", wrap(system.rename_with_flag))
        yield


def check_tree(
    folder: Path,
    before: dict[str, object],
    target: str,
    *,
    done: bool,
    killed: bool,
    is_dataset: bool,
) -> None:
    """Check that only the output has changed, and that it is complete (old or new)."""

    def is_output(name: str) -> bool:
        return name == target or name.startswith(f"{target}/")

    def is_hidden(name: str) -> bool:
        first = name.partition("/")[0]
        return is_leftover(first) or (first.startswith(".") and first.endswith(".job"))

    after = read_tree(folder)
    assert {name: value for name, value in before.items() if not is_output(name)} == {
        name: value
        for name, value in after.items()
        if not is_output(name) and not (killed and is_hidden(name))
    }
    old = {name: value for name, value in before.items() if is_output(name)}
    new = {name: value for name, value in after.items() if is_output(name)}
    if done or (killed and new != old):
        assert new
        if is_dataset:
            open_dataset(folder / target).close()
    else:
        assert new == old


@pytest.mark.slow
@settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
@given(data=st.data())
def test_nothing_changes_but_the_output(inputs, data):
    command, suffixes = COMMANDS[data.draw(st.sampled_from(sorted(COMMANDS)))]
    name = f"out.{data.draw(st.sampled_from(suffixes))}"
    kind = data.draw(st.sampled_from(KINDS))
    flags = ["--overwrite"] * data.draw(st.integers(0, 1))
    moment = data.draw(st.one_of(st.none(), st.integers(1, 30)))
    with tempfile.TemporaryDirectory() as top:
        folder = Path(top, "work")
        shutil.copytree(inputs, folder)
        (folder / "precious.nc").write_text("precious")
        shutil.copytree(folder / "log.zarr", folder / "elsewhere")
        put(folder, name, kind, source=command[1])
        (folder / "probe").write_text("mine")
        before, target = read_tree(folder), named_output(folder, name)

        def interrupt(number: int) -> None:
            if number == moment:
                raise Interruption

        code = 3
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            try:
                with calls_of_the_disk(interrupt, folder):
                    code = call(*command, "-o", name, *flags, "--quiet-progress")
            except Interruption:
                pass
        assert code in (0, 2, 3)
        check_tree(
            folder,
            before,
            target,
            done=code == 0,
            killed=code == 3,
            is_dataset=name.endswith(
                ("nc", "zarr")
            ),  # the target of a link may have another suffix
        )
        if kind in ("photos", "store with notes", "an input") or (
            not flags and "nothing" not in kind
        ):
            assert read_tree(folder) == before


# ------------------------------------------------------------------------------
# kills


def kill_commands(inputs: Path, top: Path, seed: int, kills: int) -> dict[str, object]:
    """Kill commands, each in a child process, before calls that change the disk; check the rest."""
    draw = random.Random(seed)
    wrong, landed = [], 0
    for number in range(kills):
        command, suffixes = COMMANDS[draw.choice(sorted(COMMANDS))]
        name = f"out.{draw.choice(suffixes)}"
        folder = top / f"work{number}"
        shutil.copytree(inputs, folder)
        put(folder, name, draw.choice(["nothing", "file" if "zarr" not in name else "store"]))
        before, moment = read_tree(folder), draw.randint(1, 12)
        child = os.fork()
        if child == 0:
            os.chdir(folder)
            with calls_of_the_disk(
                lambda call, at=moment: os.kill(os.getpid(), 9) if call == at else None, folder
            ):
                os._exit(call(*command, "-o", name, "--overwrite", "--quiet-progress"))
        killed = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -9
        landed += killed
        try:
            is_dataset = name.endswith(("nc", "zarr"))
            check_tree(folder, before, name, done=not killed, killed=killed, is_dataset=is_dataset)
        except AssertionError as error:
            wrong.append(f"{command} -o {name}, killed before call {moment}: {error}")
    return {"kills": landed, "wrong": wrong}


@pytest.mark.slow  # the test above interrupts before the same calls
def test_kills_leave_the_old_output_or_the_new_one(inputs, tmp_path):
    command = ["-m", "tests.store.output.test_property", str(inputs), str(tmp_path), "1", "4"]
    done = subprocess.run(
        [sys.executable, *command],
        capture_output=True,
        text=True,
        timeout=250,
        cwd=Path(__file__).parents[3],
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["wrong"] == []
    assert result["kills"] >= 2


if __name__ == "__main__":
    print(
        json.dumps(
            kill_commands(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
        )
    )

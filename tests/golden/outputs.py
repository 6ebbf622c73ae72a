"""Make the reference outputs: every format, the demo, two archives, ten diagnoses."""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import shutil
import tomllib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gyrostab
from gyrostab.cli import main
from tests.fuzz.seeds import FOLDER, WINDOWS, Seed, make_seeds

ROOT = Path(__file__).resolve().parents[2]
RECORDINGS = Path(
    os.environ.get("GYROSTAB_RECORDINGS", ROOT.parent / "shared" / "recordings")
).resolve()
COMMANDS = (
    "demo",
    "scan",
    "ingest",
    "run",
    "davar",
    "fit",
    "correlate",
    "simulate",
    "diagnose",
    "report",
    "plot",
    "prove",
)
#: Models that are simulated and then diagnosed: duration and sampling rate [Hz].
SIMULATED = {
    "x2": ("2000s", "10"),
    "p16_vibration": ("1500s", "20"),
    "l13_temperature": ("9000s", "2"),
    "mwd_24h": ("3h", "5"),
}
NULLS = 100  # the fewest allowed: the outputs are compared with themselves, not with the truth

Job = Callable[[], None]


def call(*arguments: str) -> None:
    """Run a command in this process; write its exit code and what it prints to a text file."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
        try:
            code = main(list(arguments))
        except SystemExit as ended:
            code = int(ended.code or 0)
    name = "-".join(Path(word).name.strip("-") for word in arguments[:2])
    count = len(list(Path.cwd().glob("*.txt")))
    Path(f"{count:02d}-{name}.txt").write_text(
        f"exit {code}\n{printed.getvalue()}", encoding="utf-8"
    )


def read_seed(seed: Seed) -> Job:
    """Use an undamaged input of the fuzz harness with each of its commands."""

    def job() -> None:
        place = Path("input")
        for name, data in seed.files.items():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_bytes(data.replace(FOLDER.encode(), str(place.resolve()).encode()))
        options = [word.replace(FOLDER, str(place)) for word in seed.options]
        main_input = str(place / seed.main)
        for command in sorted(set(seed.commands) & {"scan", "ingest", "run", "simulate"}):
            output = [] if command == "scan" else ["-o", f"{command}.nc"]
            windows = WINDOWS if command == "run" else ()
            call(command, main_input, *options, *output, *windows)

    return job


def demo() -> None:
    """The shipped log to its product, and the stages one by one in every container."""
    call("demo", "-o", "demo")
    log = shutil.copy(ROOT / "data" / "mwd_sample.csv.gz", "mwd_sample.csv.gz")
    for ending in ("nc", "zarr"):
        call("ingest", log, "-o", f"log.{ending}")
        call(
            "run",
            f"log.{ending}",
            "-o",
            f"product-{ending}.nc",
            "--window",
            "2min",
            "--step",
            "30s",
        )
    call(
        "davar", "log.nc", "-o", "davar.nc", "--window", "2min", "--step", "30s", "--taus", "octave"
    )
    call("fit", "davar.nc", "-o", "fitted.nc")
    call("correlate", "product-nc.nc", "--with", "temperature", "-o", "correlation.nc")


def archive() -> None:
    """The shipped log in five files: one is missing, two overlap, one holds unreadable cells."""
    head, *rows = (
        gzip.decompress((ROOT / "data" / "mwd_sample.csv.gz").read_bytes()).decode().splitlines()
    )
    comments = [head]
    while rows[0].startswith("#") or not rows[0][:1].isdigit():
        comments.append(rows.pop(0))
    size = len(rows) // 5
    for number in (0, 1, 2, 4):
        part = rows[max(0, number * size - 50 * (number == 2)) : (number + 1) * size]
        if number == 1:
            part[100:110] = [line.rsplit(",", 2)[0] + ",****,nan" for line in part[100:110]]
        Path(f"part{number}.csv").write_text("\n".join([*comments, *part]) + "\n", encoding="utf-8")
    call(
        "run",
        *(f"part{number}.csv" for number in (0, 1, 2, 4)),
        "-o",
        "product.nc",
        "--window",
        "1min",
        "--step",
        "20s",
        "--max-gap",
        "1day",
    )
    call(
        "run",
        *(f"part{number}.csv" for number in (0, 1)),
        "-o",
        "fine.nc",
        "--window",
        "30s",
        "--step",
        "1s",
        "--taus",
        "all",
    )


def simulated(name: str) -> Job:
    """A model to a log, the log to its product and to a diagnosis."""
    duration, rate = SIMULATED[name]

    def job() -> None:
        model = shutil.copy(ROOT / "data" / "models" / f"{name}.toml", f"{name}.toml")
        call(
            "simulate", model, "-o", "log.nc", "--duration", duration, "--rate", rate, "--seed", "3"
        )
        call("run", "log.nc", "-o", "product.nc")
        call("diagnose", "log.nc", "-o", "diagnosis", "--nulls", str(NULLS), "--seed", "1")

    return job


def recording(entry: dict[str, Any]) -> Job:
    """A real recording and its diagnosis."""

    def job() -> None:
        log = gyrostab.regularise(
            gyrostab.read_log([RECORDINGS / name for name in entry["files"]], **entry["read"])
        )
        gyrostab.write_diagnosis(gyrostab.diagnose(log, nulls=NULLS, seed=1), "diagnosis")

    return job


def helps() -> None:
    """The help of every command."""
    for command in COMMANDS:
        call(command, "--help")


def jobs() -> Iterator[tuple[str, Job]]:
    """Name and work of every reference output."""
    yield "help", helps
    for name, seeds in make_seeds().items():
        if name not in ("checkpoint", "options"):
            for number, seed in enumerate(seeds):
                yield f"{name.replace(' ', '_')}-{number}", read_seed(seed)
    yield "demo", demo
    yield "archive", archive
    for name in SIMULATED:
        yield f"simulated-{name}", simulated(name)
    plan = tomllib.loads(
        (ROOT / "pipelines" / "diagnose_recordings.toml").read_text(encoding="utf-8")
    )
    for name, entry in plan["recording"].items():
        if all((RECORDINGS / file).exists() for file in entry["files"]):
            yield f"recording-{name}", recording(entry)


def make_outputs(folder: Path, chosen: list[str]) -> list[str]:
    """Make the outputs, one folder a job; those whose name contains one of `chosen`, or all."""
    os.environ["SOURCE_DATE_EPOCH"] = "1767225600"
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for name, job in jobs():
        if chosen and not any(word in name for word in chosen):
            continue
        place = folder / name
        place.mkdir()
        with contextlib.chdir(place), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            job()
        made.append(name)
        print(name, flush=True)
    return made

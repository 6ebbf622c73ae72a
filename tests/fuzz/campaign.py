"""Batches of damaged inputs, determined by the seed, the format and their number alone."""

from __future__ import annotations

import atexit
import hashlib
import json
import random
import signal
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from tests.fuzz.mutate import damage
from tests.fuzz.seeds import Seed, make_seeds
from tests.fuzz.server import Outcome, Server
from tests.fuzz.structured import STRUCTURED, draw_inputs
from tests.ingest.field_files import WRITERS

BATCH = 100


@dataclass(frozen=True)
class Input:
    """Input of one command."""

    format: str
    files: dict[str, bytes]
    main: str
    options: tuple[str, ...]
    command: str


@dataclass
class Tally:
    """Results for the inputs of one format."""

    codes: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0  # processor time
    slowest: float = 0.0
    bytes: int = 0
    failures: list[dict[str, Any]] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Add the results of another batch."""
        self.codes.update(other.codes)
        self.seconds += other.seconds
        self.slowest, self.bytes = max(self.slowest, other.slowest), max(self.bytes, other.bytes)
        self.failures += other.failures

    def as_json(self) -> dict[str, Any]:
        """Return the tally as JSON; `Tally.from_json` reads it back."""
        return {**vars(self), "codes": dict(self.codes)}

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> Tally:
        """Return the tally that `as_json` wrote."""
        return cls(**{**stored, "codes": Counter(stored["codes"])})


@cache
def seeds() -> dict[str, list[Seed]]:
    """Return valid inputs by format, made once in each process."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return make_seeds()


@cache
def server() -> Server:
    """Return the child of this process."""
    made = Server()
    atexit.register(made.close)
    return made


#: Rows of the result table.
FORMATS = (
    "text",
    "parquet",
    "netcdf3",
    "netcdf4",
    "zarr2",
    "zarr3",
    "hdf5",
    "matlab5",
    "matlab7.3",
    "miniseed",
    "ulog",
    "las",
    "tdms",
    "binary",
    "layout",
    *WRITERS,
    "wits0",
    "model",
    "options",
    "checkpoint",
    *STRUCTURED,
)


def make_input(form: str, seed: int, number: int) -> Input:
    """Make one damaged input, determined by the arguments."""
    draw = random.Random(f"{seed} {form} {number}")
    chosen = draw.choice(seeds()[form])
    others = [other for group in seeds().values() for other in group]
    files = damage(chosen, seeds()[form] if draw.random() < 0.7 else others, draw)
    return Input(form, files, chosen.main, chosen.options, draw.choice(chosen.commands))


def ignore_interrupts() -> None:
    """Leave Ctrl-C to the first process, which stops the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def run_batch(
    form: str, seed: int, first: int, count: int, folder: str | None
) -> tuple[str, int, Tally]:
    """Try inputs of one format; failing ones are saved in `folder`."""
    tally = Tally()
    if form in STRUCTURED:
        inputs = (
            Input(form, *parts) for parts in draw_inputs(form, f"{seed} {form} {first}", count)
        )
    else:
        inputs = (make_input(form, seed, number) for number in range(first, first + count))
    for item in inputs:
        outcome = server().try_input(item.files, item.command, item.main, item.options)
        tally.codes[str(outcome.code)] += 1
        tally.seconds += outcome.worked
        tally.slowest, tally.bytes = (
            max(tally.slowest, outcome.seconds),
            max(tally.bytes, outcome.bytes),
        )
        if not outcome.is_right(may_be_interrupted=form == "checkpoint"):
            tally.failures.append(report(item, outcome, folder))
    return form, first, tally


def report(item: Input, outcome: Outcome, folder: str | None) -> dict[str, Any]:
    """Describe a failure, and save its input in `folder`."""
    name = hashlib.sha256(
        repr(sorted(item.files.items())).encode() + item.command.encode()
    ).hexdigest()[:12]
    if folder is not None:
        keep_input(item, Path(folder) / f"{item.format}-{name}")
    return {
        "format": item.format,
        "name": name,
        "command": item.command,
        "code": outcome.code,
        "text": outcome.text[-300:],
    }


def keep_input(item: Input, place: Path) -> None:
    """Write an input for `load_input`."""
    for name, data in item.files.items():
        (place / "files" / name).parent.mkdir(parents=True, exist_ok=True)
        (place / "files" / name).write_bytes(data)
    call = {
        "format": item.format,
        "main": item.main,
        "options": item.options,
        "command": item.command,
    }
    place.mkdir(parents=True, exist_ok=True)
    (place / "call.json").write_text(json.dumps(call, indent=1) + "\n")


def load_input(place: Path) -> Input:
    """Read an input that `keep_input` wrote."""
    call = json.loads((place / "call.json").read_text())
    files = {
        str(path.relative_to(place / "files")): path.read_bytes()
        for path in sorted((place / "files").rglob("*"))
        if path.is_file()
    }
    return Input(call["format"], files, call["main"], tuple(call["options"]), call["command"])

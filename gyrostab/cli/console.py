"""The application and what its commands share: arguments, progress, defaults from a file.

Warnings and errors are single lines, and an interruption is orderly.
"""

from __future__ import annotations

import errno
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, TextIO

from cyclopts import (
    App,
    CycloptsError,
    MissingArgumentError,
    Parameter,
    UnknownCommandError,
    UnusedCliTokensError,
)

from gyrostab.cli.options import Common, read_toml
from gyrostab.errors import SYSTEM_ERRNOS, GyrostabError, OptionError

Logs = Annotated[list[Path], Parameter(name="LOG...", negative=())]
Product = Annotated[Path, Parameter(name="PRODUCT")]
Output = Annotated[Path, Parameter(name=["--output", "-o"], metavar="FILE")]
OutputFolder = Annotated[Path, Parameter(name=["--output", "-o"], metavar="DIR")]

app = App(
    name="gyrostab",
    help="Dynamic Allan variance of gyro logs: noise coefficients over time, and a diagnosis of "
    "the physical effects that a simulation leaves out.",
    help_epilogue="Try it: gyrostab demo -o demo-output. Help on a command: gyrostab run --help.",
    version_flags=["--version"],
    help_format="markdown",
    suppress_keyboard_interrupt=False,
)
app.register_install_completion_command(
    help="Install the completion of commands and options for this shell (bash, zsh, fish)."
)


@contextmanager
def show_stages(common: Common) -> Iterator[Any]:
    """Set the number of processor cores and show the progress of each stage."""
    import dask

    from gyrostab.progress import show_progress

    chosen = {"num_workers": common.workers} if common.workers else {}
    with (
        dask.config.set(scheduler="threads", **chosen),
        show_progress(quiet=common.quiet_progress) as stage,
    ):
        yield stage


def find_inputs(arguments: Mapping[str, Any]) -> list[Path]:
    """Find the input files of a command: its path arguments except the output, and TOML options.

    Examples
    --------
    >>> output = Path("run7.nc")
    >>> find_inputs({"logs": [Path("run7.csv")], "output": output, "map": ["names.toml"]})
    [PosixPath('run7.csv'), PosixPath('names.toml')]
    """
    paths: list[Path] = []
    for value in (value for name, value in arguments.items() if name != "output"):
        if is_dataclass(value) and not isinstance(value, type):
            paths += find_inputs(asdict(value))
        for item in value if isinstance(value, list | tuple) else [value]:
            if isinstance(item, Path) or (isinstance(item, str) and item.lower().endswith(".toml")):
                paths.append(Path(item))
    return paths


def attach_negative_values(tokens: Sequence[str]) -> list[str]:
    """Attach each negative number to the option before it, so that it is not parsed as an option.

    Examples
    --------
    >>> attach_negative_values(["run", "a.csv", "--window", "-5min", "-o", "p.nc"])
    ['run', 'a.csv', '--window=-5min', '-o', 'p.nc']
    """
    attached: list[str] = []
    for token in tokens:
        if attached and re.match(r"--[a-z][a-z-]*$", attached[-1]) and re.match(r"-\.?\d", token):
            attached[-1] += f"={token}"
        else:
            attached.append(token)
    return attached


def read_config(tokens: Sequence[str], commands: Collection[str]) -> Any:
    """Make the cyclopts reader of option defaults for the file of ``--config``, or None."""
    name = None
    for place, token in enumerate(tokens):
        if token == "--config" and place + 1 < len(tokens):
            name = tokens[place + 1]
        elif token.startswith("--config="):
            name = token.removeprefix("--config=")
    if name is None:
        return None
    table = read_toml(Path(name))
    for key, value in table.items():
        if isinstance(value, dict) and key not in commands:
            raise OptionError(
                f"{name}: table [{key}] is not a command; the commands are {', '.join(commands)}"
            )
        if not isinstance(value, dict) and key in commands:
            raise OptionError(f"{name}: {key} is a command; give its options in a table [{key}]")

    def apply(current: Any, path: tuple[str, ...], arguments: Any) -> None:
        from cyclopts.config import Dict

        defaults = {key: value for key, value in table.items() if not isinstance(value, dict)}
        defaults |= table.get(path[0], {}) if path else {}
        for key, value in defaults.items():
            if isinstance(value, dict):  # [run.map] wx = "gyro_x"
                defaults[key] = [f"{left}={right}" for left, right in value.items()]
        Dict(defaults, source=name, use_commands_as_keys=False)(current, path, arguments)

    return apply


@contextmanager
def show_plain_warnings() -> Iterator[None]:
    """Show each warning of the package once, as one plain line."""
    shown: set[str] = set()

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        text = str(message)
        if text not in shown:
            shown.add(text)
            print(f"note: {text}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = show
        yield


@contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Treat ``kill``, a time limit or a closed terminal like Ctrl-C, to leave nothing behind.

    Windows has no SIGHUP, and its SIGTERM cannot be caught when another process sends it.
    """

    def stop(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    signals = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    # nohup ignores SIGHUP, and that stays so
    ours = [number for number in signals if signal.getsignal(number) is signal.SIG_DFL]
    if threading.current_thread() is not threading.main_thread():
        ours = []
    for number in ours:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


def print_error(text: str, code: int) -> int:
    """Print an error message and return the exit code."""
    print(f"gyrostab: {text}", file=sys.stderr)
    return code


def _join_duration(error: UnusedCliTokensError) -> str:
    """Advise to write ``--window 2min`` if the number stands apart from its unit; "" otherwise."""
    tokens, unused = error.root_input_tokens or [], error.unused_tokens or []
    for option, number, unit in zip(tokens, tokens[1:], tokens[2:], strict=False):
        if (
            option.startswith("--")
            and unit in unused
            and re.fullmatch(r"[\d.]+", number)
            and unit.isalpha()
        ):
            return f"write {option} {number}{unit}"
    return ""


def _find_taken_files(error: MissingArgumentError) -> str:
    """Say which files options have taken as their values, such as ``--quiet run7.csv``."""
    tokens = error.root_input_tokens or []
    return " and ".join(
        f"{value} is the value of {option}"
        for option, value in pairwise(tokens)
        if option.startswith("-") and os.path.exists(value)
    )


def _describe_command_line(error: CycloptsError) -> str:
    """Say what is wrong with a command line."""
    command = " ".join(["gyrostab", *(error.command_chain or ())])
    if isinstance(error, UnusedCliTokensError):
        if joined := _join_duration(error):
            return f"{joined}, without a blank: a duration is one word"
        text = f"Too many arguments: {' '.join(error.unused_tokens or [])}."
    elif isinstance(error, UnknownCommandError) and (error.unused_tokens or [""])[0][:1] == "-":
        option, *rest = error.unused_tokens or []
        chosen = next((token for token in rest if token in app), "COMMAND")
        text = f"Options come after the command: gyrostab {chosen} {option} ..."
    elif isinstance(error, MissingArgumentError) and error.argument and not error.keyword:
        name = error.argument.name.removesuffix("...")
        files = "" if name.startswith("-") else _find_taken_files(error)
        text = f"{name} is missing{files and ': '}{files}."
    else:
        text = str(error)
    return f"{text} See {command} --help."


def describe_error(error: Exception) -> int:
    """Print an exception as one message and return the exit code."""
    if isinstance(error, CycloptsError):
        return print_error(_describe_command_line(error), 2)
    if isinstance(error, GyrostabError):
        return print_error(str(error), 2)
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        where = error.filename or "the standard output"
        return print_error(
            f"{where}: cannot be written ({error.strerror}); make room, or write elsewhere", 2
        )
    if isinstance(error, OSError) and error.errno in SYSTEM_ERRNOS and error.filename:
        return print_error(f"{error.filename}: {error.strerror}", 2)
    if isinstance(error, MemoryError):
        return print_error(
            f"out of memory ({error}); use fewer --taus, a longer --step, or fewer --workers", 1
        )
    return print_error(
        f"unexpected {type(error).__name__}: {error}. "
        "Use --debug to see where it occurred, and please report it.",
        1,
    )

"""The application object, arguments shared by the commands, and the progress display."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from gyrostab.cli.options import Common

Logs = Annotated[list[Path], Parameter(name="LOG...", negative=())]
Product = Annotated[Path, Parameter(name="PRODUCT")]
Output = Annotated[Path, Parameter(name=["--output", "-o"], metavar="FILE")]

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

"""The command line: parse arguments, call functions, print results.

Every module of `gyrostab.cli.commands` registers its commands when it is imported.

Exit codes: 0 done; 2 bad input or usage, with one message on stderr; 3 interrupted; 1 anything
else. No traceback unless ``--debug``.
"""

from __future__ import annotations

import importlib
import io
import logging
import os
import pkgutil
import sys
from collections.abc import Sequence

from cyclopts import CycloptsError

from gyrostab.cli import commands
from gyrostab.cli.console import (
    app,
    attach_negative_values,
    describe_error,
    find_inputs,
    print_error,
    read_config,
    show_plain_warnings,
    sigterm_as_interrupt,
)
from gyrostab.store.output import protect_inputs

__all__ = ["app", "main"]

for _module in pkgutil.iter_modules(commands.__path__):
    importlib.import_module(f"{commands.__name__}.{_module.name}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments after the program's name; those of the process when absent.

    Returns
    -------
    int
        Exit code.

    Examples
    --------
    >>> main(["fit", "davar.nc"])
    2
    """
    for stream in ("stdout", "stderr"):
        if getattr(sys, stream) is None:  # closed by the shell: gyrostab run ... 2>&-
            setattr(sys, stream, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):  # names that the terminal has no characters for
        sys.stdout.reconfigure(errors="backslashreplace")
    tokens = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in tokens
    try:
        app.config = read_config(
            tokens, [command for command in app if not command.startswith("-")]
        )
        with show_plain_warnings(), sigterm_as_interrupt():
            attached = attach_negative_values(tokens)
            command, bound, _ = app.parse_args(attached, exit_on_error=False, print_error=False)
            debug = debug or getattr(bound.arguments.get("common"), "debug", False)  # in --config
            # abandoned tasks of zarr would print tracebacks
            logging.getLogger("asyncio").disabled = not debug
            with protect_inputs(find_inputs(bound.arguments)):
                command(*bound.args, **bound.kwargs)
    except KeyboardInterrupt as stop:
        nothing_written = (
            "interrupted; nothing was written under the name of the output. "
            "Start the same command again."
        )
        return print_error(str(stop) or nothing_written, 3)
    except BrokenPipeError:  # the reader of the output, for instance `head`, has ended
        sys.stderr.close()
        return 0
    except SystemExit as stop:  # of rich, which prints the help
        if isinstance(stop.__context__, BrokenPipeError):
            return 0
        raise
    except Exception as error:
        if debug and not isinstance(error, CycloptsError):
            raise
        return describe_error(error)
    return 0

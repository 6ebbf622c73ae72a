"""Print the table of `scan`, the columns of inspected files and the command to run next."""

from __future__ import annotations

import math
import shlex
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from gyrostab.store.remote import given_name
from gyrostab.time.stamps import format_stamp

if TYPE_CHECKING:
    from gyrostab.ingest.scan import InspectedFile

#: Options whose flag on the command line has another name.
_FLAGS = {"limits": "--limit", "time_from": "--from", "time_to": "--to"}


def next_command(paths: Sequence[str | Path], options: dict[str, Any]) -> str:
    """Return the complete command that makes a product of logs.

    Examples
    --------
    >>> next_command(["run 7.csv"], {"map": {"wx": "gyro_x"}, "unit": {"gyro": "deg/s"}})
    "gyrostab run 'run 7.csv' -o product.nc --map wx=gyro_x --unit gyro=deg/s"
    """
    number, target = 2, Path("product.nc")
    while target.exists():
        number, target = number + 1, Path(f"product_{number}.nc")
    words = ["gyrostab", "run", *map(given_name, paths), "-o", str(target)]
    for name, value in options.items():
        flag = _FLAGS.get(name, f"--{name.replace('_', '-')}")
        if isinstance(value, Mapping):
            for key, text in value.items():
                words += [flag, f"{key}={text}"]
        elif isinstance(value, tuple | list):
            for item in value:
                words += [flag, str(item)]
        elif value is True:
            words.append(flag)
        else:
            words += [flag, f"{value:.10g}" if isinstance(value, float) else str(value)]
    return shlex.join(words)


def print_scan(table: pd.DataFrame) -> None:
    """Print the table of `scan`: framed with notes below on a terminal, tab-separated otherwise."""
    if not sys.stdout.isatty():
        plain = table.copy()
        for name in ("start", "end"):
            plain[name] = [
                None if pd.isna(stamp) else f"{format_stamp(stamp.value)}Z" for stamp in table[name]
            ]
        plain["missing_share"] = table["missing_share"].astype(float).round(6)
        counts = {"rows": "Int64", "gaps": "Int64"}
        plain.astype(counts).to_csv(sys.stdout, sep="\t", index=False)
        return
    _print_framed(table)
    for _, row in table[table["odd"].fillna("") != ""].iterrows():
        _print_wrapped([f"{row['file']}:"])
        _print_wrapped([row["odd"].removeprefix(f"{Path(row['file']).name}: ")], indent="  ")


def _print_wrapped(lines: Iterable[str], indent: str = "") -> None:
    """Print lines within the width of the terminal, or 100; in a pipe each begins with ``#``."""
    width = shutil.get_terminal_size((100, 24)).columns
    indent = indent if sys.stdout.isatty() else f"# {indent}"
    for line in lines:
        print(
            textwrap.fill(
                line,
                width,
                initial_indent=indent,
                subsequent_indent=f"{indent}  ",
                break_long_words=False,
                break_on_hyphens=False,
            )
        )


def _print_framed(table: pd.DataFrame) -> None:
    from rich.markup import escape

    headings = ("file", "start (UTC)", "span", "rate [Hz]", "axes", "channels")
    counts = ("rows", "gaps", "missing")
    rows: list[tuple[str, ...]] = []
    for _, row in table.iterrows():
        if pd.isna(row["rate_hz"]):
            lines = "cannot be read" if pd.isna(row["format"]) else "needs options, see below"
            rows.append((escape(row["file"]), f"[red]{lines}[/red]"))
            continue
        cells = (
            f"{row['file']} ({row['format']})",
            f"{row['start']:%Y-%m-%d %H:%M:%S}",
            _format_span(row["span_s"]),
            f"{row['rate_hz']:g}",
            row["axes"],
            row["channels"],
            f"{row['rows']:,.0f}",
            f"{row['gaps']:,.0f}",
            f"{100 * row['missing_share']:.2f} %",
        )
        rows.append(tuple(map(escape, cells)))
    _print_frame((*headings, *counts), rows, right=counts)


def _print_frame(
    headings: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    right: Collection[str],
    title: str | None = None,
) -> None:
    """Print rows of text with markup in a frame; columns of numbers are aligned `right`."""
    from rich.console import Console
    from rich.table import Table

    framed = Table(title=title)
    for heading in headings:
        framed.add_column(heading, overflow="fold", justify="right" if heading in right else "left")
    for row in rows:
        framed.add_row(*row)
    Console().print(framed)


def _format_span(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds < 60.0 else str(timedelta(seconds=round(seconds)))


INSPECTION_COLUMNS = ("column", "unit", "low", "high", "mean", "scatter", "rate_hz", "taken_for")


def _inspection_rows(inspected_file: InspectedFile) -> list[tuple[str, ...]]:
    """Return the columns of a file as rows of text, in the order of `INSPECTION_COLUMNS`."""
    guess = inspected_file.guess
    targets = {column.key: f"gyro_{axis}" for axis, column in guess.axes.items()}
    if guess.time is not None:
        targets[guess.time.key] = "time"
    targets |= {column.key: channel for channel, (column, _) in guess.channels.items()}
    rows: list[tuple[str, ...]] = []
    if inspected_file.inspection.time is not None:
        time = inspected_file.inspection.time
        rate = _format_number(inspected_file.inspection.rate_hz)
        rows.append((time.header, time.unit or "", *[""] * 4, rate, "time"))
    for column in inspected_file.inspection.columns:
        has_rate = math.isfinite(column.rate_hz) or column.rows == 0
        numbers = (
            column.low,
            column.high,
            column.mean,
            column.scatter,
            column.rate_hz if has_rate else guess.sampling_rate_hz,
        )
        channel_name = column.name if column.role == "channel" else ""
        rows.append(
            (
                column.key,
                column.unit or "",
                *map(_format_number, numbers),
                targets.get(column.key, channel_name) if column.rows else "no numbers",
            )
        )
    return rows


def _format_number(value: float) -> str:
    return f"{value:.6g}" if math.isfinite(value) else ""


def print_inspection(inspected: InspectedFile, shown: Collection[str]) -> None:
    """Print the columns of a file and the guess; in a pipe every line begins with ``#``.

    Notes that are `shown` elsewhere are left out.
    """
    from gyrostab.ingest.columns.plan_roles import scan_advice

    rows = _inspection_rows(inspected)
    guess = inspected.guess
    advice = scan_advice(inspected.paths[0])
    notes = inspected.row["notes"] if inspected.row else inspected.inspection.summary.notes
    notes = [note.removesuffix(advice) for note in notes]
    lines = [
        *guess.reasons,
        *(f"check: {warning}" for warning in guess.warnings),
        *inspected.inspection.notes,
        *(note for note in notes if note not in shown),
    ]
    if inspected.row is not None:
        read = inspected.row
        lines.append(
            f"read by this guess: {_format_span(read['span_s'])} at {read['rate_hz']:.6g} Hz, axes "
            f"{read['axes']}, {100 * read['missing_share']:.2f} % missing"
        )
    name = given_name(inspected.paths[0])
    if not sys.stdout.isatty():
        print(f"# {name}: {len(rows)} columns, {inspected.inspection.rows} rows")
        for row in [INSPECTION_COLUMNS, *rows]:
            print("# " + "\t".join(row))
        _print_wrapped(lines)
        return
    from rich.markup import escape

    headings = [heading.replace("_", " ") for heading in INSPECTION_COLUMNS]
    _print_frame(
        headings,
        [tuple(map(escape, row)) for row in rows],
        right=headings[2:-1],
        title=escape(f"{name}: {inspected.inspection.rows:,} rows"),
    )
    _print_wrapped(lines)


def print_next(command: str, *, apart: bool = False) -> None:
    """Print the command to run next; with `apart`, on stderr if stdout is a pipe."""
    if sys.stdout.isatty():
        print(f"next: {command}")
    elif apart:
        print(f"next: {command}", file=sys.stderr)
    else:
        print(f"# next: {command}")

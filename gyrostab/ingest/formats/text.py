"""Text logs: separated by comma, semicolon, tab or blanks, plain or gzipped, in bounded memory.

Several blocks of the file are parsed in parallel, by a kernel; rows that the kernel does not know
are parsed cell by cell (`gyrostab.ingest.text.cells`).
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, cast

import numpy as np
import xarray as xr

from gyrostab.arrays import Ints
from gyrostab.errors import FormatError, UnitError
from gyrostab.ingest.columns.dates import has_offset
from gyrostab.ingest.columns.headers import describe_cells
from gyrostab.ingest.columns.plan import Column, Plan
from gyrostab.ingest.columns.plan_roles import plan_columns
from gyrostab.ingest.columns.raw_log import ConvertedBlock, RawLogBuilder, summary_of
from gyrostab.ingest.columns.stamps import NAT, add_weeks, cells_to_ns, is_number
from gyrostab.ingest.formats.recognise import read_head
from gyrostab.ingest.options import FileSummary, ReadOptions
from gyrostab.ingest.text.cells import BlockParser, ParsedBlock, decode_line, parse_numbers
from gyrostab.ingest.text.layout import Layout, find_layout, is_text, unit_of_duration
from gyrostab.store.threads import map_in_order

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".asc", ".log")
#: Bytes of the file in which the layout is searched; more, up to the second number, if they contain
#: fewer lines than the third.
HEAD_BYTES, MAX_HEAD_BYTES, HEAD_LINES = 2**18, 2**24, 4
BLOCK_BYTES = 2**22
_GZIP = b"\x1f\x8b"
COUNTED_BYTES = 2**24
#: Time of day and fraction of a second, a fraction with leading zeros, and the number of steps back
#: of which the fractions are compared.
_FRACTION, _PADDED = re.compile(r"(\d\d?:\d\d:\d\d)[.,](\d+)"), re.compile(rb":\d\d[.,]0\d")
_COMPARED_ROWS = 100


def matches(path: Path) -> bool:
    """Return whether the file has the suffix of a text log, or contains text with digits."""
    name = path.name.lower().removesuffix(".gz")
    return path.is_file() and (name.endswith(SUFFIXES) or _holds_text(path))


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Summarise header, columns, and first and (of plain files) last stamp."""
    layout, plan = _plan_file(path, options)
    time, rows = plan.time, None
    head = tail = np.empty(0, np.int64)
    if time is not None:
        head = _sample_stamps(layout, plan, time, layout.samples)
    if not read_head(path).startswith(_GZIP):
        size = path.stat().st_size
        with path.open("rb") as file:
            file.seek(max(layout.offset, size - 2**14))
            ends = [layout.split_row(decode_line(line)) for line in file.read().splitlines()]
            if time is not None:
                solid = [row for row in ends if _is_solid(row, layout, time.source)]
                tail = _sample_stamps(layout, plan, time, solid)
            if size <= COUNTED_BYTES:
                file.seek(layout.offset)
                rows = sum(
                    1
                    for line in file
                    if line.strip() and not line.lstrip().startswith((b"#", b"%"))
                )
    return summary_of(plan, "text", rows, head=head, tail=tail, notes=layout.notes)


def read(path: Path, options: ReadOptions) -> xr.Dataset:
    """Return the raw log of a text file; see `gyrostab.ingest.read_log`."""
    layout, plan = _plan_file(path, options)
    builder, parser, line = RawLogBuilder(plan), BlockParser(layout, plan), layout.line

    def parse(block: bytes) -> tuple[ParsedBlock, ConvertedBlock]:
        parsed = parser.parse(block)
        return parsed, builder.prepare(parsed.values, parsed.stamps, words=parsed.words)

    blocks = _read_blocks(path, layout.offset, growing=options.growing)
    dates = plan.time if plan.time is not None and plan.time.time_unit is None else None
    for parsed, converted in map_in_order(parse, blocks):
        if dates is not None:
            _check_fractions(parsed, f"{path.name}: ", line, dates)
        for row, cell, first in parsed.other_headers[:1]:
            place = parsed.name_lines(line, [row])[0]
            raise FormatError(
                f"{path.name}: {place} is a header unlike the first one: {cell!r} in place of "
                f"{first!r}; cut the file before {place}, so that each part has its own header, "
                "and read the parts together as one log"
            )
        quote = partial(parser.quote_fault, parsed)
        builder.add(converted, partial(parsed.name_lines, line), quote)
        line += parsed.lines
    raw = builder.finish(layout.notes)
    if dates is not None:
        cells = [row[dates.source] for row in layout.samples]
        raw.attrs["local_time"] = not (dates.epoch or any(map(has_offset, cells)))
    return raw


def _check_fractions(parsed: ParsedBlock, where: str, line: int, time: Column) -> None:
    """Refuse fractions of a second without leading zeros, such as ``.5`` for 5 ms.

    Time then runs backwards only from a smaller number to one of more digits, ``.9`` to ``.10``.
    """
    stamps = np.empty(0, np.int64) if parsed.stamps is None else parsed.stamps
    is_back = (stamps[1:] != NAT) & (stamps[1:] < stamps[:-1])
    rows = np.flatnonzero(is_back)[:_COMPARED_ROWS].tolist()
    if len(rows) < 2 or _PADDED.search(parsed.block):
        return
    short_fractions = []
    for row in rows:
        before, after = (_FRACTION.search(parsed.read_line(at)) for at in (row, row + 1))
        if before and after and before[1] == after[1] and len(before[2]) < len(after[2]):
            short_fractions += [(row, before[0], after[0])] * (int(before[2]) < int(after[2]))
    if len(short_fractions) > max(1, len(rows) / 2):
        row, earlier, later = short_fractions[0]
        raise UnitError(
            f"{where}{parsed.name_lines(line, [row])[0]}: the time {earlier!r} comes before "
            f"{later!r}, so the fractions of a second lack leading zeros; write .005 and not .5 "
            f'for 5 ms, or give rate and start instead: --map "{time.header}=-" --rate HZ '
            "--start 2026-05-01T08:00:00"
        )


def _plan_file(path: Path, options: ReadOptions) -> tuple[Layout, Plan]:
    with _open_text(path) as file:
        size, head = HEAD_BYTES, file.read(HEAD_BYTES)
        while (
            len(head) == size and size < MAX_HEAD_BYTES and head.count(b"\n") < HEAD_LINES
        ):  # very long lines
            head += file.read(size)
            size *= 2
        layout = find_layout(path, head, complete=len(head) < size, limits=options.limits)
    columns = []
    for place, header in enumerate(layout.headers):
        cells = [row[place] for row in layout.samples]
        cells = [n if is_number(n := layout.write_point(cell)) else cell for cell in cells]
        unit = layout.units.get(place) or _duration_unit(cells)
        columns.append(describe_cells(header, unit, cells))
    return layout, plan_columns(path, columns, options, above=layout.above)


def _duration_unit(cells: Sequence[str]) -> str | None:
    """Return the unit that all cells of a column contain, such as ``0.01 sec``."""
    unit = unit_of_duration(cells[0]) if cells else None
    return unit if unit and all(unit_of_duration(cell) == unit for cell in cells) else None


def _sample_stamps(layout: Layout, plan: Plan, time: Column, rows: Sequence[Sequence[str]]) -> Ints:
    cells = [row[time.source] for row in rows]
    if time.time_unit is not None:
        cells = [layout.write_point(cell) for cell in cells]
    stamps = cells_to_ns(cells, time.time_unit, time.epoch, time.date_order)
    for column in plan.of("week"):
        stamps = add_weeks(stamps, parse_numbers([row[column.source] for row in rows], layout))
    return stamps


def _is_solid(row: list[str], layout: Layout, time: int) -> bool:
    """Return whether a row holds a number in addition to its stamp."""
    other_cells = (cell for at, cell in enumerate(row) if at != time)
    return len(row) == layout.width and (
        layout.width == 1 or any(is_number(layout.write_point(cell)) for cell in other_cells)
    )


def _holds_text(path: Path) -> bool:
    try:
        with _open_text(path) as file:
            head = file.read(4096)
    except (FormatError, OSError):
        return False
    return is_text(head) and any(48 <= code < 58 for code in head)


@contextmanager
def _open_text(path: Path) -> Iterator[IO[bytes]]:
    """Open a text file, plain or gzipped; `FormatError` where a gzip stream is damaged."""
    is_packed = read_head(path).startswith(_GZIP)
    with gzip.open(path, "rb") if is_packed else path.open("rb") as file:
        try:
            yield cast(IO[bytes], file)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise FormatError(
                f"{path.name}: the gzip stream is damaged or cut off; {file.tell():,} bytes of "
                f"text could be read before that ({error}). copy the file again, or save the "
                f"readable part with: gzip -dc {path.name} > rescued.csv"
            ) from error


def read_text_head(path: Path) -> str:
    """Return the first characters of a text file, plain or gzipped; "" for other files."""
    if not path.is_file() or not _holds_text(path):
        return ""
    with _open_text(path) as file:
        return file.read(4096).decode("latin-1")


def _read_blocks(path: Path, offset: int, *, growing: bool = False) -> Iterator[bytes]:
    """Yield the data rows in blocks that end with a line; of a growing file, whole lines only."""
    with _open_text(path) as file:
        file.read(offset)
        rest = b""
        while chunk := file.read(BLOCK_BYTES):
            cut = chunk.rfind(b"\n") + 1
            if cut == 0:
                rest += chunk
                if len(rest) > 4 * BLOCK_BYTES:
                    raise FormatError(
                        f"{path.name}: a line is longer than {len(rest):,} bytes; this is not a "
                        "text log with line ends"
                    )
                continue
            yield b"".join((rest, memoryview(chunk)[:cut]))
            rest = chunk[cut:]
        if rest.strip() and not growing:
            yield rest + b"\n"

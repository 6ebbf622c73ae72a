"""Compare parsers of text logs: gyrostab's, pyarrow and the C engine of pandas.

All parse the same files in one process, in turn, in blocks, to float64 columns and stamps. CPU time
counts all threads. gyrostab and pyarrow give exact stamps (ISO 8601, whole numbers, decimals to the
last digit). pandas does so for ISO 8601 and whole numbers; its decimal stamps are doubles. Damaged
files hold a cell ``****`` in one row of a thousand. pyarrow and pandas stop there unless they read
the columns as text; they do so here, and convert no cell to a number.

    python benchmarks/text_parsers.py --output docs/decisions/0007-text-parsing.md
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
from page import in_new_process, machine, make_parser, memory, renew, table
from pyarrow import csv

from gyrostab.ingest.formats import text
from gyrostab.ingest.options import ReadOptions
from gyrostab.ingest.text.cells import BlockParser

EVERY = 1000  # rows per damaged row
PERIOD_US = 2500


@dataclass(frozen=True)
class Shape:
    """Form of a file: kind of stamps, and number of columns in addition to them."""

    stamps: str  # "iso", "seconds" or "microseconds"
    columns: int
    damaged: bool

    @property
    def name(self) -> str:
        """Words for the table."""
        return f"{self.stamps}, {self.columns + 1} columns{', damaged' * self.damaged}"


def write_file(path: Path, shape: Shape, rows: int) -> None:
    """Write a log of random rates."""
    rng = np.random.default_rng(5)
    counts = np.arange(rows, dtype=np.int64) * PERIOD_US + 1_767_225_600_000_000
    if shape.stamps == "iso":
        stamps = np.char.add(np.datetime_as_string(counts.view("M8[us]"), unit="us"), "Z")
    elif shape.stamps == "seconds":
        stamps = np.array([f"{count // 10**6}.{count % 10**6:06d}" for count in counts.tolist()])
    else:
        stamps = counts.astype(str)
    unit = {"iso": "", "seconds": " [s]", "microseconds": " [us]"}[shape.stamps]
    names = ["gyro_x [deg/h]", "gyro_y [deg/h]", "gyro_z [deg/h]"]
    names += [f"accel_{axis} [g]" for axis in "xyz"]
    names += [f"temperature_{n} [degC]" for n in range(shape.columns)]
    values = rng.normal(0, 30, (rows, shape.columns)).round(4)
    lines = [f"time{unit},{','.join(names[: shape.columns])}"]
    for number, (stamp, row) in enumerate(zip(stamps.tolist(), values.tolist(), strict=True)):
        cells = list(map(str, row))
        if shape.damaged and number % EVERY == EVERY // 2:
            cells[0] = "****"
        lines.append(f"{stamp},{','.join(cells)}")
    path.write_text("\n".join(lines) + "\n")


def parsers(path: Path, shape: Shape) -> dict[str, Callable[[], int]]:
    """Return name -> function that parses the file and returns the number of rows."""
    options = ReadOptions()
    layout, plan = text._plan_file(path, options)
    parser = BlockParser(layout, plan)

    def own() -> int:
        blocks = text._read_blocks(path, layout.offset)
        return sum(len(parser.parse(block).starts) for block in blocks)

    names = [str(number) for number in range(layout.width)]
    stamp = {
        "iso": pa.timestamp("ns", tz="UTC"),
        "seconds": pa.decimal128(38, 9),
        "microseconds": pa.int64(),
    }[shape.stamps]
    number = pa.string() if shape.damaged else pa.float64()

    def stream() -> int:
        with csv.open_csv(
            path,
            read_options=csv.ReadOptions(
                column_names=names, skip_rows=1, use_threads=False, block_size=2**22
            ),
            convert_options=csv.ConvertOptions(
                column_types={"0": stamp, **dict.fromkeys(names[1:], number)}
            ),
        ) as reader:
            return sum(batch.num_rows for batch in reader)

    def frames() -> int:
        types = dict.fromkeys(range(1, layout.width), str if shape.damaged else float)
        types |= {0: np.int64} if shape.stamps == "microseconds" else {}
        chunks = pd.read_csv(
            path, header=None, skiprows=1, dtype=types, engine="c", chunksize=2**16,
            parse_dates=[0] if shape.stamps == "iso" else False,
        )  # fmt: skip
        return sum(len(chunk) for chunk in chunks)

    return {"gyrostab": own, "pyarrow open_csv": stream, "pandas": frames}


def grown_memory(name: str, path: Path, shape: Shape) -> float:
    """Return by how much one parse of the file raises the peak memory of this process [MiB]."""
    work = parsers(path, shape)[name]
    before = memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins here
    work()
    return memory() - before


def main() -> None:
    """Print a table of CPU times and memory."""
    options = make_parser(__doc__)
    options.add_argument("--rows", type=int, default=1_000_000)
    options.add_argument("--rounds", type=int, default=3)
    chosen = options.parse_args()
    pa.set_cpu_count(1)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        for damaged, stamps, columns in product(
            (False, True), ("iso", "seconds", "microseconds"), (3, 11)
        ):
            shape = Shape(stamps, columns, damaged)
            write_file(path, shape, chosen.rows)
            works = parsers(path, shape)
            best = dict.fromkeys(works, np.inf)
            for turn in range(chosen.rounds + 1):
                for name, work in works.items():
                    begin = time.process_time()
                    assert work() == chosen.rows
                    if turn:  # the first warms up
                        best[name] = min(best[name], time.process_time() - begin)
            peaks = [in_new_process(grown_memory, name, path, shape) for name in works]
            cells = [f"{cpu:.2f} (x {cpu / best['gyrostab']:.1f})" for cpu in best.values()]
            rows.append([shape.name, *cells, ", ".join(f"{peak:.0f}" for peak in peaks)])
            print(*rows[-1], sep=" | ", flush=True)
    text = f"{table(['file', *works, 'peak memory [MiB]'], rows)}\n\nCPU time [s]. {machine()}"
    renew(chosen.output, "parsers", text)


if __name__ == "__main__":
    main()

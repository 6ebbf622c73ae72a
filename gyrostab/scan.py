"""A table of what is in some logs, before anything is computed from them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import pandas as pd
import xarray as xr

from gyrostab.errors import GyrostabError

__all__ = ["COLUMNS", "print_scan", "scan"]

#: Columns of the table; span in s, rate in Hz, missing as a share of the samples between start and end.
COLUMNS = ("file", "format", "start", "end", "span_s", "rate_hz", "axes", "channels", "rows", "gaps", "missing_share", "odd")


def scan(paths: Sequence[str | Path] | str | Path, **reading: Any) -> pd.DataFrame:
    r"""Say what is in some logs, one row a file.

    Each file is read once, by itself, and put on a uniform time axis to count what is missing.

    Parameters
    ----------
    paths : path, pattern, or several of them
        Logs in any format that gyrostab reads.
    **reading
        Options of `gyrostab.run.load_log`: those of `gyrostab.read.read_log`, and ``max_gap``.

    Returns
    -------
    pandas.DataFrame
        Columns of `COLUMNS`: file, format, start and end (UTC), span [s], sampling rate [Hz], axes, channels, rows, number of gaps, share
        of missing samples, and what is odd (for a file that cannot be read, why).

    Raises
    ------
    GyrostabError
        When none of the files can be read: the reason of the first.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "tool.csv"
    ...     _ = path.write_text("time [s],gyro_x [deg/h]\n" + "".join(f"{n / 10},{n % 3}\n" for n in range(50)))
    ...     table = scan(path)
    >>> print(table.loc[0, "rate_hz"], table.loc[0, "axes"], table.loc[0, "rows"])
    10.0 x 50
    """
    from gyrostab.read.files import expand

    names = expand(paths)
    rows: list[dict[str, Any]] = []
    errors: list[GyrostabError] = []
    for path in names:
        try:
            rows.append(_scan_one(path, reading))
        except GyrostabError as error:
            errors.append(error)
            rows.append({"file": str(path), "odd": str(error)})
    if errors and len(errors) == len(names):
        raise errors[0]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _scan_one(path: Path, reading: dict[str, Any]) -> dict[str, Any]:
    from gyrostab.read import ReadOptions, read_log, scan_file
    from gyrostab.regularise import gap_table, regularise
    from gyrostab.regularise.fill import count_present
    from gyrostab.schema import log_channels, signal_name, texts

    max_gap = reading.get("max_gap", "10D")
    reading = {name: value for name, value in reading.items() if name not in ("max_gap", "on_file")}
    summary = scan_file(path, ReadOptions(**reading))
    raw = read_log([path], **reading)
    regular = "sampling_rate_hz" in raw.attrs  # a log that gyrostab wrote
    log = raw if regular else regularise(raw, rate=reading.get("rate"), max_gap=max_gap, limits=reading.get("limits"))
    start, end = pd.DatetimeIndex(log["time"][[0, -1]].values)
    signal = log[signal_name(log)]
    notes = dict.fromkeys(note.removeprefix(f"{path.name}: ") for note in [*summary.notes, *texts(log, "notes")])
    return {
        "file": str(path),
        "format": summary.format,
        "start": start,
        "end": end,
        "span_s": (end.value - start.value) / 1e9,
        "rate_hz": float(log.attrs["sampling_rate_hz"]),
        "axes": " ".join(map(str, log["axis"].values)),
        "channels": " ".join(log_channels(log)),
        "rows": int(raw.sizes["time" if regular else "row"]),
        "gaps": len(gap_table(log)) if "gap_start" in log.variables else _count_runs(signal.isnull().all("axis")),
        "missing_share": 1.0 - count_present(signal.data) / signal.size,
        "odd": "; ".join(notes),
    }


def _count_runs(missing: xr.DataArray) -> int:
    """Count the runs of missing samples, for a log without a table of gaps."""
    return int((missing & ~missing.shift(time=1, fill_value=False)).sum())


def print_scan(table: pd.DataFrame) -> None:
    """Print the table of `scan`: framed on a terminal, plain tab-separated text elsewhere."""
    if not sys.stdout.isatty():
        table.to_csv(sys.stdout, sep="\t", index=False)
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console()
    framed = Table()
    for heading in ("file", "start (UTC)", "span", "rate [Hz]", "axes", "channels", "rows", "gaps", "missing"):
        framed.add_column(heading, overflow="fold", justify="right" if heading in ("rows", "gaps", "missing") else "left")
    for _, row in table.iterrows():
        if pd.isna(row["rate_hz"]):
            framed.add_row(escape(row["file"]), "[red]cannot be read[/red]")
            continue
        cells = (
            f"{row['file']} ({row['format']})",
            f"{row['start']:%Y-%m-%d %H:%M:%S}",
            _span(row["span_s"]),
            f"{row['rate_hz']:g}",
            row["axes"],
            row["channels"],
            f"{row['rows']:,.0f}",
            f"{row['gaps']:,.0f}",
            f"{row['missing_share']:.2%}",
        )
        framed.add_row(*map(escape, cells))
    console.print(framed)
    for _, row in table[table["odd"].fillna("") != ""].iterrows():
        console.print(f"[bold]{escape(row['file'])}[/bold]: {escape(row['odd'])}", highlight=False)


def _span(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds < 60.0 else str(timedelta(seconds=round(seconds)))

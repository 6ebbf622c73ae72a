"""Summarise logs in a table, and inspect files that need options."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.errors import GyrostabError
from gyrostab.ingest.columns.plan_roles import scan_advice
from gyrostab.ingest.files import expand, scan_file
from gyrostab.ingest.formats.text import read_text_head
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.ingest.grid.scan_pass import find_spans
from gyrostab.ingest.guess import guess_columns
from gyrostab.ingest.guess_unit import Guess
from gyrostab.ingest.inspect import FileInspection, inspect_file
from gyrostab.ingest.options import ReadOptions
from gyrostab.ingest.reading import read_log
from gyrostab.ingest.uniform import cut_log
from gyrostab.schema import escape_text, log_channels, signal_name, texts
from gyrostab.store.remote import given_name
from gyrostab.units import HOUR

#: Largest share of missing samples at a plausible sampling rate; above it, the mean rate of the
#: rows is tried.
MAX_MISSING_SHARE = 0.1
#: Samples from which the noise is estimated: 8 MB for each axis, an estimate within 1 %.
_MAX_NOISE_SAMPLES = 2**20

_FREQUENCY = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?) ?(k?)Hz\b", re.IGNORECASE)
_RATE_WORD = re.compile(r"(?<![a-z])(rate|odr)(?![a-z])|sampl", re.IGNORECASE)

#: Options that place or cut the samples of a log; the others are those of `ReadOptions`.
_CUTTING = ("time_from", "time_to", "exclude")
_PLACING = ("max_gap", "on_file", *_CUTTING)

#: Columns of the table: span [s], rate [Hz], share of missing samples between start and end.
COLUMNS = (
    "file",
    "format",
    "start",
    "end",
    "span_s",
    "rate_hz",
    "axes",
    "channels",
    "rows",
    "gaps",
    "missing_share",
    "odd",
)


def scan(paths: Sequence[str | Path] | str | Path, **reading: Any) -> pd.DataFrame:
    r"""Summarise logs in a table, one row per file.

    Each file is read separately and placed on a uniform time axis to count missing samples.

    Parameters
    ----------
    paths : path, pattern, or several of them
        Logs in any format that gyrostab reads.
    **reading
        Options of `gyrostab.jobs.run.load_log`: those of `gyrostab.ingest.read_log`, and
        ``max_gap``.

    Returns
    -------
    pandas.DataFrame
        Columns of `COLUMNS`: file, format, start and end (UTC), span [s], sampling rate [Hz], axes,
        channels, rows of the whole file, number of gaps in the file, share of missing samples, and
        notes ("odd"; for a file that cannot be read, the reason).

    Raises
    ------
    GyrostabError
        When no file can be read, with the reason for the first.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "tool.csv"
    ...     rows = "".join(f"{n / 10},{n % 3}\n" for n in range(50))
    ...     _ = path.write_text("time [s],gyro_x [deg/h]\n" + rows)
    ...     table = scan(path)
    >>> print(table.loc[0, "rate_hz"], table.loc[0, "axes"], table.loc[0, "rows"])
    10.0 x 50
    """
    examined = scan_and_inspect(paths, inspect=False, **reading)
    if examined.errors and len(examined.errors) == len(examined.table):
        raise examined.errors[0]
    return examined.table


@dataclass(frozen=True)
class InspectedFile:
    """Inspection of a file that needs options, with a guess and options that read it."""

    paths: list[Path]  # files with the same columns; the first was inspected
    inspection: FileInspection
    guess: Guess
    options: dict[str, Any]
    row: dict[str, Any] | None  # row of the table, read with these options
    error: GyrostabError | None  # why these options do not read it, if there is a gyro


@dataclass(frozen=True)
class ScanResult:
    """Table of `scan`, with errors and inspections of the files that need options."""

    table: pd.DataFrame
    errors: list[GyrostabError]
    inspected: list[InspectedFile]
    #: Angle random walk of each axis [deg/sqrt(h)], by the files that are read without options.
    white_noise: list[dict[str, float]]


def scan_and_inspect(
    paths: Sequence[str | Path] | str | Path, *, inspect: bool = True, **reading: Any
) -> ScanResult:
    """Scan logs as `scan` does, and `inspect` the columns of those that need options.

    Errors of unreadable files are collected, not raised. The first of files with the same columns
    is inspected.
    """
    rows: list[dict[str, Any]] = []
    errors: list[GyrostabError] = []
    inspected: dict[Any, InspectedFile | None] = {}
    for path in expand(paths):
        try:
            rows.append(_scan_one(path, reading))
        except GyrostabError as error:
            error.args = (str(error).removesuffix(scan_advice(path)),)
            inspected_file = _inspect_once(path, reading, inspected) if inspect else None
            failure = None if inspected_file is None or reading else inspected_file.error
            errors.append(failure or error)
            row: dict[str, Any] = {"file": given_name(path), "odd": str(errors[-1])}
            if inspected_file is not None and inspected_file.error is None:
                row["format"] = inspected_file.inspection.summary.format
                if inspected_file.paths == [path]:
                    row["rows"] = inspected_file.inspection.rows
            rows.append(row)
    for row in rows:
        row |= {key: escape_text(value) for key, value in row.items() if isinstance(value, str)}
    return ScanResult(
        pd.DataFrame(rows, columns=list(COLUMNS)),
        errors,
        [inspected_file for inspected_file in inspected.values() if inspected_file is not None],
        [row["white_noise"] for row in rows if "white_noise" in row],
    )


def _inspect_once(
    path: Path, reading: dict[str, Any], inspected: dict[Any, InspectedFile | None]
) -> InspectedFile | None:
    """Inspect a file, unless one with the same columns was inspected."""
    options = ReadOptions(**_select_reading(reading))
    try:
        headers = tuple(
            (column.header, column.role, column.unit) for column in scan_file(path, options).columns
        )
        if headers not in inspected:
            inspected[headers] = None
            inside = inspect_file(path, options)
            guess = guess_columns(
                inside, rate=options.rate, rate_hint=_named_rate(path), kind=options.kind
            )
            inspected[headers] = _try_guess(path, inside, guess, reading)
    except GyrostabError:
        return None
    inspected_file = inspected[headers]
    if inspected_file is not None and path not in inspected_file.paths:
        inspected_file.paths.append(path)
    return inspected_file


def _try_guess(
    path: Path, inspection: FileInspection, guess: Guess, reading: dict[str, Any]
) -> InspectedFile:
    """Read a file by the guess, and with its mean rate too if many samples seem to be missing."""
    axes = guess.axes.items()
    mapped = {column.key: f"gyro_{axis}" for axis, column in axes if column.role != "gyro"}
    if guess.time is not None and guess.time.role != "time":
        mapped[guess.time.key] = "time"
    for channel, (column, unit) in guess.channels.items():
        mapped[column.key] = f"{channel} [{unit}]"
    is_angle = any(column.name.lower().startswith("angle_") for _, column in axes)
    units = {"angle" if is_angle else "gyro": guess.unit, "time": guess.time_unit}
    guessed = {
        "map": {**reading.get("map", {}), **mapped},
        "unit": {**reading.get("unit", {}), **{key: unit for key, unit in units.items() if unit}},
        "rate": guess.rate,
        "kind": guess.kind,
    }
    chosen = {name: value for name, value in guessed.items() if value is not None}
    options = {name: value for name, value in {**reading, **chosen}.items() if value != {}}
    tries = [options]
    if "rate" not in options and math.isfinite(inspection.rate_hz):
        tries.append({**options, "rate": float(f"{inspection.rate_hz:.6g}")})
    failure: GyrostabError | None = None
    read: list[InspectedFile] = []
    for trial in tries if guess.axes else []:
        try:
            read.append(
                InspectedFile([path], inspection, guess, trial, _scan_one(path, trial), None)
            )
        except GyrostabError as error:
            failure = error
        if read and read[-1].row is not None and read[-1].row["missing_share"] < MAX_MISSING_SHARE:
            break
    best = min(read, key=lambda file: file.row["missing_share"] if file.row else 1.0, default=None)
    return best or InspectedFile([path], inspection, guess, options, None, failure)


def add_channel_files(
    options: dict[str, Any], inspected: Sequence[InspectedFile]
) -> dict[str, Any]:
    """Return options that also read the channels of the files without a gyro."""
    files = [
        file
        for file in inspected
        if not file.guess.axes
        and file.inspection.time is not None
        and any(column.role == "channel" for column in file.inspection.summary.columns)
    ]
    if not files:
        return options
    paths = [path for file in files for path in file.paths]
    names = {key: name for file in files for key, name in file.options.get("map", {}).items()}
    complete = {**options, "channel": [*options.get("channel", ()), *paths]}
    return {**complete, "map": {**options.get("map", {}), **names}} if names else complete


def _select_reading(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that belong to `ReadOptions`."""
    return {name: value for name, value in options.items() if name not in _PLACING}


def _named_rate(path: Path) -> float | None:
    """Find a sampling rate such as ``100 Hz`` in the text at the beginning of a file.

    If it names several frequencies, only one of them may be in a phrase on a rate or on sampling.
    """
    rates: dict[float, bool] = {}  # whether a phrase says that this is a rate
    for phrase in re.split(r"[\n,;]", read_text_head(path)):
        for match in _FREQUENCY.finditer(phrase):
            rate = float(match[1]) * (1000.0 if match[2] else 1.0)
            rates[rate] = rates.get(rate, False) or bool(_RATE_WORD.search(phrase))
    rates.pop(0.0, None)
    named = [rate for rate, is_named in rates.items() if is_named or len(rates) == 1]
    return named[0] if len(named) == 1 else None


def _scan_one(path: Path, reading: dict[str, Any]) -> dict[str, Any]:
    max_gap = reading.get("max_gap", "10D")
    cut = {name: reading[name] for name in _CUTTING if name in reading}
    reading = _select_reading(reading)
    summary = scan_file(path, ReadOptions(**reading))
    raw = read_log([path], **reading)
    placing = {"rate": reading.get("rate"), "max_gap": max_gap, "limits": reading.get("limits")}
    log = cut_log(regularise(raw, **placing), **cut)
    start, end = pd.DatetimeIndex(log["time"][[0, -1]].values)
    signal = log[signal_name(log)]
    notes = dict.fromkeys(
        note.removeprefix(f"{path.name}: ") for note in [*summary.notes, *texts(log, "notes")]
    )
    return {
        "file": given_name(path),
        "format": summary.format,
        "start": start,
        "end": end,
        "span_s": (end.value - start.value) / 1e9,
        "rate_hz": float(log.attrs["sampling_rate_hz"]),
        "axes": " ".join(map(str, log["axis"].values)),
        "channels": " ".join(log_channels(log)),
        "rows": int(raw.sizes["row" if "row" in raw.sizes else "time"]),
        "gaps": len(gap_table(log))
        if "gap_start" in log.variables
        else len(find_spans(signal.isnull().all("axis").values, 0)),
        "missing_share": 1.0 - int(signal.count()) / signal.size,
        "odd": "; ".join(notes),
        "notes": tuple(notes),
        "white_noise": _measure_white_noise(log),
    }


def _measure_white_noise(log: xr.Dataset) -> dict[str, float]:
    """Estimate N of each axis [deg/sqrt(h)] from at most `_MAX_NOISE_SAMPLES` in the middle.

    Where white noise dominates, the Allan deviation times the root of the averaging time is N, and
    more elsewhere: the smallest of averaging times a factor of two apart is taken, up to a
    hundredth of the samples.
    """
    signal = log[signal_name(log)]
    rate, size = float(log.attrs["sampling_rate_hz"]), signal.sizes["time"]
    begin = max(0, (size - _MAX_NOISE_SAMPLES) // 2)
    part = signal.isel(time=slice(begin, begin + _MAX_NOISE_SAMPLES)).transpose("axis", "time")
    values = np.asarray(part.values, dtype=np.float64)
    if signal.name == "angle":
        values = np.diff(values) * rate * HOUR
    noise = {}
    for axis, means in zip(signal["axis"].values, values, strict=True):
        levels, factor = [], 1
        while means.size >= 100:
            with np.errstate(over="ignore", invalid="ignore"):
                squares = np.diff(means) ** 2
                if np.isfinite(squares).any():
                    levels.append(float(np.nanmean(squares)) / 2.0 * factor / rate / HOUR)
                means = means[: means.size // 2 * 2].reshape(-1, 2).mean(axis=1)
            factor *= 2
        noise[str(axis)] = math.sqrt(min(levels, default=math.nan))
    return noise

"""Read paths into one raw log: read the files, leave out damaged ones, add channel files."""

from __future__ import annotations

import contextlib
import errno
from bisect import bisect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import xarray as xr

from gyrostab.errors import FormatError, GyrostabError, OptionError
from gyrostab.ingest.columns.pieces import SPILL_BYTES, Spool
from gyrostab.ingest.combine import (
    attach_channels,
    concatenate,
    continue_clocks,
    memory_bytes,
    move_to_disk,
    warn_notes,
)
from gyrostab.ingest.concat.core import concatenate_logs
from gyrostab.ingest.concat.grid import log_span
from gyrostab.ingest.files import expand, name_key, read_file, scan_file
from gyrostab.ingest.options import ReadOptions
from gyrostab.ingest.raw_rows import stamp_span
from gyrostab.ingest.uniform import check_same_rate
from gyrostab.schema import texts
from gyrostab.time.durations import duration_seconds
from gyrostab.time.stamps import format_stamp, to_nanoseconds

#: Largest share of unreadable files; more suggest a wrong option instead of damage.
MAX_LOST_SHARE = 0.5

#: Errors of the system that do not concern the single file.
_SYSTEM = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.EDQUOT, errno.EINTR)

Span = tuple[int, int]
#: Files that cannot be read, and why.
LostFiles = Mapping[Path, str]
#: Called with the number of a file, the number of files and the path.
OnFile = Callable[[int, int, Path], None]
#: Reads one file in place of `read_file`.
ReadFile = Callable[[Path, ReadOptions], xr.Dataset]


def read_log(
    paths: str | Path | Iterable[str | Path],
    *,
    rate: float | None = None,
    start: str | None = None,
    epoch: str | None = None,
    map: Mapping[str, str] | None = None,
    unit: Mapping[str, str] | None = None,
    missing_value: float | Sequence[float] = (),
    kind: str | None = None,
    channel: str | Path | Sequence[str | Path] = (),
    strict: bool = False,
    max_gap: str | float = "10D",
    limits: Mapping[str, float] | None = None,
    on_file: OnFile | None = None,
    read: ReadFile | None = None,
) -> xr.Dataset:
    r"""Read one or more logs as they were written.

    Parameters
    ----------
    paths : path, pattern, or several of them
        Files are concatenated in the order of their first stamps; an axis or channel that one of
        them lacks is NaN there. Either raw logs, or regular logs that gyrostab wrote, which become
        one regular log without being loaded.
    rate : float, optional
        Sampling rate [Hz] of files without a time column; otherwise the rate to check against.
    start : str, optional
        Stamp of the first row (ISO 8601, UTC) of files without a time column.
    epoch : str, optional
        Zero of a numeric time column (ISO 8601, UTC); 1970-01-01 when not given.
    map : mapping of str to str, optional
        Header name -> contract name, ``{"wx": "gyro_x [deg/s]"}``; ``"-"`` drops a column. Files
        without a header row are mapped by column number from 0: ``{"1": "gyro_x"}``.
    unit : mapping of str to str, optional
        Name -> unit: ``{"gyro": "deg/s"}`` (all gyro axes), ``{"gyro_x": ...}``, ``{"time":
        "us"}``; factors allowed (``"0.1 arcsec/s"``).
    missing_value : float or sequence of float, optional
        Numbers that mean a missing value in columns of the gyro and of channels, as they are
        written there: ``-999.25``.
    kind : {"rate", "angle"}, optional
        How angle columns are meant: ``"angle"`` cumulative, ``"rate"`` increments.
    channel : path or sequence of path, optional
        Files with further channels; each keeps its stamps as ``time_<channel>``.
    strict : bool
        Raise an error for a damaged or missing file. Otherwise such a file among several is left
        out with a note, and its time is a gap.
    max_gap : str or float
        Between regular logs, a longer step of time is taken as a step of the clock (raw logs: see
        `gyrostab.regularise`); a number is in seconds.
    limits : mapping of str to float, optional
        Limits of `gyrostab.ingest.limits` with other values, ``{"columns": 50_000}``.
    on_file : callable, optional
        Called with the number of the file (from 1), the number of files and the path before each
        file is read.
    read : callable, optional
        Function that reads one file, such as one that remembers files; by default each is read.

    Returns
    -------
    xarray.Dataset
        The raw log: ``rate(axis, row)`` [degree hour-1] or ``angle(axis, row)`` [degree],
        ``time(row)`` where the file has stamps (NaT where unreadable), channels, and the attributes
        ``kind``, ``source_files``, ``row_start``, ``notes``, ``unreadable_rows``,
        ``unreadable_cells``. Regular logs that gyrostab wrote are returned as one such log, lazily.
        ``unreadable_files`` lists the files that were left out.

    Raises
    ------
    FormatError, UnitError, OptionError, TimeError
        With file, position, what is wrong and what to do. `FormatError` also if more than half of
        the files cannot be read.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = Path(mkdtemp()) / "log.csv"
    >>> header = "time [s],gyro_x [deg/s],temperature [degC]\n"
    >>> _ = path.write_text(header + "0.0,0.5,21\n0.5,****,\n1.0,0.25,\n")
    >>> raw = read_log(path)
    >>> raw.rate.sel(axis="x").values
    array([1800.,   nan,  900.])
    >>> print(raw.attrs["notes"][-1])
    log.csv: 1 of 3 rows are unreadable: line 3 ('****')
    """
    longest_gap = duration_seconds(max_gap, "max_gap")
    options = ReadOptions(
        rate=rate,
        start=start,
        epoch=epoch,
        map=map or {},
        unit=unit or {},
        missing_value=missing_value,
        kind=kind,
        channel=channel,
        strict=strict,
        limits=limits or {},
    )
    files = expand(paths)
    extra = expand(options.channel) if options.channel else []
    parts, lost = _read_all(files, options, on_file, read or read_file)
    regular = [path for path, part in parts.items() if "sampling_rate_hz" in part.attrs]
    if regular and len(regular) < len(parts):
        raw = next(path for path in parts if path not in regular)
        raise OptionError(
            f"{regular[0].name} is a regular log already and {raw.name} is not; convert the raw "
            "logs with gyrostab ingest, and then read all of them together"
        )
    channels = [read_file(path, replace(options, channels_only=True, start=None)) for path in extra]
    if regular:
        log = _join_regular(parts, lost, options, longest_gap)
    else:
        log = _join_raw(parts, lost, options, channels)
    log = attach_channels(log, channels)
    if channels:
        log.attrs["notes"] = [note for part in (log, *channels) for note in texts(part, "notes")]
        log.attrs["channel_files"] = [part.attrs["source_files"][0] for part in channels]
    return log


def read_channel(
    path: str | Path,
    name: str = "temperature",
    *,
    epoch: str | None = None,
    map: Mapping[str, str] | None = None,
    unit: Mapping[str, str] | None = None,
) -> xr.DataArray:
    r"""Read one channel from a file in any readable format; the file needs no gyro axes.

    Parameters
    ----------
    path : path
        File with a time column.
    name : str
        Name of the channel after `map` is applied.
    epoch, map, unit
        As for `gyrostab.read_log`.

    Returns
    -------
    xarray.DataArray
        Values on ``time_<name>``, with units of `gyrostab.units.INNER`.

    Raises
    ------
    FormatError, UnitError, OptionError, TimeError
        When the file cannot be read or does not contain the channel.

    Warns
    -----
    UserWarning
        With each note on the file, for instance on unreadable rows or codes for missing values.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = Path(mkdtemp()) / "probe.csv"
    >>> _ = path.write_text("time [s],temperature [degC]\n0.0,20.5\n1.0,21.0\n")
    >>> read_channel(path).values
    array([20.5, 21. ])
    """
    options = ReadOptions(channels_only=True, epoch=epoch, map=map or {}, unit=unit or {})
    table = read_file(Path(path), options)
    channels = attach_channels(xr.Dataset(), [table])
    if name not in channels.data_vars:
        available = ", ".join(sorted(str(key) for key in channels.data_vars))
        raise OptionError(
            f"{path}: no channel {name!r}; the channels are {available}: name one of these, or "
            "rename one with --map"
        )
    warn_notes(table)
    return channels[name]


def _read_all(
    paths: Sequence[Path], options: ReadOptions, on_file: OnFile | None, read_one: ReadFile
) -> tuple[dict[Path, xr.Dataset], dict[Path, str]]:
    """Read the files one by one; move them to disk when they exceed the memory limit together."""
    parts: dict[Path, xr.Dataset] = {}
    lost: dict[Path, str] = {}
    spool = Spool()
    held = 0
    for number, path in enumerate(paths, 1):
        if on_file is not None:
            on_file(number, len(paths), path)
        try:
            part = read_one(path, options)
        except (GyrostabError, OSError) as error:
            if options.strict or len(paths) == 1 or not _is_damage(path, error):
                raise
            lost[path] = _reason_of(path, error)
            continue
        size = memory_bytes(part)
        if held + size > SPILL_BYTES and len(paths) > 1:
            part, size = move_to_disk(part, spool), 0
        held += size
        parts[path] = part
    if len(lost) > MAX_LOST_SHARE * len(paths):
        advice = "that is more than damage: check the names and the reading options"
        raise FormatError(
            f"{next(iter(lost.values()))}; {len(lost)} of {len(paths)} files cannot be read, "
            f"{advice}"
        )
    return parts, lost


def _join_regular(
    parts: Mapping[Path, xr.Dataset], lost: LostFiles, options: ReadOptions, max_gap: float
) -> xr.Dataset:
    """Join regular logs to one."""
    logs = [_check_regular(part, path.name, options) for path, part in parts.items()]
    spans = _find_lost_spans(lost, parts, options)
    gaps, limits = list(spans.values()), options.limits
    log = concatenate_logs(logs, list(parts), max_gap=max_gap, lost=gaps, limits=limits)
    return _add_lost_notes(log, lost, spans)


def _join_raw(
    parts: dict[Path, xr.Dataset],
    lost: LostFiles,
    options: ReadOptions,
    channels: Sequence[xr.Dataset],
) -> xr.Dataset:
    """Join raw logs to one; the options may concern the files with `channels` too."""
    by_name = sorted(parts, key=name_key)
    parts |= zip(by_name, continue_clocks([parts[path] for path in by_name]), strict=True)
    spans = _find_lost_spans(lost, parts, options)
    refuse_unused_options([*parts.values(), *channels])
    log = concatenate(list(parts.values()))
    if lost and "time" not in log.variables:
        raise FormatError(
            f"{next(iter(lost.values()))}; the files have no time stamps, so the time of "
            "those that follow it is not known: repair it"
        )
    if spans:
        # regularise marks the gaps there
        log.attrs["unreadable_spans"] = [list(span) for span in spans.values()]
    return _add_lost_notes(log, lost, spans)


def _check_regular(log: xr.Dataset, name: str, options: ReadOptions) -> xr.Dataset:
    """Refuse options that contradict a regular log, and note options that have no effect on it."""
    if options.rate is not None:
        check_same_rate(log, options.rate, name)
    idle = [
        f"--{option.replace('_', '-')}"
        for option in ("start", "epoch", "map", "unit", "missing_value", "kind")
        if getattr(options, option)
    ]
    if not idle or options.channel:
        return log
    note = f"{name}: is a regular log already, so {', '.join(idle)} is not used"
    return log.assign_attrs(notes=[*texts(log, "notes"), note])


def refuse_unused_options(parts: Sequence[xr.Dataset]) -> None:
    """Refuse a ``--map`` or ``--unit`` that matches no file; it is probably mistyped."""
    unmatched = set.intersection(*(set(part.attrs.pop("unmatched_options", ())) for part in parts))
    headers = dict.fromkeys(name for part in parts for name in part.attrs.pop("headers", ()))
    if unmatched:
        files = ", ".join(
            dict.fromkeys(name for part in parts for name in part.attrs["source_files"])
        )
        raise OptionError(
            f"{' and '.join(sorted(unmatched))}: no such column in {files}; the columns are "
            f"{', '.join(headers)}"
        )


def _is_damage(path: Path, error: Exception) -> bool:
    """Return whether an error is due to one damaged or missing file.

    A wrong option, a missing unit, or a system out of disk space, memory or file handles is not.
    """
    if path.is_dir() and path.suffix.lower() != ".zarr":
        return False
    if isinstance(error, GyrostabError):
        return isinstance(error, FormatError) and not isinstance(error.__cause__, MemoryError)
    return isinstance(error, OSError) and error.errno not in _SYSTEM


def _reason_of(path: Path, error: Exception) -> str:
    """Describe what is wrong with a file, in one line that begins with its name."""
    if isinstance(error, OSError) and not isinstance(error, GyrostabError):
        return f"{path.name}: cannot be read ({error.strerror or error})"
    text = " ".join(str(error).split())
    return text if path.name in text.split(": ")[0] else f"{path.name}: {text}"


def _find_lost_spans(
    lost: LostFiles, parts: Mapping[Path, xr.Dataset], options: ReadOptions
) -> dict[Path, Span]:
    """Find the time spans [ns since 1970] of lost files, as far as they can be determined.

    A lost file fills the gap between the files whose names come before and after its name, if these
    follow each other in time; `parts` are the files that were read. Otherwise the stamps that are
    still readable are used.
    """
    if not lost:
        return {}
    spans = {
        path: log_span(part) if "sampling_rate_hz" in part.attrs else stamp_span(part)
        for path, part in parts.items()
        if "time" in part.variables
    }
    names = sorted(spans, key=name_key)
    lost_spans: dict[Path, Span] = {}
    for path in lost:
        place = bisect(names, name_key(path), key=name_key)
        has_both = 0 < place < len(names)
        between = _span_between(spans, names[place - 1], names[place]) if has_both else None
        if span := between or _span_of_stamps(path, options):
            lost_spans[path] = span
    return lost_spans


def _span_between(spans: Mapping[Path, Span], previous_path: Path, next_path: Path) -> Span | None:
    """Return the time between two consecutive files; None if a third lies between."""
    (_, end), (start, _) = sorted([spans[previous_path], spans[next_path]])
    other_spans = [span for path, span in spans.items() if path not in (previous_path, next_path)]
    free = end < start and not any(first < start and last > end for first, last in other_spans)
    return (end, start) if free else None


def _span_of_stamps(path: Path, options: ReadOptions) -> Span | None:
    """Return the first and last readable stamp of a damaged file."""
    with contextlib.suppress(GyrostabError, OSError, RuntimeError, ValueError):
        summary = scan_file(path, options)
        if summary.first is not None and summary.last is not None and summary.first < summary.last:
            return int(to_nanoseconds(summary.first)), int(to_nanoseconds(summary.last))
    return None


def _add_lost_notes(log: xr.Dataset, lost: LostFiles, spans: Mapping[Path, Span]) -> xr.Dataset:
    """Add notes on the lost files, and their names as ``unreadable_files``."""
    if not lost:
        return log
    notes = []
    for path, reason in lost.items():
        where = "where no other file has its time, there is a gap"
        if path in spans:
            first, last = map(format_stamp, spans[path])
            where = (
                f"its time is between {first} and {last}, which is a gap unless another file "
                "covers it"
            )
        notes.append(f"{reason}; the file is left out: {where}")
    return log.assign_attrs(
        notes=[*texts(log, "notes"), *notes],
        unreadable_files=[*texts(log, "unreadable_files"), *(path.name for path in lost)],
    )

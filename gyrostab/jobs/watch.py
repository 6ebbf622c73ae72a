"""Follow growing logs: the product of the rows so far, at any moment that of a run over them.

Whenever rows for a new window have come, all files are read as a run reads them (`load_log`), where
files that have not changed are remembered. Windows are computed in the units of work of a run, and
only units whose samples differ from the last time: the last one, which grows, and earlier ones into
which late rows fell.
"""

from __future__ import annotations

import contextlib
import json
import re
import sys
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
import xarray as xr

from gyrostab.allan.plan import last_sample, make_plan, units_of_work
from gyrostab.errors import FormatError, GyrostabError, OptionError, OutputError, TimeError
from gyrostab.ingest.uniform import cut_log
from gyrostab.io.growing import LayoutError, write_windows
from gyrostab.io.opening import open_product
from gyrostab.jobs.alarms import Alarm, check_alarms, describe_windows
from gyrostab.jobs.engine import compute_part, find_record_bands
from gyrostab.jobs.follow import FileMemory, FileStates, RowKeeper, hash_samples, list_files
from gyrostab.jobs.job import describe_differences, lock_output, make_fingerprint
from gyrostab.jobs.load import check_run_options, load_log
from gyrostab.kernels.workspace import Workspace
from gyrostab.schema import escape_text, log_channels, signal_name, texts
from gyrostab.store.lazy import find_source
from gyrostab.store.output import check_output, protect_inputs
from gyrostab.store.remote import find_url, full_name
from gyrostab.store.system import release_memory, return_large_arrays
from gyrostab.time.durations import duration_seconds, samples
from gyrostab.time.grid import first_stamp, grid_times

#: Attribute of the product with the source and the options that made it.
_IDENTITY = "gyrostab_watch"
#: Largest share of the time that is spent on updates: after a long one, the next one waits.
_MAX_WORK_SHARE = 0.1
#: Share of the bytes that the next window is estimated to need from which on files are read.
_DUE_SHARE = 0.9
#: Notes whose counts matter are repeated when the counts change.
_COUNTED_NOTES = ("out of order", "dropped")


class Listener(Protocol):
    """Receives what a live view finds."""

    def show_window(self, window: Mapping[str, Any]) -> None:
        """Receive a new window, as `gyrostab.jobs.alarms.describe_windows` returns it."""

    def show_alarm(self, event: Mapping[str, str]) -> None:
        """Receive the begin or end of an alarm: ``time``, ``state`` and ``text``."""

    def show_note(self, text: str) -> None:
        """Receive a remark on the rows, or on what is awaited."""


def rows_folder(output: str | Path) -> Path:
    """Return the folder in which the rows of standard input are kept."""
    path = Path(output)
    return path.with_name(f"{path.stem}-rows")


def watch(
    source: str,
    output: str | Path,
    *,
    listener: Listener,
    reading: Mapping[str, Any] | None = None,
    windows: Mapping[str, Any] | None = None,
    fitting: Mapping[str, Any] | None = None,
    alarms: Sequence[Alarm] = (),
    lateness: str | None = None,
    idle: str | None = None,
    poll: float = 1.0,
    overwrite: bool = False,
    stream: IO[bytes] | None = None,
) -> Path:
    """Follow growing logs, and append each window to a Zarr product once it is complete.

    The product equals that of `gyrostab.jobs.run.run` on the same rows, bit for bit.

    Parameters
    ----------
    source : str
        A folder, a pattern or a file; or ``-`` for rows of `stream`, which are kept in
        `rows_folder`.
    output : path
        Zarr store. One that this function made of the same source with the same options is
        continued.
    listener : Listener
        Receives windows, alarms and notes.
    reading, windows, fitting : mapping
        As for `gyrostab.jobs.run.run`; the window is 10 min by default.
    alarms : sequence of Alarm
        Limits, see `gyrostab.jobs.alarms.parse_alarm`.
    lateness : str, optional
        How long after its end a window waits for rows that come out of order, in the time of the
        stamps. A window into which rows fall later is computed again.
    idle : str, optional
        Return when no row has arrived for this long. By default, only the end of the stream, or an
        interruption, ends the function; the last windows are then written too.
    poll : float
        Time between two looks at the files [s].
    overwrite : bool
        Replace an existing output.
    stream : binary file, optional
        Standard input by default.

    Returns
    -------
    Path
        The product.

    Raises
    ------
    OutputError
        When the output exists and is not that of the same source, its files and options, or cannot
        be written.
    ResumeError
        When there is an unfinished run of the output without `overwrite`, or another process works
        on it.
    OptionError, UnitError
        When an option or the unit of a column is wrong or missing.
    FormatError
        When no window could be computed until the end.
    """
    windows = {"window": "10min", **(windows or {})}
    options = check_run_options(reading=reading, windows=windows, fitting=fitting)
    return_large_arrays()
    wait = duration_seconds(lateness, "--lateness") if lateness else 0.0
    quiet = duration_seconds(idle, "--idle") if idle else np.inf
    path = Path(output)
    with protect_inputs([] if source == "-" else [source], growing=True):
        identity = make_fingerprint([], options)
        identity["inputs"] = [{"path": source if source == "-" else full_name(source)}]
        place = str(rows_folder(path)) if source == "-" else source
        until = _continue_product(path, place, identity, overwrite=overwrite)
        with lock_output(path, overwrite=overwrite):
            keeper = None
            if source == "-":
                if overwrite and rows_folder(path).exists():
                    raise OutputError(
                        f"{rows_folder(path)} holds the rows of an earlier live view, which a new "
                        "one would include; move or remove that folder, or give another name with "
                        "-o"
                    )
                if until is None and (earlier_files := list_files(place)):
                    count = len(earlier_files)
                    listener.show_note(
                        f"{place} holds the rows of an earlier live view ({count} "
                        f"file{'s' * (count > 1)}), which are part of this one; stop, and move "
                        "that folder, if they should not be"
                    )
                keeper = RowKeeper(stream or sys.stdin.buffer, rows_folder(path))
            attrs = {_IDENTITY: json.dumps(identity)}
            view = _View(path, options, attrs, wait, alarms, listener, until)
            _follow_source(view, place, keeper, quiet, poll)
    return path


def _follow_source(
    view: _View, source: str, keeper: RowKeeper | None, quiet: float, poll: float
) -> None:
    """Update a view until the stream has ended, nothing has come for long, or Ctrl-C."""
    changed = time.monotonic()
    if keeper is None and not list_files(source):
        view.listener.show_note(
            f"waiting: there is no file at {source} yet; subfolders are not followed"
        )
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            ended = keeper is not None and keeper.ended
            files = list_files(source)
            if files != view.memory.files:
                changed = time.monotonic()
                view.take_files(files)
            if ended or time.monotonic() - changed > quiet:
                break
            view.update()
            time.sleep(poll)
    if keeper is not None and keeper.error is not None:
        raise keeper.error
    view.memory.ended = True
    view.take_files(list_files(source))
    view.update(final=True)


def _continue_product(
    path: Path, place: str, identity: dict[str, Any], *, overwrite: bool
) -> np.datetime64 | None:
    """Check that the output can be written; find the last window of one that is continued.

    The files of the source are at `place`.
    """
    if find_url(path):
        raise OptionError(
            f"{find_url(path)}: a live view writes to a local store; copy it to the address with "
            "a tool such as aws s3 sync"
        )
    before = None
    if path.exists() and not overwrite:
        with contextlib.suppress(GyrostabError), open_product(path) as product:
            before = product.attrs.get(_IDENTITY)
            until: np.datetime64 = product["time"].values[-1]
            names = texts(product, "source_files")
    if before is None:
        check_output(path, suffixes=[".zarr"], overwrite=overwrite)
        return None
    check_output(path, suffixes=[".zarr"], overwrite=True)
    present = {escape_text(file.name) for file in list_files(place)}
    gone = next((name for name in names if name not in present), None)
    changes = describe_differences(json.loads(before), identity)
    if gone and not changes:
        changes = f"{place} has no {gone} any more, whose windows it holds"
    if changes:
        raise OutputError(
            f"output {str(path)!r} exists already, and {changes}; give the same files and options "
            "to continue it, --overwrite to replace it, or another name with -o"
        )
    return until


@dataclass
class _View:
    """The product so far, and which samples it was computed from."""

    path: Path
    options: dict[str, Any]
    attrs: dict[str, str]
    lateness: float  # s
    alarms: Sequence[Alarm]
    listener: Listener
    until: np.datetime64 | None  # last window that this call, or an earlier one, has shown
    memory: FileMemory = field(default_factory=FileMemory)
    space: Workspace = field(default_factory=Workspace)
    digests: list[bytes] = field(default_factory=list)
    common: str = ""
    shown: int = 0  # windows
    missing_samples: int = 0
    samples: int = 0
    n_bytes: int = 0
    next_update: float = 0.0
    notes: set[str] = field(default_factory=set)
    is_new_data: bool = False

    def __post_init__(self) -> None:
        self.exists = self.until is not None

    def take_files(self, files: FileStates) -> None:
        """Take over a new list of files."""
        if self.memory.update(files):
            self.digests, self.common = [], ""
            self.shown, self.missing_samples, self.n_bytes = 0, 0, 0
            text = "a file was cut, replaced or removed, so the product is computed again"
            if self.until is not None:
                text += f"; windows up to {self.until} are not shown again"
            self.listener.show_note(text)
        self.is_new_data = True

    def update(self, *, final: bool = False) -> None:
        """Compute and write the windows that are complete now, if there may be new ones."""
        if not final and not (self.is_new_data and self._is_due()):
            return
        if not self.memory.files:
            if final:
                raise FormatError("no row was received, so there is no product")
            return
        begun = time.monotonic()
        try:
            self._update_product(final=final)
        except (FormatError, TimeError) as error:
            if final and not self.exists:
                raise
            self._show_note(f"waiting: {error}")
        release_memory()
        self.is_new_data = False
        spent = time.monotonic() - begun
        self.next_update = time.monotonic() + spent * (1.0 / _MAX_WORK_SHARE - 1.0)

    def _is_due(self) -> bool:
        """Whether a new window may be complete: by the time of the last update, and by bytes."""
        held = sum(state["bytes"] for state in self.memory.files.values())
        needed = _DUE_SHARE * self.missing_samples * self.n_bytes / max(self.samples, 1)
        return time.monotonic() >= self.next_update and held >= self.n_bytes + needed

    def _show_note(self, text: str) -> None:
        """Show a note once, and again when the number of rows in it changes."""
        counts = any(kind in text for kind in _COUNTED_NOTES)
        key = text if counts else re.sub(r"\d+", "", text)
        if key not in self.notes:
            self.notes.add(key)
            self.listener.show_note(text)

    def _load_rows(self) -> xr.Dataset:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            log = load_log(
                list(self.memory.files), **self.options["reading"], read=self.memory.read
            )
        for warning in caught:
            self._show_note(str(warning.message))
        return log

    def _update_product(self, *, final: bool) -> None:
        log, windows = self._load_rows(), self.options["windows"]
        self.n_bytes = sum(state["bytes"] for state in self.memory.files.values())
        self.samples = log.sizes["time"]
        rate = float(log.attrs["sampling_rate_hz"])
        wait = 0 if final else round(self.lateness * rate)
        points = samples(windows["window"], rate, "window") + (signal_name(log) == "angle")
        complete = self.samples - wait - points
        if complete < 0 and not (final and not self.exists):
            self.missing_samples = -complete
            return
        unit = make_plan(log, **windows).unit  # at the end, it raises that the record is too short
        count = complete // unit.step + 1
        self.missing_samples = count * unit.step - complete
        size = last_sample(slice(0, count), unit)
        units = units_of_work(size, unit)
        spans = [(part.start * unit.step, last_sample(part, unit)) for part in units]
        start = first_stamp(log)
        used = log
        if wait:
            used = cut_log(log, time_to=np.datetime64(int(grid_times(start, rate, size)), "ns"))
        fitting = find_record_bands(used, windows, self.options["fitting"])
        source = type(find_source(log[signal_name(log)].data)).__name__
        common = repr(
            (start, rate, fitting, log["axis"].values.tolist(), log_channels(log), source)
        )
        digests = [hash_samples(log, span, common) for span in spans]
        same_record, self.common = common == self.common, common
        self._write_product(used, units, digests, fitting or {}, same_record=same_record)

    def _write_product(
        self,
        log: xr.Dataset,
        units: list[slice],
        digests: list[bytes],
        fitting: Mapping[str, Any],
        *,
        same_record: bool,
    ) -> None:
        """Compute the units whose samples have changed, write and show them."""
        exists = self.exists and self.path.exists()
        old = self.digests if exists else []
        same = [i < len(old) and old[i] == digest for i, digest in enumerate(digests)]
        if all(same) and len(old) == len(digests):
            return

        def compute(parts: Sequence[slice]) -> Iterator[tuple[slice, xr.Dataset]]:
            for part in parts:
                result = compute_part(log, part, self.options["windows"], fitting, self.space)
                windows = describe_windows(result.isel(time=slice(self.shown - part.start, None)))
                if windows and not self.shown:
                    check_alarms(self.alarms, windows[0])
                yield part, result.assign_attrs(self.attrs)
                self._show_windows(windows)

        changed = [part for part, is_same in zip(units, same, strict=True) if not is_same]
        layout = {"size": units[-1].stop, "unit": units[0].stop}
        try:
            is_continued = exists and same_record  # otherwise all units have changed
            write_windows(self.path, compute(changed), new=not is_continued, **layout)
        except LayoutError:
            write_windows(self.path, compute(units), new=True, **layout)
        self.digests = digests
        self.exists = True
        revised = sum(not is_same for is_same in same[: len(old) - 1]) if same_record else 0
        if revised:
            self.listener.show_note(
                f"late rows changed {revised} earlier part{'s' * (revised > 1)} of the record; "
                "the windows there were computed again"
            )

    def _show_windows(self, windows: Sequence[Mapping[str, Any]]) -> None:
        """Show new windows and alarms; windows that were shown before only set the alarms."""
        for window in windows:
            self.shown += 1
            stamp = np.datetime64(window["time"])
            is_known = self.until is not None and bool(stamp <= self.until)
            if not is_known:
                self.until = stamp
                self.listener.show_window(window)
            for event in (event for alarm in self.alarms for event in alarm.update(window)):
                if not is_known:
                    self.listener.show_alarm(event)

"""The command that follows growing logs."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from gyrostab.cli.console import Output, app
from gyrostab.cli.options import Common, Fitting, Reading, Windowing, whole_number
from gyrostab.wording import format_rounded

if TYPE_CHECKING:
    from gyrostab.jobs.alarms import Alarm
    from gyrostab.jobs.live_page import LivePage


@app.command(sort_key=4, help_epilogue="")
def watch(
    source: Annotated[str, Parameter(name="FOLDER", allow_leading_hyphen=True)],
    /,
    *,
    output: Output,
    alarm: Annotated[list[str] | None, Parameter(metavar="LIMIT", negative=())] = None,
    lateness: Annotated[str | None, Parameter(metavar="DURATION")] = None,
    idle: Annotated[str | None, Parameter(metavar="DURATION")] = None,
    serve: Annotated[int | None, whole_number(0, "PORT")] = None,
    windows: Windowing = Windowing(),
    fitting: Fitting = Fitting(),
    reading: Reading = Reading(),
    common: Common = Common(),
) -> None:
    """Follow logs that grow: append each window to a Zarr product, and print a line for it.

    The product equals that of gyrostab run on the rows so far, bit for bit. Ctrl-C writes the last
    windows and ends; the same command continues the product without --overwrite. --overwrite is
    needed to replace a product of another source, of files that are gone, or of other options.

    Example: gyrostab watch /data/run7 -o run7-live.zarr --window 10min --serve 8080

    Parameters
    ----------
    source
        A folder in which files appear and grow, a pattern in quotes, a file, or - for rows of text
        on the standard input, which are kept in the folder OUTPUT-rows.
    output
        Zarr store to write, or to continue.
    alarm
        Report when a limit is exceeded, and when it no longer is: "N>0.01 deg/sqrt(h)" (or Q, B,
        K, R),
        "x:N>0.01 deg/sqrt(h)" for one axis, misfit>3 (chi2/dof), "loss>5 %" (missing samples),
        "temperature>125 degC" (a channel, by its name in the product). Repeat for more.
    lateness
        How long a window waits for rows that come out of order: 10s. Rows that come even later
        are still placed, and the windows that they change are computed again.
    idle
        End if no new rows come for this long: 1h.
    serve
        Show the windows and alarms on a page at this port of 127.0.0.1, which is updated every two
        seconds; 0 for any free port.
    """
    from gyrostab.jobs.alarms import parse_alarm
    from gyrostab.jobs.live_page import LivePage
    from gyrostab.jobs.watch import watch as follow

    alarms = [parse_alarm(text) for text in alarm or ()]
    page = None if serve is None else LivePage(serve, f"gyrostab watch {source}")
    if page is not None:
        print(f"page: {page.address}", flush=True)
    try:
        target = follow(
            source,
            output,
            reading=reading.options(),
            windows=windows.options(),
            fitting=fitting.options(),
            alarms=alarms,
            lateness=lateness,
            idle=idle,
            overwrite=common.overwrite,
            listener=_Console(alarms, page),
        )
    finally:
        if page is not None:
            page.close()
    print(target)


class _Console:
    """Prints windows, alarms and notes, and hands them to the page."""

    def __init__(self, alarms: list[Alarm], page: LivePage | None):
        self.alarms, self.page = alarms, page

    def show_window(self, window: Mapping[str, Any]) -> None:
        """Print a line."""
        print(_format_window(window), flush=True)
        if self.page is not None:
            self.page.add_window(window)

    def show_alarm(self, event: Mapping[str, str]) -> None:
        """Print that an alarm begins or ends."""
        print(f"{event['time'][:19]}  {event['text']}", flush=True)
        self._add_event(event)

    def show_note(self, text: str) -> None:
        """Print a note on stderr."""
        import sys

        print(f"note: {text}", file=sys.stderr, flush=True)
        now = datetime.now(UTC).isoformat(timespec="seconds")
        self._add_event({"time": now, "state": "note", "text": text})

    def _add_event(self, event: Mapping[str, str]) -> None:
        if self.page is not None:
            active = [
                f"{alarm.text}{f', axis {axis}' if axis else ''}"
                for alarm in self.alarms
                for axis in sorted(alarm.active)
            ]
            self.page.add_event(event, active)


def _format_window(window: Mapping[str, Any]) -> str:
    """Format a window as one line: its centre, and for each axis what is observed.

    Examples
    --------
    >>> values = {"N": 0.0123, "N_upper": None, "B": None, "B_upper": 0.4, "misfit": 1.1, "loss": 0}
    >>> _format_window({"time": "2026-05-01T00:05:00.000", "axes": {"x": values}})
    '2026-05-01T00:05:00  x: N 0.0123 B <0.4 misfit 1.1 loss 0%'
    """
    axes = []
    for axis, values in window["axes"].items():
        shown = []
        for name, value in values.items():
            limit = values.get(f"{name}_upper")
            if value is not None and not name.endswith("_upper"):
                shown.append(f"{name} {format_rounded(value, 3)}{'%' if name == 'loss' else ''}")
            elif limit is not None:
                shown.append(f"{name} <{format_rounded(limit, 3)}")
        axes.append(f"{axis}: {' '.join(shown)}")
    return "  ".join([window["time"][:19], *axes])

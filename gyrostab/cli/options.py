"""The options that several commands share, as they stand on the command line, and their way to the functions."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter
from cyclopts.validators import Number

from gyrostab.errors import OptionError
from gyrostab.ingest.limits import check_limits

__all__ = ["ChannelFile", "Common", "Fitting", "Flag", "Reading", "Running", "Windows", "read_toml"]

_READING = Group("Reading options", sort_key=1)
_WINDOWS = Group("Analysis options", sort_key=2)
_FITTING = Group("Fitting options", sort_key=3)
_RUNNING = Group("Running options", sort_key=4)
_COMMON = Group("Common options", sort_key=5)
Flag = Annotated[bool, Parameter(negative=(), show_default=False)]


@Parameter(name="*", group=_READING)
@dataclass(frozen=True)
class Reading:
    """How a log is to be read where it does not say so itself.

    Parameters
    ----------
    rate
        Sampling rate in Hz, for a log without a time column (otherwise the rate is found from the
        time stamps and checked against this).
    start
        Time of the first row, for a log without a time column: 2026-11-20T14:00:00.
    epoch
        Day from which a time column in seconds counts: 2026-11-20 (default 1970-01-01).
    map
        Rename a column: wx=gyro_x. Repeat for more columns, or give a TOML file with one line per
        column: wx = "gyro_x".
    unit
        Unit of a column that has none: gyro=deg/s, gyro_x=deg/s, temperature=degC; of counts:
        "gyro=0.1 arcsec/s". Repeat for more.
    kind
        Whether the gyro columns are rotation rates or angles.
    channel
        Another file with a channel (temperature, vibration ...) of the same time. Repeat for more.
    max_gap
        Longest gap; a longer step of the time stamps is taken for a step of the clock.
    strict
        Stop at a damaged or missing file instead of leaving a gap.
    time_from
        Use the log from this time on: 2026-11-20T14:00 (UTC), or 10min after its start.
    time_to
        Use the log up to this time, in the same manner.
    exclude
        Take the samples of a span as missing: 2026-11-20T14:00/2026-11-20T14:05, or 10min/15min
        after the start. Repeat for more.
    limit
        Raise a limit that a message names: columns=50000. Repeat for more.
    """

    rate: Annotated[float | None, Parameter(metavar="HZ")] = None
    start: Annotated[str | None, Parameter(metavar="TIME")] = None
    epoch: Annotated[str | None, Parameter(metavar="TIME")] = None
    map: Annotated[list[str] | None, Parameter(metavar="HEADER=NAME", negative=())] = None
    unit: Annotated[list[str] | None, Parameter(metavar="NAME=UNIT", negative=())] = None
    kind: Literal["rate", "angle"] | None = None
    channel: Annotated[list[Path] | None, Parameter(metavar="FILE", negative=())] = None
    max_gap: Annotated[str, Parameter(metavar="DURATION")] = "10D"
    strict: Flag = False
    time_from: Annotated[str | None, Parameter(name="--from", metavar="TIME")] = None
    time_to: Annotated[str | None, Parameter(name="--to", metavar="TIME")] = None
    exclude: Annotated[list[str] | None, Parameter(metavar="START/END", negative=())] = None
    limit: Annotated[list[str] | None, Parameter(metavar="NAME=NUMBER", negative=())] = None

    def given(self) -> dict[str, Any]:
        """The options that differ from their defaults."""
        return {
            name: value
            for name, value in self.options().items()
            if (name, value) != ("max_gap", Reading.max_gap)
        }

    def options(self) -> dict[str, Any]:
        """Keyword arguments of `gyrostab.jobs.run.load_log`."""
        chosen = {
            **asdict(self),
            "map": _parse_pairs(self.map, "--map"),
            "unit": _parse_pairs(self.unit, "--unit"),
            "channel": tuple(self.channel or ()),
            "limits": check_limits(_parse_pairs(self.limit, "--limit")),
        }
        del chosen["limit"]
        return {
            name: value
            for name, value in chosen.items()
            if value not in (None, (), {}) and value is not False
        }


@Parameter(name="*", group=_READING)
@dataclass(frozen=True)
class ChannelFile:
    """One channel of another file.

    Parameters
    ----------
    channel
        Another file that holds the channel, in any format that gyrostab reads; aligned by its time
        stamps.
    epoch
        Day from which a time column in seconds counts in that file: 2026-11-20 (default
        1970-01-01).
    map
        Rename a column of that file: T_probe=temperature, or "T_probe=temperature [degC]". Repeat
        for more columns.
    unit
        Unit of a column that has none: temperature=degC. Repeat for more.
    """

    channel: Annotated[Path | None, Parameter(metavar="FILE")] = None
    epoch: Annotated[str | None, Parameter(metavar="TIME")] = None
    map: Annotated[list[str] | None, Parameter(metavar="HEADER=NAME", negative=())] = None
    unit: Annotated[list[str] | None, Parameter(metavar="NAME=UNIT", negative=())] = None

    def options(self) -> dict[str, Any]:
        """Keyword arguments of `gyrostab.read_channel`, apart from the file and the name."""
        if self.channel is None and (self.epoch or self.map or self.unit):
            raise OptionError(
                "--epoch, --map and --unit say how to read the file of --channel; name that file too"
            )
        return {
            "epoch": self.epoch,
            "map": _parse_pairs(self.map, "--map"),
            "unit": _parse_pairs(self.unit, "--unit"),
        }


@Parameter(name="*", group=_WINDOWS)
@dataclass(frozen=True)
class Windows:
    """The sliding window of the dynamic Allan variance.

    Parameters
    ----------
    window
        Length of the sliding window: 10min, 500ms, 2h or 2000samples (default: 10min, or a shorter
        one that fits four times into the record).
    step
        Distance from one window to the next, in the same manner (default: a tenth of the window).
    taus
        Averaging times: how many (40, spread evenly on a logarithmic scale), octave (1, 2, 4 ...
        samples), all, or a list: 0.1s,1s,10s.
    tau_max
        Longest averaging time (default: a third of the window; at most half of it).
    overlap
        full uses every second difference; octave thins them out where tau is long: faster on long
        windows, 1 % more scatter.
    gaps
        bridge counts only what is there; zero divides by the gap-free number, as some papers do,
        which digs a canyon at every gap.
    axis
        Only this gyro axis: x. Repeat for more.
    """

    window: Annotated[str | None, Parameter(metavar="DURATION")] = None
    step: Annotated[str | None, Parameter(metavar="DURATION")] = None
    taus: Annotated[str, Parameter(metavar="LIST")] = "40"
    tau_max: Annotated[str | None, Parameter(metavar="DURATION")] = None
    overlap: Literal["full", "octave"] = "full"
    gaps: Literal["bridge", "zero"] = "bridge"
    axis: Annotated[list[str] | None, Parameter(metavar="NAME", negative=())] = None

    def options(self) -> dict[str, Any]:
        """Keyword arguments of `gyrostab.allan.davar.davar`."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@Parameter(name="*", group=_FITTING)
@dataclass(frozen=True)
class Fitting:
    """The fit of the noise terms.

    Parameters
    ----------
    terms
        Terms of the model, letters of QNBKR.
    fit_method
        gls fits variances with their covariance; adev fits deviations, as some papers do, for
        comparison.
    fit_from
        Shortest averaging time to fit: 1s leaves out a filter or a line below that (default: all).
    fit_to
        Longest averaging time to fit (default: all).
    """

    terms: str = "QNBKR"
    fit_method: Literal["gls", "adev"] = "gls"
    fit_from: Annotated[str | None, Parameter(metavar="DURATION")] = None
    fit_to: Annotated[str | None, Parameter(metavar="DURATION")] = None

    def options(self) -> dict[str, Any]:
        """Keyword arguments of `gyrostab.allan.fit.fit_noise`."""
        return {
            "terms": self.terms,
            "method": self.fit_method,
            "tau_min": self.fit_from,
            "tau_max": self.fit_to,
        }


@Parameter(name="*", group=_RUNNING)
@dataclass(frozen=True)
class Running:
    """How long work is done, and done again.

    Parameters
    ----------
    resume
        Continue a run that was stopped or killed; begin one where there is none.
    scheduler
        Who does the work: threads, processes, or the workers of a dask scheduler at this address,
        tcp://cluster:8786.
    """

    resume: Flag = False
    scheduler: Annotated[str, Parameter(metavar="ADDRESS")] = "threads"


@Parameter(name="*", group=_COMMON)
@dataclass(frozen=True)
class Common:
    """What every command takes.

    Parameters
    ----------
    config
        TOML file with defaults for the options: [run] window = "10min".
    workers
        Processor cores to use (default: all).
    overwrite
        Replace an output that exists.
    quiet_progress
        Show no progress.
    debug
        Show where in the program an error arose.
    """

    config: Annotated[Path | None, Parameter(metavar="FILE.toml")] = None
    workers: Annotated[int | None, Parameter(metavar="N", validator=Number(gte=1))] = None
    overwrite: Flag = False
    quiet_progress: Flag = False
    debug: Flag = False


def _parse_pairs(items: Sequence[str] | None, option: str) -> dict[str, str]:
    """``["wx=gyro_x"]`` as a dict; an item may also name a TOML file of such pairs."""
    found: dict[str, str] = {}
    for item in items or ():
        name, equals, value = item.rpartition(
            "="
        )  # a header may hold the sign, a name or a unit does not
        if equals and name.strip() and value.strip():
            found[name.strip()] = value.strip()
        elif item.endswith(".toml"):
            found.update({key: str(value) for key, value in read_toml(Path(item)).items()})
        else:
            raise OptionError(
                f"{option} {item!r}: write NAME=VALUE, for instance {option} {_PAIR_EXAMPLES[option]}"
            )
    return found


_PAIR_EXAMPLES = {"--map": "wx=gyro_x", "--unit": "gyro=deg/s", "--limit": "columns=50000"}


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of options, or say what is wrong with it."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise OptionError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise OptionError(f"{path}: not a TOML file ({error})") from error

"""Options shared by several commands, and their conversion to keyword arguments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter
from cyclopts.validators import Number

from gyrostab.errors import OptionError
from gyrostab.ingest.limits import check_limits
from gyrostab.store.toml import parse_toml, read_toml_text

_READING = Group("Reading options", sort_key=1)
_WINDOWS = Group("Analysis options", sort_key=2)
_FITTING = Group("Fitting options", sort_key=3)
_RUNNING = Group("Running options", sort_key=4)
_SURVEY = Group("Survey options (iscwsa)", sort_key=4)
_COMMON = Group("Common options", sort_key=5)


def _parse_integer(_: Any, tokens: Sequence[Any]) -> int:
    """Parse a whole number; without this, 1.5 would be cut to 1."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"{tokens[0].value} (give a whole number).") from None


def whole_number(least: int, metavar: str = "N") -> Parameter:
    """Make the declaration of an option that is a whole number from `least` up."""
    return Parameter(metavar=metavar, validator=Number(gte=least), converter=_parse_integer)


Flag = Annotated[bool, Parameter(negative=(), show_default=False)]


@Parameter(name="*", group=_READING)
@dataclass(frozen=True)
class Reading:
    """How to read a log, where the log does not determine it.

    Parameters
    ----------
    rate
        Sampling rate in Hz of a log without a time column. With a time column, the rate found from
        the time stamps must agree with this one.
    start
        Time of the first row of a log without a time column: 2026-11-20T14:00:00.
    epoch
        Date from which a numeric time column counts: 2026-11-20 (default: 1970-01-01).
    map
        Rename a column: wx=gyro_x. Repeat for more, or give a TOML file with one line per column:
        wx = "gyro_x".
    unit
        Unit of a column that states none: gyro=deg/s for all gyro axes, gyro_x=deg/s,
        temperature=degC; for counts the size of one count, "gyro=0.1 arcsec/s". Repeat for more.
    missing_value
        Number that means a missing value in columns of the gyro and of channels, as it is written
        there: -999.25. Repeat for more.
    kind
        For gyro columns in a unit of angle: angle if they are cumulative, rate if each row holds
        the increment since the row before. Columns in a unit of rate need no --kind.
    channel
        Another file with a channel of the same recording (temperature, vibration, ...). Repeat for
        more.
    max_gap
        Longest gap. A larger step of the time stamps is treated as a step of the clock.
    strict
        Stop at a damaged or missing file instead of leaving a gap.
    time_from
        Use the log only after this time: 2026-11-20T14:00 (UTC), or a duration after its start,
        10min.
    time_to
        Use the log up to this time, given like --from.
    exclude
        Treat the samples of a time span as missing: 2026-11-20T14:00/2026-11-20T14:05, or
        10min/15min after the start. Repeat for more.
    limit
        Raise a limit that an error message names: columns=50000. Repeat for more.
    """

    rate: Annotated[float | None, Parameter(metavar="HZ")] = None
    start: Annotated[str | None, Parameter(metavar="TIME")] = None
    epoch: Annotated[str | None, Parameter(metavar="TIME")] = None
    map: Annotated[list[str] | None, Parameter(metavar="HEADER=NAME", negative=())] = None
    unit: Annotated[list[str] | None, Parameter(metavar="NAME=UNIT", negative=())] = None
    missing_value: Annotated[list[float] | None, Parameter(metavar="NUMBER", negative=())] = None
    kind: Literal["rate", "angle"] | None = None
    channel: Annotated[list[Path] | None, Parameter(metavar="FILE", negative=())] = None
    max_gap: Annotated[str, Parameter(metavar="DURATION")] = "10D"
    strict: Flag = False
    time_from: Annotated[str | None, Parameter(name="--from", metavar="TIME")] = None
    time_to: Annotated[str | None, Parameter(name="--to", metavar="TIME")] = None
    exclude: Annotated[list[str] | None, Parameter(metavar="START/END", negative=())] = None
    limit: Annotated[list[str] | None, Parameter(metavar="NAME=NUMBER", negative=())] = None

    def given(self) -> dict[str, Any]:
        """Return the options that differ from their defaults."""
        return {
            name: value
            for name, value in self.options().items()
            if (name, value) != ("max_gap", Reading.max_gap)
        }

    def options(self) -> dict[str, Any]:
        """Return the keyword arguments of `gyrostab.jobs.run.load_log`."""
        chosen = {
            **asdict(self),
            "map": _parse_pairs(self.map, "--map"),
            "unit": _parse_pairs(self.unit, "--unit"),
            "missing_value": tuple(self.missing_value or ()),
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
    """A channel to read from another file.

    Parameters
    ----------
    channel
        File that holds the channel, in any supported format. It is aligned by its time stamps.
    epoch
        Date from which a numeric time column of that file counts: 2026-11-20 (default: 1970-01-01).
    map
        Rename a column of that file: T_probe=temperature, or "T_probe=temperature [degC]". Repeat
        for more.
    unit
        Unit of a column of that file that states none: temperature=degC. Repeat for more.
    """

    channel: Annotated[Path | None, Parameter(metavar="FILE")] = None
    epoch: Annotated[str | None, Parameter(metavar="TIME")] = None
    map: Annotated[list[str] | None, Parameter(metavar="HEADER=NAME", negative=())] = None
    unit: Annotated[list[str] | None, Parameter(metavar="NAME=UNIT", negative=())] = None

    def options(self) -> dict[str, Any]:
        """Return the keyword arguments of `gyrostab.read_channel` except file and name."""
        if self.channel is None and (self.epoch or self.map or self.unit):
            raise OptionError(
                "--epoch, --map and --unit say how to read the file of --channel; "
                "name that file too"
            )
        return {
            "epoch": self.epoch,
            "map": _parse_pairs(self.map, "--map"),
            "unit": _parse_pairs(self.unit, "--unit"),
        }


@Parameter(name="*", group=_WINDOWS)
@dataclass(frozen=True)
class Windowing:
    """The sliding window of the dynamic Allan variance.

    Parameters
    ----------
    window
        Length of the sliding window: 10min, 500ms, 2h or 2000samples (default: 10min, or less, so
        that at least four windows fit into the record).
    step
        Time from one window to the next, written like --window (default: one tenth of the window).
    taus
        Averaging times: their number, evenly spaced on a logarithmic scale; octave (1, 2, 4, ...
        samples); all; or a list, 0.1s,1s,10s.
    tau_max
        Longest averaging time, at most half of the window, or a third for hadamard and modified
        (default: two thirds of this limit).
    axis
        Analyse this gyro axis only: x. Repeat for more.
    variance
        avar, the Allan variance. hadamard is not changed by a constant drift of the rate. modified,
        the modified Allan variance, separates white noise from quantization noise.
    min_coverage
        Smallest share of the second differences of a window that must be present at an averaging
        time. Lower it for a log of short bursts.
    """

    window: Annotated[str | None, Parameter(metavar="DURATION")] = None
    step: Annotated[str | None, Parameter(metavar="DURATION")] = None
    taus: Annotated[str, Parameter(metavar="LIST")] = "40"
    tau_max: Annotated[str | None, Parameter(metavar="DURATION")] = None
    axis: Annotated[list[str] | None, Parameter(metavar="NAME", negative=())] = None
    variance: Literal["avar", "hadamard", "modified"] = "avar"
    min_coverage: Annotated[float, Parameter(metavar="SHARE")] = 0.1

    def options(self) -> dict[str, Any]:
        """Return the keyword arguments of `gyrostab.allan.davar.davar`."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@Parameter(name="*", group=_FITTING)
@dataclass(frozen=True)
class Fitting:
    """The fit of the noise terms.

    Parameters
    ----------
    terms
        Noise terms to fit; NBK, for instance, leaves out Q and R.
    fit_from
        Shortest averaging time to fit, or all. Raise it to leave out a spectral line or motion at
        short times (default: all, except those at which a filter of the sensor shapes the noise).
    fit_to
        Longest averaging time to fit (default: all).
    """

    terms: Annotated[str, Parameter(metavar="LETTERS")] = "QNBKR"
    fit_from: Annotated[str | None, Parameter(metavar="DURATION")] = None
    fit_to: Annotated[str | None, Parameter(metavar="DURATION")] = None

    def options(self) -> dict[str, Any]:
        """Return the keyword arguments of `gyrostab.allan.fit.fit_noise`."""
        return {"terms": self.terms, "tau_min": self.fit_from, "tau_max": self.fit_to}


@Parameter(name="*", group=_RUNNING)
@dataclass(frozen=True)
class Running:
    """How a long computation runs.

    Parameters
    ----------
    resume
        Continue an interrupted run, or start a new one if there is none.
    scheduler
        Where to compute: threads, processes, or the workers of a dask scheduler, given by its
        address, tcp://cluster:8786.
    """

    resume: Flag = False
    scheduler: Annotated[str, Parameter(metavar="ADDRESS")] = "threads"


@Parameter(name="*", group=_SURVEY)
@dataclass(frozen=True)
class Survey:
    """The survey for which a tool error model is made.

    Parameters
    ----------
    station_time
        Time of the measurement at a station (default: 2min).
    section_time
        Duration of the survey section after the calibration of the bias (default: 1h).
    calibration_time
        Time over which the bias was averaged before the section (default: the station time).
    statistic
        Statistic over the windows that observe a coefficient, median or 95 % quantile (default:
        median).
    diagnosis
        Folder written by gyrostab diagnose, for the g-dependent terms.
    running_speed
        Speed of a continuous survey along the hole in m/s; without it, JSON and WITSML hold the
        stationary terms only.
    continuous_from
        Inclination in degrees from which x and y gyros survey continuously (default: 15).
    """

    station_time: Annotated[str | None, Parameter(metavar="DURATION")] = None
    section_time: Annotated[str | None, Parameter(metavar="DURATION")] = None
    calibration_time: Annotated[str | None, Parameter(metavar="DURATION")] = None
    statistic: Literal["median", "p95"] | None = None
    diagnosis: Annotated[Path | None, Parameter(metavar="DIR")] = None
    running_speed: Annotated[float | None, Parameter(metavar="M/S")] = None
    continuous_from: Annotated[float | None, Parameter(metavar="DEG")] = None

    def options(self) -> dict[str, Any]:
        """Return the keyword arguments of `gyrostab.to_iscwsa`."""
        options = {name: value for name, value in asdict(self).items() if value is not None}
        if self.diagnosis:
            from gyrostab.report.diagnosis import open_diagnosis

            options["diagnosis"] = open_diagnosis(self.diagnosis).content
        return options


@Parameter(name="*", group=_COMMON)
@dataclass(frozen=True)
class Common:
    """Options of every command.

    Parameters
    ----------
    config
        TOML file with default values of options, in a table per command: [run] window = "10min".
    workers
        Number of processor cores to use (default: all).
    overwrite
        Replace an existing output.
    quiet_progress
        Do not show progress.
    debug
        Show the traceback of an error.
    """

    config: Annotated[Path | None, Parameter(metavar="FILE.toml")] = None
    workers: Annotated[int | None, whole_number(1)] = None
    overwrite: Flag = False
    quiet_progress: Flag = False
    debug: Flag = False


def _parse_pairs(items: Sequence[str] | None, option: str) -> dict[str, str]:
    """Parse ``["wx=gyro_x"]`` to a dict; an item may also name a TOML file of such pairs."""
    pairs: dict[str, str] = {}
    for item in items or ():
        # a header may contain "="; a name or a unit does not
        name, equals, value = item.rpartition("=")
        if equals and name.strip() and value.strip():
            pairs[name.strip()] = value.strip()
        elif item.endswith(".toml"):
            pairs.update({key: str(value) for key, value in read_toml(Path(item)).items()})
        else:
            raise OptionError(
                f"{option} {item!r}: write NAME=VALUE, "
                f"for instance {option} {_PAIR_EXAMPLES[option]}"
            )
    return pairs


_PAIR_EXAMPLES = {"--map": "wx=gyro_x", "--unit": "gyro=deg/s", "--limit": "columns=50000"}


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of options."""
    try:
        return parse_toml(read_toml_text(path))
    except OSError as error:
        raise OptionError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise OptionError(f"{path}: not a TOML file ({error})") from error

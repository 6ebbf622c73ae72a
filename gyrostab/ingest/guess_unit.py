"""Guess the unit of the gyro columns, and the time column, from names and numbers."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

import numpy as np

from gyrostab.ingest.columns.headers import TIME_PATTERN, is_time_unit, is_unit, is_unit_of
from gyrostab.ingest.columns.likely_channels import find_unit_in_name
from gyrostab.ingest.columns.stamps import DATENUM, parse_time_unit
from gyrostab.ingest.inspect import ColumnInspection, FileInspection
from gyrostab.time.grid import MAX_RATE_HZ
from gyrostab.units import HOUR, parse_unit

#: Rotation of the Earth [deg/h].
EARTH_RATE_DPH = 15.041

#: Relative error with which a fine gyro measures it; its bias is a few tenths of a deg/h.
EARTH_TOLERANCE = 0.02

#: Relative error of a gyro with a bias of a few deg/h.
EARTH_NEIGHBOURHOOD = 0.3

#: Largest full scale of gyros [deg/h].
MAX_RATE_DPH = 4000.0 * HOUR

#: Angle random walk of a usual sensor [deg/sqrt(h)], and spread of other sensors [decades].
TYPICAL_ARW, ARW_DECADES = 0.3, 1.0

#: Typical rate of gyro logs [Hz], and spread [decades].
TYPICAL_RATE_HZ, RATE_DECADES = 100.0, 1.0

_TIME_WORD = re.compile(r"time|stamp|tow|clock|epoch|elapsed|seconds|(^|[^a-z])t($|[^a-z])|sec$")

_COUNTER_WORD = re.compile(
    r"count|packet|seq|index|sample|(^|[^a-z])(n|no|nr|id|row|frame)($|[^a-z])"
)

_TIME_UNIT_PATTERNS = (
    (r"nanos|(^|[^a-z])ns$|_ns|nsec", "ns"),
    (r"micros|usec|timeus|(^|[^a-z])us$|_us", "us"),
    (r"millis|msec|(^|[^a-z])ms$|_ms", "ms"),
    (r"seconds|(^|[^a-z])s$|_sec$|_s$", "s"),
)
_UNITS = ("s", "ms", "us", "ns")
#: Unix time between 2001 and 2033 is 1 to 2 of these [s].
_EPOCH_S = 1e9
#: Units of the dates of spreadsheets and of MATLAB, and their values in the years 1968 to 2119.
_SERIAL_DAYS = {"days since 1899-12-30": (25_000.0, 80_000.0), DATENUM: (718_960.0, 773_960.0)}


@dataclass
class Guess:
    """Guessed roles of the columns of a file, with the reasons.

    `axes` are the columns of the gyro by axis (empty if no column looks like one); `unit` is the
    unit to give for them, None if they carry one; `time` and `time_unit` likewise (of dates, the
    order of day and month); `kind` is the kind to give for angles; `rate` [Hz] is set for a file
    without time; `channels` are the columns of other sensors by channel, with their units.
    `sampling_rate_hz` is the rate that the guess is based on.
    """

    axes: dict[str, ColumnInspection] = field(default_factory=dict)
    unit: str | None = None
    time: ColumnInspection | None = None
    time_unit: str | None = None
    rate: float | None = None
    channels: dict[str, tuple[ColumnInspection, str]] = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    sampling_rate_hz: float = math.nan
    kind: str | None = None

    @property
    def group(self) -> list[ColumnInspection]:
        """Columns of the gyro."""
        return list(self.axes.values())


def given_unit(column: ColumnInspection, quantity: str = "rate") -> bool:
    """Return whether the header gives a unit of rates, or of another quantity."""
    return is_unit_of(column.unit, (quantity,))


def guess_unit(inspection: FileInspection, guess: Guess, *, angles: bool) -> None:
    """Guess the unit of the gyro columns, and add the reasons and warnings.

    A unit in the header that is not known leaves the guess to names and numbers.
    """
    group, warnings = guess.group, guess.warnings
    if _guess_by_name(guess, angles=angles):
        return
    units = {
        unit: is_unit(unit) or is_unit_of(unit, ("number",)) or _names_counts(unit)
        for unit in (column.unit for column in group)
        if unit
    }
    warnings += [
        f"the unit {unit!r} of the gyro is not known"
        for unit, is_known in units.items()
        if not is_known
    ]
    if angles:
        warnings.append(
            "the file states no known unit of the angles; deg is an assumption, put the true one "
            "in its place"
        )
        guess.unit = "deg"
        return
    counts = any(units.values()) or any(_names_counts(column.key) for column in group)
    large = (
        inspection.summary.format == "miniseed"
        and max(max(abs(c.low), abs(c.high)) for c in group) > 10.0
    )
    if counts or large or all(c.whole for c in group):
        guess.unit = _scale_of_counts(guess)
        return
    _guess_by_noise(guess)


def _guess_by_name(guess: Guess, *, angles: bool) -> bool:
    """Guess the unit by the headers of the columns; return whether one names it."""
    quantity = "angle" if angles else "rate"
    for column in guess.group:
        in_header = given_unit(column, quantity)
        named = column.unit if in_header else find_unit_in_name(column.key, quantity)
        if named is None and not angles and (angle := find_unit_in_name(column.key, "angle")):
            named = f"{angle}/s"
        if named is not None and is_unit_of(named, (quantity,)):
            by = "that of another axis" if in_header else "name"
            guess.reasons.append(f"unit {named}, by {by}")
            guess.unit = named
            return True
    return False


def _guess_by_noise(guess: Guess) -> None:
    """Guess the unit in which mean and noise are most plausible for a gyro."""
    rate = guess.sampling_rate_hz if guess.sampling_rate_hz > 0 else TYPICAL_RATE_HZ
    means = np.array([c.mean for c in guess.group])
    scatter = float(np.median([c.scatter for c in guess.group]))
    top = max(max(abs(c.low), abs(c.high)) for c in guess.group)
    scores = {
        unit: rate_plausibility(means, scatter, top, parse_unit(unit).factor, rate)
        for unit in ("rad/s", "deg/s", "deg/h")
    }
    unit = max(scores, key=lambda unit: scores[unit])
    factor = parse_unit(unit).factor
    walk = scatter * factor / (60.0 * math.sqrt(rate))
    guess.reasons.append(
        f"unit {unit}, by the noise: {walk:.2g} deg/sqrt(h); the mean is "
        f"{np.linalg.norm(means) * factor:.4g} deg/h"
    )
    guess.warnings.append(
        f"the unit {unit} is a guess from the numbers, as the file states no known unit; check it "
        "with the data sheet"
    )
    guess.unit = unit


def _names_counts(text: str) -> bool:
    """Return whether a unit or the name of a column is one of counts."""
    return bool(re.search(r"count|lsb|raw", text.lower()))


def rate_plausibility(
    means: np.ndarray, scatter: float, top: float, factor: float, rate: float
) -> float:
    """Return the log-plausibility that the numbers of a gyro have a unit of `factor` deg/h."""
    if top * factor > MAX_RATE_DPH:
        return -math.inf
    walk = max(scatter, 1e-300) * factor / (60.0 * math.sqrt(rate)) if rate > 0 else TYPICAL_ARW
    score = -((math.log10(walk / TYPICAL_ARW) / ARW_DECADES) ** 2) / 2
    norm = float(np.linalg.norm(means)) * factor
    if len(means) == 3 and abs(norm / EARTH_RATE_DPH - 1) < EARTH_TOLERANCE:
        # Earth rate; the chance is 0.04 of 4 ln 10 in the logarithm, e^-5
        score += 4.0
    elif len(means) == 3 and abs(norm / EARTH_RATE_DPH - 1) < EARTH_NEIGHBOURHOOD:
        score += 2.0  # with a bias of a few deg/h; the chance is 0.6 of 4 ln 10, e^-3
    elif len(means) == 3 and norm < 0.5 * EARTH_RATE_DPH:
        score -= 1.0  # below Earth rate: only if the mean was removed
    return score


def _scale_of_counts(guess: Guess) -> str:
    """Return a provisional unit for counts, whose scale the file does not contain."""
    norm = math.hypot(*(column.mean for column in guess.group))
    if len(guess.axes) == 3 and norm > 0:
        per_count = EARTH_RATE_DPH / norm  # deg/h = arcsec/s
        decade = 10.0 ** math.floor(math.log10(per_count))
        round_one = min(
            (digit * decade for digit in (1.0, 2.0, 2.5, 5.0, 10.0)),
            key=lambda scale: abs(math.log(scale / per_count)),
        )
        if abs(round_one / per_count - 1) < EARTH_TOLERANCE:
            guess.reasons.append(
                f"{round_one:g} arcsec/s a count, as the mean of the three axes is then the "
                "rotation of the Earth"
            )
            guess.warnings.append(
                f"the scale of {round_one:g} arcsec/s a count is a guess; put that of the data "
                "sheet in its place"
            )
            return f"{round_one:g} arcsec/s"
    earth = EARTH_RATE_DPH / parse_unit("rad/s").factor
    exponent = math.floor(math.log10(earth / norm)) if norm > 0 else -9
    unit = "nrad/s" if exponent == -9 else f"1e{exponent:d} rad/s"
    text = f"1 {unit}" if unit == "nrad/s" else unit
    guess.reasons.append(
        f"{text} a count is the largest decimal scale at which the mean is not more than the "
        "rotation of the Earth"
    )
    guess.warnings.append(
        "the columns are counts, and the file does not give their scale: replace "
        f"{text} with the scale of the data sheet"
    )
    return text


def unit_seconds(unit: str | None) -> float:
    """Return the seconds of a unit of time, which is seconds if None.

    Examples
    --------
    >>> unit_seconds("min"), unit_seconds(None)
    (60.0, 1.0)
    """
    return float(parse_time_unit(unit or "s").ns) / 1e9


def rises_by_row(column: ColumnInspection, inspection: FileInspection) -> bool:
    """Return whether a column rises from row to row, as time does."""
    return (
        column.rows >= max(2, 0.5 * inspection.rows)
        and column.rising >= 0.5
        and column.rising + column.held >= 0.95
        and column.pace * MAX_RATE_HZ >= 1  # else too fast in any unit
    )


def guess_time(inspection: FileInspection, guess: Guess) -> None:
    """Guess the time column and its unit, if there is one, and add the reasons and warnings."""
    best: tuple[float, ColumnInspection, str, str] | None = None
    for column in inspection.columns:
        if not rises_by_row(column, inspection):
            continue
        low = column.key.lower()
        named = bool(TIME_PATTERN.match(low) or _TIME_WORD.search(low))
        counter = (
            column.whole
            and abs(column.pace - 1.0) < 1e-6
            and abs(column.std - inspection.rows / math.sqrt(12)) < 0.1 * inspection.rows
        )
        written = column.unit or "1"
        has_other_unit = not (is_time_unit(written) or is_unit_of(written, ("number",)))
        if not named and (counter or has_other_unit or _COUNTER_WORD.search(low)):
            continue
        unit, reason = _time_unit(column)
        score = 2.0 * named + ("name" in reason) - 0.1 * _rate_distance(column, unit)
        if best is None or score > best[0]:
            best = score, column, unit, reason
    if best is None:
        return
    _, column, unit, reason = best
    guess.time, guess.time_unit = column, unit
    guess.reasons.append(
        f"{column.key!r} is the time, as it rises from row to row; in {unit}, by {reason}"
    )
    if reason.startswith("the rate"):
        guess.warnings.append(
            f'--unit "time={unit}" is an assumption, because of {reason}: if that is not the '
            "sampling rate, use the true unit instead"
        )


def _time_unit(column: ColumnInspection) -> tuple[str, str]:
    """Guess the unit of a numeric time column; also return the evidence."""
    if column.unit and is_time_unit(column.unit):
        return column.unit, "its name"
    name = column.key.lower()
    for pattern, unit in _TIME_UNIT_PATTERNS:
        if re.search(pattern, name):
            return unit, "its name"
    for unit in _UNITS:
        if 1.0 <= column.first * unit_seconds(unit) / _EPOCH_S < 2.0:
            return unit, "its size, that of Unix time"
    serials = [unit for unit, (low, high) in _SERIAL_DAYS.items() if low <= column.first < high]
    unit = min([*_UNITS, *serials], key=lambda unit: _rate_distance(column, unit))
    return unit, f"the rate of {1.0 / (column.pace * unit_seconds(unit)):.6g} Hz that it gives"


def _rate_distance(column: ColumnInspection, unit: str) -> float:
    return (
        abs(math.log10(1.0 / (column.pace * unit_seconds(unit)) / TYPICAL_RATE_HZ)) / RATE_DECADES
    )

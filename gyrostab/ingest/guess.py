"""Guess what the columns of a file are: which three are the gyro, their unit, and the time.

Names and units decide if present, otherwise the numbers. The bounds come from physics and from the
market:

- a gyro at rest turns with the Earth, 15.04 deg/h (7.292e-5 rad/s; IERS conventions 2010, table
  1.2), so the mean of three axes is at least that, and that of one axis of a fine gyro at most;
- the largest range of gyros on the market is 4000 deg/s (automotive and sports MEMS);
- angle random walk ranges from 3e-4 deg/sqrt(h) (laser gyros) to 10 deg/sqrt(h) (the noisiest
  MEMS); that of usual MEMS parts is 0.1 to 1 deg/sqrt(h) (IEEE Std 952, and the data sheets of the
  recordings in docs/real-recordings.md).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter

from gyrostab.ingest.columns.headers import (
    AXIS_PATTERN,
    INCREMENT_PATTERN,
    is_unit,
    is_unit_of,
)
from gyrostab.ingest.columns.likely_channels import find_likely_channels, find_unit_in_name
from gyrostab.ingest.guess_unit import (
    TYPICAL_RATE_HZ,
    Guess,
    given_unit,
    guess_time,
    guess_unit,
    rises_by_row,
    unit_seconds,
)
from gyrostab.ingest.inspect import ColumnInspection, FileInspection
from gyrostab.time.durations import format_duration

#: Number of a column, in its name.
_NUMBER = re.compile(r"[0-9]{1,9}\Z")
#: Smallest score of a group of columns that is taken for the gyro: one sign in its name, or a unit.
MIN_SCORE = 1.5

#: Steps of angles below this share of their standard deviation are those of a cumulative angle: the
#: steps of a random walk of n rows are sqrt(6 / n) of it, those of white increments all of it.
CUMULATIVE_STEP_SHARE = 0.1

_STRONG = re.compile(
    r"gyr|omega|ang(ular)?[ _.]?(rate|vel)|rot(ation)?[ _.]?(rate|vel)|turn[ _.]?rate"
)

_LETTER = re.compile(r"(^|[^a-z])[wg]_?\*|w_rs_s_\*|(^|[^a-z])rate|^\*?j\*$")

_OTHER = re.compile(
    r"acc|(^|[^a-z])[amft]_?\*|mag|quat|pos|euler|orient|gps|temp|press|cov|force|free|linear|lat|lon|field|torque|curr|volt|batt|state"
)

_DERIVED = re.compile(
    r"est|pred|filt|ref|bias|cal|std|var|noise|err|setpoint|sp_|integral|delta|dt|ramp|theta|incr"
)


def guess_columns(
    inspection: FileInspection,
    *,
    rate: float | None = None,
    rate_hint: float | None = None,
    kind: str | None = None,
) -> Guess:
    """Guess what the columns of a file are.

    `rate` [Hz] and `kind` are those that the user gives, `rate_hint` is the sampling rate that a
    text in the file contains.
    """
    guess = Guess()
    if inspection.time is None:
        guess_time(inspection, guess)
    if inspection.date_spans_s:
        guess.time_unit = _choose_order(inspection.date_spans_s, guess.warnings)
    if inspection.time is None and guess.time is None and rate is None:
        guess.rate = _assume_rate(inspection, rate_hint, guess.warnings)
    guess.sampling_rate_hz = rate or guess.rate or inspection.rate_hz
    if guess.time is not None and not rate:
        guess.sampling_rate_hz = 1.0 / (guess.time.pace * unit_seconds(guess.time_unit))
    _guess_axes(inspection, guess)
    angles = kind == "angle" or any(
        given_unit(column, "angle")
        or _is_increment(column)
        or column.name.lower().startswith("angle_")
        for column in guess.group
    )
    if not all(given_unit(column, "angle" if angles else "rate") for column in guess.group):
        guess_unit(inspection, guess, angles=angles)
    if angles and kind is None:
        _guess_kind(guess)
    if not guess.axes:
        guess.warnings.append(
            "no column looks like a gyro; if one is, name it: --map NAME=gyro_x --unit gyro=deg/s"
        )
    guess.channels = _guess_channels(inspection, guess)
    return guess


def _choose_order(date_spans_s: Mapping[str, float], warnings: list[str]) -> str:
    """Choose the order of day and month by which a file is shortest."""
    (order, span_s), (other, other_span_s) = sorted(date_spans_s.items(), key=itemgetter(1))
    warnings.append(
        f"--unit time={order} is an assumption, because the dates can be read in two ways: "
        f"use {other} {_compare_spans(span_s, other_span_s)}"
    )
    return order


def _compare_spans(span_s: float, other_span_s: float) -> str:
    """Say what follows for a file from the other order of its dates."""
    if span_s == other_span_s:
        return "if that is their order"
    if math.isinf(other_span_s):
        return "only if most of its stamps are wrong"
    lengths = (format_duration(seconds, " ") for seconds in (other_span_s, span_s))
    return "if the file lasts {}, not {}".format(*lengths)


def _assume_rate(inspection: FileInspection, rate_hint: float | None, warnings: list[str]) -> float:
    """Return a sampling rate [Hz] for a file without time: that of its text, or a usual one."""
    rate = rate_hint or TYPICAL_RATE_HZ
    warnings.append(
        f"the file names {rate:g} Hz; if that is not its sampling rate, use the true rate instead"
        if rate_hint
        else f"--rate {rate:g} is an assumption, because the file has no time column: use the true "
        "rate instead"
    )
    warnings += [
        f"{column.key!r} rises from row to row in {column.unit}, which is not a unit of time: if "
        "the log is over depth, export it over time"
        for column in inspection.columns
        if column.unit and not is_unit(column.unit) and rises_by_row(column, inspection)
    ]
    return rate


def _guess_channels(
    inspection: FileInspection, guess: Guess
) -> dict[str, tuple[ColumnInspection, str]]:
    """Return column and unit of each channel that only one column beyond the axes may be."""
    used_keys = {column.key for column in [*guess.group, *filter(None, [guess.time])]}
    others = [column for column in inspection.columns if column.key not in used_keys]
    channels: dict[str, tuple[ColumnInspection, str]] = {}
    named = [(column.key, column.unit) for column in others]
    for channel, likely in find_likely_channels(named).items():
        varying = [column for column in likely if others[column.place].std > 0]
        if len(varying) == 1:
            channels[channel] = others[varying[0].place], varying[0].unit
    return channels


def _guess_axes(inspection: FileInspection, guess: Guess) -> None:
    gyro_columns = {
        column.name.lower(): column for column in inspection.columns if column.role == "gyro"
    }
    if gyro_columns:
        guess.axes = {AXIS_PATTERN.sub(r"\2", name): c for name, c in gyro_columns.items()}
        return
    usable = [
        c
        for c in inspection.columns
        if c is not guess.time
        and c.rows >= 0.25 * inspection.rows
        and c.std > 0
        and _may_be_gyro(c)
    ]
    groups = list(_group_columns(usable))
    steady = [_mean_over_scatter(list(group.values())) for _, group in groups]
    best: tuple[float, dict[str, ColumnInspection]] | None = None
    for (template, group), steadiness in zip(groups, steady, strict=True):
        score = _gyro_score(template, list(group.values()), inspection)
        rivals = [rival for rival in steady if rival is not steadiness]
        if rivals and len(group) == 3:
            # gravity makes the mean of an accelerometer large
            score += 0.75 * (steadiness <= min(rivals)) - 0.75 * (steadiness > max(rivals))
        if score >= MIN_SCORE and (best is None or score > best[0]):
            best = score, group
    if best is None:
        return
    guess.axes = best[1]
    names = ", ".join(column.key for column in guess.group)
    named = _STRONG.search(names.lower()) or any(
        given_unit(column)
        or find_unit_in_name(column.key, "rate")
        or INCREMENT_PATTERN.search(column.key)
        for column in guess.group
    )
    guess.reasons.append(f"{names}: the gyro, by {'name' if named else 'name and numbers'}")


def _may_be_gyro(column: ColumnInspection) -> bool:
    """Return whether the unit of a column, in header or name, allows a gyro."""
    if is_unit_of(column.unit, ("rate", "angle", "number")):
        return True
    others = ("acceleration", "temperature", "magnetic", "pressure")
    if is_unit_of(column.unit, others):
        return False
    return find_unit_in_name(column.key, "rate") is not None or not any(
        find_unit_in_name(column.key, kind) for kind in (*others, "voltage")
    )


def _is_increment(column: ColumnInspection) -> bool:
    """Return whether the name of a column is that of angle increments, and it has their unit."""
    return bool(INCREMENT_PATTERN.search(column.key)) and (
        given_unit(column, "angle") or find_unit_in_name(column.key, "angle") is not None
    )


def _group_columns(
    columns: Sequence[ColumnInspection],
) -> Iterator[tuple[str, dict[str, ColumnInspection]]]:
    """Yield groups of columns whose names differ only in the axis, and each column alone."""
    templates: dict[str, dict[str, ColumnInspection]] = {}
    for column in columns:
        for match in re.finditer(r"[xyzXYZpqrENZ]|\d+", column.key):
            template = f"{column.key[: match.start()]}*{column.key[match.end() :]}"
            templates.setdefault(template, {})[match[0]] = column
    for template, by_label in templates.items():
        letters = set(by_label)
        for trio in ("xyz", "XYZ", "pqr", "ENZ"):
            if len(letters & set(trio)) >= 2 and (trio != "pqr" or template == "*"):
                axes = "enz" if trio == "ENZ" else "xyz"
                labelled = zip(trio, axes, strict=True)
                yield template, {axis: by_label[x] for x, axis in labelled if x in by_label}
        numbered = [(int(text), column) for text, column in by_label.items() if _NUMBER.match(text)]
        digits = sorted(
            ((number, column) for number, column in numbered if column.rising < 0.9),
            key=lambda pair: pair[0],
        )
        axes = "xyz" if len(digits) > 2 else "xy"
        step = 1 if len(digits) % len(axes) else len(axes)
        for place in range(0, len(digits) - len(axes) + 1, step):
            numbers, group = zip(*digits[place : place + len(axes)], strict=True)
            if numbers[-1] - numbers[0] == len(axes) - 1:
                yield template, dict(zip(axes, group, strict=True))
    for column in columns:
        if not column.key.isdigit():
            letter = re.search(r"[xyzXYZ](?![a-zA-Z])", column.key)
            place = letter.start() if letter else len(column.key)
            template = f"{column.key[:place]}*{column.key[place + 1 :]}"
            yield template, {letter[0].lower() if letter else "x": column}


def _gyro_score(
    template: str, group: Sequence[ColumnInspection], inspection: FileInspection
) -> float:
    """Return a score of how much a group of columns looks like a gyro."""
    low = template.lower()
    has_unit = any(given_unit(column) for column in group)
    if has_unit or all(map(_is_increment, group)):
        score = 4.0
    else:
        score = 2.5 * any(find_unit_in_name(column.key, "rate") for column in group)
        score += bool(_STRONG.search(low)) and any(find_unit_in_name(c.key, "angle") for c in group)
    if _STRONG.search(low):
        score += 3.0
    elif _LETTER.search(low) or re.search(r"(^|\.)[A-Z]J(\*|\w)", template):
        score += 2.0
    score -= 4.0 if _OTHER.search(low) and not _STRONG.search(low) else 0.0
    score -= 1.0 if _DERIVED.search(low) else 0.0
    score += 0.5 * (len(group) - 1)
    if len(group) == 3:
        scatters = [column.scatter for column in group]
        score += 0.5 if max(scatters) < 30 * max(min(scatters), 1e-30) else -0.5
        norm = math.hypot(*(column.mean for column in group))
        if (
            not has_unit
            and any(abs(norm / gravity - 1) < 0.05 for gravity in (9.80665, 1.0))
            and _mean_over_scatter(group) > 10
        ):
            score -= 3.0  # an accelerometer at rest, in m/s^2 or g
    if any(column.rising > 0.9 or column.held > 0.98 for column in group):
        score -= 3.0  # a counter, or a state
    if all(column.scatter < 0.01 * column.std for column in group):
        score -= 1.0  # a smooth curve, such as a position or an angle
    return score


def _guess_kind(guess: Guess) -> None:
    """Guess whether angles are cumulative or increments, by their names or steps."""
    if all(INCREMENT_PATTERN.search(column.key) for column in guess.group):
        guess.reasons.append("--kind rate, as the columns are increments by name")
        guess.kind = "rate"
        return
    cumulative = all(c.scatter < CUMULATIVE_STEP_SHARE * c.std for c in guess.group)
    guess.kind, meaning = (
        ("angle", "cumulative") if cumulative else ("rate", "increments of each row")
    )
    alternative = "rate if they are increments" if cumulative else "angle if they are cumulative"
    guess.warnings.append(
        f"--kind {guess.kind}, {meaning}, is a guess from the size of the steps between rows; give "
        f"--kind {alternative}"
    )


def _mean_over_scatter(group: Sequence[ColumnInspection]) -> float:
    """Return the ratio of mean and scatter."""
    return math.hypot(*(c.mean for c in group)) / max(
        math.hypot(*(c.scatter for c in group)), 1e-300
    )

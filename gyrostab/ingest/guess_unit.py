"""Guess the unit of gyro columns from their names and numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from gyrostab.ingest.columns.headers import is_unit, is_unit_of
from gyrostab.ingest.inspect import ColumnInspection, FileInspection
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


def given_unit(column: ColumnInspection, quantity: str = "rate") -> bool:
    """Return whether the header gives a unit of rates, or of another quantity."""
    return is_unit_of(column.unit, (quantity,))


def name_unit(column: ColumnInspection, quantity: str) -> str | None:
    """Return the unit at the end of a column name, such as ``deg/h`` in ``gx_deg_per_h``."""
    tokens = [
        token for token in re.split(r"[\s_./\-]+", re.sub(r"\[\d+\]$", "", column.key)) if token
    ]
    for count in range(min(4, len(tokens) - 1), 0, -1):
        last = tokens[-count:]
        for text in (" ".join(last), "/".join(last)):
            if len(text) > 1 or text in ("C", "K", "F", "g", "V", "T", "G"):
                text = {"degs": "deg/s", "rads": "rad/s"}.get(text, text)
                if is_unit_of(text, (quantity,)) and text not in ("1", "-"):
                    return parse_unit(text, quantity).text.replace(" per ", "/")
    return None


def temperature_unit(column: ColumnInspection) -> str:
    """Return the unit of a temperature column, from its header or its name."""
    has_unit = given_unit(column, "temperature")
    return str(column.unit if has_unit else name_unit(column, "temperature") or "degC")


def guess_unit(
    inspection: FileInspection,
    axes: dict[str, ColumnInspection],
    rate: float,
    reasons: list[str],
    warnings: list[str],
    *,
    angles: bool,
) -> str:
    """Guess the unit of the gyro columns, and add the reasons and warnings.

    A unit in the header that is not known leaves the guess to names and numbers.
    """
    group = list(axes.values())
    for column in group:
        in_header = given_unit(column)
        named = column.unit if in_header else name_unit(column, "rate")
        if named is None and not angles and (angle := name_unit(column, "angle")):
            named = f"{angle}/s"
        if named is not None and is_unit_of(named, ("rate",)):
            reasons.append(f"unit {named}, by {'that of another axis' if in_header else 'name'}")
            return named
    units = {column.unit: _is_known(column.unit) for column in group if column.unit}
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
        return "deg"
    counts = any(units.values()) or any(_names_counts(column.key) for column in group)
    large = (
        inspection.summary.format == "miniseed"
        and max(max(abs(c.low), abs(c.high)) for c in group) > 10.0
    )
    if counts or large or all(c.whole for c in group):
        return _scale_of_counts(group, reasons, warnings)
    means = np.array([c.mean for c in group])
    scatter = float(np.median([c.scatter for c in group]))
    top = max(max(abs(c.low), abs(c.high)) for c in group)
    scores = {
        unit: rate_plausibility(means, scatter, top, parse_unit(unit).factor, rate)
        for unit in ("rad/s", "deg/s", "deg/h")
    }
    unit = max(scores, key=lambda unit: scores[unit])
    factor = parse_unit(unit).factor
    walk = scatter * factor / (60.0 * math.sqrt(rate)) if rate > 0 else math.nan
    reasons.append(
        f"unit {unit}, by the noise: {walk:.2g} deg/sqrt(h); the mean is "
        f"{np.linalg.norm(means) * factor:.4g} deg/h"
    )
    warnings.append(
        f"the unit {unit} is a guess from the numbers, as the file states no known unit; check it "
        "with the data sheet"
    )
    return unit


def _is_known(unit: str) -> bool:
    return is_unit(unit) or is_unit_of(unit, ("number",)) or _names_counts(unit)


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


def _scale_of_counts(
    group: Sequence[ColumnInspection], reasons: list[str], warnings: list[str]
) -> str:
    """Return a provisional unit for counts, whose scale the file does not contain."""
    norm = math.hypot(*(c.mean for c in group))
    if len(group) == 3 and norm > 0:
        per_count = EARTH_RATE_DPH / norm  # deg/h = arcsec/s
        decade = 10.0 ** math.floor(math.log10(per_count))
        round_one = min(
            (digit * decade for digit in (1.0, 2.0, 2.5, 5.0, 10.0)),
            key=lambda scale: abs(math.log(scale / per_count)),
        )
        if abs(round_one / per_count - 1) < EARTH_TOLERANCE:
            reasons.append(
                f"{round_one:g} arcsec/s a count, as the mean of the three axes is then the "
                "rotation of the Earth"
            )
            warnings.append(
                f"the scale of {round_one:g} arcsec/s a count is a guess; put that of the data "
                "sheet in its place"
            )
            return f"{round_one:g} arcsec/s"
    earth = EARTH_RATE_DPH / parse_unit("rad/s").factor
    exponent = math.floor(math.log10(earth / norm)) if norm > 0 else -9
    unit = "nrad/s" if exponent == -9 else f"1e{exponent:d} rad/s"
    text = f"1 {unit}" if unit == "nrad/s" else unit
    reasons.append(
        f"{text} a count is the largest decimal scale at which the mean is not more than the "
        "rotation of the Earth"
    )
    warnings.append(
        "the columns are counts, and the file does not give their scale: replace "
        f"{text} with the scale of the data sheet"
    )
    return text

"""What a record can tell of a coupling, in flags and in one sentence."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "LIMITS",
    "VERDICTS",
    "describe_coupling",
    "driver_limits",
    "format_p_value",
    "readable_units",
]

Array = NDArray[np.float64]

#: Flag values of ``coupling_verdict``.
VERDICTS = ("cannot_tell", "none_seen", "not_told_apart", "coupled")

#: Bit -> name of ``coupling_limits``, and how a sentence says it.
LIMITS = {
    "constant": "{driver} is constant",
    "too_few": "there are too few independent windows",
    "clusters": "{driver} only differs between stretches that a gap parts",
    "one_moment": "{driver} changes at one moment only",
    "no_reversal": "{driver} never turns, so a drift or slow noise looks the same",
    "no_plateau": "{driver} never rests, so a lasting effect and one of its rate of change look alike",
    "other_channel": "another channel explains it as well",
}
_MIN_BLOCKS = 12
_MIN_RANGE = {"degree_Celsius": 0.02}  # a smaller range of the channel counts as none


def driver_limits(x: Array, pieces: NDArray[np.int64], units: str, *, derived: bool) -> set[str]:
    """Say why a driver may not tell, from its block means `x` in the stretches `pieces` between long gaps."""
    found = set()
    span = float(np.ptp(x)) if x.size else 0.0
    if x.size < _MIN_BLOCKS:
        found.add("too_few")
    if span <= max(_MIN_RANGE.get(units, 0.0), 1e-9 * float(np.abs(x).max(initial=0.0))):
        return found | {"constant"}
    inside = sum(
        float(((x[pieces == piece] - x[pieces == piece].mean()) ** 2).sum())
        for piece in np.unique(pieces)
    )
    if pieces.max() > 0 and inside < 0.1 * float(((x - x.mean()) ** 2).sum()):
        found.add("clusters")
    rise = float((x - np.minimum.accumulate(x)).max())
    fall = float((np.maximum.accumulate(x) - x).max())
    if min(rise, fall) < 0.25 * span:
        found.add("no_reversal")
    if not derived and x.size >= _MIN_BLOCKS:
        pace = np.abs(np.gradient(x))
        if np.mean(pace < 0.1 * np.quantile(pace, 0.95)) < 0.1:
            found.add("no_plateau")
    return found


def readable_units(units: str) -> str:
    """Spell a unit of UDUNITS as people write it.

    Examples
    --------
    >>> plain_units("degree hour-1 K-1"), plain_units("degree K-1"), plain_units("K-1"), plain_units("m s-2")
    ('deg/h/K', 'deg/K', '1/K', 'm/s^2')
    """
    above, below = [], ""
    for word in units.split():
        name = word.rstrip("-0123456789") or word
        power = word[len(name) :]
        name = {"degree": "deg", "hour": "h", "degree_Celsius": "K"}.get(name, name)
        size = power.removeprefix("-")
        name += f"^{size}" if size not in ("", "1") else ""
        if power.startswith("-"):
            below += f"/{name}"
        else:
            above.append(name)
    return (" ".join(above) or "1") + below


def format_p_value(p: float) -> str:
    """Write a p-value; beyond the reach of the simulation only that it is small.

    Examples
    --------
    >>> chance(0.0312), chance(3e-9)
    ('0.031', '<0.0001')
    """
    return "<0.0001" if p < 1e-4 else f"{p:.2g}"


def describe_coupling(entry: dict[str, Any], driver: str, series: str) -> str:
    """One sentence of plain words about an entry."""
    reasons = [LIMITS[name].format(driver=driver) for name in LIMITS if name in entry["limits"]]
    verdict = VERDICTS[entry["verdict"]]
    if verdict == "cannot_tell":
        hard = [
            LIMITS[name].format(driver=driver)
            for name in ("constant", "too_few", "clusters", "one_moment")
            if name in entry["limits"]
        ]
        return f"The record cannot tell whether {series} follows {driver}: {'; '.join(hard) or 'no window holds both'}."
    units = readable_units(entry["units"])
    between = f"{entry['low']:.3g} to {entry['high']:.3g}"
    number = f"{entry['slope']:.3g} ({between}) {units}"
    late = f" {entry['lag']:.3g} s later" if entry["lag"] else ""
    start = series[0].upper() + series[1:]
    odds = f"p {'' if entry['p_adjusted'] < 1e-4 else '= '}{format_p_value(entry['p_adjusted'])}"
    if verdict == "none_seen":
        apart = not entry["low"] <= 0.0 <= entry["high"]
        note = (
            "; at that lag alone it would stand out, in the whole search it does not"
            if apart
            else ""
        )
        tail = f" ({'; '.join(reasons)})" if reasons else ""
        return f"No coupling of {series} with {driver} is seen: {number}{late}, {odds} for the whole search{note}{tail}."
    if verdict == "not_told_apart" and entry["p_adjusted"] >= 0.05:
        late = f" {entry['lag_white']:.3g} s later" if entry["lag_white"] else ""
        return (
            f"{start} and {driver} change together{late}, by about {entry['slope_white']:.3g} {units}, but "
            f"{LIMITS['no_reversal'].format(driver=driver)}. Allowing for that, the sensitivity is anything from {between} {units}."
        )
    if verdict == "not_told_apart":
        return f"{start} goes with {driver}{late}, {number}, {odds} for the whole search, but {'; '.join(reasons)}."
    return f"{start} follows {driver}{late}: {number}, {odds} for the whole search{' (' + '; '.join(reasons) + ')' if reasons else ''}."

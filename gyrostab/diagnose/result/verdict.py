"""Decide whether the named effects explain a record, by its mismatches and its held-out data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

__all__ = ["decide_verdict", "failed_checks"]

#: Share of the cells inside their 95 % band when the model is right.
RIGHT_COVERAGE = 0.95
#: Fall of that share that counts as worse: two standard errors, 2 * sqrt(0.95 * 0.05 / 1080), for
#: the cells of at least 36 held-out stretches, three window lengths and some ten averaging times.
COVERAGE_TOLERANCE = 0.013


def _is_positive(value: Any) -> bool:
    return value is not None and math.isfinite(value) and value > 0.0


def _has_gain(held: Mapping[str, Any]) -> bool:
    return _is_positive(held["log_likelihood_gain"])


def _has_forecast(held: Mapping[str, Any]) -> bool:
    return held["forecast_gain"] is None or not held["forecast_gain"] < 0.0


def _has_coverage(held: Mapping[str, Any]) -> bool:
    before, after = held["coverage95_before"], held["coverage95_after"]
    if before is None or after is None or not math.isfinite(before) or not math.isfinite(after):
        return True
    return bool(after >= min(before, RIGHT_COVERAGE) - COVERAGE_TOLERANCE)


#: Checks of the held-out evidence, each with the message of a failure.
_CHECKS: tuple[tuple[Callable[[Mapping[str, Any]], bool], str], ...] = (
    (
        _has_gain,
        "held-out data are not predicted better "
        "(log-likelihood gain {log_likelihood_gain:.3g} nats)",
    ),
    (_has_forecast, "the forecast of the last 30 % is worse ({forecast_gain:.3g} nats)"),
    (
        _has_coverage,
        "fewer cells lie inside their 95 % band "
        "({coverage95_after:.1%}, before {coverage95_before:.1%})",
    ),
)


def failed_checks(held: Mapping[str, Any]) -> list[str]:
    """List the held-out checks that the effects fail.

    Parameters
    ----------
    held : mapping
        The table ``held_out`` of a diagnosis.

    Examples
    --------
    >>> held = {"log_likelihood_gain": 41.2, "forecast_gain": -3.0,
    ...         "coverage95_before": 0.71, "coverage95_after": 0.95}
    >>> failed_checks(held)
    ['the forecast of the last 30 % is worse (-3 nats)']
    """
    known = {name: math.nan if value is None else value for name, value in held.items()}
    return [text.format_map(known) for check, text in _CHECKS if not check(held)]


def decide_verdict(
    mismatches: Sequence[Any],
    named: Sequence[Any],
    unexplained: Iterable[int],
    held: Mapping[str, Any],
) -> str:
    """Choose one of `gyrostab.diagnose.result.content.VERDICTS`.

    Parameters
    ----------
    mismatches, named : sequence
        Mismatches, and named effects.
    unexplained : iterable of int
        Mismatches that no effect explains.
    held : mapping
        The table ``held_out`` of a diagnosis.

    Examples
    --------
    >>> good = {"log_likelihood_gain": 9.0, "forecast_gain": 2.0,
    ...         "coverage95_before": 0.7, "coverage95_after": 0.9}
    >>> decide_verdict([1], ["shupe"], [], good)
    'explained'
    >>> decide_verdict([1], ["shupe"], [], good | {"forecast_gain": -1.0})
    'partly explained'
    >>> decide_verdict([1], ["shupe"], [], good | {"log_likelihood_gain": -2.0})
    'unknown'
    """
    if not named:
        return "unknown" if mismatches else "no mismatch"
    if not _has_gain(held):
        return "unknown"
    return "partly explained" if list(unexplained) or failed_checks(held) else "explained"

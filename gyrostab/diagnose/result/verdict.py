"""Decide whether the named effects explain a record: by held-out data, and by their probability."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import expit, logit, logsumexp

from gyrostab.diagnose.identify.selections import Selection, own_form_error
from gyrostab.diagnose.settings import DEFAULTS, Settings

_MIN_EVIDENCE_NATS = 1e-3  # avoids a division by zero: the probability is zero far above


def _has_gain(held: Mapping[str, Any]) -> bool:
    """Return whether held-out data are predicted better; the gain may be the null of JSON."""
    return 0.0 < (held["log_likelihood_gain"] or 0.0) < math.inf


def failed_checks(held: Mapping[str, Any], *, settings: Settings = DEFAULTS) -> list[str]:
    """List the held-out checks that the effects fail.

    Examples
    --------
    >>> held = {"log_likelihood_gain": 41.2, "forecast_gain": -3.0,
    ...         "coverage95_before": 0.71, "coverage95_after": 0.95}
    >>> failed_checks(held)
    ['the forecast of the last 30 % is worse (-3 nats)']
    """
    gain, forecast, before, after = (
        math.nan if held[name] is None else float(held[name])
        for name in (
            "log_likelihood_gain",
            "forecast_gain",
            "coverage95_before",
            "coverage95_after",
        )
    )
    failed = []
    if not _has_gain(held):
        failed.append(
            f"held-out data are not predicted better (log-likelihood gain {gain:.3g} nats)"
        )
    if forecast < 0.0:
        failed.append(f"the forecast of the last 30 % is worse ({forecast:.3g} nats)")
    if after < min(before, 0.95) - settings.coverage_tolerance:
        failed.append(
            f"fewer cells lie inside their 95 % band ({100 * after:.1f} %, "
            f"before {100 * before:.1f} %)"
        )
    return failed


def doubtful_names(effects: Iterable[Mapping[str, Any]]) -> list[str]:
    """List the effects that are more probably wrong than right, each once.

    Examples
    --------
    >>> doubtful_names([{"name": "warm_up", "probability": 0.74}])
    []
    >>> doubtful_names([{"name": "warm_up", "probability": 0.2}])
    ['warm_up']
    """
    return list(
        dict.fromkeys(
            effect["name"]
            for effect in effects
            if effect.get("probability") is not None and effect["probability"] < 0.5
        )
    )


def name_probability(identification: Selection, *, settings: Settings = DEFAULTS) -> float:
    r"""Return the probability that the record contains this effect, and not an alternative.

    With the evidence :math:`E` of the effect [nats], and :math:`E_k` of its alternatives in its
    place, it is :math:`p(E) / (1 + w \sum_k \exp(E_k - E))`: p is the probability that one of them
    is right, and w the weight of an alternative of equal evidence. The log odds of p are those of
    large evidence times :math:`1 - E_0 / E`, with even odds at :math:`E_0`. An alternative that
    predicts the same data has the same evidence; so has one whose evidence differs by less than
    what an error of its form may cost the effect, and that of others differs by so much less.
    `benchmarks/name_probability.py` fits p, :math:`E_0` and w to blind tests.

    Examples
    --------
    >>> def alone(nats):
    ...     return Selection("shupe", ("temperature",), ("x",), (), nats, 8.0)
    >>> [round(name_probability(alone(nats)), 2) for nats in (10.0, 20.0, 100.0)]
    [0.71, 0.89, 0.96]
    """
    evidence_nats = max(identification.evidence_nats, _MIN_EVIDENCE_NATS)
    log_odds = logit(settings.set_probability) * (1.0 - settings.even_odds_nats / evidence_nats)
    other_nats = [
        max(
            (nats for key, nats in identification.instead.items() if key.partition("(")[0] == name),
            default=evidence_nats,
        )
        for name in identification.alternatives
    ]
    error = own_form_error(identification.components, evidence_nats, settings)
    ahead_nats = np.array(other_nats) - evidence_nats
    ahead_nats -= np.clip(ahead_nats, -error, error)
    # E_k - E may be any number of nats.
    weights = [1.0, *[settings.alternative_weight] * len(other_nats)]
    share = np.exp(-logsumexp([0.0, *ahead_nats], b=weights))
    return float(expit(log_odds) * share)


def decide_verdict(
    mismatches: Sequence[Any],
    effects: Sequence[Mapping[str, Any]],
    unexplained: Iterable[int],
    held: Mapping[str, Any],
    *,
    settings: Settings = DEFAULTS,
) -> str:
    """Choose one of `gyrostab.diagnose.result.content.VERDICTS`.

    Effects have ``name``, ``probability`` and ``alternatives``; `unexplained` are the numbers of
    the mismatches without an effect, `held` is `gyrostab.diagnose.result.content.HeldOut`.

    Examples
    --------
    >>> good = {"log_likelihood_gain": 9.0, "forecast_gain": 2.0,
    ...         "coverage95_before": 0.7, "coverage95_after": 0.9}
    >>> shupe = {"name": "shupe", "probability": 0.95, "alternatives": []}
    >>> decide_verdict([1], [shupe], [], good)
    'explained'
    >>> decide_verdict([1], [shupe], [], good | {"forecast_gain": -1.0})
    'partly explained'
    >>> decide_verdict([1], [shupe | {"probability": 0.3}], [], good)
    'partly explained'
    >>> decide_verdict([1], [shupe], [], good | {"log_likelihood_gain": -2.0})
    'unknown'
    """
    if not effects:
        return "unknown" if mismatches else "no mismatch"
    if not _has_gain(held):
        return "unknown"
    doubts = [*unexplained, *failed_checks(held, settings=settings), *doubtful_names(effects)]
    return "partly explained" if doubts else "explained"

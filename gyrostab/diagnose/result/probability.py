"""Probability that the name of an identification is right."""

from __future__ import annotations

import numpy as np

from gyrostab.diagnose.identify.identification import Identification
from gyrostab.diagnose.settings import DEFAULTS, Settings

__all__ = ["name_probability"]


def name_probability(identification: Identification, *, settings: Settings = DEFAULTS) -> float:
    r"""Return the probability that the record contains this effect, and not an alternative.

    With the evidence :math:`E` of the effect [nats], and :math:`E_k` of its alternatives in its
    place, it is :math:`p / (1 + \sum_k \exp(E_k - E))`: p is the probability that one of them is
    right, and all are equally probable beforehand. An alternative that predicts the same data has
    the same evidence. `benchmarks/name_probability.py` compares it with blind tests.

    Examples
    --------
    >>> alone = Identification("shupe", ("temperature",), ("x",), (), 20.0, 8.0)
    >>> name_probability(alone) == DEFAULTS.set_probability
    True
    """
    evidence_nats = identification.evidence_nats
    other_nats = [_evidence_instead(identification, name) for name in identification.alternatives]
    # E_k - E may be any number of nats.
    share = np.exp(evidence_nats - np.logaddexp.reduce([evidence_nats, *other_nats]))
    return float(settings.set_probability * share)


def _evidence_instead(identification: Identification, effect: str) -> float:
    """Return the evidence of an alternative in the place of an effect [nats]."""
    nats_instead = [
        nats for key, nats in identification.instead.items() if key.partition("(")[0] == effect
    ]
    return max(nats_instead, default=identification.evidence_nats)

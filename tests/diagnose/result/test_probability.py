"""The probability of a name falls with the evidence of its alternatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.result.verdict import name_probability
from gyrostab.diagnose.settings import Settings

#: The probability of a name without alternatives does not depend on its evidence here.
SETTINGS = Settings(set_probability=0.9, even_odds_nats=0.0, alternative_weight=0.5)
ALONE = Selection("shupe", ("temperature",), ("x",), (), 20.0, 8.0)


def probability(*alternatives: str, **instead: float) -> float:
    with_rivals = replace(ALONE, alternatives=alternatives, instead=instead)
    return name_probability(with_rivals, settings=SETTINGS)


def test_an_alternative_takes_its_share():
    assert probability() == pytest.approx(0.9)
    # one that predicts the same data
    assert probability("thermal_gradient") == pytest.approx(0.6)
    assert probability("thermal_gradient", thermal_gradient=20.0) == pytest.approx(0.6)
    assert probability("thermal_gradient", "ageing_bias") == pytest.approx(0.45)


def test_evidence_against_an_alternative_raises_the_probability():
    probabilities = [
        probability("warm_up", warm_up=nats) for nats in (22.2, 20.0, 19.0, 17.0, 10.0)
    ]
    assert probabilities == sorted(probabilities)
    assert probabilities[-1] == pytest.approx(0.9, abs=1e-4)
    # a plainer effect may be named although another has more evidence; the form costs up to 0.2
    assert probabilities[0] == pytest.approx(0.9 / (1.0 + 0.5 * np.exp(2.0)))
    assert probability("rate_quantization", rate_quantization=7e5) == 0.0


def test_differences_that_the_form_of_the_effect_may_cost_do_not_count():
    for nats in (1995.0, 1980.0, 2020.0):
        strong = replace(ALONE, evidence_nats=2000.0, alternatives=("warm_up",))
        strong = replace(strong, instead={"warm_up": nats})
        assert name_probability(strong, settings=SETTINGS) == pytest.approx(0.6)
    weaker = replace(strong, instead={"warm_up": 1979.0})
    assert name_probability(weaker, settings=SETTINGS) == pytest.approx(
        0.9 / (1.0 + 0.5 * np.exp(-1.0))
    )


def test_the_channel_with_most_evidence_counts():
    named = replace(
        ALONE,
        alternatives=("supply_bias",),
        instead={"supply_bias(supply_voltage)": 19.0, "supply_bias(light_power)": 12.0},
    )
    assert name_probability(named, settings=SETTINGS) == probability("warm_up", warm_up=19.0)


def test_an_effect_that_was_not_an_alternative_does_not_count():
    assert probability(ageing_bias=19.9) == pytest.approx(0.9)


def test_little_evidence_lowers_the_probability():
    settings = replace(SETTINGS, even_odds_nats=8.0)
    probabilities = [
        name_probability(replace(ALONE, evidence_nats=nats), settings=settings)
        for nats in (-3.0, 4.0, 8.0, 16.0, 1e6)
    ]
    # half of the log odds of 9 at twice the evidence of even odds
    assert probabilities == pytest.approx([0.0, 0.1, 0.5, 0.75, 0.9], abs=1e-5)

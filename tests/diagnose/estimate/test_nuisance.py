"""Lags and exponents that a record does not tell: the plainest is said, and sizes know of the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.physics.registry import make_effect
from tests.diagnose.estimate.test_joint_fit import claimed
from tests.support.named import record


@pytest.fixture(scope="module")
def quiet():
    blocks = record([])
    return blocks, calibrate_noise(blocks)


def _variant(identifications, component, values):
    candidate = next(
        one
        for one in identifications.candidates
        if one.key == component.candidate.key and one.statistic == component.candidate.statistic
    )
    return next(
        one
        for one in candidate.variants
        if one.columns == component.variant.columns
        and all(
            one.values[name] == pytest.approx(value, rel=0.01) for name, value in values.items()
        )
    )


def fitted(quiet, effect, statistic, column, *, true, size, named):
    """The fit of an effect with the values `true`, where naming likes `named` best."""
    blocks, baseline = quiet
    identifications = claimed(blocks, baseline, effect, statistic, (column,))
    component = identifications.identified[0].components[0]
    design = _variant(identifications, component, true).design
    if statistic == "mean":
        seen = blocks.assign(
            mean=blocks["mean"]
            + size * np.stack([design[0, 0], 0 * design[0, 0], 0 * design[0, 0]])
        )
    else:
        seen = blocks.assign(
            power=blocks["power"]
            + size**2 * np.stack([design[0, 0], 0 * design[0, 0], 0 * design[0, 0]])
        )
    component = replace(component, variant=_variant(identifications, component, named))
    identification = replace(identifications.identified[0], components=(component,))
    state = condition_on(initial_state(seen, baseline), [component])
    (found,) = fit_identifications(
        replace(identifications, identified=(identification,), state=state), baseline
    )
    return found


def test_where_the_record_does_not_tell_a_lag_there_is_none_and_the_size_has_room_for_it(quiet):
    truth = 0.01
    found = fitted(
        quiet,
        "shupe",
        "mean",
        "sensitivity",
        true={"lag": 1e-3, "sensor_lag": 0.0},
        size=truth,
        named={"lag": 75.4, "sensor_lag": 60.0},
    )
    lag, size = found.parameters["lag"], found.parameters["sensitivity"]
    assert (lag.value, lag.low, found.parameters["sensor_lag"].value) == (0.0, 0.0, 0.0)
    assert 20.0 < lag.high < 3000.0
    assert size.low < truth < size.high
    assert (found.effect.lag, found.effect.sensor_lag) == (1e-3, 0.0)
    assert " s at most" in found.say()


def test_a_lag_that_the_record_shows_is_told(quiet):
    found = fitted(
        quiet,
        "shupe",
        "mean",
        "sensitivity",
        true={"lag": 475.5, "sensor_lag": 0.0},
        size=0.3,
        named={"lag": 475.5, "sensor_lag": 0.0},
    )
    assert found.parameters["lag"].low > 100.0
    assert found.parameters["lag"].value == pytest.approx(475.5, rel=0.2)
    assert found.parameters["sensitivity"].value == pytest.approx(0.3, rel=0.1)


def test_the_exponent_of_the_model_is_that_of_the_size(quiet):
    found = fitted(
        quiet,
        "vibration_noise",
        "power",
        "white",
        true={"exponent": 1.0},
        size=1e-4,
        named={"exponent": 2.0},
    )
    assert found.effect.exponent == 1.0
    assert "exponent" not in found.parameters


def test_a_lag_of_nothing_is_no_lag():
    assert (
        make_effect({"name": "shupe", "sensitivity": 0.1, "lag": 1e-3, "axes": ["x"]})
        .say()
        .endswith("(degC/min) without a lag.")
    )

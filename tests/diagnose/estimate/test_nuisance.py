"""Lags and exponents that a record does not determine: defaults, and sizes with room for others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.windows import make_windows
from gyrostab.physics.registry import make_effect
from gyrostab.wording import format_value
from tests.diagnose.estimate.test_joint_fit import identify_by_hand
from tests.support.named import record


@pytest.fixture(scope="module")
def noise_only():
    blocks = record([])
    return blocks, calibrate_noise(blocks)


def _find_variant(component, values):
    return next(
        variant
        for variant in component.candidate.variants
        if variant.columns == component.variant.columns
        and all(
            variant.values[name] == pytest.approx(value, rel=0.01) for name, value in values.items()
        )
    )


def fit_effect(noise_only, effect, statistic, column, *, true, size, named):
    """Fit an effect with the values `true`, where the identification prefers `named`."""
    blocks, baseline = noise_only
    identifications = identify_by_hand(blocks, baseline, effect, statistic, (column,))
    component = identifications.identified[0].components[0]
    design = _find_variant(component, true).design
    size = size if statistic == "mean" else size**2
    added = size * np.stack([design[0, 0], 0 * design[0, 0], 0 * design[0, 0]])
    changed = blocks.assign({statistic: blocks[statistic] + added})
    component = replace(component, variant=_find_variant(component, named))
    identification = replace(identifications.identified[0], components=(component,))
    state = condition_on(initial_state(changed, baseline), [component])
    (fitted,) = fit_identifications(
        replace(identifications, identified=(identification,), state=state), baseline
    )
    return fitted


@pytest.mark.slow
def test_undetermined_lag_is_zero_and_widens_the_size(noise_only):
    truth = 0.01
    fitted = fit_effect(
        noise_only,
        "shupe",
        "mean",
        "sensitivity",
        true={"lag": 1e-3, "sensor_lag": 0.0},
        size=truth,
        named={"lag": 75.4, "sensor_lag": 60.0},
    )
    lag, size = fitted.parameters["lag"], fitted.parameters["sensitivity"]
    assert (lag.value, lag.low, fitted.parameters["sensor_lag"].value) == (0.0, 0.0, 0.0)
    assert 20.0 < lag.high < 3000.0
    assert size.low < truth < size.high
    assert (fitted.effect.lag, fitted.effect.sensor_lag) == (1e-3, 0.0)
    assert " s at most" in fitted.say()


def test_determined_lag_is_estimated(noise_only):
    fitted = fit_effect(
        noise_only,
        "shupe",
        "mean",
        "sensitivity",
        true={"lag": 475.5, "sensor_lag": 0.0},
        size=0.3,
        named={"lag": 475.5, "sensor_lag": 0.0},
    )
    assert fitted.parameters["lag"].low > 100.0
    assert fitted.parameters["lag"].value == pytest.approx(475.5, rel=0.2)
    assert fitted.parameters["sensitivity"].value == pytest.approx(0.3, rel=0.1)


def test_values_of_the_model_belong_together(noise_only):
    """Averages over two lags are not the effect with the average lag."""
    fitted = fit_effect(
        noise_only,
        "shupe",
        "mean",
        "sensitivity",
        true={"lag": 475.5, "sensor_lag": 0.0},
        size=0.06,
        named={"lag": 475.5, "sensor_lag": 0.0},
    )
    effect, lag = fitted.effect, fitted.parameters["lag"]
    assert effect.lag != pytest.approx(lag.value, rel=0.01)
    assert lag.low < effect.lag < lag.high
    assert f"a lag of {format_value(lag.value, lag.stderr)} ± " in fitted.say()
    blocks, _ = noise_only
    windows = make_windows(blocks, {"temperature": "temperature"})
    made, true = (
        version.sensitivity * version.explain(windows).mean["sensitivity"]
        for version in (effect, replace(effect, sensitivity=0.06, lag=475.5, sensor_lag=0.0))
    )
    assert np.std(made - true) < 0.3 * np.std(true)


def test_exponent_of_the_model_is_that_of_the_size(noise_only):
    fitted = fit_effect(
        noise_only,
        "vibration_noise",
        "power",
        "white",
        true={"exponent": 1.0},
        size=1e-4,
        named={"exponent": 2.0},
    )
    assert fitted.effect.exponent == 1.0
    assert "exponent" not in fitted.parameters


def test_effect_without_lags_has_no_lag_places():
    assert (
        make_effect({"name": "shupe", "sensitivity": 0.1, "lag": 1e-3, "axes": ["x"]})
        .say()
        .endswith("(degC/min) without a lag.")
    )

"""Components locked to the rotation: earth rate with either handedness, and harmonics."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.simulate import simulate
from tests.support.candidates import find_components, make_identifications
from tests.support.repetitions import first_of


def _simulate_rotation(*effects, points=((0, 108.0), (1200, 108.0))):
    model = {
        "log": {"axes": ["x", "y"]},
        "noise": {"N": 0.003},
        "effect": list(effects),
        "environment": [{"profile": "rotation", "points": [list(point) for point in points]}],
    }
    return simulate(model, duration="20min", rate=10.0, seed=5).compute()


def _some_parameters(effect, *names):
    """Return some parameters of an effect, as a model has them."""
    values = {name: getattr(effect, name) for name in names}
    return {"name": effect.name} | {
        name: list(value) if isinstance(value, tuple) else value for name, value in values.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("around", first_of(-90.0, 90.0))
def test_earth_rate_is_recovered(around):
    log = _simulate_rotation(
        {
            "name": "earth_rate",
            "latitude": 45.0,
            "toolface": 40.0,
            "off": [90.0, 90.0],
            "around": [0.0, around],
        }
    )
    blocks = reduce_log(log)
    baseline = calibrate_noise(blocks)
    known, reasons = effect_candidates(blocks, baseline["coefficient"])
    orders = [candidate for candidate in known if candidate.statistic.name == "rotation_order"]
    start = initial_state(blocks, baseline)
    components = find_components(orders, start)["earth_rate(rotation_rate)"]
    assert sum_evidence(components) > 1000.0
    state = condition_on(start, components)
    assert max(map(sum_evidence, find_components(orders, state).values())) < 5.0
    identification = Selection(
        "earth_rate", components[0].candidate.driver, ("x", "y"), tuple(components), 500.0, 8.0
    )
    identifications = make_identifications([identification], state, known, reasons)
    (fitted,) = fit_identifications(identifications, baseline)
    simulated = _simulate_rotation(
        _some_parameters(fitted.effect, "latitude", "toolface", "off", "around")
    )
    assert float(np.abs(simulated["rate"] - log["rate"]).max()) < 0.01 * float(log["rate"].std())


@pytest.mark.slow
@pytest.mark.parametrize(("latitude", "most"), [(60.0, 4.5), (89.8, 0.3)])
def test_angles_have_the_relative_error_of_the_size(latitude, most):
    """4 % of the earth rate across the tool, not of the angle, whose origin is arbitrary."""
    log = _simulate_rotation(
        {
            "name": "earth_rate",
            "latitude": latitude,
            "toolface": 150.0,
            "off": [90.0, 90.0],
            "around": [0.0, 90.0],
        }
    )
    blocks = reduce_log(log)
    baseline = calibrate_noise(blocks)
    known, reasons = effect_candidates(blocks, baseline["coefficient"])
    start = initial_state(blocks, baseline)
    orders = [candidate for candidate in known if candidate.statistic.name == "rotation_order"]
    components = find_components(orders, start)["earth_rate(rotation_rate)"]
    identification = Selection(
        "earth_rate", components[0].candidate.driver, ("x", "y"), tuple(components), 500.0, 8.0
    )
    identifications = make_identifications(
        [identification], condition_on(start, components), known, reasons
    )
    estimates = fit_identifications(identifications, baseline)[0].parameters
    assert estimates["latitude"].low < latitude < estimates["latitude"].high
    by_size = np.degrees(1.96 * 0.04 / np.tan(np.radians(latitude)))
    assert 0.9 * by_size < (estimates["latitude"].high - estimates["latitude"].low) / 2.0 < most
    assert np.degrees(0.04) - 1e-9 < estimates["toolface"].stderr < 7.0
    assert estimates["toolface"].low < 150.0 < estimates["toolface"].high


def test_all_harmonics_of_the_rotation_are_recovered():
    """The second line is the strongest, the third half of it; x has all, y only the first."""
    points = ((0, 108.0), (600, 108.0), (610, 66.0), (1200, 66.0))
    first_order = {
        "name": "rotation_line",
        "amplitude": [0.5, 0.4],
        "phase": [40.0, -60.0],
        "axes": ["x", "y"],
    }
    x = {"name": "rotation_line", "axes": ["x"]}
    log = _simulate_rotation(
        first_order,
        {**x, "order": 2.0, "amplitude": [0.8], "phase": [100.0]},
        {**x, "order": 3.0, "amplitude": [0.4]},
        points=points,
    )
    blocks = reduce_log(log)
    baseline = calibrate_noise(blocks)
    known, reasons = effect_candidates(blocks, baseline["coefficient"])
    orders = [
        candidate
        for candidate in known
        if candidate.statistic.name == "rotation_order" and candidate.effect == "rotation_line"
    ]
    start = initial_state(blocks, baseline)
    components = find_components(orders, start)["rotation_line(rotation_rate)"]
    identification = Selection(
        "rotation_line",
        components[0].candidate.driver,
        ("x", "y"),
        tuple(components),
        sum_evidence(components),
        8.0,
    )
    identifications = make_identifications(
        [identification], condition_on(start, components), known, reasons
    )
    fitted = fit_identifications(identifications, baseline)
    assert [(fitted_effect.effect.order, fitted_effect.axes) for fitted_effect in fitted] == [
        (1.0, ("x", "y")),
        (2.0, ("x",)),
        (3.0, ("x",)),
    ]
    simulated = _simulate_rotation(
        *(
            {
                **_some_parameters(fitted_effect.effect, "amplitude", "phase", "order"),
                "axes": list(fitted_effect.axes),
            }
            for fitted_effect in fitted
        ),
        points=points,
    )
    left, whole = (
        (recording["rate"] - log["rate"]).std("time").values
        for recording in (simulated, _simulate_rotation(points=points))
    )
    assert (left < 0.05 * whole).all()

"""Conditions for an effect to be listed, and for a record to count as explained."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gyrostab
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.joint_fit import Estimate, Fitted, fit_identifications
from gyrostab.diagnose.evidence.mixture import Mixture
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.candidates import Candidate, Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.result import finish as conclude
from gyrostab.diagnose.result.finish import keep_supported, supported_axes
from gyrostab.diagnose.result.record_text import summary
from gyrostab.diagnose.result.tables import effect_tables, unidentified_mismatches
from gyrostab.diagnose.result.verdict import decide_verdict, failed_checks
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.physics.registry import effects
from tests.diagnose.estimate.test_recalibrate import SHAKE, identify_by_hand, reduce_simulation
from tests.support.candidates import make_identifications
from tests.support.diagnosed import content

SHUPE: dict[str, Any] = content()["effects"][0] | {
    "name": "shupe",
    "probability": 0.95,
    "alternatives": [],
}
GOOD = {
    "blocks": 36, "log_likelihood_gain": 41.2, "stderr": 6.0, "misfit_before": 3.1,
    "misfit_after": 1.0,
    "coverage95_before": 0.71, "coverage95_after": 0.95, "forecast_gain": 12.0,
}  # fmt: skip


def estimate(value: float, error: float) -> Estimate:
    return Estimate(value, error, value - 1.96 * error, value + 1.96 * error, "deg/h")


def make_selection(
    effect: str, axes: str, gains: tuple[float, ...] | None = None, *, statistic: str = "mean"
) -> Selection:
    candidate: Any = Candidate(effect, find_statistic(statistic), (), ())
    variant: Any = SimpleNamespace(values={}, columns=())
    components = tuple(
        Component(candidate, variant, (axis,), evidence_nats)
        for axis, evidence_nats in zip(axes, gains or (20.0,) * len(axes), strict=True)
    )
    return Selection(effect, (), tuple(axes), components, 20.0 * len(axes), 8.0)


@pytest.mark.parametrize(
    ("parameters", "axes"),
    [
        ({"sensitivity": estimate(0.4, 0.1)}, ("x", "y")),
        ({"sensitivity": estimate(0.1, 0.1)}, ()),
        ({"sensitivity.x": estimate(-0.4, 0.1), "sensitivity.y": estimate(0.1, 0.1)}, ("x",)),
        ({"sensitivity": estimate(0.0, 0.0)}, ()),
        ({"sensitivity": estimate(0.1, 0.1), "quadratic": estimate(0.5, 0.1)}, ("x", "y")),
        ({"sensitivity": estimate(0.1, 0.1), "lag": estimate(60.0, 1.0)}, ()),
        ({"sensitivity": Estimate(0.4, math.nan, math.nan, math.nan, "deg/h")}, ()),
        ({}, ("x", "y")),
    ],
)
def test_axis_is_supported_if_a_size_differs_from_zero(
    parameters: dict[str, Estimate], axes: tuple[str, ...]
):
    identification = make_selection("temperature_bias", "xy")
    assert supported_axes(Fitted(identification, ("x", "y"), parameters, None)) == axes


def test_line_of_zero_amplitude_is_not_an_effect():
    identification = make_selection("spectral_line", "x", statistic="spectral_line")
    nothing = {
        "amplitude": Estimate(0.0, 0.0, 0.0, 0.0, "deg/h"),
        "frequency": Estimate(0.0, 0.1, 0.0, 0.2, "Hz"),
    }
    identifications = keep_supported(
        make_identifications([identification]), [[Fitted(identification, ("x",), nothing, None)]]
    )
    assert not identifications.identified
    assert [
        (unidentified.axes, unidentified.alternatives)
        for unidentified in identifications.unidentified
    ] == [(("x",), ("spectral_line",))]


def test_effect_keeps_axes_with_a_size():
    identification, other = (
        make_selection("temperature_bias", "xy"),
        make_selection("shupe", "z"),
    )
    numbers = [
        [
            Fitted(identification, (axis,), {"sensitivity": estimate(0.4, error)}, None)
            for axis, error in (("x", 0.1), ("y", 1.0))
        ],
        [Fitted(other, ("z",), {"sensitivity": estimate(0.4, 0.1)}, None)],
    ]
    rival = identification.evidence_nats - 2.0
    identification = replace(identification, instead={"shupe": rival})
    before = make_identifications([identification, other])
    identifications = keep_supported(before, numbers)
    assert [
        (identification.effect, identification.axes)
        for identification in identifications.identified
    ] == [
        ("temperature_bias", ("x",)),
        ("shupe", ("z",)),
    ]
    supported = identifications.identified[0]
    assert supported.components == identification.components[:1]
    assert supported.evidence_nats < identification.evidence_nats
    assert supported.instead == {"shupe": supported.evidence_nats - 2.0}  # on the same axes
    assert [
        (unidentified.axes, unidentified.effect) for unidentified in identifications.unidentified
    ] == [(("y",), "~bias(t)")]
    assert keep_supported(before, [numbers[0][:1], numbers[1]]).identified[0].axes == ("x",)
    assert keep_supported(identifications, [numbers[0][:1], numbers[1]]) is identifications


def test_unsupported_rest_below_the_threshold_is_dropped():
    identification = make_selection("temperature_bias", "xy", (30.0, 3.0))
    numbers = [
        [
            Fitted(identification, (axis,), {"sensitivity": estimate(0.4, error)}, None)
            for axis, error in (("x", 0.1), ("y", 1.0))
        ]
    ]
    identifications = keep_supported(make_identifications([identification]), numbers)
    assert [identification.axes for identification in identifications.identified] == [("x",)]
    assert not identifications.unidentified


def test_effect_of_possibly_zero_size_becomes_unidentified():
    """Vibration without any effect, named by hand: what remains is a mismatch without an effect."""
    blocks = reduce_simulation(environment=[SHAKE])
    baseline = calibrate_noise(blocks)
    identifications = identify_by_hand(
        blocks, baseline, "vibration_rectification", "mean", ("sensitivity",)
    )
    examination = replace(identifications.examination, null_best=np.arange(8.0))
    identifications = replace(identifications, examination=examination)
    supported, first, fit = conclude.fit_supported(identifications, baseline)
    assert (supported.identified, first, fit.fitted) == ((), [], [])
    assert effect_tables(fit.fitted, blocks) == []
    (region,) = unidentified_mismatches(fit.identifications, blocks, [])
    assert region["explained_by"] == []
    assert "a bias caused by vibration" in region["statement"]


# --------------------------------------------------------------------------------
# ------------- verdict


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        ({}, "explained"),
        ({"log_likelihood_gain": -0.1}, "unknown"),
        ({"log_likelihood_gain": None}, "unknown"),
        ({"forecast_gain": -0.1}, "partly explained"),
        ({"forecast_gain": 0.0}, "explained"),
        ({"forecast_gain": None}, "explained"),
        ({"coverage95_after": 0.65}, "partly explained"),
        ({"coverage95_before": 0.99, "coverage95_after": 0.95}, "explained"),
        ({"coverage95_before": 0.93, "coverage95_after": 0.92}, "explained"),
        ({"coverage95_before": None, "coverage95_after": None}, "explained"),
    ],
)
def test_held_out_data_decide_the_verdict(change: dict[str, Any], verdict: str):
    held = GOOD | change
    assert decide_verdict([{}], [SHUPE], [], held) == verdict
    assert bool(failed_checks(held)) == (verdict != "explained")
    assert decide_verdict([{}], [SHUPE], [1], held) != "explained"
    assert decide_verdict([{}], [], [1], held) == "unknown"
    assert decide_verdict([], [], [], held) == "no mismatch"


@pytest.mark.parametrize(
    ("probability", "alternatives", "verdict"),
    [
        (0.95, 0, "explained"),
        (0.74, 1, "explained"),
        (0.53, 3, "explained"),
        (0.49, 3, "partly explained"),
        (0.49, 0, "partly explained"),
        (None, 1, "explained"),
    ],
)
def test_a_name_that_is_probably_wrong_does_not_explain(
    probability: float | None, alternatives: int, verdict: str
):
    effect = SHUPE | {
        "probability": probability,
        "alternatives": ["warm_up", "bias_jump", "telegraph"],
    }
    effect["alternatives"] = effect["alternatives"][:alternatives]
    assert decide_verdict([{}], [SHUPE, effect], [], GOOD) == verdict
    text = summary(
        content() | {"verdict": verdict, "effects": [effect], "unexplained": [], "held_out": GOOD}
    )
    assert ("is only 49 %" in text) == (verdict != "explained")
    assert ("It may instead be" in text) == (verdict != "explained" and alternatives > 0)


NUMBER = st.none() | st.floats(-1e9, 1e9)
SHARE = st.none() | st.floats(0.0, 1.0)


@given(
    evidence_nats=NUMBER,
    forecast=NUMBER,
    before=SHARE,
    after=SHARE,
    left=st.lists(st.integers(1, 3), max_size=2),
)
def test_explained_requires_evidence(evidence_nats, forecast, before, after, left):
    held = GOOD | {
        "log_likelihood_gain": evidence_nats,
        "forecast_gain": forecast,
        "coverage95_before": before,
        "coverage95_after": after,
    }
    verdict = decide_verdict([{}], [SHUPE], left, held)
    assert (verdict == "explained") == (not left and not failed_checks(held))
    if verdict == "explained":
        assert evidence_nats > 0.0
        assert forecast is None or forecast >= 0.0
        assert before is None or after is None or after >= min(before, 0.95) - 0.02
    text = summary(content() | {"verdict": verdict, "unexplained": left, "held_out": held})
    assert text.endswith(".")
    assert ("do not describe the record well" in text) == bool(failed_checks(held))


@given(
    st.lists(
        st.tuples(st.floats(0.0, 1e12), st.floats(1e-9, 1e12), st.floats(1e-300, 1.0)),
        min_size=1,
        max_size=6,
    ),
)
def test_limit_of_a_mixture_lies_between_its_laws(laws):
    size, sd, share = np.array(laws).T
    ends = size + 1.6448536269514722 * sd
    mixture = Mixture(np.log(share), size[:, None], np.square(sd)[:, None, None])
    limit = mixture.quantiles(0.05)[1, 0]
    assert ends.min() * (1.0 - 1e-9) <= limit <= ends.max() * (1.0 + 1e-9)


@pytest.mark.full
@pytest.mark.parametrize(
    ("points", "has_forecast"),
    [
        ([[0, 3.0], [400, 6.0], [800, 3.0], [1200, 6.0], [1800, 6.0]], True),
        ([[0, 0.02], [400, 0.02], [401, 6.0], [800, 6.0], [801, 0.02], [1800, 0.02]], False),
        ([[0, 0.02], [1500, 0.02], [1501, 6.0], [1800, 6.0]], False),
    ],
    ids=["all the time", "over", "at the end"],
)
def test_only_lasting_effects_are_forecast(points: list[list[float]], has_forecast: bool):
    """An event that is over does not affect later data, and the size of one near the end is unknown
    before."""
    shaken = {"profile": "vibration", "points": points}
    blocks = reduce_simulation(
        {"name": "vibration_noise", "white": 0.002, "axes": ["x"]},
        axes=("x",),
        environment=[shaken],
    )
    baseline = calibrate_noise(blocks)
    identifications = identify_by_hand(
        blocks, baseline, "vibration_noise", "power", ("white",), exponent=1.0
    )
    held = conclude.measure_held_out(
        blocks, baseline, identifications, fit_identifications(identifications, baseline)
    )
    assert math.isfinite(held["forecast_gain"]) == has_forecast
    assert held["log_likelihood_gain"] > 0.0
    if has_forecast:
        assert held["forecast_gain"] > 0.0


@pytest.mark.slow
def test_noise_that_is_over_does_not_spoil_the_forecast_of_another_effect():
    """The forecast begins from noise that was calibrated with the vibration in its model."""
    shaken = {
        "profile": "vibration",
        "points": [[0, 0.02], [300, 0.02], [301, 3.0], [600, 3.0], [601, 0.02], [1800, 0.02]],
    }
    heat = {
        "profile": "ramps",
        "channel": "temperature",
        "unit": "degC",
        "points": [[300 * place, 20 + 40 * (place % 2)] for place in range(7)],
    }
    blocks = reduce_simulation(
        {"name": "vibration_noise", "white": 0.02, "axes": ["x"]},
        {"name": "temperature_noise", "linear": 0.1, "axes": ["x"]},
        axes=("x",),
        environment=[shaken, heat],
    )
    baseline = calibrate_noise(blocks)
    vibration, warmth = (
        identify_by_hand(blocks, baseline, name, "power", (column,), **values)
        for name, column, values in (
            ("vibration_noise", "white", {"exponent": 1.0}),
            ("temperature_noise", "linear", {}),
        )
    )
    both = replace(
        vibration,
        identified=(*vibration.identified, *warmth.identified),
        state=condition_on(vibration.state, list(warmth.identified[0].components)),
    )
    held = conclude.measure_held_out(blocks, baseline, both, fit_identifications(both, baseline))
    assert held["forecast_gain"] > 0.0


@pytest.mark.full
def test_bench_rotation_is_not_explained_by_a_failed_forecast(
    recordings: Callable[[str], Path],
):
    """A real record of 27 s whose rate reaches 123 deg/s at its end; upper limits once stopped the
    diagnosis."""
    path = recordings("fog-hybrid-warmup/run2_turn.txt")
    known = {
        "map": {"wx": "gyro_x", "wy": "gyro_y", "wz": "gyro_z"},
        "unit": {"gyro": "deg/s", "time": "s"},
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        diagnosis = gyrostab.diagnose(
            gyrostab.regularise(gyrostab.read_log([path], **known)), nulls=100
        )
    assert diagnosis.verdict == "partly explained"
    for effect in diagnosis.effects:
        sizes = {
            name: entry
            for name, entry in effect["parameters"].items()
            if name.split(".")[0] in effects()[effect["name"]].size_parameters
        }
        assert not sizes or any(
            entry["low"] > 0.0 or entry["high"] < 0.0 for entry in sizes.values()
        ), effect
    failed = failed_checks(diagnosis.content["held_out"])
    assert all(text in str(diagnosis) for text in failed)

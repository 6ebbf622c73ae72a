"""Phase-locked components count by their own statistic, not by band powers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.result.held_out_table import remove_phase_locked
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.simulate import simulate
from tests.support.candidates import make_identifications

N = 0.003  # deg/sqrt(h)


def component(statistic: str, evidence_nats: float) -> Component:
    variant = Variant({}, np.ones((1, 1, 1)), ("any",))
    return Component(
        Candidate("rotation_line", find_statistic(statistic), (), (variant,)),
        variant,
        ("x",),
        evidence_nats,
    )


def identification(*components: Component) -> Selection:
    return Selection(
        "rotation_line",
        (),
        ("x",),
        components,
        sum(component.evidence_nats for component in components),
        6.0,
    )


def test_only_phase_locked_components_are_removed() -> None:
    mean, wave, comb = (
        component("mean", 5.0),
        component("rotation_order", 20.0),
        component("ramp_phase", 7.0),
    )
    identifications = make_identifications(
        [identification(mean, wave), identification(comb), identification(mean)]
    )
    left, evidence_nats = remove_phase_locked(identifications, xr.Dataset())
    assert evidence_nats == 27.0
    assert [identification.components for identification in left.identified] == [(mean,), (mean,)]
    assert left.identified[1] is identifications.identified[2]


def line_model(size: float, seconds: float) -> dict[str, Any]:
    """A line at the rotation rate on x, and a second axis with noise only."""
    return {
        "noise": {"N": N, "B": 0.002, "K": 0.01},
        "effect": [{"name": "rotation_line", "amplitude": size, "axes": ["x"]}],
        "environment": [
            {"profile": "rotation", "points": [[0, 70.0], [seconds / 2.0, 75.0], [seconds, 72.0]]}
        ],
        "log": {"axes": ["x", "y"]},
    }


@pytest.mark.slow
def test_evidence_of_a_rotation_line_follows_the_normal_law() -> None:
    size, seconds = 0.07, 1200.0
    diagnosis = diagnose(
        simulate(line_model(size, seconds), duration=seconds, rate=10.0, seed=4).compute(),
        nulls=100,
    )
    assert [effect["name"] for effect in diagnosis.effects] == ["rotation_line"]
    assert diagnosis.content["held_out"]["log_likelihood_gain"] == pytest.approx(
        size**2 * seconds / (4.0 * 3600.0 * N**2), rel=0.5
    )


@pytest.mark.full
def test_allan_variance_is_compared_with_the_complete_model() -> None:
    """The model for the likelihood lacks the phase-locked power, and would fit no better than
    before."""
    table = line_model(0.3, 600.0)
    log = simulate(table, duration=600.0, rate=10.0, seed=4).compute()
    diagnosis = diagnose(log, simulation={"noise": table["noise"]}, nulls=100)
    assert [effect["name"] for effect in diagnosis.effects] == ["rotation_line"]
    held = diagnosis.content["held_out"]
    assert held["misfit_before"] > 1.5
    assert held["misfit_after"] == pytest.approx(1.0, abs=0.2)

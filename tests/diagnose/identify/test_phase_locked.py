"""Waves of known course, in what the effects are worth together: by their own view, not by the power of their bands."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.identify.identification import Identification, Identifications
from gyrostab.diagnose.identify.phase_locked import remove_phase_locked
from gyrostab.diagnose.predict.candidates import Candidate, Variant
from gyrostab.diagnose.predict.condition import Component
from gyrostab.simulate import simulate

N = 0.003  # deg/sqrt(h)


def component(statistic: str, evidence_nats: float) -> Component:
    variant = Variant({}, np.ones((1, 1, 1)), ("any",))
    return Component(
        Candidate("rotation_line", statistic, (), (variant,)), variant, ("x",), evidence_nats
    )


def identification(*components: Component) -> Identification:
    return Identification(
        "rotation_line", (), ("x",), components, sum(one.evidence_nats for one in components), 6.0
    )


def test_only_waves_are_taken_out_with_what_they_gain() -> None:
    mean, wave, comb = (
        component("mean", 5.0),
        component("order", 20.0),
        component("phase_locked", 7.0),
    )
    identifications = Identifications(
        (identification(mean, wave), identification(comb), identification(mean)),
        (),
        6.0,
        np.zeros(1),
        {},
        (),
        None,
        xr.DataArray(),
    )  # type: ignore[arg-type]
    left, evidence_nats = remove_phase_locked(identifications)
    assert evidence_nats == 27.0
    assert [one.components for one in left.identified] == [(mean,), (mean,)]
    assert left.identified[1] is identifications.identified[2]


def model(size: float, seconds: float) -> dict[str, Any]:
    """A line at the turning of the tool on x, and a second axis with noise alone."""
    return {
        "noise": {"N": N, "B": 0.002, "K": 0.01},
        "effect": [{"name": "rotation_line", "amplitude": size, "axes": ["x"]}],
        "environment": [
            {"profile": "rotation", "points": [[0, 70.0], [seconds / 2.0, 75.0], [seconds, 72.0]]}
        ],
        "log": {"axes": ["x", "y"]},
    }


def test_a_wave_locked_to_the_rotation_is_worth_what_the_normal_law_says() -> None:
    size, seconds = 0.07, 1200.0
    found = diagnose(
        simulate(model(size, seconds), duration=seconds, rate=10.0, seed=4).compute(), nulls=100
    )
    assert [one["name"] for one in found.effects] == ["rotation_line"]
    assert found.content["held_out"]["log_likelihood_gain"] == pytest.approx(
        size**2 * seconds / (4.0 * 3600.0 * N**2), rel=0.5
    )


def test_the_allan_variance_is_held_against_the_model_with_the_wave() -> None:
    """The powers of the model whose gain is told are without the wave, and would fit no better than before."""
    table = model(0.3, 600.0)
    log = simulate(table, duration=600.0, rate=10.0, seed=4).compute()
    found = diagnose(log, simulation={"noise": table["noise"]}, nulls=100)
    assert [one["name"] for one in found.effects] == ["rotation_line"]
    held = found.content["held_out"]
    assert held["misfit_before"] > 1.5
    assert held["misfit_after"] == pytest.approx(1.0, abs=0.2)

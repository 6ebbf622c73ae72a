"""Waves of known course, in what the effects are worth together: by their own view, not by the power of their bands."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.effects.candidates import Candidate, Variant
from gyrostab.diagnose.effects.explained import Part
from gyrostab.diagnose.naming.claims import Claim, Naming
from gyrostab.diagnose.naming.waves import without_waves
from gyrostab.simulate import simulate


def part(view: str, gain: float) -> Part:
    variant = Variant({}, np.ones((1, 1, 1)), ("any",))
    return Part(Candidate("rotation_line", view, (), (variant,)), variant, ("x",), gain)


def claim(*parts: Part) -> Claim:
    return Claim("rotation_line", (), ("x",), parts, sum(one.gain for one in parts), 6.0)


def test_only_waves_are_taken_out_with_what_they_gain() -> None:
    mean, wave, comb = part("mean", 5.0), part("order", 20.0), part("phase_locked", 7.0)
    naming = Naming((claim(mean, wave), claim(comb), claim(mean)), (), 6.0, np.zeros(1), {}, (), None, xr.DataArray())  # type: ignore[arg-type]
    left, gain = without_waves(naming)
    assert gain == 27.0
    assert [one.parts for one in left.claims] == [(mean,), (mean,)]
    assert left.claims[1] is naming.claims[2]


def test_a_wave_locked_to_the_rotation_is_worth_what_the_normal_law_says() -> None:
    N, size, seconds = 0.003, 0.07, 1200.0
    model = {
        "noise": {"N": N, "B": 0.002, "K": 0.01},
        "effect": [{"name": "rotation_line", "amplitude": size, "axes": ["x"]}],
        "environment": [{"profile": "rotation", "points": [[0, 70.0], [600, 75.0], [1200, 72.0]]}],
        "log": {"axes": ["x", "y"]},
    }
    found = diagnose(simulate(model, duration=seconds, rate=10.0, seed=4).compute(), nulls=100)
    assert [one["name"] for one in found.effects] == ["rotation_line"]
    expected = size**2 * seconds / (4.0 * 3600.0 * N**2)
    assert found.content["held_out"]["log_likelihood_gain"] == pytest.approx(expected, rel=0.5)

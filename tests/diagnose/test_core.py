"""A diagnosis from log to result: numbers, model and surfaces contain the fitted effects."""

from __future__ import annotations

import dask
import numpy as np
import pytest

from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.result.diagnosis import Diagnosis
from gyrostab.simulate import simulate

N = 0.003  # deg/sqrt(h)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def diagnosis() -> Diagnosis:
    """Half an hour with constant vibration that raises the noise of x, and with spikes on y."""
    model = {
        "noise": {"N": N, "B": 0.004, "K": 0.02},
        "effect": [
            {"name": "vibration_noise", "white": 0.002, "axes": ["x"]},
            {"name": "spikes", "kind": "outlier", "per_hour": 60.0, "size": 60.0, "axes": ["y"]},
        ],
        "environment": [
            {
                "profile": "vibration",
                "points": [[0, 3.0], [600, 3.0], [601, 5.0], [1200, 5.0], [1201, 8.0], [1800, 8.0]],
            }
        ],
        "log": {"axes": ["x", "y"]},
    }
    return diagnose(simulate(model, duration="30min", rate=10.0, seed=5).compute(), nulls=100)


def test_both_effects_are_identified(diagnosis: Diagnosis) -> None:
    assert {effect["name"]: effect["axes"] for effect in diagnosis.effects} == {
        "vibration_noise": ["x"],
        "spikes": ["y"],
    }


def test_model_has_the_recalibrated_noise(diagnosis: Diagnosis) -> None:
    assert (
        diagnosis.content["baseline"]["noise"]["x"]["N"]["value"] > 1.5 * N
    )  # that of the first calibration, which knows of none
    assert diagnosis.model["noise"]["x"]["N"] == pytest.approx(
        N, rel=0.3
    )  # three other records give 0.95 to 1.07 of it
    assert diagnosis.model["noise"]["y"]["N"] == pytest.approx(N, rel=0.1)


def test_surface_with_effects_matches_the_recording(diagnosis: Diagnosis) -> None:
    """White noise that vibration raises, on x; on y noise and spikes."""
    short = diagnosis.surfaces["avar"].isel(tau=0)
    recorded, after = (short.sel(case=case) for case in ("recording", "after"))
    np.testing.assert_allclose((recorded / after).sel(axis="x").mean(), 1.0, atol=0.05)
    np.testing.assert_allclose(
        recorded.sel(axis="y").mean() / after.sel(axis="y").mean(), 1.0, atol=0.3
    )


def test_held_out_misfit_excludes_blocks_with_spikes(diagnosis: Diagnosis) -> None:
    assert diagnosis.content["held_out"]["misfit_after"] == pytest.approx(1.0, abs=0.15)


@pytest.mark.full
def test_result_does_not_depend_on_the_number_of_threads() -> None:
    """Also where the null records of a statistic are drawn for each of its candidates."""
    model = {
        "noise": {"N": N},
        "environment": [{"profile": "rotation", "points": [[0, 0], [300, 60], [600, 60]]}],
    }
    log = simulate(model, duration="10min", rate=10.0, seed=6).compute()
    contents = []
    for threads in (1, 4):
        with dask.config.set(num_workers=threads):
            content = diagnose(log, nulls=100).content
        contents.append({**content, "seconds": 0.0})
    assert contents[0] == contents[1]

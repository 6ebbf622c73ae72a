"""Small real recordings: what the diagnosis identifies, and what it must not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gyrostab
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.evidence.sample_counts import has_coarse_grid
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from tests.support.scripts import load_script

SCRIPT = load_script("pipelines/diagnose_recordings.py")
RESETS_PER_S = 1502 / 360  # counted in the recording by its publisher's notes


@pytest.fixture
def open_recording(
    recordings: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    """A recording of the plan, cut to so many seconds; skipped where it is absent."""

    def read(name: str, **cut: float) -> Any:
        for file in SCRIPT.PLAN["recording"][name]["files"]:
            monkeypatch.chdir(recordings(file).parents[len(Path(file).parts) - 1])
        return SCRIPT.log_of(name, **cut)

    return read


def named_effects(diagnosis: Any) -> list[str]:
    return [effect["name"] for effect in diagnosis.effects]


@pytest.mark.slow
def test_ramp_resets_are_named_before_their_lines(open_recording: Callable[..., Any]) -> None:
    diagnosis = gyrostab.diagnose(open_recording("fog-blueseis-ramp", end=180.0), nulls=100)
    first = diagnosis.effects[0]
    assert (first["name"], first["axes"], first["driver"]) == ("feedback_reset", ["z"], "ramp")
    kicked = first["parameters"]["kick"]["value"] + first["parameters"]["tail"]["value"]
    assert 25.0 < kicked < 34.0  # 29.5 nrad in the catalogue
    model = next(table for table in diagnosis.model["effect"] if table["name"] == "feedback_reset")
    assert model["phase"] == "channel"
    assert model["full"] < 0  # the ramp falls while the rate is positive
    lines = [
        region
        for region in diagnosis.content["mismatches"]
        if "line at 4 Hz" in region["statement"]
    ]
    assert lines
    assert all("feedback_reset" in region["explained_by"] for region in lines)
    assert "spectral_line" not in lines[0]["explained_by"]
    held = diagnosis.content["held_out"]
    assert held["coverage95_before"] < 0.6
    assert held["coverage95_after"] > 0.85  # with the resets in the powers
    assert held["misfit_after"] < 0.2 * held["misfit_before"]


def test_turns_of_the_ramp_are_counted(open_recording: Callable[..., Any]) -> None:
    turns = reduce_log(open_recording("fog-blueseis-ramp", end=60.0))["ramp_turns"].values
    assert -np.mean(turns) == pytest.approx(RESETS_PER_S, rel=0.01)


@pytest.mark.full
def test_no_resets_without_the_ramp_channel(open_recording: Callable[..., Any]) -> None:
    diagnosis = gyrostab.diagnose(open_recording("fog-blueseis-without-ramp", end=180.0), nulls=100)
    assert diagnosis.verdict != "no mismatch"
    assert "feedback_reset" not in named_effects(diagnosis)
    assert "no channel ramp" in diagnosis.content["not_found"]["feedback_reset"]["reason"]


def test_coarse_quantization_grid_is_not_a_dead_zone(open_recording: Callable[..., Any]) -> None:
    blocks = reduce_log(open_recording("rlg-static-30min", end=600.0))
    assert has_coarse_grid(blocks).all()
    level = calibrate_noise(blocks)["coefficient"]
    candidates, reasons = effect_candidates(blocks, level)
    for name in ("dead_zone", "held_samples", "clipping"):
        assert "quantization grid" in reasons[name]
        assert name not in {candidate.effect for candidate in candidates}
    assert "rate_quantization" in {
        candidate.effect for candidate in candidates if candidate.statistic.name == "sample_counts"
    }


@pytest.mark.full
def test_platform_sway_is_real_motion(open_recording: Callable[..., Any]) -> None:
    diagnosis = gyrostab.diagnose(open_recording("rlg-static-30min", end=180.0), nulls=100)
    assert "real_motion" in named_effects(diagnosis)
    assert not {"dead_zone", "held_samples", "clipping"} & set(named_effects(diagnosis))


@pytest.mark.full
def test_fiber_optic_axis_does_not_follow_temperature(open_recording: Callable[..., Any]) -> None:
    diagnosis = gyrostab.diagnose(open_recording("fog-hybrid-warmup"), nulls=100)
    thermal = [effect for effect in diagnosis.effects if "temperature" in (effect["driver"] or "")]
    assert not any("z" in effect["axes"] for effect in thermal)

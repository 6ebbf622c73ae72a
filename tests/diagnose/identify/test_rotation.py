"""Scale-factor errors and real rotation are distinguished by the share of the rotation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.evidence.spectral_lines import line_evidence
from gyrostab.diagnose.identify.examination import nuisance_alternatives
from gyrostab.diagnose.identify.identifiability import find_plainer_effect, keep_physical
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.diagnose.task import Task, take_lines_at_rest
from gyrostab.ingest.make_log import make_log
from gyrostab.progress import no_stage
from gyrostab.simulate import simulate
from tests.support.candidates import find_components
from tests.support.named import name_effects, nulls
from tests.support.repetitions import first_of

_TURNS = [
    [0, 0.0],
    [300, 0.0],
    [310, 108.0],
    [600, 108.0],
    [610, 40.0],
    [800, 40.0],
    [810, 0.0],
    [1000, 0.0],
    [1010, 90.0],
    [1200, 90.0],
]


def _reduce_share(share: float) -> xr.Dataset:
    """Reduce a log in which axis z senses a share of the rotation."""
    effect = {"name": "real_motion", "spin": share, "sway": 0.0, "axes": ["z"]}
    model = {
        "log": {"axes": ["x", "z"]},
        "noise": {"N": 0.003},
        "effect": [effect],
        "environment": [{"profile": "rotation", "points": _TURNS}],
    }
    return reduce_log(simulate(model, duration="20min", rate=10.0, seed=3).compute())


def _find_components(blocks: xr.Dataset):
    baseline = calibrate_noise(blocks)
    known = [
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if candidate.effect in ("scale_factor", "real_motion")
        and candidate.statistic.name == "mean"
    ]
    state = initial_state(blocks, baseline)
    components = find_components(
        [candidate for candidate in known if candidate.statistic.name == "mean"], state
    )
    return {group[0].candidate.effect: group for group in components.values()}, state


@pytest.mark.parametrize(
    ("share", "plainer", "allowed"),
    [(3e-6, "scale_factor", False), (1e-3, "scale_factor", True), (0.5, None, True)],
)
def test_share_of_the_rotation_selects_the_effect(share, plainer, allowed):
    components, state = _find_components(_reduce_share(share))
    motion, error = components["real_motion"], components["scale_factor"]
    assert motion[0].row == ("z",)
    assert motion[0].evidence_nats > 30.0
    assert find_plainer_effect(motion, state) == plainer
    assert bool(keep_physical(motion, state)[0]) is allowed
    assert find_plainer_effect(error, state) is None


def _log_whole_rotation(seed: int, *, error: float, size: int = 15_000) -> xr.Dataset:
    """Make a log with an encoder, in which axis z senses all of the rotation, and an error of it.

    The table turns to and fro, so that its rotation has harmonics at all frequencies.
    """
    rng = np.random.default_rng(seed)
    levels = np.array([0.0, 10.0, -10.0, 30.0, -30.0, 0.0])
    stops = levels[np.arange(size) // 1000 % levels.size]
    turned = np.convolve(np.concatenate([np.zeros(30), stops]), np.full(31, 1.0 / 31.0), "valid")
    rates = 3600.0 * np.stack([np.zeros(size), (1.0 + error) * turned])
    rates += 5.0 * rng.standard_normal(rates.shape)
    log = make_log(rates, rate=10.0, unit="deg/h", start="2026-01-01", axis=["x", "z"])
    encoder = turned + 5e-4 * rng.standard_normal(size)
    return log.assign(rotation_rate=("time", encoder, {"units": "degree s-1"}))


@pytest.mark.slow
@pytest.mark.parametrize("seed", first_of(1, 2, 3))
@pytest.mark.parametrize("error", [0.0, 2e-4])
def test_whole_rotation_is_no_scale_factor_error(seed: int, error: float):
    components, state = _find_components(reduce_log(_log_whole_rotation(seed, error=error)))
    assert keep_physical(components["real_motion"], state)[0]
    assert not keep_physical(components["scale_factor"], state)[0]


@pytest.mark.parametrize("seed", first_of(1, 2, 3))
def test_lines_of_an_axis_that_turns_are_those_at_rest(seed: int):
    log = _log_whole_rotation(seed, error=0.0)
    hum = 3.0 * np.sin(2.0 * np.pi * 2.3 * np.arange(log.sizes["time"]) / 10.0)
    log["rate"][1] += hum
    blocks = reduce_log(log)
    turned = np.abs(np.diff(blocks["mean"].values[1], append=0.0)) > 50.0
    moving = np.stack([np.zeros_like(turned), turned | np.roll(turned, 1)])
    task = Task(log, None, None, 5.0, 0, 100, 0.01, no_stage, DEFAULTS)
    at_rest = take_lines_at_rest(task, blocks, moving)
    nats = line_evidence(at_rest["line_power"].values[None], at_rest["line_weight"].values)[0, 1]
    frequency = at_rest["line_frequency"].values
    assert nats[np.abs(frequency - 2.3).argmin()] > 30.0
    assert nats[np.abs(frequency - 2.3) > 0.2].max() < 5.0
    assert not np.isfinite(at_rest["sine_nats"].values[1]).any()
    np.testing.assert_array_equal(at_rest["sine_nats"][0], blocks["sine_nats"][0])


def test_tails_of_blocks_in_which_an_axis_turns_do_not_count():
    blocks = reduce_log(_log_whole_rotation(1, error=0.0))
    turned = np.zeros(blocks["kurtosis"].shape, np.bool_)
    turned[1, ::3] = True
    blocks["kurtosis"] = blocks["kurtosis"].where(~turned, 4.0).where(turned, 0.0)
    state = initial_state(blocks, calibrate_noise(blocks))
    tails = [item for item in nuisance_alternatives(blocks) if item.effect == "~outliers"]
    moments = np.zeros(2), np.full(2, 0.4)
    evidence = [
        compute_evidence(
            tails,
            blocks,
            replace(state, masked=masked),
            count_evidence=CountEvidence({"kurtosis": moments}),
        )[0].evidence_nats[0, 1]
        for masked in (np.zeros_like(turned), turned)
    ]
    assert evidence[0] > 30.0
    assert evidence[1] < 3.0


@pytest.mark.full
def test_axis_that_turns_without_a_channel_leaks_into_another():
    """What nothing explains on the axis that turns does not hide the misalignment of another."""
    log = simulate(
        {"log": {"axes": ["x", "y", "z"]}, "noise": {"N": 0.005}},
        duration="20min",
        rate=10.0,
        seed=5,
    )
    seconds = np.arange(log.sizes["time"]) / 10.0
    turns = 2000.0 * np.sin(seconds / 70.0) ** 3 * (seconds > 240.0)
    share = xr.DataArray([2e-4, 0.0, 1.0], {"axis": log["axis"]})
    blocks = reduce_log(log.assign(rate=log["rate"] + share * xr.DataArray(turns, dims="time")))
    baseline, records = nulls(blocks, 40)
    identifications = name_effects(blocks, baseline, records)
    at_rest = [other for other in identifications.identified if set(other.axes) & {"x", "y"}]
    assert [(other.effect, other.axes) for other in at_rest] == [("misalignment", ("x",))]
    assert "z" in {axis for selection in identifications.unidentified for axis in selection.axes}


@pytest.mark.full
@pytest.mark.parametrize("error", [0.0, 2e-4])
def test_whole_rotation_is_the_only_effect(error: float):
    diagnosis = diagnose(_log_whole_rotation(2, error=error), nulls=100)
    (effect,) = diagnosis.effects
    assert effect["name"] == "real_motion"
    assert effect["parameters"]["spin"]["value"] == pytest.approx(1.0 + error, abs=2e-5)


@pytest.mark.full
def test_tiny_share_of_the_rotation_is_a_scale_factor_error():
    blocks = _reduce_share(1e-6)
    baseline, records = nulls(blocks, 40)
    identifications = name_effects(blocks, baseline, records)
    (identification,) = identifications.identified
    assert identification.effect == "scale_factor"
    assert identification.axes == ("z",)
    assert "real_motion" not in identification.alternatives
    assert np.isfinite(identification.evidence_nats)


@pytest.mark.full
@pytest.mark.parametrize(("speed", "stick_slip"), [(90, 0.3), (90, 0.0), (720, 0.6)])
def test_earth_rate_is_the_only_effect_on_a_tool_that_starts_to_rotate(
    speed: float, stick_slip: float
):
    """It is constant at rest and a line while the tool rotates: no accelerometer explains both.

    Stick-slip adds side bands to the line, and moves the means.
    """
    rotation = {
        "profile": "rotation",
        "points": [[0, 0], [600, 0], [610, speed], [1800, speed], [1810, 0]],
        "sensor_rate": 50,
        "stick_slip": stick_slip,
        "period": "4 s",
        "inclination": 30,
    }
    earth = {"name": "earth_rate", "latitude": 60, "inclination": 30, "azimuth": 60}
    model = {
        "noise": {"N": 0.006, "B": 0.03, "K": 0.05},
        "environment": [rotation],
        "effect": [earth],
    }
    log = simulate(model, duration="40min", rate=10.0, seed=3).compute()
    found = diagnose(log, nulls=100, seed=1)
    (effect,) = found.effects
    assert (effect["name"], effect["axes"]) == ("earth_rate", ["x", "y"])
    assert found.verdict == "explained"
    # towards the high side 9.77 deg/h, and to the right of it -6.51 deg/h
    assert effect["parameters"]["toolface"]["value"] == pytest.approx(33.7, abs=1.0)

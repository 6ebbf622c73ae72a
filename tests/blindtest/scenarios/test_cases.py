"""Cases: reproducible, of the stated size and visibility, with recordings free of the truth."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.blindtest.generator import electronics
from gyrostab.blindtest.generator.catalogue import CATALOGUE, OUT_OF_CATALOGUE
from gyrostab.blindtest.generator.detection_limits import (
    NATS,
    NATS_PER_SAMPLE,
    filtered_density,
    fitted_nats,
    shared_size,
)
from gyrostab.blindtest.generator.noise import BANDS
from gyrostab.blindtest.generator.record import make_record
from gyrostab.blindtest.generator.scenario import AXES, draw_scenario, stream
from gyrostab.blindtest.generator.wander import wander_size
from gyrostab.blindtest.scenarios.case import (
    commit_case,
    degrade_driver,
    make_case,
    open_truth,
    truth_text,
)
from gyrostab.blindtest.scenarios.plan import DEGRADATIONS, plan_case, plan_cases, plan_counterparts
from gyrostab.blindtest.scoring.baseline_detectors import (
    MAX_SEPARATION,
    allan_detector,
    channel_detector,
)
from gyrostab.errors import FormatError, OptionError
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.schema import check_log
from tests.support.blind_cases import small, white_scenario

EVERY = CATALOGUE | OUT_OF_CATALOGUE


@cache
def case_of(name: str) -> tuple[xr.Dataset, dict]:
    """Return a small case of an effect, made once."""
    return make_case(small(name))


@pytest.mark.parametrize("name", EVERY)
def test_every_effect_gives_a_case_of_its_strength(name):
    log, truth = case_of(name)
    check_log(log)
    (effect,) = truth["effects"]
    assert effect["name"] == name
    whole = name in ("clipping", "held_samples")  # a number of samples
    assert effect["size"] == pytest.approx(3.0, rel=0.05 if whole else 0.01)
    assert effect["expected_nats"] > 0.5 * NATS * 9
    assert set(effect["axes"]) <= set(AXES)
    assert 0 < effect["tau_min_s"] < effect["tau_max_s"]
    assert all(begin < end for begin, end in effect["intervals"])
    json.loads(truth_text(truth))
    assert gap_table(log)["samples"].sum() == np.isnan(log.rate.values).all(axis=0).sum()
    if EVERY[name].channel:
        assert EVERY[name].channel in log


def test_case_is_reproducible_and_differs_from_others():
    plan = small("shupe")
    (log, truth), (repeated, same) = make_case(plan), make_case(plan)
    xr.testing.assert_identical(log, repeated)
    assert truth_text(truth) == truth_text(same)
    assert not np.array_equal(
        log.rate.values, make_case(plan | {"index": 5})[0].rate.values, equal_nan=True
    )


def test_effect_is_the_difference_to_the_record_without_it():
    scenario = white_scenario(seconds=900)
    effect = CATALOGUE["temperature_bias"].make(scenario, np.random.default_rng(0), strength=2.0)
    difference = make_record(scenario, [effect], seed=3) - make_record(scenario, [], seed=3)
    np.testing.assert_allclose(difference, effect.mean, atol=1e-9)


@pytest.mark.parametrize("name", ["vibration_noise", "aliased_vibration"])
def test_vibration_adds_the_variance_of_its_size(name):
    scenario = white_scenario(rate=100.0, seconds=600)
    effect = CATALOGUE[name].make(scenario, np.random.default_rng(2), strength=30.0)
    row = int(np.argmax(np.abs(effect.extra).max(axis=1)))
    sd = 60 * scenario.noise[row]["N"] * 10
    busy = effect.extra[row] != 0
    v = np.log1p(np.mean(effect.extra[row][busy] ** 2) / sd**2)
    n = busy.sum() * (1 - busy.mean())
    size = math.sqrt(n * v**2 / 4 / NATS)
    assert (
        0.3 < size / effect.size < 1.1
    )  # a flat density has the smallest size for its power, and other axes may add to it


def test_quantized_rate_has_multiples_of_the_step_and_no_q():
    log, truth = make_case(small("rate_quantization", strength=20.0))
    step = truth["effects"][0]["parameters"]["step"]["value"]
    counts = log.rate.values / step
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    assert all(noise["Q"] == 0 for noise in truth["noise"].values())


def test_angle_quantization_is_noise_and_not_an_effect():
    """A log of angle increments is quantized as well; its truth holds Q and no effect."""
    scenario = draw_scenario(np.random.default_rng(0), rate=10.0, seconds=600.0)
    scenario = replace(scenario, noise=tuple(noise | {"Q": 0.3} for noise in scenario.noise))
    counts = make_record(scenario, [], seed=1) / (
        0.3 * math.degrees(1e-6) * 3600 * math.sqrt(12) * scenario.rate
    )
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_amplitude_of_a_line_is_that_before_the_samples_average_it(seed):
    scenario = draw_scenario(np.random.default_rng(0), rate=10.0, seconds=600.0)
    rng = np.random.default_rng(seed)
    effect = CATALOGUE["spectral_line"].make(scenario, rng, strength=8.0)
    amplitude = effect.parameters["amplitude"]["values"]
    frequency = effect.parameters["frequency"]["value"]
    phases = 2.0 * math.pi * frequency / scenario.rate * np.linspace(-0.5, 0.5, 10_001)
    passed = np.cos(phases).mean()  # of a sine, averaged over a sample
    for axis, size in amplitude.items():
        largest = np.abs(effect.mean[AXES.index(axis)]).max()
        assert largest == pytest.approx(size * passed, rel=0.01)


def test_dead_zone_leaves_zeros():
    log, truth = make_case(small("dead_zone", strength=6.0))
    row = log.rate.sel(axis=truth["effects"][0]["axes"][0]).values
    assert 10 <= (row == 0).sum() <= 90  # expected are 30


@pytest.mark.parametrize("strength", [0.5, 1.5, 8.0])
@pytest.mark.parametrize("name", ["clipping", "held_samples"])
def test_effects_on_samples_change_as_many_as_their_evidence_needs(name, strength):
    scenario = replace(
        draw_scenario(np.random.default_rng(2), rate=100.0, seconds=600.0, gaps=0.4),
        noise=white_scenario().noise,
    )
    for seed in range(6):
        samples = max(1, round(NATS * strength**2 / NATS_PER_SAMPLE))
        effect = CATALOGUE[name].make(scenario, np.random.default_rng(seed), strength=strength)
        row = make_record(scenario, [effect], seed=seed)[AXES.index(effect.axes[0])]
        row = row[~scenario.missing]
        assert np.isfinite(row).all()
        number = row.size - np.unique(row).size  # equal to another one, which noise never is
        assert effect.nats == pytest.approx(number * NATS_PER_SAMPLE)
        assert effect.size == pytest.approx(math.sqrt(effect.nats / NATS))
        assert number == pytest.approx(samples, rel=0.1)


def test_clipping_keeps_missing_samples_for_later_effects():
    scenario = draw_scenario(np.random.default_rng(2), rate=10.0, seconds=600.0, gaps=0.4)
    effect = CATALOGUE["clipping"].make(scenario, np.random.default_rng(1), strength=8.0)
    assert np.isfinite(effect.after(np.random.default_rng(0).normal(size=(3, scenario.size)))).all()


@pytest.mark.parametrize("corner", [0.3, 0.8, math.inf])
def test_evidence_of_a_shared_source_is_its_gaussian_divergence(corner):
    power = electronics._low_pass((np.arange(50 * BANDS) + 0.5) / (50 * BANDS), corner)
    power /= power.mean()
    shares = np.array([0.5, -0.4, 0.6])
    matrices = np.eye(3) + (power[:, None, None] * np.outer(shares, shares)) - np.diag(shares**2)
    divergence = np.trace(matrices, axis1=1, axis2=2) - 3 - np.linalg.slogdet(matrices)[1]
    scenario = white_scenario()
    nats = scenario.size / 2 * divergence.mean()
    assert shared_size(scenario, shares, power) == pytest.approx(math.sqrt(nats / NATS))


def test_a_filter_changes_white_noise_and_not_the_quantization_of_the_angle():
    scenario = white_scenario()
    angle = replace(scenario, noise=tuple(noise | {"Q": 0.5} for noise in scenario.noise))
    gain = np.linspace(1.0, 0.5, 100)
    assert filtered_density(scenario, gain)[0] == pytest.approx(0.18**2 * gain)
    added = filtered_density(angle, np.ones(100)) - filtered_density(scenario, np.ones(100))
    assert filtered_density(angle, gain) == pytest.approx(filtered_density(scenario, gain) + added)
    weights = [
        CATALOGUE["logger_filter"]
        .make(of, stream(1, "filter"), strength=4.0)
        .parameters["weight"]["value"]
        for of in (scenario, angle)
    ]
    assert weights[1] > 1.2 * weights[0]  # a part of the noise is not filtered


def test_telemetry_losses_are_shorter_than_power_cuts_where_restarts_matter():
    log, truth = make_case(small("warm_up", gaps=0.4, cuts=2))
    gaps = gap_table(log)
    long = gaps["samples"] / truth["sampling_rate_hz"] >= 5.0
    assert long.sum() == len(truth["power_cuts"]) == 2


def test_size_of_a_random_bias_matches_its_spectrum():
    scenario = replace(
        white_scenario(seconds=4000),
        noise=tuple({"N": 0.003, "B": 0.0, "K": 0.0, "Q": 0.0} for _ in AXES),
    )
    size, nats = wander_size(scenario, np.array([1.0, 0.0, 0.0]), time=50.0, rms=0.003)
    larger, more = wander_size(scenario, np.array([1.0, 0.0, 0.0]), time=50.0, rms=0.006)
    assert larger / size == pytest.approx(
        4.0, rel=0.1
    )  # for small changes the log variance grows with the square
    f = np.arange(1, scenario.size) / (2 * scenario.seconds)
    ratio = 2 * 0.003**2 * 50 / (1 + (2 * math.pi * f * 50) ** 2) / (60 * 0.003) ** 2
    assert size == pytest.approx(math.sqrt((ratio**2).sum() / 4 / NATS), rel=0.05)
    assert nats < more


@pytest.mark.full
def test_sub_threshold_cases_are_invisible_in_trace_and_allan_plot():
    plan = small("spectral_line", kind="sub_threshold", seconds=3600, heavy=False, strength=1.5)
    log, truth = make_case(plan)
    assert truth["visibility"]["sub_threshold"]
    assert truth["effects"][0]["size"] <= 1.5
    noise = truth["noise"][truth["effects"][0]["axes"][0]]["N"]
    wave = truth["effects"][0]["parameters"]["peak"]["value"] / math.sqrt(2)
    assert wave / (60 * noise) < MAX_SEPARATION * 1.01 / math.sqrt(
        0.5
    )  # a mean over 1 s is smaller than the line itself
    assert truth["visibility"]["sample"] < MAX_SEPARATION
    assert truth["visibility"]["second"] < MAX_SEPARATION
    assert all(share < 1 for share in truth["visibility"]["allan"].values())
    assert allan_detector(log.rate.values, truth, rng=np.random.default_rng(0), nulls=30) < 0.0


def test_strong_effect_is_not_sub_threshold():
    from gyrostab.blindtest.scoring.baseline_detectors import find_visibility

    scenario = white_scenario(seconds=900)
    effect = CATALOGUE["spectral_line"].make(scenario, np.random.default_rng(0), strength=30.0)
    assert not find_visibility(
        scenario, [effect], make_record(scenario, [effect], seed=1), rng=np.random.default_rng(0)
    )["sub_threshold"]


def make_folders(path: Path) -> None:
    for name in ("recordings", "truth"):
        (path / name).mkdir()


def test_recordings_hold_nothing_of_the_truth(tmp_path):
    forbidden_words = [
        *EVERY,
        "strength",
        "concealed",
        "sub_threshold",
        "degraded_driver",
        "withheld",
        "substituted",
        "truth",
        "effect",
        "seed",
        "commitment",
    ]
    cases = [case_of(name) for name in EVERY] + [make_case(small(None, index=90))]
    cases += [
        make_case(small("shupe", index=91 + i, kind="degraded_driver", degradation=how))
        for i, how in enumerate(("withheld", "substituted", "lagged", "confounded"))
    ]
    attributes, dimensions = set(), set()
    make_folders(tmp_path)
    for number, (log, truth) in enumerate(cases):
        digest = commit_case(log, truth, tmp_path, name=f"{number:04d}")
        opened = open_truth(tmp_path / "truth" / f"{number:04d}.json", sha256=digest)
        assert opened["plan"]["names"] == truth["plan"]["names"]
        attributes.add(tuple(sorted(log.attrs)))
        dimensions |= set(map(str, log.variables))
    assert attributes == {("kind", "sampling_rate_hz")}
    for path in (tmp_path / "recordings").iterdir():
        content = path.read_bytes().lower() + path.name.encode()
        assert [word for word in forbidden_words if word.encode() in content] == [], path
    known = {
        "axis",
        "time",
        "rate",
        "temperature",
        "vibration",
        "rotation_rate",
        "supply_voltage",
        "light_power",
        "ramp",
        "accel_x",
    }
    assert {name.removeprefix("time_") for name in dimensions} - known <= {"accel_y", "accel_z"} | {
        n for n in dimensions if n.startswith("gap_")
    }


def test_null_records_have_the_same_channels_as_others():
    """The presence of a channel must not reveal an effect."""
    names = [set(make_case(small(None, index=i, seconds=600))[0].data_vars) for i in range(30)]
    for channel in ("rotation_rate", "supply_voltage", "light_power", "ramp", "accel_x"):
        assert 0 < sum(channel in held for held in names) < 30


def test_committed_recording_is_read_as_a_log(tmp_path):
    log, truth = make_case(small("vibration_rectification"))
    make_folders(tmp_path)
    digest = commit_case(log, truth, tmp_path, name="a")
    log_read = gyrostab.regularise(gyrostab.read_log(tmp_path / "recordings" / "a.nc"))
    np.testing.assert_array_equal(log_read.rate.values, log.rate.values)
    np.testing.assert_array_equal(log_read.time.values, log.time.values)
    np.testing.assert_array_equal(log_read.vibration.values, log.vibration.values)
    assert log_read.vibration.attrs["units"] == log.vibration.attrs["units"] == "g"
    path = tmp_path / "truth" / "a.json"
    path.write_text(path.read_text().replace("vibration_rectification", "shupe"))
    with pytest.raises(FormatError, match="changed after it was committed"):
        open_truth(path, sha256=digest)


@pytest.mark.parametrize("how", DEGRADATIONS)
def test_degraded_driver(how):
    rng = np.random.default_rng(0)
    values = np.cumsum(rng.normal(size=1000))
    channels = degrade_driver(
        {"temperature": (values, 1.0), "vibration": (np.ones(1000), 1.0)},
        "temperature",
        how=how,
        rng=rng,
    )
    assert ("temperature" in channels) == (how not in ("withheld", "substituted"))
    if how == "lagged":
        lags = [
            np.corrcoef(values[: 1000 - k], channels["temperature"][0][k:])[0, 1]
            for k in range(0, 181)
        ]
        assert np.argmax(lags) >= 30
    if how == "confounded":
        assert abs(np.corrcoef(values, channels["supply_voltage"][0])[0, 1]) > 0.8
    if how == "substituted":
        assert "supply_voltage" in channels
    if how == "noisy":
        assert 0.5 < np.corrcoef(values, channels["temperature"][0])[0, 1] < 0.9
    if how == "clipped":
        assert (channels["temperature"][0] == channels["temperature"][0].max()).sum() > 100


def test_composition_of_a_benchmark():
    plans = plan_cases(400, seed=5)
    kinds = [plan["kind"] for plan in plans]
    assert kinds.count("null") == kinds.count("sub_threshold") == 40
    assert kinds.count("out_of_catalogue") == kinds.count("degraded_driver") == 60
    assert (kinds.count("pair"), kinds.count("triple")) == (80, 20)
    strong = [plan["kind"] for plan in plans if plan["in_fitted_noise"]]
    assert not {"null", "sub_threshold"} & set(strong)
    assert 0.4 < strong.count("pair") / 80 < 0.6
    assert {len(plan["names"]) for plan in plans if plan["kind"] == "triple"} == {3}
    assert all(len(set(plan["names"])) == len(plan["names"]) for plan in plans)
    single = [plan["names"][0] for plan in plans if plan["kind"] == "single"]
    assert len(set(single)) >= 14
    assert {plan["rate"] for plan in plans} == {10.0, 100.0, 400.0}
    assert max(plan["seconds"] for plan in plans) == 86400
    assert min(plan["seconds"] for plan in plans) >= 600
    gaps = [plan["gaps"] for plan in plans]
    assert max(gaps) > 0.35
    assert 0.4 < np.mean(np.array(gaps) == 0) < 0.6
    assert plan_case(17, seed=5) == plans[17]


@pytest.mark.full
@pytest.mark.parametrize(
    "name", ["temperature_bias", "shupe", "thermal_hysteresis", "gauss_markov", "spectral_line"]
)
def test_strength_in_fitted_noise_is_reached(name):
    scenario = white_scenario(seconds=1200)

    def make(**options):
        return CATALOGUE[name].make(scenario, stream(3, name), strength=3.0, **options)

    known, strong = make(), make(in_fitted_noise=True)
    reached = math.sqrt(fitted_nats(scenario, strong) / NATS)
    assert known.strength == 3.0 <= strong.strength
    assert reached >= 3.0 or strong.strength == 24.0
    assert strong.form == known.form  # only the size differs
    if name == "spectral_line":
        assert strong.strength < 3.1


@pytest.mark.full
def test_a_third_of_the_forms_differ_from_those_fitted():
    scenario = replace(white_scenario(seconds=600), cuts=np.array([[200.0, 220.0]]))
    scenario = replace(scenario, light=np.linspace(1.0, 0.9, scenario.temperature.size))
    flags = [
        entry.make(scenario, stream(s, name), strength=2.0).form_differs
        for name, entry in CATALOGUE.items()
        for s in range(2)
    ]
    assert np.mean(flags) > 1 / 3


@pytest.mark.parametrize(
    "name", ["temperature_bias", "informative_gaps", "feedback_reset", "shared_source"]
)
def test_counterpart_is_the_record_without_its_effects(name):
    plan = small(name, strength=8.0)
    log, truth = make_case(plan)
    noise, noise_truth = make_case(plan | {"copy": "counterpart"})
    assert noise_truth["effects"] == []
    assert noise_truth["plan"]["kind"] == "counterpart"
    assert set(noise.variables) == set(log.variables)
    for channel in set(log.variables) - {"rate"}:
        xr.testing.assert_identical(noise[channel], log[channel])
    difference = log["rate"].values - noise["rate"].values
    assert np.array_equal(np.isnan(noise["rate"].values), np.isnan(log["rate"].values))
    assert noise_truth["missing_share"] == truth["missing_share"]
    assert np.nanmax(np.abs(difference)) > 0.0
    if name == "shared_source":  # the rest of the noise is that of the case
        for row, other in zip(log["rate"].values, noise["rate"].values, strict=True):
            step = np.diff([row, other])
            step = step[:, np.isfinite(step).all(axis=0)]
            assert np.corrcoef(step)[0, 1] > 0.7
    if name == "temperature_bias":
        (effect,) = truth["effects"]
        axis = effect["axes"][0]
        means = np.nanmean(difference[AXES.index(axis)].reshape(-1, 100), axis=1)
        assert means == pytest.approx(np.array(effect["waveform_10s"][axis]), abs=1e-2)


def test_one_in_four_cases_with_effects_has_a_counterpart():
    plans = plan_cases(40, seed=3)
    copies = plan_counterparts(plans, 4)
    assert [plan["index"] for plan in copies] == [plan["index"] for plan in plans if plan["names"]][
        ::4
    ]
    assert {plan["copy"] for plan in copies} == {"counterpart"}


def test_unknown_effect_is_refused():
    with pytest.raises(OptionError, match="'gremlin' is not in the catalogue"):
        make_case(small("shupe") | {"names": ["gremlin"]})


@pytest.mark.full
def test_baseline_detectors_see_strong_effects_only():
    log, truth = make_case(small("vibration_noise", strength=120.0, seconds=1800))
    assert allan_detector(log.rate.values, truth, rng=np.random.default_rng(0), nulls=30) > 0.0
    assert channel_detector(log) > 0.0
    alarms = 0
    for i in range(5):
        log, truth = make_case(small(None, index=30 + i, seconds=600))
        alarms += (
            allan_detector(log.rate.values, truth, rng=np.random.default_rng(i), nulls=30) > 0.0
        )
    assert alarms <= 2

"""Predictions of effects for block statistics, against simulated logs."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.evidence.held_out import linear_model_factors
from gyrostab.diagnose.identify.examination import nuisance_alternatives
from gyrostab.diagnose.predict.linear_model import (
    initial_state,
    power_column,
    simulate_noise,
    spread_by_gaps,
)
from gyrostab.diagnose.predict.windows import hat_functions, make_windows
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics import STATISTICS
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.ingest.make_log import make_log
from gyrostab.noise import sampled_psd
from gyrostab.physics.registry import effects
from gyrostab.simulate import simulate
from tests.support.candidates import select_candidate
from tests.support.evidence import power_factors
from tests.support.named import COEFFICIENT, WORLD, record


@pytest.fixture(scope="module")
def rich():
    """An hour with every channel that drives an effect, and no effect."""
    return record([], environment=[*WORLD["full"]])


@pytest.fixture(scope="module")
def plain():
    return record([])


@pytest.fixture(scope="module")
def tried_effects(rich):
    return effect_candidates(rich, COEFFICIENT)


def test_every_effect_is_tried_or_has_a_reason(tried_effects):
    candidates, reasons = tried_effects
    tried = {candidate.effect for candidate in candidates}
    assert tried.isdisjoint(reasons)
    assert tried | set(reasons) == set(effects())
    assert {candidate.statistic.name for candidate in candidates} <= {
        statistic.name for statistic in STATISTICS
    }
    for reason in reasons.values():
        assert reason.startswith("not identifiable: ")


def test_grids_are_small_enough_to_try_all_points(tried_effects):
    """Only the instants of a step are selected."""
    for candidate in tried_effects[0]:
        if not any("at" in variant.values for variant in candidate.variants):
            assert len(candidate.variants) <= 200, candidate.key


@pytest.mark.parametrize(
    ("effect", "statistics"),
    [
        ("shupe", {"mean"}),
        ("vibration_noise", {"power"}),
        ("aliased_vibration", {"power", "cross_spectrum"}),
        ("shared_source", {"cross_spectrum"}),
        ("g_sensitivity", {"mean"}),
        ("earth_rate", {"mean", "rotation_order"}),
        ("rotation_line", {"mean", "rotation_order"}),
        ("spectral_line", {"spectral_line"}),
        ("spikes", {"sample_counts"}),
        ("logger_filter", {"power"}),
        ("gauss_markov", {"power", "wandering_bias"}),
    ],
)
def test_effects_show_in_the_expected_statistics(tried_effects, effect, statistics):
    assert {
        candidate.statistic.name for candidate in tried_effects[0] if candidate.effect == effect
    } == statistics


def test_reason_names_the_missing_channel(plain):
    _, reasons = effect_candidates(plain.drop_vars(["channel_vibration"]), COEFFICIENT)
    assert "vibration" in reasons["vibration_noise"]
    assert "ramp" in reasons["feedback_reset"]


@pytest.mark.parametrize(
    ("band", "tried"),
    [([120.0, 160.0], (120.0, 160.0)), (None, (700.0, 800.0)), ("wide", (700.0, 800.0))],
)
def test_vibration_aliases_from_the_band_of_its_channel(band, tried):
    shaking = np.random.default_rng(2).uniform(0.0, 5.0, 60_000)
    log = make_log(
        np.random.default_rng(1).standard_normal((1, 60_000)),
        rate=100.0,
        unit="deg/h",
        channels={"vibration": (shaking, "g")},
    )
    if band is not None:
        log["vibration"].attrs["band_hz"] = band
    known, _ = effect_candidates(reduce_log(log), COEFFICIENT)
    variants = [
        variant
        for candidate in known
        if candidate.effect == "aliased_vibration"
        for variant in candidate.variants
    ]
    assert variants
    assert {(candidate.values["low"], candidate.values["high"]) for candidate in variants} == {
        tried
    }


def test_a_constant_channel_has_no_effect(plain):
    still = plain.assign(
        {name: plain[name] * 0.0 + 20.0 for name in ("channel_temperature", "fine_temperature")}
    )
    candidates, reasons = effect_candidates(still, COEFFICIENT)
    assert not [candidate for candidate in candidates if candidate.effect == "shupe"]
    assert reasons["shupe"] == "not identifiable: temperature does not change"


def test_an_axis_does_not_explain_itself(plain, tried_effects):
    turning = 500.0 * np.sin(np.linspace(0.0, 6.0, plain.sizes["block"]))
    moving = plain.assign(mean=plain["mean"] + turning)
    leak = select_candidate(effect_candidates(moving, COEFFICIENT)[0], "misalignment", "mean")
    for variant in leak.variants:
        for name, design in zip(variant.columns, variant.design, strict=True):
            assert not design["xyz".index(name)].any()
    assert not [
        candidate
        for candidate in tried_effects[0]
        if candidate.effect in ("dead_zone", "clock_error") and candidate.statistic.name == "mean"
    ]


def test_axes_at_rest_do_not_leak(plain, tried_effects):
    assert not [
        candidate
        for candidate in tried_effects[0]
        if candidate.effect == "misalignment" and candidate.statistic.name == "mean"
    ]
    course = xr.DataArray(np.linspace(0.0, 500.0, plain.sizes["block"]), dims="block")
    turning = plain.assign(mean=plain["mean"] + course.where(plain["axis"] == "z", 0.0))
    leak = select_candidate(effect_candidates(turning, COEFFICIENT)[0], "misalignment", "mean")
    assert [variant.columns for variant in leak.variants] == [("z",)]


def test_mean_designs_match_the_simulator(plain):
    candidates, _ = effect_candidates(plain, COEFFICIENT)
    table = {"name": "vibration_rectification", "sensitivity": 0.01}
    added = (record([table])["mean"] - record([])["mean"]).values
    candidate = next(candidate for candidate in candidates if candidate.effect == table["name"])
    design = next(
        variant.design for variant in candidate.variants if variant.columns == ("sensitivity",)
    )
    np.testing.assert_allclose(0.01 * design[0], added, rtol=0.02, atol=2e-4)


def test_earth_rate_is_in_quadrature_between_the_cross_axes(rich):
    candidates, _ = effect_candidates(rich, COEFFICIENT)
    candidate = select_candidate(candidates, "earth_rate", "rotation_order")
    pattern = candidate.variants[0].design[0, :, 0]
    turning = [*WORLD["turning"]]
    table = {"name": "earth_rate", "latitude": 60.0}
    recorded = (
        record([table], environment=turning)["order"] - record([], environment=turning)["order"]
    ).isel(harmonic=0)
    good = np.isfinite(recorded.values).all(axis=0)
    x, y, z = recorded.values[:, good]
    assert (
        np.median(np.abs(y / x - pattern[1] / pattern[0])) < 0.01
    )  # except in blocks with a fractional number of turns
    assert np.abs(z).max() < 0.02 * np.abs(x).min()


def test_densities_of_the_noise_terms(plain):
    frequency = np.array([0.01, 0.1, 1.0])
    np.testing.assert_allclose(sampled_psd("N", frequency, 100.0), 3600.0)
    np.testing.assert_allclose(
        sampled_psd("K", frequency, 100.0),
        1.0 / (3600.0 * (2 * np.pi * frequency) ** 2),
        rtol=1e-3,
    )
    with pytest.raises(ValueError, match="no density"):
        sampled_psd("R", frequency, 100.0)


def test_gaps_mix_a_density_with_its_mean(plain):
    density = np.linspace(1.0, 2.0, plain.sizes["band"])
    half = plain.assign(neighbours=plain["neighbours"] * 0.25)  # a quarter of that without gaps
    mixed = spread_by_gaps(density, half)
    assert np.ptp(mixed[0, 0]) == pytest.approx(0.25)
    np.testing.assert_allclose(
        spread_by_gaps(density, plain.assign(neighbours=plain["neighbours"] * 0.0 + 1.0))[0, 0],
        density,
    )


def test_gaps_in_channels_are_interpolated(plain):
    values = plain["channel_temperature"].values.copy()
    values[10:14] = np.nan
    temperatures = make_windows(
        plain.assign(channel_temperature=("block", values)), {"temperature": "temperature"}
    ).drivers["temperature"]
    np.testing.assert_allclose(
        temperatures[10:14], np.interp(np.arange(10, 14), [9, 14], [values[9], values[14]])
    )


def test_hat_functions_add_to_one():
    np.testing.assert_allclose(
        hat_functions(np.arange(50.0), np.arange(1.0, 51.0)).sum(axis=0), 1.0
    )


# --------------------------------------------------------------------------------
# cells


@pytest.mark.parametrize("common", [0.0, 0.05])
def test_linear_model_of_powers_gives_the_evidence_of_powers(plain, common):
    baseline = calibrate_noise(plain)
    baseline = baseline.assign(common=baseline["common"] + common)
    folds = fold_blocks(plain)
    generic = [
        alternative for alternative in nuisance_alternatives(plain) if alternative.effect == "~N(t)"
    ]
    state = initial_state(plain, baseline)
    cells = generic[0].statistic.model(generic, 0, plain, state)
    mine = linear_model_factors(cells, folds)[:, 1:]
    designs = [
        power_column(column, 0, state) / baseline["spectrum"].values[0]
        for column in generic[0].variants[0].design
    ]
    theirs = power_factors(plain, baseline, [np.stack(designs, axis=-1)], axis="x", folds=folds)[
        :, 1:
    ]
    np.testing.assert_allclose(mine, theirs, atol=1e-6)


@pytest.mark.parametrize("statistic", ["cross_spectrum", "rotation_order"])
def test_simulated_noise_has_the_variance_of_the_weights(rich, statistic):
    baseline = calibrate_noise(rich)
    candidates = [
        candidate
        for candidate in effect_candidates(rich, COEFFICIENT)[0]
        if candidate.statistic.name == statistic and candidate.is_per_axis
    ][:1]
    cells = candidates[0].statistic.model(candidates, 0, rich, initial_state(rich, baseline))
    z = (cells.values[..., 0] * np.sqrt(cells.weight))[
        (cells.weight > 0) & np.isfinite(cells.values[..., 0])
    ]
    assert np.mean(z**2) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / z.size) + 0.03)
    drawn = simulate_noise(cells, np.random.default_rng(1), 3)
    assert drawn.values.shape[2] == 3
    assert not drawn.values[cells.weight == 0].any()


def test_a_filter_is_a_candidate_only_if_it_changes_the_shape(tried_effects):
    candidate = next(
        candidate for candidate in tried_effects[0] if candidate.effect == "logger_filter"
    )
    assert all(variant.columns == () for variant in candidate.variants)
    assert all(
        (variant.design <= 1e-9).all()
        for variant in candidate.variants
        if not variant.values["pick"]
    )
    assert all(
        (variant.design[..., 0] > variant.design[..., -1]).all()
        for variant in candidate.variants
        if variant.values["pick"]
    )


def test_simulated_wander_has_the_predicted_variance():
    kind = effects()["gauss_markov"]
    effect = kind(rms=0.1, correlation_time=50.0)
    log = simulate(
        {"noise": {}, "effect": [{"name": "gauss_markov", "rms": 0.1, "correlation_time": 50.0}]},
        duration="4h",
        rate=1.0,
        seed=5,
    )
    blocks = reduce_log(log)
    time, variance = effect.explain(make_windows(blocks, {})).wander["rms"]
    assert time == 50.0
    assert 0.01 * variance[0] == pytest.approx(float(np.var(log["rate"].values)), rel=0.3)


def test_nuisance_alternatives_have_the_axes_of_the_record(plain):
    assert {alternative.statistic.name for alternative in nuisance_alternatives(plain)} == {
        "mean",
        "random_process",
        "power",
        "telegraph",
        "cross_spectrum",
        "sample_counts",
    }
    single_axis = plain.isel(axis=[0], pair=slice(0))
    assert "cross_spectrum" not in {
        alternative.statistic.name for alternative in nuisance_alternatives(single_axis)
    }


def test_a_constant_white_level_is_no_candidate_on_several_axes():
    """Lost samples add white noise at a constant level, whatever the N of each axis."""
    differing = COEFFICIENT * xr.DataArray([1.0, 2.0, 3.0], dims="axis")
    known_effects, _ = effect_candidates(record([]), differing)
    held = [known for known in known_effects if known.effect == "held_samples"]
    assert held
    assert not any(known.statistic.is_power for known in held)

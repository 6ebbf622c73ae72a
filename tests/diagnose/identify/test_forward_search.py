"""Identify simulated effects, and nothing in noise."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose
from scipy.signal import lfilter

from gyrostab.diagnose.evidence.folds import FOLDS, fold_blocks, fold_subsets
from gyrostab.diagnose.evidence.mixture import Mixture
from gyrostab.diagnose.evidence.sample_counts import expected_counts, sample_count_evidence
from gyrostab.diagnose.evidence.spectral_lines import line_evidence
from gyrostab.diagnose.identify import identifiability
from gyrostab.diagnose.identify.examination import prepare_examination
from gyrostab.diagnose.identify.identifiability import (
    _is_possible,
    distance_to_range,
    find_equivalent_effects,
    keep_physical,
    passes_time_shift_test,
)
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict import search
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.search import combine_rows, compute_evidence
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.rejections import find_rejections
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.thermal import apply_dead_band
from tests.support.candidates import select_candidate
from tests.support.named import WORLD, name_effects, nulls, record


def identify(effects, *, axes="xyz", environment=WORLD["usual"], seed=1, drop=(), count=40):
    blocks = record(effects, axes=axes, environment=environment, seed=seed, drop=drop)
    baseline, records = nulls(blocks, count)
    return name_effects(blocks, baseline, records)


VIBRATION = [{"name": "vibration_noise", "white": 6e-4, "axes": ["x"]}]


@pytest.fixture(scope="module")
def shaken():
    return identify(VIBRATION)


@pytest.mark.full
def test_noise_has_no_identification():
    identifications = identify([], axes="xy", seed=2)
    assert identifications.identified == identifications.unidentified == ()
    assert 3.0 < identifications.examination.threshold < 15.0
    assert identifications.examination.null_best.size == 40


@pytest.mark.slow
def test_null_records_may_come_in_parts():
    blocks = record([], axes="x", environment=())
    baseline, records = nulls(blocks, 12)
    (together,) = records
    parts = [together.isel(record=part) for part in (slice(0, 5), slice(5, None))]
    best, best_in_parts = (
        prepare_examination(blocks, baseline, given).null_best for given in (records, parts)
    )
    assert best.size == 12
    assert_allclose(best_in_parts, best, rtol=1e-9)


@pytest.mark.full
def test_evidence_does_not_depend_on_the_parts_of_a_group(shaken, monkeypatch):
    state = shaken.state
    candidates = [item for item in shaken.examination.candidates if item.statistic.null_variable]
    arguments = candidates, state.blocks, state
    whole = compute_evidence(*arguments)
    monkeypatch.setattr(search, "_COLUMNS_AT_ONCE", 20)
    parts = compute_evidence(*arguments)
    assert [item.candidate for item in parts] == [item.candidate for item in whole]
    for one, other in zip(parts, whole, strict=True):
        assert_allclose(one.evidence_nats, other.evidence_nats, rtol=1e-6, atol=1e-6)


def test_vibration_noise_is_identified_on_its_axis(shaken):
    (identification,) = shaken.identified
    assert identification.effect == "vibration_noise"
    assert identification.axes == ("x",)
    assert identification.driver == ("vibration",)
    assert identification.evidence_nats > identification.threshold >= shaken.examination.threshold
    assert "temperature_noise" not in identification.alternatives
    assert not shaken.unidentified


def test_every_other_effect_is_rejected_for_a_competitor(shaken):
    rejected = {rejection.name: rejection for rejection in find_rejections(shaken)}
    assert "vibration_noise" not in rejected
    noise = rejected["temperature_bias"]
    assert noise.beaten_by == "noise"
    assert 0.0 < noise.nats < shaken.examination.threshold + 2.0
    # the same noise, of vibration beyond half the sampling rate: its alternative, of equal evidence
    assert rejected["aliased_vibration"].beaten_by == "vibration_noise"
    assert abs(rejected["aliased_vibration"].nats) < 3.0


def test_chance_on_another_axis_does_not_veto_an_effect(shaken, monkeypatch):
    """Only the component of negative size, on an axis without the effect, is dropped."""
    state, (identification,) = shaken.state, shaken.identified
    (component,) = (
        component
        for component in identification.components
        if component.candidate.statistic.name == "power"
    )
    elsewhere = [replace(component, row=(axis,)) for axis in "yz"]
    size_by_axis = {"x": 1.0, "y": -0.1, "z": 0.1}
    monkeypatch.setattr(
        identifiability,
        "component_mixture",
        lambda component, state: Mixture(
            np.zeros(1), np.full((1, 1), size_by_axis[component.row[0]]), np.full((1, 1, 1), 1e-4)
        ),
    )
    assert keep_physical([component, *elsewhere], state)[0] == [component, elsewhere[1]]


def test_sizes_outside_the_registry_are_rejected(shaken):
    """1e4 deg/h per degree is that of a broken instrument, or not an effect of temperature."""
    bias = select_candidate(shaken.examination.candidates, "temperature_bias", "mean")
    variant = next(variant for variant in bias.variants if variant.columns == ("sensitivity",))
    component = Component(bias, variant, ("y",), 50.0)
    for size, answer in ((5e3, [component]), (1.5e4, [])):
        state = shaken.state
        mean = state.blocks["mean"] + size * xr.DataArray(variant.design[0, 0], dims="block").where(
            state.blocks["axis"] == "y", 0.0
        )
        assert (
            keep_physical([component], replace(state, blocks=state.blocks.assign(mean=mean)))[0]
            == answer
        )


@pytest.mark.parametrize(("statistic", "parts"), [("mean", 1), ("rotation_order", 2)])
@pytest.mark.parametrize(
    ("size", "error", "answer"), [(14.0, 1.0, True), (21.0, 1.0, True), (30.0, 1.0, False)]
)
def test_a_size_is_impossible_only_beyond_its_error(
    monkeypatch, statistic, parts, size, error, answer
):
    """The largest earth rate is 20 deg/h."""
    variant = Variant({}, ("rate",), np.ones((1, 1, 3)))
    candidate = Candidate("earth_rate", find_statistic(statistic), (), (variant,))
    mixture = Mixture(np.zeros(1), np.full((1, parts), size), error**2 * np.eye(parts)[None])
    monkeypatch.setattr(identifiability, "component_mixture", lambda component, state: mixture)
    state = SimpleNamespace(settings=Settings())
    assert _is_possible(Component(candidate, variant, ("x",), 50.0), state) == answer


@pytest.mark.parametrize(
    ("levels", "nats", "is_open"),
    [([0.0, 5.0], 1000.0, True), ([0.0, 2.0, 5.0], 200.0, False), ([0.0, 2.0, 5.0], 20.0, True)],
)
def test_g_and_its_square_are_separated_by_what_one_explains_less(levels, nats, is_open):
    """Of g and g^2 at 0, 2 and 5 g, 0.066 of the variance of one is not in the other."""
    candidate = Candidate("vibration_rectification", find_statistic("mean"), ("vibration",), ())
    component = Component(
        candidate, Variant({}, ("sensitivity",), np.ones((1, 1, 3))), ("x",), nats
    )
    blocks = {"channel_vibration": xr.DataArray(np.repeat(levels, 4))}
    state = SimpleNamespace(settings=Settings(), blocks=blocks)
    others = find_equivalent_effects([component], state)
    assert ("g_sensitivity" in others) == is_open


@pytest.mark.full
@pytest.mark.parametrize(
    ("table", "environment", "others"),
    [
        (
            {"name": "shupe", "sensitivity": 0.4, "axes": ["x"]},
            "usual",
            {"temperature_bias", "thermal_hysteresis", "warm_up"},
        ),
        (
            {"name": "vibration_rectification", "sensitivity": 0.005, "axes": ["y"]},
            "usual",
            {"g_sensitivity"},
        ),
        (
            {"name": "shared_source", "N": [0.0012, 0.0012, -0.0012], "axes": ["x", "y", "z"]},
            "usual",
            set(),
        ),
        (
            {"name": "spikes", "per_hour": 100.0, "kind": "outlier", "size": 30.0, "axes": ["z"]},
            "usual",
            set(),
        ),
    ],
    ids=lambda value: value["name"] if isinstance(value, dict) else None,
)
def test_single_effects_are_identified(table, environment, others):
    identifications = identify([table], environment=WORLD[environment])
    assert [identification.effect for identification in identifications.identified] == [
        table["name"]
    ]
    (identification,) = identifications.identified
    assert identification.axes == tuple(table["axes"])
    assert set(identification.alternatives) <= others


@pytest.mark.slow
def test_effect_without_its_channel_is_not_identified():
    identifications = identify(VIBRATION, axes="xy", drop=("vibration",))
    assert identifications.unidentified
    assert not identifications.identified
    assert {unidentified.effect for unidentified in identifications.unidentified} <= {
        "~N(t)",
        "~S(f)",
        "~burst",
    }
    assert all(unidentified.axes == ("x",) for unidentified in identifications.unidentified)


@pytest.mark.full
def test_two_effects_are_both_identified():
    identifications = identify(
        [*VIBRATION, {"name": "vibration_rectification", "sensitivity": 0.006, "axes": ["y"]}],
        axes="xy",
    )
    assert {
        (identification.effect, identification.axes)
        for identification in identifications.identified
    } == {
        ("vibration_noise", ("x",)),
        ("vibration_rectification", ("y",)),
    }


def test_time_shifted_channels_explain_less(shaken):
    (identification,) = shaken.identified
    start = replace(shaken.state, given={})
    beats, p_value, _ = passes_time_shift_test(identification.components, start)
    assert beats
    assert p_value <= 0.01
    elsewhere = [replace(component, row=("z",)) for component in identification.components]
    assert not passes_time_shift_test(elsewhere, start)[0]


def test_identified_effect_is_in_the_model_of_the_next(shaken):
    (identification,) = shaken.identified
    loud = shaken.state.expected_power[0] / shaken.state.baseline["spectrum"].values[0]
    vibration = shaken.state.blocks["channel_vibration"].values
    assert loud[vibration > 4].mean() > 1.2
    assert loud[vibration < 1].mean() == pytest.approx(1.0, abs=0.05)
    conditioned = condition_on(shaken.state, list(identification.components))
    np.testing.assert_allclose(conditioned.expected_power, shaken.state.expected_power, rtol=1e-3)


def test_identifications_are_frozen_data(shaken):
    assert all(
        isinstance(identification, Selection) and identification.is_named
        for identification in shaken.identified
    )


# --------------------------------------------------------------------------------
# parts


def test_additional_axes_need_evidence():
    assert combine_rows(np.array([10.0, 1.0, -5.0])) == 10.0
    assert combine_rows(np.array([10.0, 10.0, 10.0])) == 27.0
    assert combine_rows(np.array([-2.0, -1.0])) == -1.0


def subsets(block_count: int) -> np.ndarray:
    return fold_subsets(fold_blocks(record([]).isel(block=slice(0, block_count))))


def test_only_raised_counts_have_evidence():
    rng = np.random.default_rng(4)
    usual = rng.poisson(0.05, (500, 2, 120))
    mean, spread = expected_counts(usual)
    np.testing.assert_allclose(mean.mean(axis=1), 0.05, rtol=0.1)
    np.testing.assert_allclose(spread, 1.0, atol=0.2)
    null = sample_count_evidence(usual, mean, spread, subsets(120))
    raised = sample_count_evidence(rng.poisson(0.3, (50, 2, 120)), mean, spread, subsets(120))
    assert np.quantile(null, 0.99) < 3.0
    assert raised.min() > 5.0


def test_lost_blocks_are_expected_to_have_no_counts():
    """With half of the blocks lost, the usual count in the others is not raised, and three times as
    many are."""
    rng = np.random.default_rng(5)
    is_present = np.arange(120) < 60
    usual = rng.poisson(1.0 * is_present, (400, 1, 120))
    mean, spread = expected_counts(usual)
    np.testing.assert_allclose(
        [mean[0, is_present].mean(), mean[0, ~is_present].mean()], [1.0, 0.0], atol=0.02
    )
    assert (mean > 0.0).all()
    few = sample_count_evidence(
        rng.poisson(0.5 * is_present, (50, 1, 120)), mean, spread, subsets(120)
    )
    many = sample_count_evidence(
        rng.poisson(3.0 * is_present, (50, 1, 120)), mean, spread, subsets(120)
    )
    assert few.max() < 3.0
    assert many.min() > 40.0


@pytest.mark.full
def test_every_line_of_a_comb_is_identified():
    """There are more lines than the limit for other effects."""
    quiet = reduce_log(
        make_log(np.random.default_rng(3).standard_normal((2, 24_000)), rate=10.0, unit="deg/h")
    )
    comb = np.arange(5, quiet.sizes["line"], 7)
    loud = np.ones(quiet.sizes["line"])
    loud[comb] = 4.0
    shape = xr.DataArray(np.stack([loud, np.ones_like(loud)]), dims=("axis", "line"))
    blocks = quiet.assign(
        line_power=(quiet["line_power"] * shape).transpose(*quiet["line_power"].dims)
    )
    baseline, chance = nulls(quiet, 40)
    identifications = name_effects(blocks, baseline, chance)
    assert {
        (identification.effect, identification.axes)
        for identification in identifications.identified
    } == {("spectral_line", ("x",))}
    assert (
        sorted(
            component.line_index
            for identification in identifications.identified
            for component in identification.components
        )
        == comb.tolist()
    )
    assert comb.size == 14


def test_line_has_evidence_only_at_its_frequency():
    rng = np.random.default_rng(5)
    weight = np.full((1, 8), 22.0)
    power = rng.gamma(22.0, 1 / 22.0, (40, 1, 8, 500))
    null = line_evidence(power, weight).max(axis=-1)
    power[:, :, :, 123] *= 2.0
    gains = line_evidence(power, weight)
    assert np.quantile(null, 0.95) < 4.0
    assert (gains.argmax(axis=-1) == 123).all()
    assert gains.max(axis=-1).min() > 10.0


def test_folds_of_all_lengths_are_used():
    assert len(subsets(120)) == 1 + 3 * FOLDS


def test_sizes_of_infinite_error_may_have_any_value() -> None:
    sizes, limit = np.array([300.0, -2.0]), np.full(2, 20.0)
    unknown = np.diag([np.inf, np.inf])
    assert distance_to_range(sizes, unknown, -limit, limit) == 0.0
    half_known = np.diag([np.inf, 1.0])
    assert distance_to_range(sizes, half_known, -limit, limit) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.full
@pytest.mark.parametrize("effect", ["temperature_bias", "thermal_hysteresis"])
def test_a_lag_of_the_temperature_sensor_is_no_other_effect(effect):
    """The sensor of a tool that heats and cools at 2 degC/min lags by 20 s."""
    rate, lag = 5.0, 20.0
    t = np.arange(18_000) / rate
    true = 30.0 + np.interp(t, [0, 600, 900, 1500, 2100, 2700, 3600], [0, 20, 20, 5, 5, 25, 10])
    sensor = lfilter([1.0 / (lag * rate)], [1.0, 1.0 / (lag * rate) - 1.0], true - 30.0) + 30.0
    cause = true - apply_dead_band(true, 1.5, true[0])[0] if effect != "temperature_bias" else true
    rates = np.random.default_rng(1).standard_normal((1, t.size)) + 0.4 * cause
    log = make_log(rates, rate=rate, unit="deg/h", channels={"temperature": (sensor, "degC")})
    blocks = reduce_log(log)
    identified = name_effects(blocks, *nulls(blocks, 20)).identified
    assert [identification.effect for identification in identified] == [effect]

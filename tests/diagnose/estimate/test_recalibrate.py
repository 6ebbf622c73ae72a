"""Noise calibrated with the effects in the model is that of the simulation without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.assemble import assemble_baseline
from gyrostab.diagnose.baseline.calibrate import calibrate_axes, calibrate_noise
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.estimate.conditioned_baseline import predict_baseline
from gyrostab.diagnose.estimate.constant_rate import fit_white_noise
from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.estimate.recalibrate import recalibrate, refer_to_kept_noise, with_noise
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.identify.forms import choose_forms
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result import finish as conclude
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.physics.electronics import GaussMarkov
from gyrostab.simulate import simulate
from tests.support.candidates import identify_by_hand, make_identifications, select_candidate

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
HEAT = {"profile": "ramps", "channel": "temperature", "unit": "degC"}
SHAKE = {"profile": "vibration", "points": [[0, 3.0], [850, 3.0], [851, 6.0], [1800, 6.0]]}


def reduce_simulation(*effects, axes=("x", "y"), environment=(), lost=0.0):
    model = {
        "noise": NOISE,
        "effect": list(effects),
        "environment": list(environment),
        "log": {"axes": list(axes)},
    }
    log = simulate(model, duration="30min", rate=10.0, seed=5).compute()
    is_present = xr.DataArray(
        np.random.default_rng(3).random(log.sizes["time"]) >= lost, dims="time"
    )
    return reduce_log(log.assign(rate=log["rate"].where(is_present)))


def noise_coefficient(baseline, term, axis="x"):
    return tuple(
        float(baseline[name].sel(axis=axis, term=term)) for name in ("coefficient", "stderr")
    )


@pytest.fixture(scope="module")
def shaken():
    blocks = reduce_simulation(
        {"name": "vibration_noise", "white": 0.002, "axes": ["x"]}, environment=[SHAKE]
    )
    baseline = calibrate_noise(blocks)
    identifications = identify_by_hand(
        blocks, baseline, "vibration_noise", "power", ("white",), exponent=1.0
    )
    return (
        identifications,
        baseline,
        recalibrate(identifications, baseline, fit_identifications(identifications, baseline)),
    )


def test_vibration_at_two_levels_that_never_rests(shaken):
    _, baseline, after = shaken
    assert noise_coefficient(baseline, "N")[0] > 1.7 * 0.003
    value, error = noise_coefficient(after, "N")
    assert error < 0.2 * value
    assert abs(value - 0.003) < 3.0 * error
    assert after.attrs["recalibrated"] == ["x"]


def test_diagnosis_separates_noise_and_effects(shaken):
    """The first calibration has the vibration in its noise, and finds less of it than there is."""
    identifications, baseline, after = shaken
    fit = conclude.refit_with_noise(
        identifications, baseline, first := fit_identifications(identifications, baseline)
    )
    assert noise_coefficient(fit.noise, "N")[0] == noise_coefficient(after, "N")[0] < 1.2 * 0.003
    (size,) = fit.fitted[0].parameters.values()
    assert size.low < 0.002 < size.high
    held = conclude.measure_held_out(identifications.state.blocks, baseline, identifications, first)
    assert held["misfit_after"] == pytest.approx(1.0, abs=0.15)


def test_relative_size_refers_to_the_recalibrated_noise():
    """Warm throughout: the first calibration has twice the noise and more, and the growth relative
    to it."""
    heat = HEAT | {"points": [[0, 35], [600, 35], [601, 50], [1200, 50], [1201, 65], [1800, 65]]}
    blocks = reduce_simulation(
        {"name": "temperature_noise", "linear": 0.05, "axes": ["x"]}, environment=[heat]
    )
    baseline = calibrate_noise(blocks)
    identifications = identify_by_hand(blocks, baseline, "temperature_noise", "power", ("linear",))
    first = fit_identifications(identifications, baseline)
    fit = conclude.refit_with_noise(identifications, baseline, first)
    assert first[0].parameters["linear"].high < 0.05
    growth = fit.fitted[0].parameters["linear"].value * noise_coefficient(fit.noise, "N")[0] ** 2
    assert growth == pytest.approx(0.05 * 0.003**2, rel=0.1)


def test_noise_is_that_of_the_form_in_the_model():
    """The evidence may prefer the square of the temperature; the model has the plainer law."""
    heat = HEAT | {"points": [[0, 50], [900, 60], [1800, 50]]}
    blocks = reduce_simulation(
        {"name": "temperature_noise", "linear": 0.03, "axes": ["x"]}, environment=[heat]
    )
    baseline = calibrate_noise(blocks)
    frame = identify_by_hand(blocks, baseline, "temperature_noise", "power", ("quadratic",))
    identifications = choose_forms(frame, baseline)
    first = fit_identifications(identifications, baseline)
    fit = conclude.refit_with_noise(identifications, baseline, first)
    (size,) = fit.fitted[0].parameters.values()
    assert set(fit.fitted[0].parameters) == {"linear"}
    effect = fit.fitted[0].effect
    above = float(blocks["channel_temperature"].mean()) - effect.reference
    assert effect.reference in (50.0, 51.0)  # of 50 to 60
    level = noise_coefficient(fit.noise, "N")[0] ** 2 * (1.0 + size.value * above)
    assert level == pytest.approx(noise_coefficient(baseline, "N")[0] ** 2, rel=0.03)


def test_noise_belongs_to_the_exponent_in_the_model():
    """The evidence prefers the root of the time; the model has the usual proportional growth."""
    blocks = reduce_simulation({"name": "ageing_noise", "growth": 20.0, "axes": ["x"]})
    baseline = calibrate_noise(blocks)
    by_evidence = identify_by_hand(
        blocks, baseline, "ageing_noise", "power", ("growth",), exponent=0.5
    )
    identifications = choose_forms(by_evidence, baseline)
    (component,) = identifications.identified[0].components
    assert component.variant.values["exponent"] == 1.0
    first = fit_identifications(identifications, baseline)
    fit = conclude.refit_with_noise(identifications, baseline, first)
    value, error = noise_coefficient(fit.noise, "N")
    assert abs(value - 0.003) < 3.0 * error


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_lines_in_most_bands_leave_the_noise_between_them(lost):
    """The power of a steady line stands out from the lines beside it; that of its band is free."""
    places = [0.42, 0.58, 0.85, 1.31, 2.12, 3.2, 4.2, 4.7]
    lines = [
        {"name": "spectral_line", "amplitude": 0.3, "frequency": place, "axes": ["x"]}
        for place in places
    ]
    blocks = reduce_simulation(*lines, lost=lost)
    baseline = calibrate_noise(blocks)
    candidates, _ = effect_candidates(blocks, baseline["coefficient"])
    candidate = select_candidate(candidates, "spectral_line", "spectral_line")
    frequency = blocks["line_frequency"].values
    components = tuple(
        Component(
            candidate, candidate.variants[0], ("x",), 100.0, int(np.abs(frequency - place).argmin())
        )
        for place in places
    )
    selection = Selection("spectral_line", (), ("x",), components, 1200.0, 8.0)
    state = condition_on(initial_state(blocks, baseline), list(components))
    identifications = make_identifications([selection], state)
    after = recalibrate(identifications, baseline, [])
    assert noise_coefficient(baseline, "N")[0] > 1.3 * 0.003
    value, error = noise_coefficient(after, "N")
    assert value == pytest.approx(0.003, rel=0.05)
    assert error < 0.05 * 0.003


def test_white_noise_of_a_model_gives_the_power_of_the_record_with_its_effects():
    heat = HEAT | {"points": [[0, 45], [1800, 65]]}
    table = {"name": "temperature_noise", "linear": 0.03, "axes": ["x"]}
    blocks = reduce_simulation(table, environment=[heat], lost=0.2)
    wrong = {axis: NOISE | {"N": 0.0036} for axis in "xy"}
    baseline = calibrate_noise(blocks)
    baseline["quiet"][:] = True
    white = fit_white_noise({"noise": wrong, "effect": [table]}, baseline, blocks, ["x"])
    assert white == pytest.approx({"x": 0.003}, rel=0.02)


def test_noise_that_follows_temperature_refers_to_that_of_the_record():
    """Nothing determines N at 25 degrees."""
    heat = HEAT | {"points": [[0, 58], [600, 58], [601, 62], [1200, 62], [1201, 66], [1800, 66]]}
    truth = {"name": "temperature_noise", "linear": 0.12, "reference": 62.0, "axes": ["x"]}
    blocks = reduce_simulation(truth, environment=[heat])
    baseline = calibrate_noise(blocks)
    identifications = identify_by_hand(blocks, baseline, "temperature_noise", "power", ("linear",))
    first = fit_identifications(identifications, baseline)
    fit = conclude.refit_with_noise(identifications, baseline, first)
    assert fit.noise.attrs["recalibrated"] == ["x"]
    kept = refer_to_kept_noise(first, baseline, blocks)  # where the noise is not calibrated again
    for fitted, noise in ((fit.fitted, fit.noise), (kept, baseline)):
        effect, level = fitted[0].effect, noise_coefficient(noise, "N")[0] ** 2
        assert effect.reference == pytest.approx(58.0, abs=0.5)
        for degrees in (58.0, 62.0, 66.0):
            squared_noise = level * (1.0 + effect.linear * (degrees - effect.reference))
            true = 0.003**2 * (1.0 + 0.12 * (degrees - 62.0))
            assert squared_noise == pytest.approx(true, rel=0.12)
    assert "at 58 degC" in fit.fitted[0].say()


def test_noise_does_not_wander_as_the_effect_does():
    """The means of an axis contain a wandering bias once: in the effect, not in B and K too."""
    wander = {"name": "gauss_markov", "rms": 0.3, "correlation_time": 60.0, "axes": ["x"]}
    blocks = reduce_simulation(wander)
    baseline = calibrate_noise(blocks)
    identifications = identify_by_hand(
        blocks, baseline, "gauss_markov", "power", ("rms",), correlation_time=60.0
    )
    (fitted,) = fit_identifications(identifications, baseline)
    fitted = replace(fitted, effect=GaussMarkov(rms=(0.3,), correlation_time=60.0, axes=("x",)))
    after = recalibrate(identifications, baseline, [fitted])
    np.testing.assert_allclose(after["wander_square"].values[:, 0], [0.3**2, 0.0])
    assert noise_coefficient(baseline, "K")[0] > 1.0
    assert noise_coefficient(after, "K")[0] < 0.3
    assert noise_coefficient(after, "B")[0] < 0.05


@pytest.mark.parametrize("factor", [0.85, 0.95, 1.0])
def test_model_has_the_power_of_the_record_at_any_size_of_the_effect(shaken, factor):
    identifications, baseline, _ = shaken
    blocks = identifications.state.blocks
    first = fit_identifications(identifications, baseline)
    fit = conclude.refit_with_noise(identifications, baseline, first)
    (fitted,) = fit.fitted
    changed = replace(fitted, effect=replace(fitted.effect, white=factor * fitted.effect.white))
    tables = conclude.model_tables(fit.noise, [changed], None, blocks)
    expected, noise = (
        baseline_from_model(blocks, model)["spectrum"].sel(axis="x")
        for model in (tables, tables | {"effect": []})
    )
    x = blocks.sel(axis="x")
    ratio = (x["power"] / expected).weighted(x["shape"] * noise / expected)
    assert float(ratio.mean()) == pytest.approx(1.0, abs=0.02)
    assert tables["noise"]["y"]["N"] == pytest.approx(noise_coefficient(baseline, "N", "y")[0])


def test_axis_without_an_effect_keeps_its_noise(shaken):
    _, baseline, after = shaken
    for name in ("coefficient", "spectrum", "square", "grid_K", "mean_variance"):
        np.testing.assert_array_equal(after[name].sel(axis="y"), baseline[name].sel(axis="y"))
    before, now = (np.exp(noise["grid_calibrated"].sel(axis="y")) for noise in (baseline, after))
    np.testing.assert_allclose(now, before, atol=1e-9)


def test_axes_that_need_larger_grids_before_than_after(shaken):
    identifications, baseline, _ = shaken
    blocks = identifications.state.blocks
    quiescent = np.ones((2, blocks.sizes["block"]), np.bool_)
    quiescent[0, 2:] = False
    posteriors = calibrate_axes(blocks, quiescent, DEFAULTS)
    wide = assemble_baseline(blocks, posteriors, quiescent=quiescent, attrs=baseline.attrs)
    after = recalibrate(identifications, wide, fit_identifications(identifications, wide))
    assert after.sizes["grid"] < wide.sizes["grid"]
    for axis in "xy":
        assert np.exp(after["grid_calibrated"].sel(axis=axis)).sum() == pytest.approx(1.0)


def test_effect_and_new_noise_add_up_to_the_record(shaken):
    identifications, _, after = shaken
    model = predict_baseline(with_noise(identifications, after), after)
    ratio = (identifications.state.blocks["power"] / model["spectrum"]).sel(axis="x")
    shape = identifications.state.blocks["shape"].sel(axis="x")
    for block_count in (slice(0, 42), slice(43, None)):
        component = (
            ratio.isel(block=block_count).weighted(shape.isel(block=block_count).fillna(0.0)).mean()
        )
        assert float(component) == pytest.approx(
            1.0, abs=5.0 / np.sqrt(float(shape.isel(block=block_count).sum()))
        )


def test_held_out_blocks_are_not_used(shaken):
    identifications, baseline, _ = shaken
    known = np.arange(identifications.state.blocks.sizes["block"]) % 2 == 0
    blind = recalibrate(identifications, baseline, [], known)
    spoiled = identifications.state.blocks.copy()
    spoiled["power"] = spoiled["power"].where(xr.DataArray(known, dims="block"), 99.0)
    other = recalibrate(
        replace(identifications, state=replace(identifications.state, blocks=spoiled)),
        baseline,
        [],
        known,
    )
    assert noise_coefficient(blind, "N")[0] == pytest.approx(
        noise_coefficient(other, "N")[0], rel=0.03
    )


def test_common_noise_is_not_noise_of_one_axis():
    blocks = reduce_simulation({"name": "shared_source", "N": 0.002})
    baseline = calibrate_noise(blocks)
    identifications = identify_by_hand(
        blocks, baseline, "shared_source", "cross_spectrum", ("N",), bandwidth=np.inf
    )
    after = recalibrate(identifications, baseline, fit_identifications(identifications, baseline))
    for axis in "xy":
        assert noise_coefficient(baseline, "N", axis)[0] > 1.15 * 0.003
        value, error = noise_coefficient(after, "N", axis)
        assert abs(value - 0.003) < 3.0 * error
        assert (
            error < 0.2 * value
        )  # one pair of axes tells the product of what they share, not the part of either
    np.testing.assert_allclose(after["spectrum"].median(), baseline["spectrum"].median(), rtol=0.05)


def test_phase_locked_power_is_counted_once():
    shaken = {
        "profile": "vibration",
        "points": [[0, 0.02], [600, 0.02], [601, 6.0], [1200, 6.0], [1201, 0.02], [1800, 0.02]],
        "band": [17.5, 20.0],
    }
    blocks = reduce_simulation(
        {"name": "aliased_vibration", "sensitivity": 0.3, "low": 17.5, "high": 20.0},
        environment=[shaken],
    )
    baseline = calibrate_noise(blocks)
    known, reasons = effect_candidates(blocks, baseline["coefficient"])
    statistics = {
        candidate.statistic.name: candidate
        for candidate in known
        if candidate.effect == "aliased_vibration"
    }
    variants = {
        statistic: next(
            variant for variant in candidate.variants if variant.values["sampling"] == "point"
        )
        for statistic, candidate in statistics.items()
    }
    places = [("power", ("x",)), ("power", ("y",)), ("cross_spectrum", ("x", "y"))]
    components = tuple(
        Component(statistics[statistic], variants[statistic], row, 500.0)
        for statistic, row in places
    )
    identification = Selection(
        "aliased_vibration", statistics["power"].driver, ("x", "y"), components, 500.0, 8.0
    )
    state = condition_on(initial_state(blocks, baseline), list(components))
    identifications = make_identifications([identification], state, known, reasons)
    first = fit_identifications(identifications, baseline)
    noise = recalibrate(identifications, baseline, first)
    for fitted in (first, fit_identifications(with_noise(identifications, noise), noise)):
        sizes = [
            estimate.value
            for name, estimate in fitted[0].parameters.items()
            if name.startswith("sensitivity")
        ]
        assert sizes
        assert sizes == pytest.approx([0.3] * len(sizes), rel=0.1)
    for axis in "xy":
        value, error = noise_coefficient(noise, "N", axis)
        assert abs(value - 0.003) < 3.0 * error
    second_effect = {
        "name": "aliased_vibration",
        "sensitivity": 0.3,
        "low": first[0].effect.low,
        "high": first[0].effect.high,
    }
    model = reduce_simulation(
        second_effect, environment=[shaken]
    )  # 17.5 to 20 Hz fold onto 0 to 2.5 Hz
    band, loud = model["frequency"].values, model["channel_vibration"].values > 3.0
    power = model["power"].mean("axis").values
    above = power[loud].mean(axis=0) / power[~loud].mean(axis=0) - 1.0
    assert above[(band > 0.5) & (band < 2.0)].min() > 10.0 * abs(above[band > 3.0]).max()


@pytest.mark.parametrize("size", [10.0, 40.0])
def test_anomalous_samples_do_not_raise_the_noise(size):
    blocks = reduce_simulation(
        {"name": "spikes", "kind": "outlier", "per_hour": 60.0, "size": size}, axes=["x"]
    )
    baseline = calibrate_noise(blocks)
    identifications = identify_by_hand(blocks, baseline, "spikes", "sample_counts", ("outliers",))
    counted = CountEvidence({"outliers": (np.zeros(1), np.ones(1))})
    examination = replace(identifications.examination, count_evidence=counted)
    identifications = replace(identifications, examination=examination)
    (fitted,) = fit_identifications(identifications, baseline)
    for name, true in (("per_hour", 60.0), ("size", size)):
        estimate = fitted.parameters[name]
        assert estimate.low <= true <= estimate.high
        assert estimate.stderr < 0.3 * estimate.value
    value, error = noise_coefficient(recalibrate(identifications, baseline, [fitted]), "N")
    assert abs(value - 0.003) < 3.0 * error
    assert error < 0.05 * value


@pytest.mark.full
@pytest.mark.parametrize("lost", [0.0, 0.3])
@pytest.mark.parametrize(
    ("table", "grid"),
    [
        (
            {"cutoff": 2.0, "order": 2},
            {"cutoff": 2.0, "order": 2.0, "instrument": 1.0, "pick": 0.0, "length": 0.0},
        ),
        ({"length": 0.5}, {"length": 0.5, "instrument": 1.0, "cutoff": 0.0}),
    ],
)
def test_noise_before_a_filter_is_recovered(table, grid, lost):
    blocks = reduce_simulation({"name": "logger_filter", **table}, axes=["x"], lost=lost)
    baseline = calibrate_noise(blocks)
    identifications = identify_by_hand(blocks, baseline, "logger_filter", "power", (), **grid)
    (fitted,) = fit_identifications(identifications, baseline)
    name = "cutoff" if "cutoff" in table else "length"
    estimate = fitted.parameters[name]
    assert estimate.low <= table[name] <= estimate.high
    assert estimate.value == pytest.approx(table[name], rel=0.04 if lost == 0.0 else 0.15)
    after = recalibrate(identifications, baseline, [fitted])
    value, error = noise_coefficient(after, "N")
    assert abs(value - 0.003) < 3.0 * error
    assert error < 0.1 * value


def test_given_model_keeps_its_noise(shaken):
    identifications, baseline, _ = shaken
    given = baseline.assign_attrs(source="model")
    assert recalibrate(identifications, given, []) is given

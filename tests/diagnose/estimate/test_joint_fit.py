"""Sizes are unbiased, and intervals hold the true value, also for slightly wrong forms."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.conditioned_baseline import predict_baseline
from gyrostab.diagnose.estimate.joint_fit import _make_estimate, fit_identifications
from gyrostab.diagnose.estimate.upper_limits import find_upper_limits
from gyrostab.diagnose.identify.forms import choose_forms
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.windows import rebuild_variant
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.diagnose.statistics.spectral_line import estimate_line, line_quality
from gyrostab.simulate import simulate
from tests.support import candidates as by_hand
from tests.support.candidates import make_identifications, select_candidate
from tests.support.named import record

RECORDS = 60
#: Little evidence: the error of the form that a fit allows for grows with it.
identify_by_hand = partial(by_hand.identify_by_hand, evidence_nats=50.0)


@pytest.fixture(scope="module")
def noise_only():
    blocks = record([])
    return blocks, calibrate_noise(blocks)


def fit_records(noise, change, effect, statistic, columns, count=RECORDS):
    """Fit many records of noise to which `change` adds an effect; yield the parameters of each."""
    blocks, baseline = noise
    rng = np.random.default_rng(8)
    drawn = next(null_records(blocks, baseline, count=count, rng=rng, chunk=count))
    frame = identify_by_hand(blocks, baseline, effect, statistic, columns)
    for number in range(count):
        record = blocks.assign(
            mean=drawn["mean"].isel(record=number).transpose("axis", "block"),
            power=drawn["power"].isel(record=number).transpose("axis", "block", "band"),
        )
        state = condition_on(
            initial_state(change(record), baseline), list(frame.identified[0].components)
        )
        (fitted,) = fit_identifications(replace(frame, state=state), baseline)
        yield fitted.parameters


def change_vibration(noise, g, sensitivity, quartic):
    """Give a record of noise another vibration, rectified with these sizes."""
    blocks, baseline = noise
    drawn = next(null_records(blocks, baseline, count=1, rng=np.random.default_rng(4), chunk=1))
    shape = xr.DataArray(sensitivity * g**2 + quartic * g**4, dims="block")
    changed = blocks.assign(mean=drawn["mean"].isel(record=0).transpose("axis", "block") + shape)
    return changed.assign(channel_vibration=blocks["channel_vibration"].copy(data=g))


def shake_at_levels(noise, levels):
    """Return a vibration [g] at two levels, in the second and in the fourth fifth of a record."""
    place = np.linspace(0.0, 1.0, noise[0].sizes["block"])
    second, fourth = ((place > low) & (place < low + 0.2) for low in (0.2, 0.6))
    return np.where(second, levels[0], np.where(fourth, levels[1], 0.0))


def coverage(estimates, truth: float) -> float:
    return float(np.mean([estimate.low <= truth <= estimate.high for estimate in estimates]))


@pytest.mark.full
@pytest.mark.parametrize(
    ("size", "power"),
    [(0.1, 2.0), (0.5, 2.0), (0.5, 1.9)],
)
def test_intervals_of_rectification_hold_the_true_value(noise_only, size, power):
    g = noise_only[0]["channel_vibration"].values
    truth = size / 36.0

    def change(blocks):
        return blocks.assign(
            mean=blocks["mean"] + xr.DataArray(size * (g / 6.0) ** power, dims="block")
        )

    fits = fit_records(noise_only, change, "vibration_rectification", "mean", ("sensitivity",))
    estimates = [parameters["sensitivity"] for parameters in fits]
    assert 0.90 <= coverage(estimates, truth) <= 1.0
    assert np.mean([estimate.value for estimate in estimates]) == pytest.approx(
        truth, rel=DEFAULTS.size_error_share
    )


@pytest.mark.full
@pytest.mark.parametrize("share", [0.2, 1.0])
def test_intervals_of_vibration_noise_hold_the_true_value(noise_only, share):
    g = noise_only[0]["channel_vibration"].values
    truth = 0.003 * np.sqrt(share) / 6.0

    def change(blocks):
        return blocks.assign(
            power=blocks["power"] * xr.DataArray(1.0 + share * (g / 6.0) ** 2, dims="block")
        )

    fits = fit_records(noise_only, change, "vibration_noise", "power", ("white",))
    estimates = [parameters["white"] for parameters in fits]
    assert 0.88 <= coverage(estimates, truth) <= 1.0
    assert np.mean([estimate.value for estimate in estimates]) == pytest.approx(truth, rel=0.06)


@pytest.mark.parametrize(("levels", "has_both_terms"), [((5.0, 5.0), False), ((3.0, 8.0), True)])
def test_terms_not_separated_by_one_level_become_one(noise_only, levels, has_both_terms):
    g = shake_at_levels(noise_only, levels)
    g = g + 0.05 * np.random.default_rng(3).random(g.size)
    sensitivity, quartic = (0.05, -5e-4) if has_both_terms else (0.005, 0.0)
    changed, baseline = change_vibration(noise_only, g, sensitivity, quartic), noise_only[1]
    frame = identify_by_hand(
        changed, baseline, "vibration_rectification", "mean", ("sensitivity", "quartic")
    )
    (fitted,) = fit_identifications(choose_forms(frame, baseline), baseline)
    assert set(fitted.parameters) == (
        {"sensitivity", "quartic"} if has_both_terms else {"sensitivity"}
    )
    assert ("does not separate" in fitted.say()) is not has_both_terms
    for name, truth in (("sensitivity", sensitivity), ("quartic", quartic)):
        if name in fitted.parameters:
            assert fitted.parameters[name].low < truth < fitted.parameters[name].high


def test_time_of_a_jump_has_no_error_of_the_form(noise_only):
    """Late in a record, a share of the time since its start would be many blocks."""
    blocks, baseline = noise_only
    block_s = float(blocks.attrs["block_s"])
    begin, end = blocks["begin"].values, blocks["end"].values
    time = 0.8 * end[-1] + 0.3 * block_s
    step = xr.DataArray(np.clip((end - time) / (end - begin), 0.0, 1.0), dims="block")
    drawn = next(null_records(blocks, baseline, count=1, rng=np.random.default_rng(4), chunk=1))
    mean = drawn["mean"].isel(record=0).transpose("axis", "block")
    changed = blocks.assign(mean=mean + 2.0 * step)
    frame = identify_by_hand(changed, baseline, "bias_jump", "mean", ("step",), at=time)
    (fitted,) = fit_identifications(choose_forms(frame, baseline), baseline)
    at = fitted.parameters["at"]
    assert at.low < time < at.high
    assert at.high - at.low < 2.0 * block_s
    assert fitted.say().endswith(f" ± {at.stderr:.2g} s.")


@pytest.mark.parametrize("present", [("sensitivity", "quadratic"), ("quadratic", "cubic")])
def test_terms_that_explain_nothing_are_left_out(noise_only, present):
    blocks, baseline = noise_only
    sizes = {"sensitivity": 0.02, "quadratic": -0.002, "cubic": 0.0003}
    columns = tuple(sizes)
    frame = identify_by_hand(blocks, baseline, "temperature_bias", "mean", columns)
    variant = frame.identified[0].components[0].variant
    assert variant.values["reference"] == pytest.approx(
        float(blocks["channel_temperature"].mean()), abs=0.06
    )
    shape = sum(
        sizes[name] * column[0]
        for name, column in zip(columns, variant.design, strict=True)
        if name in present
    )
    # no variant has these two terms alone
    candidate, reduced = frame.identified[0].components[0].candidate, variant.with_columns(present)
    rebuilt = rebuild_variant(candidate, reduced, initial_state(blocks, baseline))
    np.testing.assert_allclose(rebuilt.design, reduced.design)
    drawn = next(null_records(blocks, baseline, count=1, rng=np.random.default_rng(4), chunk=1))
    mean = drawn["mean"].isel(record=0).transpose("axis", "block")
    changed = blocks.assign(mean=mean + xr.DataArray(shape, dims="block"))
    frame = identify_by_hand(changed, baseline, "temperature_bias", "mean", columns)
    (fitted,) = fit_identifications(choose_forms(frame, baseline), baseline)
    assert set(fitted.parameters) - {"sensor_lag"} == set(present)
    (absent,) = set(columns) - set(present)
    assert f"no sign of the term {absent}; it is taken as 0" in fitted.say()
    for name in present:
        assert fitted.parameters[name].low < sizes[name] < fitted.parameters[name].high


@pytest.mark.parametrize(
    ("levels", "column"),
    [
        ((5.0, 5.0), "quartic"),
        ((3.0, 8.0), "quartic"),
        pytest.param((5.0, 5.0), "sensitivity", marks=pytest.mark.full),
        pytest.param((3.0, 8.0), "sensitivity", marks=pytest.mark.full),
    ],
)
def test_single_term_is_the_plainest_of_equivalent_ones(noise_only, levels, column):
    g = shake_at_levels(noise_only, levels)
    sizes = (0.005, 0.0) if column == "sensitivity" else (0.0, 1e-4)
    changed, baseline = change_vibration(noise_only, g, *sizes), noise_only[1]
    frame = identify_by_hand(changed, baseline, "vibration_rectification", "mean", (column,))
    (fitted,) = fit_identifications(choose_forms(frame, baseline), baseline)
    is_one_level = levels[0] == levels[1]
    assert set(fitted.parameters) == ({"sensitivity"} if is_one_level else {column})
    assert ("does not separate" in fitted.say()) is is_one_level


def test_axes_of_one_effect_have_one_choice_of_a_text():
    """The logger samples all axes alike, also where chance favours another way on one axis."""
    table = {"name": "aliased_vibration", "low": 17.0, "high": 19.0, "sensitivity": [0.01]}
    blocks = record([table])
    baseline = calibrate_noise(blocks)
    frame = identify_by_hand(blocks, baseline, "aliased_vibration", "power", ("sensitivity",))
    (identification,) = frame.identified
    (first,) = identification.components
    ways = {variant.values["sampling"]: variant for variant in first.candidate.variants}
    assert set(ways) == {"point", "average"}
    components = (first, replace(first, row=("y",), variant=ways["average"]))
    merged = replace(identification, axes=("x", "y"), components=components)
    settled = choose_forms(replace(frame, identified=(merged,)), baseline)
    texts = [variant.variant.texts for variant in settled.identified[0].components]
    assert texts == [{"sampling": "point"}] * 2
    (fitted,) = fit_identifications(settled, baseline)
    assert fitted.effect is not None
    assert fitted.effect.sampling == "point"


@pytest.fixture(scope="module")
def shaken():
    blocks = record([{"name": "vibration_rectification", "sensitivity": 0.005, "axes": ["y"]}])
    baseline, columns = calibrate_noise(blocks), ("sensitivity",)
    return identify_by_hand(
        blocks, baseline, "vibration_rectification", "mean", columns, axis="y"
    ), baseline


def test_model_contains_the_effect(shaken):
    identifications, baseline = shaken
    (fitted,) = fit_identifications(identifications, baseline)
    estimate = fitted.parameters["sensitivity"]
    assert estimate.low < 0.005 < estimate.high
    assert estimate.unit == "deg/h/g^2"
    assert fitted.effect is not None
    assert fitted.effect.axes == ("y",)
    assert "rectified" in fitted.say()
    table = {
        "name": fitted.effect.name,
        "sensitivity": fitted.effect.sensitivity,
        "axes": list(fitted.effect.axes),
    }
    simulated = record([table])["mean"].sel(axis="y") - record([])["mean"].sel(axis="y")
    truth = record([{"name": "vibration_rectification", "sensitivity": 0.005, "axes": ["y"]}])[
        "mean"
    ].sel(axis="y") - record([])["mean"].sel(axis="y")
    np.testing.assert_allclose(simulated, truth, atol=0.25 * float(np.abs(truth).max()))


def test_prediction_is_fitted_to_known_blocks_only(shaken):
    identifications, baseline = shaken
    after = predict_baseline(identifications, baseline)
    vibration = identifications.state.blocks["channel_vibration"].values
    gained = (after["known_mean"] - baseline["known_mean"]).sel(axis="y").values
    assert np.ptp(gained) == pytest.approx(0.005 * np.max(vibration**2), rel=0.35)
    assert np.allclose((after["known_mean"] - baseline["known_mean"]).sel(axis="x"), 0.0)
    blind = predict_baseline(identifications, baseline, vibration < 1.0)
    state = identifications.state
    shift = xr.DataArray(np.where(vibration < 1.0, 0.0, 5.0), dims="block")
    shifted = state.blocks.assign(mean=state.blocks["mean"] + shift)
    changed = replace(identifications, state=replace(state, blocks=shifted))
    np.testing.assert_allclose(
        predict_baseline(changed, baseline, vibration < 1.0)["known_mean"], blind["known_mean"]
    )


def test_effects_not_found_have_a_limit_or_a_reason(shaken):
    identifications, _ = shaken
    limits = find_upper_limits(identifications)
    assert "vibration_rectification" not in limits
    assert limits["shupe"]["reason"] == "below limit"
    assert 0.0 < limits["shupe"]["upper_limit"] < 5.0
    assert limits["shupe"]["unit"] == "deg/h/(degC/min)"
    assert 0.0 < limits["vibration_noise"]["upper_limit"] < 1e-3
    assert np.isnan(limits["feedback_reset"]["upper_limit"])
    assert limits["feedback_reset"]["reason"].startswith("not identifiable")


def test_size_of_a_line():
    table = {"name": "spectral_line", "amplitude": 0.4, "frequency": 2.345, "phase": 0.0}
    table["axes"] = ["x"]
    blocks = record([table])
    power = blocks["line_power"].sel(axis="x").mean("part")
    place = int(power.values.argmax())
    (amplitude, error), (frequency, _) = estimate_line(blocks, "x", place)
    assert amplitude == pytest.approx(0.4, abs=max(4 * error, 0.04))
    assert frequency == pytest.approx(2.345, abs=0.03)


def test_quality_of_a_line_follows_from_the_scatter_of_its_power():
    """A resonance narrower than a line of the spectrum looks steady, but its power scatters."""
    line = {"name": "spectral_line", "amplitude": 0.8, "frequency": 2.345, "axes": ["x"]}
    qualities = {}
    for quality in (np.inf, 150.0, 60.0):
        given = {} if np.isinf(quality) else {"quality": quality}
        blocks = record([line | given])
        place = int(blocks["line_power"].sel(axis="x").mean("part").values.argmax())
        qualities[quality] = line_quality(blocks, calibrate_noise(record([])), "x", place)
    assert np.isinf(qualities[np.inf])
    assert 75.0 < qualities[150.0] < 300.0
    assert 30.0 < qualities[60.0] < 120.0


def test_line_has_its_frequency_to_one_bin_and_the_amplitude_of_the_rate():
    """Samples are means over 0.1 s, in which a sine of 4 Hz is a quarter weaker."""
    true = 4.013
    blocks = record([{"name": "spectral_line", "amplitude": 0.4, "frequency": true, "axes": ["x"]}])
    baseline = calibrate_noise(blocks)
    identifications = identify_by_hand(
        blocks, baseline, "spectral_line", "spectral_line", ("amplitude",)
    )
    place = int(blocks["line_power"].sel(axis="x").mean("part").values.argmax())
    component = replace(identifications.identified[0].components[0], line_index=place)
    (fitted,) = fit_identifications(
        replace(
            identifications,
            identified=(replace(identifications.identified[0], components=(component,)),),
        ),
        baseline,
    )
    frequency = fitted.parameters["frequency"]
    step = float(np.diff(blocks["line_frequency"].values[:2])[0])
    assert frequency.low < true < frequency.high
    assert frequency.high - frequency.low < 2.0 * step
    assert fitted.parameters["amplitude"].value == pytest.approx(0.4, rel=0.06)


def test_model_with_identified_effects_runs(shaken):
    identifications, baseline = shaken
    (fitted,) = fit_identifications(identifications, baseline)
    values = {item.name: getattr(fitted.effect, item.name) for item in fitted.effect.parameters()}
    log = simulate(
        {"noise": {"N": 0.003}, "effect": [{"name": fitted.effect.name, "axes": ["y"], **values}],
         "environment": [{"profile": "vibration", "points": [[0, 0.0], [30, 6.0]]}],
         "log": {"axes": ["x", "y"]}},
        duration="1min", rate=10.0,
    )  # fmt: skip
    assert np.isfinite(log["rate"].values).all()


def test_axes_missing_in_the_strongest_statistic_get_sizes_from_the_next():
    """Two axes are identified by common noise, the third by its power: its size is not 0."""
    world = [
        {
            "profile": "vibration",
            "points": [[0, 0.02], [600, 0.02], [601, 6.0], [1200, 6.0], [1201, 0.02], [3600, 0.02]],
        }
    ]
    truth = {"x": 0.2, "y": 0.3, "z": 0.1}
    effect = {
        "name": "aliased_vibration",
        "low": 700.0,
        "high": 800.0,
        "sensitivity": list(truth.values()),
        "axes": list(truth),
    }
    blocks = record([effect], environment=world)
    baseline = calibrate_noise(blocks)
    candidates, reasons = effect_candidates(blocks, baseline["coefficient"])
    power, cross = (
        select_candidate(candidates, effect["name"], statistic)
        for statistic in ("power", "cross_spectrum")
    )
    components = [
        Component(cross, cross.variants[0], ("x", "y"), 90.0),
        *(Component(power, power.variants[0], (axis,), 40.0) for axis in "yz"),
    ]
    identification = Selection(
        effect["name"], power.driver, tuple(truth), tuple(components), 130.0, 8.0
    )
    state = condition_on(initial_state(blocks, baseline), components)
    (fitted,) = fit_identifications(
        make_identifications([identification], state, candidates, reasons),
        baseline,
    )
    assert fitted.effect.sensitivity == pytest.approx(
        tuple(fitted.parameters[f"sensitivity.{axis}"].value for axis in truth)
    )
    for axis, size in truth.items():
        estimate = fitted.parameters[f"sensitivity.{axis}"]
        assert estimate.low - estimate.stderr < size < estimate.high + estimate.stderr


@given(st.floats(-5.0, 5.0), st.floats(0.01, 10.0))
def test_an_interval_of_a_positive_size_contains_it(mean: float, sd: float) -> None:
    estimate = _make_estimate(mean, sd, "1", positive=True, form=0.0)
    assert 0.0 <= estimate.low <= estimate.value < estimate.high


def test_an_interval_cut_off_at_zero_holds_its_share() -> None:
    draws = np.random.default_rng(3).normal(-1.5, 1.0, 4_000_000)
    positive = draws[draws > 0.0]
    high = _make_estimate(-1.5, 1.0, "1", positive=True, form=0.0).high
    assert abs((positive > high).mean() - 0.025) < 0.001


def test_a_standard_error_is_no_wider_than_its_interval() -> None:
    estimate = _make_estimate(-0.5, 49.0, "1", positive=False, form=0.0, ends=(-0.93, -0.09))
    assert estimate.stderr == pytest.approx(0.5 * 0.84 / 1.96, rel=1e-3)
    assert (estimate.low, estimate.high) == pytest.approx((-0.93, -0.09))

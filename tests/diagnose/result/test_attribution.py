"""Which named effects are needed to explain a mismatch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.estimate.conditioned_baseline import predict_baseline
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.locate.mismatches import locate_mismatches, merge_regions
from gyrostab.diagnose.nulls.scores import null_scores
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.condition import MIN_FITTED_POWER_RATIO, condition_on, fit_powers
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.result.attribution import attribute_mismatches, needed_effects
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.diagnose.statistics.sample_counts import find_anomalous_blocks
from tests.support.candidates import make_identifications, select_candidate
from tests.support.named import COEFFICIENT, nulls, record

NAMES = (
    ("vibration_noise", "power", "white"),
    ("vibration_rectification", "mean", "sensitivity"),
    ("spikes", "sample_counts", "outliers"),
)


def _make_identification(candidates, effect, statistic, column):
    candidate = select_candidate(candidates, effect, statistic)
    variant = next(
        variant
        for variant in candidate.variants
        if variant.columns == (column,) and variant.values.get("exponent", 1.0) == 1.0
    )
    return Selection(
        effect, candidate.driver, ("x",), (Component(candidate, variant, ("x",), 50.0),), 50.0, 8.0
    )


@pytest.fixture(scope="module")
def shaken():
    """Vibration raises noise and bias of x, with spikes in a few blocks; three identifications."""
    blocks = record([])
    g = blocks["channel_vibration"].values
    baseline, chance = nulls(blocks, 60)
    level = np.zeros((3, g.size))
    level[0] = 0.05 * g**2
    spiky = np.zeros((3, g.size), np.int64)
    spiky[0, np.flatnonzero(g > 1.0)[[4, 9]]] = 9
    changed = blocks.assign(
        power=blocks["power"] * (1.0 + level[..., None] + 20.0 * (spiky > 0)[..., None]),
        mean=blocks["mean"] + np.stack([0.004 * g**2, 0 * g, 0 * g]),
        outliers=(("axis", "block"), spiky),
    )
    candidates, reasons = effect_candidates(changed, COEFFICIENT)
    identified = tuple(_make_identification(candidates, *names) for names in NAMES)
    state = initial_state(changed, baseline)
    for identification in identified[::-1]:  # anomalous samples are named first
        state = condition_on(state, list(identification.components))
    identifications = make_identifications(identified, state, candidates, reasons)
    return changed, baseline, identifications, null_scores(baseline, chance)


@pytest.mark.slow
def test_leaving_out_an_effect_keeps_the_sizes_of_the_others(shaken):
    blocks, baseline, identifications, _ = shaken
    loud, bias, _ = identifications.identified
    whole, silent, level = (
        predict_baseline(identifications, baseline, left_out=out) for out in ([], [loud], [bias])
    )
    quiet = blocks["channel_vibration"].values < 1.0
    np.testing.assert_allclose(silent["known_mean"], whole["known_mean"])
    np.testing.assert_allclose(level["spectrum"], whole["spectrum"])
    np.testing.assert_allclose(
        level["known_mean"], baseline["known_mean"].transpose("axis", "block")
    )
    np.testing.assert_allclose(silent["spectrum"][0][quiet], whole["spectrum"][0][quiet], rtol=0.02)
    ratio = (whole["spectrum"] / silent["spectrum"]).values[0, ~quiet, -1]
    np.testing.assert_allclose(
        ratio, 1.0 + 0.05 * blocks["channel_vibration"].values[~quiet] ** 2, rtol=0.15
    )
    np.testing.assert_allclose((silent["spectrum"] / baseline["spectrum"])[0], 1.0, atol=0.2)


def test_mismatch_lists_the_effects_that_it_needs(shaken):
    blocks, baseline, identifications, null = shaken
    regions = locate_mismatches(blocks, baseline, null)
    after = predict_baseline(identifications, baseline)

    def attributed(statistic, **options):
        lists = attribute_mismatches(
            regions, identifications.identified, blocks, after, null, level=0.005, **options
        )
        return {
            frozenset(names)
            for region, names in zip(regions, lists, strict=True)
            if region["view"] == statistic
        }

    def without(out):
        return predict_baseline(identifications, baseline, left_out=out)

    assert {"vibration_noise", "vibration_rectification", "spikes"} in attributed("davar")
    noise = attributed("davar", without=without)
    assert noise
    assert set().union(*noise) == {"vibration_noise", "spikes"}
    assert attributed("mean", without=without) == {frozenset({"vibration_rectification"})}


@pytest.mark.parametrize(("source", "attributed"), [("calibrated", True), ("simulation", False)])
def test_noise_of_an_effect_in_the_calibration_is_missing_where_it_is_quiet(
    shaken, source, attributed
):
    blocks, baseline, identifications, null = shaken
    g = blocks["channel_vibration"].values
    loud = 1.0 + 0.05 * float(np.mean(g[g > 0.1] ** 2))  # as if calibrated under vibration
    factor = xr.DataArray([loud, 1.0, 1.0], dims="axis")
    calibrated = baseline.assign(spectrum=factor * baseline["spectrum"])
    quiet = next(
        region | {"begin": 0.0, "end": float(blocks["begin"].values[g > 0.1][0])}
        for region in locate_mismatches(blocks, calibrated, null)
        if region["quantity"] == "level" and region["axes"] == "x" and region["ratio"] < 1.0
    )
    after = predict_baseline(identifications, baseline).assign_attrs(source=source)
    (names,) = attribute_mismatches(
        [quiet], identifications.identified, blocks, after, null, level=0.005
    )
    assert ("vibration_noise" in names) is attributed


def test_blocks_with_anomalous_samples_are_attributed_to_them(shaken):
    blocks, baseline, identifications, null = shaken
    loud, _, spikes = identifications.identified
    assert find_anomalous_blocks(spikes.components[0], blocks).sum() == 2
    regions = locate_mismatches(blocks, baseline, null)
    after = predict_baseline(identifications, baseline)
    by_noise = attribute_mismatches(
        regions, [loud], blocks, after, null, level=0.005
    )  # the noisiest two blocks are still there
    by_all = attribute_mismatches(
        regions, identifications.identified, blocks, after, null, level=0.005
    )
    davar = [region["view"] for region in regions].index("davar")
    assert (by_noise[davar], "vibration_noise" in by_all[davar]) == ([], True)


@pytest.mark.parametrize(("step", "attributed"), [(0.3, ["bias_jump"]), (0.0, [])])
def test_jump_explains_the_mean_on_either_side(shaken, step, attributed):
    """The constant of a record is free, so that either the mean before a jump or after it is a
    mismatch."""
    _, baseline, _, null = shaken
    blocks = record([])
    after_it = blocks["begin"].values >= 1800.0
    moved = blocks.assign(
        mean=blocks["mean"] + step * np.stack([after_it, 0 * after_it, 0 * after_it])
    )
    candidates, reasons = effect_candidates(moved, COEFFICIENT)
    candidate = select_candidate(candidates, "bias_jump", "mean")
    variant = next(variant for variant in candidate.variants if variant.values["at"] == 1800.0)
    identification = Selection(
        "bias_jump",
        candidate.driver,
        ("x",),
        (Component(candidate, variant, ("x",), 50.0),),
        50.0,
        8.0,
    )
    state = condition_on(initial_state(moved, baseline), list(identification.components))
    identifications = make_identifications([identification], state, candidates, reasons)
    region = {
        "statistic": "mean",
        "view": "mean",
        "axes": "x",
        "quantity": "mean",
        "begin": 1200.0,
        "end": 1800.0,
        "tau_min_s": 20.0,
        "tau_max_s": 600.0,
    }
    region |= {"frequency": np.nan, "sign": -1, "z": -8.0}
    assert find_statistic("mean").score(moved, baseline)["quantity"].values.tolist() == ["mean"]

    def explained(**options):
        return attribute_mismatches(
            [region],
            [identification],
            moved,
            predict_baseline(identifications, baseline),
            null,
            level=0.005,
            **options,
        )[0]

    assert explained() == []  # by its time alone
    assert (
        explained(without=lambda out: predict_baseline(identifications, baseline, left_out=out))
        == attributed
    )


BOX = {"view": "davar", "axes": "x", "quantity": "level", "z": 20.0}


def _make_shown(*statistics):
    variant = Variant({}, ("white",), np.empty(0))
    return [
        (
            f"effect {n}",
            [Component(Candidate("a", find_statistic(name), (), ()), variant, ("x",), 9.0)],
        )
        for n, name in enumerate(statistics)
    ]


def _scores_without(**sizes):
    """Scores left without some effects, where sizes add to 1; a mismatch from 6 on."""

    def left(out):
        return 1.0 + sum(sizes[name.replace(" ", "_")] for name in out), 6.0

    return left


@pytest.mark.parametrize(
    ("sizes", "needed"),
    [
        ((18.0, 0.4), [0]),  # the second is not missed
        ((12.0, 6.0), [0, 1]),  # without any of the two it is a mismatch
        ((4.0, 3.5), [0, 1]),  # without none alone, and both do alike
        ((4.5, 1.0), [0]),
        ((0.0, 0.0), [0]),  # one of them does it for the two
    ],
)
def test_effect_is_needed_alone_or_by_a_fair_share(sizes, needed):
    shown = _make_shown("power", "mean")
    names = needed_effects(BOX, shown, _scores_without(effect_0=sizes[0], effect_1=sizes[1]))
    assert names == [f"effect {number}" for number in needed]


def test_effect_not_contained_in_the_statistic_stays():
    assert needed_effects(
        BOX | {"view": "spectrum"},
        _make_shown("power", "spectral_line"),
        _scores_without(effect_0=0.0, effect_1=0.0),
    ) == ["effect 0", "effect 1"]
    assert needed_effects(
        BOX, _make_shown("power", "random_process"), _scores_without(effect_0=9.0, effect_1=0.0)
    ) == [
        "effect 0",
        "effect 1",
    ]
    low_pass = _make_shown("power", "power")
    low_pass[1][1][0] = replace(low_pass[1][1][0], variant=Variant({}, (), np.empty(0)))
    assert needed_effects(BOX, low_pass, _scores_without(effect_0=9.0, effect_1=0.0)) == [
        "effect 0",
        "effect 1",
    ]


@pytest.mark.parametrize(("begin", "regions"), [(70.0, 2), (85.0, 1)])
def test_short_mismatch_is_merged_only_with_a_near_long_one(begin, regions):
    long = {
        "statistic": "power",
        "view": "davar",
        "axes": "x y",
        "quantity": "level",
        "begin": 100.0,
        "end": 400.0,
        "tau_min_s": 0.01,
        "tau_max_s": 2.0,
    }
    long |= {"frequency": float("nan"), "sign": 1, "z": 90.0, "p_value": 1e-9}
    short = long | {"axes": "x", "begin": begin, "end": begin + 10.0, "z": 80.0}
    assert len(merge_regions([long, short])) == regions


@pytest.mark.parametrize(("axes", "attributed"), [("xy", ["spectral_line"]), ("x", [])])
def test_line_on_two_axes_explains_their_covariance(shaken, axes, attributed):
    _, baseline, _, null = shaken
    quiet = record([])
    band = int(np.flatnonzero(quiet["band_low"].values < 2.0)[-1])
    level = np.sqrt(
        (baseline["spectrum"][0] * baseline["spectrum"][1])
        .transpose("block", "band")
        .values[:, band]
    )
    cross = quiet["cross"].transpose("pair", "block", "band").copy()
    pair = [
        (str(a), str(b)) for a, b in zip(quiet["first"].values, quiet["second"].values, strict=True)
    ].index(("x", "y"))
    cross.values[pair, :, band] += 0.5 * level
    shared = quiet.assign(cross=cross)
    place = int(np.abs(shared["line_frequency"].values - 2.0).argmin())
    candidates, _ = effect_candidates(shared, COEFFICIENT)
    candidate = select_candidate(candidates, "spectral_line", "spectral_line")
    identification = Selection(
        "spectral_line",
        (),
        tuple(axes),
        tuple(Component(candidate, candidate.variants[0], (axis,), 50.0, place) for axis in axes),
        50.0,
        8.0,
    )
    regions = locate_mismatches(shared, baseline, null)
    regions = [region for region in regions if region["view"] == "cross_axis"]
    assert regions
    lists = attribute_mismatches(regions, [identification], shared, baseline, null, level=0.005)
    assert all(names == attributed for names in lists)


def test_leaving_out_power_that_was_fitted_below_zero_adds_none(shaken):
    """The least power bounds what remains, and not the sum from which the share is taken."""
    blocks, baseline, _, _ = shaken
    state = initial_state(blocks, baseline)
    level, part = state.expected_power[0], np.zeros((blocks.sizes["block"], 1))
    part[:18], part[18:20] = 1.0, 100.0
    power = blocks["power"].copy()
    power[0, :18], power[0, 18:20] = 0.5 * level[:18], np.nan  # the share is negative
    state = replace(state, blocks=state.blocks.assign(power=power))
    state = state.with_columns("power", "x", [level * part])
    whole, without = fit_powers(state, "x"), fit_powers(state, "x", np.array([True]))
    np.testing.assert_allclose(
        whole[18:20], MIN_FITTED_POWER_RATIO * state.expected_power[0, 18:20]
    )
    np.testing.assert_allclose(without[:20] / without[20:40], 1.0, atol=0.2)


@pytest.mark.slow
def test_mean_after_a_restart_is_explained_by_an_effect_before_it() -> None:
    """The power fails between two blocks, five blocks after a burst of vibration."""
    quiet = record([])
    g = quiet["channel_vibration"].values
    burst_end = int(np.flatnonzero(g > 1.0)[-1])
    lost = float(quiet["end"].values[burst_end + 5])
    table = {
        f"restart_{side}": ("restart", [lost + gap])
        for side, gap in (("begin", -3.0), ("end", 0.0))
    }
    blocks = quiet.drop_dims("restart").assign(table)
    baseline, chance = nulls(blocks, 60)
    changed = blocks.assign(mean=blocks["mean"] + np.stack([0.02 * g**2, 0 * g, 0 * g]))
    candidates, reasons = effect_candidates(changed, COEFFICIENT)
    bias = _make_identification(candidates, *NAMES[1])
    state = condition_on(initial_state(changed, baseline), list(bias.components))
    identifications = make_identifications((bias,), state, candidates, reasons)
    null = null_scores(baseline, chance)
    located = locate_mismatches(changed, baseline, null, level=0.005)
    explained = attribute_mismatches(
        located,
        [bias],
        changed,
        predict_baseline(identifications, baseline),
        null,
        level=0.005,
        without=lambda out: predict_baseline(identifications, baseline, left_out=out),
    )
    after = [
        names
        for region, names in zip(located, explained, strict=True)
        if region["view"] == "restart" and region["begin"] >= lost - 20.0
    ]
    assert after
    assert all(names == ["vibration_rectification"] for names in after)

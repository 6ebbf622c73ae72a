"""Locate regions where recording and simulation differ, and none where they agree."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from gyrostab.diagnose.locate.mismatches import locate_mismatches, merge_regions
from gyrostab.diagnose.nulls.scores import null_scores
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.ingest.make_log import make_log
from tests.support.reduced_records import BLOCK_S, RATE, baseline, chunks, records, smallest_p

SIGMA = 1.8  # of a sample [deg/h]: 0.003 deg/sqrt(h) at 100 Hz
SIZE = 360_000


@pytest.fixture(scope="module")
def base() -> xr.Dataset:
    return baseline()


@pytest.fixture(scope="module")
def null(base):
    return null_scores(base, chunks(base, 200, np.random.default_rng(21)))


def _overlap_share(region, begin, end):
    shared = min(float(region["end"]), end) - max(float(region["begin"]), begin)
    return max(shared, 0.0) / (max(float(region["end"]), end) - min(float(region["begin"]), begin))


@pytest.mark.slow
def test_false_alarm_rate_is_that_of_the_level(base, null):
    """With all statistics, on other records than those that set the thresholds."""
    p = np.concatenate(
        [smallest_p(chunk, base, null) for chunk in chunks(base, 300, np.random.default_rng(22))]
    )
    for level in (0.02, 0.1):
        low, high = stats.binom.ppf([0.001, 0.999], 300, level)
        slack = 1.0 + 2.0 / np.sqrt(200 * level)  # what 200 null records leave open
        assert low / slack <= (p < level).sum() <= high * slack, level
    alarms = [
        len(
            locate_mismatches(
                records(base, 1, np.random.default_rng(seed)).isel(record=0), base, null
            )
        )
        for seed in range(15)
    ]
    assert sum(alarms) <= 2


def test_level_sets_the_threshold(base, null):
    blocks = records(base, 1, np.random.default_rng(40)).isel(record=0)
    blocks["power"][0, 75:90] *= 1.06
    p = float(smallest_p(blocks, base, null))
    assert 1e-6 < p < 0.2
    located = locate_mismatches(blocks, base, null, level=1.5 * p)
    assert min(region["p_value"] for region in located) == pytest.approx(
        p
    )  # that of a cell, as in null records
    assert not locate_mismatches(blocks, base, null, level=0.7 * p)


@cache
def _baseline_and_null(missing):
    base = baseline(missing=missing)
    return base, null_scores(base, chunks(base, 75, np.random.default_rng(23), missing=missing))


@pytest.mark.parametrize("missing", [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
@pytest.mark.parametrize("share", [0.25, 0.5])
def test_burst_of_noise_has_a_region(share, missing):
    base, null = _baseline_and_null(missing)
    overlaps = []
    for seed in range(5):
        blocks = records(base, 1, np.random.default_rng(seed), missing=missing).isel(record=0)
        blocks["power"][1, 75:90] *= 1.0 + share**2
        regions = [
            region
            for region in locate_mismatches(blocks, base, null)
            if region["view"] == "davar" and region["axes"] == "y"
        ]
        overlaps.append(_overlap_share(regions[0], 1500.0, 1800.0) if regions else 0.0)
        if share == 0.5:
            assert len(regions) == 1
            assert regions[0]["ratio"] == pytest.approx(1.25, abs=0.08)
            assert regions[0]["tau_min_s"] == 1.0 / RATE
            assert regions[0]["p_value"] < 1e-4
            assert regions[0]["sign"] == 1
    assert np.median(overlaps) >= 0.7


def test_step_of_the_mean_has_a_region(base, null):
    overlaps = []
    for seed in range(5):
        blocks = records(base, 1, np.random.default_rng(seed)).isel(record=0)
        blocks["mean"][0, 30:45] += 0.1
        blocks["mean"][0, 120:140] -= 0.1
        regions = [
            region for region in locate_mismatches(blocks, base, null) if region["view"] == "mean"
        ]
        assert [region["axes"] for region in regions] == ["x", "x"]
        for sign, begin, end in ((1, 600.0, 900.0), (-1, 2400.0, 2800.0)):
            (step,) = (region for region in regions if region["sign"] == sign)
            overlaps.append(_overlap_share(step, begin, end))
            assert abs(step["estimate"]) == pytest.approx(0.1, abs=0.045)
    assert np.median(overlaps) >= 0.7


def test_band_of_noise_has_its_averaging_times(base, null):
    """Noise between 3 and 12 Hz only is a region around tau = 0.37 / f, and no wider than that."""
    blocks = records(base, 1, np.random.default_rng(5)).isel(record=0)
    inside = (blocks["frequency"].values > 3.0) & (blocks["frequency"].values < 12.0)
    blocks["power"][0, 60:120] *= 1.0 + 3.0 * xr.DataArray(inside.astype(float), dims="band")
    region = locate_mismatches(blocks, base, null)[0]
    assert region["view"] == "davar"
    assert float(region["tau_min_s"]) in (0.02, 0.04)
    assert float(region["tau_min_s"]) < 0.37 / 7.0 < float(region["tau_max_s"])
    assert float(region["tau_max_s"]) <= 0.32
    assert _overlap_share(region, 1200.0, 2400.0) > 0.95


def test_less_noise_than_simulated_has_negative_sign(base, null):
    blocks = records(base, 1, np.random.default_rng(5)).isel(record=0)
    blocks["power"] *= 0.9
    regions = locate_mismatches(blocks, base, null)
    assert len(regions) == 1  # of all axes together
    assert sorted(regions[0]["axes"].split()) == ["x", "y", "z"]
    assert (regions[0]["begin"], regions[0]["end"]) == (0.0, 3600.0)
    assert regions[0]["sign"] == -1
    assert regions[0]["ratio"] == pytest.approx(0.9, abs=0.02)


def test_two_bursts_are_two_regions(base, null):
    blocks = records(base, 1, np.random.default_rng(5)).isel(record=0)
    blocks["power"][0, 30:45] *= 1.3
    blocks["power"][0, 100:115] *= 1.3
    regions = locate_mismatches(blocks, base, null)
    begins = sorted(region["begin"] for region in regions)
    assert len(regions) == 2
    assert begins[0] == pytest.approx(600.0, abs=2 * BLOCK_S)
    assert begins[1] == pytest.approx(2000.0, abs=2 * BLOCK_S)


def test_wandering_mean_is_one_mismatch(base, null):
    blocks = records(base, 1, np.random.default_rng(5)).isel(record=0)
    blocks["mean"][1] += 0.5 * np.sin(2.0 * np.pi * np.arange(180) / 30.0)
    (region,) = (
        region for region in locate_mismatches(blocks, base, null) if region["view"] == "mean"
    )
    assert region["sign"] == 0
    assert region["end"] - region["begin"] > 3000.0
    assert 0.3 < abs(region["estimate"]) < 0.6  # between the mean of half a wave and its crest


def test_pieces_of_one_region_are_merged_and_others_are_not():
    region = {
        "statistic": "power",
        "view": "davar",
        "axes": "x",
        "quantity": "avar",
        "begin": 0.0,
        "end": 100.0,
        "tau_min_s": 0.01,
        "tau_max_s": 0.1,
    }
    region |= {"frequency": np.nan, "sign": 1, "z": 9.0, "p_value": 1e-6}
    adjacent, separate = (
        region | {"begin": 120.0, "end": 160.0, "z": 6.0},
        region | {"begin": 400.0, "end": 460.0, "z": 6.0},
    )
    assert [
        (merged["begin"], merged["end"]) for merged in merge_regions([separate, adjacent, region])
    ] == [
        (0.0, 160.0),
        (400.0, 460.0),
    ]
    assert len(merge_regions([region, region | {"sign": -1}])) == 2
    assert len(merge_regions([region, region | {"tau_min_s": 1.0, "tau_max_s": 2.0}])) == 2
    line = region | {
        "statistic": "spectral_line",
        "view": "spectrum",
        "quantity": "line",
        "frequency": 13.35,
        "tau_min_s": 0.028,
        "tau_max_s": 0.028,
    }
    assert (
        len(merge_regions([line, line | {"frequency": 13.45, "begin": 100.0, "end": 200.0}])) == 1
    )
    assert len(merge_regions([line, line | {"frequency": 14.35}])) == 2


# -- the whole way from samples
# --------------------------------------------------------------------------------


@cache
def _reduce_log_with(seed, effect):
    rng = np.random.default_rng(seed)
    rate = SIGMA * rng.standard_normal((3, SIZE))
    effect(rate, np.arange(SIZE) / RATE, rng)
    return reduce_log(make_log(rate, rate=RATE, unit="deg/h"))


def _add_nothing(rate, t, rng):
    pass


def _baseline_of(blocks):
    level = SIGMA**2 / RATE
    axes = blocks.sizes["axis"]
    return xr.Dataset(
        {
            "spectrum": (("axis", "block", "band"), np.full(blocks["power"].shape, level)),
            "known_mean": (("axis", "block"), np.zeros(blocks["mean"].shape)),
            "mean_variance": (("axis", "block"), SIGMA**2 / blocks["samples"].values),
            "angle_variance": (("axis",), np.zeros(blocks.sizes["axis"])),
            "coefficient": (("axis", "term"), np.tile([0.0, 0.003, 0.0, 0.0, 0.0], (axes, 1))),
        },
        coords={"axis": blocks["axis"], "term": list("QNBKR"), "frequency": blocks["frequency"]},
    )


def _draw_nulls(blocks, base, count, rng):
    """Null records on the bands of a real reduction."""
    shape, weight = blocks["shape"].values, blocks["line_weight"].values[..., None]
    lines = (25, *blocks["line_power"].shape)
    drop = [
        "mean",
        "power",
        "cross",
        "line_power",
        "kurtosis",
        "outliers",
        "repeats",
        "extremes",
        "zeros",
    ]
    for _ in range(count // 25):
        made = blocks.drop_vars(drop)
        power = (
            base["spectrum"].values * rng.gamma(np.broadcast_to(shape, (25, *shape.shape))) / shape
        )
        squared = rng.beta(1.0, np.maximum(shape[0] - 1.0, 1e-9), (25, *shape.shape))
        across = np.sqrt(power * np.roll(power, -1, axis=1) * squared) * np.exp(
            2j * np.pi * rng.random(power.shape)
        )
        made["power"] = (("record", "axis", "block", "band"), power)
        made["cross"] = (
            ("record", "pair", "block", "band"),
            across[:, [0, 2, 1]],
        )  # x y, z x, y z: the order of the pairs but for a sign
        made["line_power"] = (
            ("record", "axis", "part", "line"),
            base["spectrum"].values[0, 0, 0] * rng.gamma(weight, size=lines) / weight,
        )
        plane = (25, *blocks["mean"].shape)
        made["mean"] = (
            ("record", "axis", "block"),
            rng.normal(size=plane) * np.sqrt(base["mean_variance"].values),
        )
        made["kurtosis"] = (
            ("record", "axis", "block"),
            rng.normal(size=plane) * np.sqrt(24.0 / 2000.0),
        )
        for name in ("outliers", "repeats", "zeros"):
            made[name] = (("record", "axis", "block"), np.zeros(plane))
        two = rng.integers(0, plane[-1], (2, *plane[:2], 1))
        made["extremes"] = (("record", "axis", "block"), (two == np.arange(plane[-1])).sum(axis=0))
        yield made


@pytest.fixture(scope="module")
def raw():
    blocks = _reduce_log_with(1, _add_nothing)
    base = _baseline_of(blocks)
    return (
        base,
        null_scores(base, _draw_nulls(blocks, base, 100, np.random.default_rng(24))),
        blocks,
    )


def _add_vibration(rate, t, rng):
    on = (t >= 1500.0) & (t < 1800.0)
    rate[0, on] += 0.4 * SIGMA * rng.standard_normal(on.sum())


def _add_line(rate, t, rng):
    rate[2] += 0.15 * np.sin(2.0 * np.pi * 13.37 * t + 1.0)


def _add_common_noise(rate, t, rng):
    rate += 0.12 * SIGMA * np.array([1.0, 0.8, -1.1])[:, None] * rng.standard_normal(t.size)


def _add_spikes(rate, t, rng):
    at = np.linspace(180_000, 269_000, 12).astype(int)
    rate[0, at] += rng.choice([-1.0, 1.0], 12) * 15.0 * SIGMA


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "statistic", "axes", "begin", "end"),
    [
        (_add_vibration, "davar", {"x"}, 1500.0, 1800.0),
        (_add_line, "spectrum", {"z"}, 0.0, 3600.0),
        (_add_common_noise, "cross_axis", {"x", "y", "z"}, 0.0, 3600.0),
        (_add_spikes, "distribution", {"x"}, 1800.0, 2700.0),
    ],
)
def test_effects_in_samples_are_located(raw, effect, statistic, axes, begin, end):
    base, null, _ = raw
    regions = locate_mismatches(_reduce_log_with(2, effect), base, null)
    first = next(region for region in regions if region["view"] == statistic)
    assert set(first["axes"].split()) == axes
    assert _overlap_share(first, begin, end) >= 0.7
    if effect is _add_line:
        assert first["frequency"] == pytest.approx(13.37, abs=0.06)
        assert first["estimate"] == pytest.approx(0.15, rel=0.15)
    if effect is _add_spikes:
        assert first["quantity"] == "outliers"


def test_samples_without_an_effect_have_no_region(raw):
    base, null, blocks = raw
    assert not locate_mismatches(blocks, base, null)


def test_surest_mismatch_is_first(raw):
    base, null, _ = raw
    regions = locate_mismatches(_reduce_log_with(2, _add_vibration), base, null)
    assert np.all(np.diff([region["p_value"] for region in regions]) >= 0)

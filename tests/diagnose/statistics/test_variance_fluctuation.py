"""Variance fluctuation and drifting lines: detection limits, and absence of false alarms."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.locate.mismatches import locate_mismatches, merge_regions
from gyrostab.diagnose.nulls.records import _correlate_lines
from gyrostab.diagnose.nulls.scores import null_scores, standardise
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.text import mismatch_statement
from gyrostab.diagnose.statistics import find_statistic, variance_fluctuation
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.spectra.periodogram import taper
from tests.support.reduced_records import PARTS, baseline, chunks, records

SMALL = {"rate": 10.0, "block_count": 120}
BLOCKS, LINES = 120, 100


@pytest.fixture(scope="module")
def base() -> xr.Dataset:
    return baseline(**SMALL)


@pytest.fixture(scope="module")
def null(base):
    return null_scores(base, chunks(base, 100, np.random.default_rng(31), **SMALL))


def _some_records(base, count, seed):
    return records(base, count, np.random.default_rng(seed), **SMALL)


def _largest_score(statistic, blocks, base, null, row=slice(None)):
    """Return the largest standardised score of each record."""
    name = statistic.name
    z = np.nan_to_num(standardise(statistic.score(blocks, base), null.statistics[name]))
    return z[:, row].reshape(z.shape[0], -1).max(axis=1)


@given(st.integers(4, 30), st.integers(0, 10**6))
@settings(max_examples=12)
def test_moments_of_the_scatter_match_simulated_levels(count, seed):
    rng = np.random.default_rng(seed)
    shape = rng.uniform(1.0, 40.0, count)
    drawn = rng.gamma(shape, size=(40_000, count)) / shape * rng.uniform(0.1, 10.0)
    mean = (drawn * shape).sum(axis=1, keepdims=True) / shape.sum()
    scatter = (shape * (drawn - mean) ** 2).sum(axis=1) / mean[:, 0] ** 2
    expected, variance = variance_fluctuation.scatter_moments(
        np.array(float(count)), shape.sum(), (1.0 / shape).sum()
    )
    assert scatter.mean() == pytest.approx(expected, abs=5.0 * np.sqrt(variance / scatter.size))
    error = np.sqrt(((scatter - scatter.mean()) ** 2).var() / scatter.size)
    assert scatter.var() == pytest.approx(variance, abs=5.0 * error)


def test_scores_of_steady_noise_are_normal(base):
    z = find_statistic("variance_fluctuation").score(_some_records(base, 60, 3), base)["z"].values
    z = z[np.isfinite(z)]
    assert abs(z.mean()) < 0.05
    assert z.std() == pytest.approx(1.0, abs=0.06)
    assert 0.4 < (z > 3.0).mean() / 0.00135 < 2.5


def test_records_have_the_same_scores_together_as_alone(base):
    drawn = _some_records(base, 3, 4)
    drawn["power"][:, 1, 40:47] = np.nan
    statistic = find_statistic("variance_fluctuation")
    alone = [statistic.score(drawn.isel(record=[number]), base) for number in range(3)]
    xr.testing.assert_allclose(statistic.score(drawn, base), xr.concat(alone, "record"), rtol=1e-12)


def test_detection_limit_of_variance_fluctuation(base, null):
    shape = float(_some_records(base, 1, 1)["shape"].values[0, 0, 3:].sum())
    swell = np.sqrt(2.0) * np.sin(
        2.0 * np.pi * np.arange(BLOCKS) / 3.7
    )  # too fast for averages of more than one block
    critical = null.critical("variance_fluctuation", 0.01)
    limit = np.sqrt(critical * np.sqrt(2.0 * (BLOCKS - 1)) / (BLOCKS * shape))
    shares = []
    for factor in (0.75, 1.3):
        blocks = _some_records(base, 60, 17)
        blocks["power"][:, 0] *= np.exp(factor * limit * swell)[:, None]
        shares.append(
            (
                _largest_score(find_statistic("variance_fluctuation"), blocks, base, null, row=0)
                > critical
            ).mean()
        )
    assert shares[0] < 0.5 < shares[1]


def test_common_variance_fluctuation_is_detected_jointly(base, null):
    blocks = _some_records(base, 30, 5)
    blocks["power"] *= np.exp(0.09 * np.sin(2.0 * np.pi * np.arange(BLOCKS) / 12.0))[:, None]
    together, single = (
        np.median(
            _largest_score(find_statistic("variance_fluctuation"), blocks, base, null, row=row)
        )
        for row in (3, slice(0, 3))
    )
    assert together > null.critical("variance_fluctuation", 0.01) > single


@given(st.floats(0.01, 100.0))
@settings(max_examples=5)
def test_scores_do_not_depend_on_the_noise_level(factor):
    base = baseline(**SMALL)
    blocks = _some_records(base, 1, 8)
    louder = blocks.copy(deep=True)
    louder["power"][:, 1] *= factor
    scores = [
        find_statistic("variance_fluctuation").score(record, base)["z"].isel(row=[0, 1, 2]).values
        for record in (blocks, louder)
    ]
    np.testing.assert_allclose(*scores, atol=1e-6)


def test_a_single_noisy_block_is_not_variance_fluctuation(base, null):
    blocks = _some_records(base, 20, 6)
    blocks["power"][:, 0, 50] *= 30.0
    assert (
        _largest_score(find_statistic("variance_fluctuation"), blocks, base, null)
        > null.critical("variance_fluctuation", 0.01)
    ).mean() <= 0.1


def test_shared_noise_is_not_variance_fluctuation(base, null):
    blocks = _some_records(base, 20, 7)
    blocks["power"][:, 1] = blocks["power"][:, 0]
    blocks["power"][:, 2] = blocks["power"][:, 0]
    blocks["cross"][:] = blocks["power"][:, 0].values[:, None]
    critical = null.critical("variance_fluctuation", 0.01)
    assert (
        _largest_score(find_statistic("variance_fluctuation"), blocks, base, null, row=3) > critical
    ).mean() <= 0.1
    unknown = blocks.assign(cross=blocks["cross"] * 0.0)
    assert (
        _largest_score(find_statistic("variance_fluctuation"), unknown, base, null, row=3)
        > critical
    ).mean() > 0.9


def test_a_burst_with_a_region_is_not_reported_again(base, null):
    blocks = _some_records(base, 1, 9).isel(record=0)
    blocks["power"][0, 60:75] *= 1.7
    regions = locate_mismatches(blocks, base, null)
    what = [region["quantity"] for region in regions]
    assert what == ["level"] or set(what) == {"avar"}
    blocks["power"][1] *= np.exp(0.5 * np.sin(2.0 * np.pi * np.arange(BLOCKS) / 9.0))[:, None]
    regions = locate_mismatches(blocks, base, null)
    new = [region for region in regions if region["quantity"].startswith("variance")]
    assert "y" in {axis for region in new for axis in region["axes"].split()}
    begin, end = min(region["begin"] for region in new), max(region["end"] for region in new)
    assert end - begin > 0.9 * BLOCKS * 20.0


def test_scaled_powers_have_the_expected_mean(base):
    blocks = _some_records(base, 1, 10).isel(record=0)
    blocks["power"][0, 10:40] *= 5.0
    flat = variance_fluctuation.scale_to_expected(blocks, base, [(["x"], 200.0, 800.0)])
    ratio = flat["power"].values / base["spectrum"].values
    np.testing.assert_allclose(ratio[0, 10:40].mean(axis=0), 1.0)
    np.testing.assert_array_equal(flat["power"].values[1:], blocks["power"].values[1:])
    np.testing.assert_array_equal(flat["power"].values[0, 40:], blocks["power"].values[0, 40:])
    assert variance_fluctuation.scale_to_expected(blocks, base, []) is blocks


def _moving_line(blocks, row, first, last, energy, bend=0.0):
    """Add a line of this power over the density, moving between two lines from block to block."""
    rng = np.random.default_rng(3)
    level = float(blocks["line_power"].mean())
    part_of = np.arange(BLOCKS) * PARTS // BLOCKS
    for block, part in enumerate(part_of):
        t = (block + 0.5) / BLOCKS
        line = round(first + (last - first) * (t + bend * t * (1.0 - t)))
        # of the line with the noise
        beat = 2.0 * np.sqrt(energy) * rng.normal(0.0, np.sqrt(0.5), blocks.sizes["record"])
        blocks["line_power"].values[:, row, part, line] += (
            level * (energy + beat) / (part_of == part).sum()
        )


@pytest.mark.parametrize(
    ("first", "last", "bend"), [(20, 60, 0.0), (75, 30, 0.0), (10, 50, 0.6), (25, 90, -0.6)]
)
def test_a_drifting_line_is_detected_along_its_path(base, null, first, last, bend):
    blocks = _some_records(base, 12, 12)
    energy = 9.0 * np.sqrt(
        abs(last - first) / (PARTS * BLOCKS)
    )  # nine standard deviations in theory
    _moving_line(blocks, 1, first, last, energy, bend)
    critical = null.critical("drifting_line", 0.01)
    assert (
        _largest_score(find_statistic("drifting_line"), blocks, base, null) > critical
    ).mean() > 0.5
    scores = find_statistic("drifting_line").score(blocks, base)
    best = scores["quantity"].values[
        np.bincount(
            standardise(scores, null.statistics["drifting_line"])[:, 1, 0].argmax(axis=1)
        ).argmax()
    ]
    begins, ends = (float(component) for component in str(best).split()[1:])
    assert begins == pytest.approx(first * 0.05, abs=0.65)
    assert ends == pytest.approx(last * 0.05, abs=0.65)
    single = null.critical("spectral_line", 0.01)
    assert (
        _largest_score(find_statistic("spectral_line"), blocks, base, null) > single
    ).mean() < 0.5


def test_a_steady_line_and_a_temporary_hump_do_not_drift(base, null):
    blocks = _some_records(base, 20, 13)
    blocks["line_power"][:, 0, :, 37] *= 50.0
    blocks["line_power"][:, 1, 6:8, 20:60] *= 3.0
    blocks["line_power"][:, 2, 4:12] *= 4.0
    assert (
        _largest_score(find_statistic("drifting_line"), blocks, base, null)
        > null.critical("drifting_line", 0.01)
    ).mean() <= 0.1


def test_steady_noise_has_no_drifting_line(base, null):
    assert (
        _largest_score(find_statistic("drifting_line"), _some_records(base, 100, 14), base, null)
        > null.critical("drifting_line", 0.01)
    ).mean() <= 0.03
    assert (
        _largest_score(
            find_statistic("variance_fluctuation"), _some_records(base, 100, 15), base, null
        )
        > null.critical("variance_fluctuation", 0.01)
    ).mean() <= 0.03


def test_short_records_have_no_score(base):
    few = {"rate": 10.0, "block_count": 5}
    assert (
        find_statistic("variance_fluctuation").score(
            records(baseline(**few), 2, np.random.default_rng(1), **few), baseline(**few)
        )
        is None
    )
    blocks = _some_records(base, 2, 1)
    blocks["line_weight"][:, 4:] = 0.0
    assert find_statistic("drifting_line").score(blocks, base) is None


@pytest.mark.parametrize("block_count", [213, 218, 255])
def test_windows_after_the_last_average_have_no_score(block_count):
    small = {"rate": 10.0, "block_count": block_count}
    scores = find_statistic("variance_fluctuation").score(
        records(baseline(**small), 1, np.random.default_rng(4), **small), baseline(**small)
    )
    behind = (scores["first"] > block_count // 32 * 32).values
    assert behind.any()
    long = np.char.startswith(scores["quantity"].values.astype(str), "variance 640 s")
    assert long.any()
    assert np.isnan(scores["z"].values[..., behind, :][..., long]).all()
    whole = (scores["stop"] - scores["first"] == block_count).values
    assert np.isfinite(scores["z"].values[..., whole, :][..., long]).all()


def test_a_part_without_samples_is_skipped(base, null):
    blocks = _some_records(base, 12, 16)
    _moving_line(blocks, 0, 20, 60, 7.0 * np.sqrt(40.0 / (8.0 * BLOCKS)))
    blocks["line_power"][:, :, 4], blocks["line_weight"][:, 4] = np.nan, 0.0
    z = find_statistic("drifting_line").score(blocks, base)["z"].values
    assert np.isfinite(z).any()
    assert np.median(np.nanmax(z, axis=(1, 2, 3))) > 3.0


def test_one_axis_has_no_joint_row():
    single_axis = baseline(axes="x", **SMALL)
    blocks = records(single_axis, 2, np.random.default_rng(1), **SMALL)
    assert find_statistic("variance_fluctuation").score(blocks, single_axis)[
        "axes"
    ].values.tolist() == ["x"]
    assert find_statistic("drifting_line").score(blocks, single_axis)["axes"].values.tolist() == [
        "x"
    ]


def test_a_level_and_its_scatter_are_two_mismatches():
    region = {
        "statistic": "variance_fluctuation",
        "view": "davar",
        "axes": "x",
        "quantity": "avar",
        "begin": 0.0,
        "end": 100.0,
        "tau_min_s": 0.01,
        "tau_max_s": 0.1,
    }
    region |= {"frequency": np.nan, "sign": 1, "z": 9.0, "p_value": 1e-6}
    assert len(merge_regions([region, region | {"quantity": "variance 20 s"}])) == 2
    assert (
        len(
            merge_regions(
                [
                    region | {"quantity": "variance 40 s"},
                    region | {"quantity": "variance 20 s", "axes": "x y"},
                ]
            )
        )
        == 1
    )


def test_statements_give_time_scale_and_frequencies():
    region = {
        "statistic": "variance_fluctuation",
        "view": "davar",
        "quantity": "variance 40 s",
        "axes": ["x", "y"],
        "begin": 0.0,
        "end": 2000.0,
        "tau_min_s": 0.1,
        "tau_max_s": 2.9,
    }
    region |= {"ratio": 4.38, "estimate": 0.08, "sign": 1, "p_value": 1e-4, "frequency": np.nan}
    statement = mismatch_statement(region, 2000.0)
    assert "axes x and y fluctuates over the whole record" in statement
    assert "one stretch of 40 s to another" in statement
    assert "8 % (rms)" in statement
    glide = region | {"statistic": "drifting_line", "quantity": "drifting 1.58 3.42", "axes": ["y"]}
    assert (
        "a drifting line over the whole record, from about 1.58 Hz to about 3.42 Hz"
        in mismatch_statement(glide, 2000.0)
    )
    in_one_section = glide | {"quantity": "drifting 4.71 4.71"}
    assert "line over the whole record, near 4.71 Hz" in mismatch_statement(in_one_section, 2000.0)


def test_lines_of_null_records_leak_like_tapered_noise():
    rng, size = np.random.default_rng(2), 200
    lines = (
        np.abs(np.fft.rfft(rng.normal(size=(40_000, size)) * taper(size), axis=-1)[:, 1:100]) ** 2
    )
    drawn = _correlate_lines(rng.gamma(12.0, size=(40_000, 99)) / 12.0, size)
    for wide in (4, 15, 40):  # lines in the sum along a path
        spread = [
            power[:, 20 : 20 + wide].mean(axis=1).std() / power.mean() for power in (lines, drawn)
        ]
        line_scatter = [power[:, 20:60].std() / power.mean() for power in (lines, drawn)]
        ratio, drawn_ratio = (
            sums / single * np.sqrt(wide) for sums, single in zip(spread, line_scatter, strict=True)
        )
        assert drawn_ratio == pytest.approx(ratio, abs=0.015)
    assert ratio > 1.02
    assert drawn.min() > 0.0
    assert drawn.mean() == pytest.approx(1.0, abs=1e-3)
    assert drawn.var() == pytest.approx(1.0 / 12.0, rel=0.02)


def test_an_interval_that_ends_within_a_block_leaves_no_fluctuation():
    noise = np.random.default_rng(5).standard_normal((2, 60_000))
    noise[:, 20_000:40_400] *= 6.0
    blocks = reduce_log(
        make_log(noise, rate=10.0, unit="deg/h", axis=["x", "y"]), block="1000samples"
    )
    base = calibrate_noise(blocks, quiet=(0.0, float(blocks["end"][19])))
    scaled = variance_fluctuation.scale_to_expected(blocks, base, [(("x", "y"), 2_000.0, 4_100.0)])
    assert (
        float(np.nanmax(find_statistic("variance_fluctuation").score(scaled, base)["z"].values))
        < 4.8
    )

"""Common slow motion: found below the random walk of each axis, not in independent walks."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from gyrostab.diagnose.locate.mismatches import locate_mismatches, merge_regions
from gyrostab.diagnose.nulls.scores import null_scores, standardise
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.result.attribution import attribute_mismatches
from gyrostab.diagnose.result.text import mismatch_statement
from gyrostab.diagnose.statistics import find_statistic
from tests.support.reduced_records import BLOCK_S, baseline, chunks, records

BLOCKS = 180
WALK = 0.3  # deg/h^1.5: apparent random walk of the waveform below
TRUE = 0.02


@pytest.fixture(scope="module")
def base():
    """Noise as calibrated with the waveform."""
    return baseline(walk=WALK)


@pytest.fixture(scope="module")
def null(base):
    return null_scores(base, chunks(base, 100, np.random.default_rng(4)))


def _slow_waveform() -> np.ndarray:
    """Slow rise and fall, with steps smaller than those of a walk of WALK."""
    t = 2.0 * np.pi * np.arange(BLOCKS) / BLOCKS
    shape = sum(
        size * np.sin(turns * t + turns)
        for turns, size in ((2.3, 1.0), (4.7, 0.6), (8.1, 0.4), (13.3, 0.25))
    )
    return 0.6 * shape * WALK * np.sqrt(BLOCK_S / 3600.0 / np.square(np.diff(shape)).mean())


def _records_of_means(noise, count: int, seed: int) -> xr.Dataset:
    """Return records with block means of white noise and a random walk."""
    rng, walk = np.random.default_rng(seed), float(noise["coefficient"].sel(term="K")[0])
    values = rng.normal(size=(count, 3, BLOCKS)) * np.sqrt(noise["mean_variance"].values)
    values += np.cumsum(rng.normal(0.0, walk * np.sqrt(BLOCK_S / 3600.0), values.shape), axis=-1)
    edges = np.arange(BLOCKS + 1) * BLOCK_S
    coords = {"axis": list("xyz"), "begin": ("block", edges[:-1]), "end": ("block", edges[1:])}
    return xr.Dataset(
        {"mean": (("record", "axis", "block"), values)}, coords=coords, attrs={"block_s": BLOCK_S}
    )


def _quiet_records(count: int, seed: int) -> xr.Dataset:
    return _records_of_means(baseline(walk=TRUE), count, seed)


def _with_waveform(blocks, shares):
    return blocks.assign(
        mean=blocks["mean"]
        + xr.DataArray(np.asarray(shares)[:, None] * _slow_waveform(), dims=("axis", "block"))
    )


@pytest.mark.parametrize(("assumed", "true"), [(0.0, 0.0), (0.1, 0.1), (1.0, 0.02), (0.02, 1.0)])
@pytest.mark.parametrize("missing", [0, 40])
def test_independent_axes_have_normal_scores(assumed, true, missing):
    blocks = _records_of_means(baseline(walk=true), 60, 3)
    blocks["mean"][:, 1, 30 : 30 + missing] = np.nan
    z = find_statistic("common_mode").score(blocks, baseline(walk=assumed))["z"].values
    few = z[:, :-1, -1, :3]  # each pair over the whole record, for spans with many averages
    assert abs(few.mean()) < 4.0 / np.sqrt(180.0)
    assert 0.7 < few.std() < 1.2  # smaller if independent increments are taken as correlated


@pytest.mark.slow
@pytest.mark.parametrize("shares", [(1.0, 0.8, -0.9), (-0.5, 1.0, 0.7)])
def test_a_common_waveform_is_found_that_no_axis_shows_alone(base, null, shares):
    blocks = _with_waveform(_quiet_records(30, 5), shares)
    z = np.abs(
        np.nan_to_num(
            standardise(
                find_statistic("common_mode").score(blocks, base), null.statistics["common_mode"]
            )
        )
    )
    assert (z.max(axis=(1, 2, 3)) > null.critical("common_mode", 0.005)).mean() >= 0.9
    scores_of_means = np.abs(
        np.nan_to_num(
            standardise(find_statistic("mean").score(blocks, base), null.statistics["mean"])
        )
    )
    assert (scores_of_means.max(axis=(1, 2, 3)) > null.critical("mean", 0.005)).mean() <= 0.1


@given(
    st.lists(st.floats(0.01, 100.0), min_size=3, max_size=3),
    st.lists(st.sampled_from([-1.0, 1.0]), min_size=3, max_size=3),
)
@settings(max_examples=15)
def test_scores_do_not_depend_on_sizes_of_axes(sizes, signs):
    noise, blocks = baseline(walk=WALK), _quiet_records(1, 9).isel(record=0)
    scaled = blocks.assign(
        mean=blocks["mean"] * xr.DataArray(np.multiply(sizes, signs), dims="axis")
    )
    before, after = (
        find_statistic("common_mode").score(statistics, noise)["estimate"].values
        for statistics in (blocks, scaled)
    )
    turned = np.array([signs[0] * signs[1], signs[0] * signs[2], signs[1] * signs[2], 1.0])[
        :, None, None
    ]
    np.testing.assert_allclose(after, before * turned, atol=1e-9)


def test_score_of_all_axes_is_that_of_the_determinant():
    noise = baseline()
    blocks = _records_of_means(noise, 500, 12)
    scores = find_statistic("common_mode").score(blocks, noise)
    assert stats.kstest(stats.norm.sf(scores["z"].values[:, -1, -1, 0]), "uniform").pvalue > 1e-3
    matrix = np.corrcoef(
        blocks["mean"].values[0]
    )  # of white noise, except for the constant of the record
    pairs = np.array([matrix[0, 1], matrix[0, 2], matrix[1, 2]])
    np.testing.assert_allclose(scores["estimate"].values[0, :3, -1, 0], pairs, atol=0.02)
    chi2 = -(BLOCKS - 11.0 / 6.0) * np.linalg.slogdet(matrix)[1]
    assert stats.norm.sf(scores["z"].values[0, -1, -1, 0]) == pytest.approx(
        stats.chi2.sf(chi2, 3), abs=0.06
    )


def test_known_common_white_noise_is_subtracted():
    noise = baseline()
    blocks = _records_of_means(noise, 40, 8)
    rng, share = np.random.default_rng(2), 0.4
    sigma = np.sqrt(noise["mean_variance"].values[0])
    shared = rng.normal(size=(40, 1, BLOCKS)) * sigma * np.sqrt(share)
    blocks["mean"] = blocks["mean"] * np.sqrt(1.0 - share) + xr.DataArray(
        shared, dims=("record", "axis", "block")
    ).isel(axis=0)
    known = noise.assign(cross=(("pair", "block", "band"), share * noise["spectrum"].values + 0j))
    before, after = (
        find_statistic("common_mode").score(blocks, noise_model)["estimate"].values[:, :3, -1, 0]
        for noise_model in (noise, known)
    )
    assert before.mean() == pytest.approx(share, abs=0.03)
    assert abs(after.mean()) < 0.04


def test_known_means_are_subtracted(base):
    shares = np.array([1.0, 0.8, -0.9])
    blocks = _with_waveform(_quiet_records(20, 5), shares)
    known = base.assign(known_mean=(("axis", "block"), shares[:, None] * _slow_waveform()))
    before, after = (
        np.abs(
            find_statistic("common_mode").score(blocks, noise_model)["z"].values[:, :3, -1, :3]
        ).mean()
        for noise_model in (base, known)
    )
    assert after < 1.2 < 2.5 < before


def test_one_axis_or_a_short_record_has_no_score():
    single = baseline(axes="x")
    assert (
        find_statistic("common_mode").score(records(single, 2, np.random.default_rng(1)), single)
        is None
    )
    blocks = _records_of_means(baseline(), 2, 1)
    assert (
        find_statistic("common_mode").score(
            blocks.isel(block=slice(0, 4)), baseline().isel(block=slice(0, 4))
        )
        is None
    )
    assert find_statistic("common_mode").score(blocks, baseline())["tau_min_s"].values.tolist() == [
        BLOCK_S * span for span in (1, 2, 4, 8, 16, 32)
    ]


def _identification_of(statistic: str, axes: str):
    variant = Variant({}, ("0",), np.broadcast_to(_slow_waveform(), (1, 1, BLOCKS)))
    components = tuple(
        Component(
            Candidate("cause", find_statistic(statistic), (), (variant,)), variant, (axis,), 10.0
        )
        for axis in axes
    )
    return SimpleNamespace(effect="cause", axes=tuple(axes), components=components)


def test_common_motion_is_one_region_explained_by_its_effect(base, null):
    shares = np.array([1.0, 0.8, -0.9])
    blocks = _with_waveform(records(baseline(walk=TRUE), 1, np.random.default_rng(5)), shares).isel(
        record=0
    )
    regions = locate_mismatches(blocks, base, null)
    assert [(region["view"], region["quantity"]) for region in regions] == [("cross_axis", "slow")]
    assert set(regions[0]["axes"].split()) == {"x", "y", "z"}
    message = mismatch_statement(regions[0] | {"axes": ["x", "y", "z"]}, BLOCKS * BLOCK_S)
    assert message.startswith("Axes x, y and z drift together (correlation 0.")
    assert "random walks of independent gyros" in message
    known = base.assign(known_mean=(("axis", "block"), shares[:, None] * _slow_waveform()))

    def explanation_of(statistic, axes, after):
        return attribute_mismatches(
            regions, [_identification_of(statistic, axes)], blocks, after, null, level=0.005
        )[0]

    assert explanation_of("mean", "xyz", known) == ["cause"]
    assert explanation_of("mean", "xyz", base) == []  # in the model, but leaves the mismatch
    assert explanation_of("wandering_bias", "xyz", base) == [
        "cause"
    ]  # its covariance is in no model
    assert explanation_of("wandering_bias", "x", base) == []


def test_common_motion_is_separate_from_common_noise_within_blocks():
    slow = {
        "statistic": "common_mode",
        "view": "cross_axis",
        "axes": "x y z",
        "quantity": "slow",
        "begin": 0.0,
        "end": 3600.0,
        "tau_min_s": 20.0,
        "tau_max_s": 1800.0,
    }
    slow |= {"frequency": float("nan"), "sign": 1, "z": 9.0, "p_value": 1e-6}
    fast = slow | {"quantity": "all in phase", "tau_min_s": 0.01, "tau_max_s": 20.0}
    assert [region["quantity"] for region in merge_regions([slow, fast])] == [
        "slow",
        "all in phase",
    ]
    assert len(merge_regions([slow, slow | {"axes": "x y", "tau_min_s": 40.0}])) == 1

"""Scores of the statistics: normal without an effect, with the detection limits of theory."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.nulls.scores import null_scores, standardise
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics import allan_surface as davar
from gyrostab.diagnose.statistics import cross_spectrum as cross_axis
from gyrostab.diagnose.statistics import find_statistic, mean
from gyrostab.diagnose.statistics.restart import _restart_blocks
from gyrostab.diagnose.statistics.scores import (
    cube_root_score,
    exponential_score,
    moving_sum,
    sum_over_windows,
    window_set,
)
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.regression.boxcars import (
    boxcar_information,
    filter_gains,
    precision_times,
    remaining_information,
)
from gyrostab.noise import LAWS
from tests.support.reduced_records import BLOCK_S, RATE, baseline, chunks, records

LEVEL = 3600.0 * 0.003**2  # of white noise, (deg/h)^2/Hz
EVENT = slice(83, 98)  # 15 blocks that no window of 15 blocks matches


@pytest.fixture(scope="module")
def base() -> xr.Dataset:
    return baseline()


@pytest.fixture(scope="module")
def null(base):
    return null_scores(base, chunks(base, 200, np.random.default_rng(11)))


def _dense_covariance(variance, present, walk, ou, decay):
    """Return the covariance of the observations as a dense matrix."""
    p = decay.shape[1]
    since = np.concatenate([[0.0], np.cumsum(walk[:-1])])
    dense = np.minimum.outer(since, since) + np.diag(variance)
    for i in range(p):
        decays = np.concatenate([[0.0], np.cumsum(np.log(decay[:-1, i]))])
        dense += ou[i] * np.exp(-np.abs(np.subtract.outer(decays, decays)))
    return dense[np.ix_(present, present)]


@pytest.mark.parametrize("span", [1, 4, 5, 20])
def test_moving_sums_have_fewer_places_at_the_ends(span):
    values = np.random.default_rng(2).integers(0, 2, (2, 9)).astype(bool)
    expected = [
        [row[max(place - span // 2, 0) : place - span // 2 + span].sum() for place in range(9)]
        for row in values
    ]
    np.testing.assert_array_equal(moving_sum(values, span), expected)


@pytest.mark.parametrize("angle", [0.0, 4.0])
def test_boxcar_kernels_match_dense_algebra(angle):
    rng = np.random.default_rng(5)
    n, p = 60, 3
    variance, walk, ou = (
        rng.uniform(0.5, 2.0, n),
        rng.uniform(0.0, 0.3, n),
        rng.uniform(0.1, 1.0, p),
    )
    decay = np.exp(-rng.uniform(0.5, 1.5, (n, 1)) / np.array([1.0, 5.0, 30.0]))
    present = rng.random(n) > 0.3
    # the angle at the start of a block; that at its end is also white noise of the observation
    of_states, squares = np.column_stack([np.ones(n), decay, np.zeros(n)]), np.append(ou, angle)
    shared = np.append(np.zeros(p + 1), -angle)
    innovation, gain = filter_gains(variance + angle, present, walk, squares, of_states, shared)
    noise = innovation, gain, of_states
    of_angle = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    dense = _dense_covariance(variance, present, walk, ou, decay)
    inverse = np.linalg.inv(dense + angle * of_angle[np.ix_(present, present)])
    series = rng.normal(size=(2, n))
    out = precision_times(series, *noise)
    np.testing.assert_allclose(out[:, present], series[:, present] @ inverse, rtol=1e-9)
    assert not out[:, ~present].any()
    first, stop = np.array([0, 7, 30, 59]), np.array([60, 20, 31, 60])
    information = boxcar_information(first, stop, *noise, remaining_information(*noise))
    for region in range(4):
        x = ((np.arange(n) >= first[region]) & (np.arange(n) < stop[region]))[present].astype(float)
        assert information[region] == pytest.approx(x @ inverse @ x, rel=1e-9)


@given(st.integers(1, 80), st.lists(st.integers(1, 30), min_size=1, max_size=4, unique=True))
def test_sums_over_windows_match_their_definition(block_count, lengths):
    windows = window_set(block_count, lengths)
    values = np.random.default_rng(block_count).normal(size=(2, block_count, 3))
    sums = sum_over_windows(values, windows)
    for k, (first, stop) in enumerate(zip(windows.first, windows.stop, strict=True)):
        assert 0 <= first < stop <= block_count
        np.testing.assert_allclose(sums[:, k], values[:, first:stop].sum(axis=1), atol=1e-12)
    assert (windows.length == block_count).any()


def test_transfer_reproduces_the_laws_of_the_allan_variance():
    edges = np.geomspace(1e-5, RATE / 2, 4000)
    middle = np.sqrt(edges[1:] * edges[:-1])
    tau = np.array([0.01, 0.02, 0.16, 1.28])
    weights = davar.allan_transfer(edges[:-1], edges[1:], tau, RATE)
    white = weights @ np.full(middle.size, LEVEL)
    np.testing.assert_allclose(white, LAWS["N"].avar(tau, 0.003), rtol=2e-4)
    walk = weights @ (0.02**2 / 3600.0 / (2 * np.pi * middle) ** 2)
    np.testing.assert_allclose(
        walk[-1], LAWS["K"].avar(tau[-1], 0.02), rtol=0.02
    )  # a sampled walk, so long tau only


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("slow", [{}, {"flicker": 0.01, "walk": 0.1}])
def test_scores_are_normal_without_an_effect(missing, slow):
    base = baseline(missing=missing, **slow)
    blocks = records(base, 40, np.random.default_rng(3), missing=missing)
    for name in ("power", "mean", "cross_spectrum", "spectral_line"):
        scores = find_statistic(name).score(blocks, base)
        z = scores["z"].values
        z = z[np.isfinite(z)]
        assert abs(z.mean()) < 0.05, name
        assert 0.93 < z.std() < 1.04, name
        share = np.mean(np.abs(z) > 3.0)
        assert 0.4 < share / (2 * stats.norm.sf(3.0)) < 2.0, name


def _detection_share(scores, null, name, level=0.01):
    z = np.nan_to_num(np.abs(standardise(scores, null.statistics[name])))
    return float((z.max(axis=(1, 2, 3)) > null.critical(name, level)).mean())


def _shares_around_limit(make, limit, name, base, null):
    """Return the share of records detected at 3/4 and at 5/4 of the theoretical limit."""
    shares = []
    for factor in (0.75, 1.25):
        blocks = records(base, 60, np.random.default_rng(17))
        make(blocks, factor * limit)
        shares.append(_detection_share(find_statistic(name).score(blocks, base), null, name))
    return shares


@pytest.mark.slow
def test_detection_limit_of_raised_noise(base, null):
    def burst(blocks, epsilon):
        blocks["power"][:, 0, EVENT] *= 1.0 + epsilon

    samples = 0.86 * 15 * BLOCK_S * RATE  # effective number under the taper
    nats = null.critical("power", 0.01) ** 2 / 2.0
    below, above = _shares_around_limit(burst, 2.0 * np.sqrt(nats / samples), "power", base, null)
    assert below < 0.5 < above


@pytest.mark.slow
def test_detection_limit_of_a_mean_step(base, null):
    def step(blocks, height):
        blocks["mean"][:, 0, EVENT] += height

    nats = null.critical("mean", 0.01) ** 2 / 2.0
    on, record = 15 * BLOCK_S, 180 * BLOCK_S
    limit = np.sqrt(LEVEL) * np.sqrt(2.0 * nats / (on * (1.0 - on / record)))
    below, above = _shares_around_limit(step, limit, "mean", base, null)
    assert below < 0.5 < above


@pytest.mark.slow
def test_detection_limit_of_shared_noise(base, null):
    def shared(blocks, rho):
        power, pairs = blocks["power"].values, ((0, 1), (0, 2), (1, 2))
        for place, (a, b) in enumerate(pairs):
            blocks["cross"].values[:, place] += rho * np.sqrt(power[:, a] * power[:, b])

    nats = null.critical("cross_spectrum", 0.01) ** 2 / 2.0
    limit = np.sqrt(2.0 * nats / (0.86 * 180 * BLOCK_S * RATE) / 3.0)  # three equal pairs
    below, above = _shares_around_limit(shared, limit, "cross_spectrum", base, null)
    assert below < 0.5 < above


@pytest.mark.full
def test_detection_limit_of_a_line(base, null):
    def line(blocks, amplitude):
        signal, rng = amplitude**2 / 4.0 * 0.926 * BLOCK_S, np.random.default_rng(2)
        parts = blocks.sizes["part"]
        shape = (blocks.sizes["record"], parts, blocks.sizes["block"] // parts)
        sine = np.sqrt(signal) * np.exp(2j * np.pi * rng.random(shape))
        noise = np.sqrt(LEVEL / 2.0) * (
            rng.normal(size=sine.shape) + 1j * rng.normal(size=sine.shape)
        )
        blocks["line_power"][:, 1, :, 267] = (np.abs(sine + noise) ** 2).mean(axis=-1)

    limit = 2.0 * np.sqrt(
        null.critical("spectral_line", 0.01) * LEVEL / (0.926 * BLOCK_S * np.sqrt(180))
    )
    below, above = _shares_around_limit(line, limit, "spectral_line", base, null)
    assert below < 0.5 < above


def test_the_mean_shows_a_step_between_windows_that_davar_does_not(base, null):
    blocks = records(base, 40, np.random.default_rng(4))
    blocks["mean"][:, 0, 60:120] += 0.06
    assert _detection_share(find_statistic("mean").score(blocks, base), null, "mean") > 0.9
    scores = find_statistic("power").score(blocks, base)
    scores["z"] = scores["z"].where(
        scores["stop"] - scores["first"] <= 15
    )  # the whole record shows it at its longest tau
    assert _detection_share(scores, null, "power") < 0.1


def test_a_step_raises_the_allan_variance_by_the_closed_form():
    base = baseline(noise=1e-6)
    blocks = records(base, 1, np.random.default_rng(4)).isel(record=0)
    height, block_count = 0.1, 180
    blocks["mean"][0, 90:] += height
    surface = davar.allan_surface(blocks, base)
    whole = surface["windows"].length == block_count
    for column, tau in enumerate(surface["columns"]["tau_min_s"]):
        if tau >= 4 * BLOCK_S and surface["columns"]["quantity"][column] == "avar":
            # D^2 tau / (3 (W - 2 tau)), its sum over whole blocks
            expected = height**2 * tau / (3.0 * (block_count * BLOCK_S - 2.0 * tau))
            assert surface["observed"][0, whole, column] == pytest.approx(expected, rel=0.05)


def test_the_mean_estimates_the_step(base):
    blocks = records(base, 1, np.random.default_rng(8)).isel(record=0)
    blocks["mean"][2, 60:105] += 0.5
    scores = find_statistic("mean").score(blocks, base)
    best = int(np.nanargmax(scores["z"].values[2, :, 0]))
    assert (int(scores["first"][best]), int(scores["stop"][best])) == (60, 105) or abs(
        int(scores["first"][best]) - 60
    ) <= 4
    inside = (np.arange(180) >= 60) & (np.arange(180) < 105)
    assert mean.region_mean(blocks, base, 2, inside) == pytest.approx(0.5, abs=0.03)


def test_a_line_estimates_its_amplitude():
    from gyrostab.diagnose.reduce.block_statistics import reduce_log
    from gyrostab.ingest.make_log import make_log

    rng, n = np.random.default_rng(6), 180_000
    rate = 1.8 * rng.standard_normal((1, n)) + 0.3 * np.sin(2 * np.pi * 13.37 * np.arange(n) / RATE)
    blocks = reduce_log(make_log(rate, rate=RATE, unit="deg/h"))
    flat = xr.Dataset(
        {"spectrum": (("axis", "block", "band"), np.full(blocks["power"].shape, LEVEL))},
        coords={"axis": blocks["axis"], "frequency": blocks["frequency"]},
    )
    scores = find_statistic("spectral_line").score(blocks, flat)
    best = int(np.nanargmax(scores["z"].values[0, -1]))
    assert float(scores["frequency"][best]) == pytest.approx(13.37, abs=0.06)
    assert float(scores["estimate"][0, -1, best]) == pytest.approx(0.3, rel=0.1)


def test_phase_locked_rates_are_detected(base):
    rng = np.random.default_rng(9)
    blocks = records(base, 1, rng).isel(record=0)
    assert find_statistic("ramp_phase").score(blocks, base) is None
    block_count, samples = 180, BLOCK_S * RATE
    spread = np.sqrt(2.0 * LEVEL * RATE / samples)
    order = spread * (
        rng.normal(size=(40, 3, block_count, 3)) + 1j * rng.normal(size=(40, 3, block_count, 3))
    )
    profile = np.sqrt(LEVEL * RATE / 50.0) * rng.normal(size=(40, 3, block_count, 40))
    blocks["order"] = (("record", "axis", "block", "harmonic"), order)
    blocks["order_samples"] = (("axis", "block", "harmonic"), np.full(order.shape[1:], samples))
    blocks["profile"] = (("record", "axis", "block", "phase"), profile)
    blocks["profile_samples"] = (("axis", "block", "phase"), np.full((3, block_count, 40), 50))
    blocks["channel_rotation_rate"] = ("block", np.full(block_count, 720.0))
    scores = find_statistic("ramp_phase").score(blocks, base)
    z = scores["z"].values
    assert scores["quantity"].values.tolist() == ["order 1", "order 2", "order 3", "ramp phase"]
    assert np.allclose(z.std(axis=(0, 1, 2)), 1.0, atol=0.1)
    assert np.all(z.mean(axis=(0, 1, 2)) < 0.15)
    blocks["order"][:, 0, :, 1] += 0.05 * np.exp(0.4j)
    blocks["profile"] = blocks["profile"] + xr.DataArray(
        0.1 * np.sin(2 * np.pi * np.arange(40) / 40), dims="phase"
    )
    scores = find_statistic("ramp_phase").score(blocks, base)
    assert np.median(scores["estimate"].values[:, 0, -1, 1]) == pytest.approx(0.05, rel=0.1)
    assert np.median(scores["estimate"].values[:, 1, -1, 3]) == pytest.approx(
        0.1 / np.sqrt(2.0), rel=0.1
    )
    assert (scores["z"].values[:, 0, -1, 1] > 5.0).mean() > 0.95


def test_transients_and_jumps_after_restarts_are_detected(base):
    blocks = records(base, 240, np.random.default_rng(10))
    assert find_statistic("restart").score(blocks, base) is None
    restarts = {"restart_begin": [1000.0, 2400.0], "restart_end": [1010.0, 2410.0]}
    blocks = blocks.drop_dims("restart").assign(
        {name: ("restart", times) for name, times in restarts.items()}
    )
    z = find_statistic("restart").score(blocks, base)["z"].values
    assert np.nanstd(z) == pytest.approx(1.0, abs=0.06)
    since = np.where(
        np.arange(180) >= 120,
        np.arange(180) - 120.0,
        np.where(np.arange(180) >= 50, np.arange(180) - 50.0, np.inf),
    )
    raised = blocks.copy()
    raised["mean"] = blocks["mean"] + xr.DataArray(0.2 * np.exp(-since / 6.0), dims="block")
    scores = find_statistic("restart").score(raised, base)
    assert float(np.nanmean(scores["estimate"].values[..., 1, 1])) == pytest.approx(0.2, rel=0.05)
    jumped = blocks.copy()
    jumped["mean"][:, :, 120:] += 0.1
    scores = find_statistic("restart").score(jumped, base)
    jump = scores["estimate"].values[:, :, -1, -1]
    assert np.mean(jump) == pytest.approx(0.1, rel=0.05)
    assert int(scores["first"][-1]) == 120


def test_sample_counts_and_tails_are_detected(base):
    blocks = records(base, 2, np.random.default_rng(12))
    blocks["outliers"][:] = 0
    blocks["outliers"][1, 0, 40:43] = 2
    blocks["kurtosis"][1, 2, 90:120] += 0.5
    scores = find_statistic("sample_counts").score(blocks, base)
    of = scores["quantity"].values.tolist().index
    z = scores["z"].values
    short = scores["stop"].values - scores["first"].values == 5
    best = int(np.argmax(np.where(short, z[1, 0, :, of("outliers")], -1.0)))
    assert scores["first"].values[best] <= 40
    assert scores["stop"].values[best] >= 43
    assert z[1, 2, :, of("kurtosis")].max() > 8.0
    assert z[0, :, :, of("kurtosis")].max() < 6.0


@given(st.floats(4.0, 500.0))
def test_cube_root_score_is_the_normal_quantile_of_a_gamma(shape):
    for p in (0.01, 0.3, 0.7, 0.99):
        ratio = stats.gamma.ppf(p, shape) / shape
        assert float(cube_root_score(np.array(ratio), np.array(shape))) == pytest.approx(
            stats.norm.ppf(p), abs=0.08
        )


@given(st.floats(1e-6, 600.0))
def test_exponential_score_is_exact(value):
    z = float(exponential_score(np.array(value)))
    assert stats.norm.logsf(z) == pytest.approx(-value, rel=1e-6)


def test_correlation_score_matches_student():
    r, n = np.array([0.3, 0.6]), 20.0
    t = r * np.sqrt((n - 1) / (1 - r**2))
    np.testing.assert_allclose(
        cross_axis.correlation_score(r, np.full(2, n)),
        stats.norm.isf(stats.t.sf(t, n - 1)),
        rtol=2e-3,
    )


def test_one_axis_has_no_pairs():
    base = baseline(axes="x")
    blocks = records(base, 2, np.random.default_rng(1))
    assert find_statistic("cross_spectrum").score(blocks, base) is None


@pytest.mark.parametrize("loud", [(6_050, 12_000), (6_050, 6_540)])
def test_a_noise_burst_is_neither_shared_nor_a_line(loud):
    largest: dict[str, list[float]] = {"cross_spectrum": [], "spectral_line": []}
    for seed in range(8):
        noise = np.random.default_rng(seed).standard_normal((2, 12_000))
        noise[:, slice(*loud)] *= 8.0
        blocks = reduce_log(
            make_log(noise, rate=10.0, unit="deg/h", axis=["x", "y"]), block="100samples"
        )
        base = calibrate_noise(blocks, quiet=(0.0, float(blocks["end"][59])))
        for name, values in largest.items():
            values.append(
                float(np.nanmax(np.abs(find_statistic(name).score(blocks, base)["z"].values)))
            )
    assert max(largest["cross_spectrum"]) < 4.8
    assert max(largest["spectral_line"]) < 4.8


def test_the_first_block_after_a_restart_is_that_with_most_samples_after_it():
    times = {"begin": ("block", np.arange(5) * 20.0), "end": ("block", np.arange(5) * 20.0 + 20.0)}
    for lost, back, first in ((25.0, 42.0, 2), (25.0, 58.0, 2), (43.0, 59.0, 3), (44.0, 46.0, 2)):
        restart = {"restart_begin": ("restart", [lost]), "restart_end": ("restart", [back])}
        assert _restart_blocks(xr.Dataset({**times, **restart})).tolist() == [first]

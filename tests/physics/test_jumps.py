"""Jumps, random rates and supply against their closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kurtosis

from gyrostab.allan.davar import davar
from gyrostab.errors import OptionError
from gyrostab.physics.base import Windows
from gyrostab.physics.jumps import step_means
from gyrostab.physics.registry import make_effect
from gyrostab.simulate import simulate
from tests.support.effect_bench import avar, build_effect, markov_avar, run, windows_of


@given(st.lists(st.floats(0.0, 20.0), max_size=12), st.integers(0, 12))
def test_means_of_steps_are_integrals(positions, cut):
    positions = sorted(positions)
    levels = np.random.default_rng(3).normal(size=(len(positions) + 1, 2))
    means = np.concatenate(
        [step_means(positions, levels, 0, cut), step_means(positions, levels, cut, 20 - cut)],
        axis=1,
    )
    edges = np.array([0.0, *positions, 30.0])
    for i in range(20):
        inside = np.clip(np.minimum(edges[1:], i + 1) - np.maximum(edges[:-1], i), 0.0, None)
        np.testing.assert_allclose(means[:, i], inside @ levels, atol=1e-12)


@pytest.mark.parametrize("at", [1e300, np.inf])
def test_a_step_after_all_logs_changes_nothing(at):
    with np.errstate(all="raise"):
        jump = run(build_effect("bias_jump", step=1.0, at=at), size=100)
    np.testing.assert_array_equal(jump, np.zeros((3, 100)))


def test_jump_has_the_allan_variance_of_a_step():
    effect = {"name": "bias_jump", "step": 0.1, "at": 300, "axes": ["x"]}
    log = simulate({"effect": [effect]}, duration="600s", rate=10)
    surface = davar(log, window="200s", step="50s", taus=[1.0, 5.0, 20.0]).sel(axis="x")
    tau, length = surface.tau.values, 200.0
    across = surface.isel(time=slice(3, 6)).avar.values  # 150..350, 200..400, 250..450
    np.testing.assert_allclose(
        across, np.tile(0.01 * tau / (3 * (length - 2 * tau)), (3, 1)), rtol=0.02
    )
    np.testing.assert_allclose(
        np.sqrt(3 * across[1, 0] / tau[0] * 3600), 0.1 / math.sqrt(length / 3600), rtol=0.02
    )
    assert surface.isel(time=slice(0, 3)).avar.values.max() < 1e-30
    np.testing.assert_allclose(surface.window_mean.values[[0, 4, -1]], [0.0, 0.05, 0.1], atol=1e-12)
    prediction = make_effect(effect).explain(
        Windows(np.array([0.0, 200, 400]), np.array([200.0, 400, 600]), np.ones(1), 10.0, ("x",))
    )
    np.testing.assert_allclose(prediction.mean["step"], [0.0, 0.5, 1.0])


def test_jumps_come_at_restarts_and_shocks_only():
    restarts = np.arange(1, 1000)[:, None] * 10 + np.array([0, 3])
    rates = run(
        build_effect("bias_jump", restart=0.2),
        size=10_000,
        restarts=restarts,
        gaps=restarts,
    )
    jumps = np.diff(rates, axis=1)
    assert set(np.unique(np.nonzero(jumps)[1] + 1)) == set(restarts[:, 1].tolist())
    sizes = jumps[:, restarts[:, 1] - 1]
    assert sizes.std() == pytest.approx(0.2, rel=0.04)
    assert abs(np.corrcoef(sizes)[0, 1]) < 0.12
    shocks = run(
        build_effect("bias_jump", shock=0.5, shocks_per_hour=3600),
        size=20_000,
        rate=50.0,
    )
    moved = np.diff(shocks, axis=1)
    times = np.flatnonzero(moved[0])
    # a jump inside of a sample shows in two differences
    assert times.size == pytest.approx(2 * 400, rel=0.1)
    np.testing.assert_array_equal(times, np.flatnonzero(moved[1]))
    assert np.square(shocks[:, -1]).sum() > 0
    assert (
        build_effect("bias_jump", shock=0.5, shocks_per_hour=3)
        .say()
        .endswith("by 0.5 deg/h rms at shocks, 3 per hour.")
    )


def test_gauss_markov_has_the_allan_variance_of_the_standard():
    effect = build_effect("gauss_markov", rms=[0.05, 0.1, 0.0], correlation_time=20)
    rates = run(effect, size=400_000, rate=5.0)
    taus = np.array([0.2, 2.0, 10.0, 37.8, 100.0])
    variance = avar(rates, 5.0, taus)
    for row, rms in ((0, 0.05), (1, 0.1)):
        np.testing.assert_allclose(variance[row], markov_avar(taus, rms, 20.0), rtol=0.06)
        assert rates[row].std() == pytest.approx(rms, rel=0.04)
    assert not rates[2].any()


def test_telegraph_equals_gauss_markov_to_second_order_with_two_levels():
    effect = build_effect("telegraph", step=0.2, low=60, high=30)
    rates = run(effect, size=400_000, rate=5.0)
    assert effect.correlation_time == pytest.approx(20.0)
    share = 1 / 3
    assert (rates > 0.1).mean() == pytest.approx(share, abs=0.012)
    assert np.isin(rates, [0.0, 0.2]).mean() > 0.99
    assert rates.min() >= 0.0
    assert rates.max() <= 0.2
    switches = np.abs(np.diff(rates > 0.1, axis=1)).sum()
    assert switches == pytest.approx(3 * 2 * 80_000 / 90, rel=0.05)
    taus = np.array([0.2, 2.0, 10.0, 37.8, 100.0])
    expected = markov_avar(taus, 0.2 * math.sqrt(share * (1 - share)), 20.0)
    np.testing.assert_allclose(avar(rates, 5.0, taus).mean(axis=0), expected, rtol=0.06)
    assert kurtosis(rates, axis=1).mean() == pytest.approx(1 / (share * (1 - share)) - 6, abs=0.15)
    assert abs(np.corrcoef(rates)[0, 1]) < 0.1


def test_fringe_step_has_its_size_and_ends_at_the_return_of_power():
    table = {
        "name": "fringe_hop",
        "length": 500,
        "diameter": 0.04,
        "wavelength": 1550,
        "axes": ["z"],
    }
    fringe = 1550e-9 * 299_792_458 / (500 * 0.04) * math.degrees(1) * 3600
    assert fringe / 3600 == pytest.approx(1332, rel=1e-3)
    once = make_effect(table | {"order": -2, "at": 30.05})
    rates = run(once, size=1000, signal=7.0, restarts=np.array([[600, 620]]))[0]
    np.testing.assert_allclose(
        rates[[0, 299, 301, 619, 620, 999]],
        7 - 2 * fringe * np.array([0, 0, 1, 1, 0, 0]),
        rtol=1e-12,
    )
    without_power = make_effect(table | {"at": 61.05})
    assert not run(without_power, size=1000, restarts=np.array([[600, 620]]))[0, 620:].any()
    assert rates[300] == pytest.approx(7 - fringe, rel=1e-9)  # half of this sample
    back = make_effect(table | {"at": 10, "hold": 20}).explain(windows_of(1000, 10.0, 10.0))
    np.testing.assert_allclose(back.mean["order"][:5], fringe * np.array([0, 1, 1, 0, 0]))
    many = (
        run(make_effect(table | {"per_hour": 3600, "hold": 1}), size=100_000, rate=50.0)[0] / fringe
    )
    whole = np.abs(many - np.round(many)) < 1e-9
    assert set(np.unique(np.round(many[whole]))) == {-1.0, 0.0, 1.0}
    assert whole.mean() > 0.95
    assert np.abs(many).mean() == pytest.approx(0.5, abs=0.03)  # up for a second, down for a second
    assert (many > 0.5).mean() == pytest.approx((many < -0.5).mean(), abs=0.05)
    with pytest.raises(OptionError, match=r"1\.5 is not a whole number of fringes"):
        make_effect(table | {"order": 1.5})


def test_supply_bias_follows_both_channels_and_ripple_folds():
    effect = build_effect("supply_bias", voltage=0.02, power=-0.003, axes=["x"])
    assert effect.needs() == ("supply_voltage", "light_power")
    bias = run(
        effect, size=2, drivers={"supply_voltage": [25.0, 20.0], "light_power": [110e-6, 100e-6]}
    )
    np.testing.assert_allclose(bias, [[0.02 - 0.03, -0.08]], rtol=1e-9)
    ripple = build_effect("supply_bias", ripple=0.4, frequency=63.0)
    assert ripple.needs() == ()
    rates = run(ripple, size=2000, rate=50.0)[0]
    spectrum = np.abs(np.fft.rfft(rates)) / 1000
    assert np.fft.rfftfreq(2000, 1 / 50)[spectrum.argmax()] == pytest.approx(13.0)
    assert spectrum.max() == pytest.approx(0.4 * abs(np.sinc(63 / 50)), rel=1e-6)


def slow_supply(lag):
    return build_effect(
        "supply_bias", voltage=0.02, power=-0.003, lag=lag, reference_power=0.0, axes=["x"]
    )


def test_a_slow_supply_settles_after_a_step_and_trails_a_ramp():
    """A step D gives ``D (1 - exp(-t / lag))``, a ramp v t ``v (t - lag (1 - exp(-t / lag)))``."""
    t = (np.arange(8000) - 1000) / 20.0
    power = 1e-4 + 2e-8 * np.maximum(t, 0.0)
    bias = run(
        slow_supply(30.0),
        size=t.size,
        rate=20.0,
        drivers={"supply_voltage": np.where(t > 0, 21.0, 24.0), "light_power": power},
    )
    settled = -np.expm1(-np.maximum(t, 0.0) / 30.0)
    ramp = 100.0 + 0.02 * (np.maximum(t, 0.0) - 30.0 * settled)
    np.testing.assert_allclose(bias[0], 0.02 * -3.0 * settled - 0.003 * ramp, atol=0.002 * 0.06)


@pytest.mark.parametrize("lag", [3.0, 20.0, 100.0, 2000.0])
def test_means_of_a_slow_supply_match_the_prediction(lag):
    """Loads are switched inside of 20 s windows: parts of windows show the settling."""
    t = np.arange(30_000) / 20.0
    drivers = {
        "supply_voltage": 24.0 - 2.0 * ((t > 305.0) & (t < 707.5)),
        "light_power": 1e-4 * np.exp(-t / 900.0),
    }
    bias_means = (
        run(slow_supply(lag), size=t.size, rate=20.0, drivers=drivers)[0]
        .reshape(-1, 400)
        .mean(axis=1)
    )
    means = {name: values.reshape(-1, 400).mean(axis=1) for name, values in drivers.items()}
    blunt = windows_of(30_000, 20.0, 20.0, axes=("x",), drivers=means)
    sharp = replace(
        blunt,
        fine={name: values.reshape(75, 8, 50).mean(axis=2) for name, values in drivers.items()},
    )
    off = []
    for windows in (blunt, sharp):
        prediction = slow_supply(lag).explain(windows).mean
        off.append(
            np.abs(0.02 * prediction["voltage"] - 0.003 * prediction["power"] - bias_means)[
                1:
            ].max()
        )
    assert off[1] < 0.04 * np.ptp(bias_means)
    assert off[1] < 0.5 * off[0]


def test_a_supply_without_lag_is_the_limit_of_short_ones():
    """Without a lag the means are those of the channel itself, however it is interpolated."""
    means = {"supply_voltage": np.array([24.0, 22.0, 23.0, 23.5])}
    windows = windows_of(800, 10.0, 20.0, axes=("x",), drivers=means)
    at_once, soon = (slow_supply(lag).explain(windows).mean["voltage"] for lag in (0.0, 1e-6))
    np.testing.assert_array_equal(at_once, means["supply_voltage"] - 24.0)
    line = (
        np.interp(np.arange(0.5, 80.0), windows.centre, means["supply_voltage"])
        .reshape(4, 20)
        .mean(axis=1)
        - 24.0
    )
    np.testing.assert_allclose(soon[1:3], line[1:3], atol=1e-5)


def test_a_slow_supply_says_its_lag():
    sentence = build_effect("supply_bias", voltage=0.02, lag=40.0).say({"lag": 5.0})
    assert (
        sentence == "The bias follows the supply on all axes, by 0.02 deg/h/V of voltage, "
        "with a lag of 40 ± 5 s."
    )

"""Effects of temperature, warm-up and age on the bias against their closed forms."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.linalg import solve_banded

from gyrostab.allan.davar import davar
from gyrostab.errors import OptionError
from gyrostab.kernels.thermal import apply_dead_band, mean_dead_band_distance, slab
from gyrostab.noise import LAWS
from gyrostab.physics.registry import effects, make_effect
from gyrostab.simulate import environment as env
from gyrostab.simulate import simulate
from tests.support.effect_bench import avar, build_effect, run

HOUR = 3600.0


def ramp_record(rate, *, begin, end, total, speed):
    """Make a temperature that rises with `speed` [degC/min] from `begin` to `end` [s]."""
    t = np.arange(round(total * rate)) / rate
    return 20.0 + speed / 60.0 * (np.clip(t, begin, end) - begin)


# --------------------------------------------------------------------------------
# diffusion


def heated_slab(surface, dt, lag, cells=200):
    """Compute the means of both halves of a slab under `surface` by Crank-Nicolson."""
    kappa = 4.0 / (math.pi**2 * lag)  # in thicknesses^2 per second
    r = kappa * dt * cells**2
    main = np.full(cells, -2.0)
    main[0], main[-1] = -1.0, -3.0  # the face lies half a cell beyond the last centre
    left = np.zeros((3, cells))
    left[0, 1:], left[1], left[2, :-1] = -r / 2, 1.0 - r / 2 * main, -r / 2
    state = np.full(cells, surface[0])
    out = []
    for before, after in itertools.pairwise(surface):
        laplace = main * state
        laplace[1:] += state[:-1]
        laplace[:-1] += state[1:]
        right = state + r / 2 * laplace
        right[-1] += r / 2 * 2.0 * (before + after)
        state = solve_banded((1, 1), left, right)
        out.append((state[cells // 2 :].mean(), state[: cells // 2].mean()))
    return np.array([out[0], *out]).T


def test_shupe_matches_heat_conduction_through_a_winding():
    rate, lag = 1.0, 265.0
    surface = ramp_record(rate, begin=100, end=1300, total=2500, speed=1.5)
    outer, inner = heated_slab(surface, 1.0 / rate, lag)
    truth = 0.2 * np.gradient((outer + inner) / 2) * 60 + 0.3 * np.gradient(outer - inner) * 60
    effect = build_effect("shupe", sensitivity=0.2, transient=0.3, modes=12)
    bias = run(effect, size=surface.size, rate=rate, drivers={"temperature": surface})[1]
    away = np.min([np.abs(np.arange(2500) - edge) for edge in (100, 1300)], axis=0) > 5
    np.testing.assert_allclose(bias[away], truth[away], atol=0.004)
    assert abs(truth).max() > 0.25
    # the plateau, where the halves climb alike
    assert bias[1290] == pytest.approx(0.2 * 1.5, rel=0.03)
    late = bias[1700:2300]  # only the slowest mode is left
    assert -1.0 / np.polyfit(np.arange(late.size), np.log(abs(late)), 1)[0] == pytest.approx(
        lag, rel=1e-3
    )


@given(st.integers(2, 30), st.floats(1.0, 1e4))
def test_modes_of_a_winding_share_all_of_the_ramp(count, lag):
    times, whole, halves = slab(lag, count)
    assert whole.sum() == pytest.approx(1.0, abs=1e-12)
    assert halves.sum() == pytest.approx(0.0, abs=1e-12)
    assert times[0] == lag
    assert np.all(whole > 0)


def test_lag_follows_from_thickness_and_diffusivity():
    assert 4 * 0.012**2 / (math.pi**2 * 2.2e-7) == pytest.approx(
        effects()["shupe"].example().lag, rel=2e-3
    )


def test_one_mode_of_shupe_is_a_simple_lag():
    effect = build_effect("shupe", sensitivity=0.4, modes=1, lag=60)
    for rate in (1.0, 10.0, 100.0):
        warm = ramp_record(rate, begin=50, end=250, total=400, speed=2.0)
        bias = run(effect, size=warm.size, rate=rate, drivers={"temperature": warm})[0]
        t = np.arange(warm.size) / rate
        rise = 0.8 * -np.expm1(-(np.clip(t, 50, 250) - 50) / 60)
        expected = rise * np.exp(-(np.maximum(t, 250) - 250) / 60)
        np.testing.assert_allclose(bias, expected, atol=1e-9)
        down = run(effect, size=warm.size, rate=rate, drivers={"temperature": -warm})[0]
        np.testing.assert_allclose(down, -bias, atol=1e-12)


def test_lagged_temperature_bias_equals_two_effects():
    """``y' = (T - y) / L`` equals a T and -a L of the lagged change of T."""
    t, a, lag = (np.arange(8000) - 2000) / 10.0, 0.02, 90.0
    after = np.maximum(t, 0.0)
    settled = -np.expm1(-after / lag)
    for warm, late in (
        (np.where(t > 0, 27.0, 20.0), 20.0 + 7.0 * settled),
        (20.0 + 0.03 * after, 20.0 + 0.03 * (after - lag * settled)),
    ):
        tables = (
            {"name": "temperature_bias", "sensitivity": a, "reference": 20.0},
            {"name": "shupe", "sensitivity": -a * lag / 60.0, "lag": lag, "modes": 1},
        )
        bias = sum(
            run(make_effect(table), size=t.size, drivers={"temperature": warm})[0]
            for table in tables
        )
        np.testing.assert_allclose(bias, a * (late - 20.0), atol=1e-3 * a * 7.0)


@pytest.mark.parametrize("cuts", [(), (1, 1000, 3001)])
@pytest.mark.parametrize("name", ["temperature_bias", "thermal_hysteresis"])
def test_bias_behind_a_lagging_sensor_is_that_of_the_true_temperature(name, cuts):
    """A sensor with a lag of 40 s sees a ramp up to 300 s, and down from there."""
    rate, late, v = 10.0, 40.0, 2.0
    t = np.arange(6000) / rate
    true = 20.0 + v / 60.0 * (300.0 - np.abs(t - 300.0))
    after = np.maximum(t - 300.0, 0.0)
    lags = (1.0 - np.exp(-t / late)) - 2.0 * (1.0 - np.exp(-after / late))
    reading = true - v / 60.0 * late * lags
    if name == "temperature_bias":
        table = {"sensitivity": 0.02, "quadratic": 0.001, "reference": 20.0}
        expected = 0.02 * (true - 20.0) + 0.001 * (true - 20.0) ** 2
    else:
        table = {"sensitivity": 0.02, "width": 1.5}
        follower, _ = apply_dead_band(true, 1.5, 20.0)
        expected = 0.02 * (true - follower)
    effect = make_effect({"name": name, "sensor_lag": late, **table})
    bias = run(effect, size=t.size, rate=rate, drivers={"temperature": reading}, cuts=cuts)[0]
    np.testing.assert_allclose(bias, expected, atol=4e-3 * np.ptp(expected))


def test_sensor_lag_is_corrected_on_a_ramp():
    """A sensor with a lag of 40 s sees a ramp; one mode follows the true ramp."""
    rate, lag, late, v = 10.0, 60.0, 40.0, 2.0
    t = np.arange(6000) / rate
    reading = 20.0 + v / 60.0 * (t - late * -np.expm1(-t / late))
    table = {"name": "shupe", "sensitivity": 0.4, "modes": 1, "lag": lag}
    expected = 0.4 * v * -np.expm1(-t / lag)
    bias = run(
        make_effect(table | {"sensor_lag": late}),
        size=t.size,
        rate=rate,
        drivers={"temperature": reading},
    )[0]
    np.testing.assert_allclose(bias, expected, atol=0.002 * expected.max())
    without = run(make_effect(table), size=t.size, rate=rate, drivers={"temperature": reading})[0]
    assert np.abs(without - expected).max() > 0.2 * expected.max()


def test_sensor_lag_is_corrected_on_a_step():
    """A winding of one mode reads ``D / lag exp(-t / lag)`` after a step D of its surface."""
    rate, lag, late, step = 20.0, 60.0, 40.0, 5.0
    t = np.arange(12_000) / rate
    reading = 20.0 - step * np.expm1(-np.maximum(t - 100.0, 0.0) / late)
    effect = build_effect("shupe", sensitivity=0.4, modes=1, lag=lag, sensor_lag=late)
    bias = run(effect, size=t.size, rate=rate, drivers={"temperature": reading})[0]
    expected = 0.4 * 60.0 * step / lag * np.exp(-(t - 100.0) / lag) * (t > 100.0)
    away = np.abs(t - 100.0) > 0.2
    np.testing.assert_allclose(bias[away], expected[away], atol=0.003 * expected.max())


def test_shupe_refuses_invalid_modes():
    with pytest.raises(OptionError, match=r"'modes': 2\.5 is not a whole number of modes"):
        build_effect("shupe", sensitivity=1, modes=2.5)
    with pytest.raises(OptionError, match="transient needs at least 2 modes"):
        build_effect("shupe", sensitivity=1, transient=1, modes=1)


def test_long_plateau_leaves_exactly_zero():
    effect = build_effect("shupe", sensitivity=1.0, lag=0.5)
    warm = np.concatenate([[20.0], np.full(20_000, 30.0)])
    bias = run(effect, size=warm.size, rate=10.0, drivers={"temperature": warm})[0]
    assert bias[1] > 1
    assert bias[-1] == 0.0


def test_temperature_ramp_is_a_rate_ramp_and_shupe_shifts_the_mean():
    world = [{"profile": "chamber", "low": 0, "high": 40, "speed": 2, "hold": "10 min"}]
    tables = [
        {"name": "temperature_bias", "sensitivity": 0.01, "axes": ["x"]},
        {"name": "shupe", "sensitivity": 0.1, "lag": 5, "axes": ["y"]},
    ]
    log = simulate({"environment": world, "effect": tables}, duration="60 min", rate=2)
    surface = davar(log, window="5min", step="5min", taus=[5.0, 50.0])
    ramp = 0.01 * 2 * 60  # deg/h^2
    up, down = 3, 9  # 15 to 20 min and 45 to 50 min
    for row in (up, down):
        np.testing.assert_allclose(
            surface.avar.sel(axis="x").values[row],
            LAWS["R"].avar(surface.tau.values, ramp),
            rtol=1e-6,
        )
        assert np.all(surface.avar.sel(axis="y").values[row] < 1e-12)
    np.testing.assert_allclose(
        surface.window_mean.sel(axis="y").values[[up, 7, down]], [0.2, 0.0, -0.2], atol=1e-6
    )
    np.testing.assert_allclose(
        surface.window_mean.sel(axis="x").values[[up, down]],
        0.01 * (np.array([15, 25]) - 25),
        atol=1e-3,
    )


# --------------------------------------------------------------------------------
# gradient


def test_gradient_is_the_difference_of_two_sensors_and_its_change():
    t = np.arange(6000) / 10.0
    drivers = {"temperature": 50 + t / 30, "temperature_2": 48 - t / 60}
    still = run(
        build_effect("thermal_gradient", sensitivity=-0.05),
        size=t.size,
        drivers=drivers,
    )[0]
    np.testing.assert_allclose(still, -0.05 * (2 + t / 20), rtol=1e-12)
    moving = run(
        build_effect("thermal_gradient", change=0.1, lag=20),
        size=t.size,
        drivers=drivers,
    )[2]
    np.testing.assert_allclose(moving, 0.1 * 3.0 * -np.expm1(-t / 20), atol=1e-9)  # 3 degC/min
    same = {"temperature": drivers["temperature"], "temperature_2": drivers["temperature"]}
    assert not run(effects()["thermal_gradient"].example(), size=t.size, drivers=same).any()


def test_gradient_takes_channels_of_any_name_and_is_a_ramp_while_it_builds_up():
    world = env.ramps("inside", "degC", [[0, 20], [1200, 32]], duration=1200).merge(
        env.steps("outside", "degC", [[0, 20]], duration=1200)
    )
    effect = {
        "name": "thermal_gradient",
        "sensitivity": 0.5,
        "driver": ["inside", "outside"],
        "axes": ["x"],
    }
    log = simulate(
        {"effect": [effect], "noise": {}, "log": {"rate": 10, "duration": "1200s"}},
        environment=world,
    )
    taus = np.array([1.0, 10.0, 100.0])
    slope = 0.5 * 12 / (1200 / HOUR)  # deg/h^2
    np.testing.assert_allclose(
        avar(log.rate.sel(axis="x").values, 10.0, taus)[0], LAWS["R"].avar(taus, slope), rtol=2e-3
    )


# --------------------------------------------------------------------------------
# warm-up


def test_warm_up_is_an_exponential_averaged_over_each_sample():
    effect = build_effect("warm_up", amplitude=0.3, time=7, slow_amplitude=-0.1, slow_time=50)
    bias = run(effect, size=40, rate=0.5)[1]
    for i in (0, 1, 7, 39):
        truth = (
            quad(lambda t: 0.3 * math.exp(-t / 7) - 0.1 * math.exp(-t / 50), 2 * i, 2 * i + 2)[0]
            / 2
        )
        assert bias[i] == pytest.approx(truth, rel=1e-9)


def test_warm_up_restarts_after_restarts_and_long_gaps():
    effect = build_effect("warm_up", amplitude=1.0, time=100)
    tables = {"gaps": np.array([[2000, 2100], [4000, 4600]]), "restarts": np.array([[4000, 4600]])}
    bias = run(effect, size=8000, **tables)[0]
    first = run(effect, size=4000)[0]
    np.testing.assert_array_equal(bias[:4000], first)
    np.testing.assert_allclose(bias[4600:], first[:3400], rtol=1e-12)
    every = run(replace(effect, gap=10.0), size=8000, **tables)[0]
    np.testing.assert_allclose(every[2100:4000], first[:1900], rtol=1e-12)
    longer = run(replace(effect, gap=10.1), size=8000, **tables)[0]
    np.testing.assert_array_equal(longer, bias)
    warm = run(replace(effect, cold=0.0), size=8000, **tables)[0]
    assert not warm[:4000].any()
    np.testing.assert_allclose(warm[4600:], first[:3400], rtol=1e-12)


def test_short_power_loss_restores_only_a_part():
    effect = build_effect("warm_up", amplitude=1.0, time=100, cooling=300)
    bias = run(effect, size=9000, restarts=np.array([[5000, 5600], [7000, 7030]]))[0]
    mean = -math.expm1(-1e-3) / 1e-3
    first = 1 - (1 - math.exp(-5)) * math.exp(-60 / 300)
    assert bias[5600] == pytest.approx(first * mean, rel=1e-9)
    second = 1 - (1 - first * math.exp(-140 / 100)) * math.exp(-3 / 300)
    assert bias[7030] == pytest.approx(second * mean, rel=1e-9)


def test_warm_up_looks_like_a_rate_ramp_that_fades_after_every_restart():
    world = [{"profile": "power_cuts", "cuts": [[3000, 3060]]}]
    effect = {"name": "warm_up", "amplitude": 0.3, "time": 600, "axes": ["x"]}
    log = simulate({"environment": world, "effect": [effect]}, duration="6000s", rate=2)
    surface = davar(log, window="100s", step="20s", taus=[5.0, 20.0]).sel(axis="x")
    t = np.arange(surface.sizes["time"]) * 20 + 50.0
    for begin, rows in ((0.0, (t > 0) & (t < 2900)), (3060.0, t > 3120)):
        slope = 0.3 / (600 / HOUR) * np.exp(-(t[rows] - begin) / 600)  # deg/h^2
        expected = np.stack(
            [LAWS["R"].avar(5.0, 1.0) * slope**2, LAWS["R"].avar(20.0, 1.0) * slope**2], axis=1
        )
        np.testing.assert_allclose(surface.avar.values[rows], expected, rtol=0.01)


# --------------------------------------------------------------------------------
# hysteresis


def test_hysteresis_opens_a_loop_of_known_area():
    effect = build_effect("thermal_hysteresis", sensitivity=0.002, width=4)
    way = np.concatenate([np.linspace(-40, 60, 1001), np.linspace(60, -40, 1001)[1:]])
    temperature = np.tile(way[:-1], 3)
    bias = run(effect, size=temperature.size, drivers={"temperature": temperature})[0]
    period = way.size - 1
    last_t = np.append(temperature[-period:], -40.0)
    last_b = np.append(bias[-period:], bias[-period])
    assert abs(np.trapezoid(last_b, last_t)) == pytest.approx(
        2 * 0.002 * 4 * (100 - 2 * 4), rel=1e-6
    )
    up, down = bias[500], bias[1500]
    assert (up, down) == pytest.approx((0.008, -0.008), rel=1e-9)
    assert temperature[500] == pytest.approx(temperature[1500])


def test_hysteresis_persists_on_a_plateau_where_shupe_decays():
    world = ramp_record(1.0, begin=0, end=1800, total=9000, speed=1.0)
    play_left = run(
        build_effect("thermal_hysteresis", sensitivity=0.01),
        size=9000,
        rate=1.0,
        drivers={"temperature": world},
    )
    lag_left = run(
        build_effect("shupe", sensitivity=0.03),
        size=9000,
        rate=1.0,
        drivers={"temperature": world},
    )
    assert (play_left[0, 1700], play_left[0, -1]) == pytest.approx((0.03, 0.03))
    assert lag_left[0, 1700] == pytest.approx(0.03, rel=0.01)
    assert abs(lag_left[0, -1]) < 1e-8


turns = st.lists(st.floats(-50, 100), min_size=2, max_size=8)


@given(turns, st.floats(0.1, 20.0))
def test_dead_band_is_independent_of_speed_and_forgets_overrun_reversals(values, width):
    coarse, _ = apply_dead_band(np.array(values), width, values[0])
    fine = np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(values)])
    slow, _ = apply_dead_band(fine, width, values[0])
    np.testing.assert_allclose(slow[49::50], coarse[1:], atol=1e-9)
    assert np.all(np.abs(np.array(values) - coarse) <= width + 1e-9)
    high = max(values) + 2 * width + 1  # a way up beyond all before wipes out their trace
    assert apply_dead_band(np.array([*values, high]), width, values[0])[1] == pytest.approx(
        high - width
    )


@pytest.mark.parametrize("width", [0.03, 2.5, 40.0])
def test_mean_distance_from_a_dead_band_of_any_width(width):
    times, values = np.array([0.0, 10.0, 20.0, 30.0]), np.array([0.0, 10.0, -7.0, -7.0])
    begin, end = np.array([0.0, 4.0, 20.0]), np.array([4.0, 20.0, 30.0])
    fine = np.linspace(0.0, 30.0, 300_001)
    line = np.interp(fine, times, values)
    distance = line - apply_dead_band(line, width, 0.0)[0]
    expected = [distance[(fine >= a) & (fine < b)].mean() for a, b in zip(begin, end, strict=True)]
    got = mean_dead_band_distance(times, values, begin, end, width)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-6)


# --------------------------------------------------------------------------------
# ageing


def test_a_bias_that_ages_steadily_is_a_rate_ramp():
    effect = {"name": "ageing_bias", "slope": 24.0, "axes": ["x"]}
    log = simulate({"effect": [effect]}, duration="2h", rate=1)
    taus = np.array([1.0, 60.0, 600.0])
    variance = avar(log.rate.sel(axis="x").values, 1.0, taus)[0]
    # 24 deg/h/day are 1 deg/h^2
    np.testing.assert_allclose(variance, LAWS["R"].avar(taus, 1.0), rtol=1e-6)
    assert float(log.rate.sel(axis="x")[-1]) == pytest.approx(2.0, abs=3e-4)


def test_a_bias_that_settles_is_a_logarithm():
    effect = build_effect("ageing_bias", logarithmic=0.3, time=2)
    bias = run(effect, size=361, rate=1 / 60)[0]
    np.testing.assert_allclose(
        bias[[119, 359]], 0.3 * np.log([1 + (119.5 / 60) / 2, 1 + (359.5 / 60) / 2]), rtol=1e-9
    )
    assert build_effect("ageing_bias", logarithmic=0.3, time="1 d").time == 24.0

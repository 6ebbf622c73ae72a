"""Effects of temperature, warmth, ageing, light power and vibration on bias and noise level against their closed forms."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.linalg import solve_banded

from gyrostab.davar import davar
from gyrostab.errors import OptionError, SchemaError
from gyrostab.kernels.thermal import mean_changes, play, slab
from gyrostab.log import make_log
from gyrostab.noise import LAWS
from gyrostab.physics.base import Windows
from gyrostab.physics.registry import effects, make_effect
from gyrostab.simulate import environment as env
from gyrostab.simulate import simulate

from .effect_bench import random_cuts, run, same_whatever_the_cuts

HOUR = 3600.0


def surface_of(rates, rate, *, taus, window=None, step=None):
    """Surface of some rows of plain rates; over the whole record unless a window is given."""
    log = make_log(np.atleast_2d(rates), rate=rate, unit="deg/h")
    window = log.sizes["time"] if window is None else window
    return davar(log, window=window, step=step or window, taus=[float(tau) for tau in taus], tau_max=float(max(taus)))


def avar(rates, rate, taus):
    """Allan variance of one record."""
    return surface_of(rates, rate, taus=taus).avar.isel(axis=0, time=0).values


def steady(channel, unit, value, name="steps"):
    return {"profile": name, "channel": channel, "unit": unit, "points": [[0, value]]}


def ramp_record(rate, *, begin, end, total, speed):
    """Temperature that stands, climbs by `speed` [degC/min] from `begin` to `end` [s], and stands."""
    t = np.arange(round(total * rate)) / rate
    return 20.0 + speed / 60.0 * (np.clip(t, begin, end) - begin)


# -------------------------------------------------------------------------------------------------------------------- diffusion


def heated_slab(surface, dt, lag, cells=200):
    """Means of the outer and inner half of a slab, insulated at the left, whose right face follows `surface`: Crank-Nicolson."""
    kappa = 4.0 / (math.pi**2 * lag)  # in thicknesses^2 per second
    r = kappa * dt * cells**2
    main = np.full(cells, -2.0)
    main[0], main[-1] = -1.0, -3.0  # the face lies half a cell beyond the last centre
    left = np.zeros((3, cells))
    left[0, 1:], left[1], left[2, :-1] = -r / 2, 1.0 - r / 2 * main, -r / 2
    here = np.full(cells, surface[0])
    out = []
    for before, after in itertools.pairwise(surface):
        laplace = main * here
        laplace[1:] += here[:-1]
        laplace[:-1] += here[1:]
        right = here + r / 2 * laplace
        right[-1] += r / 2 * 2.0 * (before + after)
        here = solve_banded((1, 1), left, right)
        out.append((here[cells // 2 :].mean(), here[: cells // 2].mean()))
    return np.array([out[0], *out]).T


def test_shupe_is_the_heat_that_goes_through_a_winding():
    rate, lag = 1.0, 265.0
    surface = ramp_record(rate, begin=100, end=1300, total=2500, speed=1.5)
    outer, inner = heated_slab(surface, 1.0 / rate, lag)
    truth = 0.2 * np.gradient((outer + inner) / 2) * 60 + 0.3 * np.gradient(outer - inner) * 60
    effect = make_effect({"name": "shupe", "sensitivity": 0.2, "transient": 0.3, "modes": 12})
    found = run(effect, size=surface.size, rate=rate, drivers={"temperature": surface})[1]
    away = np.min([np.abs(np.arange(2500) - edge) for edge in (100, 1300)], axis=0) > 5
    np.testing.assert_allclose(found[away], truth[away], atol=0.004)
    assert abs(truth).max() > 0.25
    assert found[1290] == pytest.approx(0.2 * 1.5, rel=0.03)  # the plateau, where the halves climb alike
    late = found[1700:2300]  # only the slowest mode is left
    assert -1.0 / np.polyfit(np.arange(late.size), np.log(abs(late)), 1)[0] == pytest.approx(lag, rel=1e-3)


@given(st.integers(2, 30), st.floats(1.0, 1e4))
@settings(max_examples=30, deadline=None)
def test_modes_of_a_winding_share_all_of_the_ramp(count, lag):
    times, whole, halves = slab(lag, count)
    assert whole.sum() == pytest.approx(1.0, abs=1e-12)
    assert halves.sum() == pytest.approx(0.0, abs=1e-12)
    assert times[0] == lag
    assert np.all(whole > 0)


def test_lag_follows_from_thickness_and_diffusivity():
    assert 4 * 0.012**2 / (math.pi**2 * 2.2e-7) == pytest.approx(effects()["shupe"].example().lag, rel=2e-3)


def test_one_mode_of_shupe_is_a_simple_lag_odd_in_direction_and_free_of_the_rate():
    effect = make_effect({"name": "shupe", "sensitivity": 0.4, "modes": 1, "lag": 60})
    for rate in (1.0, 10.0, 100.0):
        warm = ramp_record(rate, begin=50, end=250, total=400, speed=2.0)
        found = run(effect, size=warm.size, rate=rate, drivers={"temperature": warm})[0]
        t = np.arange(warm.size) / rate
        rise = 0.8 * -np.expm1(-(np.clip(t, 50, 250) - 50) / 60)
        expected = rise * np.exp(-(np.maximum(t, 250) - 250) / 60)
        np.testing.assert_allclose(found, expected, atol=1e-9)
        down = run(effect, size=warm.size, rate=rate, drivers={"temperature": -warm})[0]
        np.testing.assert_allclose(down, -found, atol=1e-12)


def test_shupe_is_invisible_at_a_steady_ramp_and_a_step_where_it_begins():
    world = [{"profile": "ramps", "channel": "temperature", "unit": "degC", "points": [[0, 20], [2000, 20], [8000, 120]]}]
    effect = {"name": "shupe", "sensitivity": 0.2, "lag": 10, "axes": ["x"]}
    log = simulate({"environment": world, "effect": [effect], "noise": {}, "log": {"rate": 1, "duration": "8000s"}})
    surface = davar(log, window="2000s", step="1000s", taus=[50.0, 100.0, 300.0]).sel(axis="x")
    step, tau = 0.2, surface.tau.values
    expected = step**2 * tau / (3 * (2000 - 2 * tau))
    np.testing.assert_allclose(surface.avar.values[1], expected, rtol=0.1)
    k = math.sqrt(3 * surface.avar.values[1][1] / 100 * HOUR)
    assert k == pytest.approx(step / math.sqrt(2000 / HOUR), rel=0.1)
    assert np.all(surface.avar.values[3:] < 1e-12)
    np.testing.assert_allclose(surface.window_mean.values[[0, 3, 5]], [0.0, 0.2, 0.2], atol=1e-9)


def test_shupe_refuses_parts_of_modes_and_halves_of_one():
    with pytest.raises(OptionError, match=r"'modes': 2\.5 is not a whole number of modes"):
        make_effect({"name": "shupe", "sensitivity": 1, "modes": 2.5})
    with pytest.raises(OptionError, match="transient needs at least 2 modes"):
        make_effect({"name": "shupe", "sensitivity": 1, "transient": 1, "modes": 1})


def test_a_long_plateau_leaves_exactly_nothing():
    effect = make_effect({"name": "shupe", "sensitivity": 1.0, "lag": 0.5})
    warm = np.concatenate([[20.0], np.full(20_000, 30.0)])
    found = run(effect, size=warm.size, rate=10.0, drivers={"temperature": warm})[0]
    assert found[1] > 1
    assert found[-1] == 0.0


def test_a_ramp_of_temperature_is_a_rate_ramp_up_and_down_alike_and_shupe_only_moves_the_mean():
    world = [{"profile": "chamber", "low": 0, "high": 40, "speed": 2, "hold": "10 min"}]
    tables = [
        {"name": "temperature_bias", "sensitivity": 0.01, "axes": ["x"]},
        {"name": "shupe", "sensitivity": 0.1, "lag": 5, "axes": ["y"]},
    ]
    log = simulate({"environment": world, "effect": tables, "noise": {}, "log": {"rate": 2, "duration": "60 min"}})
    surface = davar(log, window="5min", step="5min", taus=[5.0, 50.0])
    ramp = 0.01 * 2 * 60  # deg/h^2
    up, down = 3, 9  # 15 to 20 min and 45 to 50 min
    for row in (up, down):
        np.testing.assert_allclose(surface.avar.sel(axis="x").values[row], LAWS["R"].avar(surface.tau.values, ramp), rtol=1e-6)
        assert np.all(surface.avar.sel(axis="y").values[row] < 1e-12)
    np.testing.assert_allclose(surface.window_mean.sel(axis="y").values[[up, 7, down]], [0.2, 0.0, -0.2], atol=1e-6)
    np.testing.assert_allclose(surface.window_mean.sel(axis="x").values[[up, down]], 0.01 * (np.array([15, 25]) - 25), atol=1e-3)


# --------------------------------------------------------------------------------------------------------------------- gradient


def test_gradient_is_the_difference_of_two_sensors_and_its_change():
    t = np.arange(6000) / 10.0
    drivers = {"temperature": 50 + t / 30, "temperature_2": 48 - t / 60}
    still = run(make_effect({"name": "thermal_gradient", "sensitivity": -0.05}), size=t.size, drivers=drivers)[0]
    np.testing.assert_allclose(still, -0.05 * (2 + t / 20), rtol=1e-12)
    moving = run(make_effect({"name": "thermal_gradient", "change": 0.1, "lag": 20}), size=t.size, drivers=drivers)[2]
    np.testing.assert_allclose(moving, 0.1 * 3.0 * -np.expm1(-t / 20), atol=1e-9)  # 3 degC/min
    same = {"temperature": drivers["temperature"], "temperature_2": drivers["temperature"]}
    assert not run(effects()["thermal_gradient"].example(), size=t.size, drivers=same).any()


def test_gradient_takes_channels_of_any_name_and_is_a_ramp_while_it_builds_up():
    world = env.ramps("inside", "degC", [[0, 20], [1200, 32]], duration=1200).merge(env.steps("outside", "degC", [[0, 20]], duration=1200))
    effect = {"name": "thermal_gradient", "sensitivity": 0.5, "driver": ["inside", "outside"], "axes": ["x"]}
    log = simulate({"effect": [effect], "noise": {}, "log": {"rate": 10, "duration": "1200s"}}, environment=world)
    taus = np.array([1.0, 10.0, 100.0])
    slope = 0.5 * 12 / (1200 / HOUR)  # deg/h^2
    np.testing.assert_allclose(avar(log.rate.sel(axis="x").values, 10.0, taus), LAWS["R"].avar(taus, slope), rtol=2e-3)


# ---------------------------------------------------------------------------------------------------------------------- warm-up


def test_warm_up_is_an_exponential_averaged_over_each_sample():
    effect = make_effect({"name": "warm_up", "amplitude": 0.3, "time": 7, "slow_amplitude": -0.1, "slow_time": 50})
    found = run(effect, size=40, rate=0.5)[1]
    for i in (0, 1, 7, 39):
        truth = quad(lambda t: 0.3 * math.exp(-t / 7) - 0.1 * math.exp(-t / 50), 2 * i, 2 * i + 2)[0] / 2
        assert found[i] == pytest.approx(truth, rel=1e-9)


def test_warm_up_begins_anew_after_restarts_and_gaps_long_enough():
    effect = make_effect({"name": "warm_up", "amplitude": 1.0, "time": 100})
    tables = {"gaps": np.array([[2000, 2100], [4000, 4600]]), "restarts": np.array([[4000, 4600]])}
    found = run(effect, size=8000, **tables)[0]
    first = run(effect, size=4000)[0]
    np.testing.assert_array_equal(found[:4000], first)
    np.testing.assert_allclose(found[4600:], first[:3400], rtol=1e-12)
    every = run(replace(effect, gap=10.0), size=8000, **tables)[0]
    np.testing.assert_allclose(every[2100:4000], first[:1900], rtol=1e-12)
    longer = run(replace(effect, gap=10.1), size=8000, **tables)[0]
    np.testing.assert_array_equal(longer, found)
    warm = run(replace(effect, cold=0.0), size=8000, **tables)[0]
    assert not warm[:4000].any()
    np.testing.assert_allclose(warm[4600:], first[:3400], rtol=1e-12)


def test_a_short_loss_of_power_brings_back_only_what_cooled():
    effect = make_effect({"name": "warm_up", "amplitude": 1.0, "time": 100, "cooling": 300})
    found = run(effect, size=9000, restarts=np.array([[5000, 5600], [7000, 7030]]))[0]
    mean = -math.expm1(-1e-3) / 1e-3
    first = 1 - (1 - math.exp(-5)) * math.exp(-60 / 300)
    assert found[5600] == pytest.approx(first * mean, rel=1e-9)
    second = 1 - (1 - first * math.exp(-140 / 100)) * math.exp(-3 / 300)
    assert found[7030] == pytest.approx(second * mean, rel=1e-9)


def test_warm_up_looks_like_a_rate_ramp_that_fades_after_every_restart():
    world = [{"profile": "power_cuts", "cuts": [[3000, 3060]]}]
    effect = {"name": "warm_up", "amplitude": 0.3, "time": 600, "axes": ["x"]}
    log = simulate({"environment": world, "effect": [effect], "noise": {}, "log": {"rate": 2, "duration": "6000s"}})
    surface = davar(log, window="100s", step="20s", taus=[5.0, 20.0]).sel(axis="x")
    t = np.arange(surface.sizes["time"]) * 20 + 50.0
    for begin, rows in ((0.0, (t > 0) & (t < 2900)), (3060.0, t > 3120)):
        slope = 0.3 / (600 / HOUR) * np.exp(-(t[rows] - begin) / 600)  # deg/h^2
        expected = np.stack([LAWS["R"].avar(5.0, 1.0) * slope**2, LAWS["R"].avar(20.0, 1.0) * slope**2], axis=1)
        np.testing.assert_allclose(surface.avar.values[rows], expected, rtol=0.01)


# ------------------------------------------------------------------------------------------------------------------- hysteresis


def test_hysteresis_opens_a_loop_of_known_area():
    effect = make_effect({"name": "thermal_hysteresis", "sensitivity": 0.002, "width": 4})
    way = np.concatenate([np.linspace(-40, 60, 1001), np.linspace(60, -40, 1001)[1:]])
    temperature = np.tile(way[:-1], 3)
    bias = run(effect, size=temperature.size, drivers={"temperature": temperature})[0]
    period = way.size - 1
    last_t, last_b = np.append(temperature[-period:], -40.0), np.append(bias[-period:], bias[-period])
    assert abs(np.trapezoid(last_b, last_t)) == pytest.approx(2 * 0.002 * 4 * (100 - 2 * 4), rel=1e-6)
    up, down = bias[500], bias[1500]
    assert (up, down) == pytest.approx((0.008, -0.008), rel=1e-9)
    assert temperature[500] == pytest.approx(temperature[1500])


def test_hysteresis_stays_on_a_plateau_where_shupe_goes_back():
    world = ramp_record(1.0, begin=0, end=1800, total=9000, speed=1.0)
    play_left = run(make_effect({"name": "thermal_hysteresis", "sensitivity": 0.01}), size=9000, rate=1.0, drivers={"temperature": world})
    lag_left = run(make_effect({"name": "shupe", "sensitivity": 0.03}), size=9000, rate=1.0, drivers={"temperature": world})
    assert (play_left[0, 1700], play_left[0, -1]) == pytest.approx((0.03, 0.03))
    assert lag_left[0, 1700] == pytest.approx(0.03, rel=0.01)
    assert abs(lag_left[0, -1]) < 1e-8


turns = st.lists(st.floats(-50, 100), min_size=2, max_size=8)


@given(turns, st.floats(0.1, 20.0))
@settings(max_examples=60, deadline=None)
def test_play_does_not_depend_on_speed_and_forgets_what_was_overrun(values, width):
    coarse, _ = play(np.array(values), width, values[0])
    fine = np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(values)])
    slow, _ = play(fine, width, values[0])
    np.testing.assert_allclose(slow[49::50], coarse[1:], atol=1e-9)
    assert np.all(np.abs(np.array(values) - coarse) <= width + 1e-9)
    high = max(values) + 2 * width + 1  # a way up beyond all before wipes out their trace
    assert play(np.array([*values, high]), width, values[0])[1] == pytest.approx(high - width)


# ----------------------------------------------------------------------------------------------------------------------- ageing


def test_a_bias_that_ages_steadily_is_a_rate_ramp():
    effect = {"name": "ageing_bias", "slope": 24.0, "axes": ["x"]}
    log = simulate({"effect": [effect], "noise": {}, "log": {"rate": 1, "duration": "2h"}})
    taus = np.array([1.0, 60.0, 600.0])
    found = avar(log.rate.sel(axis="x").values, 1.0, taus)
    np.testing.assert_allclose(found, LAWS["R"].avar(taus, 1.0), rtol=1e-6)  # 24 deg/h/day are 1 deg/h^2
    assert float(log.rate.sel(axis="x")[-1]) == pytest.approx(2.0, abs=3e-4)


def test_a_bias_that_settles_is_a_logarithm():
    effect = make_effect({"name": "ageing_bias", "logarithmic": 0.3, "time": 2})
    found = run(effect, size=361, rate=1 / 60)[0]
    np.testing.assert_allclose(found[[119, 359]], 0.3 * np.log([1 + (119.5 / 60) / 2, 1 + (359.5 / 60) / 2]), rtol=1e-9)
    assert make_effect({"name": "ageing_bias", "logarithmic": 0.3, "time": "1 d"}).time == 24.0


# ------------------------------------------------------------------------------------------------------------------ noise levels


def level(table, *, drivers=None, size=5, rate=10.0, **noise):
    return run(make_effect(table), size=size, rate=rate, drivers=drivers, noise={"Q": 0.0, "N": 0.0, "B": 0.0, "K": 0.0} | noise)


def test_squared_noise_is_a_polynomial_of_temperature():
    table = {"name": "temperature_noise", "linear": 0.01, "quadratic": -1e-4, "reference": 20}
    found = level(table, drivers={"temperature": [20, 30, 70, 0, 20]}, N=[0.1, 0.2, 0.3])["N"]
    shares = [1.0, 1 + 0.1 - 0.01, 1 + 0.5 - 0.25, 1 - 0.2 - 0.04, 1.0]
    np.testing.assert_allclose(found, np.outer([0.01, 0.04, 0.09], shares), rtol=1e-12)
    with pytest.raises(OptionError, match=r"N\^2 would be negative where temperature is -90, 0.3 s after the start"):
        level(table, drivers={"temperature": [20, 20, 20, -90, 20]}, N=0.1)


def test_squared_noise_is_that_of_a_detector_in_weak_light():
    power = np.array([1e-4, 5e-5, 2e-5, 1e-5, 1e-3])
    thermal, shot, excess = 3e-12, 2e-8, 1e-3  # N^2 = thermal / P^2 + shot / P + excess
    at = thermal / 1e-8 + shot / 1e-4 + excess
    table = {"name": "light_power_noise", "thermal": thermal / 1e-8 / at, "shot": shot / 1e-4 / at}
    found = level(table, drivers={"light_power": power}, N=math.sqrt(at))["N"][0]
    np.testing.assert_allclose(found, thermal / power**2 + shot / power + excess, rtol=1e-12)
    only = level({"name": "light_power_noise", "thermal": 1.0, "nominal": "10 uW"}, drivers={"light_power": [1e-5, 5e-6] * 2 + [1e-5]}, N=1)
    np.testing.assert_allclose(only["N"][0, :2], [1.0, 4.0], rtol=1e-12)


def test_light_power_of_blin_gives_the_typical_share():
    """Detector noise as 1 / P^2, the same as excess noise at 5 uW, at a nominal 10 uW."""
    ratio = (5 / 10) ** 2
    assert effects()["light_power_noise"].example().thermal == pytest.approx(ratio / (1 + ratio))


def test_light_power_that_makes_no_sense_is_refused():
    with pytest.raises(OptionError, match=r"thermal \+ shot are 1.2 of N\^2; give shares that are together 1 or less"):
        make_effect({"name": "light_power_noise", "thermal": 0.7, "shot": 0.5})
    dark = {"name": "light_power_noise", "thermal": 0.5, "driver": "pd"}
    with pytest.raises(SchemaError, match=r"the channel 'pd' is 0 W 0.2 s after the start; it must be above 0"):
        level(dark, drivers={"light_power": [1e-4, 1e-4, 0, 1e-4, 1e-4]}, N=1)


def test_excess_noise_does_not_depend_on_the_light():
    found = level({"name": "light_power_noise", "thermal": 0.0}, drivers={"light_power": [1e-4, 1e-5, 1e-6, 1e-3, 1.0]}, N=0.3)["N"]
    np.testing.assert_array_equal(found, 0.3**2)


def test_squared_noise_ages_with_a_power_of_time():
    found = level({"name": "ageing_noise", "growth": 0.5, "exponent": 2}, size=4, rate=1 / HOUR, N=[1.0, 2.0, 0.0])["N"]
    np.testing.assert_allclose(found, np.outer([1.0, 4.0, 0.0], 1 + 0.5 * np.array([0.5, 1.5, 2.5, 3.5]) ** 2), rtol=1e-12)


@pytest.mark.parametrize(
    ("table", "world", "share"),
    [
        ({"name": "temperature_noise", "linear": 0.03}, steady("temperature", "degC", 125), 4.0),
        ({"name": "light_power_noise", "thermal": 0.5, "shot": 0.5}, steady("light_power", "uW", 50), 3.0),
    ],
    ids=["temperature", "light"],
)
def test_the_same_noise_gets_stronger_as_a_whole(table, world, share):
    model = {"environment": [world], "noise": {"N": 0.01, "K": 0.5}, "log": {"rate": 50, "duration": "400s", "axes": ["x"]}}
    plain, loud = (simulate(model | {"effect": made}, seed=3).rate.values[0] for made in ([], [table]))
    walk = simulate(model | {"noise": {"K": 0.5}}, seed=3).rate.values[0]
    np.testing.assert_allclose(loud - walk, math.sqrt(share) * (plain - walk), atol=1e-9)
    taus = np.array([0.02, 0.2, 1.0])
    np.testing.assert_allclose(avar(loud, 50.0, taus) / LAWS["N"].avar(taus, 0.01), share, rtol=0.08)


def test_noise_that_ages_rises_over_the_windows():
    model = {
        "noise": {"N": 0.01},
        "effect": [{"name": "ageing_noise", "growth": 1.5}],
        "log": {"rate": 10, "duration": "2h", "axes": ["x"]},
    }
    surface = davar(simulate(model, seed=5), window="0.5h", step="0.5h", taus=[0.1, 0.3]).sel(axis="x")
    expected = 1 + 1.5 * np.array([0.25, 0.75, 1.25, 1.75])
    np.testing.assert_allclose(surface.avar.values[:, 0] / LAWS["N"].avar(0.1, 0.01), expected, rtol=0.05)


def shaken(effect, *, noise, duration=900, rate=50, seed=8):
    world = [{"profile": "vibration", "points": [[0, 0.0], [300, 4.0], [600, 0.0]]}]
    log = {"rate": rate, "duration": duration, "axes": ["x", "y"]}
    return simulate({"environment": world, "noise": noise, "effect": [effect], "log": log}, seed=seed)


def test_vibration_adds_noise_in_squares_while_it_lasts_on_each_axis_by_itself():
    log = shaken({"name": "vibration_noise", "white": 0.01, "exponent": 1.0}, noise={"N": 0.03})
    surface = davar(log, window="300s", step="300s", taus=[0.02, 0.2, 2.0])
    ratio = surface.avar.values / LAWS["N"].avar(surface.tau.values, 1.0)
    np.testing.assert_allclose(ratio[:, :, 0], np.tile([0.03**2, 0.03**2 + 0.04**2, 0.03**2], (2, 1)), rtol=0.05)
    np.testing.assert_allclose(ratio[:, 1, 1], 0.03**2 + 0.04**2, rtol=0.15)
    np.testing.assert_allclose(ratio[:, 1, 2], 0.03**2 + 0.04**2, rtol=0.4)
    x, y = log.rate.values[:, 15_000:30_000]
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.04
    assert abs(surface.window_mean.values).max() < 5 * 60 * 0.05 / math.sqrt(300)


def test_vibration_adds_noise_of_the_angle_with_its_slope():
    table = {"name": "vibration_noise", "quantization": 5.0, "exponent": 0.5}
    log = shaken(table, noise={})
    surface = davar(log, window="300s", step="300s", taus=[0.02, 0.1, 0.5]).isel(time=1)
    expected = LAWS["Q"].avar(surface.tau.values, 5.0 * math.sqrt(4.0))
    np.testing.assert_allclose(surface.avar.values, np.tile(expected, (2, 1)), rtol=0.08)


def test_a_walk_is_inside_the_windows_and_stays_where_rectification_is_at_the_edges_and_goes_back():
    walk = shaken({"name": "vibration_random_walk", "sensitivity": 2.0}, noise={})
    step = shaken({"name": "vibration_rectification", "sensitivity": 0.05}, noise={})
    taus = [0.02, 0.1, 1.0]
    inside = davar(walk, window="200s", step="50s", taus=taus)
    law = LAWS["K"].avar(inside.tau.values, 2.0 * 4.0)
    np.testing.assert_allclose(inside.avar.values[:, 7, :2], np.tile(law[:2], (2, 1)), rtol=0.1)  # 350 to 550 s
    np.testing.assert_allclose(inside.avar.values[:, 7, 2], law[2], rtol=0.35)
    assert np.all(inside.avar.values[:, [0, 2, 12, 14]] < 1e-12)
    other = davar(step, window="200s", step="50s", taus=taus)
    assert np.all(other.avar.values[:, 7] < 1e-12)
    tau = other.tau.values
    edge = 0.8**2 * tau / (3 * (200 - 2 * tau)) * (1 + 0.5 / (tau * 50) ** 2)  # a step between two samples is sharper than one of a walk
    np.testing.assert_allclose(other.avar.values[:, 3], np.tile(edge, (2, 1)), rtol=1e-3)  # 150 to 350 s
    assert math.sqrt(3 * other.avar.values[0, 3, 2] / tau[2] * HOUR) == pytest.approx(3.4, rel=0.01)
    ends = walk.rate.values[:, -1]
    assert np.all(ends == walk.rate.values[:, 31_000])
    assert np.all(np.abs(ends) > 1e-3)
    assert not np.any(step.rate.values[:, -1])


def test_a_walk_spreads_as_fast_as_its_k_says():
    effect = {"name": "vibration_random_walk", "sensitivity": 3.0}
    log = {"rate": 1, "duration": 900, "axes": [f"a{i}" for i in range(400)]}
    model = {"environment": [steady("vibration", "g", 2.0)], "noise": {}, "effect": [effect], "log": log}
    rates = simulate(model, seed=2).rate.values
    expected = 36.0 * (900 - 0.5 - 1 / 6) / HOUR  # variance of the mean over the last second
    assert rates[:, -1].var() == pytest.approx(expected, rel=0.2)


def test_the_order_of_noise_effects_does_not_matter():
    tables = [
        {"name": "temperature_noise", "linear": 0.01},
        {"name": "vibration_noise", "white": 0.02},
        {"name": "ageing_noise", "growth": 2.0},
        {"name": "light_power_noise", "thermal": 0.5},
    ]
    world = [steady("temperature", "degC", 60), steady("vibration", "g", 2), steady("light_power", "uW", 70)]
    model = {"environment": world, "noise": {"N": 0.01}, "log": {"rate": 10, "duration": "60s"}}
    forth, back = (simulate(model | {"effect": order}).rate.values for order in (tables, tables[::-1]))
    np.testing.assert_allclose(forth, back, rtol=1e-9)


# ---------------------------------------------------------------------------------------------------------------------- explain

RATE, LENGTH = 2.0, 7200
_T = np.arange(int(LENGTH * RATE)) / RATE
_WARM = 25 + 20 * np.sin(2 * np.pi * _T / 5000) + 6 * np.sin(2 * np.pi * _T / 900 + 1)
RECORD = {
    "temperature": _WARM,
    "temperature_2": 25 + 15 * np.sin(2 * np.pi * _T / 5000 - 0.6),
    "vibration": 2.0 + (_T > 2000) * 1.5 - (_T > 5000) * 3.0,
    "light_power": 1e-4 * (0.7 + 0.2 * np.cos(2 * np.pi * _T / 4000)),
}
HOLES = np.array([[1000.0, 1030.0], [4000.0, 4400.0]])
OFF = HOLES[1:]


def windows_of(kind, length=60.0, step=30.0):
    begin = np.arange(0.0, LENGTH - length + 1, step)
    rows = [slice(int(one * RATE), int((one + length) * RATE)) for one in begin]
    means = {name: np.array([RECORD[name][row].mean() for row in rows]) for name in kind.channels}
    frequency = np.geomspace(0.02, 0.9, 9)
    gaps = {"gaps": HOLES, "restarts": OFF}
    return rows, Windows(begin, begin + length, frequency, RATE, ("x", "y", "z"), drivers=means, **gaps)


def generated(effect, **noise):
    tables = {"gaps": (HOLES * RATE).astype(int), "restarts": (OFF * RATE).astype(int)}
    drivers = {name: RECORD[name] for name in effect.channels}
    return run(effect, size=_T.size, rate=RATE, drivers=drivers, noise={"Q": 0, "N": 0, "B": 0, "K": 0} | noise, **tables)


@pytest.mark.parametrize(
    "table",
    [
        {"name": "temperature_bias", "sensitivity": 1.0},
        {"name": "shupe", "sensitivity": 1.0},
        {"name": "shupe", "sensitivity": 0.0, "transient": 1.0},
        {"name": "shupe", "sensitivity": 1.0, "modes": 1, "lag": 1000},
        {"name": "thermal_gradient", "sensitivity": 1.0},
        {"name": "thermal_gradient", "change": 1.0, "lag": 120},
        {"name": "warm_up", "amplitude": 1.0, "time": 300},
        {"name": "warm_up", "amplitude": 0.0, "slow_amplitude": 1.0, "slow_time": 900, "cooling": 200, "gap": 20, "cold": 0.5},
        {"name": "thermal_hysteresis", "sensitivity": 1.0},
        {"name": "ageing_bias", "slope": 1.0},
        {"name": "ageing_bias", "logarithmic": 1.0, "time": 0.5},
    ],
    ids=lambda table: "-".join(str(part) for part in table.values()),
)
def test_predicted_window_means_are_the_generated_ones(table):
    effect = make_effect(table)
    rows, windows = windows_of(effect)
    bias = generated(effect)[0]
    there = np.ones(_T.size, dtype=bool)
    for first, end in (HOLES * RATE).astype(int):
        there[first:end] = False
    found = np.array([bias[row][there[row]].mean() if there[row].any() else np.nan for row in rows])
    design = effect.explain(windows).mean
    size = {name: getattr(effect, name) for name in design}
    predicted = sum(value * design[name] for name, value in size.items())
    good = np.isfinite(found)
    assert good.sum() > 200
    if table["name"] not in ("warm_up",):  # the windows' mean temperature has no holes here
        found = np.array([bias[row].mean() for row in rows])
        good[:] = True
    good[0] = table["name"] == "warm_up"  # what happened before the middle of the first window is not known to the prediction
    spread = np.ptp(found[good])
    assert spread > 0
    np.testing.assert_allclose(predicted[good], found[good], atol=(0.05 if effect.name == "thermal_hysteresis" else 0.02) * spread)


@pytest.mark.parametrize(
    ("name", "parameter"),
    [
        ("temperature_noise", "linear"),
        ("temperature_noise", "quadratic"),
        ("light_power_noise", "thermal"),
        ("light_power_noise", "shot"),
        ("ageing_noise", "growth"),
    ],
)
def test_predicted_levels_are_the_generated_ones(name, parameter):
    size = {"linear": 0.01, "quadratic": 1e-4, "thermal": 0.4, "shot": 0.4, "growth": 0.7}[parameter]
    effect = effects()[name].example().switched_off()
    effect = replace(effect, **{parameter: size})
    rows, windows = windows_of(effect)
    found = generated(effect, N=0.1)["N"][0]
    share = np.array([found[row].mean() for row in rows]) / 0.01 - 1
    np.testing.assert_allclose(size * effect.explain(windows).level["N", parameter], share, atol=0.01 * np.ptp(share))


def allan_of_samples(density, k, rate):
    """Allan variance of samples with a two-sided density, k samples at a time."""
    f = (np.arange(200_000) + 0.5) * (rate / 2) / 200_000
    x = np.pi * f / rate
    return 4.0 * np.sum(density(f) * np.sin(k * x) ** 4 / (k * np.sin(x)) ** 2) * (f[1] - f[0])


@pytest.mark.parametrize(
    ("name", "parameter", "law"),
    [("vibration_noise", "white", "N"), ("vibration_noise", "quantization", "Q"), ("vibration_random_walk", "sensitivity", "K")],
)
def test_predicted_spectra_have_the_allan_variance_of_the_law(name, parameter, law):
    effect = make_effect({"name": name, parameter: 1.0, "exponent": 1.5})

    def density(f):
        windows = Windows(np.zeros(1), np.ones(1), f, 4.0, ("x",), drivers={"vibration": np.array([3.0])})
        prediction = effect.explain(windows)
        assert not prediction.coherent
        return prediction.spectrum[parameter][0]

    for k in (1, 2, 10, 60):
        assert allan_of_samples(density, k, 4.0) == pytest.approx(float(LAWS[law].avar(k / 4.0, 3.0**1.5)), rel=1e-3)


@given(st.floats(1.0, 500.0), st.integers(3, 40), st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_delayed_changes_add_up_to_what_the_lag_let_through(lag, count, seed):
    """The means over intervals that follow each other sum to how far the lagged temperature came; long after a change that is all of it."""
    rng = np.random.default_rng(seed)
    known = np.cumsum(rng.uniform(1.0, 30.0, count))
    values = rng.normal(0.0, 5.0, count)
    begin = np.concatenate([known, known[-1] + 5.0 + np.arange(40) * lag])
    end = np.append(begin[1:], begin[-1] + lag)
    flat = np.concatenate([values, [values[-1], values[-1]]])
    at = np.concatenate([known, [known[-1] + 1.0, begin[-1] + lag]])
    means = mean_changes(at, flat, begin, end, lag)
    assert np.sum(means * (end - begin)) == pytest.approx(values[-1] - values[0], abs=1e-6)


# ------------------------------------------------------------------------------------------------------------------------ frame

CASES = [
    {"name": "shupe", "sensitivity": 0.05, "transient": -0.3, "lag": 20},
    {"name": "thermal_gradient", "sensitivity": 0.05, "change": 0.2},
    {"name": "warm_up", "amplitude": 0.3, "slow_amplitude": 0.1, "gap": 2.0, "cooling": 30},
    {"name": "thermal_hysteresis", "sensitivity": 0.01, "width": 0.5},
    {"name": "ageing_bias", "slope": 1.0, "logarithmic": 0.2},
    {"name": "temperature_noise", "linear": 1e-3, "quadratic": 1e-5},
    {"name": "light_power_noise", "thermal": 0.3, "shot": 0.3},
    {"name": "vibration_noise", "white": 0.02, "quantization": 2.0, "exponent": 0.9},
    {"name": "vibration_random_walk", "sensitivity": 0.7, "exponent": 1.3},
    {"name": "ageing_noise", "growth": 0.5, "exponent": 1.7},
]


@pytest.mark.parametrize("table", CASES, ids=lambda table: table["name"])
@given(st.integers(0, 2**31), st.sampled_from([0.3, 10.0, 977.0]))
@settings(max_examples=8, deadline=None)
def test_time_may_be_cut_anywhere(table, seed, rate):
    rng = np.random.default_rng(seed)
    size = 600
    drivers = {
        "temperature": 20 + np.cumsum(rng.normal(0, 0.3, size)),
        "temperature_2": 20 + np.cumsum(rng.normal(0, 0.3, size)),
        "vibration": np.abs(rng.normal(0, 3, size)),
        "light_power": rng.uniform(1e-5, 1e-4, size),
    }
    effect = make_effect(table)
    tables = {"gaps": np.array([[50, 80], [200, 300], [420, 421]]), "restarts": np.array([[200, 300]])}
    noise = {"Q": 0.1, "N": [0.1, 0.2, 0.3], "B": 0.0, "K": 0.3}
    given_drivers = {name: drivers[name] for name in effect.channels}
    same_whatever_the_cuts(effect, random_cuts(seed, size), size=size, rate=rate, drivers=given_drivers, noise=noise, **tables)


def test_a_simulated_log_does_not_depend_on_its_chunks():
    world = [
        {"profile": "chamber", "speed": 5, "hold": 60},
        {"profile": "vibration", "points": [[0, 1.0], [700, 3.0]]},
        {"profile": "light_power", "loss": 500.0},
        steady("temperature_2", "degC", 10),
        {"profile": "power_cuts", "cuts": [[500, 540]]},
    ]
    model = {"environment": world, "effect": CASES, "noise": {"N": 0.01}, "log": {"rate": 2, "duration": "1500s"}}
    one, many = (simulate(model, seed=9, chunk=chunk).rate.values for chunk in (3000, 371))
    np.testing.assert_array_equal(one, many)
    assert np.isnan(one[:, 1000:1080]).all()


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"name": "shupe", "sensitivity": 0.1, "transient": 0.2}, r"0.2 deg/h/\(degC/min\) while heat goes through the winding"),
        ({"name": "thermal_gradient", "change": 0.1, "driver": ["a", "b"]}, "difference of a and b on all axes, by 0.1 deg/h/"),
        ({"name": "warm_up", "amplitude": 0.1, "slow_amplitude": 0.2}, "settles with 600 s, and 0.2 deg/h with 3600 s"),
        ({"name": "ageing_bias", "logarithmic": 0.2}, "by 0.2 deg/h times the logarithm of time over 24 h"),
        ({"name": "vibration_noise", "white": 1, "quantization": 2, "exponent": 0.9}, "of N and 2 urad/g of Q, added in squares, with the"),
        ({"name": "vibration_random_walk", "sensitivity": 1, "exponent": 2}, "with the power 2 of the vibration"),
    ],
)
def test_the_sentence_has_all_its_numbers(table, words):
    assert re.search(words, make_effect(table).say())

"""Effects of temperature, light power, age and vibration on noise against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import welch

from gyrostab.allan.davar import davar
from gyrostab.errors import OptionError, SchemaError
from gyrostab.noise import LAWS
from gyrostab.physics.base import Windows
from gyrostab.physics.registry import effects, make_effect
from gyrostab.simulate import simulate
from tests.support.effect_bench import avar, build_effect, run, steady

HOUR = 3600.0


def level(table, *, drivers=None, size=5, rate=10.0, **noise):
    return run(
        make_effect(table),
        size=size,
        rate=rate,
        drivers=drivers,
        noise={"Q": 0.0, "N": 0.0, "B": 0.0, "K": 0.0} | noise,
    )


def test_squared_noise_is_a_polynomial_of_temperature():
    table = {"name": "temperature_noise", "linear": 0.01, "quadratic": -1e-4, "reference": 20}
    squares = level(table, drivers={"temperature": [20, 30, 70, 0, 20]}, N=[0.1, 0.2, 0.3])["N"]
    shares = [1.0, 1 + 0.1 - 0.01, 1 + 0.5 - 0.25, 1 - 0.2 - 0.04, 1.0]
    np.testing.assert_allclose(squares, np.outer([0.01, 0.04, 0.09], shares), rtol=1e-12)
    with pytest.warns(UserWarning, match=r"less than 1 % of N\^2 at some values of temperature"):
        squares = level(table, drivers={"temperature": [20, 20, 20, -90, 20]}, N=0.1)["N"]
    np.testing.assert_allclose(squares, [[0.01, 0.01, 0.01, 0.0001, 0.01]] * 3, rtol=1e-12)


def test_law_about_a_far_reference_is_that_about_the_recorded_temperatures():
    """Between 35 and 38 degrees, the law is known and positive; at 25 degrees neither."""
    far = make_effect({"name": "temperature_noise", "linear": -4.2, "quadratic": 0.21})
    near = far.refer_noise_to({"temperature": 36.0})
    degrees = np.array([35.0, 36.0, 37.0, 38.0])
    law = 1.0 - 4.2 * (degrees - 25.0) + 0.21 * (degrees - 25.0) ** 2
    noise = {"Q": 0.0, "N": 0.1, "B": 0.0, "K": 0.0}
    squares = run(near, size=4, drivers={"temperature": degrees}, noise=noise)["N"][0]
    np.testing.assert_allclose(squares, 0.01 * (1.0 + law - law[1]), rtol=1e-9)


def test_squared_noise_is_that_of_a_detector_in_weak_light():
    power = np.array([1e-4, 5e-5, 2e-5, 1e-5, 1e-3])
    thermal, shot, excess = 3e-12, 2e-8, 1e-3  # N^2 = thermal / P^2 + shot / P + excess
    at = thermal / 1e-8 + shot / 1e-4 + excess
    table = {"name": "light_power_noise", "thermal": thermal / 1e-8 / at, "shot": shot / 1e-4 / at}
    squares = level(table, drivers={"light_power": power}, N=math.sqrt(at))["N"][0]
    np.testing.assert_allclose(squares, thermal / power**2 + shot / power + excess, rtol=1e-12)
    only = level(
        {"name": "light_power_noise", "thermal": 1.0, "nominal": "10 uW"},
        drivers={"light_power": [1e-5, 5e-6] * 2 + [1e-5]},
        N=1,
    )
    np.testing.assert_allclose(only["N"][0, :2], [1.0, 4.0], rtol=1e-12)


def test_light_power_of_blin_gives_the_typical_share():
    """Detector noise as 1 / P^2, the same as excess noise at 5 uW, at a nominal 10 uW."""
    ratio = (5 / 10) ** 2
    assert effects()["light_power_noise"].example().thermal == pytest.approx(ratio / (1 + ratio))


def test_invalid_light_power_is_refused():
    with pytest.raises(
        OptionError,
        match=r"thermal \+ shot are 1.2 of N\^2; give shares with a sum of 1 or less",
    ):
        build_effect("light_power_noise", thermal=0.7, shot=0.5)
    dark = {"name": "light_power_noise", "thermal": 0.5, "driver": "pd"}
    with pytest.raises(
        SchemaError, match=r"the channel 'pd' is 0 W 0.2 s after the start; it must be above 0"
    ):
        level(dark, drivers={"light_power": [1e-4, 1e-4, 0, 1e-4, 1e-4]}, N=1)


def test_excess_noise_does_not_depend_on_the_light():
    squares = level(
        {"name": "light_power_noise", "thermal": 0.0},
        drivers={"light_power": [1e-4, 1e-5, 1e-6, 1e-3, 1.0]},
        N=0.3,
    )["N"]
    np.testing.assert_array_equal(squares, 0.3**2)


def test_squared_noise_ages_with_a_power_of_time():
    squares = level(
        {"name": "ageing_noise", "growth": 0.5, "exponent": 2},
        size=4,
        rate=1 / HOUR,
        N=[1.0, 2.0, 0.0],
    )["N"]
    np.testing.assert_allclose(
        squares,
        np.outer([1.0, 4.0, 0.0], 1 + 0.5 * np.array([0.5, 1.5, 2.5, 3.5]) ** 2),
        rtol=1e-12,
    )


@pytest.mark.parametrize(
    ("table", "world", "share"),
    [
        ({"name": "temperature_noise", "linear": 0.03}, steady("temperature", "degC", 125), 4.0),
        (
            {"name": "light_power_noise", "thermal": 0.5, "shot": 0.5},
            steady("light_power", "uW", 50),
            3.0,
        ),
    ],
    ids=["temperature", "light"],
)
def test_noise_is_scaled_as_a_whole(table, world, share):
    model = {
        "environment": [world],
        "noise": {"N": 0.01, "K": 0.5},
        "log": {"rate": 50, "duration": "400s", "axes": ["x"]},
    }
    plain, loud = (
        simulate(model | {"effect": made}, seed=3).rate.values[0] for made in ([], [table])
    )
    walk = simulate(model | {"noise": {"K": 0.5}}, seed=3).rate.values[0]
    np.testing.assert_allclose(loud - walk, math.sqrt(share) * (plain - walk), atol=1e-9)
    taus = np.array([0.02, 0.2, 1.0])
    np.testing.assert_allclose(
        avar(loud, 50.0, taus)[0] / LAWS["N"].avar(taus, 0.01), share, rtol=0.08
    )


def test_noise_that_ages_rises_over_the_windows():
    model = {
        "noise": {"N": 0.01},
        "effect": [{"name": "ageing_noise", "growth": 1.5}],
        "log": {"rate": 10, "duration": "2h", "axes": ["x"]},
    }
    surface = davar(simulate(model, seed=5), window="0.5h", step="0.5h", taus=[0.1, 0.3]).sel(
        axis="x"
    )
    expected = 1 + 1.5 * np.array([0.25, 0.75, 1.25, 1.75])
    np.testing.assert_allclose(
        surface.avar.values[:, 0] / LAWS["N"].avar(0.1, 0.01), expected, rtol=0.05
    )


def shaken(effect, *, noise, duration=900, rate=50, seed=8):
    world = [{"profile": "vibration", "points": [[0, 0.0], [300, 4.0], [600, 0.0]]}]
    log = {"rate": rate, "duration": duration, "axes": ["x", "y"]}
    return simulate(
        {"environment": world, "noise": noise, "effect": [effect], "log": log}, seed=seed
    )


def test_vibration_adds_independent_noise_in_squares_while_it_lasts():
    log = shaken({"name": "vibration_noise", "white": 0.01, "exponent": 1.0}, noise={"N": 0.03})
    surface = davar(log, window="300s", step="300s", taus=[0.02, 0.2, 2.0])
    ratio = surface.avar.values / LAWS["N"].avar(surface.tau.values, 1.0)
    np.testing.assert_allclose(
        ratio[:, :, 0], np.tile([0.03**2, 0.03**2 + 0.04**2, 0.03**2], (2, 1)), rtol=0.05
    )
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


def test_white_noise_under_vibration_passes_the_mount():
    """The density is that of N at low frequency, and q^2 of it at the resonance; axes differ."""
    table = {"name": "vibration_noise", "white": 0.01, "resonance": 5.0, "quality": 4.0}
    log = shaken(table, noise={"N": 1e-6}, rate=100)
    at_rest, rates = log.rate.values[:, :30_000], log.rate.values[:, 30_000:60_000]
    assert at_rest.std() == pytest.approx(1e-6 * 60.0 * 10.0, rel=0.02)
    frequency, density = welch(rates, 100.0, nperseg=1000)
    ratio = density.mean(axis=0) / 2.0 / (0.01 * 4.0 * 60.0) ** 2
    low, peak, high = (ratio[np.abs(frequency - f) < 0.25].mean() for f in (0.5, 5.0, 15.0))
    assert low == pytest.approx(1.0, rel=0.15)
    assert peak == pytest.approx(16.0, rel=0.15)
    assert high == pytest.approx(1.0 / 64.0, rel=0.15)
    assert abs(np.corrcoef(rates)[0, 1]) < 0.1


def test_a_mount_is_predicted_as_it_is_generated():
    effect = build_effect("vibration_noise", white=0.01, resonance=30.0, quality=2.0)
    rates = run(effect, size=200_000, rate=100.0, axes=("x",), drivers={"vibration": 2.0})["rate"]
    frequency, density = welch(rates[0], 100.0, nperseg=256)
    windows = Windows(
        begin=np.zeros(1),
        end=np.ones(1),
        frequency=frequency[2:-2],
        rate=100.0,
        axes=("x",),
        drivers={"vibration": np.array([2.0])},
    )
    expected = 0.01**2 * effect.explain(windows).spectrum["white"][0]
    np.testing.assert_allclose(density[2:-2] / 2.0, expected, rtol=0.15)


def test_a_mount_does_not_filter_quantization():
    with pytest.raises(
        OptionError, match=r"a mount \(resonance = 30 Hz\) filters white noise only"
    ):
        build_effect("vibration_noise", white=0.01, quantization=1.0, resonance=30.0)


def test_random_walk_persists_where_rectification_reverts():
    walk = shaken({"name": "vibration_random_walk", "sensitivity": 2.0}, noise={})
    step = shaken({"name": "vibration_rectification", "sensitivity": 0.05}, noise={})
    taus = [0.02, 0.1, 1.0]
    inside = davar(walk, window="200s", step="50s", taus=taus)
    law = LAWS["K"].avar(inside.tau.values, 2.0 * 4.0)
    # 350 to 550 s
    np.testing.assert_allclose(inside.avar.values[:, 7, :2], np.tile(law[:2], (2, 1)), rtol=0.1)
    np.testing.assert_allclose(inside.avar.values[:, 7, 2], law[2], rtol=0.35)
    assert np.all(inside.avar.values[:, [0, 2, 12, 14]] < 1e-12)
    other = davar(step, window="200s", step="50s", taus=taus)
    assert np.all(other.avar.values[:, 7] < 1e-12)
    tau = other.tau.values
    # a step between two samples is sharper than one of a walk
    edge = 0.8**2 * tau / (3 * (200 - 2 * tau)) * (1 + 0.5 / (tau * 50) ** 2)
    # 150 to 350 s
    np.testing.assert_allclose(other.avar.values[:, 3], np.tile(edge, (2, 1)), rtol=1e-3)
    assert math.sqrt(3 * other.avar.values[0, 3, 2] / tau[2] * HOUR) == pytest.approx(3.4, rel=0.01)
    ends = walk.rate.values[:, -1]
    assert np.all(ends == walk.rate.values[:, 31_000])
    assert np.all(np.abs(ends) > 1e-3)
    assert not np.any(step.rate.values[:, -1])


def test_random_walk_spreads_according_to_k():
    effect = {"name": "vibration_random_walk", "sensitivity": 3.0}
    log = {"rate": 1, "duration": 900, "axes": [f"a{i}" for i in range(400)]}
    model = {
        "environment": [steady("vibration", "g", 2.0)],
        "noise": {},
        "effect": [effect],
        "log": log,
    }
    rates = simulate(model, seed=2).rate.values
    expected = 36.0 * (900 - 0.5 - 1 / 6) / HOUR  # variance of the mean over the last second
    assert rates[:, -1].var() == pytest.approx(expected, rel=0.2)


@pytest.mark.parametrize("linear", [0.01, -0.025])
def test_the_order_of_noise_effects_does_not_matter(linear):
    tables = [
        {"name": "temperature_noise", "linear": linear},
        {"name": "temperature_noise", "linear": linear},  # -0.025: below zero together
        {"name": "vibration_noise", "white": 0.02},
        {"name": "ageing_noise", "growth": 2.0},
        {"name": "light_power_noise", "thermal": 0.5},
    ]
    world = [
        steady("temperature", "degC", 60),
        steady("vibration", "g", 2),
        steady("light_power", "uW", 70),
    ]
    model = {"environment": world, "noise": {"N": 0.01}, "log": {"rate": 10, "duration": "60s"}}
    forth, back = (
        simulate(model | {"effect": order}).rate.values for order in (tables, tables[::-1])
    )
    np.testing.assert_allclose(forth, back, rtol=1e-9)

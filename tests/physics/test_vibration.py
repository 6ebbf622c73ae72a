"""Effects of vibration, acceleration and the magnetic field against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import solve_discrete_lyapunov

from gyrostab.allan.davar import davar
from gyrostab.errors import OptionError
from gyrostab.kernels.random.coloured import (
    band,
    band_psd,
    folded_psd,
    mount,
    mount_psd,
    oscillator,
    oscillator_psd,
)
from gyrostab.physics.base import Windows
from gyrostab.physics.registry import effects
from gyrostab.simulate import simulate
from tests.support.effect_bench import allan_of_samples, build_effect, run, sigma

# --------------------------------------------------------------------------------
# processes in continuous time


def density_of_reading(reading, f, rate):
    """Two-sided density of the samples, from the recursion itself."""
    size = reading.read.size
    noise = reading.kick @ reading.kick.T
    densities = []
    for frequency in f:
        gain = reading.read @ np.linalg.inv(
            np.exp(2j * np.pi * frequency / rate) * np.eye(size) - reading.step
        )
        through = np.append(gain, 1.0)
        densities.append((through @ noise @ through.conj()).real / rate)
    return np.array(densities)


@pytest.mark.parametrize("average", [False, True], ids=["point", "average"])
@pytest.mark.parametrize("rate", [7.0, 400.0, 1900.0, 30_000.0])
@pytest.mark.parametrize(
    "spring", [{}, {"resonance": 620.0, "quality": 8.0}], ids=["rigid", "mount"]
)
def test_samples_of_a_band_have_its_folded_density(spring, rate, average):
    reading = band(700.0, 800.0, rate, **spring, average=average)
    f = np.linspace(0.02, 0.48, 12) * rate
    expected = folded_psd(
        lambda g: band_psd(g, 700.0, 800.0, **spring), f, rate, 20_000.0, average=average
    )
    density_of_samples = density_of_reading(reading, f, rate)
    strong = expected > 1e-6 * expected.max()
    np.testing.assert_allclose(density_of_samples[strong], expected[strong], rtol=2e-3)
    assert strong.sum() >= 1


@pytest.mark.parametrize(
    ("low", "high", "rate"), [(1.0, 3000.0, 1000.0), (0.01, 50.0, 100.0), (20.0, 2100.0, 400.0)]
)
def test_a_wide_band_has_unit_variance_and_its_density(low, high, rate):
    reading = band(low, high, rate)
    f = np.geomspace(1e-3, 0.49, 12) * rate
    expected = folded_psd(lambda g: band_psd(g, low, high), f, rate, 20.0 * high, average=False)
    np.testing.assert_allclose(density_of_reading(reading, f, rate), expected, rtol=1e-4)
    noise = (reading.kick @ reading.kick.T)[:-1, :-1]
    variance = reading.read @ solve_discrete_lyapunov(reading.step, noise) @ reading.read
    assert variance == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("average", [False, True], ids=["point", "average"])
@pytest.mark.parametrize(
    ("frequency", "quality", "rate"),
    [(27.0, 12.0, 10.0), (27.0, 0.7, 100.0), (0.3, 20.0, 400.0), (1e-5, 0.7, 100.0)],
)
def test_samples_of_an_oscillator_have_its_folded_density(frequency, quality, rate, average):
    reading = oscillator(frequency, quality, rate, average=average)
    f = np.linspace(0.02, 0.48, 15) * rate
    expected = folded_psd(
        lambda g: oscillator_psd(g, frequency, quality), f, rate, 1e5, average=average
    )
    np.testing.assert_allclose(density_of_reading(reading, f, rate), expected, rtol=2e-3)


@pytest.mark.parametrize("average", [False, True], ids=["point", "average"])
@pytest.mark.parametrize(
    ("resonance", "quality", "rate"),
    [(30.0, 12.0, 100.0), (30.0, 0.7, 400.0), (270.0, 3.0, 100.0), (0.3, 0.7, 100.0)],
)
def test_samples_behind_a_mount_have_its_folded_density(resonance, quality, rate, average):
    reading = mount(resonance, quality, rate, average=average)
    f = np.linspace(0.02, 0.48, 15) * rate
    expected = folded_psd(lambda g: mount_psd(g, resonance, quality), f, rate, 1e5, average=average)
    np.testing.assert_allclose(density_of_reading(reading, f, rate), expected, rtol=2e-3)


def test_a_mount_has_no_gain_at_rest_and_its_quality_at_the_resonance():
    np.testing.assert_allclose(
        mount_psd(np.array([0.0, 50.0, 5000.0]), 50.0, 6.0), [1.0, 36.0, 1e-8], rtol=1e-3
    )


def test_a_slow_process_has_no_noise_far_above_it():
    f = np.array([1.4e-3, 30.0])
    slow, fast = density_of_reading(band(1e-3, 2e-3, 100.0, average=True), f, 100.0)
    assert fast < 1e-30 * slow


@pytest.mark.parametrize(
    "density", [lambda f: band_psd(f, 700.0, 800.0), lambda f: oscillator_psd(f, 700.0, 9.0)]
)
def test_densities_have_unit_power(density):
    inside = quad(density, 500.0, 1000.0, limit=400, epsabs=1e-12)[0]
    outside = quad(density, 1e-9, 500.0)[0] + quad(density, 1000.0, 1e7, limit=2000)[0]
    assert 2.0 * (inside + outside) == pytest.approx(1.0, rel=1e-3)


def test_half_power_at_the_edges_of_the_band():
    low, middle, high = band_psd(np.array([700.0, math.sqrt(700.0 * 800.0), 800.0]), 700.0, 800.0)
    assert low / middle == pytest.approx(0.5, rel=1e-9)
    assert high / middle == pytest.approx(0.5, rel=1e-9)


def test_a_mount_amplifies_at_its_resonance_only():
    gain = band_psd(np.array([600.0, 700.0, 750.0]), 500.0, 900.0, resonance=600.0, quality=12.0)
    gain /= band_psd(np.array([600.0, 700.0, 750.0]), 500.0, 900.0)
    expected = [144.0, *(1.0 / ((1 - r**2) ** 2 + (r / 12) ** 2) for r in (700 / 600, 750 / 600))]
    np.testing.assert_allclose(gain, expected, rtol=1e-9)


# --------------------------------------------------------------------------------
# vibration


def vibrating(**effect):
    """White noise of 0.003 deg/sqrt(h) at 400 Hz, with and without vibration at 700 to 800 Hz."""
    world = [{"profile": "vibration", "points": [[0, 13.39]], "sensor_rate": 1}]
    model = {
        "noise": {"N": 0.0031},
        "environment": world,
        "log": {"rate": 400, "duration": "150s", "axes": ["x"]},
    }
    loud = model | {"effect": [{"name": "aliased_vibration", "sensitivity": 50 / 13.39, **effect}]}
    return [simulate(tables, seed=3).rate.values for tables in (model, loud)]


@pytest.mark.parametrize(
    ("sampling", "taus", "times"),
    [
        ("point", [0.0025, 0.04, 0.4, 2.0], [8, 19, 19, 19]),
        ("average", [0.0025, 0.01, 0.04, 1.0], [1.3, 1.4, 1.1, 1.0]),
    ],
)
def test_a_band_on_a_multiple_of_the_sampling_rate_looks_like_n_or_q(sampling, taus, times):
    quiet, loud = vibrating(sampling=sampling)
    effect = build_effect("aliased_vibration", sensitivity=1, sampling=sampling)
    f = np.linspace(1e-3, 200, 20_001)
    windows = Windows(
        np.zeros(1), np.ones(1), f, 400.0, ("x",), drivers={"vibration": np.full(1, 50.0)}
    )
    folded = effect.explain(windows).spectrum["sensitivity"][0]
    added = np.array(
        [
            allan_of_samples(lambda g: np.interp(g, f, folded), round(tau * 400), 400.0)
            for tau in taus
        ]
    )
    expected = np.sqrt(1 + added / ((60 * 0.0031) ** 2 / np.array(taus)))
    np.testing.assert_allclose(expected, times, rtol=0.05)
    ratio = sigma(loud, 400.0, taus[:3])[0] / sigma(quiet, 400.0, taus[:3])[0]
    np.testing.assert_allclose(ratio[:2], expected[:2], rtol=0.04)
    assert ratio[2] == pytest.approx(expected[2], rel=0.2 if sampling == "point" else 0.06)


def test_band_is_aliased_to_the_expected_frequencies():
    effect = build_effect(
        "aliased_vibration", sensitivity=[1.0, -0.5], axes=["x", "y"], low=700, high=800
    )
    x, y = run(effect, size=2**17, rate=400.0, drivers={"vibration": 2.0})
    np.testing.assert_allclose(y, -0.5 * x, rtol=1e-12)
    assert x.std() == pytest.approx(2.0, rel=0.02)
    power = np.abs(np.fft.rfft(x)) ** 2
    f = np.fft.rfftfreq(x.size, 1 / 400.0)
    assert power[(f > 2) & (f < 97)].sum() / power.sum() > 0.93
    # now it lies at 200 to 250 Hz
    slower, _ = run(effect, size=2**17, rate=500.0, drivers={"vibration": 2.0})
    power = np.abs(np.fft.rfft(slower)) ** 2
    f = np.fft.rfftfreq(slower.size, 1 / 500.0)
    assert power[f > 195].sum() / power.sum() > 0.95


def test_a_faster_instrument_and_a_mean_make_integrate_and_dump():
    common = {"environment": [{"profile": "vibration", "points": [[0, 1.0]]}], "noise": {"N": 0.0}}
    effect = {"name": "aliased_vibration", "sensitivity": 50.0}
    fast = simulate(
        common
        | {
            "effect": [effect],
            "log": {"rate": 400, "duration": "30s", "oversampling": 25, "axes": ["x"]},
        }
    )
    slow = simulate(
        common
        | {
            "effect": [effect | {"sampling": "average"}],
            "log": {"rate": 400, "duration": "30s", "axes": ["x"]},
        }
    )
    taus = [0.0025, 0.005, 0.01, 0.02]
    np.testing.assert_allclose(
        sigma(fast.rate.values, 400, taus), sigma(slow.rate.values, 400, taus), rtol=0.05
    )
    # of the mean over a sample, in the default band
    inside = np.sqrt(np.mean(np.sinc(np.linspace(700.0, 800.0, 1001) / 400.0) ** 2))
    # 3.74; seeds scatter by 2 %
    assert fast.rate.values.std() == pytest.approx(50.0 * inside, rel=0.06)


def test_an_empty_band_is_refused():
    with pytest.raises(OptionError, match="from low = 800 to high = 700 Hz is empty"):
        build_effect("aliased_vibration", sensitivity=1, low=800, high=700)


def test_rectified_vibration_steps_the_mean_and_looks_like_k_at_its_edges_only():
    world = [
        {
            "profile": "vibration",
            "points": [[0, 0.0], [300, 10.0], [900, 20.0], [1200, 0.0]],
            "sensor_rate": 10,
        }
    ]
    effect = {"name": "vibration_rectification", "sensitivity": 1e-3, "axes": ["x"]}
    log = simulate({"environment": world, "effect": [effect]}, duration="1500s", rate=10)
    assert np.unique(np.round(log.rate.sel(axis="x").values, 9)).tolist() == [
        0.0,
        0.1,
        0.4,
    ]  # g^2 of 10 and 20 g
    assert not np.any(log.rate.sel(axis=["y", "z"]).values)
    surface = davar(log, window="200s", step="50s", taus=[1.0, 5.0, 20.0])
    step, tau, length = 0.1, surface.tau.values, 200.0
    # 150..350, 200..400, 250..450: the edge is 50 s inside or more
    across = surface.sel(axis="x").isel(time=slice(3, 6)).avar.values
    np.testing.assert_allclose(
        across, np.tile(step**2 * tau / (3 * (length - 2 * tau)), (3, 1)), rtol=0.02
    )
    k = np.sqrt(3 * across[1] / tau * 3600)  # deg/h^1.5
    np.testing.assert_allclose(k[:2], step / math.sqrt(length / 3600), rtol=0.06)
    inside = surface.sel(axis="x").isel(time=slice(6, 15)).avar.values  # wholly in 300..900
    assert np.all(inside < 1e-12)
    mean = surface.window_mean.sel(axis="x").values
    np.testing.assert_allclose(
        [mean[0], mean[8], mean[19], mean[-1]], [0.0, 0.1, 0.4, 0.0], atol=1e-9
    )


def test_vibration_rectification_is_even():
    rectified = build_effect("vibration_rectification", sensitivity=2e-3, quartic=1e-5)
    np.testing.assert_allclose(
        run(rectified, size=2, drivers={"vibration": [-10.0, 10.0]})[0], 0.2 + 0.1, rtol=1e-12
    )


def test_sizes_of_several_axes_read_as_a_list():
    effect = effects()["aliased_vibration"](
        sensitivity=(0.3766, 0.371), low=700.0, high=800.0, axes=("x", "y")
    )
    assert "with a sensitivity of 0.3766 and 0.371 deg/h/g; each" in effect.say()


@pytest.mark.parametrize("average", [False, True])
def test_the_factors_of_a_process_are_unique(average):
    """The signs of a matrix factor differ between processors, unless they are fixed."""
    for reading in (band(700.0, 800.0, 400.0, average=average), oscillator(45.0, 20.0, 400.0)):
        for factor in (reading.kick, reading.spread):
            assert (np.triu(factor, 1) == 0.0).all()
            assert (np.diagonal(factor) >= 0.0).all()

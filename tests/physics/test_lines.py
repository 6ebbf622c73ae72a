"""Steady lines, resonances and lines locked to the rotation against their closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from gyrostab.errors import OptionError
from gyrostab.kernels.random.coloured import oscillator_psd
from gyrostab.physics.phase import fold, line_density
from gyrostab.physics.prediction import Windows
from gyrostab.physics.registry import make_effect
from gyrostab.simulate import simulate
from gyrostab.simulate.turning import rotation
from tests.support.effect_bench import allan_of_density, build_effect, run, sigma, sinusoid_avar


def test_the_power_of_lines_is_in_their_bands():
    """Bands about 1, 2 and 4 Hz meet at 1.41 and 2.83 Hz; a line below 0.71 Hz is in none."""
    begin = np.arange(3.0)
    windows = Windows(begin, begin + 1.0, np.array([1.0, 2.0, 4.0]), 12.0, ("x",))
    frequency = np.array([[1.5, 1.5, 1.5], [2.7, 3.0, 2.7], [0.5, 1.3, np.nan]])
    power = np.array([[0.2, 0.2, 0.2], [0.3, 0.3, 0.3], [0.4, 0.4, np.nan]])
    width = np.array([1.0, 2.0, 4.0]) * (math.sqrt(2.0) - math.sqrt(0.5))
    expected = [[0.0, 0.5, 0.0], [0.4, 0.2, 0.3], [np.nan] * 3]
    np.testing.assert_allclose(line_density(windows, frequency, power) * 2.0 * width, expected)
    np.testing.assert_allclose(line_density(windows, 3.0, 0.3) * 2.0 * width, [[0.0, 0.0, 0.3]] * 3)


def test_a_steady_line_has_the_allan_variance_of_a_sinusoid():
    effect = build_effect(
        "spectral_line", amplitude=[0.2, -0.1, 0.0], frequency=0.53, phase=[30, 0, 0]
    )
    rates = run(effect, size=40_000, rate=20.0)
    taus = np.array([0.05, 0.25, 0.7, 1.0, 2.3, 5.0])
    for row, amplitude in ((0, 0.2), (1, 0.1)):
        np.testing.assert_allclose(
            sigma(rates[row], 20.0, taus)[0] ** 2, sinusoid_avar(taus, amplitude, 0.53), rtol=0.01
        )
    assert not rates[2].any()
    fine = np.arange(1, 40) * 0.05
    deviation = sigma(rates[0], 20.0, fine)[0]
    assert fine[deviation.argmax()] == pytest.approx(0.371 / 0.53, abs=0.026)
    assert deviation.max() == pytest.approx(0.7246 * 0.2, rel=0.005)
    t = np.arange(3) / 20.0
    expected = [
        0.2
        * quad(lambda s: math.sin(2 * math.pi * 0.53 * s + math.pi / 6), begin, begin + 0.05)[0]
        / 0.05
        for begin in t
    ]
    np.testing.assert_allclose(rates[0][:3], expected, rtol=1e-9)


def test_a_line_above_nyquist_folds_with_the_response_of_the_mean():
    effect = build_effect("spectral_line", amplitude=1.0, frequency=27.0)
    rates = run(effect, size=4000, rate=20.0)[0]
    spectrum = np.abs(np.fft.rfft(rates)) / 2000
    f = np.fft.rfftfreq(4000, 1 / 20.0)
    assert f[spectrum.argmax()] == pytest.approx(7.0)
    assert spectrum.max() == pytest.approx(abs(np.sinc(27 / 20)), rel=1e-6)
    np.testing.assert_allclose(fold(np.array([7.0, 13.0, 27.0, 33.0]), 20.0), 7.0)


def test_a_resonance_has_the_allan_variance_of_its_density_and_one_motion():
    effect = build_effect(
        "spectral_line", amplitude=[0.2, -0.4], axes=["x", "z"], frequency=3.0, quality=10
    )
    x, z = run(effect, size=200_000, rate=20.0)
    np.testing.assert_allclose(z, -2.0 * x, rtol=1e-12)
    taus = [0.05, 0.1, 0.2, 0.5, 1.0]
    expected = [
        allan_of_density(lambda f: 0.02 * oscillator_psd(f, 3.0, 10.0), tau, 200.0) for tau in taus
    ]
    np.testing.assert_allclose(sigma(x, 20.0, taus)[0] ** 2, expected, rtol=0.08)


def test_phase_of_a_steady_line_is_drawn_unless_given():
    line = {"name": "spectral_line", "amplitude": [0.2, -0.4], "axes": ["x", "z"], "frequency": 1.0}
    instants = np.exp(-2j * np.pi * (np.arange(1000) + 0.5) / 100.0)

    def phases(seed, **given):
        values = run(make_effect(line | given), size=1000, rate=100.0, seed=seed)
        return np.angle(values @ instants)

    drawn = np.array([phases(seed) for seed in range(1, 9)])
    turned = np.angle(np.exp(1j * (drawn[:, 1] - drawn[:, 0] - np.pi)))
    np.testing.assert_allclose(turned, 0.0, atol=1e-9)  # one motion, of the other sign
    assert len(np.unique(drawn[:, 0].round(6))) == 8
    assert abs(np.exp(1j * drawn[:, 0]).mean()) < 0.8
    np.testing.assert_allclose(phases(1, phase=[30.0]), phases(2, phase=[30.0]))


def test_lines_lock_to_a_changing_rotation():
    fast, factor = 50 * 64, 64
    speed = 90.0 + 6.0 * (np.arange(60 * fast) // factor) / 50  # held inside each sample
    turns = np.concatenate([[0.0], np.cumsum(speed)[:-1]]) / fast / 360.0 + speed / fast / 720.0
    effect = build_effect(
        "rotation_line",
        amplitude=[0.5, 1.0],
        axes=["x", "y"],
        order=2,
        harmonics=3,
        phase=[0.0, 90.0],
    )
    rates = run(effect, size=3000, rate=50.0, drivers={"rotation_rate": speed[::factor]})
    for row, (amplitude, phase) in enumerate(((0.5, 0.0), (1.0, math.pi / 2))):
        wave = sum(amplitude / k * np.cos(k * (2 * math.pi * 2 * turns + phase)) for k in (1, 2, 3))
        np.testing.assert_allclose(rates[row], wave.reshape(-1, factor).mean(axis=1), atol=3e-4)


def test_lines_need_rotation():
    """The channel has noise at rest, about a turn in half an hour."""
    rest = 0.2 * np.random.default_rng(2).standard_normal(1000)
    speed = np.concatenate([rest, np.full(1000, 90.0), rest])
    effect = build_effect("rotation_line", amplitude=[0.5], axes=["x"])
    (rates,) = run(effect, size=3000, rate=50.0, drivers={"rotation_rate": speed})
    assert not rates[:1000].any()
    assert not rates[2000:].any()
    assert np.std(rates[1000:2000]) == pytest.approx(0.5 / np.sqrt(2.0), rel=0.01)


def test_fractional_number_of_lines_is_refused():
    with pytest.raises(OptionError, match=r"'harmonics': 2\.5 is not a whole number of lines"):
        build_effect("rotation_line", amplitude=1, harmonics=2.5)


def test_a_pump_is_another_channel():
    strokes = rotation([[0, 720.0]], duration=100, accelerations=False)[["rotation_rate"]]
    strokes = strokes.rename(rotation_rate="pump", time_rotation_rate="time_pump")
    effect = {"name": "rotation_line", "amplitude": 0.3, "driver": "pump", "axes": ["x"]}
    log = simulate(
        {"effect": [effect], "noise": {}, "log": {"rate": 40, "duration": "100s"}},
        environment=strokes,
    )
    taus = [0.1, 0.371 / 2, 0.4]
    taus = [round(tau * 40) / 40 for tau in taus]
    variance = sigma(log.rate.sel(axis="x").values, 40.0, taus)[0] ** 2
    np.testing.assert_allclose(variance, sinusoid_avar(taus, 0.3, 2.0), rtol=0.01)

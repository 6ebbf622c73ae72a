"""Effects of temperature, age, light power and vibration generate what they predict."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.kernels.thermal import mean_changes
from gyrostab.noise import LAWS
from gyrostab.physics.base import Windows
from gyrostab.physics.registry import effects, make_effect
from tests.support.effect_bench import allan_of_samples, build_effect, run, switch_off

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
    rows = [slice(int(start * RATE), int((start + length) * RATE)) for start in begin]
    means = {name: np.array([RECORD[name][row].mean() for row in rows]) for name in kind.channels}
    frequency = np.geomspace(0.02, 0.9, 9)
    gaps = {"gaps": HOLES, "restarts": OFF}
    return rows, Windows(
        begin, begin + length, frequency, RATE, ("x", "y", "z"), drivers=means, **gaps
    )


def generated(effect, **noise):
    tables = {"gaps": (HOLES * RATE).astype(int), "restarts": (OFF * RATE).astype(int)}
    drivers = {name: RECORD[name] for name in effect.channels}
    return run(
        effect,
        size=_T.size,
        rate=RATE,
        drivers=drivers,
        noise={"Q": 0, "N": 0, "B": 0, "K": 0} | noise,
        **tables,
    )


@pytest.mark.parametrize(
    "table",
    [
        {"name": "temperature_bias", "sensitivity": 1.0},
        {"name": "temperature_bias", "sensitivity": 1.0, "sensor_lag": 40},
        {"name": "shupe", "sensitivity": 1.0},
        {"name": "shupe", "sensitivity": 0.0, "transient": 1.0},
        {"name": "shupe", "sensitivity": 1.0, "modes": 1, "lag": 1000},
        {"name": "shupe", "sensitivity": 1.0, "lag": 600, "sensor_lag": 40},
        {"name": "shupe", "sensitivity": 0.5, "transient": 1.0, "lag": 600, "sensor_lag": 40},
        {"name": "thermal_gradient", "sensitivity": 1.0},
        {"name": "thermal_gradient", "change": 1.0, "lag": 120},
        {"name": "warm_up", "amplitude": 1.0, "time": 300},
        {
            "name": "warm_up",
            "amplitude": 0.0,
            "slow_amplitude": 1.0,
            "slow_time": 900,
            "cooling": 200,
            "gap": 20,
            "cold": 0.5,
        },
        {"name": "thermal_hysteresis", "sensitivity": 1.0},
        {"name": "thermal_hysteresis", "sensitivity": 1.0, "sensor_lag": 40},
        {"name": "ageing_bias", "slope": 1.0},
        {"name": "ageing_bias", "logarithmic": 1.0, "time": 0.5},
    ],
    ids=lambda table: "-".join(str(part) for part in table.values()),
)
def test_predicted_window_means_are_the_generated_ones(table):
    effect = make_effect(table)
    rows, windows = windows_of(effect)
    bias = generated(effect)[0]
    present = np.ones(_T.size, dtype=bool)
    for first, end in (HOLES * RATE).astype(int):
        present[first:end] = False
    means = np.array(
        [bias[row][present[row]].mean() if present[row].any() else np.nan for row in rows]
    )
    design = effect.explain(windows).mean
    size = {name: getattr(effect, name) for name in design}
    predicted = sum(value * design[name] for name, value in size.items())
    good = np.isfinite(means)
    assert good.sum() > 200
    if table["name"] not in ("warm_up",):  # the windows' mean temperature has no holes here
        means = np.array([bias[row].mean() for row in rows])
        good[:] = True
    # what happened before the middle of the first window is not known to the prediction
    good[0] = table["name"] == "warm_up"
    # nor how the change goes on after the middle of the last one
    good[-1] = "sensor_lag" not in table
    spread = np.ptp(means[good])
    assert spread > 0
    np.testing.assert_allclose(
        predicted[good],
        means[good],
        atol=(0.05 if effect.name == "thermal_hysteresis" else 0.02) * spread,
    )


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
    size = {"linear": 0.01, "quadratic": 1e-4, "thermal": 0.4, "shot": 0.4, "growth": 0.7}[
        parameter
    ]
    effect = switch_off(effects()[name].example())
    effect = replace(effect, **{parameter: size})
    rows, windows = windows_of(effect)
    squares = generated(effect, N=0.1)["N"][0]
    share = np.array([squares[row].mean() for row in rows]) / 0.01 - 1
    np.testing.assert_allclose(
        size * effect.explain(windows).level["N", parameter], share, atol=0.01 * np.ptp(share)
    )


@pytest.mark.parametrize(
    ("name", "parameter", "law"),
    [
        ("vibration_noise", "white", "N"),
        ("vibration_noise", "quantization", "Q"),
        ("vibration_random_walk", "sensitivity", "K"),
    ],
)
def test_predicted_spectra_have_the_allan_variance_of_the_law(name, parameter, law):
    effect = build_effect(name, **{parameter: 1.0}, exponent=1.5)

    def density(f):
        windows = Windows(
            np.zeros(1), np.ones(1), f, 4.0, ("x",), drivers={"vibration": np.array([3.0])}
        )
        prediction = effect.explain(windows)
        assert not prediction.coherent
        return prediction.spectrum[parameter][0]

    for k in (1, 2, 10, 60):
        assert allan_of_samples(density, k, 4.0) == pytest.approx(
            float(LAWS[law].avar(k / 4.0, 3.0**1.5)), rel=1e-3
        )


@given(st.floats(1.0, 500.0), st.integers(3, 40), st.integers(0, 2**31))
def test_lagged_changes_sum_to_the_lagged_temperature(lag, count, seed):
    """Means over adjacent intervals sum to the change of the lagged temperature."""
    rng = np.random.default_rng(seed)
    known = np.cumsum(rng.uniform(1.0, 30.0, count))
    values = rng.normal(0.0, 5.0, count)
    begin = np.concatenate([known, known[-1] + 5.0 + np.arange(40) * lag])
    end = np.append(begin[1:], begin[-1] + lag)
    flat = np.concatenate([values, [values[-1], values[-1]]])
    at = np.concatenate([known, [known[-1] + 1.0, begin[-1] + lag]])
    means = mean_changes(at, flat, begin, end, lag)
    assert np.sum(means * (end - begin)) == pytest.approx(values[-1] - values[0], abs=1e-6)


@pytest.mark.parametrize(
    "table",
    [{"lag": 300, "sensor_lag": 40}, {"lag": 300}, {"lag": 30, "modes": 1, "sensor_lag": 60}],
    ids=str,
)
def test_fine_values_sharpen_the_predicted_change(table):
    """60 s windows resolve a corner of the temperature only with values inside of them."""
    warm = 20.0 + 2.0 / 60.0 * np.clip(_T - 3000.0, 0.0, 1200.0)
    effect = make_effect({"name": "shupe", "sensitivity": 1.0} | table)
    rates = (
        run(effect, size=_T.size, rate=RATE, drivers={"temperature": warm})[0]
        .reshape(-1, 120)
        .mean(axis=1)
    )
    begin = np.arange(0.0, LENGTH, 60.0)
    means = {"temperature": warm.reshape(-1, 120).mean(axis=1)}
    blunt = Windows(begin, begin + 60.0, np.ones(1), RATE, ("x",), drivers=means)
    sharp = replace(blunt, fine={"temperature": warm.reshape(-1, 12, 10).mean(axis=2)})
    off = [
        np.abs(effect.explain(windows).mean["sensitivity"] - rates).max()
        for windows in (blunt, sharp)
    ]
    assert off[1] < 0.15 * rates.max()
    assert off[1] < 0.4 * off[0]


def test_overlapping_windows_use_means_only():
    begin, means = np.array([0.0, 30.0]), np.array([1.0, 2.0])
    windows = Windows(
        begin,
        begin + 60.0,
        np.ones(1),
        RATE,
        ("x",),
        drivers={"a": means},
        fine={"a": np.ones((2, 4))},
    )
    at, values = windows.course("a")
    np.testing.assert_array_equal(at, [30.0, 60.0])
    np.testing.assert_array_equal(values, means)
    at, values = replace(windows, end=begin + 30.0).course("a")
    np.testing.assert_allclose(at, 3.75 + 7.5 * np.arange(8))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (
            {"name": "shupe", "sensitivity": 0.1, "transient": 0.2},
            r"0.2 deg/h/\(degC/min\) while heat passes through the winding",
        ),
        (
            {"name": "shupe", "sensitivity": 0.1, "sensor_lag": 40},
            "with a lag of 265 s, measured by a sensor that lags by 40 s",
        ),
        (
            {"name": "shupe", "sensitivity": 0.0, "transient": 0.2},
            r"temperature on all axes, by 0.2 deg/h/\(degC/min\) while heat passes",
        ),
        (
            {"name": "temperature_bias", "sensitivity": 0.0, "cubic": 1e-6},
            r"on all axes, by 1e-06 deg/h/degC\^3 around 25 degC",
        ),
        (
            {"name": "temperature_bias", "sensitivity": 0.1, "cubic": 1e-6},
            r"by 0.1 deg/h/degC, 1e-06 deg/h/degC\^3 around 25 degC",
        ),
        (
            {"name": "temperature_bias", "sensitivity": 0.1, "quadratic": 1e-4, "reference": 80.0},
            r"by 0.1 deg/h/degC, 0.0001 deg/h/degC\^2 around 80 degC",
        ),
        ({"name": "temperature_bias", "sensitivity": 0.1}, r"by 0\.1 deg/h/degC\.$"),
        ({"name": "temperature_bias", "sensitivity": 0.0}, r"by 0 deg/h/degC\.$"),
        (
            {"name": "temperature_noise", "linear": 0.0, "quadratic": 1e-5},
            r"relative to its value at 25 degC, N\^2 changes by 1e-05 1/degC\^2\.",
        ),
        (
            {"name": "vibration_rectification", "sensitivity": 0.0, "quartic": 1e-6},
            r"of 1e-06 deg/h/g\^4 times the fourth power of the rms vib",
        ),
        (
            {"name": "vibration_rectification", "sensitivity": 1e-3, "quartic": 1e-6},
            r"of the rms vibration, and of 1e-06 deg/h/g\^4 times its",
        ),
        (
            {"name": "thermal_gradient", "change": 0.1, "driver": ["a", "b"]},
            "difference of a and b on all axes, by 0.1 deg/h/",
        ),
        (
            {"name": "warm_up", "amplitude": 0.1, "slow_amplitude": 0.2},
            "settles with a time constant of 600 s; another 0.2 deg/h settles with 3600 s",
        ),
        (
            {"name": "ageing_bias", "logarithmic": 0.2},
            "by 0.2 deg/h times the logarithm of time over 24 h",
        ),
        (
            {"name": "vibration_noise", "white": 1, "quantization": 2, "exponent": 0.9},
            "of N and 2 urad/g of Q, added in squares, as vibration to the power 0.9",
        ),
        (
            {"name": "vibration_random_walk", "sensitivity": 1, "exponent": 2},
            "as vibration to the power 2",
        ),
    ],
)
def test_sentence_has_all_parameters(table, words):
    assert re.search(words, make_effect(table).say())

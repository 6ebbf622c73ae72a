"""Effects of vibration, rotation, lines and motion generate what they predict."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.physics.registry import make_effect
from tests.support.effect_bench import build_effect, means_and_prediction, run, windows_of

T = np.arange(4000) / 10.0
SPEED = 2.0 + 0.5 * np.floor(T / 40.0) * (-1) ** np.floor(T / 80)
DRIVERS = {
    "vibration": 3.0 + 2.0 * np.sin(T / 3.0),
    "rotation_rate": SPEED,
    "temperature": 25.0 + np.floor(T / 40.0),
    **{f"mag_{axis}": 30.0 * np.cos(T / 50.0 + number) for number, axis in enumerate("xyz")},
    **{f"accel_{axis}": np.cos(T / 50.0 + number) for number, axis in enumerate("xyz")},
}
TRUE = {axis: 100.0 * np.cos(T / 60 + number) for number, axis in enumerate("xyz")}


@pytest.mark.parametrize(
    "table",
    [
        {"name": "vibration_rectification", "sensitivity": 2e-3},
        {"name": "g_sensitivity", "x": 0.1, "y": -0.2, "z": 0.3},
        {"name": "magnetic", "x": 0.1, "y": -0.2, "z": 0.3},
        {"name": "rotation_line", "amplitude": 0.5, "phase": [20, 110, -30], "harmonics": 2},
        {"name": "scale_factor", "linear": 30, "asymmetry": -10, "cubic": 0.5, "thermal": 2},
        {"name": "scale_factor", "linear": 3000, "rotation": "true"},
        {"name": "misalignment", "x": 1, "y": -2, "z": 0.5},
        {"name": "earth_rate", "latitude": 40, "inclination": 20, "azimuth": 30, "toolface": 60},
        {"name": "real_motion", "spin": 0.1, "direction": [1.0, -0.5, 0.2]},
    ],
    ids=lambda table: table["name"],
)
def test_window_means_are_the_design_times_the_parameters(table):
    means, predicted, _ = means_and_prediction(
        make_effect(table), rate=10.0, length=400, drivers=DRIVERS, true=TRUE, own=TRUE
    )
    assert np.abs(means).max() > 1e-3
    np.testing.assert_allclose(predicted, means, atol=2e-3 * np.abs(means).max())


def test_tilt_leaves_the_slope_of_the_acceleration_in_the_means():
    effect = build_effect("real_motion", x=0.5, z=-0.2, direction=[1.0, -0.5, 0.2])
    means, _, design = means_and_prediction(effect, rate=10.0, length=100, drivers=DRIVERS)
    total = 0.5 * design["x"] - 0.2 * design["z"]
    np.testing.assert_allclose(total[:, 1:-1], means[:, 1:-1], atol=0.02 * np.abs(means).max())


@pytest.mark.parametrize(
    "table",
    [
        {"name": "aliased_vibration", "sensitivity": 0.5, "low": 11.0, "high": 13.0},
        {
            "name": "aliased_vibration",
            "sensitivity": 2.0,
            "low": 11.0,
            "high": 13.0,
            "resonance": 9.0,
            "quality": 6,
            "sampling": "average",
        },
        {"name": "spectral_line", "amplitude": 0.5, "frequency": 3.0, "quality": 4.0},
        {"name": "spectral_line", "amplitude": 0.5, "frequency": 17.7},
        {"name": "rotation_line", "amplitude": 0.5, "harmonics": 3},
        {"name": "real_motion", "sway": 3.0, "frequency": 1.1, "quality": 3.0},
    ],
    ids=lambda table: "-".join(map(str, [table["name"], *list(table.values())[2:]])),
)
def test_spectra_match_the_prediction(table):
    effect = make_effect(table)
    rate, length, count = 10.0, 1000, 60
    drivers = {"vibration": 2.0, "rotation_rate": 417.6}
    rates = run(effect, size=length * count, rate=rate, drivers=drivers, axes=("x", "y", "z"))
    centres = np.arange(1, 100) * 0.05
    windows = windows_of(
        length * count,
        rate,
        length / rate,
        centres,
        axes=("x", "y", "z"),
        drivers={name: np.full(count, value) for name, value in drivers.items()},
    )
    power = np.abs(
        np.fft.rfft(rates[0].reshape(count, length) * np.sqrt(8 / 3) * np.hanning(length), axis=1)
    ) ** 2 / (length * rate)
    f = np.fft.rfftfreq(length, 1 / rate)
    prediction = effect.explain(windows)
    (name,) = prediction.spectrum
    predicted = float(np.atleast_1d(getattr(effect, name))[0]) ** 2 * np.broadcast_to(
        prediction.spectrum[name], (count, 99)
    ).mean(axis=0)
    measured = power[:, 3:498].mean(axis=0).reshape(99, 5).mean(axis=1)
    for bands in (9, 11):
        wide = [values.reshape(-1, bands).sum(axis=1) for values in (predicted, measured)]
        np.testing.assert_allclose(*wide, atol=0.04 * predicted.sum())
    assert predicted.sum() == pytest.approx(measured.sum(), rel=0.06)
    if prediction.line is not None:
        place = np.atleast_2d(prediction.line)[0, 0]
        assert place == pytest.approx(f[power.mean(axis=0).argmax()], abs=0.15)


@pytest.mark.parametrize(
    "table",
    [
        {"name": "earth_rate", "latitude": 60.0, "inclination": 30.0, "azimuth": 60.0},
        {"name": "rotation_line", "amplitude": 2.0, "phase": 40.0, "order": 1.0, "harmonics": 3},
    ],
)
def test_means_in_stick_slip_follow_the_measured_means_of_the_turns(table):
    time = np.arange(20_000) / 50.0
    rotation = 90.0 + 80.0 * np.sin(1.4 * np.pi * time)  # uneven within each window of 8 s
    effect = make_effect(table)
    means, even, _ = means_and_prediction(
        effect, rate=50.0, length=400, drivers={"rotation_rate": rotation}
    )
    inside = rotation / (360.0 * 50.0)
    turns = np.cumsum(inside) - inside / 2.0
    harmonics = np.exp(2j * np.pi * turns[:, None] * [1, 2, 3]).reshape(-1, 400, 3).mean(axis=1)
    windows = windows_of(
        time.size,
        50.0,
        8.0,
        axes=("x", "y", "z"),
        drivers={"rotation_rate": rotation.reshape(-1, 400).mean(axis=1)},
        turn_means=dict.fromkeys("xyz", harmonics),
    )
    (size,) = effect.size_parameters
    scale = np.atleast_1d(getattr(effect, size))[0]
    np.testing.assert_allclose(scale * effect.explain(windows).mean[size], means, atol=5e-3)
    assert np.abs(even - means).max() > 0.1

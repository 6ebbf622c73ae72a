"""Effects of rotation and of real motion against their closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.errors import OptionError, SchemaError
from gyrostab.kernels.random.coloured import oscillator_psd
from gyrostab.simulate import simulate
from tests.support.effect_bench import allan_of_density, build_effect, run, sigma, windows_of

# --------------------------------------------------------------------------------
# rotation


def test_scale_factor_errors_are_those_of_the_catalogue():
    speed = 6 * 180.0  # 180 r/min in deg/s
    error = run(
        build_effect("scale_factor", linear=100),
        size=1,
        drivers={"rotation_rate": speed},
    )
    np.testing.assert_allclose(error, 388.8, rtol=1e-12)
    drivers = {"rotation_rate": [speed, -speed], "temperature": [35.0, 35.0]}
    linear, lopsided, cubic, thermal = (
        run(build_effect("scale_factor", **table), size=2, drivers=drivers)[0]
        for table in ({"linear": 1}, {"asymmetry": 1}, {"cubic": 1e-6}, {"thermal": 0.1})
    )
    np.testing.assert_allclose(linear, [3.888, -3.888], rtol=1e-12)
    np.testing.assert_allclose(lopsided, [3.888, 3.888], rtol=1e-12)
    np.testing.assert_allclose(cubic, np.array([3.888, -3.888]) * 1e-6 * speed**2, rtol=1e-12)
    np.testing.assert_allclose(thermal, [3.888, -3.888], rtol=1e-12)


def test_scale_factor_of_the_true_rate_needs_no_channel():
    effect = build_effect("scale_factor", linear=1000, rotation="true")
    assert effect.needs() == ()
    error = run(effect, size=2, true={"x": 15.0, "z": [1.0, -1.0]})
    np.testing.assert_allclose(error, [[0.015, 0.015], [0, 0], [0.001, -0.001]], rtol=1e-12)


def test_misalignment_leaks_the_true_rate_of_other_axes_only():
    effect = build_effect("misalignment", z=0.5, y=-1.0)
    error = run(effect, size=2, true={"x": 7.0, "y": [100.0, 0.0], "z": [2000.0, 1000.0]})
    np.testing.assert_allclose(error, [[1.0 - 0.1, 0.5], [1.0, 0.5], [-0.1, 0.0]], rtol=1e-12)
    with pytest.raises(
        SchemaError, match="needs the rate of axis 'z', which the log does not have; it has x, y"
    ):
        run(effect, size=2, axes=("x", "y"))


def test_misalignment_leaks_the_rotation_of_the_tool():
    world = [
        {"profile": "rotation", "points": [[0, 6 * 180.0]], "axis": "z", "accelerations": False}
    ]
    effect = {"name": "misalignment", "z": 1.0, "axes": ["x"]}
    log = simulate({"environment": world, "effect": [effect]}, duration="10s", rate=10)
    np.testing.assert_allclose(log.rate.isel(time=5).values, [3888.0, 0.0, 3.888e6], rtol=1e-9)


def test_misalignment_leaks_the_recorded_rate_of_other_axes():
    recording = simulate({"noise": {"N": 0.003}}, duration="20s", rate=10.0, seed=5).compute()
    recording["rate"][2] += 4000.0 * np.sin(np.arange(200) / 7.0)
    recording["rate"][2, 50:60] = np.nan  # the rate that leaks is interpolated here
    effect = {"name": "misalignment", "z": 2.0, "axes": ["x"], "motion": "recorded"}
    simulated = simulate({"noise": {}, "effect": [effect]}, like=recording, chunk=37).compute()
    present = np.isfinite(recording["rate"].values[2])
    np.testing.assert_allclose(
        simulated["rate"].values[0, present], 2e-3 * recording["rate"].values[2, present], rtol=1e-9
    )
    assert not simulated["rate"].values[1:, present].any()
    with pytest.raises(SchemaError, match="follows the recorded rate of axis 'z'; give a record"):
        simulate({"noise": {"N": 0.003}, "effect": [effect]}, duration="20s", rate=10.0)
    with pytest.raises(SchemaError, match="needs the rate of axis 'z', which the log does not"):
        simulate({"noise": {}, "effect": [effect]}, like=recording.sel(axis=["x", "y"]))


def tool_axes(inclination, azimuth, toolface):
    """Compute x, y, z in north, east, down: rotate by azimuth, inclination and toolface."""

    def about(axis, angle):
        c, s = math.cos(angle), math.sin(angle)
        return np.array(
            {"y": [[c, 0, s], [0, 1, 0], [-s, 0, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis]
        )

    return about("z", azimuth) @ about("y", inclination) @ about("z", toolface)


@given(st.floats(-90, 90), st.floats(0, 180), st.floats(-360, 360), st.floats(-360, 360))
def test_earth_rate_at_rest_is_the_rotated_vector(latitude, inclination, azimuth, toolface):
    effect = build_effect(
        "earth_rate", latitude=latitude, inclination=inclination, azimuth=azimuth, toolface=toolface
    )
    rates = run(effect, size=2, drivers={"rotation_rate": 0.0})[:, 1]
    lat = math.radians(latitude)
    earth = 15.041067 * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    axes = tool_axes(*np.radians([inclination, azimuth, toolface]))
    np.testing.assert_allclose(rates, axes.T @ earth, atol=1e-9)


def test_earth_rate_during_rotation_is_a_line_in_quadrature():
    effect = build_effect("earth_rate", latitude=50, inclination=40, azimuth=110)
    rate, speed, size = 20.0, 90.0, 20_000
    x, y, z = run(effect, size=size, rate=rate, drivers={"rotation_rate": speed})
    along, high, right = effect.components()
    assert math.hypot(along, high, right) == pytest.approx(15.041067, rel=1e-9)
    across = math.hypot(high, right)
    np.testing.assert_allclose(z, along, rtol=1e-9)
    whole = slice(0, size - size % 80)  # turns of 80 samples
    wave = np.exp(-2j * np.pi * 0.25 * (np.arange(size) + 0.5) / rate)[whole]
    ax, ay = (2 * (rates[whole] * wave).mean() for rates in (x, y))
    assert abs(ax) == pytest.approx(across * np.sinc(0.25 / rate), rel=1e-6)
    assert ay / ax == pytest.approx(1j, abs=1e-6)  # y stands a quarter ahead of x
    top = sigma(x, rate, [0.371 / 0.25])[0, 0]
    assert top == pytest.approx(0.7246 * across, rel=0.01)


def test_a_record_shows_the_earth_rate_across_the_tool_alone():
    effect = build_effect("earth_rate", latitude=60)
    text = effect.say_in_record(windows_of(100, 10.0, 1.0))
    assert "7.521 deg/h of the earth's 15.04 deg/h across its axis" in text
    assert "as a vertical tool does at latitude 60 deg" in text
    assert "along it" not in text
    assert "along it" in effect.say()


def test_earth_rate_and_gravity_share_the_frame_of_the_tool():
    """At the pole the earth rotates about the vertical: its rate is along measured gravity."""
    world = [{"profile": "rotation", "points": [[0, 30.0]], "inclination": 90.0, "toolface": 25.0}]
    effect = {"name": "earth_rate", "latitude": 90, "inclination": 90, "toolface": 25}
    log = simulate({"environment": world, "effect": [effect]}, duration="30s", rate=10)
    middle = (
        log.accel_x.interp(time_accel_x=log.time + np.timedelta64(50, "ms")),
        log.accel_y.interp(time_accel_y=log.time + np.timedelta64(50, "ms")),
    )
    for axis, acceleration in zip("xy", middle, strict=True):
        np.testing.assert_allclose(
            log.rate.sel(axis=axis).values[:-1], 15.041067 * acceleration.values[:-1], atol=0.02
        )


def test_axes_of_other_names_need_directions():
    with pytest.raises(
        OptionError, match="axis 'north' is not x, y or z; give its direction with off and around"
    ):
        run(
            build_effect("earth_rate", latitude=45),
            size=2,
            axes=("north",),
            drivers={"rotation_rate": 0.0},
        )
    across = build_effect("earth_rate", latitude=30, around=[0, 180])
    rates = run(across, size=1, axes=("a", "b"), drivers={"rotation_rate": 0.0})[:, 0]
    np.testing.assert_allclose(rates, 15.041067 * np.array([0.8660254, -0.8660254]), rtol=1e-6)
    effect = build_effect("earth_rate", latitude=30, off=[90, 0, 45], around=[0, 0, 0])
    rates = run(effect, size=1, axes=("a", "b", "c"), drivers={"rotation_rate": 0.0})[:, 0]
    np.testing.assert_allclose(
        rates, 15.041067 * np.array([0.8660254, -0.5, (0.8660254 - 0.5) / math.sqrt(2)]), rtol=1e-6
    )


# --------------------------------------------------------------------------------
# real motion


def test_sway_is_one_motion_in_its_direction_with_no_floor():
    effect = build_effect(
        "real_motion", sway=10, frequency=0.5, quality=5, direction=[0.6, -0.8, 0.0]
    )
    x, y, z = run(effect, size=200_000, rate=10.0)
    np.testing.assert_allclose(y, -0.8 / 0.6 * x, rtol=1e-9)
    assert not z.any()
    taus = [0.2, 0.7, 2.0]
    expected = [
        allan_of_density(lambda f: 36.0 * oscillator_psd(f, 0.5, 5.0), tau, 60.0) for tau in taus
    ]
    np.testing.assert_allclose(sigma(x, 10.0, taus)[0] ** 2, expected, rtol=0.1)
    angle = np.cumsum(x) / 10.0 / 3600  # deg; an oscillator's is bounded: rms rate over 2 pi f
    assert (angle - angle.mean()).std() == pytest.approx(6.0 / (2 * math.pi * 0.5 * 3600), rel=0.1)


def test_tilt_follows_the_change_of_acceleration():
    effect = build_effect("real_motion", x=2.0, y=-1.0, direction=1.0, axes=["y"])
    accel = {"accel_x": [0.5, 0.5, 1.5, 1.0], "accel_y": [0.0, 0.0, 0.0, 1.0]}
    rates = run(effect, size=4, rate=10.0, drivers=accel)[0]
    angle = np.radians(np.cumsum(rates) / 10.0 / 3600) * 1e3  # mrad
    np.testing.assert_allclose(angle, [0.0, 0.0, 2.0, 0.0], atol=1e-9)


def test_motion_is_true_and_leaks_through_misalignment():
    motion = {"name": "real_motion", "sway": 1000, "frequency": 0.5, "direction": [0.0, 0.0, 1.0]}
    leak = {"name": "misalignment", "z": 2.0, "axes": ["x"]}
    log = simulate(
        {
            "effect": [leak, motion],
            "noise": {},
            "log": {"rate": 10, "duration": "60s", "axes": ["x", "y", "z"]},
        }
    )
    x, y, z = log.rate.values
    assert z.std() > 300
    np.testing.assert_allclose(x, 2e-3 * z, rtol=1e-9)
    assert not y.any()


def test_spin_is_a_share_of_the_rotation():
    effect = build_effect("real_motion", spin=0.5, direction=[0.0, 0.0, 1.0])
    assert effect.needs() == ("rotation_rate",)
    np.testing.assert_allclose(
        run(effect, size=2, drivers={"rotation_rate": 2.0})[2], 3600.0, rtol=1e-12
    )

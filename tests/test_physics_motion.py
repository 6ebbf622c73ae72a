"""Effects of vibration, rotation, lines and real motion against their closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from gyrostab.davar import davar
from gyrostab.errors import OptionError, SchemaError
from gyrostab.kernels.coloured import band, band_psd, folded_psd, oscillator, oscillator_psd
from gyrostab.log import make_log
from gyrostab.physics.base import Windows
from gyrostab.physics.phase import fold
from gyrostab.physics.registry import make_effect
from gyrostab.simulate import environment as env
from gyrostab.simulate import simulate

from .effect_bench import random_cuts, run, same_whatever_the_cuts


def sigma(rates, rate, taus):
    """Allan deviation of one axis over the whole record."""
    log = make_log(np.atleast_2d(rates), rate=rate, unit="deg/h")
    surface = davar(log, window=log.sizes["time"], taus=[float(tau) for tau in taus], tau_max=float(max(taus)))
    return np.sqrt(surface.avar.isel(time=0).values)


def allan_of_density(density, tau, top):
    """Allan variance of a two-sided density (P16 Eq. 7), by numerical integration up to `top` [Hz]."""
    f = np.linspace(top / 400_000, top, 400_000)
    return 4.0 * np.trapezoid(density(f) * np.sin(np.pi * f * tau) ** 4 / (np.pi * f * tau) ** 2, f)


def allan_of_samples(density, k, rate):
    """Allan variance of samples with a two-sided density, k samples at a time: the mean of k has the response of Dirichlet."""
    f = np.linspace(rate / 400_000, rate / 2, 200_000)
    x = np.pi * f / rate
    return 4.0 * np.trapezoid(density(f) * np.sin(k * x) ** 4 / (k * np.sin(x)) ** 2, f)


# ------------------------------------------------------------------------------------------------- processes in continuous time


def density_of_reading(reading, f, rate):
    """Two-sided density of the samples, from the recursion itself."""
    size = reading.read.size
    noise = reading.kick @ reading.kick.T
    found = []
    for one in f:
        gain = reading.read @ np.linalg.inv(np.exp(2j * np.pi * one / rate) * np.eye(size) - reading.step)
        through = np.append(gain, 1.0)
        found.append((through @ noise @ through.conj()).real / rate)
    return np.array(found)


@pytest.mark.parametrize("average", [False, True], ids=["point", "average"])
@pytest.mark.parametrize("rate", [7.0, 400.0, 1900.0, 30_000.0])
@pytest.mark.parametrize("mount", [{}, {"resonance": 620.0, "quality": 8.0}], ids=["rigid", "mount"])
def test_samples_of_a_band_have_its_folded_density(mount, rate, average):
    reading = band(700.0, 800.0, rate, **mount, average=average)
    f = np.linspace(0.02, 0.48, 12) * rate
    expected = folded_psd(lambda g: band_psd(g, 700.0, 800.0, **mount), f, rate, 20_000.0, average=average)
    found = density_of_reading(reading, f, rate)
    strong = expected > 1e-6 * expected.max()
    np.testing.assert_allclose(found[strong], expected[strong], rtol=2e-3)
    assert strong.sum() >= 1


@pytest.mark.parametrize("average", [False, True], ids=["point", "average"])
@pytest.mark.parametrize(("frequency", "quality", "rate"), [(27.0, 12.0, 10.0), (27.0, 0.7, 100.0), (0.3, 20.0, 400.0)])
def test_samples_of_an_oscillator_have_its_folded_density(frequency, quality, rate, average):
    reading = oscillator(frequency, quality, rate, average=average)
    f = np.linspace(0.02, 0.48, 15) * rate
    expected = folded_psd(lambda g: oscillator_psd(g, frequency, quality), f, rate, 1e5, average=average)
    np.testing.assert_allclose(density_of_reading(reading, f, rate), expected, rtol=2e-3)


@pytest.mark.parametrize("density", [lambda f: band_psd(f, 700.0, 800.0), lambda f: oscillator_psd(f, 700.0, 9.0)])
def test_densities_have_unit_power(density):
    near = quad(density, 500.0, 1000.0, limit=400, epsabs=1e-12)[0]
    far = quad(density, 1e-9, 500.0)[0] + quad(density, 1000.0, 1e7, limit=2000)[0]
    assert 2.0 * (near + far) == pytest.approx(1.0, rel=1e-3)


def test_half_power_at_the_edges_of_the_band():
    low, middle, high = band_psd(np.array([700.0, math.sqrt(700.0 * 800.0), 800.0]), 700.0, 800.0)
    assert low / middle == pytest.approx(0.5, rel=1e-9)
    assert high / middle == pytest.approx(0.5, rel=1e-9)


def test_a_mount_amplifies_at_its_resonance_only():
    gain = band_psd(np.array([600.0, 700.0, 750.0]), 500.0, 900.0, resonance=600.0, quality=12.0)
    gain /= band_psd(np.array([600.0, 700.0, 750.0]), 500.0, 900.0)
    expected = [144.0, *(1.0 / ((1 - r**2) ** 2 + (r / 12) ** 2) for r in (700 / 600, 750 / 600))]
    np.testing.assert_allclose(gain, expected, rtol=1e-9)


# ------------------------------------------------------------------------------------------------------------------ vibration


def vibrating(**effect):
    """White noise of 0.003 deg/sqrt(h) at 400 Hz, with and without 50 deg/h rms of vibration at 700 to 800 Hz."""
    world = [{"profile": "vibration", "points": [[0, 13.39]], "sensor_rate": 1}]
    model = {"noise": {"N": 0.0031}, "environment": world, "log": {"rate": 400, "duration": "150s", "axes": ["x"]}}
    loud = model | {"effect": [{"name": "aliased_vibration", "sensitivity": 50 / 13.39, **effect}]}
    return [simulate(one, seed=3).rate.values for one in (model, loud)]


@pytest.mark.parametrize(
    ("sampling", "taus", "times"),
    [("point", [0.0025, 0.04, 0.4, 2.0], [8, 19, 19, 19]), ("average", [0.0025, 0.01, 0.04, 1.0], [1.3, 1.4, 1.1, 1.0])],
)
def test_a_band_on_a_multiple_of_the_sampling_rate_looks_like_n_or_q(sampling, taus, times):
    quiet, loud = vibrating(sampling=sampling)
    effect = make_effect({"name": "aliased_vibration", "sensitivity": 1, "sampling": sampling})
    f = np.linspace(1e-3, 200, 20_001)
    windows = Windows(np.zeros(1), np.ones(1), f, 400.0, ("x",), drivers={"vibration": np.full(1, 50.0)})
    folded = effect.explain(windows).spectrum["sensitivity"][0]
    added = np.array([allan_of_samples(lambda g: np.interp(g, f, folded), round(tau * 400), 400.0) for tau in taus])
    expected = np.sqrt(1 + added / ((60 * 0.0031) ** 2 / np.array(taus)))
    np.testing.assert_allclose(expected, times, rtol=0.05)
    found = sigma(loud, 400.0, taus[:3])[0] / sigma(quiet, 400.0, taus[:3])[0]
    np.testing.assert_allclose(found[:2], expected[:2], rtol=0.04)
    assert found[2] == pytest.approx(expected[2], rel=0.2 if sampling == "point" else 0.06)


def test_a_band_folds_where_it_must():
    effect = make_effect({"name": "aliased_vibration", "sensitivity": [1.0, -0.5], "axes": ["x", "y"], "low": 700, "high": 800})
    x, y = run(effect, size=2**17, rate=400.0, drivers={"vibration": 2.0})
    np.testing.assert_allclose(y, -0.5 * x, rtol=1e-12)
    assert x.std() == pytest.approx(2.0, rel=0.02)
    power = np.abs(np.fft.rfft(x)) ** 2
    f = np.fft.rfftfreq(x.size, 1 / 400.0)
    assert power[(f > 2) & (f < 97)].sum() / power.sum() > 0.93
    slower, _ = run(effect, size=2**17, rate=500.0, drivers={"vibration": 2.0})  # now it lies at 200 to 250 Hz
    power = np.abs(np.fft.rfft(slower)) ** 2
    f = np.fft.rfftfreq(slower.size, 1 / 500.0)
    assert power[f > 195].sum() / power.sum() > 0.95


def test_a_faster_instrument_and_a_mean_make_integrate_and_dump():
    common = {"environment": [{"profile": "vibration", "points": [[0, 1.0]]}], "noise": {"N": 0.0}}
    effect = {"name": "aliased_vibration", "sensitivity": 50.0}
    fast = simulate(common | {"effect": [effect], "log": {"rate": 400, "duration": "30s", "oversampling": 25, "axes": ["x"]}})
    slow = simulate(common | {"effect": [effect | {"sampling": "average"}], "log": {"rate": 400, "duration": "30s", "axes": ["x"]}})
    taus = [0.0025, 0.005, 0.01, 0.02]
    np.testing.assert_allclose(sigma(fast.rate.values, 400, taus), sigma(slow.rate.values, 400, taus), rtol=0.04)
    assert fast.rate.values.std() == pytest.approx(3.6, rel=0.06)  # 50 deg/h times rms of sinc over the band


def test_an_empty_band_is_refused():
    with pytest.raises(OptionError, match="from low = 800 to high = 700 Hz is empty"):
        make_effect({"name": "aliased_vibration", "sensitivity": 1, "low": 800, "high": 700})


def test_rectified_vibration_steps_the_mean_and_looks_like_k_at_its_edges_only():
    world = [{"profile": "vibration", "points": [[0, 0.0], [300, 10.0], [900, 20.0], [1200, 0.0]], "sensor_rate": 10}]
    effect = {"name": "vibration_rectification", "sensitivity": 1e-3, "axes": ["x"]}
    log = simulate({"environment": world, "effect": [effect], "noise": {}, "log": {"rate": 10, "duration": "1500s"}})
    assert np.unique(np.round(log.rate.sel(axis="x").values, 9)).tolist() == [0.0, 0.1, 0.4]  # g^2 of 10 and 20 g
    assert not np.any(log.rate.sel(axis=["y", "z"]).values)
    surface = davar(log, window="200s", step="50s", taus=[1.0, 5.0, 20.0])
    step, tau, length = 0.1, surface.tau.values, 200.0
    across = surface.sel(axis="x").isel(time=slice(3, 6)).avar.values  # 150..350, 200..400, 250..450: the edge is 50 s inside or more
    np.testing.assert_allclose(across, np.tile(step**2 * tau / (3 * (length - 2 * tau)), (3, 1)), rtol=0.02)
    k = np.sqrt(3 * across[1] / tau * 3600)  # deg/h^1.5
    np.testing.assert_allclose(k[:2], step / math.sqrt(length / 3600), rtol=0.06)
    inside = surface.sel(axis="x").isel(time=slice(6, 15)).avar.values  # wholly in 300..900
    assert np.all(inside < 1e-12)
    mean = surface.window_mean.sel(axis="x").values
    np.testing.assert_allclose([mean[0], mean[8], mean[19], mean[-1]], [0.0, 0.1, 0.4, 0.0], atol=1e-9)


def test_vibration_rectification_is_even_and_acceleration_odd():
    rectified = make_effect({"name": "vibration_rectification", "sensitivity": 2e-3, "quartic": 1e-5})
    np.testing.assert_allclose(run(rectified, size=2, drivers={"vibration": [-10.0, 10.0]})[0], 0.2 + 0.1, rtol=1e-12)
    odd = make_effect({"name": "g_sensitivity", "x": 0.01, "y": -0.02, "z": 0.5})
    drivers = {"accel_x": [1.0, -1.0], "accel_y": [0.5, -0.5], "accel_z": [0.1, -0.1]}
    np.testing.assert_allclose(run(odd, size=2, drivers=drivers)[2], [0.05, -0.05], rtol=1e-12)


def test_magnetic_bias_is_its_scalar_product_and_needs_only_what_it_uses():
    effect = make_effect({"name": "magnetic", "y": 0.002, "z": -0.01, "axes": ["z"]})
    assert effect.needs() == ("mag_y", "mag_z")
    np.testing.assert_allclose(run(effect, size=2, drivers={"mag_y": [50, 0], "mag_z": [0, 20]}), [[0.1, -0.2]], rtol=1e-12)


def test_gravity_in_a_turning_tool_is_a_line_of_its_amplitude():
    world = [{"profile": "rotation", "points": [[0, 72.0]], "inclination": 30.0}]
    effect = {"name": "g_sensitivity", "x": 0.4, "axes": ["y"]}
    log = simulate({"environment": world, "effect": [effect], "noise": {}, "log": {"rate": 50, "duration": "400s"}})
    top = 0.371 / 0.2
    assert sigma(log.rate.sel(axis="y").values, 50, [top])[0, 0] == pytest.approx(0.7246 * 0.4 * 0.5, rel=0.01)


# ---------------------------------------------------------------------------------------------------------------------- lines


def sinusoid_avar(amplitude, f, tau):
    x = math.pi * f * np.asarray(tau)
    return amplitude**2 * np.sin(x) ** 4 / x**2


def test_a_steady_line_has_the_allan_variance_of_a_sinusoid():
    effect = make_effect({"name": "spectral_line", "amplitude": [0.2, -0.1, 0.0], "frequency": 0.53, "phase": [30, 0, 0]})
    rates = run(effect, size=40_000, rate=20.0)
    taus = np.array([0.05, 0.25, 0.7, 1.0, 2.3, 5.0])
    for row, amplitude in ((0, 0.2), (1, 0.1)):
        np.testing.assert_allclose(sigma(rates[row], 20.0, taus)[0] ** 2, sinusoid_avar(amplitude, 0.53, taus), rtol=0.01)
    assert not rates[2].any()
    fine = np.arange(1, 40) * 0.05
    found = sigma(rates[0], 20.0, fine)[0]
    assert fine[found.argmax()] == pytest.approx(0.371 / 0.53, abs=0.026)
    assert found.max() == pytest.approx(0.7246 * 0.2, rel=0.005)
    t = np.arange(3) / 20.0
    expected = [0.2 * quad(lambda s: math.sin(2 * math.pi * 0.53 * s + math.pi / 6), one, one + 0.05)[0] / 0.05 for one in t]
    np.testing.assert_allclose(rates[0][:3], expected, rtol=1e-9)


def test_a_line_above_nyquist_folds_with_the_response_of_the_mean():
    effect = make_effect({"name": "spectral_line", "amplitude": 1.0, "frequency": 27.0})
    rates = run(effect, size=4000, rate=20.0)[0]
    spectrum = np.abs(np.fft.rfft(rates)) / 2000
    f = np.fft.rfftfreq(4000, 1 / 20.0)
    assert f[spectrum.argmax()] == pytest.approx(7.0)
    assert spectrum.max() == pytest.approx(abs(np.sinc(27 / 20)), rel=1e-6)
    np.testing.assert_allclose(fold(np.array([7.0, 13.0, 27.0, 33.0]), 20.0), 7.0)


def test_a_resonance_has_the_allan_variance_of_its_density_and_one_motion():
    effect = make_effect({"name": "spectral_line", "amplitude": [0.2, -0.4], "axes": ["x", "z"], "frequency": 3.0, "quality": 10})
    x, z = run(effect, size=200_000, rate=20.0)
    np.testing.assert_allclose(z, -2.0 * x, rtol=1e-12)
    taus = [0.05, 0.1, 0.2, 0.5, 1.0]
    expected = [allan_of_density(lambda f: 0.02 * oscillator_psd(f, 3.0, 10.0), tau, 200.0) for tau in taus]
    np.testing.assert_allclose(sigma(x, 20.0, taus)[0] ** 2, expected, rtol=0.08)


def test_lines_lock_to_a_changing_rotation():
    fast, factor = 50 * 64, 64
    speed = 90.0 + 6.0 * (np.arange(60 * fast) // factor) / 50  # held inside each sample
    turns = np.concatenate([[0.0], np.cumsum(speed)[:-1]]) / fast / 360.0 + speed / fast / 720.0
    effect = make_effect(
        {"name": "rotation_line", "amplitude": [0.5, 1.0], "axes": ["x", "y"], "order": 2, "harmonics": 3, "phase": [0.0, 90.0]}
    )
    rates = run(effect, size=3000, rate=50.0, drivers={"rotation_rate": speed[::factor]})
    for row, (amplitude, phase) in enumerate(((0.5, 0.0), (1.0, math.pi / 2))):
        wave = sum(amplitude / k * np.cos(k * (2 * math.pi * 2 * turns + phase)) for k in (1, 2, 3))
        np.testing.assert_allclose(rates[row], wave.reshape(-1, factor).mean(axis=1), atol=3e-4)


def test_a_part_of_a_line_is_refused():
    with pytest.raises(OptionError, match=r"'harmonics': 2\.5 is not a whole number of lines"):
        make_effect({"name": "rotation_line", "amplitude": 1, "harmonics": 2.5})


def test_a_pump_is_another_channel():
    strokes = env.rotation([[0, 720.0]], duration=100, accelerations=False)[["rotation_rate"]]
    strokes = strokes.rename(rotation_rate="pump", time_rotation_rate="time_pump")
    effect = {"name": "rotation_line", "amplitude": 0.3, "driver": "pump", "axes": ["x"]}
    log = simulate({"effect": [effect], "noise": {}, "log": {"rate": 40, "duration": "100s"}}, environment=strokes)
    taus = [0.1, 0.371 / 2, 0.4]
    taus = [round(tau * 40) / 40 for tau in taus]
    found = sigma(log.rate.sel(axis="x").values, 40.0, taus)[0] ** 2
    np.testing.assert_allclose(found, sinusoid_avar(0.3, 2.0, taus), rtol=0.01)


# ------------------------------------------------------------------------------------------------------------------- rotation


def test_scale_factor_errors_are_those_of_the_catalogue():
    speed = 6 * 180.0  # 180 r/min in deg/s
    one = run(make_effect({"name": "scale_factor", "linear": 100}), size=1, drivers={"rotation_rate": speed})
    np.testing.assert_allclose(one, 388.8, rtol=1e-12)
    both = {"rotation_rate": [speed, -speed], "temperature": [35.0, 35.0]}
    linear, lopsided, cubic, thermal = (
        run(make_effect({"name": "scale_factor", **table}), size=2, drivers=both)[0]
        for table in ({"linear": 1}, {"asymmetry": 1}, {"cubic": 1e-6}, {"thermal": 0.1})
    )
    np.testing.assert_allclose(linear, [3.888, -3.888], rtol=1e-12)
    np.testing.assert_allclose(lopsided, [3.888, 3.888], rtol=1e-12)
    np.testing.assert_allclose(cubic, np.array([3.888, -3.888]) * 1e-6 * speed**2, rtol=1e-12)
    np.testing.assert_allclose(thermal, [3.888, -3.888], rtol=1e-12)


def test_a_ramp_of_rotation_is_a_rate_ramp_through_the_scale_factor():
    world = [{"profile": "rotation", "points": [[0, 0.0], [600, 60.0]], "accelerations": False}]
    effect = {"name": "scale_factor", "linear": 100, "axes": ["z"]}
    log = simulate({"environment": world, "effect": [effect], "noise": {}, "log": {"rate": 10, "duration": "600s"}})
    ramp = 1e-4 * 60 * 3600 / (600 / 3600)  # deg/h^2
    taus = [1.0, 10.0, 100.0]
    expected = ramp * np.array(taus) / 3600 / math.sqrt(2)
    np.testing.assert_allclose(sigma(log.rate.sel(axis="z").values, 10.0, taus)[0], expected, rtol=1e-3)


def test_scale_factor_of_the_true_rate_needs_no_channel():
    effect = make_effect({"name": "scale_factor", "linear": 1000, "rotation": "true"})
    assert effect.needs() == ()
    found = run(effect, size=2, true={"x": 15.0, "z": [1.0, -1.0]})
    np.testing.assert_allclose(found, [[0.015, 0.015], [0, 0], [0.001, -0.001]], rtol=1e-12)


def test_misalignment_leaks_the_true_rate_of_other_axes_only():
    effect = make_effect({"name": "misalignment", "z": 0.5, "y": -1.0})
    found = run(effect, size=2, true={"x": 7.0, "y": [100.0, 0.0], "z": [2000.0, 1000.0]})
    np.testing.assert_allclose(found, [[1.0 - 0.1, 0.5], [1.0, 0.5], [-0.1, 0.0]], rtol=1e-12)
    with pytest.raises(SchemaError, match="needs the rate of axis 'z', which the log does not have; it has x, y"):
        run(effect, size=2, axes=("x", "y"))


def test_misalignment_sees_the_turning_of_the_tool():
    world = [{"profile": "rotation", "points": [[0, 6 * 180.0]], "axis": "z", "accelerations": False}]
    effect = {"name": "misalignment", "z": 1.0, "axes": ["x"]}
    log = simulate({"environment": world, "effect": [effect], "noise": {}, "log": {"rate": 10, "duration": "10s"}})
    np.testing.assert_allclose(log.rate.isel(time=5).values, [3888.0, 0.0, 3.888e6], rtol=1e-9)


def tool_axes(inclination, azimuth, toolface):
    """Directions of x, y, z in north, east, down, by rotation matrices: turn by azimuth, lean, turn by toolface about the tool."""

    def about(axis, angle):
        c, s = math.cos(angle), math.sin(angle)
        return np.array({"y": [[c, 0, s], [0, 1, 0], [-s, 0, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis])

    return about("z", azimuth) @ about("y", inclination) @ about("z", toolface)


@given(st.floats(-90, 90), st.floats(0, 180), st.floats(-360, 360), st.floats(-360, 360))
@settings(max_examples=60, deadline=None)
def test_earth_rate_of_a_standing_tool_is_the_rotated_vector(latitude, inclination, azimuth, toolface):
    effect = make_effect({"name": "earth_rate", "latitude": latitude, "inclination": inclination, "azimuth": azimuth, "toolface": toolface})
    seen = run(effect, size=2, drivers={"rotation_rate": 0.0})[:, 1]
    lat = math.radians(latitude)
    earth = 15.041067 * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    axes = tool_axes(*np.radians([inclination, azimuth, toolface]))
    np.testing.assert_allclose(seen, axes.T @ earth, atol=1e-9)


def test_earth_rate_of_a_turning_tool_is_a_line_in_quadrature():
    effect = make_effect({"name": "earth_rate", "latitude": 50, "inclination": 40, "azimuth": 110})
    rate, speed, size = 20.0, 90.0, 20_000
    x, y, z = run(effect, size=size, rate=rate, drivers={"rotation_rate": speed})
    along, high, right = effect.components()
    assert math.hypot(along, high, right) == pytest.approx(15.041067, rel=1e-9)
    across = math.hypot(high, right)
    np.testing.assert_allclose(z, along, rtol=1e-9)
    whole = slice(0, size - size % 80)  # turns of 80 samples
    wave = np.exp(-2j * np.pi * 0.25 * (np.arange(size) + 0.5) / rate)[whole]
    ax, ay = (2 * (one[whole] * wave).mean() for one in (x, y))
    assert abs(ax) == pytest.approx(across * np.sinc(0.25 / rate), rel=1e-6)
    assert ay / ax == pytest.approx(1j, abs=1e-6)  # y stands a quarter ahead of x
    top = sigma(x, rate, [0.371 / 0.25])[0, 0]
    assert top == pytest.approx(0.7246 * across, rel=0.01)


def test_earth_rate_and_gravity_share_the_frame_of_the_tool():
    """Inclination 90, pointing north at the pole: the earth turns about the plumb line, so its rate is along the measured gravity."""
    world = [{"profile": "rotation", "points": [[0, 30.0]], "inclination": 90.0, "toolface": 25.0}]
    effect = {"name": "earth_rate", "latitude": 90, "inclination": 90, "toolface": 25}
    log = simulate({"environment": world, "effect": [effect], "noise": {}, "log": {"rate": 10, "duration": "30s"}})
    middle = (
        log.accel_x.interp(time_accel_x=log.time + np.timedelta64(50, "ms")),
        log.accel_y.interp(time_accel_y=log.time + np.timedelta64(50, "ms")),
    )
    for axis, acceleration in zip("xy", middle, strict=True):
        np.testing.assert_allclose(log.rate.sel(axis=axis).values[:-1], 15.041067 * acceleration.values[:-1], atol=0.02)


def test_axes_of_other_names_say_where_they_look():
    with pytest.raises(OptionError, match="axis 'north' is not x, y or z; say where it looks with off and around"):
        run(make_effect({"name": "earth_rate", "latitude": 45}), size=2, axes=("north",), drivers={"rotation_rate": 0.0})
    across = make_effect({"name": "earth_rate", "latitude": 30, "around": [0, 180]})
    seen = run(across, size=1, axes=("a", "b"), drivers={"rotation_rate": 0.0})[:, 0]
    np.testing.assert_allclose(seen, 15.041067 * np.array([0.8660254, -0.8660254]), rtol=1e-6)
    effect = make_effect({"name": "earth_rate", "latitude": 30, "off": [90, 0, 45], "around": [0, 0, 0]})
    seen = run(effect, size=1, axes=("a", "b", "c"), drivers={"rotation_rate": 0.0})[:, 0]
    np.testing.assert_allclose(seen, 15.041067 * np.array([0.8660254, -0.5, (0.8660254 - 0.5) / math.sqrt(2)]), rtol=1e-6)


# ---------------------------------------------------------------------------------------------------------------- real motion


def test_sway_is_one_motion_in_its_direction_with_no_floor():
    effect = make_effect({"name": "real_motion", "sway": 10, "frequency": 0.5, "quality": 5, "direction": [0.6, -0.8, 0.0]})
    x, y, z = run(effect, size=200_000, rate=10.0)
    np.testing.assert_allclose(y, -0.8 / 0.6 * x, rtol=1e-9)
    assert not z.any()
    taus = [0.2, 0.7, 2.0]
    expected = [allan_of_density(lambda f: 36.0 * oscillator_psd(f, 0.5, 5.0), tau, 60.0) for tau in taus]
    np.testing.assert_allclose(sigma(x, 10.0, taus)[0] ** 2, expected, rtol=0.1)
    angle = np.cumsum(x) / 10.0 / 3600  # deg; an oscillator's is bounded: rms rate over 2 pi f
    assert (angle - angle.mean()).std() == pytest.approx(6.0 / (2 * math.pi * 0.5 * 3600), rel=0.1)


def test_tilt_of_the_mounting_turns_by_what_the_acceleration_changed():
    effect = make_effect({"name": "real_motion", "x": 2.0, "y": -1.0, "direction": 1.0, "axes": ["y"]})
    accel = {"accel_x": [0.5, 0.5, 1.5, 1.0], "accel_y": [0.0, 0.0, 0.0, 1.0]}
    rates = run(effect, size=4, rate=10.0, drivers=accel)[0]
    angle = np.radians(np.cumsum(rates) / 10.0 / 3600) * 1e3  # mrad
    np.testing.assert_allclose(angle, [0.0, 0.0, 2.0, 0.0], atol=1e-9)


def test_motion_is_true_and_leaks_through_misalignment():
    motion = {"name": "real_motion", "sway": 1000, "frequency": 0.5, "direction": [0.0, 0.0, 1.0]}
    leak = {"name": "misalignment", "z": 2.0, "axes": ["x"]}
    log = simulate({"effect": [leak, motion], "noise": {}, "log": {"rate": 10, "duration": "60s", "axes": ["x", "y", "z"]}})
    x, y, z = log.rate.values
    assert z.std() > 300
    np.testing.assert_allclose(x, 2e-3 * z, rtol=1e-9)
    assert not y.any()


def test_spin_is_a_share_of_the_rotation():
    effect = make_effect({"name": "real_motion", "spin": 0.5, "direction": [0.0, 0.0, 1.0]})
    assert effect.needs() == ("rotation_rate",)
    np.testing.assert_allclose(run(effect, size=2, drivers={"rotation_rate": 2.0})[2], 3600.0, rtol=1e-12)


# ----------------------------------------------------------------------------------------------- explain says what generate does


def windows_of(rates, rate, length, drivers, own=None, frequency=None):
    """Windows side by side, with the mean of the drivers (rms of vibration), and the means of the rates."""
    n = rates.shape[1] // length
    edges = np.arange(n + 1) * length / rate

    def mean(values):
        return np.broadcast_to(np.asarray(values, float), rates.shape[1])[: n * length].reshape(n, length).mean(axis=1)

    reduced = {name: np.sqrt(mean(np.square(values))) if name == "vibration" else mean(values) for name, values in drivers.items()}
    windows = Windows(
        begin=edges[:-1],
        end=edges[1:],
        frequency=np.geomspace(0.1, rate / 2, 12) if frequency is None else frequency,
        rate=rate,
        axes=("x", "y", "z"),
        drivers=reduced,
        own={axis: mean(values) for axis, values in (own or {}).items()},
    )
    return windows, np.stack([mean(row) for row in rates])


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
    effect = make_effect(table)
    rates = run(effect, size=4000, rate=10.0, drivers=DRIVERS, true=TRUE)
    windows, means = windows_of(rates, 10.0, 400, DRIVERS, own=TRUE)
    design = effect.explain(windows).mean
    each = {name: np.atleast_1d(getattr(effect, name)) for name in design}
    total = sum(np.broadcast_to(values, means.shape) * each[name].reshape(-1, 1) for name, values in design.items())
    assert np.abs(means).max() > 1e-3
    np.testing.assert_allclose(total, means, atol=2e-3 * np.abs(means).max())


def test_tilt_leaves_the_slope_of_the_acceleration_in_the_means():
    effect = make_effect({"name": "real_motion", "x": 0.5, "z": -0.2, "direction": [1.0, -0.5, 0.2]})
    rates = run(effect, size=4000, rate=10.0, drivers=DRIVERS)
    windows, means = windows_of(rates, 10.0, 100, DRIVERS)
    design = effect.explain(windows).mean
    total = 0.5 * design["x"] - 0.2 * design["z"]
    np.testing.assert_allclose(total[:, 1:-1], means[:, 1:-1], atol=0.02 * np.abs(means).max())


@pytest.mark.parametrize(
    "table",
    [
        {"name": "aliased_vibration", "sensitivity": 0.5, "low": 11.0, "high": 13.0},
        {"name": "aliased_vibration", "sensitivity": 2.0, "low": 11.0, "high": 13.0, "resonance": 9.0, "quality": 6, "sampling": "average"},
        {"name": "spectral_line", "amplitude": 0.5, "frequency": 3.0, "quality": 4.0},
        {"name": "spectral_line", "amplitude": 0.5, "frequency": 17.7},
        {"name": "rotation_line", "amplitude": 0.5, "harmonics": 3},
        {"name": "real_motion", "sway": 3.0, "frequency": 1.1, "quality": 3.0},
    ],
    ids=lambda table: "-".join(map(str, [table["name"], *list(table.values())[2:]])),
)
def test_spectra_are_those_that_are_predicted(table):
    effect = make_effect(table)
    rate, length, count = 10.0, 1000, 60
    drivers = {"vibration": 2.0, "rotation_rate": 417.6}
    rates = run(effect, size=length * count, rate=rate, drivers=drivers, axes=("x", "y", "z"))
    centres = np.arange(1, 100) * 0.05
    windows, _ = windows_of(rates, rate, length, drivers, frequency=centres)
    power = np.abs(np.fft.rfft(rates[0].reshape(count, length) * np.sqrt(8 / 3) * np.hanning(length), axis=1)) ** 2 / (length * rate)
    f = np.fft.rfftfreq(length, 1 / rate)
    prediction = effect.explain(windows)
    (name,) = prediction.spectrum
    predicted = float(np.atleast_1d(getattr(effect, name))[0]) ** 2 * np.broadcast_to(prediction.spectrum[name], (count, 99)).mean(axis=0)
    found = power[:, 3:498].mean(axis=0).reshape(99, 5).mean(axis=1)
    for bands in (9, 11):
        wide = [values.reshape(-1, bands).sum(axis=1) for values in (predicted, found)]
        np.testing.assert_allclose(*wide, atol=0.04 * predicted.sum())
    assert predicted.sum() == pytest.approx(found.sum(), rel=0.06)
    if prediction.line is not None:
        place = np.atleast_2d(prediction.line)[0, 0]
        assert place == pytest.approx(f[power.mean(axis=0).argmax()], abs=0.15)


# ------------------------------------------------------------------------------------------------------------- all of the family


@given(st.integers(0, 2**32 - 1), st.sampled_from(["bent", "band", "resonance", "lines", "earth", "errors"]))
@settings(max_examples=24, deadline=None)
def test_chunks_never_matter(seed, which):
    table = {
        "bent": {"name": "real_motion", "sway": 3, "spin": 0.2, "x": 0.1, "z": -0.3, "direction": [1.0, 0.5, -0.5]},
        "band": {"name": "aliased_vibration", "sensitivity": [1, 2, 3], "resonance": 650, "sampling": "average"},
        "resonance": {"name": "spectral_line", "amplitude": 1, "frequency": 3.3, "quality": 30},
        "lines": {"name": "rotation_line", "amplitude": [1, 2, 3], "harmonics": 4, "phase": [1, 2, 3]},
        "earth": {"name": "earth_rate", "latitude": 30, "inclination": 50, "azimuth": 70},
        "errors": {"name": "scale_factor", "linear": 30, "asymmetry": -10, "cubic": 0.5, "thermal": 2},
    }[which]
    drivers = {name: values[:700] for name, values in DRIVERS.items()}
    same_whatever_the_cuts(make_effect(table), random_cuts(seed, 700), size=700, drivers=drivers, seed=seed)

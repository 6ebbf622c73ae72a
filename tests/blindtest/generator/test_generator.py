"""Physics of the generator against closed forms."""

from __future__ import annotations

import math

import allantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from gyrostab.blindtest.generator import electronics, instrument, telemetry
from gyrostab.blindtest.generator import noise as floor
from gyrostab.blindtest.scoring.baseline_detectors import (
    allan_band,
    allan_variance,
    band_excess,
    log_allan,
    octaves,
)


@pytest.mark.parametrize(("thickness", "diffusivity"), [(0.012, 2.2e-7), (0.007, 3e-7)])
def test_coil_step_response_decays_with_the_slowest_mode(thickness, diffusivity):
    tau = instrument.diffusion_time(thickness, diffusivity)
    face = np.r_[20.0, np.full(round(8 * tau), 30.0)]
    inner = instrument.layer_temperatures(
        face, dt=1.0, layers=48, thickness=thickness, diffusivity=diffusivity
    )[-1]
    late = slice(round(3 * tau), round(6 * tau))
    slope = np.polyfit(np.arange(face.size)[late], np.log(30.0 - inner[late]), 1)[0]
    assert -1 / slope == pytest.approx(tau, rel=5e-3)


def test_coil_lags_a_steady_ramp_by_a_parabola():
    d, kappa, speed, layers = 0.012, 2.2e-7, 1 / 60, 48
    layer = instrument.layer_temperatures(
        speed * np.arange(4000.0), dt=1.0, layers=layers, thickness=d, diffusivity=kappa
    )[:, -1]
    x = (np.arange(layers) + 0.5) * d / layers
    behind = speed * (d * x - x**2 / 2) / kappa
    np.testing.assert_allclose(speed * 3999 - layer, behind, rtol=0.01, atol=2e-3)


def test_coil_conserves_heat():
    d, kappa, layers = 0.012, 2.2e-7, 24
    face = 20 + 5 * np.sin(np.arange(2000) / 150.0)
    layer = instrument.layer_temperatures(
        face, dt=1.0, layers=layers, thickness=d, diffusivity=kappa
    )
    into = (
        kappa * (face - layer[0]) / (d / layers / 2)
    )  # through half a cell, per unit of area and heat capacity
    entered = np.sum(0.5 * (into[1:] + into[:-1]))
    assert entered == pytest.approx((layer[:, -1] - layer[:, 0]).sum() * d / layers, rel=1e-9)


def test_quadrupole_cancels_shupe_except_for_trim_error():
    ramp = 20 + np.arange(3000) / 60.0
    speed = np.gradient(instrument.layer_temperatures(ramp, dt=1.0, layers=24), axis=1)[:, -1]
    even, trimmed = (instrument.layer_weights(24, trim=trim) @ speed for trim in (0.0, 1e-3))
    expected = 2e-3 * 500**2 / 60  # half to half asymmetry of 2 trim: 2 trim L^2 dT/dt
    assert abs(even) < 1e-3 * expected
    assert trimmed == pytest.approx(expected, rel=1e-3)


def test_outer_layers_of_a_quadrupole_are_the_ends_of_the_fiber():
    weights = np.abs(instrument.layer_weights(24))
    assert weights[0] == weights.max()  # wound from the middle of the fiber, on the spool
    assert weights[:4].min() > 5 * weights[-4:].max()


def test_detector_noise_terms_have_their_power_laws():
    power = np.array([1e-6, 4e-6])
    shot = instrument.relative_psd(power, rin=0.0, load=1e12)
    thermal = instrument.relative_psd(power, rin=0.0, load=1.0)
    excess = instrument.relative_psd(power, rin=1e-7)
    assert shot[0] / shot[1] == pytest.approx(4.0, rel=1e-3)
    assert thermal[0] / thermal[1] == pytest.approx(16.0, rel=1e-3)
    assert excess[0] / excess[1] == pytest.approx(1.0, rel=1e-3)
    assert instrument.detector_psd(np.array([1e-5]))["shot"][0] == pytest.approx(
        2 * 1.602176634e-19 * 0.9e-5
    )


def test_shot_noise_level_matches_textbook():
    power, depth = 20e-6, math.pi / 2
    detected = power * (1 + math.cos(depth))
    phase = (
        math.sqrt(2 * 1.602176634e-19 / (0.9 * detected))
        * (1 + math.cos(depth))
        / math.sin(depth)
        / math.sqrt(2)
    )
    level = instrument.relative_psd(np.array([power]), rin=0.0, load=1e12, depth=depth)[0]
    assert math.sqrt(level / 2) == pytest.approx(phase, rel=1e-3)


def test_reset_count_follows_the_rate():
    rate, seconds, dt = 22.0, 500.0, 0.01
    phase = instrument.ramp_phase(np.full(round(seconds / dt), rate), dt=dt)
    expected = 0.04 * math.radians(rate / 3600) / (1.45 * 1.55e-6) * seconds
    assert (np.diff(phase) < 0).sum() == math.floor(expected)


def test_dead_zone_holds_at_zero_and_is_odd():
    w = np.linspace(-1, 1, 201)
    out = instrument.apply_dead_zone(w, width=0.3)
    assert (out[np.abs(w) <= 0.3] == 0).all()
    np.testing.assert_allclose(out, -out[::-1], atol=1e-7)


def test_mount_has_the_response_of_a_damped_spring():
    f = np.array([10.0, 60.0, 120.0, 400.0])
    _, got = signal.freqz(
        *instrument.mount_filter(120.0, quality=8.0), worN=f, fs=instrument.FAST_HZ
    )
    x = f / 120.0
    expected = np.sqrt((1 + (x / 8) ** 2) / ((1 - x**2) ** 2 + (x / 8) ** 2))
    np.testing.assert_allclose(
        np.abs(got), expected, rtol=0.12
    )  # the bilinear rule bends the upper end


@pytest.mark.parametrize(("kind", "power"), [("point", 0), ("dump", 1), ("cic2", 2)])
def test_line_above_nyquist_is_aliased_with_the_gain_of_the_filter(kind, power):
    f, rate = 730.0, 400.0
    x = np.sqrt(2) * np.sin(2 * np.pi * f * np.arange(200_000) / instrument.FAST_HZ)
    logged = instrument.decimate(x, rate=rate, kind=kind)[50:]
    m = instrument.FAST_HZ / rate
    factor = (
        abs(math.sin(math.pi * f / rate) / (m * math.sin(math.pi * f / instrument.FAST_HZ)))
        ** power
    )
    assert logged.std() == pytest.approx(factor, rel=2e-3)
    freq, density = signal.periodogram(logged, fs=rate)
    assert freq[np.argmax(density)] == pytest.approx(800.0 - f, abs=0.1)


def test_folded_density_matches_the_decimator():
    rng = np.random.default_rng(2)
    mount = instrument.mount_filter(650.0, quality=6.0)
    x = signal.lfilter(*mount, instrument.band_noise(rng, 800_000, low=600, high=800))
    logged = instrument.decimate(x, rate=400.0, kind="dump")
    freq, measured = signal.welch(logged, fs=400.0, nperseg=256)
    expected = 2 * instrument.folded_psd(
        freq[2:-2], rate=400.0, kind="dump", low=600, high=800, mount=mount
    )
    assert np.median(measured[2:-2] / expected) == pytest.approx(1.0, abs=0.03)
    assert logged.var() == pytest.approx(np.trapezoid(expected, freq[2:-2]), rel=0.05)


def test_rectification_saturates():
    levels = np.array([0.1, 100.0])
    low, high = instrument.rectify(levels, exponent=1.9, saturation=8.0)
    assert low == pytest.approx(0.1**1.9, rel=1e-3)
    assert high == pytest.approx(8.0**1.9, rel=0.02)


@pytest.mark.parametrize("method", ["spectrum", "relaxations"])
def test_noise_floor_has_the_allan_deviation_of_its_coefficients(method):
    rate, size = 10.0, 2**16
    rng = np.random.default_rng(3)
    tau = np.array([1.0, 8.0, 64.0, 512.0])
    terms = {
        "N": (
            lambda: floor.white_level(0.01) * math.sqrt(rate) * rng.standard_normal(size),
            0.01**2 * 3600 / tau,
        ),
        "B": (
            lambda: floor.flicker(rng, size, b=0.3, rate=rate, method=method),
            np.full(4, 2 * math.log(2) / math.pi * 0.3**2),
        ),
        "K": (lambda: floor.random_walk(rng, size, k=0.5, rate=rate), 0.5**2 * tau / 3600 / 3),
    }
    for name, (draw, expected) in terms.items():
        records = 8
        got = np.mean(
            [
                allantools.oadev(draw(), rate=rate, data_type="freq", taus=tau)[1] ** 2
                for _ in range(records)
            ],
            axis=0,
        )
        freedom = records * size / rate / tau
        np.testing.assert_array_less(
            np.abs(got / expected - 1), 0.04 + 5 / np.sqrt(freedom), err_msg=name
        )


def test_angle_quantization_has_the_allan_variance_of_q():
    rate, q = 10.0, 2.0
    rng = np.random.default_rng(4)
    out = floor.quantize_angle(rng.normal(20.0, 8.0, 100_000), q=q, rate=rate)
    plain = floor.quantize_angle(rng.normal(20.0, 8.0, 100_000), q=0.0, rate=rate)
    urad = math.degrees(1e-6) * 3600
    tau, dev, _, _ = allantools.oadev(out, rate=rate, data_type="freq", taus=[0.1, 0.2])
    base = allantools.oadev(plain, rate=rate, data_type="freq", taus=[0.1, 0.2])[1]
    np.testing.assert_allclose(dev**2 - base**2, 3 * (q * urad) ** 2 / tau**2, rtol=0.15)


def test_floor_density_integrates_to_the_variance_of_q():
    f = (np.arange(20_000) + 0.5) / 20_000 * 5.0
    q = 1.5 * math.degrees(1e-6) * 3600
    density = floor.floor_psd(f, noise={"Q": 1.5}, rate=10.0)
    assert 2 * density.mean() * 5.0 == pytest.approx(2 * q**2 * 100.0, rel=1e-6)


def test_allan_variance_matches_allantools():
    x = np.cumsum(np.random.default_rng(5).normal(size=5000))
    factors = octaves(x.size)
    expected = allantools.oadev(x, rate=1.0, data_type="freq", taus=factors)[1] ** 2
    np.testing.assert_allclose(allan_variance(x, factors), expected, rtol=1e-9)


@pytest.mark.parametrize(("size", "bands", "records"), [(2000, 8, 100), (60_000, 2, 50)])
def test_noise_exceeds_its_allan_band_in_one_percent(size, bands, records):
    rate, noise = 10.0, {"N": 0.003, "B": 0.004, "K": 0.05, "Q": 0.0}
    rng = np.random.default_rng(6)
    missing = telemetry.draw_losses(rng, size, share=0.2, frame=10, burst=4)
    out = 0
    for _ in range(bands):
        band = allan_band(noise=noise, rate=rate, missing=missing, rng=rng)
        for _ in range(records):
            x = floor.white_level(0.003) * math.sqrt(rate) * rng.standard_normal(
                size
            ) + floor.flicker(rng, size, b=0.004, rate=rate)
            x += floor.random_walk(rng, size, k=0.05, rate=rate)
            x[missing] = np.nan
            out += band_excess(x, band) > band["limit"]
    assert (
        0.0015 * bands * records <= out + (size > 2000) <= 0.03 * bands * records + 2
    )  # the tail of a chi-square is longer than normal


def test_log_allan_of_long_records_matches_the_direct_one():
    x = np.random.default_rng(7).normal(size=60_000)
    x[::7] = np.nan
    direct = allan_variance(x, octaves(x.size))
    np.testing.assert_allclose(np.exp(log_allan(x)), direct, rtol=0.06)


@given(st.floats(0.02, 0.6), st.floats(1.0, 8.0))
@settings(max_examples=15)
def test_telemetry_loses_the_given_share(share, burst):
    lost = telemetry.draw_losses(
        np.random.default_rng(7), 200_000, share=share, frame=5, burst=burst
    )
    assert lost.mean() == pytest.approx(share, abs=0.06)


def test_earth_and_gravity_rotate_together():
    angle = instrument.toolface(
        instrument.rotation(np.random.default_rng(8), 600.0, dt=0.1), dt=0.1
    )
    x, y = instrument.cross_axis(angle, across=9.0)
    np.testing.assert_allclose(np.hypot(x, y), 9.0)
    gx, gy, _ = instrument.gravity(angle, inclination=40.0)
    np.testing.assert_allclose(gx * y, gy * x, atol=1e-9)


@pytest.mark.parametrize("corner", [0.3, 0.8])
def test_level_below_a_low_pass_matches_long_means(corner):
    common = electronics._low_passed(np.random.default_rng(1), 400_000, corner=corner)
    means = common.reshape(-1, 50).mean(axis=1) * np.sqrt(50.0)
    power = electronics._low_pass((np.arange(1000) + 0.5) / 1000, corner)
    assert means.std() == pytest.approx(1 / math.sqrt(power.mean()), rel=0.03)

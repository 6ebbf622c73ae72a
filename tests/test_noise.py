"""The noise table against the integral that defines the Allan variance, and against simulated noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from gyrostab.allan.davar import davar
from gyrostab.ingest.make_log import make_log
from gyrostab.noise import LAWS, TERMS, URAD_PER_S, avar_columns, model_avar, sample_squares
from tests.support.noise_records import flicker, quantization, random_walk, white

HOUR = 3600.0


def integral(psd, tau):
    """Allan variance from a two-sided rate PSD: 4 int_0^inf S(f) sin^4(pi f tau) / (pi f tau)^2 df (P16 Eq. 7, with df)."""

    def integrand(u):  # u = pi f tau
        return 4 * psd(u / (np.pi * tau)) * np.sin(u) ** 4 / u**2 / (np.pi * tau)

    total = sum(quad(integrand, j * np.pi, (j + 1) * np.pi, epsrel=1e-9)[0] for j in range(400))
    edge = 400 * np.pi
    return (
        total
        + 4 * 3 / 8 * quad(lambda u: psd(u / (np.pi * tau)) / u**2 / (np.pi * tau), edge, np.inf)[0]
    )


@pytest.mark.parametrize("tau", [0.02, 1.0, 300.0])
def test_table_is_the_integral_of_the_spectrum(tau):
    for term, psd in (
        ("N", lambda f: HOUR * f**0),  # (deg/h)^2/Hz of 1 deg/sqrt(h): 1 deg^2/h = 3600 (deg/h)^2 s
        ("B", lambda f: 1 / (2 * np.pi * f)),
        ("K", lambda f: 1 / (HOUR * (2 * np.pi * f) ** 2)),
    ):
        assert integral(psd, tau) == pytest.approx(float(LAWS[term].avar(tau)), rel=1e-3), term


def test_rate_random_walk_needs_the_density_of_ieee_952():
    """P16 Table 1 prints K^2 / (2 pi f^2); the Allan variance K^2 tau / 3 asks for (K / 2 pi f)^2, which is 2 pi less."""
    printed = integral(lambda f: 1 / (HOUR * 2 * np.pi * f**2), 10.0)
    assert printed / float(LAWS["K"].avar(10.0)) == pytest.approx(2 * np.pi, rel=1e-3)


def test_quantization_follows_from_independent_angles():
    """An angle error of Q at both ends: the second difference has the variance 6 Q^2, over 2 tau^2."""
    tau = 0.5
    angle = np.degrees(1e-6)  # 1 urad in degree
    assert float(LAWS["Q"].avar(tau)) == pytest.approx(
        6 * angle**2 / (2 * (tau / HOUR) ** 2), rel=1e-12
    )
    assert pytest.approx(1e6 * np.pi / 180 / HOUR) == 1 / URAD_PER_S


def test_the_factor_of_the_papers_gives_microradian_not_arcsec():
    """P16 Eq. 9 and P15 Eq. 4: Q = sqrt(A) 10^6 pi / (180 * 3600 sqrt 3) with A the tau^-2 coefficient in (deg/h)^2 s^2."""
    coefficient = 2.5  # urad
    a = float(LAWS["Q"].avar(1.0, coefficient))
    assert np.sqrt(a) * 1e6 * np.pi / (180 * 3600 * np.sqrt(3)) == pytest.approx(
        coefficient, rel=1e-12
    )


def test_stored_numbers_are_deviations_at_their_reference():
    for symbol, hours in (("N", 1.0), ("K", 3.0)):
        law = LAWS[symbol]
        assert law.tau_ref_hours == hours
        assert np.sqrt(float(law.avar(hours * HOUR, 0.37))) == pytest.approx(0.37, rel=1e-12)
    assert np.sqrt(float(LAWS["B"].avar(1.0))) == pytest.approx(0.664, abs=5e-4)


def test_a_model_is_the_sum_of_its_terms():
    tau = np.geomspace(0.01, 1e4, 7)
    truth = {"Q": 0.5, "N": 0.003, "B": 0.004, "K": 0.02, "R": 0.1}
    np.testing.assert_allclose(
        model_avar(tau, truth),
        avar_columns(tau) @ np.array([truth[t] ** 2 for t in TERMS]),
        rtol=1e-12,
    )


def test_sample_units_undo_the_columns():
    k = np.array([1.0, 8.0, 100.0])
    ones = np.stack([3 / k**2, 1 / k, 0 * k + 2 * np.log(2) / np.pi, k / 3, k**2 / 2], axis=-1)
    np.testing.assert_allclose(ones * sample_squares(250.0), avar_columns(k / 250.0), rtol=1e-12)


@pytest.mark.parametrize("term", "QNBK")
def test_simulated_noise_follows_its_law_at_every_tau(term):
    rng = np.random.default_rng(20)
    trials, n, rate = 400, 2000, 50.0
    make = {
        "Q": lambda: quantization(rng, trials, n, Q=1.0, rate=rate),
        "N": lambda: white(rng, trials, n, N=1.0, rate=rate),
        "B": lambda: flicker(rng, trials, n, B=1.0),
        "K": lambda: random_walk(rng, trials, n, K=1.0, rate=rate),
    }[term]
    surface = davar(
        make_log(make().reshape(-1), rate=rate, unit="deg/h"),
        window=f"{n}samples",
        step=f"{n}samples",
        taus="octave",
        tau_max=4.0,
    )
    mean = surface.avar.mean("time").values[0]
    scatter = surface.avar.std("time").values[0] / np.sqrt(trials)
    assert np.all(np.abs(mean - LAWS[term].avar(surface.tau)) < 4.5 * scatter + 0.01 * mean)


def test_a_bias_step_looks_like_a_random_walk():
    """A step D inside a window of W hours gives D^2 tau / (3 (W - 2 tau)): an apparent K of D / sqrt(W)."""
    n, rate, step = 20_000, 100.0, 0.1
    x = np.where(np.arange(n) < n // 2, 0.0, step)
    surface = davar(
        make_log(x, rate=rate, unit="deg/h"),
        window=f"{n}samples",
        step=f"{n}samples",
        taus=[0.1, 1.0, 2.0],
    )
    window = n / rate
    expected = step**2 * surface.tau / (3 * (window - 2 * surface.tau))
    np.testing.assert_allclose(surface.avar[0, 0], expected, rtol=0.02)
    apparent = np.sqrt(3 * float(surface.avar[0, 0, 0]) / (0.1 / HOUR))
    assert apparent == pytest.approx(step / np.sqrt(window / HOUR), rel=0.01)

"""The noise laws against the definition of the Allan variance, and against simulated noise."""

from __future__ import annotations

import io
import re
import tokenize
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from gyrostab.allan.davar import davar
from gyrostab.ingest.make_log import make_log
from gyrostab.noise import (
    LAWS,
    TERMS,
    URAD_PER_S,
    avar_columns,
    model_avar,
    sample_squares,
    sampled_psd,
)
from gyrostab.units import HOUR
from tests.support.noise_records import flicker, quantization, random_walk, white

PACKAGE = Path(__file__).resolve().parents[1] / "gyrostab"
#: Numbers that have one home, and the files that may write them out again, with the reason.
SHARED_NUMBERS = {
    "3600": "units.HOUR",
    "86400": "units.DAY",
    "1.96": "noise.NORMAL_95",
    "1.959964": "noise.NORMAL_95",
    "0.664": 'noise.LAWS["B"]',
}
HOMES = ("units.py", "noise.py")
WHOLE_SECONDS = {
    "time/durations.py": "names of lengths of time in whole seconds",
    "time/stamps.py": "calendar arithmetic in whole seconds, where a float loses nanoseconds",
    "ingest/columns/stamps.py": "whole nanoseconds of a time unit",
    "ingest/formats/las.py": "hours, minutes and seconds of a clock reading",
}
#: Formulas of the noise laws, as they were once repeated.
LAW_FORMULAS = {
    "Allan variance of bias instability": r"2(\.0)? \* (math|np)\.log\(2(\.0)?\) / (math|np)\.pi",
    "PSD of bias instability": (
        r"1(\.0)? / \(2(\.0)? \* (math|np)\.pi \* f(requency)?\)|0\.5 / \((math|np)\.pi \* f"
    ),
    "PSD of rate random walk": r"6(\.0)? \* \(1(\.0)? - (np|math)\.cos",
    "PSD of quantization noise": r"URAD_PER_S \* (np|math)\.sin",
    "unit of quantization noise": r"1e-6 \* 180|degrees\(1e-6\)",
}
KERNELS_WITH_LAWS = {
    "kernels/spectra/expected.py": "kernels do not import noise; unit strengths only",
    "kernels/fit/covariance.py": "kernels do not import noise; covariance in sample units",
}


def allan_variance_of_psd(psd, tau):
    """Allan variance from a two-sided rate PSD: 4 int_0^inf S(f) sin^4(pi f tau) / (pi f tau)^2 df.

    Wang et al. 2016, Eq. 7, which omits df.
    """

    def integrand(u):  # u = pi f tau
        return 4 * psd(u / (np.pi * tau)) * np.sin(u) ** 4 / u**2 / (np.pi * tau)

    total = sum(quad(integrand, j * np.pi, (j + 1) * np.pi, epsrel=1e-9)[0] for j in range(400))
    edge = 400 * np.pi
    return (
        total
        + 4 * 3 / 8 * quad(lambda u: psd(u / (np.pi * tau)) / u**2 / (np.pi * tau), edge, np.inf)[0]
    )


@pytest.mark.parametrize("tau", [0.02, 1.0, 300.0])
def test_allan_variance_is_the_integral_of_the_psd(tau):
    for term, psd in (
        ("N", lambda f: HOUR * f**0),  # (deg/h)^2/Hz of 1 deg/sqrt(h): 1 deg^2/h = 3600 (deg/h)^2 s
        ("B", lambda f: 1 / (2 * np.pi * f)),
        ("K", lambda f: 1 / (HOUR * (2 * np.pi * f) ** 2)),
    ):
        assert allan_variance_of_psd(psd, tau) == pytest.approx(
            float(LAWS[term].avar(tau)), rel=1e-3
        ), term


def test_rate_random_walk_has_the_psd_of_ieee_952():
    """Wang et al. 2016, Table 1, print K^2 / (2 pi f^2), 2 pi times the PSD of K^2 tau / 3."""
    printed = allan_variance_of_psd(lambda f: 1 / (HOUR * 2 * np.pi * f**2), 10.0)
    assert printed / float(LAWS["K"].avar(10.0)) == pytest.approx(2 * np.pi, rel=1e-3)


def test_quantization_follows_from_independent_angles():
    """The second difference of angles with independent errors Q has the variance 6 Q^2."""
    tau = 0.5
    angle = np.degrees(1e-6)  # 1 urad in degree
    assert float(LAWS["Q"].avar(tau)) == pytest.approx(
        6 * angle**2 / (2 * (tau / HOUR) ** 2), rel=1e-12
    )
    assert pytest.approx(1e6 * np.pi / 180 / HOUR) == 1 / URAD_PER_S


def test_the_factor_of_the_papers_gives_microradian_not_arcsec():
    """Q = sqrt(A) 10^6 pi / (180 * 3600 sqrt 3), A the coefficient of tau^-2 in (deg/h)^2 s^2.

    Wang et al. 2016, Eq. 9.
    """
    coefficient = 2.5  # urad
    a = float(LAWS["Q"].avar(1.0, coefficient))
    assert np.sqrt(a) * 1e6 * np.pi / (180 * 3600 * np.sqrt(3)) == pytest.approx(
        coefficient, rel=1e-12
    )


def test_stored_numbers_are_allan_deviations_at_their_reference_time():
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


def test_sample_units_reproduce_the_design_matrix():
    k = np.array([1.0, 8.0, 100.0])
    ones = np.stack([3 / k**2, 1 / k, 0 * k + 2 * np.log(2) / np.pi, k / 3, k**2 / 2], axis=-1)
    np.testing.assert_allclose(ones * sample_squares(250.0), avar_columns(k / 250.0), rtol=1e-12)


@pytest.mark.parametrize(
    ("term", "table"),
    [
        ("Q", lambda f: (2 * np.pi * f * URAD_PER_S) ** 2 / 100.0),
        ("N", lambda f: HOUR * f**0),
        ("B", lambda f: 1 / (2 * np.pi * f)),
        ("K", lambda f: 1 / (HOUR * (2 * np.pi * f) ** 2)),
    ],
)
def test_sampled_psd_is_that_of_the_table_far_below_nyquist(term, table):
    f = np.array([0.01, 0.1])
    np.testing.assert_allclose(sampled_psd(term, f, 100.0), table(f), rtol=1e-5)


@pytest.mark.parametrize("term", "NK")
def test_sampled_psd_holds_the_folded_part(term):
    """The sum over all aliases of the PSD of means over the sampling interval."""
    rate, f = 100.0, np.array([10.0, 30.0, 49.0])
    alias = f[:, None] + rate * np.arange(-20_000, 20_001)
    density = {
        "N": HOUR * alias**0,
        "K": 1 / (HOUR * (2 * np.pi * alias) ** 2),
    }[term]
    folded = (density * np.sinc(alias / rate) ** 2).sum(axis=1)
    np.testing.assert_allclose(sampled_psd(term, f, rate), folded, rtol=1e-4)


def test_sampled_psd_is_exact_far_below_the_rate():
    f = np.array([1e-9, 1e-7]) * 100.0
    expected = 1 / (HOUR * (2 * np.pi * f) ** 2)
    np.testing.assert_allclose(sampled_psd("K", f, 100.0), expected, rtol=1e-12)


def test_a_ramp_has_no_psd():
    with pytest.raises(ValueError, match="no density for the term 'R'"):
        sampled_psd("R", [1.0], 100.0)


def modules_that_share_the_laws():
    """Every module except the blind test, which may not share anything with what it tests."""
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if not name.startswith("blindtest/"):
            yield name, path.read_text(encoding="utf-8")


def test_shared_numbers_are_written_once():
    repeated = []
    for name, source in modules_that_share_the_laws():
        if name in HOMES or name in WHOLE_SECONDS:
            continue
        if not any(number in source for number in SHARED_NUMBERS):
            continue  # tokens take time
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            number = token.string.removesuffix(".0")
            in_braces = token.type == tokenize.STRING and re.search(
                r"\{[^{}\"]*\b(3600|86400)\b[^{}\"]*\}", token.string
            )
            if in_braces and not token.string.startswith(('"""', 'r"""')):
                repeated.append(f"{name}:{token.start[0]}: {token.string}")
            elif token.type == tokenize.NUMBER and number in SHARED_NUMBERS:
                repeated.append(f"{name}:{token.start[0]}: use {SHARED_NUMBERS[number]}")
    assert repeated == []


def test_noise_laws_are_written_once():
    repeated = [
        f"{name}: {formula}"
        for name, source in modules_that_share_the_laws()
        if name != "noise.py" and name not in KERNELS_WITH_LAWS
        for formula, pattern in LAW_FORMULAS.items()
        if re.search(pattern, source)
    ]
    assert repeated == []


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
    """A step D in W hours gives D^2 tau / (3 (W - 2 tau)), an apparent K of D / sqrt(W)."""
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

"""Confidence intervals and fitted coefficients against simulated truth."""

from __future__ import annotations

from copy import copy

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import chi2

from gyrostab.allan import fit, window_fit
from gyrostab.allan.confidence import confidence_interval
from gyrostab.allan.davar import davar
from gyrostab.allan.fit import fit_noise
from gyrostab.allan.fit_inputs import fit_inputs
from gyrostab.errors import OptionError, SchemaError
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.allan.pairs import white_pair_sum
from gyrostab.kernels.fit.averages import FIT_FIELDS
from gyrostab.kernels.fit.covariance import product_tables
from gyrostab.kernels.fit.limits import cell_limits, chi_square_quantile, estimate_bounds
from gyrostab.kernels.fit.mixture import Curves
from gyrostab.noise import LAWS, NORMAL_95, TERMS, model_avar
from gyrostab.schema import OBSERVABLE
from tests.reference import average_plainly, fit_window_plainly
from tests.support.noise_records import flicker, lose, quantization, random_walk, white
from tests.support.published import fit_deviations
from tests.support.repetitions import first_of

RATE = 100.0
#: Sides of an interval: scores of its lower and upper bound.
SIDES = np.array([1.0, -1.0])


def windows_of(x, **options):
    """Surface of independent trials, one window each, one after the other on one axis."""
    n = x.shape[1]
    return davar(
        make_log(x.reshape(-1), rate=RATE, unit="deg/h"),
        window=f"{n}samples",
        step=f"{n}samples",
        **options,
    )


def records(kind, rng, trials, n):
    if kind == "white":
        return white(rng, trials, n, N=0.01, rate=RATE), {"N": 0.01}
    if kind == "flicker":
        return flicker(rng, trials, n, B=1.0), {"B": 1.0}
    return random_walk(rng, trials, n, K=20.0, rate=RATE), {"K": 20.0}


@pytest.mark.parametrize(
    ("kind", "share", "block"),
    [
        ("white", 0.2, 50),
        ("flicker", 0.1, 5),
        ("random walk", 0.0, 1),
        pytest.param("white", 0.0, 1, marks=pytest.mark.slow),
        pytest.param("white", 0.1, 5, marks=pytest.mark.slow),
        pytest.param("flicker", 0.0, 1, marks=pytest.mark.slow),
        pytest.param("flicker", 0.2, 50, marks=pytest.mark.slow),
        pytest.param("random walk", 0.2, 50, marks=pytest.mark.slow),
        pytest.param("random walk", 0.1, 5, marks=pytest.mark.slow),
    ],
)
def test_95_percent_intervals_hold_the_truth(kind, share, block):
    """2000 trials at each of nine averaging times; the share of hits has a binomial sd of 0.5 %."""
    rng = np.random.default_rng([1, len(kind), block])
    x, law = records(kind, rng, 2000, 700)
    surface = windows_of(lose(rng, x, share, block), taus="octave").isel(axis=0)
    truth = model_avar(surface.tau, law) * (surface.white_response if kind == "white" else 1.0)
    whole = surface.expand_dims("axis").transpose("axis", "time", "tau", "bnds")
    for product in (whole, fit_noise(whole)):
        limits = confidence_interval(product).isel(axis=0)
        has_interval = limits.avar_lower.notnull()
        assert has_interval.mean() > 0.99
        hit = (
            ((limits.avar_lower <= truth) & (truth <= limits.avar_upper))
            .where(has_interval)
            .mean("time")
        )
        assert 0.93 <= float(hit.mean()) <= 0.97
        assert float(hit.min()) >= 0.92
        assert float(hit.max()) <= 0.98


@pytest.mark.slow
def test_intervals_hold_where_tiny_gaps_raise_quantization_noise():
    rng = np.random.default_rng(18)
    x = white(rng, 1500, 2000, N=0.01, rate=RATE) + quantization(rng, 1500, 2000, Q=0.4, rate=RATE)
    product = fit_noise(windows_of(lose(rng, x, 0.2, 5), taus=16))
    assert float(product.quantization_response.max()) > 30
    truth = product.white_response * model_avar(product.tau, {"N": 0.01})
    truth = truth + product.quantization_response * model_avar(product.tau, {"Q": 0.4})
    limits = confidence_interval(product)
    hit = ((limits.avar_lower <= truth) & (truth <= limits.avar_upper)).mean(("axis", "time"))
    assert float(hit.min()) > 0.925
    assert float(hit.max()) < 0.99


def test_degrees_of_freedom_are_those_of_greenhall():
    """allantools computes the same tables, approximately for white noise at short tau."""
    from allantools.ci import edf_greenhall

    window = 1000
    for alpha, term in ((0, 1), (-1, 2), (-2, 3)):
        for k in (20, 100, 333):
            ks = np.array([k])
            product = product_tables(window, ks)[0][term, term, 0, 0]
            mean = {1: 1 / k, 2: 2 * np.log(2) / np.pi, 3: k / 3}[term]
            expected = edf_greenhall(alpha, 2, k, window + 1, overlapping=True, modified=False)
            assert 2 * mean**2 / product == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("k", [1, 2, 7, 40])
def test_closed_form_of_the_white_pair_sum(k):
    """Compare with the sum, with the correlation from the weights of the second difference."""
    weights = np.concatenate([-np.ones(k), np.ones(k)])
    correlation = np.correlate(weights, weights, "full")[2 * k - 1 :] / (2 * k)
    for n in (1, 2, k, 2 * k, 100):
        rho = np.zeros(n)
        rho[: min(n, 2 * k)] = correlation[: min(n, 2 * k)]
        lags = np.arange(1, n)
        assert white_pair_sum(n, k) == pytest.approx(
            n + 2 * np.sum((n - lags) * rho[1:] ** 2), rel=1e-10
        )


def test_covariance_between_averaging_times_is_that_of_simulated_noise():
    rng = np.random.default_rng(3)
    ks = np.array([1, 2, 5, 20, 100])
    x = (
        white(rng, 4000, 600, N=0.01, rate=RATE)
        + random_walk(rng, 4000, 600, K=30.0, rate=RATE)
        + quantization(rng, 4000, 600, Q=0.2, rate=RATE)
    )
    avar = windows_of(x, taus=list(ks / RATE)).avar.values[0]
    from gyrostab.noise import sample_squares

    squares = np.array([0.2, 0.01, 0.0, 30.0]) ** 2 * sample_squares(RATE)[:4]
    predicted = np.einsum("a,b,abij->ij", squares, squares, product_tables(600, ks)[0])
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    np.testing.assert_allclose(np.cov(avar.T) / scale, predicted / scale, atol=0.12)


@pytest.mark.parametrize(
    ("share", "block"),
    [
        pytest.param(0.0, 1, marks=pytest.mark.slow),
        pytest.param(0.2, 50, marks=pytest.mark.slow),
        (0.2, 5),
    ],
)
def test_standard_errors_are_right(share, block):
    """z-scores of repeated simulations have a standard deviation of 0.78 to 1.1, also with gaps.

    The least is that of N, whose error allows for a marginal B.
    """
    rng = np.random.default_rng([4, block])
    truth = {"Q": 0.3, "N": 0.01, "K": 400.0}
    x = white(rng, 1000, 3000, N=truth["N"], rate=RATE) + quantization(
        rng, 1000, 3000, Q=truth["Q"], rate=RATE
    )
    x += random_walk(rng, 1000, 3000, K=truth["K"], rate=RATE)
    surface = windows_of(lose(rng, x, share, block), taus=24)
    product = fit_noise(surface)
    for term, value in truth.items():
        z = (product[term] - value) / product[f"{term}_stderr"]
        assert 0.78 <= float(z.std()) <= 1.1, term
    assert 0.7 < float((product.fit_chi2 / product.fit_dof).mean()) < 1.2
    # B cannot be negative and takes a little from its neighbours; without it they are unbiased
    for term, value in truth.items():
        assert float(fit_noise(surface, terms="QNK")[term].mean()) == pytest.approx(
            value, rel=0.03
        ), term


def test_flicker_noise_alone_gives_b():
    rng = np.random.default_rng(5)
    product = fit_noise(windows_of(flicker(rng, 600, 2000, B=0.5), taus=20))
    z = (product.B - 0.5) / product.B_stderr
    assert 0.85 <= float(z.std()) <= 1.2
    assert 0.93 <= float((abs(z) <= NORMAL_95).mean()) <= 0.98
    assert float(product.B.mean()) == pytest.approx(0.5, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("share", first_of(0.2, 0.0))
def test_absent_terms_are_rarely_observed_and_their_limits_hold(share):
    """With white noise only, absent terms are observed in about 1 % of windows."""
    rng = np.random.default_rng([6, int(share * 10)])
    product = fit_noise(
        windows_of(lose(rng, white(rng, 2000, 2000, N=0.01, rate=RATE), share, 20), taus=20)
    )
    for term in "QBKR":
        assert (
            float((product.observable.sel(term=term) == OBSERVABLE.index("observed")).mean())
            <= 0.025
        )
    described = window_fit.is_described(product.fit_chi2, product.fit_dof)
    assert described.mean() > 0.98
    np.testing.assert_array_equal(
        product.observable.sel(term="N") == OBSERVABLE.index("observed"), described
    )
    rng = np.random.default_rng([7, int(share * 10)])
    x = white(rng, 1000, 2000, N=0.01, rate=RATE) + flicker(rng, 1000, 2000, B=0.4)
    product = fit_noise(windows_of(lose(rng, x, share, 20), taus=20))
    limited = product.observable.sel(term="B") == OBSERVABLE.index("upper_limit_only")
    assert limited.sum() > 300


@pytest.mark.slow
@pytest.mark.parametrize(("term", "value"), [("B", 0.6), ("K", 45.0)])
@pytest.mark.parametrize("share", first_of(0.3, 0.0))
def test_truth_exceeds_a_limit_in_5_percent_of_windows(term, value, share):
    """A term at the edge of visibility: 2 to 8 %, three standard deviations about 5."""
    rng = np.random.default_rng([7, int(share * 10)])
    noise = {
        "B": lambda: flicker(rng, 1000, 4000, B=value),
        "K": lambda: random_walk(rng, 1000, 4000, K=value, rate=RATE),
    }[term]()
    x = lose(rng, white(rng, 1000, 4000, N=0.01, rate=RATE) + noise, share, 50)
    product = fit_noise(windows_of(x, taus=24), observed_only=False)
    assert 0.1 < float((product.observable.sel(term=term) == 2).mean()) < 0.7
    assert 0.02 <= float((product[f"{term}_upper"] < value).mean()) <= 0.08
    error = abs(product[term] - value) / product[f"{term}_stderr"]
    assert float((error <= NORMAL_95).mean()) >= 0.92


def folded(rng, trials, n, *, N):
    """White noise of N up to a quarter of the sampling rate only, as after a filter."""
    spectrum = np.fft.rfft(white(rng, trials, n, N=N, rate=RATE))
    spectrum[:, np.fft.rfftfreq(n) > 0.25] = 0.0
    return np.fft.irfft(spectrum, n)


def test_limits_hold_where_the_five_terms_do_not_fit():
    """White noise below half of the band only is fitted as B, so the fit alone would exclude N."""
    rng = np.random.default_rng(21)
    product = fit_noise(windows_of(folded(rng, 600, 2000, N=0.01), taus=30), tau_min="all")
    assert float((product.fit_chi2 / product.fit_dof).median()) > 10
    limited = product.observable == OBSERVABLE.index("upper_limit_only")
    assert (limited.mean(("axis", "time")) > 0.99).all()
    assert float((product.N_upper >= 0.01).where(limited.sel(term="N"), True).mean()) >= 0.94
    assert float(product.N_upper.median()) < 0.02


def test_limits_hold_with_a_tone_on_the_noise():
    """With a tone at medium averaging times, no term that is present may be excluded."""
    rng = np.random.default_rng(22)
    t = np.arange(2000) / RATE
    tone = 60.0 * np.sin(2 * np.pi * 1.3 * t + rng.uniform(0, 2 * np.pi, (600, 1)))
    product = fit_noise(
        windows_of(
            white(rng, 600, 2000, N=0.01, rate=RATE) + flicker(rng, 600, 2000, B=0.4) + tone,
            taus=30,
        )
    )
    assert (product.fit_chi2 > 2 * product.fit_dof).mean() > 0.95
    for term, value in (("N", 0.01), ("B", 0.4)):
        limited = product.observable.sel(term=term) == OBSERVABLE.index("upper_limit_only")
        assert limited.sum() > 100
        assert float((product[f"{term}_upper"] >= value).where(limited).mean()) >= 0.95, term


def test_no_term_is_observed_where_the_five_terms_do_not_describe_the_window():
    """With a tone of 60 deg/h, N and B are fitted with small errors to the wrong curve."""
    rng = np.random.default_rng(24)
    t = np.arange(2000) / RATE
    tone = 60.0 * np.sin(2 * np.pi * 1.3 * t + rng.uniform(0, 2 * np.pi, (100, 1)))
    surface = windows_of(white(rng, 100, 2000, N=0.01, rate=RATE) + tone, taus=30)
    product = fit_noise(surface)
    assert not window_fit.is_described(product.fit_chi2, product.fit_dof).any()
    assert (product.observable != OBSERVABLE.index("observed")).all()
    assert float((product.N_upper >= 0.01).mean()) >= 0.95
    for term in TERMS:
        assert product[term].isnull().all(), term
        assert product[f"{term}_stderr"].isnull().all(), term
    estimates = fit_noise(surface, observed_only=False)
    assert estimates.N.notnull().all()
    xr.testing.assert_equal(estimates.observable, product.observable)


def test_coefficient_and_error_are_nan_where_the_term_is_not_observed():
    product = fit_noise(
        windows_of(white(np.random.default_rng(25), 50, 2000, N=0.01, rate=RATE), taus=20)
    )
    for term in TERMS:
        is_observed = product.observable.sel(term=term) == OBSERVABLE.index("observed")
        np.testing.assert_array_equal(product[term].notnull(), is_observed, err_msg=term)
        np.testing.assert_array_equal(
            product[f"{term}_stderr"].notnull(), is_observed, err_msg=term
        )
        assert product[f"{term}_upper"].where(is_observed).isnull().all(), term
    assert (product.observable == OBSERVABLE.index("upper_limit_only")).any()


def test_errors_widen_only_with_a_misfit():
    rng = np.random.default_rng(23)
    surface = windows_of(white(rng, 40, 2000, N=0.01, rate=RATE), taus=20)
    spoiled = surface.assign(avar=surface.avar * (1 + 0.2 * (np.arange(surface.sizes["tau"]) % 2)))
    for cells, fits in ((surface, True), (spoiled, False)):
        product = fit_noise(cells, terms="N", observed_only=False)
        result, misfit, _ = window_fit.run_kernel(*cells_of(cells), 2)
        fails = chi2.sf(misfit[:, 0], misfit[:, 1]) < 1e-3
        assert fails.mean() < 0.06 if fits else fails.all()
        scale = np.where(fails, misfit[:, 0] / misfit[:, 1], 1.0)
        names = ("free", "variance_null", "variance_linear", "variance_square")
        square, *variance = (result[:, FIT_FIELDS.index(name), 1] for name in names)
        low, high = estimate_bounds(square, *(scale * part for part in variance), NORMAL_95 * SIDES)
        expected = (np.sqrt(high) - np.sqrt(low)) / (2 * NORMAL_95)
        np.testing.assert_allclose(product.N_stderr[0], expected, rtol=1e-9)
        simple = np.sqrt((variance[0] + variance[2] * square**2) * scale / square) / 2
        np.testing.assert_allclose(expected, simple, rtol=0.1)


@pytest.mark.parametrize("freedom", [30.0, 300.0])
def test_bounds_of_an_estimate_alone_are_those_of_chi_square(freedom):
    """A chi-square with `freedom`, to 4 % of the interval from 30 degrees of freedom on."""
    bounds = estimate_bounds(
        np.ones(1), np.zeros(1), np.zeros(1), np.full(1, 2 / freedom), NORMAL_95 * SIDES
    )[:, 0]
    expected = freedom / chi2.ppf([0.975, 0.025], freedom)
    np.testing.assert_allclose(
        np.log(bounds), np.log(expected), atol=0.04 * np.ptp(np.log(expected))
    )


def test_interval_of_a_marginal_ramp_on_a_strong_random_walk_holds():
    """The value is shrunk where the ramp is not observed; the binomial sd of the share is 1.1 %."""
    rng = np.random.default_rng(12)
    x = random_walk(rng, 400, 3000, K=400.0, rate=RATE)
    spread = np.sqrt(window_fit.fit_tables((1, 2), RATE, 3000).trend_variance[3]) * 400.0
    x += white(rng, 400, 3000, N=0.01, rate=RATE) + 2.5 * spread * np.arange(3000) / RATE / 3600
    product = fit_noise(windows_of(x, taus=21), observed_only=False)
    held = abs(product.R - 2.5 * spread) <= NORMAL_95 * product.R_stderr
    assert 0.92 <= float(held.mean()) <= 0.99


@pytest.mark.full
def test_intervals_of_n_and_b_hold_where_four_terms_compete():
    """N and B are too high where another term is dropped; the binomial sd of a share is 0.6 %."""
    rng = np.random.default_rng(14)
    truth = {"Q": 0.25, "N": 0.01, "B": 0.9, "K": 60.0}
    x = white(rng, 1500, 4000, N=truth["N"], rate=RATE) + flicker(rng, 1500, 4000, B=truth["B"])
    x += quantization(rng, 1500, 4000, Q=truth["Q"], rate=RATE)
    x += random_walk(rng, 1500, 4000, K=truth["K"], rate=RATE)
    product = fit_noise(windows_of(lose(rng, x, 0.3, 50), taus=24), observed_only=False)
    for term in "NB":
        held = abs(product[term] - truth[term]) <= NORMAL_95 * product[f"{term}_stderr"]
        assert 0.935 <= float(held.mean()) <= 0.98, term


def test_a_lower_end_above_the_estimate_is_not_used():
    field = {name: np.zeros((1, 5)) for name in FIT_FIELDS}
    field["free"] += 1.0
    field["variance_null"] += 0.04
    errors = []
    for low, null in ((1.0, 0.04), (4.0, 0.01), (1.0, 0.16)):  # the same, above, and wider
        law = {**field, "low": 0.0 * field["free"] + low, "low_null": 0.0 * field["free"] + null}
        errors.append(window_fit._bound_estimates(law, np.ones((1, 5)))[0][0, 0])
    same, above, wider = errors
    assert same == above > 0
    assert wider > 1.2 * same


def test_bounds_of_an_estimate_have_their_scores():
    """Put the bounds into the definition of the score, with the integral done by quadrature."""
    for estimate, a, b, c in ((0.0, 1.0, 0.0, 0.1), (-0.7, 1.0, 0.5, 1.4), (3.0, 0.2, 1.5, 0.3)):
        spread = np.vectorize(lambda s, a=a, b=b, c=c: np.sqrt(a + (b + c * s) * max(s, 0.0)))
        arguments = (np.array([number]) for number in (estimate, a, b, c))
        for bound, score in zip(
            estimate_bounds(*arguments, np.array([-1.96, -1.0, 1.0]))[:, 0],
            (-1.96, -1.0, 1.0),
            strict=True,
        ):
            inner = quad(lambda s, spread=spread: 1 / spread(s), bound, estimate, points=[0.0])[0]
            got = ((estimate - bound) / spread(bound) + 2 * inner) / 3
            assert got == pytest.approx(score, abs=1e-5) or (bound == 0 and got < score)


def test_pure_ramp_gives_r():
    t = np.arange(20_000) / RATE / 3600
    x = 36.0 * t + 1e-3 * np.random.default_rng(8).standard_normal(20_000)
    product = fit_noise(
        davar(make_log(x, rate=RATE, unit="deg/h"), window="5000samples"), observed_only=False
    )
    np.testing.assert_allclose(product.R, 36.0, rtol=2e-3)


def test_gap_aware_columns_remove_the_bias_of_nominal_columns():
    """With 20 % missing in blocks of five, nominal columns bias N high by a quarter."""
    rng = np.random.default_rng(9)
    x = lose(rng, white(rng, 40, 20_000, N=0.01, rate=RATE), 0.2, 5)
    surface = windows_of(x, taus=24, min_strict=1.0)  # cluster means throughout
    aware = fit_noise(surface, terms="QN")
    ones = xr.ones_like(surface.white_response)
    nominal = fit_noise(surface.assign(white_response=ones, quantization_response=ones), terms="N")
    assert float(aware.N.mean()) == pytest.approx(0.01, rel=0.005)
    assert float(nominal.N.mean()) > 0.0101


def test_fit_of_deviations_of_the_2015_paper_is_biased():
    """P15 adds deviations although variances add: with N and K together it misses both."""
    tau = np.geomspace(0.01, 1000, 30)
    truth = {"N": 0.01, "K": 5.0}
    surface = windows_of(np.zeros((2, 300_000)), taus=list(np.round(tau, 2)))
    surface["avar"] = xr.zeros_like(surface.avar) + model_avar(surface.tau, truth)
    good, paper = fit_noise(surface, terms="QNBK"), fit_deviations(surface)
    for term, value in truth.items():
        assert float(good[term][0, 0]) == pytest.approx(value, rel=1e-3)
    assert abs(float(paper["K"][0, 0]) / truth["K"] - 1) > 0.03


def test_averaging_times_with_a_disturbance_can_be_left_out():
    """A tone at 5 Hz disturbs N at tau below a second; from 5 s on the noise is undisturbed."""
    t = np.arange(300_000) / RATE
    x = white(np.random.default_rng(17), 1, t.size, N=0.01, rate=RATE)[0] + 10 * np.sin(
        2 * np.pi * 5.013 * t
    )
    surface = davar(
        make_log(x, rate=RATE, unit="deg/h"), window="100000samples", step="100000samples"
    )
    spoiled, clean = (
        fit_noise(surface, terms="NBK", tau_min=shortest, observed_only=False)
        for shortest in (None, "5s")
    )
    assert abs(float(clean.N.mean()) / 0.01 - 1) < 0.2
    assert abs(float(spoiled.N.mean()) / 0.01 - 1) > 0.5
    with pytest.raises(OptionError, match="no averaging time"):
        fit_noise(surface, tau_min="2h")


def test_the_fit_begins_at_an_averaging_time_of_six_digits():
    log = make_log(np.random.default_rng(3).standard_normal(12_000), rate=300.0, unit="deg/h")
    surface = davar(log, window="40s")
    for tau in surface["tau"].values[:-4]:
        product = fit_noise(surface, tau_min=f"{tau:g}s")
        assert product.attrs["fit_tau_min_s"] == pytest.approx(tau, rel=1e-9)


def test_windows_fitted_again_keep_the_averaging_times_of_the_product():
    """A tone lies below ``tau_min``, so that only a fit from there on describes the windows."""
    x = white(np.random.default_rng(12), 3, 4000, N=0.01, rate=RATE)
    surface = windows_of(x + 20.0 * np.sin(2 * np.pi * 30.0 * np.arange(4000) / RATE), taus=60)
    product = fit_noise(surface, tau_min=1.0, observed_only=False)
    xr.testing.assert_identical(fit.refit(product), product)


def test_window_without_data_is_not_observable():
    x = np.random.default_rng(10).standard_normal((3, 1000))
    x[1] = np.nan
    product = fit_noise(windows_of(x))
    assert (product.observable[0, 1] == OBSERVABLE.index("not_observable")).all()
    assert product.N.isnull().values.tolist() == [[False, True, False]]


def test_two_averaging_times_cannot_tell_five_terms_apart():
    product = fit_noise(
        windows_of(np.random.default_rng(11).standard_normal((3, 1000)), taus=[0.01, 0.1])
    )
    assert (product.observable == OBSERVABLE.index("not_observable")).any()
    chosen = fit_noise(
        windows_of(np.random.default_rng(11).standard_normal((3, 1000)), taus=[0.01, 0.1]),
        terms="N",
    )
    assert (chosen.observable.sel(term="N") == OBSERVABLE.index("observed")).all()
    assert (chosen.observable.sel(term="Q") == OBSERVABLE.index("not_observable")).all()
    one = windows_of(np.random.default_rng(11).standard_normal((3, 1000)), taus=[0.01])
    assert (fit_noise(one).fit_dof == 0).all()


def test_a_lazy_surface_stays_lazy_and_fits_the_same():
    x = np.random.default_rng(12).standard_normal((2, 20_000))
    log = make_log(x, rate=RATE, unit="deg/h")
    eager = fit_noise(davar(log, window="2000samples", step="500samples"))
    lazy = fit_noise(davar(log.chunk(time=7000), window="2000samples", step="500samples"))
    assert isinstance(lazy.N.data, da.Array)
    for name in (*TERMS, "N_stderr", "K_upper", "observable", "fit_chi2", "edf"):
        np.testing.assert_array_equal(lazy[name].values, eager[name].values)


@pytest.mark.parametrize("planes", [None, 3])
def test_cubes_and_planes_may_have_other_chunks(planes):
    """Of a stored surface only the long variables are lazy."""
    x = np.random.default_rng(12).standard_normal((2, 20_000))
    surface = davar(make_log(x, rate=RATE, unit="deg/h"), window="2000samples", step="500samples")
    chunks = {name: {"time": 16} if "tau" in v.dims else planes for name, v in surface.items()}
    lazy = surface.assign(
        {name: surface[name].chunk(size) for name, size in chunks.items() if size is not None}
    )
    fitted = fit_noise(lazy)
    assert isinstance(fitted.N.data, da.Array)
    xr.testing.assert_allclose(fitted.compute(), fit_noise(surface))


def test_terms_count_once_whatever_iterable_holds_them():
    x = np.random.default_rng(12).standard_normal(6000)
    surface = davar(make_log(x, rate=RATE, unit="deg/h"), window="2000samples", step="500samples")
    expected = fit_noise(surface, terms="NB")
    for terms in ("NBN", ["N", "B"], iter("NB")):
        xr.testing.assert_identical(fit_noise(surface, terms=terms), expected)


def test_many_averaging_times_are_thinned_for_the_fit():
    surface = davar(
        make_log(np.random.default_rng(13).standard_normal(6000), rate=RATE, unit="deg/h"),
        window="3000samples",
        taus="all",
    )
    product = fit_noise(surface)
    assert product.sizes["tau"] == 1000
    assert product.edf.notnull().all()
    assert float(product.N.mean()) == pytest.approx(1 / 600, rel=0.05)


@pytest.mark.parametrize(("share", "block"), [(0.0, 1), (0.2, 50), (0.2, 5)])
@pytest.mark.parametrize(
    "law",
    [{"N": 0.01}, {"Q": 0.4, "N": 0.01, "K": 200.0}, {"N": 0.01, "K": 40.0, "R": 3000.0}],
    ids="+".join,
)
def test_fast_fit_equals_the_reference_implementation(law, share, block):
    """Compare all numbers behind errors and limits with numpy and scipy, window by window."""
    rng = np.random.default_rng([19, block])
    x = white(rng, 12, 3000, N=law["N"], rate=RATE) + random_walk(
        rng, 12, 3000, K=law.get("K", 0.0), rate=RATE
    )
    x += (
        quantization(rng, 12, 3000, Q=law.get("Q", 0.0), rate=RATE)
        + law.get("R", 0.0) * np.arange(3000) / RATE / 3600
    )
    given = cells_of(windows_of(lose(rng, x, share, block), taus=21))
    given[0][0][3, 5] = np.nan
    result, misfit, _ = window_fit.run_kernel(*given, 31)
    for w, plain in enumerate(plain_fits(*given)):
        assert misfit[w, 0] == pytest.approx(float(plain["chi2"]), rel=1e-5)
        averaged = average_plainly(plain)
        for row, name in enumerate(FIT_FIELDS[:-1]):
            np.testing.assert_allclose(
                result[w, row, :4],
                averaged[name],
                rtol=0.03,
                atol=1e-3 * abs(averaged[name][np.isfinite(averaged[name])]).max(),
                err_msg=name,
            )


def cells_of(surface):
    """Arguments of `window_fit.run_kernel` for the windows of a surface with one axis."""
    cells, ks, rate, window = fit_inputs(surface)
    tables = window_fit.fit_tables(tuple(ks.tolist()), rate, window)
    flat = [np.ascontiguousarray(cell[0], dtype=np.float64) for cell in cells[:5]]
    trend, *responses, exact = (cell[0, :, 0] for cell in cells[5:])
    return flat, trend, np.stack(responses, axis=-1), exact, tables


def plain_fits(flat, trend, responses, exact, tables):
    for w in range(trend.size):
        trends = tables.trend_variance * responses[w]
        trends = np.append(trends, [trend[w] ** 2, 1 - exact[w]])
        yield fit_window_plainly(*(cell[w] for cell in flat), trends, tables)


def mixed_records(rng, trials):
    """Each window has another noise, so that fits in one vector differ in terms and convergence."""
    x = white(rng, trials, 3000, N=0.01, rate=RATE) * rng.choice([0.1, 1.0, 3.0], (trials, 1))
    x += random_walk(rng, trials, 3000, K=400.0, rate=RATE) * rng.choice([0.0, 1.0], (trials, 1))
    x += quantization(rng, trials, 3000, Q=0.4, rate=RATE) * rng.choice([0.0, 1.0], (trials, 1))
    return x + rng.choice([0.0, 3000.0], (trials, 1)) * np.arange(3000) / RATE / 3600


def test_fit_of_a_window_does_not_depend_on_other_windows():
    """Bit for bit, in another order, with empty windows and with numbers that overflow."""
    rng = np.random.default_rng(32)
    flat, *trends, tables = cells_of(
        windows_of(lose(rng, mixed_records(rng, 21), 0.2, 20), taus=21)
    )
    expected = window_fit.run_kernel(flat, *trends, tables, 31)
    order = rng.permutation(21)
    moved = [cell[order] for cell in flat], *(cell[order] for cell in trends)
    for got, want in zip(window_fit.run_kernel(*moved, tables, 31), expected, strict=True):
        np.testing.assert_array_equal(got, want[order])
    spoiled = [cell.copy() for cell in flat]
    spoiled[0][3::8] = np.nan
    spoiled[0][5::8] *= 1e200
    spoiled[0][6::8] *= 1e-200
    left = np.flatnonzero(~np.isin(np.arange(21) % 8, (3, 5, 6)))
    result, misfit, dof = window_fit.run_kernel(spoiled, *trends, tables, 31)
    for got, want in zip((result, misfit, dof), expected, strict=True):
        np.testing.assert_array_equal(got[left], want[left])
    assert np.isnan(result[3::8, 0]).all()


def test_a_covariance_that_is_not_positive_definite_is_widened_only_where_it_must_be():
    """Tables are wrong by 2e-5 for random walks only."""
    rng = np.random.default_rng(33)
    walks = random_walk(rng, 20, 3000, K=400.0, rate=RATE)
    x = np.where(np.arange(20)[:, None] % 3 == 1, walks, mixed_records(rng, 20))
    flat, *trends, tables = cells_of(windows_of(x, taus=21))
    pairs = tables.trend.pairs.copy()
    scale = np.sqrt(np.diag(pairs[3, 3]))
    values, vectors = np.linalg.eigh(pairs[3, 3] / np.outer(scale, scale))
    pairs[3, 3] -= (values[0] + 2e-5) * np.outer(vectors[:, 0] * scale, vectors[:, 0] * scale)
    damaged = copy(tables)
    damaged.trend = tables.trend._replace(pairs=pairs)
    _, misfit, _ = window_fit.run_kernel(flat, *trends, damaged, 31)
    widened = 0
    for w, plain in enumerate(plain_fits(flat, *trends, damaged)):
        assert misfit[w, 0] == pytest.approx(float(plain["chi2"]), rel=1e-4)
        widened += plain["jitter"] > 1e-6
    assert 2 < widened < 18


def test_windows_have_the_same_fit_alone_and_together():
    x = np.random.default_rng(20).standard_normal((9, 2000))
    surface = windows_of(x, taus=21)
    together = fit_noise(surface)
    for w in (0, 4, 8):
        single = fit_noise(surface.isel(time=[w]))
        for name in (*TERMS, "N_stderr", "K_upper", "fit_chi2", "edf"):
            np.testing.assert_array_equal(single[name].values[:, 0], together[name].values[:, w])


@pytest.fixture(scope="module")
def quantile_curve():
    return window_fit.quantile_curve(0.05)


@given(st.floats(-4.0, 6.0))
def test_interpolated_quantile_is_that_of_scipy(quantile_curve, exponent):
    freedom = 10.0**exponent
    expected = chi2.ppf(0.05, freedom) / freedom
    got = chi_square_quantile(np.array(freedom), quantile_curve)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-250)


@pytest.mark.parametrize("decades", [np.inf, 10.0])
def test_limit_of_a_cell_is_the_smallest_of_all_cells(quantile_curve, decades):
    """Try every cell with the quantile of scipy; a term cannot exceed the cell."""
    rng = np.random.default_rng(34)
    ks = np.round(np.geomspace(1, 1000, 25))
    columns = ks[:, None] ** np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    squares = np.array([1.0, 0.3, 0.01, 1e-4, 1e-7]) * rng.choice(
        [0.0, 0.1, 1.0, 10.0, np.nan], (40, 5)
    )
    own = rng.uniform(0.5, 2.0, (5, 25)) * 3000 / ks
    own[4] = np.inf
    white, quantization, ramp = rng.uniform(0.5, 1.5, (3, 40, 25))
    factor = np.where(rng.random((40, 1)) < 0.5, 1.0, rng.uniform(0.1, 1.0, (40, 25)))
    response = np.stack([quantization, white, *np.ones((2, 40, 25)), ramp], axis=-1)
    part = response * columns
    model = (part * np.nan_to_num(squares)[:, None]).sum(axis=-1)
    dof = rng.uniform(1.0, 3000.0, (40, 25))
    avar = model * rng.chisquare(dof) / dof
    avar[rng.random((40, 25)) < 0.1] = np.nan
    span = np.array([np.inf, *[decades] * 4])
    curves = Curves(avar, white, quantization, ramp, factor)
    got = cell_limits(curves, squares, dof, columns, own, ks, span, 1e6, quantile_curve)
    freedom = np.minimum(own.T * factor[..., None], 1e6)
    freedom[..., 4] = np.minimum(freedom[..., 4], dof)
    reach = 1.0 / (chi2.ppf(0.05, freedom) / freedom * part)
    for w in range(40):
        is_finite = np.isfinite(avar[w])
        for a in range(5):
            able = np.flatnonzero(is_finite & (ks * span[a] >= ks[is_finite].max()))
            best = able[np.argmin(model[w, able] * reach[w, able, a])]
            assert got[w, a] == pytest.approx(avar[w, best] * reach[w, best, a], rel=1e-5)


@pytest.mark.parametrize(("variance", "terms"), [("hadamard", "QNBKR"), ("avar", "QNBK")])
def test_a_fit_without_a_ramp_needs_no_tables_of_trends(monkeypatch, variance, terms):
    monkeypatch.setattr(window_fit, "detrend_tables", lambda *_, **__: pytest.fail("made"))
    surface = windows_of(np.random.default_rng(15).standard_normal((3, 907)), variance=variance)
    assert (fit_noise(surface, terms=terms).observable.sel(term="R") == 0).all()


def test_every_variable_has_a_unit():
    product = fit_noise(windows_of(np.random.default_rng(15).standard_normal((3, 1000))))
    for term, law in LAWS.items():
        assert product[term].units == law.units
        assert product[term].unit_label == law.label
        assert product[f"{term}_stderr"].units == law.units
    np.testing.assert_allclose(product.N_squared, product.N**2)
    assert product.K_squared.units == "degree2 hour-3"


def test_wrong_arguments_are_explained():
    surface = windows_of(np.random.default_rng(16).standard_normal((3, 1000)))
    with pytest.raises(OptionError, match="Q, N, B, K, R"):
        fit_noise(surface, terms="NX")
    for terms in (None, 3, ["NB"]):
        with pytest.raises(OptionError, match="Q, N, B, K, R"):
            fit_noise(surface, terms=terms)
    with pytest.raises(SchemaError, match="avar"):
        fit_noise(surface.drop_vars("avar"))
    with pytest.raises(SchemaError, match="white_response"):
        fit_noise(surface.drop_vars("white_response"))
    for level in (95, "0.9"):
        with pytest.raises(OptionError, match="between 0 and 1"):
            confidence_interval(surface, level=level)


@pytest.mark.parametrize("kind", ["rate", "angle"])
def test_removing_the_trend_equals_removing_the_line_from_the_samples(kind):
    """In unbroken runs, in clusters and in angle logs; window by window."""
    rng = np.random.default_rng(41)
    x = white(rng, 1, 12_000, N=0.01, rate=RATE) + 9000.0 * np.arange(12_000) / RATE / 3600
    missing = np.isnan(lose(rng, np.zeros_like(x), 0.3, 50))[0]
    signal = x[0] if kind == "rate" else np.cumsum(x[0]) / RATE / 3600

    def surface_of(values, **options):
        log = make_log(
            np.where(missing[: values.size], np.nan, values), rate=RATE, kind=kind,
            unit="deg/h" if kind == "rate" else "deg",
        )  # fmt: skip
        return davar(log, **options)

    surface = surface_of(signal, window="40s", step="25s", taus=24)
    assert set(np.unique(surface.estimator)) == ({1, 2} if kind == "rate" else {1})
    slope = float(surface.window_trend[0, 0])
    hours = np.arange(4001) / RATE / 3600
    line = slope * hours[:4000] if kind == "rate" else slope * hours**2 / 2
    options = {"window": "40s", "step": "40s", "taus": list(surface.tau.values)}
    bare = surface_of(signal[: line.size] - line, **options)
    cells, *_ = fit_inputs(surface)
    ramp = surface.ramp_response[0, 0] * slope**2 * (surface.tau / 3600) ** 2 / 2
    np.testing.assert_allclose(cells[0][0, 0] - ramp, bare.avar[0, 0], rtol=1e-6)


def test_ramp_through_gaps_changes_only_the_ramp():
    """However strong it is: misfit and coefficients of the noise stay what they are."""
    rng = np.random.default_rng(42)
    x = lose(rng, white(rng, 30, 4000, N=0.01, rate=RATE), 0.3, 50)
    hours = (np.arange(4000) - 2000) / RATE / 3600
    few, many = (fit_noise(windows_of(x + slope * hours, taus=24)) for slope in (500.0, 50_000.0))
    assert float((chi2.sf(many.fit_chi2, many.fit_dof) < 1e-3).mean()) == 0
    np.testing.assert_allclose(many.fit_chi2, few.fit_chi2, rtol=0.1)  # steps of the iteration
    np.testing.assert_allclose(many.N, few.N, rtol=0.01)
    np.testing.assert_allclose(many.window_trend - few.window_trend, 49_500.0, rtol=1e-9)
    assert (many.observable.sel(term="R") == 2).all()


@pytest.mark.parametrize("kind", ["random walk", "flicker", "quantization"])
def test_trend_of_noise_through_gaps_is_no_ramp(kind):
    """The variance of the trend depends on where the samples are missing, and on the noise."""
    rng = np.random.default_rng([43, len(kind)])
    x = white(rng, 200, 2000, N=0.01, rate=RATE)
    if kind == "quantization":  # whose errors at both ends of a gap do not cancel
        x = lose(rng, x + quantization(rng, 200, 2000, Q=2.0, rate=RATE), 0.1, 1)
    else:
        noise = random_walk(rng, 200, 2000, K=400.0, rate=RATE)
        x += noise if kind == "random walk" else flicker(rng, 200, 2000, B=3.0)
        x[:, 600:] = np.nan
    product = fit_noise(windows_of(x, taus=24), tau_min="all", observed_only=False)
    assert float((product.observable.sel(term="R") == 2).mean()) <= 0.03
    assert float((NORMAL_95 * product.R_stderr >= product.R).mean()) >= 0.94


@pytest.mark.parametrize("loss", ["10 % one by one", "30 % in bursts", "last 70 %"])
def test_intervals_hold_where_strong_quantization_noise_meets_gaps(loss):
    """The jumps across the gaps are one sample at all averaging times, and clusters are thinned."""
    Q = {"10 % one by one": 2.0, "30 % in bursts": 5.0, "last 70 %": 10.0}[loss]
    rng = np.random.default_rng([45, len(loss)])
    x = white(rng, 400, 4000, N=0.01, rate=RATE) + quantization(rng, 400, 4000, Q=Q, rate=RATE)
    if loss == "last 70 %":
        x[:, 1200:] = np.nan
    else:
        x = lose(rng, x, *((0.1, 1) if loss.startswith("10") else (0.3, 50)))
    surface = windows_of(x, taus=24)
    product = fit_noise(surface, tau_min="all", observed_only=False)
    assert float((chi2.sf(product.fit_chi2, product.fit_dof) < 1e-3).mean()) <= 0.02
    for term, true in (("Q", Q), ("N", 0.01)):
        assert (
            float((abs(product[term] - true) <= NORMAL_95 * product[f"{term}_stderr"]).mean())
            >= 0.94
        )
        assert float((product[f"{term}_upper"] < true).mean()) <= 0.07
    assert float((product.observable.sel(term=["B", "K", "R"]) == 2).mean()) <= 0.01
    law = surface.quantization_response * model_avar(surface.tau, {"Q": Q})
    law = law + surface.white_response * model_avar(surface.tau, {"N": 0.01})
    limits = confidence_interval(product)
    hit = ((limits.avar_lower <= law) & (law <= limits.avar_upper)).where(surface.avar.notnull())
    assert float(hit.mean(("axis", "time")).min()) >= 0.9


def test_angles_on_both_sides_of_a_gap_give_its_rate():
    """Errors of an angle cancel in the trend, so that a lost angle adds hardly any scatter."""
    rng = np.random.default_rng(44)
    angle = np.cumsum(white(rng, 1, 200_000, N=0.002, rate=RATE)[0]) / RATE / 3600
    angle += np.degrees(2e-6) * rng.standard_normal(angle.size)
    angle[rng.random(angle.size) < 0.1] = np.nan
    log = make_log(angle, rate=RATE, unit="deg", kind="angle")
    surface = davar(log, window="2000samples", step="2000samples", taus=24)
    assert float(surface.trend_quantization_response.max()) < 1.2
    product = fit_noise(surface, tau_min="all")
    assert float((chi2.sf(product.fit_chi2, product.fit_dof) < 1e-3).mean()) <= 0.02
    assert (product.observable.sel(term=["B", "K", "R"]) < 2).mean() > 0.98
    np.testing.assert_allclose(product.Q.mean(), 2.0, rtol=0.02)


@pytest.mark.parametrize("block", [5, 50])
def test_strong_ramp_fits_in_windows_with_gaps(block):
    """Lost samples move the centres of clusters; the ramp response accounts for that."""
    rng = np.random.default_rng([31, block])
    x = white(rng, 100, 4000, N=0.01, rate=RATE) + 3000.0 * np.arange(4000) / RATE / 3600
    surface = windows_of(lose(rng, x, 0.2, block), taus=24)
    bare = surface.assign(ramp_response=xr.ones_like(surface.ramp_response))
    fails = [
        float((chi2.sf(product.fit_chi2, product.fit_dof) < 1e-3).mean())
        for product in (fit_noise(surface), fit_noise(bare))
    ]
    assert fails[0] <= 0.02
    assert block == 5 or fails[1] > 0.15
    # as a version wrote it that took the response of a ramp as 1
    old = surface.drop_vars("ramp_response")
    xr.testing.assert_equal(fit_noise(old), fit_noise(bare).drop_vars("ramp_response"))


def test_window_of_no_noise_term_has_no_infinite_limit():
    """Without a noise term that fits, no cell has degrees of freedom, and none bounds a ramp."""
    rng = np.random.default_rng(33)
    x = 10.0 + rng.normal(size=300)
    rng.integers(0, 200)
    x[rng.random(300) < 0.3] = np.nan
    x[16:115] = 0.0
    log = make_log(x, rate=100.0, unit="deg/h")
    surface = davar(log, window="3s", step="3s", taus="octave", variance="modified")
    product = fit_noise(surface, tau_min=0.01)
    assert np.isfinite(product.avar).any()
    assert np.isnan(product.R_upper)
    assert product.observable.values.ravel().tolist() == [1, 0, 0, 0, 0]

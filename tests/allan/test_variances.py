"""Hadamard and modified Allan variance: allantools, direct sums, gaps, scatter, fit."""

from __future__ import annotations

import allantools
import numpy as np
import pytest
import xarray as xr
from hypothesis import example, given
from hypothesis import strategies as st

from gyrostab import davar, fit_noise, make_log
from gyrostab.allan.variance import surface_columns, variance_name
from gyrostab.errors import OptionError
from gyrostab.kernels.allan.surface import WorkUnit, surface_unit
from gyrostab.kernels.fit.covariance import product_tables, third_columns
from gyrostab.noise import sample_squares
from gyrostab.plot import plot_adev

RATE = 100.0
VARIANCES = ["hadamard", "modified"]
#: Weights of the angles of a third difference.
THIRD = (-1.0, 3.0, -3.0, 1.0)


def direct_sums(x, variance, window, step, ks, *, angle=False):
    """Mean square and count of every window and factor, term by term."""
    theta = x if angle else np.concatenate([[0.0], np.cumsum(np.nan_to_num(x))])
    windows = (x.size - window - angle) // step + 1
    avar, count = np.full((2, windows, ks.size), np.nan)
    for j in range(windows):
        for i, k in enumerate(ks):
            span = 3 * k - (variance == "modified")
            squares = []
            for m in range(j * step, j * step + window - span + 1):
                places = m + np.arange(4) * k
                used = x[places[places < x.size]] if angle else x[m : m + span]
                if variance == "modified":
                    inner = np.arange(m, m + k)
                    used = x[m : m + 3 * k] if angle else used
                    d = np.sum(theta[inner + 2 * k] - 2 * theta[inner + k] + theta[inner])
                else:
                    d = np.dot(THIRD, theta[places])
                if np.isfinite(used).all():
                    squares.append(d**2 / (2.0 * k**4 if variance == "modified" else 6.0 * k**2))
            count[j, i] = len(squares)
            if squares:
                avar[j, i] = np.mean(squares)
    return avar, count


@pytest.mark.parametrize("variance", VARIANCES)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(20, 60),
    st.sampled_from([0.0, 0.02, 0.2]),
    st.sampled_from([0.0, 1e9]),
    st.booleans(),
)
@example(seed=113328, window=25, missing=0.02, shock=1e9, angle=False)
def test_cells_are_those_of_direct_sums(variance, seed, window, missing, shock, angle):
    rng = np.random.default_rng(seed)
    step, n = int(rng.integers(1, window + 1)), int(rng.integers(window + 1, 150))
    x = rng.integers(-9, 10, n).astype(np.float64)  # so that the direct sums are exact
    x[n // 2] += shock if not angle else 0.0
    x[rng.random(n) < missing] = np.nan
    ks = np.array([1, 2, 3, 5])
    unit = WorkUnit(window, step, ks, angle, 1.0, 0.3, 0.0, variance)
    cells, _ = surface_unit(x, unit)
    want, count = direct_sums(x, variance, window, step, ks, angle=angle)
    np.testing.assert_array_equal(np.broadcast_to(cells.count, count.shape), count)
    np.testing.assert_allclose(cells.avar, want, rtol=1e-13, atol=1e-13)
    few = count == 0
    assert np.all(np.broadcast_to(cells.gap_factor, count.shape)[few] == 0.0)


@pytest.mark.parametrize("variance", ["avar", *VARIANCES])
def test_a_shock_costs_no_digits_of_windows_without_it(variance):
    x, ks = np.random.default_rng(2).standard_normal(120), np.array([1, 2, 3, 5])
    unit = WorkUnit(30, 6, ks, False, 1.0, 0.3, 0.0, variance)
    want = surface_unit(x, unit)[0].avar
    x[60] = 1e9
    cells = surface_unit(x, unit)[0].avar
    begins = np.arange(len(want)) * 6
    other = (begins > 60) | (begins + 30 <= 60)
    np.testing.assert_allclose(cells[other], want[other], rtol=1e-13)


@pytest.mark.parametrize(("variance", "peer"), [("hadamard", "ohdev"), ("modified", "mdev")])
def test_windows_agree_with_allantools(variance, peer):
    x = np.random.default_rng(3).standard_normal(3000) + np.arange(3000) * 0.01
    log = make_log(x, rate=RATE, unit="deg/h")
    taus = [0.01, 0.02, 0.05, 0.3, 1.0, 3.3]
    surface = davar(log, window="10s", step="3s", taus=taus, tau_max=3.3, variance=variance)
    for j in range(surface.sizes["time"]):
        part = x[j * 300 : j * 300 + 1000]
        tau, deviation, _, count = getattr(allantools, peer)(
            part, rate=RATE, data_type="freq", taus=taus
        )
        np.testing.assert_allclose(surface.tau, tau)
        np.testing.assert_allclose(surface.avar[0, j], deviation**2, rtol=1e-9)
        np.testing.assert_array_equal(surface["count"][0, j], count)


@pytest.mark.parametrize("variance", VARIANCES)
def test_a_drift_of_the_rate_disappears_only_from_the_hadamard_variance(variance):
    drift = np.arange(2000) * 0.5
    log = make_log(drift, rate=RATE, unit="deg/h")
    surface = davar(log, window="10s", variance=variance)
    slope = 0.5 * RATE * 3600.0  # deg/h^2
    if variance == "hadamard":
        assert float(surface.avar.max()) < 1e-12
    else:
        want = surface_columns(surface)[:, 4] * slope**2
        np.testing.assert_allclose(surface.avar[0, 0], want, rtol=1e-9)


def test_columns_are_the_published_laws():
    ks = np.array([1, 2, 7, 50, 3000])
    k = ks.astype(float)
    flicker = (8 * np.log(2) - 3 * np.log(3)) / (2 * np.pi)  # SP 1065: ln(256/27) / 2 of h(-1)
    want = np.stack([10 / (3 * k**2), 1 / k, flicker + 0 * k, k / 6, 0 * k], axis=1)
    np.testing.assert_allclose(third_columns("hadamard", ks), want, rtol=1e-7)
    modified = third_columns("modified", ks)
    # Exact for every k; SP 1065 gives the limits 3/k^3, 1/2k and (33/40) k/3.
    want = np.stack([3 / k**3, (1 + k**-2) / (2 * k), (33 * k + 5 / k + 2 / k**3) / 120, k**2 / 2])
    np.testing.assert_allclose(modified[:, [0, 1, 3, 4]].T, want, rtol=1e-7)
    assert modified[0, 2] == pytest.approx(2 * np.log(2) / np.pi)
    limit = (27 * np.log(3) - 32 * np.log(2)) / (8 * np.pi)  # 27/20 ln 2 of h(-1), rounded
    assert modified[-1, 2] == pytest.approx(limit, rel=1e-5)


def noise_record(rng, shape, *, q=0.0, n=0.0, k=0.0):
    """Quantization, white and random walk noise along the last axis, in sample units."""
    steps = k * rng.standard_normal(shape)
    bridge = k * rng.standard_normal(shape) / np.sqrt(12.0)  # mean of a walk over each sample
    angle = q * rng.standard_normal((*shape[:-1], shape[-1] + 1))
    walk = steps.cumsum(axis=-1) - 0.5 * steps + bridge
    return np.diff(angle, axis=-1) + n * rng.standard_normal(shape) + walk


@pytest.mark.parametrize("variance", VARIANCES)
@pytest.mark.parametrize(("term", "place"), [("q", 0), ("n", 1), ("k", 3)])
def test_mean_and_scatter_are_those_of_the_tables(variance, term, place):
    count, window, ks = 3000, 400, np.array([1, 3, 10, 40, 88])
    unit = WorkUnit(window, window, ks, False, 1.0, 0.3, 0.0, variance)
    records = noise_record(np.random.default_rng(7), (count, window), **{term: 1.0})
    cells = np.concatenate([surface_unit(x, unit)[0].avar for x in records])
    want = product_tables(window, ks, variance=variance)[0][place, place]
    sigma = np.sqrt(want.diagonal())
    error = (cells.mean(axis=0) - third_columns(variance, ks)[:, place]) / sigma
    assert np.abs(error).max() < 4.0 / np.sqrt(count)
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(np.cov(cells.T) / scale, want / scale, atol=0.15)


@pytest.mark.parametrize("variance", VARIANCES)
def test_degrees_of_freedom_with_gaps_are_those_of_simulated_records(variance):
    rng, window = np.random.default_rng(11), 600
    lost = np.zeros(window, bool)
    lost[150:210] = lost[400:404] = True
    ks = np.array([1, 5, 20, 40])
    x = rng.standard_normal((3000, window))
    x[:, lost] = np.nan
    unit = WorkUnit(window, window, ks, False, 1.0, 0.0, 0.0, variance)
    surfaces = [surface_unit(row, unit)[0] for row in x]
    avar = np.concatenate([cells.avar for cells in surfaces])
    pairs, _ = product_tables(window, ks, variance=variance)
    own = 2.0 * third_columns(variance, ks)[:, 1] ** 2 / pairs[1, 1].diagonal()
    edf = 2.0 * avar.mean(axis=0) ** 2 / avar.var(axis=0)
    np.testing.assert_allclose(own * surfaces[0].gap_factor[0], edf, rtol=0.12)


@pytest.mark.parametrize("variance", VARIANCES)
def test_fit_finds_the_noise_and_says_what_it_cannot_see(variance):
    squares, truth = sample_squares(RATE), {"N": 0.02, "K": 60.0}
    n, k = (truth[t] * np.sqrt(squares[i]) for t, i in (("N", 1), ("K", 3)))
    x = noise_record(np.random.default_rng(5), (2_400_000,), n=n, k=k)
    x += 5000.0 * np.arange(x.size) / (3600.0 * RATE)
    x[50_000:60_000] = np.nan
    log = make_log(x, rate=RATE, unit="deg/h")
    surface = davar(log, window="1min", step="1min", variance=variance)
    product = fit_noise(surface, terms="QNKR", observed_only=False)
    for term, value in truth.items():
        size = float(np.sqrt(np.mean(product[term] ** 2)))
        assert size == pytest.approx(value, rel=0.01 if term == "N" else 0.05)
        error = np.abs(product[term] - value) / product[f"{term}_stderr"]
        assert 0.9 < float((error < 1.96).mean()) <= 1.0
    flags = product.observable.sel(term="R")
    if variance == "hadamard":
        assert not flags.any()
        assert np.isnan(product.R).all()
        assert np.isnan(product.R_upper).all()
    else:
        assert float((flags == 2).mean()) > 0.9
        assert float(product.R.median()) == pytest.approx(5000.0, rel=0.05)
    described = product.fit_chi2 / product.fit_dof
    assert 0.7 < float(described.median()) < 1.3


@pytest.mark.parametrize("variance", VARIANCES)
def test_a_surface_says_which_variance_it_holds(variance):
    log = make_log(np.random.default_rng(0).standard_normal(5000), rate=RATE, unit="deg/h")
    surface = davar(log, window="10s", variance=variance)
    assert surface.attrs["variance"] == variance
    assert variance_name(surface) in surface.avar.attrs["long_name"]
    assert variance_name(xr.Dataset()) == "Allan"
    lazy = davar(log.chunk(time=700), window="10s", variance=variance)
    xr.testing.assert_identical(lazy.compute(), surface)
    with pytest.raises(OptionError, match="a third of the window"):
        davar(log, window="10s", variance=variance, tau_max=4.0)
    product = fit_noise(surface)
    figure = plot_adev(product, "x")
    assert variance_name(surface) in figure.axes[0].get_ylabel()


def test_unknown_variance_and_a_ramp_alone_are_refused():
    log = make_log(np.zeros(5000), rate=RATE, unit="deg/h")
    with pytest.raises(OptionError, match="avar, hadamard, modified"):
        davar(log, window="10s", variance="total")
    with pytest.raises(OptionError, match="does not see a ramp"):
        fit_noise(davar(log, window="10s", variance="hadamard"), terms="R")

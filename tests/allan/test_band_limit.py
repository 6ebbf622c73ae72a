"""The band limit: simulated noise behind filters of SciPy, closed forms, and what is no filter."""

import numpy as np
import pytest
import xarray as xr
from scipy.signal import butter, firwin, lfilter

import gyrostab
from gyrostab.allan import fit
from gyrostab.allan.band_limit import choose_windows, filter_response, low_pass_response
from gyrostab.allan.summary import describe_record, summarise_fit
from gyrostab.jobs.run import run
from tests.support.noise_records import flicker, lose, quantization, random_walk, white

RATE, N = 100.0, 0.01
POLE = np.exp(-2 * np.pi * 10 / RATE)
FILTERS = {
    "rc": ([1 - POLE], [1.0, -POLE]),
    "butterworth": butter(2, 10, fs=RATE),
    "boxcar": (np.ones(10) / 10, [1.0]),
    "cic": (np.convolve(np.convolve(np.ones(5), np.ones(5)), np.ones(5)) / 125, [1.0]),
    "fir": (firwin(63, 20, fs=RATE), [1.0]),
}


def time_constant(b, a):
    """Sum of |lag| times the autocorrelation over that of the autocorrelation [s]."""
    impulse = lfilter(b, a, np.r_[1.0, np.zeros(999)])
    r = np.correlate(impulse, impulse, "full")
    return float((np.abs(np.arange(-999, 1000)) * r).sum() / r.sum() / RATE)


def make_surface(x):
    log = gyrostab.make_log(x.reshape(-1), rate=RATE, unit="deg/h")
    length = f"{x.shape[-1]}samples"
    return gyrostab.davar(log, window=length, step=length, taus=30)


def filtered(name, seed, windows=24, samples=8000, **terms):
    rng = np.random.default_rng(seed)
    x = white(rng, windows, samples + 500, N=N, rate=RATE)
    if "B" in terms:
        x += flicker(rng, windows, samples + 500, B=terms["B"])
    if "K" in terms:
        x += random_walk(rng, windows, samples + 500, K=terms["K"], rate=RATE)
    return lfilter(*FILTERS[name], x)[:, 500:]


@pytest.mark.parametrize("name", FILTERS)
def test_behind_a_filter_the_noise_is_that_without_it(name):
    product = gyrostab.fit_noise(make_surface(filtered(name, 1, B=1.0)))
    constant = time_constant(*FILTERS[name])
    assert product.filter_time_constant.item() == pytest.approx(constant, abs=0.005)
    assert 2 * constant < product.fit_tau_min.item() < 0.5
    assert float(product.N.mean()) == pytest.approx(N, rel=0.03)
    assert float(product.B.mean()) == pytest.approx(1.0, rel=0.1)
    assert (product.observable.sel(term="B") == 2).mean() > 0.6
    assert (product.observable.sel(term="Q") == 0).all()
    assert 0.6 < summarise_fit(product)[0].chi2_per_dof < 1.4
    assert not summarise_fit(product)[0].fails


def test_the_error_of_n_includes_that_of_the_time_constant():
    """Two windows determine the time constant hardly better than N."""
    scores = []
    for seed in range(24):
        surface = make_surface(filtered("boxcar", seed, windows=2, samples=4000))
        product = gyrostab.fit_noise(surface, observed_only=False)
        limit = [product[name].item() for name in fit._BAND_VARIABLES]
        assert 0.003 < limit[2] < 0.05
        without_error = fit.fit_part(surface, bands={"x": limit[:2]}, observed_only=False)
        squares = without_error.N_stderr**2 + (limit[2] * product.N) ** 2
        np.testing.assert_allclose(product.N_stderr, np.sqrt(squares), rtol=0.05)
        scores.append(
            [((fitted.N - N) / fitted.N_stderr).values for fitted in (product, without_error)]
        )
    with_error, without = np.std(scores, axis=(0, 2, 3))
    assert with_error < 1.2 < without


def test_the_response_is_exact_beyond_the_memory_of_a_moving_average():
    """Allan variance of white noise behind a boxcar of ten, from its autocorrelation."""
    r = np.convolve(np.ones(10), np.ones(10)) / 100
    constant = time_constant(*FILTERS["boxcar"])
    assert constant == pytest.approx((100 - 1) / 30 / RATE)
    for k in (9, 12, 40):
        weights = np.r_[np.ones(k), -np.ones(k)]
        avar = np.sum(np.correlate(weights, weights, "full")[2 * k - 10 : 2 * k + 9] * r)
        assert avar / (2 * k**2) == pytest.approx(
            filter_response(np.array([k / RATE]), constant)[0] / k
        )


@pytest.mark.parametrize(
    "terms", [{"N": 1}, {"Q": 1}, {"N": 1, "Q": 1}, {"K": 1}, {"N": 1, "B": 1}, {"N": 1, "line": 1}]
)
def test_noise_without_a_filter_has_no_band_limit(terms):
    """Quantization noise, steeper than white, and a line at 12.3 Hz are no filters."""
    rng = np.random.default_rng(5)
    x = np.zeros((12, 4000))
    if "N" in terms:
        x += white(rng, *x.shape, N=N, rate=RATE)
    if "Q" in terms:
        x += quantization(rng, *x.shape, Q=0.4, rate=RATE)
    if "K" in terms:
        x += random_walk(rng, *x.shape, K=60.0, rate=RATE)
    if "B" in terms:
        x += flicker(rng, *x.shape, B=1.0)
    if "line" in terms:
        x += 3.0 * np.sin(2 * np.pi * 12.3 * np.arange(4000) / RATE)
    product = gyrostab.fit_noise(make_surface(x))
    assert product.filter_time_constant.item() == 0.0
    assert product.fit_tau_min.item() == float(product.tau[0])


@pytest.mark.parametrize("seed", [0, 6, 8])
def test_white_noise_that_changes_its_level_has_no_filter(seed):
    """One window over the whole record, with three times the noise in its middle third."""
    x = np.random.default_rng(seed).standard_normal(20_000)
    x[6_667:13_334] *= 3.0
    assert gyrostab.fit_noise(make_surface(x)).filter_time_constant.item() == 0.0


def test_the_response_of_a_low_pass_is_that_of_its_autocorrelation():
    """A pole of 0.99 at 100 Hz is a low-pass with a time constant of 0.995 s."""
    k = np.arange(1, 4001)
    power = 0.99 ** np.arange(8001)
    # variance of the angle over m samples, of noise with unit density
    lags = np.cumsum(power[1:] * np.arange(1, 8001)), np.cumsum(power[1:])
    m = np.arange(1, 8001)
    angle = m + 2.0 * (m * lags[1] - lags[0])
    angle /= (1 + 0.99) / (1 - 0.99)
    exact = (4.0 * angle[k - 1] - angle[2 * k - 1]) / (2.0 * k)
    for place in (9, 99, 3999):
        response = low_pass_response(k[place] / 100.0, 0.995)
        assert response == pytest.approx(exact[place], rel=0.01)


def test_each_axis_has_its_filter_and_gaps_and_motion_do_not_hide_it():
    rng = np.random.default_rng(6)
    x = np.stack([filtered("boxcar", 7), white(rng, 24, 8000, N=N, rate=RATE)])
    x[0, 3] += 500.0 * np.sin(2 * np.pi * 0.2 * np.arange(8000) / RATE)  # motion in one window
    x[0] = lose(rng, x[0], 0.1, 200)
    log = gyrostab.make_log(x.reshape(2, -1), rate=RATE, unit="deg/h")
    surface = gyrostab.davar(log, window="80s", step="80s", taus=30)
    product = gyrostab.fit_noise(surface)
    constants = product.filter_time_constant.values
    assert constants[0] == pytest.approx(0.033, abs=0.005)
    assert constants[1] == 0.0
    assert (product.observable.isel(axis=0, time=3) < 2).all()
    assert (product.observable.isel(axis=1).sel(term="Q") > 0).all()
    # the filter stays with the product, also where few windows are fitted again
    refitted = gyrostab.allan.fit.refit(product.isel(time=[5]))
    assert refitted.filter_time_constant.values.tolist() == constants.tolist()
    assert float(refitted.N[0, 0]) == float(product.N[0, 5])
    plain = gyrostab.fit_noise(surface, tau_min="all")
    assert (plain.filter_time_constant == 0).all()
    assert (plain.observable.isel(axis=0) < 2).all()
    (text,) = [line for line in describe_record(product) if "filter" in line]
    assert text.startswith(
        "Averaging times at which a filter shapes the noise are left out: x below"
    )


def test_a_run_in_parts_finds_the_filter_of_the_whole_record(tmp_path):
    log = gyrostab.make_log(filtered("cic", 8).reshape(-1), rate=RATE, unit="deg/h")
    gyrostab.to_netcdf(log, tmp_path / "log.nc")
    run([tmp_path / "log.nc"], tmp_path / "product.nc", windows={"window": "80s"})
    product = gyrostab.open_product(tmp_path / "product.nc").load()
    whole = gyrostab.fit_noise(gyrostab.davar(log, window="80s"))
    assert product.filter_time_constant.item() == pytest.approx(0.03, rel=0.2)
    for name in ("N", "N_stderr", "fit_chi2", "edf", "fit_tau_min", "filter_time_constant"):
        xr.testing.assert_equal(product[name].variable, whole[name].variable)


def test_windows_of_the_average_do_not_overlap():
    assert np.diff(choose_windows(1000, window=100, step=7)).min() >= 15
    assert choose_windows(10_000, window=100, step=50).size == 24
    assert choose_windows(1, window=100, step=10).tolist() == [0]

"""Compare estimators of the five coefficients with each other and with the Cramer-Rao bound.

    python benchmarks/estimators.py --output docs/statistics.md

Every estimator gets the same simulated records and fits all five terms. What other tools do is
written again from their sources, with the constants of IEEE Std 952 where they have others. All
Allan variances are those of `davar`; the times of the estimators do not include them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import xarray as xr
from fit_coverage import choose_squares, make_units, surface_of
from page import make_parser, renew, table
from scipy.fft import dct
from scipy.optimize import least_squares, nnls
from scipy.stats import chi2

from gyrostab import davar, fit_noise, make_log
from gyrostab.allan import window_fit
from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.spectra.expected import sample_covariance
from gyrostab.noise import LAWS, NORMAL_95, TERMS, avar_columns

MIXTURES = ("", "Qs", "Bm", "Bs", "Km", "Ks", "Rs", "QsBsKsRs")
#: Length [s], rate [Hz] and number of records.
LENGTHS = ((40.0, 100.0, 200), (600.0, 100.0, 100), (7200.0, 10.0, 100))
#: Cosines that are taken one by one, which hold the ramp; the others are averaged in groups.
SINGLE, GROUPS = 64, 200


class Records(NamedTuple):
    """Records of one length and mixture (n_records, n), with their Allan variances."""

    values: Floats
    rate: float
    surface: xr.Dataset  # with the averaging times that `davar` chooses
    #: At up to 100 averaging times up to a tenth of the record, and at 1, 2, 4, ... samples up to a
    #: quarter of it: averaging factors, and Allan variance (n_records, n_factors).
    dense: tuple[Ints, Floats]
    octaves: tuple[Ints, Floats]
    #: At a quarter of it: averaging factors (1,), and Allan variance (n_records, 1).
    quarter: tuple[Ints, Floats]


class Estimates(NamedTuple):
    """Coefficients with the ends of their 95 % intervals, (n_records, 5)."""

    value: Floats
    low: Floats
    high: Floats


def from_squares(square: Floats, error: Floats) -> Estimates:
    """Take the roots of squared coefficients and of their normal intervals."""
    ends = (square, square - NORMAL_95 * error, square + NORMAL_95 * error)
    return Estimates(*(np.sqrt(np.maximum(end, 0.0)) for end in ends))


def without_intervals(value: Floats) -> Estimates:
    nothing = np.full(value.shape, np.nan)
    return Estimates(value, nothing, nothing)


def measure_avar(values: Floats, rate: float, ks: Ints) -> Floats:
    n = values.shape[1]
    log = make_log(values.reshape(-1), rate=rate, unit="deg/h")
    taus = list(ks / rate)
    surface = davar(log, window=f"{n}samples", step=f"{n}samples", taus=taus, tau_max=n / 2 / rate)
    return np.asarray(surface.avar.values[0])


def make_records(values: Floats, rate: float) -> Records:
    n = values.shape[1]
    dense = np.unique(np.round(np.geomspace(1, n // 10, 100)).astype(np.int64))
    octaves = 2 ** np.arange(int(np.log2(n)) - 1)
    factors = (dense, octaves, np.array([n // 4]))
    curves = ((ks, measure_avar(values, rate, ks)) for ks in factors)
    return Records(values, rate, surface_of(values, rate), *curves)


def fit_gyrostab(records: Records) -> Estimates:
    product = fit_noise(records.surface, observed_only=False)
    value, error = (
        np.stack([product[term + name].values[0] for term in TERMS], axis=1)
        for name in ("", "_stderr")
    )
    return Estimates(value, value - NORMAL_95 * error, value + NORMAL_95 * error)


class Cosines:
    """Likelihood of the squares of the cosine transform of a record, as of Whittle.

    The transform (type II) makes a random walk diagonal as well as white noise, so that nothing
    leaks from low frequencies to high ones. The expected squares are exact; covariances between
    them are neglected. A ramp of free size is removed by generalised least squares.
    """

    def __init__(self, n: int, rate: float):
        lag, angle = np.arange(n), np.pi * np.arange(1, n) / n
        columns = np.empty((n - 1, 4))
        for a, covariance in enumerate(sample_covariance(n, rate)):
            covariance[1:] *= 2.0
            even = np.fft.rfft(covariance * (1.0 - lag / n), 2 * n)[1:n].real
            odd = -np.fft.rfft(covariance / n, 2 * n)[1:n].imag
            columns[:, a] = LAWS[TERMS[a]].seconds_factor * (even - odd / np.sin(angle))
        edges = np.concatenate([np.arange(SINGLE), np.geomspace(SINGLE, n - 1, GROUPS)[:-1]])
        self.edges = np.unique(edges.astype(np.int64))
        self.count = np.diff(np.append(self.edges, n - 1))
        self.columns = self.average(columns)
        self.ramp = dct((lag - (n - 1) / 2) / rate / 3600, norm="ortho")[1 : SINGLE + 1]

    def average(self, values: Floats) -> Floats:
        return np.asarray((np.add.reduceat(values, self.edges, axis=0).T / self.count).T)

    def information(self, squares: Floats, *, free_ramp: bool) -> tuple[Floats, float]:
        """Compute the Fisher information of the four squares (4, 4) and of the ramp."""
        expected = self.columns @ squares[:4]
        share = self.columns / expected[:, None]
        total = 0.5 * (share.T * self.count) @ share
        weight = self.ramp**2 / expected[:SINGLE]
        ramp = float(weight.sum())
        if free_ramp:
            mixed = weight @ share[:SINGLE]
            total -= (share[:SINGLE].T * weight) @ share[:SINGLE] / ramp
            total += 0.5 * np.outer(mixed, mixed) / ramp**2
        return total, ramp

    def bounds(self, squares: Floats) -> Floats:
        """Compute the Cramer-Rao bounds of the standard errors (5,) with the terms known."""
        information, ramp = self.information(squares, free_ramp=squares[4] > 0)
        present = np.flatnonzero(squares[:4])
        out = np.full(5, np.nan)
        variance = np.diag(np.linalg.inv(information[np.ix_(present, present)]))
        out[present] = np.sqrt(variance / (4.0 * squares[present]))
        out[4] = 1.0 / np.sqrt(ramp)
        return out

    def maximise(self, cosines: Floats) -> tuple[Floats, Floats]:
        """Return squares and slope of largest (restricted) likelihood, and their errors, (5,)."""
        power, low = self.average(cosines**2), cosines[:SINGLE]
        squares = np.array([0.0, np.median(power / self.columns[:, 1]), 0.0, 0.0])
        for step in range(100):
            expected = self.columns @ squares
            weight = self.ramp / expected[:SINGLE]
            information = weight @ self.ramp
            slope = weight @ low / information
            power[:SINGLE] = (low - slope * self.ramp) ** 2 + self.ramp**2 / information
            root = np.sqrt(self.count) / expected
            scale = 1.0 / np.linalg.norm(self.columns * root[:, None], axis=0)
            estimate = nnls(self.columns * root[:, None] * scale, root * power)[0] * scale
            change = np.abs(self.columns @ estimate / expected - 1.0).max()
            squares = estimate if step < 20 else 0.5 * (estimate + squares)
            if change < 1e-5:
                break
        final_information, ramp = self.information(squares, free_ramp=True)
        scale = 1.0 / np.sqrt(np.diag(final_information))
        covariance = np.linalg.pinv(final_information * np.outer(scale, scale)) * np.outer(
            scale, scale
        )
        error = np.append(np.sqrt(np.diag(covariance)), 1.0 / np.sqrt(ramp))
        return np.append(squares, slope), error


def fit_whittle(records: Records) -> Estimates:
    likelihood = Cosines(records.values.shape[1], records.rate)
    cosines = dct(records.values, norm="ortho", axis=1)[:, 1:]
    value, error = np.array([likelihood.maximise(row) for row in cosines]).transpose(1, 0, 2)
    out = from_squares(value, error)
    slope, reach = np.abs(value[:, 4]), NORMAL_95 * error[:, 4]
    for array, end in zip(out, (slope, slope - reach, slope + reach), strict=True):
        array[:, 4] = end
    return out


def fit_gmwm(records: Records) -> Estimates:
    """Match the Haar wavelet variances, half the Allan variances, of 2, 4, 8, ... samples.

    First with the widths of their chi-square intervals as weights, then with their covariance
    under this fit; that is exact here, where `simts` takes it from simulated records.
    """
    n, (ks, avar) = records.values.shape[1], records.octaves
    tables = window_fit.fit_tables(tuple(ks.tolist()), records.rate, n)
    columns, wavelet = tables.columns / 2, avar / 2
    freedom = np.maximum((n - 2 * ks + 1) / (2 * ks), 1.0)
    width = freedom / chi2.ppf(0.025, freedom) - freedom / chi2.ppf(0.975, freedom)
    scale = 1.0 / np.linalg.norm(columns / wavelet[0][:, None], axis=0)
    value, error = np.empty((2, len(wavelet), 5))
    for row, data in enumerate(wavelet):
        weighted = columns * scale / (width * data)[:, None]
        squares = nnls(weighted, 1.0 / width)[0] * scale
        amounts = squares * tables.to_samples
        covariance = np.einsum("a,b,abij->ij", amounts[:4], amounts[:4], tables.pairs)
        covariance += np.einsum("a,aij->ij", amounts[:4] * amounts[4], tables.ramps)
        covariance += 1e-7 * np.diag(np.diag(covariance))
        inverse = 2.0 * np.linalg.inv(np.linalg.cholesky(covariance))
        whitened = inverse @ (columns * scale)
        value[row] = nnls(whitened, inverse @ data)[0] * scale
        error[row] = np.sqrt(np.diag(np.linalg.pinv(whitened.T @ whitened))) * scale
    return from_squares(value, error)


def fit_relative(records: Records) -> Estimates:
    """Fit non-negative least squares of relative residuals (nmayorov/allan-variance)."""
    ks, avar = records.dense
    columns = avar_columns(ks / records.rate)
    estimates = []
    for data in avar:
        weighted = columns / data[:, None]
        scale = np.linalg.norm(weighted, axis=0)
        estimates.append(nnls(weighted / scale, np.ones(ks.size))[0] / scale)
    return without_intervals(np.sqrt(estimates))


def fit_logarithms(records: Records) -> Estimates:
    """Fit the logarithm of the Allan variance (imu_utils)."""
    ks, avar = records.dense
    columns = avar_columns(ks / records.rate)
    estimates = []
    for data in avar:
        scale = np.sqrt(data.mean() / columns.mean(axis=0))
        own = columns * scale**2 / data[:, None]
        start = np.abs(np.linalg.lstsq(np.sqrt(own), np.ones(ks.size), rcond=None)[0])
        result = least_squares(
            lambda root, own=own: np.log10(own @ root**2 + 1e-300),
            start,
            jac=lambda root, own=own: 2 * own * root / (own @ root**2 * np.log(10))[:, None],
        )
        estimates.append(np.abs(result.x) * scale)
    return without_intervals(np.array(estimates))


def read_slopes(records: Records) -> Estimates:
    """Read B at the minimum, Q and R at the ends, N and K where the local slope is closest.

    N before and K behind the minimum, as in MATLAB's example; Q at the shortest averaging time, R
    at a quarter of the record.
    """
    ks, avar = records.dense
    columns = avar_columns(ks / records.rate)
    local = np.diff(np.log(avar), axis=1) / np.diff(np.log(ks))
    value = np.empty((len(avar), 5))
    for row, (data, slopes) in enumerate(zip(avar, local, strict=True)):
        low = min(max(int(data.argmin()), 1), slopes.size - 1)
        places = {
            "Q": 0,
            "N": int(np.abs(slopes[:low] - LAWS["N"].power).argmin()),
            "B": low,
            "K": low + int(np.abs(slopes[low:] - LAWS["K"].power).argmin()),
        }
        for term, place in places.items():
            a = TERMS.index(term)
            value[row, a] = np.sqrt(data[place] / columns[place, a])
    ks, avar = records.quarter
    value[:, 4] = np.sqrt(avar[:, 0] / avar_columns(ks / records.rate)[0, 4])
    return without_intervals(value)


ESTIMATORS: dict[str, Callable[[Records], Estimates]] = {
    "gyrostab": fit_gyrostab,
    "Whittle": fit_whittle,
    "GMWM": fit_gmwm,
    "relative NNLS": fit_relative,
    "log fit": fit_logarithms,
    "slopes": read_slopes,
}


def judge(estimates: Estimates, true: Floats, bound: Floats) -> Floats:
    """Return relative bias and RMSE, efficiency and coverage of each term, (4, 5)."""
    value, low, high = estimates
    with np.errstate(divide="ignore", invalid="ignore"):
        bias = value.mean(axis=0) / true - 1.0
        error = np.sqrt(((value - true) ** 2).mean(axis=0))
        holds = np.where(np.isnan(low), np.nan, (low <= true) & (true <= high)).mean(axis=0)
        return np.stack([bias, error / true, (bound / error) ** 2, holds])


def compare(seconds: float, rate: float, trials: int, mixtures: tuple[str, ...] = MIXTURES):  # type: ignore[no-untyped-def]
    """Yield mixture, term, relative bound, and per estimator its figures and processor time."""
    n = int(seconds * rate)
    units, parts = make_units(np.random.default_rng([n, 1]), trials, n, rate)
    tables = window_fit.fit_tables(_default_factors(parts[1][:1], rate), rate, n)
    likelihood = Cosines(n, rate)
    for mixture in mixtures:
        squares = choose_squares(tables, mixture)
        true = np.sqrt(squares)
        values = sum(size * part for size, part in zip(true / units, parts, strict=True))
        records = make_records(values, rate)
        bound = likelihood.bounds(squares)
        figures, times = {}, {}
        for name, estimate in ESTIMATORS.items():
            started = time.process_time()
            figures[name] = judge(estimate(records), true, bound)
            times[name] = (time.process_time() - started) / trials
        for a in np.flatnonzero(squares):
            own = {name: values[:, a] for name, values in figures.items()}
            yield mixture or "none", TERMS[a], bound[a] / true[a], own, times


def _default_factors(record: Floats, rate: float) -> tuple[int, ...]:
    ks = np.round(surface_of(record, rate).tau.values * rate).astype(np.int64)
    return tuple(ks.tolist())


def summarise(cells: dict[str, list[tuple[str, Floats]]], times: dict[str, list[float]]) -> str:
    """Tabulate median efficiency, largest bias and mean coverage of each term and estimator."""
    rows = []
    for name, figures in cells.items():
        row = [name]
        for term in TERMS:
            own = np.array([values for symbol, values in figures if symbol == term])
            bias = own[np.abs(own[:, 0]).argmax(), 0]
            text = f"{np.median(own[:, 2]):.2f}; {bias:+.0%}"
            row.append(text + ("" if np.isnan(own[0, 3]) else f"; {own[:, 3].mean():.2f}"))
        rows.append([*row, f"{np.mean(times[name]) * 1e3:.2f} ms"])
    return table(["estimator", *TERMS, "time of a record"], rows)


def describe(figures: Floats) -> str:
    bias, error, efficiency, holds = figures
    text = f"{bias:+.1%}; {error:.1%}; {efficiency:.2f}"
    return text if np.isnan(holds) else f"{text}; {holds:.2f}"


def main() -> None:
    output = make_parser(__doc__).parse_args().output
    cells: dict[str, list[tuple[str, Floats]]] = {name: [] for name in ESTIMATORS}
    times: dict[str, list[float]] = {name: [] for name in ESTIMATORS}
    rows = []
    for seconds, rate, trials in LENGTHS:
        for mixture, term, bound, figures, spent in compare(seconds, rate, trials):
            for name, own in figures.items():
                cells[name].append((term, own))
                times[name].append(spent[name])
            figures = map(describe, figures.values())
            rows.append([f"{seconds:g} s", mixture, term, f"{bound:.1%}", *figures])
            print(*rows[-1], sep=" | ", flush=True)
    print(summary := summarise(cells, times))
    print(f"{time.process_time():.0f} s of processor time")
    renew(output, "estimators", summary)
    head = ["record", "terms on N", "term", "bound", *ESTIMATORS]
    renew(output, "estimator-cells", table(head, rows))


if __name__ == "__main__":
    main()

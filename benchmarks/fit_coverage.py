"""Measure how often the interval and the limit of each coefficient hold for the true value.

    python benchmarks/fit_coverage.py --output docs/statistics.md

Each term is absent, marginal or strong: its squared coefficient is 2.5 or 8 standard errors of a
fit of white noise and that term alone (for a ramp: its slope exceeds that of the other noise 2.5 or
8 times). Unit records of Q, N, B, K and R are simulated outside the package. Their Allan variances
and cross terms are added for every mixture, because `davar` is quadratic in the record.
"""

from __future__ import annotations

import itertools

import numpy as np
import xarray as xr
from page import make_parser, renew, table
from scipy.optimize import brentq

from gyrostab import davar, fit_noise, make_log
from gyrostab.allan import window_fit
from gyrostab.noise import NORMAL_95, TERMS
from tests.support.noise_records import flicker, lose, quantization, random_walk, white

N = 0.01
#: Length [s], rate [Hz] and number of windows.
LENGTHS = ((40.0, 100.0, 1000), (600.0, 100.0, 1000), (7200.0, 10.0, 1000))
PAIRS = list(itertools.combinations_with_replacement(range(5), 2))
MIXTURES = ("", "Qm", "Qs", "Bm", "Bs", "Km", "Ks", "Rm", "Rs", "QmBmKmRm", "QsBsKsRs", "KsRm")


def surface_of(x: np.ndarray, rate: float) -> xr.Dataset:
    length = f"{x.shape[1]}samples"
    return davar(make_log(x.reshape(-1), rate=rate, unit="deg/h"), window=length, step=length)


def make_units(rng: np.random.Generator, trials: int, n: int, rate: float):  # type: ignore[no-untyped-def]
    """Return unit coefficients of similar size, and records of each term alone."""
    hours = (np.arange(n) / rate - n / rate / 2) / 3600
    units = np.array([120.0, N, 20.0, 60 / np.sqrt(n / rate / 3600), 200 / (n / rate / 3600)])
    return units, [
        quantization(rng, trials, n, Q=units[0], rate=rate),
        white(rng, trials, n, N=units[1], rate=rate),
        flicker(rng, trials, n, B=units[2]),
        random_walk(rng, trials, n, K=units[3], rate=rate),
        np.tile(units[4] * hours, (trials, 1)),
    ]


def simulate_units(rng: np.random.Generator, trials: int, n: int, rate: float, share: float):  # type: ignore[no-untyped-def]
    """Return surfaces of unit records, alone and in pairs."""
    units, records = make_units(rng, trials, n, rate)
    lost = lose(rng, np.zeros((trials, n)), share, 50.0)
    singles = [surface_of(record + lost, rate) for record in records]
    parts = {}
    for a, b in PAIRS:
        if a == b:
            parts[a, b] = singles[a].avar / units[a] ** 2
        else:
            pair_avar = surface_of(records[a] + records[b] + lost, rate).avar
            cross = 0.5 * (pair_avar - singles[a].avar - singles[b].avar)
            parts[a, b] = cross / (units[a] * units[b])
    names = ["window_trend", "difference_trend"]
    trends = [surface[names] / unit for surface, unit in zip(singles, units, strict=True)]
    return singles[1], parts, trends


def mix(white_surface: xr.Dataset, parts, trends, squares: np.ndarray) -> xr.Dataset:  # type: ignore[no-untyped-def]
    roots = np.sqrt(squares)
    avar = sum((1 if a == b else 2) * roots[a] * roots[b] * parts[a, b] for a, b in PAIRS)
    trend = sum(root * part for root, part in zip(roots, trends, strict=True))
    return white_surface.assign(avar=white_surface.avar.copy(data=avar.data), **trend.data_vars)


def choose_squares(tables: window_fit.FitTables, mixture: str) -> np.ndarray:
    """Find the squared coefficients of a mixture such as ``QmKs`` on white noise."""

    def excess(log_square: float, term: int, target: float) -> float:
        squares = np.array([0.0, N**2, 0.0, 0.0])
        squares[term] = np.exp(log_square)
        amounts = squares * tables.to_samples[:4]
        covariance = np.einsum("a,b,abij->ij", amounts, amounts, tables.pairs)
        covariance += 1e-9 * np.diag(np.diag(covariance))
        columns = tables.columns[:, [1, term]]
        normal = columns.T @ np.linalg.solve(covariance, columns)
        return float(np.exp(log_square) / np.sqrt(np.linalg.inv(normal)[1, 1]) - target)

    squares = np.array([0.0, N**2, 0.0, 0.0, 0.0])
    for symbol, level in zip(mixture[::2], mixture[1::2], strict=True):
        term, target = TERMS.index(symbol), 2.5 if level == "m" else 8.0
        if term < 4:
            squares[term] = np.exp(brentq(excess, -40, 40, args=(term, target)))
        else:
            squares[4] = target**2 * (squares[:4] @ tables.trend_variance)
    return squares


def judge(product: xr.Dataset, squares: np.ndarray) -> list[str]:
    """Describe each term: how often it is observed, and how often interval and limit fail."""
    cells = []
    for term, true in zip(TERMS, np.sqrt(squares), strict=True):
        is_observed = (product.observable.sel(term=term) == 2).values
        if true == 0:
            cells.append(f"claimed {is_observed.mean():.3f}")
            continue
        value, upper = product[term].values, product[f"{term}_upper"].values
        holds = abs(value - true) <= NORMAL_95 * product[f"{term}_stderr"].values
        exceeded = [(upper < true).mean()]
        exceeded += [(upper < true)[~is_observed].mean()] if (~is_observed).sum() >= 100 else []
        cells.append(
            f"{value.mean() / true:.2f} ({(value.mean() - true) / value.std():+.2f}); seen "
            f"{is_observed.mean():.2f}; holds {holds.mean():.3f}; exceeded "
            + " (not observed ".join(f"{share:.3f}" for share in exceeded)
            + ")" * (len(exceeded) - 1)
        )
    return cells


def summarise_claims(rows: list[list[str]]) -> str:
    """Tabulate how often a term is observed that is absent: mean and largest share of the rows."""
    claims: dict[tuple[str, str], list[list[float]]] = {}
    for window, missing, _, *cells in rows:
        own = claims.setdefault((window, missing), [[] for _ in TERMS])
        for shares, cell in zip(own, cells, strict=True):
            if cell.startswith("claimed"):
                shares.append(float(cell.split()[1]))
    return table(
        ["window", "missing", "Q", "B", "K", "R"],
        [
            [*case, *(f"{np.mean(shares):.1%}; {max(shares):.1%}" for shares in own if shares)]
            for case, own in claims.items()
        ],
    )


def main() -> None:
    output = make_parser(__doc__).parse_args().output
    rows = []
    for (seconds, rate, trials), share in itertools.product(LENGTHS, (0.0, 0.3)):
        n = int(seconds * rate)
        rng = np.random.default_rng([n, int(10 * share)])
        whole, parts, trends = simulate_units(rng, trials, n, rate, share)
        ks = np.round(whole.tau.values * rate).astype(np.int64)
        tables = window_fit.fit_tables(tuple(ks.tolist()), rate, n)
        for mixture in MIXTURES:
            squares = choose_squares(tables, mixture)
            product = fit_noise(mix(whole, parts, trends, squares), observed_only=False)
            cells = judge(product, squares)
            rows.append([f"{seconds:g} s", f"{share:.0%}", mixture or "none", *cells])
            print(*rows[-1], sep=" | ", flush=True)
    renew(output, "coverage", table(["window", "missing", "terms on N", *TERMS], rows))
    renew(output, "claims", summarise_claims(rows))


if __name__ == "__main__":
    main()

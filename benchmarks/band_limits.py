"""Measure the fit of simulated logs behind six filters, for the table of docs/statistics.md.

    python benchmarks/band_limits.py --output docs/statistics.md

A record is 24 independent windows of 60 s or 600 s at 100 Hz, simulated outside the package
(tests/support/noise_records.py) and filtered by SciPy.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from page import make_parser, renew, table
from scipy.signal import butter, firwin, lfilter

from gyrostab import davar, fit_noise, make_log
from tests.support.noise_records import lose, mixture

RATE, WINDOWS, SETTLING = 100.0, 24, 500
_POLE = np.exp(-2 * np.pi * 10 / RATE)
_BOXCAR = np.ones(5) / 5
#: Filter -> its coefficients.
FILTERS = {
    "none": ([1.0], [1.0]),
    "RC, 10 Hz": ([1 - _POLE], [1.0, -_POLE]),
    "Butterworth, order 2, 10 Hz": butter(2, 10, fs=RATE),
    "boxcar of 10": (np.ones(10) / 10, [1.0]),
    "CIC, 3 of 5": (np.convolve(np.convolve(_BOXCAR, _BOXCAR), _BOXCAR), [1.0]),
    "decimation FIR, 63 taps, 20 Hz": (firwin(63, 20, fs=RATE), [1.0]),
}
#: Window [s] -> records of a row, and B [deg/h] and K [deg/h^1.5] that are just strong in it.
LENGTHS = {60: (10, 1.0, 60.0), 600: (2, 0.3, 4.0)}
N = 0.01
#: Mixtures without a filter, for false alarms: coefficients, share and length of the losses.
PLAIN = {
    "N": ({"N": N}, 0.0, 1),
    "N, 20 % lost in bursts of 50": ({"N": N}, 0.2, 50),
    "Q": ({"Q": 0.4}, 0.0, 1),
    "N, Q": ({"N": N, "Q": 0.4}, 0.0, 1),
    "N, B": ({"N": N, "B": 1.0}, 0.0, 1),
    "N, K": ({"N": N, "K": 60.0}, 0.0, 1),
    "B": ({"B": 1.0}, 0.0, 1),
    "K": ({"K": 60.0}, 0.0, 1),
    "N, line at 12.3 Hz": ({"N": N, "line": 3.0}, 0.0, 1),
}
TRIALS = 200


def simulate(rng: np.random.Generator, seconds: int, truth: dict[str, float]) -> np.ndarray:
    n = int(seconds * RATE) + SETTLING
    terms = {term: value for term, value in truth.items() if term != "line"}
    line = truth.get("line", 0.0) * np.sin(2 * np.pi * 12.3 * np.arange(n) / RATE)
    return mixture(rng, WINDOWS, n, rate=RATE, **terms) + line


def analyse(x: np.ndarray, **options: object) -> xr.Dataset:
    length = f"{x.shape[1]}samples"
    log = make_log(x.reshape(-1), rate=RATE, unit="deg/h")
    return fit_noise(davar(log, window=length, step=length, taus=30), **options)


def describe_term(product: xr.Dataset, term: str, truth: dict[str, float]) -> str:
    is_observed = product.observable.sel(term=term) == 2
    if term not in truth:
        return f"claimed {float(is_observed.mean()):.3f}"
    value = float(product[term].mean()) / truth[term]
    return f"{value:.3f} in {float(is_observed.mean()):.2f}"


def make_row(name: str, seconds: int, terms: str) -> list[str]:
    records, B, K = LENGTHS[seconds]
    truth = {term: {"N": N, "B": B, "K": K}[term] for term in terms}
    products, ignored = [], []
    for record in range(records):
        rng = np.random.default_rng([7, seconds, len(terms), record])
        x = lfilter(*FILTERS[name], simulate(rng, seconds, truth))[:, SETTLING:]
        products.append(analyse(x))
        ignored.append(fit_noise(products[-1], tau_min="all", observed_only=False))
    product, plain = (xr.concat(parts, "time", data_vars="all") for parts in (products, ignored))
    ratio = product.fit_chi2 / product.fit_dof
    plain_ratio = float((plain.fit_chi2 / plain.fit_dof).median())
    flagged = (product.observable == 2).any("term") == 0
    limits = [float(part.fit_tau_min.item()) for part in products]
    constants = [float(part.filter_time_constant.item()) for part in products]
    return [
        name,
        f"{seconds} s",
        terms,
        f"{min(limits):.2f} .. {max(limits):.2f} s" if max(constants) else "none",
        f"{np.mean(constants) * 1e3:.1f} ms",
        *(describe_term(product, term, truth) for term in "NBK"),
        f"{float(ratio.median()):.2f}",
        f"{float(flagged.mean()):.3f}",
        f"{float(plain.N.mean()) / N:.2f}; {plain_ratio:.3g}",
    ]


def count_false_alarms(name: str) -> list[str]:
    truth, share, block = PLAIN[name]
    constants, shifted = [], []
    for trial in range(TRIALS):
        rng = np.random.default_rng([8, list(PLAIN).index(name), trial])
        x = lose(rng, simulate(rng, 40, truth)[:, SETTLING:], share, block)
        product = analyse(x)
        constants.append(float(product.filter_time_constant.item()) > 0)
        shifted.append(float(product.fit_tau_min.item()) > float(product.tau[0]))
    return [name, f"{np.mean(constants):.3f}", f"{np.mean(shifted):.3f}"]


def main() -> None:
    output = make_parser(__doc__).parse_args().output
    head = ["filter", "window", "terms", "fitted from", "time constant", "N", "B", "K", "chi2/dof",
            "flagged", "filter ignored: N; chi2/dof"]  # fmt: skip
    rows = [
        make_row(name, seconds, terms)
        for name in FILTERS
        for seconds in LENGTHS
        for terms in ("N", "NB", "NK")
    ]
    bands = table(head, rows)
    print(bands, flush=True)
    head = ["noise without a filter", "filter found", "shorter averaging times left out"]
    alarms = table(head, map(count_false_alarms, PLAIN))
    print(alarms)
    renew(output, "bands", bands)
    renew(output, "alarms", alarms)


if __name__ == "__main__":
    main()

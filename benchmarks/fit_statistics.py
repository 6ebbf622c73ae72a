"""Check every statistical claim of the fit by simulation, for the tables of docs/statistics.md.

    python benchmarks/fit_statistics.py --output docs/statistics.md

Each row is 1000 (trend through gaps: 300) independent windows of 40 s at 100 Hz, simulated outside
the package (tests/support/noise_records.py).
"""

from __future__ import annotations

import itertools

import numpy as np
import xarray as xr
from page import make_parser, renew, table

from gyrostab import confidence_interval, davar, fit_noise, make_log
from gyrostab.allan.window_fit import is_described
from gyrostab.noise import NORMAL_95, TERMS, model_avar
from tests.support.noise_records import lose, mixture

RATE, SAMPLES, TRIALS = 100.0, 4000, 1000
MIXTURES: dict[str, dict[str, float]] = {
    "N": {"N": 0.01},
    "B": {"B": 1.0},
    "K": {"K": 20.0},
    "Q + N": {"Q": 0.4, "N": 0.01},
    "N + B": {"N": 0.01, "B": 0.6},
    "N + K": {"N": 0.01, "K": 40.0},
    "Q + N + K": {"Q": 0.4, "N": 0.01, "K": 200.0},
}
GAPS = {"none": (0.0, 1.0), "20 %, bursts of 50": (0.2, 50.0), "20 %, bursts of 5": (0.2, 5.0)}
#: Noise whose trend gaps change most, and samples that are lost: a place, or (share, block).
TREND_TRIALS = 300
TREND_NOISES: dict[str, dict[str, float]] = {
    "N": {"N": 0.01},
    "N + B": {"N": 0.01, "B": 3.0},
    "N + K": {"N": 0.01, "K": 200.0},
    "Q + N": {"Q": 2.0, "N": 0.01},
    "5 Q + N": {"Q": 10.0, "N": 0.01},
}
LOSSES: dict[str, slice | tuple[float, float]] = {
    "last 50 %": slice(SAMPLES // 2, None),
    "last 70 %": slice(3 * SAMPLES // 10, None),
    "middle 50 %": slice(SAMPLES // 4, 3 * SAMPLES // 4),
    "10 %, one by one": (0.1, 1.0),
    "20 %, bursts of 5": (0.2, 5.0),
    "50 %, bursts of 50": (0.5, 50.0),
    "20 %, one by one": (0.2, 1.0),
}


def fit_windows(x: np.ndarray, **options: str) -> xr.Dataset:
    length = f"{SAMPLES}samples"
    surface = davar(
        make_log(x.reshape(-1), rate=RATE, unit="deg/h"), window=length, step=length, taus=24
    )
    return fit_noise(surface, observed_only=False, **options)


def judge_trend(name: str, loss: str) -> list[str]:
    """Describe how often a ramp that is absent is observed, and whether intervals hold."""
    rng = np.random.default_rng([2026, list(TREND_NOISES).index(name), list(LOSSES).index(loss)])
    truth, lost = TREND_NOISES[name], LOSSES[loss]
    x = mixture(rng, TREND_TRIALS, SAMPLES, rate=RATE, **truth)
    if isinstance(lost, slice):
        x[:, lost] = np.nan
    else:
        x = lose(rng, x, *lost)
    product = fit_windows(x, tau_min="all")
    fails = 1.0 - is_described(product.fit_chi2, product.fit_dof).mean()
    claimed = float((product.observable.sel(term="R") == 2).mean())
    cells = [f"{claimed:.3f}"]
    for term in ("R", *truth):
        value, true = product[term], truth.get(term, 0.0)
        held = float((abs(value - true) <= NORMAL_95 * product[f"{term}_stderr"]).mean())
        mean = f"{term} {float(value.mean()) / true:.2f}; " if true else ""
        cells.append(f"{mean}{held:.3f}")
    return [name, loss, *cells[:2], ", ".join(cells[2:]), f"{fails:.3f}"]


def seen_law(product: xr.Dataset, truth: dict[str, float]) -> xr.DataArray:
    """Return the expected Allan variance of each cell, with the effect of the gaps."""
    response = {"Q": product.quantization_response, "N": product.white_response}
    parts = [
        response.get(term, 1.0) * (0 * product.avar + model_avar(product.tau, {term: value}))
        for term, value in truth.items()
    ]
    return sum(parts[1:], parts[0])


def judge_noise(name: str, gap: str) -> list[str]:
    """Describe intervals of the cells, and for each term its z-scores and how often it is seen."""
    truth, (share, block) = MIXTURES[name], GAPS[gap]
    rng = np.random.default_rng([2026, list(MIXTURES).index(name), int(block)])
    x = mixture(rng, TRIALS, SAMPLES, rate=RATE, **truth)
    product = fit_windows(lose(rng, x, share, block))
    limits, law = confidence_interval(product), seen_law(product, truth)
    hit = (
        ((limits.avar_lower <= law) & (law <= limits.avar_upper))
        .where(product.avar.notnull())
        .mean(("axis", "time"))
    )
    cells = [name, gap, f"{float(hit.min()):.3f} .. {float(hit.max()):.3f}"]
    for term in TERMS:
        flags = product.observable.sel(term=term)
        claimed = float((flags == 2).mean())
        if term not in truth:
            cells.append(f"claimed {claimed:.3f}")
            continue
        z = (product[term] - truth[term]) / product[f"{term}_stderr"]
        text = (
            f"{float(product[term].mean()) / truth[term]:.3f}; z {float(z.mean()):+.2f} ± "
            f"{float(z.std()):.2f}; seen {claimed:.2f}"
        )
        if (flags == 1).sum() >= 100:
            text += (
                "; limit holds "
                f"{float((product[f'{term}_upper'] >= truth[term]).where(flags == 1).mean()):.3f}"
            )
        cells.append(text)
    return cells


def main() -> None:
    output = make_parser(__doc__).parse_args().output
    cases = itertools.product(MIXTURES, GAPS)
    head = ["noise", "missing", "95 % intervals of the cells", *TERMS]
    noises = table(head, itertools.starmap(judge_noise, cases))
    print(noises, flush=True)
    losses = itertools.product(TREND_NOISES, LOSSES)
    head = ["noise", "missing", "R claimed", "R holds", "mean; holds", "misfit"]
    trends = table(head, itertools.starmap(judge_trend, losses))
    print(trends)
    renew(output, "table", noises)
    renew(output, "trends", trends)


if __name__ == "__main__":
    main()

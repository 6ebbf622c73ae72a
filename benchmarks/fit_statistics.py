"""Check every statistical claim of the fit by simulation, for the tables of docs/statistics.md.

    python benchmarks/fit_statistics.py --output docs/statistics.md      # about a minute

Each row is 1000 (trend through gaps: 300) independent windows of 40 s at 100 Hz, simulated outside
the package (tests/support/noise_records.py).
"""

from __future__ import annotations

import argparse
import itertools
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import xarray as xr
from page import renew

from gyrostab import confidence_interval, davar, fit_noise, make_log
from gyrostab.allan.window_fit import is_described
from gyrostab.noise import NORMAL_95, TERMS, model_avar
from tests.support.noise_records import flicker, lose, quantization, random_walk, white

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
GAPS = {"none": (0.0, 1.0), "20 %, blocks of 50": (0.2, 50.0), "20 %, blocks of 5": (0.2, 5.0)}
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
    "20 %, blocks of 5": (0.2, 5.0),
    "50 %, blocks of 50": (0.5, 50.0),
}


def simulate(rng: np.random.Generator, truth: dict[str, float], trials: int) -> np.ndarray:
    x = np.zeros((trials, SAMPLES))
    for term, value in truth.items():
        if term == "Q":
            x += quantization(rng, trials, SAMPLES, Q=value, rate=RATE)
        elif term == "N":
            x += white(rng, trials, SAMPLES, N=value, rate=RATE)
        elif term == "B":
            x += flicker(rng, trials, SAMPLES, B=value)
        else:
            x += random_walk(rng, trials, SAMPLES, K=value, rate=RATE)
    return x


def fit_windows(x: np.ndarray, **options: str) -> xr.Dataset:
    length = f"{SAMPLES}samples"
    surface = davar(
        make_log(x.reshape(-1), rate=RATE, unit="deg/h"), window=length, step=length, taus=24
    )
    return fit_noise(surface, observed_only=False, **options)


def judge_trend(name: str, loss: str) -> str:
    """Describe how often a ramp that is absent is observed, and whether intervals hold."""
    rng = np.random.default_rng([2026, list(TREND_NOISES).index(name), list(LOSSES).index(loss)])
    truth, lost = TREND_NOISES[name], LOSSES[loss]
    x = simulate(rng, truth, TREND_TRIALS)
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
    return " | ".join([cells[0], cells[1], ", ".join(cells[2:]), f"{fails:.3f}"])


def seen_law(product: xr.Dataset, truth: dict[str, float]) -> xr.DataArray:
    """Return the expected Allan variance of each cell, with the effect of the gaps."""
    response = {"Q": product.quantization_response, "N": product.white_response}
    parts = [
        response.get(term, 1.0) * (0 * product.avar + model_avar(product.tau, {term: value}))
        for term, value in truth.items()
    ]
    return sum(parts[1:], parts[0])


def row(rng: np.random.Generator, truth: dict[str, float], share: float, block: float) -> str:
    product = fit_windows(lose(rng, simulate(rng, truth, TRIALS), share, block))
    limits, law = confidence_interval(product), seen_law(product, truth)
    hit = (
        ((limits.avar_lower <= law) & (law <= limits.avar_upper))
        .where(product.avar.notnull())
        .mean(("axis", "time"))
    )
    cells = [f"{float(hit.min()):.3f} .. {float(hit.max()):.3f}"]
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
    return " | ".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--output", type=Path, help="document whose part between the marks is renewed"
    )
    options = parser.parse_args()
    lines = [
        "| noise | missing | 95 % intervals of the cells | Q | N | B | K | R |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for number, (name, truth) in enumerate(MIXTURES.items()):
        for gap, (share, block) in GAPS.items():
            rng = np.random.default_rng([2026, number, int(block)])
            lines.append(f"| {name} | {gap} | {row(rng, truth, share, block)} |")
            print(lines[-1], flush=True)
    trends = [
        "| noise | missing | R claimed | R holds | mean; holds | misfit |",
        "|---|---|---|---|---|---|",
    ]
    for name, loss in itertools.product(TREND_NOISES, LOSSES):
        trends.append(f"| {name} | {loss} | {judge_trend(name, loss)} |")
        print(trends[-1], flush=True)
    if options.output:
        renew(options.output, "table", "\n".join(lines))
        renew(options.output, "trends", "\n".join(trends))


if __name__ == "__main__":
    main()

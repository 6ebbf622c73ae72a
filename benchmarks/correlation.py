"""Measure what docs/temperature.md claims, and write its tables between their markers.

    python benchmarks/correlation.py --output docs/temperature.md

False claims and coverage of the intervals against Pearson, ordinary least squares and Newey-West
(statsmodels), power against an oracle that knows the noise, and how often a temperature and its
rate of change are taken for each other; all on simulated records
(tests/support/coupled.py) whose seeds count from `SEED`, so that the same command makes the same
tables.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from multiprocessing import Pool
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one process a core instead

import numpy as np
import statsmodels.api as sm
from page import make_parser, renew, table
from scipy.stats import pearsonr

import gyrostab
from gyrostab.correlate.judge import VERDICTS
from tests.support import coupled

SEED = 100_000
NAMES = {
    "white": "white",
    "flicker": "white + flicker",
    "weak walk": "white + weak random walk",
    "walk": "white + random walk",
    "strong walk": "white + strong random walk",
    "slow": "white + slow autoregression",
}
HEATS = {"sine": "sine", "ramps": "ramps and plateaus", "walk": "random walk"}
CYCLE = {"chamber": "chamber cycles"}
TOLD_APART = (("white", "chamber"), ("walk", "chamber"), ("white", "walk"), ("white", "sine"))
STRENGTHS = (2, 4, 8)
#: Standard deviation of an effect, in those of white noise in half a window.
EFFECT_SIGMA = 3.0


def judge(noises: str, heat: str, seed: int) -> tuple[bool, ...]:
    """Return who claims a coupling that is not there, and whose interval does not hold 0.

    Pearson, least squares, Newey-West and gyrostab's interval of the window mean at lag 0; then
    whether gyrostab's search over lags and drivers ends with ``coupled``.
    """
    product = coupled.product(seed=seed, noises=noises, heat=heat, axes="x", terms=False)
    good = np.isfinite(product["window_mean"].values[0])
    mean, warm = product["window_mean"].values[0][good], product["temperature"].values[good]
    after = np.cumsum(~good)[good] > 0
    design = np.column_stack([warm, ~after, after, np.flatnonzero(good) / good.size]).astype(float)
    model = sm.OLS(mean, design)
    newey_west = model.fit(
        cov_type="HAC", cov_kwds={"maxlags": round(1.3 * good.sum() ** 0.5), "use_correction": True}
    )
    at_zero = gyrostab.correlate(product, variables="window_mean", max_lag=0)
    whole = gyrostab.correlate(product, variables="window_mean")
    return (
        pearsonr(mean, warm).pvalue < 0.05,
        model.fit().pvalues[0] < 0.05,
        newey_west.pvalues[0] < 0.05,
        at_zero["p_value"].sel(axis="x", driver="temperature").item() < 0.05,
        bool((whole["coupling_verdict"] == VERDICTS.index("coupled")).any()),
    )


def seen(
    noises: str, heat: str, inverse: np.ndarray, strength: int, seed: int
) -> tuple[bool, bool, float]:
    """Return whether the oracle and gyrostab see a slope of this many standard errors.

    The errors are those of the oracle. The last item is the swing of the slope against the noise.
    """
    product = coupled.product(seed=seed, noises=noises, heat=heat, terms=False, axes="x")
    warm, mean = product["temperature"].values, product["window_mean"].values[0]
    good = np.isfinite(mean)
    stretch = np.cumsum(np.diff(good, prepend=True) & good)[good]
    nuisance = np.column_stack(
        [stretch == 0, stretch > 0, np.arange(mean.size)[good] / mean.size]
    ).astype(float)
    q, _ = np.linalg.qr(inverse @ nuisance)
    x = inverse @ warm[good]
    x -= q @ (q.T @ x)
    error = 1.0 / np.sqrt(x @ x)
    coupled_mean = mean + strength * error * warm
    product["window_mean"] = product["window_mean"].copy(data=coupled_mean[None])
    correlation = gyrostab.correlate(product, variables="window_mean", max_lag=0)
    oracle = abs(x @ (inverse @ coupled_mean[good])) * error > 1.959964
    swing = strength * error * np.ptp(warm[good]) / np.std(mean[good])
    return (
        bool(oracle),
        float(correlation["p_value"].sel(axis="x", driver="temperature").item()) < 0.05,
        float(swing),
    )


def claim(noises: str, heat: str, effect: str, seed: int) -> tuple[bool, bool]:
    """Return whether gyrostab claims that the mean follows temperature, and its rate of change.

    The mean follows one of them, which is the `effect`.
    """
    warm = coupled.temperature(heat, 161, np.random.default_rng(seed))
    rate = np.gradient(warm, coupled.CELL / 3600)
    follows = {"slope": EFFECT_SIGMA / warm.std()}
    if effect == "rate":
        follows = {"pace": EFFECT_SIGMA / rate.std()}
    product = coupled.product(seed=seed, noises=noises, heat=heat, axes="x", terms=False, **follows)
    correlation = gyrostab.correlate(product, variables="window_mean")
    first, second = correlation["coupling_verdict"].values.ravel() == VERDICTS.index("coupled")
    return bool(first), bool(second)


def whitener(noises: str) -> np.ndarray:
    """What makes the noise of the windows white, from 20 000 records of noise alone."""
    good = np.isfinite(coupled.product(terms=False)["window_mean"].values[0])
    rng = np.random.default_rng(SEED)
    cells = np.stack([coupled.noise(noises, good.size + 1, rng) for _ in range(20_000)])
    return np.linalg.inv(
        np.linalg.cholesky(np.cov((0.5 * (cells[:, 1:] + cells[:, :-1]))[:, good].T))
    )


def share(spread: Callable[..., Any], job: Callable[..., Any], records: int) -> Any:
    return np.mean(spread(job, range(SEED, SEED + records), chunksize=5), axis=0)


def compare(spread: Callable[..., Any], records: int) -> str:
    rows = []
    for noises, name in NAMES.items():
        for heat, course in HEATS.items():
            wrong = share(spread, partial(judge, noises, heat), records)
            rows.append([name, course, *(f"{value:.1%}" for value in wrong)])
    methods = ("Pearson", "least squares", "Newey-West", "gyrostab", "whole search")
    return table(["noise", "temperature", *methods], rows)


def power(spread: Callable[..., Any], records: int) -> str:
    rows = []
    for noises in ("white", "walk", "flicker"):
        inverse = whitener(noises)
        for heat in ("sine", "ramps"):
            row = [NAMES[noises], HEATS[heat]]
            for strength in STRENGTHS:
                job = partial(seen, noises, heat, inverse, strength)
                oracle, ours, swing = share(spread, job, records // 4)
                row.append(f"{swing:.1f}, {oracle:.0%}, {ours:.0%}")
            rows.append(row)
    heads = [f"{strength} errors: swing, oracle, gyrostab" for strength in STRENGTHS]
    return table(["noise", "temperature", *heads], rows)


def tell_apart(spread: Callable[..., Any], records: int) -> str:
    rows = []
    for noises, heat in TOLD_APART:
        claims = [
            share(spread, partial(claim, noises, heat, effect), 5 * records // 8)
            for effect in ("temperature", "rate")
        ]
        course = (HEATS | CYCLE)[heat]
        rows.append([NAMES[noises], course, *(f"{a:.0%}, {b:.0%}" for a, b in claims)])
    heads = [f"follows {effect}: temperature, rate" for effect in ("temperature", "its rate")]
    return table(["noise", "temperature", *heads], rows)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--records", type=int, default=160)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    chosen = parser.parse_args()
    with Pool(chosen.processes) as pool:
        for name, make_table in {"compared": compare, "power": power, "apart": tell_apart}.items():
            text = make_table(pool.map, chosen.records)
            print(f"{name}\n{text}\n", flush=True)
            renew(chosen.output, name, text)


if __name__ == "__main__":
    main()

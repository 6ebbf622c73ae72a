"""Measure what docs/temperature.md claims, and write its tables between their markers.

    python benchmarks/correlation.py --records 400 --output docs/temperature.md

False claims, coverage of the intervals, and power against an oracle that knows the noise; all on
simulated records (tests/support/coupled.py) whose seeds count from `SEED`, so that the same command
makes the same tables.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from functools import partial
from multiprocessing import Pool
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one process a core instead
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from page import renew

import gyrostab
from gyrostab.correlate.judge import VERDICTS
from tests.support import coupled

SEED = 100_000
NAMES = {
    "white": "white",
    "flicker": "white + flicker",
    "walk": "white + random walk",
    "slow": "white + slow autoregression",
}
HEATS = {"sine": "sine", "ramps": "ramps and plateaus", "walk": "random walk"}
CLAIMS = (
    ("flicker", "sine", "x"),
    ("walk", "sine", "x"),
    ("flicker", "ramps", "x"),
    ("slow", "walk", "x"),
    ("flicker", "sine", "xyz"),
)
STRENGTHS = (2, 4, 8)


def claimed(noises: str, heat: str, axes: str, seed: int) -> bool:
    found = gyrostab.correlate(coupled.product(seed=seed, noises=noises, heat=heat, axes=axes))
    return bool((found["coupling_verdict"] == VERDICTS.index("coupled")).any())


def held(noises: str, heat: str, gap: bool, seed: int) -> float:
    """Share of the three axes whose interval holds the truth."""
    product = coupled.product(seed=seed, noises=noises, heat=heat, gap=gap, slope=0.5, terms=False)
    found = gyrostab.correlate(product, variables="window_mean", max_lag=0)
    low, high = (found[f"window_mean_per_temperature_{end}"].values for end in ("low", "high"))
    return float(np.mean((low <= [0.5, 0.0, 0.0]) & (high >= [0.5, 0.0, 0.0])))


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
    beside = np.column_stack(
        [stretch == 0, stretch > 0, np.arange(mean.size)[good] / mean.size]
    ).astype(float)
    q, _ = np.linalg.qr(inverse @ beside)
    x = inverse @ warm[good]
    x -= q @ (q.T @ x)
    error = 1.0 / np.sqrt(x @ x)
    coupled_mean = mean + strength * error * warm
    product["window_mean"] = product["window_mean"].copy(data=coupled_mean[None])
    found = gyrostab.correlate(product, variables="window_mean", max_lag=0)
    oracle = abs(x @ (inverse @ coupled_mean[good])) * error > 1.959964
    swing = strength * error * np.ptp(warm[good]) / np.std(mean[good])
    return (
        bool(oracle),
        float(found["p_value"].sel(axis="x", driver="temperature").item()) < 0.05,
        float(swing),
    )


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


def count_claims(spread: Callable[..., Any], records: int) -> list[str]:
    rows = [
        "| noise | temperature | axes | records | records with a false alarm |",
        "|---|---|---|---|---|",
    ]
    for noises, heat, axes in CLAIMS:
        found = share(spread, partial(claimed, noises, heat, axes), records)
        rows.append(f"| {NAMES[noises]} | {HEATS[heat]} | {len(axes)} | {records} | {found:.1%} |")
    return rows


def intervals(spread: Callable[..., Any], records: int) -> list[str]:
    rows = [
        "| noise | " + " | ".join(HEATS.values()) + " | sine, no gap |",
        "|---|---|---|---|---|",
    ]
    for noises, name in NAMES.items():
        jobs = [partial(held, noises, heat, True) for heat in HEATS] + [
            partial(held, noises, "sine", False)
        ]
        rows.append(
            f"| {name} | "
            + " | ".join(f"{share(spread, job, records // 4):.1%}" for job in jobs)
            + " |"
        )
    return rows


def power(spread: Callable[..., Any], records: int) -> list[str]:
    rows = [
        "| noise | temperature | "
        + " | ".join(f"{strength} errors: swing, oracle, gyrostab" for strength in STRENGTHS)
        + " |"
    ]
    rows.append("|---|---|" + "---|" * len(STRENGTHS))
    for noises in ("white", "walk", "flicker"):
        inverse = whitener(noises)
        for heat in ("sine", "ramps"):
            parts = [
                share(spread, partial(seen, noises, heat, inverse, strength), records // 4)
                for strength in STRENGTHS
            ]
            cells = " | ".join(
                f"{swing:.1f}, {oracle:.0%}, {ours:.0%}" for oracle, ours, swing in parts
            )
            rows.append(f"| {NAMES[noises]} | {HEATS[heat]} | {cells} |")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the tables of docs/temperature.md.")
    parser.add_argument("--records", type=int, default=400)
    parser.add_argument(
        "--output", type=Path, help="page to put the tables into; printed only when not given"
    )
    chosen = parser.parse_args()
    with Pool() as pool:
        for name, table in {"claims": count_claims, "intervals": intervals, "power": power}.items():
            text = "\n".join(table(pool.map, chosen.records))
            print(f"{name}\n{text}\n", flush=True)
            if chosen.output:
                renew(chosen.output, name, text)


if __name__ == "__main__":
    main()

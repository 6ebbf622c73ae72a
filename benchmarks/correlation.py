"""Measure how often a coupling is claimed where there is none, and how often the intervals hold: the table of docs/temperature.md."""

from __future__ import annotations

import sys

import numpy as np

import gyrostab
from gyrostab.correlate.judge import VERDICTS
from tests import coupled


def measure(noises: str, heat: str, records: int) -> tuple[float, float]:
    """Share of records with a claim, and share of intervals that hold the truth."""
    claims, hold = 0, []
    for seed in range(records):
        nothing = gyrostab.correlate(coupled.product(windows=120, seed=10_000 + seed, noises=noises, heat=heat))
        claims += bool((nothing["coupling_verdict"] == VERDICTS.index("coupled")).any())
        one = coupled.product(windows=120, seed=30_000 + seed, noises=noises, heat=heat, slope=0.5, terms=False)
        found = gyrostab.correlate(one, max_lag=0)
        low, high = (found[f"window_mean_per_temperature_{end}"].values for end in ("low", "high"))
        hold += list((low <= [0.5, 0.0, 0.0]) & (high >= [0.5, 0.0, 0.0]))
    return claims / records, float(np.mean(hold))


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    for pair in (("flicker", "sine"), ("walk", "sine"), ("flicker", "ramps"), ("slow", "walk")):
        print("| {} | {} | {} | {:.3f} | {:.3f} |".format(*pair, count, *measure(*pair, count)), flush=True)

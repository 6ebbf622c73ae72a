"""Measure what losses do to N, for each way to treat them; write the table of a page.

    python benchmarks/gap_treatment.py --records 40 --output docs/how-to/rate-data-with-gaps.md

Every record has 60 s of white noise (N = 0.01 deg/sqrt(h)) at 100 Hz on a mean rate of 10 deg/h.
The same surface and fit are used for all treatments.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from page import renew

import gyrostab
from tests.support.noise_records import lose, white

SAMPLES, RATE, TRUTH = 6000, 100.0, 0.01
LOSSES = {
    "12 % in bursts": (0.12, 50),
    "30 % in bursts": (0.30, 50),
    "49 % in bursts": (0.49, 50),
    "20 % one by one": (0.20, 1),
    "21 %, in the noisy third": None,
}


def make_records(loss: tuple[float, float] | None, count: int) -> tuple[np.ndarray, float]:
    """Make records with losses, and the N of what they were before.

    Without a loss, a third of the time, in spells of 1 s, has three times the noise, and 64 % of
    it is lost in bursts of 0.1 s.
    """
    rng = np.random.default_rng(7)
    x = white(rng, count, SAMPLES, N=TRUTH, rate=RATE)
    if loss is not None:
        return 10.0 + lose(rng, x, *loss), TRUTH
    spells = np.repeat(rng.random((count, SAMPLES // 100)) < 1 / 3, 100, axis=1)
    x *= 1 + 2 * spells
    bursts = np.repeat(rng.random((count, SAMPLES // 10)) < 0.64, 10, axis=1)
    x[spells & bursts] = np.nan
    return 10.0 + x, TRUTH * np.sqrt(1 + 8 * spells.mean())


def interpolate(row: np.ndarray) -> np.ndarray:
    known = np.flatnonzero(np.isfinite(row))
    return np.interp(np.arange(row.size), known, row[known])


def hold(row: np.ndarray) -> np.ndarray:
    last = np.maximum.accumulate(np.where(np.isfinite(row), np.arange(row.size), 0))
    return np.nan_to_num(row[last], nan=10.0)


TREATMENTS = {
    "gyrostab: counted": (lambda row: row, "bridge"),
    "differences at gaps set to zero (P16)": (lambda row: row, "zero"),
    "interpolated": (interpolate, "bridge"),
    "last value held": (hold, "bridge"),
    "filled with zeros": (np.nan_to_num, "bridge"),
    "joined end to end": (lambda row: row[np.isfinite(row)], "bridge"),
}


def measure(rows: np.ndarray, treat, gaps: str) -> tuple[float, float, float]:  # type: ignore[no-untyped-def]
    """Return the mean N, the median misfit, and the median scatter next to gaps over the rest."""
    found = []
    for row in rows:
        log = gyrostab.make_log(treat(row), rate=RATE, unit="deg/h")
        size = f"{log.sizes['time']}samples"
        surface = gyrostab.davar(log, window=size, step=size, taus=24, gaps=gaps)
        product = gyrostab.fit_noise(surface, observed_only=False).isel(axis=0, time=0)
        misfit = product["fit_chi2"] / product["fit_dof"]
        found.append([float(v) for v in (product["N"], misfit, product["gap_edge_ratio"])])
    n, misfit, ratio = np.transpose(found)
    return (
        float(n.mean()),
        float(np.median(misfit)),
        float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else np.nan,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure what losses do to N.")
    parser.add_argument("--records", type=int, default=40)
    parser.add_argument("--output", type=Path, help="page to put the table into")
    chosen = parser.parse_args()
    made = {name: make_records(loss, chosen.records) for name, loss in LOSSES.items()}
    lines = [f"| treatment | {' | '.join(LOSSES)} |", "|---|" + "---|" * len(LOSSES)]
    edges = "| scatter next to gaps over the rest |"
    for name, (treat, gaps) in TREATMENTS.items():
        line = f"| {name} |"
        for rows, truth in made.values():
            n, misfit, ratio = measure(rows, treat, gaps)
            line += f" {n / truth:.2f} ({misfit:.3g}) |"
            edges += f" {ratio:.2f} |" if name.startswith("gyrostab") else ""
        lines.append(line)
        print(line, flush=True)
    text = "\n".join([*lines, edges])
    print(text)
    if chosen.output:
        renew(chosen.output, "gaps", text)


if __name__ == "__main__":
    main()

"""Measure what losses do to N, B and K, for each way to treat them; write the table of a page.

    python benchmarks/gap_treatment.py --output docs/how-to/rate-data-with-gaps.md

Every record has 60 s at 100 Hz on a mean rate of 10 deg/h: white noise (N = 0.01 deg/sqrt(h)),
alone or with bias instability (B = 1.5 deg/h) or rate random walk (K = 150 deg/h^1.5). The same
averaging times and the same fit are used for all treatments.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import xarray as xr
from page import make_parser, renew, table

import gyrostab
from gyrostab.noise import NORMAL_95
from tests.support.noise_records import flicker, lose, random_walk, white
from tests.support.published import published_davar

SAMPLES, RATE, MEAN = 6000, 100.0, 10.0
TRUTH = {"N": 0.01, "B": 1.5, "K": 150.0}
LOSSES = {
    "none": (0.0, 1),
    "12 % in bursts": (0.12, 50),
    "30 % in bursts": (0.30, 50),
    "49 % in bursts": (0.49, 50),
    "20 % one by one": (0.20, 1),
    "21 %, in the noisy third": None,
}


def make_records(
    term: str, loss: tuple[float, float] | None, count: int
) -> tuple[np.ndarray, float]:
    """Make records with losses, and the true coefficient of `term` before the losses.

    Without a loss, a third of the time, in spells of 1 s, has three times the white noise, and 64 %
    of it is lost in bursts of 0.1 s.
    """
    rng = np.random.default_rng(7)
    x = white(rng, count, SAMPLES, N=TRUTH["N"], rate=RATE)
    truth = TRUTH[term]
    missing = lose(rng, np.zeros_like(x), *loss) if loss else np.zeros_like(x)
    if loss is None:
        spells = np.repeat(rng.random((count, SAMPLES // 100)) < 1 / 3, 100, axis=1)
        bursts = np.repeat(rng.random((count, SAMPLES // 10)) < 0.64, 10, axis=1)
        x *= 1 + 2 * spells
        missing[spells & bursts] = np.nan
        truth *= np.sqrt(1 + 8 * spells.mean()) if term == "N" else 1.0
    if term == "B":
        x += flicker(rng, count, SAMPLES, B=truth)
    elif term == "K":
        x += random_walk(rng, count, SAMPLES, K=truth, rate=RATE)
    return MEAN + x + missing, truth


def interpolate(row: np.ndarray) -> np.ndarray:
    known = np.flatnonzero(np.isfinite(row))
    return np.interp(np.arange(row.size), known, row[known])


def hold(row: np.ndarray) -> np.ndarray:
    last = np.maximum.accumulate(np.where(np.isfinite(row), np.arange(row.size), 0))
    return np.nan_to_num(row[last], nan=MEAN)


def make_surface(row: np.ndarray, run: Callable[..., xr.Dataset] = gyrostab.davar) -> xr.Dataset:
    """Compute the Allan variance of one record."""
    log = gyrostab.make_log(row, rate=RATE, unit="deg/h")
    size = f"{row.size}samples"
    return run(log, window=size, step=size, taus=24)


def weigh_means(row: np.ndarray) -> xr.Dataset:
    """Compute the Allan variance of the means of what is present, as FAVAR does.

    The weight of a pair of neighbouring means is the product of their numbers of samples. Intervals
    are those of a record without gaps, because FAVAR gives no intervals.
    """
    surface = make_surface(interpolate(row))
    present = np.isfinite(row)
    sums = np.cumsum(np.concatenate([[0.0], np.where(present, row - MEAN, 0.0)]))
    counts = np.cumsum(np.concatenate([[0], present]))
    avar = []
    for k in np.rint(surface.tau.values * RATE).astype(int):
        sizes = counts[k:] - counts[:-k]
        means = (sums[k:] - sums[:-k]) / np.maximum(sizes, 1)
        weights = sizes[k:] * sizes[:-k]
        avar.append(weights @ (means[k:] - means[:-k]) ** 2 / (2 * weights.sum()))
    return surface.assign(avar=surface.avar.copy(data=np.reshape(avar, surface.avar.shape)))


Treatment = Callable[[np.ndarray], xr.Dataset]
TREATMENTS: dict[str, Treatment] = {
    "gyrostab: counted": make_surface,
    "differences at gaps set to zero (P16)": partial(
        make_surface, run=partial(published_davar, method="direct", zero_fill=True)
    ),
    "weighted means of what is present (FAVAR)": weigh_means,
    "interpolated": lambda row: make_surface(interpolate(row)),
    "last value held": lambda row: make_surface(hold(row)),
    "filled with zeros": lambda row: make_surface(np.nan_to_num(row)),
    "joined end to end": lambda row: make_surface(row[np.isfinite(row)]),
}


def measure(rows: np.ndarray, term: str, truth: float, treat: Treatment) -> tuple[str, float]:
    """Return the cell of a table, and the median scatter next to gaps relative to elsewhere."""
    results = []
    for row in rows:
        product = gyrostab.fit_noise(treat(row), observed_only=False).isel(axis=0, time=0)
        value, error = float(product[term]), float(product[f"{term}_stderr"])
        misfit = float(product["fit_chi2"] / product["fit_dof"])
        held = abs(value - truth) <= NORMAL_95 * error
        results.append([value / truth, held, misfit, float(product["gap_edge_ratio"])])
    value, held, misfit, ratio = np.transpose(results)
    edges = float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else np.nan
    return f"{np.mean(value):.2f}; {np.mean(held):.0%}; {np.median(misfit):.2g}", edges


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--records", type=int, default=100)
    chosen = parser.parse_args()
    rows = []
    edges = ["", "scatter next to gaps / elsewhere"]
    for term in TRUTH:
        made = [make_records(term, loss, chosen.records) for loss in LOSSES.values()]
        for name, treat in TREATMENTS.items():
            measured = [measure(rows, term, truth, treat) for rows, truth in made]
            if (term, treat) == ("N", make_surface):
                edges += ["" if np.isnan(ratio) else f"{ratio:.2f}" for _, ratio in measured]
            rows.append([term, name, *(cell for cell, _ in measured)])
            print(*rows[-1], sep=" | ", flush=True)
    text = table(["", "treatment", *LOSSES], [*rows, edges])
    print(text)
    renew(chosen.output, "gaps", text)


if __name__ == "__main__":
    main()

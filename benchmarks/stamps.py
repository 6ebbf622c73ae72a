"""Rows kept, rate and losses found where stamps are times of arrival: the table in docs/method.md.

Run with ``python -m benchmarks.stamps [ROWS]``; 20 000 rows a case by default. A cell is the worst
of all scatters and units of time: samples too many or few, and the largest displacement of a row.
"""

from __future__ import annotations

import itertools
import sys

import numpy as np

from gyrostab.ingest.grid.regularise import regularise
from tests.support.raw_rows import raw_log
from tests.support.stamp_scatter import (
    JITTER,
    LOSSES,
    UNITS,
    lose_samples,
    round_stamps,
    scatter_stamps,
)

SCATTERS = (0.1, 0.3, 0.6)
RATE = 99.7


def measure(
    jitter: str, losses: str, scatter: float, unit: str, rows: int, seed: int
) -> tuple[float, float, int, int]:
    """Return share of rows kept, errors of rate [1e-6] and sample count, largest row error."""
    random = np.random.default_rng(seed)
    samples = lose_samples(losses, rows, random)
    log = regularise(
        raw_log(round_stamps(scatter_stamps(samples, jitter, scatter, random), RATE, unit))
    )
    values = log["rate"].values[0]
    given = np.flatnonzero(np.isfinite(values))
    off = given - samples[values[given].astype(int) - 1]
    off -= int(np.median(off))
    error = 1e6 * (log.attrs["sampling_rate_hz"] / RATE - 1)
    return (
        len(given) / len(samples),
        abs(error),
        abs(log.sizes["time"] - 1 - int(samples[-1])),
        int(np.abs(off).max()),
    )


def main() -> None:
    """Print the table."""
    rows = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    print(f"| jitter | {' | '.join(LOSSES)} |")
    print(f"|---{'|---' * len(LOSSES)}|")
    kept_shares, rate_errors = [], []
    for jitter in JITTER:
        cells = []
        for losses in LOSSES:
            cases = itertools.product(SCATTERS, UNITS)
            results = [
                measure(jitter, losses, scatter, unit, rows, seed)
                for seed, (scatter, unit) in enumerate(cases)
            ]
            shares, error, size, row_error = (list(column) for column in zip(*results, strict=True))
            kept_shares += shares
            rate_errors += error
            cells.append(f"{max(size)}; {max(row_error)}")
        print(f"| {jitter} | {' | '.join(cells)} |", flush=True)
    print(f"rows kept: {100 * min(kept_shares):.2f} %; rate error: {max(rate_errors):.2f} ppm")


if __name__ == "__main__":
    main()

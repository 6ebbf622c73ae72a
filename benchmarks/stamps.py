"""Rows kept, rate and losses found where stamps are times of arrival.

    python benchmarks/stamps.py --output docs/method.md

A cell is the worst of all scatters and units of time: samples too many or few, and the largest
displacement of a row.
"""

from __future__ import annotations

import itertools

import numpy as np
from page import make_parser, renew, table

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
    parser = make_parser(__doc__)
    parser.add_argument("--rows", type=int, default=20_000, help="rows of a record")
    options = parser.parse_args()
    cases = list(enumerate(itertools.product(SCATTERS, UNITS)))
    rows, kept_shares, rate_errors = [], [], []
    for jitter in JITTER:
        cells = []
        for losses in LOSSES:
            shares, errors, sizes, displacements = zip(
                *(
                    measure(jitter, losses, scatter, unit, options.rows, seed)
                    for seed, (scatter, unit) in cases
                ),
                strict=True,
            )
            kept_shares += shares
            rate_errors += errors
            cells.append(f"{max(sizes)}; {max(displacements)}")
        rows.append([jitter, *cells])
    text = table(["jitter", *LOSSES], rows)
    print(text)
    print(f"rows kept: {100 * min(kept_shares):.2f} %; rate error: {max(rate_errors):.2f} ppm")
    renew(options.output, "stamps", text)


if __name__ == "__main__":
    main()

"""Probabilities behind settings of `gyrostab.diagnose` that have no textbook value.

    python benchmarks/settings_derivations.py [--records 400]

Prints, for the shortest and the longest blocks, how often white noise alone exceeds `noisy_sigma`,
`excess_sigma`, `known_line_sigma` and `line_nats`. The powers of white noise are gamma distributed
with as many degrees of freedom as a band has lines, so that all but `line_nats` follow in closed
form.
"""

from __future__ import annotations

import numpy as np
from page import machine, make_parser
from scipy.stats import gamma

from gyrostab.diagnose.evidence.spectral_lines import line_evidence
from gyrostab.diagnose.reduce.accumulate import RECORD_PARTS
from gyrostab.diagnose.reduce.block_statistics import MIN_BLOCKS
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.kernels.spectra.periodogram import band_edges, ordinates

#: Samples of the shortest default block, and of one of 20 s at 100 Hz; fewest and most blocks.
CASES = ((100, MIN_BLOCKS), (2000, 1000))


def exceedance(sigma: float, shape: float) -> float:
    """Return how often the mean of a gamma law of this shape exceeds 1 by so many deviations."""
    return float(gamma.sf(shape + sigma * np.sqrt(shape), shape))


def largest_line(count: int, records: int, lines: int = 1000) -> np.ndarray:
    """Return the largest evidence of any line of white noise in each record [nats]."""
    rng = np.random.default_rng(0)
    weight = np.full((1, RECORD_PARTS), count / RECORD_PARTS)
    power = rng.gamma(weight[0, 0], 1.0 / weight[0, 0], (records, 1, RECORD_PARTS, lines))
    return np.asarray(line_evidence(power, weight).max(axis=(1, 2)))


def main() -> None:
    """Print the probabilities."""
    parser = make_parser(__doc__, has_page=False)
    parser.add_argument("--records", type=int, default=400)
    records = parser.parse_args().records
    print(f"{machine()}\n")
    for samples, blocks in CASES:
        lines = ordinates(samples)
        bands = np.diff(band_edges(samples))
        print(f"{blocks} blocks of {samples} samples, {lines} lines in {bands.size} bands:")
        for name in ("noisy_sigma", "excess_sigma"):
            share = exceedance(getattr(DEFAULTS, name), lines)
            print(f"- {name}: P = {share:.2g} a block, {share * blocks:.2g} blocks of a record")
        share = exceedance(DEFAULTS.known_line_sigma, blocks / RECORD_PARTS)
        print(f"- known_line_sigma: P = {share:.2g} a line and part")
        best = np.sort(largest_line(blocks, records))
        print(
            f"- line_nats: largest of 1000 lines {best[-1]:.2f} nats in {records} records, "
            f"95 % below {np.quantile(best, 0.95):.2f}"
        )


if __name__ == "__main__":
    main()

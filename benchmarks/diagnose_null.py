"""False alarms of the diagnosis on simulated records that hold nothing but noise.

    python benchmarks/diagnose_null.py --output docs/diagnosis-method.md

Half of the records have random gaps. Prints each record in which something was found, and a table
of how many there are.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
import xarray as xr
from page import make_parser, renew, table
from scipy.stats import binomtest

import gyrostab
from gyrostab.simulate import simulate

MODEL = {"log": {"axes": ["x"]}, "noise": {"N": 0.003, "B": 0.004, "K": 0.02}}
RATE_HZ, LOST, NULLS = 10.0, (0.0, 0.3), 400


def main() -> None:
    """Count, print."""
    parser = make_parser(__doc__)
    parser.add_argument("--records", type=int, default=300)
    options = parser.parse_args()
    named = mismatched = 0
    for seed, log in make_logs(options.records):
        diagnosis = gyrostab.diagnose(log, nulls=NULLS, seed=seed)
        if diagnosis.verdict == "no mismatch" and not diagnosis.effects:
            continue
        named += bool(diagnosis.effects)
        mismatched += not diagnosis.effects
        effects = [effect["name"] for effect in diagnosis.effects]
        boxes = [f"{box['statement']} (p = {box['p_value']:.2g})" for box in diagnosis.mismatches]
        print(
            f"record {seed}: {diagnosis.verdict}; {effects}; {boxes}", file=sys.stderr, flush=True
        )
    rows = [
        ["a name", *describe(named, options.records), "0.5 %"],
        ["a mismatch without a name", *describe(mismatched, options.records),
         "0.5 %, with the names 1 %"],
    ]  # fmt: skip
    text = table(["", "records", "share (95 % interval)", "required"], rows)
    print(text)
    renew(options.output, "false alarms", text)


def make_logs(records: int) -> Iterator[tuple[int, xr.Dataset]]:
    """Noise, one half of the records with random gaps; no two have the same noise."""
    for seed in range(records):
        log = simulate(MODEL, duration="1h", rate=RATE_HZ, seed=seed).compute()
        lost = LOST[2 * seed // records]
        present = np.random.default_rng(seed).random(log.sizes["time"]) >= lost
        signal = log["rate"].where(xr.DataArray(present, dims="time")).transpose("axis", "time")
        yield seed, log.assign(rate=signal.assign_attrs(log["rate"].attrs))


def describe(count: int, records: int) -> tuple[str, str]:
    low, high = binomtest(count, records).proportion_ci()
    return f"{count} of {records}", f"{count / records:.1%} ({low:.2%} to {high:.1%})"


if __name__ == "__main__":
    main()

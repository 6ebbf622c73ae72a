"""False alarms of the diagnosis on records that hold nothing but noise, simulated sample by sample.

    python benchmarks/diagnose_null.py --records 300
    python benchmarks/diagnose_null.py --records 300 --whole

Every record is reduced and calibrated separately, and its largest held-out gain over steps, trends,
events, curves, bands and filters is ranked among null records drawn from its own calibration. The
ranks must be uniform: a share of 1 % below 1 %. With --whole the diagnosis itself runs, and what it
claims is counted. Prints a Markdown table, and then each record in which something was found.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator

import numpy as np
import xarray as xr
from page import machine
from scipy.stats import binom, kstest

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.simulate import simulate
from tests.support.evidence import mean_evidence, power_evidence

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
VIEWS = {"means": mean_evidence, "powers": power_evidence}


def main() -> None:
    """Count, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--records", type=int, default=300, help="records of each kind")
    parser.add_argument("--nulls", type=int, default=400, help="null records for each")
    parser.add_argument("--rates", type=float, nargs="+", default=[10.0, 100.0])
    parser.add_argument(
        "--lost",
        type=float,
        nargs="+",
        default=[0.0, 0.3],
        help="share of the samples that is missing",
    )
    parser.add_argument(
        "--whole", action="store_true", help="run the whole diagnosis (slow) in place of the gains"
    )
    options = parser.parse_args()
    kinds = [(rate, lost) for rate in options.rates for lost in options.lost]
    count = whole if options.whole else ranks
    rows = [
        row
        for number, (rate, lost) in enumerate(kinds)
        for row in count(rate, lost, options, first=number * options.records)
    ]
    if options.whole:
        head = (
            "| rate [Hz] | lost | records | named an effect | found a mismatch | 95 % "
            "bound of the share that is named | seconds a record |"
        )
    else:
        head = (
            "| rate [Hz] | lost | in | noise | p < 0.01 | p < 0.05 | p < 0.1 | uniform "
            "(Kolmogorov-Smirnov) | gain at 99 %: null, raw |"
        )
    summary = (
        f"{machine()}; {options.records} records of 1 h, one axis, N = 0.003, B = 0.004, "
        f"K = 0.02; {options.nulls} null records each."
    )
    print(f"{summary}\n", head, "|" + "---|" * head.count(" | ") + "---|", *rows, sep="\n")


def logs(rate: float, lost: float, seeds: range) -> Iterator[tuple[int, xr.Dataset]]:
    """Noise with random gaps."""
    for seed in seeds:
        log = simulate(
            {"log": {"axes": ["x"]}, "noise": NOISE}, duration="1h", rate=rate, seed=seed
        ).compute()
        gone = np.random.default_rng(seed).random(log.sizes["time"]) < lost
        yield (
            seed,
            log.assign(
                rate=log["rate"]
                .where(xr.DataArray(~gone, dims="time"))
                .transpose("axis", "time")
                .assign_attrs(log["rate"].attrs)
            ),
        )


def candidates(reduced: xr.Dataset) -> dict[str, dict[str, list[np.ndarray]]]:
    """Shapes of all kinds that an effect could have, by view."""
    n, bands = reduced.sizes["block"], reduced.sizes["band"]
    t, x = np.arange(n) / n, np.linspace(0.0, 1.0, bands)
    curves = np.stack(
        [np.interp(t, np.linspace(0, 1, 13), unit_vector) for unit_vector in np.eye(13)], axis=1
    )
    events = [((t > edge) & (t < edge + 0.08)).astype(float) for edge in (0.2, 0.4, 0.6)]
    flat = np.ones((n, bands))
    means = {
        "step": [(t > edge).astype(float) for edge in np.arange(0.1, 0.95, 0.1)],
        "trend": [t],
        "decay": [np.exp(-t / time) for time in (0.05, 0.2)],
        "event": events,
        "sine": [np.sin(9.0 * t + phase) for phase in (0.0, 1.0, 2.0)],
        "curve": [curves],
    }
    powers = {
        "trend": [t[:, None] * flat],
        "event": [event[:, None] * flat for event in events],
        "filter": [-(x**power) * flat for power in (4, 8)],
        "band": [
            np.exp(-0.5 * ((x - place) / 0.07) ** 2) * events[1][:, None]
            for place in (0.5, 0.7, 0.9)
        ],
        "curve": [curves[:, None, :] * flat[..., None]],
    }
    return {"means": means, "powers": powers}


def ranks(rate: float, lost: float, options: argparse.Namespace, *, first: int) -> list[str]:
    """Rows of the table for one kind of record; no two kinds have a record of the same noise."""
    scores: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for seed, log in logs(rate, lost, range(first, first + options.records)):
        reduced = reduce_log(log)
        baseline = calibrate_noise(reduced)
        chunks = list(
            null_records(
                reduced, baseline, count=options.nulls, rng=np.random.default_rng(seed), chunk=100
            )
        )
        nulls = xr.concat(
            chunks,
            "record",
            data_vars="minimal",
            coords="minimal",
            compat="override",
            join="override",
        )
        for view, tried in candidates(reduced).items():
            for tier in ("free", "calibrated"):
                own = float(VIEWS[view](reduced, baseline, tried, axis="x", tier=tier).max())
                others = (
                    VIEWS[view](nulls, baseline, tried, axis="x", tier=tier).max("candidate").values
                )
                p = (1 + int((others >= own).sum())) / (1 + others.size)
                scores.setdefault((view, tier), []).append(
                    (p, own, float(np.quantile(others, 0.99)))
                )
    rows = []
    for (view, tier), values in scores.items():
        p, own, limit = np.array(values).T
        shares = " | ".join(f"{(p < level).mean():.3f}" for level in (0.01, 0.05, 0.1))
        uniform = kstest(p, "uniform").pvalue
        rows.append(
            f"| {rate:g} | {lost:g} | {view} | {tier} | {shares} | {uniform:.2f} | "
            f"{limit.mean():.1f}, {np.quantile(own, 0.99):.1f} |"
        )
    return rows


def whole(rate: float, lost: float, options: argparse.Namespace, *, first: int) -> list[str]:
    """Row of the table of claims for one kind of record."""
    import gyrostab

    named, mismatched, begin = 0, 0, time.monotonic()
    for seed, log in logs(rate, lost, range(first, first + options.records)):
        diagnosis = gyrostab.diagnose(log, nulls=options.nulls, seed=seed)
        named += bool(diagnosis.effects)
        mismatched += diagnosis.verdict != "no mismatch"
        if diagnosis.verdict != "no mismatch":
            boxes = "; ".join(
                f"{box['statement']} (p = {box['p_value']:.2g})" for box in diagnosis.mismatches
            )
            print(
                f"record {seed}: {diagnosis.verdict}; "
                f"{[effect['name'] for effect in diagnosis.effects]}; {boxes}",
                file=sys.stderr,
                flush=True,
            )
    levels = np.linspace(0.0, 1.0, 10_001)
    bound = float(levels[binom.cdf(named, options.records, levels) >= 0.05].max())
    seconds = (time.monotonic() - begin) / options.records
    return [
        f"| {rate:g} | {lost:g} | {options.records} | {named} | {mismatched} | {bound:.3f} | "
        f"{seconds:.1f} |"
    ]


if __name__ == "__main__":
    main()

"""Evidence for effects on the mean, with everything known about the noise and with less and less.

    python benchmarks/slow_effects.py --output docs/diagnosis-method.md

A row for each effect and strength: medians over records of an hour at 10 Hz, summed over the axes
[nats].
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from page import make_parser, renew, table

from gyrostab.blindtest.scenarios.case import make_case
from gyrostab.blindtest.scenarios.plan import plan_case
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.evidence.held_out import mean_factors
from gyrostab.diagnose.evidence.products import mean_products
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.search import compute_evidence, evidence_by_effect
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates

EFFECTS = ("temperature_bias", "shupe", "warm_up", "vibration_rectification", "bias_jump")
COLUMNS = ("all known", "size unknown", "K and B unknown too", "scored")


def waveform(truth: dict[str, Any], axis: str, reduced: xr.Dataset) -> np.ndarray:
    """True bias of an axis in the blocks [deg/h]."""
    values = np.array(truth["effects"][0]["waveform_10s"][axis])
    middle = 10.0 * (np.arange(values.size) + 0.5)
    edges = zip(reduced["begin"].values, reduced["end"].values, strict=True)
    return np.array([values[(middle >= begin) & (middle < end)].mean() for begin, end in edges])


def ladder(name: str, strength: float, number: int) -> list[float]:
    """Gains in one record, in the order of `COLUMNS`."""
    plan = plan_case(number, seed=777) | {
        "rate": 10.0,
        "seconds": 3600,
        "kind": "single",
        "names": [name],
        "strengths": [strength],
        "in_fitted_noise": False,
    }
    log, truth = make_case(plan | {"gaps": 0.0, "cuts": 0, "heavy": False, "degradation": None})
    reduced = reduce_log(log)
    baseline, folds = calibrate_noise(reduced), fold_blocks(reduced)
    total = np.zeros(3)
    for axis in truth["effects"][0]["axes"]:
        column, noise = (
            waveform(truth, axis, reduced),
            {term: np.array([truth["noise"][axis].get(term, 0.0)]) for term in "KB"},
        )
        mean = reduced["mean"].sel(axis=axis).values
        known: dict[str, Any] = {
            "variance": baseline["mean_variance"].sel(axis=axis).values,
            "present": np.isfinite(mean),
            **noise,
        }
        products = mean_products(
            np.nan_to_num(mean)[:, None],
            column[:, None],
            step=float(reduced.attrs["block_s"]),
            **known,
        )
        noise_grids = {
            f"grid_{term}": (("axis", "grid"), np.full(baseline["grid_K"].shape, value[0]))
            for term, value in noise.items()
        }
        total += [
            float(products.cross[0, 0, 0] - 0.5 * products.gram[0, 0, 0]),
            mean_factors(reduced, baseline.assign(noise_grids), [column], axis=axis, folds=folds)[
                0, 1, 0
            ],
            mean_factors(reduced, baseline, [column], axis=axis, folds=folds)[0, 1, 0],
        ]
    tried = [
        candidate
        for candidate in effect_candidates(reduced, baseline["coefficient"])[0]
        if candidate.effect == name and candidate.statistic.is_in_means
    ]
    scored = evidence_by_effect(compute_evidence(tried, reduced, initial_state(reduced, baseline)))
    return [*total, max(float(gain[0]) for gain in scored.values())]


def main() -> None:
    """Print the table."""
    parser = make_parser(__doc__)
    parser.add_argument(
        "--records", type=int, default=8, help="records of each effect and strength"
    )
    parser.add_argument(
        "--strengths", type=float, nargs="+", default=[1.5, 2.5], help="in units of the limit"
    )
    given = parser.parse_args()
    rows = []
    for name in EFFECTS:
        for strength in given.strengths:
            evidence = [ladder(name, strength, number) for number in range(given.records)]
            medians = np.median(evidence, axis=0)
            rows.append([name, f"{strength:g}", *(f"{value:.1f}" for value in medians)])
            print(*rows[-1], sep=" | ", flush=True)
    renew(given.output, "slow effects", table(["effect", "strength", *COLUMNS], rows))


if __name__ == "__main__":
    main()

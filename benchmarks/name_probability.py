"""Calibrate the probability that an identified name is right, on finished blind tests.

    python benchmarks/name_probability.py proof-tuning [MORE ...]

Fits `set_probability`, `alternative_weight` and `even_odds_nats` of `gyrostab.diagnose.settings` to
the names of the diagnoses in these folders by maximum likelihood
(`gyrostab.diagnose.result.verdict` has the law). Prints them with their standard errors, the log
scores and calibration errors of the values in the settings, and of values fitted to the other
folders only; and the log score of one probability for all names, which is fitted to nine tenths and
scored on the other, ten times. Give runs of which the ground truths are known already: a seed below
1 000 000, or one in the register of docs/proof.md.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from page import make_parser
from scipy.optimize import minimize
from scipy.special import expit, logit

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.blindtest.scoring.probability import expected_calibration_error
from gyrostab.blindtest.scoring.score import drawn_rows, score_case
from gyrostab.diagnose.settings import DEFAULTS

PARTS = 10
#: Standard deviation of the three logarithms of the fit about zero, which bounds them.
PRIOR_SD = 3.0
STEP = 1e-3


class Names(NamedTuple):
    """Identified names."""

    run: Ints  # number of the folder
    evidence_nats: Floats
    rivals: Floats  # sum of exp(evidence of an alternative - evidence) over the alternatives
    right: Bools


def main() -> None:
    parser = make_parser(__doc__, has_page=False)
    parser.add_argument("runs", type=Path, nargs="+", help="folders of blind tests")
    names = collect_names(parser.parse_args().runs)
    best = fit_law(names)
    errors = np.sqrt(np.diagonal(np.linalg.inv(curvature(best, names))))
    ends = np.column_stack([best - errors, best + errors])
    print(f"{names.right.size} names, {names.right.mean():.3f} right")
    has_no_rival = names.rivals == 0.0
    print(
        f"{has_no_rival.sum()} without alternatives, {names.right[has_no_rival].mean():.3f} right"
    )
    for label, value, (low, high) in zip(
        ("set_probability", "weight of an alternative", "evidence of even odds"),
        (expit(best[0]), math.exp(best[1]), math.exp(best[2])),
        (expit(ends[0]), np.exp(ends[1]), np.exp(ends[2])),
        strict=True,
    ):
        print(f"{label}: {value:.3f} ({low:.3f} to {high:.3f})")
    settings = np.array(
        [
            logit(DEFAULTS.set_probability),
            math.log(DEFAULTS.alternative_weight),
            math.log(DEFAULTS.even_odds_nats),
        ]
    )
    print_score("settings", probabilities(settings, names), names.right)
    if len(np.unique(names.run)) > 1:
        print_score("fitted to the other folders", fit_without_own_run(names), names.right)
    constant = cross_validate(names)
    print(f"one probability for all names: log score {log_score(constant, names.right):.3f} nats")


def print_score(label: str, stated: Floats, right: Bools) -> None:
    """Print the log score and the calibration error of stated probabilities."""
    error = expected_calibration_error(stated, right.astype(float))
    score = log_score(stated, right)
    print(f"{label}: log score {score:.3f} nats, calibration error {error:.3f}")


def collect_names(runs: list[Path]) -> Names:
    """Read the diagnoses and ground truths of blind tests."""
    numbers, evidence_nats, rivals, right = [], [], [], []
    for number, run in enumerate(runs):
        for path in sorted((run / "diagnoses").glob("*.json")):
            diagnosis = json.loads(path.read_text(encoding="utf-8"))
            truth = json.loads((run / "truth" / path.name).read_text(encoding="utf-8"))
            for case in drawn_rows(score_case(diagnosis, truth))[:1]:
                for identification in case["identifications"]:
                    numbers.append(number)
                    table = strongest_table(identification["name"], diagnosis)
                    evidence_nats.append(table["held_out_gain"]["nats"])
                    rivals.append(sum_rivals(table, diagnosis))
                    right.append(identification["exact"])
    return Names(np.array(numbers), np.array(evidence_nats), np.array(rivals), np.array(right))


def strongest_table(name: str, diagnosis: dict[str, Any]) -> dict[str, Any]:
    """Return the table of an effect with the most evidence."""
    tables: list[dict[str, Any]] = [
        table for table in diagnosis["effects"] if table["name"] == name
    ]
    return max(tables, key=lambda table: table["held_out_gain"]["nats"])


def sum_rivals(table: dict[str, Any], diagnosis: dict[str, Any]) -> float:
    """Sum exp(evidence of an alternative - evidence); without a difference it is equal."""
    differences = {
        rejection["name"]: rejection["nats"] or 0.0
        for rejection in diagnosis["rejected"]
        if rejection["beaten_by"] == table["name"]
    }
    return sum(
        float(np.exp(-differences.get(alternative, 0.0))) for alternative in table["alternatives"]
    )


def probabilities(law: Floats, names: Names) -> Floats:
    """Return the probability of each name.

    `law` has the log odds of large evidence, and the logarithms of the weight of an alternative and
    of the evidence of even odds.
    """
    log_odds = law[0] * (1.0 - np.exp(law[2]) / names.evidence_nats)
    return np.asarray(expit(log_odds) / (1.0 + np.exp(law[1]) * names.rivals))


def fit_law(names: Names) -> Floats:
    """Fit the law by penalised maximum likelihood."""
    return np.asarray(minimize(penalised_loss, np.zeros(3), args=(names,)).x)


def penalised_loss(law: Floats, names: Names) -> float:
    """Return the negative log-likelihood with the prior of the law [nats]."""
    loss = log_score(probabilities(law, names), names.right) * names.right.size
    return float(loss + 0.5 * (law**2).sum() / PRIOR_SD**2)


def curvature(law: Floats, names: Names) -> Floats:
    """Return the second derivatives of the loss."""
    steps = STEP * np.eye(3)
    return np.array(
        [
            [
                sum(
                    sign * penalised_loss(law + first + sign * second, names)
                    - sign * penalised_loss(law - first + sign * second, names)
                    for sign in (1.0, -1.0)
                )
                / (4.0 * STEP**2)
                for second in steps
            ]
            for first in steps
        ]
    )


def fit_without_own_run(names: Names) -> Floats:
    """Return the probability of each name by the law that is fitted to the other folders."""
    stated = np.empty(names.right.size)
    for run in np.unique(names.run):
        own = names.run == run
        law = fit_law(Names(*(values[~own] for values in names)))
        stated[own] = probabilities(law, Names(*(values[own] for values in names)))
    return stated


def cross_validate(names: Names) -> Floats:
    """Return for each name the share of names in the other parts that is right."""
    part = np.random.default_rng(0).permutation(names.right.size) % PARTS
    share = [names.right[part != number].mean() for number in range(PARTS)]
    return np.clip(share, 1.0 / names.right.size, 1.0 - 1.0 / names.right.size)[part]


def log_score(stated: Floats, right: Bools) -> float:
    """Return the mean negative log-probability of what is true."""
    return float(-np.log(np.where(right, stated, 1.0 - stated)).mean())


if __name__ == "__main__":
    main()

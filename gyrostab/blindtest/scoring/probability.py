"""Check the probabilities of identifications against how often these are right."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gyrostab.arrays import Floats
from gyrostab.blindtest.scoring.proportions import Line, make_line, resample, share_interval
from gyrostab.blindtest.scoring.score import drawn_rows, first_rows

Row = Mapping[str, Any]

_GROUPS = 5  # of about equal size, in the curve and in the calibration error
_DRAWS = 1000  # of the outcomes of exact probabilities
_LEAST_PROBABILITY = 1e-3  # in the log score, which is infinite for a wrong certain answer
_SEED = 0  # of these draws
_INTERVAL = (0.025, 0.975)


def _collect_probabilities(rows: Sequence[Row]) -> tuple[list[Row], Floats, Floats]:
    """Return each identification, its probability, and 1 where its name is right."""
    entries: list[Row] = [
        {**identification, "index": row["index"]}
        for row in first_rows(drawn_rows(rows))
        for identification in row["identifications"]
        if identification["probability"] is not None
    ]
    pairs = [(entry["probability"], entry["exact"]) for entry in entries]
    stated, right = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
    return entries, stated, right


def _split_groups(stated: Floats) -> list[NDArray[np.intp]]:
    """Split identifications into groups of about equal size; equal probabilities stay together."""
    from scipy.stats import rankdata

    number = np.floor((rankdata(stated) - 0.5) * _GROUPS / max(stated.size, 1))
    return [np.flatnonzero(number == group) for group in np.unique(number)]


def expected_calibration_error(stated: Floats, right: Floats) -> float:
    """Compute the mean distance of stated probability and share that is right, over groups.

    Examples
    --------
    >>> expected_calibration_error(np.full(10, 0.75), np.ones(10))
    0.25
    """
    groups = _split_groups(stated)
    return float(
        sum(abs(stated[group].sum() - right[group].sum()) for group in groups) / stated.size
    )


def calibration_curve(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the share of names that are right, in groups of similar probability.

    ``stated`` is the mean probability of the group; ``low`` and ``high`` are the ends of the 95 %
    interval.
    """
    entries, stated, right = _collect_probabilities(rows)
    lines = []
    for group in _split_groups(stated):
        low, high = share_interval(
            [entries[place] for place in group], (right[group] > 0.0).tolist()
        )
        lines.append(
            {
                "stated": float(stated[group].mean()),
                "n": int(group.size),
                "right": float(right[group].mean()),
                "low": low,
                "high": high,
            }
        )
    return pd.DataFrame(lines, columns=["stated", "n", "right", "low", "high"])


def risk_coverage(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the share of wrong names against the share of records named.

    Each line, the largest probability first, has this ``least`` probability, the ``coverage``
    (share of the records with effects that have a name at least as probable), and the ``risk``
    (share of all such names that is wrong).
    """
    _, stated, right = _collect_probabilities(rows)
    thresholds = np.unique(stated)[::-1]
    above = stated >= thresholds[:, None]
    records = first_rows([row for row in drawn_rows(rows) if row["kind"] != "null"])
    surest = np.array(
        [
            max(
                (
                    identification["probability"]
                    for identification in row["identifications"]
                    if identification["probability"] is not None
                ),
                default=-math.inf,
            )
            for row in records
        ]
    )
    return pd.DataFrame(
        {
            "least": thresholds,
            "coverage": [
                float((surest >= threshold).mean()) if records else math.nan
                for threshold in thresholds
            ],
            "risk": above @ (1.0 - right) / above.sum(axis=1),
        }
    )


def probability_lines(rows: Sequence[Row]) -> list[Line]:
    """Make the lines of the calibration, with intervals from resampled records.

    A sample of exact probabilities has a calibration error too; a line gives its mean.
    """
    entries, stated, right = _collect_probabilities(rows)
    scores: dict[str, tuple[Callable[[Floats, Floats], float], str]] = {
        "probability of a name: expected calibration error": (
            expected_calibration_error,
            "<= 0.05",
        ),
        "Brier score of the probabilities": (_brier_score, ""),
        "Brier score of one probability for all names": (_constant_brier_score, ""),
        "log score of the probabilities, nats per name": (_log_score, ""),
    }
    exact = "calibration error of exact probabilities in as many names, mean and 95 % range"
    if not stated.size:
        nothing = (math.nan, math.nan, math.nan, 0)
        return [
            *(make_line(name, *nothing, target) for name, (_, target) in scores.items()),
            make_line(exact, *nothing, ""),
        ]

    def score_line(name: str, score: Callable[[Floats, Floats], float], target: str) -> Line:
        ends = resample(entries, lambda chosen: score(stated[chosen], right[chosen]))
        return make_line(name, score(stated, right), *ends, stated.size, target)

    draws = np.random.default_rng(_SEED).random((_DRAWS, stated.size))
    outcomes = (draws < stated).astype(float)
    by_chance = [expected_calibration_error(stated, outcome) for outcome in outcomes]
    low, high = np.quantile(by_chance, _INTERVAL)
    mean = float(np.mean(by_chance))
    return [
        *(score_line(name, *scored) for name, scored in scores.items()),
        make_line(exact, mean, low, high, stated.size, ""),
    ]


def _brier_score(stated: Floats, right: Floats) -> float:
    return float(np.mean((stated - right) ** 2))


def _constant_brier_score(stated: Floats, right: Floats) -> float:
    return _brier_score(np.full(stated.size, right.mean()), right)


def _log_score(stated: Floats, right: Floats) -> float:
    of_outcome = np.maximum(np.where(right > 0.0, stated, 1.0 - stated), _LEAST_PROBABILITY)
    return float(-np.log(of_outcome).mean())

"""Compare detectors at equal false-alarm rates, and cases with their noise-only counterparts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gyrostab.blindtest.scoring.proportions import Target, share, share_of
from gyrostab.blindtest.scoring.score import CATALOGUE_KINDS, answered_rows, drawn_rows, first_rows
from gyrostab.blindtest.scoring.table import CLEAR_STRENGTH

Row = Mapping[str, Any]
Array = NDArray[np.float64]

#: Shares of records of noise that each detector may call a detection.
FALSE_ALARM_RATES = (0.02, 0.05)
#: Kinds of cases whose detection is counted together.
_GROUPS = {
    "catalogue": CATALOGUE_KINDS,
    "out of catalogue or degraded driver": ("out_of_catalogue", "degraded_driver"),
}
_RESAMPLINGS = 1000
_SEED = 0  # of the resamplings
_INTERVAL = (0.025, 0.975)


def _list_comparisons(rows: Sequence[Row]) -> list[tuple[str, str, Array, Array]]:
    """List group of cases, detector, and its scores of the records of noise and of the cases."""
    noise = answered_rows([row for row in rows if row["kind"] in ("null", "counterpart")])
    out = []
    for group, kinds in _GROUPS.items():
        strong = [row for row in rows if row["kind"] in kinds and row["strength"] >= CLEAR_STRENGTH]
        cases = first_rows(strong)
        if not noise or not cases:
            continue
        names = ["diagnosis", *cases[0]["baseline_detectors"]]
        out += [
            (group, name, *(_read_scores(part, name) for part in (noise, cases))) for name in names
        ]
    return out


def _read_scores(rows: Sequence[Row], detector: str) -> Array:
    return np.array(
        [
            row["score"] if detector == "diagnosis" else row["baseline_detectors"][detector]
            for row in rows
        ],
        dtype=float,
    )


def _shares_detected(noise: Array, cases: Array, rate: float) -> Array:
    """Compute the share of `cases` above the score that at most `rate` of `noise` exceeds.

    Both have a leading axis of resamplings, or of one.
    """
    allowed = math.floor(rate * noise.shape[1] + 1e-9)
    threshold = np.sort(noise, axis=1)[:, noise.shape[1] - 1 - allowed]
    return np.asarray((cases > threshold[:, None]).mean(axis=1))


def detection_shares(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the share of cases that each detector detects at equal rates of false alarms.

    The threshold of each detector is the score that this share of the null records and of the
    noise-only counterparts exceeds. A case counts if its strongest effect has strength 1.5 or more.

    Returns
    -------
    pandas.DataFrame
        ``detector``, ``cases`` (group), ``n``, ``noise`` (number of records), and for each rate the
        share detected, with the 95 % interval of resampled cases and records of noise. Empty
        without records of noise.
    """
    rng = np.random.default_rng(_SEED)
    lines = []
    for group, name, noise, cases in _list_comparisons(rows):
        line: dict[str, Any] = {
            "cases": group,
            "detector": name,
            "n": cases.size,
            "noise": noise.size,
        }
        resampled_noise, resampled_cases = (
            values[rng.integers(values.size, size=(_RESAMPLINGS, values.size))]
            for values in (noise, cases)
        )
        for rate in FALSE_ALARM_RATES:
            (value,) = _shares_detected(noise[None], cases[None], rate)
            low, high = np.quantile(
                _shares_detected(resampled_noise, resampled_cases, rate), _INTERVAL
            )
            label = f"at {100 * rate:g} %"
            line |= {label: float(value), f"{label}, low": low, f"{label}, high": high}
        lines.append(line)
    return pd.DataFrame(lines)


def roc_curves(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the shares of cases and of records of noise above each score.

    Returns
    -------
    pandas.DataFrame
        ``cases`` (group), ``detector``, ``false_alarms`` and ``detected`` (shares), and ``own``:
        whether this is the threshold of the detector itself, which is score 0.
    """
    lines = []
    for group, name, noise, cases in _list_comparisons(rows):
        thresholds = [math.inf, *np.unique(noise)[::-1], -math.inf]
        lines += [
            {
                "cases": group,
                "detector": name,
                "false_alarms": float((noise > threshold).mean()),
                "detected": float((cases > threshold).mean()),
                "own": is_own,
            }
            for threshold, is_own in [(0.0, True), *((value, False) for value in thresholds)]
        ]
    return pd.DataFrame(lines, columns=["cases", "detector", "false_alarms", "detected", "own"])


def counterpart_table(rows: Sequence[Row]) -> pd.DataFrame:
    """Compare cases with their noise-only counterparts; empty without counterparts.

    Returns
    -------
    pandas.DataFrame
        Lines as in `score_table`.
    """
    mine = answered_rows([row for row in rows if row["kind"] == "counterpart"])
    if not mine:
        return pd.DataFrame()
    cases = {row["index"]: row for row in drawn_rows(rows)}
    pairs = [(cases[row["index"]], row) for row in mine if row["index"] in cases]
    noise = answered_rows([row for row in rows if row["kind"] in ("null", "counterpart")])
    names = [
        (
            identification["name"],
            {other["name"] for other in counterpart["identifications"]},
        )
        for case, counterpart in pairs
        for identification in case["identifications"]
    ]
    return pd.DataFrame(
        [
            share_of("false alarms: effect named on a counterpart", mine, "identifications"),
            share_of(
                "effect named on a counterpart or a null record",
                noise,
                "identifications",
                Target("<= 1 %, upper bound <= 1.5 %", most=0.01, surely=0.015),
            ),
            share_of("counterparts with any mismatch", mine, "detected"),
            share(
                "detected with its effects, and not without them",
                (case["detected"] and not row["detected"] for case, row in pairs),
            ),
            share(
                "detected with its effects, and without them too",
                (case["detected"] and row["detected"] for case, row in pairs),
            ),
            share(
                "detected only without its effects",
                (row["detected"] and not case["detected"] for case, row in pairs),
            ),
            share(
                "names of a case that its counterpart has too",
                (name in counterpart_names for name, counterpart_names in names),
            ),
        ]
    )

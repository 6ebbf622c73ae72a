"""Scores of probabilities: exact ones are calibrated, and overconfident ones are not."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.blindtest.scoring.probability import (
    calibration_curve,
    expected_calibration_error,
    probability_lines,
    risk_coverage,
)


def rows_of(stated: np.ndarray, right: np.ndarray) -> list[dict]:
    return [
        {
            "index": number,
            "kind": "single",
            "identifications": [{"name": "shupe", "probability": p, "right": True, "exact": hit}],
        }
        for number, (p, hit) in enumerate(zip(stated.tolist(), right.tolist(), strict=True))
    ]


@pytest.fixture(scope="module")
def drawn() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    stated = rng.uniform(0.3, 1.0, 400)
    return stated, rng.random(400) < stated


def test_exact_probabilities_are_calibrated_to_what_chance_leaves(drawn):
    lines = {line["quantity"]: line for line in probability_lines(rows_of(*drawn))}
    error = lines["probability of a name: expected calibration error"]
    chance = lines["calibration error of exact probabilities in as many names, mean and 95 % range"]
    assert chance["low"] < error["value"] < chance["high"]
    assert 0.02 < chance["value"] < 0.05
    brier = lines["Brier score of the probabilities"]["value"]
    assert brier < lines["Brier score of one probability for all names"]["value"]


def test_overconfident_probabilities_have_a_calibration_error(drawn):
    stated, right = drawn
    overconfident = stated**0.25
    assert expected_calibration_error(overconfident, right.astype(float)) == pytest.approx(
        float(np.mean(overconfident - stated)), abs=0.04
    )
    (error, *_) = probability_lines(rows_of(overconfident, right))
    assert error["state"] == "missed"
    curve = calibration_curve(rows_of(overconfident, right))
    assert (curve["high"] < curve["stated"]).sum() >= 3


def test_risk_falls_with_the_coverage(drawn):
    risk = risk_coverage(rows_of(*drawn))
    assert risk["coverage"].iloc[-1] == 1.0
    assert risk["risk"].iloc[-1] == pytest.approx(1.0 - drawn[1].mean())
    assert risk["risk"].iloc[99] < 0.5 * risk["risk"].iloc[-1]


def test_coverage_counts_records_with_effects(drawn):
    rows = rows_of(*drawn)
    silent = [
        row | {"index": 1000 + place, "identifications": []} for place, row in enumerate(rows)
    ]
    null = [{"index": -1, "kind": "null", "identifications": []}]
    risk = risk_coverage([*rows, *silent, *null])
    assert risk["coverage"].iloc[-1] == 0.5
    assert risk["risk"].equals(risk_coverage(rows)["risk"])


def test_a_name_of_no_probability_does_not_cover_records_without_a_name():
    rows = rows_of(np.array([0.0, 0.9]), np.array([True, True]))
    silent = [row | {"index": 1000 + k, "identifications": []} for k, row in enumerate(rows)]
    risk = risk_coverage([*rows, *silent])
    assert risk[["least", "coverage"]].to_numpy().tolist() == [[0.9, 0.25], [0.0, 0.5]]


def test_names_of_equal_probability_are_one_group():
    stated = np.repeat([0.5, 0.95], [20, 80])
    right = np.concatenate([np.arange(20) < 10, np.arange(80) < 76])
    curve = calibration_curve(rows_of(stated, right))
    assert curve[["n", "right"]].to_numpy().tolist() == [[20, 0.5], [80, 0.95]]
    assert expected_calibration_error(stated, right.astype(float)) == pytest.approx(0.0)
    risk = risk_coverage(rows_of(stated, right))
    assert risk.to_numpy() == pytest.approx(np.array([[0.95, 0.8, 0.05], [0.5, 1.0, 0.14]]))


def test_a_diagnosis_without_probabilities_has_no_figures():
    rows = rows_of(np.ones(2), np.ones(2, np.bool_))
    for row in rows:
        row["identifications"][0]["probability"] = None
    assert {line["n"] for line in probability_lines(rows)} == {0}
    assert calibration_curve(rows).empty
    assert risk_coverage(rows).empty

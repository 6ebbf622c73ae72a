"""Detectors at equal false-alarm rates, stepwise regression, and ranks of the truth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gyrostab.blindtest.generator.record import make_log
from gyrostab.blindtest.scoring.curves import rank_histogram
from gyrostab.blindtest.scoring.detection import counterpart_table, detection_shares, roc_curves
from gyrostab.blindtest.scoring.score import detection_score
from gyrostab.blindtest.scoring.stepwise import stepwise_detector


def row(index: int, kind: str, score: float, *, other: float = 0.0, strength: float = 2.0) -> dict:
    return {
        "index": index,
        "kind": kind,
        "score": score,
        "strength": strength,
        "detected": score > 0.0,
        "identifications": [{"name": "shupe"}] if score > 0.0 else [],
        "baseline_detectors": {"other": other},
    }


@pytest.fixture
def rows() -> list[dict]:
    """100 records of noise with scores -1 to -100, and 10 cases with scores -9.5 to -0.5."""
    noise = [
        row(place, "counterpart" if place % 2 else "null", -1.0 - place, strength=0.0)
        for place in range(100)
    ]
    cases = [row(100 + place, "single", -9.5 + place, other=1.0) for place in range(10)]
    weak = [row(200, "pair", 50.0, strength=1.0), row(201, "injected", 50.0)]
    return [*noise, *cases, *weak]


def test_threshold_of_each_detector_is_exceeded_by_the_same_share_of_noise(rows):
    shares = detection_shares(rows).set_index("detector")
    assert shares.loc["diagnosis", ["n", "noise"]].tolist() == [10, 100]
    assert shares.loc["diagnosis", "at 2 %"] == 0.3  # two records exceed -3, and three cases
    assert shares.loc["diagnosis", "at 5 %"] == 0.6
    assert shares.loc["diagnosis", "at 2 %, low"] < 0.3 < shares.loc["diagnosis", "at 2 %, high"]
    assert shares.loc["other", "at 2 %"] == 1.0


def test_records_of_equal_score_are_on_one_side_of_the_threshold(rows):
    for row in rows:
        row["baseline_detectors"] = {"other": 0.0}
    assert detection_shares(rows).set_index("detector").loc["other", "at 5 %"] == 0.0


def test_curve_goes_from_nothing_to_everything(rows):
    curve = roc_curves(rows)
    mine = curve[(curve["detector"] == "diagnosis") & ~curve["own"]]
    assert mine["false_alarms"].iloc[[0, -1]].tolist() == [0.0, 1.0]
    assert mine["detected"].iloc[[0, -1]].tolist() == [0.0, 1.0]
    assert mine["false_alarms"].is_monotonic_increasing
    own = curve[curve["own"]].set_index("detector")
    assert own.loc["diagnosis", ["false_alarms", "detected"]].tolist() == [0.0, 0.0]
    assert own.loc["other", "detected"] == 1.0


def test_failed_records_of_noise_are_left_out(rows):
    failed = [
        row | {"score": -math.inf, "failed": True} for row in rows if row["kind"] == "counterpart"
    ]
    others = [row for row in rows if row["kind"] != "counterpart"]
    assert detection_shares([*others, *failed]).equals(detection_shares(others))
    assert roc_curves([*others, *failed]).equals(roc_curves(others))
    assert counterpart_table(failed).empty


def test_few_cases_give_empty_tables():
    assert detection_shares([row(0, "single", 1.0)]).empty
    assert roc_curves([row(0, "null", 1.0)]).empty
    assert counterpart_table([row(0, "single", 1.0)]).empty
    assert rank_histogram([])["n"].sum() == 0


def test_case_and_counterpart_are_compared():
    cases = [row(place, "single", score) for place, score in enumerate((1.0, 1.0, -1.0, -1.0))]
    copies = [row(place, "counterpart", score) for place, score in enumerate((1.0, -1.0, 1.0))]
    table = counterpart_table([*cases, *copies, row(9, "null", -1.0)]).set_index("quantity")[
        "value"
    ]
    assert table["false alarms: effect named on a counterpart"] == pytest.approx(2 / 3)
    assert table["effect named on a counterpart or a null record"] == 0.5
    assert table["detected with its effects, and not without them"] == pytest.approx(1 / 3)
    assert table["detected with its effects, and without them too"] == pytest.approx(1 / 3)
    assert table["detected only without its effects"] == pytest.approx(1 / 3)
    assert table["names of a case that its counterpart has too"] == 0.5


def test_score_of_a_diagnosis_is_zero_at_its_threshold():
    gain = {"nats": 12.0, "threshold": 8.5}
    lacking = [
        {"name": "shupe", "beaten_by": "noise", "nats": 1.5},
        {"name": "telegraph", "beaten_by": "the bias wanders", "nats": 0.1},
    ]
    answer = {"effects": [], "mismatches": [], "rejected": lacking, "false_alarm_level": 0.01}
    assert detection_score(answer) == -1.5
    assert detection_score(answer | {"mismatches": [{"p_value": 1e-4}]}) == pytest.approx(
        math.log(100.0)
    )
    assert detection_score(answer | {"effects": [{"held_out_gain": gain}]}) == 3.5
    assert detection_score({"effects": [], "mismatches": []}) == -math.inf


def noise_log(seed: int, *, size: int = 12_000):
    """Three axes of white noise and random walk at 10 Hz, with gaps and a temperature."""
    rng = np.random.default_rng(seed)
    record = rng.normal(0.0, 1.0, (3, size)) + np.cumsum(rng.normal(0.0, 0.003, (3, size)), axis=1)
    temperature = np.cumsum(rng.normal(0.0, 0.05, size // 10))
    record[:, 3000:3600] = np.nan
    return record, temperature


def score_record(record: np.ndarray, temperature: np.ndarray) -> float:
    log = make_log(record, {"temperature": (temperature, 1.0)}, start=0, rate=10.0)
    return stepwise_detector(log)


@pytest.mark.full
def test_stepwise_regression_allows_for_random_walk():
    scores = [score_record(*noise_log(seed)) for seed in range(12)]
    assert sum(score > 0.0 for score in scores) <= 2
    assert max(scores) < 4.0


@pytest.mark.parametrize("effect", ["channel", "change point", "level"])
def test_stepwise_regression_finds_an_effect(effect):
    record, temperature = noise_log(3)
    before = score_record(record, temperature)
    if effect == "channel":
        record[1] += 0.6 * np.repeat(temperature, 10)
    elif effect == "change point":
        record[1, 7000:] += 1.0
    else:
        record[1, 4000:8000] *= 1.3
    assert score_record(record, temperature) > max(10.0, before + 10.0)


def parameter_rows(pulls: np.ndarray) -> list[dict]:
    scores = [{"pull": float(pull)} for pull in pulls]
    return [{"kind": "single", "effect": "shupe", "strength": 2.0, "parameter_scores": scores}]


def test_ranks_of_exact_estimates_are_equally_frequent():
    pulls = np.random.default_rng(0).normal(0.0, 1.0, 2000)
    exact = rank_histogram(parameter_rows(pulls))
    assert exact["n"].between(exact["low"], exact["high"]).sum() >= 9
    bold = rank_histogram(parameter_rows(2.0 * pulls))
    assert (bold["n"].iloc[[0, -1]] > bold["high"].iloc[0]).all()
    high = rank_histogram(parameter_rows(pulls + 1.0))
    assert high["n"].iloc[0] > 2 * high["n"].iloc[-1]  # the truth is below estimates that are high

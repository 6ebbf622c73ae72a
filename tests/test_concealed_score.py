"""The scorer on diagnoses made by hand, whose marks can be counted on fingers."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from gyrostab.concealed import curves, markdown, missed, reliability, score_case, score_table
from gyrostab.concealed.catalogue import AMBIGUITY, CATALOGUE, merged
from gyrostab.concealed.score import intersection_over_union
from gyrostab.concealed.table import wilson
from gyrostab.errors import SchemaError


def moment(second: float) -> str:
    return str(np.datetime64("2026-05-01T00:00:00") + np.timedelta64(round(second * 1000), "ms"))


def claim(name: str, *, nats: float = 20.0, alternatives=(), intervals=((100, 200),), axes=("x",), parameters=None) -> dict:
    return {
        "name": name,
        "axes": list(axes),
        "driver": None,
        "intervals": [[moment(a), moment(b)] for a, b in intervals],
        "parameters": parameters or {},
        "held_out_gain": {"nats": nats, "stderr": 1.0, "threshold": 5.7},
        "alternatives": list(alternatives),
        "statement": "",
    }


def diagnosis(*claims: dict, verdict: str | None = None, mismatches=(), gain: float = 0.0) -> dict:
    return {
        "verdict": verdict or ("explained" if claims else "no mismatch"),
        "mismatches": list(mismatches),
        "effects": list(claims),
        "unexplained": [],
        "held_out": {"log_likelihood_gain": gain, "coverage95_after": 0.95},
        "seconds": 2.0,
    }


def truth(*names: str, kind: str = "single", strength: float = 2.0, index: int = 0, accepted=(), severing=None, localised=True) -> dict:
    effects = [
        {
            "name": name,
            "axes": ["x"],
            "driver": None,
            "form": "",
            "form_differs": False,
            "strength": strength,
            "size": strength,
            "expected_nats": 10.0,
            "tau_min_s": 1.0,
            "tau_max_s": 10.0,
            "localised": localised,
            "intervals": [[moment(100), moment(200)]],
            "parameters": {"sensitivity": {"value": 0.5, "unit": "deg/h/g^2", "axis": "x"}},
        }
        for name in names
    ]
    plan = {"index": index, "kind": kind, "severing": severing}
    return {"effects": effects, "accepted": list(accepted), "plan": plan, "sampling_rate_hz": 10.0, "seconds": 900.0, "missing_share": 0.0}


def one(*args, **kwargs) -> dict:
    (row,) = score_case(*args, **kwargs)
    return row


def test_a_right_claim_earns_every_mark():
    band = {"tau_min_s": 5.0, "tau_max_s": 50.0, "explained_by": ["vibration_rectification"]}
    parameters = {"sensitivity": {"value": 0.48, "low": 0.4, "high": 0.6, "unit": "deg/h/g^2"}}
    found = claim("vibration_rectification", alternatives=["g_sensitivity"], intervals=[(150, 200)], parameters=parameters)
    row = one(diagnosis(found, mismatches=[band], gain=9.0), truth("vibration_rectification"))
    assert row["detected"]
    assert row["named"]
    assert row["named_exactly"]
    assert row["in_set"]
    assert row["set_size"] == 2
    assert row["wrong"] == 0
    assert row["iou"] == pytest.approx(0.5)
    assert row["tau_hit"] is True
    assert row["covered"] == [True]
    assert (row["gain"], row["oracle"]) == (9.0, 10.0)
    missing = parameters | {"sensitivity": parameters["sensitivity"] | {"low": 0.55}}
    assert one(diagnosis(claim("vibration_rectification", parameters=missing)), truth("vibration_rectification"))["covered"] == [False]
    other_unit = {"sensitivity": parameters["sensitivity"] | {"unit": "deg/h/g"}}
    assert one(diagnosis(claim("vibration_rectification", parameters=other_unit)), truth("vibration_rectification"))["covered"] == []


def test_a_name_of_the_same_set_is_named_but_not_exactly():
    row = one(diagnosis(claim("g_sensitivity")), truth("vibration_rectification"))
    assert row["named"]
    assert not row["named_exactly"]
    assert not row["in_set"]
    assert row["wrong"] == 0


def test_the_strongest_claim_is_the_one_that_names():
    row = one(diagnosis(claim("shupe", nats=8), claim("spikes", nats=30)), truth("shupe"))
    assert not row["named"]
    assert row["wrong"] == 1
    assert row["wrong_names"] == ["spikes"]


def test_each_effect_of_a_pair_is_looked_for_beside_the_other():
    rows = score_case(diagnosis(claim("spikes", nats=30), claim("shupe", nats=8)), truth("shupe", "spikes", kind="pair"))
    assert [row["named_exactly"] for row in rows] == [True, True]
    rows = score_case(diagnosis(claim("spikes")), truth("shupe", "spikes", kind="pair"))
    assert [row["named"] for row in rows] == [False, True]


def test_what_stands_beside_an_effect_is_no_false_name():
    row = one(diagnosis(claim("real_motion", nats=90), claim("misalignment")), truth("misalignment", accepted=["real_motion"]))
    assert row["wrong"] == 0
    assert row["named"]


@pytest.mark.parametrize(
    ("found", "unknown", "wrong"),
    [
        (diagnosis(verdict="unknown"), True, 0),
        (diagnosis(claim("shupe")), False, 1),
        (diagnosis(claim("shupe"), verdict="partly explained"), False, 1),
        (diagnosis(), False, 0),
    ],
)
def test_what_no_catalogue_holds_should_be_unknown(found, unknown, wrong):
    row = one(found, truth("chirped_line", kind="strange"))
    assert (row["unknown"], row["wrong"]) == (unknown, wrong)


def test_a_null_is_one_row_and_any_name_a_false_alarm():
    quiet, loud = one(diagnosis(), truth(kind="null")), one(diagnosis(claim("shupe")), truth(kind="null"))
    assert not quiet["detected"]
    assert loud["claims"] == [("shupe", False)]
    table = score_table([quiet | {"index": 1}, loud | {"index": 2}]).set_index("quantity")
    assert table.loc["false alarms: a name on a null", "value"] == 0.5


def test_a_table_of_known_marks():
    rows = []
    for i in range(20):
        found = diagnosis(claim("shupe", intervals=[(100, 200)]), gain=9.5) if i < 18 else diagnosis()
        rows += score_case(found, truth("shupe", index=i), naive={"plain Allan plot": i < 5})
    rows += [row for i in range(400) for row in score_case(diagnosis(), truth(kind="null", index=100 + i))]
    rows += [
        row for i in range(10) for row in score_case(diagnosis(verdict="unknown"), truth("chirped_line", kind="strange", index=600 + i))
    ]
    severed = truth("shupe", kind="severed", severing="withheld", index=700)
    rows += score_case(diagnosis(claim("supply_bias")), severed)
    table = score_table(rows).set_index("quantity")
    assert table.loc["false alarms: a name on a null", ["value", "n"]].tolist() == [0.0, 400]
    assert table.loc["false alarms: a name on a null", "met"] is True
    assert table.loc["detected at 1.5 times the limit and more", "value"] == pytest.approx(0.9)
    assert table.loc["detected at 1.5 times the limit and more", "met"] is False
    assert table.loc["named rightly, of those (sets merged)", "value"] == 1.0
    assert table.loc["out of the catalogue: unknown", "met"] is True
    assert table.loc["severed: wrong name", "value"] == 1.0
    assert table.loc["overlap in time (IoU), median", "value"] == 1.0
    assert table.loc["gain over the oracle's, median", "value"] == pytest.approx(0.95)
    assert table.loc["seen by the plain Allan plot, at 1.5 times the limit", "value"] == 0.25
    said = missed(score_table(rows))
    assert any(line.startswith("detected at 1.5") for line in said)
    assert not any(line.startswith("false alarms") for line in said)
    assert "| severed: wrong name | 1 |" in markdown(score_table(rows))


def test_curves_and_reliability():
    rows = []
    for strength, hits in ((0.5, 1), (1.5, 8)):
        for i in range(10):
            found = diagnosis(claim("shupe")) if i < hits else diagnosis(claim("spikes"))
            rows += score_case(found, truth("shupe", strength=strength, index=100 * round(strength * 2) + i))
    line = curves(rows).set_index(["effect", "strength"])
    assert line.loc[("shupe", 0.5), "named"] == pytest.approx(0.1)
    assert line.loc[("shupe", 1.5), "named"] == pytest.approx(0.8)
    assert line.loc[("all", 1.5), "n"] == 10
    right = reliability(rows).set_index("name")
    assert right.loc["shupe", "right"] == 1.0
    assert right.loc["spikes", ["right", "n"]].tolist() == [0.0, 11]


def test_nothing_counted_is_neither_met_nor_missed():
    table = score_table(score_case(diagnosis(), truth(kind="null")))
    empty = table[table["n"] == 0]
    assert len(empty) > 5
    assert all(value is None for value in empty["met"])
    assert missed(table.iloc[1:]) == []


@given(st.integers(0, 60), st.integers(1, 60))
def test_wilson_is_that_of_scipy(hits, total):
    hits = min(hits, total)
    expected = stats.binomtest(hits, total).proportion_ci(method="wilson")
    np.testing.assert_allclose(wilson(hits, total), (expected.low, expected.high), atol=1e-6)


@given(st.lists(st.tuples(st.integers(0, 300), st.integers(1, 60)), min_size=1, max_size=4), st.integers(-200, 200))
def test_overlap_is_that_of_seconds_counted_one_by_one(spans, shift):
    a = [(begin, begin + length) for begin, length in spans]
    b = [(begin + shift, end + shift) for begin, end in a]
    seconds = [set().union(*(range(x, y) for x, y in part)) for part in (a, b)]
    expected = len(seconds[0] & seconds[1]) / len(seconds[0] | seconds[1])
    iso = [[[moment(x), moment(y)] for x, y in part] for part in (a, b)]
    assert intersection_over_union(*iso) == pytest.approx(expected, abs=1e-9)
    assert intersection_over_union(iso[0], iso[0]) == pytest.approx(1.0)


def test_sets_are_symmetric_and_the_catalogue_is_that_of_the_contract():
    for group in AMBIGUITY:
        for name in group:
            assert group <= merged(name)
    contract = {name for group in AMBIGUITY for name in group} | {"logger_filter", "supply_bias", "held_samples", "dead_zone", "clipping"}
    assert set(CATALOGUE) <= contract


def test_what_is_no_diagnosis_is_refused():
    broken = copy.deepcopy(diagnosis())
    del broken["verdict"]
    with pytest.raises(SchemaError, match="has no 'verdict'"):
        score_case(broken, truth("shupe"))


def test_a_claim_without_a_gain_comes_last():
    bare = claim("spikes") | {"held_out_gain": None}
    row = one(diagnosis(bare, claim("shupe", nats=6.0)), truth("shupe"))
    assert row["named"]
    assert math.isfinite(row["gain"])

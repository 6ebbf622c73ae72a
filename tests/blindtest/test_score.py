"""The scorer on diagnoses made by hand, whose marks can be counted on fingers."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from gyrostab.blindtest.generator.catalogue import AMBIGUITY, CATALOGUE, merged
from gyrostab.blindtest.scoring.curves import by_effect, curves, reliability
from gyrostab.blindtest.scoring.injections import injection_differences, injection_table
from gyrostab.blindtest.scoring.proportions import Target, spread, wilson
from gyrostab.blindtest.scoring.score import intersection_over_union, score_case
from gyrostab.blindtest.scoring.table import markdown, missed, score_table
from gyrostab.errors import SchemaError


def moment(second: float) -> str:
    return str(np.datetime64("2026-05-01T00:00:00") + np.timedelta64(round(second * 1000), "ms"))


def claim(
    name: str,
    *,
    nats: float = 20.0,
    alternatives=(),
    intervals=((100, 200),),
    axes=("x",),
    parameters=None,
) -> dict:
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


def truth(
    *names: str,
    kind: str = "single",
    strength: float = 2.0,
    index: int = 0,
    accepted=(),
    severing=None,
    localised=True,
) -> dict:
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
            "learned_nats": 4.5,
            "tau_min_s": 1.0,
            "tau_max_s": 10.0,
            "localised": localised,
            "intervals": [[moment(100), moment(200)]],
            "parameters": {"sensitivity": {"values": {"x": 0.5}, "unit": "deg/h/g^2"}},
        }
        for name in names
    ]
    plan = {"index": index, "kind": kind, "severing": severing}
    return {
        "effects": effects,
        "accepted": list(accepted),
        "plan": plan,
        "sampling_rate_hz": 10.0,
        "seconds": 900.0,
        "missing_share": 0.0,
    }


def one(*args, **kwargs) -> dict:
    (row,) = score_case(*args, **kwargs)
    return row


def test_a_right_claim_earns_every_mark():
    band = {"tau_min_s": 5.0, "tau_max_s": 50.0, "explained_by": ["vibration_rectification"]}
    parameters = {
        "sensitivity": {"value": 0.48, "stderr": 0.05, "low": 0.4, "high": 0.6, "unit": "deg/h/g^2"}
    }
    found = claim(
        "vibration_rectification",
        alternatives=["g_sensitivity"],
        intervals=[(150, 200)],
        parameters=parameters,
    )
    row = one(diagnosis(found, mismatches=[band], gain=9.0), truth("vibration_rectification"))
    assert row["detected"]
    assert row["named"]
    assert row["named_exactly"]
    assert row["in_set"]
    assert row["set_size"] == 2
    assert row["wrong"] == 0
    assert row["iou"] == pytest.approx(0.5)
    assert row["tau_hit"] is True
    assert row["numbers"] == [
        {"parameter": "sensitivity", "held": True, "pull": pytest.approx(-0.4)}
    ]
    assert (row["gain"], row["oracle"], row["learned"]) == (9.0, 10.0, 4.5)
    assert row["learned_strength"] == pytest.approx(math.sqrt(4.5 / 5.7))
    missing = parameters | {"sensitivity": parameters["sensitivity"] | {"low": 0.55}}
    (number,) = one(
        diagnosis(claim("vibration_rectification", parameters=missing)),
        truth("vibration_rectification"),
    )["numbers"]
    assert number["held"] is False
    other_unit = {"sensitivity": parameters["sensitivity"] | {"unit": "deg/h/g"}}
    assert (
        one(
            diagnosis(claim("vibration_rectification", parameters=other_unit)),
            truth("vibration_rectification"),
        )["numbers"]
        == []
    )


def number(value: float, *, stderr: float = 0.1, unit: str = "deg/h") -> dict:
    return {
        "value": value,
        "stderr": stderr,
        "low": value - 2 * stderr,
        "high": value + 2 * stderr,
        "unit": unit,
    }


def test_a_name_on_three_axes_is_one_claim_with_a_number_for_each():
    told = truth("shupe")
    told["effects"][0]["parameters"] = {
        "sensitivity": {"values": {"x": 0.5, "y": -0.5, "z": 0.1}, "unit": "deg/h"}
    }
    tables = [
        claim("shupe", axes=(axis,), parameters={"sensitivity": number(size)})
        for axis, size in (("x", 0.45), ("y", -0.9), ("z", 0.1))
    ]
    row = one(diagnosis(*tables), told)
    assert row["claims"] == [("shupe", True)]
    assert [entry["held"] for entry in row["numbers"]] == [True, False, True]
    row = one(diagnosis(*tables), truth("spikes"))
    assert (row["wrong"], row["wrong_names"]) == (1, ["shupe"])


def test_numbers_by_axis_in_one_table_and_signs_that_nobody_can_know():
    told = truth("shared_source")
    told["effects"][0]["parameters"] = {"N": {"values": {"x": 0.5, "y": 0.4}, "unit": "deg/h"}}
    table = claim(
        "shared_source",
        axes=("x", "y"),
        parameters={"N.x": number(0.52), "N.y": number(-0.35), "N.z": number(9.0)},
    )
    row = one(diagnosis(table), told)
    assert [(entry["held"], round(entry["pull"], 6)) for entry in row["numbers"]] == [
        (True, 0.2),
        (True, -0.5),
    ]


def test_of_several_lines_the_nearest_is_meant():
    told = truth("spectral_line")
    told["effects"][0]["parameters"] = {
        "frequency": {"value": 3.0, "unit": "Hz"},
        "amplitude": {"values": {"x": 0.5}, "unit": "deg/h", "unless": ["quality"]},
    }
    tables = [
        claim(
            "spectral_line",
            nats=nats,
            parameters={"frequency": number(frequency, unit="Hz"), "amplitude": number(size)},
        )
        for nats, frequency, size in ((50, 7.0, 2.0), (20, 3.05, 0.5))
    ]
    assert [entry["held"] for entry in one(diagnosis(*tables), told)["numbers"]] == [True, True]
    for table in tables:
        table["parameters"]["quality"] = number(30.0, unit="1")  # a resonance has another amplitude
    assert [entry["parameter"] for entry in one(diagnosis(*tables), told)["numbers"]] == [
        "frequency"
    ]


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
    rows = score_case(
        diagnosis(claim("spikes", nats=30), claim("shupe", nats=8)),
        truth("shupe", "spikes", kind="pair"),
    )
    assert [row["named_exactly"] for row in rows] == [True, True]
    rows = score_case(diagnosis(claim("spikes")), truth("shupe", "spikes", kind="pair"))
    assert [row["named"] for row in rows] == [False, True]


def test_what_stands_beside_an_effect_is_no_false_name():
    row = one(
        diagnosis(claim("real_motion", nats=90), claim("misalignment")),
        truth("misalignment", accepted=["real_motion"]),
    )
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
    quiet, loud = (
        one(diagnosis(), truth(kind="null")),
        one(diagnosis(claim("shupe")), truth(kind="null")),
    )
    assert not quiet["detected"]
    assert loud["claims"] == [("shupe", False)]
    table = score_table([quiet | {"index": 1}, loud | {"index": 2}]).set_index("quantity")
    assert table.loc["false alarms: a name on a null", "value"] == 0.5


def test_a_table_of_known_marks():
    rows = []
    for i in range(20):
        found = (
            diagnosis(claim("shupe", intervals=[(100, 200)]), gain=9.5) if i < 18 else diagnosis()
        )
        rows += score_case(found, truth("shupe", index=i), naive={"plain Allan plot": i < 5})
    rows += [
        row
        for i in range(400)
        for row in score_case(diagnosis(), truth(kind="null", index=100 + i))
    ]
    rows += [
        row
        for i in range(10)
        for row in score_case(
            diagnosis(verdict="unknown"), truth("chirped_line", kind="strange", index=600 + i)
        )
    ]
    severed = truth("shupe", kind="severed", severing="withheld", index=700)
    rows += score_case(diagnosis(claim("supply_bias")), severed)
    table = score_table(rows).set_index("quantity")
    assert table.loc["false alarms: a name on a null", ["value", "n"]].tolist() == [0.0, 400]
    assert table.loc["false alarms: a name on a null", "state"] == "met"
    assert table.loc["detected at 1.5 times the limit and more", "value"] == pytest.approx(0.9)
    assert table.loc["detected at 1.5 times the limit and more", "state"] == "missed"
    assert table.loc["named rightly, of those (sets merged)", "value"] == 1.0
    assert table.loc["out of the catalogue: unknown", ["value", "state"]].tolist() == [
        1.0,
        "not shown",
    ]  # ten cases cannot
    assert table.loc["channel withheld or replaced: wrong name", "value"] == 1.0
    assert table.loc["overlap in time (IoU), median", "value"] == 1.0
    assert table.loc["gain over the oracle's, median", "value"] == pytest.approx(0.95)
    learned = table.loc[
        "gain over that of the truth where noise is learned from the record, median", "value"
    ]
    assert learned == pytest.approx(0.95 * 10.0 / 4.5)
    strong = table.loc[
        "detected, of those that were alone and are as strong in noise learned from the record",
        ["value", "n"],
    ]
    assert strong["n"] == 0
    louder = score_table([row | {"learned_strength": 2.0} for row in rows]).set_index("quantity")
    alone = table.loc["named rightly, of those that were alone", "n"] + sum(
        row["kind"] in ("single", "buried") and row["strength"] >= 1.5 and not row["detected"]
        for row in rows
    )
    assert (
        louder.loc[
            "detected, of those that were alone and are as strong in noise learned from the record",
            "n",
        ]
        == alone
        > 0
    )
    assert (
        table.loc["effects at 1.5 times the limit and more seen by the plain Allan plot", "value"]
        == 0.25
    )
    said = missed(score_table(rows))
    assert any(line.startswith("detected at 1.5") for line in said)
    assert not any(line.startswith("false alarms") for line in said)
    assert "| channel withheld or replaced: wrong name | 1 |" in markdown(score_table(rows))


def test_curves_and_reliability():
    rows = []
    for strength, hits in ((0.5, 1), (1.5, 8)):
        for i in range(10):
            found = diagnosis(claim("shupe")) if i < hits else diagnosis(claim("spikes"))
            rows += score_case(
                found, truth("shupe", strength=strength, index=100 * round(strength * 2) + i)
            )
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
    assert set(empty["state"]) == {"", "not shown"}
    assert all(
        (state == "") == (target == "")
        for state, target in zip(table["state"], table["target"], strict=True)
    )
    assert missed(table[table["n"] == 0]) == []


def test_every_effect_has_its_line():
    rows = []
    for i in range(4):
        found = diagnosis(claim("shupe")) if i else diagnosis(claim("spikes"))
        rows += score_case(found, truth("shupe", index=i, strength=0.5 if i == 3 else 2.0))
    table = by_effect(rows).set_index("effect")
    assert table.loc["shupe", ["n", "detected", "claims", "right", "numbers"]].tolist() == [
        3,
        1.0,
        3,
        1.0,
        0,
    ]
    assert table.loc["shupe", "named"] == pytest.approx(2 / 3)
    assert table.loc["spikes", ["n", "claims", "right"]].tolist() == [0, 1, 0.0]
    assert table.loc["spikes", "named"] is None


def test_two_thirds_of_normal_errors_are_within_one():
    line = spread(
        "errors", np.random.default_rng(0).normal(0, 1, 2000), Target("0.8-1.25", 0.8, 1.25)
    )
    assert line["value"] == pytest.approx(1.0, abs=0.06)
    assert line["state"] == "met"
    assert (
        spread("errors", [3.0, -3.0, 2.5, 2.8], Target("0.8-1.25", 0.8, 1.25))["state"] == "missed"
    )


def salted_rows(*, salted=(), untouched=(), flipped=(), turned=()) -> list[dict]:
    rows = []
    for one_copy, names in (
        ("salted", salted),
        ("untouched", untouched),
        ("flipped", flipped),
        ("reversed", turned),
    ):
        told = truth(
            *(["shupe"] if one_copy == "salted" else []),
            kind="salted" if one_copy == "salted" else "control",
        )
        told["plan"] |= {"copy": one_copy, "recording": "a gyro"}
        rows += score_case(diagnosis(*map(claim, names)), told)
    return rows


def test_of_salted_recordings_only_what_salt_brings_counts():
    (one_group,) = injection_differences(
        salted_rows(
            salted=["shupe", "spectral_line"], untouched=["spectral_line"], turned=["spikes"]
        )
    )
    assert one_group["named"]
    assert (one_group["others"], one_group["flipped"], one_group["reversed"]) == (
        [],
        [],
        ["spikes"],
    )
    (again,) = injection_differences(
        salted_rows(
            salted=["warm_up", "spikes"], untouched=["ageing_bias"], flipped=["temperature_bias"]
        )
    )
    assert again["there_before"]  # one of the set was named without salt
    assert (again["others"], again["flipped"]) == (["spikes"], [])
    table = injection_table(salted_rows(salted=["shupe"])).set_index("quantity")
    assert table.loc[
        "salt of 1.5 times the limit and more: named rightly", ["value", "n"]
    ].tolist() == [1.0, 1]
    assert injection_table([]).empty
    main = score_table(salted_rows(salted=["shupe"], untouched=["spikes"])).set_index("quantity")
    assert set(main["n"]) == {0}  # they are in no other figure


@settings(deadline=None)
@given(st.integers(0, 60), st.integers(1, 60))
def test_wilson_is_that_of_scipy(hits, total):
    hits = min(hits, total)
    expected = stats.binomtest(hits, total).proportion_ci(method="wilson")
    np.testing.assert_allclose(wilson(hits, total), (expected.low, expected.high), atol=1e-6)


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 300), st.integers(1, 60)), min_size=1, max_size=4),
    st.integers(-200, 200),
)
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
    contract = {name for group in AMBIGUITY for name in group} | {
        "logger_filter", "supply_bias", "held_samples", "dead_zone", "clipping", "spikes", "rate_quantization",
    }  # fmt: skip
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


def test_what_was_alone_what_was_named_whole_and_what_is_no_shared_source_are_counted_apart():
    number = {"value": 0.5, "stderr": 0.1, "unit": "deg/h/g^2"}
    sure, off = number | {"low": 0.3, "high": 0.7}, number | {"low": 0.1, "high": 0.3}
    alone = score_case(diagnosis(), truth("shupe", index=1))
    both = score_case(
        diagnosis(
            claim("shared_source", parameters={"sensitivity": off}),
            claim("shupe", parameters={"sensitivity": sure}),
            gain=16.0,
        ),
        truth("shared_source", "shupe", kind="pair", index=2),
    )
    half = score_case(
        diagnosis(claim("shupe"), gain=4.0), truth("shupe", "spikes", kind="pair", index=3)
    )
    table = score_table([*alone, *both, *half]).set_index("quantity")
    assert table.loc["detected at 1.5 times the limit and more", ["value", "n"]].tolist() == [
        0.8,
        5,
    ]
    assert table.loc["detected, of those that were alone", ["value", "n"]].tolist() == [0.0, 1]
    assert table.loc["95 % intervals that hold the truth", ["value", "n"]].tolist() == [0.5, 2]
    assert table.loc["of those, without the shared source", ["value", "n"]].tolist() == [1.0, 1]
    assert table.loc["gain over the oracle's, median", ["value", "n"]].tolist() == [0.5, 2]
    assert table.loc[
        "gain over the oracle's where all was named rightly, median", ["value", "n"]
    ].tolist() == [0.8, 1]

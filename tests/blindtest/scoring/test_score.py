"""Scores of hand-written diagnoses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.blindtest.generator.catalogue import AMBIGUITY, CATALOGUE, merge_ambiguous
from gyrostab.blindtest.scoring.curves import (
    by_effect,
    curves,
    fitted_noise_curve,
    names_given,
    reliability,
)
from gyrostab.blindtest.scoring.detection import injection_differences, injection_table
from gyrostab.blindtest.scoring.proportions import median, share, spread, wilson
from gyrostab.blindtest.scoring.score import intersection_over_union, score_case
from gyrostab.blindtest.scoring.table import list_missed, markdown, score_table


def moment(second: float) -> str:
    return str(np.datetime64("2026-05-01T00:00:00") + np.timedelta64(round(second * 1000), "ms"))


def identification(
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
        "probability": 0.9,
        "statement": "",
    }


def diagnosis(
    *identifications: dict, verdict: str | None = None, mismatches=(), gain: float = 0.0
) -> dict:
    return {
        "verdict": verdict or ("explained" if identifications else "no mismatch"),
        "mismatches": list(mismatches),
        "effects": list(identifications),
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
    degradation=None,
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
    plan = {"index": index, "kind": kind, "degradation": degradation}
    return {
        "effects": effects,
        "accepted": list(accepted),
        "plan": plan,
        "sampling_rate_hz": 10.0,
        "seconds": 900.0,
        "missing_share": 0.0,
    }


def score_one(*args, **kwargs) -> dict:
    (row,) = score_case(*args, **kwargs)
    return row


def test_correct_identification_scores_in_every_column():
    band = {"tau_min_s": 5.0, "tau_max_s": 50.0, "explained_by": ["vibration_rectification"]}
    parameters = {
        "sensitivity": {"value": 0.48, "stderr": 0.05, "low": 0.4, "high": 0.6, "unit": "deg/h/g^2"}
    }
    named = identification(
        "vibration_rectification",
        alternatives=["g_sensitivity"],
        intervals=[(150, 200)],
        parameters=parameters,
    )
    row = score_one(diagnosis(named, mismatches=[band], gain=9.0), truth("vibration_rectification"))
    assert row["detected"]
    assert row["named"]
    assert row["named_exactly"]
    assert row["in_set"]
    assert row["set_size"] == 2
    assert row["wrong"] == 0
    assert row["iou"] == pytest.approx(0.5)
    assert row["tau_hit"] is True
    assert row["parameter_scores"] == [
        {"parameter": "sensitivity", "covered": True, "pull": pytest.approx(-0.4)}
    ]
    assert (row["gain"], row["oracle"], row["learned"]) == (9.0, 10.0, 4.5)
    assert row["learned_strength"] == pytest.approx(math.sqrt(4.5 / 5.7))
    missing = parameters | {"sensitivity": parameters["sensitivity"] | {"low": 0.55}}
    (number,) = score_one(
        diagnosis(identification("vibration_rectification", parameters=missing)),
        truth("vibration_rectification"),
    )["parameter_scores"]
    assert number["covered"] is False
    other_unit = {"sensitivity": parameters["sensitivity"] | {"unit": "deg/h/g"}}
    assert (
        score_one(
            diagnosis(identification("vibration_rectification", parameters=other_unit)),
            truth("vibration_rectification"),
        )["parameter_scores"]
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


def test_name_on_three_axes_counts_once_with_a_parameter_for_each():
    known_truth = truth("shupe")
    known_truth["effects"][0]["parameters"] = {
        "sensitivity": {"values": {"x": 0.5, "y": -0.5, "z": 0.1}, "unit": "deg/h"}
    }
    tables = [
        identification("shupe", axes=(axis,), parameters={"sensitivity": number(size)})
        for axis, size in (("x", 0.45), ("y", -0.9), ("z", 0.1))
    ]
    row = score_one(diagnosis(*tables), known_truth)
    assert row["identifications"] == [
        {"name": "shupe", "probability": 0.9, "right": True, "exact": True}
    ]
    assert [entry["covered"] for entry in row["parameter_scores"]] == [True, False, True]
    row = score_one(diagnosis(*tables), truth("spikes"))
    assert (row["wrong"], row["wrong_names"]) == (1, ["shupe"])


def test_parameters_by_axis_are_compared_without_arbitrary_signs():
    known_truth = truth("shared_source")
    known_truth["effects"][0]["parameters"] = {
        "N": {"values": {"x": 0.5, "y": 0.4}, "unit": "deg/h"}
    }
    table = identification(
        "shared_source",
        axes=("x", "y"),
        parameters={"N.x": number(0.52), "N.y": number(-0.35), "N.z": number(9.0)},
    )
    row = score_one(diagnosis(table), known_truth)
    assert [(entry["covered"], round(entry["pull"], 6)) for entry in row["parameter_scores"]] == [
        (True, 0.2),
        (True, -0.5),
    ]


def test_nearest_of_several_lines_is_compared():
    known_truth = truth("spectral_line")
    known_truth["effects"][0]["parameters"] = {
        "frequency": {"value": 3.0, "unit": "Hz"},
        "amplitude": {"values": {"x": 0.5}, "unit": "deg/h", "unless": ["quality"]},
    }
    tables = [
        identification(
            "spectral_line",
            nats=nats,
            parameters={"frequency": number(frequency, unit="Hz"), "amplitude": number(size)},
        )
        for nats, frequency, size in ((50, 7.0, 2.0), (20, 3.05, 0.5))
    ]
    assert [
        entry["covered"] for entry in score_one(diagnosis(*tables), known_truth)["parameter_scores"]
    ] == [
        True,
        True,
    ]
    for table in tables:
        table["parameters"]["quality"] = number(
            30.0, unit="1"
        )  # the amplitude of a resonance is another quantity
    assert [
        entry["parameter"]
        for entry in score_one(diagnosis(*tables), known_truth)["parameter_scores"]
    ] == ["frequency"]


def test_name_of_the_same_set_is_named_but_not_exactly():
    row = score_one(diagnosis(identification("g_sensitivity")), truth("vibration_rectification"))
    assert row["named"]
    assert not row["named_exactly"]
    assert not row["in_set"]
    assert row["wrong"] == 0


def test_strongest_identification_decides_the_name():
    row = score_one(
        diagnosis(identification("shupe", nats=8), identification("spikes", nats=30)),
        truth("shupe"),
    )
    assert not row["named"]
    assert row["wrong"] == 1
    assert row["wrong_names"] == ["spikes"]


def test_each_effect_of_a_pair_is_scored_separately():
    rows = score_case(
        diagnosis(identification("spikes", nats=30), identification("shupe", nats=8)),
        truth("shupe", "spikes", kind="pair"),
    )
    assert [row["named_exactly"] for row in rows] == [True, True]
    rows = score_case(diagnosis(identification("spikes")), truth("shupe", "spikes", kind="pair"))
    assert [row["named"] for row in rows] == [False, True]


@pytest.mark.parametrize(
    ("names", "true", "named", "wrong_names"),
    [
        (["temperature_bias"], ["temperature_bias", "shupe"], [True, False], []),
        (["warm_up"], ["temperature_bias", "shupe"], [True, False], []),
        (["shupe", "warm_up"], ["temperature_bias", "shupe"], [True, True], []),
        (["real_motion", "scale_factor"], ["misalignment", "shared_source"], [True, True], []),
        (
            ["temperature_bias", "warm_up", "shupe"],
            ["temperature_bias"],
            [True],
            ["warm_up", "shupe"],
        ),
        (["warm_up", "temperature_bias"], ["temperature_bias"], [False], ["warm_up"]),
        (["warm_up", "ageing_bias"], ["temperature_bias"], [True], ["ageing_bias"]),
    ],
)
def test_each_name_counts_for_one_effect(names, true, named, wrong_names):
    answer = diagnosis(
        *(identification(name, nats=30.0 - place) for place, name in enumerate(names))
    )
    rows = score_case(answer, truth(*true, kind="pair"))
    assert [row["named"] for row in rows] == named
    assert rows[0]["wrong_names"] == wrong_names
    right = [entry["name"] for entry in rows[0]["identifications"] if entry["right"]]
    assert sorted([*right, *wrong_names]) == sorted(names)


def test_alternatives_make_no_name_right():
    row = score_one(
        diagnosis(identification("earth_rate", alternatives=["feedback_reset"])),
        truth("feedback_reset"),
    )
    assert (row["named"], row["wrong_names"], row["in_set"]) == (False, ["earth_rate"], True)
    assert [entry["right"] for entry in row["identifications"]] == [False]


def test_accepted_name_in_addition_is_not_wrong():
    row = score_one(
        diagnosis(identification("real_motion", nats=90), identification("misalignment")),
        truth("misalignment", accepted=["real_motion"]),
    )
    assert row["wrong"] == 0
    assert row["named"]


def test_an_accepted_name_of_an_effect_out_of_catalogue_is_no_miss():
    three_levels = truth("three_levels", kind="out_of_catalogue", accepted=["telegraph"])
    row = score_one(diagnosis(identification("telegraph")), three_levels)
    assert (row["unidentified"], row["wrong"]) == (True, 0)


@pytest.mark.parametrize(
    ("answer", "unknown", "wrong"),
    [
        (diagnosis(verdict="unknown"), True, 0),
        (diagnosis(identification("shupe")), False, 1),
        (diagnosis(identification("shupe"), verdict="partly explained"), False, 1),
        (diagnosis(), False, 0),
    ],
)
def test_effect_out_of_catalogue_should_be_unidentified(answer, unknown, wrong):
    row = score_one(answer, truth("chirped_line", kind="out_of_catalogue"))
    assert (row["unidentified"], row["wrong"]) == (unknown, wrong)


def test_null_record_is_one_row_and_any_name_a_false_alarm():
    silent, alarm = (
        score_one(diagnosis(), truth(kind="null")),
        score_one(diagnosis(identification("shupe")), truth(kind="null")),
    )
    assert not silent["detected"]
    assert [entry["right"] for entry in alarm["identifications"]] == [False]
    table = score_table([silent | {"index": 1}, alarm | {"index": 2}]).set_index("quantity")
    assert table.loc["false alarms: effect named on a null record", "value"] == 0.5


def test_table_of_known_scores():
    rows = []
    for i in range(20):
        answer = (
            diagnosis(identification("shupe", intervals=[(100, 200)]), gain=9.5)
            if i < 18
            else diagnosis()
        )
        rows += score_case(
            answer, truth("shupe", index=i), baseline_scores={"plain Allan plot": i < 5}
        )
    rows += [
        row
        for i in range(400)
        for row in score_case(diagnosis(), truth(kind="null", index=100 + i))
    ]
    rows += [
        row
        for i in range(10)
        for row in score_case(
            diagnosis(verdict="unknown"),
            truth("chirped_line", kind="out_of_catalogue", index=600 + i),
        )
    ]
    withheld = truth("shupe", kind="degraded_driver", degradation="withheld", index=700)
    rows += score_case(diagnosis(identification("supply_bias")), withheld)
    withheld = truth("shupe", kind="degraded_driver", degradation="withheld", index=701)
    rows += score_case(diagnosis(identification("telegraph") | {"probability": 0.4}), withheld)
    table = score_table(rows).set_index("quantity")
    assert table.loc["false alarms: effect named on a null record", ["value", "n"]].tolist() == [
        0.0,
        400,
    ]
    assert table.loc["false alarms: effect named on a null record", "state"] == "met"
    assert table.loc["detected, strength 1.5 or more", "value"] == pytest.approx(0.9)
    assert table.loc["detected, strength 1.5 or more", "state"] == "missed"
    assert table.loc["named correctly, of the detected (sets merged)", "value"] == 1.0
    assert table.loc["out of catalogue: unidentified", ["value", "state"]].tolist() == [
        1.0,
        "not shown",
    ]  # too few cases
    assert table.loc["driver withheld or substituted: wrong name", "value"] == 1.0
    confident = "driver withheld or substituted: wrong name with a probability of 0.5 or more"
    assert table.loc[confident, "value"] == 0.5
    assert table.loc["overlap in time (IoU), median", "value"] == 1.0
    assert table.loc["evidence relative to the oracle, median", "value"] == pytest.approx(0.95)
    learned = table.loc["evidence relative to the oracle with fitted noise, median", "value"]
    assert learned == pytest.approx(0.95 * 10.0 / 4.5)
    strong = table.loc[
        "detected, single effects of that strength with fitted noise",
        ["value", "n"],
    ]
    assert strong["n"] == 0
    stronger = score_table([row | {"learned_strength": 2.0} for row in rows]).set_index("quantity")
    single = table.loc["named correctly, single effects", "n"] + sum(
        row["kind"] in ("single", "sub_threshold")
        and row["strength"] >= 1.5
        and not row["detected"]
        for row in rows
    )
    assert (
        stronger.loc[
            "detected, single effects of that strength with fitted noise",
            "n",
        ]
        == single
        > 0
    )
    assert table.loc["detected by the plain Allan plot, strength 1.5 or more", "value"] == 0.25
    sentences = list_missed(score_table(rows))
    assert any(line.startswith("detected, strength 1.5") for line in sentences)
    assert not any(line.startswith("false alarms") for line in sentences)
    assert "| driver withheld or substituted: wrong name | 1 |" in markdown(score_table(rows))


def test_models_of_named_cases_are_counted_once():
    checks = [{"runs": True, "nats": 3.0}, {"runs": True, "nats": -1.0}, {"runs": False}, None]
    rows = [
        row
        for i, check in enumerate(checks)
        for row in score_case(
            diagnosis(identification("shupe")) | {"model_check": check}, truth("shupe", index=i)
        )
    ]
    table = score_table([*rows, rows[0]]).set_index("quantity")
    runs = table.loc["models that can be simulated, of those with an effect"]
    nearer = table.loc["simulated records nearer to the recording with the effects, without refit"]
    assert (runs["value"], runs["n"]) == (pytest.approx(2 / 3), 3)
    assert (nearer["value"], nearer["n"]) == (pytest.approx(1 / 3), 3)
    assert nearer["target"] == ">= 95 %"


def test_curves_and_reliability():
    rows = []
    for strength, hits in ((0.5, 1), (1.5, 8)):
        for i in range(10):
            answer = (
                diagnosis(identification("shupe"))
                if i < hits
                else diagnosis(identification("spikes"))
            )
            rows += score_case(
                answer, truth("shupe", strength=strength, index=100 * round(strength * 2) + i)
            )
    line = curves(rows).set_index(["effect", "strength"])
    assert line.loc[("shupe", 0.5), "named"] == pytest.approx(0.1)
    assert line.loc[("shupe", 1.5), "named"] == pytest.approx(0.8)
    assert line.loc[("all", 1.5), "n"] == 10
    right = reliability(rows).set_index("name")
    assert right.loc["shupe", "right"] == 1.0
    assert right.loc["spikes", ["right", "n"]].tolist() == [0.0, 11]


def test_completeness_against_strength_in_fitted_noise():
    rows = []
    for i, (strength, name) in enumerate(((0.4, "spikes"), (2.0, "shupe"), (2.9, "spikes"))):
        rows += score_case(diagnosis(identification(name)), truth("shupe", index=i))
        rows[-1]["learned_strength"] = strength
    line = fitted_noise_curve(rows).set_index("strength")
    assert line["n"].to_dict() == {"0 to 0.5": 1, "2 to 3": 2}
    assert line["named"].tolist() == [0.0, 0.5]
    assert line["detected"].tolist() == [1.0, 1.0]
    assert line.loc["2 to 3", "named_high"] > 0.9
    assert fitted_noise_curve([]).empty


def test_an_effect_out_of_catalogue_counts_as_named_when_left_unidentified():
    rows = []
    for i, answer in enumerate((diagnosis(verdict="unknown"), diagnosis(identification("shupe")))):
        rows += score_case(
            answer,
            truth("flicker_step", kind="out_of_catalogue", strength=3.0, index=900 + i),
        )
    line = curves(rows).set_index(["effect", "strength"])
    assert line.loc[("flicker_step", 3.0), ["detected", "named", "n"]].tolist() == [1.0, 0.5, 2]
    assert ("all", 3.0) not in line.index


def test_target_without_cases_is_neither_met_nor_missed():
    table = score_table(score_case(diagnosis(), truth(kind="null")))
    empty = table[table["n"] == 0]
    assert len(empty) > 5
    assert set(empty["state"]) == {"", "not shown"}
    assert all(
        (state == "") == (target == "")
        for state, target in zip(table["state"], table["target"], strict=True)
    )
    assert list_missed(table[table["n"] == 0]) == []


def test_by_effect_has_a_line_for_every_effect():
    rows = []
    for i in range(4):
        answer = diagnosis(identification("shupe")) if i else diagnosis(identification("spikes"))
        rows += score_case(answer, truth("shupe", index=i, strength=0.5 if i == 3 else 2.0))
    table = by_effect(rows).set_index("effect")
    assert table.loc[
        "shupe", ["n", "detected", "identifications", "right", "parameters"]
    ].tolist() == [
        3,
        1.0,
        3,
        1.0,
        0,
    ]
    assert table.loc["shupe", "named"] == pytest.approx(2 / 3)
    assert table.loc["spikes", ["n", "identifications", "right"]].tolist() == [0, 1, 0.0]
    assert table.loc["spikes", "named"] is None


def test_a_pair_counts_if_both_of_its_strong_effects_are_named():
    rows = []
    named = (("shupe", "spikes"), ("shupe",), ("shupe",))
    for number, (names, strength) in enumerate(zip(named, (3.0, 3.0, 2.0), strict=True)):
        pair = truth("shupe", "spikes", index=number, kind="pair")
        answer = diagnosis(*map(identification, names))
        rows += [row | {"learned_strength": strength} for row in score_case(answer, pair)]
    table = score_table(rows).set_index("quantity")
    pairs = table.loc["both effects of a pair named correctly, each of that strength"]
    assert (pairs["value"], pairs["n"]) == (0.5, 2)
    assert table.loc["detected, 3 times the limit in fitted noise or more", "n"] == 4
    assert table.loc["named correctly, 3 times the limit in fitted noise or more", "value"] == 0.75


def test_names_given_to_a_single_effect_are_counted():
    answers = [
        diagnosis(identification("shupe")),
        diagnosis(identification("warm_up", nats=30.0), identification("shupe")),
        diagnosis(verdict="unknown"),
        diagnosis(),
    ]
    rows = [
        row
        for number, answer in enumerate(answers)
        for row in score_case(answer, truth("shupe", index=number))
    ]
    (line,) = names_given([*rows, *score_case(answers[0], truth(kind="null"))]).to_dict("records")
    assert line == {
        "effect": "shupe",
        "n": 4,
        "itself": 1,
        "other names": "warm_up 1",
        "unidentified": 1,
        "nothing": 1,
    }


def test_68_percent_of_normal_errors_are_within_one_sigma():
    target = "0.8-1.25"

    def errors(values) -> list[dict]:
        return [{"index": place, "pull": value} for place, value in enumerate(values)]

    line = spread("errors", errors(np.random.default_rng(0).normal(0, 1, 2000)), "pull", target)
    assert line["value"] == pytest.approx(1.0, abs=0.06)
    assert line["state"] == "met"
    assert spread("errors", errors([3.0, -3.0, 2.5, 2.8]), "pull", target)["state"] == "missed"


def injection_rows(*, injected=(), untouched=(), flipped=(), turned=()) -> list[dict]:
    rows = []
    for copy_name, names in (
        ("injected", injected),
        ("untouched", untouched),
        ("flipped", flipped),
        ("reversed", turned),
    ):
        known_truth = truth(
            *(["shupe"] if copy_name == "injected" else []),
            kind="injected" if copy_name == "injected" else "control",
        )
        known_truth["plan"] |= {"copy": copy_name, "recording": "a gyro"}
        rows += score_case(diagnosis(*map(identification, names)), known_truth)
    return rows


def test_only_names_added_by_an_injection_count():
    (one_group,) = injection_differences(
        injection_rows(
            injected=["shupe", "spectral_line"], untouched=["spectral_line"], turned=["spikes"]
        )
    )
    assert one_group["named"]
    assert (one_group["others"], one_group["flipped"], one_group["reversed"]) == (
        [],
        [],
        ["spikes"],
    )
    (difference,) = injection_differences(
        injection_rows(
            injected=["warm_up", "spikes"], untouched=["ageing_bias"], flipped=["temperature_bias"]
        )
    )
    assert difference["there_before"]  # a name of its set was found without the injection
    assert (difference["others"], difference["flipped"]) == (["spikes"], [])
    table = injection_table(injection_rows(injected=["shupe"])).set_index("quantity")
    assert table.loc[
        "injections of strength 1.5 or more: named correctly", ["value", "n"]
    ].tolist() == [1.0, 1]
    assert (
        table.loc["injections of 5 times the limit in fitted noise or more: named correctly", "n"]
        == 0
    )  # its 4.5 nats in fitted noise are below the limit
    strong = [
        row | ({"learned_strength": 4.996} if row["copy"] == "injected" else {})
        for row in injection_rows(injected=["shupe"])
    ]
    assert injection_differences(strong)[0]["learned_strength"] == 4.996
    assert injection_table(strong).set_index("quantity").loc[
        "injections of 5 times the limit in fitted noise or more: named correctly", ["value", "n"]
    ].tolist() == [1.0, 1]  # drawn at 5, to 0.1 %
    assert injection_table([]).empty
    main = score_table(injection_rows(injected=["shupe"], untouched=["spikes"])).set_index(
        "quantity"
    )
    assert set(main["n"]) == {0}  # excluded from all other figures


def test_failed_diagnosis_counts_against_detection_only():
    truths = [truth(kind="null"), truth("shupe", index=1)]
    truths += [
        truth("shupe", kind="degraded_driver", degradation=how, index=index)
        for index, how in ((2, "withheld"), (3, "noisy"))
    ]
    rows = [row for known in truths for row in score_case(diagnosis(), known)]
    table = score_table([row | {"failed": True} for row in rows]).set_index("quantity")
    assert table.loc["failed diagnoses", ["value", "n"]].tolist() == [1.0, 4]
    assert table.loc["detected, strength 1.5 or more", ["value", "n"]].tolist() == [0.0, 1]
    absent = table.filter(regex="wrong name|false alarms: |any mismatch", axis=0)
    assert len(absent) == 7
    assert set(absent["n"]) == {0}
    copies = injection_rows(injected=["shupe"])
    for failed, others in (("injected", 0), ("flipped", 0), (None, 1)):
        lines = injection_table([row | {"failed": row["copy"] == failed} for row in copies])
        if len(lines):
            lines = lines.set_index("quantity")["n"]
            assert lines["injection adds another name"] == others
            assert lines["injections of strength 1.5 or more: named correctly"] == 1


@pytest.mark.parametrize(
    "read", [lambda rows: share("", rows, "flag"), lambda rows: median("", rows, "size")]
)
def test_rows_of_one_record_do_not_narrow_an_interval(read):
    rng = np.random.default_rng(0)
    records = [
        {"index": place, "flag": size > 0.8, "size": size}
        for place, size in enumerate(rng.normal(0.0, 1.0, 80))
    ]
    single, repeated = read(records), read(records * 5)
    assert repeated["value"] == pytest.approx(single["value"])
    width, alone = repeated["high"] - repeated["low"], single["high"] - single["low"]
    assert width == pytest.approx(alone, rel=0.15)


def test_share_of_repeated_rows_without_a_flag_has_the_interval_of_the_records():
    rows = [{"index": place // 5, "flag": False} for place in range(100)]
    line = share("", rows, "flag")
    assert (line["n"], line["low"], line["high"]) == (100, *wilson(0, 20))


def test_share_near_its_end_has_no_narrower_interval_than_independent_rows():
    rows = [{"index": min(place, 149), "flag": place not in (3, 30)} for place in range(200)]
    line = share("", rows, "flag")
    low, high = wilson(198, 200)
    assert (line["value"], line["high"]) == (0.99, 1.0)
    assert high < 1.0
    assert line["low"] == pytest.approx(low)


@given(
    st.lists(st.tuples(st.integers(0, 300), st.integers(1, 60)), min_size=1, max_size=4),
    st.integers(-200, 200),
)
def test_overlap_matches_counted_seconds(spans, shift):
    a = [(begin, begin + length) for begin, length in spans]
    b = [(begin + shift, end + shift) for begin, end in a]
    seconds = [set().union(*(range(x, y) for x, y in part)) for part in (a, b)]
    expected = len(seconds[0] & seconds[1]) / len(seconds[0] | seconds[1])
    iso = [[[moment(x), moment(y)] for x, y in part] for part in (a, b)]
    assert intersection_over_union(*iso) == pytest.approx(expected, abs=1e-9)
    assert intersection_over_union(iso[0], iso[0]) == pytest.approx(1.0)


def test_ambiguity_sets_are_symmetric_and_cover_the_catalogue():
    for group in AMBIGUITY:
        for name in group:
            assert group <= merge_ambiguous(name)
    contract = {name for group in AMBIGUITY for name in group} | {
        "logger_filter",
        "supply_bias",
        "held_samples",
        "dead_zone",
        "clipping",
        "spikes",
        "rate_quantization",
    }
    assert set(CATALOGUE) <= contract


def test_identification_without_evidence_comes_last():
    bare = identification("spikes") | {"held_out_gain": None}
    row = score_one(diagnosis(bare, identification("shupe", nats=6.0)), truth("shupe"))
    assert row["named"]
    assert math.isfinite(row["gain"])


def test_single_effects_and_shared_source_have_separate_lines():
    number = {"value": 0.5, "stderr": 0.1, "unit": "deg/h/g^2"}
    sure, off = number | {"low": 0.3, "high": 0.7}, number | {"low": 0.1, "high": 0.3}
    single = score_case(diagnosis(), truth("shupe", index=1))
    pair = score_case(
        diagnosis(
            identification("shared_source", parameters={"sensitivity": off}),
            identification("shupe", parameters={"sensitivity": sure}),
            gain=16.0,
        ),
        truth("shared_source", "shupe", kind="pair", index=2),
    )
    half = score_case(
        diagnosis(identification("shupe"), gain=4.0), truth("shupe", "spikes", kind="pair", index=3)
    )
    rows = [*single, *pair, *half]
    table = score_table(rows).set_index("quantity")
    assert table.loc["detected, strength 1.5 or more", ["value", "n"]].tolist() == [
        0.8,
        5,
    ]
    assert table.loc["detected, single effects", ["value", "n"]].tolist() == [0.0, 1]
    assert table.loc["95 % intervals that contain the truth", ["value", "n"]].tolist() == [0.5, 2]
    assert table.loc["of those, without shared_source", ["value", "n"]].tolist() == [1.0, 1]
    assert table.loc["evidence relative to the oracle, median", ["value", "n"]].tolist() == [0.5, 2]
    assert table.loc[
        "evidence relative to the oracle, all effects named correctly, median", ["value", "n"]
    ].tolist() == [0.8, 1]
    assert score_table(rows[::-1]).set_index("quantity").loc[
        "evidence relative to the oracle, median", ["value", "n"]
    ].tolist() == [0.5, 2]  # whichever effect of a pair comes first

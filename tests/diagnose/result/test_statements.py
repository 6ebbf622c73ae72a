"""Sentences of a diagnosis state what the record determines, and once."""

from __future__ import annotations

import copy
import re
from typing import Any

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.predict.channel_use import unused_channels
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.diagnosis import Diagnosis
from gyrostab.diagnose.result.record_text import summary
from gyrostab.diagnose.result.tables import effect_tables
from gyrostab.diagnose.statistics.mismatch_wording import COARSE_ANGLE_GRID
from gyrostab.ingest.make_log import make_log
from gyrostab.physics.registry import make_effect
from tests.support.diagnosed import content, model, surfaces
from tests.support.named import name_effects, nulls
from tests.support.repetitions import first_of

RATE = 50.0


def shaken_blocks(seed: int, *, band_hz: tuple[float, float] | None) -> xr.Dataset:
    """Make two axes of white noise, with the same white noise added to both in vibration of 5 g."""
    rng = np.random.default_rng(seed)
    size = round(RATE * 1200)
    vibration = 5.0 * ((np.arange(size) // round(RATE * 100)) % 3 == 1)
    rates = rng.standard_normal((2, size)) + np.outer(
        [0.4, 0.3], vibration * rng.standard_normal(size)
    )
    log = make_log(rates, rate=RATE, unit="deg/h", channels={"vibration": (vibration, "g")})
    if band_hz:
        log["vibration"].attrs["band_hz"] = band_hz
    return reduce_log(log, block="20s")


@pytest.mark.full
@pytest.mark.parametrize("seed", first_of(1, 2, 3))
@pytest.mark.parametrize("band_hz", [None, (600.0, 725.0)])
def test_only_known_frequencies_of_aliased_vibration_are_stated(
    seed: int, band_hz: tuple[float, float] | None
) -> None:
    blocks = shaken_blocks(seed, band_hz=band_hz)
    baseline, records = nulls(blocks, 10)
    identifications = name_effects(blocks, baseline, records)
    (table,) = effect_tables(fit_identifications(identifications, baseline), blocks)
    assert table["name"] == "aliased_vibration"
    if band_hz:
        assert "Vibration at 600 to 725 Hz folds" in table["statement"]
        return
    assert not re.search("[78]00", table["statement"])
    ((low, high, x, y),) = re.findall(
        r"noise at (\S+) to (\S+) Hz of (\S+) and (\S+) deg/h/g", table["statement"]
    )
    assert (float(low), float(high)) == (0.0, RATE / 2.0)
    assert [float(x), float(y)] == pytest.approx([0.4, 0.3], rel=0.05)


def make_content(**changes: Any) -> dict[str, Any]:
    """Return a diagnosis made by hand with three axes of equal noise."""
    made = copy.deepcopy(content())
    terms = next(iter(made["baseline"]["noise"].values()))
    for symbol, value in (("N", 0.05), ("B", 0.1), ("K", 0.4)):
        terms[symbol] = {"value": value, "stderr": 0.2 * value, "unit": terms[symbol]["unit"]}
    made["baseline"]["noise"] = {axis: copy.deepcopy(terms) for axis in "xyz"}
    return made | changes


@pytest.mark.parametrize(("factor", "is_stated"), [(1.5, False), (1.9, False), (7.0, True)])
@pytest.mark.parametrize("symbol", ["B", "K"])
def test_axis_with_more_slow_noise_than_the_others_is_stated(
    symbol: str, factor: float, is_stated: bool
) -> None:
    made = make_content()
    made["baseline"]["noise"]["x"][symbol]["value"] *= factor
    text = str(Diagnosis(made, surfaces(), model()))
    assert "noise calibrated on " in text
    assert "\n  y: N 0.05 ± 0.01 deg/sqrt(h), B 0.1 ± 0.02 deg/h, K 0.4 ± 0.08 deg/h^1.5" in text
    sentence = f"{symbol} of x is at least 7 times that of y and z: a wandering bias on x"
    assert (sentence in text) is is_stated
    assert ("times that of" in text) is is_stated


def test_undetermined_slow_noise_is_not_compared() -> None:
    made = make_content()
    for symbol, stderr in (("B", None), ("K", 1.0)):
        made["baseline"]["noise"]["x"][symbol] |= {"value": 2.0, "stderr": stderr}
    assert "times that of" not in str(Diagnosis(made, surfaces(), model()))


def test_noise_of_a_given_model_is_not_listed() -> None:
    made = make_content()
    made["baseline"]["source"] = "model"
    assert "noise calibrated" not in str(Diagnosis(made, surfaces(), model()))


def test_effect_on_several_axes_has_its_evidence_once() -> None:
    made = make_content()
    effect = made["effects"][0] | {"alternatives": [], "family": None, "probability": 0.9}
    made["effects"] = [
        effect | {"axes": [axis], "statement": f"It drifts on axis {axis} by {size} deg/h. Tail."}
        for axis, size in (("x", 1), ("y", 2), ("z", 3))
    ]
    text = str(Diagnosis(made, surfaces(), model()))
    assert text.count("evidence: ") == text.count("Tail.") == text.count("- vibration_noise") == 1
    assert "  It drifts on axis y by 2 deg/h.\n  It drifts on axis z by 3 deg/h.\n  Tail." in text
    for effect in made["effects"]:
        effect["statement"] = f"It drifts on axis {effect['axes'][0]} by 1 deg/h. Tail."
    assert "It drifts on axes x, y and z by 1 deg/h. Tail." in str(
        Diagnosis(made, surfaces(), model())
    )
    made["effects"][1]["held_out_gain"] = effect["held_out_gain"] | {"nats": 7.0}
    assert str(Diagnosis(made, surfaces(), model())).count("evidence: ") == 2


def test_summary_names_the_alternative_of_a_doubtful_name() -> None:
    made = make_content()
    made["effects"][0] |= {"alternatives": ["aliased_vibration"], "probability": 0.1}
    assert (
        "It may instead be vibration aliased by the sampling: the probability of noise that rises "
        "with vibration is only 10 %." in summary(made)
    )


def test_coarse_grid_of_angles_is_stated_beside_what_is_not_explained() -> None:
    made = make_content(unexplained=[])
    made["not_found"] = {
        "rate_quantization": {"upper_limit": None, "unit": None, "reason": COARSE_ANGLE_GRID}
    }
    assert "angle counter" not in str(Diagnosis(made, surfaces(), model()))
    made["unexplained"] = [1]
    assert "angle counter" in str(Diagnosis(made, surfaces(), model()))


@pytest.mark.slow
@pytest.mark.parametrize("seed", first_of(1, 2))
def test_coarse_angle_counter_is_recognised(seed: int) -> None:
    """Two values of the log: the counter advances by a step in some samples only."""
    rng = np.random.default_rng(seed)
    angle = np.cumsum(0.3 + 0.05 * rng.standard_normal((1, 18_000)), axis=1)
    rates = np.diff(np.floor(angle), axis=1)
    blocks = reduce_log(make_log(rates, rate=RATE, unit="deg/h"))
    baseline, records = nulls(blocks, 10)
    assert (
        name_effects(blocks, baseline, records).examination.reasons["rate_quantization"]
        == COARSE_ANGLE_GRID
    )


def test_tool_face_is_said_to_come_from_the_rotation_rate() -> None:
    time = np.arange(24_000) / RATE
    log = make_log(
        np.random.default_rng(1).standard_normal((1, time.size)),
        rate=RATE,
        unit="deg/h",
        channels={"toolface": (np.sin(time / 300.0), "rad")},
    )
    ((channel),) = unused_channels(reduce_log(log, block="20s"), set())
    assert channel["name"] == "toolface"
    assert "take it from the channel rotation_rate" in channel["reason"]


def test_exact_size_has_no_error() -> None:
    effect = make_effect({"name": "logger_filter", "length": 0.08, "instrument": 1})
    assert "average over 0.08 s;" in effect.say({"length": 0.0})

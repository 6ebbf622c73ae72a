"""Effects with several components in one row, such as two jumps on an axis."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.identify.components import renew_component, split_layers
from gyrostab.diagnose.identify.selections import Selection, with_axes_of
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.simulate import simulate
from tests.support import named
from tests.support.named import name_effects

VARIANT = Variant({}, ("size",), np.ones((1, 1, 3)))


def component(evidence_nats, *, row="x", reference=""):
    return Component(
        Candidate(
            "misalignment", find_statistic("transfer"), (), (VARIANT,), reference=(reference,)
        ),
        VARIANT,
        (row,),
        evidence_nats,
    )


def test_repeated_rows_form_new_layers():
    components = [
        component(9.0),
        component(8.0, row="y"),
        component(7.0),
        component(6.0, reference="seismometer"),
        component(5.0),
    ]
    assert [
        [component.evidence_nats for component in layer] for layer in split_layers(components)
    ] == [
        [9.0, 8.0, 6.0],
        [7.0],
        [5.0],
    ]


def test_evidence_is_kept_apart_by_reference_channel():
    components = [component(40.0, reference="z"), component(9.0, reference="seismometer")]
    assert [
        renew_component(component(1.0, reference=name), components).evidence_nats
        for name in ("z", "seismometer", "y")
    ] == [
        40.0,
        9.0,
        1.0,
    ]


def test_identification_keeps_axes_that_still_show_it():
    components = (component(9.0), component(8.0, row="y"))
    identification = Selection("misalignment", (), ("x", "y"), components, 15.5, 8.0)
    key = components[0].candidate.key
    assert with_axes_of(
        identification, {key: [component(9.0), component(1.0, row="y")]}, DEFAULTS
    ).axes == ("x",)
    assert (
        with_axes_of(
            identification, {key: [component(9.0), component(1.0, row="y")]}, DEFAULTS
        ).components
        == components[:1]
    )
    for others in ({key: [component(3.0), component(4.0, row="y")]}, {}):  # NaN is not equal to NaN
        assert repr(with_axes_of(identification, others, DEFAULTS)) == repr(identification)


@pytest.mark.full
def test_two_opposite_jumps_have_evidence_only_together():
    jumps = [
        {"name": "bias_jump", "step": [step], "at": at, "axes": ["x"]}
        for step, at in ((0.3, 600.0), (-0.3, 1300.0))
    ]
    model = {"log": {"axes": ["x"]}, "noise": {"N": 0.003, "K": 0.005}, "effect": jumps}
    blocks = reduce_log(simulate(model, duration="30min", rate=10.0, seed=4).compute())
    baseline = calibrate_noise(blocks)
    # the threshold of fewer null records may exceed what each jump alone explains
    nulls = list(null_records(blocks, baseline, count=400, rng=np.random.default_rng(1), chunk=40))
    (identification,) = name_effects(blocks, baseline, nulls).identified
    assert identification.effect == "bias_jump"
    assert sorted(component.variant.values["at"] for component in identification.components) == [
        600.0,
        1300.0,
    ]
    assert identification.evidence_nats == pytest.approx(
        sum(component.evidence_nats for component in identification.components)
    )
    assert (
        identification.evidence_nats
        > max(component.evidence_nats for component in identification.components) + 5.0
    )


@pytest.mark.full
def test_a_pair_is_found_where_any_course_explains_more_than_each():
    heat = {
        "profile": "ramps", "channel": "temperature", "unit": "degC",
        "points": [[0, 30], [600, 30], [1500, 50], [2400, 30], [3600, 30]],
    }  # fmt: skip
    light = {
        "profile": "ramps", "channel": "light_power", "unit": "W",
        "points": [[0, 1e-4], [1200, 1e-4], [2100, 1.8e-4], [3000, 1e-4], [3600, 1e-4]],
    }  # fmt: skip
    effects = [
        {"name": "temperature_noise", "linear": 0.01},
        {"name": "light_power_noise", "shot": 0.4, "thermal": 0.0},
    ]
    blocks = named.record(effects, environment=(heat, light))
    identifications = name_effects(blocks, *named.nulls(blocks))
    assert {identification.effect for identification in identifications.identified} == {
        "temperature_noise",
        "light_power_noise",
    }
    assert not identifications.unidentified

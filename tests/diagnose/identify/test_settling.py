"""Effects are tested again with all others in the model, and keep only what they explain alone."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.identify import forward_search, naming_order
from gyrostab.diagnose.identify.examination import Examination, nuisance_alternatives
from gyrostab.diagnose.identify.selections import (
    Selection,
    ambiguous_evidence,
    make_selection,
)
from gyrostab.diagnose.identify.settling import prune_selections, settle_selections
from gyrostab.diagnose.identify.withdrawal import _without_part_of_drift, withdraw_effects
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.ingest.make_log import make_log

MODEL = {"noise": {"N": 0.003, "K": 0.005}, "log": {"axes": ["x"]}}
BLOCKS = 180


def _examine(values, rate, channels, chosen):
    blocks = reduce_log(make_log(values, rate=rate, unit="deg/h", channels=channels), block="20s")
    baseline = baseline_from_model(blocks, MODEL)
    candidates, _ = effect_candidates(blocks, baseline["coefficient"])
    chosen_candidates = [
        candidate
        for candidate in [*candidates, *nuisance_alternatives(blocks)]
        if candidate.effect in chosen
    ]
    state = initial_state(blocks, baseline)
    return Examination(chosen_candidates, CountEvidence({}), 8.0, state)


def test_a_channel_that_two_others_make_superfluous_is_dropped():
    rng = np.random.default_rng(0)

    def smooth():
        course = np.convolve(rng.standard_normal(BLOCKS + 8), np.hanning(9), "valid")
        return np.repeat((course - course.mean()) / course.std(), 20)

    first, second, third = smooth(), smooth(), smooth()
    values = 0.18 * rng.standard_normal(BLOCKS * 20) + 0.3 * (first + 0.6 * second)
    courses = (first + second + 0.25 * third, first, second)
    names = ("temperature", "temperature_2", "temperature_3")
    channels = {
        name: (30.0 + 5.0 * course, "degC") for name, course in zip(names, courses, strict=True)
    }
    examination = _examine(values, 1.0, channels, ("temperature_bias",))
    chosen, *_ = forward_search._select_all(examination)
    assert chosen[0].driver == ("temperature",)
    _, settled = settle_selections(examination, prune_selections(examination, chosen))
    assert {identification.driver for identification in settled} == {(names[1],), (names[2],)}


def test_two_channels_are_named_where_a_random_walk_explains_more_than_each():
    rng = np.random.default_rng(3)
    courses = rng.standard_normal((2, BLOCKS)).cumsum(axis=1).repeat(20, axis=1)
    values = 0.18 * rng.standard_normal(BLOCKS * 20) + 3.0 * courses.sum(axis=0)
    channels = {
        name: (30.0 + 5.0 * course, "degC")
        for name, course in zip(("temperature", "temperature_2"), courses, strict=True)
    }
    examination = _examine(values, 1.0, channels, ("temperature_bias", "~red"))
    evidence = forward_search.score_candidates(examination, examination.start, ())
    best = max(evidence, key=lambda item: item.evidence_nats.max())
    assert best.candidate.effect == "~red"
    chosen, _ = forward_search._select_all(examination)
    assert {selection.driver for selection in chosen} == {("temperature",), ("temperature_2",)}


def test_an_effect_stays_beside_an_unidentified_burst():
    rng = np.random.default_rng(1)
    vibration = np.full(BLOCKS, 0.02)
    vibration[20:60] = 1.0 + np.abs(np.sin(np.arange(40)))
    level = 1.0 + 0.2 * (vibration / 2.0) ** 2
    level[120:135] *= 1.8
    values = 0.18 * np.sqrt(5.0 * np.repeat(level, 100)) * rng.standard_normal(BLOCKS * 100)
    channels = {"vibration": (np.repeat(vibration, 100), "g")}
    examination = _examine(values, 5.0, channels, ("vibration_noise", "~N(t)", "~burst"))
    chosen, *_ = forward_search._select_all(examination)
    named = [selection for selection in chosen if selection.is_named]
    others = [selection for selection in chosen if not selection.is_named]
    assert [selection.effect for selection in named] == ["vibration_noise"]
    assert [selection.effect for selection in others] == ["~burst"]
    assert withdraw_effects(examination, named, others) == (named, [])


def _explain(effect, statistic, evidence):
    """Return the components of a selection with this evidence on each axis."""
    candidate = Candidate(effect, find_statistic(statistic), (), ())
    variant = Variant({}, ("0",), np.empty(0))
    return [Component(candidate, variant, (axis,), nats) for axis, nats in evidence.items()]


@pytest.mark.parametrize(
    ("jump_nats", "on_x", "remaining_axes"),
    [
        ({"x": 50.0}, 3.5, [("x",)]),
        ({"x": 50.0}, 60.0, []),
        ({"x": 50.0, "z": 200.0}, 60.0, [("z",)]),
        ({"x": 50.0, "z": 7.0}, 60.0, []),  # not enough on the other axis alone
    ],
)
@pytest.mark.parametrize("name", ["~bias(t)", "~levels", "~red"])
def test_a_drift_takes_only_what_it_explains_on_its_axis(jump_nats, on_x, remaining_axes, name):
    jump = make_selection(_explain("bias_jump", "mean", jump_nats), 8.0)
    jump = replace(jump, instead={"warm_up": jump.evidence_nats - 5.0})
    parts = _explain(name, "mean", {"x": on_x, "y": 201.0})
    drift = make_selection(parts, 8.0)
    remaining = _without_part_of_drift([jump], [drift], "x", 8.0)
    assert [identification.axes for identification in remaining] == remaining_axes
    for identification in remaining:
        assert identification.evidence_nats == sum(jump_nats[axis] for axis in identification.axes)
        assert identification.instead == {"warm_up": identification.evidence_nats - 5.0}
        assert {component.row for component in identification.components} == {identification.axes}


@pytest.mark.slow
def test_both_of_a_pair_are_selected_at_once():
    """Neither explains more than a course of levels while the other is not in the model."""
    second = np.arange(BLOCKS * 20)
    values = 0.18 * np.random.default_rng(1).standard_normal(second.size)
    values += 0.3 * ((second >= 1000) & (second < 2200))
    examination = _examine(values, 1.0, {}, ("bias_jump", "~levels"))
    evidence = forward_search.score_candidates(examination, examination.start, ())
    selections, failed = forward_search._select_next(
        examination, evidence, examination.start, [], {}
    )
    (first, other) = (selection.components for selection in selections)
    at = sorted(component.variant.values["at"] for component in (*first, *other))
    assert at == pytest.approx([1000.0, 2200.0], abs=20.0)
    assert not failed


def test_the_form_that_beats_an_effect_is_recorded():
    second = np.arange(BLOCKS * 20)
    values = 0.18 * np.random.default_rng(2).standard_normal(second.size)
    values += 2.0 * np.clip((second - 1700.0) / 160.0, 0.0, 1.0)
    examination = _examine(values, 1.0, {}, ("bias_jump",))
    evidence = forward_search.score_candidates(examination, examination.start, ())
    beaten = {}
    assert forward_search._select_next(examination, evidence, examination.start, [], beaten) == (
        [],
        {},
    )
    name, nats = beaten["bias_jump"]
    assert name == "a gradual change"
    assert nats > 3.0


def test_rejected_channels_do_not_use_up_the_number_of_effects(monkeypatch):
    rounds = iter(range(100))

    def select_next(*_):
        number = next(rounds)
        failed = {f"channel {number}": ("a time-shifted channel", 1.0)}
        return [], failed if number < 2 * forward_search.MAX_EFFECTS else {}

    monkeypatch.setattr(forward_search, "_select_next", select_next)
    monkeypatch.setattr(forward_search, "score_candidates", lambda *_, **__: [])
    forward_search._select_all(SimpleNamespace(start=None, expected=()))
    # the last round is repeated with what is tried last
    assert next(rounds) == 2 * forward_search.MAX_EFFECTS + 2


def test_what_fails_the_time_shift_test_is_barred_before_random_biases_are_tried(monkeypatch):
    tried: list[tuple[set[str], bool]] = []
    answers = iter([([], {"shupe": ("a time-shifted channel", 3.0)}), ([], {}), ([], {})])
    monkeypatch.setattr(
        forward_search,
        "score_candidates",
        lambda examination, state, barred, includes_last_resorts: tried.append(
            ({*barred}, includes_last_resorts)
        ),
    )
    monkeypatch.setattr(forward_search, "_select_next", lambda *given: next(answers))
    chosen, beaten = forward_search._select_all(SimpleNamespace(start=None, expected=()))
    assert not chosen
    assert list(beaten) == ["shupe"]
    assert tried == [(set(), False), ({"shupe"}, False), ({"shupe"}, True)]


@pytest.mark.parametrize(("statistic", "least"), [("mean", 1977.0), ("random_process", 1997.0)])
def test_alternatives_may_lack_what_an_error_of_the_form_costs(statistic, least):
    """3 nats, and 1 % of the evidence; a random walk has no form that may be wrong."""
    variant = Variant({}, ("size",), np.ones((1, 1, BLOCKS)))
    candidate = Candidate("shupe", find_statistic(statistic), ("temperature",), (variant,))
    component = Component(candidate, variant, ("x",), 2000.0)
    assert ambiguous_evidence([component], 2000.0, DEFAULTS) == pytest.approx(least)


def test_alternatives_of_a_strong_effect_are_listed_within_the_error_of_its_form():
    """A supply voltage with the course of the temperature and 1.5 % noise explains little less."""
    rng = np.random.default_rng(1)
    course = np.repeat(np.cumsum(rng.standard_normal(BLOCKS)), 20)
    other = course + 0.015 * course.std() * np.repeat(rng.standard_normal(BLOCKS), 20)
    values = 0.18 * rng.standard_normal(BLOCKS * 20) + 3.0 * course / course.std()
    channels = {"temperature": (30.0 + course, "degC"), "supply_voltage": (28.0 + other, "V")}
    examination = _examine(values, 1.0, channels, ("temperature_bias", "supply_bias"))
    chosen, _ = forward_search._select_all(examination)
    (settled,) = settle_selections(examination, prune_selections(examination, chosen))[1]
    rival = max(nats for key, nats in settled.instead.items() if "supply" in key)
    assert 3.0 < settled.evidence_nats - rival < 3.0 + 0.01 * settled.evidence_nats
    assert settled.alternatives == ("supply_bias",)


@pytest.mark.parametrize(("left", "remains"), [(17.0, False), (19.0, True)])
def test_what_an_error_of_a_form_may_leave_is_not_unidentified(left, remains):
    """1 % of the 1000 nats of an effect, in addition to the threshold of 8 nats."""
    strong = make_selection(_explain("temperature_bias", "mean", {"x": 1000.0}), 8.0)
    drift = make_selection(_explain("~bias(t)", "mean", {"x": 50.0}), 8.0)

    class WithOthers(Examination):
        def state_with(self, selections):
            return None

        def find_components(self, candidates, state):
            (candidate,) = candidates
            nats = left if candidate.effect == "~bias(t)" else 1000.0
            return {candidate.key: _explain(candidate.effect, "mean", {"x": nats})}

    examination = WithOthers((), CountEvidence({}), 8.0, SimpleNamespace(settings=DEFAULTS))
    pruned = prune_selections(examination, [strong, drift])
    assert (drift in pruned) is remains


@pytest.mark.parametrize(("nats", "passes"), [(17.0, False), (19.0, True)])
def test_the_second_of_a_pair_needs_what_earlier_effects_may_leave(monkeypatch, nats, passes):
    """1 % of the 1000 nats of an effect named before, in addition to the threshold of 8 nats."""
    monkeypatch.setattr(naming_order, "condition_on", lambda state, components: state)
    monkeypatch.setattr(
        naming_order, "keep_physical", lambda components, state, error: (components, None)
    )
    earlier = make_selection(_explain("temperature_bias", "mean", {"x": 1000.0}), 8.0)
    first = _explain("bias_jump", "mean", {"y": 30.0})
    second = _explain("shupe", "mean", {"x": nats})

    class OfPair(Examination):
        def find_components(self, candidates, state):
            return {"shupe": second}

    examination = OfPair((), CountEvidence({}), 8.0, SimpleNamespace(settings=DEFAULTS))
    search = naming_order.SearchRound(
        examination, None, {"bias_jump": first}, {"bias_jump": 8.0}, [earlier]
    )
    _, companions = search._find_companions(["shupe"], "bias_jump", first)
    assert ("shupe" in companions) is passes


def test_spikes_of_a_comb_of_lines_are_not_identified(monkeypatch):
    def selection(effect, statistic, place):
        candidate = Candidate(effect, find_statistic(statistic), (), ())
        component = Component(candidate, None, ("x",), 50.0, place)
        return Selection(effect, (), ("x",), (component,), 50.0, 8.0)

    lines = [selection("spectral_line", "spectral_line", place) for place in (10, 20, 30)]
    found = [selection("spikes", "sample_counts", -1), *lines]
    examination = SimpleNamespace(
        settings=DEFAULTS, candidates=(), expected=(), state_with=lambda selections: None
    )
    for name, result in (
        ("identify_expected_effects", lambda given: given),
        ("_select_all", lambda given: (found, {})),
        ("prune_selections", lambda given, chosen: chosen),
        ("settle_selections", lambda given, chosen: ([], chosen)),
        ("withdraw_effects", lambda given, identified, unidentified: (identified, [])),
    ):
        monkeypatch.setattr(forward_search, name, result)
    assert forward_search.identify_effects(examination).identified == tuple(lines)

"""Jumps of the bias are looked for at all times, and first of all where power came back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gyrostab.diagnose.calibration.baseline import calibrate
from gyrostab.diagnose.effects.candidates import effect_candidates
from gyrostab.diagnose.effects.cells import begin_state
from gyrostab.diagnose.effects.search import gains
from gyrostab.diagnose.gains.folds import fold_blocks
from tests.named import COEFFICIENT, record

_BACK = 1913.0  # s, between two values of the thinned grid


@pytest.fixture(scope="module")
def restarted():
    """An hour whose power was lost for 7 s."""
    reduced = record([]).drop_vars([name for name in ("restart_begin", "restart_end") if name in record([])])
    return reduced.assign(restart_begin=("restart", [_BACK - 7.0]), restart_end=("restart", [_BACK]))


def _jumps(reduced):
    return next(one for one in effect_candidates(reduced, COEFFICIENT)[0] if one.effect == "bias_jump" and one.view == "mean")


def test_a_restart_weighs_as_much_as_all_other_times(restarted):
    variants = _jumps(restarted).variants
    weight = np.array([one.weight for one in variants])
    known = np.array([one.values["at"] == _BACK for one in variants])
    assert known.sum() == 1
    assert weight[known].sum() == pytest.approx(weight[~known].sum())
    assert weight[~known].sum() == (~known).sum()


def test_without_restarts_all_times_weigh_the_same():
    assert {one.weight for one in _jumps(record([])).variants} == {1.0}


def test_two_restarts_share_their_weight(restarted):
    twice = restarted.drop_vars(["restart_begin", "restart_end"])
    twice = twice.assign(restart_begin=("restart", [900.0, _BACK]), restart_end=("restart", [905.0, _BACK + 7.0]))
    weight = np.array([one.weight for one in _jumps(twice).variants])
    assert np.count_nonzero(weight != 1.0) == 2
    assert weight[weight != 1.0].sum() == pytest.approx(weight[weight == 1.0].sum())


def test_a_jump_where_power_came_back_needs_less_to_be_seen(restarted):
    middle = (restarted["begin"] + restarted["end"]) / 2.0
    moved = restarted.assign(mean=restarted["mean"] + 0.08 * (middle > _BACK))
    state = begin_state(moved, calibrate(moved))
    weighed = _jumps(moved)
    alike = replace(weighed, variants=tuple(replace(one, weight=1.0) for one in weighed.variants))
    found = [gains([one], moved, state, fold_blocks(moved))[0] for one in (weighed, alike)]
    assert (found[0].gain > found[1].gain + 0.5).any()
    assert {one.values["at"] for one in found[0].best} == {_BACK}

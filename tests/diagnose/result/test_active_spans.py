"""When named effects act."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.result.active_spans import active_blocks, active_spans
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from tests.support.candidates import select_candidate
from tests.support.named import COEFFICIENT, WORLD, record


@pytest.fixture(scope="module")
def turning():
    speed = {
        "profile": "rotation",
        "points": [[0, 0], [1200, 0], [1210, 180], [2500, 180], [2510, 60], [3600, 60]],
        "sensor_rate": 10.0,
    }
    return record([], environment=(*WORLD["usual"], speed))


def identification(blocks, effect, statistic):
    candidates, _ = effect_candidates(blocks, COEFFICIENT)
    candidate = select_candidate(candidates, effect, statistic)
    component = Component(candidate, candidate.variants[0], ("x",), 50.0, line_index=0)
    return Selection(effect, candidate.driver, ("x",), (component,), 50.0, 8.0)


def test_rotation_line_acts_while_the_tool_rotates(turning):
    intervals = active_spans(identification(turning, "rotation_line", "rotation_order"), turning)
    assert intervals == [(1200.0, 3600.0)]


def test_effect_present_at_rest_acts_at_rest(turning):
    rotation = identification(turning, "earth_rate", "rotation_order")
    combined = replace(
        rotation,
        components=(
            *rotation.components,
            *identification(turning, "earth_rate", "mean").components,
        ),
    )
    assert active_spans(combined, turning) == [(0.0, 3600.0)]


def test_effect_of_a_mostly_active_channel_acts_while_it_is_active(
    turning,
):
    (span,) = active_spans(identification(turning, "scale_factor", "mean"), turning)
    assert span == (1200.0, 3600.0)


@pytest.mark.parametrize(("level", "is_active"), [(0.5, True), (0.2, False)])
def test_a_tenth_of_the_largest_counts_as_acting(level, is_active):
    blocks = record([])
    g = np.zeros(blocks.sizes["block"])
    g[40:60], g[100:120] = 5.0, 5.0 * level
    shaken = blocks.assign(channel_vibration=blocks["channel_vibration"].copy(data=g))
    active = active_blocks(identification(shaken, "vibration_rectification", "mean"), shaken)
    np.testing.assert_array_equal(
        np.flatnonzero(active), [*range(40, 60), *(range(100, 120) if is_active else ())]
    )

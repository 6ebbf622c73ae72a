"""Steps at several times are split into groups that have a size each."""

from __future__ import annotations

import numpy as np

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.estimate.component_groups import split_steps
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.ingest.make_log import make_log
from tests.diagnose.statistics.test_jump_forms import MODEL, try_jumps


def test_steps_of_other_axes_do_not_limit_the_times_of_a_step() -> None:
    """Axis y has steps at two instants; that of x at the second one belongs to the first group."""
    second = np.arange(9_000) / 5.0
    rate = np.random.default_rng(1).standard_normal((2, second.size))
    blocks = reduce_log(make_log(rate, rate=5.0, unit="deg/h"))
    jumps, state = try_jumps(blocks, baseline_from_model(blocks, MODEL))
    at = {variant.values["at"]: variant for variant in jumps.variants}
    first, then = sorted(at)[len(at) // 2 :][:2]
    steps = [
        Component(jumps, at[time], (axis,), 20.0)
        for axis, time in (("y", first), ("x", then), ("y", then))
    ]
    parts = split_steps(steps, state)
    assert [[step.row for step in part] for part, _ in parts] == [[("y",), ("x",)], [("y",)]]
    for part, _ in parts:
        assert all(step.candidate.variants for step in part)


def test_steps_of_one_axis_at_one_time_are_one() -> None:
    """Jumps that were selected one after another may be set to the same time."""
    second = np.arange(9_000) / 5.0
    rate = np.random.default_rng(1).standard_normal((1, second.size))
    blocks = reduce_log(make_log(rate, rate=5.0, unit="deg/h"))
    jumps, state = try_jumps(blocks, baseline_from_model(blocks, MODEL))
    early, late = (jumps.variants[place] for place in (20, 60))
    steps = [
        Component(jumps, variant, ("x",), nats)
        for variant, nats in ((late, 9.0), (early, 20.0), (late, 7.0))
    ]
    parts = split_steps(steps, state)
    assert [[step.evidence_nats for step in part] for part, _ in parts] == [[20.0], [9.0]]
    assert all(step.candidate.variants for part, _ in parts for step in part)

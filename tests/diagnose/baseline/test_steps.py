"""Steps of the rate within a block explain its power, but not that of other blocks."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.known_effects import (
    find_blocks_with_known_motion,
    remove_known_motion,
)
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.task import Task, lines_without_motion
from gyrostab.progress import no_stage
from gyrostab.simulate import simulate
from tests.support.named import nulls, record

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
JUMP = {
    "name": "bias_jump",
    "step": [2.0],
    "at": 807.0,
}  # 50 standard deviations of a block's mean; blocks begin at 800 s and 820 s


def _make_log(effects, seed):
    model = {"noise": NOISE, "effect": effects, "log": {"axes": ["x"]}}
    return simulate(model, duration="30min", rate=10.0, seed=seed).compute()


def _diagnose_log(log, effects=()):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gyrostab.diagnose(
            log, simulation={"noise": NOISE, "effect": list(effects)}, nulls=100
        )


@pytest.fixture(scope="module")
def jumped():
    return _make_log([JUMP], 2)


@pytest.mark.full
def test_a_jump_within_a_block_explains_its_power(jumped):
    diagnosis = _diagnose_log(jumped)
    assert diagnosis.verdict == "explained"
    assert [effect["name"] for effect in diagnosis.effects] == ["bias_jump"]
    assert {"davar", "spectrum", "mean"} <= {
        region["view"] for region in diagnosis.content["mismatches"]
    }
    assert {
        name for region in diagnosis.content["mismatches"] for name in region["explained_by"]
    } == {"bias_jump"}


@pytest.mark.full
def test_a_jump_does_not_explain_noise_in_other_blocks(jumped):
    seconds = np.arange(jumped.sizes["time"]) / 10.0
    rate = jumped["rate"].transpose("axis", "time").values.copy()
    louder = rate[:, (seconds >= 1200) & (seconds < 1300)]
    rate[:, (seconds >= 1200) & (seconds < 1300)] += 0.4 * (louder - louder.mean())
    diagnosis = _diagnose_log(jumped.assign(rate=(("axis", "time"), rate, jumped["rate"].attrs)))
    left = [region for region in diagnosis.content["mismatches"] if not region["explained_by"]]
    assert diagnosis.verdict == "partly explained"
    start = np.datetime64(diagnosis.content["recording"]["start"].removesuffix("Z"))
    spans = [
        [
            (np.datetime64(region[end].removesuffix("Z")) - start) / np.timedelta64(1, "s")
            for end in ("start", "end")
        ]
        for region in left
    ]
    assert any(begin < 1300 and end > 1200 for begin, end in spans)


def test_a_part_of_moving_blocks_has_no_lines(jumped):
    """The log is read again for its lines, without the blocks that are left out."""
    task = Task(jumped, None, None, 5.0, 0, 100, 0.01, no_stage, Settings())
    blocks = reduce_log(jumped)
    baseline = calibrate_noise(blocks)
    course = np.zeros((1, blocks.sizes["block"]))
    course[:, :12:2] = 5.0  # the first part has the blocks 0 to 11
    known = baseline.assign(known_mean=(("axis", "block"), course))
    reread = lines_without_motion(task, blocks, known)
    assert reread["line_weight"].values[0, 0] == 0.0
    np.testing.assert_allclose(reread["line_power"][:, 2:], blocks["line_power"][:, 2:])
    assert (reread["sine_nats"] == -np.inf).all()  # sought in the record as a whole
    lines = ["line_power", "line_weight", "sine_nats"]
    xr.testing.assert_identical(reread.drop_vars(lines), blocks.drop_vars(lines))
    assert lines_without_motion(task, blocks, baseline) is blocks


def test_only_blocks_with_known_motion_are_left_out():
    blocks = record([])
    baseline, _ = nulls(blocks, 4)
    step = np.zeros((3, blocks.sizes["block"]))
    step[1, 90:] = 1.0
    known = baseline.assign(known_mean=(("axis", "block"), step))
    moving = find_blocks_with_known_motion(blocks, known)
    assert np.argwhere(moving).tolist() == [[1, 89], [1, 90]]
    out = remove_known_motion(blocks, known)
    for name in ("power", "kurtosis"):
        lost = out[name].isnull() & blocks[name].notnull()
        lost = lost.any("band") if "band" in lost.dims else lost
        np.testing.assert_array_equal(lost.transpose("axis", "block"), moving)
    lost = (
        (out["cross"].isnull() & blocks["cross"].notnull())
        .any("band")
        .transpose("pair", "block")
        .values
    )
    touched = [
        "y" in pair for pair in zip(blocks["first"].values, blocks["second"].values, strict=True)
    ]
    np.testing.assert_array_equal(lost, np.outer(touched, moving[1]))
    xr.testing.assert_identical(out["mean"], blocks["mean"])
    assert remove_known_motion(blocks, baseline) is blocks

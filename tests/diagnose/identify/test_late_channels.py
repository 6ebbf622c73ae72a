"""A channel with late time stamps is moved if it then explains the rates, and only then."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.identify import late_channels
from gyrostab.diagnose.identify.examination import prepare_examination
from gyrostab.diagnose.identify.forward_search import identify_effects
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.late_channels import (
    DelaySearch,
    chance_of_best,
    find_late_channel,
)
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.schema.delays import move_channels
from gyrostab.simulate import simulate
from tests.support.named import nulls

DELAY = 47.0  # s
BURSTS = [[0, 0.1], [150, 4.0], [190, 0.1], [350, 6.0], [440, 0.1], [650, 3.0], [700, 0.1]]
NOISE = {"N": 0.003, "B": 0.002, "K": 0.01}
RECTIFIED = {"name": "vibration_rectification", "axes": ["x"], "sensitivity": 0.05}
SHAKEN = {"profile": "vibration", "points": BURSTS}
WARMING = {
    "profile": "ramps",
    "channel": "temperature",
    "unit": "degC",
    "points": [[0, 20], [450, 60], [900, 80]],
}


def recorded(
    effects: list[dict[str, Any]],
    delay: float = DELAY,
    *,
    own_stamps: bool = True,
    world: tuple[dict[str, Any], ...] = (SHAKEN,),
) -> xr.Dataset:
    """Return a quarter of an hour of a log whose vibration is late."""
    model = {
        "noise": NOISE,
        "effect": effects,
        "environment": list(world),
        "log": {"axes": ["x", "y"]},
    }
    log = simulate(model, duration="15min", rate=10.0, seed=5).compute()
    late = move_channels(log, {"vibration": -delay})
    if own_stamps:
        return late
    stamps = late["time_vibration"].values
    last = np.clip(np.searchsorted(stamps, log["time"].values, "right") - 1, 0, stamps.size - 1)
    on_time = late["vibration"].variable[last]
    return log.drop_vars(["vibration", "time_vibration"]).assign(
        vibration=("time", on_time.values, on_time.attrs)
    )


def examined(log: xr.Dataset) -> tuple[Identifications, xr.Dataset, xr.Dataset]:
    blocks = reduce_log(log, block="10s")
    baseline, records = nulls(blocks)
    return identify_effects(prepare_examination(blocks, baseline, records)), baseline, log


@pytest.mark.full
@pytest.mark.parametrize(("delay", "own_stamps"), [(DELAY, False), (-123.0, True)])
def test_late_or_early_channel_is_found(delay: float, own_stamps: bool) -> None:
    record = examined(recorded([RECTIFIED], delay, own_stamps=own_stamps))
    found = find_late_channel(*record)
    assert found is not None
    assert found[0] == "vibration"
    assert found[1] == pytest.approx(delay, abs=1.5)  # blocks of 10 s, vibration at 1 Hz
    assert find_late_channel(*record, moved=["vibration"]) is None


@pytest.mark.full
@pytest.mark.parametrize(
    ("effects", "delay", "world"),
    [
        ([], DELAY, (SHAKEN,)),
        ([RECTIFIED], 0.0, (SHAKEN,)),
        ([RECTIFIED], 400.0, (SHAKEN,)),
        # the bias follows no channel
        ([{"name": "bias_jump", "axes": ["x"], "step": [0.2], "at": 450.0}], DELAY, (SHAKEN,)),
        ([{"name": "ageing_bias", "axes": ["x"], "slope": 20.0}], DELAY, (WARMING, SHAKEN)),
    ],
)
def test_channel_that_does_not_explain_more_stays(
    effects: list[dict[str, Any]], delay: float, world: tuple[dict[str, Any], ...]
) -> None:
    assert find_late_channel(*examined(recorded(effects, delay, world=world))) is None


@pytest.mark.parametrize(("count", "others"), [(60, 20), (120, 64), (300, 40)])
def test_chance_holds_its_level_on_values_of_unknown_scale(count: int, others: int) -> None:
    rng = np.random.default_rng(8)
    best, compared = (
        np.square(rng.standard_normal((2_000, size))).max(axis=1) for size in (count, others)
    )
    chance = [chance_of_best(ratio, count, others) for ratio in best / compared]
    for level in (0.05, 0.2):  # two and a half standard errors
        assert np.mean(np.array(chance) <= level) == pytest.approx(
            level, abs=2.5 * np.sqrt(level / 2_000)
        )


@pytest.mark.parametrize(
    ("on_time", "elsewhere", "without_channel", "best", "is_late"),
    [
        (0.0, 5.0, 20.0, 60.0, True),
        (55.0, 5.0, 20.0, 60.0, False),  # hardly more than at its own time
        (0.0, 40.0, 20.0, 60.0, False),  # hardly more than by chance
        (0.0, 5.0, 65.0, 60.0, False),  # less than without a channel
        (0.0, 0.5, 5.0, 12.0, False),  # 30 delays of 16 parts are worth 6.2 nats
    ],
)
def test_late_channel_explains_more_than_all_else(
    on_time: float,
    elsewhere: float,
    without_channel: float,
    best: float,
    is_late: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The evidence of each delay is given."""

    class GivenEvidence(DelaySearch):
        def evidence(self, channel: str, shifts: Iterable[int], *, wrap: bool = False) -> Floats:
            peak = np.maximum(best - np.abs(np.array(list(shifts)) - 48.0), 0.0)
            peak[np.array(list(shifts)) == 0] = on_time
            return np.full(peak.size, elsewhere) if wrap else peak

    blocks = xr.Dataset({"channel_vibration": ("block", np.zeros(90))}, attrs={"block_s": 10.0})
    examination: Any = SimpleNamespace(
        settings=DEFAULTS,
        threshold=9.0,
        state_with=lambda selections: None,
    )
    unexplained = SimpleNamespace(driver=(), components=(), evidence_nats=without_channel)
    identifications: Any = SimpleNamespace(
        examination=examination,
        identified=(),
        unidentified=(unexplained,),
        state=SimpleNamespace(blocks=blocks),
    )
    monkeypatch.setattr(late_channels, "DelaySearch", GivenEvidence)
    parts = np.random.default_rng(4).standard_normal(90 * 16)
    monkeypatch.setattr(late_channels, "split_channel", lambda *_: parts)
    found = find_late_channel(identifications, blocks, blocks)
    assert found == (("vibration", 30.0) if is_late else None)
    # another effect follows the channel at its own time
    identifications.identified = (SimpleNamespace(driver=("vibration",), components=()),)
    assert find_late_channel(identifications, blocks, blocks) is None


@pytest.mark.full
def test_diagnosis_states_the_delay_and_its_model_has_it() -> None:
    log = recorded([RECTIFIED])
    found = diagnose(log, nulls=100)
    (effect,) = found.effects
    assert effect["name"] == "vibration_rectification"
    size = effect["parameters"]["sensitivity"]
    assert size["low"] < RECTIFIED["sensitivity"] < size["high"]
    ((channel, delay),) = (tuple(entry.values()) for entry in found.content["channel_delays"])
    assert (channel, delay) == ("vibration", pytest.approx(DELAY, abs=1.0))
    assert f"stamps of channel vibration are {delay:g} s late" in str(found)
    assert found.model["delay"] == {"vibration": delay}
    # simulated again, the rate follows the vibration as in the recording
    course = simulate({**found.model, "noise": {}}, like=log)["rate"].sel(axis="x").values
    begin, level = np.array(BURSTS).T
    shaken = level[np.searchsorted(begin, np.arange(9000) / 10.0, "right") - 1] ** 2
    assert np.corrcoef(course, shaken)[0, 1] > 0.9
    # compared with this model, nothing differs
    again = diagnose(log, simulation=found.model, nulls=100)
    assert again.verdict == "no mismatch"
    assert again.content["channel_delays"] == found.content["channel_delays"]

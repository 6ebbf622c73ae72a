"""Channels with their own stamps: resampled to the time grid of the gyro, or left out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

import gyrostab
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.predict.channel_use import unused_channels
from gyrostab.diagnose.reduce.aligned_channels import align_channels
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.ingest.make_log import make_log
from gyrostab.time.grid import time_coordinate

RATE, SIZE = 100.0, 3000
START = np.datetime64("2026-03-14T08:00:00", "ns")


def log_of(size: int = SIZE, *, seed: int = 0) -> xr.Dataset:
    rate = 1.8 * np.random.default_rng(seed).standard_normal((1, size))
    return make_log(rate, rate=RATE, unit="deg/h", start="2026-03-14T08:00:00")


def with_channel(
    log: xr.Dataset, name: str, seconds: Any, values: Any, unit: str = "1", **attrs: Any
) -> xr.Dataset:
    """Add a channel with stamps in seconds after the start."""
    stamps = START + np.rint(np.asarray(seconds) * 1e9).astype("timedelta64[ns]")
    return log.assign_coords({f"time_{name}": stamps}).assign(
        {name: (f"time_{name}", values, {"units": unit, **attrs})}
    )


@pytest.mark.parametrize("skew", [0.0, 1 / 3, -1 / 3, 0.45])
def test_a_channel_sampled_like_the_gyro_has_the_nearest_value(skew: float):
    """Interpolation across the reset of a ramp would give a phase that never occurs."""
    seconds = (np.arange(SIZE) + skew) / RATE
    ramp = np.mod(seconds * 4.17, 1.0)
    aligned = align_channels(with_channel(log_of(), "ramp", seconds, ramp))
    np.testing.assert_array_equal(aligned.log["ramp"].values, ramp)
    assert aligned.log["ramp"].dims == ("time",)
    assert "time_ramp" not in aligned.log.variables
    assert not aligned.unused
    where = "after" if skew > 0 else "before"
    assert bool(aligned.notes) == (skew != 0.0)
    assert all(
        f"channel ramp: its stamps are {abs(skew) * 10:.3g} ms {where} those of the gyro" in note
        for note in aligned.notes
    )


def test_samples_without_a_value_near_them_are_missing():
    seconds = np.delete(np.arange(SIZE) / RATE, slice(1000, 1500))
    aligned = align_channels(with_channel(log_of(), "accel_x", seconds, np.ones(seconds.size), "g"))
    lost = np.isnan(aligned.log["accel_x"].values)
    assert np.flatnonzero(lost).tolist() == list(range(1000, 1500))


def test_a_faster_channel_is_averaged():
    seconds = (np.arange(4 * SIZE) - 1.5) / (4 * RATE)  # four values around each sample
    values = np.random.default_rng(1).standard_normal(seconds.size)
    aligned = align_channels(with_channel(log_of(), "accel_x", seconds, values, "g"))
    np.testing.assert_allclose(aligned.log["accel_x"].values, values.reshape(-1, 4).mean(axis=1))
    assert "mean of its values at 400 Hz" in aligned.notes[0]


def test_a_slower_channel_is_interpolated_but_not_across_gaps():
    seconds = np.delete(np.arange(0.0, 30.0, 0.03), slice(100, 110))
    aligned = align_channels(with_channel(log_of(), "accel_x", seconds, 2.0 * seconds, "g"))
    at = np.arange(SIZE) / RATE
    values = aligned.log["accel_x"].values
    gap = (at > 2.97 + 1e-6) & (at < 3.30 - 1e-6)
    inside = ~gap & (at <= seconds[-1])
    np.testing.assert_allclose(values[inside], 2.0 * at[inside], atol=1e-9)
    assert np.isnan(values[gap]).all()
    assert "interpolated from 33.33 Hz" in aligned.notes[0]
    held = align_channels(
        with_channel(log_of(), "accel_x", seconds, seconds, "g", interpolation="previous")
    )
    assert set(np.unique(held.log["accel_x"].values[inside])) <= set(seconds)


@pytest.mark.parametrize(
    ("name", "period"),
    [("temperature", 1.0), ("vibration", 0.01), ("vibration_x", 0.0025), ("pressure", 0.05)],
)
def test_slow_channels_and_vibration_keep_their_stamps(name: str, period: float):
    seconds = np.arange(0.0, 30.0, period)
    aligned = align_channels(log := with_channel(log_of(), name, seconds, seconds, "g"))
    assert aligned.log.identical(log)
    assert (aligned.unused, aligned.notes) == ({}, [])


@pytest.mark.parametrize("period", [0.001, 0.01, 0.03])
def test_rotating_channels_keep_their_stamps_with_a_rotation_rate(period: float):
    """Gravity is a wave at the rotation, coherent with its lines; a toolface has no mean."""
    seconds = np.arange(0.0, 30.0, period)
    accel = with_channel(log_of(), "accel_x", seconds, np.sin(2 * np.pi * seconds), "g")
    turning = with_channel(
        accel, "rotation_rate", seconds, np.full(seconds.size, 360.0), "degree s-1"
    )
    assert align_channels(turning).log.identical(turning)
    assert align_channels(accel).log["accel_x"].dims == ("time",)
    toolface = with_channel(log_of(), "toolface", seconds, np.mod(360.0 * seconds, 360.0), "degree")
    assert align_channels(toolface).log.identical(toolface)
    ground = with_channel(turning, "seismometer_z", seconds, seconds)
    assert align_channels(ground).log["seismometer_z"].dims == ("time",)


def test_a_fast_toolface_is_not_reported_as_slow():
    seconds = np.arange(0.0, 600.0, 0.01)
    blocks, _, _ = candidates_of(
        with_channel(log_of(60_000), "toolface", seconds, np.mod(70.0 * seconds, 360.0), "degree")
    )
    assert [channel["reason"] for channel in unused_channels(blocks, ())] == [
        "effects that vary with the toolface, such as earth rate, take it from the channel "
        "rotation_rate"
    ]


@pytest.mark.parametrize(
    ("name", "seconds", "reason"),
    [
        ("ramp", np.arange(0.0, 30.0, 0.02), "sampled at 50 Hz, slower than the gyro at 100 Hz"),
        ("ramp", np.arange(40.0, 50.0, 0.01), "lie outside the time of the gyro"),
        ("temperature", np.empty(0), "holds no value"),
        ("mode", np.arange(0.0, 30.0, 1.0), "text, not numbers"),
    ],
)
def test_a_useless_channel_is_left_out_with_a_reason(name: str, seconds: Any, reason: str):
    values = np.full(len(seconds), "idle") if name == "mode" else np.mod(seconds, 1.0)
    aligned = align_channels(with_channel(log_of(), name, seconds, values))
    assert list(aligned.unused) == [name]
    assert reason in aligned.unused[name]
    assert not {name, f"time_{name}"} & set(aligned.log.variables)


@given(
    ratio=st.sampled_from([0.2, 0.5, 0.9, 1.0, 1.1, 2.0, 3.0]),
    skew=st.floats(-2.0, 2.0),
    chunk=st.integers(7, 400),
    lost=st.sets(st.integers(0, 400), max_size=60),
    grid=st.booleans(),
)
def test_a_lazy_log_gives_the_same_as_a_log_in_memory(
    ratio: float, skew: float, chunk: int, lost: set[int], grid: bool
):
    log = log_of(400)
    count = int(400 / ratio)
    values = np.random.default_rng(2).standard_normal(count)
    values[[place for place in lost if place < count]] = np.nan
    seconds = (np.arange(count) * ratio + skew) / RATE
    log_with_channel = with_channel(log, "accel_x", seconds, values, "g")
    if grid:
        start = int((START + np.timedelta64(round(skew / RATE * 1e9), "ns")).view(np.int64))
        log_with_channel = log_with_channel.drop_vars("time_accel_x").assign_coords(
            time_coordinate(start, RATE / ratio, count, name="time_accel_x")
        )
    whole = align_channels(log_with_channel).log["accel_x"]
    lazy = log_with_channel.assign(
        rate=log_with_channel["rate"].chunk(time=chunk),
        accel_x=log_with_channel["accel_x"].chunk(time_accel_x=31),
    )
    pieces = align_channels(lazy).log["accel_x"]
    assert isinstance(pieces.data, da.Array)
    np.testing.assert_allclose(pieces.values, whole.values, rtol=1e-9, atol=1e-9)


def test_a_lazy_channel_is_read_chunk_by_chunk():
    """Resampling reads nothing; a chunk of the log then reads only the values around it."""
    size, read = 100_000, []

    def values(block_info: Any = None) -> Any:
        low, high = block_info[None]["array-location"][0]
        read.append((low, high))
        return np.zeros(high - low)

    log = log_of(size).chunk(time=10_000)
    channel = da.map_blocks(values, chunks=((1000,) * 100,), dtype=np.float64, meta=np.empty(0))
    log_with_channel = with_channel(log, "accel_x", (np.arange(size) + 0.3) / RATE, channel, "g")
    aligned = align_channels(log_with_channel).log["accel_x"]
    read.clear()
    aligned.data.blocks[4].compute(scheduler="synchronous")
    assert sum(high - low for low, high in read) <= 12_000
    assert min(low for low, _ in read) >= 39_000


# --------------------------------------------------------------------------------
# the diagnosis


def kicked(skew: float, *, size: int = 60_000) -> xr.Dataset:
    """Ten minutes at 100 Hz, 2 deg/h in the last twentieth of a 4.17 Hz ramp with own stamps."""
    log = log_of(size)
    phase = np.mod(np.arange(size) / RATE * 4.17, 1.0)
    log["rate"] = log["rate"] + 2.0 * (phase > 0.95)
    log["rate"].attrs["units"] = "degree hour-1"
    seconds = (np.arange(size) + skew) / RATE
    return with_channel(log, "ramp", seconds, np.mod(seconds * 4.17, 1.0))


def candidates_of(log: xr.Dataset) -> tuple[xr.Dataset, list[Any], dict[str, str]]:
    aligned = align_channels(log)
    blocks = reduce_log(aligned.log.assign_attrs(unused_channels=aligned.unused))
    return blocks, *effect_candidates(blocks, calibrate_noise(blocks)["coefficient"])


def test_a_ramp_from_another_file_is_used():
    blocks, candidates, reasons = candidates_of(kicked(1 / 3))
    assert "feedback_reset" not in reasons
    assert {
        candidate.statistic.name for candidate in candidates if candidate.effect == "feedback_reset"
    } >= {"ramp_phase"}
    profile = blocks["profile"].mean("block").values[0]
    late = 4.17 / RATE / 3.0  # turns between a sample and its ramp value
    assert profile[-2:].mean() - profile[2:36].mean() == pytest.approx(
        2.0 * (1.0 - late / 0.05), abs=0.15
    )


def test_reason_of_an_effect_names_the_unused_channel():
    log = kicked(0.0)
    slow = with_channel(
        log.drop_vars(["ramp", "time_ramp"]), "ramp", np.arange(0.0, 600.0, 0.5), np.zeros(1200)
    )
    blocks, candidates, reasons = candidates_of(slow)
    assert "the channel ramp is not used: it is sampled at 2 Hz" in reasons["feedback_reset"]
    assert "no channel temperature" in reasons["shupe"]
    (channel,) = unused_channels(
        blocks,
        {name for candidate in candidates for name in (*candidate.driver, *candidate.reference)},
    )
    assert channel["name"] == "ramp"


@pytest.mark.parametrize("name", ["temperature", "temperature_case"])
def test_reason_of_a_difference_names_the_only_temperature(name):
    log = kicked(0.0)
    log = log.assign({name: ("time", 20.0 + np.arange(log.sizes["time"]) / 1e4)})
    log[name].attrs["units"] = "degree_Celsius"
    _, candidates, reasons = candidates_of(log)
    assert "shupe" in {candidate.effect for candidate in candidates}
    assert reasons["thermal_gradient"] == (
        "not identifiable: it needs 2 channels such as temperature and temperature_2, and the "
        f"recording has only {name}"
    )


@pytest.mark.parametrize(
    ("name", "unit", "values", "reason"),
    [
        ("temperature", "degree_Celsius", np.full(600, 20.0), "does not change"),
        (
            "temperature",
            "V",
            np.arange(600.0),
            "its unit is 'V', and effects need 'degree_Celsius'; give it with --unit "
            "temperature=UNIT, or in Python convert the channel and set its attribute units",
        ),
        (
            "humidity",
            "1",
            np.arange(600.0),
            "no effect follows a channel of this name, and it is too slow",
        ),
        (
            "temperature",
            "degree_Celsius",
            np.where(np.arange(600) < 200, np.arange(600.0), np.nan),
            " % of the blocks, and 50 % are needed",
        ),
    ],
)
def test_every_unused_channel_is_listed(name: str, unit: str, values: Any, reason: str):
    log = with_channel(log_of(60_000), name, np.arange(600.0), values, unit)
    blocks, candidates, reasons = candidates_of(log)
    (channel,) = unused_channels(
        blocks,
        {
            channel_name
            for candidate in candidates
            for channel_name in (*candidate.driver, *candidate.reference)
        },
    )
    assert channel["name"] == name
    assert reason in channel["reason"]
    if name == "temperature" and "change" not in reason:
        assert reason in reasons["temperature_bias"]


def test_a_seismometer_with_its_own_stamps_is_compared_sample_by_sample():
    log = log_of(60_000)
    ground = np.random.default_rng(4).standard_normal(60_000)
    log["rate"] = log["rate"] + ground
    log["rate"].attrs["units"] = "degree hour-1"
    blocks, candidates, _ = candidates_of(
        with_channel(log, "seismometer_z", (np.arange(60_000) + 0.37) / RATE, ground)
    )
    assert ("real_motion", ("seismometer_z",)) in {
        (candidate.effect, candidate.reference)
        for candidate in candidates
        if candidate.statistic.name == "transfer"
    }
    assert unused_channels(blocks, {"seismometer_z"}) == []


@pytest.mark.slow
def test_diagnosis_lists_the_channels_it_used(recwarn: pytest.WarningsRecorder):
    log = with_channel(kicked(1 / 3, size=30_000), "humidity", np.arange(300.0), np.arange(300.0))
    with pytest.warns(
        UserWarning, match=r"channel ramp: its stamps are 3\.33 ms after those of the gyro"
    ):
        diagnosis = gyrostab.diagnose(log, nulls=100)
    assert diagnosis.effects[0]["name"] == "feedback_reset"
    assert [channel["name"] for channel in diagnosis.content["unused_channels"]] == ["humidity"]
    assert "- channel humidity is not used: no effect follows" in str(diagnosis)


def test_separate_files_are_diagnosed_like_one_file(recordings: Callable[[str], Path]):
    """The real ramp of a fiber-optic gyro, in a separate file."""
    path, ramp = (
        recordings("fog-blueseis-ramp/FOG.mseed"),
        recordings("fog-blueseis-ramp/RAMP.mseed"),
    )
    raw = gyrostab.read_log(
        [path],
        channel=[ramp],
        map={"HJ3": "gyro_z", "YR3": "ramp"},
        unit={"gyro": "1 nrad/s", "ramp": "1"},
    )
    aligned = align_channels(gyrostab.regularise(raw))
    assert aligned.log["ramp"].dims == ("time",)
    turns = reduce_log(aligned.log.isel(time=slice(0, 12_000)))["ramp_turns"].values
    assert -np.mean(turns) == pytest.approx(1502 / 360, rel=0.01)

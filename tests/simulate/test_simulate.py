"""Simulated logs: noise, effects, and the same bits whatever the chunks."""

from __future__ import annotations

import pickle
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import cloudpickle
import dask
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from gyrostab.allan.davar import davar
from gyrostab.errors import OptionError, SchemaError
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.make_log import make_log
from gyrostab.io.datasets import to_netcdf
from gyrostab.io.opening import open_log
from gyrostab.physics.registry import effects
from gyrostab.schema import check_log
from gyrostab.simulate import block, drivers, read_model, simulate
from gyrostab.simulate.block import Chain
from gyrostab.simulate.environment import ramps
from gyrostab.simulate.losses import gaps
from gyrostab.time.grid import time_coordinate
from tests.support.effect_bench import switch_off
from tests.support.simulated import BIASED, LOG, WORLD, every_channel, model

# --------------------------------------------------------------------------------
# logs


def test_the_model_on_the_page_can_be_simulated():
    page = Path(__file__).resolve().parents[2] / "docs" / "simulate.md"
    (example,) = re.findall(r"^```toml\n(.*?)^```$", page.read_text("utf-8"), re.M | re.S)
    log = simulate(tomllib.loads(example), duration="10s")
    assert set(log.data_vars) >= {"rate", "vibration", "temperature"}
    assert np.isfinite(log.rate.values).all()


def test_simulated_log_has_the_schema_of_a_log():
    log = simulate(model())
    check_log(log)
    assert dict(log.sizes)["time"] == 1800
    assert list(log.axis.values) == ["x", "y", "z"]
    assert log.time.values[0] == np.datetime64("2026-03-14T08:00:00")
    assert log.rate.chunks is not None
    assert {
        "vibration",
        "temperature",
        "rotation_rate",
        "accel_x",
        "supply_voltage",
        "light_power",
    } <= set(log.data_vars)
    table = gap_table(log)
    assert table[["seconds", "samples", "cause"]].values.tolist() == [
        [0.5, 10, "missing"],
        [5.0, 100, "restart"],
    ]
    missing = np.isnan(log.rate.values)
    assert missing.sum() == 3 * 110
    assert missing[:, 200:210].all()
    assert missing[:, 800:900].all()


def test_constant_rate_of_an_axis_is_rounded_and_clipped_with_the_noise():
    tables = {"noise": {"N": 0.003}, "log": {"rate": 10.0, "duration": "60s"}}
    plain = simulate(tables).rate.values
    biased = simulate(tables | {"bias": {"y": "0.002 deg/s"}}).rate.values
    np.testing.assert_allclose(biased - plain, [[0.0], [7.2], [0.0]] * np.ones(600), atol=1e-12)
    step = {"name": "rate_quantization", "step": 3.0}
    rounded = simulate(tables | {"bias": {"y": 7.2}, "effect": [step]}).rate.values
    np.testing.assert_array_equal(rounded, 3.0 * np.rint(biased / 3.0))
    with pytest.raises(OptionError, match=r"\[bias\]: y = 'much' is not a number|bias of y"):
        simulate(tables | {"bias": {"y": "much"}})


def test_simulated_log_is_written_and_analysed(tmp_path):
    log = simulate(model())
    back = open_log(to_netcdf(log, tmp_path / "log.nc"))
    np.testing.assert_array_equal(back.rate.values, log.rate.values)
    assert back.attrs["simulation_seed"] == 0
    surface = davar(back, window="30s", step="10s")
    assert np.isfinite(surface.avar.isel(tau=0)).all()


def test_noise_reaches_the_analysis_at_its_level():
    log = simulate({"noise": {"N": 0.02, "z": {"N": 0.04}}}, duration="1h", rate=50.0, seed=1)
    n = davar(log, window="1h", taus=[0.02]).avar.squeeze(("time", "tau")) ** 0.5 * np.sqrt(
        0.02 / 3600
    )
    np.testing.assert_allclose(n, [0.02, 0.02, 0.04], rtol=0.01)


@settings(max_examples=6)
@given(
    chunk=st.integers(150, 2500), seed=st.integers(0, 2**32), oversampling=st.sampled_from([1, 3])
)
def test_the_same_seed_gives_the_same_bits_whatever_the_chunks(chunk, seed, oversampling):
    tables = model(log=LOG | {"oversampling": oversampling})
    np.testing.assert_array_equal(
        simulate(tables, seed=seed, chunk=chunk).rate.values,
        simulate(tables, seed=seed).rate.values,
    )


def test_every_effect_gives_the_same_bits_whatever_the_chunks():
    world = every_channel(90.0)
    for name, kind in effects().items():
        plain = read_model(model(environment=[WORLD[5]], effect=[]))
        single = replace(plain, effects=(kind.example(),))
        whole, cut = (
            simulate(single, environment=world, chunk=chunk).rate.values for chunk in (1800, 331)
        )
        np.testing.assert_array_equal(cut, whole, err_msg=name)


def test_another_seed_gives_other_noise():
    assert np.all(
        simulate(model(), seed=1).rate.isel(time=5) != simulate(model(), seed=2).rate.isel(time=5)
    )


def test_oversampling_keeps_the_noise_of_the_log():
    size = {"duration": "30min", "rate": 20.0}
    for factor in (1, 4):
        log = simulate({"noise": {"N": 0.02, "K": 3.0}, "log": {"oversampling": factor}}, **size)
        variance = davar(log, window="30min", taus=["0.05s"]).avar.values.mean()
        assert variance == pytest.approx(0.02**2 * 3600 / 0.05 + 9 * 0.05 / 3600 / 3, rel=0.02)


# --------------------------------------------------------------------------------
# effects


def test_an_effect_alone_is_the_difference_of_two_runs():
    with_effects, without = simulate(model(), seed=5), simulate(model(effect=[]), seed=5)
    difference = (with_effects.rate - without.rate).values
    t = np.arange(1800) / 20
    bias = 0.02 * (np.interp(t, [0, 90], [20, 20 + 90 * 0.5]) - 25.0)
    present = ~np.isnan(difference[0])
    np.testing.assert_allclose(difference[0, present], bias[present], rtol=0, atol=1e-9)
    accel = np.interp(t, np.arange(2251) / 25, with_effects.accel_x.values)
    np.testing.assert_allclose(
        difference[1, present], (bias + 0.5 * accel)[present], rtol=0, atol=1e-9
    )


def test_zero_size_changes_nothing_whatever_the_effect():
    world = every_channel(90.0)
    plain = read_model(model(environment=[WORLD[5], WORLD[6]], effect=[]))
    before = simulate(plain, environment=world, seed=3).rate.values
    for name, kind in effects().items():
        off = replace(plain, effects=(switch_off(kind.example()),))
        np.testing.assert_array_equal(
            simulate(off, environment=world, seed=3).rate.values, before, err_msg=name
        )


def test_a_channel_in_the_wrong_unit_is_refused():
    wrong = [{"profile": "steps", "channel": "temperature", "unit": "V", "points": [[0, 1]]}]
    with pytest.raises(
        SchemaError, match="needs 'temperature' in degree_Celsius; the channel is in 'V'"
    ):
        simulate(model(environment=wrong, effect=BIASED[:1]))


def test_units_of_one_quantity_are_converted():
    """A rate in deg/h drives what wants deg/s."""
    turning = make_log(np.zeros((3, 100)), rate=10.0, unit="deg/h").assign(
        spin=("time", np.full(100, 3600.0 * 90.0), {"units": "degree hour-1"})
    )
    effect = [{"name": "scale_factor", "linear": 100.0, "driver": ["spin", "temperature"]}]
    scaled = simulate({"effect": effect}, like=turning)
    np.testing.assert_allclose(scaled.rate, 90 * 3600 * 1e-4, rtol=1e-9)


def test_a_channel_may_have_another_name():
    world = [
        {"profile": "steps", "channel": "coil_temperature", "unit": "degC", "points": [[0, 75]]}
    ]
    effect = [{"name": "temperature_bias", "sensitivity": 0.1, "driver": "coil_temperature"}]
    hot = simulate({"environment": world, "effect": effect}, duration="5s", rate=10.0)
    np.testing.assert_allclose(hot.rate.values, 5.0, rtol=1e-12)


def test_two_effects_of_one_name_add():
    world = [{"profile": "steps", "channel": "temperature", "unit": "degC", "points": [[0, 35]]}]
    log = simulate(
        {"environment": world, "effect": [BIASED[0], BIASED[0]]}, duration="5s", rate=10.0
    )
    np.testing.assert_allclose(log.rate.values, 0.4, rtol=1e-12)


def test_a_rate_may_be_a_number_of_numpy():
    assert simulate({"noise": {"N": 1}}, duration="1s", rate=np.int64(10)).sizes["time"] == 10


def test_one_number_per_axis_goes_to_the_axes_in_the_order_of_the_effect():
    jump = {"name": "bias_jump", "step": [1.0, 2.0], "axes": ["z", "x"]}
    log = simulate({"effect": [jump]}, duration="1s", rate=10.0)
    np.testing.assert_array_equal(log.rate.sel(axis=["x", "y", "z"]).values[:, 5], [2.0, 0.0, 1.0])


def add_sensor_noise(log, name, size):
    """Return a recording of which a channel has the noise of its sensor."""
    noise = size * np.random.default_rng(5).standard_normal(log[name].size)
    return log.assign({name: log[name].copy(data=log[name].values + noise)})


@pytest.mark.parametrize("long", [False, True])
@pytest.mark.parametrize(
    ("effect", "noise", "largest"),
    [
        ({"name": "shupe", "sensitivity": 0.5, "lag": 100.0, "sensor_lag": 20.0}, 0.05, 0.15),
        ({"name": "shupe", "sensitivity": 0.5, "lag": 1e-3}, 0.05, 0.2),
        ({"name": "thermal_hysteresis", "sensitivity": 0.1, "width": 2.0}, 0.5, 0.1),
    ],
)
def test_effects_follow_the_course_of_a_recorded_channel(monkeypatch, effect, noise, largest, long):
    """The noise of the sensor is neither amplified by a derivative nor taken for extremes."""
    heat = {
        "profile": "ramps",
        "channel": "temperature",
        "unit": "degC",
        "points": [[0, 25], [600, 25], [1200, 40], [1800, 40], [2400, 25], [3600, 25]],
    }
    tables = {"environment": [heat], "log": {"rate": 1.0, "duration": "1h", "axes": ["x"]}}
    truth = simulate(tables | {"effect": [effect]}).compute()
    recorded = add_sensor_noise(truth, "temperature", noise)
    if long:
        monkeypatch.setattr(drivers, "SHORT", 1000)
    follow = {"effect": [effect], "log": {"axes": ["x"]}}
    rates = simulate(follow, like=recorded).rate.values
    error = rates - truth.rate.values
    assert np.sqrt(np.mean(error**2)) < largest * np.std(truth.rate.values)
    np.testing.assert_array_equal(simulate(follow, like=recorded, chunk=257).rate.values, rates)


def test_noise_of_a_light_power_below_zero_is_not_followed():
    steps = {"profile": "light_power", "power": 1e-5, "points": [[0, 0], [900, 3], [1800, 0]]}
    tables = {"environment": [steps], "log": {"rate": 1.0, "duration": "1h", "axes": ["x"]}}
    truth = simulate(tables).compute()
    recorded = add_sensor_noise(truth, "light_power", 8e-6)
    assert recorded["light_power"].min() < 0.0
    noisy = {"name": "light_power_noise", "thermal": 0.5, "nominal": 1e-5}
    model = {"noise": {"N": 0.01}, "effect": [noisy], "log": {"axes": ["x"]}}
    rates, right = (simulate(model, like=recording).rate.values for recording in (recorded, truth))
    assert np.std(rates - right) < 0.1 * np.std(right)
    dark = recorded.assign(light_power=recorded["light_power"] * 0.0)
    dark["light_power"][:100] = 1e-5
    with pytest.warns(UserWarning, match="light_power"):
        simulate(model, like=dark)


def test_rotation_is_true_rate_on_its_axis():
    world = [{"profile": "rotation", "points": [[0, 90.0]], "axis": "z"}]
    log = simulate({"environment": world}, duration="5s", rate=10.0)
    np.testing.assert_allclose(log.rate.sel(axis="z"), 90.0 * 3600, rtol=1e-12)
    np.testing.assert_array_equal(log.rate.sel(axis="x"), 0.0)


# --------------------------------------------------------------------------------
# blocks


def test_chain_takes_each_step_once_and_resumes_from_a_state():
    steps_taken: list[int] = []

    def step(number: int, state: int) -> tuple[int, int]:
        steps_taken.append(number)
        return 10 * state, state + number

    chain = Chain(step, 1, 2000)
    whole = [chain(number) for number in range(2000)]
    assert steps_taken == list(range(2000))
    assert len(chain._states) <= block.STATES + 3 * block.RECENT
    steps_taken.clear()
    assert chain(1001) == whole[1001]
    assert len(steps_taken) <= 4  # 2000 steps, 512 states
    steps_taken.clear()
    assert [pickle.loads(pickle.dumps(Chain(_count, 1, 50)))(number) for number in (30, 7)] == [
        10 * (1 + 435),
        10 * (1 + 21),
    ]


def _count(number: int, state: int) -> tuple[int, int]:
    return 10 * state, state + number


def test_blocks_in_any_order_from_any_thread_are_those_of_the_whole():
    whole = simulate(model(), seed=2, chunk=100)
    second_run = simulate(model(), seed=2, chunk=100)
    backwards = [second_run.rate.data.blocks[0, k] for k in reversed(range(18))]
    parts = dask.compute(*backwards, scheduler="threads", num_workers=4)
    np.testing.assert_array_equal(np.concatenate(parts[::-1], axis=1), whole.rate.values)


def test_a_copy_in_another_process_gives_the_same(monkeypatch):
    # channels that are read stretch by stretch travel too
    monkeypatch.setattr(drivers, "SHORT", 100)
    log = simulate(model(), seed=2, chunk=300)
    late = log.rate.data[:, 1500:].compute()
    copy = cloudpickle.loads(cloudpickle.dumps(log.rate.data))
    np.testing.assert_array_equal(copy[:, 1500:].compute(), late)


def test_writing_in_pieces_makes_each_block_once(tmp_path, monkeypatch):
    made: list[int] = []
    step = block.next_block

    def counted(plan, state, first, count, units):
        made.append(first)
        return step(plan, state, first, count, units)

    monkeypatch.setattr(block, "next_block", counted)
    log = simulate({"noise": {"N": 0.01}}, duration="1h", rate=100.0, chunk=6000)
    for first in range(0, 360_000, 90_000):
        log.rate.isel(time=slice(first, first + 90_000)).compute()
    assert len(made) <= 60 + 3  # threads that come out of turn may make one again


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"seed": 1.5}, OptionError, "seed=1.5: give a whole number"),
        ({"seed": "a"}, OptionError, "seed='a': give a whole number"),
        ({"environment": xr.DataArray([1.0])}, SchemaError, "environment is a DataArray, not"),
        (
            {"environment": xr.Dataset({"temperature": ("time", [1.0, 2.0])})},
            SchemaError,
            "channel 'temperature' of the environment has .*'time': 2.*expected 'time_temperature'",
        ),
        (
            {"environment": xr.Dataset({"a": ("time_a", [1.0, 2.0])})},
            SchemaError,
            "'time_a' of the environment has no coordinate of times",
        ),
        (
            {"environment": xr.Dataset({"a": ("time", np.ones(100))}, {"time": np.arange(100)})},
            SchemaError,
            "'time' of the environment has no coordinate of times",
        ),
        (
            {"environment": xr.Dataset({"a": ("time", np.ones(100))}, time_coordinate(0, 20, 100))},
            SchemaError,
            "times of the environment are not those of the log.*10 Hz",
        ),
        (
            {"environment": ramps("a", "V", [[0, 1]], duration=9.0, start="2020-01-01")},
            SchemaError,
            "'a' of the environment is outside of the log, which begins at 1970.*from 2020",
        ),
        (
            {"environment": gaps([[1, 2], [3, 4]], start="2020-01-01")},
            SchemaError,
            "every gap of the environment is outside of the log",
        ),
        (
            {"environment": gaps([[1, 2]]).drop_vars("gap_cause")},
            SchemaError,
            "has gap_start, gap_end of a table of gaps, which needs",
        ),
        ({"chunk": 1.5}, OptionError, "chunk=1.5: give a whole number of samples"),
        ({"chunk": "1"}, OptionError, "chunk='1': give a whole number of samples"),
    ],
)
def test_arguments_of_a_wrong_kind_are_refused(options, error, words):
    with pytest.raises(error, match=words):
        simulate({"noise": {"N": 1}}, duration="10s", rate=10.0, **options)


def test_a_channel_on_the_samples_gets_the_times_of_the_log():
    warm = xr.Dataset({"temperature": ("time", np.arange(100.0), {"units": "degC"})})
    bias = {"name": "temperature_bias", "sensitivity": 1.0, "reference": 0.0}
    log = simulate(
        {"effect": [bias]}, duration="10s", rate=10.0, start="2026-01-01", environment=warm
    )
    np.testing.assert_allclose(log.rate.sel(axis="x"), np.arange(100.0), rtol=1e-12)
    assert str(log.time.values[1]) == "2026-01-01T00:00:00.100000000"
    like = simulate({"effect": [bias]}, like=log.drop_vars("temperature"), environment=warm)
    xr.testing.assert_identical(like.time, log.time)
    np.testing.assert_array_equal(like.rate, log.rate)


def test_the_rotation_of_the_environment_may_be_in_another_unit():
    turning = ramps("rotation_rate", "degree s-1", [[0, 6.0]], duration=10.0)
    turning.rotation_rate.attrs.update(units="rpm", rotation_axis="z")
    log = simulate({}, duration="10s", rate=10.0, environment=turning)
    np.testing.assert_allclose(log.rate.sel(axis="z"), 36.0 * 3600.0, rtol=1e-12)
    assert log.rotation_rate.units == "degree s-1"


# --------------------------------------------------------------------------------
# late channels


@pytest.mark.parametrize("own_stamps", [True, False])
@pytest.mark.parametrize(("delay", "step"), [(20.0, 40), (-15.0, 75)])
def test_effects_take_a_late_channel_earlier(own_stamps: bool, delay: float, step: int) -> None:
    """A step that the channel shows after 60 s; the log keeps the channel as it is."""
    world = ramps("temperature", "degC", [[0, 0], [59.9, 0], [60, 10], [120, 10]], duration=120.0)
    recorded = make_log(np.zeros((1, 120)), rate=1.0, unit="deg/h", start="1970-01-01")
    if own_stamps:
        recorded = recorded.assign_coords(world.coords).assign(world.data_vars)
    else:
        values = world["temperature"].values[:120]
        recorded = recorded.assign(temperature=("time", values, world["temperature"].attrs))
    effect = {"name": "temperature_bias", "sensitivity": 1.0, "reference": 0.0}
    late = {"effect": [effect], "delay": {"temperature": delay}}
    log = simulate(late, like=recorded)
    expected = np.where(np.arange(120) < step, 0.0, 10.0)
    np.testing.assert_allclose(log["rate"].values[0], expected, atol=1e-9)
    xr.testing.assert_equal(log["temperature"], recorded["temperature"])

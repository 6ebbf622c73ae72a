"""Simulated logs: models, effects, chunks, environments, recordings as patterns, the command."""

from __future__ import annotations

import itertools
import pickle
import re
import tomllib
from dataclasses import replace
from typing import Any

import cloudpickle
import dask
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from gyrostab.cli import main
from gyrostab.davar import davar
from gyrostab.errors import FormatError, OptionError, SchemaError
from gyrostab.export import open_log, to_netcdf
from gyrostab.log import make_log
from gyrostab.physics.registry import effects
from gyrostab.regularise import gap_table
from gyrostab.run import load_log
from gyrostab.schema import check_log
from gyrostab.simulate import combine, drivers, lazy, read_model, simulate
from gyrostab.simulate import environment as env
from gyrostab.simulate.lazy import Chain
from gyrostab.simulate.losses import gaps, losses, power_cuts
from gyrostab.simulate.model import PROFILES
from gyrostab.timegrid import time_coordinate

from .conftest import ROOT

NOISE = {"Q": 0.06, "N": 0.006, "B": 0.03, "K": 0.05, "z": {"N": 0.004, "R": 0.3}}
WORLD = [
    {"profile": "vibration", "points": [[0, 0.02], [30, 8.0], [60, 0.02]]},
    {"profile": "ramps", "channel": "temperature", "unit": "degC", "points": [[0, 20], [90, 65]]},
    {"profile": "rotation", "points": [[0, 0.0], [20, 90.0]], "stick_slip": 0.5, "sensor_rate": 25},
    {"profile": "supply", "life": "2 min"},
    {"profile": "light_power", "loss": 1000},
    {"profile": "power_cuts", "cuts": [[40, 45]]},
    {"profile": "gaps", "spans": [[10, 10.5]]},
]
LOG = {"rate": 20, "duration": "90 s", "start": "2026-03-14T08:00:00"}
BIASED = [{"name": "temperature_bias", "sensitivity": 0.02}, {"name": "g_sensitivity", "x": 0.5, "axes": ["y"]}]


def model(**change: Any) -> dict[str, Any]:
    return {"log": LOG, "noise": NOISE, "environment": WORLD, "effect": BIASED} | change


def every_channel(duration: float) -> xr.Dataset:
    """Each channel that some effect asks for by its own name, so that none lacks its driver."""
    typical = {"degree_Celsius": 60.0, "g": 1.0, "degree s-1": 90.0, "V": 24.0, "W": 1e-4, "uT": 30.0, "Pa": 1e7, "1": 0.5}
    units = {name: unit for kind in effects().values() for name, unit in kind.channels.items()}
    units |= {"accel_x": "g"}
    return combine(
        *(
            env.ramps(name, unit, [[0, typical.get(unit, 1.0)], [duration, 1.3 * typical.get(unit, 1.0)]], duration=duration)
            for name, unit in units.items()
        )
    )


# ------------------------------------------------------------------------------------------------------------------- logs


def test_it_is_a_log_like_any_other():
    log = simulate(model())
    check_log(log)
    assert dict(log.sizes)["time"] == 1800
    assert list(log.axis.values) == ["x", "y", "z"]
    assert log.time.values[0] == np.datetime64("2026-03-14T08:00:00")
    assert log.rate.chunks is not None
    assert {"vibration", "temperature", "rotation_rate", "accel_x", "supply_voltage", "light_power"} <= set(log.data_vars)
    table = gap_table(log)
    assert table[["seconds", "samples", "cause"]].values.tolist() == [[0.5, 10, "missing"], [5.0, 100, "restart"]]
    missing = np.isnan(log.rate.values)
    assert missing.sum() == 3 * 110
    assert missing[:, 200:210].all()
    assert missing[:, 800:900].all()


def test_it_goes_through_file_and_analysis(tmp_path):
    log = simulate(model())
    back = open_log(to_netcdf(log, tmp_path / "log.nc"))
    np.testing.assert_array_equal(back.rate.values, log.rate.values)
    assert back.attrs["simulation_seed"] == 0
    surface = davar(back, window="30s", step="10s")
    assert np.isfinite(surface.avar.isel(tau=0)).all()


def test_noise_reaches_the_analysis_at_its_level():
    log = simulate({"noise": {"N": 0.02, "z": {"N": 0.04}}}, duration="1h", rate=50.0, seed=1)
    n = davar(log, window="1h", taus=[0.02]).avar.squeeze(("time", "tau")) ** 0.5 * np.sqrt(0.02 / 3600)
    np.testing.assert_allclose(n, [0.02, 0.02, 0.04], rtol=0.01)


@settings(max_examples=6, deadline=None)
@given(chunk=st.integers(150, 2500), seed=st.integers(0, 2**32), oversampling=st.sampled_from([1, 3]))
def test_the_same_seed_gives_the_same_bits_whatever_the_chunks(chunk, seed, oversampling):
    one = model(log=LOG | {"oversampling": oversampling})
    np.testing.assert_array_equal(simulate(one, seed=seed, chunk=chunk).rate.values, simulate(one, seed=seed).rate.values)


def test_every_effect_gives_the_same_bits_whatever_the_chunks():
    world = every_channel(90.0)
    for name, kind in effects().items():
        plain = read_model(model(environment=[WORLD[5]], effect=[]))
        one = replace(plain, effects=(kind.example(),))
        whole, cut = (simulate(one, environment=world, chunk=chunk).rate.values for chunk in (1800, 331))
        np.testing.assert_array_equal(cut, whole, err_msg=name)


def test_another_seed_gives_other_noise():
    assert np.all(simulate(model(), seed=1).rate.isel(time=5) != simulate(model(), seed=2).rate.isel(time=5))


def test_a_slice_is_that_of_the_whole():
    log = simulate(model(), chunk=200)
    np.testing.assert_array_equal(log.rate.isel(time=slice(950, 960)).values, log.rate.values[:, 950:960])


def test_oversampling_keeps_the_noise_of_the_log():
    size = {"duration": "30min", "rate": 20.0}
    for factor in (1, 4):
        log = simulate({"noise": {"N": 0.02, "K": 3.0}, "log": {"oversampling": factor}}, **size)
        found = davar(log, window="30min", taus=["0.05s"]).avar.values.mean()
        assert found == pytest.approx(0.02**2 * 3600 / 0.05 + 9 * 0.05 / 3600 / 3, rel=0.02)


# ---------------------------------------------------------------------------------------------------------------- effects


def test_an_effect_alone_is_the_difference_of_two_runs():
    with_effects, without = simulate(model(), seed=5), simulate(model(effect=[]), seed=5)
    alone = (with_effects.rate - without.rate).values
    t = np.arange(1800) / 20
    bias = 0.02 * (np.interp(t, [0, 89], [20, 20 + 89 * 0.5]) - 25.0)
    present = ~np.isnan(alone[0])
    np.testing.assert_allclose(alone[0, present], bias[present], rtol=0, atol=1e-9)
    accel = np.interp(t, np.arange(2250) / 25, with_effects.accel_x.values)
    np.testing.assert_allclose(alone[1, present], (bias + 0.5 * accel)[present], rtol=0, atol=1e-9)


def test_zero_size_changes_nothing_whatever_the_effect():
    world = every_channel(90.0)
    plain = read_model(model(environment=[WORLD[5], WORLD[6]], effect=[]))
    before = simulate(plain, environment=world, seed=3).rate.values
    for name, kind in effects().items():
        off = replace(plain, effects=(kind.example().switched_off(),))
        np.testing.assert_array_equal(simulate(off, environment=world, seed=3).rate.values, before, err_msg=name)


def test_each_effect_without_its_channel_says_so():
    for name, kind in effects().items():
        needs = kind.example().needs()
        if not needs:
            continue
        bare = replace(read_model({"noise": {"N": 0.01}}), effects=(kind.example(),))
        with pytest.raises(SchemaError, match=f"effect '{name}' needs the channel '{needs[0]}'.*there are no channels"):
            simulate(bare, duration="10s", rate=10.0)


def test_a_channel_in_the_wrong_unit_is_refused():
    wrong = [{"profile": "steps", "channel": "temperature", "unit": "V", "points": [[0, 1]]}]
    with pytest.raises(SchemaError, match="needs 'temperature' in degree_Celsius; the channel is in 'V'"):
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
    world = [{"profile": "steps", "channel": "coil_temperature", "unit": "degC", "points": [[0, 75]]}]
    effect = [{"name": "temperature_bias", "sensitivity": 0.1, "driver": "coil_temperature"}]
    hot = simulate({"environment": world, "effect": effect}, duration="5s", rate=10.0)
    np.testing.assert_allclose(hot.rate.values, 5.0, rtol=1e-12)


def test_two_effects_of_one_name_add():
    world = [{"profile": "steps", "channel": "temperature", "unit": "degC", "points": [[0, 35]]}]
    log = simulate({"environment": world, "effect": [BIASED[0], BIASED[0]]}, duration="5s", rate=10.0)
    np.testing.assert_allclose(log.rate.values, 0.4, rtol=1e-12)


def test_turning_is_true_rate_on_its_axis():
    world = [{"profile": "rotation", "points": [[0, 90.0]], "axis": "z"}]
    log = simulate({"environment": world}, duration="5s", rate=10.0)
    np.testing.assert_allclose(log.rate.sel(axis="z"), 90.0 * 3600, rtol=1e-12)
    np.testing.assert_array_equal(log.rate.sel(axis="x"), 0.0)


# ----------------------------------------------------------------------------------------------------------------- models


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"effects": []}, r"no section 'effects' \(did you mean 'effect'\?\); there are \[log\]"),
        ({"effect": {"name": "shupe"}}, r"write effect as \[\[effect\]\]"),
        ({"noise": {"W": 1}}, r"no noise term 'W'; there are Q \[urad\], N \[deg/sqrt\(h\)\]"),
        ({"noise": {"N": "3 m"}}, r"the unit 'm' is not known here; give the number in deg/sqrt\(h\)"),
        ({"noise": {"x": {"N": -1}}}, r"\[noise.x\]: N = -1 is not a number from 0 up"),
        ({"noise": {"flicker_band": 3}}, "flicker_band is 3; write"),
        ({"log": {"rat": 10}}, r"\[log\]: there is no 'rat' \(did you mean 'rate'\?\); there are rate, duration"),
        ({"log": LOG | {"seed": 1.5}}, "seed = 1.5 is not a whole number"),
        ({"log": {"duration": "1h"}}, "there is no rate; give rate = 100"),
        ({"log": {"rate": 100}}, "there is no duration; give duration = 1h"),
        ({"log": LOG | {"rate": "fast"}}, "'fast' is not a number with a unit"),
        ({"log": LOG | {"axes": ["x"]}}, "effect 'g_sensitivity': the log has no axis 'y'; it has x"),
        ({"environment": [{}]}, "an environment has no profile; there are steps, ramps, vibration"),
        ({"environment": [{"profile": "vibratoin"}]}, "no profile 'vibratoin' .did you mean 'vibration'"),
        ({"environment": [{"profile": "chamber", "speeed": 1}]}, r"no parameter 'speeed' .did you mean 'speed'.*speed \[degC/min\]"),
        ({"environment": [{"profile": "vibration"}]}, "lacks 'points'"),
        ({"environment": [{"profile": "vibration", "points": [[5, 1], [0, 1]]}]}, "do not rise"),
        ({"environment": [{"profile": "vibration", "points": [1, 2]}]}, "is not a list of .time .s., vibration .g.."),
        ({"environment": [WORLD[0], WORLD[0]]}, "the channel 'vibration' twice"),
        ({"environment": [WORLD[1] | {"channel": 3}]}, "channel = 3 is not text"),
        ({"environment": [WORLD[5] | {"cuts": 3}]}, "cuts = 3 is not a list"),
        ({"environment": ["chamber"]}, "environment 1 is 'chamber', not a table"),
        ({"effect": [BIASED[0] | {"axes": 3}]}, "axes = 3 is not a list of names"),
        ({"effect": [BIASED[0] | {"driver": [3]}]}, r"driver = \[3\] is not a list of names"),
        ({"log": LOG | {"axes": ["x", "x"]}}, "is not a list of different names"),
        ({"log": LOG | {"duration": 1e300}}, "a duration of 1e.300 is not one"),
        ({"environment": [{"profile": "losses", "per_hour": 1e300}]}, "at most 1e8 gaps"),
        ({"environment": [{"profile": "losses", "seed": "x"}]}, "seed='x': give a whole number"),
        ({"environment": [{"profile": "chamber", "lag": "5 m"}]}, "the unit 'm' is not known here; give the number in s"),
    ],
)
def test_a_wrong_model_is_explained(wrong, words):
    with pytest.raises(OptionError, match=words):
        simulate(model(**wrong))


def test_a_wrong_effect_names_file_and_place(tmp_path):
    path = tmp_path / "m.toml"
    path.write_text('[noise]\nN = 1\n[[effect]]\nname = "temperature_bias"\nsensitivity = 1\n[[effect]]\nname = "shuppe"\n')
    with pytest.raises(
        OptionError, match=rf"{re.escape(str(path))}, effect 2: there is no effect 'shuppe'.*; there are .*temperature_bias"
    ):
        read_model(path)
    path.write_text("[noise\n")
    with pytest.raises(FormatError, match="not a TOML file"):
        read_model(path)
    with pytest.raises(FormatError, match="cannot be read"):
        read_model(tmp_path / "none.toml")


def test_axes_come_from_the_model():
    assert read_model({"noise": {"x": {"N": 1}, "w": {"N": 1}}}).axes == ("x", "w")
    assert read_model({"noise": {"N": 1, "x": {"N": 2}}}).axes == ()
    assert list(simulate({"noise": {"x": {"N": 1}}}, duration="1s", rate=10.0).axis.values) == ["x"]


def test_units_are_converted():
    made = read_model({"noise": {"Q": "1 arcsec", "B": "0.001 deg/s"}, "log": {"duration": "2 min", "rate": "1 kHz"}})
    assert made.coefficients("x")["Q"] == pytest.approx(np.pi / 180 / 3600 * 1e6)
    assert made.coefficients("x")["B"] == pytest.approx(3.6)
    assert made.log == {"duration": 120.0, "rate": 1000.0}


# ----------------------------------------------------------------------------------------------------------- environments


def test_chamber_is_the_test_of_li_et_al():
    """-40 to 60 degC at 1 degC/min with half an hour at each end, and back."""
    t = env.chamber(duration="260min").temperature.values
    assert t[: 1800 + 1].tolist() == [-40.0] * 1801
    np.testing.assert_allclose(np.diff(t[1800:7800]), 1 / 60, rtol=1e-9)
    assert t[7800:9601].tolist() == [60.0] * 1801
    np.testing.assert_allclose(np.diff(t[9600:15600]), -1 / 60, rtol=1e-9)


def test_a_lag_is_that_of_a_first_order_response():
    """On a ramp of r the response trails by r times the lag, once the start is forgotten: exactly, with the known transient."""
    lag, t = 300.0, np.arange(6000.0)
    felt = env.chamber(duration="130min", low=-40, high=60, hold=1, lag=lag).temperature.values[1:6001]
    np.testing.assert_allclose(felt, -40 + (t - lag * (1 - np.exp(-t / lag))) / 60, rtol=0, atol=1e-9)


def test_trip_reaches_the_rock_and_circulation_cools_it():
    down = env.trip([[0, 0], [36000, 3000]], duration="40h", gradient=30, surface=15, circulation=[[90000, 144000]], cooling=0.4)
    assert down.temperature.values[89999] == pytest.approx(105.0, abs=0.01)
    assert down.temperature.values[-1] == pytest.approx(15 + 0.6 * 90, abs=0.01)
    middle = down.temperature.values[18000:30000]
    np.testing.assert_allclose(np.diff(middle) * 60, 300 * 0.03 / 60, rtol=1e-6)  # 300 m/h: 0.15 degC/min


@pytest.mark.parametrize("stick_slip", [0.0, 1.0])
def test_toolface_is_the_integral_of_the_rate(stick_slip):
    turning = env.rotation(
        [[0, 0], [3, 40], [8, 400], [10, 400]], duration=15.0, stick_slip=stick_slip, period=2.7, sensor_rate=2000, inclination=90
    )
    rate = turning.rotation_rate.values
    angle = np.concatenate([[0], np.cumsum((rate[1:] + rate[:-1]) / 2) / 2000])
    np.testing.assert_allclose(turning.accel_x.values, np.cos(np.radians(angle)), atol=1e-5)
    np.testing.assert_allclose(turning.accel_y.values, -np.sin(np.radians(angle)), atol=1e-5)
    assert rate.min() >= 0.0
    np.testing.assert_allclose(turning.accel_z.values, 0.0, atol=1e-12)


def test_a_tool_that_hangs_plumb_feels_gravity_on_its_axis():
    still = env.rotation([[0, 0]], duration=1.0, inclination=0.0)
    assert (still.accel_z.values == -1.0).all()  # z points down; what holds the tool pushes up
    np.testing.assert_allclose(still.accel_x.values, 0.0, atol=1e-15)


def test_light_power_is_a_loss_in_decibel():
    light = env.light_power(duration="1000h", power=1e-4, loss=3.0, sensor_rate=0.01).light_power.values
    assert 10 * np.log10(light[0] / light[-1]) == pytest.approx(3.0, abs=1e-3)


def test_losses_have_their_rate_and_length_and_come_in_bursts():
    steady = losses(duration="500h", per_hour=5, bursts_per_hour=0, mean=3.0, seed=2)
    length = (steady.gap_end - steady.gap_start).values / np.timedelta64(1, "s")
    assert length.size == pytest.approx(2500, rel=0.08)
    assert length.mean() == pytest.approx(3.0, rel=0.08)
    burst = losses(duration="500h", per_hour=5, bursts_per_hour=1, burst=120, within=50, seed=2)
    counts = np.histogram(burst.gap_start.values.astype(np.int64) / 3.6e12, np.arange(501))[0]
    assert counts.var() > 2 * counts.mean()  # a Poisson process has them equal
    assert counts.mean() == pytest.approx(5 + 49 * 5 * 120 / 3600, rel=0.25)


def test_random_power_cuts_are_restarts():
    cut = power_cuts(duration="240h", per_day=4, seed=1)
    assert cut.sizes["gap"] == pytest.approx(40, abs=20)
    log = simulate({"noise": {"N": 1}}, duration="240h", rate=0.1, environment=cut)
    assert set(gap_table(log).cause) == {"restart"}


def test_gaps_that_overlap_are_one():
    world = combine(gaps([[1, 3], [2, 5]]), power_cuts([[4.5, 6]], duration=10.0))
    table = gap_table(simulate({"noise": {"N": 1}}, duration="10s", rate=10.0, environment=world))
    assert table[["seconds", "cause"]].values.tolist() == [[5.0, "restart"]]


# ------------------------------------------------------------------------------------------------- channels and recordings


@settings(max_examples=20, deadline=None)
@given(
    cuts=st.lists(st.integers(1, 399), max_size=6, unique=True),
    rate=st.sampled_from([0.7, 7.0, 20.0, 33.0]),
    held=st.booleans(),
    seed=st.integers(0, 99),
)
def test_a_long_channel_does_not_depend_on_the_chunks(cuts, rate, held, seed):
    """Read stretch by stretch, with holes, at another rate: each piece as from the whole, and as by plain interpolation."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=int(25 * rate))
    values[rng.random(values.size) < 0.2] = np.nan
    values[rng.integers(values.size)] = 1.0
    good = ~np.isnan(values)
    source = drivers.Source("a", "1", held, None, values, start=0, rate=rate, first=float(values[good][0]), size=values.size)
    instants = np.rint(np.arange(400) * 1e9 / 20.0).astype(np.int64)

    def run(edges: list[int]) -> np.ndarray:
        carry, parts = None, []
        for first, end in itertools.pairwise(edges):
            stretch = source.stretch(int(instants[max(first - 1, 0)]), int(instants[end - 1]))
            piece, carry = source.at(instants[first:end], (stretch, values[stretch.low : stretch.high]), carry)
            parts.append(piece)
        return np.concatenate(parts)

    whole = run([0, 400])
    np.testing.assert_array_equal(run([0, *sorted(cuts), 400]), whole)
    filled = np.where(good, values, np.nan)
    last = float(values[good][0])
    for number, value in enumerate(filled):
        last = value if good[number] else last
        filled[number] = last
    position = instants * rate / 1e9
    plain = (
        filled[np.minimum((position + 1e-6).astype(int), filled.size - 1)] if held else np.interp(position, np.arange(filled.size), filled)
    )
    np.testing.assert_allclose(whole, plain, atol=1e-5)


def test_long_channels_drive_as_short_ones(monkeypatch):
    before = simulate(model(), seed=1).rate.values
    monkeypatch.setattr(drivers, "SHORT", 100)
    np.testing.assert_allclose(simulate(model(), seed=1, chunk=170).rate.values, before, rtol=0, atol=1e-9)


def test_a_log_like_a_recording_has_its_stamps_gaps_and_channels():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(2, 2000))
    values[0, 300:350] = np.nan
    values[:, 1500] = np.nan
    full = 40.0 + np.arange(2000) / 100
    recorded = make_log(
        values, rate=33.3, unit="deg/h", start="2025-05-05T05:05:05.123456789", axis=["u", "v"], channels={"temperature": (full, "degC")}
    )
    slow = time_coordinate(1_746_421_505_000_000_000, 0.5, 40, name="time_vibration")
    recorded = recorded.assign(vibration=("time_vibration", np.ones(40), {"units": "g"})).assign_coords(slow)
    effect = [{"name": "temperature_bias", "sensitivity": 1.0, "reference": 40.0, "axes": ["v"]}]
    log = simulate({"noise": {"N": 0.01}, "effect": effect}, like=recorded, chunk=333)
    assert (log.time.values == recorded.time.values).all()
    np.testing.assert_array_equal(np.isnan(log.rate), np.isnan(recorded.rate))
    xr.testing.assert_identical(log.temperature.drop_vars("axis", errors="ignore"), recorded.temperature)
    xr.testing.assert_identical(log.vibration, recorded.vibration)
    plain = simulate({"noise": {"N": 0.01}}, like=recorded)
    np.testing.assert_allclose((log.rate - plain.rate).sel(axis="v").dropna("time"), np.delete(full - 40, 1500), atol=1e-6)
    with pytest.raises(OptionError, match="rate is taken from the recording"):
        simulate({"noise": {"N": 0.01}}, like=recorded, rate=10.0)
    with pytest.raises(OptionError, match="no axis 'x' in this log; it has u, v"):
        simulate({"noise": {"x": {"N": 0.01}}}, like=recorded)


# ---------------------------------------------------------------------------------------------------------------- command


def test_command_writes_a_log_that_run_takes(tmp_path, capsys):
    path = tmp_path / "m.toml"
    path.write_text(
        '[noise]\nN = 0.02\n[[environment]]\nprofile = "chamber"\n[[effect]]\nname = "temperature_bias"\nsensitivity = 0.01\naxes = "x"\n'
    )
    out = tmp_path / "log.nc"
    options = ["--duration", "2min", "--rate", "50", "--seed", "3", "--quiet-progress"]
    assert main(["simulate", str(path), "-o", str(out), *options]) == 0
    log = open_log(out)
    assert log.sizes["time"] == 6000
    np.testing.assert_array_equal(log.rate.values, simulate(path, duration="2min", rate=50.0, seed=3).rate.values)
    assert main(["run", str(out), "-o", str(tmp_path / "p.nc"), "--window", "30s", "--quiet-progress"]) == 0
    again = tmp_path / "again.nc"
    assert main(["simulate", str(path), "-o", str(again), "--like", str(out), "--seed", "3", "--quiet-progress"]) == 2  # temperature twice
    assert "the channel 'temperature' twice" in capsys.readouterr().err
    path.write_text("[noise]\nN = 0.02\n")
    assert main(["simulate", str(path), "-o", str(again), "--like", str(out), "--seed", "3", "--quiet-progress"]) == 0
    assert (open_log(again).time.values == log.time.values).all()


def test_command_explains_a_wrong_model(tmp_path, capsys):
    path = tmp_path / "m.toml"
    path.write_text('[noise]\nN = 0.02\n[[effect]]\nname = "temperature_bias"\n')
    assert main(["simulate", str(path), "-o", str(tmp_path / "log.nc"), "--duration", "1min", "--rate", "10"]) == 2
    said = capsys.readouterr().err
    assert "lacks the parameter 'sensitivity'" in said
    assert "Traceback" not in said
    assert not (tmp_path / "log.nc").exists()


# ----------------------------------------------------------------------------------------------------------- shipped models

MODELS = sorted((ROOT / "data" / "models").glob("*.toml"))


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.stem)
def test_shipped_models_make_logs(path):
    log = simulate(path)
    check_log(log)
    values = log.rate.isel(time=slice(0, 500)).values
    assert np.isfinite(values).all()
    assert (values.std(axis=1) > 0).all()


def test_shipped_models_are_all_there():
    assert {"p16_vibration", "l13_vibration", "l13_temperature", "mwd_24h"} <= {path.stem for path in MODELS}


def test_p16_has_its_timeline():
    log = simulate(ROOT / "data" / "models" / "p16_vibration.toml")
    assert log.attrs["sampling_rate_hz"] == 400
    assert log.sizes["time"] == 930 * 400
    assert gap_table(log)[["seconds", "samples"]].values.tolist() == [[18.0, 7200]]
    shaken = log.vibration.values > 1
    assert (np.flatnonzero(shaken)[[0, -1]] == [330, 629]).all()
    x = log.rate.sel(axis="x").values.reshape(93, 4000)
    assert np.nanstd(x[33:43]) > 3 * np.nanstd(x[:33])


def test_the_model_in_the_guide_is_a_model():
    text = (ROOT / "docs" / "simulate.md").read_text(encoding="utf-8")
    table = tomllib.loads(text.split("```toml\n")[1].split("```")[0])
    made = read_model(table)
    assert made.log["oversampling"] == 1
    with pytest.raises(SchemaError, match="needs the channel 'temperature'"):
        simulate(table)


def test_the_guide_lists_every_profile():
    text = (ROOT / "docs" / "simulate.md").read_text(encoding="utf-8")
    for name in PROFILES:
        assert f"`{name}`" in text


# ----------------------------------------------------------------------------------------------------------------- blocks


def test_a_chain_takes_each_step_once_and_goes_back_from_a_state_on_its_way():
    taken: list[int] = []

    def step(number: int, state: int) -> tuple[int, int]:
        taken.append(number)
        return 10 * state, state + number

    chain = Chain(step, 1, 2000)
    whole = [chain(number) for number in range(2000)]
    assert taken == list(range(2000))
    taken.clear()
    assert chain(1001) == whole[1001]
    assert len(taken) <= 4  # 2000 steps, 512 states
    taken.clear()
    assert [pickle.loads(pickle.dumps(Chain(_count, 1, 50)))(number) for number in (30, 7)] == [10 * (1 + 435), 10 * (1 + 21)]


def _count(number: int, state: int) -> tuple[int, int]:
    return 10 * state, state + number


def test_blocks_in_any_order_from_any_thread_are_those_of_the_whole():
    whole = simulate(model(), seed=2, chunk=100)
    again = simulate(model(), seed=2, chunk=100)
    backwards = [again.rate.data.blocks[0, k] for k in reversed(range(18))]
    parts = dask.compute(*backwards, scheduler="threads", num_workers=4)
    np.testing.assert_array_equal(np.concatenate(parts[::-1], axis=1), whole.rate.values)


def test_a_copy_in_another_process_gives_the_same(monkeypatch):
    monkeypatch.setattr(drivers, "SHORT", 100)  # channels that are read stretch by stretch travel too
    log = simulate(model(), seed=2, chunk=300)
    late = log.rate.data[:, 1500:].compute()
    copy = cloudpickle.loads(cloudpickle.dumps(log.rate.data))
    np.testing.assert_array_equal(copy[:, 1500:].compute(), late)


def test_writing_in_pieces_makes_each_block_once(tmp_path, monkeypatch):
    made: list[int] = []
    step = lazy.next_block

    def counted(plan, state, first, count, units, parts):
        made.append(first)
        return step(plan, state, first, count, units, parts)

    monkeypatch.setattr(lazy, "next_block", counted)
    log = simulate({"noise": {"N": 0.01}}, duration="1h", rate=100.0, chunk=6000)
    for first in range(0, 360_000, 90_000):
        log.rate.isel(time=slice(first, first + 90_000)).compute()
    assert len(made) <= 60 + 3  # threads that come out of turn may make one again


# ------------------------------------------------------------------------------------------------------------- recordings


def test_like_a_real_recording(recordings, tmp_path):
    """Stamps, gaps, restarts and channels are the recording's; the temperature it measured drives an effect."""
    path = recordings("fog-hybrid-warmup/run1_static.txt")
    names = {"wx": "gyro_x", "wy": "gyro_y", "wz": "gyro_z", "Tx": "temperature"}
    units = {"gyro": "deg/s", "time": "s", "temperature": "degC"}
    recorded = load_log([path], map=names, unit=units)
    toml = tmp_path / "m.toml"
    toml.write_text("[noise]\nN = 0.01\n[[effect]]\nname = 'temperature_bias'\nsensitivity = 2\naxes = 'z'\n")
    out = tmp_path / "twin.nc"
    given = [word for key, value in names.items() for word in ("--map", f"{key}={value}")]
    given += [word for key, value in units.items() for word in ("--unit", f"{key}={value}")]
    assert main(["simulate", str(toml), "-o", str(out), "--like", str(path), *given, "--quiet-progress"]) == 0
    twin = open_log(out)
    np.testing.assert_array_equal(twin.time.values, recorded.time.values)
    np.testing.assert_array_equal(np.isnan(twin.rate.values), np.isnan(recorded.rate.values))
    np.testing.assert_array_equal(twin.temperature.values, recorded.temperature.values)
    restarts = gap_table(recorded).query("cause == 'restart'")
    assert gap_table(twin).query("cause == 'restart'").start.tolist() == restarts.start.tolist()
    bias = davar(twin, window="20s", step="20s", taus=[1.0])
    np.testing.assert_allclose(bias.window_mean.sel(axis="z"), 2 * (bias.temperature - 25), atol=1.0)

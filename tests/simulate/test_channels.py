"""Channels that drive a simulation, made or recorded, and recordings as patterns of a log."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from gyrostab.allan.davar import davar
from gyrostab.cli import main
from gyrostab.errors import OptionError
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.make_log import make_log
from gyrostab.io.opening import open_log
from gyrostab.jobs.run import load_log
from gyrostab.simulate import drivers, simulate
from gyrostab.time.grid import time_coordinate
from tests.support.simulated import model


@settings(max_examples=20)
@given(
    cuts=st.lists(st.integers(1, 399), max_size=6, unique=True),
    rate=st.sampled_from([0.7, 7.0, 20.0, 33.0]),
    held=st.booleans(),
    seed=st.integers(0, 99),
)
def test_a_long_channel_does_not_depend_on_the_chunks(cuts, rate, held, seed):
    """Parts of a channel with gaps equal those of the whole, and plain interpolation."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=int(25 * rate))
    values[rng.random(values.size) < 0.2] = np.nan
    values[rng.integers(values.size)] = 1.0
    good = ~np.isnan(values)
    source = drivers.DriverChannel(
        "a",
        "1",
        held,
        None,
        values,
        start=0,
        rate=rate,
        first=float(values[good][0]),
        size=values.size,
    )
    instants = np.rint(np.arange(400) * 1e9 / 20.0).astype(np.int64)

    def run(edges: list[int]) -> np.ndarray:
        carry, parts = None, []
        for first, end in itertools.pairwise(edges):
            before = int(instants[max(first - 1, 0)])
            piece, carry = source.at(instants[first:end], carry, before=before)
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
        filled[np.minimum((position + 1e-6).astype(int), filled.size - 1)]
        if held
        else np.interp(position, np.arange(filled.size), filled)
    )
    np.testing.assert_allclose(whole, plain, atol=1e-5)


def test_long_channels_drive_as_short_ones(monkeypatch):
    before = simulate(model(), seed=1).rate.values
    monkeypatch.setattr(drivers, "SHORT", 100)
    np.testing.assert_allclose(
        simulate(model(), seed=1, chunk=170).rate.values, before, rtol=0, atol=1e-9
    )


def test_a_log_like_a_recording_has_its_stamps_gaps_and_channels():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(2, 2000))
    values[0, 300:350] = np.nan
    values[:, 1500] = np.nan
    full = 40.0 + np.arange(2000) / 100
    recorded = make_log(
        values,
        rate=33.3,
        unit="deg/h",
        start="2025-05-05T05:05:05.123456789",
        axis=["u", "v"],
        channels={"temperature": (full, "degC")},
    )
    slow = time_coordinate(1_746_421_505_000_000_000, 0.5, 40, name="time_vibration")
    recorded = recorded.assign(
        vibration=("time_vibration", np.ones(40), {"units": "g"})
    ).assign_coords(slow)
    effect = [{"name": "temperature_bias", "sensitivity": 1.0, "reference": 40.0, "axes": ["v"]}]
    log = simulate({"noise": {"N": 0.01}, "effect": effect}, like=recorded, chunk=333)
    assert (log.time.values == recorded.time.values).all()
    np.testing.assert_array_equal(np.isnan(log.rate), np.isnan(recorded.rate))
    xr.testing.assert_identical(
        log.temperature.drop_vars("axis", errors="ignore"), recorded.temperature
    )
    xr.testing.assert_identical(log.vibration, recorded.vibration)
    plain = simulate({"noise": {"N": 0.01}}, like=recorded)
    np.testing.assert_allclose(
        (log.rate - plain.rate).sel(axis="v").dropna("time"), np.delete(full - 40, 1500), atol=1e-6
    )
    with pytest.raises(OptionError, match="rate is taken from the recording"):
        simulate({"noise": {"N": 0.01}}, like=recorded, rate=10.0)
    with pytest.raises(OptionError, match="no axis 'x' in this log; it has u, v"):
        simulate({"noise": {"x": {"N": 0.01}}}, like=recorded)


def test_a_log_like_a_recording_has_the_axes_that_the_model_names():
    """Effects may still take the rotation about an axis that is not simulated."""
    world = [{"profile": "rotation", "points": [[0, 90.0]], "axis": "z"}]
    recorded = simulate({"noise": {"N": 1.0}, "environment": world}, duration="9s", rate=10.0)
    recorded = recorded.compute()
    recorded["rate"][1, 30:40] = np.nan
    some = {"noise": {"x": {"N": 0.01}, "y": {}}, "bias": {"y": 2.0}}
    log = simulate(some, like=recorded)
    assert log["axis"].values.tolist() == ["x", "y"]
    np.testing.assert_array_equal(np.isnan(log["rate"]), np.isnan(recorded["rate"][:2]))
    np.testing.assert_array_equal(log["rate"][1].dropna("time"), 2.0)
    for whole in (recorded, recorded.sel(axis=["x"])):
        alone = simulate({"noise": {"x": {"N": 0.01}}}, like=whole)
        np.testing.assert_array_equal(alone["rate"], log["rate"].sel(axis=["x"]))
    assert simulate({"noise": {"N": 0.01}}, like=recorded).sizes["axis"] == 3
    for motion, rate in (("true", 90.0 * 3600.0), ("recorded", recorded["rate"].values[2])):
        leak = {"name": "misalignment", "z": 0.5, "axes": ["x"], "motion": motion}
        leaking = simulate({"noise": {"x": {}}, "effect": [leak]}, like=recorded)
        assert leaking["axis"].values.tolist() == ["x"]
        np.testing.assert_allclose(leaking["rate"].values[0], 5e-4 * rate * np.ones(90), rtol=1e-9)


def test_gaps_of_a_recording_are_lost_on_their_axis_and_those_of_the_model_on_all():
    values = np.zeros((2, 200))
    values[0, 30:60] = np.nan
    recorded = make_log(values, rate=10.0, unit="deg/h", axis=["x", "y"])
    edges = recorded.time.values[[30, 60]]
    table = {"gap_start": edges[:1], "gap_end": edges[1:], "gap_samples": [30], "gap_rows": [0]}
    table["gap_cause"] = np.zeros(1, np.int8)
    gaps = [name for name, variable in recorded.variables.items() if variable.dims == ("gap",)]
    recorded = recorded.drop_vars(gaps).assign({k: ("gap", v) for k, v in table.items()})
    lost = [{"profile": "gaps", "spans": [[10, 12]]}]
    log = simulate({"noise": {"N": 1.0}, "environment": lost}, like=recorded)
    assert np.isnan(log.rate.values).sum(axis=1).tolist() == [50, 20]
    assert gap_table(log).seconds.tolist() == [3.0, 2.0]


def test_simulation_like_a_real_recording(recordings, tmp_path):
    """Stamps, gaps, restarts and channels are the recording's; its temperature drives an effect."""
    path = recordings("fog-hybrid-warmup/run1_static.txt")
    names = {"wx": "gyro_x", "wy": "gyro_y", "wz": "gyro_z", "Tx": "temperature"}
    units = {"gyro": "deg/s", "time": "s", "temperature": "degC"}
    recorded = load_log([path], map=names, unit=units)
    toml = tmp_path / "m.toml"
    toml.write_text(
        "[noise]\nN = 0.01\n[[effect]]\nname = 'temperature_bias'\nsensitivity = 2\naxes = 'z'\n"
    )
    out = tmp_path / "twin.nc"
    given = [word for key, value in names.items() for word in ("--map", f"{key}={value}")]
    given += [word for key, value in units.items() for word in ("--unit", f"{key}={value}")]
    assert (
        main(
            ["simulate", str(toml), "-o", str(out), "--like", str(path), *given, "--quiet-progress"]
        )
        == 0
    )
    twin = open_log(out)
    np.testing.assert_array_equal(twin.time.values, recorded.time.values)
    np.testing.assert_array_equal(np.isnan(twin.rate.values), np.isnan(recorded.rate.values))
    np.testing.assert_array_equal(twin.temperature.values, recorded.temperature.values)
    restarts = gap_table(recorded).query("cause == 'restart'")
    assert gap_table(twin).query("cause == 'restart'").start.tolist() == restarts.start.tolist()
    bias = davar(twin, window="20s", step="20s", taus=[1.0])
    np.testing.assert_allclose(
        bias.window_mean.sel(axis="z"), 2 * (bias.temperature - 25), atol=1.0
    )

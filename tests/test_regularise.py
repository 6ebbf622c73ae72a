"""Raw rows to a regular log, against samples known from the generator and a slow placement by exact fractions."""

from __future__ import annotations

import sys
import tracemalloc
from fractions import Fraction

import dask.array as da
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from gyrostab.errors import FormatError, OptionError, TimeError
from gyrostab.regularise import gap_table, regularise
from gyrostab.regularise.fill import on_grid
from gyrostab.regularise.place import place_by_stamp
from gyrostab.regularise.rate import estimate_rate
from gyrostab.schema import check_log
from gyrostab.timegrid import time_coordinate

START = 1_773_226_800_000_000_000  # 2026-03-11T11:00:00
RATES = [99.3, 300.0, 1 / 7, 248.7, 100.0021]


def raw_log(stamps, values=None, *, kind="rate", name="tool.csv", **channels):
    """A raw log; `stamps` in ns (int), None for a file without time; values by row, or by axis and row."""
    n = len(stamps) if stamps is not None else np.shape(values)[-1]
    values = np.atleast_2d(np.arange(1.0, n + 1) if values is None else values)
    signal = "rate" if kind == "rate" else "angle"
    units = "degree hour-1" if kind == "rate" else "degree"
    data = {signal: (("axis", "row"), values, {"units": units})}
    data |= {key: ("row", np.asarray(column), {"units": "degree_Celsius"}) for key, column in channels.items()}
    coords = {"axis": list("xyz"[: len(values)])}
    if stamps is not None:
        coords["time"] = ("row", np.asarray(stamps, dtype=np.int64).view("datetime64[ns]"))
    return xr.Dataset(data, coords, {"kind": kind, "source_files": [name], "row_start": [0], "notes": ["read"]})


def stamps_of(samples, rate):
    return START + np.rint(np.asarray(samples) * (1e9 / rate)).astype(np.int64)


def expected(samples):
    """Signal on the grid when row i (value i + 1) belongs to samples[i]; a negative sample is a dropped row."""
    samples = np.asarray(samples)
    out = np.full(samples.max() + 1, np.nan)
    out[samples[samples >= 0]] = np.flatnonzero(samples >= 0) + 1.0
    return out


def slow_placement(stamps, rate):
    """Every row to the nearest sample by exact fractions, the first one kept: no hysteresis, no state, no blocks."""
    taken, found = set(), []
    for stamp in stamps.tolist():
        sample = round((stamp - START) * Fraction(rate) / 10**9)
        found.append(-1 if sample in taken else sample)
        taken.add(sample)
    return found


@st.composite
def patterns(draw):
    """Rate, true sample of every row, stamps."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rate = draw(st.sampled_from(RATES))
    n = draw(st.integers(400, 1500))
    keep = random.random(n) >= draw(st.sampled_from([0.0, 0.001, 0.02, 0.1]))
    for _ in range(draw(st.integers(0, 3))):
        at = random.integers(250, n)
        keep[at : at + random.integers(1, 60)] = False
    keep[0] = True
    samples = np.flatnonzero(keep)
    if draw(st.booleans()) and len(samples) > 300:
        samples[random.integers(250, len(samples)) :] += draw(st.integers(1, 300))
    jitter = draw(st.sampled_from([0.0, 0.05, 0.2]))
    position = samples + random.uniform(-jitter, jitter, len(samples))
    position[0] = 0.0
    stamps = stamps_of(position, rate)
    if draw(st.booleans()) and jitter == 0.0 and rate < 301:
        stamps = START + np.rint((stamps - START) / 1e6).astype(np.int64) * 1_000_000
    return rate, samples, stamps, random


@settings(max_examples=150, deadline=None)
@given(patterns())
def test_rows_land_on_their_samples(pattern):
    rate, samples, stamps, _ = pattern
    log = regularise(raw_log(stamps))
    assert abs(log.attrs["sampling_rate_hz"] / rate - 1) * samples[-1] < 0.5
    np.testing.assert_array_equal(log.rate.values[0], expected(samples))
    assert slow_placement(stamps, rate) == samples.tolist()
    holes = gap_table(log)
    assert holes.samples.sum() == samples[-1] + 1 - len(samples)
    check_log(log)


@settings(max_examples=100, deadline=None)
@given(patterns(), st.integers(0, 12), st.integers(0, 6))
def test_doubled_and_swapped_rows(pattern, doubled, swapped):
    rate, samples, stamps, random = pattern
    stamps = stamps.copy()
    # swap neighbours, far from each other and from the doubled rows
    places = 20 + 8 * random.permutation((len(stamps) - 40) // 8)
    order = np.arange(len(stamps))
    for at in places[:swapped]:
        order[at], order[at + 1] = order[at + 1], order[at]
    again = places[swapped : swapped + doubled]
    order = np.insert(order, again + 1, order[again])
    log = regularise(raw_log(stamps[order]))
    truth = samples[order]
    truth[np.sort(again) + 1 + np.arange(len(again))] = -1
    np.testing.assert_array_equal(log.rate.values[0], expected(truth))
    table = gap_table(log)
    assert table[table.cause == "duplicate"].rows.sum() == len(again)
    assert table[table.cause == "out_of_order"].rows.sum() == len(places[:swapped])
    assert slow_placement(stamps[order], rate) == truth.tolist()


@settings(max_examples=40, deadline=None)
@given(patterns(), st.lists(st.integers(40, 400), min_size=1, max_size=3))
def test_restarts_append_after_one_missing_sample(pattern, pieces):
    rate, samples, stamps, _ = pattern
    truth, all_stamps = [samples], [stamps]
    for length in pieces:
        all_stamps.append(stamps_of(np.arange(length) + 1, rate))
        truth.append(truth[-1][-1] + 2 + np.arange(length))
    log = regularise(raw_log(np.concatenate(all_stamps)))
    np.testing.assert_array_equal(log.rate.values[0], expected(np.concatenate(truth)))
    table = gap_table(log)
    restarts = table[table.cause == "restart"]
    assert restarts.samples.tolist() == [1] * len(pieces)
    assert sum("time restarts at row" in note for note in log.attrs["notes"]) == len(pieces)


@settings(max_examples=25, deadline=None)
@given(patterns(), st.integers(64, 700))
def test_blocks_and_chunks_make_no_difference(pattern, block):
    _, _, stamps, _ = pattern
    stamps = np.concatenate([stamps, stamps[:200]])
    raw = raw_log(stamps, temperature=np.where(np.arange(len(stamps)) % 7, np.nan, 20.0))
    whole, parts = regularise(raw), regularise(raw, block=block, chunk=97)
    for log in (whole, parts):
        del log.attrs["history"]
    xr.testing.assert_identical(whole, parts)


@pytest.mark.parametrize("chunk", [1000, 4096])
def test_lazy_arrays_equal_those_in_memory(chunk, monkeypatch):
    random = np.random.default_rng(2)
    samples = np.sort(random.choice(40_000, 9000, replace=False))
    samples -= samples[0]
    samples[4000:] += 50_000
    values = random.normal(size=(2, 9000))
    raw = raw_log(stamps_of(samples, 300.0), values)
    truth = np.full((2, samples[-1] + 1), np.nan)
    truth[:, samples] = values
    monkeypatch.setattr(sys.modules["gyrostab.regularise.fill"], "SMALL", 10)
    for signal in (values, da.from_array(values, chunks=(1, 1234))):
        log = regularise(raw.assign(rate=raw.rate.copy(data=signal)), chunk=chunk)
        assert isinstance(log.rate.data, da.Array)
        np.testing.assert_array_equal(log.rate.values, truth)
        np.testing.assert_array_equal(log.rate[:, 44_000:61_000].values, truth[:, 44_000:61_000])


def test_gap_of_200_hours_costs_next_to_nothing():
    gap = 200 * 3600 * 400
    raw = raw_log(stamps_of(np.r_[0:5000, gap : gap + 5000], 400.0))
    regularise(raw)  # compiles the kernels
    tracemalloc.start()
    log = regularise(raw)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert log.sizes["time"] == gap + 5000
    assert peak < 8e6
    assert len(log.rate.data.dask) < 2000
    assert np.isnan(log.rate[0, gap // 2 : gap // 2 + 1000].values).all()
    assert log.rate[0, -1].compute().item() == 10_000.0
    assert "200.0 h without samples from 2026-03-11T11:00:12.500 (after row 4999)" in log.attrs["notes"][-1]


@pytest.mark.parametrize("rate", [300.0, 99.3])
def test_no_drift_over_200_hours(rate):
    """One row in 64, in stretches over the whole 200 h, written to the microsecond."""
    last, block = int(200 * 3600 * rate), 1 << 22
    step = 1e9 / rate

    def stamps():
        for begin in range(0, last + 1, block * 8):
            rows = np.arange(begin, min(begin + block // 8, last + 1))
            yield rows, START + np.rint(rows * (step / 1000)).astype(np.int64) * 1000
        yield np.array([last]), START + np.rint(np.array([last]) * (step / 1000)).astype(np.int64) * 1000

    estimate = estimate_rate(stamps, where="long.csv")
    assert estimate.rate == rate
    placement = place_by_stamp(stamps, rate, tolerance=0.25, max_gap=1e9, where="long.csv")
    assert placement.size == last + 1
    assert np.all(placement.runs[:, 0] == placement.runs[:, 1])  # rows are numbered by their true sample
    exact = START + round(last * Fraction(10**9) / Fraction(repr(rate)))
    end = time_coordinate(placement.start, rate, placement.size)["time"][-1].values.astype(np.int64)
    assert abs(int(end) - exact) <= 1


def test_bursts_are_placed_by_count_and_a_loss_shows_as_a_lasting_delay():
    random = np.random.default_rng(4)
    n, lost = 20_000, 450
    samples = np.arange(n)
    samples[12_000:] += lost
    sent = samples / 100.0
    packet = np.ceil(sent / 0.07)  # one every 70 ms, unpacked row by row
    arrival = packet * 0.07 + 0.002 * (np.arange(n) - np.searchsorted(packet, packet)) + random.uniform(0, 0.0005, n)
    log = regularise(raw_log(START + np.rint(arrival * 1e9).astype(np.int64)))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(100.0, rel=2e-4)
    assert any("bursts" in note for note in log.attrs["notes"])
    (hole,) = gap_table(log).itertuples()
    assert abs(hole.samples - lost) <= 10
    present = np.flatnonzero(np.isfinite(log.rate.values[0]))
    assert len(present) == n
    assert np.abs(present - samples).max() <= 10


def test_whole_seconds_shared_by_many_rows_are_not_duplicates():
    samples = np.arange(60_000)
    stamps = START + (samples / 99.3 // 1 * 1e9).astype(np.int64)
    log = regularise(raw_log(stamps))
    assert log.attrs["sampling_rate_hz"] == 99.3
    np.testing.assert_array_equal(log.rate.values[0], samples + 1.0)
    assert abs((log.time.values[0] - np.datetime64(START, "ns")) / np.timedelta64(1, "ms")) < 11


def test_declared_rate_without_time():
    raw = raw_log(None, np.arange(6.0), temperature=[20.0, np.nan, np.nan, np.nan, 21.0, np.nan])
    raw.attrs |= {"declared_rate_hz": 2.0, "start": "2026-03-11T11:00:00"}
    log = regularise(raw)
    assert log.time.values[-1] == np.datetime64("2026-03-11T11:00:02.5")
    np.testing.assert_array_equal(log.time_temperature.values, np.array(["2026-03-11T11:00:00", "2026-03-11T11:00:02"], "datetime64[ns]"))
    np.testing.assert_array_equal(log.temperature.values, [20.0, 21.0])
    with pytest.raises(TimeError, match="--rate"):
        regularise(raw.assign_attrs(declared_rate_hz=None))


def test_wrong_declared_rate_is_an_error_with_both_figures():
    raw = raw_log(stamps_of(np.arange(500), 100.0))
    assert regularise(raw, rate=100.0).attrs["sampling_rate_hz"] == 100.0
    with pytest.raises(TimeError, match=r"tool\.csv: .*200 Hz.*100 Hz.*--rate"):
        regularise(raw, rate=200.0)


def test_increments_become_rates():
    log = regularise(raw_log(stamps_of([0, 1, 2, 4], 100.0), [1e-6, 2e-6, 3e-6, 4e-6], kind="increment"))
    np.testing.assert_allclose(log.rate.values[0], [0.36, 0.72, 1.08, np.nan, 1.44])
    assert log.rate.attrs["units"] == "degree hour-1"
    assert log.attrs["kind"] == "rate"


def test_cumulative_angle_stays_an_angle():
    log = regularise(raw_log(stamps_of([0, 1, 2, 4], 100.0), [1.0, 2.0, 3.0, 4.0], kind="angle"))
    np.testing.assert_array_equal(log.angle.values[0], [1.0, 2.0, 3.0, np.nan, 4.0])
    assert log.attrs["kind"] == "angle"


def test_unreadable_cells_infinite_values_and_lost_stamps():
    values = np.arange(400.0).reshape(2, 200)
    values[0, 50:53] = np.nan  # one axis
    values[:, 80] = np.nan  # a whole row
    values[1, 120] = np.inf
    stamps = stamps_of(np.arange(200), 100.0)
    stamps[150:152] = np.iinfo(np.int64).min
    log = regularise(raw_log(stamps, values))
    truth = np.where(np.isinf(values), np.nan, values)
    np.testing.assert_array_equal(log.rate.values, truth)
    table = gap_table(log).set_index("start")
    seen = [(round((when.value - START) / 1e7), row.samples, row.cause) for when, row in table.iterrows()]
    assert seen == [(50, 3, "unreadable"), (80, 1, "unreadable"), (120, 1, "outside_range")]
    assert log.attrs["notes"][0] == "read"
    assert any("infinite" in note for note in log.attrs["notes"])


def test_channels_on_time_and_slow_channels_on_their_own():
    n = 300
    stamps = np.concatenate([stamps_of(np.arange(n), 100.0), stamps_of(np.arange(n), 100.0)])
    slow = np.full(2 * n, np.nan)
    slow[::50] = np.arange(12.0)
    raw = raw_log(stamps, temperature=slow, vibration=np.arange(2.0 * n))
    other = np.array(["2026-03-11T11:00:01", "2026-03-11T11:00:02"], "datetime64[ns]")
    raw = raw.assign_coords(time_pressure=other).assign(pressure=("time_pressure", [1.0, 2.0], {"units": "Pa"}))
    log = regularise(raw)
    assert log.vibration.dims == ("time",)
    np.testing.assert_array_equal(log.vibration.values, np.r_[0:n, np.nan, n : 2 * n])
    samples = np.r_[0:n:50, n + 1 : 2 * n + 1 : 50]
    np.testing.assert_array_equal(log.time_temperature.values, log.time.values[samples])
    np.testing.assert_array_equal(log.temperature.values, np.arange(12.0))
    assert log.temperature.attrs["units"] == "degree_Celsius"
    np.testing.assert_array_equal(log.time_pressure.values, other)


def test_rows_that_hold_a_slow_channel_only_are_no_samples():
    samples = np.arange(1000)
    stamps = stamps_of(np.sort(np.r_[samples, samples[5::10] + 0.4]), 100.0)
    other = np.flatnonzero(np.isin(np.arange(len(stamps)), np.searchsorted(stamps, stamps_of(samples[5::10] + 0.4, 100.0))))
    values = np.full(len(stamps), np.nan)
    gyro = np.setdiff1d(np.arange(len(stamps)), other)
    values[gyro] = samples
    temperature = np.full(len(stamps), np.nan)
    temperature[other] = 20.0
    log = regularise(raw_log(stamps, values, temperature=temperature))
    assert log.attrs["sampling_rate_hz"] == 100.0
    np.testing.assert_array_equal(log.rate.values[0], samples)
    np.testing.assert_array_equal(log.time_temperature.values.astype(np.int64), stamps[other])


def test_a_stretch_at_another_rate_is_told():
    log = regularise(raw_log(stamps_of(np.r_[0:9000, 9000 + np.arange(4000) * 1.25], 100.0)))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(100.0, rel=1e-4)
    (note,) = [note for note in log.attrs["notes"] if "split the log" in note]
    assert "80 Hz" in note
    assert abs(log.sizes["time"] - 9000 - 3999 * 1.25) < 3


def test_long_step_is_a_step_of_the_clock_unless_allowed():
    raw = raw_log(stamps_of(np.r_[0:300, 100_000_000:100_000_300], 100.0))
    log = regularise(raw)
    assert log.sizes["time"] == 601
    assert gap_table(log).cause.tolist() == ["clock_step"]
    assert any("raise max_gap" in note for note in log.attrs["notes"])
    assert regularise(raw, max_gap="20D").sizes["time"] == 100_000_300


def test_many_holes_are_counted_together():
    samples = np.flatnonzero(np.random.default_rng(0).random(90_000) > 0.2)
    samples -= samples[0]
    holes = int((np.diff(samples) > 1).sum())
    log = regularise(raw_log(stamps_of(samples, 100.0)))
    assert holes > 12_000
    assert 9_000 < log.sizes["gap"] <= 10_000
    assert gap_table(log).samples.sum() == samples[-1] + 1 - len(samples)


def test_names_of_several_files():
    raw = raw_log(stamps_of(np.r_[0:500, 1000:1500], 100.0))
    raw.attrs |= {"source_files": ["a.csv", "b.csv"], "row_start": [0, 400]}
    notes = regularise(raw).attrs["notes"]
    assert any(note.startswith("b.csv: 5.0 s without samples from 2026-03-11T11:00:05.000 (after row 99)") for note in notes)


def test_hopeless_logs_are_errors():
    with pytest.raises(FormatError, match=r"tool\.csv"):
        regularise(raw_log(stamps_of(np.arange(10), 100.0), np.full(10, np.nan)))
    with pytest.raises(TimeError, match="only one sample"):
        regularise(raw_log(stamps_of([0], 100.0)))
    with pytest.raises(TimeError, match="backwards"):
        regularise(raw_log(stamps_of(np.arange(100)[::-1], 100.0)))
    with pytest.raises(TimeError, match="the same"):
        regularise(raw_log(stamps_of(np.zeros(100), 100.0)))
    with pytest.raises(TimeError):
        regularise(raw_log(np.full(100, np.iinfo(np.int64).min)))
    for wrong in ({"rate": -1.0}, {"tolerance": 0.7}, {"max_gap": "soon"}, {"max_gap": 0}, {"chunk": 0}):
        with pytest.raises(OptionError):
            regularise(raw_log(stamps_of(np.arange(10), 100.0)), **wrong)


def test_one_sample_with_a_given_rate_and_a_constant_axis():
    assert regularise(raw_log(stamps_of([0], 100.0)), rate=100.0).sizes["time"] == 1
    log = regularise(raw_log(stamps_of(np.arange(100), 100.0), np.ones(100)))
    assert any("axis x never changes" in note for note in log.attrs["notes"])


def test_a_regular_log_passes_through():
    log = regularise(raw_log(stamps_of(np.arange(10), 100.0)))
    assert regularise(log) is log


def test_arrays_keep_every_bit():
    values = np.random.default_rng(0).normal(size=(3, 1000)) * 10.0 ** np.arange(-200, 100, 100)[:, None]
    log = regularise(raw_log(stamps_of(np.arange(1000) * 2, 50.0), values))
    assert log.rate.values.tobytes() == values.tobytes()


# real recordings


def recorded(seconds, columns, name):
    seconds = np.asarray(seconds, dtype=np.float64)
    stamps = np.full(len(seconds), np.iinfo(np.int64).min)
    good = np.isfinite(seconds)
    stamps[good] = np.rint(seconds[good] * 1e9).astype(np.int64)
    return raw_log(stamps, np.asarray(columns, dtype=np.float64).T, name=name)


def present(log):
    return log.rate.values[:, np.isfinite(log.rate.values).any(axis=0)]


def test_mpu6050_arrives_in_bursts(recordings):
    table = pd.read_csv(recordings("mpu6050-static-temperature/mpu6050_10min.csv.gz"))
    gyro = table[["gx_dps", "gy_dps", "gz_dps"]]
    log = regularise(recorded(table.t_s, gyro, "mpu6050.csv"))
    rate = log.attrs["sampling_rate_hz"]
    assert 99.2 < rate < 100.05
    assert log.sizes["time"] / rate == pytest.approx(655.1, abs=1.5)
    np.testing.assert_array_equal(present(log), gyro.to_numpy().T)


def test_rocket_gap(recordings):
    table = pd.read_csv(recordings("rocket-flight-temperature/jackpot_launch_1.csv"))
    axes = [f"raw_angular_rate_{axis}_deg_per_s" for axis in "xyz"]
    log = regularise(recorded(table.timestamp_seconds, table[axes], "launch_1.csv"))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(90.909, abs=0.01)
    (gap,) = gap_table(log).itertuples()
    assert gap.seconds == pytest.approx(1068.2, abs=0.1)
    assert any(note.startswith("launch_1.csv: 1068.2 s without samples") and "row 500" in note for note in log.attrs["notes"])
    np.testing.assert_array_equal(present(log), table[axes].to_numpy().T)


def test_px4_dropouts(recordings):
    table = pd.read_csv(recordings("px4-bench-dropouts/sensor_combined.csv.gz"))
    gyro = table[[f"gyro_rad[{i}]" for i in range(3)]]
    log = regularise(recorded(table.timestamp * 1e-6, gyro, "sample.ulg"))
    assert 248.0 < log.attrs["sampling_rate_hz"] < 250.0
    steps = np.diff(table.timestamp) * 1e-6
    gaps = gap_table(log)
    assert gaps.cause.tolist() == ["missing"] * 8
    np.testing.assert_allclose(gaps.seconds + 1 / 248.55, steps[steps > 0.006], atol=0.0045)
    np.testing.assert_array_equal(present(log), gyro.to_numpy().T)


@pytest.mark.parametrize(("name", "rows"), [("run1_static.txt", [5818]), ("run2_turn.txt", [1341, 1960, 2550])])
def test_fog_restarts(recordings, name, rows):
    table = pd.read_csv(recordings(f"fog-hybrid-warmup/{name}"), comment="#")
    log = regularise(recorded(table.time, table[["wx", "wy", "wz"]], name))
    assert log.attrs["sampling_rate_hz"] == 100.0
    gaps = gap_table(log)
    assert gaps.cause.tolist() == ["restart"] * len(rows)
    where = np.flatnonzero(np.isnan(log.rate.values).all(axis=0))
    assert where.tolist() == [row + i for i, row in enumerate(rows)]
    assert all(any(f"at row {row}:" in note for note in log.attrs["notes"]) for row in rows)


def test_mav_stamps_damaged_by_a_spreadsheet(recordings):
    table = pd.read_csv(recordings("mav-flight-adis16448/imu0_data.csv"))
    gyro = table.iloc[:, 1:4].apply(pd.to_numeric, errors="coerce")
    stamps = pd.to_numeric(table.iloc[:, 0], errors="coerce") * 1e-9
    log = regularise(recorded(stamps, gyro, "imu0.csv"))
    assert log.attrs["sampling_rate_hz"] == 200.0
    assert log.sizes["time"] == 36_820
    assert np.isfinite(log.rate.values).all()


def test_on_grid_of_nothing_but_one_run_is_the_array_itself():
    placement = place_by_stamp(
        lambda: iter([(np.arange(50), stamps_of(np.arange(50), 10.0))]), 10.0, tolerance=0.25, max_gap=1e9, where="x"
    )
    np.testing.assert_array_equal(on_grid(np.arange(50.0), placement, chunk=7), np.arange(50.0))


def test_three_rows_are_enough():
    log = regularise(raw_log(stamps_of([0, 1, 5], 10.0)))
    assert log.attrs["sampling_rate_hz"] == 10.0
    np.testing.assert_array_equal(log.rate.values[0], [1, 2, np.nan, np.nan, np.nan, 3])


def test_arrival_at_random_times_loses_no_row():
    stamps = START + np.rint(np.sort(np.random.default_rng(0).uniform(0, 100, 10_000)) * 1e9).astype(np.int64)
    log = regularise(raw_log(stamps))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(100.0, rel=0.02)
    assert np.isfinite(log.rate.values).sum() == 10_000


def test_clock_set_back_in_the_middle():
    log = regularise(raw_log(stamps_of(np.r_[0:9000, 8500:12_000], 100.0)))
    assert gap_table(log).cause.tolist() == ["clock_step"]
    np.testing.assert_array_equal(log.rate.values[0], np.r_[1:9001, np.nan, 9001:12_501])


@pytest.mark.parametrize(("rate", "n"), [(700.0, 2000), (700.0, 50_000), (300.0, 50_000)])
def test_stamps_coarser_than_the_jitter_of_a_sample(rate, n):
    """At 700 Hz and whole milliseconds, steps are 1 ms and 2 ms: neither is the period."""
    keep = np.random.default_rng(1).random(n) > 0.03
    keep[:50] = True
    samples = np.flatnonzero(keep)
    log = regularise(raw_log(START + np.floor(samples * 1e3 / rate).astype(np.int64) * 1_000_000))
    assert log.attrs["sampling_rate_hz"] == pytest.approx(rate, rel=1e-4 if n < 10_000 else 1e-6)
    assert np.isfinite(log.rate.values).sum() > 0.98 * len(samples)
    assert abs(log.sizes["time"] - 1 - samples[-1]) <= 1


def test_a_channel_of_another_day_is_told():
    raw = raw_log(stamps_of(np.arange(100), 10.0))
    for day, told in ((0, False), (3, True)):
        stamps = raw.time.values[:5] + np.timedelta64(day, "D")
        other = raw.assign_coords(time_temperature=("time_temperature", stamps)).assign(
            temperature=("time_temperature", np.full(5, 20.0), {"units": "degree_Celsius"})
        )
        assert any("channel temperature: none of its 5 values" in note for note in regularise(other).attrs["notes"]) is told


@pytest.mark.parametrize("pattern", [[1, 1, 1, 0, 0], [1, 0, 1, 1, 0], [1, 1, 0], [1, 1, 0, 0, 0, 0, 0]])
@pytest.mark.parametrize("rate", [100.0, 300.0, 248.7])
@pytest.mark.parametrize("jitter", [0.0, 0.03])
def test_rows_missing_in_a_fixed_pattern_leave_the_declared_grid(pattern, rate, jitter):
    samples = np.flatnonzero(np.resize(pattern, 6000))
    stamps = stamps_of(samples + np.random.default_rng(3).uniform(-jitter, jitter, len(samples)), rate)
    log = regularise(raw_log(stamps), rate=rate)
    assert log.attrs["sampling_rate_hz"] == rate
    assert np.array_equal(log.rate.values[0], expected(samples), equal_nan=True)


def test_a_multiple_of_the_rate_is_not_taken_for_it():
    with pytest.raises(TimeError, match=r"200 Hz.*100 Hz"):
        regularise(raw_log(stamps_of(np.arange(2000), 100.0)), rate=200.0)


REPEATED = {
    "at once": np.r_[0:3000, 2000:3000, 3000:6000],
    "much later": np.r_[0:5000, 1000:2500, 5000:6000],
    "at the end": np.r_[0:6000, 4500:6000],
    "as a whole": np.r_[0:6000, 0:6000],
    "three times": np.r_[0:3000, 2000:3000, 2000:3000, 3000:6000],
    "two stretches": np.r_[0:2000, 1500:2000, 2000:4000, 2500:4000, 4000:6000],
}


@pytest.mark.parametrize("rows", REPEATED.values(), ids=REPEATED)
@pytest.mark.parametrize("block", [64, 1 << 20])
def test_rows_given_twice_are_duplicates(rows, block):
    samples = np.r_[0:1200, 1300:3100, 3101:6101]  # with gaps, which the repetitions have too
    values = np.random.default_rng(1).standard_normal(6000)
    log = regularise(raw_log(stamps_of(samples, 300.0)[rows], values[rows]), block=block)
    once = regularise(raw_log(stamps_of(samples, 300.0), values))
    assert np.array_equal(log.rate.values, once.rate.values, equal_nan=True)
    assert np.array_equal(log.time.values, once.time.values)
    table = gap_table(log)
    twice = table[table.cause == "duplicate"]
    assert twice.rows.sum() == len(rows) - 6000
    assert set(table.cause) == {"missing", "duplicate"}
    first = samples[rows[np.flatnonzero(np.diff(rows) < 0)[0] + 1]]
    assert first in np.rint((twice.start - once.time.values[0]) / np.timedelta64(1, "ns") * 300e-9).astype(int).tolist()
    assert any(f"dropped as their sample is taken: {len(rows) - 6000} rows" in note for note in log.attrs["notes"])


def test_a_damaged_copy_is_a_copy():
    values = np.random.default_rng(1).standard_normal(6000)
    rows = REPEATED["at once"]
    copied = values[rows]
    copied[3100:3150], copied[3200:3220] = np.nan, 7.0
    log = regularise(raw_log(stamps_of(np.arange(6000), 300.0)[rows], copied))
    assert np.array_equal(log.rate.values[0], values)


@pytest.mark.parametrize(
    "values", [np.random.default_rng(2).standard_normal(9000), np.zeros(9000)], ids=["other values", "values that never change"]
)
def test_a_clock_that_starts_again_is_no_repetition(values):
    log = regularise(raw_log(stamps_of(np.r_[0:6000, 0:3000], 300.0), values))
    assert log.sizes["time"] == 9001
    assert gap_table(log).cause.tolist() == ["restart"]

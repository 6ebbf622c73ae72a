"""Regularise real recordings: every row is kept, gaps and restarts are found."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.regularise import regularise
from tests.support.raw_rows import raw_log


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
    assert any(
        note.startswith("launch_1.csv: 1068.2 s without samples") and "row 500" in note
        for note in log.attrs["notes"]
    )
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


@pytest.mark.parametrize(
    ("name", "rows"), [("run1_static.txt", [5818]), ("run2_turn.txt", [1341, 1960, 2550])]
)
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

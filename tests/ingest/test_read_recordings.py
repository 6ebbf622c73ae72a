"""Real recordings, checked against their README, their source, or a second reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.io import loadmat

from gyrostab.errors import MissingUnitError
from gyrostab.ingest import read_log, scan_file

Find = Callable[[str], Path]
DPS = {f"g{axis}_dps": f"gyro_{axis}" for axis in "xyz"}
FIRM = {f"raw_angular_rate_{axis}_deg_per_s": f"gyro_{axis} [deg/s]" for axis in "xyz"}
HINS: dict[str, Any] = {
    "map": {**{f"w{axis}": f"gyro_{axis}" for axis in "xyz"}, "Tx": "temperature"},
    "unit": {"gyro": "deg/s", "time": "s", "temperature": "degC"},
}


def test_adis_parquet(recordings: Find) -> None:
    path = recordings("adis16405-static-2h47/adis_16405_imu1.parquet")
    raw = read_log(
        path,
        rate=100,
        map={f"gyro_{axis}_dps": f"gyro_{axis}" for axis in "xyz"},
        unit={"gyro": "deg/s"},
    )
    table = pd.read_parquet(path)
    assert raw.sizes == {"axis": 3, "row": 1_000_000}
    np.testing.assert_allclose(raw.rate[2], table["gyro_z_dps"].to_numpy(np.float64) * 3600)


def test_ring_laser_strapdown_sees_the_earth(recordings: Find) -> None:
    raw = read_log(
        recordings("rlg-static-30min/lasergyro.csv.gz"),
        map={f"g{axis}_deg_per_h": f"gyro_{axis}" for axis in "xyz"},
        unit={"gyro": "deg/h"},
    )
    assert raw.sizes["row"] == 184_718
    np.testing.assert_allclose(raw.rate.mean("row"), [-12.27, 0.44, 8.36], atol=0.005)
    assert set(np.diff(raw.time.values.astype(np.int64))) == {10_000_000}


def test_blueseis_fog_counts_are_nanoradians_per_second(recordings: Find) -> None:
    raw = read_log(
        recordings("fog-blueseis-ramp/fog_ramp.csv.gz"),
        map={"rate_counts": "gyro_z", "ramp_counts": "ramp"},
        unit={"gyro": "1 nrad/s"},
    )
    earth = 15.041067 * np.sin(np.deg2rad(47.9))  # deg/h, the vertical Earth rate
    assert float(raw.rate.mean()) == pytest.approx(earth, rel=2e-3)
    assert (float(raw.ramp.min()), float(raw.ramp.max())) == (0, 32767)
    assert raw.ramp.attrs["units"] == "1"


def test_ch104_text_and_matlab_agree(recordings: Find) -> None:
    text = read_log(
        recordings("mems-static-53min/ch104.csv.gz"), rate=100, map=DPS, unit={"gyro": "deg/s"}
    )
    path = recordings("mems-static-53min/ch104.mat")
    matrix = read_log(
        path,
        rate=100,
        map={f"gyroReading/{i}": f"gyro_{a}" for i, a in enumerate("xyz")},
        unit={"gyro": "deg/s"},
    )
    assert text.sizes["row"] == matrix.sizes["row"] == 321_253
    np.testing.assert_array_equal(matrix.rate, loadmat(path)["gyroReading"].T * 3600)
    np.testing.assert_allclose(text.rate, matrix.rate, atol=1e-8 * 3600)


def test_mpu6050_text_and_matlab_73_agree(recordings: Find) -> None:
    text = read_log(
        recordings("mpu6050-static-temperature/mpu6050_10min.csv.gz"),
        map={**DPS, "temp_C": "temperature"},
        unit={"gyro": "deg/s", "temperature": "degC"},
    )
    path = recordings("mpu6050-static-temperature/mpu6050_gyroscope.mat")
    mapping = {
        "gyroBuffer/0": "time",
        **{f"gyroBuffer/{i}": f"gyro_{a}" for i, a in enumerate("xyz", 1)},
    }
    matrix = read_log(path, map=mapping, unit={"gyro": "deg/s", "time": "s"})
    with h5py.File(path) as file:
        np.testing.assert_array_equal(matrix.rate, file["gyroBuffer"][1:] * 3600)
        seconds = file["gyroBuffer"][0]
    assert np.abs(matrix.time.values.astype(np.int64) - seconds * 1e9).max() < 1
    assert text.sizes["row"] == 65_067
    assert (
        np.abs((text.time.values - matrix.time.values).astype(np.int64)).max() < 100_000
    )  # the text has 7 digits
    assert 25.1 < float(text.temperature.min()) < float(text.temperature.max()) < 25.7


def test_ringlaser_g(recordings: Find) -> None:
    path = recordings("ringlaser-g-3h/ringlaser_g_3h.nc")
    raw = read_log(path, map={"BJZ": "gyro_z"}, unit={"gyro": f"{1 / 6.3191e12!r} rad/s"})
    with netCDF4.Dataset(path) as file:
        np.testing.assert_allclose(
            raw.rate[0], np.rad2deg(file["BJZ"][:] / 6.3191e12) * 3600, rtol=1e-12
        )
    assert raw.time.values[0] == np.datetime64("2024-12-05T18:34:19.981750000")
    assert set(np.diff(raw.time.values.astype(np.int64))) == {50_000_000}
    assert raw.BHZ.attrs["units"] == "counts"


@pytest.mark.parametrize(("number", "rows"), [(1, 6616), (3, 7646)])
def test_rocket_flights(recordings: Find, number: int, rows: int) -> None:
    path = recordings(f"rocket-flight-temperature/jackpot_launch_{number}.csv")
    raw = read_log(path, map={**FIRM, "temperature_celsius": "temperature [degC]"})
    table = pd.read_csv(path, dtype={"timestamp_seconds": str})
    assert raw.sizes["row"] == rows
    np.testing.assert_allclose(raw.rate[1], table["raw_angular_rate_y_deg_per_s"] * 3600)
    np.testing.assert_array_equal(raw.temperature, table["temperature_celsius"])
    exact = [
        int(text.replace(".", "")) * 10 for text in table["timestamp_seconds"]
    ]  # eight decimals
    np.testing.assert_array_equal(raw.time.values.astype(np.int64), exact)
    assert "update_timestamp_ns" in " ".join(
        scan_file(path).notes
    )  # a second clock is listed, but is not the time


def test_px4_microseconds(recordings: Find) -> None:
    path = recordings("px4-bench-dropouts/sensor_combined.csv.gz")
    mapping = {f"gyro_rad[{place}]": f"gyro_{axis}" for place, axis in enumerate("xyz")}
    recognised = read_log(path)
    assert any("preset" in note and "PX4" in note for note in recognised.attrs["notes"])
    raw = read_log(path, map=mapping, unit={"gyro": "rad/s", "time": "us"})
    assert raw.sizes["row"] == 17_070
    assert raw.time.values[0].astype(np.int64) == 112_614_307_000
    xr.testing.assert_equal(recognised[["rate", "time"]], raw[["rate", "time"]])


def test_euroc_damaged_by_a_spreadsheet(recordings: Find) -> None:
    path = recordings("mav-flight-adis16448/imu0_data.csv")
    recognised = read_log(path)
    assert any("preset" in note and "EuRoC" in note for note in recognised.attrs["notes"])
    raw = read_log(path, map={f"w_RS_S_{axis}": f"gyro_{axis}" for axis in "xyz"})
    xr.testing.assert_equal(recognised[["rate", "time"]], raw[["rate", "time"]])
    assert (raw.sizes["row"], raw.attrs["unreadable_rows"]) == (36_827, 7)
    assert any(
        "lines 36822 (',,,,,,'), 36823, 36824, 36825, 36826, 36827, 36828" in note
        for note in raw.attrs["notes"]
    )
    assert raw.time.values[0].astype(np.int64) == 1_403_636_579_758_560_000
    assert np.isnat(raw.time.values[-7:]).all()
    good = raw.time.values[:-7]
    assert set(np.diff(good.astype(np.int64))) == {5_000_000}
    assert float(raw.rate[0, 0]) == pytest.approx(np.rad2deg(-0.0991347015) * 3600, rel=1e-14)
    assert float(raw.accel_z[0]) == pytest.approx(-2.4026292 / 9.80665, rel=0.05)
    assert raw.accel_z.attrs["units"] == "g"
    assert scan_file(path).last == good[-1]


@pytest.mark.parametrize(("name", "rows"), [("run1_static", 8641), ("run2_turn", 2752)])
def test_hybrid_fog_with_comment_lines(recordings: Find, name: str, rows: int) -> None:
    path = recordings(f"fog-hybrid-warmup/{name}.txt")
    with pytest.raises(MissingUnitError, match="--unit time=s"):
        read_log(path, map=HINS["map"])
    raw = read_log(path, **HINS)
    table = pd.read_csv(path, comment="#")
    assert (raw.sizes["row"], raw.attrs["unreadable_rows"]) == (rows, 0)
    np.testing.assert_allclose(raw.rate[2], table["wz"] * 3600)
    np.testing.assert_array_equal(
        raw.time.values.astype(np.int64), np.rint(table["time"] * 1000).astype(np.int64) * 10**6
    )
    np.testing.assert_array_equal(raw.temperature, table["Tx"])

"""Files of known programs: their header lines, with a few rows of our own."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import pytest

from gyrostab.errors import OptionError
from gyrostab.ingest import read_log, scan_file
from gyrostab.store.toml import load_toml_folder

RAD = math.degrees(1) * 3600  # deg/h
IN_RADIANS = (0.001 * RAD, -0.002 * RAD, 0.003 * RAD)
IN_DEGREES = (1800, -900, 450)


class Sample(NamedTuple):
    """A file of a program: its name, its text, and the expected first row."""

    file: str
    header: str
    row: Callable[[int], str]
    rate: tuple[float, float, float]  # deg/h, first row
    step: float | None  # s, None without stamps
    channels: Mapping[str, float] = MappingProxyType({})  # first row, inner units

    def write_to(self, folder: Path) -> Path:
        path = folder / self.file
        path.write_text(self.header + "".join(map(self.row, range(4))))
        return path


XSENS = (
    "PacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z\tMag_X\tMag_Y\tMag_Z\n"
)
SAMPLES = {
    "xsens-mt-manager": Sample(
        "MT_001-000.txt",
        "// General information: \n//  MT Manager version: 2022.2.0 \n// Coordinate system: ENU\n"
        + XSENS,
        lambda n: (
            f"{n}\t{1000 + 100 * n}\t0.1\t0.2\t9.80665\t0.001\t-0.002\t0.003\t0.4\t0.5\t0.6\n"
        ),
        IN_RADIANS,
        0.01,
        {"accel_z": 1.0},
    ),
    "xsens-mt-manager, wireless": Sample(
        "MT_001-001.txt",
        "// Start Time: Unknown\n// Update Rate: 50.0Hz\n// Filter Profile: human (46.1)\n" + XSENS,
        lambda n: f"{n}\t\t0.1\t0.2\t9.80665\t0.001\t-0.002\t0.003\t0.4\t0.5\t0.6\n",
        IN_RADIANS,
        None,
        {"accel_z": 1.0},
    ),
    "xsens-dot": Sample(
        "dot.csv",
        "DeviceTag:,D1\nFirmwareVersion:,1.6.0\nOutputRate:,60Hz\n\n"
        "PacketCounter,SampleTimeFine,Euler_X,Euler_Y,Euler_Z,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z,Status\n",
        lambda n: f"{n},{7 + 16667 * n},1,2,3,0.1,0.2,9.80665,0.5,-0.25,0.125,0\n",
        IN_DEGREES,
        0.016667,
        {"accel_z": 1.0},
    ),
    "microstrain-mip": Sample(
        "mip.csv",
        "FILE_INFO\nListSeparator=comma\nDecimalSeparator=period\n\n"
        "SESSION_INFO\nStartTime,1/2/2017 "
        "1:02:03 PM\n\n"
        "DEVICE_INFO\nModelName,3DM\nSerialNumber,6225-1\nFirmwareVersion,1.1.19\n\nDATA_START\n"
        "GPS TFlags,GPS Week,GPS TOW,X Accel [x8004],Y Accel [x8004],Z Accel [x8004],X Gyro "
        "[x8005],Y Gyro [x8005],Z Gyro [x8005],"
        "Lat [x8103],Flags [x8103],Flags [x8108]\n",
        lambda n: f"5,1936,{494410 + n / 50:.6f},0.1,0.2,1.0,0.001,-0.002,0.003,,,\n",
        IN_RADIANS,
        0.02,
        {"accel_z": 1.0},
    ),
    "instinct-imu": Sample(
        "kvh.csv",
        "Time [s],GpsCycle,GpsWeek,GpsToW [s],TimeStartup [ns],UnCompMagX [Gauss],UnCompMagY "
        "[Gauss],UnCompMagZ [Gauss],"
        "UnCompAccX [m/s^2],UnCompAccY [m/s^2],UnCompAccZ [m/s^2],UnCompGyroX "
        "[rad/s],UnCompGyroY [rad/s],UnCompGyroZ [rad/s],"
        "Temperature [Celsius]\n",
        lambda n: f"{n / 100},,,,{n * 10**7 + 5},1,2,3,0.1,0.2,9.80665,0.001,-0.002,0.003,21.5\n",
        IN_RADIANS,
        0.01,
        {"accel_z": 1.0, "temperature": 21.5, "mag_x": 100.0},
    ),
    "instinct-vectornav": Sample(
        "vn310.csv",
        "Time [s],GpsCycle,GpsWeek,GpsToW [s],Time::TimeStartup [ns],IMU::UncompMag::X "
        "[Gauss],IMU::UncompAccel::X [m/s^2],"
        "IMU::UncompAccel::Y [m/s^2],IMU::UncompAccel::Z [m/s^2],IMU::UncompGyro::X "
        "[rad/s],IMU::UncompGyro::Y [rad/s],"
        "IMU::UncompGyro::Z [rad/s],IMU::Temp [Celsius],IMU::Pres [kPa]\n",
        lambda n: f",,,,{n * 10**7 + 5},1,0.1,0.2,9.80665,0.001,-0.002,0.003,21.5,101.3\n",
        IN_RADIANS,
        0.01,
        {"accel_z": 1.0, "temperature": 21.5, "mag_x": 100.0, "pressure": 101300.0},
    ),
    "phyphox": Sample(
        "Gyroscope.csv",
        '"Time (s)","Gyroscope x (rad/s)","Gyroscope y (rad/s)","Gyroscope z (rad/s)","Absolute '
        '(rad/s)"\n',
        lambda n: f"{n / 100:.9E},1.0E-3,-2.0E-3,3.0E-3,3.7E-3\n",
        IN_RADIANS,
        0.01,
    ),
    "x-io": Sample(
        "sensors.csv",
        "Time (s),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X "
        "(g),Accelerometer Y (g),"
        "Accelerometer Z (g),Magnetometer X (uT),Magnetometer Y (uT),Magnetometer Z "
        "(uT),Barometer (hPa)\n",
        lambda n: f"{n / 100},0.5,-0.25,0.125,0.1,0.2,1.0,20,0,-40,1013\n",
        IN_DEGREES,
        0.01,
        {"accel_z": 1.0, "mag_z": -40.0, "pressure": 101300.0},
    ),
    "x-io, x-IMU": Sample(
        "LoggedData_CalInertialAndMag.csv",
        "Packet number,Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer "
        "X (g),Accelerometer Y (g),"
        "Accelerometer Z (g),Magnetometer X (G),Magnetometer Y (G),Magnetometer Z (G)\n",
        lambda n: f"{n},0.5,-0.25,0.125,0.1,0.2,1.0,0.2,0,-0.4\n",
        IN_DEGREES,
        None,
        {"accel_z": 1.0, "mag_z": -40.0},
    ),
    "sensor-logger": Sample(
        "Gyroscope.csv",
        "time,seconds_elapsed,z,y,x\n",
        lambda n: f"{1767620467350470700 + n * 10**7},{n / 100},0.003,-0.002,0.001\n",
        IN_RADIANS,
        0.01,
    ),
    "euroc": Sample(
        "data.csv",
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n",
        lambda n: f"{1403636579758555392 + n * 5 * 10**6},0.001,-0.002,0.003,0.1,0.2,9.80665\n",
        IN_RADIANS,
        0.005,
        {"accel_z": 1.0},
    ),
    "ros-topic": Sample(
        "imu.csv",
        "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.orientation.x,field.orientation.y,field.orientation.z,"
        "field.orientation.w,field.orientation_covariance0,field.angular_velocity.x,field.angular_velocity.y,field.angular_velocity.z,"
        "field.linear_acceleration.x,field.linear_acceleration.y,field.linear_acceleration.z\n",
        lambda n: (
            f"{1609060336768428032 + n * 10**7 + 999},{n},"
            f"{1609060336768428032 + n * 10**7},imu_link,0,0,0,1,-1,"
            "0.001,-0.002,0.003,0.1,0.2,9.80665\n"
        ),
        IN_RADIANS,
        0.01,
        {"accel_z": 1.0},
    ),
    "px4-sensor-combined": Sample(
        "log_sensor_combined_0.csv",
        "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],gyro_integral_dt,accelerometer_timestamp_relative,"
        "accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2],accelerometer_integral_dt\n",
        lambda n: f"{n * 4000 + 112574307},0.001,-0.002,0.003,4000,0,0.1,0.2,9.80665,4000\n",
        IN_RADIANS,
        0.004,
        {"accel_z": 1.0},
    ),
    "px4-sensor-gyro": Sample(
        "log_sensor_gyro_0.csv",
        "timestamp,timestamp_sample,device_id,x,y,z,temperature,error_count,samples\n",
        lambda n: f"{n * 4000 + 112574307},{n * 4000 + 112574100},42,0.001,-0.002,0.003,41.5,0,8\n",
        IN_RADIANS,
        0.004,
        {"temperature": 41.5},
    ),
}


def key_of(name: str) -> str:
    return name.split(",")[0]


def test_each_preset_has_a_sample_and_known_keys() -> None:
    presets = load_toml_folder("gyrostab.ingest.columns", "presets")
    assert {key_of(name) for name in SAMPLES} == set(presets)
    keys = {"name", "above", "file", "needs", "times", "drops", "rate", "columns"}
    assert [name for name, preset in presets.items() if not set(preset) <= keys] == []


@pytest.mark.parametrize("name", SAMPLES)
def test_a_file_of_a_known_program_needs_no_options(tmp_path: Path, name: str) -> None:
    sample = SAMPLES[name]
    path = sample.write_to(tmp_path)
    note_text = f"(preset {key_of(name)})"
    assert any(note_text in note for note in scan_file(path).notes)
    raw = read_log(path, rate=100.0 if name == "x-io, x-IMU" else None)
    assert any(note_text in note for note in raw.attrs["notes"])
    assert raw.attrs["unreadable_rows"] == 0
    assert raw.axis.values.tolist() == ["x", "y", "z"]
    np.testing.assert_allclose(raw.rate.values[:, 0], sample.rate, rtol=1e-12)
    if sample.step is None:
        assert "time" not in raw.variables
        assert raw.attrs["declared_rate_hz"] == (100.0 if name == "x-io, x-IMU" else 50.0)
    else:
        steps = np.diff(raw.time.values).astype(np.int64) / 1e9
        np.testing.assert_allclose(steps, sample.step, rtol=1e-9)
    for channel, value in sample.channels.items():
        assert float(raw[channel][0]) == pytest.approx(value, rel=1e-9), channel


def test_weeks_of_mip_monitor_date_its_times(tmp_path: Path) -> None:
    raw = read_log(SAMPLES["microstrain-mip"].write_to(tmp_path))
    assert raw.time.values[0] == np.datetime64("2017-02-17T17:20:10")


def test_options_overrule_a_preset(tmp_path: Path) -> None:
    sample = SAMPLES["xsens-mt-manager"]
    path = sample.write_to(tmp_path)
    in_degrees = read_log(path, unit={"gyro": "deg/s", "time": "s"})
    np.testing.assert_allclose(in_degrees.rate.values[:, 0], [3.6, -7.2, 10.8])
    assert np.diff(in_degrees.time.values).astype(np.int64).tolist() == [100 * 10**9] * 3
    swapped = read_log(path, map={"Gyr_Y": "gyro_x [deg/s]"})
    assert swapped.axis.values.tolist() == ["x"]  # the axes are named all together
    assert float(swapped.rate[0, 0]) == pytest.approx(-7.2)
    counted = read_log(path, map={"PacketCounter": "time [s]", "Acc_Z": "-"})
    assert np.diff(counted.time.values).astype(np.int64).tolist() == [10**9] * 3
    assert "accel_x" in counted
    assert "accel_z" not in counted


def test_contract_names_match_no_preset(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "time [s],gyro_x [deg/h],gyro_rad[0],gyro_rad[1],gyro_rad[2]\n0,1,0,0,0\n1,2,0,0,0\n"
    )
    raw = read_log(path)
    assert raw.rate[0].values.tolist() == [1, 2]
    assert not any("preset" in note for note in raw.attrs["notes"])


def test_preset_without_time_or_rate_requires_the_rate(tmp_path: Path) -> None:
    sample = SAMPLES["x-io, x-IMU"]
    path = sample.write_to(tmp_path)
    with pytest.raises(OptionError, match="--rate HZ"):
        read_log(path)

"""Columns of other programs: units in parentheses, duplicate names, channels without units."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from gyrostab.allan.davar import davar
from gyrostab.allan.fit import fit_noise
from gyrostab.errors import GyrostabError, MissingUnitError, UnitError
from gyrostab.ingest import read_channel, read_log
from gyrostab.ingest.columns.headers import split_header
from gyrostab.ingest.files import scan_file
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.io.datasets import to_netcdf
from gyrostab.io.opening import open_log
from tests.support.text_logs import write


def seconds(raw: xr.Dataset) -> list[float]:
    return (raw.time.values.astype("datetime64[ns]").view(np.int64) / 1e9).tolist()


def has_note(raw: xr.Dataset, *words: str) -> bool:
    return any(all(word in note for word in words) for note in raw.attrs["notes"])


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([-999.25] * 40, "in 40 of the first 40 rows; it is a common code for a missing value"),
        ([21.5, -999.25, -999.25] * 10, "in 20 of the first 30 rows, far outside all other values"),
        ([*range(36), *[-9999] * 4], "far outside all other values; it is a common code"),
        ([*range(36), *[-777] * 4], "far outside all other values; if that is a code"),
        ([5.0] * 40, None),
    ],
)
def test_codes_for_missing_values_are_named(
    tmp_path: Path, values: list[float], words: str | None
) -> None:
    rows = [f"{n / 10},{value},{n % 7}" for n, value in enumerate(values)]
    text = "\n".join(["time [s],gyro_x [deg/h],gyro_y [deg/h]", *rows])
    raw = read_log(write(tmp_path, text))
    assert has_note(raw, words or "code for a missing value") == (words is not None)


def test_a_channel_is_read_with_the_notes_of_its_file(tmp_path: Path) -> None:
    rows = [f"{n / 10},{-999.25 if n % 7 == 0 else 20 + n / 10}" for n in range(140)]
    path = write(tmp_path, "\n".join(["time [s],temperature [degC]", *rows]))
    with pytest.warns(UserWarning, match="it is a common code for a missing value"):
        read_channel(path)


def test_column_named_as_a_unit_of_rate_is_kept_as_the_rotation(tmp_path: Path) -> None:
    path = write(tmp_path, "time [s],gyro_x [deg/h],RPM\n0,1,10\n1,2,20\n")
    raw = read_log(path)
    option = '--map "RPM=rotation_rate [RPM]"'
    assert has_note(raw, "may be channels that effects follow: rotation_rate (RPM)", option)
    assert not has_note(raw, "keep one with a unit")
    key, target = shlex.split(option)[1].split("=")
    assert read_log(path, map={key: target}).rotation_rate.values.tolist() == [60.0, 120.0]


@pytest.mark.parametrize(
    ("header", "split"),
    [
        ("Gyroscope x (deg/s)", ("Gyroscope x", "deg/s")),
        ("Time (s)", ("Time", "s")),
        ("Temp(°C)", ("Temp", "°C")),
        ("GX [DEG/HR]", ("GX", "DEG/HR")),
        ("Acceleration x (m/s^2)", ("Acceleration x", "m/s^2")),
        ("supply (raw)", ("supply (raw)", None)),
        ("column (2)", ("column (2)", None)),
        ("gyro_rad[1]", ("gyro_rad[1]", None)),
    ],
)
def test_units_in_brackets_and_parentheses(header: str, split: tuple[str, str | None]) -> None:
    assert split_header(header) == split


def test_a_header_with_parentheses_needs_no_units_from_the_user(tmp_path: Path) -> None:
    path = write(tmp_path, "Time (s),GX (DEG/HR),Temperature (Celsius)\n0,1,20\n1,2,21\n")
    raw = read_log(path, map={"GX": "gyro_x"})
    assert seconds(raw) == [0, 1]
    assert raw.rate[0].values.tolist() == [1, 2]
    assert raw.temperature.values.tolist() == [20, 21]


@pytest.mark.parametrize(
    "header",
    [
        "temperature",
        "temperature [furlong]",
        "temperature [x8103]",
        "mag_x",
        "pressure [V]",
        "accel_z",
    ],
)
def test_unusable_channel_that_was_not_requested_is_left_out(tmp_path: Path, header: str) -> None:
    path = write(tmp_path, f"time [s],gyro_x [deg/h],{header}\n0,1,2\n1,2,3\n")
    raw = read_log(path)
    assert list(raw.data_vars) == ["rate"]
    assert has_note(raw, "left out", header)


@pytest.mark.parametrize(
    ("header", "unit"),
    [("temperature", "degC"), ("temperature [furlong]", "degC"), ("pressure [x8103]", "Pa")],
)
def test_advice_of_the_note_on_a_dropped_channel_works(
    tmp_path: Path, header: str, unit: str
) -> None:
    path = write(tmp_path, f"time [s],gyro_x [deg/h],{header}\n0,1,2\n1,2,3\n")
    name = header.split(" ")[0]
    advice = next(
        match[1]
        for note in read_log(path).attrs["notes"]
        if (match := re.search(r"--unit (\S+?=[^\s,;)]+)", note))
    )
    assert advice.startswith(f"{name}=")
    key, _, value = advice.partition("=")
    log = read_log(path, unit={key: unit if value == "UNIT" else value})
    assert log[name].values.tolist() == [2, 3]


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("time [s],gyro_x\n0,1\n1,2\n", {}),
        ("time [s],gyro_x [furlong]\n0,1\n1,2\n", {}),
        ("time [s],gyro_x [degC]\n0,1\n1,2\n", {}),
        ("time,gyro_x [deg/h]\n0,1\n1,2\n", {}),
        ("tick [x800E],gyro_x [deg/h]\n0,1\n1,2\n", {"map": {"tick": "time"}}),
        ("time [s],wx,wy\n0,1,2\n1,2,3\n", {}),
        ("time [s],wx (raw),wy (raw)\n0,1,2\n1,2,3\n", {}),
        ("time [s],wx [V],wy [V]\n0,1,2\n1,2,3\n", {}),
        ("time [s],gyro_x [deg/h],gyro_x [deg/h]\n0,1,1\n1,2,1\n", {}),
        ("time [s],gyro_x [deg/h],Gyro_X [deg/s]\n0,1,1\n1,2,1\n", {}),
        ("time [s],gyro_x [deg/h],T\n0,1,1\n1,2,1\n", {"map": {"T": "temperature"}}),
        ("time [s],gyro_x [deg/h],T [V]\n0,1,1\n1,2,1\n", {"map": {"T": "temperature"}}),
        ("time [s],gyro_x [deg/h]\n0,1\n1,2\n", {"kind": "angle"}),
        ("time [s],dtheta_x [arcsec]\n0,1\n1,2\n", {}),
        ("time [s],theta_x [arcsec]\n0,1\n1,2\n", {}),
        (
            "time [s],dtheta_x [arcsec]\n0,1\n1,2\n",
            {"map": {"dtheta_x": "gyro_x"}, "kind": "angle"},
        ),
    ],
)
def test_advice_of_a_message_works(tmp_path: Path, text: str, options: dict) -> None:
    path = write(tmp_path, text)
    with pytest.raises(GyrostabError) as caught:
        read_log(path, **options)
    options = {"map": dict(options.get("map", {})), "unit": {}, "kind": options.get("kind")}
    words = shlex.split(str(caught.value).replace("'", "").partition("; gyrostab scan")[0])
    for option in ("map", "unit"):
        for at, word in enumerate(words[:-1]):
            if word == f"--{option}" and "NAME" not in words[at + 1]:
                key, _, value = words[at + 1].rstrip(",;").partition("=")
                if "UNIT" not in value:
                    options[option].setdefault(key, value)
                break  # the first advice suffices
    if "--kind" in words and "leave" not in words:
        options["kind"] = words[len(words) - words[::-1].index("--kind")].rstrip(",;")
    if "UNIT" in str(caught.value) and not options["unit"]:
        options["unit"] = {"temperature": "degC"}
    assert read_log(path, **options).sizes["row"] == 2


@pytest.mark.parametrize(
    ("header", "options"),
    [
        ("TMP [degC]", {}),
        ("Temperatur [°C]", {}),
        ("Board (K)", {}),
        ("T", {"unit": {"T": "degF"}}),
    ],
)
def test_a_column_in_a_unit_of_temperature_keeps_its_name_with_a_note(
    tmp_path: Path, header: str, options: dict
) -> None:
    path = write(tmp_path, f"time [s],gyro_x [deg/h],{header},bus [V]\n0,1,2,3\n1,2,3,3\n")
    raw = read_log(path, **options)
    name = header.split(" ")[0]
    assert set(raw.data_vars) == {"rate", name, "bus"}
    assert has_note(raw, header, f'--map "{name}=temperature"')
    mapped = read_log(path, map={name: "temperature"}, **options)
    assert mapped.temperature.attrs["units"] == "degree_Celsius"
    assert not has_note(mapped, "temperature (")


def test_temperature_of_another_file_needs_no_note(tmp_path: Path) -> None:
    path = write(tmp_path, "time [s],gyro_x [deg/h],TMP [degC]\n0,1,2\n1,2,3\n")
    probe = write(tmp_path, "time [s],temperature [degC]\n0,7\n1,8\n", "probe.csv")
    raw = read_log(path, channel=probe)
    assert {"TMP", "temperature"} <= set(raw.data_vars)
    assert not has_note(raw, "temperature (")


def test_several_temperatures_keep_their_names_with_a_note(tmp_path: Path) -> None:
    path = write(tmp_path, "time [s],gyro_x [deg/h],TMP [degC],Case [degC]\n0,1,2,3\n1,2,3,3\n")
    raw = read_log(path)
    assert {"TMP", "Case"} <= set(raw.data_vars)
    assert has_note(raw, "TMP [degC], Case [degC]", '--map "TMP=temperature"')
    raw = read_log(path, map={"TMP": "temperature"})
    assert {"temperature", "Case"} <= set(raw.data_vars)
    assert not has_note(raw, "temperature")


@pytest.mark.parametrize("name", ["temp", "IMU_Temp", "TMP", "Temperatur"])
def test_name_like_a_temperature_is_advised_its_unit(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, f"time [s],gyro_x [deg/h],{name}\n0,1,2\n1,2,3\n")
    assert has_note(read_log(path), f"--unit {name}=degC")
    assert read_log(path, unit={name: "degC"})[name].values.tolist() == [2, 3]


def test_unit_option_overrules_a_header_without_a_unit(tmp_path: Path) -> None:
    path = write(tmp_path, "time [s],gyro_x [x8005],temperature [x8014]\n0,1,20\n1,2,21\n")
    raw = read_log(path, unit={"gyro": "deg/s", "temperature": "degC"})
    assert raw.rate[0].values.tolist() == [3600, 7200]
    assert raw.temperature.values.tolist() == [20, 21]
    assert has_note(raw, "gyro_x [x8005]", "--unit gyro=deg/s")


def test_requested_channel_without_a_unit_is_an_error(tmp_path: Path) -> None:
    path = write(tmp_path, "time [s],gyro_x [deg/h],T\n0,1,2\n1,2,3\n")
    probe = write(tmp_path, "time [s],temperature\n0,1\n1,2\n", "probe.csv")
    with pytest.raises(MissingUnitError, match="'T' carries no unit"):
        read_log(path, map={"T": "temperature"})
    with pytest.raises(UnitError, match="not a known unit of temperature"):
        read_log(path, map={"T": "temperature"}, unit={"temperature": "V"})
    with pytest.raises(MissingUnitError, match="'temperature' carries no unit"):
        read_log(path, channel=probe)


def test_columns_of_one_name_are_renamed(tmp_path: Path) -> None:
    header = (
        "time [s],gyro_x [deg/h],Flags [x8103],Flags [x8108],temperature [degC],temperature "
        "[degF],load [%],load [%]"
    )
    path = write(tmp_path, header + "\n0,1,3,4,20,68,5,6\n1,2,3,4,20,68,5,6\n")
    raw = read_log(path)
    expected = {
        "Flags": 3,
        "Flags_2": 4,
        "temperature": 20,
        "temperature_2": 20,
        "load": 5,
        "load_2": 6,
    }
    assert {name: float(raw[name][0]) for name in raw.data_vars if name != "rate"} == pytest.approx(
        expected
    )
    assert has_note(raw, "are renamed", "'Flags [x8108]' is 'Flags_2'")
    assert "load_2" not in read_log(path, map={"load_2": "-"})
    assert "Flags_2" not in read_log(path, map={"Flags [x8108]": "-"})


def test_mapped_axis_overrules_a_column_of_its_name(tmp_path: Path) -> None:
    path = write(tmp_path, "time [s],gyro_x [deg/h],raw_x [deg/h]\n0,1,5\n1,2,6\n")
    raw = read_log(path, map={"raw_x": "gyro_x"})
    assert raw.rate[0].values.tolist() == [5, 6]
    assert has_note(raw, "left out", "gyro_x [deg/h]")


@pytest.mark.parametrize(
    ("text", "used", "stamps"),
    [
        ("time [s],timestamp [us],gyro_x [deg/h]\n0,0,1\n1,1000000,2\n", "time [s]", [0, 1]),
        ("time [s],timestamp [us],gyro_x [deg/h]\n0,0,1\n0,1000000,2\n", "timestamp [us]", [0, 1]),
        ("Time [s],time (ms),gyro_x [deg/h]\n7,0,1\n6,1000,2\n", "time (ms)", [0, 1]),
        (
            "time,timestamp [ms],gyro_x "
            "[deg/h]\n1970-01-01T00:00:03,0,1\n1970-01-01T00:00:04,1000,2\n",
            "time",
            [3, 4],
        ),
        (
            "n,When,gyro_x [deg/h]\n7,1970-01-01T00:00:03,1\n8,1970-01-01T00:00:04,2\n",
            "When",
            [3, 4],
        ),
    ],
)
def test_the_time_column_is_chosen_and_named(
    tmp_path: Path, text: str, used: str, stamps: list[float]
) -> None:
    raw = read_log(write(tmp_path, text))
    assert seconds(raw) == stamps
    assert has_note(raw, f"{used!r}", "time")
    assert list(raw.data_vars) == ["rate"]


def test_another_time_column_can_be_named(tmp_path: Path) -> None:
    path = write(
        tmp_path, "Time [s],Time::TimeStartup [ns],gyro_x [deg/h]\n0,0,1\n1,2000000000,2\n"
    )
    assert seconds(read_log(path)) == [0, 1]
    assert seconds(read_log(path, map={"Time::TimeStartup": "time"})) == [0, 2]


def test_matlab_durations_are_the_time(tmp_path: Path) -> None:
    rows = "".join(f"{n / 100:g} sec,{n},20\n" for n in range(300))
    raw = read_log(write(tmp_path, "Time,gyro_x,T\n" + rows), unit={"gyro": "deg/h"})
    assert seconds(raw) == [n / 100 for n in range(300)]
    assert raw.rate[0].values.tolist() == list(range(300))
    assert raw.attrs["unreadable_rows"] == 0


def test_aligned_columns_without_a_header_are_mapped_by_number(tmp_path: Path) -> None:
    rows = "".join(f"{n / 100:12.4f}{n:10.3f}{-n:10.3f}   \n" for n in range(5))
    raw = read_log(
        write(tmp_path, rows, "log.txt"),
        map={"0": "time [s]", "1": "gyro_x [deg/h]", "2": "gyro_y [deg/h]"},
    )
    assert raw.rate.values.tolist() == [[0, 1, 2, 3, 4], [0, -1, -2, -3, -4]]


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
def test_a_slow_channel_with_its_own_stamps_is_read(tmp_path: Path, ending: str) -> None:
    times = np.datetime64("2026-03-14T08:00:00") + np.arange(100) * np.timedelta64(20, "ms")
    celsius = np.array([20.0, 21.0])
    foreign = xr.Dataset(
        {
            "gyro_x": ("time", np.arange(100.0), {"units": "deg/h"}),
            "T_case": ("time_t", celsius + 273.15, {"units": "K"}),
        },
        coords={"time": times, "time_t": times[::50]},
    )
    path = tmp_path / f"foreign{ending}"
    foreign.to_zarr(path) if ending == ".zarr" else foreign.to_netcdf(path)
    raw = read_log(path, map={"T_case": "temperature"})
    assert raw.rate[0].values.tolist() == list(range(100))
    assert raw.temperature.values == pytest.approx(celsius, abs=1e-9)
    assert raw.time_temperature.values.tolist() == times[::50].astype("M8[ns]").tolist()
    assert not has_note(raw, "left out")
    assert scan_file(path).channels == ("T_case",)
    write(tmp_path, "time,gyro_x [deg/h]\n2026-03-14T08:00:00,1\n2026-03-14T08:00:01,2\n")
    joined = read_log(tmp_path / "log.csv", channel=path)
    assert joined.T_case.values == pytest.approx(celsius + 273.15)  # in K, as in the file


def test_axes_along_two_dimensions_keep_their_stamps(tmp_path: Path) -> None:
    start, step = np.datetime64("2026-03-14T08:00:00"), np.timedelta64(20, "ms")
    times = start + np.arange(100) * step
    variables = {
        "gyro_x": ("time", np.arange(100.0), {"units": "deg/h"}),
        "gyro_y": ("time_y", np.arange(90.0), {"units": "deg/h"}),
    }
    foreign = xr.Dataset(variables, coords={"time": times, "time_y": times[10:]})
    foreign.to_netcdf(tmp_path / "foreign.nc")
    assert scan_file(tmp_path / "foreign.nc").axes == ("x", "y")
    log = regularise(read_log(tmp_path / "foreign.nc"))
    assert log.rate.sel(axis="x").values.tolist() == list(range(100))
    y = log.rate.sel(axis="y").values
    assert np.isnan(y[:10]).all()
    assert y[10:].tolist() == list(range(90))


def test_unusable_stamps_of_a_slow_channel_are_named(tmp_path: Path) -> None:
    units = {"units": "days since 2026-03-14", "calendar": "noleap"}
    foreign = xr.Dataset(
        {
            "gyro_x": ("time", np.arange(4.0), {"units": "deg/h"}),
            "T_case": ("day", [20.0, 21.0], {"units": "degC"}),
        },
        coords={
            "time": ("time", np.arange(4.0), {"units": "s"}),
            "day": ("day", [0.0, 1.0], units),
        },
    )
    foreign.to_netcdf(tmp_path / "foreign.nc")
    assert any("noleap" in note for note in scan_file(tmp_path / "foreign.nc").notes)
    with pytest.raises(UnitError, match=r"foreign.nc: .*calendar 'noleap'"):
        read_log(tmp_path / "foreign.nc")


@pytest.mark.parametrize("name", ["rate", "axis", "count", "tau", "term", "gap_start", "gap", "N"])
def test_a_channel_named_like_a_variable_of_gyrostab_gets_another_name(
    name: str, tmp_path: Path
) -> None:
    rows = "".join(f"{n / 10},{n % 7},{n},20\n" for n in range(300))
    path = tmp_path / "log.csv"
    path.write_text(f"time [s],gyro_x [deg/h],{name} [V],temperature [degC]\n{rows}")
    log = regularise(read_log(path))
    assert any(f"'{name}_channel'" in note for note in log.attrs["notes"])
    to_netcdf(log, tmp_path / "log.nc")
    product = fit_noise(davar(open_log(tmp_path / "log.nc"), window="10s"))
    means = product[f"{name}_channel"]
    assert means.dims == ("time",)
    np.testing.assert_allclose(means[0], 49.5)  # the mean of 0 to 99

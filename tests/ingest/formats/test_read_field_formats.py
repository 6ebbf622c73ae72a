"""Formats of rigs, robots and vehicles: small files written here, all with the same log."""

from __future__ import annotations

import sqlite3
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from gyrostab.errors import FormatError, GyrostabError, MissingUnitError, OptionError, UnitError
from gyrostab.ingest import ReadOptions, read_log, scan_file
from gyrostab.ingest.formats.layout import crc32_mpeg2
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.ingest.reading import read_channel
from tests.ingest.field_files import (
    RATES,
    ROWS,
    STAMPS,
    TEMPERATURE,
    WRITERS,
    Made,
    import_matio,
    kvh_message,
    las_text,
    stim_message,
    write_wits0,
    write_witsml,
)
from tests.support.command_line import call

START_OF_WITSML = np.datetime64("2026-05-01T08:00:00", "ns")


@pytest.fixture(params=WRITERS, scope="module")
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    return WRITERS[request.param](tmp_path_factory.mktemp("field"))


def test_every_format_holds_the_same_log(made: Made) -> None:
    raw = read_log(made.path, **made.options)
    assert raw.axis.values.tolist() == ["x", "y", "z"]
    np.testing.assert_allclose(raw.rate.values, RATES * 3.6, rtol=1e-6)
    assert np.array_equal(raw.time.values, STAMPS)
    if made.form != "novatel":
        np.testing.assert_allclose(raw.temperature.values, TEMPERATURE, rtol=1e-6)
    summary = scan_file(made.path, ReadOptions(**made.options))
    assert (summary.format, summary.axes, summary.n_rows) == (made.form, ("x", "y", "z"), ROWS)
    assert (summary.first, summary.last) == (STAMPS[0], STAMPS[-1])


def test_a_file_that_is_cut_off_is_read_in_part_or_named(made: Made, tmp_path: Path) -> None:
    if made.path.is_dir():
        pytest.skip("a folder")
    data = made.path.read_bytes()
    for size in (len(data) // 2, 40):
        path = tmp_path / made.path.name
        path.write_bytes(data[:size])
        try:
            rows, text = read_log(path, **made.options).sizes["row"], path.name
        except GyrostabError as error:
            rows, text = 0, str(error)
        assert rows < ROWS
        assert path.name in text


@pytest.mark.parametrize(
    ("name", "module", "extra"),
    [
        ("dlis", "dlisio.dlis", "dlis"),
        ("ardupilot", "pymavlink.DFReader", "ardupilot"),
        ("mcap", "rosbags.highlevel", "rosbag"),
        ("novatel", "novatel_edie.oem", "novatel"),
        ("timetable5", "matio", "matlab"),
        ("a.mseed", "pymseed", "miniseed"),
        ("a.ulg", "pyulog", "ulog"),
        ("a.tdms", "nptdms", "tdms"),
        ("a.las", "lasio", "las"),
    ],
)
def test_a_missing_library_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, module: str, extra: str
) -> None:
    path, _, options = WRITERS[name](tmp_path) if name in WRITERS else (tmp_path / name, "", {})
    if name not in WRITERS:
        path.write_bytes(b"~A\n")
    monkeypatch.setitem(sys.modules, module, None)
    advice = rf"install it with pip install 'gyrostab\[{extra}\]'"
    with pytest.raises(OptionError, match=f"{path.name}: reading it needs {module}; {advice}"):
        read_log(path, **options)


def test_the_file_of_a_ros_bag_is_read_without_its_folder(tmp_path: Path) -> None:
    file = next(WRITERS["mcap"](tmp_path).path.glob("*.mcap"))
    assert read_log(file).sizes["row"] == ROWS


@pytest.mark.parametrize(
    ("cell", "unit", "first"),
    [
        ("2026-03-14T23:59:59.5Z", "", "2026-03-14T23:59:59.5"),
        ("2026/03/14_23:59:59", "", "2026-03-14T23:59:59"),
        ("14-Mar-26/23:59:59.5", "", "2026-03-14T23:59:59.5"),
        ("03/04/2026-08:00:00", "DD/MM/YYYY", "2026-04-03T08:00"),
    ],
)
def test_the_index_of_las_holds_dates_and_times(
    tmp_path: Path, cell: str, unit: str, first: str
) -> None:
    path = tmp_path / "a.las"
    path.write_text(las_text(f"INDEX.{unit} GYRO_X.deg/h", [f"{cell} 1.5", f"{cell} 2"]))
    raw = read_log(path)
    assert raw.time.values.tolist() == [np.datetime64(first, "ns").astype(np.int64)] * 2
    assert raw.rate[0].values.tolist() == [1.5, 2.0]


def test_the_checksum_is_that_of_a_message_of_a_sensor() -> None:
    """A message of a KVH 1750, from the test of a driver."""
    text = "FE81FF5537A96A6E38586C1FB75BF862BF803E78BB650D283B0A37AC773D00284BFA34D8"
    message = np.frombuffer(bytes.fromhex(text), dtype=np.uint8)
    assert crc32_mpeg2(message[None, :-4]) == message[-4:].view(">u4")


@pytest.mark.parametrize(("sensor", "option"), [("kvh-a", "start"), ("stim300-a5", "epoch")])
def test_messages_of_known_sensors(tmp_path: Path, sensor: str, option: str) -> None:
    if sensor == "kvh-a":
        messages = [kvh_message(n, RATES[:, n % ROWS] * 1e-3, 40) for n in range(300)]
        options: dict[str, Any] = {"unit": {"gyro": "deg/s", "temperature": "degC"}}
    else:
        messages = [stim_message(n, RATES[:, n % ROWS], 40 * 256) for n in range(300)]
        options = {}
    lost, broken = 20, bytearray(messages[140])
    broken[9] ^= 1
    stream = b"".join([b"\xfe\x81", *messages[:100], *messages[100 + lost : 140], bytes(broken)])
    path = tmp_path / "log.bin"
    path.write_bytes(stream + b"\r\n".join(messages[141:]) + messages[0][:20])
    raw = read_log(path, rate=250.0, **{option: "2026-03-01"}, **options)
    numbers = np.r_[0:100, 100 + lost : 140, 141:300]
    scale = 3.6 if sensor == "kvh-a" else 3600 / 2**14
    np.testing.assert_allclose(raw.rate, RATES[:, numbers % ROWS] * scale, rtol=1e-6)
    since = (raw.time.values - np.datetime64("2026-03-01", "ns")).astype(np.int64)
    assert np.array_equal(since, numbers * 4_000_000)
    assert (raw.temperature.values == 40.0).all()
    assert any(sensor in note for note in raw.attrs["notes"])
    assert not any("--start is not used" in note for note in raw.attrs["notes"])
    assert any(f"{lost + 1} messages were lost" in note for note in raw.attrs["notes"])
    gaps = gap_table(regularise(raw))
    assert gaps["samples"].tolist() == [lost, 1]


def test_scan_shows_how_to_read_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("log.bin")
    path.write_bytes(b"".join(kvh_message(n, RATES[:, n] * 1e-3, 40) for n in range(ROWS)))
    hint = '--unit "gyro=1000 rad/s" for angles at 1000 Hz'
    assert call("scan", path) == 0
    shown = capsys.readouterr().out
    assert "check: --rate 100 is an assumption" in shown
    assert shown.splitlines()[-1].startswith("# next: gyrostab run log.bin -o product.nc")
    assert shown.splitlines()[-1].endswith(" --rate 100")
    for options in ([], ["--unit", "gyro=rad/s"]):
        assert call("scan", path, "--rate", "1000", *options) in (0, 2)
        shown = capsys.readouterr().out
        wrapped = [line for line in shown.splitlines() if "\t" not in line and "next:" not in line]
        assert all(line.startswith("# ") and len(line) <= 100 for line in wrapped)
        text = " ".join(line.lstrip("# ") for line in shown.splitlines())
        assert hint in text.replace('""', '"')


def test_without_a_unit_or_a_rate_the_messages_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.bin"
    path.write_bytes(b"".join(kvh_message(n, RATES[:, n] * 1e-3, 40) for n in range(ROWS)))
    with pytest.raises(OptionError, match=r"log\.bin: .*--rate HZ"):
        read_log(path, unit={"gyro": "deg/s"})
    with pytest.raises(MissingUnitError, match=r"log\.bin: .*--unit gyro="):
        read_log(path, rate=1000.0)


def test_the_rate_of_numbered_messages_has_any_number_of_decimals(tmp_path: Path) -> None:
    made = WRITERS["messages"](tmp_path)
    raw = read_log(made.path, **{**made.options, "rate": 1000 / 3})
    since = (raw.time.values - STAMPS[0]).astype(np.int64)
    assert np.array_equal(since, np.arange(ROWS) * 3_000_000)


@pytest.mark.parametrize("order", ["little", "big"])
def test_numbers_of_24_bits(tmp_path: Path, order: Any) -> None:
    values = [0, 1, -1, 2**23 - 1, -(2**23)]
    path = tmp_path / "run.bin"
    path.write_bytes(b"".join(b"!" + value.to_bytes(3, order, signed=True) for value in values))
    fields = '[{skip = 1}, {name = "gyro_x [deg/h]", type = "int24"}]'
    path.with_suffix(".toml").write_text(f'byte_order = "{order}"\nfields = {fields}')
    assert read_log(path, rate=1.0).rate[0].values.tolist() == values


def test_items_of_wits_are_channels(tmp_path: Path) -> None:
    path, form, options = write_wits0(tmp_path)
    channel = read_channel(path, **options)
    assert channel.values.tolist() == [60.5, 62.5, 64.5, 66.5, 68.5]
    assert channel.time_temperature.values[1] == np.datetime64("2026-03-14T08:00:02")
    assert scan_file(path).format == form
    assert {column.name for column in scan_file(path).columns} >= {"0110", "0921"}


@pytest.mark.parametrize(("time", "read"), [("930", "00:09:30"), ("1500", "00:15:00")])
def test_dates_and_times_of_wits_may_lack_leading_zeros(
    tmp_path: Path, time: str, read: str
) -> None:
    path = tmp_path / "rig.wits"
    path.write_text(f"&&\n010590501\n0106{time}\n01221.5\n!!\n&&\n010590501\n01222.5\n!!\n")
    raw = read_log(path, map={"0122": "gyro_x [deg/h]"})
    expected = [np.datetime64(f"2009-05-01T{read}"), np.datetime64("NaT")]
    np.testing.assert_array_equal(raw.time, np.array(expected, "datetime64[ns]"))


WITS_OF_TWO_RECORDS = """&&
0105260314
0106235959
01081234.5
011012.5
!!
&&
0105260315
0106000000
01081234.6
011012.75
0705260315
0706000000
0713 1.25
!!
"""


@pytest.mark.parametrize("as_channel", [False, True])
def test_all_records_of_wits_have_the_offset_of_local_times(
    tmp_path: Path, as_channel: bool
) -> None:
    path, log = tmp_path / "rig.wits", tmp_path / "gyro.csv"
    path.write_text(WITS_OF_TWO_RECORDS)
    log.write_text("time,gyro_x [deg/h]\n2026-03-15T06:00:00Z,1\n2026-03-15T06:00:01Z,2\n")
    items = {"0110": "rotation_rate [rpm]", "0713": "vibration [g]"}
    if as_channel:  # the log has its own offset
        raw = read_log(log, channel=path, map=items, unit={"time": "UTC-06:00"})
        assert raw.time.values[0] == np.datetime64("2026-03-15T06:00:00")
        first = raw.time_rotation_rate
    else:
        raw = read_log(path, map=items | {"0108": "gyro_x [deg/h]"}, unit={"time": "UTC-06:00"})
        first = raw.time
    assert first.values[0] == np.datetime64("2026-03-15T05:59:59")
    assert raw.time_vibration.values.tolist() == [
        np.datetime64("2026-03-15T06:00:00", "ns").astype(np.int64)
    ]


@pytest.mark.parametrize("index", ["measured depth", "elapsed time"])
def test_witsml_over_anything_but_dates_is_refused(tmp_path: Path, index: str) -> None:
    made = write_witsml(tmp_path)
    made.path.write_text(made.path.read_text().replace("date time", index))
    with pytest.raises(FormatError, match=r"log\.xml: .*export the log by time"):
        read_log(made.path)


def test_curves_of_witsml_have_separate_null_values(tmp_path: Path) -> None:
    path = write_witsml(tmp_path).path
    null = "<unit>degC</unit><nullValue>60.25</nullValue>"
    path.write_text(path.read_text().replace("<unit>degC</unit>", null))
    assert np.array_equal(
        read_log(path).temperature.values[:3], [60.0, np.nan, 60.5], equal_nan=True
    )


def read_small_witsml(folder: Path, *blocks: str, log: str = "", curves: str = "") -> Any:
    """Read a WITSML log of these blocks of data, with elements of the log and of its curves."""
    infos = "".join(
        f"<logCurveInfo><mnemonic>{name}</mnemonic><unit>{unit}</unit>{more}</logCurveInfo>"
        for (name, unit), more in zip(
            {"TIME": "", "gyro_x": "dega/h", "temperature": "degC"}.items(),
            curves.split() or [""] * 3,
            strict=True,
        )
    )
    path = folder / "log.xml"
    path.write_text(
        '<?xml version="1.0"?><logs xmlns="http://www.witsml.org/schemas/1series"><log><indexType>'
        f"date time</indexType><indexCurve>TIME</indexCurve>{log}{infos}"
        + "".join(f"<logData>{block}</logData>" for block in blocks)
        + "</log></logs>"
    )
    return read_log(path)


def list_witsml(names: str, *rows: str) -> str:
    """Return a block of data whose rows begin with the seconds of the index."""
    names = f"<mnemonicList>{names}</mnemonicList>" if names else ""
    return names + "".join(f"<data>2026-05-01T08:00:0{row}</data>" for row in rows)


def test_times_of_witsml_may_be_local(tmp_path: Path) -> None:
    block = list_witsml("TIME,gyro_x", "0,1", "1,2")
    zoned = list_witsml("TIME,gyro_x", "2.5-06:00,3")
    for blocks, options, first in (
        ([block], {}, "08:00"),
        ([block], {"unit": {"time": "UTC-06:00"}}, "14:00"),
        ([zoned], {}, "14:00:02.5"),
    ):
        path = tmp_path / "log.xml"
        read_small_witsml(tmp_path, *blocks, *blocks)
        raw = read_log(path, **options)
        assert raw.time.values[0] == np.datetime64(f"2026-05-01T{first}")
    with pytest.raises(OptionError, match="--unit time: no such column"):
        read_log(path, unit={"time": "UTC-06:00"})
    with pytest.raises(UnitError, match=r"column 'TZ' holds 'CEST'.*--unit time=UTC"):
        read_small_witsml(tmp_path, list_witsml("TIME,TZ,gyro_x", "0,CEST,1", "1,CEST,2"))


def test_blocks_of_witsml_have_separate_lists_of_curves(tmp_path: Path) -> None:
    raw = read_small_witsml(
        tmp_path,
        list_witsml("TIME,gyro_x,temperature", "0,1,60", "1,2,61"),
        list_witsml("TIME,temperature,gyro_x", "2,62,3"),
        list_witsml("TIME,gyro_x", "3,4"),
    )
    assert (raw.time.values == START_OF_WITSML + np.arange(4) * np.timedelta64(1, "s")).all()
    assert raw.rate[0].values.tolist() == [1, 2, 3, 4]
    np.testing.assert_array_equal(raw.temperature, [60, 61, 62, np.nan])


def test_curves_of_witsml_1_3_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    numbers = " ".join(f"<columnIndex>{number}</columnIndex>" for number in (1, 3, 2))
    raw = read_small_witsml(tmp_path, list_witsml("", "0,60,1", "1,61,2"), curves=numbers)
    assert raw.rate[0].values.tolist() == [1, 2]
    assert raw.temperature.values.tolist() == [60, 61]


@pytest.mark.parametrize("mark", ["|", "||"])
def test_cells_of_witsml_are_separated_by_its_delimiter(tmp_path: Path, mark: str) -> None:
    rows = ("TIME,gyro_x,temperature", "0,1,60", "1,2,61")
    block = list_witsml(*(row.replace(",", mark) for row in rows))
    raw = read_small_witsml(tmp_path, block, log=f"<dataDelimiter>{mark}</dataDelimiter>")
    assert raw.rate[0].values.tolist() == [1, 2]


def test_rows_of_witsml_with_too_many_cells_are_unreadable(tmp_path: Path) -> None:
    block = list_witsml("TIME,gyro_x,temperature", "0,1,60", "1,2,61,9", "2,3,62,")
    raw = read_small_witsml(tmp_path, block)
    np.testing.assert_array_equal(raw.rate[0], [1, np.nan, 3])
    assert raw.attrs["unreadable_rows"] == 1


def test_accelerometers_of_ardupilot_are_channels_without_imu_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 141, 31, ACC, QBQfff, TimeUS,I,SampleUS,AccX,AccY,AccZ",
        "FMT, 142, 31, GYR, QBQfff, TimeUS,I,SampleUS,GyrX,GyrY,GyrZ",
    ]
    for row in range(10):
        for kind in ("ACC", "GYR"):
            lines.append(f"{kind}, {20000 * row + 7}, 0, {20000 * row}, 0.1, 0.2, {row}.5")
    path.write_text("\n".join(lines) + "\n")
    raw = read_log(path)
    assert raw.axis.values.tolist() == ["x", "y", "z"]
    np.testing.assert_allclose(raw.accel_z * 9.80665, np.arange(10) + 0.5, rtol=1e-6)


def test_topics_of_an_unknown_type_are_left_out_of_a_bag(tmp_path: Path) -> None:
    """The file of a bag, whose messages have no definitions, as ROS 2 Humble writes it."""
    file = next(WRITERS["ros2"](tmp_path).path.glob("*.db3"))
    with sqlite3.connect(file) as bag:
        bag.execute("drop table message_definitions")
        bag.execute("update schema set schema_version = 3")
        bag.execute("update topics set type = 'my_msgs/msg/Heat' where name = '/imu/temperature'")
    bag.close()
    settings = file.with_name("metadata.yaml")
    text = settings.read_text().replace("sensor_msgs/msg/Temperature", "my_msgs/msg/Heat")
    settings.write_text(text.replace("version: 9", "version: 5"))
    raw = read_log(file.parent)
    assert raw.sizes["row"] == ROWS
    assert any("/imu/temperature" in note for note in raw.attrs["notes"])


def test_timetables_of_matlab_are_read_next_to_vectors(tmp_path: Path) -> None:
    matio, made = import_matio(), WRITERS["timetable5"](tmp_path)
    content = matio.load_from_mat(str(made.path))
    matio.save_to_mat(
        str(made.path), {"TT": content["TT"], "bias": np.arange(3.0)[None]}, version="v7"
    )
    raw = read_log(made.path, **made.options)
    assert np.array_equal(raw.time.values, STAMPS)
    assert any("bias" in note for note in raw.attrs["notes"])


@pytest.mark.parametrize("zone", ["", "America/Denver"])
@pytest.mark.parametrize("version", ["v7", "v7.3"])
def test_times_of_matlab_may_be_local(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, zone: str
) -> None:
    """A timetable, and another of fewer rows; MATLAB stores times with a zone in UTC."""
    matio, path = import_matio(), tmp_path / "run.mat"
    writers = sys.modules["matio.utils.matconvert"].PY_TO_MAT
    write = writers["datetime"]
    with_zone = {"tz": np.array([[zone]])} if zone else {}
    monkeypatch.setitem(writers, "datetime", lambda values: write(values) | with_zone)
    first = np.datetime64("2026-03-14T23:30:00", "ns")
    index = pd.DatetimeIndex(first + np.arange(40) * np.timedelta64(100, "ms"), name="Time")
    rates = pd.DataFrame({"gyro_x": np.arange(40.0)}, index)
    slow = pd.DataFrame({"temperature": np.arange(4.0)}, index[::10])
    matio.save_to_mat(str(path), {"imu": rates, "probe": slow}, version=version)
    units = {"gyro": "deg/s", "temperature": "degC"}
    raw = read_log(path, unit=units)
    assert (raw.time.values[0], raw.time_temperature.values[0]) == (first, first)
    if zone:
        with pytest.raises(OptionError, match="--unit time: no such column"):
            read_log(path, unit=units | {"time": "UTC-06:00"})
        return
    moved = read_log(path, unit=units | {"time": "UTC-06:00"})
    for name in ("time", "time_temperature"):
        np.testing.assert_array_equal(moved[name], raw[name] + np.timedelta64(6, "h"))


def test_tables_of_matlab_are_read_where_pandas_lacks_the_option_of_mat_io(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(option: str) -> None:
        raise pd.errors.OptionError(option)

    made = WRITERS["timetable5"](tmp_path)
    monkeypatch.setattr(pd, "get_option", refuse)  # as pandas 4 is to do
    assert read_log(made.path, **made.options).sizes["row"] == ROWS

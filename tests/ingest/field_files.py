"""Small files of the formats of rigs, robots and vehicles, all with the same log."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import IO, Any, NamedTuple

import numpy as np
import pandas as pd

from gyrostab.arrays import Array
from gyrostab.ingest.formats.layout import crc32_mpeg2
from gyrostab.ingest.formats.matlab import keep_pandas_options

ROWS, RATE = 60, 50.0
START = np.datetime64("2026-03-01T12:00:00", "ns")
STAMPS = START + (np.arange(ROWS) * 20_000_000).astype("timedelta64[ns]")
#: Three axes [1e-3 deg/s], and a temperature [degC].
RATES = np.random.default_rng(3).integers(-20000, 20000, (3, ROWS))
TEMPERATURE = 60.0 + np.arange(ROWS) / 4
RAD = np.deg2rad(1.0)


class Made(NamedTuple):
    """A written file: its format, and the reading options that it needs."""

    path: Path
    form: str
    options: dict[str, Any]


def write_trace(
    file: IO[bytes], code: str, values: Array, rate: float, start: Any, **records: Any
) -> None:
    """Append a trace of miniSEED that starts at an instant, as integer [ns] or datetime64[ns]."""
    from pymseed import MS3TraceList

    traces = MS3TraceList()
    kind = "d" if values.dtype.kind == "f" else "i"
    first = int(np.asarray(start).astype(np.int64))
    traces.add_data(f"FDSN:XX_TOOL__{code}", values, kind, rate, starttime=first)
    for record in traces.generate(max_record_length=512, **records):
        file.write(record)


def las_text(curves: str, rows: Iterable[str]) -> str:
    """Return a LAS file with curves, such as ``TIME.S GYRO_X.deg/h``, and rows."""
    head = "~V\nVERS. 2.0 :\nWRAP. NO :\n~W\nSTRT. 0 :\nSTOP. 1 :\nSTEP. 0 :\nNULL. -999.25 :\n~C"
    return "\n".join([head, *(f"{curve} :" for curve in curves.split()), "~A", *rows, ""])


def write_las(place: Path) -> Made:
    rows = (
        f"{np.datetime_as_string(stamp, 'ms').replace('T', '/')} {x} {y} {z} {t}"
        for stamp, (x, y, z), t in zip(STAMPS, RATES.T * 3.6, TEMPERATURE, strict=True)
    )
    curves = "DTIM. GYRO_X.deg/h GYRO_Y.deg/h GYRO_Z.deg/h TEMPERATURE.degC"
    path = place / "run.las"
    path.write_text(las_text(curves, rows))
    return Made(path, "las", {})


def write_witsml(place: Path) -> Made:
    names = ("TIME", "GYRO_X", "GYRO_Y", "GYRO_Z", "TEMPERATURE")
    curves = "".join(
        f"<logCurveInfo uid='{name}'><mnemonic>{name}</mnemonic><unit>{unit}</unit></logCurveInfo>"
        for name, unit in zip(names, ("unitless", *["rad/s"] * 3, "degC"), strict=True)
    )
    rows = "".join(
        f"<data>{np.datetime_as_string(stamp, 'ms')}Z,{','.join(map(str, values))},{t}</data>"
        for stamp, values, t in zip(STAMPS, RATES.T * 1e-3 * RAD, TEMPERATURE, strict=True)
    )
    path = place / "log.xml"
    path.write_text(
        '<?xml version="1.0"?>\n<logs xmlns="http://www.witsml.org/schemas/1series" '
        'version="1.4.1.1"><log uid="1"><name>gyro</name><indexType>date time</indexType>'
        f"<indexCurve>TIME</indexCurve><nullValue>-999.25</nullValue>{curves}<logData>"
        f"<mnemonicList>{','.join(names)}</mnemonicList>{rows}</logData></log></logs>"
    )
    return Made(path, "witsml", {})


def write_wits0(place: Path) -> Made:
    """Write a frame a second: bit depth, and in every second frame a temperature of the tool."""
    lines = []
    for second in range(10):
        time = f"{80000 + second:06d}"
        lines += ["&&", "01011", "0105260314", f"0106{time}", f"0110{2500 + second}"]
        if second % 2 == 0:
            lines += ["0905260314", f"0906{time}", f"0921 {60.5 + second}"]
        lines.append("!!")
    path = place / "rig.wits"
    path.write_bytes("\r\n".join([*lines, "&&", "01019999", ""]).encode())
    return Made(path, "wits0", {"map": {"0921": "temperature [degC]"}})


def write_dlis(place: Path) -> Made:
    """Write one frame of doubles over an index TIME in milliseconds."""

    def text(value: str) -> bytes:
        return bytes([len(value)]) + value.encode()

    def name(value: str) -> bytes:
        return b"\x01\x00" + text(value)

    def segment(body: bytes, kind: int, *, explicit: bool) -> bytes:
        pad = -len(body) % 2 or 2 * (len(body) < 12)
        pad += max(0, 12 - len(body) - pad)
        attributes = (0x80 if explicit else 0) | (0x01 if pad else 0)
        body += bytes(max(pad - 1, 0)) + bytes([pad] if pad else [])
        return struct.pack(">HBB", len(body) + 4, attributes, kind) + body

    def table(kind: str, labels: dict[str, int], objects: dict[str, list[bytes]]) -> bytes:
        """Return a set of objects; each attribute is a count with a value, or a value."""
        body = b"\xf0" + text(kind)
        for label, code in labels.items():
            body += b"\x34" + text(label) + bytes([code])
        for object_name, values in objects.items():
            body += b"\x70" + name(object_name) + b"".join(values)
        return body

    names = ("TIME", "GYRO_X", "GYRO_Y", "GYRO_Z", "TEMPERATURE")
    units = ("ms", *["rad/s"] * 3, "degC")
    count = b"\x29\x01"
    header = {"0": [b"\x21" + text("1".rjust(10)), b"\x21" + text("run7".ljust(65))]}
    channels = {
        channel: [b"\x21\x07", b"\x21" + text(unit), count + b"\x01"]
        for channel, unit in zip(names, units, strict=True)
    }
    listed = b"\x29" + bytes([len(names)]) + b"".join(map(name, names))
    records = [
        segment(table("FILE-HEADER", {"SEQUENCE-NUMBER": 20, "ID": 20}, header), 0, explicit=True),
        segment(
            table("ORIGIN", {"FILE-ID": 20}, {"0": [b"\x21" + text("run7")]}), 1, explicit=True
        ),
        segment(
            table("CHANNEL", {"REPRESENTATION-CODE": 15, "UNITS": 27, "DIMENSION": 18}, channels),
            3,
            explicit=True,
        ),
        segment(
            table(
                "FRAME", {"CHANNELS": 23, "INDEX-TYPE": 19}, {"A": [listed, b"\x21" + text("TIME")]}
            ),
            4,
            explicit=True,
        ),
    ]
    for row in range(ROWS):
        values = (20.0 * row, *(RATES[:, row] * 1e-3 * RAD), TEMPERATURE[row])
        body = name("A") + bytes([row + 1]) + struct.pack(">5d", *values)
        records.append(segment(body, 0, explicit=False))
    label = b"   1V1.00RECORD08192" + b"gyrostab".ljust(60)
    path = place / "run.dlis"
    path.write_bytes(
        label
        + b"".join(struct.pack(">HBB", len(record) + 4, 0xFF, 1) + record for record in records)
    )
    return Made(path, "dlis", {"epoch": str(START)})


def write_ardupilot(place: Path) -> Made:
    """Write messages of two IMUs, of which the first holds the log."""

    def form(kind: int, name: str, codes: str, columns: str) -> bytes:
        size = 3 + sum({"Q": 8, "B": 1, "f": 4, "n": 4, "N": 16, "Z": 64}[code] for code in codes)
        head = struct.pack(
            "<BB4s16s64s", kind, size, name.encode(), codes.encode(), columns.encode()
        )
        return b"\xa3\x95\x80" + head

    data = [
        form(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"),
        form(140, "IMU", "QBfffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T"),
    ]
    for row in range(ROWS):
        for instance in (0, 1):
            rates = RATES[:, row] * 1e-3 * RAD * (1 + instance)
            values = (20_000 * row, instance, *rates, 0.0, 0.0, -9.81, TEMPERATURE[row])
            data.append(b"\xa3\x95\x8c" + struct.pack("<QB7f", *values))
    path = place / "00000012.BIN"
    path.write_bytes(b"".join(data))
    return Made(path, "ardupilot", {"epoch": str(START)})


def write_rosbag(place: Path, form: str) -> Made:
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    is_first_version = form == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_first_version else Stores.ROS2_HUMBLE)
    path = place / ("run.bag" if is_first_version else "bag")
    plugin = None if is_first_version else getattr(rosbag2.StoragePlugin, form.upper())
    types = store.types
    vector, header = types["geometry_msgs/msg/Vector3"], types["std_msgs/msg/Header"]
    turn, time = types["geometry_msgs/msg/Quaternion"], types["builtin_interfaces/msg/Time"]
    imu, heat = types["sensor_msgs/msg/Imu"], types["sensor_msgs/msg/Temperature"]
    none = np.zeros(9)
    with (
        rosbag1.Writer(path)
        if is_first_version
        else rosbag2.Writer(path, version=9, storage_plugin=plugin) as bag
    ):
        topics = {
            kind.__msgtype__: bag.add_connection(topic, kind.__msgtype__, typestore=store)
            for topic, kind in (("/imu/data", imu), ("/imu/temperature", heat))
        }
        for row in range(ROWS):
            stamp = int(STAMPS[row].astype(np.int64))
            first = {"seq": row} if is_first_version else {}
            head = header(**first, stamp=time(*divmod(stamp, 10**9)), frame_id="imu")
            rates = vector(*(float(rate) for rate in RATES[:, row] * 1e-3 * RAD))
            flat = vector(0.0, 0.0, 9.81)
            for message in (
                imu(head, turn(0.0, 0.0, 0.0, 1.0), none, rates, none, flat, none),
                heat(head, float(TEMPERATURE[row]), 0.0),
            ):
                kind = message.__msgtype__
                raw = (
                    store.serialize_ros1(message, kind)
                    if is_first_version
                    else store.serialize_cdr(message, kind)
                )
                bag.write(topics[kind], stamp + 5_000_000, raw)
    return Made(path, "rosbag", {})


def write_novatel(place: Path) -> Made:
    """Write short binary messages RAWIMUSX, with angles of 1e-3 deg * 20 ms a count."""
    data = []
    for row in range(ROWS):
        since = (STAMPS[row] - np.datetime64("1980-01-06", "ns")).astype(np.int64)
        week, rest = divmod(int(since), 604800 * 10**9)
        x, y, z = (int(rate) for rate in RATES[:, row])
        body = struct.pack("<BBHdI6i", 0, 60, week, rest / 1e9, 0, 1000, 0, 0, z, -y, x)
        head = b"\xaa\x44\x13" + struct.pack("<BHHI", len(body), 1462, week, rest // 10**6)
        crc = zlib.crc32(head + body, 0xFFFFFFFF) ^ 0xFFFFFFFF
        data.append(head + body + struct.pack("<I", crc))
    path = place / "span.gps"
    path.write_bytes(b"".join(data))
    return Made(path, "novatel", {"unit": {"gyro": "0.001 deg/s"}})


def kvh_message(number: int, rates: Any, temperature: int) -> bytes:
    body = bytes.fromhex("FE81FF55") + struct.pack(
        ">6fBBh", *rates, 0.0, 0.0, 1.0, 0x77, number % 128, temperature
    )
    return body + int(crc32_mpeg2(np.frombuffer(body, np.uint8)[None])[0]).to_bytes(4, "big")


def stim_message(number: int, counts: Any, temperature: int) -> bytes:
    """Return a datagram A5 at 250 Hz, whose counter counts 8 samples at 2000 Hz."""
    triples = b"".join(int(count).to_bytes(3, "big", signed=True) for count in counts)
    body = b"\xa5" + triples + b"\0" + bytes(9) + b"\0"
    body += struct.pack(">3hB", temperature, 0, 0, 0) + bytes(7)
    body += struct.pack(">BH", 8 * number % 256, 500)
    return body + int(crc32_mpeg2(np.frombuffer(body, np.uint8)[None])[0]).to_bytes(4, "big")


def write_kvh(place: Path) -> Made:
    path = place / "kvh.bin"
    rows = range(ROWS)
    path.write_bytes(
        b"".join(kvh_message(n, RATES[:, n] * 1e-3, int(100 * TEMPERATURE[n])) for n in rows)
    )
    units = {"gyro": "deg/s", "temperature": "0.01 degC"}
    return Made(path, "binary", {"rate": RATE, "epoch": str(START), "unit": units})


def import_matio() -> ModuleType:
    """Import mat-io without the option of pandas that it sets for all tests that follow."""
    with keep_pandas_options():
        return import_module("matio")


def write_matlab(place: Path, version: str) -> Made:
    """Write a timetable by row times."""
    columns = {f"gyro_{axis}": values * 1e-3 for axis, values in zip("xyz", RATES, strict=True)}
    index = pd.DatetimeIndex(STAMPS, name="Time")
    table = pd.DataFrame({**columns, "temperature": TEMPERATURE}, index=index)
    path = place / "run.mat"
    import_matio().save_to_mat(str(path), {"TT": table}, version=version)
    return Made(path, "matlab", {"unit": {"gyro": "deg/s", "temperature": "degC"}})


#: Row of the result table of the fuzz harness -> function that writes the file.
WRITERS: dict[str, Callable[[Path], Made]] = {
    "las dates": write_las,
    "witsml": write_witsml,
    "dlis": write_dlis,
    "ardupilot": write_ardupilot,
    "ros1": lambda place: write_rosbag(place, "bag"),
    "ros2": lambda place: write_rosbag(place, "sqlite3"),
    "mcap": lambda place: write_rosbag(place, "mcap"),
    "novatel": write_novatel,
    "timetable5": lambda place: write_matlab(place, "v7"),
    "timetable7.3": lambda place: write_matlab(place, "v7.3"),
    "messages": write_kvh,
}

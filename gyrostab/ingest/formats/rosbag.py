"""ROS 1 bags, ROS 2 bags and MCAP files: the numbers of each topic, ``angular_velocity.x``.

A ROS 2 bag is a folder with ``metadata.yaml``, or a file of it. Stamps come from the headers of
messages, otherwise the times of recording. Units follow from the definitions of the messages.

References
----------
ROS common_interfaces, package sensor_msgs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gyrostab.ingest.columns.plan import describe_left_out
from gyrostab.ingest.formats.recognise import read_head
from gyrostab.ingest.formats.tables import Messages, TablesOfFile, library, make_reader
from gyrostab.ingest.options import ReadOptions

_MAGICS = (b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0")
#: Type of a message -> field -> target in the form of ``--map``.
_MEANINGS = {
    "sensor_msgs/msg/Imu": {
        **{f"angular_velocity.{axis}": f"gyro_{axis} [rad/s]" for axis in "xyz"},
        **{f"linear_acceleration.{axis}": f"accel_{axis} [m/s^2]" for axis in "xyz"},
    },
    "sensor_msgs/msg/MagneticField": {f"magnetic_field.{a}": f"mag_{a} [T]" for a in "xyz"},
    "sensor_msgs/msg/Temperature": {"temperature": "temperature [degC]"},
    "sensor_msgs/msg/FluidPressure": {"fluid_pressure": "pressure [Pa]"},
}
#: Larger messages hold images or clouds of points, and are left out [bytes].
_LARGEST_MESSAGE = 4096


def matches(path: Path) -> bool:
    """Return whether the file begins like a bag, or the folder is a ROS 2 bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return read_head(path).startswith(_MAGICS)


def _read_topics(path: Path, options: ReadOptions) -> TablesOfFile:
    """Return a table for each topic with numbers, and notes on topics that are left out."""
    highlevel = library("rosbags.highlevel", path, extra="rosbag")
    typesys = library("rosbags.typesys", path, extra="rosbag")
    typestore = typesys.get_typestore(typesys.Stores.LATEST)
    by_topic: dict[tuple[str, str], Messages] = {}
    left_out: dict[str, None] = {}
    with highlevel.AnyReader([path], default_typestore=typestore) as reader:
        known = [c for c in reader.connections if c.msgtype in reader.typestore.fielddefs]
        unknown = {c.topic for c in reader.connections if c not in known}
        for connection, received, raw in reader.messages(known) if known else ():
            if len(raw) > _LARGEST_MESSAGE:
                left_out[connection.topic] = None
                continue
            message = reader.deserialize(raw, connection.msgtype)
            messages = by_topic.setdefault((connection.topic, connection.msgtype), Messages())
            messages.add(_message_time(message) or received, dict(_select_numbers(message)))
    tables = [
        messages.make_table(topic, targets=_MEANINGS.get(kind))
        for (topic, kind), messages in by_topic.items()
    ]
    reasons = (
        ("their messages are large", list(left_out)),
        ("the types of their messages are unknown", sorted(unknown)),
    )
    return tables, [note for reason in reasons for note in describe_left_out(*reason)]


def _message_time(message: Any) -> int:
    """Return the stamp in the header [ns since 1970], 0 without one."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _select_numbers(message: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield names and values of the numbers in a message, including messages within it."""
    for field in dataclasses.fields(message):
        value = getattr(message, field.name)
        if isinstance(value, int | float):
            yield prefix + field.name, float(value)
        elif dataclasses.is_dataclass(value) and field.name != "header":
            yield from _select_numbers(value, f"{prefix}{field.name}.")


scan, read = make_reader("rosbag", _read_topics)

"""ArduPilot DataFlash logs, binary and text: gyros, accelerometers and what explains them.

Columns are named by message, instance and field (``IMU[0].GyrX``); axes and channels are those of
the first instance. Stamps are microseconds since the start of the autopilot.

References
----------
ArduPilot, onboard message log messages.
"""

from __future__ import annotations

import threading
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from gyrostab.errors import DamageError
from gyrostab.ingest.formats.recognise import make_matcher, read_head
from gyrostab.ingest.formats.tables import Messages, TablesOfFile, library, make_reader
from gyrostab.ingest.options import ReadOptions

#: Held while the standard streams of the process are redirected.
_LOCK = threading.Lock()
_BINARY = b"\xa3\x95\x80"
_GYRO = {f"Gyr{axis.upper()}": f"gyro_{axis} [rad/s]" for axis in "xyz"}
_ACCEL = {f"Acc{axis.upper()}": f"accel_{axis} [m/s^2]" for axis in "xyz"}
#: Message -> field -> target in the form of ``--map``; GYR and ACC hold every sample of a sensor.
_MEANINGS = {
    "IMU": {**_GYRO, **_ACCEL, "T": "temperature [degC]"},
    "GYR": _GYRO,
    "ACC": _ACCEL,
    "MAG": {f"Mag{axis.upper()}": f"mag_{axis} [mG]" for axis in "xyz"},
    "BARO": {"Press": "pressure [Pa]", "Temp": "temperature_baro [degC]"},
}


#: The description of a message, binary or in a line.
matches = make_matcher(_BINARY + rb"|(?ms:.*?^FMT, ?128, ?89, ?FMT,)")


def _open_binary(reader: Any, path: Path) -> Any:
    """Open a binary log; the library would read a message without length again for ever."""

    class Forward(reader):  # type: ignore[misc]
        def _parse_next(self) -> Any:
            begin = self.offset
            message = super()._parse_next()
            if message is not None and self.offset <= begin:
                raise DamageError(
                    f"{path.name}: is damaged, the message at byte {begin} has no length; copy it "
                    "again"
                )
            return message

    return Forward(str(path))


def _read_messages(path: Path, options: ReadOptions) -> TablesOfFile:
    """Return a table for each message and instance of a sensor."""
    reader = library("pymavlink.DFReader", path, extra="ardupilot")
    binary = read_head(path).startswith(_BINARY)
    by_instance: dict[tuple[str, int], Messages] = {}
    # It prints what it skips, and the streams are those of the process.
    with _LOCK, redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        log = (
            _open_binary(reader.DFReader_binary, path)
            if binary
            else reader.DFReader_text(str(path))
        )
        while (message := log.recv_match(type=list(_MEANINGS))) is not None:
            fields = message.to_dict()
            kind, instance = message.get_type(), fields.pop("I", 0)
            stamp = fields.pop("TimeUS", None)
            stamp = fields.pop("SampleUS", stamp)
            if isinstance(stamp, int):
                numbers = {
                    f"{kind}[{instance}].{name}": value
                    for name, value in fields.items()
                    if isinstance(value, int | float)
                }
                by_instance.setdefault((kind, instance), Messages()).add(stamp, numbers)
    inertial = ("IMU",) if ("IMU", 0) in by_instance else ("GYR", "ACC")
    targets = {
        f"{kind}[0].{field}": target
        for kind in (*inertial, "MAG", "BARO")
        for field, target in _MEANINGS[kind].items()
    }
    return [
        messages.make_table(time_unit="us", targets=targets) for messages in by_instance.values()
    ], ()


scan, read = make_reader("ardupilot", _read_messages)

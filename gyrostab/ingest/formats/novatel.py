"""NovAtel SPAN logs, binary and ASCII: raw counts of the IMU.

The scale of a count is in the manual of the IMU; a count is an angle, so it is multiplied with the
rate. The axis y is negated in the messages, and turned back here. Stamps are GPS time.

References
----------
NovAtel, OEM7 commands and logs reference manual, RAWIMU, RAWIMUX, RAWIMUS and RAWIMUSX.
"""

from __future__ import annotations

from pathlib import Path

from gyrostab.ingest.columns.stamps import GPS_EPOCH, GPS_NOTE, GPS_WEEK, MAX_GPS_WEEK, NAT
from gyrostab.ingest.formats.recognise import make_matcher
from gyrostab.ingest.formats.tables import Messages, TablesOfFile, library, make_reader
from gyrostab.ingest.options import ReadOptions

_SENSORS = ("gyro", "accel")
_KINDS = ("RAWIMU", "RAWIMUX", "RAWIMUS", "RAWIMUSX")


#: A message of a receiver, binary or in a line.
matches = make_matcher(rb"\xaa\x44[\x12\x13]|(?ms:.*?^[#%][A-Z0-9]{3,}A,[^\r\n]*;)")


def _read_messages(path: Path, options: ReadOptions) -> TablesOfFile:
    """Return a table for each kind of message, and a note on their time."""
    oem = library("novatel_edie.oem", path, extra="novatel")
    by_kind: dict[str, Messages] = {}
    for message in oem.FileParser(str(path)):
        if getattr(message, "name", None) not in _KINDS:  # or bytes between messages
            continue
        fields = message.to_dict()
        week, since = int(fields["gps_week"]), round(float(fields["gps_seconds"]) * 1e9)
        counts = {f"{kind}_{axis}": fields[f"{kind}_{axis}"] for kind in _SENSORS for axis in "xyz"}
        counts |= {f"{kind}_y": -counts[f"{kind}_y"] for kind in _SENSORS}
        usable = 0 <= week <= MAX_GPS_WEEK and 0 <= since <= GPS_WEEK
        stamp = GPS_EPOCH + week * GPS_WEEK + since if usable else NAT
        by_kind.setdefault(message.name, Messages()).add(stamp, counts)
    return [messages.make_table(kind) for kind, messages in by_kind.items()], [GPS_NOTE]


scan, read = make_reader("novatel", _read_messages)

"""Small text logs, for the tests of their reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np

PLAIN = "time [s],gyro_x [deg/h]\n"


def write(folder: Path, text: str | bytes, name: str = "log.csv") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def ns(raw: object) -> list[int]:
    return [int(stamp) for stamp in raw.time.values.astype("datetime64[ns]").astype(np.int64)]  # type: ignore[attr-defined]

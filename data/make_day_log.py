"""Simulate the log of `gyrostab demo`, ``models/demo.toml``, and write it as ``mwd_day.csv.gz``.

    python data/make_day_log.py

Rows that the telemetry lost are missing from the file. The values of the gyro are rounded to
0.01 deg/h; temperature and vibration have a value every ten seconds.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np

from gyrostab import simulate

HERE = Path(__file__).resolve().parent
RATE, CHANNEL_RATE, SLOW_RATE = 2, 1, 0.1  # Hz: gyro, simulated channels, channels in the file


def format_rows() -> list[str]:
    """The lines of the file."""
    log = simulate(HERE / "models" / "demo.toml").load()
    milliseconds = log["time"].values.astype("datetime64[ms]")
    rates = np.round(log["rate"].values, 2)
    slow = np.stack([log["temperature"].values, log["vibration"].values])
    axes = ",".join(f"gyro_{axis} [deg/h]" for axis in log["axis"].values)
    lines = [
        "# SIMULATED log of a three-axis fiber-optic gyro; no measurement.",
        "# Written by data/make_day_log.py from data/models/demo.toml, which states what is true.",
        f"time,{axes},temperature [degC],vibration [g]",
    ]
    for row in np.flatnonzero(np.isfinite(rates).all(axis=0)):
        extra = ["", ""]
        if row % round(RATE / SLOW_RATE) == 0:
            extra = [f"{value:.2f}" for value in slow[:, row * CHANNEL_RATE // RATE]]
        values = (f"{value:.2f}" for value in rates[:, row])
        lines.append(f"{milliseconds[row]}Z,{','.join(values)},{','.join(extra)}")
    return lines


if __name__ == "__main__":
    with (HERE / "mwd_day.csv.gz").open("wb") as file:
        file.write(gzip.compress("\n".join(format_rows()).encode() + b"\n", 9, mtime=0))

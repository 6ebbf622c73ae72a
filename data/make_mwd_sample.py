"""Simulate the log of a three-axis fiber-optic gyro on a shaker; write it and its README.

The files are ``mwd_sample.csv.gz`` and ``README.md`` in this folder. The timeline is that of the
vibration experiment in section 8 of Wang et al., Sensors 16 (2016): 930 s, still until 330 s,
vibrating until 630 s, still again, data lost from 432 s to 450 s, at about 65 degC, 13.39 g rms
with its power at 700-800 Hz. The sampling rate here is 100 Hz. Time t is in seconds from the first
row. With dt = 0.01 s, each axis reads

    rate(t) = earth + a_T (T(t) - 60 degC) + k_2 g(t)^2 + b(t) + w(t)
              + (theta(t) - theta(t - dt)) / dt

- ``earth``: earth rate, 15.041 deg/h, in a tool that hangs plumb at 40 degrees north with toolface
  azimuth 30 degrees.
- ``a_T``: temperature sensitivity that remains after compensation, up to 3e-3 deg/h/degC for a gyro
  of the 0.03 deg/h class (estimate).
- ``k_2 g^2``: vibration rectification. Published sinusoidal tests at 30 Hz and 6 g gave 0.0118 to
  0.0445 deg/h, that is 0.7e-3 to 2.5e-3 deg/h/g^2 if 6 g is the amplitude; g is the rms
  acceleration. It is a step of the mean, not a random walk.
- ``b``: bias instability (flicker, two-sided PSD B^2 / (2 pi f)) plus rate random walk (white
  steps), at one level throughout.
- ``w``: white rate noise, N, raised by a factor under vibration (intensity and polarisation noise
  of the shaken fiber; in stepped vibration tests of a three-axis gyro by Li et al., Chin. J. Lasers
  40 (2013) 0908004, N rose four times on average, ten times at most).
- ``theta``: angle noise. At rest it is the rounding of the angle increments (Q). Under vibration
  the housing also *rotates* back and forth in the band 700-800 Hz. The logger integrates the rate
  over each interval, which means that it samples the angle; a flat band of 100 Hz sampled at 100 Hz
  folds to a white sequence, which no Allan variance can distinguish from quantization noise with
  Q = the rms angle.

Under vibration N and Q therefore rise for two different reasons, B and K do not rise, and the mean
steps.

Then the logger and the telemetry damage the log: missing rows, unreadable cells, duplicated rows,
rows out of order, flipped bits.
"""

from __future__ import annotations

import gzip
import io
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gyrostab.noise import URAD_PER_S

SEED = 20160930
RATE = 100  # Hz
DURATION = 930  # s
VIBRATING = (330.0, 630.0)  # s
LOST = (432.0, 450.0)  # s
START = np.datetime64("2026-03-14T08:00:00.000")
G_STILL, G_VIBRATING = 0.02, 13.39  # g rms
LSB = 0.01  # deg/h
AXES = ("x", "y", "z")

#: Truth by axis, in the units of the README; ``N_factor`` and ``theta`` (rms angle, urad) act under
#: vibration only.
TRUTH: dict[str, dict[str, float]] = {
    "x": {
        "Q": 0.06,
        "N": 0.006,
        "B": 0.03,
        "K": 0.05,
        "N_factor": 5.0,
        "theta": 0.40,
        "k_2": 1.5e-3,
        "a_T": 3.0e-3,
    },
    "y": {
        "Q": 0.06,
        "N": 0.010,
        "B": 0.03,
        "K": 0.05,
        "N_factor": 2.5,
        "theta": 0.25,
        "k_2": 2.4e-3,
        "a_T": -2.0e-3,
    },
    "z": {
        "Q": 0.06,
        "N": 0.004,
        "B": 0.02,
        "K": 0.03,
        "N_factor": 1.3,
        "theta": 0.08,
        "k_2": 0.8e-3,
        "a_T": 1.0e-3,
    },
}
#: Short losses: start [s], length [s].
DROPOUTS = (
    (37.42, 0.05),
    (118.90, 0.30),
    (203.15, 1.20),
    (289.77, 0.12),
    (401.33, 0.75),
    (547.08, 2.00),
    (699.51, 0.08),
    (812.64, 0.45),
)
SPIKES = (251.20, 14)  # s, flipped words on axis y within 0.4 s
WORDS = ("****", "ERR", "")


def earth_rate() -> dict[str, float]:
    """Earth rate by axis [deg/h]; z points down."""
    latitude, azimuth = np.radians(40.0), np.radians(30.0)
    level = 15.041 * np.cos(latitude)
    return {
        "x": level * np.cos(azimuth),
        "y": -level * np.sin(azimuth),
        "z": -15.041 * np.sin(latitude),
    }


def shaped(
    rng: np.random.Generator, size: int, rate: float, psd: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Draw `size` samples of Gaussian noise at `rate` [Hz].

    `psd` is the two-sided density at ``rfftfreq(size, 1 / rate)``.
    """
    parts = rng.standard_normal((2, psd.size))
    spectrum = (parts[0] + 1j * parts[1]) * np.sqrt(psd * rate * size / 2.0)
    spectrum[0] = 0.0
    return np.fft.irfft(spectrum, size)


def flicker(rng: np.random.Generator, size: int, coefficient: float) -> NDArray[np.float64]:
    """Draw flicker noise [deg/h], twice as long and halved, so that it is not periodic."""
    frequency = np.fft.rfftfreq(2 * size, 1.0 / RATE)
    psd = np.zeros(frequency.size)
    psd[1:] = coefficient**2 / (2.0 * np.pi * frequency[1:])
    return shaped(rng, 2 * size, RATE, psd)[:size]


def angular_vibration(rng: np.random.Generator, size: int, rms: float) -> NDArray[np.float64]:
    """Draw the angle of a motion with a flat band of 700-800 Hz at the ends of sampling intervals.

    The unit is that of `rms`.
    """
    fine = 20  # 2 kHz
    frequency = np.fft.rfftfreq(size * fine, 1.0 / (RATE * fine))
    psd = np.where(
        (frequency > 700.0) & (frequency < 800.0), rms**2 / 200.0, 0.0
    )  # 200 Hz: both signs of the frequency
    return shaped(rng, size * fine, RATE * fine, psd)[::fine]


def simulate(rng: np.random.Generator) -> pd.DataFrame:
    """Make the log as an ideal logger would have it: every row, no spoiled word."""
    size = DURATION * RATE
    second = np.arange(size) / RATE
    shaken = (second >= VIBRATING[0]) & (second < VIBRATING[1])
    # the tool warms by its own electronics towards 68 degC, a little faster while it is shaken
    temperature = (
        68.0
        - 10.0 * np.exp(-second / 600.0)
        + 0.4 * np.clip((second - VIBRATING[0]) / 300.0, 0.0, 1.0)
    )
    columns: dict[str, NDArray[np.float64]] = {"second": second}
    for axis in AXES:
        truth, earth = TRUTH[axis], earth_rate()[axis]
        white = (
            60.0
            * truth["N"]
            * np.sqrt(RATE)
            * rng.standard_normal(size)
            * np.where(shaken, truth["N_factor"], 1.0)
        )
        walk = np.cumsum(rng.standard_normal(size)) * truth["K"] / np.sqrt(3600.0 * RATE)
        theta = truth["Q"] * rng.standard_normal(size + 1)
        theta[1:][shaken] += angular_vibration(rng, int(shaken.sum()), truth["theta"])
        mean = (
            earth
            + truth["a_T"] * (temperature - 60.0)
            + truth["k_2"] * np.where(shaken, G_VIBRATING, G_STILL) ** 2
        )
        columns[axis] = (
            mean
            + walk
            + flicker(rng, size, truth["B"])
            + white
            + np.diff(theta) * URAD_PER_S * RATE
        )
    columns["temperature"] = temperature + 0.02 * rng.standard_normal(size)
    columns["vibration"] = np.where(shaken, G_VIBRATING, G_STILL) * (
        1.0 + 0.02 * rng.standard_normal(size)
    )
    return pd.DataFrame(columns)


def write_cells(frame: pd.DataFrame, rng: np.random.Generator) -> list[list[str]]:
    """Rows of text cells; the two slow sensors stand in one row a second, each in its own."""
    codes = {axis: np.rint(frame[axis].to_numpy() / LSB).astype(np.int64) for axis in AXES}
    first = round(SPIKES[0] * RATE)
    hit = first + np.sort(rng.choice(40, SPIKES[1], replace=False))
    codes["y"][hit] ^= 1 << rng.integers(13, 17, hit.size)
    stamps = np.datetime_as_string(
        START + np.rint(frame["second"].to_numpy() * 1000.0).astype("timedelta64[ms]")
    )
    row = np.arange(len(frame))
    temperature = np.where(row % RATE == 0, [f"{value:.2f}" for value in frame["temperature"]], "")
    vibration = np.where(
        row % RATE == RATE // 2, [f"{value:.3f}" for value in frame["vibration"]], ""
    )
    gyro = [[f"{code * LSB:.2f}" for code in codes[axis]] for axis in AXES]
    return [
        list(cells)
        for cells in zip(
            (f"{stamp}Z" for stamp in stamps), *gyro, temperature, vibration, strict=True
        )
    ]


def spoil(rows: list[list[str]], rng: np.random.Generator) -> list[list[str]]:
    """Lose, garble, repeat and shuffle rows."""
    present = np.ones(len(rows), dtype=bool)
    for start, length in (*DROPOUTS, (LOST[0], LOST[1] - LOST[0])):
        present[round(start * RATE) : round((start + length) * RATE)] = False
    present_rows = np.flatnonzero(present)
    for number, index in enumerate(rng.choice(present_rows, 60, replace=False)):
        columns = (1, 2, 3) if number % 4 == 0 else (1 + int(rng.integers(3)),)
        for column in columns:
            rows[index][column] = WORDS[number % 3]
    order = [int(index) for index in present_rows]
    for place in (15_321, 54_002):  # sent twice
        order.insert(place + 1, order[place])
    for place in (8_123, 47_710, 71_404):  # four rows late
        order.insert(place + 4, order.pop(place))
    return [rows[index] for index in order]


def header() -> list[str]:
    """Comment lines and the header row."""
    return [
        "# SIMULATED log of a three-axis fiber-optic gyro on a shaker; no measurement.",
        f"# Written by data/make_mwd_sample.py, seed {SEED}; "
        "the true noise coefficients stand in data/README.md.",
        f"# Still to {VIBRATING[0]:g} s, vibrating to {VIBRATING[1]:g} s, still to {DURATION:g} s; "
        f"data lost {LOST[0]:g}-{LOST[1]:g} s.",
        "time,gyro_x [deg/h],gyro_y [deg/h],gyro_z [deg/h],temperature [degC],vibration [g]",
    ]


def truth_table() -> str:
    """Markdown table of the true coefficients, still and under vibration."""
    lines = [
        "| axis | state | Q [urad] | N [deg/sqrt(h)] | B [deg/h] | K [deg/h^1.5] "
        "| mean [deg/h] at 60 degC |",
        "|---|---|---|---|---|---|---|",
    ]
    for axis in AXES:
        truth, earth = TRUTH[axis], earth_rate()[axis]
        for state, g in (("still", G_STILL), ("vibrating", G_VIBRATING)):
            shaken = state == "vibrating"
            q = np.hypot(truth["Q"], truth["theta"] if shaken else 0.0)
            n = truth["N"] * (truth["N_factor"] if shaken else 1.0)
            lines.append(
                f"| {axis} | {state} | {q:.3f} | {n:.4f} | {truth['B']:g} | {truth['K']:g} "
                f"| {earth + truth['k_2'] * g**2:.3f} |"
            )
    return "\n".join(lines)


def readme(rows: int) -> str:
    """Return the README, which describes the log and its ground truth."""
    steps = ", ".join(
        f"{axis} {TRUTH[axis]['k_2'] * (G_VIBRATING**2 - G_STILL**2):.2f}" for axis in AXES
    )
    slopes = ", ".join(f"{axis} {TRUTH[axis]['a_T']:g}" for axis in AXES)
    places = [f"{start:g} s ({length:g} s)" for start, length in DROPOUTS]
    dropouts = ", ".join(places[:4]) + ",\n  " + ", ".join(places[4:])
    return f"""# The shipped logs

`mwd_day.csv.gz` is the log of `gyrostab demo`, **simulated**: a day of three axes at 2 Hz, with
warm-up, rest, vibration and lost telemetry. `make_day_log.py` writes it from `models/demo.toml`,
which states what is true. The rest of this page describes the other log.

`mwd_sample.csv.gz` is **simulated**: three axes of a fiber-optic gyro of the 0.03 deg/h class on a
shaker, {RATE} Hz, {DURATION} s, {rows} rows. `make_mwd_sample.py` (seed {SEED}) writes it and this
page; the docstring of the script states every assumption, with figures and sources.

    python data/make_mwd_sample.py

## What is in it

- `time` is ISO 8601 with milliseconds, which is exact at {RATE} Hz and needs no separate epoch.
- `gyro_x`, `gyro_y`, `gyro_z` in deg/h, least significant digit {LSB:g} deg/h.
- `temperature` and `vibration` (rms acceleration) are slow sensors: each has a value once a second,
  in different rows.
- Still until {VIBRATING[0]:g} s, vibrating ({G_VIBRATING:g} g rms, 700-800 Hz) until
  {VIBRATING[1]:g} s, still to the end.

## What is true

{truth_table()}

R is zero. The vibration raises the mean by {steps} deg/h (rectification), a
step that an Allan variance shows as an apparent K in windows across 330 s and 630 s and nowhere
else. Q rises because the tool rotates back and forth at 700-800 Hz, which folds to white angle
noise at {RATE} Hz. The temperature rises from 58 to 66 degC and shifts the means by
{slopes} deg/h per degC. B and K are below what windows of a minute can
show: expect upper limits.

## Deliberate damage

- no rows from {LOST[0]:g} s to {LOST[1]:g} s (telemetry), nor at
  {dropouts};
- 60 rows with `****`, `ERR` or an empty cell in place of one gyro axis or all three;
- 2 rows sent twice, 3 rows four places late;
- {SPIKES[1]} values of axis y with a flipped bit (82 to 655 deg/h) within 0.4 s
  from {SPIKES[0]:g} s.
"""


def main() -> None:
    """Write both files."""
    folder = Path(__file__).resolve().parent
    rng = np.random.default_rng(SEED)
    rows = spoil(write_cells(simulate(rng), rng), rng)
    text = "\n".join([*header(), *(",".join(row) for row in rows)]) + "\n"
    buffer = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", fileobj=buffer, compresslevel=9, mtime=0) as packed:
        packed.write(text.encode("ascii"))
    (folder / "mwd_sample.csv.gz").write_bytes(buffer.getvalue())
    (folder / "README.md").write_text(readme(len(rows)), encoding="utf-8")


if __name__ == "__main__":
    main()

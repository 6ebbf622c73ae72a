"""Small products with a changing temperature and a known coupling."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.noise import TERMS
from gyrostab.schema import attributes

WINDOW, STEP = 60.0, 30.0  # s
CELL = 30.0  # s; noise and temperature are made in cells, two per window


def temperature(kind: str, cells: int, rng: np.random.Generator) -> np.ndarray:
    t = np.arange(cells) / cells
    if kind == "ramps":
        return 40 + 20 * np.clip(1.6 - np.abs(4 * t - 2), 0, 1.2)
    if kind == "sine":
        return 40 + 10 * np.sin(2 * np.pi * (rng.uniform(1, 4) * t + rng.uniform()))
    if kind == "walk":
        return 40 + np.cumsum(rng.normal(0, 0.3, cells))
    if kind == "chamber":  # three cycles of a thermal chamber
        return 20 + 60 * np.interp(3 * t % 1, [0, 0.25, 0.375, 0.625, 0.75, 1], [0, 0, 1, 1, 0, 0])
    if kind == "rise":
        return 40 + 10 * t + 3 * t**2
    return np.full(cells, 40.0)


def averaged_walk(step: float, cells: int, rng: np.random.Generator) -> np.ndarray:
    """Means over the cells of a random walk that changes by `step` (one sigma) in a cell.

    The mean of a Brownian bridge over its cell has the variance step^2 / 12.
    """
    ends = np.cumsum(rng.normal(0, step, cells + 1))
    return 0.5 * (ends[1:] + ends[:-1]) + rng.normal(0, step / np.sqrt(12), cells)


def noise(kind: str, cells: int, rng: np.random.Generator) -> np.ndarray:
    """Cell means [deg/h]: white, with flicker, random walk, or slow autoregression."""
    white = rng.normal(size=cells)
    if kind == "flicker":
        f = np.fft.rfftfreq(4 * cells)[1:]
        shape = np.concatenate([[0], f**-0.5])
        slow = np.fft.irfft(
            shape * (rng.normal(size=shape.size) + 1j * rng.normal(size=shape.size))
        )[:cells]
        return white + 1.5 * slow / slow.std()
    if kind in ("weak walk", "walk", "strong walk"):
        return white + averaged_walk(
            {"weak walk": 0.15, "walk": 0.5, "strong walk": 5.0}[kind], cells, rng
        )
    if kind == "slow":
        slow, step = np.zeros(cells), rng.normal(size=cells)
        for i in range(1, cells):
            slow[i] = 0.93 * slow[i - 1] + step[i]
        return white + slow
    return white


def product(
    *,
    windows: int = 120,
    axes: str = "xyz",
    seed: int = 1,
    noises: str = "flicker",
    heat: str = "sine",
    slope: float = 0.0,
    lag: int = 0,
    pace: float = 0.0,
    gap: bool = True,
    terms: bool = True,
) -> xr.Dataset:
    """Make a product whose x axis follows temperature by `slope` [deg/h/K] and its rate by `pace`.

    It follows `lag` steps late; the other axes do not follow temperature.
    """
    rng = np.random.default_rng(seed)
    head = 40
    cells = windows + 1
    warm = temperature(heat, cells + head, rng)
    rate = np.gradient(warm, CELL / 3600)
    cold = warm[head:]
    drive = (
        slope * warm[head - lag : head - lag + cells] + pace * rate[head - lag : head - lag + cells]
    )
    series = np.stack(
        [noise(noises, cells, rng) + (drive if i == 0 else 0.0) for i in range(len(axes))]
    )
    pair = lambda row: 0.5 * (row[..., 1:] + row[..., :-1])  # noqa: E731
    shape = (len(axes), windows)
    values = {name: np.full((*shape, 1), 1.0) for name in ("avar", "count", "coverage", "edf")} | {
        "estimator": np.ones((*shape, 1), np.int8)
    }
    made = xr.Dataset(
        {name: (("axis", "time", "tau"), value, attributes(name)) for name, value in values.items()}
    )
    made["window_mean"] = (("axis", "time"), 10 + pair(series), attributes("window_mean"))
    made["window_coverage"] = (("axis", "time"), np.ones(shape), attributes("window_coverage"))
    for term in TERMS:
        kind = "flicker" if noises == "flicker" else "white"
        level = 0.01 * np.stack([1 + 0.1 * pair(noise(kind, cells, rng)) for _ in axes])
        for name, value in (
            (term, level),
            (f"{term}_stderr", 0.1 * level),
            (f"{term}_upper", level),
        ):
            made[name] = (("axis", "time"), value, attributes(name))
    flags = np.zeros((*shape, len(TERMS)), np.int8)
    if terms:
        flags[..., [1, 2]] = 2
    made["observable"] = (("axis", "time", "term"), flags, attributes("observable"))
    made["temperature"] = (
        "time",
        pair(cold),
        {"units": "degree_Celsius", "long_name": "temperature, mean of the window"},
    )
    made["temperature_rate"] = (
        "time",
        np.diff(cold) / (CELL / 3600),
        {"units": "K hour-1", "long_name": "rate of change of temperature"},
    )
    start = np.datetime64("2026-09-21T12:00:00", "ns") + (
        np.arange(windows) * int(STEP * 1e9)
    ).astype("timedelta64[ns]")
    ends = np.stack([start, start + np.timedelta64(int(WINDOW * 1e9), "ns")], axis=1)
    made = made.assign_coords(
        axis=("axis", list(axes), attributes("axis")),
        tau=("tau", [1.0], attributes("tau")),
        term=("term", list(TERMS), attributes("term")),
        time=("time", start + np.timedelta64(int(WINDOW * 5e8), "ns"), attributes("time")),
        time_bounds=(("time", "bnds"), ends),
    )
    made.attrs = {"window_s": WINDOW, "step_s": STEP, "sampling_rate_hz": 100.0}
    if gap:
        hole = slice(windows // 3, windows // 3 + windows // 10)
        for name in ("window_mean", *TERMS):
            made[name][:, hole] = np.nan
        made["window_coverage"][:, hole] = 0.0
    return made

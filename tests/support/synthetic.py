"""A small product with known coefficients, a log and a surface, for tests of files and figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from gyrostab.noise import LAWS, TERMS, model_avar
from gyrostab.schema import attributes
from gyrostab.time.grid import grid_times, time_coordinate

START = 1_790_000_000_123_456_789  # September 2026, with odd nanoseconds
RATE = 300.0
COEFFICIENTS = {"Q": 0.8, "N": 0.01, "B": 0.02, "K": 0.05, "R": 0.01}


def product(*, windows: int = 40, taus: int = 12, axes: str = "xyz", seed: int = 1) -> xr.Dataset:
    """Product of known coefficients with chi-square scatter, a gap, and weighted cells after it."""
    rng = np.random.default_rng(seed)
    window, step = 1800, 9000
    tau = np.unique(np.geomspace(1, 600, taus).astype(int)) / RATE
    shape = (len(axes), windows, tau.size)
    edf = np.broadcast_to(np.maximum(2.0, 1.5 * window / RATE / tau), shape).copy()
    growth = 1.0 + np.linspace(0.0, 2.0, windows)
    true = {
        s: np.stack(
            [
                COEFFICIENTS[s] * (1 + 0.5 * i) * (growth if s == "N" else np.ones(windows))
                for i in range(len(axes))
            ]
        )
        for s in TERMS
    }
    clean = np.stack(
        [
            [model_avar(tau, {s: true[s][a, t] for s in TERMS}) for t in range(windows)]
            for a in range(len(axes))
        ]
    )
    avar = clean * rng.chisquare(edf) / edf
    gap = slice(windows // 2, windows // 2 + 4)
    estimator = np.ones(shape, np.int8)
    estimator[:, gap.stop : gap.stop + 5] = 2
    estimator[:, gap] = 0
    coverage = np.where(estimator == 2, 0.7, 1.0)
    edf[:, gap] = avar[:, gap] = np.nan
    coverage[:, gap] = 0.0
    count = np.where(estimator > 0, (window - 2 * tau * RATE).clip(1), 0).astype(np.int64)
    names = ("axis", "time", "tau")
    ones = np.ones(shape)
    data: dict[str, Any] = {
        "avar": (names, avar),
        "count": (names, count),
        "coverage": (names, coverage),
        "edf": (names, edf),
        "estimator": (names, estimator),
        "white_response": (names, ones),
        "quantization_response": (names, ones),
        "gap_factor": (names, coverage),
    }
    data |= _coefficients(true, gap, rng)
    data["window_mean"] = (names[:2], rng.normal(7.0, 0.1, shape[:2]))
    data["window_trend"] = (names[:2], rng.normal(0.0, 0.1, shape[:2]))
    data["trend_response"] = (names[:2], np.ones(shape[:2]))
    data["window_coverage"] = (names[:2], coverage[..., 0])
    result = xr.Dataset(
        {name: (dims, values, attributes(name)) for name, (dims, values) in data.items()}
    )
    for name, units, values in (
        ("temperature", "degree_Celsius", 65.0 + np.linspace(0, 20, windows)),
        ("temperature_rate", "degree_Celsius hour-1", np.full(windows, 4.0)),
        ("vibration", "g", np.abs(rng.normal(1.0, 0.2, windows))),
    ):
        result[name] = (
            "time",
            values,
            {"units": units, "long_name": f"{name.replace('_', ' ')}, mean of the window"},
        )
    first = np.arange(windows) * step
    edges = np.stack(
        [grid_times(START, RATE, first), grid_times(START, RATE, first + window)], axis=1
    )
    result = result.assign_coords(
        axis=("axis", list(axes), attributes("axis")),
        tau=("tau", tau, attributes("tau")),
        term=("term", list(TERMS), attributes("term")),
        time=(
            "time",
            (edges[:, 0] + (edges[:, 1] - edges[:, 0]) // 2).view("datetime64[ns]"),
            attributes("time"),
        ),
        time_bounds=(("time", "bnds"), edges.view("datetime64[ns]")),
    )
    result.attrs = {
        "sampling_rate_hz": RATE,
        "window_s": window / RATE,
        "step_s": step / RATE,
        "window_samples": window,
        "step_samples": step,
        "kind": "rate",
        "source_files": ["bore_run_4a.csv", "bore_run_4b.csv"],
        "history": "2026-09-21T14:13:20Z read",
        "notes": ["gyro_x [deg/h] taken as it stands", "2 rows could not be read, µ"],
    }
    return result


def _coefficients(
    true: dict[str, np.ndarray], gap: slice, rng: np.random.Generator
) -> dict[str, Any]:
    data: dict[str, Any] = {}
    shape = true["N"].shape
    observable = np.full((*shape, len(TERMS)), 2, np.int8)
    observable[:, :, TERMS.index("R")] = 1
    observable[:, ::2, TERMS.index("Q")] = 1
    observable[:, gap] = 0
    for number, symbol in enumerate(TERMS):
        state = observable[..., number]
        error = 0.05 * true[symbol]
        value = true[symbol] + error * rng.normal(size=shape)
        data[symbol] = (("axis", "time"), np.where(state == 2, value, np.nan))
        data[f"{symbol}_stderr"] = (("axis", "time"), np.where(state == 2, error, np.nan))
        data[f"{symbol}_upper"] = (
            ("axis", "time"),
            np.where(state == 1, true[symbol] * 1.6, np.nan),
        )
        if symbol in "NK":
            data[f"{symbol}_squared"] = (("axis", "time"), data[symbol][1] ** 2)
    data["observable"] = (("axis", "time", "term"), observable)
    data["fit_chi2"] = (("axis", "time"), np.where(state == 0, np.nan, rng.chisquare(7, shape)))
    data["fit_dof"] = (("axis", "time"), np.where(state == 0, np.nan, 7.0))
    return data


def surface(**options: Any) -> xr.Dataset:
    """The same without coefficients."""
    whole = product(**options)
    fitted = [f"{s}{end}" for s in LAWS for end in ("", "_stderr", "_upper", "_squared")] + [
        "observable",
        "fit_chi2",
        "fit_dof",
        "term",
    ]
    return whole.drop_vars(fitted, errors="ignore")


def log(
    *, samples: int = 3000, rate: float = RATE, start: int = START, axes: str = "xyz", seed: int = 2
) -> xr.Dataset:
    """White noise on 7 deg/h with a gap, one slow and one full channel, and a gap table."""
    rng = np.random.default_rng(seed)
    values = rng.normal(7.0, 0.3, (len(axes), samples))
    gap = slice(samples // 2, samples // 2 + samples // 10)
    values[:, gap] = np.nan
    stamps = grid_times(start, rate, np.array([gap.start, gap.stop - 1])).view("datetime64[ns]")
    slow = time_coordinate(start, rate / 100, max(1, samples // 100), name="time_temperature")
    result = xr.Dataset(
        {
            "rate": (
                ("axis", "time"),
                values,
                {"units": "degree hour-1", "long_name": "rotation rate"},
            ),
            "vibration": (
                "time",
                rng.normal(0, 1, samples),
                {"units": "g", "long_name": "vibration"},
            ),
            "temperature": (
                "time_temperature",
                65 + np.arange(max(1, samples // 100)) / 10,
                {"units": "degree_Celsius", "long_name": "temperature"},
            ),
            "pump": (
                "time",
                np.arange(samples) % 7.0,
                {"units": "gal/min", "long_name": "pump flow"},
            ),
            "gap_start": ("gap", stamps[:1], {"long_name": "first missing sample"}),
            "gap_end": ("gap", stamps[1:], {"long_name": "last missing sample"}),
            "gap_samples": (
                "gap",
                np.array([gap.stop - gap.start]),
                {"long_name": "missing samples", "units": "1"},
            ),
            "gap_cause": (
                "gap",
                np.zeros(1, np.int8),
                {
                    "long_name": "cause",
                    "flag_values": np.arange(2, dtype=np.int8),
                    "flag_meanings": "missing unreadable",
                },
            ),
        },
        coords={"axis": ("axis", list(axes), attributes("axis"))},
        attrs={
            "sampling_rate_hz": rate,
            "kind": "rate",
            "source_files": ["a.csv"],
            "history": "",
            "notes": [],
            "epoch_said": True,
        },
    )
    return result.assign_coords(time_coordinate(start, rate, samples)).assign_coords(slow)

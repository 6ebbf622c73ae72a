"""A diagnosis made by hand, for the tests of its files and its page."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.result.diagnosis import Diagnosis
from gyrostab.diagnose.result.text import effect_statement, mismatch_statement
from gyrostab.noise import model_avar
from gyrostab.physics.registry import make_effect

START = np.datetime64("2026-03-14T08:00:00", "ns")
NOISE = {"Q": 0.0, "N": 0.003, "B": 0.004, "K": 0.02}
UNITS = {"Q": "urad", "N": "deg/sqrt(h)", "B": "deg/h", "K": "deg/h^1.5"}


def when(seconds: float) -> str:
    return f"{(START + np.timedelta64(round(seconds * 1e3), 'ms')).astype('datetime64[ms]')}Z"


def surfaces(*, axes: str = "xy", seed: int = 1) -> xr.Dataset:
    """An hour at 100 Hz; for five minutes axis x has 1.8 times the variance and 0.08 deg/h more."""
    rng = np.random.default_rng(seed)
    tau = 0.01 * 2.0 ** np.arange(14)
    begin = np.arange(0.0, 3600.0, 100.0)
    end = begin + 100.0
    noisy = (begin >= 1500) & (begin < 1800)
    plain = np.broadcast_to(model_avar(tau, NOISE), (len(axes), begin.size, tau.size))
    after = plain.copy()
    after[0, noisy] *= 1.8
    edf = np.maximum(100.0 / tau, 2.0)
    recording = after * rng.chisquare(edf, after.shape) / edf
    z = np.minimum(1.96 * np.sqrt(2.0 / edf), 0.9)
    block = np.arange(0.0, 3600.0, 20.0)
    shift = np.zeros((len(axes), block.size))
    shift[0, (block >= 1500) & (block < 1800)] = 0.08
    window_shift = np.zeros((len(axes), begin.size))
    window_shift[0, noisy] = 0.08
    mean = np.stack(
        [
            window_shift + 0.018 * rng.standard_normal(window_shift.shape),
            0 * window_shift,
            window_shift,
        ]
    )
    line = np.arange(1, 1000) * 0.05
    density = np.full((3, len(axes), 12), (0.003 * 60) ** 2)
    return xr.Dataset(
        {
            "avar": (("case", "axis", "window", "tau"), np.stack([recording, plain, after]),
            {"units": "degree2 hour-2"}),
            "avar_low": (("case", "axis", "window", "tau"), np.stack([recording * np.nan,
            plain * (1 - z), after * (1 - z)])),
            "avar_high": (("case", "axis", "window", "tau"), np.stack([recording * np.nan,
            plain * (1 + z), after * (1 + z)])),
            "mean": (("case", "axis", "window"), mean, {"units": "degree hour-1"}),
            "mean_stderr": (("case", "axis", "window"), np.full(mean.shape, 0.018),
            {"units": "degree hour-1"}),
            "block_mean": (("axis", "block"), shift + 0.04 * rng.standard_normal(shift.shape),
            {"units": "degree hour-1"}),
            "density": (("case", "axis", "band"), density, {"units": "degree2 hour-2 s"}),
            "line_density": (("axis", "line"), density[0, :, :1] * rng.gamma(180.0, 1 / 180.0,
            (len(axes), line.size))),
            "channel_vibration": ("block", np.where((block >= 1500) & (block < 1800), 6.0, 0.02),
            {"units": "g"}),
        },
        coords={
            "case": ["recording", "before", "after"], "axis": list(axes), "tau": tau,
            "begin": ("window", begin), "end": ("window", end),
            "block_begin": ("block", block), "block_end": ("block", block + 20.0),
            "line_frequency": ("line", line),
            "frequency": ("band", np.geomspace(0.05, 50, 12)),
        },
    )  # fmt: skip


def content() -> dict[str, Any]:
    region = {
        "statistic": "power", "view": "davar", "quantity": "avar", "axes": ["x"],
        "begin": 1500.0, "end": 1800.0,
        "tau_min_s": 0.01, "tau_max_s": 3.0, "ratio": 1.8,
        "sign": 1, "p_value": 0.0004, "estimate": 1.8, "frequency": np.nan,
    }  # fmt: skip
    shift = region | {
        "statistic": "mean",
        "view": "mean",
        "quantity": "mean",
        "tau_min_s": 20.0,
        "tau_max_s": 300.0,
        "ratio": 7.0,
        "estimate": 0.08,
        "p_value": 1e-9,
    }
    keys = ("view", "axes", "tau_min_s", "tau_max_s", "ratio", "p_value")
    mismatches = [
        {"id": number, **{key: mismatch[key] for key in keys}, "start": when(mismatch["begin"]),
        "end": when(mismatch["end"]), "explained_by": [name],
         "statement": mismatch_statement(mismatch, 3600.0)}
        for number, (mismatch, name) in enumerate(
            [(shift, "vibration_rectification"), (region, "vibration_noise")], start=1
        )
    ]  # fmt: skip
    effects = []
    for name, parameter, value, unit, others in (
        ("vibration_noise", "white", 0.00045, "deg/sqrt(h)/g", []),
        ("vibration_rectification", "sensitivity", 0.0022, "deg/h/g^2", ["g_sensitivity"]),
    ):
        sentence = make_effect({"name": name, parameter: value, "axes": ["x"]}).say(
            {parameter: 0.05 * value}
        )
        effects.append(
            {
                "name": name, "axes": ["x"], "driver": "vibration", "intervals": [[when(1500),
                when(1800)]],
                "parameters": {
                    parameter: {"value": value, "stderr": 0.05 * value, "low": 0.9 * value,
                    "high": 1.1 * value, "unit": unit}
                },
                "held_out_gain": {"nats": 31.0, "stderr": 6.0, "threshold": 5.7},
                "alternatives": others,
                "probability": 0.62,
                "statement": effect_statement(sentence, alternatives=others),
            }
        )  # fmt: skip
    noise = {
        axis: {
            term: {"value": value, "stderr": 0.05 * value, "unit": UNITS[term]}
            for term, value in NOISE.items()
        }
        for axis in ("x", "y")
    }
    return {
        "schema": "gyrostab.diagnosis/1",
        "recording": {
            "files": ["run7/log.csv"], "axes": ["x", "y"], "start": when(0), "end": when(3600),
            "sampling_rate_hz": 100.0,
            "channels": ["vibration"], "missing_share": 0.02,
        },
        "baseline": {"source": "calibrated", "noise": noise, "calibrated_on": [[when(0),
        when(1400)], [when(1900), when(3600)]]},
        "verdict": "explained",
        "false_alarm_level": 0.01,
        "mismatches": mismatches,
        "effects": effects,
        "unexplained": [],
        "rejected": [
            {"name": "shupe", "axes": ["x"], "beaten_by": "vibration_rectification", "nats": 4.25},
            {"name": "spectral_line", "axes": ["y"], "beaten_by": "noise", "nats": 6.0},
        ],
        "unused_channels": [{"name": "humidity",
        "reason": "no effect follows a channel of this name"}],
        "not_found": {
            "shupe": {"upper_limit": None, "unit": None,
            "reason": "not identifiable: there is no temperature channel"},
            "spectral_line": {"upper_limit": 0.05, "unit": "deg/h", "reason": "below limit"},
        },
        "held_out": {
            "blocks": 36, "log_likelihood_gain": 62.0, "stderr": 8.0, "misfit_before": 3.1,
            "misfit_after": 1.02, "coverage95_before": 0.71,
            "coverage95_after": 0.95, "forecast_gain": None,
        },
        "seconds": 12.3,
    }  # fmt: skip


def model() -> dict[str, Any]:
    return {
        "noise": {axis: dict(NOISE) for axis in ("x", "y")},
        "effect": [
            {"name": "vibration_noise", "axes": ["x"], "white": 0.00045},
            {"name": "vibration_rectification", "axes": ["x"], "sensitivity": 0.0022},
        ],
    }


def diagnosis() -> Diagnosis:
    return Diagnosis(content(), surfaces(), model())

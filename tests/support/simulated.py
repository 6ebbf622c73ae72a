"""A model with all that a simulation can do, for its tests."""

from __future__ import annotations

from typing import Any

import xarray as xr

from gyrostab.physics.registry import effects
from gyrostab.simulate import combine
from gyrostab.simulate import environment as env

NOISE = {"Q": 0.06, "N": 0.006, "B": 0.03, "K": 0.05, "z": {"N": 0.004, "R": 0.3}}
WORLD = [
    {"profile": "vibration", "points": [[0, 0.02], [30, 8.0], [60, 0.02]]},
    {"profile": "ramps", "channel": "temperature", "unit": "degC", "points": [[0, 20], [90, 65]]},
    {"profile": "rotation", "points": [[0, 0.0], [20, 90.0]], "stick_slip": 0.5, "sensor_rate": 25},
    {"profile": "supply", "life": "2 min"},
    {"profile": "light_power", "loss": 1000},
    {"profile": "power_cuts", "cuts": [[40, 45]]},
    {"profile": "gaps", "spans": [[10, 10.5]]},
]
LOG = {"rate": 20, "duration": "90 s", "start": "2026-03-14T08:00:00"}
BIASED = [
    {"name": "temperature_bias", "sensitivity": 0.02},
    {"name": "g_sensitivity", "x": 0.5, "axes": ["y"]},
]


def model(**change: Any) -> dict[str, Any]:
    """The model, with some of its sections changed."""
    return {"log": LOG, "noise": NOISE, "environment": WORLD, "effect": BIASED} | change


#: Values of channels by their units.
TYPICAL = {
    "degree_Celsius": 60.0, "g": 1.0, "degree s-1": 90.0, "V": 24.0, "W": 1e-4, "uT": 30.0,
    "Pa": 1e7, "1": 0.5,
}  # fmt: skip


def every_channel(duration: float) -> xr.Dataset:
    """Each channel that some effect asks for by its own name, so that none lacks its driver."""
    units = {name: unit for kind in effects().values() for name, unit in kind.channels.items()}
    units |= {"accel_x": "g"}
    return combine(
        *(
            env.ramps(
                name,
                unit,
                [[0, TYPICAL[unit]], [duration, 1.3 * TYPICAL[unit]]],
                duration=duration,
                start=LOG["start"],
            )
            for name, unit in units.items()
        )
    )

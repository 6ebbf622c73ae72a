"""Block statistics with known effects, for tests of identification: an hour of 10 Hz data."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.identify.examination import prepare_examination
from gyrostab.diagnose.identify.forward_search import identify_effects
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.simulate import simulate

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
COEFFICIENT = xr.DataArray(
    np.tile([0.0, 0.003, 0.004, 0.02, 0.0], (3, 1)),
    {"axis": ["x", "y", "z"], "term": list("QNBKR")},
    ("axis", "term"),
)
_HEAT = {
    "profile": "ramps", "channel": "temperature", "unit": "degC",
    "points": [[0, 30], [500, 30], [900, 38], [1300, 38],
               [2000, 52], [2600, 47], [3000, 47], [3600, 58]],
}  # fmt: skip
_SHAKE = {
    "profile": "vibration",
    "points": [[0, 0.02], [1500, 5.0], [1580, 7.0], [1640, 4.5], [1710, 8.0], [1800, 0.02]],
}
_TURN = {
    "profile": "rotation",
    "points": [
        [0, 0],
        [300, 0],
        [310, 180],
        [1500, 180],
        [1510, 60],
        [2500, 60],
        [2510, 180],
        [3600, 180],
    ],
}
_LIGHT = {
    "profile": "ramps",
    "channel": "light_power",
    "unit": "W",
    "points": [[0, 1e-4], [1500, 0.9e-4], [3600, 0.95e-4]],
}
_SUPPLY = {
    "profile": "steps",
    "channel": "supply_voltage",
    "unit": "V",
    "points": [[0, 24.0], [1000, 23.5], [2400, 24.1]],
}
_SECOND = dict(_HEAT, channel="temperature_2", points=[[0, 30], [700, 31], [2100, 45], [3600, 50]])
#: Environments by name, as tuples of tables.
WORLD: dict[str, tuple[dict[str, Any], ...]] = {
    "usual": (_HEAT, _SHAKE),
    "turning": (_HEAT, _SHAKE, dict(_TURN, sensor_rate=10.0)),
    "full": (
        _HEAT,
        _SHAKE,
        dict(_TURN, sensor_rate=10.0, accelerations=True),
        _LIGHT,
        _SUPPLY,
        _SECOND,
    ),
}


def record(
    effects: list[dict[str, Any]],
    *,
    axes: str = "xyz",
    environment: Any = WORLD["usual"],
    seed: int = 1,
    drop: tuple[str, ...] = (),
) -> xr.Dataset:
    """Return cached block statistics for these arguments."""
    blocks = _make_record(json.dumps(effects), axes, json.dumps(list(environment)), seed)
    return blocks.drop_vars([f"channel_{name}" for name in drop])


@cache
def _make_record(effects: str, axes: str, environment: str, seed: int) -> xr.Dataset:
    model = {
        "noise": NOISE,
        "effect": json.loads(effects),
        "environment": json.loads(environment),
        "log": {"axes": list(axes)},
    }
    return reduce_log(simulate(model, duration="1h", rate=10.0, seed=seed).compute())


def nulls(
    blocks: xr.Dataset, count: int = 80, seed: int = 3
) -> tuple[xr.Dataset, list[xr.Dataset]]:
    """Return the baseline of a record, and null records."""
    baseline = calibrate_noise(blocks)
    return baseline, list(
        null_records(blocks, baseline, count=count, rng=np.random.default_rng(seed), chunk=count)
    )


def name_effects(
    blocks: xr.Dataset, baseline: xr.Dataset, records: Any, **options: Any
) -> Identifications:
    """Identify the effects of block statistics, as a diagnosis does before it compares again."""
    return identify_effects(prepare_examination(blocks, baseline, records, **options))

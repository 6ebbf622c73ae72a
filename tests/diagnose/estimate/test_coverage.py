"""Intervals hold the true value for slow and curved responses, and off the grid."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.upper_limits import find_upper_limits
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.predict.linear_model import initial_state
from tests.diagnose.estimate import test_joint_fit as joint_fit
from tests.support.named import WORLD, record

RECORDS, SECONDS, BLOCK = 20, 3600, 20
VOLTS = [[0, 28.0], [600, 27.0], [1300, 28.2], [2100, 26.8], [2900, 27.9]]
HEAT = [[0, 30], [400, 30], [1000, 36], [1600, 36], [2200, 31], [2800, 31], [3300, 35], [3600, 35]]


def average_blocks(seconds: np.ndarray) -> xr.DataArray:
    """Average one value per second over blocks."""
    return xr.DataArray(seconds.reshape(-1, BLOCK).mean(axis=1), dims="block")


def filter_slowly(values: np.ndarray, time: float) -> np.ndarray:
    """Filter values of every second by a time constant."""
    out = np.empty_like(values)
    out[0] = values[0]
    for place in range(1, values.size):
        out[place] = out[place - 1] + (values[place - 1] - out[place - 1]) * -np.expm1(-1.0 / time)
    return out


def fit_records(
    environment: tuple[dict[str, Any], ...], effect: str, column: str, shape: np.ndarray
) -> list[dict[str, Any]]:
    """Fit an effect to records of noise with its mean, given once per second."""
    blocks = record([], environment=environment)

    def change(drawn: xr.Dataset) -> xr.Dataset:
        return drawn.assign(mean=drawn["mean"] + average_blocks(shape))

    noise = blocks, calibrate_noise(blocks)
    return [*joint_fit.fit_records(noise, change, effect, "mean", (column,), RECORDS)]


def covered_share(estimates: list[dict[str, Any]], name: str, truth: float) -> float:
    return float(
        np.mean([estimate[name].low <= truth <= estimate[name].high for estimate in estimates])
    )


def median_half_width(estimates: list[dict[str, Any]], name: str) -> float:
    return float(
        np.median([0.5 * (estimate[name].high - estimate[name].low) for estimate in estimates])
    )


@pytest.mark.full
def test_intervals_of_a_slow_curved_supply_response():
    time, size = 45.0, 0.12
    second = np.arange(SECONDS)
    volt = np.array([level for _, level in VOLTS])[
        np.searchsorted([at for at, _ in VOLTS], second, side="right") - 1
    ]
    above = volt - volt.mean()
    bent = above - 0.3 * np.minimum(above, 0.0) ** 2
    at_rest = size * np.polyfit(above, bent, 1)[0]
    environment = (
        *WORLD["usual"],
        {"profile": "steps", "channel": "supply_voltage", "unit": "V", "points": VOLTS},
    )
    estimates = fit_records(environment, "supply_bias", "voltage", size * filter_slowly(bent, time))
    assert 0.9 <= covered_share(estimates, "voltage", at_rest) <= 1.0
    assert 0.9 <= covered_share(estimates, "lag", time) <= 1.0
    assert median_half_width(estimates, "voltage") < 0.25 * at_rest
    assert median_half_width(estimates, "lag") < 0.5 * time


@pytest.mark.full
def test_intervals_of_a_warm_up_faster_than_the_grid():
    time, size = 25.0, 1.0
    estimates = fit_records(
        WORLD["usual"], "warm_up", "amplitude", size * np.exp(-(np.arange(SECONDS) + 0.5) / time)
    )
    assert 0.9 <= covered_share(estimates, "amplitude", size) <= 1.0
    assert 0.9 <= covered_share(estimates, "time", time) <= 1.0
    assert median_half_width(estimates, "time") < 0.6 * time


@pytest.mark.parametrize(
    "size",
    [pytest.param(0.15, marks=pytest.mark.full), 1.5],
    ids=["weak", "strong"],
)
def test_intervals_of_a_dead_band_between_grid_values(size):
    """At the widths of the grid, a wrong lag of the sensor fits best."""
    width = 0.9
    heat = np.interp(np.arange(SECONDS), *np.transpose(HEAT))
    slider = np.empty_like(heat)
    last = heat[0]
    for place, value in enumerate(heat):
        slider[place] = last = min(max(last, value - width), value + width)
    environment = (
        {"profile": "ramps", "channel": "temperature", "unit": "degC", "points": HEAT},
        WORLD["usual"][1],
    )
    estimates = fit_records(
        environment, "thermal_hysteresis", "sensitivity", size * (heat - slider)
    )
    assert 0.9 <= covered_share(estimates, "sensitivity", size) <= 1.0
    assert 0.9 <= covered_share(estimates, "width", width) <= 1.0
    assert median_half_width(estimates, "sensitivity") < 0.4 * size


@pytest.mark.full
def test_limit_of_an_effect_slower_than_the_grid():
    size, time = 0.25, 700.0
    heat = np.interp(np.arange(SECONDS), *np.transpose(HEAT))
    environment = (
        {"profile": "ramps", "channel": "temperature", "unit": "degC", "points": HEAT},
        WORLD["usual"][1],
    )
    blocks = record([], environment=environment)
    baseline = calibrate_noise(blocks)
    frame = joint_fit.identify_by_hand(blocks, baseline, "shupe", "mean", ("sensitivity",))
    tried = [candidate for candidate in frame.examination.candidates if candidate.effect == "shupe"]
    examination = replace(frame.examination, candidates=tried)
    frame = replace(frame, identified=(), examination=examination)
    rng = np.random.default_rng(8)
    drawn = next(null_records(blocks, baseline, count=RECORDS, rng=rng, chunk=RECORDS))
    means = average_blocks(size * filter_slowly(60.0 * np.gradient(heat), time))
    limits = []
    for number in range(RECORDS):
        changed = blocks.assign(
            mean=drawn["mean"].isel(record=number).transpose("axis", "block") + means
        )
        limits.append(
            find_upper_limits(replace(frame, state=initial_state(changed, baseline)))["shupe"][
                "upper_limit"
            ]
        )
    assert np.mean(np.array(limits) >= size) >= 0.9
    assert np.median(limits) < 4.0 * size

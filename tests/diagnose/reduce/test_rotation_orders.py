"""Amplitudes at multiples of the tool rotation, block by block."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.simulate import simulate

RATE, BLOCK_S = 50.0, 20.0
AMPLITUDE, TURNS_PER_SECOND = 3.0, 1.5


def log_that_starts_to_turn(start: float, lost: slice) -> xr.Dataset:
    """One axis with a line at the rotation, which starts after `start` seconds."""
    log = simulate(
        {"log": {"axes": ["x"]}, "noise": {"N": 0.005}}, duration="10min", rate=RATE, seed=4
    )
    seconds = np.arange(log.sizes["time"]) / RATE
    is_turning = seconds >= start
    angle = 2.0 * np.pi * TURNS_PER_SECOND * np.maximum(seconds - start, 0.0)
    rate = log["rate"] + xr.DataArray(6.0 + AMPLITUDE * is_turning * np.cos(angle), dims="time")
    rate[{"time": lost}] = np.nan
    log["rate"] = rate.assign_attrs(log["rate"].attrs)
    log["rotation_rate"] = (
        "time",
        360.0 * TURNS_PER_SECOND * is_turning,
        {"units": "degree s-1"},
    )
    return log


@pytest.mark.parametrize("lost_s", [0.0, 4.0])
def test_amplitudes_are_those_of_the_line(lost_s):
    first = round(105.0 * RATE)
    log = log_that_starts_to_turn(90.0, slice(first, first + round(lost_s * RATE)))
    order = reduce_log(log, block=f"{BLOCK_S:g}s")["order"].sel(axis="x", harmonic=1).values
    assert np.isnan(order[:4]).all()
    np.testing.assert_allclose(np.abs(order[5:]), AMPLITUDE, atol=0.4)


def test_block_without_the_samples_of_its_turns_has_no_amplitude():
    """What is left of it at rest would be divided between the constant and the harmonics."""
    log = log_that_starts_to_turn(95.0, slice(round(95.05 * RATE), round(100.0 * RATE)))
    order = reduce_log(log, block=f"{BLOCK_S:g}s")["order"].sel(axis="x", harmonic=1).values
    assert np.isnan(order[:5]).all()
    np.testing.assert_allclose(np.abs(order[5:]), AMPLITUDE, atol=0.4)

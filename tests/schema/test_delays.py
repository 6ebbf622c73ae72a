"""Channels with late stamps are moved to their time, without computing anything."""

from __future__ import annotations

import dask.array as da
import numpy as np
import pytest
import xarray as xr

from gyrostab.ingest.make_log import make_log
from gyrostab.schema import check_log
from gyrostab.schema.delays import move_channels
from gyrostab.time.grid import TimeGridIndex


@pytest.fixture
def log() -> xr.Dataset:
    """A log with a channel on its time, and another with separate, uneven stamps."""
    rates = da.zeros((2, 600), chunks=(2, 200))
    recorded = make_log(rates, rate=10.0, unit="deg/h", start="2026-03-14T08:00")
    stamps = recorded["time"].values[[3, 50, 51, 400]]
    return recorded.assign_coords(time_temperature=stamps).assign(
        vibration=("time", da.arange(600.0, chunks=200), {"units": "g"}),
        temperature=("time_temperature", np.arange(4.0), {"units": "degree_Celsius"}),
    )


@pytest.mark.parametrize("delay", [0.0, 12.25, -7.0])
@pytest.mark.parametrize("name", ["vibration", "temperature"])
def test_stamps_are_earlier_by_the_delay(log: xr.Dataset, name: str, delay: float) -> None:
    (dim,) = log[name].dims
    moved = move_channels(log, {name: delay})
    earlier = log[dim].values - np.timedelta64(round(delay * 1e9), "ns")
    np.testing.assert_array_equal(moved[f"time_{name}"].values, earlier)
    np.testing.assert_array_equal(moved[name].values, log[name].values)
    assert moved[name].attrs == log[name].attrs
    check_log(moved)


def test_only_the_channel_changes(log: xr.Dataset) -> None:
    moved = move_channels(log, {"temperature": 5.0, "pressure": 9.0, "rate": 2.0, "gap_end": 3.0})
    assert list(moved) == list(log)
    xr.testing.assert_identical(
        moved.drop_dims("time_temperature"), log.drop_dims("time_temperature")
    )
    xr.testing.assert_identical(move_channels(moved, {"temperature": -5.0}), log)


def test_a_lazy_channel_stays_lazy_and_its_stamps_are_not_stored(log: xr.Dataset) -> None:
    moved = move_channels(log, {"vibration": 5.0})
    assert moved["vibration"].chunks == log["vibration"].chunks
    assert isinstance(moved.xindexes["time_vibration"], TimeGridIndex)

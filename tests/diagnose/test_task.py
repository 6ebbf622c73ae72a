"""Checks of the axes of a recording before its diagnosis."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab import diagnose
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.task import varying_axes
from gyrostab.errors import SchemaError
from gyrostab.ingest.make_log import make_log


def test_axes_without_noise_or_samples_are_left_out():
    rates = np.random.default_rng(1).standard_normal((3, 6000))
    rates[1], rates[2] = np.nan, 0.3
    log = make_log(rates, rate=10.0, unit="deg/h")
    with pytest.warns(UserWarning, match="left out of the diagnosis") as notes:
        assert varying_axes(reduce_log(log)) == ["x"]
    assert [str(note.message) for note in notes] == [
        "all samples are the same on axis z: left out of the diagnosis",
        "too many samples are missing for a spectrum on axis y: left out of the diagnosis",
    ]
    with pytest.raises(SchemaError, match=r"on axis z, and too many .* on axis y: without noise"):
        varying_axes(reduce_log(log.isel(axis=[1, 2])))


def test_axis_names_with_separators_are_refused():
    rates = np.random.default_rng(1).standard_normal((2, 6000))
    log = make_log(rates, rate=10.0, unit="deg/h", axis=["gyro a", "gyro b"])
    with pytest.raises(SchemaError, match=r"axis 'gyro a': a diagnosis lists axes .*; rename it"):
        diagnose(log)

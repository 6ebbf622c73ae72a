"""The table of windows for spreadsheets."""

from __future__ import annotations

import numpy as np
import pandas as pd

from gyrostab.cli import main
from gyrostab.io.datasets import to_netcdf
from tests.support import synthetic


def test_table_has_a_row_for_each_window_and_axis_and_units_in_its_header(tmp_path):
    product = synthetic.product(axes="xy", windows=6)
    to_netcdf(product, tmp_path / "product.nc")
    command = ["export", str(tmp_path / "product.nc"), "-o", str(tmp_path / "table.csv")]
    assert main([*command, "--format", "csv"]) == 0
    table = pd.read_csv(tmp_path / "table.csv", parse_dates=["time"])
    assert len(table) == 12
    start = ["time", "axis", "window_mean [degree hour-1]", "Q [urad]", "Q_stderr [urad]"]
    assert list(table.columns[:5]) == start
    assert {"N_upper [deg/sqrt(h)]", "temperature [degree_Celsius]"} <= set(table.columns)
    stamps = table["time"].iloc[::2].dt.tz_localize(None).to_numpy()
    assert (abs(stamps - product["time"].values) <= np.timedelta64(500, "ns")).all()  # rounded
    assert list(table["axis"].iloc[:2]) == ["x", "y"]
    np.testing.assert_allclose(table["N [deg/sqrt(h)]"][1::2], product["N"].sel(axis="y"))
    np.testing.assert_allclose(table["temperature [degree_Celsius]"][::2], product["temperature"])

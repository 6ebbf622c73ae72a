"""Products of one axis, after ``.sel(axis="x")``: every output is that of the kept dimension."""

from __future__ import annotations

import pytest

import gyrostab
from tests.support import synthetic


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (gyrostab.to_csv, "product.csv"),
        (gyrostab.to_kalibr, "imu.yaml"),
        (gyrostab.to_iscwsa, "tool.csv"),
    ],
)
def test_one_axis_is_written_as_a_product_of_one_axis(write, name, tmp_path):
    product = synthetic.product()
    (tmp_path / "one").mkdir()
    write(product.sel(axis="x"), tmp_path / "one" / name)
    write(product.sel(axis=["x"]), tmp_path / name)
    assert (tmp_path / "one" / name).read_bytes() == (tmp_path / name).read_bytes()


def test_one_axis_has_figures_and_a_report(tmp_path):
    product = synthetic.product(windows=4).sel(axis="x")
    paths = gyrostab.save_figures(product, tmp_path / "figures", dpi=20)
    assert {"adev_x.png", "coefficients.png"} <= {path.name for path in paths}
    report = gyrostab.write_report(product, tmp_path / "report.html")
    assert "axis x" in report.read_text(encoding="utf-8")

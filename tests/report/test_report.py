"""The report of a product: a self-contained page with the right numbers."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyrostab.allan.fit import fit_noise
from gyrostab.errors import OutputError, SchemaError
from gyrostab.io.datasets import to_netcdf
from gyrostab.io.opening import open_log, open_product
from gyrostab.report import write_report
from gyrostab.schema import OBSERVABLE
from tests.support import synthetic


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the pictures empty in tests that are about the text of a page."""
    monkeypatch.setattr("gyrostab.report.product.encode_png", lambda _: "")


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.images: list[str] = []
        self.on_screen: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.text = ""
        self.open: list[tuple[str, str]] = []

    def handle_starttag(self, tag, attrs):
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if "id" in dict(attrs):
            self.ids.append(dict(attrs)["id"])
        if tag == "img":
            self.images.append(dict(attrs)["src"])
            assert dict(attrs)["alt"]
            if not any("static" in classes for _, classes in self.open):
                self.on_screen.append(dict(attrs)["alt"])
        if tag not in ("meta", "img", "input"):
            self.open.append((tag, dict(attrs).get("class", "")))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        tags = [tag for tag, _ in self.open]
        if "script" not in tags:
            self.text += data
        if tags and tags[-1] in ("td", "th"):
            self.rows[-1][-1] += data


def read(path) -> _Page:
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    assert page.open == []
    return page


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> _Page:
    folder = tmp_path_factory.mktemp("report")
    product = to_netcdf(synthetic.product(), folder / "product.nc")
    log = to_netcdf(synthetic.log(samples=20_000), folder / "log.nc")
    return read(write_report(open_product(product), folder / "report.html", log=open_log(log)))


def test_page_is_self_contained(page):
    assert all(link.startswith("data:image/png;base64,") for link in page.links)
    # signal, coefficients, two maps, one window for each of three axes
    assert len(page.images) == 7
    for image in page.images:
        assert base64.b64decode(image.split(",")[1]).startswith(b"\x89PNG")


def test_a_screen_shows_the_signal_and_a_print_the_figures_in_place_of_charts(page):
    assert page.on_screen == ["Signal as recorded"]


def test_coefficient_table_holds_medians_ranges_and_shares(page):
    product = synthetic.product()
    rows = [row for row in page.rows if len(row) == 8 and ", " in row[1]]
    assert len(rows) == 15
    n_of_y = rows[6]
    values = product.N.sel(axis="y").values
    assert n_of_y[1] == "N, angle random walk"
    assert float(n_of_y[2]) == pytest.approx(np.nanmedian(values), rel=0.01)
    low, high = (float(text) for text in n_of_y[3].split(" to "))
    assert (low, high) == pytest.approx(tuple(np.nanquantile(values, [0.05, 0.95])), rel=0.01)
    assert n_of_y[4:] == ["deg/√h", "90 %", "0 %", "–"]
    q_of_x = rows[0]
    is_observed = product.observable.sel(axis="x", term="Q") == 2
    assert float(q_of_x[2]) == pytest.approx(
        float(product.Q.sel(axis="x").where(is_observed).median()), rel=0.01
    )
    assert q_of_x[5:7] == ["45 %", "45 %"]
    r_of_z = rows[14]
    assert r_of_z[2:4] == ["–", "–"]
    assert r_of_z[5:7] == ["0 %", "90 %"]
    assert float(r_of_z[7].removeprefix("< ")) == pytest.approx(
        synthetic.COEFFICIENTS["R"] * 2 * 1.6, rel=0.01
    )


def test_summary_names_axes_span_and_change(page):
    text = re.sub(r"\s+", " ", page.text)
    assert "3 gyro axes (x, y, z) at 300 Hz from 2 files" in text
    assert "2026-09-21 14:13:20" in text
    assert "analysed in 40 windows" in text
    n = synthetic.product().N.sel(axis="y")

    change = re.search(r"N varies .*?(\S+) on y \(highest around (\S+ \S+)\)", text)
    assert change is not None
    low, high = n.quantile([0.05, 0.95]).values
    assert float(change[1]) == pytest.approx(high / low, rel=0.05)
    assert change[2] == str(n.time[n.argmax("time")].values)[:19].replace("T", " ")
    assert "µrad (observed in 45 % of the windows only)" in text
    assert "R = " not in text
    assert "axis x 14 %" in text  # 4 of 40 windows hold nothing, 5 hold 70 %: 1 - 34.5 / 40 = 14 %


def test_page_lists_facts_gaps_and_notes(page):
    facts = {row[0]: row[1] for row in page.rows if len(row) == 2}
    assert facts["Files"] == "bore_run_4a.csv, bore_run_4b.csv"
    assert facts["Window"] == "6 s"
    assert facts["Step"] == "30 s"
    (gap,) = [row for row in page.rows if len(row) == 5 and row[4] == "missing"]
    assert gap[2:4] == ["6.67 s", "2 000"]
    assert "2 rows could not be read, µ" in page.text


@pytest.mark.usefixtures("without_figures")
def test_text_of_the_user_is_escaped(tmp_path):
    product = synthetic.product(windows=6, axes="x")
    product.attrs["notes"] = ["<script>alert(1)</script> & more"]
    path = write_report(product, tmp_path / "report.html")
    assert "<script>alert" not in path.read_text(encoding="utf-8")
    page = read(path)
    assert "<script>alert(1)</script> & more" in page.text
    assert "<h2>Gaps</h2>" not in path.read_text(encoding="utf-8")
    assert len(page.images) == 4


def test_one_window_without_an_estimate_makes_a_page(tmp_path):
    page = read(write_report(synthetic.product(axes="x").isel(time=[20]), tmp_path / "report.html"))
    assert "Axis x: no coefficient is observed in any window." in page.text
    assert "surface" not in page.ids  # of a single window


@pytest.mark.usefixtures("without_figures")
def test_a_single_window_has_standard_errors_instead_of_a_range(tmp_path):
    product = synthetic.product(axes="x").isel(time=[2])
    product["N_stderr"] = product["N"] * 0.0 + 0.00123
    page = read(write_report(product, tmp_path / "report.html"))
    (row,) = (row for row in page.rows if row[1:2] == ["N, angle random walk"])
    assert float(row[2]) == pytest.approx(float(product["N"][0, 0]), rel=0.01)
    assert row[3] == "0.00123"
    assert "analysed in 1 window." in page.text
    assert "medians" not in page.text
    assert "Standard error" in page.text
    assert "5 % to 95 %" not in page.text


def test_existing_report_and_wrong_input_are_refused(tmp_path):
    path = tmp_path / "report.html"
    path.write_text("old")
    with pytest.raises(OutputError, match="exists already; give --overwrite"):
        write_report(synthetic.product(), path)
    assert path.read_text() == "old"
    with pytest.raises(SchemaError, match="not a product"):
        write_report(synthetic.surface(), path, overwrite=True)
    with pytest.raises(SchemaError):
        write_report(synthetic.product(), path, log=synthetic.surface(), overwrite=True)
    product = synthetic.product()
    later = product.assign_coords(time=product.time + pd.Timedelta("1D"))
    with pytest.raises(SchemaError, match="the log holds no window: the log goes from 2026-"):
        write_report(later, path, log=synthetic.log(), overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.usefixtures("without_figures")
def test_product_of_an_earlier_version_has_a_report(tmp_path):
    old = synthetic.product(axes="x").drop_vars(["window_trend", "trend_response"])
    page = read(write_report(old, tmp_path / "report.html"))
    assert "record" in page.ids
    with pytest.raises(SchemaError, match="window_trend"):
        fit_noise(old)


@pytest.mark.usefixtures("without_figures")
def test_large_coefficients_are_written_out(tmp_path):
    product = synthetic.product(axes="x")
    product["R"] = xr.full_like(product["R"], 3371.0)
    product["observable"].loc[{"term": "R"}] = OBSERVABLE.index("observed")
    text = read(write_report(product, tmp_path / "report.html")).text
    assert "R = 3370 deg/h²" in text
    assert "3.37e+03" not in text

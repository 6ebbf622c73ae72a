"""The interactive charts of a report: their numbers, their size, and that a browser draws them."""

from __future__ import annotations

import base64
import html
import json
import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from gyrostab import davar, fit_noise, make_log
from gyrostab.allan.fit import refit
from gyrostab.jobs.archive import LogRun
from gyrostab.jobs.fleet_table import list_effects, make_table, summarise_run
from gyrostab.noise import LAWS, model_avar
from gyrostab.plot.style import COLOURS
from gyrostab.report import write_diagnosis_report, write_report
from gyrostab.report.diagnosis_charts import diagnosis_charts, draw_change
from gyrostab.report.fleet import write_overview
from gyrostab.report.product_charts import product_charts, window_data
from gyrostab.report.static import draw_static
from tests.diagnose.result.test_diagnosis import content, diagnosis, surfaces
from tests.jobs.test_fleet_table import write_diagnosis
from tests.support import synthetic

_BROWSER = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)


def _figures(product, log=None):
    return {chart.name: json.loads(chart.figure) for chart in product_charts(product, log)}


def _decode_numbers(packed):
    """Decode a typed array as plotly writes it."""
    if isinstance(packed, list):
        return np.array(packed, dtype=float)
    values = np.frombuffer(base64.b64decode(packed["bdata"]), dtype=packed["dtype"])
    return values.reshape([int(n) for n in str(packed.get("shape", values.size)).split(",")])


def test_the_fitted_curve_of_a_window_is_seen_through_its_gaps():
    draw = np.random.default_rng(1)
    values = np.where(draw.random(6000) < 0.4, np.nan, draw.standard_normal(6000))
    surface = davar(make_log(values, rate=10.0, unit="deg/h"), window="5min")
    product = fit_noise(surface, terms="N")
    text = json.loads(window_data(product))["values"][0]["fitted"]
    response = product.white_response.values
    assert np.nanmax(np.abs(response - 1.0)) > 0.05
    white = LAWS["N"].avar(product.tau.values, refit(product).N.values[..., None])
    curve = np.frombuffer(base64.b64decode(text), dtype="<f4").reshape(response.shape[1:])
    np.testing.assert_allclose(curve, np.sqrt(white * response)[0], rtol=1e-5)


def test_windows_of_every_axis_are_in_the_page():
    product = synthetic.product()
    data = json.loads(window_data(product))
    assert data["axes"] == ["x", "y", "z"]
    assert data["colours"] == list(COLOURS[:3])
    assert data["tau"] == product.tau.values.tolist()
    shape = product.sizes["time"], product.sizes["tau"]
    for row, axis in enumerate(data["axes"]):
        values = {
            name: np.frombuffer(base64.b64decode(text), dtype="<f4").reshape(shape)
            for name, text in data["values"][row].items()
        }
        measured = np.sqrt(product.avar.sel(axis=axis).values)
        np.testing.assert_allclose(values["measured"], measured, rtol=1e-6)
        inside = np.isfinite(measured)
        assert (values["low"][inside] < measured[inside]).all()
        assert (values["high"][inside] > measured[inside]).all()


def test_windows_shorter_than_a_second_have_different_labels():
    product = synthetic.product(axes="x").isel(time=slice(3))
    product["time"] = product.time[0].values + np.arange(3) * np.timedelta64(50, "ms")
    labels = json.loads(window_data(product))["times"]
    assert np.diff(np.array(labels, dtype="M8[ms]")).astype(int).tolist() == [50, 50]


def test_the_map_shows_the_first_axis_by_time_and_averaging_time():
    product = synthetic.product()
    trace = _figures(product)["map"]["data"][0]
    milliseconds = product.time.values.astype("M8[ms]").astype(float)
    np.testing.assert_allclose(_decode_numbers(trace["x"]), milliseconds, atol=1)
    np.testing.assert_allclose(_decode_numbers(trace["y"]), product.tau.values)
    expected = 0.5 * np.log10(product.avar.isel(axis=0).values.T)
    np.testing.assert_allclose(_decode_numbers(trace["z"]), expected, rtol=1e-5)


def test_the_record_is_the_mean_of_the_windows_and_its_fit_follows():
    product = synthetic.product(axes="x").load()
    terms = {"Q": 0.0, "N": 0.01, "B": 0.0, "K": 5.0, "R": 0.0}
    tau = product.tau.values
    product["avar"] = product.avar * 0 + model_avar(tau, terms)
    measured, fitted = _figures(product)["record"]["data"]
    np.testing.assert_allclose(
        _decode_numbers(measured["y"]), np.sqrt(model_avar(tau, terms)), rtol=1e-6
    )
    np.testing.assert_allclose(
        _decode_numbers(fitted["y"]), np.sqrt(model_avar(tau, terms)), rtol=0.12
    )


def test_each_window_of_a_long_product_enters_the_record_once():
    product = synthetic.product(windows=1600, axes="x").load()
    product["avar"][:, 801] *= 1e6
    figures = _figures(product)
    measured = figures["record"]["data"][0]
    assert _decode_numbers(figures["coefficients"]["data"][0]["x"]).size < 1600
    expected = np.sqrt(np.nanmean(product.avar.values[0], axis=0))
    np.testing.assert_allclose(_decode_numbers(measured["y"]), expected, rtol=1e-6)


def test_the_fit_of_the_record_follows_through_gaps():
    values = np.random.default_rng(7).standard_normal(36_000)
    values[(np.arange(36_000) % 1500) < 20] = np.nan
    product = fit_noise(davar(make_log(values, rate=10.0, unit="deg/h"), window="5min"))
    measured, fitted = (_decode_numbers(t["y"]) for t in _figures(product)["record"]["data"])
    np.testing.assert_allclose(fitted[-3:], measured[-3:], rtol=0.06)


def test_coefficients_are_estimates_or_limits_on_one_time_axis():
    product = synthetic.product()
    figure = _figures(product)["coefficients"]
    n_of_y = [
        trace for trace in figure["data"] if trace["yaxis"] == "y2" and trace["name"] == "axis y"
    ]
    is_observed = product.observable.sel(axis="y", term="N").values == 2
    expected = np.where(is_observed, product.N.sel(axis="y").values, np.nan)
    np.testing.assert_allclose(_decode_numbers(n_of_y[0]["y"]), expected, rtol=1e-6)
    limits = [trace for trace in figure["data"] if trace["name"] == "axis z, upper limit"]
    assert limits
    assert all(trace["marker"]["symbol"] == "arrow-bar-down-open" for trace in limits)
    assert {trace.get("xaxis", "x") for trace in figure["data"]} == {"x"}


@pytest.mark.full
def test_a_long_product_is_thinned_and_says_so(tmp_path):
    product = synthetic.product(windows=2500)
    charts = {chart.name: chart for chart in product_charts(product)}
    assert "One window in 2.5 is drawn." in charts["coefficients"].note
    for name in ("map", "window", "surface"):
        assert charts[name].note == " One window in 12.5 is drawn."
    assert charts["record"].note == ""
    times = _decode_numbers(json.loads(charts["map"].figure)["data"][0]["x"])
    assert times.size == 200
    stamps = product.time.values.astype("M8[ms]").astype(float)
    assert times[[0, -1]] == pytest.approx(stamps[[0, -1]], abs=1)
    assert write_report(product, tmp_path / "report.html").stat().st_size < 8e6


def test_thinned_averaging_times_are_in_the_captions():
    values = np.random.default_rng(1).standard_normal(1500)
    log = make_log(values, rate=10.0, unit="deg/h")
    product = fit_noise(davar(log, window="1min", step="1min", taus="all"), terms="N")
    notes = {chart.name: chart.note for chart in product_charts(product)}
    drawn = len(json.loads(window_data(product))["tau"])
    assert product.sizes["tau"] == 200
    text = f" One averaging time in {200 / drawn:.3g} is drawn."
    assert notes.pop("coefficients") == ""
    assert notes == dict.fromkeys(("record", "map", "window", "surface"), text)


def test_names_of_the_user_do_not_become_markup():
    product = synthetic.product(windows=6, axes="x")
    hostile = "</script><a href='http://example.org'>"
    product = product.rename(temperature=hostile)
    charts = {chart.name: chart.figure for chart in product_charts(product)}
    assert not any("<" in figure for figure in charts.values())
    labels = [note["text"] for note in json.loads(charts["coefficients"])["layout"]["annotations"]]
    assert "&lt;/script&gt;&lt;a href=&#x27;http://example.org&#x27;&gt; [°C]" in labels


# Headless Chromium has no window narrower than 500 px: the page is shown in a frame of the width.
_FRAME = """<!DOCTYPE html><html><body><iframe src="PAGE" width="WIDTH" height="900"
style="border: 0"></iframe><script>
addEventListener("message", (event) => {
  const result = document.createElement("pre");
  result.id = "probe";
  result.textContent = event.data;
  document.body.append(result);
});
</script></body></html>"""

_PROBE = """<script>
const probe = {
  linked() {
    const state = () => [document.getElementById("window-label").textContent,
      JSON.stringify(Array.from(document.getElementById("window").data[3].y))];
    const slider = document.getElementById("window-slider");
    if (!slider) return {};
    const before = state();
    slider.value = 3;
    slider.dispatchEvent(new Event("input"));
    const after = state();
    const select = document.getElementById("axis-select");
    select.value = "1";
    select.dispatchEvent(new Event("change"));
    return { before, after, axis: state() };
  },
  name(element) {
    const label = element.labels && element.labels.length ? element.labels[0].textContent : "";
    const content = element.matches("input, select, textarea") ? "" : element.textContent;
    return (element.getAttribute("aria-label") || label || content || element.title || "").trim();
  },
  controls() {
    const found = document.querySelectorAll(
      "a, button, input, select, textarea, summary, [role=button], [onclick]");
    return Array.from(found).filter((element) => element.checkVisibility()).map((element) => {
      element.focus();
      const reached = element.tabIndex >= 0 && document.activeElement === element;
      return { tag: element.localName, name: probe.name(element), reached };
    });
  },
  colour(text) {
    const [r, g, b, a = 1] = (text.match(/[0-9.]+/g) || [0, 0, 0, 0]).map(Number);
    return [r, g, b, a];
  },
  over([r, g, b, a], below) {
    return [r, g, b].map((value, i) => a * value + (1 - a) * below[i]);
  },
  background(element) {
    const layers = [];
    for (let at = element; at; at = at.parentElement)
      layers.push(probe.colour(getComputedStyle(at).backgroundColor));
    return layers.reduceRight((below, layer) => probe.over(layer, below), [255, 255, 255]);
  },
  luminance(rgb) {
    const [r, g, b] = rgb.map((value) => value / 255).map((value) =>
      value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  },
  texts() {
    const rows = [];
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
      const element = walker.currentNode.parentElement;
      const text = walker.currentNode.data.trim();
      if (!text || /^(script|style|noscript)$/i.test(element.localName)) continue;
      if (!element.checkVisibility({ checkOpacity: true, checkVisibilityCSS: true })) continue;
      const style = getComputedStyle(element);
      const ink = probe.colour(element instanceof SVGElement ? style.fill : style.color);
      const below = probe.background(element);
      const [dark, light] = [probe.over(ink, below), below].map(probe.luminance)
        .sort((a, b) => a - b);
      rows.push({ text: text.slice(0, 60), size: parseFloat(style.fontSize),
        contrast: (light + 0.05) / (dark + 0.05) });
    }
    return rows;
  },
  crowded() {
    return Array.from(document.querySelectorAll(".chart")).flatMap((chart) => {
      const labels = Array.from(chart.querySelectorAll(".xaxislayer-above text"))
        .filter((label) => label.checkVisibility({ checkOpacity: true, checkVisibilityCSS: true }))
        .map((label) => ({ text: label.textContent, place: label.getBoundingClientRect() }))
        .filter(({ place }) => place.width > 0)
        .sort((a, b) => a.place.left - b.place.left);
      return labels.filter(({ place }, i) => labels.slice(0, i).some((other) =>
        place.left < other.place.right + 2
          && place.top < other.place.bottom && other.place.top < place.bottom))
        .map(({ text }) => text);
    });
  },
  runs() {
    const heads = document.querySelectorAll("#runs th");
    if (!heads.length) return {};
    const names = () => Array.from(document.querySelectorAll("#runs tbody tr"))
      .filter((row) => row.checkVisibility()).map((row) => row.cells[0].textContent);
    Array.from(heads).find((head) => head.textContent.startsWith("N ")).click();
    const ordered = names();
    const filter = document.getElementById("filter");
    const show = (words) => {
      filter.value = words;
      filter.dispatchEvent(new Event("input"));
      return names();
    };
    return { ordered, filtered: show("RUN 2"), all: show("") };
  },
  tables() {
    return Array.from(document.querySelectorAll("table"))
      .filter((table) => table.checkVisibility()).map((table) => {
        const card = (table.closest(".scroll") || table).getBoundingClientRect();
        return { left: card.left, right: card.right, rows: table.rows.length };
      });
  },
};
window.addEventListener("load", () => setTimeout(() => {
  const root = document.documentElement;
  const linked = probe.linked();
  const closed = Array.from(document.querySelectorAll("details:not([open])"));
  for (const details of closed) details.open = true;
  parent.postMessage(JSON.stringify({ ...linked, runs: probe.runs(),
    drawn: document.querySelectorAll(".chart .main-svg").length,
    wide: root.scrollWidth, seen: root.clientWidth, body: document.body.scrollWidth,
    controls: probe.controls(), texts: probe.texts(), tables: probe.tables(),
    crowded: probe.crowded() }), "*");
}, 3000));
</script></body>"""

_needs_browser = pytest.mark.skipif(_BROWSER is None, reason="needs Chromium")


def _browse(path, width):
    """Return what the probe finds in the page of a width, without a network or console errors."""
    page = path.read_text(encoding="utf-8").replace("</body>", _PROBE)
    path.write_text(page, encoding="utf-8")
    frame = path.with_name("frame.html")
    text = _FRAME.replace("PAGE", path.name).replace("WIDTH", str(width))
    frame.write_text(text, encoding="utf-8")
    command = [
        str(_BROWSER), "--headless", "--no-sandbox", "--enable-unsafe-swiftshader",
        "--enable-logging=stderr", "--v=0", "--host-resolver-rules=MAP * ~NOTFOUND",
        f"--user-data-dir={path.parent / 'profile'}", f"--window-size={width + 100},1000",
        "--hide-scrollbars", "--virtual-time-budget=20000", "--dump-dom", frame.as_uri(),
    ]  # fmt: skip
    ended = subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=True, env={**os.environ}
    )
    console = [line for line in ended.stderr.splitlines() if ":CONSOLE" in line]
    assert not [line for line in console if re.search(r"error|failed|refused|net::", line, re.I)]
    match = re.search(r'<pre id="probe">(.*?)</pre>', ended.stdout, re.S)
    assert match is not None
    return json.loads(html.unescape(match[1]))


def _check_access(state, width):
    """Check that a page can be read at its width, and used from the keyboard."""
    assert state["seen"] == width
    assert max(state["wide"], state["body"]) <= width  # nothing to scroll sideways
    assert state["tables"]
    assert not [table for table in state["tables"] if table["left"] < 0 or table["right"] > width]
    assert state["controls"]
    assert not [row for row in state["controls"] if not (row["reached"] and row["name"])]
    assert len(state["texts"]) > 100
    assert not [row for row in state["texts"] if row["contrast"] < 4.5]  # WCAG 2.2, level AA
    assert not [row for row in state["texts"] if row["size"] < 12]
    assert not state["crowded"]  # labels of the lower axes run into each other


@pytest.mark.slow
@_needs_browser
@pytest.mark.parametrize("width", [1280, 400])
def test_a_browser_draws_the_page_without_errors_or_requests(tmp_path, width):
    product = synthetic.product()
    path = write_report(product, tmp_path / "report.html", log=synthetic.log(samples=20_000))
    state = _browse(path, width)
    _check_access(state, width)
    assert state["drawn"] >= 5
    assert {"select", "input"} <= {row["tag"] for row in state["controls"]}
    times = [str(time).replace("T", " ") for time in product.time.values.astype("M8[ms]")]
    assert times[20] in state["before"][0]
    assert state["after"][0] == f"axis x, window centred on {times[3]} UTC"
    assert state["axis"][0] == f"axis y, window centred on {times[3]} UTC"
    for (_, shown), axis, row in (
        (state["after"], "x", 3),
        (state["axis"], "y", 3),
    ):
        expected = np.sqrt(product.avar.sel(axis=axis).values[row])
        drawn = np.array([np.nan if value is None else value for value in json.loads(shown)])
        np.testing.assert_allclose(drawn, expected, rtol=1e-5)


def test_change_is_the_ratio_of_recording_and_simulation():
    stored = surfaces()
    figure = {chart.name: chart.figure for chart in diagnosis_charts(stored, content())}["change"]
    traces = json.loads(figure)["data"]
    assert len(traces) == 2 * stored.sizes["axis"]
    avar = stored["avar"].isel(axis=0).transpose("case", "tau", "window")
    for trace, case in zip(traces[:: stored.sizes["axis"]], ("before", "after"), strict=True):
        expected = np.sqrt(avar.sel(case="recording") / avar.sel(case=case)).values
        np.testing.assert_allclose(_decode_numbers(trace["customdata"]), expected, rtol=1e-6)
    shapes = json.loads(figure)["layout"]["shapes"]
    framed = {shape["label"]["text"] for shape in shapes if shape.get("label", {}).get("text")}
    assert framed == {
        str(region["id"]) for region in content()["mismatches"] if region["view"] == "davar"
    }


def test_the_colours_of_the_change_have_a_label_with_unit():
    drawn = draw_static(draw_change(surfaces(), content()))
    assert drawn.axes[-1].get_ylabel() == "σ(τ), recording / simulation [1]"
    assert drawn.axes[-1].get_yticklabels()[0].get_text() == "≤ 0.5"


@pytest.mark.slow
@_needs_browser
@pytest.mark.parametrize(("width", "hours"), [(1280, 1.0), (400, 1.0), (700, 24.0), (400, 24.0)])
def test_a_browser_draws_the_page_of_a_diagnosis(tmp_path, width, hours):
    """A record of a day has midnight, and so a date, at both ends of each panel."""
    made = diagnosis()
    if hours > 1.0:
        made.content["recording"]["start"] = "2026-03-14T00:00:00.000Z"
        for name in ("begin", "end", "block_begin", "block_end"):
            made.surfaces[name] = made.surfaces[name] * hours
    path = write_diagnosis_report(made, tmp_path / "report.html")
    state = _browse(path, width)
    _check_access(state, width)
    assert state["drawn"] >= 4
    assert "summary" in {row["tag"] for row in state["controls"]}


@pytest.mark.slow
@_needs_browser
@pytest.mark.parametrize("width", [1280, 400])
def test_a_browser_sorts_and_filters_the_overview_of_a_fleet(tmp_path, width):
    """Run 0 is the noisiest, run 4 the quietest; two are diagnosed, and one failed."""
    rows, runs = {}, []
    for number in range(5):
        name = f"tool 1/run {number}"
        product = synthetic.product()
        row = summarise_run(product.assign(N=product["N"] * (6 - number)))
        rows[name] = {"run": name, "tool": "tool 1", "error": "", "files": 1, **row}
        rows[name]["report"] = f"reports/{name}.html"
        folder = tmp_path / f"diagnosis {number}"
        write_diagnosis(folder, 4.0 if number else None)
        is_diagnosed = number < 2
        runs.append(
            LogRun(name, "tool 1", (), 0, folder, "explained")
            if is_diagnosed
            else LogRun(name, "tool 1", (), 0, None, "")
        )
    rows["tool 2/run 5"] = {"run": "tool 2/run 5", "tool": "tool 2", "error": "it is <damaged>"}
    table = make_table(rows, runs)
    effects = list_effects(table)
    path = write_overview(table, tmp_path / "index.html", effects=effects)
    assert "1 of 2 diagnosed runs" in path.read_text(encoding="utf-8")
    state = _browse(path, width)
    _check_access(state, width)
    names = [f"tool 1/run {number}" for number in range(5)]
    assert state["runs"] == {"ordered": names[::-1], "filtered": [names[2]], "all": names[::-1]}
    assert set(names) <= {row["name"] for row in state["controls"] if row["tag"] == "a"}
    assert "Missing [%]" in {row["name"] for row in state["controls"] if row["tag"] == "button"}

"""The papers' experiments: a small run of the pipeline, the errata, and the page."""

from __future__ import annotations

import copy
import math
import re
from pathlib import Path

import numpy as np
import pytest

from tests.support.scripts import load_script

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "seeds.md"


#: Marks of the experiments that are not for `make test-full` alone.
MARKS = {"x3": [], "l13_vibration": [], "p16_vibration": [pytest.mark.slow]}
SCRIPT = load_script("docs/generate/seed_experiments.py")
ERRATA = load_script("benchmarks/seed_errata.py")


def cells(text: str) -> dict[str, list[str]]:
    """Rows of a table by their first cell."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    return {row[0]: row[1:] for row in rows[2:]}


def on_the_page(name: str) -> str:
    return (
        PAGE.read_text(encoding="utf-8")
        .split(f"<!-- {name}: begin -->\n")[1]
        .split(f"\n<!-- {name}: end -->")[0]
    )


@pytest.fixture
def plan(monkeypatch):
    changed = copy.deepcopy(SCRIPT.PLAN)
    for entry in changed["experiment"].values():
        entry["figure"] = {}
        for run in entry["run"].values():
            run["davar"]["taus"] = 12
    monkeypatch.setattr(SCRIPT, "PLAN", changed)
    return changed["experiment"]


@pytest.fixture(scope="module")
def slips():
    return ERRATA.errata()


# ----------------------------------------------------------------------------------------
# experiments


def test_x1_has_the_expected_windows_and_noise(plan, tmp_path):
    rows = cells(SCRIPT.experiment("x1", tmp_path))
    assert rows["windows"] == ["166", "166", "166", "166", "167"]
    noise = next(row for label, row in rows.items() if label.startswith("N "))
    assert noise[:2] == ["constant", "constant"]
    assert np.array(noise[2:], dtype=float) == pytest.approx(1 / 600, rel=0.03)


def test_noise_of_x2_rises_linearly(plan):
    run = plan["x2"]["run"]["blocks"]
    made = SCRIPT.analyse(SCRIPT.simulate("x2", run), run)
    seconds = (made["time"] - made["time"][0]) / np.timedelta64(1, "s") + 10.0
    slope, level = np.polyfit(seconds, made["N"].values[0] * 600, 1)
    assert level == pytest.approx(1.0, abs=0.1)
    assert 6000 * slope == pytest.approx(10.0, rel=0.03)


def test_gap_bias_equals_the_share_of_lost_samples(plan, tmp_path):
    rows = cells(SCRIPT.experiment("x3", tmp_path))
    _, printed, counted = next(row for label, row in rows.items() if "195-205" in label)
    k = 10
    assert (float(printed) / float(counted)) ** 2 == pytest.approx(
        (500 - 2 * k) / (1000 - 2 * k), rel=0.03
    )
    assert float(counted) == pytest.approx(math.sqrt(0.1), rel=0.2)


def test_folded_vibration_is_white_noise_from_20_ms_on(
    plan,
):
    made = {}
    for name in ("long", "sums"):
        run = plan["p16_vibration"]["run"][name] | {"from": 300, "to": 400}
        made[name] = SCRIPT.analyse(SCRIPT.simulate("p16_vibration", run).sel(axis=["x"]), run)

    def median(name, of, **where):
        return SCRIPT.number({"run": name, "of": of, **where}, made)

    folded = math.sqrt(
        50**2 / (2 * 100) / 3600
    )  # 50 deg/h rms, white up to 100 Hz; N^2 is half of the one-sided density
    assert float(median("long", "N", **{"from": 30})) == pytest.approx(folded, rel=0.1)
    assert median("long", "K", **{"from": 30}).startswith("< ")
    for of in "QNK":
        assert float(median("sums", of, **{"from": 30})) > 5 * float(median("sums", of, to=30))


def test_l13_vibration_has_the_coefficients_of_the_plan(plan, tmp_path):
    rows = cells(SCRIPT.experiment("l13_vibration", tmp_path))
    titles = [column["title"] for column in plan["l13_vibration"]["columns"]]
    at = {title: number for number, title in enumerate(titles)}
    for title, tolerance in (("static, ours", 0.05), ("vibrating, ours", 0.1), ("max, ours", 0.2)):
        assert float(rows["N [deg/√h]"][at[title]]) == pytest.approx(
            float(rows["N [deg/√h]"][at[title] - 1]), rel=tolerance
        )
    assert float(rows["Q [µrad]"][at["max, ours"]]) == pytest.approx(26.85, rel=0.1)
    _, smallest = parse(rows["R [deg/h²]"][at["min, ours"]])
    assert smallest > 1000 * float(rows["R [deg/h²]"][at["min, ours"] - 1])


# ----------------------------------------------------------------------------------------
# errata

TRUTHS = {
    "Allan variance of x1 at 0.1 s [deg²/h²]; 1/k = 0.1": (10.0, 0.1),
    "Allan variance of a ramp of 1 deg/h a sample, k = 10 [deg²/h²]; k²/2 = 50": (
        sum(m**2 for m in range(981)) / 981 / 2,
        50.0,
    ),
    "Allan variance of N = 1 at τ = 10 s, integrated over u = π f τ and over f; N²/τ = 0.1": (
        math.pi,
        0.1,
    ),
    "Q of an angle rounded to 1 arcsec rms, in arcsec": (math.pi / 180 / 3600 * 1e6, 1.0),
    "Eq. 7 over K² τ/3 at τ = 1 s": (2 * math.pi, 1.0),
    "Allan deviation of the second term at 1 s for its Table 1 at rest [deg/h]": (
        0.13814101,
        60 * 0.01657046,
    ),
    "variance of the last 30 s of x2 [deg²/h²], with a scatter of 3": (11.0, 10.975**2),
    "Allan variance of x1 at 0.1 s, half of it lost [deg²/h²]; 0.1": (0.05, 0.1),
    "windows of 1000 in 6000 samples, step 30": (166, 5000 // 30 + 1),
    "windows of 2000 in 600000 samples, step 300": (1993, 598000 // 300 + 1),
    "end of the first window with a loss, and of the first with twice the Allan deviation [s]": (
        432.5,
        330.5,
    ),
    "share of the power below 100 Hz: in the vibration, in its samples": (0.0, 1.0),
    "K fitted to white noise with such a step, and its true K [deg/h^1.5]": (
        0.27 / math.sqrt(5 / 3600),
        0.0,
    ),
    "centrifugal acceleration 2 cm off the axis [g]": (
        (600 * math.pi) ** 2 * 0.02 / 9.80665,
        (10 * math.pi) ** 2 * 0.02 / 9.80665,
    ),
}


@pytest.mark.parametrize("quantity", TRUTHS)
def test_erratum_has_the_size_of_its_closed_form(quantity, slips):
    slip = next(slip for slip in slips if slip.quantity == quantity)
    assert (slip.as_printed, slip.in_truth) == pytest.approx(TRUTHS[quantity], rel=0.05)


def test_added_deviations_are_too_large_and_angles_do_not_cross_a_gap(slips):
    added = next(slip for slip in slips if slip.where == "P15 Eq. 3")
    assert 1.5 < added.as_printed / added.in_truth < math.sqrt(5)
    crossed = next(slip for slip in slips if slip.where == "P16 Eq. 21, 22")
    assert crossed.as_printed > 50
    assert crossed.in_truth == pytest.approx(1.0, abs=0.3)


# ----------------------------------------------------------------------------------------
# page


def test_page_holds_the_current_errata(slips):
    written = [line.strip("|").split("|")[-2:] for line in on_the_page("errata").splitlines()[2:]]
    assert np.array(written, dtype=float) == pytest.approx(
        np.array([slip[-2:] for slip in slips]), rel=2e-3, abs=1e-6
    )


def test_page_has_every_experiment_and_figure():
    text = PAGE.read_text(encoding="utf-8")
    figures = {
        f"figures/seeds-{name}.png"
        for entry in SCRIPT.PLAN["experiment"].values()
        for name in entry.get("figure", {})
    }
    assert set(re.findall(r"\((figures/[^)]*)\)", text)) == figures
    assert all((PAGE.parent / figure).exists() for figure in figures)
    for name, entry in SCRIPT.PLAN["experiment"].items():
        assert (ROOT / "data" / "models" / f"{name}.toml").exists()
        assert set(cells(on_the_page(name))) == set(entry["rows"])


def parse(cell: str) -> tuple[str, float]:
    """Split a cell into its text, without the number, and the number; NaN without one."""
    match = re.search(r"-?[\d.]+(e[+-]?\d+)?$", cell)
    return (cell[: match.start()], float(match[0])) if match else (cell, math.nan)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=MARKS.get(name, [pytest.mark.full]))
        for name in SCRIPT.PLAN["experiment"]
    ],
)
@pytest.mark.filterwarnings("ignore:All-NaN slice")
def test_page_holds_the_current_figures_of_each_experiment(name, tmp_path, monkeypatch):
    """If this fails after a change of the fit, run docs/generate/seed_experiments.py again."""
    monkeypatch.setitem(SCRIPT.PLAN["experiment"][name], "figure", {})
    made, written = cells(SCRIPT.experiment(name, tmp_path)), cells(on_the_page(name))
    for label in written.keys() - {"time [s]"}:
        for new_cell, old_cell in zip(made[label], written[label], strict=True):
            (text, number), (old_text, old_number) = parse(new_cell), parse(old_cell)
            assert text == old_text, label
            assert number == pytest.approx(old_number, rel=2e-3, nan_ok=True), label


def test_table_replaces_the_text_between_its_markers():
    page = "a\n<!-- x: begin -->\nold\n<!-- x: end -->\nb\n<!-- y: begin -->\n<!-- y: end -->\n"
    assert SCRIPT.fill(page, "x", r"| \1 |") == page.replace("old", r"| \1 |")
    assert "new" in SCRIPT.fill(page, "y", "new")

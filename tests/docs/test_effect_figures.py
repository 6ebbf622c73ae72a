"""Every effect has a section, a figure and a table row, and the figure shows what they say."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gyrostab.ingest.make_log import make_log
from gyrostab.physics.registry import effects
from tests.conftest import ROOT
from tests.support.pictures import same_layout
from tests.support.scripts import load_script

PAGES = ROOT / "docs" / "physics"
INDEX = (PAGES / "README.md").read_text(encoding="utf-8")


SCRIPT = load_script("docs/generate/effect_figures.py")


def section(name: str) -> str:
    """The section of an effect; there is one, on one page."""
    texts = [page.read_text(encoding="utf-8") for page in PAGES.glob("*.md")]
    sections = [
        part
        for text in texts
        for part in re.split(r"(?m)^## ", text)[1:]
        if part.startswith(f"{name}\n")
    ]
    assert len(sections) == 1, name
    return sections[0]


@pytest.mark.parametrize("name", list(effects()))
def test_every_effect_is_described_drawn_and_listed(name: str) -> None:
    text = section(name)
    words = text.replace("*", "").replace("\n", " ")
    for view in ("DAVAR", "Window mean", "Spectrum", "Axes", "Confused with"):
        assert view.lower() in words.lower(), f"{name}: {view}"
    picture = PAGES / re.findall(rf"!\[[^\]]+\]\((\.\./figures/effects/{name}\.png)\)", text)[0]
    assert picture.stat().st_size < 60_000
    assert Image.open(picture).size == (912, 588)
    assert SCRIPT.PLAN[name]["caption"] in " ".join(text.split())
    assert SCRIPT.PLAN[name]["caption"].endswith(".")


def test_the_table_is_that_of_the_registry() -> None:
    made = "".join(SCRIPT.rows([page for page in PAGES.glob("*.md") if page.name != "README.md"]))
    assert made in INDEX, "run docs/generate/effect_figures.py"
    assert made.count("\n") == len(effects()) == len(SCRIPT.PLAN)


def test_the_table_of_confusions_names_effects() -> None:
    table = INDEX.split("## Effects that can be confused")[1].split("\n## ")[0]
    named = set(re.findall(r"`([a-z_]+)`", table))
    assert named - set(effects()) == set()
    assert set(effects()) - named == set()


@same_layout
@pytest.mark.parametrize("name", ["shared_source", "earth_rate"])
def test_the_script_draws_an_effect(name: str, tmp_path: Path) -> None:
    shown = np.asarray(Image.open(SCRIPT.draw(name, tmp_path)).convert("L"), float)
    published = np.asarray(
        Image.open(ROOT / "docs" / "figures" / "effects" / f"{name}.png").convert("L"), float
    )
    assert shown.shape == published.shape
    assert (
        np.sqrt(np.mean((shown - published) ** 2)) < 40
    )  # of 255; other fonts make less, another panel more


def test_the_panels_show_what_the_closed_forms_say() -> None:
    rng = np.random.default_rng(2)
    own, common = rng.standard_normal((2, 36_000)), rng.standard_normal(36_000)
    without = make_log(own, rate=10.0, unit="deg/h")
    louder = make_log(np.stack([own[0] + common, own[1] - common]) + 3.0, rate=10.0, unit="deg/h")
    figure = SCRIPT.plot_comparison(without, louder, window="10min", moments=[1800.0, *range(9)])
    curves, means, power, across = figure.axes
    before, after, *others = (np.asarray(line.get_ydata(), float) for line in curves.get_lines())
    assert len(others) == 9
    assert after[0] / before[0] == pytest.approx(np.sqrt(2.0), rel=0.05)
    before, after = (np.asarray(line.get_ydata(), float) for line in means.get_lines())
    assert np.mean(after - before) == pytest.approx(3.0, abs=0.1)
    before, after = (np.asarray(line.get_ydata(), float) for line in power.get_lines())
    assert np.mean(before) == pytest.approx(2.0 / 10.0, rel=0.05)  # one-sided
    assert np.mean(after) == pytest.approx(4.0 / 10.0, rel=0.05)
    before, after = (np.asarray(line.get_ydata(), float) for line in across.get_lines())
    assert before[0] == pytest.approx(0.0, abs=0.03)
    assert after[0] == pytest.approx(-0.5, abs=0.03)


def test_coherency_tells_quadrature_and_its_sign() -> None:
    turn, noise = (
        2.0 * np.pi * 0.5 * np.arange(6000) / 10.0,
        0.1 * np.random.default_rng(3).standard_normal((2, 6000)),
    )
    logs = [
        make_log(noise + size * np.stack([np.cos(turn), -np.sin(turn)]), rate=10.0, unit="deg/h")
        for size in (0.0, 1.0)
    ]
    panel = SCRIPT.plot_comparison(*logs, window="1min", coherency=True).axes[3]
    lines = panel.get_lines()[2:]
    at = np.abs(np.asarray(lines[0].get_xdata(), float) - 0.5).argmin()
    values = {str(line.get_label()): float(np.asarray(line.get_ydata())[at]) for line in lines}
    assert values["in quadrature"] == pytest.approx(1.0, abs=0.02)  # y is a quarter turn ahead
    assert values["in phase"] == pytest.approx(0.0, abs=0.05)

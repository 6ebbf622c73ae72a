"""The code cells of the tutorials run as they are printed."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

PAGES = sorted((Path(__file__).parents[2] / "docs" / "tutorials").glob("*-*.md"))
CELL = re.compile(r"^```\{code-cell\} python\n(?::[^\n]*\n)*(.*?)^```$", re.MULTILINE | re.DOTALL)


def test_every_tutorial_is_listed():
    listed = (PAGES[0].parent / "index.md").read_text(encoding="utf-8")
    assert len(PAGES) >= 3
    for page in PAGES:
        assert f"\n{page.stem}\n" in listed


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_cells_run(page: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    cells = CELL.findall(page.read_text(encoding="utf-8"))
    assert len(cells) > 5
    names: dict[str, object] = {"display": print}
    for cell in cells:
        exec(compile(cell, str(page), "exec"), names)
    plt.close("all")

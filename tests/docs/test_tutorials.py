"""The tutorials are listed; building the site runs their cells."""

from __future__ import annotations

from pathlib import Path

PAGES = sorted((Path(__file__).parents[2] / "docs" / "tutorials").glob("*-*.md"))


def test_every_tutorial_is_listed():
    listed = (PAGES[0].parent / "index.md").read_text(encoding="utf-8")
    assert len(PAGES) >= 3
    for page in PAGES:
        assert f"\n{page.stem}\n" in listed

"""Publishing a benchmark replaces the figures between the marks of the page and nothing else."""

from __future__ import annotations

import json
import runpy
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def docs(tmp_path):
    (tmp_path / "docs" / "figures").mkdir(parents=True)
    shutil.copyfile(ROOT / "docs" / "proof.md", tmp_path / "docs" / "proof.md")
    return tmp_path / "docs"


@pytest.fixture
def publish(monkeypatch):
    """The script, as it is called in its folder."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return runpy.run_path(str(ROOT / "benchmarks" / "publish_proof.py"))["main"]


def finish_run(folder: Path, docs: Path, monkeypatch, *, seed: int = 2_000_003) -> None:
    """Write the files of a finished run, and name it on the command line."""
    folder.mkdir(exist_ok=True)
    job = {"seed": seed, "begun": "2026-12-01T00:00:00Z", "cases": 400, "code": ["abc"]}
    (folder / "benchmark.json").write_text(json.dumps(job))
    lines = [
        f"Seed {seed}, to be repeated.\n",
        "| quantity | value | low | high | n | target | state |",
        "|---|---|---|---|---|---|---|",
        "| false alarms: effect named on a null record | 0.02 | 0 | 0.1 | 100 | - | - |",
        "| detected, strength 1.5 or more | 0.123 | 0.1 | 0.2 | 80 | - | - |",
    ]
    (folder / "table.md").write_text("\n".join(lines))
    for name in ("completeness", "reliability", "calibration", "ranks", "roc"):
        (folder / f"{name}.png").write_bytes(name.encode())
    monkeypatch.setattr("sys.argv", ["publish_proof.py", str(folder), "--docs", str(docs)])


def test_figures_are_replaced_and_handwritten_text_stays(
    tmp_path, docs, publish, monkeypatch, capsys
):
    before = (docs / "proof.md").read_text(encoding="utf-8")
    finish_run(tmp_path / "proof", docs, monkeypatch)
    publish()
    after = (docs / "proof.md").read_text(encoding="utf-8")
    by_hand = before.split("<!-- proof: begin -->")[0]
    assert "## What failed, and why" in by_hand
    line = "| 2000003 | 2026-12-01T00:00:00Z | "
    lines = [text for text in after.splitlines() if not text.startswith(line)]
    assert "\n".join(lines).startswith(by_hand)
    assert "| detected, strength 1.5 or more | 0.123 |" in after
    (entry,) = (text for text in after.splitlines() if text.startswith(line))
    assert entry.endswith("| 400 | abc | 2 of 100 | 0.123 | - | - | - | - |")
    assert "| 444447592 |" in after
    for name in ("completeness", "calibration"):
        assert (docs / "figures" / f"proof-{name}.png").read_bytes() == name.encode()
    assert "What failed, and why" in capsys.readouterr().out  # which describes another run
    publish()
    assert (docs / "proof.md").read_text(encoding="utf-8") == after
    assert capsys.readouterr().out == ""


def test_run_without_all_figures_is_refused(tmp_path, docs, publish, monkeypatch):
    before = (docs / "proof.md").read_bytes()
    finish_run(tmp_path / "proof", docs, monkeypatch)
    (tmp_path / "proof" / "roc.png").unlink()
    with pytest.raises(SystemExit, match=r"roc\.png is missing"):
        publish()
    assert (docs / "proof.md").read_bytes() == before


def test_tuning_seed_is_refused_without_changes(tmp_path, docs, publish, monkeypatch):
    before = (docs / "proof.md").read_bytes()
    finish_run(tmp_path / "proof", docs, monkeypatch, seed=7)
    with pytest.raises(SystemExit, match="for tuning"):
        publish()
    assert (docs / "proof.md").read_bytes() == before
    assert not list((docs / "figures").iterdir())

"""Publishing a benchmark replaces the figures between the marks of the page and nothing else."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def docs(tmp_path):
    (tmp_path / "docs" / "figures").mkdir(parents=True)
    shutil.copyfile(ROOT / "docs" / "proof.md", tmp_path / "docs" / "proof.md")
    return tmp_path / "docs"


def run(folder: Path, docs: Path, *, seed: int = 2_000_003) -> subprocess.CompletedProcess[str]:
    folder.mkdir(exist_ok=True)
    (folder / "benchmark.json").write_text(json.dumps({"seed": seed}))
    (folder / "table.md").write_text(
        f"Seed {seed}, to be repeated.\n\n| quantity | value |\n|---|---|\n| detected | 0.123 |\n"
    )
    for name in ("completeness", "reliability"):
        (folder / f"{name}.png").write_bytes(name.encode())
    command = [
        sys.executable,
        str(ROOT / "benchmarks" / "publish_proof.py"),
        str(folder),
        "--docs",
        str(docs),
    ]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_figures_are_replaced_and_handwritten_text_stays(tmp_path, docs):
    before = (docs / "proof.md").read_text(encoding="utf-8")
    done = run(tmp_path / "proof", docs)
    assert done.returncode == 0, done.stderr
    after = (docs / "proof.md").read_text(encoding="utf-8")
    by_hand = before.split("<!-- proof: begin -->")[0]
    assert "## What failed, and why" in by_hand
    assert after.startswith(by_hand)
    assert "| detected | 0.123 |" in after
    assert (docs / "figures" / "proof-completeness.png").read_bytes() == b"completeness"
    assert "What failed, and why" in done.stdout  # which describes another run
    again = run(tmp_path / "proof", docs)
    assert (docs / "proof.md").read_text(encoding="utf-8") == after
    assert again.stdout == ""


def test_tuning_seed_is_refused_without_changes(tmp_path, docs):
    before = (docs / "proof.md").read_bytes()
    done = run(tmp_path / "proof", docs, seed=7)
    assert done.returncode != 0
    assert "for tuning" in done.stderr
    assert (docs / "proof.md").read_bytes() == before
    assert not list((docs / "figures").iterdir())

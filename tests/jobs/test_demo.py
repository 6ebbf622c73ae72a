"""The shipped log is what its script makes, and the demo finds what is in its model."""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import io
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from gyrostab.cli import main
from gyrostab.io.opening import open_product
from gyrostab.jobs.demo import FILES, sample_log
from gyrostab.schema import OBSERVED

DATA = Path(__file__).resolve().parents[2] / "data"


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> tuple[Path, str]:
    """The folder that the demo wrote, with coarse pictures, and what it printed."""
    folder, shown = tmp_path_factory.mktemp("demo"), io.StringIO()
    with contextlib.redirect_stdout(shown), pytest.MonkeyPatch.context() as patch:
        patch.setattr("gyrostab.jobs.demo._DPI", 40)
        assert main(["demo", "-o", str(folder), "--quiet-progress"]) == 0
    return folder, shown.getvalue()


@pytest.fixture(scope="module")
def folder(demo) -> Path:
    return demo[0]


def test_the_shipped_log_is_what_its_script_writes(tmp_path):
    shutil.copy(DATA / "make_mwd_sample.py", tmp_path)
    runpy.run_path(str(tmp_path / "make_mwd_sample.py"), run_name="__main__")
    digest = [
        hashlib.sha256(gzip.decompress((place / "mwd_sample.csv.gz").read_bytes())).hexdigest()
        for place in (DATA, tmp_path)
    ]
    assert digest[0] == digest[1]
    assert (DATA / "README.md").read_text() == (tmp_path / "README.md").read_text()


def test_the_day_is_what_its_script_writes():
    rows = runpy.run_path(str(DATA / "make_day_log.py"))["format_rows"]()
    shipped = gzip.decompress(sample_log("mwd_day.csv.gz").read_bytes()).decode().splitlines()
    # other versions of numpy or numba may round a few values the other way
    assert len(rows) == len(shipped)
    assert sum(ours != own for ours, own in zip(rows, shipped, strict=True)) < len(rows) / 1000


def test_the_shipped_log_is_found_and_small():
    assert sample_log().stat().st_size < 15e6


def test_demo_shows_each_term_and_what_raises_it(demo):
    """The table has the values of ``data/models/demo.toml``; each term is observed in a part."""
    folder, shown = demo
    rows = {
        tuple(line.split()[:2]): [
            np.nan if cell.startswith("<") else float(cell) for cell in _cells(line)
        ]
        for line in shown.splitlines()
        if line.split()[:1] in (["x"], ["y"], ["z"])
    }
    assert len(rows) == 15
    for axis, white, shaken in (("x", 0.006, 0.0302), ("y", 0.006, 0.0127), ("z", 0.008, 0.0138)):
        assert rows[axis, "N"] == pytest.approx([white, white, shaken, white], rel=0.1)
        assert rows[axis, "Q"] == pytest.approx([2.0] * 4, rel=0.1)
        assert rows[axis, "R"][0] == pytest.approx(3.0, rel=0.2)
        assert np.isnan(rows[axis, "R"][1:]).all()
        for term, size in (("B", 0.05), ("K", 0.2 if axis == "z" else 0.3)):
            assert np.isfinite(rows[axis, term]).any()
            assert np.nanmedian(rows[axis, term]) == pytest.approx(size, rel=0.5)
    product = open_product(folder / "product.nc")
    assert (product["observable"] == OBSERVED).any("time").all()
    changes, terms = shown.splitlines()[-2:]
    assert changes.startswith("N is larger by a factor of 5")
    assert "on x" in changes
    assert changes.endswith("while vibration is high.")
    assert terms.startswith("All five terms are observed in windows of 4h")
    assert "R only while the rate of change of temperature is high" in terms


def _cells(line: str) -> list[str]:
    return line.replace("< ", "<").split()[3:]


def test_demo_writes_all_files(demo):
    folder, shown = demo
    for name in FILES:
        assert (folder / name).stat().st_size > 1000
        assert str(folder / name) in shown


def test_demo_does_not_overwrite(folder, capsys):
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert set(FILES) == {path.name for path in before}
    assert main(["demo", "-o", str(folder)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before

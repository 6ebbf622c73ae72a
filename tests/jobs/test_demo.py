"""The shipped log is what its script makes, and the demo finds in it what was put in."""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import io
import runpy
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyrostab.cli import main
from gyrostab.errors import SchemaError
from gyrostab.io.datasets import open_log, open_product
from gyrostab.jobs.demo import FILES, find_parts, sample_log

DATA = Path(__file__).resolve().parents[2] / "data"


@pytest.fixture(scope="module")
def truth() -> dict[str, dict[str, float]]:
    return runpy.run_path(str(DATA / "make_mwd_sample.py"))["TRUTH"]


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> tuple[Path, str]:
    """The folder that the demo wrote, and what it printed."""
    folder, shown = tmp_path_factory.mktemp("demo"), io.StringIO()
    with contextlib.redirect_stdout(shown):
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


def test_the_shipped_log_is_found_and_small():
    assert sample_log().stat().st_size < 15e6


def test_parts_come_from_the_vibration_channel(folder):
    parts = find_parts(open_log(folder / "log.nc")["vibration"])
    start = pd.Timestamp("2026-03-14T08:00:00")
    seconds = {
        name: [(stamp - start).total_seconds() for stamp in span] for name, span in parts.items()
    }
    assert seconds["still"][1] == pytest.approx(329.5, abs=1.0)
    assert seconds["vibrating"] == pytest.approx([330.5, 629.5], abs=1.0)
    assert seconds["after"][0] == pytest.approx(630.5, abs=1.0)


@pytest.mark.parametrize("levels", [[0.0, 0.0, 9.0], [9.0, 0.0], [np.nan, np.nan], []])
def test_a_vibration_that_does_not_rise_and_fall_is_refused(levels):
    stamps = pd.date_range("2026-03-14", periods=len(levels), freq="1s")
    with pytest.raises(SchemaError, match="vibration"):
        find_parts(xr.DataArray(levels, {"t": stamps}, ["t"]))


def test_demo_finds_what_was_put_in(folder, truth):
    product = open_product(folder / "product.nc").load()
    second = (product["time"].values - np.datetime64("2026-03-14T08:00:00")) / np.timedelta64(
        1, "s"
    )
    for axis, true in truth.items():
        for inside, vibrating in (
            ((second < 220), False),
            ((second > 480) & (second < 600), True),
            ((second > 660), False),
        ):
            part = product.sel(axis=axis).isel(time=np.flatnonzero(inside))
            n_true = true["N"] * (true["N_factor"] if vibrating else 1.0)
            q_true = np.hypot(true["Q"], true["theta"] if vibrating else 0.0)
            assert float(part["N"].median()) == pytest.approx(n_true, rel=0.1), (axis, vibrating)
            assert float(part["Q"].median()) == pytest.approx(q_true, rel=0.1), (axis, vibrating)


def test_demo_prints_the_table_and_the_files(demo):
    folder, shown = demo
    for name in FILES:
        assert (folder / name).stat().st_size > 1000
        assert str(folder / name) in shown
    rows = [line.split() for line in shown.splitlines() if line.split()[:2] == ["x", "N"]]
    assert len(rows) == 1
    assert [float(cell) for cell in rows[0][3:]] == pytest.approx([0.006, 0.030, 0.006], rel=0.1)
    assert any("<" in line for line in shown.splitlines()[2:])


def test_demo_does_not_overwrite(folder, capsys):
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert set(FILES) == {path.name for path in before}
    assert main(["demo", "-o", str(folder)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before

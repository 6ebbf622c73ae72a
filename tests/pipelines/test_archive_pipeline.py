"""pipelines/archive.py takes files of several days to one product, as it is shipped."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import gyrostab
from tests.conftest import ROOT

HERTZ = 0.2
N_TRUE = {"x": 0.01, "y": 0.03}  # deg/sqrt(h)
DAYS = ("2026-03-01", "2026-03-02", "2026-03-03")


def write_day(folder: Path, number: int, day: str, *, hours: float = 20.0) -> None:
    """One file: white noise of `N_TRUE` for twenty hours, then four hours of nothing."""
    rng = np.random.default_rng(number)
    samples = int(hours * 3600 * HERTZ)
    stamps = pd.date_range(day, periods=samples, freq=pd.Timedelta(seconds=1 / HERTZ))
    columns = {"time": stamps.strftime("%Y-%m-%dT%H:%M:%S")}
    for axis, n in N_TRUE.items():
        columns[f"gyro_{axis} [deg/h]"] = np.round(
            10.0 + rng.normal(0.0, n * np.sqrt(3600.0 * HERTZ), samples), 4
        )
    columns["temperature [degC]"] = np.round(60.0 + 5.0 * np.sin(np.arange(samples) / 5000.0), 2)
    # the names run against the order of time
    pd.DataFrame(columns).to_csv(folder / f"run_{9 - number}.csv", index=False)


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> tuple[Path, str]:
    """The pipeline as a user copies it: two files beside a folder of logs."""
    folder = tmp_path_factory.mktemp("archive")
    (folder / "logs").mkdir()
    for number, day in enumerate(DAYS):
        write_day(folder / "logs", number, day)
    (folder / "logs" / "run_0.csv").write_text(
        ""
    )  # damaged; it comes first by its name, where it leaves no gap
    for name in ("archive.py", "archive.toml"):
        shutil.copy(ROOT / "pipelines" / name, folder)
    done = subprocess.run(
        [sys.executable, "archive.py"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_it_is_short():
    for name in ("archive.py", "archive.toml"):
        assert len((ROOT / "pipelines" / name).read_text().splitlines()) <= 80


@pytest.mark.slow
def test_product_spans_the_days_and_finds_the_noise(archive):
    folder, printed = archive
    with gyrostab.open_product(folder / "results" / "product.nc") as product:
        bounds = product["time_bounds"].values
        assert bounds[0, 0] == np.datetime64(DAYS[0])
        assert bounds[-1, 1] > np.datetime64(DAYS[-1]) + np.timedelta64(19, "h")
        for axis, n in N_TRUE.items():
            part = product.sel(axis=axis).load()
            observed = part["N"].where(part["observable"].sel(term="N") == 2)
            assert float(observed.median()) == pytest.approx(n, rel=0.03)
            assert f"axis {axis}: " in printed
        night = product.sel(
            time=slice(f"{DAYS[0]}T21:05", f"{DAYS[0]}T22:55")
        )  # windows wholly in the gap
        assert night.sizes["time"] > 3
        assert np.isnan(night["avar"]).all()
        assert (night["window_coverage"] == 0).all()
        assert (night["observable"] == 0).all()


@pytest.mark.slow
def test_all_other_outputs_exist(archive):
    folder, printed = archive
    results = folder / "results"
    assert {path.name for path in results.iterdir()} == {
        "log.nc",
        "product.nc",
        "report.html",
        "figures",
        "imu.yaml",
    }
    assert {path.name for path in (results / "figures").iterdir()} >= {
        "coefficients.png",
        "davar.png",
        "adev_x.png",
        "davar_3d_y.png",
    }
    assert "3 files" in (results / "report.html").read_text()
    assert all(f"run_{9 - number}.csv" in printed for number in range(3))
    with gyrostab.open_log(results / "log.nc") as log:
        assert gyrostab.gap_table(log)["samples"].tolist() == [4 * 3600 * HERTZ] * 2


@pytest.mark.slow
def test_a_damaged_file_is_left_out_and_named(archive):
    folder, _ = archive
    with gyrostab.open_product(folder / "results" / "product.nc") as product:
        assert product.attrs["unreadable_files"] == ["run_0.csv"]
        assert len(product.attrs["source_files"]) == 3


@pytest.mark.full
def test_second_start_keeps_complete_results(archive):
    folder, _ = archive
    results = [folder / "results" / name for name in ("log.nc", "product.nc")]
    before = [path.stat().st_mtime_ns for path in results]
    done = subprocess.run(
        [sys.executable, "archive.py"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "product.nc is complete already" in done.stderr
    assert [path.stat().st_mtime_ns for path in results] == before


def test_the_log_is_that_of_the_files_that_are_there(tmp_path, capsys):
    """Also where a file is added with the time of its recording, or removed."""
    make_log = runpy.run_path(str(ROOT / "pipelines" / "archive.py"))["make_log"]
    logs = [tmp_path / f"run_{9 - number}.csv" for number in range(len(DAYS))]
    for number, day in enumerate(DAYS):
        write_day(tmp_path, number, day, hours=0.5)
        os.utime(logs[number], ns=(10**18, 10**18 + number))
    target = tmp_path / "log.nc"
    for files in (logs[:2], logs, logs[1:], logs[1:]):
        make_log(files, target, reading={})
        with gyrostab.open_log(target) as log:
            assert sorted(log.attrs["source_files"]) == sorted(path.name for path in files)
    assert capsys.readouterr().out.count("run_7.csv") == 2  # once for each log that was made


def test_message_without_logs(tmp_path, monkeypatch):
    for name in ("archive.py", "archive.toml"):
        shutil.copy(ROOT / "pipelines" / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["archive.py"])
    with pytest.raises(SystemExit, match=r"holds no file \*\.csv"):
        runpy.run_path("archive.py", run_name="__main__")

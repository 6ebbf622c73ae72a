"""A fleet of runs: products, table, overview; what is new, what failed, and what was killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyrostab import make_log, open_log, open_product, to_netcdf, to_zarr
from gyrostab.cli import main
from gyrostab.errors import FormatError, OptionError, OutputError, ResumeError
from gyrostab.ingest.files import scan_file
from gyrostab.jobs import fleet as fleet_module
from gyrostab.jobs.archive import Archive, LogRun, find_archive, find_runs
from gyrostab.jobs.fleet import process_run, run_fleet, write_file_table
from gyrostab.jobs.fleet_table import TREND_COLUMNS, read_table, write_table
from gyrostab.jobs.job import begin_job, job_folder, make_fingerprint
from gyrostab.jobs.load import check_run_options
from gyrostab.jobs.run import run
from gyrostab.jobs.schedule import open_pool
from gyrostab.report.fleet import write_overview
from gyrostab.store.remote import find_url

RATE = 10.0
WINDOWS = {"window": "60s", "step": "30s", "taus": "12"}
OPTIONS = {"windows": WINDOWS, "reports": False, "scheduler": "threads", "workers": 1}


def write_log(path: Path, seed: int, *, minutes: float = 5.0, start: str = "2026-05-01") -> Path:
    rng = np.random.default_rng(seed)
    values = 5.0 + rng.standard_normal((1, round(60 * minutes * RATE)))
    path.parent.mkdir(parents=True, exist_ok=True)
    return to_netcdf(make_log(values, rate=RATE, unit="deg/h", start=start), path)


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    """Three runs of two tools: two files that follow each other, one file, and a damaged file."""
    folder = tmp_path_factory.mktemp("archive")
    write_log(folder / "tool 1" / "run a" / "1.nc", 1)
    write_log(folder / "tool 1" / "run a" / "2.nc", 2, start="2026-05-01T00:05:00")
    write_log(folder / "tool 1" / "run <b>" / "log.nc", 3)
    whole = write_log(folder / "tool 2" / "broken" / "log.nc", 4)
    whole.write_bytes(whole.read_bytes()[:2000])
    (folder / "tool 1" / "README.txt").write_text("Logs of the spring campaign.\n")
    return folder


@pytest.fixture
def computed(monkeypatch) -> list[str]:
    """Names of the runs that are computed from now on."""
    names: list[str] = []

    def count(*arguments):
        names.append(arguments[-1].name)
        return process_run(*arguments)

    monkeypatch.setattr(fleet_module, "process_run", count)
    return names


def analyse(paths, output: Path, **options) -> pd.DataFrame:
    with pytest.warns(UserWarning, match="tool 2/broken: "):
        return run_fleet([paths], output, **{**OPTIONS, **options})


@pytest.fixture(scope="module")
def done(archive, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("fleet") / "fleet"
    with pytest.raises(FormatError, match=r"1 of 3 runs failed: tool 2/broken; .*index\.html"):
        analyse(archive, output)
    return output


def test_missing_reports_are_written_and_tools_are_those_of_the_call(tmp_path, computed):
    write_log(tmp_path / "in" / "SN7" / "r1.nc", 6)
    paths = [tmp_path / "in"], tmp_path / "out"
    run_fleet(*paths, **OPTIONS)
    table = run_fleet(*paths, **{**OPTIONS, "reports": True})
    assert list(table["tool"]) == [""]
    assert (tmp_path / "out" / "reports" / f"{table['run'][0]}.html").exists()
    computed.clear()
    table = run_fleet(*paths, **{**OPTIONS, "reports": True, "tool": "[0-9]"})
    assert list(table["tool"]) == ["7"]
    assert not computed


# ------------------------------------------------------------------------------
# which files are a run


@pytest.mark.parametrize(
    ("per", "expected"),
    [
        ("folder", {"a": ["1.nc", "2.nc"], "b/c": ["3.nc"], "b/files": ["4.nc"]}),
        ("file", {"a/1": ["1.nc"], "a/2": ["2.nc"], "b/c/3": ["3.nc"], "b/4": ["4.nc"]}),
    ],
)
def test_runs_are_folders_or_files(tmp_path, per, expected):
    for name in ("a/1.nc", "a/2.nc", "b/c/3.nc", "b/4.nc", ".hidden/5.nc"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    for paths in ([tmp_path], [f"{tmp_path}/**"], [tmp_path / "a", tmp_path / "b"]):
        archive = find_archive(paths)
        table = pd.DataFrame(
            {"file": map(str, archive.files), "bytes": 0, "is_log": True, "note": ""}
        )
        runs = find_runs(archive, table, per=per)
        assert {item.name: [path.name for path in item.files] for item in runs} == expected
    assert {item.tool for item in runs} == {item.name.rpartition("/")[0] for item in runs}
    assert {item.tool for item in find_runs(archive, table, tool="^.")} == {"a", "b"}


def test_every_run_has_a_name_also_where_a_folder_is_called_files(tmp_path):
    files = [tmp_path / name for name in ("x/1.nc", "x/files/2.nc", "x/y/3.nc", "reports/4.nc")]
    table = pd.DataFrame({"file": map(str, files), "bytes": 0, "is_log": True, "note": ""})
    runs = find_runs(Archive(tmp_path, files, []), table)
    names = {item.name: item.files[0].name for item in runs}
    assert names == {
        "reports/files": "4.nc", "x/files": "2.nc", "x/files_": "1.nc", "x/y": "3.nc"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("names", "per", "expected"),
    [
        (["x/log.csv", "x/LOG.txt"], "file", {"x/log.csv", "x/LOG.txt"}),
        (["run/1.nc", "RUN/2.nc"], "folder", {"run", "RUN_"}),
        (["Index.HTML/1.nc", "r/2.nc"], "folder", {"Index.HTML/files", "r"}),
        (["AUX/nul.csv", "AUX/falcon.csv"], "file", {"AUX_/nul_", "AUX_/falcon"}),
        (["Com1.a/con.csv", "Com1.a/con.txt"], "file", {"Com1_.a/con_.csv", "Com1_.a/con_.txt"}),
    ],
)
def test_names_of_runs_are_those_of_different_files_on_any_system(tmp_path, names, per, expected):
    files = [tmp_path / name for name in names]
    table = pd.DataFrame({"file": map(str, files), "bytes": 0, "is_log": True, "note": ""})
    runs = find_runs(Archive(tmp_path, files, []), table, per=per)
    found = {item.name for item in runs}
    assert len({name.casefold() for name in found}) == len(files)
    assert found == expected


def test_an_archive_of_ten_thousand_files_is_listed_in_linear_time(tmp_path):
    names = [f"r{number // 100}/{number}.nc" for number in range(2000)]
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    begun = time.process_time()
    assert len(find_archive([tmp_path]).files) == len(names)
    assert time.process_time() - begun < 0.5


# ------------------------------------------------------------------------------
# what is written


def test_products_equal_those_of_single_runs(archive, done, tmp_path):
    files = sorted((archive / "tool 1" / "run a").iterdir())
    single = run(files, tmp_path / "product.nc", windows=WINDOWS)
    with (
        open_product(single) as expected,
        xr.open_datatree(done, engine="gyrostab") as tree,
    ):
        xr.testing.assert_equal(expected, open_product(done / "tool 1" / "run a.nc"))
        assert set(tree["tool 1"].children) == {"run a", "run <b>"}
        xr.testing.assert_equal(tree["tool 1/run a"].to_dataset(), expected)


def test_a_zarr_store_holds_the_same_products(archive, done, tmp_path):
    output = tmp_path / "fleet.zarr"
    run_fleet([archive / "tool 1"], output, **OPTIONS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tree = xr.open_datatree(output, engine="zarr")
    assert set(tree.children) == {"run a", "run <b>"}
    expected = open_product(done / "tool 1" / "run a.nc")
    xr.testing.assert_equal(open_product(output / "run a"), expected)
    np.testing.assert_array_equal(tree["run a"]["N"].values, expected["N"].values)
    for fleet in (output, done):
        with pytest.raises(FormatError, match=r"is the output of 'gyrostab fleet'.*index\.html"):
            open_product(fleet)


def test_the_table_has_a_row_for_each_run(done):
    table = read_table(done / "index.parquet", content="runs")
    assert list(table["run"]) == ["tool 1/run <b>", "tool 1/run a", "tool 2/broken"]
    assert list(table["tool"]) == ["tool 1", "tool 1", "tool 2"]
    assert list(table["files"]) == [1, 2, 1]
    row = table.iloc[1]
    assert (row["start"], row["span [s]"], row["rate [Hz]"]) == (
        pd.Timestamp("2026-05-01"),
        600.0,
        RATE,
    )
    white = 1.0 / np.sqrt(RATE * 3600.0)  # deg/sqrt(h), of 1 deg/h in each sample
    assert row["N_x [deg/sqrt(h)]"] == pytest.approx(white, rel=0.1)
    assert "log.nc: is damaged" in table.iloc[2]["error"]
    files = read_table(done / "files.parquet", content="files").set_index("file")
    readme = next(name for name in files.index if name.endswith("README.txt"))
    assert not files.loc[readme, "is_log"]


def test_the_overview_escapes_names_and_links_reports(done, tmp_path):
    page = (done / "index.html").read_text(encoding="utf-8")
    assert "run &lt;b&gt;" in page
    assert "<b>" not in page
    assert "http" not in page.replace("http://www.w3.org", "")
    table = read_table(done / "index.parquet", content="runs")
    table["report"] = "reports/" + table["run"] + ".html"
    table[["K_x [deg/h^1.5]", "K_x_upper [deg/h^1.5]"]] = np.nan, 356.0
    row = ("<i>", "N_x [deg/sqrt(h)]", "age [d]", 9, 0.0333, 0.0111, 0.0444, 0.002)
    trends = pd.DataFrame([row, (*row[:-1], 0.2)], columns=list(TREND_COLUMNS))
    page = write_overview(table, tmp_path / "index.html", trends=trends)
    text = page.read_text(encoding="utf-8")
    assert "&lt; 360" in text  # not 3.6e+02
    assert text.count("0.0333 (0.0111 to 0.0444)") == 1
    assert "<i>" not in text
    assert 'href="reports/tool%201/run%20%3Cb%3E.html"' in text


@pytest.mark.parametrize(
    ("hours", "days", "said"),
    [
        (0.2, 1, "0.4 h of logs on 2026-05-01"),
        (6172.5, 500, "12345 h of logs from 2026-05-01 to 2027-09-12"),
    ],
)
def test_the_overview_states_hours_and_days(done, tmp_path, hours, days, said):
    table = read_table(done / "index.parquet", content="runs").assign(report="")
    table["span [s]"] = 3600.0 * hours  # of two runs and one that failed
    table["start"] = pd.Timestamp("2026-05-01")
    table["end"] = pd.Timestamp("2026-05-01") + pd.Timedelta(days - 1, "D")
    assert said in write_overview(table, tmp_path / "index.html").read_text(encoding="utf-8")


def test_a_run_that_failed_has_no_report(archive, tmp_path):
    log = archive / "tool 2" / "broken" / "log.nc"
    options = {"reading": {}, "windows": WINDOWS, "fitting": {}}
    broken = LogRun("tool 2/broken", "tool 2", (log,), 2000, None, "")
    row = process_run(str(tmp_path), json.dumps(options), True, False, broken)
    assert "is damaged" in row["error"]
    assert not row["report"]


def test_survey_terms_are_those_of_the_windows_of_all_runs(done, tmp_path, capsys):
    runs = [open_product(done / "tool 1" / f"run {name}.nc").load() for name in ("a", "<b>")]
    bounds = np.concatenate([run["time_bounds"].values for run in runs])
    start, end = (np.datetime_as_string(time, "s") for time in (bounds.min(), bounds.max()))
    for folder in (done, done / "tool 1"):
        call = ["export", str(folder), "--format", "iscwsa", "-o", str(tmp_path / "tool.csv")]
        assert main([*call, "--overwrite"]) == 0
        assert f"from 2 runs of {folder.name}, {start} to {end}." in capsys.readouterr().out
    noise = np.concatenate([run["N"].values[0] for run in runs])
    terms = pd.read_csv(tmp_path / "tool.csv", comment="#").set_index("code")
    assert terms.loc["GXY-GRW", "value"] == pytest.approx(np.nanmedian(noise))
    assert main(["export", str(tmp_path), "--format", "iscwsa", "-o", str(tmp_path / "a.csv")]) == 2


# ------------------------------------------------------------------------------
# the second call


def test_a_second_call_computes_what_is_new_changed_or_failed(tmp_path, computed):
    own, output = tmp_path / "archive", tmp_path / "fleet"
    for name in ("a", "b"):
        write_log(own / name / "log.nc", 5)
    run_fleet([own], output, **OPTIONS)
    assert sorted(computed) == ["a", "b"]
    write_log(own / "c" / "log.nc", 6)
    log = own / "b" / "log.nc"
    log.unlink()
    write_log(log, 7, minutes=6.0)
    del computed[:]
    table = run_fleet([own], output, **OPTIONS)
    assert sorted(computed) == ["b", "c"]
    assert list(table["span [s]"]) == [300.0, 360.0, 300.0]
    del computed[:]
    run_fleet([own], output, **OPTIONS)
    assert computed == []


def test_results_of_other_files_or_options_are_replaced_with_overwrite_only(tmp_path, computed):
    output = tmp_path / "fleet"
    for folder, minutes in (("spring", 5.0), ("autumn", 6.0)):
        write_log(tmp_path / folder / "run" / "log.nc", 5, minutes=minutes)
    run_fleet([tmp_path / "spring"], output, **OPTIONS)
    before = (output / "run.nc").read_bytes()
    others = {
        r"it has results of .*spring/run/log\.nc": {"paths": [tmp_path / "autumn"]},
        "per is file, was folder": {"per": "file"},
        "window is 2min, was ": {"windows": {"window": "2min"}},
    }
    for message, options in others.items():
        given = {"paths": [tmp_path / "spring"], **OPTIONS, **options}
        with pytest.raises(OutputError, match=f"exists already, and {message}.*--overwrite"):
            run_fleet(output=output, **given)
    assert (output / "run.nc").read_bytes() == before
    del computed[:]
    run_fleet([tmp_path / "spring"], output, **OPTIONS)
    assert computed == []
    table = run_fleet([tmp_path / "autumn"], output, **OPTIONS, overwrite=True)
    assert list(table["span [s]"]) == [360.0]


def test_a_run_under_another_name_has_one_row(tmp_path):
    archive, output = tmp_path / "archive", tmp_path / "fleet"
    for name in ("r1", "r2", "gone"):
        write_log(archive / "SN7" / name / "log.nc", 5)
    assert list(run_fleet([archive / "SN7"], output, **OPTIONS)["run"]) == ["gone", "r1", "r2"]
    (archive / "SN7" / "gone" / "log.nc").unlink()
    write_log(archive / "SN7" / "r1" / "more.nc", 6, start="2026-05-01T00:05:00")
    table = run_fleet([archive], output, **OPTIONS)
    assert list(table["run"]) == ["SN7/r1", "SN7/r2", "gone"]
    assert list(table["span [s]"]) == [600.0, 300.0, 300.0]
    assert list(run_fleet([archive], output, **OPTIONS)["run"]) == list(table["run"])


def test_a_table_of_other_options_has_no_rows_of_the_earlier_ones(tmp_path):
    archive, output = tmp_path / "archive", tmp_path / "fleet"
    for name in ("r1", "r2"):
        write_log(archive / name / "log.nc", 5)
    run_fleet([archive], output, **OPTIONS)
    (archive / "r1" / "log.nc").unlink()
    others = {**OPTIONS, "windows": {**WINDOWS, "step": "1min"}}
    table = run_fleet([archive], output, **others, overwrite=True)
    assert list(table["run"]) == ["r2"]
    assert (output / "r1.nc").exists()


def test_runs_that_failed_are_computed_with_other_options(tmp_path):
    archive, output = tmp_path / "archive", tmp_path / "fleet"
    write_log(archive / "run" / "log.nc", 5)
    too_long = {**OPTIONS, "windows": {"window": "1h"}}
    with pytest.raises(FormatError, match="1 of 1 runs failed"), pytest.warns(match="run: "):
        run_fleet([archive], output, **too_long)
    assert list(run_fleet([archive], output, **OPTIONS)["error"]) == [""]


def test_a_table_of_other_files_is_replaced_with_overwrite_only(tmp_path):
    table, folders = tmp_path / "files.parquet", [tmp_path / "spring", tmp_path / "autumn"]
    for folder in folders:
        write_log(folder / "log.nc", 5)
    names = [str(folder / "log.nc") for folder in folders]
    write_file_table(folders[:1], table, scheduler="threads")
    before = table.read_bytes()
    with pytest.raises(OutputError, match=r"it has results of .*spring/log\.nc"):
        write_file_table(folders[1:], table, scheduler="threads")
    with pytest.raises(OutputError, match="kind is angle, was not given"):
        write_file_table(folders[:1], table, scheduler="threads", reading={"kind": "angle"})
    assert table.read_bytes() == before
    assert sorted(write_file_table(folders, table, scheduler="threads")["file"]) == sorted(names)
    (folders[0] / "log.nc").unlink()
    (folders[0] / "new.nc").write_bytes((folders[1] / "log.nc").read_bytes())
    updated = write_file_table(folders, table, scheduler="threads")
    assert sorted(updated["file"]) == sorted([str(folders[0] / "new.nc"), names[1]])
    replaced = write_file_table(folders[1:], table, scheduler="threads", overwrite=True)
    assert list(replaced["file"]) == names[1:]


def test_a_changed_layout_of_a_binary_log_counts_as_a_change(tmp_path, computed):
    log, output, means = tmp_path / "archive" / "run" / "log.bin", tmp_path / "fleet", []
    log.parent.mkdir(parents=True)
    np.random.default_rng(1).integers(-99, 99, 12_000, dtype=np.int16).tofile(log)
    for unit in ("deg/h", "deg/h", "10 deg/h"):
        layout = f'fields = [{{name = "gyro_x [{unit}]", type = "int16"}}]'
        if not means or unit != "deg/h":
            log.with_name("log.bin.toml").write_text(layout)
        run_fleet([tmp_path / "archive" / "run" / "*.bin"], output, **OPTIONS, reading={"rate": 20})
        with open_product(next(output.rglob("*.nc"))) as product:
            means.append(float(product["window_mean"][0, 0]))
    assert len(computed) == 2
    np.testing.assert_allclose(means, [means[0], means[0], 10 * means[0]])


def test_a_table_of_files_takes_the_place_of_the_archive(archive, tmp_path, monkeypatch):
    table = tmp_path / "files.parquet"
    options = ["--quiet-progress", "--scheduler", "threads"]
    assert main(["index", str(archive), "-o", str(table), *options]) == 0
    monkeypatch.setattr("gyrostab.jobs.archive.scan_file", None)  # no file is opened to list it
    monkeypatch.setattr(fleet_module, "process_run", tell_name)
    assert main(["index", str(archive), "-o", str(table), *options]) == 0
    with (
        pytest.raises(FormatError, match="3 of 3 runs failed"),
        pytest.warns(UserWarning, match="tool 2/broken: not computed"),
    ):
        run_fleet([table], tmp_path / "fleet", **OPTIONS, reading={"max_gap": "10D"})
    rows = read_table(tmp_path / "fleet" / "index.parquet", content="runs")
    assert list(rows["run"]) == ["tool 1/run <b>", "tool 1/run a", "tool 2/broken"]


@pytest.mark.parametrize("window", ["1min", "1h"])  # 1h is longer than the record: the run fails
def test_files_that_are_not_read_are_named(tmp_path, capsys, window):
    write_log(tmp_path / "runs" / "log.nc", 5)
    (tmp_path / "runs" / "a").mkdir()
    (tmp_path / "runs" / "a" / "raw.csv").write_text("time [s],wx\n0,1\n1,2\n2,3\n")
    output = tmp_path / "fleet"
    options = ["--window", window, "--no-reports", "--scheduler", "threads", "--quiet-progress"]
    fails = window == "1h"
    assert main(["fleet", str(tmp_path / "runs"), "-o", str(output), *options]) == 2 * fails
    printed = capsys.readouterr()
    assert printed.out.startswith("1 run of 1 tool\n") == (not fails)
    assert "1 of 2 files are logs\nnote: not logs, or not" in printed.err
    assert "without options: a/raw.csv;" in printed.err
    notes = read_table(output / "files.parquet", content="files").set_index("format")["note"]
    assert "no gyro column" in notes["text"]


def test_a_file_whose_name_is_not_utf8_does_not_stop_the_others(tmp_path):
    write_log(tmp_path / "runs" / "log.nc", 5)
    (tmp_path / "runs" / os.fsdecode(b"m\xe4rz.csv")).write_text("time [s],gyro_x [deg/h]\n")
    table = write_file_table([tmp_path / "runs"], tmp_path / "files.parquet", scheduler="threads")
    assert table.set_index(table["file"].map(lambda name: Path(name).name))["is_log"].to_dict() == {
        "log.nc": True,
        r"m\udce4rz.csv": False,
    }
    assert "rename the file" in table["note"].iloc[1]
    assert list(run_fleet([tmp_path / "runs"], tmp_path / "fleet", **OPTIONS)["run"]) == ["runs"]


def test_files_next_to_a_dead_link_are_opened_once(tmp_path, monkeypatch):
    write_log(tmp_path / "runs" / "log.nc", 5)
    (tmp_path / "runs" / "dead.csv").symlink_to(tmp_path / "nothing.csv")
    opened: list[str] = []

    def count(name, options):
        opened.append(Path(name).name)
        return scan_file(name, options)

    monkeypatch.setattr("gyrostab.jobs.archive.scan_file", count)
    table = tmp_path / "files.parquet"
    for _ in range(3):
        write_file_table([tmp_path / "runs"], table, scheduler="threads")
    assert sorted(opened) == ["dead.csv", "log.nc"]
    stored = pd.read_parquet(table).set_index("is_log")["changed_ns"]
    assert stored[True] == (tmp_path / "runs" / "log.nc").stat().st_mtime_ns


def test_a_store_whose_files_have_other_names_is_listed_again(tmp_path, monkeypatch):
    store, table = tmp_path / "archive" / "log.zarr", tmp_path / "files.parquet"
    store.parent.mkdir()
    to_zarr(make_log(np.ones((1, 600)), rate=RATE, unit="deg/h"), store)
    command = ["index", str(store.parent), "-o", str(table), "--quiet-progress"]
    command += ["--scheduler", "threads"]
    assert main(command) == 0
    read: list[str] = []

    def count(name, options):
        read.append(name)
        return scan_file(name, options)

    monkeypatch.setattr("gyrostab.jobs.archive.scan_file", count)
    assert main(command) == 0
    assert read == []
    chunk = max(
        (file for file in store.rglob("*") if file.is_file()), key=lambda file: file.stat().st_size
    )
    chunk.rename(chunk.with_name("7"))  # as large, and as old, as before
    assert main(command) == 0
    assert len(read) == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"base": "/elsewhere"}, "log.nc: is not inside /elsewhere"), ({"is_log": None}, "no gyro")],
)
def test_a_given_table_cannot_name_products_outside_the_output(changes, message, tmp_path):
    log, path, output = tmp_path / "log.nc", tmp_path / "files.parquet", tmp_path / "fleet"
    write_log(log, 1)
    table = write_file_table([log], path, scheduler="threads")
    made = table.assign(**changes).dropna(axis="columns", subset=[0])
    write_table(made, path, content="files", overwrite=True)
    with pytest.raises(FormatError, match=message):
        run_fleet([path], output, **OPTIONS, per="file")
    assert not list(output.rglob("*.nc"))


def tell_name(*arguments):
    return {"run": arguments[-1].name, "tool": "", "error": "not computed", "report": ""}


def test_nothing_foreign_is_replaced(archive, tmp_path):
    output = tmp_path / "fleet"
    output.mkdir()
    (output / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"notes\.txt.*gyrostab did not make"):
        run_fleet([archive], output, overwrite=True)
    assert [path.name for path in output.iterdir()] == ["notes.txt"]


def test_finished_parts_of_a_run_are_kept(tmp_path):
    write_log(tmp_path / "in" / "r1.nc", 6)
    output = tmp_path / "out.zarr"
    folder = job_folder(output)
    folder.mkdir()
    begin_job(folder, make_fingerprint([], check_run_options()), parts=5, overwrite=False)
    (folder / "windows-0000000000.block").write_bytes(b"an hour of work")
    with pytest.raises(ResumeError, match=r"out\.zarr: a run of it.*1 of 5 parts.*--resume"):
        run_fleet([tmp_path / "in"], output, **OPTIONS)
    assert (folder / "windows-0000000000.block").read_bytes() == b"an hour of work"
    assert not output.exists()


@pytest.fixture
def memory(archive):
    """An archive in an object store: two NetCDF logs of one run, a Zarr log, and a text."""
    store = pytest.importorskip("fsspec").filesystem("memory")
    store.store.clear()
    store.pseudo_dirs[:] = [""]
    for name in ("1.nc", "2.nc"):
        store.put(str(archive / "tool 1" / "run a" / name), f"/rig/tool 1/run a/{name}")
    with open_log(archive / "tool 1" / "run <b>" / "log.nc") as log:
        to_zarr(log, "memory://rig/tool 1/run b/log.zarr")
    store.pipe("/rig/tool 1/README.txt", b"Logs of the spring campaign.")
    store.pipe("/rig/tool 1/diagnosis/diagnosis.json", b"{}")
    store.pipe("/rig/old/fleet.json", b'{"schema": "gyrostab.fleet/1"}')
    store.pipe("/rig/old/run.nc", b"a product")
    return store


def test_a_fleet_of_an_object_store_is_that_of_its_folder(memory, done, tmp_path):
    for paths in (["memory://rig"], ["memory://rig/tool*"]):
        assert [find_url(path) for path in find_archive(paths).files] == [
            "memory://rig/tool 1/README.txt",
            "memory://rig/tool 1/diagnosis/diagnosis.json",  # of another program
            "memory://rig/tool 1/run a/1.nc",
            "memory://rig/tool 1/run a/2.nc",
            "memory://rig/tool 1/run b/log.zarr",
        ]
    table = run_fleet(paths, tmp_path / "fleet", **OPTIONS)
    assert list(table["run"]) == ["tool 1/run a", "tool 1/run b"]
    for name, local in (("run a", "run a"), ("run b", "run <b>")):
        with (
            open_product(tmp_path / "fleet" / "tool 1" / f"{name}.nc") as remote,
            open_product(done / "tool 1" / f"{local}.nc") as other,
        ):
            xr.testing.assert_equal(remote, other)


@pytest.mark.slow
def test_a_fleet_of_an_object_store_is_brought_up_to_date(memory, tmp_path, computed, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    table = tmp_path / "files.parquet"
    for _ in range(2):
        write_file_table(["memory://rig"], table, scheduler="threads")
        run_fleet([table], tmp_path / "fleet", **OPTIONS)
    assert computed == ["tool 1/run a", "tool 1/run b"]
    log = make_log(np.arange(3000.0) % 7, rate=RATE, unit="deg/h", start="2026-05-01")
    memory.rm("/rig/tool 1/run b/log.zarr", recursive=True)
    to_zarr(log, "memory://rig/tool 1/run b/log.zarr")
    run_fleet(["memory://rig"], tmp_path / "fleet", **OPTIONS)
    assert computed[2:] == ["tool 1/run b"]
    assert not list(tmp_path.glob("gyrostab-*"))  # copies of the NetCDF logs are removed


def test_a_fleet_is_read_from_a_web_server(archive, done, tmp_path, serve_folder):
    address = serve_folder(archive / "tool 1" / "run a")
    table = run_fleet([address], tmp_path / "fleet", **OPTIONS)
    assert table["files"].tolist() == [2]
    with (
        open_product(tmp_path / "fleet" / f"{table['run'][0]}.nc") as remote,
        open_product(done / "tool 1" / "run a.nc") as local,
    ):
        xr.testing.assert_equal(remote, local)


def test_what_a_fleet_does_not_do_at_addresses_is_said(archive, tmp_path, memory):
    for call, name in ((run_fleet, "fleet"), (write_file_table, "files.csv")):
        with pytest.raises(
            OptionError, match=r"output 'memory://rig/.*' must end in \.(zarr|parq)"
        ):
            call([archive], f"memory://rig/{name}")
    foreign = {"fleet.zarr": run_fleet, "files.parquet": write_file_table}
    for name, call in foreign.items():
        memory.pipe(f"/mine/{name}", b"mine")
        with pytest.raises(
            OutputError, match="exists already, and gyrostab fleet or index did not"
        ):
            call([archive], f"memory://mine/{name}")
        assert memory.cat(f"/mine/{name}") == b"mine"
    with pytest.raises(OptionError, match="either at addresses or in folders"):
        find_archive(["memory://rig", archive])
    with pytest.raises(FormatError, match=r"memory://none: there is no such object"):
        find_archive(["memory://none"])
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_fleet_is_written_to_an_object_store(archive, done, memory, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    output = "memory://results/fleet.zarr"
    run_fleet([archive / "tool 1"], output, **{**OPTIONS, "reports": True})
    tree = xr.open_datatree(output, engine="zarr")
    assert set(tree.children) == {"run a", "run <b>"}
    with open_product(done / "tool 1" / "run a.nc") as expected:
        xr.testing.assert_equal(open_product(f"{output}/run a").load(), expected.load())
        np.testing.assert_array_equal(tree["run a"]["N"].values, expected["N"].values)
    objects = {name.removeprefix("/results/fleet.zarr/") for name in memory.find("/results")}
    tables = {"effects.parquet", "files.parquet", "index.parquet", "trends.parquet"}
    pages = {"index.html", "reports/plotly.js", "reports/run a.html", "reports/run <b>.html"}
    assert objects > tables | pages | {"fleet.json"}
    page = memory.cat("/results/fleet.zarr/index.html").decode()
    assert 'href="reports/run%20a.html"' in page
    terms = tmp_path / "tool.csv"
    assert main(["export", output, "--format", "iscwsa", "-o", str(terms)]) == 0
    assert "from 2 runs of fleet.zarr, " in terms.read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["tool.csv"]


@pytest.mark.full
def test_a_fleet_at_an_address_is_brought_up_to_date(memory, tmp_path, computed, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own, output, table = tmp_path / "in", "memory://results/fleet.zarr", "memory://rig/all.parquet"
    for name in ("a", "b", "c"):
        write_log(own / name / "log.nc", 5)
    put, calls = type(memory).put, []

    def fail_once(self, *arguments, **options):
        calls.append(arguments)
        if len(calls) == 4:  # the metadata of the second product
            raise OSError("the network is down")
        return put(self, *arguments, **options)

    monkeypatch.setattr(type(memory), "put", fail_once)
    write_file_table([own], table, scheduler="threads")
    with pytest.raises(FormatError, match="1 of 3 runs failed: "), pytest.warns(match="is down"):
        run_fleet([table], output, **OPTIONS)
    assert computed == ["a", "b", "c"]
    run_fleet([own], output, **OPTIONS)
    assert computed[3:] == ["b"]
    write_log(own / "d" / "log.nc", 6)
    (own / "c" / "log.nc").unlink()
    write_log(own / "c" / "log.nc", 7, minutes=6.0)
    memory.rm("/results/fleet.zarr/a", recursive=True)
    write_file_table([own], table, scheduler="threads")
    rows = run_fleet([table], output, **OPTIONS)
    assert sorted(computed[4:]) == ["a", "c", "d"]
    assert list(rows["span [s]"]) == [300.0, 300.0, 360.0, 300.0]
    tree = xr.open_datatree(output, engine="zarr")
    assert {name: node.sizes["time"] for name, node in tree.children.items()} == {
        "a": 9, "b": 9, "c": 11, "d": 9,
    }  # fmt: skip
    del computed[:]
    run_fleet([own], output, **OPTIONS)
    assert computed == []


def test_diagnoses_at_addresses_are_those_of_their_runs(memory, archive, tmp_path):
    from tests.jobs.test_fleet_table import write_diagnosis

    write_diagnosis(tmp_path / "found", 4.0)
    made = json.loads((tmp_path / "found" / "diagnosis.json").read_text())
    made["recording"]["files"] = ["log.zarr"]
    memory.pipe("/rig/tool 1/run b/found/diagnosis.json", json.dumps(made).encode())
    table = run_fleet(["memory://rig"], tmp_path / "fleet", **OPTIONS).set_index("run")
    assert table["verdict"].to_dict() == {"tool 1/run a": "", "tool 1/run b": "explained"}
    effects = pd.read_parquet(tmp_path / "fleet" / "effects.parquet")
    assert list(effects["effect"]) == ["vibration_noise"]
    page = (tmp_path / "fleet" / "index.html").read_text(encoding="utf-8")
    assert 'href="memory://rig/tool%201/run%20b/found/report.html"' in page
    assert "1 of 1 diagnosed runs" in page


# ------------------------------------------------------------------------------
# stopped and killed


def test_an_interrupted_pool_does_not_wait_for_its_processes():
    def interrupt_call() -> None:
        with open_pool("processes", workers=2) as pool:
            pool.submit(os.getpid).result()
            call = pool.submit(time.sleep, 60)
            while not call.running():
                time.sleep(0.01)
            raise KeyboardInterrupt

    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupt_call()
    assert time.monotonic() - begun < 50


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_killed_fleet_goes_on_where_it_was(tmp_path, computed):
    """Kill a call in its third run, with the product computed and not yet renamed."""
    own, output = tmp_path / "archive", tmp_path / "fleet"
    for number in range(4):
        write_log(own / f"run{number}" / "log.nc", number)

    replace = os.replace

    def kill_third(source, target):
        if str(target).endswith(".nc") and len(list(output.glob("*.nc"))) == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)

    child = os.fork()
    if child == 0:
        os.replace = kill_third
        run_fleet([own], output, **OPTIONS)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    before = {path.name: path.stat().st_mtime_ns for path in output.glob("*.nc")}
    assert len(before) == 2
    table = run_fleet([own], output, **OPTIONS)
    assert list(table["error"]) == [""] * 4
    after = {path.name: path.stat().st_mtime_ns for path in output.glob("*.nc")}
    assert len(after) == 4
    assert {name: after[name] for name in before} == before
    assert not [path for path in output.rglob("*") if path.name.endswith((".job", ".part"))]


_KILLED_CALL = """
import os, signal, sys
import s3fs
from gyrostab.cli import main

put, calls = s3fs.S3FileSystem.put, []

def kill_fourth(*arguments, **options):
    calls.append(arguments)
    if len(calls) == 4:  # the metadata of the second product
        os.kill(os.getpid(), signal.SIGKILL)
    return put(*arguments, **options)

s3fs.S3FileSystem.put = kill_fourth
main(sys.argv[1:])
"""


@pytest.mark.full  # 570 requests of a server in Python
def test_a_fleet_killed_while_it_writes_to_a_bucket_goes_on(s3_bucket, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in range(2):
        write_log(tmp_path / "archive" / f"run{number}" / "log.nc", number)
    output = f"{s3_bucket}/fleet.zarr"
    command = ["fleet", "archive", "-o", output, "--window", "60s", "--step", "30s"]
    command += ["--taus", "12", "--no-reports", "--scheduler", "threads", "--quiet-progress"]
    killed = subprocess.run([sys.executable, "-c", _KILLED_CALL, *command])
    assert killed.returncode == -signal.SIGKILL
    store = pytest.importorskip("fsspec").filesystem("s3")
    complete = store.glob(f"{output}/*/.zmetadata")
    assert len(complete) == 1
    before = store.info(complete[0])["ETag"]
    assert main(command) == 0
    store.invalidate_cache()
    assert store.info(complete[0])["ETag"] == before  # with the time at which it was made
    tree = xr.open_datatree(output, engine="zarr")
    for name, node in tree.children.items():
        run([tmp_path / "archive" / name / "log.nc"], tmp_path / "product.nc", windows=WINDOWS,
            overwrite=True)  # fmt: skip
        with open_product(tmp_path / "product.nc") as single:
            np.testing.assert_array_equal(node["N"].values, single["N"].values)
    assert not list(tmp_path.glob(".*"))  # the job folders are removed

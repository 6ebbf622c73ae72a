"""Refused outputs: inputs, folders around them, foreign folders; and symbolic links."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from gyrostab import davar, make_log, open_log, to_netcdf, to_zarr
from gyrostab.errors import GyrostabError, OptionError, OutputError
from gyrostab.jobs.job import job_folder
from gyrostab.jobs.run import run
from gyrostab.plot.style import save_png
from gyrostab.store.output import (
    check_output,
    find_foreign_item,
    new_folder,
    new_output,
    protect_inputs,
)
from tests.support.command_line import WINDOW, call, write_log
from tests.support.outputs import read_tree, write_inputs

QUIET = "--quiet-progress"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A log as text and as store, a product, a model and a picture of a holiday."""
    folder = write_inputs(tmp_path_factory.mktemp("made"), seconds=40.0, window="20s", step="5s")
    (folder / "names.toml").write_text('t_probe = "temperature [degC]"\n')
    (folder / "probe.csv").write_text("time [s],temperature [degC]\n0,20\n20,21\n40,22\n")
    return folder


@pytest.fixture
def folder(made, tmp_path) -> Path:
    """The same files, to be spoiled, with a folder of photos called like a store."""
    import shutil

    shutil.copytree(made, tmp_path / "work")
    (tmp_path / "work" / "photos.zarr").mkdir()
    (tmp_path / "work" / "photos.zarr" / "tide.jpg").write_bytes(b"\xff\xd8 the sea")
    return tmp_path / "work"


@pytest.fixture
def check_refusal(folder, capfd) -> Callable[[str, str], None]:
    """Call a command in the folder: it refuses with one message, and changes nothing."""

    def check(command: str, says: str) -> None:
        before = read_tree(folder)
        capfd.readouterr()
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            assert call(*command.split(), QUIET) == 2
        shown = capfd.readouterr().err
        assert says in shown, shown
        assert "Traceback" not in shown
        assert read_tree(folder) == before

    return check


COMMANDS = (
    "ingest log.csv",
    "simulate model.toml --duration 5s --rate 10",
    "export product.nc --format zarr",
)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("overwrite", ["", "--overwrite"])
def test_a_folder_that_another_program_made_is_never_replaced(check_refusal, command, overwrite):
    says = "holds 'tide.jpg', which gyrostab did not make"
    check_refusal(f"{command} -o photos.zarr {overwrite}", says)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_store_that_holds_something_else_is_not_replaced(folder, command, check_refusal):
    (folder / "log.zarr" / "rate" / "notes.txt").write_text("mine")
    check_refusal(f"{command} -o log.zarr --overwrite", "holds 'rate/notes.txt'")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_store_is_replaced_with_overwrite(folder, command):
    before = read_tree(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert call(*command.split(), "-o", "log.zarr", QUIET) == 2
        assert read_tree(folder) == before
        assert call(*command.split(), "-o", "log.zarr", "--overwrite", QUIET) == 0
    after = read_tree(folder)
    outside = {name for name in before if not name.startswith("log.zarr/")}
    assert outside == {name for name in after if not name.startswith("log.zarr/")}
    assert all(before[name] == after[name] for name in outside)
    assert before != after


@pytest.mark.parametrize(
    "command",
    [
        "ingest log.nc -o log.nc",
        "ingest log.zarr -o log.zarr",
        "ingest log.* -o log.nc",
        "ingest log.csv --channel log.nc -o log.nc",
        "run *.nc -o product.nc",
        "run log.csv --channel product.nc -o product.nc --resume",
        "davar log.csv --channel log.* -o log.nc",
        "fit product.nc -o product.nc",
        "correlate product.nc -o product.nc",
        "simulate model.toml --like log.nc -o log.nc",
        "report product.nc --log log.html -o log.html",
        "export product.nc --format zarr -o log.zarr --config log.zarr/.zattrs",
    ],
)
def test_an_output_that_is_an_input_is_refused(folder, command, check_refusal):
    (folder / "log.html").hardlink_to(folder / "log.nc")
    (folder / "log.zarr" / ".zattrs").write_text("")  # an empty TOML file, too
    check_refusal(f"{command} --overwrite", "input")


@pytest.mark.parametrize("how", [Path.symlink_to, Path.hardlink_to])
@pytest.mark.parametrize("command", ["ingest", "run"])
def test_links_do_not_hide_an_input(folder, command, how, check_refusal):
    how(folder / "other.nc", folder / "log.nc")
    check_refusal(f"{command} log.nc -o other.nc --overwrite", "is also an input")
    check_refusal(f"{command} other.nc -o log.nc --overwrite", "is also an input")


def test_a_folder_around_an_input_is_refused(folder, check_refusal):
    (folder / "logs.zarr").mkdir()
    write_log(folder / "logs.zarr" / "in.csv", 20.0)
    (folder / "away.zarr").symlink_to("logs.zarr")
    for output in ("logs.zarr", "away.zarr"):
        command = f"ingest logs.zarr/in.csv -o {output} --overwrite"
        check_refusal(command, "a folder around the input")


def test_an_output_inside_a_store_that_is_read_is_refused(check_refusal):
    command = "run log.zarr -o log.zarr/product.nc --window 20s --step 5s"
    check_refusal(command, "lies inside the input")


# ------------------------------------------------------------------------------
# links


def test_a_link_to_a_store_stays_a_link_and_its_target_is_replaced(folder):
    (folder / "latest.zarr").symlink_to("log.zarr")
    before = read_tree(folder)
    for _ in range(2):
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            assert call("ingest", "log.csv", "-o", "latest.zarr", "--overwrite", QUIET) == 0
    after = read_tree(folder)
    assert after.keys() == before.keys()
    assert after["latest.zarr"] == "log.zarr"
    assert open_log(folder / "log.zarr").sizes["time"] == 4000


def test_a_link_to_a_file_stays_a_link(folder):
    (folder / "latest.nc").symlink_to(folder / "made.nc")
    assert call("run", folder / "log.csv", "-o", folder / "latest.nc", *WINDOW, QUIET) == 0
    assert (folder / "latest.nc").is_symlink()
    assert not (folder / "made.nc").is_symlink()
    assert not [name for name in os.listdir(folder) if name.startswith(".")]


def test_links_in_a_loop_and_what_is_no_file(folder, check_refusal):
    (folder / "a.nc").symlink_to("b.nc")
    (folder / "b.nc").symlink_to("a.nc")
    check_refusal("ingest log.csv -o a.nc --overwrite", "symbolic link in a loop")
    os.mkfifo(folder / "pipe.nc")
    with pytest.raises(OutputError, match="not a regular file"):
        check_output(folder / "pipe.nc", overwrite=True)
    with pytest.raises(OutputError, match="not a regular file"):
        check_output("/dev/null", overwrite=True)


# ------------------------------------------------------------------------------
# Python functions


def test_the_functions_refuse_what_the_commands_refuse(folder):
    log = open_log(folder / "log.nc")
    before = read_tree(folder)
    surface = davar(log, window="20s", step="5s")
    for dataset in (log, surface, log.isel(time=slice(0, 100))):
        with pytest.raises(OptionError, match="is also an input"):
            to_netcdf(dataset, folder / "log.nc", overwrite=True)
    with pytest.raises(OptionError, match="is also an input"):
        to_zarr(
            davar(open_log(folder / "log.zarr"), window="20s", step="5s"),
            folder / "log.zarr",
            overwrite=True,
        )
    with pytest.raises(OutputError, match=r"tide\.jpg"):
        to_zarr(log, folder / "photos.zarr", overwrite=True)
    with pytest.raises(OptionError, match="is also an input"):
        run([folder / "log.nc"], folder / "log.nc", windows={"window": "20s"}, overwrite=True)
    assert read_tree(folder) == before
    to_netcdf(log.load(), folder / "log.nc", overwrite=True)


def test_a_written_dataset_of_xarray_is_an_input_while_it_is_lazy(tmp_path):
    made = xr.Dataset(
        {"avar": (("axis", "time", "tau"), np.ones((1, 2, 3)))}, coords={"axis": ["x"]}
    )
    path = to_netcdf(made, tmp_path / "cube.nc")
    with xr.open_dataset(path) as lazy, pytest.raises(OptionError, match="is also an input"):
        to_netcdf(lazy, path, overwrite=True)


# ------------------------------------------------------------------------------
# folders of files


@pytest.mark.full
def test_the_other_files_of_a_folder_of_figures_stay(folder, monkeypatch):
    monkeypatch.setattr(
        "gyrostab.plot.figures.save_png", lambda figure, path, dpi: save_png(figure, path, dpi=40)
    )
    figures = folder / "figures"
    figures.mkdir()
    (figures / "thesis.tex").write_text("years of work")
    (figures / "davar.png").write_text("mine")
    before = read_tree(figures)
    assert call("plot", folder / "product.nc", "-o", figures, QUIET) == 2
    assert read_tree(figures) == before
    assert call("plot", folder / "product.nc", "-o", figures, "--overwrite", QUIET) == 0
    after = read_tree(figures)
    assert after["thesis.tex"] == before["thesis.tex"]
    assert after["davar.png"].startswith(b"\x89PNG")
    assert not any(name.startswith(".") for name in after)


def test_figures_that_cannot_be_finished_leave_nothing(folder, monkeypatch):
    monkeypatch.setattr(
        "gyrostab.plot.figures.save_png",
        lambda figure, path, dpi: path.write_text("half") and 1 / 0,
    )
    before = read_tree(folder)
    for target in ("new/figures", "photos.zarr"):
        assert call("plot", folder / "product.nc", "-o", folder / target, QUIET) == 1
    assert read_tree(folder) == before


def test_a_folder_of_files_is_checked_before_the_first_is_moved(tmp_path):
    (tmp_path / "b.txt").mkdir()

    def write() -> None:
        with new_folder(tmp_path, overwrite=True) as temporary:
            (temporary / "a.txt").write_text("new")
            (temporary / "b.txt").write_text("new")

    with pytest.raises(OutputError, match="is a directory"):
        write()
    assert [path.name for path in tmp_path.iterdir()] == ["b.txt"]


@pytest.mark.parametrize(
    "names", [["notes.txt"], ["report.html"], ["diagnosis.json", "notes.txt"], ["diagnosis.json"]]
)
def test_a_diagnosis_replaces_a_diagnosis_only(folder, names, check_refusal):
    (folder / "run7").mkdir()
    for name in names:
        (folder / "run7" / name).write_text(
            json.dumps({"schema": "gyrostab.diagnosis/1" if len(names) == 2 else "other"})
        )
    check_refusal("diagnose log.nc -o run7 --overwrite", "which gyrostab did not make")


def test_a_benchmark_replaces_a_benchmark_only(folder, check_refusal):
    for name in ("recordings", "truth"):
        (folder / "proof" / name).mkdir(parents=True)
    (folder / "proof" / "recordings" / "holiday.wav").write_text("waves")
    check_refusal("prove -o proof --overwrite", "holds 'recordings/holiday.wav'")
    (folder / "proof" / "benchmark.json").write_text('{"schema": "gyrostab.prove/1"}')
    check_refusal("prove -o proof --overwrite", "holds 'recordings/holiday.wav'")


# ------------------------------------------------------------------------------
# the folder of a run


@pytest.mark.parametrize(
    "content",
    [
        {"notes.txt": "mine"},
        {"job.json": "{}"},
        {"lock": "keep"},
        {"windows-0000000000.block": ""},
        None,
    ],
)
@pytest.mark.parametrize("option", ["--overwrite", "--resume"])
def test_a_folder_with_the_name_of_a_job_is_left_alone(folder, content, option, check_refusal):
    job = job_folder(folder / "out.nc")
    if content is None:
        job.write_text("a file")
    else:
        job.mkdir()
        for name, text in content.items():
            (job / name).write_text(text)
    command = f"run log.csv -o out.nc --window 20s --step 5s {option}"
    check_refusal(command, "gyrostab did not make what is there")


# ---------------------------------------------------------------------------------------- the
# decision and the writing itself


@pytest.mark.parametrize("version", [2, 3])
def test_stores_of_other_programs_are_known(tmp_path, version):
    import zarr

    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=version)
    group.create_array("one", data=np.zeros((3, 4)), chunks=(1, 4))
    group.create_group("inner").create_array("two", data=np.ones(5))
    assert find_foreign_item(tmp_path / "a.zarr") is None
    (tmp_path / "a.zarr" / "inner" / "link").symlink_to(tmp_path)
    assert find_foreign_item(tmp_path / "a.zarr") == "inner/link"
    (tmp_path / "a.zarr" / "inner" / "link").unlink()
    (tmp_path / "a.zarr" / "inner" / "folder").mkdir()
    assert find_foreign_item(tmp_path / "a.zarr") is None
    (tmp_path / "a.zarr" / "inner" / "folder" / "0.0").write_text("")
    assert find_foreign_item(tmp_path / "a.zarr") == "inner/folder/0.0"


@pytest.mark.parametrize("suffix", ["nc", "zarr"])
def test_what_another_process_has_made_meanwhile_is_not_replaced(tmp_path, suffix):
    log = make_log(np.zeros((1, 10)), rate=1.0, unit="deg/h")
    write = to_netcdf if suffix == "nc" else to_zarr
    target = tmp_path / f"log.{suffix}"
    options = {"find_foreign": find_foreign_item} if suffix == "zarr" else {}
    tree: dict[str, object] = {}

    def write_late() -> None:
        with new_output(target, **options) as temporary:
            with pytest.warns(UserWarning, match="is being written now"):
                write(log, target)
            tree.update(read_tree(tmp_path))
            (temporary / "x" if suffix == "zarr" else temporary).write_text("late")

    with pytest.raises(OutputError, match="exists already"):
        write_late()
    assert {name: value for name, value in tree.items() if ".part" not in name} == read_tree(
        tmp_path
    )


@pytest.mark.parametrize("renameat2", [True, False])
def test_a_folder_is_replaced_in_one_step_or_put_back(tmp_path, monkeypatch, renameat2):
    log = make_log(np.zeros((1, 10)), rate=1.0, unit="deg/h")
    if not renameat2:
        monkeypatch.setattr("gyrostab.store.system.rename_with_flag", lambda *_: False)
    path = to_zarr(log, tmp_path / "log.zarr")
    to_zarr(log.isel(time=slice(0, 5)), path, overwrite=True)
    assert open_log(path).sizes["time"] == 5
    before = read_tree(tmp_path)
    if not renameat2:
        rename, done = Path.rename, []

        def fail_once(self, target):
            done.append(target)
            if len(done) == 2:
                raise KeyboardInterrupt
            return rename(self, target)

        monkeypatch.setattr(Path, "rename", fail_once)
        with pytest.raises(KeyboardInterrupt):
            to_zarr(log, path, overwrite=True)
        assert read_tree(tmp_path) == before


@pytest.mark.parametrize("change", ["has changed", "has vanished"])
def test_an_input_that_changes_before_the_output_is_complete(folder, change, monkeypatch, capfd):
    from gyrostab.io import datasets as export

    begin = export._begin_netcdf

    def spoil(*arguments):
        (folder / "log.csv").write_text("other") if change == "has changed" else (
            folder / "log.csv"
        ).unlink()
        begin(*arguments)

    monkeypatch.setattr(export, "_begin_netcdf", spoil)
    assert call("ingest", folder / "log.csv", "-o", folder / "new.nc", QUIET) == 2
    assert change in capfd.readouterr().err
    assert not [name for name in os.listdir(folder) if "new.nc" in name]


@pytest.mark.parametrize("name", ["log.nc", "[n]" * 84 + ".nc"])
def test_a_leftover_of_a_killed_process_is_reported(name, tmp_path):
    with new_output(tmp_path / name) as temporary:
        left = temporary.name[:-13] + "0123abcd.part"
    (tmp_path / left).write_text("half")
    log = make_log(np.zeros((1, 10)), rate=1.0, unit="deg/h")
    with pytest.warns(UserWarning, match="killed: then delete it"):
        to_netcdf(log, tmp_path / name, overwrite=True)
    assert (tmp_path / left).read_text() == "half"


def test_long_names_and_names_without_a_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with new_output("n" * 252 + ".nc") as temporary:
        temporary.write_text("")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with new_folder(".") as inside:
        (inside / "a.txt").write_text("")
    assert os.listdir() == ["a.txt"]
    with pytest.raises(OutputError, match="exists already"):
        check_output(".", find_foreign=lambda _: None)
    with protect_inputs(["*.txt"]), pytest.raises(GyrostabError, match="is also an input"):
        check_output("../here/a.txt", overwrite=True)

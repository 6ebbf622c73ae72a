"""Runs that are stopped, killed, out of disk or without input, and continued with --resume."""

from __future__ import annotations

import json
import os
import random
import resource
import subprocess
import sys
from pathlib import Path

import dask.array as da
import numpy as np
import pytest
import xarray as xr

from gyrostab import davar, fit_noise, make_log, open_product, to_netcdf
from gyrostab.allan.davar import davar_part, davar_parts
from gyrostab.cli import main
from gyrostab.io.opening import open_log
from gyrostab.jobs import checkpoint, engine
from gyrostab.jobs.job import job_folder, lock_job
from gyrostab.time.grid import time_coordinate
from tests.support.crashing import WINDOW, WINDOW_OPTIONS

PARTS = 5


def write_log(path: Path) -> Path:
    """White noise of one axis for `PARTS` units of work, with a gap and a slow temperature."""
    rng = np.random.default_rng(7)
    rate = 5.0 + rng.standard_normal((1, 1_270_000))
    rate[:, 500_000:530_000] = np.nan
    log = make_log(rate, rate=100.0, unit="deg/h", start="2026-05-01")
    stamps = log["time"].values[::100]
    log = log.assign_coords(time_temperature=stamps)
    log["temperature"] = (
        "time_temperature",
        20.0 + np.arange(stamps.size) / 1000.0,
        {"units": "degree_Celsius"},
    )
    return to_netcdf(log, path)


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "tool.nc")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setitem(davar_parts.__kwdefaults__, "samples", 1)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")


def call(*arguments: object) -> int:
    return main(["run", *(str(argument) for argument in (*arguments, *WINDOW_OPTIONS))])


@pytest.fixture(scope="module")
def whole(log, tmp_path_factory) -> bytes:
    """The product of a run that nothing disturbs."""
    path = tmp_path_factory.mktemp("whole") / "product.nc"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(davar_parts.__kwdefaults__, "samples", 1)
        patch.setenv("SOURCE_DATE_EPOCH", "1700000000")
        assert call(log, "-o", path) == 0
    return path.read_bytes()


@pytest.fixture
def after_two(monkeypatch):
    """Let something happen once two parts are on disk."""

    def plan(event) -> None:
        done = []

        def write(*arguments, **options):
            if len(done) == 2:
                event()
            done.append(checkpoint.write_block(*arguments, **options))
            return done[-1]

        monkeypatch.setattr(engine, "write_block", write)
        monkeypatch.setattr(engine, "_MAX_HELD_SECONDS", 0.0)

    return plan


@pytest.fixture
def computed(monkeypatch) -> list[slice]:
    """The parts that are computed from now on."""
    parts: list[slice] = []

    def counted(log, part, windows, fitting, space=None):
        parts.append(part)
        return engine.compute_part(log, part, windows, fitting, space)

    monkeypatch.setattr("gyrostab.jobs.run.compute_part", counted)
    return parts


def stop() -> None:
    raise KeyboardInterrupt


def one_message(captured) -> str:
    lines = [
        line
        for line in captured.err.splitlines()
        if not (line.startswith("note: ") or line.endswith(" ..."))
    ]
    assert len(lines) == 1, captured.err
    assert "Traceback" not in captured.err
    return lines[0]


@pytest.fixture
def stopped(log, after_two, tmp_path, capfd, monkeypatch) -> Path:
    """An output whose run was stopped with two of its parts done."""
    after_two(stop)
    output = tmp_path / "product.nc"
    assert call(log, "-o", output) == 3
    message = one_message(capfd.readouterr())
    assert f"2 of {PARTS} parts (40 %) are kept" in message
    assert "--resume" in message
    assert not output.exists()
    monkeypatch.setattr(engine, "write_block", checkpoint.write_block)
    return output


# ------------------------------------------------------------------------------
# the parts


def test_parts_are_cuts_of_the_whole_bit_for_bit():
    rng = np.random.default_rng(3)
    values = rng.standard_normal((2, 700_000)).cumsum(axis=1)
    values[0, 100_000:180_000] = np.nan
    values[1, 555_555] = np.nan
    log = make_log(
        values,
        rate=300.0,
        unit="deg/h",
        start="2026-05-01T00:00:00.1",
        channels={"temperature": (values[0] / 1e4, "degC")},
    )
    options = {"window": "1500samples", "step": "700samples", "taus": 9}
    surface = davar(log.chunk({"time": 99_999}), **options).compute()
    parts = davar_parts(log, samples=1, **options)
    assert len(parts) == 3
    assert parts[-1].stop == surface.sizes["time"]
    for part in [*parts, slice(370, 380), slice(0, 1), slice(5, surface.sizes["time"])]:
        cut = davar_part(log.chunk({"time": 77_777}), part=part, **options)
        xr.testing.assert_identical(cut, surface.isel(time=part))


@pytest.mark.parametrize(("hours", "workers"), [(12, 2), (24, 2), (100, 2), (100, 4)])
def test_workers_that_share_the_parts_end_at_about_the_same_time(hours, workers):
    attrs = make_log(np.zeros(4), rate=400.0, unit="deg/h").attrs
    lazy = xr.Dataset(
        {
            "rate": (
                ("axis", "time"),
                da.zeros((3, hours * 1_440_000), chunks=480_000),
                {"units": "degree hour-1"},
            )
        },
        {"axis": list("xyz")}, attrs,
    ).assign_coords(time_coordinate(0, 400.0, hours * 1_440_000))  # fmt: skip
    parts = davar_parts(lazy, samples=2**24, window="10min", step="1min")
    sizes = [part.stop - part.start for part in parts]
    assert sum(sizes) == parts[-1].stop
    busy = [0] * workers
    for size in sizes:  # each goes to the worker that is free first
        busy[busy.index(min(busy))] += size
    assert max(busy) < 1.1 * sum(sizes) / workers
    assert len(parts) < 0.27 * hours + 4  # what two parts share is read twice


def test_a_run_makes_what_the_functions_make(log, whole, tmp_path):
    (tmp_path / "run.nc").write_bytes(whole)
    product = fit_noise(davar(open_log(log), **WINDOW)).compute()
    with open_product(tmp_path / "run.nc") as made:
        assert made.attrs["gyrostab_job"].startswith("sha256:")
        xr.testing.assert_equal(made, product)


@pytest.mark.parametrize(
    "options",
    [
        ("--workers", 1),
        ("--workers", 3),
        # as the workers of a dask scheduler, which make the same bytes
        pytest.param(("--scheduler", "processes", "--workers", 2), marks=pytest.mark.slow),
    ],
)
def test_workers_do_not_change_a_byte(log, whole, tmp_path, options):
    assert call(log, "-o", tmp_path / "product.nc", *options) == 0
    assert (tmp_path / "product.nc").read_bytes() == whole
    assert [path.name for path in tmp_path.iterdir()] == ["product.nc"]


# ------------------------------------------------------------------------------
# stopped and continued


def test_resume_computes_the_rest_only(stopped, log, whole, computed):
    assert call(log, "-o", stopped, "--resume") == 0
    assert len(computed) == PARTS - 2
    assert stopped.read_bytes() == whole
    assert [path.name for path in stopped.parent.iterdir()] == [stopped.name]


def test_without_resume_an_unfinished_run_is_not_touched(stopped, log, whole, computed, capfd):
    assert call(log, "-o", stopped) == 2
    message = one_message(capfd.readouterr())
    assert "begun and not finished" in message
    assert "--resume" in message
    assert "--overwrite" in message
    assert call(log, "-o", stopped, "--overwrite") == 0
    assert len(computed) == PARTS
    assert stopped.read_bytes() == whole


@pytest.mark.parametrize("damage", ["altered", "cut", "empty"])
def test_a_damaged_block_is_computed_again(stopped, log, whole, computed, damage):
    block = sorted(job_folder(stopped).glob("*.block"))[0]
    content = bytearray(block.read_bytes())
    content[len(content) // 2] ^= 1
    block.write_bytes({"altered": bytes(content), "cut": content[:-40], "empty": b""}[damage])
    assert call(log, "-o", stopped, "--resume") == 0
    assert len(computed) == PARTS - 1
    assert stopped.read_bytes() == whole


def test_resume_of_nothing_begins_and_of_the_complete_does_nothing(
    log, whole, computed, tmp_path, capfd
):
    output = tmp_path / "product.nc"
    assert call(log, "-o", output, "--resume") == 0
    assert (len(computed), output.read_bytes()) == (PARTS, whole)
    before = output.stat()
    assert call(log, "-o", output, "--resume") == 0
    assert "complete already" in capfd.readouterr().err
    assert len(computed) == PARTS
    assert output.stat().st_mtime_ns == before.st_mtime_ns
    assert call(log, "-o", output, "--resume", "--terms", "N") == 2
    assert "not the product of these logs and options" in capfd.readouterr().err
    assert call(log, "-o", output) == 2
    assert "exists already" in capfd.readouterr().err


def test_resume_remembers_that_the_old_product_may_go(
    log, whole, after_two, tmp_path, monkeypatch, capfd
):
    output = tmp_path / "product.nc"
    output.write_text("old")
    after_two(stop)
    assert call(log, "-o", output, "--overwrite") == 3
    assert output.read_text() == "old"
    monkeypatch.setattr(engine, "write_block", checkpoint.write_block)
    assert call(log, "-o", output, "--resume") == 0
    assert output.read_bytes() == whole


# ------------------------------------------------------------------------------
# what has changed


def _touched(path: Path) -> None:
    os.utime(path, ns=(1, 1_600_000_000_000_000_000))


def _longer(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"\0" * 10)


def test_changes_refuse_to_resume_and_say_what(log, tmp_path, after_two, monkeypatch, capfd):
    own = tmp_path / "b.nc"
    own.write_bytes(log.read_bytes())
    stamp, size = own.stat().st_mtime_ns, own.stat().st_size
    output = tmp_path / "product.nc"
    after_two(stop)
    assert call(own, "-o", output) == 3
    monkeypatch.setattr(engine, "write_block", checkpoint.write_block)

    def refused(*options: object, expected: str, logs: tuple[Path, ...] = (own,)) -> None:
        capfd.readouterr()
        assert call(*logs, "-o", output, "--resume", *options) == 2
        message = one_message(capfd.readouterr())
        assert "cannot be continued" in message
        assert expected in message, message

    refused("--tau-max", "5s", expected="tau_max is 5s, was not given")
    refused("--terms", "NB", expected="fit terms is NB, was QNBKR")
    refused("--rate", "100", expected="rate is 100.0, was not given")
    refused(expected="a.nc is given now and was not before", logs=(own, tmp_path / "a.nc"))
    _touched(own)
    refused(expected="b.nc has changed: written 2020-09-13")
    _longer(own)
    refused(expected=f"b.nc has changed: {size + 10} bytes, was {size}")
    own.write_bytes(log.read_bytes())
    os.utime(own, ns=(stamp, stamp))
    with monkeypatch.context() as patch:
        patch.setattr("gyrostab.jobs.job.find_version", lambda name: "9.9.9")
        refused(expected="gyrostab is 9.9.9, was ")
    assert call(own, "-o", output, "--resume") == 0


def test_a_log_is_not_mistaken_for_a_file_of_channels(tmp_path, capfd):
    log, probe, output = tmp_path / "a.csv", tmp_path / "probe.csv", tmp_path / "q.nc"
    values = np.random.default_rng(7).standard_normal(3_000)
    rows = "".join(f"{i / 50:.2f},{value:.3f}\n" for i, value in enumerate(values.tolist()))
    log.write_text("time [s],gyro_x [deg/h]\n" + rows)
    probe.write_text(
        "time [s],gyro_x [deg/h],temperature [degC]\n"
        + "".join(f"{i + 60:.2f},0.5,{20 + i}\n" for i in range(60))
    )
    windows = ["-o", str(output), "--window", "10s", "--step", "10s"]
    assert main(["run", str(log), str(probe), *windows]) == 0
    before = output.read_bytes()
    capfd.readouterr()
    with_channel = ["run", str(log), "--channel", str(probe), *windows]
    assert main([*with_channel, "--resume"]) == 2
    assert "is not the product of these logs and options" in one_message(capfd.readouterr())
    assert output.read_bytes() == before
    assert main([*with_channel, "--overwrite"]) == 0
    capfd.readouterr()
    assert main([*with_channel, "--resume"]) == 0
    assert "complete already" in capfd.readouterr().err


def test_a_zarr_store_with_a_changed_chunk_is_noticed(log, tmp_path):
    from gyrostab import to_zarr
    from gyrostab.jobs.job import describe_differences, make_fingerprint
    from gyrostab.jobs.load import check_run_options

    store = to_zarr(open_log(log), tmp_path / "run7.zarr")
    before = make_fingerprint([store], check_run_options())
    assert describe_differences(before, make_fingerprint([store], check_run_options())) == ""
    chunk = next(
        path for path in sorted((store / "rate").iterdir()) if not path.name.startswith(".")
    )
    while chunk.is_dir():
        chunk = next(chunk.iterdir())
    _touched(chunk)
    assert "run7.zarr has changed" in describe_differences(
        before, make_fingerprint([store], check_run_options())
    )


def test_an_input_that_vanishes_meanwhile(
    log, whole, tmp_path, after_two, monkeypatch, computed, capfd
):
    own, aside = tmp_path / log.name, tmp_path / "aside"
    own.write_bytes(log.read_bytes())
    os.utime(own, ns=(log.stat().st_atime_ns, log.stat().st_mtime_ns))
    output = tmp_path / "product.nc"
    monkeypatch.setattr(engine, "_MAX_HELD_SECONDS", 0.0)
    after_two(lambda: own.rename(aside))
    assert call(own, "-o", output, "--workers", 1) == 2
    message = one_message(capfd.readouterr())
    assert f"{log.name} has vanished" in message
    assert "--resume continues" in message
    assert not output.exists()
    aside.rename(own)
    monkeypatch.setattr(engine, "write_block", checkpoint.write_block)
    del computed[:]
    assert call(own, "-o", output, "--resume") == 0
    assert 0 < len(computed) < PARTS
    assert output.read_bytes() == whole


# ------------------------------------------------------------------------------
# no more room


def limit_file_size(bytes_: int) -> None:
    resource.setrlimit(
        resource.RLIMIT_FSIZE, (bytes_, resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    )


@pytest.fixture
def free_again():
    yield
    limit_file_size(resource.getrlimit(resource.RLIMIT_FSIZE)[1])


def test_no_room_for_the_first_block(log, tmp_path, free_again, capfd):
    limit_file_size(8192)
    assert call(log, "-o", tmp_path / "product.nc") == 2
    assert "cannot be written" in one_message(capfd.readouterr())
    assert list(tmp_path.iterdir()) == []


def test_no_room_for_a_later_block(
    log, whole, tmp_path, after_two, monkeypatch, free_again, computed, capfd
):
    after_two(lambda: limit_file_size(8192))
    assert call(log, "-o", tmp_path / "product.nc") == 2
    message = one_message(capfd.readouterr())
    assert "cannot be written" in message
    assert f"2 of {PARTS} parts" in message
    limit_file_size(resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    monkeypatch.setattr(engine, "write_block", checkpoint.write_block)
    del computed[:]
    assert call(log, "-o", tmp_path / "product.nc", "--resume") == 0
    assert len(computed) == PARTS - 2
    assert (tmp_path / "product.nc").read_bytes() == whole


def test_no_room_for_the_product(log, whole, tmp_path, monkeypatch, free_again, computed, capfd):
    write = to_netcdf

    def tight(*arguments, **options):
        limit_file_size(65536)
        return write(*arguments, **options)

    monkeypatch.setattr("gyrostab.jobs.run.to_netcdf", tight)
    assert call(log, "-o", tmp_path / "product.nc") == 2
    message = one_message(capfd.readouterr())
    assert "product.nc: cannot be written" in message
    assert f"{PARTS} of {PARTS} parts" in message
    limit_file_size(resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    monkeypatch.setattr("gyrostab.jobs.run.to_netcdf", write)
    del computed[:]
    assert call(log, "-o", tmp_path / "product.nc", "--resume") == 0
    assert computed == []
    assert (tmp_path / "product.nc").read_bytes() == whole


# ------------------------------------------------------------------------------
# two at once, and kills


def test_two_runs_of_one_output_at_once(log, tmp_path, capfd):
    output = tmp_path / "product.nc"
    with lock_job(job_folder(output)):
        assert call(log, "-o", output) == 2
        message = one_message(capfd.readouterr())
        assert f"process {os.getpid()}" in message
        assert "making this product now" in message
        assert call(log, "-o", output, "--overwrite", "--resume") == 2
    assert call(log, "-o", output) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("calls", "kills"),
    [
        (2, 1),
        pytest.param(4, 2, marks=pytest.mark.full),
        pytest.param(16, 8, marks=pytest.mark.full),
    ],
)
def test_killed_before_changes_of_the_disk_and_at_random(log, tmp_path, calls, kills):
    seed = random.SystemRandom().randrange(10**6)
    print(f"seed {seed}")
    arguments = [str(argument) for argument in (tmp_path, log, seed, calls, kills)]
    command = [sys.executable, "-m", "tests.support.crashing", *arguments]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=250, cwd=Path(__file__).parents[2]
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    print(result)
    assert result["wrong"] == []
    assert result["calls"] > 3 * PARTS
    assert result["kills"] >= calls

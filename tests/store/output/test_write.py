"""Outputs take their name once they are complete; what fails leaves nothing behind."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from gyrostab.errors import OutputError
from gyrostab.io.datasets import to_netcdf, to_zarr
from gyrostab.io.opening import open_surface
from gyrostab.store.output import find_foreign_item, new_output
from tests.support import synthetic


@pytest.mark.parametrize("write", [to_netcdf, to_zarr])
def test_an_existing_output_stays_without_overwrite(tmp_path, write):
    path = write(synthetic.surface(windows=3), tmp_path / "out")
    with pytest.raises(OutputError, match="exists already; give --overwrite"):
        write(synthetic.surface(windows=4), path)
    assert open_surface(path).sizes["time"] == 3
    write(synthetic.surface(windows=4), path, overwrite=True)
    assert open_surface(path).sizes["time"] == 4
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


FULL = """
import resource, sys
sys.path.insert(0, {tests!r})
from tests.support import synthetic
from gyrostab.errors import OutputError
from gyrostab.io.datasets import to_netcdf
whole = synthetic.log(samples=300_000)
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
for log in (whole, whole.chunk(time=50_000)):
    try:
        to_netcdf(log, "out.nc", overwrite=True)
    except OutputError as error:
        print(error)
"""


@pytest.mark.slow
def test_a_full_disk_leaves_the_old_file_and_one_message(tmp_path):
    """Logs in memory and lazy ones."""
    (tmp_path / "out.nc").write_text("old")
    code = FULL.format(tests=str(Path(__file__).parents[3]))
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.stderr == ""
    messages = done.stdout.splitlines()
    assert len(messages) == 2
    for message in messages:
        assert message.startswith("out.nc: cannot be written: ")
        assert "disk full" in message
    assert [p.name for p in tmp_path.iterdir()] == ["out.nc"]
    assert (tmp_path / "out.nc").read_text() == "old"


def test_unwritable_directory():
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o555)
    root = os.geteuid() == 0
    try:
        if root:
            os.seteuid(65534)  # root may write anywhere; nobody may not
        with (
            pytest.raises(OutputError, match="no permission to write in"),
            new_output(folder / "out.nc"),
        ):
            pass
    finally:
        if root:
            os.seteuid(0)
        shutil.rmtree(folder)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_interruption_leaves_nothing_behind(tmp_path, error):
    def fail(block):
        raise error

    surface = synthetic.surface(windows=4).chunk(time=2)
    surface["avar"] = surface.avar.copy(
        data=surface.avar.data.map_blocks(fail, dtype=float, meta=np.empty((0, 0, 0)))
    )
    for write in (to_netcdf, to_zarr):
        with pytest.raises(error):
            write(surface, tmp_path / "out")
        assert not list(tmp_path.iterdir())


def test_a_late_piece_of_a_directory_is_removed_too(tmp_path, monkeypatch):
    """A worker thread may still write after another one has failed; here between two checks."""
    late = ["first", "second", "third"]

    def write_on(seconds):
        if late and len(looks) % 4 == 0:
            folder.mkdir(exist_ok=True)
            (folder / late.pop()).touch()
        looks.append(seconds)

    looks: list[float] = []
    monkeypatch.setattr("gyrostab.store.output.write.time.sleep", write_on)
    with (
        pytest.raises(ZeroDivisionError),
        new_output(tmp_path / "out.zarr", find_foreign=find_foreign_item) as folder,
    ):
        raise ZeroDivisionError
    assert not late
    assert not list(tmp_path.iterdir())
    assert sum(looks[-13:]) > 0.25  # what was not back after so long does not come any more


def test_output_has_the_usual_permissions(tmp_path):
    umask = os.umask(0o022)
    try:
        path = to_netcdf(synthetic.surface(windows=2), tmp_path / "out.nc")
    finally:
        os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("mode", [0o600, 0o660])
def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path, mode):
    path = to_netcdf(synthetic.surface(windows=3), tmp_path / "out.nc")
    path.chmod(mode)
    to_netcdf(synthetic.surface(windows=4), path, overwrite=True)
    assert path.stat().st_mode & 0o777 == mode


def test_a_store_that_is_replaced_keeps_its_permissions(tmp_path):
    path = to_zarr(synthetic.surface(windows=3), tmp_path / "out.zarr")
    path.chmod(0o700)
    to_zarr(synthetic.surface(windows=4), path, overwrite=True)
    assert path.stat().st_mode & 0o777 == 0o700


def test_a_file_is_private_while_it_is_written(tmp_path):
    (tmp_path / "out.txt").write_text("old")
    (tmp_path / "out.txt").chmod(0o400)
    with new_output(tmp_path / "out.txt", overwrite=True) as temporary:
        assert temporary.stat().st_mode & 0o777 == 0o600  # it can be written

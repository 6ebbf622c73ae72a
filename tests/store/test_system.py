"""Every call that some system lacks has a fallback; here the tests remove the calls one by one."""

import errno
import os
import subprocess
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from gyrostab import make_log, to_netcdf, to_zarr
from gyrostab.errors import OutputError, ResumeError
from gyrostab.ingest.columns.pieces import Spool
from gyrostab.jobs.job import begin_job, lock_job, remove_job
from gyrostab.store import system
from gyrostab.store.output import new_output
from gyrostab.store.output.write import _describe_reason


def test_reads_of_a_temporary_file_in_several_threads_do_not_mix():
    spool, data = Spool(), np.random.default_rng(1).standard_normal(2**13)
    columns = [spool.store(data), spool.store(-data)]
    wrong = []

    def read_pieces(offset):
        for begin in range(offset, data.size - 64, 512):
            for column, values in zip(columns, (data, -data), strict=True):
                if not np.array_equal(column[begin : begin + 64], values[begin : begin + 64]):
                    wrong.append(begin)

    threads = [threading.Thread(target=read_pieces, args=(64 * n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_folders_that_cannot_be_opened_are_not_synced(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "O_DIRECTORY")
    opened = []
    open_path = os.open

    def open_file(path, flags, *mode, **options):
        if os.path.isdir(path) and not options:
            raise PermissionError(errno.EACCES, "as on Windows", str(path))
        opened.append((os.path.basename(path), flags))
        return open_path(path, flags, *mode, **options)

    monkeypatch.setattr(os, "open", open_file)
    log = make_log(np.zeros((1, 10)), rate=1.0, unit="deg/h")
    to_netcdf(log, tmp_path / "log.nc")
    to_zarr(log, tmp_path / "log.zarr")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.nc", "log.zarr"]
    assert any(name == ".zmetadata" and flags & os.O_RDWR for name, flags in opened)


def test_the_cache_of_the_drive_is_emptied_where_a_command_does_so(tmp_path, monkeypatch):
    done = []
    fcntl = SimpleNamespace(F_FULLFSYNC=51, fcntl=lambda handle, command: done.append(command))
    monkeypatch.setattr(system, "_FCNTL", fcntl)
    (tmp_path / "note.txt").write_text("complete")
    system.sync_path(tmp_path / "note.txt")
    assert done == [51]

    def refuse(handle, command):
        raise OSError(errno.ENOTSUP, "no such command")

    fcntl.fcntl = refuse
    system.sync_path(tmp_path / "note.txt")


@pytest.mark.parametrize("has_links", [True, False])
def test_a_new_name_is_not_taken_from_another_file(tmp_path, monkeypatch, has_links):
    monkeypatch.setattr(system, "_FLAGGED_RENAMES", {})
    if not has_links:
        monkeypatch.delattr(os, "link")
    with new_output(tmp_path / "note.txt") as temporary:
        temporary.write_text("complete")
    assert os.listdir(tmp_path) == ["note.txt"]
    assert (tmp_path / "note.txt").read_text() == "complete"
    (tmp_path / "other.txt").write_text("late")
    with pytest.raises(FileExistsError):
        system.rename_new(tmp_path / "other.txt", tmp_path / "note.txt")
    (tmp_path / "folder").mkdir()
    with pytest.raises(FileExistsError):
        system.rename_new(tmp_path / "folder", tmp_path / "note.txt")
    system.rename_new(tmp_path / "folder", tmp_path / "renamed")
    assert (tmp_path / "note.txt").read_text() == "complete"


def test_a_name_that_another_process_took_meanwhile_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(system, "_FLAGGED_RENAMES", {})
    monkeypatch.setattr("gyrostab.store.output.write.check_target", lambda path, **_: path)
    (tmp_path / "note.txt").write_text("theirs")
    with (
        pytest.raises(OutputError, match="another process has made it"),
        new_output(tmp_path / "note.txt") as temporary,
    ):
        temporary.write_text("ours")
    assert (tmp_path / "note.txt").read_text() == "theirs"


@pytest.mark.skipif(sys.platform == "win32", reason="a program that Windows does not have")
def test_the_flags_of_macos_are_its_own(tmp_path, monkeypatch):
    calls = []
    library = SimpleNamespace(renamex_np=lambda *arguments: calls.append(arguments) or 0)
    monkeypatch.setattr(system.sys, "platform", "darwin")
    monkeypatch.setattr(system.ctypes, "CDLL", lambda *_, **__: library)
    assert system.exchange_paths(tmp_path / "a", tmp_path / "b")
    assert system.rename_with_flag(tmp_path / "a", tmp_path / "b", system.NO_REPLACE)
    first, second = os.fsencode(tmp_path / "a"), os.fsencode(tmp_path / "b")
    assert calls == [(first, second, 2), (first, second, 4)]


class WindowsLocks:
    """As much of the module msvcrt as is used; the locks belong to open files."""

    LK_NBLCK = 2

    def __init__(self):
        self.locked = {}

    def locking(self, handle, mode, count):
        assert os.lseek(handle, 0, os.SEEK_CUR) > 1000
        file = os.fstat(handle).st_ino
        owner = self.locked.get(file)
        if owner is not None and owner != handle:
            try:
                if os.fstat(owner).st_ino == file:
                    raise PermissionError(errno.EACCES, "locked")
            except PermissionError:
                raise
            except OSError:  # closed, which ends the lock
                pass
        self.locked[file] = handle


@pytest.mark.parametrize("locks", [WindowsLocks(), None])
def test_a_job_folder_is_locked_as_far_as_the_system_can(tmp_path, monkeypatch, locks):
    monkeypatch.setattr(system, "_FCNTL", None)
    monkeypatch.setattr(system, "_MSVCRT", locks)
    folder = tmp_path / ".product.nc.job"
    with lock_job(folder):
        if locks:
            with pytest.raises(ResumeError, match=rf"process {os.getpid()} on"), lock_job(folder):
                pass
        begin_job(folder, {"inputs": [], "options": {}, "versions": {}}, parts=1, overwrite=False)
    with lock_job(folder):  # it ended with the block
        remove_job(folder, output=tmp_path / "product.nc")
    assert list(tmp_path.iterdir()) == []


def test_an_open_lock_that_cannot_be_removed_goes_once_it_is_closed(tmp_path, monkeypatch):
    folder, is_open = tmp_path / ".product.nc.job", True
    unlink = type(folder).unlink

    def unlink_closed(path, missing_ok=False):
        if path.name == "lock" and is_open:
            raise PermissionError(errno.EACCES, "open, as on Windows", str(path))
        unlink(path, missing_ok=missing_ok)

    close = os.close

    def close_lock(handle):
        nonlocal is_open
        close(handle)
        is_open = False

    monkeypatch.setattr(type(folder), "unlink", unlink_closed)
    monkeypatch.setattr("gyrostab.jobs.job._REMOVES_OPEN_FILES", False)
    monkeypatch.setattr(os, "close", close_lock)
    with lock_job(folder):
        remove_job(folder, output=tmp_path / "product.nc")
        assert (folder / "lock").exists()
    assert not folder.exists()


def test_a_file_that_is_open_in_another_program_is_named_as_the_reason(tmp_path):
    error = PermissionError(errno.EACCES, "Access is denied")
    error.winerror = 32
    assert "open in another program" in _describe_reason(error, tmp_path / "product.nc")


def test_the_package_needs_no_module_that_windows_lacks():
    code = (
        "import sys\n"
        "for name in ('fcntl', 'resource', 'pwd', 'grp', 'termios'): sys.modules[name] = None\n"
        "import gyrostab.jobs.run, gyrostab.cli, gyrostab.io.datasets\n"
    )
    # find_spec raises ValueError for a module that is blocked so
    code = code.replace(
        "import sys\n",
        "import sys, importlib.util\nspec = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *a: None if name == 'fcntl' else spec(name, *a)\n",
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr[-2000:]

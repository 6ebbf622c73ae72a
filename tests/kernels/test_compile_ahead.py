"""Another process compiles, once; whoever needs its kernels waits, and a failure is no error."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from numba.core import event

from gyrostab.kernels import compile_ahead
from gyrostab.kernels.compile_ahead import WAITING, await_compilation, start_compilation
from gyrostab.progress import show_progress

VERSION = f"py{sys.version_info[0]}{sys.version_info[1]}"
#: A module that takes a moment, and tells that it was there.
CODE = "import time, pathlib; time.sleep(0.5); pathlib.Path({place!r}).write_text('done')\n"


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that the module ``slow_module`` writes."""
    place = tmp_path / "written"
    (tmp_path / "slow_module.py").write_text(CODE.format(place=str(place)))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    return place


def kernel_with_cache(folder: Path) -> SimpleNamespace:
    function = SimpleNamespace(__code__=SimpleNamespace(co_firstlineno=12))
    stats = SimpleNamespace(cache_path=str(folder))
    return SimpleNamespace(__name__="solve", py_func=function, stats=stats)


def test_a_process_is_started_and_awaited_with_notice(
    module: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / f"solvers.solve-11.{VERSION}.nbi").touch()  # of an earlier source
    start_compilation("slow_module", kernel_with_cache(tmp_path))
    assert not module.exists()
    with show_progress() as stage, event.install_recorder(WAITING) as recorder:
        stage("fitting")
        await_compilation()
        assert module.read_text() == "done"
        await_compilation()
    assert [heard.is_start for _, heard in recorder.buffer] == [True, False]
    assert capsys.readouterr().err.startswith("fitting ...\ncompiling, once after installation")


@pytest.mark.parametrize("case", ["in cache", "no cache", "no compiler", "one core"])
def test_nothing_is_started(case: str, module: Path, tmp_path: Path, monkeypatch) -> None:
    kernel = kernel_with_cache(tmp_path)
    if case == "in cache":
        (tmp_path / f"solvers.solve-12.{VERSION}.nbi").touch()
    elif case == "no cache":
        kernel.stats.cache_path = None
    elif case == "no compiler":
        del kernel.stats
    else:
        monkeypatch.setattr(os, "cpu_count", lambda: 1)
    start_compilation("slow_module", kernel)
    await_compilation()
    assert not module.exists()


def test_another_kernel_in_the_cache_does_not_count(module: Path, tmp_path: Path) -> None:
    for name in (f"solvers.solve_all-12.{VERSION}.nbi", "solvers.solve-12.py27.nbi"):
        (tmp_path / name).touch()
    start_compilation("slow_module", kernel_with_cache(tmp_path))
    await_compilation()
    assert module.exists()


def test_one_process_runs_at_a_time(
    module: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    running: list[object] = []
    monkeypatch.setattr(compile_ahead, "_running", running)
    for _ in range(2):
        start_compilation("slow_module", kernel_with_cache(tmp_path))
    assert len(running) == 1
    await_compilation()
    start_compilation("slow_module", kernel_with_cache(tmp_path))
    assert len(running) == 2
    await_compilation()
    assert module.exists()


def test_a_process_that_fails_is_ignored(module: Path, tmp_path: Path) -> None:
    start_compilation("no_such_module", kernel_with_cache(tmp_path))
    await_compilation()
    assert not module.exists()


def test_several_threads_wait_for_the_same_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another thread ends its wait between two steps of this one."""

    class Interrupted(list):
        searches = 0

        def __contains__(self, process: object) -> bool:
            is_in = super().__contains__(process)
            self.searches += 1
            if self.searches == 1:
                await_compilation()
            return is_in

    ended = SimpleNamespace(poll=lambda: 0)
    monkeypatch.setattr(compile_ahead, "_running", Interrupted([ended]))
    await_compilation()

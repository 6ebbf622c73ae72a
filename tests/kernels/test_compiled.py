"""Compiled code of an earlier source is not used."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gyrostab.kernels.compiled import delete_stale_code

CALLEE = "from numba import njit\n@njit(cache=True)\ndef value():\n    return {}\n"
CALLER = """from pathlib import Path
from numba import njit
from gyrostab.kernels.compiled import delete_stale_code
delete_stale_code(Path(__file__).parent)
from callee import value
@njit(cache=True)
def twice():
    return 2 * value()
print(twice())
"""


def run_caller(folder: Path) -> str:
    command = [sys.executable, str(folder / "caller.py")]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_a_changed_callee_is_compiled_into_its_caller(tmp_path: Path) -> None:
    (tmp_path / "caller.py").write_text(CALLER)
    for value in (1, 2):
        (tmp_path / "callee.py").write_text(CALLEE.format(value))
        os.utime(tmp_path / "callee.py", (1e9 + value, 1e9 + value))
        assert run_caller(tmp_path) == str(2 * value)
        assert list((tmp_path / "__pycache__").glob("*.nbi"))


def test_code_of_unchanged_sources_is_kept(tmp_path: Path) -> None:
    source, compiled = tmp_path / "sums.py", tmp_path / "allan" / "__pycache__" / "sums.nbi"
    source.touch()
    delete_stale_code(tmp_path)
    compiled.parent.mkdir(parents=True)
    compiled.touch()
    delete_stale_code(tmp_path)
    assert compiled.exists()
    source.write_text("changed")
    delete_stale_code(tmp_path)
    assert not compiled.exists()
    assert not list(tmp_path.rglob("sources.[0-9]*"))


@pytest.mark.parametrize("folder", ["absent", "archive.zip/kernels"])
def test_a_folder_that_cannot_be_written_is_left_alone(tmp_path: Path, folder: str) -> None:
    (tmp_path / "archive.zip").touch()
    delete_stale_code(tmp_path / folder)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["archive.zip"]

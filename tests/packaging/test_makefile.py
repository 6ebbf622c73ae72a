"""An installation of a checkout does not keep the compiled code of an earlier source."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

MAKEFILE = Path(__file__).resolve().parents[2] / "Makefile"


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_changed_kernel_deletes_the_compiled_ones(tmp_path: Path) -> None:
    shutil.copy(MAKEFILE, tmp_path)
    cached = tmp_path / "gyrostab/kernels/__pycache__/sums.nbi"
    source, installed, project = (
        tmp_path / name
        for name in ("gyrostab/kernels/sums.py", ".venv/.installed", "pyproject.toml")
    )
    for place in (cached, source, installed, project):
        place.parent.mkdir(parents=True, exist_ok=True)
    for time, place in enumerate((project, source, installed.with_name(".kernels"), installed)):
        place.touch()
        os.utime(place, (1e9 + time, 1e9 + time))
    for changed in (False, True):
        cached.touch()
        if changed:
            source.touch()
        subprocess.run(["make", "-s", ".venv/.installed"], cwd=tmp_path, check=True)
        assert cached.exists() is not changed

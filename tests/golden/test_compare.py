"""The comparison reports every changed number and unit, and counts changed text."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.golden.compare import compare_folders


def write_outputs(
    folder: Path, *, value: float = 1.5, units: str = "s", statement: str = "none", code: int = 0
) -> None:
    (folder / "job").mkdir(parents=True)
    data = xr.Dataset({"a": ("x", np.array([value, np.nan]), {"units": units})})
    data.to_netcdf(folder / "job" / "out.nc")
    diagnosis = {
        "effects": [{"value": value, "statement": statement}],
        "seconds": np.random.default_rng().random(),
    }
    (folder / "job" / "diagnosis.json").write_text(json.dumps(diagnosis))
    (folder / "job" / "00-run.txt").write_text(f"exit {code}\nprinted\n")


@pytest.mark.parametrize(
    ("change", "rtol", "differences", "texts"),
    [
        ({}, 0.0, [], 0),
        (
            {"value": 1.5 + 1e-12},
            0.0,
            ["diagnosis.json: .effects[0].value", "out.nc: a: values"],
            0,
        ),
        ({"value": 1.5 + 1e-12}, 1e-9, [], 0),
        (
            {"value": 1.5 + 1e-6},
            1e-9,
            ["diagnosis.json: .effects[0].value", "out.nc: a: values"],
            0,
        ),
        ({"units": "min"}, 0.0, ["out.nc: a: attributes"], 1),
        ({"statement": "other words"}, 0.0, [], 1),
        ({"code": 2}, 0.0, ["00-run.txt: exit 0 became exit 2"], 0),
    ],
)
def test_changes_are_reported(tmp_path, change, rtol, differences, texts):
    write_outputs(tmp_path / "before")
    write_outputs(tmp_path / "after", **change)
    lines, in_text = compare_folders(tmp_path / "before", tmp_path / "after", ["job"], rtol=rtol)
    assert len(lines) == len(differences)
    assert all(any(f"job: {text}" in line for line in lines) for text in differences)
    assert in_text == texts


def test_a_missing_output_is_reported(tmp_path):
    for name in ("before", "after"):
        write_outputs(tmp_path / name)
    (tmp_path / "after" / "job" / "out.nc").unlink()
    lines, _ = compare_folders(tmp_path / "before", tmp_path / "after", ["job"], rtol=0.0)
    assert lines == ["job: out.nc is in one of both only"]

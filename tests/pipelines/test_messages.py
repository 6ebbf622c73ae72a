"""A pipeline that lacks a file ends with one message."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT


def run_pipeline(name: str, plan: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(sys, "argv", [name, str(plan)])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(ROOT / "pipelines" / name), run_name="__main__")
    return str(stopped.value)


@pytest.mark.parametrize("name", ["archive.py", "temperature_chain.py"])
def test_a_plan_that_does_not_exist_is_named(name, tmp_path, monkeypatch):
    message = run_pipeline(name, tmp_path / "missing.toml", monkeypatch)
    assert "No such file" in message
    assert "missing.toml" in message


def test_a_product_that_does_not_exist_is_named(tmp_path, monkeypatch):
    plan = tmp_path / "plan.toml"
    plan.write_bytes((ROOT / "pipelines" / "temperature_chain.toml").read_bytes())
    assert "product.nc: there is no such file" in run_pipeline(
        "temperature_chain.py", plan, monkeypatch
    )

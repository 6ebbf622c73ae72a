"""The settings of the diagnosis: documented, recorded, and without a copy in a module."""

from __future__ import annotations

import ast
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from gyrostab.diagnose.nulls.scores import fit_best_evidence
from gyrostab.diagnose.result.verdict import failed_checks
from gyrostab.diagnose.settings import DEFAULTS, Settings, stored_settings

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_lists_every_setting_with_its_source() -> None:
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"<!-- table: begin -->\n(.*)\n<!-- table: end -->", page, re.DOTALL)
    assert table == Settings.table()


def test_every_setting_has_unit_meaning_and_source() -> None:
    assert len(fields(Settings)) < 80
    for item in fields(Settings):
        assert all(item.metadata[key].strip() for key in ("unit", "meaning", "source")), item.name


def test_every_setting_is_used() -> None:
    used = {
        node.attr
        for path in (ROOT / "gyrostab" / "diagnose").rglob("*.py")
        if path.name != "settings.py"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute)
    }
    assert {item.name for item in fields(Settings)} <= used


def test_a_setting_changes_the_decision() -> None:
    held = {"log_likelihood_gain": 9.0, "forecast_gain": 2.0}
    held |= {"coverage95_before": 0.95, "coverage95_after": 0.93}
    assert failed_checks(held)
    assert not failed_checks(held, settings=Settings(coverage_tolerance=0.03))
    best = np.sort(np.random.default_rng(1).exponential(size=400))
    wide = fit_best_evidence(best, settings=Settings(tail_share=0.1)).value_at(0.2)
    assert wide == np.quantile(best, 0.8)  # no extrapolation within the sample


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_impossible_numbers_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="ambiguous_nats"):
        replace(DEFAULTS, ambiguous_nats=value)


def test_settings_of_another_version_are_read():
    other = {**Settings(coverage_tolerance=0.03).to_dict(), "a_number_of_the_future": 7.0}
    del other["tail_share"]
    assert stored_settings(other) == Settings(coverage_tolerance=0.03)

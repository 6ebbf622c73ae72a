"""Check a file with the compliance checker of IOOS, in this process: starting it takes seconds."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from compliance_checker.cf import util
from compliance_checker.runner import CheckSuite, ComplianceChecker

#: Functions of the checker that search all variables of a file, and are called thousands of times.
_SEARCHES = (
    "get_auxiliary_coordinate_variables",
    "get_axis_variables",
    "get_latitude_variables",
    "get_longitude_variables",
    "get_time_variables",
    "get_z_variables",
)
_load_checkers = cache(CheckSuite.load_all_available_checkers)


def assert_follows_cf(path: Path) -> None:
    """Check that a file follows CF 1.11 strictly, without any remark and without the network."""
    _load_checkers()
    report = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(report):
        for name in ("http_proxy", "https_proxy"):
            patch.setenv(name, "http://127.0.0.1:9")
        for name in _SEARCHES:
            patch.setattr(util, name, _remember_result(getattr(util, name)))
        passed, failed = ComplianceChecker.run_checker([str(path)], ["cf:1.11"], 0, "strict")
    assert "All tests passed!" in report.getvalue(), report.getvalue()
    assert passed
    assert not failed


def _remember_result(search: Callable[[Any], list[str]]) -> Callable[[Any], list[str]]:
    """Search an open file once; every caller gets a copy of the result, which it may change."""
    remembered = cache(search)
    return lambda dataset: list(remembered(dataset))

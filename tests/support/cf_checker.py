"""Check a file with the compliance checker of IOOS, in this process: starting it takes seconds."""

from __future__ import annotations

import contextlib
import io
from functools import cache
from pathlib import Path

import pytest
from compliance_checker.runner import CheckSuite, ComplianceChecker

_load_checkers = cache(CheckSuite.load_all_available_checkers)


def assert_follows_cf(path: Path) -> None:
    """Check that a file follows CF 1.11 strictly, without any remark and without the network."""
    _load_checkers()
    report = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(report):
        for name in ("http_proxy", "https_proxy"):
            patch.setenv(name, "http://127.0.0.1:9")
        passed, failed = ComplianceChecker.run_checker([str(path)], ["cf:1.11"], 0, "strict")
    assert "All tests passed!" in report.getvalue(), report.getvalue()
    assert passed
    assert not failed

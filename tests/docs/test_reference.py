"""The reference describes every public function: parameters, result and a running example."""

from __future__ import annotations

import doctest
import inspect
import re
from pathlib import Path

import pytest

import gyrostab

API = Path(__file__).resolve().parents[2] / "docs" / "reference" / "api.md"
NAMES = sorted({*gyrostab.__all__} - {"__version__"})
#: Functions whose examples need a recording or take minutes.
LONG = {"diagnose", "prove", "write_diagnosis"}


def section(text: str, title: str) -> str:
    """Return the text of a section of a numpydoc docstring."""
    match = re.search(rf"(?ms)^{title}\n-+\n(.*?)(?=^\w[\w ]*\n---|\Z)", text)
    return match[1] if match else ""


def test_the_page_lists_every_public_name_once():
    listed = re.findall(r"(?m)^   ([a-z0-9_]+)$", API.read_text(encoding="utf-8"))
    assert sorted(listed) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_public_function_describes_its_parameters_and_result(name):
    function = getattr(gyrostab, name)
    text = inspect.getdoc(function) or ""
    lines = re.findall(r"(?m)^(\*{0,2}[a-zA-Z_][\w, *]*)(?: :.*)?$", section(text, "Parameters"))
    described = [part.strip(" *") for line in lines for part in line.split(",")]
    assert described == list(inspect.signature(function).parameters)
    assert section(text, "Returns")


@pytest.mark.parametrize("name", NAMES)
def test_a_public_function_has_an_example_that_runs(name):
    examples = doctest.DocTestParser().get_examples(inspect.getdoc(getattr(gyrostab, name)) or "")
    assert examples
    skipped = [doctest.SKIP in example.options for example in examples]
    assert any(skipped) == (name in LONG)

"""Wording and names follow docs/glossary.md."""

from __future__ import annotations

import pytest

from tests import language


def test_no_wording_that_the_glossary_replaces():
    findings = language.find_all(list(language.PLACES))
    assert not findings, "\n".join(f"{item.path}:{item.line}: {item.text}" for item in findings)


def test_private_functions_have_a_verb_and_an_object():
    single, total = language.single_word_share(language.ROOT / "gyrostab")
    assert single <= language.MAX_SINGLE_WORD_SHARE * total


@pytest.mark.parametrize(
    "text",
    [
        "The line stands out of the noise.",
        "It is told by its spectrum.",
        "A phrase that goes\n    with the line break.",
        "This is no filter.",
        "The odd samples of a block.",
        "First sentence. So the rest follows.",
    ],
)
def test_finds_replaced_wording(tmp_path, text):
    path = tmp_path / "page.py"
    path.write_text(f'"""{text}"""\n', encoding="utf-8")
    assert [finding.line for finding in language.find_phrases(path, "page.py")] != []


@pytest.mark.parametrize(
    "text",
    [
        "There is no gap, and there are none.",
        "The window slides along the record.",
        "Has it been moved? It is no longer there.",
        "So far, so good. Of course.",
        "A name in backticks: `salt`, ``odd samples``.",
        ">>> text = 'this is no filter'",
        "The file claims more rows than it holds, in four views.",
    ],
)
def test_accepts_plain_english(tmp_path, text):
    path = tmp_path / "page.py"
    path.write_text(f'"""{text}"""\n', encoding="utf-8")
    assert list(language.find_phrases(path, "page.py")) == []


def test_finds_old_names_and_long_lines(tmp_path):
    code, page = tmp_path / "code.py", tmp_path / "page.md"
    code.write_text("def _salted_log():\n    pass\n", encoding="utf-8")
    page.write_text("word " * 30 + "\n| " + "cell " * 30 + "|\n", encoding="utf-8")
    assert [finding.line for finding in language.find_names(code, "code.py")] == [1]
    assert [finding.line for finding in language.find_long_lines(page, "page.md")] == [1]


@pytest.mark.parametrize("code", ["for one in names: pass", "def fit(found): pass", "here = 2"])
def test_finds_variables_named_by_their_role(tmp_path, code):
    path = tmp_path / "code.py"
    path.write_text(f"named = oneself = 1\n{code}\n", encoding="utf-8")
    assert [finding.line for finding in language.find_role_words(path, "code.py")] == [2]


def test_finding_has_the_line_of_the_phrase(tmp_path):
    path = tmp_path / "page.md"
    path.write_text("# Title\n\nFirst line\nof a paragraph beside it.\n", encoding="utf-8")
    assert [finding.line for finding in language.find_phrases(path, "page.md")] == [4]

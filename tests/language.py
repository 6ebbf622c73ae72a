"""Find wording that the glossary replaces, in prose and in names.

    python -m tests.language [PATH ...]        every finding as FILE:LINE: text; exit code 1 if there is one

Checked are comments, docstrings and other strings of Python files, Markdown pages, HTML templates and TOML files, and the names of
functions and classes. Each pattern stands for a phrase that reads as translated, or for an old name of a thing that docs/glossary.md
names otherwise. `ALLOWED` lists the exceptions with their reasons.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PLACES = ("gyrostab", "pipelines", "benchmarks", "data", "docs", "README.md", "CHANGELOG.md")
MAX_MARKDOWN_COLUMNS = 120
MAX_SINGLE_WORD_SHARE = 0.15  # of the private functions

#: Phrases that are seldom the plainest choice.
PHRASES = {
    r"\b(is|are|was|were) told (by|from|apart by)\b": "say what shows it",
    r"\btells? of\b": "shows, indicates",
    r"\bstands? (beside|out|for)\b": "is next to, exceeds, means",
    r"\b(is|are|was|were) none\b": "does not exist, there is no",
    r"\b(is|are) no [a-z]+": "is not a",
    r"\bas good as none\b": "negligible",
    r"\bby (itself|themselves)\b": "automatically, alone",
    r"\bof (its|their) own\b": "separate, own",
    r"\bcomes? and goes?\b": "intermittent",
    r"\bsays? nothing (of|about)\b": "does not depend on",
    r"\bknows? (no|nothing)\b": "does not allow, does not use",
    r"\bgoes? with\b": "belongs to, varies with",
    r"\bhas it\b": "is given",
    r"\b[Ww]here [^.,;:]* there\b": "",
    r"\bbeside\b": "in addition to, next to",
    r"(?:(?<=[.:!?] )|(?<=\A))Of [a-z]": "begin with the subject",
    r"(?:(?<=[.:!?] )|(?<=\A))So [a-z]": "begin with the subject",
    r"(?:(?<=[.!?] )|(?<=\A))For [a-z]+ (is|are|has|have|it|they|the)\b": "because",
}
#: Old names of things.
OLD_WORDS = {
    r"\bsalt(ed|s|ing)?\b": "inject, injection",
    r"\bsevere?d\b": "driver withheld",
    r"\bdecoys?\b": "driver substituted",
    r"\bburied\b": "sub-threshold",
    r"\bseal(ed|s)?\b": "commit, committed",
    r"\bnaive\b": "baseline detector",
    r"\bviews?\b": "statistic",
    r"\b(explain|take)n? away\b": "condition on",
    r"\bslides?\b": "time-shifted surrogate",
    r"\blattices?\b": "quantization grid",
    r"\b(hops?|hopping|hopped)\b": "switches",
    r"\b(gliding|glides?)\b": "drifting line",
    r"\b(restless|unrest|restlessness)\b": "variance fluctuation",
    r"\bredness\b": "excess low-frequency noise",
    r"\bwitness(es)?\b": "reference channel",
    r"\bcanyons?\b": "gap bias",
    r"\btwins?\b": "reference implementation",
    r"\bkept apart\b": "held out",
    r"\b(loud|louder|loudest|loudness)\b": "noisy",
    r"\bodd samples?\b": "anomalous samples",
    r"\bclaims?\b": "identification",
    r"\bjumps? out\b": "outlier",
}
#: Words of `OLD_WORDS` that are in names of functions and classes.
OLD_NAME_WORDS = {
    "salt", "salted", "sever", "severed", "decoy", "seal", "sealed", "naive", "view", "views", "hop", "hops", "hopping",
    "gliding", "restless", "unrest", "redness", "lattice", "witness", "claim", "claims", "odd", "loud", "louder",
    "told", "twin", "slide", "slides",
}  # fmt: skip


class Allowed(NamedTuple):
    """Text in which a pattern is right, and why."""

    phrase: str
    reason: str


ALLOWED = (
    Allowed("fringe_hop", "name of an effect, fixed"),
    Allowed("fringe hop", "term of the field: a step of one fringe"),
    Allowed('"view"', "key of diagnosis.json, fixed"),
    Allowed("'view'", "key of diagnosis.json, fixed"),
    Allowed("`view`", "key of diagnosis.json, fixed"),
    Allowed(".view(", "method of numpy arrays"),
    Allowed("memoryview", "type of Python"),
)


class Finding(NamedTuple):
    """One place that does not follow the vocabulary."""

    path: str
    line: int
    text: str
    advice: str


def texts_of_python(source: str) -> Iterator[tuple[int, str]]:
    """Comments and strings, each with its first line."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("#: ")
        elif token.type in (tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", -1)):
            text = token.string
            if " " in text:
                yield token.start[0], text.strip("rbf\"'")


def texts_of(path: Path) -> Iterator[tuple[int, str]]:
    """Prose of a file by line."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        yield from texts_of_python(source)
    elif path.suffix in (".md", ".html", ".j2"):
        in_code = False
        for number, line in enumerate(source.splitlines(), 1):
            in_code ^= line.startswith("```")
            if not in_code and not line.startswith("    "):
                yield number, re.sub(r"`[^`]*`", "``", line)
    elif path.suffix == ".toml":
        for number, line in enumerate(source.splitlines(), 1):
            if "#" in line:
                yield number, line.split("#", 1)[1].strip()


def find_phrases(path: Path, name: str) -> Iterator[Finding]:
    """Phrases and old words in the prose of a file."""
    for first, text in texts_of(path):
        cleaned = text
        for allowed in ALLOWED:
            cleaned = cleaned.replace(allowed.phrase, "")
        for pattern, advice in (PHRASES | OLD_WORDS).items():
            for match in re.finditer(pattern, cleaned):
                line = first + cleaned.count("\n", 0, match.start())
                around = cleaned[max(0, match.start() - 30) : match.end() + 30].replace("\n", " ")
                yield Finding(name, line, f"...{around}...", advice)


def find_names(path: Path, name: str) -> Iterator[Finding]:
    """Old words in names of functions and classes."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            words = set(re.findall(r"[a-z]+|[A-Z][a-z]*", node.name))
            for word in sorted({word.lower() for word in words} & OLD_NAME_WORDS):
                yield Finding(name, node.lineno, f"name {node.name}", f"without {word!r}")


def find_long_lines(path: Path, name: str) -> Iterator[Finding]:
    """Lines of prose in Markdown that are too long; tables and links may be longer."""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if len(line) > MAX_MARKDOWN_COLUMNS and not line.startswith(("|", "    ", "![", "[")):
            yield Finding(name, number, f"{len(line)} columns", f"at most {MAX_MARKDOWN_COLUMNS}")


def files_in(places: list[str]) -> Iterator[Path]:
    """The files of these places that hold prose."""
    for place in places:
        path = ROOT / place
        found = [path] if path.is_file() else sorted(path.rglob("*"))
        for file in found:
            hidden = any(part.startswith(".") or part == "__pycache__" for part in file.parts)
            if file.suffix in (".py", ".md", ".html", ".j2", ".toml") and not hidden:
                yield file


def find_all(places: list[str]) -> list[Finding]:
    """Everything in these places that does not follow the vocabulary."""
    found = []
    for path in files_in(places):
        name = str(path.relative_to(ROOT))
        found += find_phrases(path, name)
        if path.suffix == ".py":
            found += find_names(path, name)
        if path.suffix == ".md":
            found += find_long_lines(path, name)
    return found


def single_word_share(folder: Path) -> tuple[int, int]:
    """How many private functions have a name of one word, and how many there are."""
    names = [
        node.name.strip("_")
        for path in files_in([str(folder)])
        if path.suffix == ".py"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef) and re.match(r"_[^_]", node.name)
    ]
    return sum("_" not in name for name in names), len(names)


def main(arguments: list[str]) -> int:
    """Print the findings; 1 if there are any."""
    found = find_all(arguments or list(PLACES))
    for finding in found:
        print(f"{finding.path}:{finding.line}: {finding.text}  [{finding.advice}]")
    single, total = single_word_share(ROOT / (arguments[0] if arguments else "gyrostab"))
    share = single / max(total, 1)
    print(
        f"{len(found)} findings; {single} of {total} private functions have a name of one word ({share:.0%})"
    )
    return int(bool(found) or share > MAX_SINGLE_WORD_SHARE)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

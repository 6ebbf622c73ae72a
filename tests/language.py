"""Find wording that the glossary replaces, in prose and in names.

    python -m tests.language [PATH ...]

It prints each finding as FILE:LINE: text, and the exit code is 1 if there is one.

The script reads the comments, docstrings and messages of Python files, Markdown pages, HTML
templates and the comments of TOML files, and the names of functions, classes and variables. It
skips code: text in backticks, doctest lines, code blocks, replacement fields of f-strings. Each
pattern is a phrase that is seldom plain English, or an old name of a thing that docs/glossary.md
now names otherwise. `ALLOWED` lists the exceptions with their reasons.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PLACES = ("gyrostab", "pipelines", "benchmarks", "data", "docs", "README.md", "CHANGELOG.md")
MAX_MARKDOWN_COLUMNS = 120
MAX_SINGLE_WORD_SHARE = 0.15  # of the private functions

SENTENCE_START = r"(?:(?<=[.:!?] )|(?<=  )|(?<=\A))"
#: Phrases that are seldom the plainest choice.
PHRASES = {
    r"\b(is|are|was|were) told (by|from|apart by)\b": "say what shows it",
    r"\btells? of\b": "shows, indicates",
    r"\bstands? (beside|out|for)\b": "is next to, exceeds, means",
    r"(?<!\b[Tt]here )\b(is|are|was|were) none\b(?! of)": "does not exist, there is no",
    r"(?<!\b[Tt]here )\b(is|are) no (?!longer|more|better|worse|less|fewer)[a-z]+": "is not a",
    r"\bas good as none\b": "negligible",
    r"\bby (itself|themselves)\b": "automatically, alone",
    r"\bof (its|their) own\b": "separate, own",
    r"\bcomes? and goes?\b": "intermittent",
    r"\bsays? nothing (of|about)\b": "does not depend on",
    r"\bknows? (no|nothing)\b": "does not allow, does not use",
    r"\bgoes? with\b": "belongs to, varies with",
    r"\bhas it\b(?! (been|not)\b)": "gives, contains",
    r"\b[Ww]here [^.,;:]* there\b(?! (is|are|was|were)\b)": "if, when",
    r"\bbeside\b": "in addition to, next to",
    rf"{SENTENCE_START}Of (?!course)[a-z]": "begin with the subject",
    rf"{SENTENCE_START}So (?!far)[a-z]": "begin with the subject",
    rf"{SENTENCE_START}For [a-z]+ (is|are|has|have|it|they|the)\b": "because",
}
#: Old names of things.
OLD_WORDS = {
    r"\bsalt(ed|s|ing)?\b": "inject, injection",
    r"\bsevere?d\b": "driver withheld",
    r"\bdecoys?\b": "driver substituted",
    r"\bburied\b": "sub-threshold",
    r"\bseal(ed|s)?\b": "commit, committed",
    r"\bnaive\b": "baseline detector",
    r"\b(explain|take)n? away\b": "condition on",
    r"\bslides?\b(?! (along|over|a window))": "time-shifted surrogate",
    r"\blattices?\b": "quantization grid",
    r"\b(hops?|hopping|hopped)\b": "switches",
    r"\b(gliding|glides?)\b": "drifting line",
    r"\b(restless|unrest|restlessness)\b": "variance fluctuation",
    r"\bredness\b": "excess low-frequency noise",
    r"\bwitness(es)?\b": "reference channel",
    r"\bcanyons?\b": "gap bias",
    r"\btwins?\b": "reference implementation",
    r"(?<!columns of one name are )\bkept apart\b": "held out",
    r"\b(loud|louder|loudest|loudness)\b": "noisy",
    r"\bodd samples?\b": "anomalous samples",
    r"\bjumps? out\b": "outlier",
}
#: Old names of things in the diagnosis and the blind test; elsewhere the words are plain English.
OLD_WORDS_OF_DIAGNOSIS = {
    r"\bviews?\b": "statistic",
    r"\bclaims?\b": "identification",
}
DIAGNOSIS = ("gyrostab/diagnose/", "gyrostab/blindtest/", "docs/diagnos", "docs/proof.md")
#: Words of `OLD_WORDS` that are in names of functions and classes.
OLD_NAME_WORDS = {
    *("salt", "salted", "sever", "severed", "decoy", "seal", "sealed", "naive"),
    *("hop", "hops", "hopping", "gliding", "restless", "unrest", "redness", "lattice", "witness"),
    *("odd", "loud", "louder", "told", "twin", "slide", "slides"),
}
OLD_NAME_WORDS_OF_DIAGNOSIS = {"view", "views", "claim", "claims"}
#: Variables that have a role in a sentence instead of the name of what they hold.
ROLE_WORDS = {
    *("one", "each", "both", "some", "several", "those", "these", "here", "there", "what", "why"),
    *("said", "told", "seen", "found", "kept", "taken", "wanted"),
    *("far", "near", "alike", "alone", "again", "beside"),
}


class Allowed(NamedTuple):
    """Text in which a pattern is right, why, and in which files ("" for all)."""

    phrase: str
    reason: str
    path: str = ""


ALLOWED = (
    Allowed("fringe_hop", "name of an effect, fixed"),
    Allowed("fringe hop", "term of the field: a step of one fringe"),
    Allowed('"view"', "key of diagnosis.json, fixed"),
    Allowed("'view'", "key of diagnosis.json, fixed"),
    Allowed("FringeHop", "class of the effect fringe_hop"),
    Allowed("}.view is", "key of diagnosis.json, fixed"),
    Allowed("lattice (a quantization grid)", "name of a mark, fixed", "gyrostab/physics/"),
    Allowed("canyon", "the paper's own word, quoted", "docs/seeds.md"),
)


class Finding(NamedTuple):
    """One place that does not follow the vocabulary."""

    path: str
    line: int
    text: str
    advice: str


def without_code(text: str) -> str:
    """Prose without names in backticks and doctest lines; the line breaks stay."""
    text = re.sub(r"^\s*(>>>|\.\.\.) .*$", "", text, flags=re.MULTILINE)
    return re.sub(r"(`+)[^`\n]+\1", "``", text)


#: Comments and strings of Python: of a string, its prefix and what is between its quotes.
PYTHON_TEXT = re.compile(
    r"""#(?P<comment>[^\n]*)"""
    r"""|(?P<prefix>\b[A-Za-z]{1,2})?(?P<quotes>\"{3}|'{3}|"|')(?P<text>(?:\\.|[^\\])*?)(?P=quotes)""",
    re.DOTALL,
)


def texts_of_python(source: str) -> Iterator[tuple[int, str]]:
    """Comments and strings of more than one word, each with its first line."""
    line, place = 1, 0
    for match in PYTHON_TEXT.finditer(source):
        text = match["text"]
        if match["comment"] is not None:
            text = match["comment"].lstrip("#: ")
        elif "f" in (match["prefix"] or "").lower():
            text = re.sub(r"\{[^{}]*\}", "{}", text)
        if match["comment"] is not None or " " in text:
            line, place = line + source.count("\n", place, match.start()), match.start()
            yield line, text


def texts_of_markdown(source: str) -> Iterator[tuple[int, str]]:
    """Paragraphs, table rows and list items outside code blocks, each with its first line."""
    paragraph: list[str] = []
    in_code = False
    for number, line in enumerate([*source.splitlines(), ""], 1):
        is_fence = line.startswith("```")
        if is_fence or in_code or not line or line.startswith(("    ", "|", "- ", "#", "<!--")):
            if paragraph:
                yield number - len(paragraph), "\n".join(paragraph)
            paragraph = []
        in_code ^= is_fence
        if line and not (is_fence or in_code or line.startswith(("    ", "<!--"))):
            paragraph.append(line)


def texts_of(path: Path) -> Iterator[tuple[int, str]]:
    """Prose of a file, each piece with its first line."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        yield from texts_of_python(source)
    elif path.suffix == ".toml":
        for number, line in enumerate(source.splitlines(), 1):
            if "#" in line:
                yield number, line.split("#", 1)[1].strip()
    elif path.suffix == ".md":
        yield from texts_of_markdown(source)
    else:
        yield from enumerate(source.splitlines(), 1)


@cache
def patterns_in(diagnosis: bool) -> list[tuple[Callable[[str], Iterator[re.Match]], str]]:
    """What finds each pattern, with its advice."""
    patterns = PHRASES | OLD_WORDS | (OLD_WORDS_OF_DIAGNOSIS if diagnosis else {})
    return [(re.compile(pattern).finditer, advice) for pattern, advice in patterns.items()]


def find_phrases(path: Path, name: str) -> Iterator[Finding]:
    """Phrases and old words in the prose of a file, also where a line breaks within them."""
    patterns = patterns_in(name.startswith(DIAGNOSIS))
    for first, text in texts_of(path):
        cleaned = re.sub(r"\n[ \t]+", "\n", without_code(text))
        for allowed in ALLOWED:
            if name.startswith(allowed.path):
                cleaned = cleaned.replace(allowed.phrase, "")
        flat = cleaned.replace("\n", " ")
        for find_matches, advice in patterns:
            for match in find_matches(flat):
                line = first + cleaned.count("\n", 0, match.start())
                context = flat[max(0, match.start() - 30) : match.end() + 30]
                yield Finding(name, line, f"...{context}...", advice)


def find_names(path: Path, name: str) -> Iterator[Finding]:
    """Old words in names of functions and classes."""
    old_words = OLD_NAME_WORDS | (
        OLD_NAME_WORDS_OF_DIAGNOSIS if name.startswith(DIAGNOSIS) else set()
    )
    for line, defined in defined_names(path):
        words = {word.lower() for word in re.findall(r"[a-z]+|[A-Z][a-z]*", defined)}
        if any(defined == allowed.phrase for allowed in ALLOWED):
            continue
        for word in sorted(words & old_words):
            yield Finding(name, line, f"name {defined}", f"without {word!r}")


def find_role_words(path: Path, name: str) -> Iterator[Finding]:
    """Find variables and parameters that are not named by what they hold."""
    source = path.read_text(encoding="utf-8")
    if ROLE_WORDS.isdisjoint(re.findall(r"\w+", PYTHON_TEXT.sub("''", source))):
        return
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg):
            variable = node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            variable = node.id
        else:
            continue
        if variable in ROLE_WORDS:
            yield Finding(name, node.lineno, f"variable {variable}", "name what it holds")


def defined_names(path: Path, kind: str = "def|class") -> Iterator[tuple[int, str]]:
    """Names of the functions and classes of a file, each with its line."""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if match := re.match(rf"\s*(?:{kind}) (\w+)", line):
            yield number, match[1]


def find_long_lines(path: Path, name: str) -> Iterator[Finding]:
    """Find Markdown lines that are too long; tables, links and quotes may be longer."""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if len(line) > MAX_MARKDOWN_COLUMNS and not line.startswith(("|", "    ", "![", "[", ">")):
            yield Finding(name, number, f"{len(line)} columns", f"at most {MAX_MARKDOWN_COLUMNS}")


def files_in(places: list[str]) -> Iterator[Path]:
    """The files of these places that hold prose."""
    for place in places:
        path = ROOT / place
        paths = [path] if path.is_file() else sorted(path.rglob("*"))
        for file in paths:
            hidden = any(part.startswith(".") or part == "__pycache__" for part in file.parts)
            if file.suffix in (".py", ".md", ".jinja", ".toml") and not hidden:
                yield file


def find_all(places: list[str]) -> list[Finding]:
    """Everything in these places that does not follow the vocabulary."""
    findings = []
    for path in files_in(places):
        name = str(path.relative_to(ROOT))
        findings += find_phrases(path, name)
        if path.suffix == ".py":
            findings += find_names(path, name)
            findings += find_role_words(path, name)
        if path.suffix == ".md":
            findings += find_long_lines(path, name)
    return findings


def single_word_share(folder: Path) -> tuple[int, int]:
    """How many private functions have a name of one word, and how many there are."""
    names = [
        name.strip("_")
        for path in files_in([str(folder)])
        if path.suffix == ".py"
        for _, name in defined_names(path, "def")
        if re.match(r"_[^_]", name)
    ]
    return sum("_" not in name for name in names), len(names)


def main(arguments: list[str]) -> int:
    """Print the findings; 1 if there are any."""
    findings = find_all(arguments or list(PLACES))
    for finding in findings:
        print(f"{finding.path}:{finding.line}: {finding.text}  [{finding.advice}]")
    single, total = single_word_share(ROOT / (arguments[0] if arguments else "gyrostab"))
    share = single / max(total, 1)
    print(f"{len(findings)} findings; {single} of {total} private functions have a one-word name")
    return int(bool(findings) or share > MAX_SINGLE_WORD_SHARE)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

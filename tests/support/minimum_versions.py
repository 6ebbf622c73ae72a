"""Print the lowest versions of the dependencies in pyproject.toml as constraints for pip.

python -m tests.support.minimum_versions > constraints.txt
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PYPROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"


def list_requirements(project: dict[str, Any], extras: list[str]) -> Iterator[str]:
    """Yield the requirements of some extras, with those of the extras that they name."""
    for extra in extras:
        for item in project["optional-dependencies"][extra]:
            if own := re.fullmatch(rf"{project['name']}\[(.*)\]", item):
                yield from list_requirements(project, own[1].split(","))
            else:
                yield item


def minimum_versions(pyproject: Path = PYPROJECT) -> list[str]:
    """Lines `name==version`, one for each requirement of the tests with a lower bound, by name."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    requirements = [*project["dependencies"], *list_requirements(project, ["test"])]
    matches = [re.fullmatch(r"([\w.-]+)(?:\[.*\])?>=([\w.]+)", item) for item in requirements]
    return sorted({f"{match[1]}=={match[2]}" for match in matches if match}, key=str.lower)


if __name__ == "__main__":
    print(*minimum_versions(), sep="\n")

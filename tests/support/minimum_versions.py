"""Print the lowest versions of the dependencies in pyproject.toml as constraints for pip.

python -m tests.support.minimum_versions > constraints.txt
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

PYPROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
#: Extras that the tests need in addition to the dependencies of the package.
EXTRAS = ("las", "miniseed", "tdms", "ulog", "distributed", "test")


def minimum_versions(pyproject: Path = PYPROJECT) -> list[str]:
    """Lines `name==version`, one for each requirement with a lower bound, by name."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    requirements = [
        *project["dependencies"],
        *(item for extra in EXTRAS for item in optional[extra]),
    ]
    matches = [re.fullmatch(r"([\w.-]+)(?:\[.*\])?>=([\w.]+)", item) for item in requirements]
    return sorted({f"{match[1]}=={match[2]}" for match in matches if match}, key=str.lower)


if __name__ == "__main__":
    print(*minimum_versions(), sep="\n")

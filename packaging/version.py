"""The version: from the tag in git; without one, from the newest release in the changelog.

hatchling reads it while it builds (`tool.hatch.version` in pyproject.toml). A commit after the tag
``v0.2.0`` is ``0.2.1.dev5+g0123abc``; without git, unreleased changes are ``0.2.1.dev0``. A source
archive carries its version in ``PKG-INFO``.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def find_version(root: Path = ROOT) -> str:
    """Return the version of the checkout or source archive in `root`."""
    archive = root / "PKG-INFO"
    if archive.exists():
        text = archive.read_text(encoding="utf-8")
        return re.search(r"^Version: (.+)$", text, re.MULTILINE)[1]
    described = _describe_tag(root) if (root / ".git").exists() else ""
    if match := re.fullmatch(r"v(\d+)\.(\d+)\.(\d+)-(\d+)-(g[0-9a-f]+)", described):
        major, minor, patch, commits, commit = match.groups()
        if commits == "0":
            return f"{major}.{minor}.{patch}"
        return f"{major}.{minor}.{int(patch) + 1}.dev{commits}+{commit}"
    changelog = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.search(r"^## \[(\d+)\.(\d+)\.(\d+)\] - ", changelog, re.MULTILINE)
    major, minor, patch = released.groups()
    if re.search(r"^- ", changelog[: released.start()], re.MULTILINE):
        return f"{major}.{minor}.{int(patch) + 1}.dev0"
    return f"{major}.{minor}.{patch}"


def _describe_tag(root: Path) -> str:
    """Return what git says of the newest tag; empty without git, tag, or permission to read."""
    command = ["git", "describe", "--tags", "--long", "--match", "v[0-9]*.[0-9]*.[0-9]*"]
    try:
        return subprocess.run(
            command, cwd=root, capture_output=True, text=True, check=False
        ).stdout.strip()
    except OSError:
        return ""

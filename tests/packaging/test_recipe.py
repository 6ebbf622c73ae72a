"""The conda recipe, the citation and the changelog agree with pyproject.toml."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
#: Packages that conda-forge names otherwise.
CONDA_NAMES = {"dask[array]": "dask-core", "matplotlib": "matplotlib-base", "netCDF4": "netcdf4"}


@pytest.fixture(scope="module")
def project() -> dict[str, object]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.fixture(scope="module")
def recipe() -> dict[str, dict[str, object]]:
    return yaml.safe_load((ROOT / "packaging" / "recipe.yaml").read_text(encoding="utf-8"))


def test_recipe_requires_what_the_package_requires(project, recipe) -> None:
    found = [f"python {project['requires-python']}"]
    for requirement in project["dependencies"]:
        name, versions = re.fullmatch(r"([\w\-\[\]]+)(.*)", requirement).groups()
        found.append(f"{CONDA_NAMES.get(name, name)} {versions}".strip())
    assert sorted(recipe["requirements"]["run"]) == sorted(found)


def test_versions_agree(project, recipe) -> None:
    version = project["version"]
    assert recipe["package"]["version"] == version
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == version
    assert f"\n## [{version}] - " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")

"""The conda recipe, the citation and the changelog agree with pyproject.toml."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import tomllib
from pathlib import Path
from types import ModuleType

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
    requirements = [f"python {project['requires-python']}"]
    for requirement in project["dependencies"]:
        name, versions = re.fullmatch(r"([\w\-\[\]]+)(.*)", requirement).groups()
        requirements.append(f"{CONDA_NAMES.get(name, name)} {versions}".strip())
    assert sorted(recipe["requirements"]["run"]) == sorted(requirements)


@pytest.fixture(scope="module")
def version_module() -> ModuleType:
    spec = importlib.util.spec_from_file_location("version", ROOT / "packaging" / "version.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_versions_agree(recipe, version_module, tmp_path: Path) -> None:
    """Apart from what the changelog has of the next version."""
    _, *releases = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("\n## [")[1:]
    (tmp_path / "CHANGELOG.md").write_text(f"## [{releases[0]}", encoding="utf-8")
    version = version_module.find_version(tmp_path)
    assert recipe["package"]["version"] == version
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == version


def test_version_from_tag_changelog_or_source_archive(version_module, tmp_path: Path) -> None:
    def run_git(*arguments: str) -> None:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", *identity, *arguments], cwd=tmp_path, check=True)

    (tmp_path / "CHANGELOG.md").write_text("## [Unreleased]\n## [1.2.3] - 2026-01-01\n")
    assert version_module.find_version(tmp_path) == "1.2.3"
    (tmp_path / "CHANGELOG.md").write_text("## [Unreleased]\n- New.\n## [1.2.3] - 2026-01-01\n")
    assert version_module.find_version(tmp_path) == "1.2.4.dev0"
    (tmp_path / "CHANGELOG.md").write_text("## [Unreleased]\n## [1.2.3] - 2026-01-01\n- Old.\n")
    run_git("init", "--quiet")
    run_git("commit", "--quiet", "--allow-empty", "-m", "first")
    assert version_module.find_version(tmp_path) == "1.2.3"
    run_git("tag", "v1.3.0")
    assert version_module.find_version(tmp_path) == "1.3.0"
    run_git("commit", "--quiet", "--allow-empty", "-m", "second")
    assert version_module.find_version(tmp_path).startswith("1.3.1.dev1+g")
    (tmp_path / "PKG-INFO").write_text("Metadata-Version: 2.4\nVersion: 1.3.0\n")
    assert version_module.find_version(tmp_path) == "1.3.0"

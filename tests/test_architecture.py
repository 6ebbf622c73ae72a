"""Import layers, and what importing a module may load."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BLIND_TEST = sorted((ROOT / "gyrostab" / "blindtest").rglob("*.py"))
PUBLIC_MODULES = tuple(
    f"gyrostab.{name}" for name in ("arrays", "errors", "units", "schema", "progress")
)
HEAVY = ("matplotlib", "numba", "pyarrow", "netCDF4", "h5py", "scipy.stats")


def _python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120
    )


def test_imports_go_down_only():
    done = _python(
        "import sys; from importlinter.cli import lint_imports\n"
        "sys.exit(lint_imports(config_filename='pyproject.toml'))"
    )
    assert done.returncode == 0, done.stdout
    assert "0 broken" in done.stdout


def test_page_lists_the_layers_of_the_contract():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = project["tool"]["importlinter"]["contracts"][0]["layers"]
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert "\n\n" + "".join(f"    {layer}\n" for layer in layers) + "\n" in page


def test_page_lists_every_package_and_root_module():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    tree = page.split("## The tree")[1].split("\n## ")[0]
    for path in sorted((ROOT / "gyrostab").iterdir()):
        if (path / "__init__.py").exists():
            assert f"\n      {path.name}/ " in tree
            for folder in path.glob("*/__init__.py"):
                assert f" {folder.parent.name}/" in tree
        elif path.suffix == ".py" and not path.stem.startswith("__"):
            assert f" {path.stem} " in tree


def test_import_loads_nothing_heavy():
    """In one process: what a step loads is still there after the next one."""
    steps = {
        "import gyrostab": (*HEAVY, "xarray", "pandas", "dask"),
        "import gyrostab.cli; gyrostab.cli.main(['--help'])": (*HEAVY, "xarray", "pandas", "dask"),
        "gyrostab.cli.main(['run', '--help'])": (*HEAVY, "xarray", "pandas", "dask"),
        "import gyrostab.plot, gyrostab.report": ("matplotlib", "jinja2", "PIL", "scipy.stats"),
    }
    lines = [
        f"{step}; print('loaded:', [name for name in {banned!r} if name in sys.modules])"
        for step, banned in steps.items()
    ]
    done = _python("\n".join(["import sys", *lines]))
    assert done.returncode == 0, done.stderr
    loaded = [line for line in done.stdout.splitlines() if line.startswith("loaded: ")]
    assert dict(zip(steps, loaded, strict=True)) == dict.fromkeys(steps, "loaded: []")


def test_public_names_are_functions_whatever_was_imported_first():
    code = (
        "import gyrostab, types\n"
        "from gyrostab.ingest.scan import COLUMNS\n"
        "import gyrostab.correlate, gyrostab.diagnose, gyrostab.ingest.scan, gyrostab.simulate\n"
        "names = [n for n in gyrostab.__all__ if n != '__version__']\n"
        "bad = [n for n in names if not isinstance(getattr(gyrostab, n), types.FunctionType)]\n"
        "print(bad)"
    )
    done = _python(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_unknown_name_is_an_attribute_error():
    import gyrostab

    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        gyrostab.nonsense  # noqa: B018
    assert "davar" in dir(gyrostab)


def test_a_file_is_written_without_loading_a_scheduler(tmp_path):
    """xarray imports dask.distributed to see whether it is active, which takes 0.25 s."""
    done = _python(
        "import sys; import numpy as np; from gyrostab import make_log, to_netcdf\n"
        "log = make_log(np.arange(60.0), rate=100.0, unit='deg/h')\n"
        f"to_netcdf(log, {str(tmp_path / 'log.nc')!r}); print('distributed' in sys.modules)"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "False"


def list_imports(path: Path) -> list[tuple[str, str]]:
    """List module and name of every import of gyrostab."""
    imports = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            imports += [(node.module or "", alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            imports += [(alias.name, "") for alias in node.names]
    return [item for item in imports if item[0].split(".")[0] == "gyrostab"]


def is_public(module: str, name: str) -> bool:
    """Test whether a name is exported by the package, a public module or a package's `__init__`."""
    if module in PUBLIC_MODULES or module.split(".")[:2] == ["gyrostab", "time"]:
        return True
    package = importlib.import_module(module)
    return hasattr(package, "__path__") and name in ("", *getattr(package, "__all__", ()))


@pytest.mark.parametrize("path", BLIND_TEST, ids=lambda path: path.stem)
def test_blind_test_uses_public_names_only(path):
    outside = [item for item in list_imports(path) if item[0][:18] != "gyrostab.blindtest"]
    assert [item for item in outside if not is_public(*item)] == []


@pytest.mark.parametrize(
    ("module", "name", "public"),
    [
        ("gyrostab", "diagnose", True),
        ("gyrostab.time.grid", "grid_times", True),
        ("gyrostab.store.output", "replace_file", True),
        ("gyrostab.store.output", "check", False),
        ("gyrostab.diagnose.core", "diagnose", False),
    ],
)
def test_deep_modules_are_not_public(module, name, public):
    assert is_public(module, name) == public


SCRIPTS = sorted(
    path for folder in ("benchmarks", "docs", "pipelines") for path in (ROOT / folder).rglob("*.py")
)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_scripts_import_names_that_exist(path):
    """Scripts run rarely, and types are not checked in them."""
    for module, name in list_imports(path):
        if not (name == "" or hasattr(importlib.import_module(module), name)):
            importlib.import_module(f"{module}.{name}")

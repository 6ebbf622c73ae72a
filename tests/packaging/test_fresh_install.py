"""A fresh checkout follows its README to the letter; the wheel works in a bare environment."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = [pytest.mark.install, pytest.mark.timeout(1200)]
ROOT = Path(__file__).resolve().parents[2]
TUTORIAL_CELL = re.compile(
    r"^```\{code-cell\} python\n(?::[^\n]*\n)*(.*?)^```$", re.MULTILINE | re.DOTALL
)
#: A model of the noise, for the command of the README that compares with a simulation.
MODEL = "[noise]\nN = 0.006\nB = 0.03\nK = 0.05\n"


def call(command: str | list[str], folder: Path, bin_folder: Path | None = None) -> str:
    """Run a command outside this environment and return what it prints."""
    path = os.environ["PATH"]
    environment = {
        k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    environment["PATH"] = f"{bin_folder}{os.pathsep}{path}" if bin_folder else path
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        shell=isinstance(command, str),
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-3000:]}"
    return done.stdout


@pytest.fixture
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of this checkout that git knows, in another folder."""
    folder = tmp_path_factory.mktemp("checkout") / "gyrostab"
    folder.mkdir()
    listed = call(["git", "ls-files", "-co", "--exclude-standard", "-z"], ROOT).split("\0")
    packed = folder.with_suffix(".tar")
    with tarfile.open(packed, "w") as archive:
        for name in filter(None, listed):
            if (ROOT / name).exists():
                archive.add(ROOT / name, name)
    with tarfile.open(packed) as archive:
        archive.extractall(folder, filter="data")
    return folder


def readme_commands() -> list[str]:
    """The shell commands of the README, without the tests and without installing tools."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = re.findall(r"^    ((?:make|gyrostab) .*)$", text, re.MULTILINE)
    return [line for line in lines if not line.startswith("make test")]


def test_readme_and_first_tutorial_to_the_letter(checkout: Path) -> None:
    commands = readme_commands()
    assert commands[0].startswith("make demo")
    assert len(commands) >= 5
    printed = call(commands[0], checkout)
    assert "product.nc" in printed
    tools = checkout / ".venv" / "bin"
    _write_pieces(checkout / "run7", tools)
    (checkout / "model.toml").write_text(MODEL)
    for command in commands[1:]:
        overwrite = " --overwrite" if "diagnose" in command else ""
        call(command.split(" #")[0] + overwrite, checkout, tools)
    (checkout / "product.nc").unlink()
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    call([str(tools / "python"), "-c", block], checkout)
    tutorial = (ROOT / "docs" / "tutorials" / "first-log.md").read_text(encoding="utf-8")
    cells = "\n".join(TUTORIAL_CELL.findall(tutorial))
    assert cells
    environment = "import matplotlib; matplotlib.use('agg'); display = print\n"
    call([str(tools / "python"), "-c", environment + cells], checkout)


def _write_pieces(folder: Path, tools: Path) -> None:
    """Write the shipped log as two files, as a logger that begins a new file would."""
    script = (
        "import gzip; lines = gzip.open('data/mwd_sample.csv.gz', 'rt').readlines()\n"
        "head = next(i for i, line in enumerate(lines) if line.startswith('time')) + 1\n"
        "half = len(lines) // 2\n"
        f"open({str(folder / 'a.csv')!r}, 'w').writelines(lines[:half])\n"
        f"open({str(folder / 'b.csv')!r}, 'w').writelines(lines[:head] + lines[half:])\n"
    )
    folder.mkdir()
    call([str(tools / "python"), "-c", script], folder.parent)


def test_wheel_in_a_bare_environment(checkout: Path, tmp_path: Path) -> None:
    call([sys.executable, "-m", "build", "--outdir", str(tmp_path), str(checkout)], tmp_path)
    (source,) = tmp_path.glob("*.tar.gz")
    (wheel,) = tmp_path.glob("*.whl")
    with tarfile.open(source) as archive:
        assert not [name for name in archive.getnames() if "/.venv" in name or "/run7" in name]
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"gyrostab"}
    for name in ("py.typed", "data/mwd_day.csv.gz", "report/charts.js"):
        assert f"gyrostab/{name}" in names
    venv.create(tmp_path / "bare", with_pip=True)
    tools = tmp_path / "bare" / "bin"
    call([str(tools / "pip"), "install", "--quiet", "--no-compile", str(wheel)], tmp_path)
    assert "gyrostab" in call("gyrostab doctor", tmp_path, tools)
    assert "product.nc" in call("gyrostab demo -o demo", tmp_path, tools)
    (tmp_path / "log.las").write_text("~Version\n VERS. 2.0 :\n~Curve\n")
    refused = call("gyrostab scan log.las || true", tmp_path, tools)
    assert "pip install 'gyrostab[las]'" in refused
    assert "Traceback" not in refused

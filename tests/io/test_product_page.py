"""docs/product.md names every variable of a product as it is, and its readers run.

Remake the table with ``python -m tests.io.test_product_page``.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import gyrostab
from gyrostab.noise import LAWS
from gyrostab.schema import ESTIMATORS, GAP_CAUSES, OBSERVABLE, VARIABLES
from tests.support import synthetic

PAGE = Path(__file__).resolve().parents[2] / "docs" / "product.md"
BEGIN, END = "<!-- table: begin -->\n", "<!-- table: end -->"


def write_product(path: Path) -> Path:
    """A product by the way that a user's takes: log, surface, coefficients, file."""
    surface = gyrostab.davar(synthetic.log(samples=6000), window="4s", step="1s", taus="12")
    return gyrostab.to_netcdf(gyrostab.fit_noise(surface), path)


def table(path: Path) -> str:
    """The table of the page, from the file; channels of the log are left to the text."""
    import netCDF4

    rows = [
        "| variable | dimensions | type | unit | missing | meaning |",
        "|---|---|---|---|---|---|",
    ]
    with netCDF4.Dataset(path) as file:
        stored = [name for name in file.variables if name in VARIABLES or name == "time_bounds"]
        assert set(VARIABLES) <= set(stored), "a product has every variable of the schema"
        for name in sorted(
            stored, key=[*list(VARIABLES)[:1], "time_bounds", *list(VARIABLES)[1:]].index
        ):
            variable = file[name]
            kind = "text" if variable.dtype == "S1" else variable.dtype.name
            dims = ", ".join(dim for dim in variable.dimensions if not dim.startswith("string"))
            unit = getattr(variable, "units", "")
            unit = (
                "micro- or nanoseconds since 1970-01-01"
                if "since" in unit or name == "time_bounds"
                else unit
            )
            label = getattr(variable, "unit_label", None)
            missing = "fill" if "_FillValue" in variable.ncattrs() else "never"
            meaning = getattr(variable, "long_name", "start and end of the window")
            unit = (
                f"`{unit}`"
                + (f" (reads {label})" if label in (LAWS["N"].label, LAWS["K"].label) else "")
                if unit
                else "–"
            )
            rows.append(f"| `{name}` | {dims} | {kind} | {unit} | {missing} | {meaning} |")
    return "\n".join(rows) + "\n"


def remake() -> None:
    with tempfile.TemporaryDirectory() as folder:
        rows = table(write_product(Path(folder, "product.nc")))
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(
        text[: text.index(BEGIN) + len(BEGIN)] + rows + text[text.index(END) :], encoding="utf-8"
    )


@pytest.fixture(scope="module")
def product(tmp_path_factory) -> Path:
    return write_product(tmp_path_factory.mktemp("page") / "product.nc")


@pytest.fixture(scope="module")
def text() -> str:
    return PAGE.read_text(encoding="utf-8")


def test_the_table_is_that_of_a_product(product, text):
    shown = text[text.index(BEGIN) + len(BEGIN) : text.index(END)]
    assert shown == table(product), "remake the table: python -m tests.io.test_product_page"


def test_every_flag_is_explained(text):
    for number, meaning in [*enumerate(OBSERVABLE), *enumerate(ESTIMATORS), *enumerate(GAP_CAUSES)]:
        assert re.search(rf"^\| {number} \| `{meaning}`", text, re.M)


def test_what_is_never_missing_is_not(product):
    import netCDF4

    with netCDF4.Dataset(product) as file:
        for variable in file.variables.values():
            if "_FillValue" not in variable.ncattrs():
                assert not np.ma.is_masked(variable[:]), variable.name


def snippet(text: str, language: str, mark: str = "product.nc") -> str:
    (code,) = (code for code in re.findall(rf"```{language}\n(.*?)```", text, re.S) if mark in code)
    assert len(code.splitlines()) == 3
    return code


def wanted(path: Path) -> float:
    import netCDF4

    with netCDF4.Dataset(path) as file:
        is_observed = file["observable"][0, 1] == OBSERVABLE.index("observed")
        assert 0 < is_observed.sum() < is_observed.size
        return float(np.median(file["N"][0][is_observed].compressed()))


@pytest.fixture
def folder(tmp_path) -> Path:
    gyrostab.to_netcdf(synthetic.product(), tmp_path / "product.nc")
    return tmp_path


def test_the_python_reader(folder, text):
    code = snippet(text, "python")
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True
    )
    assert float(done.stdout) == pytest.approx(wanted(folder / "product.nc"))


def test_the_table_for_excel(folder, text, monkeypatch):
    monkeypatch.chdir(folder)
    exec(re.search(r"^    (product = .*\n)    (product\[.*)$", text, re.M).expand(r"\1\2"))
    # numbers are read by Python, as pandas 2 rounds those that it reads
    table = pd.read_csv("coefficients.csv", dtype={"N": str})
    product = gyrostab.open_product("product.nc")
    assert len(table) == product.sizes["axis"] * product.sizes["time"]
    np.testing.assert_array_equal(table["N"].astype(float), product["N"].values.ravel())


@pytest.mark.parametrize(
    ("program", "language", "command", "before"),
    [
        (
            "octave",
            "matlab",
            ["--no-gui", "--norc", "-q", "--eval"],
            "pkg load netcdf\nformat long\n",
        ),
        ("Rscript", "r", ["-e"], ""),
        ("julia", "julia", ["-e"], ""),
    ],
)
def test_the_other_readers(program, language, command, before, folder, text):
    number = printed_by(program, [*command, before + snippet(text, language)], folder)
    assert number == pytest.approx(wanted(folder / "product.nc"), rel=1e-4)


def printed_by(program: str, arguments: list[str], folder: Path) -> float:
    if shutil.which(program) is None:
        pytest.skip(f"{program} is absent")
    done = subprocess.run(
        [program, *arguments], cwd=folder, capture_output=True, text=True, timeout=200, check=False
    )
    if not done.stdout and re.search("netcdf|ncdf4|NCDatasets", done.stderr):
        pytest.skip(f"{program} has no package for NetCDF")
    return float(re.findall(r"[-+.\deE]+\s*$", done.stdout.strip())[0])


@pytest.fixture
def log_folder(tmp_path) -> tuple[Path, float]:
    """A log in counts, and the mean of the second minute of its first axis."""
    log = synthetic.log(samples=1500, rate=10.0)
    log["rate"] = log.rate.copy(data=np.rint(log.rate.values / 0.01) * 0.01)
    log["rate"].encoding = {"dtype": np.dtype("i2"), "scale_factor": 0.01}
    gyrostab.to_netcdf(log, tmp_path / "log.nc", compression="zlib")
    return tmp_path, float(log.rate[0, 600:1200].mean())


@pytest.mark.parametrize(
    ("program", "language", "command", "before"),
    [
        (sys.executable, "python", ["-c"], ""),
        (
            "octave",
            "matlab",
            ["--no-gui", "--norc", "-q", "--eval"],
            "pkg load netcdf\nformat long\n",
        ),
        ("Rscript", "r", ["-e"], ""),
    ],
)
def test_the_readers_of_a_log(program, language, command, before, log_folder, text):
    folder, mean = log_folder
    assert printed_by(
        program, [*command, before + snippet(text, language, "log.nc")], folder
    ) == pytest.approx(mean, rel=1e-5)


if __name__ == "__main__":
    remake()

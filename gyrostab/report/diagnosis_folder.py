"""A diagnosis as a folder of four files, and back."""

from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path

import xarray as xr

from gyrostab.diagnose.result.content import check_diagnosis
from gyrostab.diagnose.result.diagnosis import Diagnosis, model_text
from gyrostab.errors import FormatError, SchemaError
from gyrostab.io.datasets import to_netcdf
from gyrostab.io.opening import open_dataset
from gyrostab.report import write_diagnosis_report
from gyrostab.store.output import new_output
from gyrostab.store.output.content import read_json
from gyrostab.store.toml import read_toml_text

#: Files of the folder.
FILES = ("diagnosis.json", "model.toml", "diagnosis.nc", "report.html")


def write_diagnosis(
    diagnosis: Diagnosis, directory: str | os.PathLike[str], *, overwrite: bool = False
) -> list[Path]:
    """Write ``diagnosis.json``, ``model.toml``, ``diagnosis.nc`` and ``report.html`` to a folder.

    The folder appears once all files are complete.

    Parameters
    ----------
    diagnosis : Diagnosis
        What `gyrostab.diagnose` returns.
    directory : path-like
        The folder to make.
    overwrite : bool
        Replace an existing folder, if a diagnosis or nothing is in it.

    Returns
    -------
    list of pathlib.Path
        The files.

    Raises
    ------
    SchemaError
        When the content is not that of a diagnosis.
    OutputError
        When the folder exists, holds something else, or cannot be written.
    """
    check_diagnosis(diagnosis.content)
    directory = Path(directory)
    with new_output(directory, overwrite=overwrite, find_foreign=find_foreign_file) as temporary:
        (temporary / "diagnosis.json").write_text(diagnosis.to_json(), encoding="utf-8")
        (temporary / "model.toml").write_text(
            model_text(diagnosis.model, heading=_make_heading(diagnosis)), encoding="utf-8"
        )
        to_netcdf(diagnosis.surfaces, temporary / "diagnosis.nc")
        write_diagnosis_report(diagnosis, temporary / "report.html")
    return [directory / name for name in FILES]


def find_foreign_file(directory: Path) -> str | None:
    """Find an item in a folder that is not part of a diagnosis; None if there is none."""
    ours = FILES if is_diagnosis(directory) else ()
    foreign = (
        item.name
        for item in directory.iterdir()
        if item.name not in ours or item.is_symlink() or not item.is_file()
    )
    return min(foreign, default=None)


def is_diagnosis(directory: Path) -> bool:
    """Whether a folder holds a diagnosis of any version."""
    content = read_json(directory / "diagnosis.json")
    return isinstance(content, dict) and str(content.get("schema")).startswith(
        "gyrostab.diagnosis/"
    )


def _make_heading(diagnosis: Diagnosis) -> str:
    files = (
        ", ".join(Path(name).name for name in diagnosis.content["recording"]["files"])
        or "the recording"
    )
    return (
        f"The simulation of {files} with what its diagnosis found.\n"
        "gyrostab simulate model.toml --like RECORDING -o simulation.nc"
    )


def open_diagnosis(directory: str | os.PathLike[str]) -> Diagnosis:
    """Open what `write_diagnosis` wrote.

    Parameters
    ----------
    directory : path-like
        The folder.

    Returns
    -------
    Diagnosis

    Raises
    ------
    FormatError
        When there is no such folder, or no diagnosis in it.

    Examples
    --------
    >>> open_diagnosis("nowhere")
    Traceback (most recent call last):
    gyrostab.errors.FormatError: nowhere: there is no such folder; gyrostab diagnose RECORDING ...
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise FormatError(
            f"{directory}: there is no such folder; gyrostab diagnose RECORDING -o DIR makes one"
        )
    try:
        content = json.loads((directory / "diagnosis.json").read_text(encoding="utf-8"))
        check_diagnosis(content)
        model = tomllib.loads(read_toml_text(directory / "model.toml"))
    except OSError as error:
        raise FormatError(
            f"{error.filename}: cannot be read ({error.strerror}); "
            f"is {directory} the folder of a diagnosis?"
        ) from error
    except (ValueError, RecursionError, SchemaError) as error:
        raise FormatError(
            f"{directory}: holds no diagnosis that can be read ({error}); "
            "make it again with gyrostab diagnose"
        ) from error
    surfaces: xr.Dataset = open_dataset(directory / "diagnosis.nc").load()
    surfaces.close()
    return Diagnosis(content, surfaces, model)

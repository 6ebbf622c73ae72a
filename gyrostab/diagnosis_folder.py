"""A diagnosis as a folder of four files, and back."""

from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path

import xarray as xr

from gyrostab.diagnose.conclusion.result import Diagnosis, check_diagnosis, model_text
from gyrostab.errors import FormatError, OutputError, SchemaError
from gyrostab.export import open_dataset, to_netcdf
from gyrostab.output import new_output
from gyrostab.report import write_diagnosis_report

__all__ = ["FILES", "check_folder", "open_diagnosis", "write_diagnosis"]

#: Files of the folder.
FILES = ("diagnosis.json", "model.toml", "diagnosis.nc", "report.html")


def write_diagnosis(diagnosis: Diagnosis, directory: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
    """Write ``diagnosis.json``, ``model.toml``, ``diagnosis.nc`` and ``report.html`` into a folder, which appears once all are complete.

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
        When the folder exists, or cannot be written.
    """
    check_diagnosis(diagnosis.content)
    directory = Path(directory)
    check_folder(directory, overwrite=overwrite)
    with new_output(directory, overwrite=overwrite, directory=True) as temporary:
        (temporary / "diagnosis.json").write_text(diagnosis.to_json(), encoding="utf-8")
        (temporary / "model.toml").write_text(model_text(diagnosis.model, heading=_heading(diagnosis)), encoding="utf-8")
        to_netcdf(diagnosis.surfaces, temporary / "diagnosis.nc")
        write_diagnosis_report(diagnosis, temporary / "report.html")
    return [directory / name for name in FILES]


def check_folder(directory: Path, *, overwrite: bool) -> None:
    """Raise `OutputError` before the long work when the folder cannot be made, or holds something else that would be lost."""
    if not directory.parent.is_dir():
        raise OutputError(f"output {str(directory)!r}: there is no directory {str(directory.parent)!r}; make it first or choose another")
    if directory.exists() and not directory.is_dir():
        raise OutputError(f"output {str(directory)!r} is a file; give the name of a folder with -o")
    if not directory.exists():
        return
    if not overwrite:
        raise OutputError(f"output {str(directory)!r} exists already; give --overwrite to replace it, or another name with -o")
    others = sorted(item.name for item in directory.iterdir() if item.name not in FILES)
    if others:
        raise OutputError(f"output {str(directory)!r} holds {others[0]!r} too, which would be lost; give another name with -o")


def _heading(diagnosis: Diagnosis) -> str:
    files = ", ".join(Path(name).name for name in diagnosis.content["recording"]["files"]) or "the recording"
    return f"The simulation of {files} with what its diagnosis found.\ngyrostab simulate model.toml --like RECORDING -o simulation.nc"


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
    gyrostab.errors.FormatError: nowhere: there is no such folder; gyrostab diagnose RECORDING -o DIR makes one
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise FormatError(f"{directory}: there is no such folder; gyrostab diagnose RECORDING -o DIR makes one")
    try:
        content = json.loads((directory / "diagnosis.json").read_text(encoding="utf-8"))
        check_diagnosis(content)
        model = tomllib.loads((directory / "model.toml").read_text(encoding="utf-8"))
    except OSError as error:
        raise FormatError(f"{error.filename}: cannot be read ({error.strerror}); is {directory} the folder of a diagnosis?") from error
    except (ValueError, SchemaError) as error:
        raise FormatError(f"{directory}: holds no diagnosis that can be read ({error}); make it again with gyrostab diagnose") from error
    surfaces: xr.Dataset = open_dataset(directory / "diagnosis.nc").load()
    surfaces.close()
    return Diagnosis(content, surfaces, model)

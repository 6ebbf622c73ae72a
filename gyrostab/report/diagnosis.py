"""Write the report of a diagnosis: one self-contained HTML file."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.result.content import check_diagnosis
from gyrostab.diagnose.result.diagnosis import Diagnosis, model_text
from gyrostab.diagnose.result.families import group_families
from gyrostab.diagnose.result.record_text import delay_texts, noise_texts, span_seconds, summary
from gyrostab.diagnose.result.text import (
    chance_share,
    family_text,
    next_measurement,
    plain_name,
    probability_text,
    rejection_text,
    without_chance,
)
from gyrostab.diagnose.statistics.mismatch_wording import axes_text, length_text
from gyrostab.errors import FormatError, SchemaError
from gyrostab.io.datasets import to_netcdf
from gyrostab.io.opening import open_dataset
from gyrostab.noise import LAWS
from gyrostab.plot.style import unit_symbol
from gyrostab.report.charts import page_text
from gyrostab.report.diagnosis_charts import diagnosis_charts
from gyrostab.store.output import new_output
from gyrostab.store.output.content import read_json
from gyrostab.store.toml import read_toml_text
from gyrostab.wording import value_digits


def write_diagnosis_report(
    diagnosis: Diagnosis, path: str | os.PathLike[str], *, overwrite: bool = False
) -> Path:
    """Write the report of a diagnosis.

    Raises
    ------
    SchemaError
        When the content is not that of a diagnosis.
    OutputError
        When the file exists or cannot be written.
    """
    content = diagnosis.content
    check_diagnosis(content)
    rows = [
        {
            **region,
            "statement": without_chance(region["statement"]),
            "chance": chance_share(region["p_value"]),
        }
        for region in content["mismatches"]
    ]
    cards = [
        _effect_card(effect, others, content, rows)
        for effect, *others in group_families(content["effects"])
    ]
    with new_output(path, overwrite=overwrite) as temporary:
        text = page_text(
            "diagnosis.html.jinja",
            title="Gyro diagnosis",
            content=content,
            file_name=lambda name: Path(name).name,
            summary=summary(content),
            length=length_text(
                span_seconds(content["recording"]["start"], content["recording"]["end"])
            ),
            delay_texts=delay_texts(content),
            noise_texts=[text.strip() for text in noise_texts(content)[1:]],
            effects=cards,
            mismatches=rows,
            unexplained=[
                row for row in rows if not any(row in card["mismatches"] for card in cards)
            ],
            charts=diagnosis_charts(diagnosis.surfaces, content),
            limits=sorted(
                content["not_found"].items(),
                key=lambda item: (item[1]["upper_limit"] is None, item[0]),
            ),
            rejected={
                rejection["name"]: rejection_text(rejection["beaten_by"], rejection["nats"])
                for rejection in content.get("rejected", [])
            },
            laws=LAWS,
            number=_format_number,
            parameter=_format_parameter,
            plain_name=plain_name,
            unit=unit_symbol,
        )
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def _format_number(value: Any, digits: int = 3) -> str:
    if value is None or not np.isfinite(value):
        return "–"
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"


def _format_parameter(entry: Mapping[str, Any], key: str) -> str:
    return _format_number(entry[key], value_digits(entry["value"], entry["stderr"]))


def _effect_card(
    effect: Mapping[str, Any],
    others: list[Mapping[str, Any]],
    content: Mapping[str, Any],
    rows: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return the card of an effect, and of the others of its family."""
    title = plain_name(effect["name"])
    axes = set(effect["axes"]).union(*(other["axes"] for other in others))
    return {
        **effect,
        "title": f"{title[0].upper()}{title[1:]}, {axes_text(effect['axes'])}",
        "family": family_text(effect, others) if others else "",
        "alternatives": [f"{plain_name(name)} ({name})" for name in effect["alternatives"]],
        "probability": probability_text(effect),
        "next": next_measurement(effect["name"], effect["alternatives"]),
        "mismatches": [
            row
            for row, region in zip(rows, content["mismatches"], strict=True)
            if effect["name"] in region["explained_by"] and axes & set(region["axes"])
        ],
    }


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

    Examples
    --------
    >>> found = gyrostab.diagnose(gyrostab.open_log("run7.nc"))  # doctest: +SKIP
    >>> gyrostab.write_diagnosis(found, "run7-diagnosis")  # doctest: +SKIP
    """
    if not isinstance(diagnosis, Diagnosis):
        raise SchemaError(
            f"this is a {type(diagnosis).__name__}, not a diagnosis; gyrostab.diagnose and "
            "gyrostab.open_diagnosis return one"
        )
    check_diagnosis(diagnosis.content)
    directory = Path(directory)
    files = [Path(name).name for name in diagnosis.content["recording"]["files"]]
    heading = (
        f"The simulation of {', '.join(files) or 'the recording'} with what its diagnosis found.\n"
        "gyrostab simulate model.toml --like RECORDING -o simulation.nc"
    )
    with new_output(directory, overwrite=overwrite, find_foreign=find_foreign_file) as temporary:
        (temporary / "diagnosis.json").write_text(diagnosis.to_json(), encoding="utf-8")
        model = model_text(diagnosis.model, heading=heading)
        (temporary / "model.toml").write_text(model, encoding="utf-8")
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
    if directory.is_file():
        raise FormatError(
            f"{directory}: is a file; give the folder of the diagnosis, for instance "
            f"{directory.parent}"
        )
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

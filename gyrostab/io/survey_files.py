"""Write the gyro terms of a survey tool as a table, as JSON, or as WITSML.

======  ====================================================================================
suffix  content
======  ====================================================================================
.csv    one row a term, below comments with origin, validity and notes
.json   tool error model in the draft JSON schema of ISCWSA, with the keys that welleng adds
.xml    WITSML 2.1 ToolErrorModel
======  ====================================================================================

References
----------
github.com/iscwsa/error-models, schemas/draft.json; welleng 0.30, `welleng.errors.tool_errors`;
Energistics WITSML 2.1, ToolErrorModel.xsd.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import uuid
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import asdict, fields
from datetime import UTC, datetime
from typing import Any

import xarray as xr

from gyrostab.errors import OptionError
from gyrostab.io.survey_model import TABLES, SurveyModel, SurveyTerm
from gyrostab.io.survey_terms import survey_terms
from gyrostab.store.output import check_output, new_output
from gyrostab.units import HOUR

SUFFIXES = (".csv", ".json", ".xml")
#: Code -> weighting function of the azimuth.
WEIGHTS = {code: weight for rows in TABLES.values() for code, _, _, weight in rows}
#: Unit -> unit in the JSON of ISCWSA; g-dependent terms are per g, the acceleration in the weights.
_JSON_UNITS = {"deg/h": "deg/hr", "deg/sqrt(h)": "deg/sqr(hr)", "deg/h/g": "deg/hr"}
_WITSML_UNITS = {"deg/h": "dega/h", "deg/sqrt(h)": "dega/sqrt(h)", "deg/h/g": "dega/h/gn"}
#: Unit of a channel -> its name in the list of units of Energistics.
_WITSML_CHANNEL_UNITS = {
    "g": "gn", "degree_Celsius": "degC", "K hour-1": "degC/h", "degree s-1": "dega/s", "V": "V",
    "W": "W", "Pa": "Pa", "uT": "uT", "1": "Euc",
}  # fmt: skip
_MAX_TEXT, _MAX_TITLE = 2000, 64  # characters of a description and of a title in WITSML
_NO_HASH = 32 * "0"


def to_iscwsa(
    product: xr.Dataset,
    path: str | os.PathLike[str],
    *,
    running_speed: float | None = None,
    continuous_from: float = 15.0,
    overwrite: bool = False,
    **options: Any,
) -> SurveyModel:
    """Write the gyro terms of an ISCWSA tool error model, in the form of the suffix of the file.

    The terms are those of `survey_terms`, which states their meaning. They are to be confirmed by a
    survey engineer.

    Parameters
    ----------
    product : xarray.Dataset
        What `gyrostab.fit_noise` returns or `gyrostab.open_product` opens.
    path : path-like
        File to write: ``.csv`` (table), ``.json`` (for welleng) or ``.xml`` (WITSML 2.1
        ToolErrorModel).
    running_speed : float, optional
        Speed of a continuous survey along the hole [m/s]. Without it, JSON and WITSML hold the
        stationary terms only; a table always holds all terms.
    continuous_from : float
        Inclination from which x and y gyros survey continuously [deg]; below it they stop at each
        station. A tool with three axes is initialised at its first station.
    overwrite : bool
        Replace an existing file.
    **options
        Options of `survey_terms`.

    Returns
    -------
    SurveyModel
        What was written.

    Raises
    ------
    SchemaError
        When `product` is not a product, has other axes, or shows neither N nor B nor K.
    OptionError
        When an option makes no sense, or the suffix of the file is not one of the three.
    OutputError
        When the file exists, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from gyrostab import davar, fit_noise, make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     model = to_iscwsa(fit_noise(davar(log, window="20s")), folder + "/tool.csv")
    >>> model.terms[0].code, model.terms[0].unit
    ('GXY-RN', 'deg/h')
    """
    _check_course(running_speed, continuous_from)
    path = check_output(path, suffixes=list(SUFFIXES), overwrite=overwrite)
    model = survey_terms(product, **options)
    if path.suffix.lower() == ".csv":
        text = _make_table(model)
    else:
        if running_speed is None and model.tool == "z":
            raise OptionError(
                "a tool with a z gyro alone surveys continuously; give its speed along the hole in "
                "m/s as running_speed (--running-speed)"
            )
        make = {".json": _make_json, ".xml": _make_witsml}[path.suffix.lower()]
        text = make(model, path.stem, running_speed, continuous_from)
    with new_output(path, overwrite=overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return model


def _check_course(running_speed: float | None, continuous_from: float) -> None:
    if not 0.0 <= continuous_from <= 90.0:  # false for nan too
        raise OptionError(
            f"continuous_from (--continuous-from) {continuous_from!r} is not an inclination from "
            "0 to 90 degrees"
        )
    if running_speed is not None and not 0.0 < running_speed < math.inf:
        raise OptionError(
            f"running_speed (--running-speed) {running_speed!r} is not a speed above zero, in m/s"
        )


def _make_table(model: SurveyModel) -> str:
    """Write one row a term, below comments."""
    text = io.StringIO()
    text.writelines(f"# {remark}\n" for remark in model.remarks)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(SurveyTerm)])
    writer.writerows(asdict(term).values() for term in model.terms)
    return text.getvalue()


def _exported_terms(model: SurveyModel, running_speed: float | None) -> list[SurveyTerm]:
    """Return the terms with a value, without continuous ones unless there is a speed."""
    return [
        term
        for term in model.terms
        if not math.isnan(term.value) and (term.mode == "stationary" or running_speed is not None)
    ]


def _make_json(
    model: SurveyModel, name: str, running_speed: float | None, continuous_from: float
) -> str:
    """Write the draft schema of ISCWSA with the parameters of continuous surveys of welleng."""
    parameters: dict[str, Any] = {"inc_min": 0, "inc_max": 180, "noise_reduction_factor": 1.0}
    start = math.inf if running_speed is None else continuous_from if model.tool == "xy" else -1.0
    if running_speed is not None:
        parameters["gxy_running_speed"] = running_speed * HOUR  # m/h
        parameters["xy_static_gyro_end_inc"] = math.radians(start)
    content = {
        "$schema": "https://github.com/iscwsa/error-models/blob/main/schemas/draft.json",
        "metadata": {
            "schema_uuid": str(uuid.UUID(int=0)),
            "model_uuid": _make_uuid(name),
            "model_id": name,
            "short_name": name,
            "long_name": f"{model.tool} gyro terms from a log",
            "revision_number": 0,
            "revision_date": f"{datetime.now(UTC):%Y-%m-%d}",
            "revision_comment": model.notes[0],
            "source": model.origin[0],
            "application": model.conditions,
            "tool_type": "Gyroscopic",
            "author": "gyrostab",
            "framework": "ISCWSA Rev5",
            "tags": [*model.remarks],
        },
        "parameters": parameters,
        "terms": [
            entry
            for term in _exported_terms(model, running_speed)
            for entry in _make_entries(term, model, name, start)
        ],
        "hash_function": "SHA256",
        "hash_value": _NO_HASH,
        "x_gyrostab": [
            {key: None if value != value else value for key, value in asdict(term).items()}
            for term in model.terms
        ],
    }
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _make_uuid(*names: str) -> str:
    """Make the same identifier for the same names."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, "/".join(("gyrostab", *names))))


def _make_entries(
    term: SurveyTerm, model: SurveyModel, name: str, start: float
) -> Iterator[dict[str, Any]]:
    """Make the entry of a term, and that of the error with which a continuous survey starts."""
    entry = {
        "uuid": _make_uuid(name, term.code),
        "name": term.code,
        "value": term.value,
        "units": _JSON_UNITS[term.unit],
        "depth_factor": 0,
        "inclination_factor": 0,
        "azimuth_factor": 1,
        "propagation_mode": term.propagation,
        "depth_formula": "0",
        "inclination_formula": "0",
        "azimuth_formula": WEIGHTS[term.code],
        "north_singularity": None,
        "east_singularity": None,
        "vertical_singularity": None,
        "hash_value": _NO_HASH,
    }
    initial = {"name": f"{term.code}-INIT", "propagation_mode": "Systematic", "carry_only": True}
    if term.mode == "continuous" or start == math.inf:
        yield entry
    elif model.tool == "xyz":
        yield entry | initial | {"inc_min_deg": 0.0}
    elif term.propagation == "Systematic":
        yield entry | {"inc_max_deg": start, "carry_above_max": True}
    else:
        yield entry | {"inc_max_deg": start}
        yield entry | initial | {"inc_min_deg": start}


def _make_witsml(
    model: SurveyModel, name: str, running_speed: float | None, continuous_from: float
) -> str:
    """Write a WITSML 2.1 ToolErrorModel, which refers to error terms by their names."""
    root = ET.Element(
        "ToolErrorModel",
        {
            "xmlns": "http://www.energistics.org/energyml/data/witsmlv2",
            "xmlns:eml": "http://www.energistics.org/energyml/data/commonv2",
            "schemaVersion": "2.1",
            "uuid": _make_uuid(name),
        },
    )
    _add_element(root, "eml:Citation", {
        "eml:Title": name, "eml:Originator": "gyrostab",
        "eml:Creation": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}", "eml:Format": "gyrostab",
        "eml:Description": " ".join(model.remarks)[:_MAX_TEXT],
    })  # fmt: skip
    _add_element(root, "Application", model.conditions[:_MAX_TEXT])
    _add_element(root, "Source", model.origin[0][:_MAX_TEXT])
    _add_element(root, "ToolKind", "gyroscopic")
    _add_element(root, "ToolSubKind", "north seeking gyro" if "x" in model.tool else "unknown")
    _add_element(root, "MisalignmentMode", "3")
    constraints = _add_element(root, "OperatingConstraints")
    for channel, (low, high, unit) in model.validity.items():
        if unit not in _WITSML_CHANNEL_UNITS:  # the description has all channels
            continue
        _add_element(constraints, "CustomRange", {
            "EndInclusive": "true", "StartInclusive": "true", "Start": low, "End": high,
            "Title": channel[:_MAX_TITLE], "Uom": _WITSML_CHANNEL_UNITS[unit],
        })  # fmt: skip
    _add_element(root, "Authorization", {
        "ApprovalAuthority": "none: to be confirmed by a survey engineer",
        "RevisionComment": model.notes[0], "Status": "provisional",
    })  # fmt: skip
    for term in _exported_terms(model, running_speed):
        value = _add_element(root, "ErrorTermValue")
        _add_element(value, "Magnitude", term.value).set("uom", _WITSML_UNITS[term.unit])
        reference = _add_element(value, "ErrorTerm", {
            "eml:Uuid": _make_uuid(term.code), "eml:QualifiedType": "witsml21.ErrorTerm",
            "eml:Title": term.code,
        })  # fmt: skip
        for key in ("status", "low", "high", "mode", "propagation", "derivation"):
            _add_element(reference, "eml:ExtensionNameValue", {
                "eml:Name": key, "eml:Value": getattr(term, key),
            })  # fmt: skip
    _add_gyros(_add_element(root, "GyroToolConfiguration"), model, running_speed, continuous_from)
    ET.indent(root)
    return f"{ET.tostring(root, encoding='unicode', xml_declaration=True)}\n"


def _add_element(parent: ET.Element, tag: str, content: Any = None) -> ET.Element:
    """Add an element with a text, with elements that each have a text, or empty."""
    element = ET.SubElement(parent, tag)
    if isinstance(content, dict):
        for name, text in content.items():
            _add_element(element, name, text)
    elif content is not None:
        element.text = str(content)
    return element


def _add_gyros(
    parent: ET.Element, model: SurveyModel, running_speed: float | None, continuous_from: float
) -> None:
    """Add where the gyros survey continuously and where they stop at stations."""
    _add_element(parent, "ExternalReference", "true" if model.tool == "z" else "false")
    start = continuous_from if model.tool == "xy" else 0.0
    if running_speed is not None:
        gyro = _add_element(parent, "ContinuousGyro", {"AxisCombination": model.tool})
        _add_range(gyro, start, 180.0)
        _add_element(gyro, "Speed", running_speed).set("uom", "m/s")
        _add_element(gyro, "Initialization", start).set("uom", "dega")
    if model.tool != "z":
        gyro = _add_element(parent, "StationaryGyro", {"AxisCombination": model.tool})
        _add_range(gyro, 0.0, 180.0 if running_speed is None else start)


def _add_range(parent: ET.Element, start: float, end: float) -> None:
    _add_element(parent, "Range", {
        "EndInclusive": "true", "StartInclusive": "true", "Start": start, "End": end, "Uom": "dega",
    })  # fmt: skip

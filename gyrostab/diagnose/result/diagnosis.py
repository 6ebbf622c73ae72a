"""Hold a diagnosis: the contents of `diagnosis.json`, their check, and the model as TOML."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.result.text import chance_share, next_measurement, summary, without_chance
from gyrostab.diagnose.settings import Settings
from gyrostab.errors import SchemaError
from gyrostab.noise import TERMS
from gyrostab.physics.base import Effect

__all__ = [
    "HELD_OUT",
    "MISMATCH_VIEWS",
    "SCHEMA",
    "VERDICTS",
    "Diagnosis",
    "check_diagnosis",
    "effect_table",
    "model_text",
    "plain",
]

SCHEMA = "gyrostab.diagnosis/1"
VERDICTS = ("no mismatch", "explained", "partly explained", "unknown")
MISMATCH_VIEWS = ("davar", "mean", "cross_axis", "spectrum", "distribution", "restart")
_SOURCES = ("calibrated", "model", "simulation")


@dataclass(frozen=True)
class Diagnosis:
    """Where a recording differs from its simulation, and which physics explains it.

    Attributes
    ----------
    content : mapping
        The contents of `diagnosis.json` as plain data; `check_diagnosis` lists the keys.
    surfaces : xarray.Dataset
        Allan variances and means of the recording, and of the simulation without and with the
        effects.
    model : mapping
        Tables of the simulation with the effects added, as `gyrostab.read_model` takes them.
    """

    content: Mapping[str, Any]
    surfaces: xr.Dataset = field(repr=False)
    model: Mapping[str, Any] = field(repr=False)

    @property
    def verdict(self) -> str:
        """One of `VERDICTS`."""
        return str(self.content["verdict"])

    @property
    def effects(self) -> list[dict[str, Any]]:
        """Return the named effects."""
        return list(self.content["effects"])

    @property
    def mismatches(self) -> list[dict[str, Any]]:
        """Return the places where recording and simulation differ."""
        return list(self.content["mismatches"])

    @property
    def settings(self) -> Settings:
        """Return the numbers that decided what is reported."""
        return Settings(**self.content["settings"])

    def to_json(self) -> str:
        """Return the contents as JSON."""
        return json.dumps(self.content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"

    def __str__(self) -> str:
        """Return the verdict with a sentence for each effect and each unexplained mismatch."""
        lines = [f"{self.verdict}: {summary(self.content)}"]
        for effect in self.effects:
            evidence = effect["held_out_gain"]
            lines.append(f"- {effect['name']}: {effect['statement']}")
            lines.append(
                f"  evidence: held-out data are predicted better by {evidence['nats']:.3g} nats "
                f"(threshold against chance: {evidence['threshold']:.2g} nats)"
            )
            if step := next_measurement(effect["name"], effect["alternatives"]):
                lines.append(f"  {step}")
        lines += [
            f"- channel {channel['name']} is not used: {channel['reason']}"
            for channel in self.content.get("unused_channels", [])
        ]
        unexplained = set(self.content["unexplained"])
        regions = [region for region in self.mismatches if region["id"] in unexplained]
        if len(regions) == 1:
            lines.append(f"- unexplained: {regions[0]['statement']}")
        elif regions:
            lines += [f"- unexplained: {without_chance(region['statement'])}" for region in regions]
            share = chance_share(max(region["p_value"] for region in regions))
            lines.append(
                f"  Noise alone would show the least certain of these in {share} such records."
            )
        return "\n".join(lines)


def plain(value: Any) -> Any:
    """Convert a value to what JSON allows.

    NumPy numbers become Python's, times ISO 8601, and values that are not finite null.

    Examples
    --------
    >>> plain({"a": np.float64(0.5), "b": [np.nan, np.int64(3)]})
    {'a': 0.5, 'b': [None, 3]}
    >>> plain(np.datetime64("2026-03-01T12:00", "ns"))
    '2026-03-01T12:00:00.000Z'
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist() if value.dtype.kind != "M" else list(value))
    if isinstance(value, np.datetime64):
        return None if np.isnat(value) else f"{value.astype('datetime64[ms]')}Z"
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


# --------------------------------------------------------------------------------------------------
# ---------------- check

_NUMBER = (int, float)
_NUMBER_OR_NULL = (int, float, type(None))  # null: the record does not determine it
_ENTRY: dict[str, Any] = {
    "value": _NUMBER_OR_NULL,
    "stderr": _NUMBER_OR_NULL,
    "low": _NUMBER_OR_NULL,
    "high": _NUMBER_OR_NULL,
    "unit": str,
}
_FIELDS: dict[str, dict[str, Any]] = {
    "": {
        "schema": str, "recording": dict, "baseline": dict, "verdict": str,
        "false_alarm_level": _NUMBER, "mismatches": list,
        "effects": list, "unexplained": list, "not_found": dict, "held_out": dict,
        "seconds": _NUMBER,
    },
    "unused_channel": {"name": str, "reason": str},
    "recording": {
        "files": list, "axes": list, "start": str, "end": str, "sampling_rate_hz": _NUMBER,
        "channels": list, "missing_share": _NUMBER,
    },
    "baseline": {"source": str, "noise": dict, "calibrated_on": list},
    "expected": {"name": str, "axes": list, "statement": str},
    "noise": {"value": _NUMBER, "stderr": _NUMBER_OR_NULL, "unit": str},
    "mismatch": {
        "id": int, "view": str, "axes": list, "start": str, "end": str,
        "tau_min_s": _NUMBER_OR_NULL, "tau_max_s": _NUMBER_OR_NULL, "ratio": _NUMBER_OR_NULL,
        "p_value": _NUMBER, "explained_by": list, "statement": str,
    },
    "effect": {
        "name": str, "axes": list, "driver": (str, type(None)), "intervals": list,
        "parameters": dict, "held_out_gain": dict,
        "alternatives": list, "statement": str,
    },
    "held_out_gain": {"nats": _NUMBER, "stderr": _NUMBER_OR_NULL, "threshold": _NUMBER},
    "not_found": {"upper_limit": _NUMBER_OR_NULL, "unit": (str, type(None)), "reason": str},
    "held_out": {
        "blocks": int, "log_likelihood_gain": _NUMBER_OR_NULL, "stderr": _NUMBER_OR_NULL,
        "misfit_before": _NUMBER_OR_NULL, "misfit_after": _NUMBER_OR_NULL,
        "coverage95_before": _NUMBER_OR_NULL, "coverage95_after": _NUMBER_OR_NULL,
        "forecast_gain": _NUMBER_OR_NULL,
    },
}  # fmt: skip

#: Keys of the held-out evidence.
HELD_OUT = tuple(_FIELDS["held_out"])


def _check_fields(table: Any, kind: str, where: str) -> None:
    if not isinstance(table, Mapping):
        raise SchemaError(
            f"diagnosis: {where or 'the file'} must be a table, not {type(table).__name__}"
        )
    for name, types in _FIELDS[kind].items():
        place = f"{where}.{name}" if where else name
        if name not in table:
            raise SchemaError(f"diagnosis: {place} is missing")
        value = table[name]
        if not isinstance(value, types) or (
            isinstance(value, bool) and bool not in np.atleast_1d(types)
        ):
            raise SchemaError(f"diagnosis: {place} is {value!r}, expected {_type_names(types)}")


def _type_names(types: Any) -> str:
    names = {
        int: "whole number",
        float: "number",
        str: "text",
        list: "list",
        dict: "table",
        type(None): "null",
    }
    return " or ".join(
        dict.fromkeys(names[kind] for kind in (types if isinstance(types, tuple) else (types,)))
    )


def _check_times(values: Iterable[Any], where: str) -> None:
    for value in values:
        try:
            np.datetime64(str(value).removesuffix("Z"))
        except ValueError:
            raise SchemaError(
                f"diagnosis: {where} holds {value!r}, expected a time in ISO 8601"
            ) from None


def check_diagnosis(content: Mapping[str, Any]) -> None:
    """Raise `SchemaError`, naming the place, unless `content` is that of a `diagnosis.json`.

    Examples
    --------
    >>> check_diagnosis({"schema": "gyrostab.diagnosis/1"})
    Traceback (most recent call last):
    gyrostab.errors.SchemaError: diagnosis: recording is missing
    """
    _check_fields(content, "", "")
    if content["schema"] != SCHEMA:
        raise SchemaError(f"diagnosis: the schema is {content['schema']!r}, expected {SCHEMA!r}")
    if content["verdict"] not in VERDICTS:
        raise SchemaError(
            f"diagnosis: the verdict is {content['verdict']!r}, expected one of "
            f"{', '.join(VERDICTS)}"
        )
    _check_fields(content["recording"], "recording", "recording")
    _check_times((content["recording"]["start"], content["recording"]["end"]), "recording")
    _check_baseline(content["baseline"])
    _check_fields(content["held_out"], "held_out", "held_out")
    numbers = [region.get("id") for region in content["mismatches"]]
    if len(set(numbers)) < len(numbers):
        raise SchemaError(f"diagnosis: the ids of the mismatches are not unique: {numbers}")
    names = [effect.get("name") for effect in content["effects"]]
    for place, region in enumerate(content["mismatches"]):
        _check_mismatch(region, f"mismatches[{place}]", names)
    for place, effect in enumerate(content["effects"]):
        _check_effect(effect, f"effects[{place}]")
    for name, entry in content["not_found"].items():
        _check_fields(entry, "not_found", f"not_found.{name}")
    unused = content.get("unused_channels", [])
    if not isinstance(unused, list):
        raise SchemaError(f"diagnosis: unused_channels is {unused!r}, expected a list")
    for place, channel in enumerate(unused):
        _check_fields(channel, "unused_channel", f"unused_channels[{place}]")
    stray = [number for number in content["unexplained"] if number not in numbers]
    if stray:
        raise SchemaError(f"diagnosis: unexplained lists mismatch {stray[0]}, which does not exist")


def _check_baseline(baseline: Mapping[str, Any]) -> None:
    _check_fields(baseline, "baseline", "baseline")
    if baseline["source"] not in _SOURCES:
        raise SchemaError(
            f"diagnosis: baseline.source is {baseline['source']!r}, expected one of "
            f"{', '.join(_SOURCES)}"
        )
    for axis, terms in baseline["noise"].items():
        for term, entry in terms.items():
            where = f"baseline.noise.{axis}.{term}"
            if term not in TERMS:
                raise SchemaError(
                    f"diagnosis: {where}: unknown noise term, expected one of {', '.join(TERMS)}"
                )
            _check_fields(entry, "noise", where)
    for span in baseline["calibrated_on"]:
        _check_times(span, "baseline.calibrated_on")
    for number, effect in enumerate(baseline.get("expected", [])):
        _check_fields(effect, "expected", f"baseline.expected[{number}]")


def _check_mismatch(region: Mapping[str, Any], where: str, names: list[Any]) -> None:
    _check_fields(region, "mismatch", where)
    if region["view"] not in MISMATCH_VIEWS:
        raise SchemaError(
            f"diagnosis: {where}.view is {region['view']!r}, expected one of "
            f"{', '.join(MISMATCH_VIEWS)}"
        )
    _check_times((region["start"], region["end"]), where)
    if not 0.0 <= region["p_value"] <= 1.0:
        raise SchemaError(
            f"diagnosis: {where}.p_value is {region['p_value']}, expected a probability"
        )
    stray = [name for name in region["explained_by"] if name not in names]
    if stray:
        raise SchemaError(
            f"diagnosis: {where}.explained_by lists {stray[0]!r}, which is not among the effects"
        )


def _check_effect(effect: Mapping[str, Any], where: str) -> None:
    _check_fields(effect, "effect", where)
    _check_fields(effect["held_out_gain"], "held_out_gain", f"{where}.held_out_gain")
    for span in effect["intervals"]:
        _check_times(span, f"{where}.intervals")
    for name, entry in effect["parameters"].items():
        for key, types in _ENTRY.items():
            absent = 0.5 if key == "unit" else "none"  # a value of the wrong type
            if not isinstance(entry.get(key, absent), types):
                raise SchemaError(
                    f"diagnosis: {where}.parameters.{name}.{key} is {entry.get(key)!r}"
                )


# --------------------------------------------------------------------------------------------------
# ---------------- model


def effect_table(effect: Effect) -> dict[str, Any]:
    """Return an effect as its table in a model, with the parameters that differ from defaults.

    Examples
    --------
    >>> from gyrostab.physics.registry import make_effect
    >>> shupe = {"name": "shupe", "axes": ["x"], "sensitivity": 0.4, "lag": 180.0}
    >>> effect_table(make_effect(shupe))
    {'name': 'shupe', 'axes': ['x'], 'sensitivity': 0.4, 'lag': 180.0}
    """
    kind = type(effect)
    table: dict[str, Any] = {"name": effect.name}
    if effect.axes:
        table["axes"] = list(effect.axes)
    if effect.driver:
        table["driver"] = list(effect.driver)
    required = set(kind.required())
    defaults = {name: item.default for name, item in kind.__dataclass_fields__.items()}
    for known in kind.parameters():
        value = getattr(effect, known.name)
        if known.name in required or value != defaults[known.name]:
            table[known.name] = list(value) if isinstance(value, tuple) else value
    return table


def model_text(model: Mapping[str, Any], *, heading: str = "") -> str:
    """Write the tables of a model as TOML.

    Parameters
    ----------
    model : mapping
        Tables ``noise``, ``log`` and lists of tables ``effect``, ``environment``.
    heading : str
        Comment lines to begin with.

    Examples
    --------
    >>> effect = {"name": "warm_up", "axes": ["x"], "amplitude": 0.5}
    >>> print(model_text({"noise": {"x": {"N": 0.003}}, "effect": [effect]}))
    [noise.x]
    N = 0.003
    <BLANKLINE>
    [[effect]]
    name = "warm_up"
    axes = ["x"]
    amplitude = 0.5
    <BLANKLINE>
    """
    lines = [f"# {line}" for line in heading.splitlines()]
    lines += [""] if lines else []
    for name, table in model.items():
        if isinstance(table, Mapping):
            lines += _format_section(name, table)
        else:
            for item in table:
                lines += [f"[[{name}]]", *_format_pairs(item), ""]
    return "\n".join(lines)


def _format_section(name: str, table: Mapping[str, Any]) -> list[str]:
    flat = {key: value for key, value in table.items() if not isinstance(value, Mapping)}
    lines = [f"[{name}]", *_format_pairs(flat), ""] if flat or not table else []
    for key, value in table.items():
        if isinstance(value, Mapping):
            lines += _format_section(f"{name}.{_format_key(key)}", value)
    return lines


def _format_pairs(table: Mapping[str, Any]) -> list[str]:
    return [
        f"{_format_key(key)} = {_format_value(value)}"
        for key, value in table.items()
        if value is not None
    ]


def _format_key(key: str) -> str:
    return (
        key
        if key and all(letter.isascii() and (letter.isalnum() or letter in "_-") for letter in key)
        else _format_string(key)
    )


def _format_string(text: str) -> str:
    """Write a basic string of TOML.

    It is that of JSON, except for DEL, and for halves of surrogate pairs, which no file can hold.
    """
    return json.dumps(text.encode("utf-8", "replace").decode("utf-8"), ensure_ascii=False).replace(
        "\x7f", "\\u007f"
    )


def _format_value(value: Any) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return "nan" if math.isnan(value) else repr(value)
    if isinstance(value, list | tuple | np.ndarray):
        return f"[{', '.join(_format_value(item) for item in value)}]"
    return _format_string(str(value))

"""What a diagnosis says: the JSON of the contract as plain data, its check, and the model as TOML."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.result.text import chance_share, next_measurement, summary, without_chance
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
        What `diagnosis.json` holds, as plain data; `check_diagnosis` says what is in it.
    surfaces : xarray.Dataset
        Allan variances and means of the recording, of the simulation before, and of that with the
        effects added.
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
        """The named effects."""
        return list(self.content["effects"])

    @property
    def mismatches(self) -> list[dict[str, Any]]:
        """Where recording and simulation differ."""
        return list(self.content["mismatches"])

    def to_json(self) -> str:
        """The content as JSON."""
        return json.dumps(self.content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"

    def __str__(self) -> str:
        """The verdict, and a sentence for each effect and each mismatch that none explains."""
        lines = [f"{self.verdict}: {summary(self.content)}"]
        for effect in self.effects:
            evidence_nats = effect["held_out_gain"]
            lines.append(f"- {effect['name']}: {effect['statement']}")
            lines.append(
                f"  predicts time kept apart better by {evidence_nats['nats']:.3g} nats; chance reaches {evidence_nats['threshold']:.2g}"
            )
            if step := next_measurement(effect["name"], effect["alternatives"]):
                lines.append(f"  {step}")
        lines += [
            f"- channel {one['name']} is not used: {one['reason']}"
            for one in self.content.get("unused_channels", [])
        ]
        left = set(self.content["unexplained"])
        regions = [region for region in self.mismatches if region["id"] in left]
        lines += [
            f"- unexplained: {without_chance(region['statement']) if len(regions) > 1 else region['statement']}"
            for region in regions
        ]
        if len(regions) > 1:
            likeliest = max(region["p_value"] for region in regions)
            lines.append(
                f"  Noise alone does as much as the least certain of these in {chance_share(likeliest)} such records."
            )
        return "\n".join(lines)


def plain(value: Any) -> Any:
    """The same as JSON knows it: numbers of numpy as Python's, times as ISO 8601, what is not finite as null.

    Examples
    --------
    >>> plain({"a": np.float64(0.5), "b": [np.nan, np.int64(3)], "t": np.datetime64("2026-03-01T12:00", "ns")})
    {'a': 0.5, 'b': [None, 3], 't': '2026-03-01T12:00:00.000Z'}
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


# --------------------------------------------------------------------------------
# the check

_NUMBER = (int, float)
_LATER = (int, float, type(None))  # null where the record cannot tell
_ENTRY: dict[str, Any] = {
    "value": _LATER,
    "stderr": _LATER,
    "low": _LATER,
    "high": _LATER,
    "unit": str,
}
_FIELDS: dict[str, dict[str, Any]] = {
    "": {
        "schema": str, "recording": dict, "baseline": dict, "verdict": str, "false_alarm_level": _NUMBER, "mismatches": list,
        "effects": list, "unexplained": list, "not_found": dict, "held_out": dict, "seconds": _NUMBER,
    },
    "unused_channel": {"name": str, "reason": str},
    "recording": {
        "files": list, "axes": list, "start": str, "end": str, "sampling_rate_hz": _NUMBER, "channels": list, "missing_share": _NUMBER,
    },
    "baseline": {"source": str, "noise": dict, "calibrated_on": list},
    "expected": {"name": str, "axes": list, "statement": str},
    "noise": {"value": _NUMBER, "stderr": _LATER, "unit": str},
    "mismatch": {
        "id": int, "view": str, "axes": list, "start": str, "end": str, "tau_min_s": _LATER, "tau_max_s": _LATER, "ratio": _LATER,
        "p_value": _NUMBER, "explained_by": list, "statement": str,
    },
    "effect": {
        "name": str, "axes": list, "driver": (str, type(None)), "intervals": list, "parameters": dict, "held_out_gain": dict,
        "alternatives": list, "statement": str,
    },
    "held_out_gain": {"nats": _NUMBER, "stderr": _LATER, "threshold": _NUMBER},
    "not_found": {"upper_limit": _LATER, "unit": (str, type(None)), "reason": str},
    "held_out": {
        "blocks": int, "log_likelihood_gain": _LATER, "stderr": _LATER, "misfit_before": _LATER, "misfit_after": _LATER,
        "coverage95_before": _LATER, "coverage95_after": _LATER, "forecast_gain": _LATER,
    },
}  # fmt: skip

#: What is told of held-out time.
HELD_OUT = tuple(_FIELDS["held_out"])


def _require(table: Any, kind: str, where: str) -> None:
    if not isinstance(table, Mapping):
        raise SchemaError(
            f"diagnosis: {where or 'the whole'} is no table but {type(table).__name__}"
        )
    for name, types in _FIELDS[kind].items():
        place = f"{where}.{name}" if where else name
        if name not in table:
            raise SchemaError(f"diagnosis: {place} is missing")
        value = table[name]
        if not isinstance(value, types) or (
            isinstance(value, bool) and bool not in np.atleast_1d(types)
        ):
            raise SchemaError(f"diagnosis: {place} is {value!r}, which is no {_called(types)}")


def _called(types: Any) -> str:
    names = {
        int: "whole number",
        float: "number",
        str: "text",
        list: "list",
        dict: "table",
        type(None): "null",
    }
    return " or ".join(
        dict.fromkeys(names[one] for one in (types if isinstance(types, tuple) else (types,)))
    )


def _times(values: Iterable[Any], where: str) -> None:
    for value in values:
        try:
            np.datetime64(str(value).removesuffix("Z"))
        except ValueError:
            raise SchemaError(
                f"diagnosis: {where} holds {value!r}, which is no time of ISO 8601"
            ) from None


def check_diagnosis(content: Mapping[str, Any]) -> None:
    """Raise `SchemaError`, naming the place, unless the content is that of a `diagnosis.json`.

    Examples
    --------
    >>> check_diagnosis({"schema": "gyrostab.diagnosis/1"})
    Traceback (most recent call last):
    gyrostab.errors.SchemaError: diagnosis: recording is missing
    """
    _require(content, "", "")
    if content["schema"] != SCHEMA:
        raise SchemaError(f"diagnosis: the schema is {content['schema']!r}, expected {SCHEMA!r}")
    if content["verdict"] not in VERDICTS:
        raise SchemaError(
            f"diagnosis: the verdict is {content['verdict']!r}; there are {', '.join(VERDICTS)}"
        )
    _require(content["recording"], "recording", "recording")
    _times((content["recording"]["start"], content["recording"]["end"]), "recording")
    _check_baseline(content["baseline"])
    _require(content["held_out"], "held_out", "held_out")
    numbers = [region.get("id") for region in content["mismatches"]]
    if len(set(numbers)) < len(numbers):
        raise SchemaError(
            f"diagnosis: the ids of the mismatches are {numbers}; each must be there once"
        )
    names = [effect.get("name") for effect in content["effects"]]
    for place, region in enumerate(content["mismatches"]):
        _check_mismatch(region, f"mismatches[{place}]", names)
    for place, effect in enumerate(content["effects"]):
        _check_effect(effect, f"effects[{place}]")
    for name, entry in content["not_found"].items():
        _require(entry, "not_found", f"not_found.{name}")
    unused = content.get("unused_channels", [])
    if not isinstance(unused, list):
        raise SchemaError(f"diagnosis: unused_channels is {unused!r}, which is no list")
    for place, channel in enumerate(unused):
        _require(channel, "unused_channel", f"unused_channels[{place}]")
    stray = [number for number in content["unexplained"] if number not in numbers]
    if stray:
        raise SchemaError(
            f"diagnosis: unexplained names the mismatch {stray[0]}, which is not there"
        )


def _check_baseline(baseline: Mapping[str, Any]) -> None:
    _require(baseline, "baseline", "baseline")
    if baseline["source"] not in _SOURCES:
        raise SchemaError(
            f"diagnosis: baseline.source is {baseline['source']!r}; there are {', '.join(_SOURCES)}"
        )
    for axis, terms in baseline["noise"].items():
        for term, entry in terms.items():
            where = f"baseline.noise.{axis}.{term}"
            if term not in TERMS:
                raise SchemaError(
                    f"diagnosis: {where} is no noise term; there are {', '.join(TERMS)}"
                )
            _require(entry, "noise", where)
    for span in baseline["calibrated_on"]:
        _times(span, "baseline.calibrated_on")
    for number, effect in enumerate(baseline.get("expected", [])):
        _require(effect, "expected", f"baseline.expected[{number}]")


def _check_mismatch(region: Mapping[str, Any], where: str, names: list[Any]) -> None:
    _require(region, "mismatch", where)
    if region["view"] not in MISMATCH_VIEWS:
        raise SchemaError(
            f"diagnosis: {where}.view is {region['view']!r}; there are {', '.join(MISMATCH_VIEWS)}"
        )
    _times((region["start"], region["end"]), where)
    if not 0.0 <= region["p_value"] <= 1.0:
        raise SchemaError(
            f"diagnosis: {where}.p_value is {region['p_value']}, which is no probability"
        )
    stray = [name for name in region["explained_by"] if name not in names]
    if stray:
        raise SchemaError(
            f"diagnosis: {where}.explained_by names {stray[0]!r}, which is not among the effects"
        )


def _check_effect(effect: Mapping[str, Any], where: str) -> None:
    _require(effect, "effect", where)
    _require(effect["held_out_gain"], "held_out_gain", f"{where}.held_out_gain")
    for span in effect["intervals"]:
        _times(span, f"{where}.intervals")
    for name, entry in effect["parameters"].items():
        for key, types in _ENTRY.items():
            if not isinstance(entry.get(key, 0.5 if key == "unit" else "none"), types):
                raise SchemaError(
                    f"diagnosis: {where}.parameters.{name}.{key} is {entry.get(key)!r}"
                )


# --------------------------------------------------------------------------------
# the model


def effect_table(effect: Effect) -> dict[str, Any]:
    """An effect as its table in a model: name, axes, driver, and the parameters that are not at their default.

    Examples
    --------
    >>> from gyrostab.physics.registry import make_effect
    >>> effect_table(make_effect({"name": "shupe", "axes": ["x"], "sensitivity": 0.4, "lag": 180.0}))
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
        Lines of comment to begin with.

    Examples
    --------
    >>> print(model_text({"noise": {"x": {"N": 0.003}}, "effect": [{"name": "warm_up", "axes": ["x"], "amplitude": 0.5}]}))
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
            lines += _section(name, table)
        else:
            for item in table:
                lines += [f"[[{name}]]", *_pairs(item), ""]
    return "\n".join(lines)


def _section(name: str, table: Mapping[str, Any]) -> list[str]:
    flat = {key: value for key, value in table.items() if not isinstance(value, Mapping)}
    lines = [f"[{name}]", *_pairs(flat), ""] if flat or not table else []
    for key, value in table.items():
        if isinstance(value, Mapping):
            lines += _section(f"{name}.{_key(key)}", value)
    return lines


def _pairs(table: Mapping[str, Any]) -> list[str]:
    return [f"{_key(key)} = {_value(value)}" for key, value in table.items() if value is not None]


def _key(key: str) -> str:
    return (
        key
        if key and all(letter.isascii() and (letter.isalnum() or letter in "_-") for letter in key)
        else _quoted(key)
    )


def _quoted(text: str) -> str:
    """A basic string of TOML: as that of JSON, but for DEL, and for halves of surrogate pairs, which have no place in a file."""
    return json.dumps(text.encode("utf-8", "replace").decode("utf-8"), ensure_ascii=False).replace(
        "\x7f", "\\u007f"
    )


def _value(value: Any) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return "nan" if math.isnan(value) else repr(value)
    if isinstance(value, list | tuple | np.ndarray):
        return f"[{', '.join(_value(item) for item in value)}]"
    return _quoted(str(value))

"""Hold a diagnosis: the contents of `diagnosis.json`, and the model as TOML."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.result.families import group_families
from gyrostab.diagnose.result.record_text import (
    delay_texts,
    join_axes,
    joined_statements,
    noise_texts,
    summary,
)
from gyrostab.diagnose.result.text import (
    chance_share,
    family_text,
    next_measurement,
    probability_text,
    without_chance,
)
from gyrostab.diagnose.settings import Settings, stored_settings
from gyrostab.diagnose.statistics.mismatch_wording import COARSE_ANGLE_GRID
from gyrostab.physics.base import Effect


@dataclass(frozen=True)
class Diagnosis:
    """Where a recording differs from its simulation, and which physics explains it.

    Attributes
    ----------
    content : mapping
        The contents of `diagnosis.json` as plain data; `gyrostab.diagnose.result.content.Content`
        lists the keys.
    surfaces : xarray.Dataset
        Allan variances and means of the recording, and of the simulation without and with the
        effects.
    model : mapping
        Tables of the simulation with the effects added, as `gyrostab.read_model` takes them.
    """

    content: Mapping[str, Any]
    surfaces: xr.Dataset
    model: Mapping[str, Any]

    @property
    def verdict(self) -> str:
        """One of `content.VERDICTS`."""
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
        return stored_settings(self.content["settings"])

    def to_json(self) -> str:
        """Return the contents as JSON."""
        return json.dumps(self.content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"

    def __repr__(self) -> str:
        """Return the verdict with a sentence for each effect and each unexplained mismatch."""
        lines = [f"{self.verdict}: {summary(self.content)}"]
        for effect, *others in join_axes(group_families(self.effects)):
            evidence = effect["held_out_gain"]
            has_family = effect.get("family") is not None
            if has_family:
                lines.append(f"- {effect['name']}: {effect['statement']}")
            else:
                first, *more = joined_statements([effect, *others])
                lines += [f"- {effect['name']}: {first}", *(f"  {text}" for text in more)]
            if others and has_family:
                lines.append(f"  {family_text(effect, others)}")
            lines.append(
                f"  evidence: {evidence['nats']:.3g} nats "
                f"(threshold against chance: {evidence['threshold']:.2g} nats)"
            )
            if sure := probability_text(effect):
                lines.append(f"  {sure}")
            if step := next_measurement(effect["name"], effect["alternatives"]):
                lines.append(f"  {step}")
        lines += [f"- {text}" for text in delay_texts(self.content)]
        lines += [
            f"- channel {channel['name']} is not used: {channel['reason']}"
            for channel in self.content.get("unused_channels", [])
        ]
        if self.content["unexplained"] and any(
            limit["reason"] == COARSE_ANGLE_GRID for limit in self.content["not_found"].values()
        ):
            lines.append(
                "- The values lie on a coarse quantization grid of angles: the rounding of an "
                "angle counter may cause what is not explained."
            )
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
        return "\n".join([*lines, *noise_texts(self.content)])


def to_json_types(value: Any) -> Any:
    """Convert a value to what JSON allows.

    NumPy numbers become Python's, times ISO 8601, and values that are not finite null.

    Examples
    --------
    >>> to_json_types({"a": np.float64(0.5), "b": [np.nan, np.int64(3)]})
    {'a': 0.5, 'b': [None, 3]}
    >>> to_json_types(np.datetime64("2026-03-01T12:00", "ns"))
    '2026-03-01T12:00:00.000Z'
    """
    if isinstance(value, Mapping):
        return {str(key): to_json_types(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return to_json_types(value.tolist() if value.dtype.kind != "M" else list(value))
    if isinstance(value, np.datetime64):
        return None if np.isnat(value) else f"{value.astype('datetime64[ms]')}Z"
    if isinstance(value, list | tuple):
        return [to_json_types(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, str):  # names of files may hold bytes that UTF-8 does not allow
        return value.encode("utf-8", "replace").decode()
    return value


def tabulate_effect(effect: Effect) -> dict[str, Any]:
    """Return an effect as its table in a model, with the parameters that differ from defaults.

    Examples
    --------
    >>> from gyrostab.physics.registry import make_effect
    >>> shupe = {"name": "shupe", "axes": ["x"], "sensitivity": 0.4, "lag": 180.0}
    >>> tabulate_effect(make_effect(shupe))
    {'name': 'shupe', 'axes': ['x'], 'sensitivity': 0.4, 'lag': 180.0}
    """
    table: dict[str, Any] = {"name": effect.name}
    if effect.axes:
        table["axes"] = list(effect.axes)
    if effect.driver:
        table["driver"] = list(effect.driver)
    for parameter in effect.parameters():
        value = getattr(effect, parameter.name)
        if value != parameter.default:  # None where a model must give it
            table[parameter.name] = list(value) if isinstance(value, tuple) else value
    return table


def model_text(model: Mapping[str, Any], *, heading: str = "") -> str:
    """Write a model as TOML: tables ``noise``, ``log``, lists ``effect``, ``environment``.

    Examples
    --------
    >>> effect = {"name": "warm_up", "axes": ["x"], "amplitude": 0.5}
    >>> print(model_text({"noise": {"x": {"N": 0.003}}, "effect": [effect]}))
    [noise.x]
    N = 0.003
    <BLANKLINE>
    [[effect]]
    name = "warm_up"
    axes = [
        "x",
    ]
    amplitude = 0.5
    <BLANKLINE>
    """
    import tomli_w

    tables = {name: table for name, table in model.items() if isinstance(table, Mapping) or table}
    printable = ("".join(filter(str.isprintable, line)) for line in heading.splitlines())
    comment = "".join(f"# {line}\n" for line in printable)
    return f"{comment}\n" * bool(comment) + tomli_w.dumps(_to_toml(tables))


def _to_toml(value: Any) -> Any:
    """Convert a value to what TOML allows; keys without a value are left out."""
    if isinstance(value, Mapping):
        return {key: _to_toml(item) for key, item in value.items() if item is not None}
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_to_toml(item) for item in value]
    if isinstance(value, bool | int | float):
        return value
    return str(value).encode("utf-8", "replace").decode("utf-8")  # no halves of surrogate pairs

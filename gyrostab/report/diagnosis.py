"""Write the report of a diagnosis: one self-contained HTML file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gyrostab.diagnose.result.content import check_diagnosis
from gyrostab.diagnose.result.diagnosis import Diagnosis
from gyrostab.diagnose.result.families import group_families
from gyrostab.diagnose.result.record_text import noise_texts, span_seconds, summary
from gyrostab.diagnose.result.text import (
    chance_share,
    family_text,
    next_measurement,
    plain_name,
    probability_text,
    rejection_text,
    without_chance,
)
from gyrostab.diagnose.statistics.wording import axes_text, length_text
from gyrostab.noise import LAWS
from gyrostab.plot.style import unit_symbol
from gyrostab.report.charts import page_text
from gyrostab.report.diagnosis_charts import diagnosis_charts
from gyrostab.store.output import new_output
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

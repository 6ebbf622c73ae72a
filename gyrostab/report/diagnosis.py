"""The page of a diagnosis: one HTML file that needs nothing beside it, in the words of people who run the tool."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gyrostab.diagnose.result.diagnosis import Diagnosis, check_diagnosis
from gyrostab.diagnose.result.text import (
    axes_text,
    chance_share,
    length_text,
    next_measurement,
    plain_name,
    summary,
    without_chance,
)
from gyrostab.noise import LAWS
from gyrostab.plot.style import embedded
from gyrostab.report.page import page_text
from gyrostab.store.output import new_output

__all__ = ["write_diagnosis_report"]

_VIEWS = {
    "davar": "noise over time and averaging time (dynamic Allan variance)",
    "mean": "mean rate over time",
    "cross_axis": "what the axes have in common",
    "spectrum": "lines in the spectrum",
    "distribution": "distribution of the samples",
    "restart": "what follows a restart",
}
_SOURCE = {
    "calibrated": "calibrated on quiet stretches of this recording",
    "model": "the model given",
    "simulation": "the simulated log given",
}
#: What the file says for programs, for people.
_REASON = {"below limit": "looked for, not seen"}


def write_diagnosis_report(
    diagnosis: Diagnosis, path: str | os.PathLike[str], *, overwrite: bool = False
) -> Path:
    """Write the page of a diagnosis.

    Parameters
    ----------
    diagnosis : Diagnosis
        What `gyrostab.diagnose` returns or `gyrostab.open_diagnosis` opens.
    path : path-like
        The HTML file to make.
    overwrite : bool
        Replace an existing file.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    SchemaError
        When the content is not that of a diagnosis.
    OutputError
        When the file exists, or cannot be written.
    """
    content = diagnosis.content
    check_diagnosis(content)
    with new_output(path, overwrite=overwrite) as temporary:
        text = page_text(
            "diagnosis.html.jinja",
            title="Gyro diagnosis",
            recording=_recording(content),
            verdict=content["verdict"],
            summary=summary(content),
            facts=_facts(content),
            effects=[_effect(effect, content) for effect in content["effects"]],
            mismatches=[_mismatch(box, content) for box in content["mismatches"]],
            figures=_figures(diagnosis),
            proof=_proof(content),
            limits=_limits(content),
            noise=_noise(content),
            level=f"{100.0 * content['false_alarm_level']:g} %",
            # the other half of the level is for places
            rare=f"{50.0 * content['false_alarm_level']:g} %",
        )
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def _number(value: Any, digits: int = 3) -> str:
    if value is None or not np.isfinite(value):
        return "–"
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"


def _stamp(text: str) -> str:
    return text.removesuffix("Z").split(".")[0].replace("T", " ")


def _recording(content: Mapping[str, Any]) -> str:
    return ", ".join(Path(name).name for name in content["recording"]["files"]) or "not recorded"


def _facts(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    recording, baseline = content["recording"], content["baseline"]
    length = (
        np.datetime64(recording["end"].removesuffix("Z"))
        - np.datetime64(recording["start"].removesuffix("Z"))
    ) / np.timedelta64(1, "s")
    spans = "; ".join(
        f"{_stamp(first)} to {_stamp(last)}" for first, last in baseline["calibrated_on"][:6]
    )
    more = len(baseline["calibrated_on"]) - 6
    expected = " ".join(one["statement"] for one in baseline.get("expected", []))
    return [
        ("Recording", _recording(content)),
        (
            "Span (UTC)",
            f"{_stamp(recording['start'])} to {_stamp(recording['end'])}, {length_text(float(length))}",
        ),
        (
            "Axes, sampling rate",
            f"{', '.join(recording['axes'])} at {recording['sampling_rate_hz']:g} Hz",
        ),
        ("Channels", ", ".join(recording["channels"]) or "none"),
        *([("Channels not used", _unused_text(content))] if content.get("unused_channels") else []),
        ("Missing samples", f"{100.0 * recording['missing_share']:.2g} %"),
        ("Simulation compared with", _source_text(baseline)),
        *([("Expected, with the size it has here", expected)] if expected else []),
        *(
            [("Quiet stretches (UTC)", spans + (f" and {more} more" if more > 0 else ""))]
            if spans
            else []
        ),
        ("Time taken", f"{content['seconds']:.3g} s"),
    ]


def _unused_text(content: Mapping[str, Any]) -> str:
    """List the channels that took no part, each with the reason."""
    return "; ".join(f"{one['name']}: {one['reason']}" for one in content["unused_channels"])


def _source_text(baseline: Mapping[str, Any]) -> str:
    """Say where the noise of the simulation comes from."""
    text = _SOURCE[baseline["source"]]
    is_scaled = baseline["source"] == "model" and baseline["calibrated_on"]
    return f"{text}, its noise scaled to quiet stretches of this recording" if is_scaled else text


def _effect(effect: Mapping[str, Any], content: Mapping[str, Any]) -> dict[str, Any]:
    gain = effect["held_out_gain"]
    return {
        "title": f"{plain_name(effect['name'])[0].upper()}{plain_name(effect['name'])[1:]}, {axes_text(effect['axes'])}",
        "name": effect["name"],
        "driver": effect["driver"] or "",
        "statement": effect["statement"],
        "rows": [
            {
                "name": name.replace("_", " "),
                "value": _number(entry["value"]),
                "range": f"{_number(entry['low'])} to {_number(entry['high'])}",
                "unit": "" if entry["unit"] == "1" else entry["unit"],
            }
            for name, entry in effect["parameters"].items()
        ],
        "gain": f"{_number(gain['nats'])} ± {_number(gain['stderr'], 2)} nats (chance reaches {_number(gain['threshold'], 2)})",
        "alternatives": [f"{plain_name(name)} ({name})" for name in effect["alternatives"]],
        "next": next_measurement(effect["name"], effect["alternatives"]),
        "boxes": [
            box["id"]
            for box in content["mismatches"]
            if effect["name"] in box["explained_by"] and set(effect["axes"]) & set(box["axes"])
        ],
    }


def _mismatch(box: Mapping[str, Any], content: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "id": box["id"],
        "view": _VIEWS[box["view"]],
        "statement": without_chance(box["statement"]),
        "chance": chance_share(box["p_value"]),
        "explained": "; ".join(plain_name(name) for name in box["explained_by"])
        or ("not explained" if box["id"] in content["unexplained"] else "–"),
    }


def _proof(content: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """What is measured, before, after, and how to read it."""
    held = content["held_out"]

    def share(value: Any) -> str:
        return "–" if value is None else f"{100.0 * value:.3g} %"

    forecast = "–" if held["forecast_gain"] is None else f"{_number(held['forecast_gain'])} nats"
    gain = f"{_number(held['log_likelihood_gain'])} ± {_number(held['stderr'], 2)} nats"
    return [
        (
            "Log-likelihood of time kept apart",
            "0",
            gain,
            "Every stretch is predicted from the others. Above 0 is better; 5 nats are 150 to 1.",
        ),
        (
            "Misfit of the surface (mean z²)",
            _number(held["misfit_before"]),
            _number(held["misfit_after"]),
            "1 is what noise alone gives.",
        ),
        (
            "Cells inside their 95 % band",
            share(held["coverage95_before"]),
            share(held["coverage95_after"]),
            "95 % is right.",
        ),
        (
            "Forecast of the last 30 %",
            "0",
            forecast,
            "Fitted on the first 70 % only. A dash: no effect acts in both.",
        ),
    ]


def _limits(content: Mapping[str, Any]) -> list[dict[str, str]]:
    rows = []
    for name, entry in content["not_found"].items():
        unit = "" if entry["unit"] in (None, "1") else f" {entry['unit']}"
        limit = (
            "–" if entry["upper_limit"] is None else f"< {_number(entry['upper_limit'], 2)}{unit}"
        )
        rows.append(
            {
                "name": name,
                "plain": plain_name(name),
                "limit": limit,
                "reason": _REASON.get(entry["reason"], entry["reason"]),
            }
        )
    return sorted(rows, key=lambda row: (row["limit"] == "–", row["name"]))


def _noise(content: Mapping[str, Any]) -> list[dict[str, str]]:
    rows = []
    for axis, terms in content["baseline"]["noise"].items():
        for symbol, entry in terms.items():
            error = "" if entry["stderr"] is None else f" ± {_number(entry['stderr'], 2)}"
            rows.append(
                {
                    "axis": axis,
                    "term": f"{symbol}, {LAWS[symbol].name}",
                    "value": f"{_number(entry['value'])}{error}",
                    "unit": entry["unit"],
                }
            )
    return rows


def _figures(diagnosis: Diagnosis) -> list[dict[str, str]]:
    from gyrostab.plot.diagnosis import (
        plot_change,
        plot_deviations,
        plot_means,
        plot_spectra,
        plot_surfaces,
    )

    surfaces, content = diagnosis.surfaces, diagnosis.content
    return [
        embedded(
            plot_surfaces(surfaces, content),
            "Recording, simulation before and after",
            _READ["surfaces"],
        ),
        embedded(plot_change(surfaces, content), "Where they differ", _READ["change"]),
        embedded(
            plot_means(surfaces, content), "Mean rate over time, and what drives it", _READ["means"]
        ),
        embedded(
            plot_deviations(surfaces), "Allan deviation of the whole record", _READ["deviations"]
        ),
        embedded(plot_spectra(surfaces), "Power spectrum of the whole record", _READ["spectra"]),
    ]


#: How to read each figure.
_READ = {
    "surfaces": (
        "Colour is the Allan deviation: how much the rate, averaged over the time on the vertical axis, differs from one average to the "
        "next. All panels have the same colours. A red frame, numbered as in the table above, is a place where the recording differs from "
        "the simulation before; the simulation after has the named effects in it and should look like the recording."
    ),
    "change": (
        "The recording divided by the simulation: white where they agree, orange where the recording is noisier, purple where it is "
        "quieter. Pale cells lie within what chance does in 95 of 100 cells; full colours are what counts, and a few scattered ones are "
        "chance too. Right: what is left with the effects added."
    ),
    "means": (
        "What is constant within a window does not show in the figures above, but here: each dot is the mean rate of a short block. The "
        "simulation before knows no reason for the mean to move. Red bars are the numbered mismatches of the mean rate. Beneath: channels."
    ),
    "deviations": (
        "All windows together. Dots are the recording; where they leave the dashed line, the simulation before is wrong. Where both lines "
        "are one, the named effects change nothing."
    ),
    "spectra": "Grey is the recording at full resolution, so that narrow lines show; the lines are the simulations, averaged over bands.",
}

"""Overview page of many runs: failures, tools, noise over time, and links to the reports."""

from __future__ import annotations

import os
import re
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from gyrostab.diagnose.result.content import VERDICTS
from gyrostab.noise import LAWS
from gyrostab.plot.style import (
    COLOURS,
    GREY,
    INCH_MM,
    PAGE_MM,
    draws_figure,
    encode_png,
    label_log_axis,
    new_figure,
    time_axis,
    unit_label,
    unit_symbol,
)
from gyrostab.report.charts import page_text
from gyrostab.store.output import new_output
from gyrostab.store.remote import find_url, upload_file
from gyrostab.time.durations import format_duration
from gyrostab.units import HOUR
from gyrostab.wording import format_rounded

_PANEL_MM = 45.0
_MAX_CHANCE = 0.05  # probability that chance alone shows any trend


def write_overview(
    table: pd.DataFrame,
    path: str | os.PathLike[str],
    *,
    effects: pd.DataFrame | None = None,
    trends: pd.DataFrame | None = None,
    overwrite: bool = False,
) -> Path:
    """Write the overview of many runs as one self-contained HTML file.

    `table` is what `gyrostab.jobs.fleet.run_fleet` returns, `effects` and `trends` are from
    `gyrostab.jobs.fleet_table`. Links to reports are relative to the folder of the file.
    """
    done, failed = table[table["error"] == ""], table[table["error"] != ""]
    axes = _find_axes(table)
    path = Path(path)
    with upload_file(path) as place, new_output(place, overwrite=overwrite) as temporary:
        text = page_text(
            "fleet.html.jinja",
            title="Gyro stability of a fleet",
            summary=_summarise_fleet(table, done, failed),
            failed=failed[["run", "error"]].to_dict("records"),
            terms=[(term, unit_symbol(LAWS[term].label)) for term in LAWS],
            axes=axes,
            tools=[_describe_tool(str(tool), part, axes) for tool, part in done.groupby("tool")],
            effects=[] if effects is None else combine_effects(effects, done),
            trend_count=0 if trends is None else len(trends),
            trends=[] if trends is None else _describe_trends(trends),
            runs=[_describe_run(row, axes, path.parent) for row in done.to_dict("records")],
            figures=[
                {
                    "png": encode_png(_plot_noise(done, axes)),
                    "name": "noise",
                    "alt": "N of each run over time",
                }
            ]
            if len(done) and axes
            else [],
        )
        temporary.write_text(text, encoding="utf-8")
    return path


def _find_axes(table: pd.DataFrame) -> list[str]:
    """Find the axes in the names of the columns, ``N_x [deg/sqrt(h)]``."""
    pattern = re.compile(re.escape(_column_name("N", "AXIS")).replace("AXIS", "(.+)"))
    names = [match[1] for match in map(pattern.fullmatch, map(str, table.columns)) if match]
    return sorted(name for name in names if not name.endswith("_upper"))


def _column_name(term: str, axis: str, kind: str = "") -> str:
    return f"{term}_{axis}{kind} [{LAWS[term].label}]"


def _summarise_fleet(table: pd.DataFrame, done: pd.DataFrame, failed: pd.DataFrame) -> str:
    runs, tools = len(table), table["tool"].nunique()
    text = f"{runs} run{'s' * (runs != 1)} of {tools} tool{'s' * (tools != 1)}"
    if len(done):
        hours = done["span [s]"].sum() / HOUR
        first, last = (f"{time:%Y-%m-%d}" for time in (done["start"].min(), done["end"].max()))
        days = f"on {first}" if first == last else f"from {first} to {last}"
        text += f", {hours:.{0 if hours >= 100 else 1}f} h of logs {days}"
    return text + (f". {len(failed)} failed." if len(failed) else ". None failed.")


def _describe_tool(tool: str, part: pd.DataFrame, axes: list[str]) -> dict[str, Any]:
    """Give the median and range of each term over the runs of a tool, by axis."""
    cells = []
    for term in LAWS:
        lines = []
        for axis in axes:
            values = part[_column_name(term, axis)].dropna()
            if len(values):
                low, middle, high = np.quantile(values, [0.0, 0.5, 1.0])
                lines.append(f"{axis} {middle:.3g} ({low:.3g} to {high:.3g})")
        cells.append(lines)
    return {"tool": tool or "–", "runs": len(part), "cells": cells}


def combine_effects(effects: pd.DataFrame, done: pd.DataFrame) -> list[dict[str, Any]]:
    """Combine the effects of the same name over the diagnosed runs of each tool."""
    diagnosed = done[done["verdict"].isin(VERDICTS)].groupby("tool").size()
    rows = []
    for (tool, effect), part in effects.groupby(["tool", "effect"]):
        single = part.drop_duplicates(["run", "axes", "evidence [nats]"])
        rows.append(
            {
                "tool": tool or "–",
                "effect": effect,
                "seen": f"{part['run'].nunique()} of {diagnosed.get(tool, 0)} diagnosed runs",
                "axes": ", ".join(sorted({axis for axes in part["axes"] for axis in axes.split()})),
                "evidence": f"{single['evidence [nats]'].sum():.3g}",
                "sizes": [_describe_size(size) for size in part.to_dict("records")],
            }
        )
    return rows


def _describe_size(size: Mapping[Any, Any]) -> str:
    """Describe a parameter of one run with its interval."""
    text = f"{size['run']}, {size['axes'] or 'all axes'}"
    if pd.isna(size["value"]):
        return text
    interval = "" if pd.isna(size["low"]) else f" ({size['low']:.3g} to {size['high']:.3g})"
    return f"{text}: {size['parameter']} {size['value']:.3g}{interval} {size['unit']}"


def _describe_trends(trends: pd.DataFrame) -> list[dict[Hashable, Any]]:
    """Describe the trends that are not chance, the clearest first."""
    clear = trends[trends["p_value"] < _MAX_CHANCE].sort_values("p_value")
    return [
        {
            **row,
            **{key: _show_unit(row[key]) for key in ("quantity", "against")},
            "slope": f"{row['slope']:.3g} ({row['low']:.3g} to {row['high']:.3g})",
            "p_value": f"{row['p_value']:.2g}",
        }
        for row in clear.to_dict("records")
    ]


def _show_unit(column: str) -> str:
    """Write the unit at the end of the name of a column with symbols."""
    name, _, unit = column.partition(" [")
    return f"{name} {unit_label(unit.rstrip(']') or None)}".strip()


def _describe_run(row: Mapping[Any, Any], axes: list[str], folder: Path) -> dict[str, Any]:
    ratio = row["worst_ratio"]
    report, diagnosis = row["report"], row["diagnosis"]
    return {
        "name": row["run"],
        "link": quote(report) if report else "",
        "tool": row["tool"],
        "start": f"{row['start']:%Y-%m-%d %H:%M}",
        "length": format_duration(row["span [s]"], " "),
        "seconds": row["span [s]"],
        "rate": f"{row['rate [Hz]']:.6g}",
        "missing": f"{100.0 * row['missing_share']:.3g}",
        "cells": [_describe_term(row, term, axes) for term in LAWS],
        "worst": f"{row['worst_window']:%Y-%m-%d %H:%M}, {row['worst_axis']} {ratio:.3g} times"
        if np.isfinite(ratio)
        else "–",
        "ratio": ratio,
        "verdict": row["verdict"] or "–",
        "diagnosis": _link_diagnosis(Path(diagnosis, "report.html"), folder) if diagnosis else "",
    }


def _link_diagnosis(page: Path, folder: Path) -> str:
    """Link to the report of a diagnosis: relative if it and the overview are in folders."""
    if url := find_url(page):
        return quote(url, safe="/:")
    if find_url(folder):
        return page.absolute().as_uri()
    return quote(os.path.relpath(page, folder.absolute()))


def _describe_term(row: Mapping[Any, Any], term: str, axes: list[str]) -> dict[str, Any]:
    """Give the medians of a term by axis, or upper limits, and the largest for sorting."""
    texts, values = [], [0.0]
    for axis in axes:
        value, limit = (row.get(_column_name(term, axis, kind), np.nan) for kind in ("", "_upper"))
        if np.isfinite(value):
            texts.append(format_rounded(value, 3))
            values.append(float(value))
        else:
            texts.append(f"< {format_rounded(limit)}" if np.isfinite(limit) else "–")
    return {"text": " / ".join(texts), "value": max(values)}


@draws_figure
def _plot_noise(done: pd.DataFrame, axes: list[str]) -> Any:
    height = (_PANEL_MM * len(axes) + 15.0) / INCH_MM
    figure = new_figure(PAGE_MM / INCH_MM, height)
    panels = figure.subplots(len(axes), sharex=True, squeeze=False)[:, 0]
    times = (done["start"] + (done["end"] - done["start"]) / 2).to_numpy()
    common = list(done["tool"].value_counts().index[: len(COLOURS)])
    for panel, axis in zip(panels, axes, strict=True):
        values = done[_column_name("N", axis)].to_numpy()
        is_other = ~done["tool"].isin(common).to_numpy()
        panel.plot(times[is_other], values[is_other], "o", color=GREY, markersize=3)
        for tool, colour in zip(common, COLOURS, strict=False):
            part = (done["tool"] == tool).to_numpy()
            label = str(tool) or None
            panel.plot(times[part], values[part], "o", color=colour, markersize=3, label=label)
        if np.nanmin(values, initial=np.inf) > 0 and np.isfinite(values).any():
            panel.set_yscale("log")
            label_log_axis(panel.yaxis, *panel.get_ylim())
        panel.set_ylabel(f"N_{axis} [{unit_symbol(LAWS['N'].label)}]")
    time_axis(panels[-1], np.array([]))
    if any(common):
        panels[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure

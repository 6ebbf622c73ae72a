"""Figures of a benchmark: completeness, names, probabilities, ranks, detectors."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from gyrostab.plot import COLOURS, MARKERS, new_figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS = 5
_LABELS = {
    "detected": "detected",
    "named": "named correctly (or unidentified, if out of catalogue)",
}


def draw_completeness(curves: pd.DataFrame) -> Figure:
    """Plot shares detected and named against strength, one panel per effect, with intervals.

    The first panel shows all effects.
    """
    names = list(dict.fromkeys(curves["effect"])) if len(curves) else []
    down = max(1, math.ceil(len(names) / _COLUMNS))
    figure = new_figure(2.4 * _COLUMNS, 1.8 * down + 0.6)
    panels: Any = figure.subplots(down, _COLUMNS, sharex=True, sharey=True, squeeze=False)
    for place, panel in enumerate(panels.flat):
        if place < len(names):
            part = curves[curves["effect"] == names[place]]
            _draw_panel(panel, part, names[place].replace("_", " "))
        else:
            panel.set_axis_off()
    figure.supxlabel("strength, in units of the closed-form limit")
    figure.supylabel("share of the cases, with 95 % interval")
    if names:
        figure.legend(
            *panels.flat[0].get_legend_handles_labels(),
            loc="outside upper center",
            ncols=2,
            frameon=False,
        )
    return figure


def _draw_panel(panel: Axes, part: pd.DataFrame, title: str) -> None:
    for number, key in enumerate(("detected", "named")):
        share = part[key].to_numpy()
        reach = [share - part[f"{key}_low"].to_numpy(), part[f"{key}_high"].to_numpy() - share]
        panel.errorbar(
            part["strength"].to_numpy() * (0.97, 1.03)[number],
            share,
            yerr=[limit.clip(min=0.0) for limit in reach],
            color=COLOURS[number],
            marker=MARKERS[number],
            markersize=4,
            linewidth=1.2,
            elinewidth=0.7,
            label=_LABELS[key],
        )
    panel.set_title(f"{title} ({int(part['n'].sum())})", fontsize="small")
    panel.set_xscale("log", base=2)
    panel.set_xticks([0.5, 1, 2, 4, 8, 16, 32], ["0.5", "1", "2", "4", "8", "16", "32"])
    panel.set_ylim(-0.05, 1.05)
    panel.axvline(1.5, color="#8c8c8c", linewidth=0.7, linestyle=":")


def draw_reliability(reliability: pd.DataFrame) -> Figure:
    """Plot the share of correct identifications of each name, with Wilson's interval."""
    figure = new_figure(6.5, 1.2 + 0.26 * max(3, len(reliability)))
    panel: Any = figure.subplots()
    identifications: list[Any] = reliability.to_dict("records")
    for place, identification in enumerate(identifications):
        panel.barh(place, identification["right"], color=COLOURS[2], height=0.6)
        panel.plot(
            [identification["low"], identification["high"]],
            [place, place],
            color="black",
            linewidth=1.0,
        )
    panel.set_yticks(
        range(len(identifications)),
        [
            f"{identification['name'].replace('_', ' ')} ({identification['n']})"
            for identification in identifications
        ],
    )
    panel.set_ylim(max(len(identifications), 1) - 0.4, -0.6)
    panel.set_xlim(0, 1)
    panel.set_xlabel("share of the identifications (number)\nthat are correct, with 95 % interval")
    return figure


def draw_calibration(curve: pd.DataFrame, risk: pd.DataFrame) -> Figure:
    """Plot the share of right names against their probability, and the risk of the likeliest."""
    figure = new_figure(7.0, 3.2)
    panels: Any = figure.subplots(1, 2)
    calibration, coverage = panels
    right = curve["right"].to_numpy()
    calibration.plot([0, 1], [0, 1], color="#8c8c8c", linewidth=0.7, linestyle=":")
    calibration.errorbar(
        curve["stated"].to_numpy(),
        right,
        yerr=[
            (right - curve["low"].to_numpy()).clip(min=0.0),
            (curve["high"].to_numpy() - right).clip(min=0.0),
        ],
        color=COLOURS[0],
        marker=MARKERS[0],
        linewidth=1.2,
        elinewidth=0.7,
    )
    calibration.set(
        xlim=(0, 1),
        ylim=(0, 1.02),
        xlabel="stated probability of the name",
        ylabel="share of names that are right,\nwith 95 % interval",
    )
    coverage.plot(
        risk["coverage"].to_numpy(),
        risk["risk"].to_numpy(),
        color=COLOURS[1],
        marker=MARKERS[1],
        markersize=3,
    )
    coverage.set(
        xlim=(0, 1),
        ylim=(0, None),
        xlabel="share of the records with effects\nthat have a name, most probable first",
        ylabel="share of these names\nthat are wrong",
    )
    return figure


def draw_ranks(histogram: pd.DataFrame) -> Figure:
    """Plot how often the truth has each rank in its estimate, and the range of exact estimates."""
    figure = new_figure(5.0, 3.0)
    panel: Any = figure.subplots()
    number = int(histogram["n"].sum())
    width = 1.0 / len(histogram)
    centre = [width * (place + 0.5) for place in range(len(histogram))]
    panel.bar(centre, histogram["n"], width=0.9 * width, color=COLOURS[2])
    low, high = int(histogram["low"].iloc[0]), int(histogram["high"].iloc[0])
    panel.axhspan(low, high, color="#dcdcdc", zorder=0)
    panel.axhline(number * width, color="black", linewidth=0.7, linestyle=":")
    panel.set(
        xlim=(0, 1),
        xlabel="rank of the true parameter in its estimate",
        ylabel=f"parameters (of {number})",
    )
    return figure


def draw_roc(curves: pd.DataFrame) -> Figure:
    """Plot the share of cases detected against the share of false alarms, for each detector.

    The axis of false alarms is logarithmic above one in a hundred, and linear below.
    """
    figure = new_figure(8.0, 4.2)
    groups = list(dict.fromkeys(curves["cases"])) or [""]
    panels: Any = figure.subplots(1, len(groups), sharey=True, squeeze=False)
    for panel, group in zip(panels.flat, groups, strict=True):
        part = curves[curves["cases"] == group]
        for place, name in enumerate(dict.fromkeys(part["detector"])):
            mine = part[part["detector"] == name]
            colour, marker = COLOURS[place % len(COLOURS)], MARKERS[place % len(MARKERS)]
            points, operating_point = mine[~mine["own"]], mine[mine["own"]]
            panel.step(
                points["false_alarms"],
                points["detected"],
                where="post",
                color=colour,
                linewidth=1.2,
            )
            panel.plot(
                operating_point["false_alarms"],
                operating_point["detected"],
                marker,
                color=colour,
                markersize=6,
                label=name,
            )
        panel.set_xscale("symlog", linthresh=0.01, linscale=0.3)
        panel.set_xticks([0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1])
        panel.set_xticks([], minor=True)
        panel.set_xticklabels(["0", "1", "2", "5", "10", "20", "50", "100"])
        panel.set(xlim=(-0.001, 1.0), ylim=(0, 1.02), xlabel="false alarms [%]")
        panel.set_title(group, fontsize="small")
    panels.flat[0].set_ylabel("share of the cases detected")
    if len(curves):
        figure.legend(
            *panels.flat[0].get_legend_handles_labels(),
            loc="outside upper center",
            ncols=3,
            frameon=False,
        )
    return figure

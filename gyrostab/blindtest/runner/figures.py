"""The curves of a benchmark: what is found and named against strength, and how often a name that is given is right."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

__all__ = ["draw_completeness", "draw_reliability"]

_ACROSS = 5
_POOLS = (1.5, 4.0)  # below the first: too faint to be asked for
_LABELS = {
    "detected": "detected",
    "named": "named rightly (called unknown, where no catalogue holds it)",
}


def draw_completeness(curves: pd.DataFrame) -> Callable[[Path], None]:
    """Prepare a panel for each effect: shares detected and named against strength, with Wilson's intervals.

    One effect has few cases of each strength, so those of like strength are pooled; the first panel
    is of all.
    """
    from gyrostab.plot.style import new_figure, save_png

    names = list(dict.fromkeys(curves["effect"])) if len(curves) else []
    down = max(1, math.ceil(len(names) / _ACROSS))
    figure = new_figure(2.4 * _ACROSS, 1.8 * down + 0.6)
    panels: Any = figure.subplots(down, _ACROSS, sharex=True, sharey=True, squeeze=False)
    for place, panel in enumerate(panels.flat):
        if place < len(names):
            part = curves[curves["effect"] == names[place]]
            _panel(
                panel,
                part if names[place] == "all" else _pooled(part),
                names[place].replace("_", " "),
            )
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
    return lambda target: save_png(figure, target, colours=64)


def _pooled(part: pd.DataFrame) -> pd.DataFrame:
    """The same with few strengths: each the (geometric) middle of those from one limit to the next, weighted by their cases."""
    import numpy as np
    import pandas as pd

    from gyrostab.blindtest.scoring.proportions import wilson

    out = []
    for _, group in part.groupby(np.digitize(part["strength"], _POOLS)):
        number = int(group["n"].sum())
        line: dict[str, Any] = {
            "strength": float(np.exp(np.average(np.log(group["strength"]), weights=group["n"]))),
            "n": number,
        }
        for key in ("detected", "named"):
            hits = round(float((group[key] * group["n"]).sum()))
            low, high = wilson(hits, number)
            line |= {key: hits / number, f"{key}_low": low, f"{key}_high": high}
        out.append(line)
    return pd.DataFrame(out)


def _panel(panel: Axes, part: pd.DataFrame, title: str) -> None:
    from gyrostab.plot.style import COLOURS, MARKERS

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
    panel.set_xticks([0.5, 1, 2, 4, 8], ["0.5", "1", "2", "4", "8"])
    panel.set_ylim(-0.05, 1.05)
    panel.axvline(1.5, color="#8c8c8c", linewidth=0.7, linestyle=":")


def draw_reliability(reliability: pd.DataFrame) -> Callable[[Path], None]:
    """Prepare a bar for each name: the share of its claims that stand for something true, with Wilson's interval."""
    from gyrostab.plot.style import COLOURS, new_figure, save_png

    figure = new_figure(6.5, 1.2 + 0.26 * max(3, len(reliability)))
    panel: Any = figure.subplots()
    claims: list[Any] = reliability.to_dict("records")
    for place, claim in enumerate(claims):
        panel.barh(place, claim["right"], color=COLOURS[2], height=0.6)
        panel.plot([claim["low"], claim["high"]], [place, place], color="black", linewidth=1.0)
    panel.set_yticks(
        range(len(claims)),
        [f"{claim['name'].replace('_', ' ')} ({claim['n']})" for claim in claims],
    )
    panel.set_ylim(max(len(claims), 1) - 0.4, -0.6)
    panel.set_xlim(0, 1)
    panel.set_xlabel("share of the claims (number) that are right,\nwith 95 % interval")
    return lambda target: save_png(figure, target, colours=64)

"""What came out, as files that people and programs read: every score, the table, what was missed and what failed."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from gyrostab.blindtest.runner.figures import draw_completeness, draw_reliability
from gyrostab.blindtest.runner.folder import TUNING, write_text
from gyrostab.blindtest.scoring.curves import by_effect, curves, reliability
from gyrostab.blindtest.scoring.injections import injection_differences, injection_table
from gyrostab.blindtest.scoring.score import score_case
from gyrostab.blindtest.scoring.table import markdown, missed
from gyrostab.store.output import replace_file

__all__ = ["page_text", "score_rows", "write_outcome"]

Rows = list[dict[str, Any]]

#: Stands for the diagnosis of a case that has none: nothing was found in it.
_NOTHING = {
    "verdict": "no mismatch",
    "mismatches": [],
    "effects": [],
    "unexplained": [],
    "held_out": {},
    "seconds": math.nan,
}

_SHOWN = 40  # cases that a list holds


def score_rows(
    found: Mapping[str, dict[str, Any]],
    truths: Mapping[str, dict[str, Any]],
    naive: Mapping[str, Mapping[str, bool]],
) -> Rows:
    """All rows of `score_case` with the name of the case; a case without a diagnosis counts as nothing found."""
    return [
        {"name": name, "failed": name not in found, **row}
        for name, truth in truths.items()
        for row in score_case(found.get(name, _NOTHING), truth, naive=naive.get(name))
    ]


def write_outcome(
    folder: Path,
    rows: Rows,
    table: pd.DataFrame,
    *,
    job: Mapping[str, Any],
    sealed: str,
    failed: Mapping[str, str],
) -> list[Path]:
    """Write ``scores.csv``, ``table.md``, ``completeness.png`` and ``reliability.png``."""
    plain = [
        {
            key: json.dumps(value) if isinstance(value, list | dict | tuple) else value
            for key, value in row.items()
        }
        for row in rows
    ]
    targets = [
        folder / name for name in ("scores.csv", "table.md", "completeness.png", "reliability.png")
    ]
    write_text(targets[0], pd.DataFrame(plain).to_csv(index=False))
    write_text(targets[1], page_text(rows, table, job=job, sealed=sealed, failed=failed))
    for target, draw in zip(
        targets[2:],
        (draw_completeness(curves(rows)), draw_reliability(reliability(rows))),
        strict=True,
    ):
        with replace_file(target) as temporary:
            draw(temporary)
    return targets


def page_text(
    rows: Sequence[Mapping[str, Any]],
    table: pd.DataFrame,
    *,
    job: Mapping[str, Any],
    sealed: str,
    failed: Mapping[str, str],
) -> str:
    """The outcome in Markdown: how it was made, the table, the targets missed, the curves, and the cases that went wrong."""
    shown = curves(rows)
    every = shown[shown["effect"] == "all"] if len(shown) else shown
    drawn = [row for row in rows if row["kind"] not in ("salted", "control")]
    parts = [
        _made(rows, job, sealed),
        "### Figures with 95 % intervals and targets",
        "A target is *met* where the whole interval lies where it should, *missed* where the value does not, and else *not shown*: there "
        "are too few cases to tell.",
        markdown(table),
        "### Targets that were missed",
        _listed(missed(table), "none"),
        "### Completeness against strength",
        "Shares of all effects of the catalogue whose channel was there; strength in units of the closed-form limit.",
        markdown(every.drop(columns="effect")) if len(every) else "no effects among these cases",
        "### Effect by effect",
        "*n*: cases at 1.5 times the limit and more, and the shares of them that were *detected*, *named* (ambiguity sets merged) and "
        "named *exactly*. *claims*: how often the name was given in all cases, and the share of these that stands for something true "
        "(*right*). *numbers*: parameters that can be compared, and the share whose 95 % interval holds the truth (*held*).",
        markdown(by_effect(rows)),
        "### Wrong names",
        _listed([_wrong(row) for row in _cases(drawn) if row["wrong"]], "none"),
        "### Clear effects that were missed",
        _listed(
            [
                _silent(row)
                for row in drawn
                if row["effect"] and row["strength"] >= 1.5 and not row["detected"]
            ],
            "none",
        ),
        "### Real recordings with salt",
        *_salted(rows),
        "### What it cost",
        markdown(_cost(drawn)),
        "### Diagnoses that failed",
        _listed([f"{name}: {why}" for name, why in failed.items()], "none"),
    ]
    return "\n\n".join(parts) + "\n"


def _salted(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    found = injection_differences(rows)
    if not found:
        return [
            "None: the folder of the real recordings was not given to this run, or it had too few cases."
        ]
    lines = [
        f"{one['recording']}, {one['effect']} at {one['strength']:g}: "
        + ("named" if one["named"] else "not named")
        + (", and so it was without salt" if one["there_before"] else "")
        + "".join(f"; {label} {', '.join(one[key])}" for key, label in _TURNED.items() if one[key])
        for one in found
    ]
    about = (
        "An effect is added to a piece of a real recording, which holds effects of its own; so what counts is what is claimed beside that "
        "which is claimed of the untouched piece, by the salted one and by copies of the untouched one turned in sign and in time."
    )
    return [about, markdown(injection_table(rows)), _listed(lines, "none")]


_TURNED = {
    "before": "without salt",
    "others": "salt brings",
    "flipped": "turned in sign",
    "reversed": "turned in time",
}


def _cost(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Seconds that a diagnosis took, by rate and length."""
    each = pd.DataFrame(
        [{key: row[key] for key in ("rate", "length", "seconds")} for row in _cases(rows)]
    )
    each["length"] = pd.cut(
        each["length"],
        [0, 1200, 3600, 10800, math.inf],
        labels=["< 20 min", "< 1 h", "< 3 h", "longer"],
        right=False,
    )
    parts = each.groupby(["rate", "length"], observed=True)["seconds"]
    table = parts.agg(["count", "median", "max", "sum"]).reset_index()
    return table.rename(
        columns={
            "rate": "rate [Hz]",
            "median": "median [s]",
            "max": "longest [s]",
            "sum": "all [s]",
        }
    )


def _made(rows: Sequence[Mapping[str, Any]], job: Mapping[str, Any], sealed: str) -> str:
    kinds = pd.Series([row["kind"] for row in _cases(rows)]).value_counts()
    numbers = ", ".join(f"{number} {kind}" for kind, number in kinds.items())
    repeat = f"gyrostab prove --cases {job['cases']} --seed {job['seed']} --nulls {job['nulls']}"
    said = [
        f"{job['cases']} cases ({numbers}); begun {job['begun']}; {job['machine']}; code {' then '.join(job['code'])}.",
        f"Seed {job['seed']}, to be repeated with `{repeat}`.",
        f"SHA-256 of the list of sealed truths, taken before the first diagnosis: `{sealed}`.",
    ]
    if job["seed"] < TUNING:
        said.append(
            f"**This seed is one for tuning (below {TUNING:,}): these figures are not for publication.**"
        )
    if len(job["code"]) > 1:
        said.append(
            f"**The code changed {len(job['code']) - 1} times during this run: these figures are not those of one version.**"
        )
    return "  \n".join(said)


def _cases(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The first row of every case."""
    return list({row["name"]: row for row in reversed(rows)}.values())[::-1]


def _about(row: Mapping[str, Any]) -> str:
    held = f"{row['effect']} at {row['strength']:g}" if row["effect"] else "nothing"
    severed = f", channel {row['severing']}" if row["severing"] else ""
    record = f"{row['rate']:g} Hz, {row['length'] / 60:.0f} min, {100 * row['missing']:.0f} % lost"
    return f"{row['name']} ({row['kind']}{severed}, {record}): {held}"


def _wrong(row: Mapping[str, Any]) -> str:
    return f"{_about(row)}; named {', '.join(row['wrong_names'])}"


def _silent(row: Mapping[str, Any]) -> str:
    return f"{_about(row)}; {'its diagnosis failed' if row['failed'] else 'nothing was found'}"


def _listed(lines: Sequence[str], none: str) -> str:
    shown = [f"- {line}" for line in lines[:_SHOWN]] + (
        [f"- and {len(lines) - _SHOWN} more, see scores.csv"] if len(lines) > _SHOWN else []
    )
    return "\n".join(shown) or none

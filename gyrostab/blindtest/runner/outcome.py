"""Write the outcome of a benchmark: scores, table, figures, and lists of misses and failures."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gyrostab.blindtest.runner.figures import (
    draw_calibration,
    draw_completeness,
    draw_ranks,
    draw_reliability,
    draw_roc,
)
from gyrostab.blindtest.runner.folder import FIRST_PUBLIC_SEED
from gyrostab.blindtest.scoring.curves import (
    by_effect,
    curves,
    fitted_noise_curve,
    names_given,
    rank_histogram,
    reliability,
)
from gyrostab.blindtest.scoring.detection import (
    counterpart_table,
    detection_shares,
    injection_differences,
    injection_table,
    roc_curves,
)
from gyrostab.blindtest.scoring.probability import calibration_curve, risk_coverage
from gyrostab.blindtest.scoring.score import drawn_rows, first_rows, score_case
from gyrostab.blindtest.scoring.table import list_missed, markdown
from gyrostab.plot import save_png
from gyrostab.store.output import replace_file, write_text

Rows = list[dict[str, Any]]

#: Diagnosis of a case whose diagnosis failed: nothing was detected. `answered_rows` leaves it out
#: where that would be right.
_EMPTY_DIAGNOSIS = {
    "verdict": "no mismatch",
    "mismatches": [],
    "effects": [],
    "unexplained": [],
    "held_out": {},
    "seconds": math.nan,
}

_HEADLINES = (
    "false alarms: effect named on a null record",
    "effect named on a counterpart or a null record",
    "detected, 3 times the limit in fitted noise or more",
    "named correctly, 3 times the limit in fitted noise or more",
    "both effects of a pair named correctly, each of that strength",
    "cases with a wrong name, strength 1.5 or more",
    "out of catalogue: unidentified",
    "95 % intervals that contain the truth",
    "probability of a name: expected calibration error",
    "simulated records nearer to the recording with the effects, without refit",
    "injections of strength 1.5 or more: named correctly",
    "injections of 5 times the limit in fitted noise or more: named correctly",
    "injection adds another name",
)
_MAX_LISTED = 40
_COLUMNS = 118


def score_rows(
    diagnoses: Mapping[str, dict[str, Any]],
    truths: Mapping[str, dict[str, Any]],
    baseline_scores: Mapping[str, Mapping[str, float]],
) -> Rows:
    """Score all cases; a case without a diagnosis counts as "nothing detected"."""
    return [
        {"name": name, "failed": name not in diagnoses, **row}
        for name, truth in truths.items()
        for row in score_case(
            diagnoses.get(name, _EMPTY_DIAGNOSIS), truth, baseline_scores=baseline_scores.get(name)
        )
    ]


def write_outcome(
    folder: Path,
    rows: Rows,
    table: pd.DataFrame,
    *,
    job: Mapping[str, Any],
    commitment: str,
    failed: Mapping[str, str],
) -> list[Path]:
    """Write ``scores.csv``, ``table.md`` and the figures."""
    plain = [
        {
            key: json.dumps(value) if isinstance(value, list | dict | tuple) else value
            for key, value in row.items()
        }
        for row in rows
    ]
    figures = {
        "completeness.png": draw_completeness(curves(rows)),
        "reliability.png": draw_reliability(reliability(rows)),
        "calibration.png": draw_calibration(calibration_curve(rows), risk_coverage(rows)),
        "ranks.png": draw_ranks(rank_histogram(rows)),
        "roc.png": draw_roc(roc_curves(rows)),
    }
    targets = [folder / name for name in ("scores.csv", "table.md", *figures)]
    write_text(targets[0], pd.DataFrame(plain).to_csv(index=False))
    write_text(
        targets[1], format_outcome(rows, table, job=job, commitment=commitment, failed=failed)
    )
    for target, figure in zip(targets[2:], figures.values(), strict=True):
        with replace_file(target) as temporary:
            save_png(figure, temporary, colours=64)
    return targets


def format_outcome(
    rows: Sequence[Mapping[str, Any]],
    table: pd.DataFrame,
    *,
    job: Mapping[str, Any],
    commitment: str,
    failed: Mapping[str, str],
) -> str:
    """Format the outcome in Markdown: run, table, missed targets, curves and failed cases."""
    shown = curves(rows)
    every = shown[shown["effect"] == "all"] if len(shown) else shown
    drawn = drawn_rows(rows)
    counterparts, injections = counterpart_table(rows), injection_table(rows)
    lines = pd.concat([lines for lines in (table, counterparts, injections) if len(lines)])
    parts = [
        _describe_run(rows, job, commitment),
        "### Headline figures",
        markdown(lines[lines["quantity"].isin(_HEADLINES)]),
        "### Figures with 95 % intervals and targets",
        "A target is *met* where the whole interval is in the target range, *missed* where the "
        "value is not, and otherwise *not shown*: there are too few cases to decide.",
        markdown(table),
        "### Missed targets",
        _format_list(list_missed(table)),
        "### Completeness against strength",
        "Shares of all catalogue effects with an undisturbed driver; strength in units of the "
        "closed-form limit.",
        markdown(every.drop(columns="effect")) if len(every) else "no effects among these cases",
        "The same against the strength in *fitted* noise:",
        markdown(fitted_noise_curve(rows)),
        "### Effect by effect",
        "*n*: cases of strength 1.5 or more, and the shares of them that were *detected*, *named* "
        "(ambiguity sets merged) and named *exactly*. *identifications*: how often the name was "
        "given in all cases, and the share of these that is *right*. *parameters*: parameters that "
        "can be compared, and the share *covered* by their 95 % intervals.",
        markdown(by_effect(rows)),
        "### Names given to single effects",
        "Records with one effect of any strength, by their strongest name: the effect *itself*, "
        "*other names*, something *unidentified*, or *nothing* detected.",
        markdown(names_given(rows)),
        "### Probability of the names",
        "Identifications in groups of similar probability: the mean probability *stated*, and the "
        "share of names that are *right*: true themselves, not only a member of the ambiguity set.",
        markdown(calibration_curve(rows)),
        "The share of wrong names, and of the records with effects that have a name, if only names "
        "of at least this probability count:",
        markdown(_thin_out(risk_coverage(rows))),
        "### Ranks of the true parameters",
        "The rank of a true parameter is the probability below it by estimate and standard error. "
        "*low* and *high* contain 95 % of the counts of exact normal estimates.",
        markdown(rank_histogram(rows)),
        "### Detection at equal rates of false alarms",
        *_describe_detection(rows),
        "### Noise-only counterparts",
        *_describe_counterparts(rows, counterparts),
        "### Wrong names",
        _format_list(
            [_describe_wrong_name(row, drawn) for row in first_rows(drawn) if row["wrong"]]
        ),
        "### Undetected effects of strength 1.5 or more",
        _format_list(
            [
                _describe_miss(row)
                for row in drawn
                if row["effect"] and row["strength"] >= 1.5 and not row["detected"]
            ]
        ),
        "### Injections into real recordings",
        *_describe_injections(rows, injections),
        "### Cost",
        markdown(_tabulate_cost(drawn)),
        "### Failed diagnoses",
        _format_list([f"{name}: {reason}" for name, reason in failed.items()]),
    ]
    return "\n\n".join(part if "\n" in part else _wrap_text(part) for part in parts) + "\n"


def _thin_out(risk: pd.DataFrame) -> pd.DataFrame:
    """Keep about ten lines of a risk-coverage curve, with the first and the last."""
    places = np.linspace(0, len(risk) - 1, min(len(risk), 10))
    return risk.iloc[places.round().astype(int)]


def _describe_detection(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    shares = detection_shares(rows)
    if not len(shares):
        return ["Not computed: the run has no null records, or no effects of strength 1.5 or more."]
    return [
        "The threshold of each detector is the score that this share of all records of *noise* "
        "(null records and counterparts) exceeds, rounded down to whole records. A record counts "
        "if its strongest effect has strength 1.5 or more. The intervals are those of resampled "
        "records, each case together with its counterpart.",
        markdown(shares),
    ]


def _describe_counterparts(rows: Sequence[Mapping[str, Any]], table: pd.DataFrame) -> list[str]:
    if not len(table):
        return ["None in this run."]
    named = [
        _describe_wrong_name(row, [row])
        for row in rows
        if row["kind"] == "counterpart" and row["wrong_names"]
    ]
    return [
        "A counterpart is the record of a case without its effects: same noise, missing samples, "
        "channels and quantization.",
        markdown(table),
        _format_list(named, "No effect was named on a counterpart."),
    ]


def _describe_injections(rows: Sequence[Mapping[str, Any]], table: pd.DataFrame) -> list[str]:
    differences = injection_differences(rows)
    if not differences:
        return [
            "None: the folder of the real recordings was not given to this run, or it had too few "
            "cases."
        ]
    lines = [
        f"{line['recording']}, {line['effect']} at {line['strength']:g}"
        + (f" ({line['learned_strength']:.2g} in fitted noise)" if line["learned_strength"] else "")
        + ": "
        + ("named" if line["named"] else "not named")
        + (", as in the untouched copy" if line["there_before"] else "")
        + "".join(
            f"; {label} {', '.join(line[key])}" for key, label in _COPY_LABELS.items() if line[key]
        )
        for line in differences
    ]
    about = (
        "An effect is injected into a piece of a real recording, which contains unknown effects. "
        "Names therefore count only if they are not found in the untouched piece. Controls are the "
        "untouched piece, and its copies reversed in sign and in time."
    )
    return [about, markdown(table), _format_list(lines)]


_COPY_LABELS = {
    "before": "untouched",
    "others": "injection adds",
    "flipped": "reversed in sign adds",
    "reversed": "reversed in time adds",
}


def _tabulate_cost(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Tabulate the time of a diagnosis [s] by rate and length."""
    costs = pd.DataFrame(
        [{key: row[key] for key in ("rate", "length", "seconds")} for row in first_rows(rows)]
    )
    costs["length"] = pd.cut(
        costs["length"],
        [0, 1200, 3600, 10800, math.inf],
        labels=["< 20 min", "< 1 h", "< 3 h", "longer"],
        right=False,
    )
    parts = costs.groupby(["rate", "length"], observed=True)["seconds"]
    table = parts.agg(["count", "median", "max", "sum"]).reset_index()
    return table.rename(
        columns={
            "rate": "rate [Hz]",
            "median": "median [s]",
            "max": "longest [s]",
            "sum": "all [s]",
        }
    )


def _describe_run(
    rows: Sequence[Mapping[str, Any]], job: Mapping[str, Any], commitment: str
) -> str:
    kinds = pd.Series([row["kind"] for row in first_rows(rows)]).value_counts()
    numbers = ", ".join(f"{number} {kind}" for kind, number in kinds.items())
    options = ("cases", "seed", "nulls", "counterparts")
    repeat = " ".join(["gyrostab prove", *(f"--{name} {job[name]}" for name in options)])
    repeat += " --real DIR" if job["injected"] else ""
    lines = [
        f"{job['cases']} cases ({numbers}); begun {job['begun']}; {job['machine']}; "
        f"code {' then '.join(job['code'])}.",
        f"Seed {job['seed']}, to be repeated with `{repeat}`.",
        "SHA-256 of the list of ground truths, committed before the first diagnosis: "
        f"`{commitment}`.",
    ]
    if job["seed"] < FIRST_PUBLIC_SEED:
        lines.append(
            f"**This is a tuning seed (below {FIRST_PUBLIC_SEED:,}): "
            "these figures are not for publication.**"
        )
    if len(job["code"]) > 1:
        lines.append(
            f"**The code changed {len(job['code']) - 1} times during this run: "
            "these figures are not those of one version.**"
        )
    return "  \n".join(_wrap_text(line) for line in lines)


def _describe_case(row: Mapping[str, Any], effects: Sequence[Mapping[str, Any]]) -> str:
    content = " and ".join(
        f"{effect['effect']} at {effect['strength']:g}" for effect in effects if effect["effect"]
    )
    driver = f", driver {row['degradation']}" if row["degradation"] else ""
    record = f"{row['rate']:g} Hz, {row['length'] / 60:.0f} min, {100 * row['missing']:.0f} % lost"
    return f"{row['name']} ({row['kind']}{driver}, {record}): {content or 'no effect'}"


def _describe_wrong_name(row: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    effects = [other for other in rows if other["name"] == row["name"]]
    return f"{_describe_case(row, effects)}; named {', '.join(row['wrong_names'])}"


def _describe_miss(row: Mapping[str, Any]) -> str:
    reason = "its diagnosis failed" if row["failed"] else "nothing was detected"
    return f"{_describe_case(row, [row])}; {reason}"


def _format_list(lines: Sequence[str], none: str = "none") -> str:
    shown = [_wrap_text(f"- {line}", indent="  ") for line in lines[:_MAX_LISTED]] + (
        [f"- and {len(lines) - _MAX_LISTED} more, see scores.csv"]
        if len(lines) > _MAX_LISTED
        else []
    )
    return "\n".join(shown) or none


def _wrap_text(text: str, *, indent: str = "") -> str:
    """Wrap a line of Markdown."""
    return textwrap.fill(
        text, _COLUMNS, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )

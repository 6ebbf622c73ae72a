"""Completeness against strength and by effect, names given, and reliability of each name."""

from __future__ import annotations

import math
from bisect import bisect
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import gmean

from gyrostab.blindtest.scoring.proportions import share_columns, wilson
from gyrostab.blindtest.scoring.score import CATALOGUE_KINDS, catalogue_rows, drawn_rows, first_rows
from gyrostab.blindtest.scoring.table import CLEAR_STRENGTH, SURE_STRENGTH

Row = Mapping[str, Any]

_CURVES = [f"{key}{end}" for key in ("detected", "named") for end in ("", "_low", "_high")]
_RANKS = 10  # groups of the rank histogram
#: Limits between ranges of strength in known noise, for all effects and for one, which has fewer
#: cases; detection is not required below strength 1.5.
_KNOWN_LIMITS = (0.75, 1.25, CLEAR_STRENGTH, 2.0, 3.0, 4.5, 7.0, 12.0)
_EFFECT_LIMITS = (CLEAR_STRENGTH, 4.0, 12.0)
#: Limits between ranges of strength in fitted noise.
_FITTED_LIMITS = (0.5, 1.0, CLEAR_STRENGTH, 2.0, SURE_STRENGTH, 5.0)


def curves(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the shares detected and named against strength, by effect and for all effects.

    For an effect out of catalogue, unidentified counts as named. Similar strengths count together;
    ``strength`` is their geometric mean.
    """
    groups: defaultdict[tuple[str, int], list[Row]] = defaultdict(list)
    for row in rows:
        place = bisect(_EFFECT_LIMITS, row["strength"])
        if row["kind"] == "out_of_catalogue":
            groups[row["effect"], place].append({**row, "named": row["unidentified"]})
        elif row["kind"] in CATALOGUE_KINDS:
            groups[row["effect"], place].append(row)
            groups["all", bisect(_KNOWN_LIMITS, row["strength"])].append(row)
    return pd.DataFrame(
        [
            {
                "effect": key[0],
                "strength": float(f"{gmean([row['strength'] for row in groups[key]]):.4g}"),
                **_count_shares(groups[key]),
            }
            for key in sorted(groups, key=lambda key: (key[0] != "all", key))
        ]
    )


def fitted_noise_curve(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the shares detected and named against ranges of strength in fitted noise.

    They are those of catalogue effects with an undisturbed driver.
    """
    selected = [
        (row, row["learned_strength"])
        for row in catalogue_rows(rows)
        if row.get("learned_strength") is not None
    ]
    out = []
    for low, high in pairwise((0.0, *_FITTED_LIMITS, math.inf)):
        part = [row for row, strength in selected if low <= strength < high]
        if part:
            name = f"{low:g} to {high:g}" if high < math.inf else f"{low:g} and more"
            out.append({"strength": name, **_count_shares(part)})
    return pd.DataFrame(out, columns=["strength", "n", *_CURVES])


def _count_shares(part: Sequence[Row]) -> dict[str, Any]:
    """Return the shares detected and named of some rows, with the ends of 95 % intervals."""
    return {"n": len(part), **share_columns(part, "detected"), **share_columns(part, "named")}


def reliability(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the share of correct identifications by name, with Wilson's interval."""
    right = pd.DataFrame(
        [
            (identification["name"], identification["right"])
            for row in first_rows(drawn_rows(rows))
            for identification in row["identifications"]
        ],
        columns=["name", "right"],
    )
    counts = right.groupby("name")["right"].agg(["size", "sum"]).astype(int)
    return pd.DataFrame(
        [(name, n, hits / n, *wilson(hits, n)) for name, n, hits in counts.itertuples()],
        columns=["name", "n", "right", "low", "high"],
    )


def rank_histogram(rows: Sequence[Row]) -> pd.DataFrame:
    """Count the ranks of the true parameters in the normal laws of their estimates.

    The rank is the probability below the truth. Exact estimates have all ranks equally often, and
    95 % of the counts between ``low`` and ``high``; standard errors that are too small give too
    many low and high ranks.
    """
    from scipy.stats import binom, norm

    pulls = [
        number["pull"]
        for row in catalogue_rows(rows, min_strength=CLEAR_STRENGTH)
        for number in row["parameter_scores"]
        if number["pull"] is not None
    ]
    edges = np.linspace(0.0, 1.0, _RANKS + 1)
    counts, _ = np.histogram(norm.sf(np.array(pulls, dtype=float)), edges)
    low, high = (int(binom.ppf(level, len(pulls), 1 / _RANKS)) for level in (0.025, 0.975))
    return pd.DataFrame(
        [
            {"rank": f"{begin:.1f} to {end:.1f}", "n": int(count), "low": low, "high": high}
            for (begin, end), count in zip(pairwise(edges), counts, strict=True)
        ]
    )


def names_given(rows: Sequence[Row]) -> pd.DataFrame:
    """Count the strongest name of each record with a single effect.

    ``itself`` is the right name; in the other records there are ``other names``, something was
    ``unidentified``, or ``nothing`` was detected.
    """
    out = []
    single = [row for row in rows if row["kind"] in ("single", "sub_threshold")]
    for effect in sorted({row["effect"] for row in single}):
        selected = [row for row in single if row["effect"] == effect]
        names = Counter(
            row["identifications"][0]["name"] for row in selected if row["identifications"]
        )
        nothing = sum(not row["detected"] for row in selected)
        out.append(
            {
                "effect": effect,
                "n": len(selected),
                "itself": names.pop(effect, 0),
                "other names": ", ".join(f"{name} {n}" for name, n in names.most_common()),
                "unidentified": sum(not row["identifications"] for row in selected) - nothing,
                "nothing": nothing,
            }
        )
    return pd.DataFrame(
        out, columns=["effect", "n", "itself", "other names", "unidentified", "nothing"]
    )


def by_effect(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute completeness and reliability of every effect of the catalogue.

    ``n`` cases have strength 1.5 or more; ``detected``, ``named`` (sets merged) and ``exactly`` are
    shares of these. The ``identifications`` of this name, and the share ``right``, are of all
    cases; of the ``parameters`` that can be compared, a share is ``covered`` by their 95 %
    intervals. Shares are None where there is nothing to count.
    """
    identifications = {line["name"]: line for line in reliability(rows).to_dict("records")}
    selected = catalogue_rows(rows)
    out = []
    for effect in sorted({row["effect"] for row in selected} | set(identifications)):
        clear = [
            row for row in selected if row["effect"] == effect and row["strength"] >= CLEAR_STRENGTH
        ]
        numbers = [number["covered"] for row in clear for number in row["parameter_scores"]]
        out.append(
            {
                "effect": effect,
                "n": len(clear),
                **{key: _share_true([row[mark] for row in clear]) for key, mark in _SHARES.items()},
                "identifications": identifications.get(effect, {}).get("n", 0),
                "right": identifications.get(effect, {}).get("right"),
                "parameters": len(numbers),
                "covered": _share_true(numbers),
            }
        )
    return pd.DataFrame(
        out,
        columns=["effect", "n", *_SHARES, "identifications", "right", "parameters", "covered"],
        dtype=object,
    )


_SHARES = {"detected": "detected", "named": "named", "exactly": "named_exactly"}


def _share_true(flags: Sequence[bool]) -> float | None:
    return sum(map(bool, flags)) / len(flags) if flags else None

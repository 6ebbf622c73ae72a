"""Effects that the diagnoses of many runs name, as one table."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from gyrostab.jobs.archive import read_diagnosis

__all__ = ["list_effects", "read_verdict"]

_COLUMNS = (
    "run", "tool", "start", "effect", "axes", "driver", "evidence [nats]", "parameter", "value",
    "low", "high", "unit",
)  # fmt: skip


def read_verdict(folder: str) -> str:
    """Read the verdict of a diagnosis; empty without one, ``not readable`` of a damaged one."""
    if not folder:
        return ""
    content = read_diagnosis(Path(folder))
    return "not readable" if content is None else str(content["verdict"])


def list_effects(table: pd.DataFrame) -> pd.DataFrame:
    """List the effects that the diagnoses of runs name.

    Parameters
    ----------
    table : pandas.DataFrame
        One row a run, with the columns run, tool, start and diagnosis (a folder, or empty).

    Returns
    -------
    pandas.DataFrame
        One row for each run, effect and parameter: axes, driver, evidence [nats], and value with
        95 % interval in the unit of the row.
    """
    rows = []
    for run in table.to_dict("records"):
        content = read_diagnosis(Path(run["diagnosis"])) if run["diagnosis"] else None
        for effect in content["effects"] if content else ():
            known = {
                **{name: run[name] for name in ("run", "tool", "start")},
                "effect": effect["name"],
                "axes": " ".join(effect["axes"]),
                "driver": effect["driver"],
                "evidence [nats]": effect["held_out_gain"]["nats"],
            }
            for parameter, size in (effect["parameters"] or {"": {}}).items():
                numbers = {name: size.get(name) for name in ("value", "low", "high", "unit")}
                rows.append({**known, "parameter": parameter, **numbers})
    return pd.DataFrame(rows, columns=list(_COLUMNS))

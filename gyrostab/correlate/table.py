"""The correlation as a table for the terminal."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.correlate.judge import VERDICTS, format_p_value


def correlation_rows(result: xr.Dataset) -> list[dict[str, str]]:
    """List every coupling as a row of a table.

    Parameters
    ----------
    result : xarray.Dataset
        Result of `gyrostab.correlate`.

    Returns
    -------
    list of dict
        Text by heading, the same headings in every row; ``-`` where the record gives no number.
    """
    rows = []
    for a, axis in enumerate(result["axis"].values):
        for v, name in enumerate(result["variable"].values):
            for d, driver in enumerate(result["driver"].values):
                cell = result.isel(axis=a, variable=v, driver=d)
                slope = cell[f"{name}_per_{driver}"]
                low, high = (float(cell[f"{name}_per_{driver}_{end}"]) for end in ("low", "high"))
                numbers = (
                    float(cell["coupling_lag"]),
                    float(slope),
                    float(cell["correlation"]),
                    float(cell["effective_samples"]),
                )
                lag, value, r, n = (
                    "-" if np.isnan(number) else f"{number:.3g}" for number in numbers
                )
                p = float(cell["p_value_adjusted"])
                rows.append(
                    {
                        "axis": str(axis),
                        "variable": str(name),
                        "driver": str(driver),
                        "lag [s]": lag,
                        "sensitivity": value,
                        f"{100 * result.attrs['interval_level']:g} % interval": "-"
                        if np.isnan(low)
                        else f"{low:.3g} .. {high:.3g}",
                        **_partial_column(cell, f"{name}_per_{driver}_partial"),
                        "unit": str(slope.attrs["unit_label"]),
                        "r": r,
                        "n eff": n,
                        "p adjusted": "-" if np.isnan(p) else format_p_value(p),
                        "verdict": VERDICTS[int(cell["coupling_verdict"])].replace("_", " "),
                    }
                )
    return rows


def _partial_column(cell: xr.Dataset, name: str) -> dict[str, str]:
    """Format the slope given the other drivers, if there is one."""
    if name not in cell:
        return {}
    value, low, high = (float(cell[f"{name}{end}"]) for end in ("", "_low", "_high"))
    return {
        "given the others": "-" if np.isnan(value) else f"{value:.3g} ({low:.3g} .. {high:.3g})"
    }


def format_correlation(result: xr.Dataset) -> str:
    """Format the result as a table, with a sentence on each coupling that is or may be there.

    Couplings that the record cannot show are counted in one line.
    """
    rows = correlation_rows(result)
    shown = [row for row in rows if row["verdict"] != "cannot tell"]
    table = [tuple(rows[0]), *(tuple(row.values()) for row in shown)] if shown else []
    verdicts = result["coupling_verdict"].values.ravel()
    sentences = result["statement"].values.ravel()
    statements = [
        str(sentences[place])
        for place in np.flatnonzero(verdicts >= VERDICTS.index("not_told_apart"))
    ]
    cannot = np.flatnonzero(verdicts == VERDICTS.index("cannot_tell"))
    if cannot.size:
        statements.append(_count_untold(cannot.size, rows, str(sentences[cannot[0]])))
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table
    ]
    note = (
        "Lag, sensitivity and interval are those of the best-fitting lag; "
        "p adjusted is for the whole search."
    )
    lines += [note, ""] if shown else []
    return "\n".join([*lines, *(statements or ["No coupling is seen."])])


def _count_untold(count: int, rows: list[dict[str, str]], example: str) -> str:
    """Fold the couplings of which the record shows nothing into one line."""
    if count == 1:
        return example
    names = dict.fromkeys(row["variable"] for row in rows if row["verdict"] == "cannot tell")
    return (
        f"{count} of {len(rows)} combinations ({', '.join(names)}) cannot be judged, for instance: "
        f"{example}"
    )

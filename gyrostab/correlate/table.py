"""The correlation as a table for the terminal."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.correlate.judge import VERDICTS, format_p_value

__all__ = ["correlation_rows", "format_correlation"]


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
                        f"{result.attrs['interval_level']:.0%} interval": "-"
                        if np.isnan(low)
                        else f"{low:.3g} .. {high:.3g}",
                        "unit": str(slope.attrs["unit_label"]),
                        "r": r,
                        "n eff": n,
                        "p adjusted": "-" if np.isnan(p) else format_p_value(p),
                        "verdict": VERDICTS[int(cell["coupling_verdict"])].replace("_", " "),
                    }
                )
    return rows


def format_correlation(result: xr.Dataset) -> str:
    """Format the result as a table, with a sentence on each coupling that is or may be there.

    Parameters
    ----------
    result : xarray.Dataset
        Result of `gyrostab.correlate`.

    Returns
    -------
    str
        Text of several lines.
    """
    rows = correlation_rows(result)
    table = [tuple(rows[0]), *(tuple(row.values()) for row in rows)]
    verdicts = result["coupling_verdict"].values.ravel()
    sentences = result["statement"].values.ravel()
    statements = [
        str(sentences[place])
        for place in np.flatnonzero(verdicts >= VERDICTS.index("not_told_apart"))
    ]
    cannot = np.flatnonzero(verdicts == VERDICTS.index("cannot_tell"))
    if cannot.size:
        statements.append(
            str(sentences[cannot[0]])
            + (f" ({cannot.size - 1} more like it)" if cannot.size > 1 else "")
        )
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table
    ]
    note = (
        "Lag, sensitivity and interval are those of the best-fitting lag; "
        "p adjusted is for the whole search."
    )
    return "\n".join([*lines, note, "", *(statements or ["No coupling is seen."])])

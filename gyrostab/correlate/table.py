"""The result as a table for the terminal."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.correlate.judge import VERDICTS

__all__ = ["format_correlation"]


def format_correlation(result: xr.Dataset) -> str:
    """Write the entries as a table, and a sentence on each that is coupled or not told apart.

    Parameters
    ----------
    result : xarray.Dataset
        Of `gyrostab.correlate`.

    Returns
    -------
    str
        Text of several lines.
    """
    rows = [("axis", "variable", "driver", "lag [s]", "sensitivity", "95 % interval", "unit", "r", "n eff", "p adjusted", "verdict")]
    rows[0] = (*rows[0][:5], f"{result.attrs['interval_level']:.0%} interval", *rows[0][6:])
    said = []
    for a, axis in enumerate(result["axis"].values):
        for v, name in enumerate(result["variable"].values):
            for d, driver in enumerate(result["driver"].values):
                cell = result.isel(axis=a, variable=v, driver=d)
                slope = cell[f"{name}_per_{driver}"]
                low, high = (float(cell[f"{name}_per_{driver}_{end}"]) for end in ("low", "high"))
                verdict = VERDICTS[int(cell["coupling_verdict"])]
                numbers = (float(cell["coupling_lag"]), float(slope), float(cell["correlation"]), float(cell["effective_samples"]))
                lag, value, r, n = ("-" if np.isnan(number) else f"{number:.3g}" for number in numbers)
                between = "-" if np.isnan(low) else f"{low:.3g} .. {high:.3g}"
                p = float(cell["p_value_adjusted"])
                chance = "-" if np.isnan(p) else f"{p:.2g}"
                units = str(slope.attrs["units"])
                rows.append((str(axis), str(name), str(driver), lag, value, between, units, r, n, chance, verdict.replace("_", " ")))
                if verdict in ("coupled", "not_told_apart"):
                    said.append(str(cell["statement"].values))
    cannot = int((result["coupling_verdict"] == 0).sum())
    if cannot:
        place = np.argwhere(result["coupling_verdict"].values == 0)[0]
        said.append(str(result["statement"].values[tuple(place)]) + (f" ({cannot - 1} more like it)" if cannot > 1 else ""))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join([*lines, "", *(said or ["No coupling is seen."])])

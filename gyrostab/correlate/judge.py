"""What a record shows about a coupling, as flags and in one sentence."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.correlate.drivers import slope_units
from gyrostab.errors import SchemaError
from gyrostab.schema import with_axis
from gyrostab.wording import format_rounded

#: Flag values of ``coupling_verdict``.
VERDICTS = ("cannot_tell", "none_seen", "not_told_apart", "coupled")

#: Names of the bits of ``coupling_limits``, and the wording of each in a sentence.
LIMITS = {
    "constant": "{driver} is constant",
    "too_few": "there are too few independent windows",
    "clusters": "{driver} differs only between segments separated by a gap",
    "one_moment": "{driver} changes mainly at one moment",
    "no_reversal": "{driver} changes mainly in one direction, so a drift or slow noise looks the "
    "same",
    "no_plateau": "{driver} is hardly ever constant, so its effect and that of its rate of change "
    "look alike",
    "other_channel": "another channel or rate of change explains it equally well",
    "no_values": "{driver} has no value in any window",
    "constant_series": "{series} is constant",
}
#: Limits that leave no verdict, in the order in which a sentence names them.
_HARD_LIMITS = ("constant", "too_few", "clusters", "one_moment", "no_values", "constant_series")
_READABLE = {"degree": "deg", "hour": "h", "degree_Celsius": "K", "standard_free_fall": "g"}
_MIN_RANGE = {"degree_Celsius": 0.02}  # a channel with a smaller range counts as constant


def driver_limits(x: Floats, pieces: Ints, units: str, *, derived: bool) -> set[str]:
    """List what limits a verdict on a driver.

    Parameters
    ----------
    x : ndarray, shape (n_blocks,)
        Block means of the driver.
    pieces : ndarray of int, shape (n_blocks,)
        Number of the segment between long gaps that holds each block.
    units : str
        Units of the driver.
    derived : bool
        The driver is the rate of change of a channel.

    Returns
    -------
    set of str
        Keys of `LIMITS`.
    """
    limits: set[str] = set()
    span = float(np.ptp(x))
    if span <= max(_MIN_RANGE.get(units, 0.0), 1e-9 * float(np.abs(x).max())):
        return limits | {"constant"}
    inside = sum(
        float(((x[pieces == piece] - x[pieces == piece].mean()) ** 2).sum())
        for piece in np.unique(pieces)
    )
    if pieces.max() > 0 and inside < 0.1 * float(((x - x.mean()) ** 2).sum()):
        limits.add("clusters")
    rise = float((x - np.minimum.accumulate(x)).max())
    fall = float((np.maximum.accumulate(x) - x).max())
    if min(rise, fall) < 0.25 * span:
        limits.add("no_reversal")
    if not derived:
        pace = np.abs(np.gradient(x))
        if np.mean(pace < 0.1 * np.quantile(pace, 0.95)) < 0.1:
            limits.add("no_plateau")
    return limits


def readable_units(units: str) -> str:
    """Spell a UDUNITS unit in the customary way.

    Examples
    --------
    >>> [readable_units(text) for text in ("degree hour-1 K-1", "degree K-1", "K-1", "m s-2")]
    ['deg/h/K', 'deg/K', '1/K', 'm/s^2']
    """
    above, below = [], ""
    for word in units.split():
        name = word.rstrip("-0123456789") or word
        power = word[len(name) :]
        name = _READABLE.get(name, name)
        size = power.removeprefix("-")
        name += f"^{size}" if size not in ("", "1") else ""
        if power.startswith("-"):
            below += f"/{name}"
        else:
            above.append(name)
    return (" ".join(above) or "1") + below


def slope_label(series: xr.DataArray, driver: str) -> str:
    """Spell the unit of a sensitivity as people write it: N in deg/sqrt(h), not as it is stored.

    Examples
    --------
    >>> N = xr.DataArray(0.01, attrs={"units": "degree hour-1", "unit_label": "deg/sqrt(h)"})
    >>> slope_label(N, "degree_Celsius"), slope_label(N, "K hour-1")
    ('deg/sqrt(h)/K', 'deg/sqrt(h) h/K')
    """
    label = series.attrs.get("unit_label")
    if label is None:
        return readable_units(slope_units(str(series.attrs.get("units", "1")), driver))
    per = readable_units(slope_units("1", driver))
    return f"{label}{per[1:]}" if per.startswith("1/") else f"{label} {per}"


def format_p_value(p: float) -> str:
    """Format a p-value; the simulation does not resolve values below 0.0001.

    Examples
    --------
    >>> format_p_value(0.0312), format_p_value(3e-9)
    ('0.031', '<0.0001')
    """
    return "<0.0001" if p < 1e-4 else f"{p:.2g}"


def describe_coupling(entry: dict[str, Any], driver: str, series: str) -> str:
    """Describe the coupling of a series with a driver in one sentence."""
    driver = f"the {driver}" if driver.startswith("rate of change") else driver
    reasons = [
        text.format(driver=driver, series=series)
        for name, text in LIMITS.items()
        if name in entry["limits"]
    ]
    verdict = VERDICTS[entry["verdict"]]
    if verdict == "cannot_tell":
        hard = [
            LIMITS[name].format(driver=driver, series=series)
            for name in _HARD_LIMITS
            if name in entry["limits"]
        ]
        reason = "; ".join(hard) or "no window holds both"
        return f"The record cannot show whether {series} follows {driver}: {reason}."
    units = entry["unit_label"]
    between = f"{entry['low']:.3g} to {entry['high']:.3g}"
    number = f"{entry['slope']:.3g} ({between}) {units}"
    late = f" after a lag of {entry['lag']:.6g} s" if entry["lag"] else ""
    start = series[0].upper() + series[1:]
    if np.isfinite(entry.get("partial", np.nan)):
        ends = f"{entry['partial_low']:.3g} to {entry['partial_high']:.3g}"
        number += f", given the other drivers {entry['partial']:.3g} ({ends})"
    odds = f"p {'' if entry['p_adjusted'] < 1e-4 else '= '}{format_p_value(entry['p_adjusted'])}"
    if verdict == "none_seen":
        apart = not entry["low"] <= 0.0 <= entry["high"]
        note = "; it is significant at that lag alone, but not in the whole search" if apart else ""
        tail = f" ({'; '.join(reasons)})" if reasons else ""
        return (
            f"No coupling of {series} with {driver} is seen: {number}{late}, {odds} for the whole "
            f"search{note}{tail}."
        )
    if verdict == "not_told_apart" and entry["p_adjusted"] >= 0.05:
        late = f" after a lag of {entry['lag_white']:.6g} s" if entry["lag_white"] else ""
        return (
            f"{start} changes with {driver}{late}, by about {entry['slope_white']:.3g} "
            f"{units}, but {LIMITS['no_reversal'].format(driver=driver)}. Allowing for that, the "
            f"sensitivity may be anywhere from {between} {units}."
        )
    if verdict == "not_told_apart":
        return (
            f"{start} varies with {driver}{late}, {number}, {odds} for the whole search, but "
            f"{'; '.join(reasons)}."
        )
    tail = f" ({'; '.join(reasons)})" if reasons else ""
    return f"{start} follows {driver}{late}: {number}, {odds} for the whole search{tail}."


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

    Raises
    ------
    SchemaError
        If `result` is not a result of `gyrostab.correlate`.

    Examples
    --------
    >>> from gyrostab import correlate, davar, fit_noise, make_log
    >>> rate, temperature = np.random.default_rng(1).standard_normal((2, 36_000))
    >>> channels = {"temperature": (temperature, "degC")}
    >>> log = make_log(rate, rate=10.0, unit="deg/h", channels=channels)
    >>> product = fit_noise(davar(log, window="1min", step="30s"))
    >>> row = correlation_rows(correlate(product, variables="window_mean"))[0]
    >>> row["variable"], row["driver"], row["unit"], row["verdict"]
    ('window_mean', 'temperature', 'deg/h/K', 'none seen')
    """
    result = require_correlation(result)
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
                    "-" if np.isnan(number) else format_rounded(number, 3) for number in numbers
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
                        "given the others": _format_partial(cell, f"{name}_per_{driver}_partial"),
                        "unit": str(slope.attrs["unit_label"]),
                        "r": r,
                        "n eff": n,
                        "p adjusted": "-" if np.isnan(p) else format_p_value(p),
                        "verdict": VERDICTS[int(cell["coupling_verdict"])].replace("_", " "),
                    }
                )
    return rows


def require_correlation(result: Any) -> xr.Dataset:
    """Return a result of `gyrostab.correlate` with its axes, even after ``.sel(axis="x")``.

    Raises
    ------
    SchemaError
        If it is something else, or has lost another of its dimensions.
    """
    if not isinstance(result, xr.Dataset) or "coupling_verdict" not in result:
        raise SchemaError(
            "this holds no correlation; call gyrostab.correlate (or 'gyrostab correlate') first"
        )
    correlation: xr.Dataset = with_axis(result)
    for dim in ("axis", "variable", "driver"):
        if dim not in correlation.dims:
            raise SchemaError(
                f"the correlation has no dimension {dim!r}; keep it, even to select one label: "
                f".isel({dim}=[0])"
            )
    return correlation


def _format_partial(cell: xr.Dataset, name: str) -> str:
    """Format the slope given the other drivers."""
    value, low, high = (float(cell[f"{name}{end}"]) for end in ("", "_low", "_high"))
    return "-" if np.isnan(value) else f"{value:.3g} ({low:.3g} .. {high:.3g})"


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
        "Sensitivity and interval are given at the best-fitting lag; "
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

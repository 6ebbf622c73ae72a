"""Names, units and attributes of the variables of every dataset.

The table `VARIABLES` holds the attributes of every product variable; the stages and the export all
read it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gyrostab.noise import LAWS
from gyrostab.units import INNER

#: Flag values of ``gap_cause(gap)``, in the order of their numbers.
GAP_CAUSES = (
    "missing",
    "unreadable",
    "duplicate",
    "out_of_order",
    "outside_range",
    "clock_step",
    "restart",
)

#: Flag values of ``estimator(axis, time, tau)``: how a cell of the surface was estimated.
ESTIMATORS = ("none", "strict_runs", "weighted_clusters")

#: Flag values of ``observable(axis, time, term)``.
OBSERVABLE = ("not_observable", "upper_limit_only", "observed")
NOT_OBSERVABLE, UPPER_LIMIT_ONLY, OBSERVED = range(len(OBSERVABLE))

#: Name of the gyro signal -> its unit; a log has one of them, and its ``kind`` attribute names it.
SIGNAL_UNITS = {"rate": INNER["rate"], "angle": INNER["angle"]}

#: Name of the gyro signal -> its label in figures.
SIGNAL_LONG_NAMES = {"rate": "rotation rate", "angle": "angle"}


def flag_attributes(meanings: tuple[str, ...]) -> dict[str, Any]:
    """Return the attributes of flags that have these meanings, in the order of their numbers."""
    return {
        "flag_values": np.arange(len(meanings), dtype=np.int8),
        "flag_meanings": " ".join(meanings),
    }


def _make_attrs(long_name: str, units: str = "1") -> dict[str, Any]:
    return {"long_name": long_name, "units": units}


#: Product variable -> attributes. CF, UDUNITS spelling; ``axis`` and ``term`` hold strings and so
#: carry no unit.
VARIABLES: dict[str, dict[str, Any]] = {
    "time": {
        "long_name": "centre of the window",
        "standard_name": "time",
        "bounds": "time_bounds",
        "axis": "T",
    },
    "tau": _make_attrs("averaging time", "s"),
    "axis": {"long_name": "sensor axis"},
    "term": {"long_name": "noise term, symbol of IEEE Std 952"},
    "avar": _make_attrs(
        "dynamic overlapping Allan variance of the rotation rate", "degree2 hour-2"
    ),
    "count": _make_attrs("second differences used"),
    "coverage": _make_attrs("second differences used, share of the gap-free number"),
    "edf": _make_attrs("equivalent degrees of freedom of the Allan variance"),
    "estimator": {"long_name": "estimator of the Allan variance", **flag_attributes(ESTIMATORS)},
    "gap_factor": _make_attrs("degrees of freedom left by the gaps, share of the gap-free ones"),
    "white_response": _make_attrs(
        "Allan variance of angle random walk seen through the gaps, as a share of the gap-free law"
    ),
    "quantization_response": _make_attrs(
        "Allan variance of quantization noise seen through the gaps, as a share of the gap-free law"
    ),
    "ramp_response": _make_attrs(
        "Allan variance of a rate ramp seen through the gaps, as a share of the gap-free law"
    ),
    "difference_trend": _make_attrs(
        "slope of the rate that the second differences show through the gaps", "degree hour-2"
    ),
    "window_mean": _make_attrs("mean rotation rate of the window", INNER["rate"]),
    "window_trend": _make_attrs(
        "slope of the least-squares line through the rate of the window", "degree hour-2"
    ),
    "trend_response": _make_attrs(
        "variance of window_trend under white noise, as a share of that of a window without gaps"
    ),
    "trend_quantization_response": _make_attrs(
        "variance of window_trend under quantization noise, as a share of that of a window without "
        "gaps"
    ),
    "trend_flicker_response": _make_attrs(
        "variance of window_trend under bias instability, as a share of that of a window without "
        "gaps"
    ),
    "trend_walk_response": _make_attrs(
        "variance of window_trend under rate random walk, as a share of that of a window without "
        "gaps"
    ),
    "outlier_count": _make_attrs("single samples of the window that are far from both neighbours"),
    "gap_edge_ratio": _make_attrs("scatter of the samples next to gaps divided by that elsewhere"),
    "window_coverage": _make_attrs("share of the window's samples that are present"),
    "observable": {
        "long_name": "whether the window shows the noise term",
        **flag_attributes(OBSERVABLE),
    },
    "fit_chi2": _make_attrs("misfit of the five-term model, generalised least squares chi-square"),
    "fit_dof": _make_attrs("degrees of freedom of the misfit"),
    "fit_tau_min": _make_attrs("shortest averaging time of the fit", "s"),
    "filter_time_constant": _make_attrs(
        "time constant of the first-order low-pass that acts like the filter of the sensor on "
        "the averaging times of the fit, 0 without a filter",
        "s",
    ),
    "filter_white_error": _make_attrs(
        "relative standard error of N due to filter_time_constant, included in the standard "
        "error of N"
    ),
}


def _add_coefficients() -> None:
    for symbol, law in LAWS.items():
        attrs: dict[str, Any] = {"units": law.units, "unit_label": law.label}
        note = ""
        if law.tau_ref_hours is not None:
            attrs["tau_ref"] = f"{law.tau_ref_hours:g} h"
            attrs["comment"] = f"numerically {symbol} in {law.label}"
            note = f", Allan deviation of its term at {law.tau_ref_hours:g} h"
        for end, meaning in (
            ("", ""),
            ("_stderr", "standard error of the "),
            ("_upper", "95 % upper limit of the "),
        ):
            long_name = f"{meaning}{law.name} coefficient{note}"
            VARIABLES[f"{symbol}{end}"] = {"long_name": long_name, **attrs}
        if symbol in "NK":
            VARIABLES[f"{symbol}_squared"] = {
                "long_name": f"square of the {law.name} coefficient",
                "units": law.squared_units,
            }


_add_coefficients()

#: Names that datasets of gyrostab use; a channel has another one.
RESERVED_NAMES = frozenset(
    {
        *SIGNAL_UNITS,
        *VARIABLES,
        *("row", "gap", "gap_start", "gap_end", "gap_samples", "gap_rows", "gap_cause"),
        *("bnds", "time_bounds", "time_start", "time_index"),
        # dimensions of texts in NetCDF files of xarray, by their length
        *(f"string{length}" for length in range(1, 256)),
    }
)


def attributes(name: str, *, variance: str = "Allan") -> dict[str, Any]:
    """A fresh copy of the attributes of a product variable, for the variance of that name."""
    attrs = dict(VARIABLES[name])
    label = attrs["long_name"].replace("Allan variance", f"{variance} variance")
    if variance != "Allan":  # only those of the Allan variance are second differences
        label = label.replace("second differences", "third differences")
    attrs["long_name"] = label
    return attrs

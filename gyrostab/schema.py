"""Names, dimensions and units of the datasets that pass between the stages, and one check for each.

raw log      what a reader returns: columns by ``row`` with the stamps as they were written
log          uniform time, NaN at every missing sample, a table of gaps
surface      dynamic Allan variance by ``(axis, time, tau)``
product      surface plus the coefficients Q, N, B, K, R by ``(axis, time)``

A recording and a simulation have the same schema. The table `VARIABLES` holds the attributes of
every product variable; the stages and the export all read it.
"""

from __future__ import annotations

import os
from collections.abc import Hashable
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import SchemaError
from gyrostab.noise import LAWS, TERMS
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

#: What tau may differ from a whole number of samples, as a share: the rounding of stored numbers,
#: far below a sample in any window.
_TAU_TOLERANCE = 1e-9

#: Name of the gyro signal -> its unit; a log has one of them, and its ``kind`` attribute names it.
SIGNAL_UNITS = {"rate": INNER["rate"], "angle": INNER["angle"]}

#: Name of the gyro signal -> its label in figures.
SIGNAL_LONG_NAMES = {"rate": "rotation rate", "angle": "angle"}


def _flag_attributes(meanings: tuple[str, ...]) -> dict[str, Any]:
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
    "estimator": {"long_name": "estimator of the Allan variance", **_flag_attributes(ESTIMATORS)},
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
    "gap_edge_ratio": _make_attrs("scatter of the samples next to gaps over that of the others"),
    "window_coverage": _make_attrs("share of the window's samples that are present"),
    "observable": {
        "long_name": "whether the window shows the noise term",
        **_flag_attributes(OBSERVABLE),
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
        extra: dict[str, Any] = {"unit_label": law.label}
        note = ""
        if law.tau_ref_hours is not None:
            extra["tau_ref"] = f"{law.tau_ref_hours:g} h"
            extra["comment"] = f"numerically {symbol} in {law.label}"
            note = f", Allan deviation of its term at {law.tau_ref_hours:g} h"
        base = {"units": law.units, **extra}
        VARIABLES[symbol] = {"long_name": f"{law.name} coefficient{note}", **base}
        VARIABLES[f"{symbol}_stderr"] = {
            "long_name": f"standard error of the {law.name} coefficient{note}",
            **base,
        }
        VARIABLES[f"{symbol}_upper"] = {
            "long_name": f"95 % upper limit of the {law.name} coefficient{note}",
            **base,
        }
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
    }
)


def attributes(name: str, *, variance: str = "Allan") -> dict[str, Any]:
    """A fresh copy of the attributes of a product variable, for the variance of that name."""
    attrs = dict(VARIABLES[name])
    attrs["long_name"] = attrs["long_name"].replace("Allan variance", f"{variance} variance")
    return attrs


def signal_name(log: xr.Dataset) -> str:
    """``"rate"`` or ``"angle"``: which gyro signal the dataset holds.

    Raises
    ------
    SchemaError
        When it holds neither, or both.
    """
    signals = [name for name in SIGNAL_UNITS if name in log.data_vars]
    if "avar" in log.data_vars:
        kind = "product" if "observable" in log.data_vars else "DAVAR surface"
        raise SchemaError(f"this is a {kind}, not a log; give the log from which it was computed")
    if len(signals) != 1:
        holds = ", ".join(signals or sorted(map(str, log.data_vars))) or "nothing"
        raise SchemaError(
            f"a log holds either 'rate' or 'angle'; this dataset holds {holds}; "
            "make one with gyrostab.make_log"
        )
    return signals[0]


def texts(dataset: xr.Dataset, name: str) -> list[str]:
    """Return the texts of an attribute such as ``notes`` or ``source_files`` as a list.

    A single text may be stored without a list.

    Examples
    --------
    >>> texts(xr.Dataset(attrs={"notes": "one"}), "notes"), texts(xr.Dataset(), "notes")
    (['one'], [])
    """
    held = dataset.attrs.get(name, ())
    return [held] if isinstance(held, str) else [str(text) for text in held]


def log_channels(log: xr.Dataset) -> list[str]:
    """List the channels of a log: one-dimensional variables on ``time`` or ``time_<channel>``."""
    return [
        str(name)
        for name in log.data_vars
        if log.variables[name].dims in (("time",), (f"time_{name}",))
    ]


def is_rate_of_change(name: str, product: xr.Dataset) -> bool:
    """Whether a channel of a product is the rate of change of another of its channels."""
    return name.endswith("_rate") and name.removesuffix("_rate") in product.data_vars


def require_dataset(dataset: Any, kind: str) -> None:
    """Raise `SchemaError` unless this is a dataset, and not the name of its file."""
    if isinstance(dataset, str | os.PathLike):
        raise SchemaError(
            f"{os.fspath(dataset)!r} is the name of a file, not a {kind}: open it with "
            f"{_OPENERS[kind]}"
        )
    if not isinstance(dataset, xr.Dataset):
        raise SchemaError(
            f"this is a {type(dataset).__name__}, not a {kind}: give the whole xarray.Dataset; "
            f"{_MAKERS[kind]} makes one, and gyrostab.from_dataframe and gyrostab.from_dataarray "
            "make logs"
        )


def _require_variables(dataset: xr.Dataset, kind: str, dims: dict[str, tuple[str, ...]]) -> None:
    require_dataset(dataset, kind)
    for name, expected in dims.items():
        if name not in dataset.variables:
            raise SchemaError(
                f"this is not a {kind}: it has no variable {name!r}; "
                f"it has {sorted(map(str, dataset.variables))}"
            )
        if (has := dataset.variables[name].dims) != expected:
            raise SchemaError(
                f"{kind}: variable {name!r} has dimensions {has}, expected {expected}; "
                f"{_advise_dimensions(has, expected)}"
            )


def _advise_dimensions(has: tuple[Hashable, ...], expected: tuple[str, ...]) -> str:
    """Advise what gives a variable the expected dimensions."""
    lost = [name for name in expected if name not in has]
    extra = [name for name in has if name not in expected]
    if not lost and not extra:
        order = ", ".join(map(repr, expected))
        return f"call .transpose({order}, ...), or open a file with engine='gyrostab'"
    if not extra:
        return f"keep the dimension {lost[0]!r}, also to select one: .isel({lost[0]}=[0])"
    if not lost:
        return (
            f"if datasets were concatenated along {extra[0]!r}, give xarray.concat "
            "data_vars='minimal'"
        )
    return f"rename {extra[0]!r} to {lost[0]!r}"


#: What a message calls a dataset -> the function that makes one.
_MAKERS = {
    "raw log": "gyrostab.read_log",
    "log": "gyrostab.make_log",
    "DAVAR surface": "gyrostab.davar",
    "product": "gyrostab.fit_noise",
}

#: What a message calls a dataset -> the function that opens its file.
_OPENERS = {
    "raw log": "gyrostab.read_log",
    "log": (
        "gyrostab.open_log, or a file of another program with "
        "gyrostab.regularise(gyrostab.read_log(...))"
    ),
    "DAVAR surface": "gyrostab.open_surface",
    "product": "gyrostab.open_product",
}


def check_raw(raw: xr.Dataset) -> None:
    """Raise `SchemaError` unless `raw` is what a reader returns (see `gyrostab.ingest`)."""
    _require_variables(raw, "raw log", {})
    name = signal_name(raw)
    _require_variables(raw, "raw log", {name: ("axis", "row")})
    _check_units(raw, name)


def check_log(log: xr.Dataset, *, rate: bool = True) -> None:
    """Raise `SchemaError` unless `log` is a regular log: uniform time, a signal with units, a rate.

    Whether ``time`` is uniform, and the rate true, is checked by
    `gyrostab.ingest.uniform.as_uniform`, which every function that takes a log calls. With
    ``rate=False`` the attribute ``sampling_rate_hz`` may be absent.
    """
    if "row" in log.dims:
        raise SchemaError(
            "these are raw rows with their stamps as written; call gyrostab.regularise(raw) first"
        )
    name = signal_name(log)
    _require_variables(log, "log", {name: ("axis", "time"), "time": ("time",)})
    _check_units(log, name)
    if log.sizes["axis"] == 0 or log.sizes["time"] == 0:
        raise SchemaError("the log is empty: it has no axis or no sample")
    names = [str(axis) for axis in log["axis"].values]
    if len(set(names)) < len(names):
        raise SchemaError(
            f"the axes {', '.join(map(repr, names))} have names in common; rename them with "
            "log.assign_coords(axis=[...])"
        )
    declared = log.attrs.get("sampling_rate_hz")
    if rate and (declared is None or not np.isfinite(declared) or declared <= 0):
        raise SchemaError(
            "the log needs the attribute 'sampling_rate_hz' in Hz, a number above 0; "
            f"it has {declared!r}"
        )


def _check_units(dataset: xr.Dataset, name: str) -> None:
    units = dataset.variables[name].attrs.get("units")
    if units is None:
        raise SchemaError(
            f"variable {name!r} has no units; set them, {SIGNAL_UNITS[name]!r} if they were not "
            f"changed: dataset[{name!r}].attrs['units'] = {SIGNAL_UNITS[name]!r}"
        )
    if units != SIGNAL_UNITS[name]:
        raise SchemaError(
            f"variable {name!r} has units {units!r}, expected {SIGNAL_UNITS[name]!r}; "
            f"gyrostab.from_dataarray(dataset[{name!r}]) converts it"
        )


def with_axis(product: xr.Dataset) -> xr.Dataset:
    """Return a surface or product with its dimension ``axis``, also after ``.sel(axis="x")``."""
    if not isinstance(product, xr.Dataset) or "axis" not in product or product["axis"].ndim:
        return product
    names = [name for name in VARIABLES if name in product.data_vars]
    return product.assign({name: product[name].expand_dims("axis") for name in names})


def check_surface(surface: xr.Dataset) -> None:
    """Raise `SchemaError` unless `surface` is what `gyrostab.davar` returns, or a part of it."""
    cube = ("axis", "time", "tau")
    _require_variables(
        surface,
        "DAVAR surface",
        dict.fromkeys(("avar", "count", "coverage", "edf", "estimator"), cube),
    )
    _require_variables(
        surface, "DAVAR surface", dict.fromkeys(("window_mean", "window_coverage"), cube[:2])
    )
    units, expected = surface.variables["avar"].attrs.get("units"), VARIABLES["avar"]["units"]
    if units != expected:
        raise SchemaError(
            f"variable 'avar' has units {units!r}, expected {expected!r}; "
            "give the surface as gyrostab.davar made it"
        )
    _check_labels(surface, "surface")
    _check_tau(surface)


def _check_labels(dataset: xr.Dataset, kind: str) -> None:
    """Windows have dates and times, and axes have names."""
    for name, kinds, holds, example in (
        ("time", "M", "dates and times", "times of datetime64"),
        ("axis", "OTU", "names", "['x', 'y', 'z']"),
    ):
        labels = dataset[name].values
        if labels.dtype.kind not in kinds or bool(dataset[name].isnull().any()):
            shown = ", ".join(str(label) for label in labels[:3])
            raise SchemaError(
                f"{name!r} of the {kind} holds {shown}{', ...' if labels.size > 3 else ''}, not "
                f"{holds}; give them with .assign_coords({name}=...), {example}"
            )


def _check_tau(surface: xr.Dataset) -> None:
    """Averaging times are whole numbers of samples, and the window as long as its samples."""
    rate = surface.attrs.get("sampling_rate_hz")
    if rate is None or "tau" not in surface.variables:
        return
    if not isinstance(rate, int | float | np.number):
        raise SchemaError(
            f"sampling_rate_hz of the surface is {rate!r}, not a number of Hz; "
            "set it with .assign_attrs(sampling_rate_hz=...)"
        )
    factors = np.asarray(surface.variables["tau"].values, dtype=np.float64) * float(rate)
    whole_factors = np.rint(factors)
    if (
        np.any(whole_factors < 1)
        or np.any(np.abs(factors - whole_factors) > _TAU_TOLERANCE * whole_factors)
        or np.any(np.diff(whole_factors) <= 0)
    ):
        raise SchemaError(
            "the averaging times of the surface are not rising whole numbers of samples at "
            f"{float(rate):g} Hz (sampling_rate_hz): they have been averaged, interpolated or "
            "sorted, or stem from another log; choose them with taus=... in gyrostab.davar"
        )
    samples, seconds = surface.attrs.get("window_samples"), surface.attrs.get("window_s")
    if (
        samples is not None
        and seconds is not None
        and abs(samples / rate - seconds) > _TAU_TOLERANCE * seconds
    ):
        raise SchemaError(
            f"the surface has windows of {samples} samples and of {seconds:g} s, "
            f"which do not agree at {float(rate):g} Hz: its attributes "
            "have been changed; compute it anew with gyrostab.davar"
        )


def check_coefficients(product: xr.Dataset) -> None:
    """Raise `SchemaError` unless `product` holds the coefficients of every axis and window."""
    _require_variables(product, "product", {"axis": ("axis",), "time": ("time",)})
    for name in (f"{term}{end}" for term in TERMS for end in ("", "_stderr", "_upper")):
        _require_variables(product, "product", {name: ("axis", "time")})
    _require_variables(product, "product", {"observable": ("axis", "time", "term")})
    terms = [str(term) for term in product["term"].values]
    if terms != list(TERMS):
        raise SchemaError(
            f"'term' of the product holds {', '.join(terms)}, expected {', '.join(TERMS)}; "
            "give the product with all terms"
        )
    _check_labels(product, "product")


def check_product(product: xr.Dataset) -> None:
    """Raise `SchemaError` unless `product` is what `gyrostab.fit_noise` returns."""
    check_surface(product)
    check_coefficients(product)
    for name in ("fit_tau_min", "filter_time_constant", "filter_white_error"):
        if name in product:
            _require_variables(product, "product", {name: ("axis",)})

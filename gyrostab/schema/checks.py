"""One check for each dataset, and what the checks and stages ask of a dataset."""

from __future__ import annotations

import os
from collections.abc import Hashable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.errors import SchemaError
from gyrostab.noise import TERMS
from gyrostab.schema.variables import (
    OBSERVED,
    RESERVED_NAMES,
    SIGNAL_UNITS,
    UPPER_LIMIT_ONLY,
    VARIABLES,
)
from gyrostab.units import known_units

#: What tau may differ from a whole number of samples, as a share: the rounding of stored numbers,
#: far below a sample in any window.
_TAU_TOLERANCE = 1e-9


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


def escape_text(text: str) -> str:
    r"""Escape what UTF-8 cannot hold: bytes of file names in another encoding.

    Examples
    --------
    >>> print(escape_text("run\udcff.csv"))
    run\udcff.csv
    """
    return text.encode("utf-8", "backslashreplace").decode()


def texts(dataset: xr.Dataset, name: str) -> list[str]:
    """Return the texts of an attribute such as ``notes`` or ``source_files`` as a list.

    A single text may be stored without a list. All can be written as UTF-8.

    Examples
    --------
    >>> texts(xr.Dataset(attrs={"notes": "one"}), "notes"), texts(xr.Dataset(), "notes")
    (['one'], [])
    """
    held = dataset.attrs.get(name, ())
    return [escape_text(str(text)) for text in ([held] if isinstance(held, str) else held)]


def name_axes(signal: Any) -> list[str]:
    """Return the names of the axes of a log or a signal, whatever the type of its labels.

    Up to three axes without labels are x, y and z.

    Raises
    ------
    SchemaError
        When more axes have no labels.

    Examples
    --------
    >>> name_axes(xr.Dataset(coords={"axis": [0, 1]})), name_axes(xr.DataArray(np.zeros(100)))
    (['0', '1'], ['x'])
    """
    if "axis" in signal.coords:
        labels = np.atleast_1d(signal["axis"].values)
        return [label.decode() if isinstance(label, bytes) else str(label) for label in labels]
    count = signal.sizes.get("axis", 1)
    if count > len("xyz"):
        raise SchemaError(
            f"there are {count} axes without names; give them: .assign_coords(axis=[...])"
        )
    return list("xyz"[:count])


def log_channels(log: xr.Dataset) -> list[str]:
    """List the channels of a log: one-dimensional variables on ``time`` or ``time_<channel>``."""
    return [
        str(name)
        for name in log.data_vars
        if log.variables[name].dims in (("time",), (f"time_{name}",))
    ]


def find_unusable_channels(log: xr.Dataset) -> dict[str, str]:
    """Find the variables on the time of a log that cannot be used as channels, with reasons.

    Examples
    --------
    >>> log = xr.Dataset({"pump": ("time", ["on", "off"]), "pressure": ("time", [1e5, 2e5])})
    >>> find_unusable_channels(log)
    {'pump': 'it holds text, not numbers'}
    """
    reasons: dict[str, str] = {}
    for name, array in log.data_vars.items():
        if name in RESERVED_NAMES or not {"time", f"time_{name}"}.intersection(array.dims):
            continue
        if array.ndim > 1:
            (other, *_) = (dim for dim in array.dims if dim not in ("time", f"time_{name}"))
            reasons[str(name)] = (
                f"it has dimensions {array.dims}, and a channel lies on time only; make a channel "
                f"of each part, for instance of log[{name!r}].isel({other}=0, drop=True)"
            )
        elif array.dtype.kind in "SUT":
            reasons[str(name)] = "it holds text, not numbers"
        elif array.dtype.kind not in "iuf":
            reasons[str(name)] = (
                f"it holds values of type {array.dtype}, not real numbers; convert them, with "
                f"log[{name!r}].astype(float) if they are numbers"
            )
    return reasons


def is_rate_of_change(name: str, product: xr.Dataset) -> bool:
    """Whether a channel of a product is the rate of change of another of its channels."""
    return name.endswith("_rate") and name.removesuffix("_rate") in product.data_vars


def split_coefficient(product: xr.Dataset, term: str) -> tuple[Floats, Floats]:
    """Return the values of a term where it is observed, and the upper limits where it has only one.

    Both are NaN elsewhere.
    """
    state = product["observable"].sel(term=term).values
    values = np.where(state == OBSERVED, product[term].values, np.nan)
    return values, np.where(state == UPPER_LIMIT_ONLY, product[f"{term}_upper"].values, np.nan)


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
    refuse_multi_index(dataset, kind)


def refuse_multi_index(data: xr.Dataset | xr.DataArray, kind: str) -> None:
    """Raise `SchemaError` where a MultiIndex of xarray replaces axis or time."""
    for dim, index in data.xindexes.items():
        levels = (
            list(map(str, index.index.names))
            if isinstance(index, xr.indexes.PandasMultiIndex)
            else []
        )
        dates = [name for name in levels if data[name].dtype.kind == "M"]
        if dim not in data.dims or not {"axis", "time"}.intersection([dim, *levels]) or not levels:
            continue
        if dim == "time":
            level = dates[0] if dates else levels[0]
            advice = f".reset_index('time').set_index(time={level!r})"
        elif dim == "axis":
            advice = ".reset_index('axis', drop=True).assign_coords(axis=[...])"
        else:
            advice = f".unstack({dim!r})"
        raise SchemaError(
            f"the dimension {dim!r} of the {kind} has a MultiIndex of {', '.join(levels)}; undo it "
            f"with {advice}"
        )


def _require_variables(dataset: xr.Dataset, kind: str, dims: Mapping[str, tuple[str, ...]]) -> None:
    require_dataset(dataset, kind)
    for name, expected in dims.items():
        if name not in dataset.variables:
            raise SchemaError(
                f"this is not a {kind}, which {_MAKERS[kind]} makes: it has no variable {name!r}; "
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
        return f"keep the dimension {lost[0]!r}, even to select one label: .isel({lost[0]}=[0])"
    if not lost:
        return (
            f"if datasets were concatenated along {extra[0]!r}, give xarray.concat "
            "data_vars='minimal'; instead of .where(...), which repeats every variable along "
            f"{extra[0]!r}, select with .isel({extra[0]}=...)"
        )
    if len(extra) > len(lost):
        return f"select one label of {extra[0]!r}: .isel({extra[0]}=0)"
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
    if (kind := log.variables[name].dtype).kind not in "biuf":
        raise SchemaError(
            f"variable {name!r} holds values of type {kind}; give real numbers, and NaN where one "
            f"is missing: log.assign({name}=log.{name}.astype(float))"
        )
    if reserved := sorted(RESERVED_NAMES.intersection(log_channels(log))):
        raise SchemaError(
            f"channel {reserved[0]!r}: variables of gyrostab have this name; choose another one: "
            f"log.rename({reserved[0]}='{reserved[0]}_channel')"
        )
    if log.sizes["axis"] == 0 or log.sizes["time"] == 0:
        raise SchemaError("the log is empty: it has no axis or no sample")
    _refuse_equal_axes(name_axes(log), "log")
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
            f"known units of a Dataset are converted ({known_units(name)}), also by "
            "gyrostab.to_netcdf"
        )


def with_axis(product: xr.Dataset) -> xr.Dataset:
    """Return a surface or product with its dimension ``axis``, even after ``.sel(axis="x")``."""
    if not isinstance(product, xr.Dataset) or "axis" not in product or product["axis"].ndim:
        return product
    names = [name for name in VARIABLES if name in product.data_vars]
    return product.assign({name: product[name].expand_dims("axis") for name in names})


def describe_times(log: xr.Dataset, product: xr.Dataset) -> str:
    """Describe the times of a log and of the windows of a product that do not belong together.

    Examples
    --------
    >>> log = xr.Dataset(coords={"time": np.array(["2026-05-01", "2026-05-02"], "datetime64[ns]")})
    >>> describe_times(log, log.assign_coords(time=log["time"] + np.timedelta64(1, "h")))[:67]
    'the log goes from 2026-05-01T00:00:00 to 2026-05-02T00:00:00, and t'
    """
    (start, end), (first, last) = (
        np.datetime_as_string(times.values[[0, -1]], unit="s")
        for times in (log["time"], product["time"])
    )
    return (
        f"the log goes from {start} to {end}, and the windows of the product are centred from "
        f"{first} to {last}; give the log of this product"
    )


def check_surface(surface: xr.Dataset, kind: str = "DAVAR surface") -> None:
    """Raise `SchemaError` unless `surface` is what `gyrostab.davar` returns, or a part of it.

    Messages call it `kind`.
    """
    cube = ("axis", "time", "tau")
    _require_variables(
        surface,
        kind,
        {name: cube for name in ("avar", "count", "coverage", "edf", "estimator")}
        | {name: cube[:2] for name in ("window_mean", "window_coverage")},
    )
    units, expected = surface.variables["avar"].attrs.get("units"), VARIABLES["avar"]["units"]
    if units != expected:
        raise SchemaError(
            f"variable 'avar' has units {units!r}, expected {expected!r}; "
            "give the surface as gyrostab.davar made it"
        )
    _check_labels(surface, "surface")
    _check_tau(surface)


def _refuse_equal_axes(names: list[str], kind: str) -> None:
    if len(set(names)) < len(names):
        raise SchemaError(
            f"the axes {', '.join(map(repr, names))} have names in common; rename them with "
            f"{kind}.assign_coords(axis=[...])"
        )


def _check_labels(dataset: xr.Dataset, kind: str) -> None:
    """Windows have dates and times, axes have names, and there are some of them."""
    for name, counted in (("time", "window"), ("axis", "axis"), ("tau", "averaging time")):
        if dataset.sizes.get(name) == 0:
            raise SchemaError(
                f"there is no {counted}: the dimension {name!r} is empty; select some"
            )
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
    _refuse_equal_axes(name_axes(dataset), kind)


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
    if not (  # NaN compares false
        np.all(whole_factors >= 1)
        and np.all(np.abs(factors - whole_factors) <= _TAU_TOLERANCE * whole_factors)
        and np.all(np.diff(whole_factors) > 0)
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
    require_dataset(product, "product")
    if "observable" not in product.variables:
        raise SchemaError(
            "this is not a product: it holds no coefficients yet; call gyrostab.fit_noise (or "
            "'gyrostab fit') first"
        )
    names = [f"{term}{end}" for term in TERMS for end in ("", "_stderr", "_upper")]
    dims = {"axis": ("axis",), "time": ("time",), **dict.fromkeys(names, ("axis", "time"))}
    _require_variables(product, "product", {**dims, "observable": ("axis", "time", "term")})
    terms = [str(term) for term in product["term"].values]
    if terms != list(TERMS):
        raise SchemaError(
            f"'term' of the product holds {', '.join(terms)}, expected {', '.join(TERMS)}; "
            "give the product with all terms"
        )
    _check_labels(product, "product")


def check_product(product: xr.Dataset) -> None:
    """Raise `SchemaError` unless `product` is what `gyrostab.fit_noise` returns."""
    check_surface(product, "product")
    check_coefficients(product)
    names = ("fit_tau_min", "filter_time_constant", "filter_white_error")
    _require_variables(product, "product", {name: ("axis",) for name in names if name in product})

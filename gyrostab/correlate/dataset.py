"""The correlation as a dataset with units on every variable."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.correlate.drivers import Driver, slope_units
from gyrostab.correlate.judge import LIMITS, VERDICTS, slope_label
from gyrostab.errors import OptionError
from gyrostab.noise import TERMS
from gyrostab.schema import flag_attributes

_PLACE = ("axis", "variable", "driver")
# Key of the entry, long name and units of each variable.
_STATISTICS = {
    "coupling_lag": ("lag", "time by which the variable follows the driver", "s"),
    "correlation": ("correlation", "correlation of the block means at that lag", "1"),
    "partial_correlation_time": (
        "partial_time",
        "partial correlation at that lag, given time",
        "1",
    ),
    "partial_correlation_channels": (
        "partial_channels",
        "partial correlation at that lag, given time and the other channels",
        "1",
    ),
    "p_value": ("p_value", "p-value of the sensitivity at that lag alone", "1"),
    "p_value_adjusted": (
        "p_adjusted",
        "p-value adjusted for the search over lags, axes, variables and drivers",
        "1",
    ),
    "p_value_partial": ("p_partial", "p-value of the sensitivity, given the other drivers", "1"),
    "effective_samples": ("effective", "effective number of independent samples", "1"),
}
#: Names of a correlation that no channel may have.
_RESULTS = {
    *_STATISTICS,
    *("windows_used", "coupling_verdict", "coupling_limits", "statement", "variable", "driver"),
}
#: Key of the entry, and end of the long name of each number of a sensitivity.
_SLOPES = {
    "slope": "",
    "stderr": ", standard error",
    "low": ", lower end of the {level:g} % interval",
    "high": ", upper end of the {level:g} % interval",
    "rising": ", while it rises",
    "rising_stderr": ", while it rises, standard error",
    "falling": ", while it falls",
    "falling_stderr": ", while it falls, standard error",
}
_SLOPES |= {
    "partial": ", given the other drivers",
    **{f"partial_{key}": f", given the other drivers{_SLOPES[key]}" for key in list(_SLOPES)[1:4]},
}


def check_names(drivers: list[Driver]) -> None:
    """Raise `OptionError` if a channel has the name of a result, which would replace it."""
    for name in _RESULTS.intersection(driver.name for driver in drivers):
        raise OptionError(
            f"channel {name!r} has the name of a result of the correlation; give it another one, "
            f"for instance with .rename({name}='other_name') or --map {name}=other_name"
        )


def make_coupling_dataset(
    product: xr.Dataset,
    names: list[str],
    drivers: list[Driver],
    entries: dict[tuple[int, int, int], dict[str, Any]],
    *,
    level: float,
    longest: float,
) -> xr.Dataset:
    """Build the dataset of entries by (axis, variable, driver), with the series they describe."""
    table = np.empty((product.sizes["axis"], len(names), len(drivers)), dtype=object)
    for place, entry in entries.items():
        table[place] = entry
    copied = [*names, *(["observable"] if set(names) & set(TERMS) else [])]
    result = (
        product[copied].drop_attrs(deep=False).assign_coords(time_bounds=product["time_bounds"])
    )
    statement = _entry_values(table, "statement", str), {"long_name": "result in one sentence"}
    result = result.assign(
        {
            **_driver_series(product, drivers),
            **_tabulate_statistics(table),
            **_tabulate_slopes(product, names, drivers, table, level),
            "statement": (_PLACE, *statement),
        }
    )
    labels = {
        "variable": (names, "variable of the product"),
        "driver": ([driver.name for driver in drivers], "channel that may drive the variable"),
    }
    result = result.assign_coords(
        {
            dim: (dim, np.array(values, dtype=str), {"long_name": text})
            for dim, (values, text) in labels.items()
        }
    )
    kept_attrs = ("sampling_rate_hz", "window_s", "step_s", "source_files", "history")
    result.attrs = {name: product.attrs[name] for name in kept_attrs if name in product.attrs}
    result.attrs |= {
        "title": "Coupling of a gyro's noise coefficients and window means with a channel",
        "interval_level": level,
    }
    return result.assign_attrs(longest_lag_s=longest)


def _entry_values(table: Array, key: str, dtype: Any = np.float64) -> Array:
    """Return one value of every entry in a table of entries, in its shape."""
    return np.array([entry[key] for entry in table.flat], dtype).reshape(table.shape)


def _driver_series(product: xr.Dataset, drivers: list[Driver]) -> dict[str, Any]:
    """Return the series of every driver: the one in the product, or the means of its windows."""
    made: dict[str, Any] = {}
    for driver in drivers:
        attributes = {"long_name": f"{driver.label}, mean of the window", "units": driver.units}
        made[driver.name] = (
            product[driver.name] if driver.of_product else ("time", driver.values[0], attributes)
        )
    return made


def _tabulate_statistics(table: Array) -> dict[str, Any]:
    """Return statistics, verdicts and their limits by (axis, variable, driver)."""
    made: dict[str, Any] = {
        name: (_PLACE, _entry_values(table, key), {"long_name": label, "units": units})
        for name, (key, label, units) in _STATISTICS.items()
    }
    made["windows_used"] = (
        _PLACE,
        _entry_values(table, "windows", np.int32),
        {"long_name": "windows used", "units": "1"},
    )
    label = "what the record shows about the coupling"
    verdict_attrs = {"long_name": label, **flag_attributes(VERDICTS)}
    made["coupling_verdict"] = (_PLACE, _entry_values(table, "verdict", np.int8), verdict_attrs)
    masks = {name: 1 << bit for bit, name in enumerate(LIMITS)}
    bits = [sum(masks[name] for name in entry["limits"]) for entry in table.flat]
    limit_attrs = {
        "long_name": "what limits the verdict",
        "flag_masks": np.array(list(masks.values()), np.int16),
        "flag_meanings": " ".join(masks),
    }
    made["coupling_limits"] = (_PLACE, np.array(bits, np.int16).reshape(table.shape), limit_attrs)
    return made


def _tabulate_slopes(
    product: xr.Dataset,
    names: list[str],
    drivers: list[Driver],
    table: Array,
    level: float,
) -> dict[str, Any]:
    """Return the sensitivities of each variable to each driver, by axis."""
    made: dict[str, Any] = {}
    for (v, name), (d, driver) in itertools.product(enumerate(names), enumerate(drivers)):
        attributes = {
            "units": slope_units(str(product[name].attrs.get("units", "1")), driver.units),
            "unit_label": slope_label(product[name], driver.units),
        }
        for key, text in _SLOPES.items():
            suffix = "" if key == "slope" else f"_{key}"
            series = name.replace("_", " ")
            label = f"sensitivity of {series} to {driver.label}{text.format(level=100 * level)}"
            made[f"{name}_per_{driver.name}{suffix}"] = (
                "axis",
                _entry_values(table[:, v, d], key),
                {"long_name": label, **attributes},
            )
    return made


def join(product: xr.Dataset, result: xr.Dataset) -> xr.Dataset:
    """Merge product and correlation; a variable that both hold is taken from the product.

    An earlier correlation in the product is replaced, including the series of its file.
    """
    replaced = [
        name
        for name in map(str, result["driver"].values)
        if name in product and not product[name].identical(result[name])
    ]
    product = product.drop_vars(replaced)
    earlier = [str(name) for name in product.get("driver", xr.DataArray([])).values]
    sensitivities = [
        name
        for name in map(str, product.data_vars)
        if any(f"_per_{driver}" in name for driver in earlier)
    ]
    product = product.drop_vars(sensitivities).drop_dims(["driver", "variable"], errors="ignore")
    new = [name for name in result.data_vars if name not in product.variables]
    return product.merge(result[new], compat="no_conflicts").assign_attrs(
        interval_level=result.attrs["interval_level"], longest_lag_s=result.attrs["longest_lag_s"]
    )

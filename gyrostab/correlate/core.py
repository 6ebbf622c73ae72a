"""Correlate window means and coefficients with a channel and its rate of change."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.correlate.dataset import check_names, make_coupling_dataset
from gyrostab.correlate.drivers import Driver, align_drivers, other_channels, suggest_channels
from gyrostab.correlate.fit import (
    SIGNIFICANCE,
    Blocks,
    fit_driver,
    fit_partial_effects,
    make_blocks,
)
from gyrostab.correlate.judge import VERDICTS, describe_coupling, slope_label
from gyrostab.errors import OptionError, SchemaError
from gyrostab.noise import TERMS
from gyrostab.schema import OBSERVED, check_product, with_axis
from gyrostab.time.durations import duration_seconds

_MAX_LAGS = 48
#: Share of the samples of a window from which on it is used.
_MIN_COVERAGE = 0.05


def correlate(
    product: xr.Dataset,
    *,
    channel: str | xr.DataArray | Sequence[str | xr.DataArray] = "temperature",
    variables: str | Sequence[str] | None = None,
    max_lag: Any = None,
    level: float = 0.95,
) -> xr.Dataset:
    """Estimate the coupling of window means and coefficients with a channel and its rate of change.

    Each series is regressed on the driver at every lag by generalised least squares, together with
    a constant, a trend in time and a constant for every segment between long gaps; then on all
    drivers together, each at its best-fitting lag, so that the effect of a channel is not taken for
    one of its rate of change. The noise of the
    series is white (shared by overlapping windows) plus a slow part of unknown strength and memory;
    slopes and p-values are averaged over these noise laws, weighted by their restricted likelihood.
    The p-value allows for the search over lags (by simulation with a fixed seed) and over axes,
    variables and drivers (Holm).

    Parameters
    ----------
    product : xarray.Dataset
        Product of `gyrostab.fit_noise`.
    channel : str, DataArray or sequence of them
        Channel of the product, or a channel with a separate time coordinate, which is averaged over
        the windows. With several, the rates of change are drivers only if they are named
        (``["temperature", "temperature_rate", "vibration"]``). The partial effect of each driver
        is estimated, given the others at their best-fitting lags, from the windows in which all are
        known. A driver that cannot be fitted alone, for instance one without values, is left out of
        these effects.
    variables : str or sequence of str, optional
        Names with dims ``(axis, time)``; by default ``window_mean`` and every coefficient that is
        observed in at least one window.
    max_lag : str, timedelta or number, optional
        Longest time by which the gyro may follow the channel [s]; a tenth of the record by default,
        0 for none.
    level : float
        Confidence level of the intervals, from 0.5 to below 1.

    Returns
    -------
    xarray.Dataset
        By ``(axis, variable, driver)``: ``coupling_lag`` [s], ``correlation``,
        ``partial_correlation_time``, ``partial_correlation_channels``, ``p_value``,
        ``p_value_adjusted``, ``effective_samples``, ``windows_used``, ``coupling_verdict``,
        ``coupling_limits`` (flags), ``statement``; by ``axis`` the sensitivity
        ``<variable>_per_<driver>`` with ``_stderr``, ``_low``, ``_high``, ``_rising``, ``_falling``
        [units of the variable per unit of the driver]; and the series themselves. Given the other
        drivers: ``p_value_partial``, and ``<variable>_per_<driver>_partial`` with
        ``_partial_stderr``, ``_partial_low``, ``_partial_high``.

    Raises
    ------
    OptionError
        If a channel or variable is unknown, or the lag or the level is invalid.
    SchemaError
        If `product` is not a product.
    MissingUnitError
        If a channel with a separate time coordinate has no units.
    TimeError
        If a channel does not overlap the record.

    Examples
    --------
    >>> from gyrostab import davar, fit_noise, make_log
    >>> temperature = 30.0 + 5.0 * np.sin(2.0 * np.pi * np.arange(36_000) / 9000.0)
    >>> rate = 0.2 * temperature + np.random.default_rng(1).standard_normal(36_000)
    >>> channels = {"temperature": (temperature, "degC")}
    >>> log = make_log(rate, rate=10.0, unit="deg/h", channels=channels)
    >>> product = fit_noise(davar(log, window="1min", step="30s"))
    >>> result = correlate(product, variables="window_mean")
    >>> slope = result["window_mean_per_temperature"].sel(axis="x")
    >>> round(float(slope), 2), slope.unit_label
    (0.2, 'deg/h/K')
    """
    from threadpoolctl import threadpool_limits

    product = with_axis(product)
    check_product(product)
    _check_windows(product)
    if not (isinstance(level, int | float | np.number) and 0.5 <= level < 1.0):
        raise OptionError(
            f"level {level!r}: the level of an interval lies between 0.5 and 1, for instance 0.95"
        )
    names = _select_variables(product, variables)
    time = (product["time"].values - product["time"].values[0]) / np.timedelta64(1, "s")
    length, step = _window_lengths(product, time)
    lags = _choose_lags(max_lag, float(time[-1] - time[0]), step)
    channels = _list_channels(channel)
    drivers = align_drivers(product, channels, lags, step)
    check_names(drivers)
    other_series = [product[name].values for name in other_channels(product, drivers)]
    series = {
        (a, v): _usable_series(product, name, a)
        for v, name in enumerate(names)
        for a in range(product.sizes["axis"])
    }
    known, counts = _known_windows(drivers)
    coverage = product["window_coverage"].values.astype(np.float64)

    @functools.cache
    def find_blocks(mask: bytes, share: bytes) -> Blocks | None:
        return make_blocks(
            np.frombuffer(mask, dtype=np.bool_), time, length, step, np.frombuffer(share)
        )

    entries: dict[tuple[int, int, int], dict[str, Any]] = {}
    # the matrices are many and small: more threads would only wait for each other
    with threadpool_limits(1, user_api="blas"):
        for d, driver in enumerate(drivers):
            used = replace(driver, values=driver.values[: counts[d]])
            lag_times = lags[: counts[d]].astype(np.float64) * step
            for key, places in _group_series(series, known[d], coverage).items():
                rows = np.stack([series[place] for place in places])
                fitted = fit_driver(find_blocks(*key), rows, used, other_series, lag_times, level)
                entries |= {(*place, d): entry for place, entry in zip(places, fitted, strict=True)}
        _note_empty_drivers(product, drivers, is_single=len(channels) == 1)
        for (a, v), row in series.items():
            of_series = [entries[a, v, d] for d in range(len(drivers))]
            shared = known[["best" in entry for entry in of_series]].all(axis=0)
            blocks = find_blocks((np.isfinite(row) & shared).tobytes(), coverage[a].tobytes())
            fit_partial_effects(blocks, row, drivers, of_series, level)
    _adjust_p_values(entries)
    _judge_entries(entries, product, names, drivers)
    longest = float(lags[counts.max() - 1] * step)
    return make_coupling_dataset(product, names, drivers, entries, level=level, longest=longest)


def _list_channels(channel: Any) -> list[str | xr.DataArray]:
    """Return the channels to correlate with; raise `OptionError` for other objects."""
    is_list = isinstance(channel, Sequence) and not isinstance(channel, str)
    channels: list[Any] = list(channel) if is_list else [channel]
    for item in channels:
        if not isinstance(item, str | xr.DataArray):
            raise OptionError(
                f"a channel of type {type(item).__name__} is neither a name nor an "
                "xarray.DataArray; a pandas.Series on dates becomes one with "
                ".to_xarray().assign_attrs(units=...)"
            )
    return channels


def _group_series(
    series: Mapping[tuple[int, int], Floats], known: Bools, coverage: Floats
) -> dict[tuple[bytes, bytes], list[tuple[int, int]]]:
    """Group the places of series by the windows that they can use, and by their coverage."""
    groups: dict[tuple[bytes, bytes], list[tuple[int, int]]] = {}
    for place, row in series.items():
        mask = np.isfinite(row) & known
        groups.setdefault((mask.tobytes(), coverage[place[0]].tobytes()), []).append(place)
    return groups


def _judge_entries(
    entries: Mapping[tuple[int, int, int], dict[str, Any]],
    product: xr.Dataset,
    names: list[str],
    drivers: list[Driver],
) -> None:
    """Add verdict, unit and statement to each entry."""
    is_pair = [driver.name for driver in drivers[1:]] == [f"{drivers[0].name}_rate"]
    for (a, v, d), entry in entries.items():
        twin = entries[a, v, 1 - d] if is_pair else None
        entry["verdict"] = VERDICTS.index(_judge_coupling(entry, twin))
        entry["unit_label"] = slope_label(product[names[v]], drivers[d].units)
        series_name = f"{names[v].replace('_', ' ')} of axis {product['axis'].values[a]}"
        entry["statement"] = describe_coupling(entry, drivers[d].label, series_name)


def _check_windows(product: xr.Dataset) -> None:
    """Raise `SchemaError` unless the windows are in the order of time, with bounds."""
    if "time_bounds" not in product.variables:
        raise SchemaError(
            "the product has no 'time_bounds', which hold start and end of each window; give it as "
            "gyrostab.fit_noise or gyrostab.open_product returns it"
        )
    if (np.diff(product["time"].values) <= np.timedelta64(0)).any():
        raise SchemaError(
            "the windows of the product are not in the order of time, or occur twice; call "
            ".sortby('time').drop_duplicates('time')"
        )


def _select_variables(product: xr.Dataset, variables: str | Sequence[str] | None) -> list[str]:
    if variables is None:
        observed = [
            term for term in TERMS if bool((product["observable"].sel(term=term) == OBSERVED).any())
        ]
        return ["window_mean", *observed]
    is_single = isinstance(variables, str) or not np.iterable(variables)
    names: list[Any] = [variables] if is_single else list(variables)
    if not names:
        raise OptionError("give at least one variable, for instance window_mean")
    for name in names:
        if name not in product or product[name].dims != ("axis", "time"):
            raise OptionError(
                f"variable {name!r} is not in the product by (axis, time); try window_mean, "
                f"{', '.join(TERMS)}"
            )
    if len(set(names)) < len(names):
        raise OptionError(f"the variables {', '.join(names)} are not all different; name each once")
    return names


def _window_lengths(product: xr.Dataset, time: Floats) -> tuple[float, float]:
    """Find length and step of the windows [s]."""
    bounds = product["time_bounds"].values
    length = float(np.median(bounds[:, 1] - bounds[:, 0]) / np.timedelta64(1, "s"))
    spacing = float(np.median(np.diff(time))) if time.size > 1 else length
    return length, float(product.attrs.get("step_s", spacing))


def _choose_lags(max_lag: Any, span: float, step: float) -> Ints:
    longest = 0.1 * span if max_lag is None else duration_seconds(max_lag, "max_lag", zero=True)
    if longest > span:
        raise OptionError(
            f"max_lag {max_lag} is longer than the record ({span:g} s); give a shorter --max-lag"
        )
    max_steps = int(longest / step + 1e-9)
    return np.unique(
        np.rint(np.linspace(0, max_steps, min(max_steps + 1, _MAX_LAGS))).astype(np.int64)
    )


def _usable_series(product: xr.Dataset, name: str, axis: int) -> Floats:
    """Return a variable by window, NaN where it is not observed or almost no sample is present."""
    part = product.isel(axis=axis)
    if name == "window_coverage":
        return np.asarray(part[name].values, np.float64)
    good = part["window_coverage"].values > _MIN_COVERAGE
    if name in TERMS:
        good &= part["observable"].sel(term=name).values == OBSERVED
    return np.where(good, part[name].values, np.nan)


def _known_windows(drivers: list[Driver]) -> tuple[Bools, Ints]:
    """Find the windows in which each driver is known at every lag, and its number of lags.

    Lags that would cost more than a third of the windows are left out.
    """
    is_known = np.logical_and.accumulate([np.isfinite(driver.values) for driver in drivers], axis=1)
    windows = is_known.sum(axis=2)
    counts = np.array([np.flatnonzero(row >= 2 / 3 * row[0])[-1] + 1 for row in windows])
    return is_known[np.arange(len(drivers)), counts - 1], counts


def _note_empty_drivers(product: xr.Dataset, drivers: list[Driver], *, is_single: bool) -> None:
    """Warn of drivers without any value: effects of the others are estimated without them.

    `is_single` says that the drivers are one channel and its rate of change.
    """
    for driver in drivers[:1] if is_single else drivers:
        if np.isfinite(driver.values).any():
            continue
        note = (
            f" of the product; {suggest_channels(product, driver.name)}"
            if is_single
            else ", so it is left out: the effects of the other drivers are estimated without it"
        )
        warnings.warn(f"{driver.label} has no value in any window{note}", stacklevel=3)


def _adjust_p_values(entries: dict[tuple[int, int, int], dict[str, Any]]) -> None:
    """Adjust the p-values of all entries by Holm's method."""
    tested = sorted(
        (entry for entry in entries.values() if np.isfinite(entry["p_search"])),
        key=lambda entry: float(entry["p_search"]),
    )
    previous = 0.0
    for rank, entry in enumerate(tested):
        previous = entry["p_adjusted"] = min(
            1.0, max(previous, (len(tested) - rank) * entry["p_search"])
        )
    for entry in entries.values():
        entry.setdefault("p_adjusted", np.nan)
        entry["tests"] = len(tested)


def _judge_coupling(entry: dict[str, Any], twin: dict[str, Any] | None) -> str:
    """Return the verdict on a coupling, and add what limits it.

    `twin` is the coupling with the rate of change of the same channel, or with the channel of the
    same rate of change, if these are the only drivers. Where the record does not tell both apart,
    the one with the shorter lag is the simpler explanation.
    """
    if entry["limits"] & {"constant", "too_few", "clusters"} or not np.isfinite(entry["p_search"]):
        return "cannot_tell"
    if entry["p_adjusted"] >= SIGNIFICANCE:
        in_white_noise = entry.get("p_white", 1.0) * entry["tests"] < SIGNIFICANCE
        return "not_told_apart" if in_white_noise else "none_seen"
    # a partial effect that cannot be estimated (NaN) does not count as evidence
    is_apart = entry.get("p_partial", 0.0) < SIGNIFICANCE
    if not is_apart and twin is not None and not twin.get("p_partial", 0.0) < SIGNIFICANCE:
        is_apart = entry["lag"] < twin["lag"]
    if not (is_apart and entry.get("p_channels", 0.0) < SIGNIFICANCE):
        entry["limits"].add("other_channel")
    return "not_told_apart" if entry["limits"] & {"no_reversal", "other_channel"} else "coupled"

"""Dynamic Allan variance of a log as a surface ``(axis, time, tau)``."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.allan.channels import window_channels
from gyrostab.allan.compute import (
    CELL_FIELDS,
    FIELD_TYPES,
    PLANE_FIELDS,
    compute_windows,
    run_units,
)
from gyrostab.allan.plan import MOST_CELLS, SurfacePlan, make_plan, units_of_work
from gyrostab.errors import OptionError
from gyrostab.ingest.convert import as_log
from gyrostab.kernels.allan.variances import VARIANCES
from gyrostab.kernels.workspace import Workspace
from gyrostab.schema import attributes, find_unusable_channels, log_channels
from gyrostab.time.grid import first_stamp, grid_times

#: Smallest number of parts for the threads to share, if there are as many units of work.
_MIN_PARTS = 4
#: Largest share of the remaining units of work in one part: two threads then end at about the same
#: time.
_MAX_SHARE_OF_REST = 1 / 2


def davar(
    log: xr.Dataset,
    *,
    window: Any = None,
    step: Any = None,
    taus: Any = 40,
    tau_max: Any = None,
    axis: str | Sequence[str] | None = None,
    min_strict: float = 0.3,
    min_coverage: float = 0.1,
    variance: str = "avar",
) -> xr.Dataset:
    """Compute the dynamic overlapping Allan variance of a gyro log (improved fast DAVAR).

    A window moves along the record; in each window the Allan variance is the mean squared second
    difference of the angle,

        avar(t, tau) = < (theta[m + 2k] - 2 theta[m + k] + theta[m])^2 > / (2 tau^2),

    with ``tau = k / sampling rate``, over all ``window - 2k + 1`` positions m. Missing samples are
    left out, never filled.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log with ``rate(axis, time)`` [degree hour-1] or ``angle(axis, time)`` [degree],
        with dimensions in any order and NaN where a sample is missing, numpy or dask, float or
        integer; other known units in its attribute ``units`` are converted. A dask log stays lazy
        and gives the same bits for any chunking. The sampling rate is that of ``time``: a log that
        was thinned or averaged has its new rate, and dropped samples are missing. A DataArray with
        ``attrs["units"]``, or a pandas table as for `gyrostab.from_dataframe`, is also accepted.
    window, step : str or timedelta
        Length and step of the window: a duration (``"10min"``), or a number of samples
        (``"2000samples"``). A bare number is refused. `window` defaults to ten minutes, or less,
        so that at least four windows fit into the record; `step` to a tenth of the window.
    taus : int, {"octave", "all"} or sequence
        Averaging times: a number of them, evenly spaced in log tau; powers of two samples; every
        one; or a list [s] (numbers, or strings such as ``"0.1s"``). Each is rounded to a whole
        number of samples and reported exactly, with a warning if it changes by more than a fifth.
    tau_max : float or str, optional
        Longest averaging time [s]; a third of the window by default (L13), at most half of it.
    axis : str or sequence of str, optional
        Axes to use; all by default.
    min_strict, min_coverage : float
        In a rate log with gaps, the terms inside unbroken runs are used or, where fewer than
        `min_strict` of them are left, weighted cluster means (see ``estimator``); in an angle log,
        the terms of which all three angles are present. A cell whose coverage is below
        `min_coverage` is NaN.
    variance : {"avar", "hadamard", "modified"}
        The overlapping Allan variance; the overlapping Hadamard variance, which a constant drift
        of the rate does not change; or the modified Allan variance, in which quantization noise
        falls as tau^-3 and white noise as tau^-1. The last two use terms of three averaging times,
        so `tau_max` is at most a third of the window (2/9 by default), and no cluster means in
        gaps. Their values are in ``avar``, too; its ``long_name`` and the attribute ``variance``
        of the surface say which variance it is.

    Returns
    -------
    xarray.Dataset
        ``avar, count, coverage, edf, estimator, white_response, quantization_response,
        ramp_response, difference_trend (axis, time, tau)``, ``window_mean, window_coverage,
        window_trend, trend_response, trend_quantization_response, trend_flicker_response,
        trend_walk_response, outlier_count, gap_edge_ratio (axis, time)``, and every
        channel of the log averaged over each window; ``time`` is the centre of the window, with
        ``time_bounds``; ``tau`` [s]. Units are attributes of the variables. Global attributes are
        kept; coordinates of the log that are neither dimensions nor numbers on ``time`` are not.

    Raises
    ------
    OptionError
        If window, step or taus do not fit the record or each other, with a message that says which
        would, or if another option is invalid.
    SchemaError
        If `log` is not a regular log.
    MissingUnitError, UnitError
        If a DataArray or a table has no units, or no known ones.
    TimeError
        If its time is not in order, or not uniform.

    References
    ----------
    P16: Wang et al., Sensors 16 (2016), Eq. 16. L13: Li et al., Chin. J. Lasers 40 (2013)
    0908004. Degrees of freedom: Greenhall and Riley, PTTI 2003.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> noise = np.random.default_rng(1).standard_normal(60_000)
    >>> log = make_log(noise, rate=100.0, unit="deg/h")
    >>> surface = davar(log, window="1min", step="30s", taus=[0.01, 1.0])
    >>> surface.avar.sel(axis="x").dims, surface.sizes["time"]
    (('time', 'tau'), 19)
    >>> float(surface.avar.sel(tau=0.01).mean())  # white noise: avar = sd^2 / k
    0.99...
    """
    log = as_log(log)
    plan = make_plan(
        log, window=window, step=step, taus=taus, tau_max=tau_max, axis=axis,
        min_strict=min_strict, min_coverage=min_coverage, variance=variance,
    )  # fmt: skip
    _warn_unusable_channels(log)
    cells, means = run_units(plan)
    return _attach_labels(cells, means, log, plan)


def davar_parts(log: xr.Dataset, *, samples: int = 2**24, **options: Any) -> list[slice]:
    """Divide the windows of a surface into parts for `davar_part`.

    Each part consists of whole units of work; the last parts are smaller.

    Parameters
    ----------
    samples : int
        Samples of a part over all axes; a part has at least one unit of work. With closely spaced
        windows or few units, a part has fewer samples.

    Returns
    -------
    list of slice
        Windows of each part, counted from the first window of the log.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> log = make_log(np.zeros(10**6), rate=100.0, unit="deg/h")
    >>> davar_parts(log, samples=500_000, window="1min", step="30s")
    [slice(0, 85, None), slice(85, 170, None), slice(170, 255, None), slice(255, 332, None)]
    """
    log = as_log(log)
    plan = make_plan(log, **options)
    _warn_unusable_channels(log)
    axes, size = plan.signal.shape
    units = units_of_work(size, plan.unit)
    per_unit = max(1, units[0].stop - units[0].start)
    cells = axes * plan.unit.ks.size
    together = max(
        1,
        min(
            samples // (axes * per_unit * plan.unit.step),
            MOST_CELLS // (cells * per_unit),
            -(-len(units) // _MIN_PARTS),
        ),
    )
    edges = [0]
    while remaining := len(units) - edges[-1]:
        edges.append(edges[-1] + max(1, min(together, int(remaining * _MAX_SHARE_OF_REST))))
    return [slice(units[a].start, units[b - 1].stop) for a, b in pairwise(edges)]


def _warn_unusable_channels(log: xr.Dataset) -> None:
    """Warn of the channels that a surface does not have, where the calling function is called."""
    for name, reason in find_unusable_channels(log).items():
        warnings.warn(f"channel {name!r} is left out: {reason}", stacklevel=3)


def davar_part(
    log: xr.Dataset, *, part: slice, space: Workspace | None = None, **options: Any
) -> xr.Dataset:
    """Compute some windows of the surface of `davar`, immediately and in the calling thread.

    Only the samples of these windows are read, and dask computes nothing else, so that many parts
    can be computed in parallel, in threads, processes or on other machines. The numbers are those
    of `davar`, bit for bit.

    Parameters
    ----------
    part : slice
        Windows, counted from the first window of the log: one of `davar_parts`, or any other slice
        without a step.
    space : gyrostab.kernels.workspace.Workspace, optional
        Working memory, reused by parts that one thread computes one after the other.
    **options
        Options of `davar`.

    Raises
    ------
    OptionError
        If the options do not fit, or the part has no window.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> log = make_log(np.arange(60_000.0) % 7, rate=100.0, unit="deg/h")
    >>> part = davar_part(log, part=slice(3, 5), window="1min", step="30s")
    >>> part.equals(davar(log, window="1min", step="30s").isel(time=slice(3, 5)))
    True
    """
    log = as_log(log)
    plan = make_plan(log, **options)
    units = units_of_work(plan.signal.sizes["time"], plan.unit)
    first, stop, hop = part.indices(units[-1].stop)
    if first >= stop or hop != 1:
        raise OptionError(f"part={part}: give a slice of windows 0 to {units[-1].stop - 1}")
    part = slice(first, stop)
    units = [windows for windows in units if windows.start < stop and windows.stop > first]
    cells, means = compute_windows(plan, units, space or Workspace())
    selected = slice(part.start - units[0].start, part.stop - units[0].start)
    return _attach_labels(
        [field[:, selected] for field in cells], means[:, :, selected], log, plan, part=part
    )


def davar_sample(log: xr.Dataset, *, numbers: Sequence[int], **options: Any) -> xr.Dataset:
    """Compute single windows of the surface of `davar`, in order, as `davar_part` does.

    No sample outside these windows is read, nor are channels. Rounding may differ from that of
    `davar`.
    """
    log = as_log(log)
    log = log.drop_vars(log_channels(log))
    plan, space = make_plan(log, **options), Workspace()
    results = [compute_windows(plan, [slice(number, number + 1)], space) for number in numbers]
    fields, means = zip(*results, strict=True)
    cells = [np.concatenate(parts, axis=1) for parts in zip(*fields, strict=True)]
    return _attach_labels(cells, np.concatenate(means, axis=2), log, plan, numbers=numbers)


def _attach_labels(
    cells: Any,
    means: Any,
    log: xr.Dataset,
    plan: SurfacePlan,
    *,
    part: slice | None = None,
    numbers: Sequence[int] | None = None,
) -> xr.Dataset:
    cube, plane = ("axis", "time", "tau"), ("axis", "time")
    signal, unit, rate, *_ = plan
    start, begin = first_stamp(log), 0 if part is None else part.start
    first = (
        begin + np.arange(means.shape[2]) if numbers is None else np.array(numbers)
    ) * unit.step
    bounds = np.stack(
        [grid_times(start, rate, first), grid_times(start, rate, first + unit.window)], axis=-1
    )
    centre = bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) // 2
    variables: dict[str, Any] = {
        name: (cube, values, attributes(name, variance=VARIANCES[unit.variance].text))
        for name, values in zip(CELL_FIELDS, cells, strict=True)
    }
    # In addition to the responses, the fit needs the share of degrees of freedom left by the gaps.
    gap_factor = variables.pop("gap_factor")
    for name, values in zip(PLANE_FIELDS, means, strict=True):
        kind = FIELD_TYPES.get(name, np.float64)
        variables[name] = (plane, values.astype(kind), attributes(name))
    variables["gap_factor"] = gap_factor
    groups = units_of_work(signal.sizes["time"], unit)
    return xr.Dataset(
        {**variables, **window_channels(log, unit.window, unit.step, groups, part=part)},
        coords={
            "axis": ("axis", signal["axis"].values, attributes("axis")),
            "time": (
                "time",
                pd.DatetimeIndex(centre.view("datetime64[ns]")),
                {**attributes("time")},
            ),
            "tau": ("tau", plan.taus, attributes("tau")),
            "time_bounds": (("time", "bnds"), bounds.view("datetime64[ns]")),
        },
        attrs={**log.attrs, **plan.attrs},
    )

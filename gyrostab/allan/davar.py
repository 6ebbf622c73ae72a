"""Dynamic Allan variance of a log as a surface ``(axis, time, tau)``, with all dask calls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import dask
import dask.array as da
import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from gyrostab.allan.channels import window_channels
from gyrostab.allan.plan import MOST_CELLS, Plan, last_sample, make_plan, units_of_work
from gyrostab.errors import OptionError
from gyrostab.ingest.convert import as_log
from gyrostab.kernels.allan.gap_edges import gap_edge_ratio
from gyrostab.kernels.allan.outlier_count import count_outliers
from gyrostab.kernels.allan.pairs import white_pair_sum
from gyrostab.kernels.allan.reference import direct_sums, recursive_sums, reference_theta
from gyrostab.kernels.allan.surface import CELL_FIELDS, STRICT, Unit, surface_unit, window_means
from gyrostab.kernels.allan.trend import window_trends
from gyrostab.kernels.fit.covariance import diagonal_products
from gyrostab.kernels.fit.least_squares import identify_noise
from gyrostab.kernels.workspace import Workspace
from gyrostab.noise import HOUR, avar_columns, sample_squares
from gyrostab.schema import attributes
from gyrostab.store.lazy import find_source, keep_sources, read_into, read_slice
from gyrostab.time.grid import first_stamp, grid_times

__all__ = ["davar", "davar_part", "davar_parts"]

#: Variables by axis and window, in the order in which `_compute_unit` returns them.
_PLANE_FIELDS = (
    "window_mean",
    "window_coverage",
    "window_trend",
    "trend_response",
    "outlier_count",
    "gap_edge_ratio",
)
#: Largest number of samples of a part of which all axes are read together.
_MAX_SAMPLES_READ_AT_ONCE = 2**21
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
    overlap: str = "full",
    gaps: str = "bridge",
    min_strict: float = 0.3,
    min_coverage: float = 0.1,
    method: str = "blocks",
    convention: str = "all",
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
        Regular log with ``rate(axis, time)`` [degree hour-1] or ``angle(axis, time)`` [degree], NaN
        where a sample is missing, numpy or dask, float or integer. A dask log stays lazy and gives
        the same bits for any chunking. The sampling rate is that of ``time``: a log that was
        thinned or averaged has its new rate, and dropped samples are missing. A DataArray with
        ``attrs["units"]``, or a pandas table as for `gyrostab.from_dataframe`, is also accepted.
    window, step : str or timedelta
        Length and step of the window: a duration (``"10min"``), or a number of samples
        (``"2000samples"``). A bare number is refused. `step` defaults to a tenth of the window.
    taus : int, {"octave", "all"} or sequence
        Averaging times: a number of them, evenly spaced in log tau; powers of two samples; every
        one; or a list [s] (numbers, or strings such as ``"0.1s"``). Each is rounded to a whole
        number of samples and reported exactly.
    tau_max : float or str, optional
        Longest averaging time [s]; a third of the window by default (L13), at most half of it.
    axis : str or sequence of str, optional
        Axes to use; all by default.
    overlap : {"full", "octave"}
        Use every second difference, or for ``k >= 16`` one in k/16 to k/8 of them, with k rounded
        to a multiple of a power of two: less work on long windows (1.7 times faster as measured by
        ``make bench``), with 1 % more scatter.
    gaps : {"bridge", "zero"}
        ``"bridge"`` uses only samples that are present. In a rate log these are the terms inside
        unbroken runs or, if fewer than `min_strict` of them are left, weighted cluster means (see
        ``estimator``). In an angle log they are the terms of which all three angles are present.
        ``"zero"`` divides by the number of terms without gaps instead, which lowers the surface at
        every gap (the gap bias of P16).
    min_strict, min_coverage : float
        Share of terms in unbroken runs below which cluster means are used; coverage below which a
        cell is NaN.
    method : {"blocks", "direct", "recursive"}
        Block sums (default); the classical DAVAR (P16 Eq. 16); the published recursion (P16 Eq.
        19-22). The last two load the log into memory and are provided for comparison.
    convention : {"all", "paper"}
        With ``"paper"`` the reference methods count ``window - 2k`` terms and omit the last window,
        as P16 does.

    Returns
    -------
    xarray.Dataset
        ``avar, count, coverage, edf, estimator, white_response, quantization_response,
        ramp_response (axis, time, tau)``, ``window_mean, window_coverage, window_trend,
        trend_response, outlier_count, gap_edge_ratio (axis, time)``, and every channel of the log
        averaged over each window; ``time`` is the centre of the window, with ``time_bounds``;
        ``tau`` [s]. Units are attributes of the variables.

    Raises
    ------
    OptionError
        If window, step or taus do not fit the record or each other; the message says which would.
    SchemaError
        If `log` is not a regular log.
    TimeError
        If its time is not in order, or not uniform.

    References
    ----------
    P16: Wang et al., Sensors 16 (2016), Eq. 16-22. L13: Li et al., Chin. J. Lasers 40 (2013)
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
        log, window=window, step=step, taus=taus, tau_max=tau_max, axis=axis, overlap=overlap,
        gaps=gaps, min_strict=min_strict, min_coverage=min_coverage, method=method,
        convention=convention,
    )  # fmt: skip
    if method == "blocks":
        cells, means = _run_units(plan.signal.data, plan.unit, plan.rate)
    else:
        cells, means = _run_published_method(
            plan.signal, plan.unit, plan.rate, method, paper=convention == "paper"
        )
    return _attach_labels(cells, means, log, plan)


def davar_parts(log: xr.Dataset, *, samples: int = 2**24, **options: Any) -> list[slice]:
    """Divide the windows of a surface into parts for `davar_part`.

    Each part consists of whole units of work; the last parts are smaller.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log.
    samples : int
        Samples of a part over all axes; a part has at least one unit of work. With closely spaced
        windows or few units, a part has fewer samples.
    **options
        Options of `davar`.

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
    plan = make_plan(as_log(log), **options)
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
    while left := len(units) - edges[-1]:
        edges.append(edges[-1] + max(1, min(together, int(left * _MAX_SHARE_OF_REST))))
    return [slice(units[a].start, units[b - 1].stop) for a, b in pairwise(edges)]


def davar_part(
    log: xr.Dataset, *, part: slice, space: Workspace | None = None, **options: Any
) -> xr.Dataset:
    """Compute some windows of the surface of `davar`, immediately and in the calling thread.

    Only the samples of these windows are read, and dask computes nothing else, so that many parts
    can be computed in parallel, in threads, processes or on other machines. The numbers are those
    of `davar`, bit for bit.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log, numpy or dask.
    part : slice
        Windows, counted from the first window of the log: one of `davar_parts`, or any other slice
        without a step.
    space : gyrostab.kernels.workspace.Workspace, optional
        Working memory, reused by parts that one thread computes one after the other.
    **options
        Options of `davar`, with ``method="blocks"``.

    Returns
    -------
    xarray.Dataset
        As from `davar`, in memory.

    Raises
    ------
    OptionError
        If the options do not fit, or the method is not that of the block sums.

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
    if plan.attrs["method"] != "blocks":
        raise OptionError(
            f"method={plan.attrs['method']!r} is for whole logs; parts are computed with "
            "method='blocks'"
        )
    data, unit = plan.signal.data, plan.unit
    tables = _cached_tables_of(plan)
    units = [
        windows
        for windows in units_of_work(data.shape[1], unit)
        if windows.start < part.stop and windows.stop > part.start
    ]
    spans = [(windows.start * unit.step, last_sample(windows, unit)) for windows in units]
    space = space or Workspace()
    results = [_compute_unit(x, unit, tables, space) for x in _read_spans(data, spans, space)]
    rows = range(0, len(results), len(units))
    cells, means = (
        [
            np.concatenate([arrays[i] for arrays in results[row : row + len(units)]], axis=1)
            for row in rows
        ]
        for i in range(2)
    )
    selected = slice(part.start - units[0].start, part.stop - units[0].start)
    return _attach_labels(
        np.stack(cells, axis=1)[:, :, selected],
        np.stack(means, axis=1)[:, :, selected],
        log,
        plan,
        part=part,
    )


def _read_spans(
    data: Any, spans: Sequence[tuple[int, int]], space: Workspace
) -> Iterator[NDArray[np.generic]]:
    """Read the samples of each span, axis by axis; use each result before asking for the next.

    Without dask, spans are read one by one, and the samples that two spans share are read once.
    With dask, all axes are read together if they are few.
    """
    begin, end = spans[0][0], spans[-1][1]
    if find_source(data) is not None:
        longest = max(last - first for first, last in spans)
        line = space.array("samples", longest).view(data.dtype)[:longest]
        for row in range(data.shape[0]):
            held_from = held_to = begin
            for first, last in spans:
                shared = max(held_to - first, 0)
                line[:shared] = line[first - held_from : held_to - held_from]
                read_into(data, row, first + shared, line[shared : last - first])
                held_from, held_to = first, last
                yield line[: last - first]
        return
    together = 1 if data.shape[0] * (end - begin) > _MAX_SAMPLES_READ_AT_ONCE else data.shape[0]
    for row in range(0, data.shape[0], together):
        for whole in read_slice(data[row : row + together], begin, end):
            yield from (whole[first - begin : last - begin] for first, last in spans)


def _compute_unit(
    x: NDArray[np.generic], unit: Unit, tables: tuple[Any, ...], space: Workspace | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute one unit: cells (9, n_windows, n_tau) and plane fields (6, n_windows).

    The last field of the cells holds the degrees of freedom.
    """
    x = np.ascontiguousarray(x)
    if x.dtype.kind == "f" and np.isnan(x[[0, x.size // 2, -1]]).all() and np.isnan(x).all():
        cells, means = (part.copy() for part in _empty_surface(_with_tuples(unit), x.size))
    else:
        cells, means = surface_unit(x, unit, space)
    scale = (
        HOUR if unit.angle else 1.0
    )  # angles are in degree, so their slopes in degree per second
    cells[0] *= scale**2
    dof = identify_noise(cells[0], cells[5], cells[6], cells[7], cells[3], *tables)
    means[0] *= scale
    return np.concatenate([cells, dof[None]]), np.concatenate([means, _describe_windows(x, unit)])


def _describe_windows(
    x: NDArray[np.generic], unit: Unit, windows: int | None = None
) -> NDArray[np.float64]:
    """Compute the plane fields from the trend on, (4, n_windows)."""
    count = (x.size - unit.window - unit.angle) // unit.step + 1 if windows is None else windows
    first = np.arange(count) * unit.step
    trends = window_trends(x, angle=unit.angle, window=unit.window, step=unit.step, n_windows=count)
    trends[0] *= HOUR / unit.interval * (HOUR / unit.interval if unit.angle else 1.0)
    outliers = count_outliers(x, first, unit.window)
    return np.vstack([trends, outliers, gap_edge_ratio(x, first, unit.window)])


def _cached_tables_of(plan: Plan) -> tuple[Any, ...]:
    """Make `_noise_tables` once for all parts of a log."""
    return _cached_noise_tables(_with_tuples(plan.unit), plan.rate)


@lru_cache(maxsize=4)
def _cached_noise_tables(unit: Unit, rate: float) -> tuple[Any, ...]:
    return _noise_tables(_with_arrays(unit), rate)


@lru_cache(maxsize=4)
def _empty_surface(unit: Unit, size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cache the surface of a unit without any sample, because a long gap has many of them."""
    return surface_unit(np.full(size, np.nan), _with_arrays(unit), None)


def _with_tuples(unit: Unit) -> Unit:
    return unit._replace(ks=tuple(unit.ks.tolist()), shifts=tuple(unit.shifts.tolist()))  # type: ignore[arg-type]


def _with_arrays(unit: Unit) -> Unit:
    return unit._replace(
        ks=np.array(unit.ks, dtype=np.int64), shifts=np.array(unit.shifts, dtype=np.int64)
    )


def _noise_tables(unit: Unit, rate: float) -> tuple[Any, ...]:
    """Make the tables of `identify_noise`: columns, weights, sample units, sums over pairs."""
    columns = avar_columns(unit.ks / rate)
    to_samples = sample_squares(rate)
    n = [int(unit.window - 2 * k + 1) for k in unit.ks]
    weight = np.array(
        [count**2 / white_pair_sum(count, int(k)) for count, k in zip(n, unit.ks, strict=True)]
    )
    pairs, ramps = diagonal_products(unit.window, unit.ks, unit.shifts)
    return columns, weight, to_samples, pairs, ramps


def _run_units(data: Any, unit: Unit, rate: float) -> tuple[Any, Any]:
    """Run the units of work: cells (9, axis, time, tau), plane fields (6, axis, time).

    The results are dask arrays if `data` is one.
    """
    lazy = isinstance(data, da.Array)
    tables = _noise_tables(unit, rate)
    shared = dask.delayed(tables, pure=True, traverse=False) if lazy else tables
    work = dask.delayed(_compute_unit, nout=2, pure=False)
    rows_cells, rows_means = [], []
    for row in range(data.shape[0]):
        cells, means = [], []
        for windows in units_of_work(data.shape[1], unit):
            n = windows.stop - windows.start
            unit_cells, unit_means = work(
                data[row, windows.start * unit.step : last_sample(windows, unit)], unit, shared
            )
            cells.append(
                da.from_delayed(
                    unit_cells, (len(CELL_FIELDS) + 1, n, unit.ks.size), dtype=np.float64
                )
            )
            means.append(da.from_delayed(unit_means, (len(_PLANE_FIELDS), n), dtype=np.float64))
        rows_cells.append(da.concatenate(cells, axis=1))
        rows_means.append(da.concatenate(means, axis=1))
    stacked = da.stack(rows_cells, axis=1), da.stack(rows_means, axis=1)
    cells_array, means_array = stacked if lazy else dask.compute(*stacked)
    if lazy:
        cells_array, means_array = (keep_sources(data, part) for part in stacked)
    return cells_array, means_array


def _run_published_method(
    signal: xr.DataArray, unit: Unit, rate: float, method: str, *, paper: bool
) -> tuple[Any, Any]:
    """Run a published algorithm in memory: cells (9, axis, time, tau), plane (6, axis, time)."""
    points = unit.window + (0 if paper and not unit.angle else 1)
    all_points = signal.sizes["time"] + (0 if unit.angle or paper else 1)
    n_windows = (all_points - points) // unit.step + (0 if paper else 1)
    if n_windows < 1:
        raise OptionError(
            "convention='paper' leaves no window, because it omits the last one; give a longer "
            "record"
        )
    run = direct_sums if method == "direct" else recursive_sums
    tables = _noise_tables(unit, rate)
    full = (points - 2 * unit.ks).astype(np.float64)
    cells = np.zeros((len(CELL_FIELDS) + 1, signal.sizes["axis"], n_windows, unit.ks.size))
    means = np.zeros((len(_PLANE_FIELDS), signal.sizes["axis"], n_windows))
    for row in range(signal.sizes["axis"]):
        x = np.asarray(signal.isel(axis=row).data)
        theta, present, missing = reference_theta(x, angle=unit.angle, paper=paper)
        sums, counts = run(theta, present, missing, points, unit.step, n_windows, unit.ks)
        divisor = full if unit.zero_fill else counts
        interval = unit.interval if unit.angle else 1.0
        with np.errstate(invalid="ignore", divide="ignore"):
            cells[0, row] = (
                sums
                / (2.0 * (unit.ks * interval) ** 2 * divisor)
                * (HOUR**2 if unit.angle else 1.0)
            )
        cells[1, row], cells[2, row] = counts, counts / full
        cells[3, row], cells[4, row], cells[5:8, row] = counts / full, STRICT, 1.0
        if not unit.zero_fill:
            cells[0, row][cells[2, row] < unit.min_coverage] = np.nan
        cells[8, row] = identify_noise(
            cells[0, row], cells[5, row], cells[6, row], cells[7, row], cells[3, row], *tables
        )
        means[:2, row] = window_means(x, unit)[:, :n_windows]
        means[2:, row] = _describe_windows(x, unit, n_windows)
        means[0, row] *= HOUR if unit.angle else 1.0
    return cells, means


def _attach_labels(
    cells: Any, means: Any, log: xr.Dataset, plan: Plan, *, part: slice | None = None
) -> xr.Dataset:
    cube, plane = ("axis", "time", "tau"), ("axis", "time")
    signal, unit, rate, _ = plan
    start, begin = first_stamp(log), 0 if part is None else part.start
    first = (begin + np.arange(cells.shape[2])) * unit.step
    bounds = np.stack(
        [grid_times(start, rate, first), grid_times(start, rate, first + unit.window)], axis=-1
    )
    centre = bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) // 2
    names = (*CELL_FIELDS, "edf")
    integers = {"count": np.int64, "estimator": np.int8, "outlier_count": np.int64}
    variables: dict[str, Any] = {
        name: (
            cube,
            cells[i].astype(integers[name]) if name in integers else cells[i],
            attributes(name),
        )
        for i, name in enumerate(names)
        if name != "gap_factor"
    }
    for name, values in zip(_PLANE_FIELDS, means, strict=True):
        variables[name] = (plane, values.astype(integers.get(name, np.float64)), attributes(name))
    # In addition to the responses, the fit needs the share of degrees of freedom left by the gaps.
    variables["gap_factor"] = (
        cube,
        cells[CELL_FIELDS.index("gap_factor")],
        attributes("gap_factor"),
    )
    groups = units_of_work(signal.sizes["time"], unit)
    if part is None:  # convention "paper" omits the last window
        groups = [
            slice(group.start, min(group.stop, first.size))
            for group in groups
            if group.start < first.size
        ]
    return xr.Dataset(
        {**variables, **window_channels(log, unit.window, unit.step, groups, part=part)},
        coords={
            "axis": ("axis", signal["axis"].values, attributes("axis")),
            "time": (
                "time",
                pd.DatetimeIndex(centre.view("datetime64[ns]")),
                {**attributes("time")},
            ),
            "tau": ("tau", unit.ks / rate, attributes("tau")),
            "time_bounds": (("time", "bnds"), bounds.view("datetime64[ns]")),
        },
        attrs={**log.attrs, **plan.attrs},
    )

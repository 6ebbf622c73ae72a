"""Dynamic Allan variance of a log as a surface ``(axis, time, tau)``, with all dask calls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any, NamedTuple

import dask
import dask.array as da
import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from gyrostab.allan.channels import window_channels
from gyrostab.allan.plan import (
    MOST_CELLS,
    Plan,
    last_sample,
    make_plan,
    thin_factors,
    units_of_work,
)
from gyrostab.allan.variance import variance_columns, white_freedoms
from gyrostab.errors import OptionError
from gyrostab.ingest.convert import as_log
from gyrostab.kernels.allan.gap_edges import gap_edge_ratio
from gyrostab.kernels.allan.outlier_count import count_outliers
from gyrostab.kernels.allan.reference import direct_sums, recursive_sums, reference_theta
from gyrostab.kernels.allan.surface import STRICT, Cells, Unit, surface_unit, window_means
from gyrostab.kernels.allan.trend import window_trends
from gyrostab.kernels.allan.variances import VARIANCES
from gyrostab.kernels.fit.covariance import diagonal_products
from gyrostab.kernels.fit.least_squares import cell_freedoms, combine_diagonal, identify_noise
from gyrostab.kernels.fit.third_differences import third_diagonals
from gyrostab.kernels.workspace import Workspace
from gyrostab.noise import HOUR, sample_squares
from gyrostab.schema import attributes, log_channels
from gyrostab.store.lazy import find_source, keep_sources, read_into, read_slice
from gyrostab.time.grid import first_stamp, grid_times

__all__ = ["davar", "davar_part", "davar_parts"]

Floats = NDArray[np.float64]

#: Variables by axis, window and averaging time, in the order in which `_compute_unit` returns them.
_CELL_FIELDS = (*Cells._fields, "edf")
#: Types of the variables that are not float64.
_TYPES = {"count": np.int64, "estimator": np.int8, "outlier_count": np.int64}
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
        convention=convention, variance=variance,
    )  # fmt: skip
    if method == "blocks":
        cells, means = _run_units(plan.signal.data, plan)
    else:
        cells, means = _run_published_method(plan, method, paper=convention == "paper")
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
    log: xr.Dataset,
    *,
    part: slice,
    space: Workspace | None = None,
    alone: bool = False,
    **options: Any,
) -> xr.Dataset:
    """Compute some windows of the surface of `davar`, immediately and in the calling thread.

    Only the samples of these windows are read, and dask computes nothing else, so that many parts
    can be computed in parallel, in threads, processes or on other machines. The numbers are those
    of `davar`, bit for bit, unless `alone` is set.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log, numpy or dask.
    part : slice
        Windows, counted from the first window of the log: one of `davar_parts`, or any other slice
        without a step.
    space : gyrostab.kernels.workspace.Workspace, optional
        Working memory, reused by parts that one thread computes one after the other.
    alone : bool
        Read no sample outside these windows, nor channels; rounding may differ from that of
        `davar`.
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
    if alone:
        log = log.drop_vars(log_channels(log))
    if plan.attrs["method"] != "blocks":
        raise OptionError(
            f"method={plan.attrs['method']!r} is for whole logs; parts are computed with "
            "method='blocks'"
        )
    data, unit = plan.signal.data, plan.unit
    tables = _noise_tables(plan)
    units = [part] if alone else units_of_work(data.shape[1], unit)
    units = [
        windows for windows in units if windows.start < part.stop and windows.stop > part.start
    ]
    spans = [(windows.start * unit.step, last_sample(windows, unit)) for windows in units]
    space = space or Workspace()
    results = [_compute_unit(x, unit, tables, space) for x in _read_spans(data, spans, space)]
    cells, means = _join_units(results, data.shape[0])
    selected = slice(part.start - units[0].start, part.stop - units[0].start)
    return _attach_labels(
        [field[:, selected] for field in cells], means[:, :, selected], log, plan, part=part
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
    x: NDArray[np.generic], unit: Unit, tables: _NoiseTables, space: Workspace | None = None
) -> tuple[list[Floats], Floats]:
    """Compute one unit: the fields of the cells, see `Cells`, and plane fields (6, n_windows)."""
    x = np.ascontiguousarray(x)
    cells, means = surface_unit(x, unit, space)
    scale = (
        HOUR if unit.angle else 1.0
    )  # angles are in degree, so their slopes in degree per second
    if unit.angle:
        cells.avar[:] *= scale**2
    means[0] *= scale
    fields = [*cells, _cell_freedoms(cells, tables)]
    return fields, np.concatenate([means, _describe_windows(x, unit)])


def _stack_unit(x: NDArray[np.generic], unit: Unit, tables: _NoiseTables) -> tuple[Floats, Floats]:
    """`_compute_unit` with all fields in one array (9, n_windows, n_tau)."""
    fields, means = _compute_unit(x, unit, tables)
    return np.stack(np.broadcast_arrays(*fields)), means


def _join_units(
    results: Sequence[tuple[list[Floats], Floats]], n_axes: int
) -> tuple[list[NDArray[Any]], Floats]:
    """Join units, axis by axis: fields (axis, time, tau), plane fields (6, axis, time).

    A field that is the same in all windows is stored once, and repeated as a view.
    """
    sizes = [plane.shape[1] for _, plane in results]
    fields = [
        _join_field([unit[i] for unit, _ in results], sizes, n_axes, _TYPES.get(name, np.float64))
        for i, name in enumerate(_CELL_FIELDS)
    ]
    means = np.concatenate([plane for _, plane in results], axis=1)
    return fields, means.reshape(len(_PLANE_FIELDS), n_axes, -1)


def _join_field(parts: list[Floats], sizes: list[int], n_axes: int, kind: Any) -> NDArray[Any]:
    shape = n_axes, sum(sizes) // n_axes, parts[0].shape[1]
    parts = [part.astype(kind, copy=False) for part in parts]
    if all(part.shape[0] == 1 and np.array_equal(part, parts[0]) for part in parts):
        return np.broadcast_to(parts[0], shape)
    if len(parts) > 1:
        rows = zip(parts, sizes, strict=True)
        parts = [np.concatenate([np.broadcast_to(part, (n, shape[2])) for part, n in rows])]
    return parts[0].reshape(shape)


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


class _NoiseTables(NamedTuple):
    """Arguments of `identify_noise` and `cell_freedoms` that all windows share."""

    chosen: NDArray[np.int64]
    columns: Floats
    weight: Floats
    to_samples: Floats
    diagonal: Floats


def _noise_tables(plan: Plan) -> _NoiseTables:
    unit = plan.unit
    factors, thinning = tuple(unit.ks.tolist()), tuple(unit.shifts.tolist())
    return _cached_noise_tables(unit.window, factors, thinning, plan.rate, unit.variance)


@lru_cache(maxsize=4)
def _cached_noise_tables(
    window: int, factors: tuple[int, ...], thinning: tuple[int, ...], rate: float, variance: str
) -> _NoiseTables:
    """Make the tables once for all parts of a log."""
    ks, shifts = np.array(factors, dtype=np.int64), np.array(thinning, dtype=np.int64)
    columns = variance_columns(variance, ks, rate)
    if variance == "avar":
        pairs, ramps = diagonal_products(window, ks, shifts)
    else:
        pairs, ramps = third_diagonals(variance, window, ks, shifts)
    weight = white_freedoms(variance, window, ks, pairs)
    diagonal = combine_diagonal(pairs, ramps)
    return _NoiseTables(thin_factors(ks), columns, weight, sample_squares(rate), diagonal)


def _cell_freedoms(cells: Cells, tables: _NoiseTables) -> Floats:
    """Compute the degrees of freedom of cells (n_windows, n_tau) from a quick fit of the noise."""
    chosen, columns, weight, to_samples, diagonal = tables
    seen = (cells.avar, *cells[5:], cells.gap_factor)
    few = [np.ascontiguousarray(field[:, chosen]) for field in seen]
    squares = identify_noise(*few, columns[chosen], weight[chosen], to_samples)
    return np.asarray(cell_freedoms(squares, *seen, columns, to_samples, diagonal))


def _run_units(data: Any, plan: Plan) -> tuple[Any, Any]:
    """Run the units of work: fields (axis, time, tau), plane fields (6, axis, time).

    The results are dask arrays if `data` is one.
    """
    lazy, unit, tables = isinstance(data, da.Array), plan.unit, _noise_tables(plan)
    units = units_of_work(data.shape[1], unit)
    spans = [slice(part.start * unit.step, last_sample(part, unit)) for part in units]
    if not lazy:
        tasks = [
            partial(_compute_unit, data[row, span], unit, tables)
            for row in range(data.shape[0])
            for span in spans
        ]
        if len(tasks) == 1:  # a short call does not wait for a graph
            return _join_units([tasks[0]()], 1)
        run = dask.compute(*(dask.delayed(task, pure=False)() for task in tasks))
        return _join_units(run, data.shape[0])
    shared = dask.delayed(tables, pure=True, traverse=False)
    work = dask.delayed(_stack_unit, nout=2, pure=False)
    rows_cells, rows_means = [], []
    for row in range(data.shape[0]):
        cells, means = [], []
        for part, span in zip(units, spans, strict=True):
            n = part.stop - part.start
            unit_cells, unit_means = work(data[row, span], unit, shared)
            shape = len(_CELL_FIELDS), n, unit.ks.size
            cells.append(da.from_delayed(unit_cells, shape, dtype=np.float64))
            means.append(da.from_delayed(unit_means, (len(_PLANE_FIELDS), n), dtype=np.float64))
        rows_cells.append(da.concatenate(cells, axis=1))
        rows_means.append(da.concatenate(means, axis=1))
    stacked = da.stack(rows_cells, axis=1), da.stack(rows_means, axis=1)
    cells_array, means_array = (keep_sources(data, part) for part in stacked)
    kinds = [_TYPES.get(name, np.float64) for name in _CELL_FIELDS]
    return [cells_array[i].astype(kind) for i, kind in enumerate(kinds)], means_array


def _run_published_method(
    plan: Plan, method: str, *, paper: bool
) -> tuple[list[NDArray[Any]], Floats]:
    """Run a published algorithm in memory: fields (axis, time, tau), plane (6, axis, time)."""
    signal, unit, _, _ = plan
    points = unit.window + (0 if paper and not unit.angle else 1)
    all_points = signal.sizes["time"] + (0 if unit.angle or paper else 1)
    n_windows = (all_points - points) // unit.step + (0 if paper else 1)
    if n_windows < 1:
        raise OptionError(
            "convention='paper' leaves no window, because it omits the last one; give a longer "
            "record"
        )
    run = direct_sums if method == "direct" else recursive_sums
    tables = _noise_tables(plan)
    full = (points - 2 * unit.ks).astype(np.float64)
    results = []
    for row in range(signal.sizes["axis"]):
        x = np.asarray(signal.isel(axis=row).data)
        theta, present, missing = reference_theta(x, angle=unit.angle, paper=paper)
        sums, counts = run(theta, present, missing, points, unit.step, n_windows, unit.ks)
        interval = unit.interval / HOUR if unit.angle else 1.0
        with np.errstate(invalid="ignore", divide="ignore"):
            avar = sums / (2.0 * (unit.ks * interval) ** 2 * (full if unit.zero_fill else counts))
        coverage = counts / full
        if not unit.zero_fill:
            avar[coverage < unit.min_coverage] = np.nan
        one = np.ones_like(avar)
        cells = Cells(
            avar, counts.astype(np.float64), coverage, coverage, STRICT * one, one, one, one
        )
        means = window_means(x, unit)[:, :n_windows]
        means[0] *= HOUR if unit.angle else 1.0
        plane = np.concatenate([means, _describe_windows(x, unit, n_windows)])
        results.append(([*cells, _cell_freedoms(cells, tables)], plane))
    return _join_units(results, len(results))


def _attach_labels(
    cells: Any, means: Any, log: xr.Dataset, plan: Plan, *, part: slice | None = None
) -> xr.Dataset:
    cube, plane = ("axis", "time", "tau"), ("axis", "time")
    signal, unit, rate, _ = plan
    start, begin = first_stamp(log), 0 if part is None else part.start
    first = (begin + np.arange(means.shape[2])) * unit.step
    bounds = np.stack(
        [grid_times(start, rate, first), grid_times(start, rate, first + unit.window)], axis=-1
    )
    centre = bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) // 2
    variables: dict[str, Any] = {
        name: (cube, values, attributes(name, variance=VARIANCES[unit.variance].text))
        for name, values in zip(_CELL_FIELDS, cells, strict=True)
    }
    # In addition to the responses, the fit needs the share of degrees of freedom left by the gaps.
    gap_factor = variables.pop("gap_factor")
    for name, values in zip(_PLANE_FIELDS, means, strict=True):
        kind = _TYPES.get(name, np.float64)
        variables[name] = (plane, values.astype(kind), attributes(name))
    variables["gap_factor"] = gap_factor
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

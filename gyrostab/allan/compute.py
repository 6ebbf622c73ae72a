"""Computation of a surface: units of work, with all dask calls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import dask
import dask.array as da
import numpy as np
from numpy.typing import NDArray

from gyrostab.allan.freedoms import NoiseTables, estimate_freedoms, make_noise_tables
from gyrostab.allan.plan import SurfacePlan, last_sample, units_of_work
from gyrostab.arrays import Array, Floats
from gyrostab.kernels.allan.biased_samples import count_outliers, gap_edge_ratio
from gyrostab.kernels.allan.surface import Cells, WorkUnit, convert_to_native, surface_unit
from gyrostab.kernels.workspace import Workspace, Workspaces
from gyrostab.store.lazy import find_source, keep_sources, read_into, read_slice
from gyrostab.units import HOUR

#: Variables by axis, window and averaging time, in the order in which `_compute_unit` returns them.
CELL_FIELDS = (*Cells._fields, "edf")
#: Types of the variables that are not float64.
FIELD_TYPES = {"count": np.int64, "estimator": np.int8, "outlier_count": np.int64}
#: Variance of the trend of a window under Q, N, B and K, as shares of that without gaps.
TREND_RESPONSES = (
    "trend_quantization_response",
    "trend_response",
    "trend_flicker_response",
    "trend_walk_response",
)
#: Variables by axis and window, in the order in which `_compute_unit` returns them.
PLANE_FIELDS = (
    "window_mean",
    "window_coverage",
    "window_trend",
    *TREND_RESPONSES,
    "outlier_count",
    "gap_edge_ratio",
)
#: Largest number of samples of a part of which all axes are read together.
_MAX_SAMPLES_READ_AT_ONCE = 2**21


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
        for samples in read_slice(data[row : row + together], begin, end):
            yield from (samples[first - begin : last - begin] for first, last in spans)


def _compute_unit(
    x: NDArray[np.generic],
    unit: WorkUnit,
    tables: NoiseTables,
    space: Workspace | None = None,
) -> tuple[list[Floats], Floats]:
    """Compute one unit: the fields of the cells, see `Cells`, and plane fields (9, n_windows)."""
    cells, lines = surface_unit(x, unit, space)
    per_hour = HOUR / unit.interval
    if unit.angle:  # in degree, so that the slopes are in degree per second or sample
        cells.avar[:] *= HOUR**2
        lines[0] *= per_hour
    for trend in (cells.difference_trend, lines[2]):
        trend *= per_hour ** (2 if unit.angle else 1)
    first = np.arange(lines.shape[1]) * unit.step
    native = convert_to_native(x)
    outliers = count_outliers(native, first, unit.window)
    edges = np.full(first.size, np.nan)
    if (lines[1] < 1.0).any():
        windows = {"window": unit.window, "step": unit.step, "n_windows": first.size}
        edges = gap_edge_ratio(native, **windows)
    fields = [*cells, estimate_freedoms(cells, tables)]
    return fields, np.vstack([lines, outliers, edges])


def _compute_in_thread(
    x: NDArray[np.generic], unit: WorkUnit, tables: NoiseTables, spaces: Workspaces
) -> tuple[list[Floats], Floats]:
    """`_compute_unit` with the working memory of the calling thread."""
    return _compute_unit(x, unit, tables, spaces.own)


def _stack_unit(
    x: NDArray[np.generic], unit: WorkUnit, tables: NoiseTables
) -> tuple[Floats, Floats]:
    """`_compute_unit` with all fields in one array (10, n_windows, n_tau)."""
    fields, means = _compute_unit(x, unit, tables)
    return np.stack(np.broadcast_arrays(*fields)), means


def compute_windows(
    plan: SurfacePlan, groups: Sequence[slice], space: Workspace
) -> tuple[list[Array], Floats]:
    """Compute groups of windows, as `run_units` does, immediately and in the calling thread."""
    unit, tables = plan.unit, make_noise_tables(plan)
    spans = [(group.start * unit.step, last_sample(group, unit)) for group in groups]
    samples = _read_spans(plan.signal.data, spans, space)
    return _join_units([_compute_unit(x, unit, tables, space) for x in samples], plan)


def _join_units(
    results: Sequence[tuple[list[Floats], Floats]], plan: SurfacePlan
) -> tuple[list[Array], Floats]:
    """Join units, axis by axis: fields (axis, time, tau), plane fields (9, axis, time).

    A field that is the same in all windows is stored once, and repeated as a view.
    """
    sizes, n_axes = [plane.shape[1] for _, plane in results], plan.signal.shape[0]
    fields = []
    for i, name in enumerate(CELL_FIELDS):
        parts = [unit[i][:, plan.reported] for unit, _ in results]
        fields.append(_join_field(parts, sizes, n_axes, FIELD_TYPES.get(name, float)))
    means = np.concatenate([plane for _, plane in results], axis=1)
    return fields, means.reshape(len(PLANE_FIELDS), n_axes, -1)


def _join_field(parts: list[Floats], sizes: list[int], n_axes: int, kind: Any) -> Array:
    shape = n_axes, sum(sizes) // n_axes, parts[0].shape[1]
    parts = [part.astype(kind, copy=False) for part in parts]
    if all(part.shape[0] == 1 and np.array_equal(part, parts[0], equal_nan=True) for part in parts):
        return np.broadcast_to(parts[0], shape)
    if len(parts) > 1:
        rows = zip(parts, sizes, strict=True)
        parts = [np.concatenate([np.broadcast_to(part, (n, shape[2])) for part, n in rows])]
    return parts[0].reshape(shape)


def run_units(plan: SurfacePlan) -> tuple[Any, Any]:
    """Run the units of work: fields (axis, time, tau), plane fields (9, axis, time).

    The results are dask arrays if the signal is one.
    """
    data, unit, tables = plan.signal.data, plan.unit, make_noise_tables(plan)
    units = units_of_work(data.shape[1], unit)
    spans = [slice(part.start * unit.step, last_sample(part, unit)) for part in units]
    if not isinstance(data, da.Array):
        spaces = Workspaces()
        tasks = [
            partial(_compute_in_thread, data[row, span], unit, tables, spaces)
            for row in range(data.shape[0])
            for span in spans
        ]
        if len(tasks) == 1:  # a short call does not wait for a graph
            return _join_units([tasks[0]()], plan)
        run = dask.compute(*(dask.delayed(task, pure=False)() for task in tasks))
        return _join_units(run, plan)
    shared = dask.delayed(tables, pure=True, traverse=False)
    work = dask.delayed(_stack_unit, nout=2, pure=False)
    rows_cells, rows_means = [], []
    for row in range(data.shape[0]):
        cells, means = [], []
        for part, span in zip(units, spans, strict=True):
            n = part.stop - part.start
            unit_cells, unit_means = work(data[row, span], unit, shared)
            shape = len(CELL_FIELDS), n, unit.ks.size
            cells.append(da.from_delayed(unit_cells, shape, dtype=np.float64))
            means.append(da.from_delayed(unit_means, (len(PLANE_FIELDS), n), dtype=np.float64))
        rows_cells.append(da.concatenate(cells, axis=1))
        rows_means.append(da.concatenate(means, axis=1))
    stacked = da.stack(rows_cells, axis=1), da.stack(rows_means, axis=1)
    cells_array, means_array = (keep_sources(data, part) for part in stacked)
    kinds = [FIELD_TYPES.get(name, np.float64) for name in CELL_FIELDS]
    fields = [cells_array[i, ..., plan.reported].astype(kind) for i, kind in enumerate(kinds)]
    return fields, means_array

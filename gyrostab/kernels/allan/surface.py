"""One unit of work of the improved fast DAVAR: from samples of one axis to cells of windows."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.kernels.allan.blocks import (
    Cut,
    group_factors,
    grouped_blocks,
    held_points,
    windows_from_blocks,
)
from gyrostab.kernels.allan.clusters import (
    cluster_cells,
    cluster_factors,
    cluster_strides,
    integrate_places,
    pack_mask,
)
from gyrostab.kernels.allan.integrate import (
    align_two,
    integrate,
    integrate_two,
    needs_two_doubles,
    padded_size,
    present_runs,
    sum_two,
)
from gyrostab.kernels.allan.intervals import single_blocks
from gyrostab.kernels.allan.pairs import strict_gap_factors
from gyrostab.kernels.allan.trend import difference_slopes, window_lines
from gyrostab.kernels.allan.variances import VARIANCES
from gyrostab.kernels.workspace import Workspace

NONE, STRICT, WEIGHTED = 0, 1, 2

# Types that are summed as they are; others become double first, since each type is compiled anew.
_NATIVE = np.dtype(np.float64), np.dtype(np.float32)


class WorkUnit(NamedTuple):
    """Options shared by all units of work of one surface.

    Attributes
    ----------
    window, step : int
        Window and step [samples].
    ks : int64 (n_tau,)
        Averaging factors, rising.
    angle : bool
        The samples are cumulative angles, ``window + 1`` per window, instead of rates.
    interval : float
        Sampling interval [s], for angles.
    min_strict, min_coverage : float
        Smallest share of terms in unbroken runs; smallest coverage of a reported cell.
    variance : str
        One of `VARIANCES`. Only those of second differences bridge gaps by cluster means.
    """

    window: int
    step: int
    ks: Ints
    angle: bool
    interval: float
    min_strict: float
    min_coverage: float
    variance: str = "avar"

    @property
    def order(self) -> int:
        """Order of the differences."""
        return VARIANCES[self.variance].order

    @property
    def spans(self) -> Ints:
        """Samples that a term uses, (n_tau,)."""
        return VARIANCES[self.variance].spans(self.ks)

    @property
    def lengths(self) -> Ints:
        """Terms of a window without gaps, (n_tau,)."""
        return self.window - self.spans + 1

    @property
    def points(self) -> int:
        """Angles of a term that must be present; 0 if all samples of its span must be."""
        return self.order + 1 if self.angle and not VARIANCES[self.variance].summed else 0


class Cells(NamedTuple):
    """Fields of the cells: (n_windows, n_tau), or (1, n_tau) where all windows have the same."""

    avar: Floats
    count: Floats  # type: ignore[assignment]  # not that of a tuple
    coverage: Floats
    gap_factor: Floats
    estimator: Floats
    white_response: Floats
    quantization_response: Floats
    ramp_response: Floats
    #: Slope of the rate per sample as the second differences show it; NaN in windows without gaps.
    difference_trend: Floats


class _Work(NamedTuple):
    """Samples of a unit of work: windows, runs of present samples, what is taken from each rate."""

    x: NDArray[np.generic]
    unit: WorkUnit
    space: Workspace
    n_windows: int
    starts: Ints
    stops: Ints
    offset: float


def _line_removed(work: _Work) -> Floats:
    """Angle less a line through its beginning and its end, zero where it is missing.

    Medians of some present points, because a damaged one would cost all others their digits.
    """
    values = np.asarray(work.x, dtype=np.float64)
    present = np.isfinite(values)
    places = np.flatnonzero(present)
    (first, low), (last, high) = (
        (np.median(ends), np.median(values[ends])) for ends in (places[:9], places[-9:])
    )
    line = low + (high - low) / max(last - first, 1.0) * (np.arange(values.size) - first)
    return np.where(present, values - line, 0.0)


def _strict_sums(work: _Work, gaps: bool) -> tuple[Floats, Floats]:
    """Sum squared second differences of every window and factor, and count terms if any miss."""
    unit, space, n_windows = work.unit, work.space, work.n_windows
    lengths = unit.lengths
    whole_blocks = lengths // unit.step
    head_lengths = lengths - whole_blocks * unit.step
    blocks = space.array("blocks", 4 if gaps else 2, n_windows + int(whole_blocks[0]), unit.ks.size)
    has_intervals = unit.order == 3 or (unit.angle and work.starts.size > 1)
    add = _interval_blocks if has_intervals else _grouped_blocks
    add(work, Cut(unit.step, unit.ks, head_lengths, whole_blocks, n_windows), blocks)
    sums = space.array("sums", len(blocks) // 2, n_windows, unit.ks.size)
    for heads_and_tails, out in zip((blocks[:2], blocks[2:]), sums, strict=False):
        windows_from_blocks(*heads_and_tails, whole_blocks, out)
    return sums[0], sums[1] if gaps else np.empty((0, 0))


def _grouped_blocks(work: _Work, cut: Cut, blocks: Floats) -> None:
    """Sum heads and tails of rates, or of angles without gaps."""
    x, unit, space, _, starts, stops, offset = work
    points = x.size if unit.angle else held_points(x.size + 1, unit.step, unit.ks)
    flat = space.array("angle", padded_size(points, unit.ks))
    if unit.angle:
        flat[:points] = _line_removed(work)
        x, offset = np.empty(0), 0.0
    runs = starts, stops + (not unit.angle)
    groups = group_factors(unit.ks)
    largest = grouped_blocks(x, offset, flat, points, *runs, cut, groups, blocks)
    if not unit.angle and needs_two_doubles(largest, x):
        _interval_blocks(work, cut, blocks)


def _angle_of(work: _Work, windows: Ints) -> Floats:
    """Take the angles (n + 1,) of some windows and the block behind each, each from zero on."""
    x, unit = work.x, work.unit
    angle = work.space.array("angle", x.size + 1)
    begins, ends = windows * unit.step, np.minimum((windows + 1) * unit.step + unit.window, x.size)
    apart = np.flatnonzero(begins[1:] > ends[:-1])
    for first, last in zip(begins[np.r_[0, apart + 1]], ends[np.r_[apart, -1]], strict=True):
        starts, stops = (np.clip(edges, first, last) - first for edges in (work.starts, work.stops))
        inside = starts < stops
        part = angle[first : last + 1]
        integrate(x[first:last], work.offset, starts[inside], stops[inside], part)
    return angle


def _interval_blocks(work: _Work, cut: Cut, blocks: Floats) -> None:
    """Sum heads and tails interval by interval; a sum of the angle is held as two doubles."""
    x, unit, space, _, starts, stops, offset = work
    summed = VARIANCES[unit.variance].summed
    angles = x.size if unit.angle else x.size + 1
    size = angles + summed
    high, low = space.array("angle", size), space.array("rest of the angle", size)
    precise = summed
    if unit.angle:
        high[:angles], low[:angles] = _line_removed(work), 0.0
    else:
        precise = summed or needs_two_doubles(integrate(x, offset, starts, stops, high[:angles]), x)
        if precise:
            integrate_two(x, offset, starts, stops, high[:angles], low[:angles])
    if summed:
        high[angles] = low[angles] = 0.0
        sum_two(high, low)
    if precise:
        align_two(high, low)
    spans = unit.spans + unit.angle  # of angles instead of samples
    terms = (unit.order, spans, unit.points)
    low = low if precise else low[:0]
    blocks[:] = single_blocks(high, low, starts, stops, *terms, cut)[: len(blocks)]


def convert_to_native(x: NDArray[np.generic]) -> NDArray[np.floating[Any]]:
    """Convert samples to a contiguous array of a type for which the kernels are compiled."""
    return np.ascontiguousarray(x if x.dtype in _NATIVE else x.astype(np.float64))


def surface_unit(
    x: NDArray[np.generic], unit: WorkUnit, space: Workspace | None = None
) -> tuple[Cells, Floats]:
    """Compute cells and means of the windows in a span of samples of one axis.

    Parameters
    ----------
    x : ndarray (n,)
        Rates, or cumulative angles if ``unit.angle``; NaN marks a missing sample; integer or float
        of any size. Windows start at samples 0, step, 2 step ... and lie inside the span.
    unit : WorkUnit
        Window, step, averaging factors and rules.
    space : Workspace, optional
        Working memory for consecutive units; the previous result is overwritten.

    Returns
    -------
    cells : Cells
        The variance is in the square of the rate's unit (for angles: of angle per second). Without
        gaps only the variance differs between the windows.
    lines : ndarray (7, n_windows)
        Result of `window_lines`.
    """
    counts_only = np.issubdtype(x.dtype, np.integer)
    n_windows = (x.size - unit.window - unit.angle) // unit.step + 1
    x = convert_to_native(x[: (n_windows - 1) * unit.step + unit.window + unit.angle])
    space = space or Workspace()
    lines, mean = window_lines(
        x, angle=unit.angle, window=unit.window, step=unit.step, n_windows=n_windows
    )
    gaps = bool((lines[1] < 1.0).any())
    if not lines[1].any():
        return _empty_cells(n_windows, unit.ks.size), lines
    starts, stops = present_runs(x) if gaps else (np.zeros(1, np.int64), np.full(1, x.size))
    # integers less an integer: every sum is exact
    offset = float(np.rint(mean)) if counts_only else mean
    work = _Work(x, unit, space, n_windows, starts, stops, offset)
    sums, counts = _strict_sums(work, gaps)
    full = unit.lengths.astype(np.float64)[None]
    scale = VARIANCES[unit.variance].divisors(unit.ks) * (unit.interval if unit.angle else 1.0) ** 2
    if gaps:
        full = np.ascontiguousarray(np.broadcast_to(full, counts.shape))
        return _cells_with_gaps(work, sums / scale, counts, full), lines
    ones = np.ones((1, unit.ks.size))
    other_fields = ones, STRICT * ones, ones, ones, ones, np.nan * ones
    return Cells(sums / (scale * full), full, ones, *other_fields), lines


def _empty_cells(n_windows: int, n_tau: int) -> Cells:
    """Cells of windows without any sample."""
    none, zero = np.full((1, n_tau), np.nan), np.zeros((1, n_tau))
    avar = np.full((n_windows, n_tau), np.nan)
    return Cells(avar, zero, zero, zero, NONE + zero, none, none, none, none)


def _cells_with_gaps(work: _Work, sums: Floats, counts: Floats, full: Floats) -> Cells:
    """Compute the cells from the scaled sums of squares in unbroken runs, and their counts."""
    unit = work.unit
    cells = np.ones((len(Cells._fields), *counts.shape))
    with np.errstate(invalid="ignore", divide="ignore"):
        np.divide(sums, counts, out=cells[0])
    cells[1], cells[2], cells[4] = counts, counts / full, STRICT
    if unit.angle:
        cells[3] = counts / full
    else:
        terms = unit.ks, unit.spans, unit.order, VARIANCES[unit.variance].summed
        runs = work.starts, work.stops, unit.window, unit.step
        strict_gap_factors(*runs, *terms, counts, full, cells[3])
    cells[8] = _find_slopes(work, counts < full)
    poor = counts < unit.min_strict * full
    if unit.order == 2 and not unit.angle and poor.any():
        _bridge_gaps(work, _angle_of(work, np.flatnonzero(poor.any(axis=1))), poor, cells)
    blank = ~(cells[2] >= unit.min_coverage)
    cells[0][blank] = np.nan
    cells[5:, blank] = np.nan
    cells[4][blank] = NONE
    cells[3][blank] = 0.0
    return Cells(*cells)


def _bridge_gaps(work: _Work, theta: Floats, poor: Bools, cells: Floats) -> None:
    """Weighted clusters where too few terms are left (rate logs only)."""
    unit, runs = work.unit, (work.starts, work.stops, theta.size - 1)
    mask = pack_mask(*runs)
    strides = cluster_strides(unit.window, unit.ks)
    places = integrate_places(*runs)
    for i in np.flatnonzero(poor.any(axis=0)):
        rows = np.ascontiguousarray(poor[:, i])
        pairs = unit.window, unit.step, unit.ks[i], strides[i]
        bridged = cluster_cells(theta, places, mask, *pairs, rows)
        has_pairs = bridged[:, 4] > 0.0
        factor = cluster_factors(mask, has_pairs, *pairs)
        avar, white, quantization, coverage, count, ramp, slope = bridged.T
        avar = np.where(has_pairs, avar, np.nan)
        method = np.full(rows.size, WEIGHTED)
        fields = avar, count, coverage, factor, method, white, quantization, ramp, slope
        cells[:, rows, i] = np.stack(fields)[:, rows]


def _find_slopes(work: _Work, with_gaps: Bools) -> Floats:
    """Find the slope of the rate that the second differences of windows with gaps show."""
    x, unit, space, n_windows, starts, stops, offset = work
    if unit.order == 3:
        return np.full(with_gaps.shape, np.nan)
    if unit.angle:
        angle = _line_removed(work)
    else:
        angle = space.array("angle", x.size + 1)
        integrate(x, offset, starts, stops, angle)
    places = starts, stops, unit.window, unit.step, n_windows
    slopes = difference_slopes(angle, *places, unit.ks, unit.points)
    return np.where(with_gaps, slopes, np.nan)

"""One unit of work of the improved fast DAVAR: a stretch of one axis to the cells of its windows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.blocks import integrate, integrate_two, needs_two_doubles, present_runs, slide, strict_sums, valid_intervals
from gyrostab.kernels.clusters import cluster_cell, cluster_prefix
from gyrostab.kernels.pairs import strict_gap_factors

__all__ = ["CELL_FIELDS", "NONE", "STRICT", "WEIGHTED", "Unit", "surface_unit", "window_means"]

NONE, STRICT, WEIGHTED = 0, 1, 2
#: Order of the fields of a cell in the array that `surface_unit` returns.
CELL_FIELDS = ("avar", "count", "coverage", "gap_factor", "estimator", "white_response", "quantization_response")


class Unit(NamedTuple):
    """What every unit of work of one surface has in common.

    Attributes
    ----------
    window, step : int
        Window and step [samples].
    ks, shifts : int64 (n_tau,)
        Averaging factors, rising, and the powers of two that thin their second differences, not falling.
    angle : bool
        The samples are cumulative angles, ``window + 1`` of them to a window, instead of rates.
    interval : float
        Sampling interval [s], for angles.
    zero_fill : bool
        Divide by the gap-free number of terms, as the paper does, instead of by the number used.
    min_strict, min_coverage : float
        Least share of terms in unbroken runs; least coverage of a cell that is reported.
    """

    window: int
    step: int
    ks: NDArray[np.int64]
    shifts: NDArray[np.int64]
    angle: bool
    interval: float
    zero_fill: bool
    min_strict: float
    min_coverage: float


@njit(nogil=True, cache=True)
def _bridge_gaps(theta, present, starts, stops, angle, window, step, ks, shifts, counts, full, min_strict, cells):  # type: ignore[no-untyped-def]
    """Degrees of freedom of the strict cells, and weighted clusters where too few terms are left (rate logs only)."""
    samples, runs = cluster_prefix(present)
    for i in range(ks.size):
        k = ks[i]
        if window - 2 * k + 1 < 1:
            continue
        if angle:
            for j in range(counts.shape[0]):
                cells[3, j, i] = counts[j, i] / full[j, i]
            continue
        begin, end = valid_intervals(starts, stops, k, angle)
        cells[3, :, i] = strict_gap_factors(begin, end, counts[:, i], full[:, i], k, shifts[i], window, step)
        for j in range(counts.shape[0]):
            if counts[j, i] < min_strict * full[j, i]:
                cell = cluster_cell(theta, present, samples, runs, j * step, window, k)
                cells[0, j, i] = cell[0]
                cells[1, j, i] = cell[1]
                cells[2, j, i] = cell[2]
                cells[3, j, i] = cell[5]
                cells[4, j, i] = WEIGHTED
                cells[5, j, i] = cell[3]
                cells[6, j, i] = cell[4]


def _theta(x: NDArray[np.generic], present: NDArray[np.bool_], angle: bool) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """Local angle of the unit, its remainder, and whether the remainder is needed."""
    values = np.asarray(x, dtype=np.float64)
    if angle:
        where = np.flatnonzero(present)
        first, last = where[0], where[-1]
        slope = (values[last] - values[first]) / max(last - first, 1)
        line = values[first] + slope * (np.arange(values.size) - first)
        theta = np.where(present, values - line, 0.0)
        return theta, theta, False
    offset = float(np.mean(values) if present.all() else np.mean(values, where=present))
    if not np.issubdtype(x.dtype, np.floating):
        offset = float(np.rint(offset))  # integer counts less an integer: every sum is exact
    theta = integrate(values, present, offset)
    if needs_two_doubles(theta, values, present):
        return *integrate_two(values, present, offset), True
    return theta, theta, False


def surface_unit(x: NDArray[np.generic], unit: Unit) -> NDArray[np.float64]:
    """Cells of the windows that start in a stretch of one axis.

    Parameters
    ----------
    x : ndarray (n,)
        Rates, or cumulative angles where ``unit.angle``; NaN marks a missing sample; integer or float of any size.
        Windows start at samples 0, step, 2 step ... and every window lies inside the stretch.
    unit : Unit
        Window, step, averaging factors and rules.

    Returns
    -------
    ndarray (7, n_windows, n_tau)
        The fields of `CELL_FIELDS`; the variance is in the square of the rate's unit (for angles: of angle per second).
    """
    points = unit.window + 1 if unit.angle else unit.window
    n_windows = (x.size - points) // unit.step + 1
    cells = np.zeros((len(CELL_FIELDS), n_windows, unit.ks.size))
    cells[0], cells[5:] = np.nan, np.nan
    present = np.isfinite(x) if np.issubdtype(x.dtype, np.floating) else np.ones(x.size, dtype=np.bool_)
    if not present.any():
        return cells
    theta, rest, two = _theta(x, present, unit.angle)
    starts, stops = present_runs(present)
    sums, counts, full = strict_sums(theta, rest, two, starts, stops, unit.angle, unit.window, unit.step, n_windows, unit.ks, unit.shifts)
    divisor = full if unit.zero_fill else counts
    with np.errstate(invalid="ignore", divide="ignore"):
        cells[0] = sums / (2.0 * unit.ks.astype(np.float64) ** 2 * divisor) / (unit.interval**2 if unit.angle else 1.0)
        cells[2] = counts / full
    cells[1] = counts
    cells[3] = 1.0
    cells[4] = STRICT
    cells[5:] = 1.0
    if not present.all():
        _bridge_gaps(
            theta, present, starts, stops, unit.angle, unit.window, unit.step, unit.ks, unit.shifts, counts, full,
            0.0 if unit.zero_fill else unit.min_strict, cells,
        )  # fmt: skip
    if not unit.zero_fill:
        blank = ~(cells[2] >= unit.min_coverage)
        cells[0][blank] = cells[5][blank] = cells[6][blank] = np.nan
        cells[4][blank] = NONE
        cells[3][blank] = 0.0
    return cells


@njit(nogil=True, cache=True)
def _rate_means(values, window, step, n_windows):  # type: ignore[no-untyped-def]
    """Means and shares of present samples by block sums, as in `gyrostab.kernels.blocks`."""
    whole = window // step
    head_length = window - whole * step
    n_blocks = n_windows + whole
    heads, tails = np.zeros(n_blocks), np.zeros(n_blocks)
    head_counts, tail_counts = np.zeros(n_blocks), np.zeros(n_blocks)
    offset = 0.0  # the first value present: the sums stay small on a tool that turns
    for i in range(values.size):
        if np.isfinite(values[i]):
            offset = values[i]
            break
    for block in range(n_blocks):
        for i in range(step):
            m = block * step + i
            if m < values.size and np.isfinite(values[m]):
                if i < head_length:
                    heads[block] += values[m] - offset
                    head_counts[block] += 1
                else:
                    tails[block] += values[m] - offset
                    tail_counts[block] += 1
    sums, counts = np.empty(n_windows), np.empty(n_windows)
    slide(heads + tails, whole, n_windows, sums)
    slide(head_counts + tail_counts, whole, n_windows, counts)
    out = np.full((2, n_windows), np.nan)
    for j in range(n_windows):
        count = counts[j] + head_counts[j + whole]
        out[1, j] = count / window
        if count > 0:
            out[0, j] = offset + (sums[j] + heads[j + whole]) / count
    return out


def window_means(x: NDArray[np.generic], unit: Unit) -> NDArray[np.float64]:
    """Mean rate and share of present samples of each window of a stretch (arguments as `surface_unit`).

    Returns
    -------
    ndarray (2, n_windows)
        Mean [unit of the rate; for angles: of angle per second], NaN where nothing is present; share of samples present.
    """
    values = np.asarray(x, dtype=np.float64)
    points = unit.window + 1 if unit.angle else unit.window
    n_windows = (x.size - points) // unit.step + 1
    if not unit.angle:
        return np.asarray(_rate_means(values, unit.window, unit.step, n_windows))
    out = np.full((2, n_windows), np.nan)
    for j in range(n_windows):
        part = values[j * unit.step : j * unit.step + points]
        where = np.flatnonzero(np.isfinite(part))
        out[1, j] = where.size / points
        if where.size > 1:
            out[0, j] = (part[where[-1]] - part[where[0]]) / ((where[-1] - where[0]) * unit.interval)
    return out

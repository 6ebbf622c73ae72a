"""Compact columns: values as 32-bit counts, stamps as even runs; both restored exactly.

Only the sign of a zero is lost.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.compiled import KERNEL

#: Stands for a value that is missing.
_FILL = np.int32(np.iinfo(np.int32).min)
_LARGEST = float(np.iinfo(np.int32).max)
_STRETCH = 4096
_MOST_DECIMALS = 9
_LOOKED_AT = 256
#: Smaller remainders, as a share of the largest value, come from rounding: 2^-53, which Euclid's
#: algorithm amplifies by the largest count, here up to 2^25.
_ROUNDING = 2.0**-28


@njit(**KERNEL)
def pack_counts(values, step, divisor, counts):  # type: ignore[no-untyped-def]
    """Find 32-bit integers that give exactly these values on a grid, if they exist.

    Parameters
    ----------
    values : float64 (n,)
        Values; what is not finite is missing.
    step, divisor : float
        The grid: a value is exactly count * step / divisor, in double precision.
    counts : int32 (n,)
        Overwritten.

    Returns
    -------
    fits : bool
        False if a value is not on the grid; the rest is then undefined.
    missing : int
        Values that are not finite.
    low, high : float
        Range of the others; infinite without any.
    whole : bool
        Whether the others are whole numbers.
    """
    n, scale = values.size, divisor / step
    missing = np.int64(0)
    smallest = np.int32(2147483647)
    largest = np.int32(-2147483647)
    all_whole = True
    for begin in range(0, n, _STRETCH):
        off, absent, odd = np.int64(0), np.int64(0), np.int64(0)
        for i in range(begin, min(begin + _STRETCH, n)):
            value = values[i]
            finite = value - value == 0.0
            nearest = np.rint(value * scale)
            inside = abs(nearest) < _LARGEST
            count = np.int32(nearest) if finite and inside else _FILL
            back = np.float64(count) * step / divisor
            off += finite and (not inside or back != value)
            absent += not finite
            odd += finite and np.rint(value) != value
            smallest = min(smallest, count if finite else np.int32(2147483647))
            largest = max(largest, count)
            counts[i] = count
        missing += absent
        all_whole = all_whole and odd == 0
        if off:
            return False, missing, 0.0, 0.0, False
    if missing == n:
        return True, missing, np.inf, -np.inf, True
    return True, missing, smallest * step / divisor, largest * step / divisor, all_whole


@njit(**KERNEL)
def unpack_counts(counts, step, divisor, factor, offset, values):  # type: ignore[no-untyped-def]
    """Restore the values of `pack_counts`, times a factor plus an offset; NaN where missing.

    Parameters
    ----------
    counts : int32 (n,)
    step, divisor, factor, offset : float
    values : float64 (n,)
        Overwritten.
    """
    same = factor == 1.0 and offset == 0.0
    if divisor == 1.0:
        for i in range(counts.size):
            value = np.float64(counts[i]) * step
            values[i] = np.nan if counts[i] == _FILL else value * factor + offset
        return
    for i in range(counts.size):
        value = np.float64(counts[i]) * step / divisor
        value = value if same else value * factor + offset
        values[i] = np.nan if counts[i] == _FILL else value


def find_grid(values: NDArray[np.float64]) -> tuple[float, float] | None:
    """Find step and divisor of a grid that holds the first values.

    Decimal fractions are counts divided by a power of ten; other loggers write their counts times a
    scale factor, or divided by a sensitivity.

    Examples
    --------
    >>> find_grid(np.array([1.25, np.nan, -3.0]))
    (1.0, 100.0)
    >>> find_grid(np.arange(-50, 50) / 16.4)
    (1.0, 16.4)
    >>> find_grid(np.array([np.pi, np.e])) is None
    True
    """
    sample = np.ascontiguousarray(values[np.isfinite(values)][:_LOOKED_AT])
    counts = np.empty(sample.size, np.int32)
    decimals = ((1.0, 10.0**n) for n in range(_MOST_DECIMALS + 1))
    for grid in itertools.chain(decimals, _guess_grids(sample)):
        if pack_counts(sample, *grid, counts)[0]:
            return grid
    return None


def _guess_grids(values: NDArray[np.float64]) -> Iterator[tuple[float, float]]:
    """Yield grids whose step is the greatest common divisor of the values, up to rounding."""
    sizes = np.abs(values)
    largest = float(sizes.max(initial=0.0))
    divisor = 0.0
    for size in sizes.tolist():
        while size > largest * _ROUNDING:
            divisor, size = size, abs(math.remainder(divisor, size))
    count = float(np.rint(largest / divisor)) if divisor else 0.0
    if not 0.0 < count < _LARGEST:
        return
    for steps in (0, 1, -1, 2, -2):  # value and quotient are rounded to half a unit each
        for numerator, denominator in ((largest, count), (count, largest)):
            ratio = numerator / denominator
            ratio += steps * math.ulp(ratio)
            yield (ratio, 1.0) if denominator == count else (1.0, ratio)


@njit(**KERNEL)
def _count_steps(stamps):  # type: ignore[no-untyped-def]
    """Count the changes of the step between stamps."""
    changes = np.int64(0)
    for i in range(2, stamps.size):
        changes += stamps[i] - stamps[i - 1] != stamps[i - 1] - stamps[i - 2]
    return changes


@njit(**KERNEL)
def _find_steps(stamps, table):  # type: ignore[no-untyped-def]
    """Fill the table of `even_steps`; returns its length."""
    n, row = np.int64(0), np.int64(0)
    while row < stamps.size:
        step = stamps[row + 1] - stamps[row] if row + 1 < stamps.size else np.int64(0)
        table[n, 0], table[n, 1], table[n, 2] = row, stamps[row], step
        n += 1
        row += 1
        while row < stamps.size and stamps[row] - stamps[row - 1] == step:
            row += 1
    return n


def even_steps(stamps: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Find runs of stamps at even steps: first row, its stamp, step (n, 3); None if not smaller.

    Examples
    --------
    >>> even_steps(np.array([*range(0, 500, 5), *range(900, 1400, 5)]))
    array([[  0,   0,   5],
           [100, 900,   5]])
    """
    max_runs = _count_steps(stamps) + 2
    if 3 * max_runs > max(stamps.size // 8, 12):
        return None
    table = np.empty((max_runs, 3), np.int64)
    return table[: _find_steps(stamps, table)].copy()


def unroll_steps(table: NDArray[np.int64], begin: int, stamps: NDArray[np.int64]) -> None:
    """Restore stamps from row `begin` on from the table of `even_steps`.

    Parameters
    ----------
    table : int64 (n, 3)
    begin : int
    stamps : int64 (m,)
        Overwritten.
    """
    _unroll_steps(table, int(np.searchsorted(table[:, 0], begin, side="right")) - 1, begin, stamps)


@njit(**KERNEL)
def _unroll_steps(table, n, begin, stamps):  # type: ignore[no-untyped-def]
    """Restore stamps from row `begin` on, which is in row n of the table."""
    row, end = np.int64(begin), begin + stamps.size
    while row < end:
        stop = min(end, table[n + 1, 0]) if n + 1 < len(table) else end
        first, step = table[n, 1] - table[n, 0] * table[n, 2], table[n, 2]
        for i in range(row, stop):
            stamps[i - begin] = first + i * step
        row, n = stop, n + 1

"""Common parts of the statistics: windows of blocks, sums, near-normal scores, and the dataset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import ndtri_exp

from gyrostab.arrays import Floats, Ints

#: tau * f at the maximum of sin(pi f tau)^4 / (pi f tau)^2, the Allan variance of a sine.
SINE_TAU_CYCLES = 0.371
_WINDOW_STEP = 0.2  # of the length of a window, from one to the next; design choice
_MAX_DENSE_BLOCKS = 1000  # of a record with this step; limits time
_LONG_WINDOW_STEP = 0.4  # the same for longer records


class BlockWindows(NamedTuple):
    """Windows of whole blocks: first block of each, and the first one after it."""

    first: Ints
    stop: Ints

    @property
    def length(self) -> Ints:
        """Number of blocks of each window."""
        return self.stop - self.first


def window_set(block_count: int, lengths: Sequence[int], *, whole: bool = True) -> BlockWindows:
    """Return windows of several lengths [blocks], a fifth of their length apart.

    In long records it is two fifths. Lengths above half of the record are skipped.

    Examples
    --------
    >>> windows = window_set(10, (1, 5))
    >>> windows.length.tolist()
    [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 5, 5, 5, 5, 5, 5, 10]
    """
    first, length = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for window_length in lengths:
        if window_length > max(block_count // 2, 1):
            continue
        share = _WINDOW_STEP if block_count <= _MAX_DENSE_BLOCKS else _LONG_WINDOW_STEP
        step = max(1, round(window_length * share))
        start = np.arange(0, block_count - window_length + 1, step)
        if start[-1] != block_count - window_length:
            start = np.append(start, block_count - window_length)
        first.append(start)
        length.append(np.full(start.size, window_length))
    if whole:
        first.append(np.zeros(1, np.int64))
        length.append(np.full(1, block_count))
    begin = np.concatenate(first)
    return BlockWindows(begin, begin + np.concatenate(length))


def part_windows(blocks: xr.Dataset, part_count: int) -> BlockWindows:
    """Return the blocks of the equal parts of the record, and of the whole last."""
    block_count = blocks.sizes["block"]
    # As the blocks were divided when the log was read.
    edge = -(-np.arange(part_count + 1) * block_count // part_count)
    return BlockWindows(
        np.append(edge[:-1], 0), np.append(np.maximum(edge[1:], edge[:-1] + 1), block_count)
    )


def cumulative(values: Any, axis: int = -1) -> Any:
    """Return cumulative sums over a dimension, by default the last one, from 0."""
    shape, after = list(values.shape), [slice(None)] * values.ndim
    shape[axis] += 1
    after[axis] = slice(1, None)
    total = np.zeros(shape, np.result_type(values, np.int64))
    np.cumsum(values, axis=axis, out=total[tuple(after)])
    return total


def moving_sum(values: Floats, span: int) -> Floats:
    """Return sums over `span` places of the last dimension around each, fewer at the ends."""
    ends = [(0, 0)] * (values.ndim - 1) + [(span // 2, span - 1 - span // 2)]
    total = cumulative(np.pad(values, ends))
    return np.asarray(total[..., span:] - total[..., :-span])


def sum_over_windows(values: Any, windows: BlockWindows, *, axis: int = -2) -> Any:
    """Sum over each window; missing values must be zero. The blocks are along `axis`.

    Examples
    --------
    >>> sum_over_windows(np.ones((4, 1)), window_set(4, (2,), whole=False))[:, 0]
    array([2., 2., 2.])
    """
    total = cumulative(values, axis)
    return np.take(total, windows.stop, axis) - np.take(total, windows.first, axis)


def cube_root_score(ratio: Floats, shape: Floats) -> Floats:
    """Return the near-normal score of a gamma-distributed ratio of mean 1; NaN for shape <= 0.

    Wilson and Hilferty (1931), doi:10.1073/pnas.17.12.684.

    Examples
    --------
    >>> float(cube_root_score(np.array(1.02), np.array(1e4)).round(2))  # two standard deviations
    1.99
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = 1.0 / (9.0 * shape)
        return np.asarray((np.cbrt(np.maximum(ratio, 0.0)) - (1.0 - variance)) / np.sqrt(variance))


def exponential_score(value: Floats) -> Floats:
    """Return the normal score of an exponentially distributed value of mean 1.

    Examples
    --------
    >>> float(exponential_score(np.array(np.log(2.0))).round(6)) + 0.0
    0.0
    """
    return np.asarray(-ndtri_exp(-value))


def statistic_dataset(
    blocks: xr.Dataset,
    *,
    windows: BlockWindows,
    columns: dict[str, Any],
    z: Floats,
    ratio: Floats,
    rows: Sequence[str] | None = None,
    estimate: Floats | None = None,
    one_sided: bool = False,
) -> xr.Dataset:
    """Assemble the results of a statistic by (record), row, window, tau.

    These are its near-normal score ``z``, the ``ratio`` of observed over expected, and perhaps an
    ``estimate``, the size of the mismatch. Columns have ``quantity`` (str), ``tau_min_s``,
    ``tau_max_s`` [s], ``frequency`` [Hz] and ``floor``, the smallest standard deviation that null
    records may give a score. The rows are axes, separated by blanks; by default each axis of the
    record. Only an excess is a mismatch in a one-sided statistic.
    """
    dims = ("record", "row", "window", "tau") if z.ndim == 4 else ("row", "window", "tau")
    begin, end = blocks["begin"].values, blocks["end"].values
    size = z.shape[-1]
    labels = {"frequency": np.nan, "floor": 0.2} | columns
    dataset = xr.Dataset(
        {"z": (dims, z), "ratio": (dims, ratio)},
        coords={
            "axes": ("row", np.asarray(blocks["axis"].values if rows is None else rows, dtype=str)),
            "begin": ("window", begin[windows.first]),
            "end": ("window", end[windows.stop - 1]),
            "first": ("window", windows.first),
            "stop": ("window", windows.stop),
            **{
                name: ("tau", np.broadcast_to(np.asarray(values), size))
                for name, values in labels.items()
            },
        },
        attrs={"one_sided": int(one_sided)},
    )
    if estimate is not None:
        dataset["estimate"] = (dims, np.broadcast_to(estimate, z.shape))
    return dataset

"""Channels of a log interpolated to the samples of the effects, for any span of time."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.errors import SchemaError
from gyrostab.kernels.regression.smooth import smooth_curve
from gyrostab.store.lazy import read_slice
from gyrostab.time.grid import TimeGridIndex, grid_index, grid_times
from gyrostab.time.stamps import to_nanoseconds
from gyrostab.units import INNER

#: Longer channels are read stretch by stretch.
SHORT = 2**22
#: Parts over which a recorded channel is averaged: a quarter of a block of the diagnosis [s], and
#: their least and largest number. Design choices, as for its blocks.
PART_S, MIN_PARTS, MAX_PARTS = 5.0, 360, 4000
LONGEST_PARTS = 8.0  # over which a recorded channel is smoothed: two blocks of the diagnosis
LEAST_POWER_SHARE = 0.01  # of the median, below which a light power is a fault; design choice


@dataclass(frozen=True)
class DriverChannel:
    """A channel that can be interpolated at any time."""

    name: str  # name in the log
    units: str  # its unit
    held: bool  # values hold until the next one; otherwise they run straight towards it
    #: Instants of the values [ns since 1970]; None for a long channel.
    stamps: Ints | None
    values: Any  # the values; a long channel may have NaN
    #: Grid of a long channel: first stamp [ns since 1970], samples in a second [Hz].
    start: int = 0
    rate: float = 1.0
    first: float = np.nan  # first value that is a number
    size: int = 0  # number of its values

    def at(
        self, instants: Ints, carry: float | None = None, *, before: int | None = None
    ) -> tuple[Floats, float | None]:
        """Interpolate at increasing `instants` [ns since 1970].

        The values of a long channel are read from those for the time `before` the first instant on.
        `carry` is what the call for the instants just before returned in addition to its values.
        """
        if self.stamps is not None:
            return self._interpolate_between(instants), None
        ends = [instants[0] - 1 if before is None else before, instants[-1]]
        low, high = np.floor(grid_index(self.start, self.rate, ends)).astype(int).tolist()
        low, high = min(max(low, 0), self.size - 1), min(max(high + 2, 1), self.size)
        samples = np.asarray(read_slice(self.values, low, high), dtype=np.float64)
        filled = _fill_gaps(np.concatenate([[self.first if carry is None else carry], samples]))
        position = grid_index(self.start, self.rate, instants)
        position = np.where(
            np.abs(position - np.rint(position)) < 1e-6, np.rint(position), position
        )
        position = np.clip(position, 0, self.size - 1)
        base = np.floor(position).astype(np.int64)
        place = base - low + 1
        interpolated = filled[place]
        # from the number of the sample itself, so that the last bit is the same in every stretch
        if not self.held:
            interpolated = interpolated + (position - base) * (
                filled[np.minimum(place + 1, samples.size)] - interpolated
            )
        return interpolated, float(filled[place[-1]])

    def _interpolate_between(self, instants: Ints) -> Floats:
        stamps = self.stamps
        assert stamps is not None
        if self.held:
            return np.asarray(
                self.values[np.maximum(np.searchsorted(stamps, instants, side="right") - 1, 0)]
            )
        low = max(0, int(np.searchsorted(stamps, instants[0], side="right")) - 1)
        high = int(np.searchsorted(stamps, instants[-1], side="left")) + 1
        origin = stamps[low]
        at = (instants - origin).astype(np.float64)
        knots = (stamps[low:high] - origin).astype(np.float64)
        return np.asarray(np.interp(at, knots, self.values[low:high]))


def _fill_gaps(values: Floats) -> Floats:
    """Each NaN replaced by the number before it."""
    good = ~np.isnan(values)
    return np.asarray(values[np.maximum.accumulate(np.where(good, np.arange(values.size), 0))])


def _first_number(values: Any, name: str) -> float:
    low, step = 0, 1000  # mostly it is the first one
    while low < values.size:
        part = np.asarray(values[low : low + step], dtype=np.float64)
        good = part[~np.isnan(part)]
        if good.size:
            return float(good[0])
        low, step = low + step, min(SHORT, 8 * step)
    raise SchemaError(
        f"the channel {name!r} holds no number; leave it out, or name another with driver = ..."
    )


def make_source(log: xr.Dataset, name: str) -> DriverChannel:
    """Prepare a channel of a log for interpolation.

    Raises
    ------
    SchemaError
        When it holds no number.

    Examples
    --------
    >>> from gyrostab.simulate.environment import ramps
    >>> ramp = ramps("temperature", "degC", [[0, 20], [4, 60]], duration=5.0)
    >>> warm = make_source(ramp, "temperature")
    >>> warm.at(np.array([500_000_000, 1_500_000_000]))[0]
    array([25., 35.])
    """
    variable = log[name]
    dim = str(variable.dims[0])
    data = variable.data
    units = str(variable.attrs.get("units", ""))
    held = variable.attrs.get("interpolation") == "previous"
    index = log.xindexes.get(dim)
    if data.size > SHORT and isinstance(index, TimeGridIndex):
        return DriverChannel(
            name,
            units,
            held,
            None,
            data,
            start=index.start,
            rate=index.rate,
            first=_first_number(data, name),
            size=data.size,
        )
    values = np.asarray(data, dtype=np.float64)
    good = ~np.isnan(values)
    if not good.any():
        _first_number(values, name)
    stamps = to_nanoseconds(log[dim].values)[good]
    return DriverChannel(name, units, held, stamps, values[good])


def make_course(log: xr.Dataset, name: str) -> DriverChannel:
    """Prepare a recorded channel without the noise of its sensor, as the diagnosis sees it.

    Means over parts of a quarter of a block are smoothed. Steps that hold have no noise, and remain
    as they are.

    Raises
    ------
    SchemaError
        When it holds no number.
    """
    source = make_source(log, name)
    if source.held or source.size + (0 if source.stamps is None else source.stamps.size) < 2:
        return source
    stamps, means = _average_parts(source)
    present = np.isfinite(means)
    bridged = np.interp(stamps - stamps[0], stamps[present] - stamps[0], means[present])
    smooth = smooth_curve(bridged, longest=LONGEST_PARTS)
    if source.units == INNER["power"]:
        minimum = LEAST_POWER_SHARE * float(np.median(smooth))
        if float(smooth.min()) < minimum:
            warnings.warn(
                f"the channel {name!r} falls to {smooth.min():g} {source.units} without its noise; "
                f"effects take {minimum:g} {source.units} at least. Correct the channel, or leave "
                "its bad values out",
                stacklevel=2,
            )
            smooth = np.maximum(smooth, minimum)
    return replace(source, stamps=stamps, values=smooth)


def _average_parts(source: DriverChannel) -> tuple[Ints, Floats]:
    """Return the middles of parts of a channel [ns since 1970], and its means there."""
    if source.stamps is None:
        size, first = source.size, source.start
        last = int(grid_times(source.start, source.rate, size - 1))
    else:
        size, first, last = source.stamps.size, int(source.stamps[0]), int(source.stamps[-1])
    span = (last - first) * size / (size - 1)
    count = int(np.clip(span / 1e9 / PART_S, min(MIN_PARTS, size), min(MAX_PARTS, size)))
    total, number = np.zeros(count), np.zeros(count)
    for low in range(0, size, SHORT):
        values = np.asarray(source.values[low : low + SHORT], dtype=np.float64)
        at = (
            grid_times(source.start, source.rate, np.arange(low, low + values.size))
            if source.stamps is None
            else source.stamps[low : low + SHORT]
        )
        good = np.isfinite(values)
        part = np.minimum((at[good] - first) * (count / span), count - 1).astype(np.int64)
        total += np.bincount(part, weights=values[good], minlength=count)
        number += np.bincount(part, minlength=count)
    with np.errstate(invalid="ignore"):
        means = total / number
    middles = first + ((np.arange(count) + 0.5) * (span / count)).astype(np.int64)
    return middles, np.asarray(means)

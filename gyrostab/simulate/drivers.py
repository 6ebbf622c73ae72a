"""Channels of a log interpolated to the samples of the effects, for any span of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import SchemaError
from gyrostab.time.grid import TimeGridIndex, grid_index
from gyrostab.time.stamps import to_nanoseconds

__all__ = ["Source", "Stretch", "make_source"]

Array = NDArray[np.float64]
#: Longer channels are read stretch by stretch.
SHORT = 2**22


@dataclass(frozen=True)
class Stretch:
    """The part of a long channel that some instants need."""

    low: int
    high: int


@dataclass(frozen=True)
class Source:
    """A channel that can be interpolated at any time."""

    name: str  # name in the log
    units: str  # its unit
    held: bool  # values hold until the next one; otherwise they run straight towards it
    #: Instants of the values [ns since 1970]; None for a long channel.
    stamps: NDArray[np.int64] | None
    values: Any  # the values; a long channel may have NaN
    #: Grid of a long channel: first stamp [ns since 1970], samples in a second [Hz].
    start: int = 0
    rate: float = 1.0
    first: float = np.nan  # first value that is a number
    size: int = 0  # number of its values

    def stretch(self, before: int, end: int) -> Stretch | None:
        """Find the values needed for times after `before` up to `end` [ns]; None if in memory."""
        if self.stamps is not None:
            return None
        first, last = (
            np.floor(grid_index(self.start, self.rate, [before, end])).astype(int).tolist()
        )
        size = self.size
        return Stretch(min(max(first, 0), size - 1), min(max(last + 2, 1), size))

    def at(
        self, instants: NDArray[np.int64], part: tuple[Stretch, Any] | None, carry: float | None
    ) -> tuple[Array, float | None]:
        """Interpolate at increasing `instants` [ns since 1970].

        Parameters
        ----------
        instants : ndarray of int64
            Where.
        part : (Stretch, ndarray), optional
            The values of a long channel that `stretch` asked for.
        carry : float, optional
            What the call for the instants just before gave back.

        Returns
        -------
        values : ndarray
        carry : float or None
        """
        if self.stamps is not None:
            return self._interpolate_between(instants), None
        assert part is not None
        stretch, values = part
        known = np.asarray(values, dtype=np.float64)
        whole = _fill_gaps(np.concatenate([[self.first if carry is None else carry], known]))
        position = grid_index(self.start, self.rate, instants)
        position = np.where(
            np.abs(position - np.rint(position)) < 1e-6, np.rint(position), position
        )
        position = np.clip(position, 0, self.size - 1)
        base = np.floor(position).astype(np.int64)
        place = base - stretch.low + 1
        after = whole[place]
        # from the number of the sample itself, so that the last bit is the same in every stretch
        if not self.held:
            after = after + (position - base) * (whole[np.minimum(place + 1, known.size)] - after)
        return after, float(whole[place[-1]])

    def _interpolate_between(self, instants: NDArray[np.int64]) -> Array:
        stamps = self.stamps
        assert stamps is not None
        if self.held:
            return np.asarray(
                self.values[np.maximum(np.searchsorted(stamps, instants, side="right") - 1, 0)]
            )
        low = max(0, int(np.searchsorted(stamps, instants[0], side="right")) - 1)
        high = int(np.searchsorted(stamps, instants[-1], side="left")) + 1
        origin = stamps[low]
        at, known = (
            (instants - origin).astype(np.float64),
            (stamps[low:high] - origin).astype(np.float64),
        )
        return np.asarray(np.interp(at, known, self.values[low:high]))


def _fill_gaps(values: Array) -> Array:
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


def make_source(log: xr.Dataset, name: str) -> Source:
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
    >>> warm.at(np.array([500_000_000, 1_500_000_000]), None, None)[0]
    array([25., 35.])
    """
    variable = log[name]
    dim = str(variable.dims[0])
    data = variable.data
    units = str(variable.attrs.get("units", ""))
    held = variable.attrs.get("interpolation") == "previous"
    index = log.xindexes.get(dim)
    if data.size > SHORT and isinstance(index, TimeGridIndex):
        return Source(
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
    return Source(name, units, held, stamps, values[good])

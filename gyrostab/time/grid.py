"""A uniform time axis that is computed, not stored: ``start + round(n * 1e9 / rate)`` nanoseconds.

Every stamp comes from its integer index, so nothing drifts: the rate is taken as the exact decimal
that is written (99.3 Hz is 993/10 Hz), the whole nanoseconds of the period are multiplied as
integers and only the fraction below one nanosecond as a float. 200 h at 300 Hz end on the right
nanosecond, and the axis of such a log takes no memory.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import date
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from xarray.indexes import CoordinateTransform, CoordinateTransformIndex

from gyrostab.arrays import Array, Bools, Floats, Ints
from gyrostab.errors import OptionError, TimeError
from gyrostab.time.stamps import NANOSECONDS, to_nanoseconds

#: Stamps are integer nanoseconds: at a higher rate, several samples would share one.
MAX_RATE_HZ = 1e9
#: At a lower rate, one period could exceed 64-bit nanoseconds, which hold 292 years.
MIN_RATE_HZ = 1e-9

_OFFSET = re.compile(r"(.*\d[T ].*?)\s*(Z|UTC|[+-]\d\d(?::?\d\d)?)")


def check_rate(rate: float, name: str) -> None:
    """Check that a number can be a sampling rate; `name` begins the message.

    Raises
    ------
    OptionError
        When it is not between `MIN_RATE_HZ` and `MAX_RATE_HZ`.

    Examples
    --------
    >>> check_rate(0.0, "--rate")
    Traceback (most recent call last):
    gyrostab.errors.OptionError: --rate 0: give the sampling rate in Hz, a number from 1e-09 to ...
    """
    is_number = isinstance(rate, int | float | np.number) and not isinstance(rate, bool)
    if not (is_number and MIN_RATE_HZ <= rate <= MAX_RATE_HZ):  # false for nan too
        raise OptionError(
            f"{name} {f'{rate:g}' if is_number else repr(rate)}: give the sampling rate in Hz, "
            f"a number from {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g}"
        )


def check_span(start: int, rate: float, size: int, where: str) -> None:
    """Check that the stamps of a uniform axis fit into 64-bit nanoseconds.

    `where` begins the message.

    Raises
    ------
    TimeError
        When the last one is outside the years 1678 to 2262.
    """
    last = start + max(size - 1, 0) * NANOSECONDS / rate
    if not max(abs(start), abs(last)) < 2.0**63:
        first = np.datetime64(int(start) // NANOSECONDS, "s")  # of any year
        raise TimeError(
            f"{where}: {size} samples at {rate:.6g} Hz from {first} "
            "would begin or end outside the years 1678 to 2262; "
            "check the sampling rate and the start"
        )


@lru_cache(maxsize=64)
def period_ns(rate: float) -> tuple[int, float]:
    """Split the sampling period of `rate` [Hz] into integer and fractional nanoseconds.

    Examples
    --------
    >>> period_ns(400.0)
    (2500000, 0.0)
    >>> period_ns(300.0)
    (3333333, 0.3333333333333333)
    """
    period = NANOSECONDS / Fraction(repr(float(rate)))
    nanoseconds = int(period)
    return nanoseconds, float(period - nanoseconds)


def grid_times(start: int, rate: float, index: Any) -> Ints:
    """Compute the stamps [ns since 1970] of samples of a grid.

    Parameters
    ----------
    start : int
        Stamp of sample 0 [ns since 1970-01-01T00:00:00].
    rate : float
        Sampling rate [Hz].

    Examples
    --------
    >>> int(grid_times(0, 300.0, 200 * 3600 * 300))  # 200 h at 300 Hz, to the nanosecond
    720000000000000
    """
    index = np.asarray(index, dtype=np.int64)
    nanoseconds, fraction = period_ns(rate)
    return np.asarray(start + index * nanoseconds + np.rint(index * fraction).astype(np.int64))


def grid_index(start: int, rate: float, stamps: Any) -> Floats:
    """Compute the positions of `stamps` [ns since 1970] on the grid, in fractional samples."""
    nanoseconds, fraction = period_ns(rate)
    stamps = np.asarray(stamps, dtype=np.int64)
    since = np.asarray(stamps - start)
    has_wrapped = (since < 0) != (stamps < start)
    since = np.where(has_wrapped, stamps - float(start), since) if has_wrapped.any() else since
    return np.asarray(since / (nanoseconds + fraction))


def first_stamp(log: xr.Dataset) -> int:
    """Return the first stamp of a log [ns since 1970] without computing the others."""
    return int(to_nanoseconds(log.variables["time"][0].values).ravel()[0])


class GridTransform(CoordinateTransform):
    """Transform from position to stamp, for some evenly spaced `samples` of a grid."""

    def __init__(self, start: int, rate: float, samples: range, name: str):
        super().__init__([name], {name: len(samples)}, dtype=np.dtype("datetime64[ns]"))
        self.start, self.rate, self.samples = int(start), float(rate), samples

    @property
    def size(self) -> int:
        """Number of samples."""
        return len(self.samples)

    def stamps_at(self, positions: Any) -> Ints:
        """Return the stamps [ns since 1970] of places among the samples."""
        samples = self.samples.start + self.samples.step * np.asarray(positions, dtype=np.int64)
        return grid_times(self.start, self.rate, samples)

    def find_positions(self, stamps: Any) -> Floats:
        """Return the places of stamps among the samples, in fractions."""
        sample = grid_index(self.start, self.rate, to_nanoseconds(stamps))
        return np.asarray((sample - self.samples.start) / self.samples.step)

    def forward(self, dim_positions: dict[str, Any]) -> dict[Any, Any]:
        """Return the stamps of positions, by name of the coordinate."""
        stamps = self.stamps_at(dim_positions[self.dims[0]])
        return {self.coord_names[0]: stamps.view("datetime64[ns]")}

    def reverse(self, coord_labels: dict[Any, Any]) -> dict[str, Any]:
        """Return the positions of stamps, by dimension."""
        return {self.dims[0]: self.find_positions(coord_labels[self.coord_names[0]])}

    def equals(self, other: CoordinateTransform, *, exclude: frozenset[Any] | None = None) -> bool:
        """Whether another transform has the same samples of the same grid."""
        return isinstance(other, GridTransform) and (self.start, self.rate, self.samples) == (
            other.start,
            other.rate,
            other.samples,
        )

    def select(self, samples: range) -> GridTransform:
        """Return other samples of the same grid."""
        return GridTransform(self.start, self.rate, samples, self.dims[0])

    def end_stamps(self) -> Ints:
        """Return the first and last stamp; two equal ones if there is none in between."""
        return self.stamps_at([0, max(self.size - 1, 0)])


def span_of(bound: Any) -> tuple[np.datetime64, np.datetime64]:
    """Return the first and last nanosecond, UTC, of a time or of what a text names."""
    if isinstance(bound, str):  # "T12:00:03" ends with that second
        match = _OFFSET.fullmatch(bound.strip())
        period: Any = pd.Period(match[1] if match else bound)
        if period is pd.NaT:
            raise ValueError(f"{bound!r} is not a time")
        zone: Any = pd.Timestamp(f"1970-01-01T00:00{match[2] if match else 'Z'}").utcoffset()
        ends = period.start_time - zone, period.end_time - zone
    else:
        scalar: Any = np.asarray(bound)[()]  # also of a DataArray
        time = pd.Timestamp(scalar)
        ends = (time.tz_convert(None) if time.tzinfo else time,) * 2
    first, last = (end.as_unit("ns").to_datetime64() for end in ends)
    return first, last


def _wrap_positions(positions: dict[Any, Any]) -> Any:
    """Wrap positions by dimension as xarray expects them; it does not export the class."""
    return type(xr.indexes.PandasIndex([0], "n").sel({"n": 0}))(positions)


class TimeGridIndex(CoordinateTransformIndex):
    """Index of a uniform time axis: slices stay lazy, and labels are found by arithmetic."""

    transform: GridTransform

    @property
    def start(self) -> int:
        """Stamp of the first sample [ns since 1970]."""
        return int(self.transform.stamps_at(0))

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return self.transform.rate / self.transform.samples.step

    def isel(self, indexers: Mapping[Any, Any]) -> Any:
        """Keep the index for slices forward; other selections have an ordinary one, in memory."""
        (dim,), size = self.transform.dims, self.transform.size
        part = indexers[dim]
        if isinstance(part, slice):
            if part.step is None or part.step > 0:
                return type(self)(self.transform.select(self.transform.samples[part]))
            part = np.arange(*part.indices(size))
        if isinstance(part, xr.Variable):
            if part.dims != (dim,):
                return None
            part = part.data
        places = np.asarray(part)
        if places.ndim != 1:
            return None
        places = np.flatnonzero(places) if places.dtype.kind == "b" else places.astype(np.int64)
        if ((places < -size) | (places >= size)).any():
            raise IndexError(f"{dim!r} has {size} samples, and one outside of them is selected")
        places = np.where(places < 0, places + size, places)
        stamps = self.transform.stamps_at(places).view("datetime64[ns]")
        return xr.indexes.PandasIndex(pd.DatetimeIndex(stamps), dim)

    @classmethod
    def concat(cls, indexes: Sequence[Any], dim: Any, positions: Any = None) -> Any:
        """Concatenate axes; the result is computed if each begins where the previous one ends."""
        if positions is None and all(isinstance(index, cls) for index in indexes):
            grids = [index.transform for index in indexes]
            edges = np.cumsum([0, *(grid.size for grid in grids)]).tolist()
            first, step = grids[0].samples.start, grids[0].samples.step
            joined = [
                grids[0].select(range(first + step * begin, first + step * end, step))
                for begin, end in [*pairwise(edges), (0, edges[-1])]
            ]
            if all(
                np.array_equal(part.end_stamps(), grid.end_stamps())
                for part, grid in zip(joined, grids, strict=False)
            ):
                return cls(joined[-1])
        stamps = [index.to_pandas_index() for index in indexes]
        return xr.indexes.PandasIndex(stamps[0].append(stamps[1:]), dim)

    def join(self, other: Any, how: str = "inner") -> Any:
        """Return the common or united axis; it is computed if both are parts of one grid."""
        own, another = self.transform, other.transform
        grids = [(grid.start, grid.rate, grid.samples.step) for grid in (own, another)]
        starts = own.samples.start, another.samples.start
        step = own.samples.step
        if grids[0] == grids[1] and (starts[1] - starts[0]) % step == 0:
            stops = [
                begin + step * grid.size for begin, grid in zip(starts, (own, another), strict=True)
            ]
            if how == "inner":
                return type(self)(own.select(range(max(starts), min(stops), step)))
            if max(starts) <= min(stops):
                return type(self)(own.select(range(min(starts), max(stops), step)))
        stamps = self.to_pandas_index(), other.to_pandas_index()
        joined = stamps[0].union(stamps[1]) if how == "outer" else stamps[0].intersection(stamps[1])
        return xr.indexes.PandasIndex(joined, own.dims[0])

    def reindex_like(self, other: Any, method: Any = None, tolerance: Any = None) -> dict[Any, Any]:
        """Find the positions of the stamps of another index, -1 for those without a position."""
        positions, is_found = self._find_stamps(other.to_pandas_index().values, method, tolerance)
        return {self.transform.dims[0]: np.where(is_found, positions, -1)}

    def sel(self, labels: dict[Any, Any], method: Any = None, tolerance: Any = None) -> Any:
        """Find positions of stamps (exact or nearest), of a day, or of slices with both ends."""
        (name,), (dim,) = self.transform.coord_names, self.transform.dims
        label = labels[name]
        if isinstance(label, slice):
            return _wrap_positions({dim: self._find_slice(label)})
        if isinstance(label, str) and method is None:
            first, last = span_of(label)
            if last - first > np.timedelta64(1, "s"):
                # "2026-11-20" or "2026-11-20T14": the whole day or hour, as in pandas
                return _wrap_positions({dim: self._find_slice(slice(first, last))})
        if isinstance(label, str | date):  # also a pandas.Timestamp
            times: Array = np.asarray(span_of(label)[0])
        else:
            times = np.asarray(getattr(label, "values", label))
        if times.dtype.kind == "b":
            positions = times
        else:
            if times.dtype.kind in "iufc":
                raise KeyError(f"{label} is not a time")
            positions, is_found = self._find_stamps(
                times.astype("datetime64") if times.dtype.kind in "USO" else times,
                method,
                tolerance,
            )
            if not np.all(is_found):
                where = "near" if tolerance is None else f"within {tolerance} of"
                raise KeyError(
                    f"no sample exactly at {label}; use method='nearest' or a slice"
                    if method is None
                    else f"no sample {where} {label}"
                )
        if isinstance(label, xr.DataArray | xr.Variable):
            return _wrap_positions({dim: xr.Variable(label.dims, positions)})
        return _wrap_positions({dim: int(positions) if positions.ndim == 0 else positions})

    def _find_stamps(self, stamps: Array, method: Any, tolerance: Any) -> tuple[Ints, Bools]:
        """Find the nearest samples of stamps, and whether each is exact or near enough."""
        if method not in (None, "nearest"):
            raise ValueError(
                f"a uniform time axis selects with method='nearest' or exactly, not {method!r}"
            )
        positions = np.rint(self.transform.find_positions(stamps))
        nearest = np.clip(positions, 0, max(self.transform.size - 1, 0)).astype(np.int64)
        miss = np.abs(self.transform.stamps_at(nearest).view("datetime64[ns]") - stamps)
        if method is None:
            most: np.timedelta64 = np.timedelta64(0, "ns")
        elif tolerance is not None:
            most = pd.Timedelta(tolerance).to_timedelta64()
        else:
            return nearest, ~np.isnat(stamps)
        return nearest, (miss <= most) & (self.transform.size > 0)

    def _find_slice(self, label: slice) -> slice:
        size = self.transform.size

        def edge(bound: Any, side: str) -> int | None:
            if bound is None:
                return None
            stamp = span_of(bound)[0 if side == "left" else 1]
            guess = int(np.clip(self.transform.find_positions(stamp), 1, size + 1)) - 1
            while guess < size:  # at most three steps: only rounding is missing
                grid_stamp = self.transform.stamps_at(guess).view("datetime64[ns]")
                if grid_stamp > stamp or (grid_stamp == stamp and side == "left"):
                    break
                guess += 1
            return min(guess, size)

        return slice(edge(label.start, "left"), edge(label.stop, "right"), label.step)

    def to_pandas_index(self) -> pd.Index:
        """Return the whole axis as a DatetimeIndex, in memory."""
        (dim,) = self.transform.dims
        return pd.DatetimeIndex(
            self.transform.generate_coords()[self.transform.coord_names[0]], name=dim
        )


def time_coordinate(
    start: int, rate: float, samples: int | range, *, name: str = "time"
) -> xr.Coordinates:
    """Lazy, exact, uniform time coordinate.

    Parameters
    ----------
    start : int
        Stamp of sample 0 [ns since 1970-01-01T00:00:00].
    rate : float
        Sampling rate [Hz], taken as the decimal number that it prints as.
    samples : int or range
        Number of samples on the axis, or those that it holds of the grid that begins at `start`.
    name : str
        Name of the coordinate and of its dimension.

    Returns
    -------
    xarray.Coordinates
        To be given to ``xr.Dataset(..., coords=...)``; no stamp is held in memory.

    Examples
    --------
    >>> log = xr.Dataset(coords=time_coordinate(0, 400.0, 3 * 10**8))
    >>> log.time[-1].values
    np.datetime64('1970-01-09T16:19:59.997500000')
    >>> log.isel(time=slice(0, 4, 2)).time.values
    array(['1970-01-01T00:00:00.000000000', '1970-01-01T00:00:00.005000000'],
          dtype='datetime64[ns]')
    """
    samples = samples if isinstance(samples, range) else range(samples)
    return xr.Coordinates.from_xindex(TimeGridIndex(GridTransform(start, rate, samples, name)))

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
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from xarray.indexes import CoordinateTransform, CoordinateTransformIndex

from gyrostab.errors import OptionError, TimeError
from gyrostab.time.stamps import to_nanoseconds

NANOSECONDS = 10**9
#: Stamps are integer nanoseconds: at a higher rate, several samples would share one.
MAX_RATE_HZ = 1e9

_CLOCK = r"(\d{1,2})(?::(\d{1,2})(?::(\d{1,2})(?:[.,](\d+))?)?)?"
_ZONE = r"\s*(Z|UTC|GMT|[+-]\d{1,2}(?::?\d{2})?)?"
_INSTANT = re.compile(
    rf"(\d{{4}}|1(?=-0?1-))-(\d{{1,2}})-(\d{{1,2}})(?:[T ]\s*{_CLOCK}{_ZONE})?", re.IGNORECASE
)
_COMPACT_INSTANT = re.compile(
    rf"(\d{{4}})(\d\d)(\d\d)(?:[T ](\d\d)(\d\d)(\d\d)(?:[.,](\d+))?{_ZONE})?", re.IGNORECASE
)


def split_instant(text: str) -> tuple[int, int, int, int] | None:
    """Split a date and time into year, month, day and nanoseconds after its midnight UTC.

    Only texts that can be read in one way are split: the year has four digits and comes first (ISO
    8601, or the form ``2026-1-2 3:4:5 UTC`` that UDUNITS reads). The fields are not checked against
    a calendar.

    Parameters
    ----------
    text : str
        The date and time; UTC unless it names an offset.

    Returns
    -------
    tuple of int or None
        None when the text has another form.

    Examples
    --------
    >>> split_instant("2026-1-2 3:00 +01:00")
    (2026, 1, 2, 7200000000000)
    >>> split_instant("01-02-2026") is None
    True
    """
    match = _INSTANT.fullmatch(text.strip()) or _COMPACT_INSTANT.fullmatch(text.strip())
    if match is None:
        return None
    year, month, day, hour, minute, second = (int(group or 0) for group in match.groups()[:6])
    fraction, zone = match.groups()[6:]
    seconds = 3600 * hour + 60 * minute + second
    if seconds > 86400 or minute > 59 or second > 60:
        return None
    if zone and zone[0] in "+-":
        digits = zone[1:].replace(":", "")
        hours, minutes = (digits, "0") if len(digits) <= 2 else (digits[:-2], digits[-2:])
        seconds -= int(f"{zone[0]}1") * (3600 * int(hours) + 60 * int(minutes))
    return year, month, day, seconds * NANOSECONDS + int((fraction or "0")[:9].ljust(9, "0"))


def stamp_ns(start: Any, name: str = "start") -> int:
    """Convert an instant, as text or as nanoseconds since 1970, to nanoseconds since 1970.

    Parameters
    ----------
    start : str, int or datetime
        The instant; text is ISO 8601, UTC unless it says otherwise.

    Raises
    ------
    OptionError
        When it is not a date and time, or outside the years 1678 to 2262.

    Examples
    --------
    >>> stamp_ns("1970-01-01T02:00:01+02:00")
    1000000000
    """
    if isinstance(start, int | np.integer):
        return int(start)
    try:
        if isinstance(start, str):
            stamp = _parse_stamp_ns(start)
        else:
            time = pd.Timestamp(start)
            if pd.isna(time):
                raise ValueError("no time")
            stamp = int((time.tz_convert(None) if time.tzinfo else time).as_unit("ns").value)
    except (ValueError, TypeError, OverflowError, AttributeError) as error:
        example = "2026-11-20T14:00:00 (UTC)"
        raise OptionError(
            f"{name} {start!r} is not a date and time; write for instance {example}"
        ) from error
    if abs(stamp) >= 2**63:
        raise OptionError(
            f"{name} {start!r} is outside the years 1678 to 2262, which 64-bit nanoseconds hold; "
            "give another date"
        )
    return stamp


def check_rate(rate: float, name: str) -> None:
    """Check that a number can be a sampling rate; `name` begins the message.

    Raises
    ------
    OptionError
        When it is not above 0 and at most `MAX_RATE_HZ`.

    Examples
    --------
    >>> check_rate(0.0, "--rate")
    Traceback (most recent call last):
    gyrostab.errors.OptionError: --rate 0: give the sampling rate in Hz, a number above 0 and at...
    """
    if not 0 < rate <= MAX_RATE_HZ:  # false for nan too
        raise OptionError(
            f"{name} {rate:g}: give the sampling rate in Hz, "
            f"a number above 0 and at most {MAX_RATE_HZ:g}"
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


def _parse_stamp_ns(text: str) -> int:
    fields = split_instant(text)
    if fields is None:
        raise ValueError("the year does not come first, with four digits")
    year, month, day, nanoseconds = fields
    return (date(year, month, day) - date(1970, 1, 1)).days * 86400 * NANOSECONDS + nanoseconds


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


def grid_times(start: int, rate: float, index: Any) -> NDArray[np.int64]:
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


def grid_index(start: int, rate: float, stamps: Any) -> NDArray[np.float64]:
    """Compute the positions of `stamps` [ns since 1970] on the grid, in fractional samples."""
    nanoseconds, fraction = period_ns(rate)
    return np.asarray((np.asarray(stamps, dtype=np.int64) - start) / (nanoseconds + fraction))


def first_stamp(log: xr.Dataset) -> int:
    """Return the first stamp of a log [ns since 1970] without computing the others."""
    return int(to_nanoseconds(log.variables["time"][0].values).ravel()[0])


class _GridTransform(CoordinateTransform):
    """Transform from position to stamp, for sample ``first + stride * position`` of a grid."""

    def __init__(
        self,
        start: int,
        rate: float,
        size: int,
        *,
        first: int = 0,
        stride: int = 1,
        name: str = "time",
        dim: str = "time",
    ):
        super().__init__([name], {dim: size}, dtype=np.dtype("datetime64[ns]"))
        self.start, self.rate = int(start), float(rate)
        self.first, self.stride = int(first), int(stride)

    @property
    def size(self) -> int:
        return int(next(iter(self.dim_size.values())))

    def forward(self, dim_positions: dict[str, Any]) -> dict[Any, Any]:
        position = np.asarray(dim_positions[self.dims[0]], dtype=np.int64)
        stamps = grid_times(self.start, self.rate, self.first + self.stride * position)
        return {self.coord_names[0]: stamps.view("datetime64[ns]")}

    def reverse(self, coord_labels: dict[Any, Any]) -> dict[str, Any]:
        stamps = to_nanoseconds(coord_labels[self.coord_names[0]])
        return {
            self.dims[0]: (grid_index(self.start, self.rate, stamps) - self.first) / self.stride
        }

    def equals(self, other: CoordinateTransform, *, exclude: frozenset[Any] | None = None) -> bool:
        return isinstance(other, _GridTransform) and self._key() == other._key()

    def _key(self) -> tuple[Any, ...]:
        return (self.start, self.rate, self.first, self.stride, self.size)

    def select(self, positions: range) -> _GridTransform:
        """Return the samples at these positions, also beyond the end."""
        first, stride = self.first + self.stride * positions.start, self.stride * positions.step
        return _GridTransform(
            self.start,
            self.rate,
            len(positions),
            first=first,
            stride=stride,
            name=str(self.coord_names[0]),
            dim=self.dims[0],
        )

    def cut(self, part: slice) -> _GridTransform:
        return self.select(range(self.size)[part])

    def has_ends_of(self, other: _GridTransform) -> bool:
        """Whether another grid of the same size has the same first and last stamp."""
        ends = {self.dims[0]: np.array([0, max(self.size - 1, 0)])}
        own_stamps, other_stamps = (
            grid.forward(ends)[grid.coord_names[0]] for grid in (self, other)
        )
        return bool(np.array_equal(own_stamps, other_stamps))


def _wrap_positions(positions: dict[Any, Any]) -> Any:
    """Wrap positions by dimension as xarray expects them; it does not export the class."""
    return type(xr.indexes.PandasIndex([0], "n").sel({"n": 0}))(positions)


class TimeGridIndex(CoordinateTransformIndex):
    """Index of a uniform time axis: slices stay lazy, and labels are found by arithmetic."""

    transform: _GridTransform

    @property
    def start(self) -> int:
        """Stamp of the first sample [ns since 1970]."""
        return int(grid_times(self.transform.start, self.transform.rate, self.transform.first))

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return self.transform.rate / self.transform.stride

    def isel(self, indexers: Mapping[Any, Any]) -> TimeGridIndex | None:
        """Keep the index for slices; other selections get an ordinary coordinate."""
        part = indexers[self.transform.dims[0]]
        return type(self)(self.transform.cut(part)) if isinstance(part, slice) else None

    @classmethod
    def concat(cls, indexes: Sequence[Any], dim: Any, positions: Any = None) -> Any:
        """Concatenate axes; the result is computed if each begins where the previous one ends."""
        if positions is None and all(isinstance(index, cls) for index in indexes):
            grids = [index.transform for index in indexes]
            full_grid, at, fits = grids[0].select(range(sum(grid.size for grid in grids))), 0, True
            for grid in grids:
                fits = fits and full_grid.cut(slice(at, at + grid.size)).has_ends_of(grid)
                at += grid.size
            if fits:
                return cls(full_grid)
        stamps = [index.to_pandas_index() for index in indexes]
        return xr.indexes.PandasIndex(stamps[0].append(stamps[1:]), dim)

    def sel(self, labels: dict[Any, Any], method: Any = None, tolerance: Any = None) -> Any:
        """Find positions of stamps (exact or nearest), of a day, or of slices with both ends."""
        (name,) = self.transform.coord_names
        label = labels[name]
        dim = self.transform.dims[0]
        if isinstance(label, slice):
            return _wrap_positions({dim: self._find_slice(label)})
        if isinstance(label, str) and method is None and len(label) < len("2000-01-01T00:00:00"):
            # "2026-11-20" or "2026-11-20T14": the whole day or hour, as in pandas
            period = pd.Period(label)
            return _wrap_positions(
                {dim: self._find_slice(slice(period.start_time, period.end_time))}
            )
        stamps = np.asarray(getattr(label, "values", label)).astype("datetime64[ns]")
        position = self.transform.reverse({name: stamps})[dim]
        nearest = np.rint(position).astype(np.int64)
        if method not in (None, "nearest"):
            raise ValueError(
                f"a uniform time axis selects with method='nearest' or exactly, not {method!r}"
            )
        outside = (nearest < 0) | (nearest >= self.transform.size)
        if method is None:
            exact = self.transform.forward({dim: nearest})[name] == stamps
            if np.any(outside | ~exact):
                raise KeyError(f"no sample exactly at {label}; use method='nearest' or a slice")
        nearest = np.clip(nearest, 0, self.transform.size - 1)
        if tolerance is not None:
            miss = np.abs(self.transform.forward({dim: nearest})[name] - stamps)
            if np.any(miss > pd.Timedelta(tolerance).to_timedelta64()):
                raise KeyError(f"no sample within {tolerance} of {label}")
        if isinstance(label, xr.DataArray | xr.Variable):
            return _wrap_positions({dim: xr.Variable(label.dims, nearest)})
        return _wrap_positions({dim: int(nearest) if nearest.ndim == 0 else nearest})

    def _find_slice(self, label: slice) -> slice:
        (name,), (dim,) = self.transform.coord_names, self.transform.dims

        def edge(bound: Any, side: str) -> int | None:
            if bound is None:
                return None
            is_period_end = (
                side == "right"
                and isinstance(bound, str)
                and not re.search(r"(Z|[+-]\d\d:?\d\d)$", bound)
            )
            # "T12:00:03" ends with that second
            time = pd.Period(bound).end_time if is_period_end else pd.Timestamp(bound)
            stamp = (time.tz_convert(None) if time.tzinfo else time).as_unit("ns").to_datetime64()
            guess = int(np.floor(self.transform.reverse({name: stamp})[dim])) - 1
            while guess < self.transform.size:  # at most three steps: only rounding is missing
                grid_stamp = self.transform.forward({dim: guess})[name]
                if grid_stamp > stamp or (grid_stamp == stamp and side == "left"):
                    break
                guess += 1
            return max(0, min(guess, self.transform.size))

        return slice(edge(label.start, "left"), edge(label.stop, "right"), label.step)

    def to_pandas_index(self) -> pd.Index:
        """Return the whole axis as a DatetimeIndex, in memory."""
        (dim,) = self.transform.dims
        return pd.DatetimeIndex(
            self.transform.generate_coords()[self.transform.coord_names[0]], name=dim
        )


def time_coordinate(
    start: int, rate: float, size: int, *, name: str = "time", first: int = 0, stride: int = 1
) -> xr.Coordinates:
    """Lazy, exact, uniform time coordinate.

    Parameters
    ----------
    start : int
        Stamp of sample 0 [ns since 1970-01-01T00:00:00].
    rate : float
        Sampling rate [Hz], taken as the decimal number that it prints as.
    size : int
        Number of samples on the axis.
    name : str
        Name of the coordinate and of its dimension.
    first, stride : int
        The axis holds the samples `first`, ``first + stride``, ... of the grid that begins at
        `start`.

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
    return xr.Coordinates.from_xindex(
        TimeGridIndex(
            _GridTransform(start, rate, size, first=first, stride=stride, name=name, dim=name)
        )
    )

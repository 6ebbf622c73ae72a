"""Channels with their own stamps on the time grid of the gyro, where their rate allows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.schema import log_channels, signal_name
from gyrostab.time.grid import TimeGridIndex, first_stamp, grid_index, grid_times

__all__ = ["TURNING", "Aligned", "align_channels"]

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
#: Sampling periods of the gyro up to which a channel counts as sampled like the gyro: each sample
#: then has a value within three quarters of a period. The ramp must be as fast, since its phase
#: between its samples is not known.
MAX_SAME_PERIODS = 1.5
#: Periods of the gyro above which a channel says nothing of the spectrum of a sample: interpolated
#: linearly it keeps less than an eighth of the band. It then enters by its means over blocks.
MAX_LINEAR_PERIODS = 4.0
#: Periods of the channel that a straight line may bridge, as for its means over blocks.
MAX_BRIDGED_PERIODS = 3.0
#: Periods of the channel between a sample and the value nearest to it; one that is missing leaves
#: a sample without a value, jitter of the stamps does not.
MAX_NEAREST_PERIODS = 0.75
#: Stamps are even when half of the intervals lie within this share of their median. Stamps of the
#: arrival come in bursts instead: their mean is the period, without gaps of so many medians.
EVEN_SHARE, GAP_MEDIANS = 0.1, 16.0
#: Beginnings of the names of channels that hold the rotation of the tool as a wave: gravity and the
#: Earth's field turn in their frame. Such a wave is coherent with any line of the gyro at the
#: rotation, whatever causes the line, so that sample by sample it is no evidence for a cause.
TURNING = ("rotation_rate", "toolface", "accel", "mag_")
_STAMPS_INSPECTED = 2**20
_PIECE_SAMPLES = 2**20


#: Instants, stamps and their values, reach and period of the gyro [ns] -> value at each instant.
_Choose = Callable[[Stamps, Stamps, Array, float, float], Array]


class Aligned(NamedTuple):
    """A log whose channels are on its grid where they can be.

    Attributes
    ----------
    log : xarray.Dataset
        Without the channels that are not used.
    unused : dict of str to str
        Channel -> why it is not used.
    notes : list of str
        Sentences on channels that were moved.
    """

    log: xr.Dataset
    unused: dict[str, str]
    notes: list[str]


@dataclass(frozen=True)
class _Clock:
    """Stamps of a channel [ns since 1970]: a grid, or one by one."""

    size: int
    start: int = 0
    rate: float = 0.0
    stamps: Stamps | None = None

    def between(self, low: int, high: int) -> Stamps:
        """Stamps of the values `low` to `high`."""
        if self.stamps is not None:
            return self.stamps[low:high]
        return grid_times(self.start, self.rate, np.arange(low, high))

    def place(self, instant: int) -> int:
        """Number of values before an instant."""
        if self.stamps is not None:
            return int(np.searchsorted(self.stamps, instant))
        return int(
            np.clip(np.ceil(float(grid_index(self.start, self.rate, instant))), 0, self.size)
        )

    def period(self) -> float:
        """Median interval [ns], or where intervals vary their mean without gaps; infinite for a single value."""
        if self.stamps is None:
            return 1e9 / self.rate
        steps = np.diff(self.stamps[:_STAMPS_INSPECTED]).astype(np.float64)
        steps = steps[steps > 0.0]
        if not steps.size:
            return np.inf
        median = float(np.median(steps))
        if np.mean(np.abs(steps - median) <= EVEN_SHARE * median) > 0.5:
            return median
        return float(steps[steps <= GAP_MEDIANS * median].mean())


def align_channels(log: xr.Dataset) -> Aligned:
    """Lay channels that have their own stamps on the time grid of the gyro.

    A channel sampled like the gyro, or a faster ramp, gives each sample the value nearest to it. A
    faster channel gives it the mean of its values about it, and one up to four times slower a value
    on the straight line between its neighbours, but not across gaps. Slower channels, and
    vibration, whose rms counts, keep their stamps: they enter by their means over blocks. So do
    accelerometers and magnetometers where the log has the rotation rate: with it the lines at the
    rotation are measured, and the wave of gravity would explain them once more. A toolface always
    keeps its stamps, since angles that wrap have no mean.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log, in memory or lazy; a lazy log stays lazy.

    Returns
    -------
    Aligned

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> log = make_log(np.zeros((1, 4)), rate=100.0, unit="deg/h", start="2026-01-01")
    >>> late = log["time"].values + np.timedelta64(3, "ms")
    >>> log = log.assign_coords(time_ramp=late).assign(ramp=("time_ramp", [0.0, 0.4, 0.8, 0.2], {"units": "1"}))
    >>> aligned = align_channels(log)
    >>> aligned.log["ramp"].values, aligned.unused, aligned.notes
    (array([0. , 0.4, 0.8, 0.2]), {}, ['channel ramp: its stamps are 3 ms after those of the gyro; each sample has the nearest value'])
    """
    unused: dict[str, str] = {}
    notes: list[str] = []
    for name in log_channels(log):
        if not np.issubdtype(log[name].dtype, np.number):
            unused[name] = "it holds text, not numbers"
        elif log[name].dims != ("time",):
            problem = _lay_channel(log, name)
            if isinstance(problem, str):
                unused[name] = problem
            elif problem is not None:
                dim = f"time_{name}"
                log = log.drop_vars([name, dim]).assign(
                    {name: ("time", problem.values, log[name].attrs)}
                )
                notes += [problem.note] if problem.note else []
    mine = [
        component
        for name in unused
        for component in (name, f"time_{name}")
        if component in log.variables
    ]
    return Aligned(log.drop_vars(mine), unused, notes)


class _Laid(NamedTuple):
    values: Any
    note: str


def _lay_channel(log: xr.Dataset, name: str) -> _Laid | str | None:
    """Values on the gyro's grid with a note; or why the channel is of no use; or None where it keeps its stamps."""
    clock = _clock_of(log, name)
    rate, start, size = float(log.attrs["sampling_rate_hz"]), first_stamp(log), log.sizes["time"]
    if not clock.size:
        return "it holds no value"
    first, last = (int(clock.between(place, place + 1)[0]) for place in (0, clock.size - 1))
    end = int(grid_times(start, rate, size - 1))
    if last < start or first > end:
        return f"its values, {_iso(first)} to {_iso(last)}, lie outside the time of the gyro, {_iso(start)} to {_iso(end)}"
    period = clock.period()
    ratio = period * rate / 1e9
    is_ramp = name == "ramp"
    if is_ramp and ratio > MAX_SAME_PERIODS:
        return (
            f"it is sampled at {1e9 / period:.4g} Hz, slower than the gyro at {rate:.4g} Hz, "
            "so that its phase between its samples is not known"
        )
    if (
        name.startswith("vibration")
        or ratio > MAX_LINEAR_PERIODS
        or _is_wave_of_rotation(log, name)
    ):
        return None
    held = log[name].attrs.get("interpolation") == "previous"
    choose: _Choose
    if ratio > MAX_SAME_PERIODS:
        choose, reach, how = (
            partial(_at_line, held=held),
            MAX_BRIDGED_PERIODS,
            f"it is interpolated from {1e9 / period:.4g} Hz",
        )
    elif is_ramp or ratio * MAX_SAME_PERIODS >= 1.0:
        choose, reach, how = _at_nearest, MAX_NEAREST_PERIODS, "each sample has the nearest value"
    else:
        choose, reach, how = (
            _at_mean,
            1.0,
            f"each sample has the mean of its values at {1e9 / period:.4g} Hz",
        )
    lay = partial(
        _lay_piece,
        clock,
        start=start,
        rate=rate,
        reach=max(reach * period, 0.5e9 / rate),
        choose=choose,
    )
    return _Laid(
        _on_grid(log, name, clock, lay, size), _note(name, clock, start, rate, period, how)
    )


def _is_wave_of_rotation(log: xr.Dataset, name: str) -> bool:
    """Return whether a channel only repeats, sample by sample, the rotation that another channel gives."""
    return name == "toolface" or (name.startswith(TURNING) and "rotation_rate" in log.data_vars)


def _clock_of(log: xr.Dataset, name: str) -> _Clock:
    index = log.xindexes.get(f"time_{name}")
    if isinstance(index, TimeGridIndex):
        return _Clock(log.sizes[f"time_{name}"], index.start, index.rate)
    stamps = log[f"time_{name}"].values.astype("datetime64[ns]").view(np.int64)
    return _Clock(stamps.size, stamps=stamps)


def _note(name: str, clock: _Clock, start: int, rate: float, period: float, how: str) -> str:
    """Say how far the stamps are from those of the gyro; nothing where they are the same."""
    place = min(clock.place(start), clock.size - 1)
    skew = float(grid_index(start, rate, clock.between(place, place + 1))[0])
    skew = (skew - round(skew)) / rate
    if abs(skew) < 1e-3 / rate and abs(period * rate / 1e9 - 1.0) < 1e-3:
        return ""
    where = "after" if skew > 0.0 else "before"
    said = (
        f"its stamps are {abs(skew) * 1e3:.3g} ms {where} those of the gyro; "
        if abs(skew) >= 1e-3 / rate
        else ""
    )
    return f"channel {name}: {said}{how}"


def _iso(stamp: int) -> str:
    return str(np.datetime64(stamp, "ns").astype("datetime64[ms]")) + "Z"


# ------------------------------------------------------------------------------------- in pieces


def _on_grid(log: xr.Dataset, name: str, clock: _Clock, lay: Any, size: int) -> Any:
    """Samples of a channel on the grid: an array where log and channel are in memory, else lazy, chunk by chunk as the gyro has them."""
    signal, data = log[signal_name(log)].transpose("axis", "time").data, log[name].data
    edges = [*range(0, size, _PIECE_SAMPLES), size]
    if hasattr(signal, "chunks"):
        edges = np.concatenate([[0], np.cumsum(signal.chunks[1])]).tolist()
    pieces = list(pairwise(edges))
    spans = [_needed(clock, lay, low, high) for low, high in pieces]
    if isinstance(signal, np.ndarray) and isinstance(data, np.ndarray):
        return np.concatenate(
            [
                lay(data[a:b], a, low, high)
                for (low, high), (a, b) in zip(pieces, spans, strict=True)
            ]
        )
    import dask
    import dask.array as da

    laid = dask.delayed(lay, pure=False)
    components = [
        da.from_delayed(laid(data[a:b], a, low, high), (high - low,), dtype=np.float64)
        for (low, high), (a, b) in zip(pieces, spans, strict=True)
    ]
    return da.concatenate(components)


def _needed(clock: _Clock, lay: Any, low: int, high: int) -> tuple[int, int]:
    """Values that the samples `low` to `high` may need, one beyond on either side."""
    start, rate, reach = (lay.keywords[word] for word in ("start", "rate", "reach"))
    first, last = (int(edge) for edge in grid_times(start, rate, [low, high - 1]))
    return max(clock.place(first - int(reach)) - 1, 0), min(
        clock.place(last + int(reach)) + 1, clock.size
    )


def _lay_piece(
    clock: _Clock,
    values: Any,
    offset: int,
    low: int,
    high: int,
    *,
    start: int,
    rate: float,
    reach: float,
    choose: _Choose,
) -> Array:
    """Values at the samples `low` to `high`, NaN where none is within reach."""
    numbers = np.asarray(values, dtype=np.float64)
    stamps = clock.between(offset, offset + numbers.size)
    good = np.isfinite(numbers)
    numbers, stamps = numbers[good], stamps[good]
    if not numbers.size:
        return np.full(high - low, np.nan)
    instants = grid_times(start, rate, np.arange(low, high))
    return np.asarray(choose(instants, stamps, numbers, reach, 1e9 / rate))


def _at_nearest(
    instants: Stamps, stamps: Stamps, values: Array, reach: float, period: float
) -> Array:
    after = (
        np.clip(np.searchsorted(stamps, instants), 1, stamps.size - 1)
        if stamps.size > 1
        else np.zeros(instants.size, np.int64)
    )
    before = np.maximum(after - 1, 0)
    place = np.where(instants - stamps[before] <= stamps[after] - instants, before, after)
    return np.where(np.abs(instants - stamps[place]) <= reach, values[place], np.nan)


def _at_line(
    instants: Stamps, stamps: Stamps, values: Array, reach: float, period: float, *, held: bool
) -> Array:
    after = np.searchsorted(stamps, instants, side="left")
    inside = (after < stamps.size) & (
        (after > 0) | (stamps[np.minimum(after, stamps.size - 1)] == instants)
    )
    high = np.clip(after, 0, stamps.size - 1)
    low = np.where(stamps[high] == instants, high, np.maximum(high - 1, 0))
    near = inside & (stamps[high] - stamps[low] <= reach)
    share = (instants - stamps[low]) / np.maximum(stamps[high] - stamps[low], 1)
    line = values[low] + (0.0 if held else share) * (values[high] - values[low])
    return np.where(near, line, np.nan)


def _at_mean(instants: Stamps, stamps: Stamps, values: Array, reach: float, period: float) -> Array:
    edges = np.append(instants, instants[-1] + round(period)) - round(period / 2.0)
    place = np.searchsorted(edges, stamps, side="right") - 1
    inside = (place >= 0) & (place < instants.size)
    total = np.bincount(place[inside], weights=values[inside], minlength=instants.size)
    count = np.bincount(place[inside], minlength=instants.size)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / count)

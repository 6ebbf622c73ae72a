"""Resampling of channels that have their own time stamps to the time grid of the gyro."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from gyrostab.arrays import Floats, Ints
from gyrostab.schema import find_unusable_channels, log_channels, signal_name
from gyrostab.time.grid import TimeGridIndex, first_stamp, grid_index, grid_times
from gyrostab.time.stamps import format_stamp, to_nanoseconds

#: Sampling periods of the gyro up to which a channel counts as sampled like the gyro: each sample
#: then has a value within three quarters of a period. A slower ramp is not used, because its phase
#: between its samples is unknown. Derived: half of 1.5 periods.
MAX_SAME_PERIODS = 1.5
#: Periods of the gyro above which a channel no longer describes single samples: linear
#: interpolation keeps less than an eighth of the band. It then enters by its block means. Derived.
MAX_LINEAR_PERIODS = 4.0
#: Periods of the channel that linear interpolation may bridge; the same rule as for block means.
MAX_BRIDGED_PERIODS = 3.0
#: Periods of the channel between a sample and its nearest value. Design choice: a missing value
#: leaves the sample empty, jitter of the stamps does not.
MAX_NEAREST_PERIODS = 0.75
#: Stamps are even when half of the intervals lie within this share of their median. Design choice.
EVEN_INTERVAL_SHARE = 0.1
#: Medians above which an interval is a gap. Arrival stamps come in bursts, so that their period is
#: the mean interval without gaps. Design choice.
GAP_MEDIANS = 16.0
#: Prefixes of channels that contain the tool rotation as a wave: gravity and the Earth's field turn
#: in their frame. Such a wave is coherent with every line of the gyro at the rotation, whatever
#: causes the line, and therefore no evidence for a cause sample by sample.
ROTATION_WAVE_PREFIXES = ("rotation_rate", "toolface", "accel", "mag_")
_MAX_STAMPS_INSPECTED = 2**20  # limits memory
_CHUNK_SAMPLES = 2**20  # samples converted at once; limits memory

#: Instants, stamps and their values, and reach [ns] -> value at each instant.
_Choose = Callable[[Ints, Ints, Floats, float], Floats]


class Aligned(NamedTuple):
    """A log with its channels on the time grid of the gyro, as far as possible."""

    log: xr.Dataset  # the log without unused channels
    unused: dict[str, str]  # why each unused channel is not used
    notes: list[str]  # sentences on resampled channels


@dataclass(frozen=True)
class Clock:
    """Time stamps of a channel [ns since 1970]: a uniform grid, or an array."""

    size: int
    start: int = 0
    rate: float = 0.0
    stamps: Ints | None = None

    def stamps_between(self, low: int, high: int) -> Ints:
        """Return the stamps of the values `low` to `high`."""
        if self.stamps is not None:
            return self.stamps[low:high]
        return grid_times(self.start, self.rate, np.arange(low, high))

    def count_before(self, instants: ArrayLike) -> Ints:
        """Count the values before each instant [ns since 1970]."""
        if self.stamps is not None:
            return np.asarray(np.searchsorted(self.stamps, instants))
        places = np.ceil(grid_index(self.start, self.rate, instants))
        return np.clip(places, 0, self.size).astype(np.int64)

    def find_period(self) -> float:
        """Return the median interval [ns], or the mean without gaps where intervals are uneven.

        Infinite for a single value.
        """
        if self.stamps is None:
            return 1e9 / self.rate
        steps = np.diff(self.stamps[:_MAX_STAMPS_INSPECTED]).astype(np.float64)
        steps = steps[steps > 0.0]
        if not steps.size:
            return np.inf
        median = float(np.median(steps))
        if np.mean(np.abs(steps - median) <= EVEN_INTERVAL_SHARE * median) > 0.5:
            return median
        return float(steps[steps <= GAP_MEDIANS * median].mean())


def align_channels(log: xr.Dataset) -> Aligned:
    """Resample channels with their own time stamps to the time grid of the gyro.

    A channel sampled like the gyro, or a faster ramp, gives each sample its nearest value. A faster
    channel gives each sample the mean of the values around it. A channel up to four times slower is
    interpolated linearly, but not across gaps. Slower channels, and vibration, of which the rms
    matters, keep their stamps and enter by their block means. The same holds for accelerometers and
    magnetometers in a log with the rotation rate: the rotation rate already gives the lines at the
    rotation, and the wave of gravity would explain them a second time. A toolface always keeps its
    stamps, because wrapped angles have no mean. A lazy log stays lazy.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> log = make_log(np.zeros((1, 4)), rate=100.0, unit="deg/h", start="2026-01-01")
    >>> late = log["time"].values + np.timedelta64(3, "ms")
    >>> ramp = ("time_ramp", [0.0, 0.4, 0.8, 0.2], {"units": "1"})
    >>> log = log.assign_coords(time_ramp=late).assign(ramp=ramp)
    >>> aligned = align_channels(log)
    >>> aligned.log["ramp"].values, aligned.unused
    (array([0. , 0.4, 0.8, 0.2]), {})
    >>> aligned.notes[0]
    'channel ramp: its stamps are 3 ms after those of the gyro; each sample has the nearest value'
    """
    unused = find_unusable_channels(log)
    notes: list[str] = []
    for name in log_channels(log):
        if name in unused:
            continue
        if log[name].dims != ("time",):
            placed = _place_channel(log, name)
            if isinstance(placed, str):
                unused[name] = placed
            elif placed is not None:
                values, note = placed
                log = log.drop_vars([name, f"time_{name}"]).assign(
                    {name: ("time", values, log[name].attrs)}
                )
                notes += [note] if note else []
    with_times = [variable for name in unused for variable in (name, f"time_{name}")]
    return Aligned(log.drop_vars(with_times, errors="ignore"), unused, notes)


def _place_channel(log: xr.Dataset, name: str) -> tuple[Any, str] | str | None:
    """Resample a channel, with a note; or say why it is not used; None if it keeps its stamps."""
    clock = read_clock(log, name)
    rate, start, size = float(log.attrs["sampling_rate_hz"]), first_stamp(log), log.sizes["time"]
    if not clock.size:
        return "it holds no value"
    first, last = (int(clock.stamps_between(place, place + 1)[0]) for place in (0, clock.size - 1))
    end = int(grid_times(start, rate, size - 1))
    if last < start or first > end:
        return (
            f"its values, {format_stamp(first)}Z to {format_stamp(last)}Z, "
            f"lie outside the time of the gyro, {format_stamp(start)}Z to {format_stamp(end)}Z"
        )
    period = clock.find_period()
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
    hold_previous = log[name].attrs.get("interpolation") == "previous"
    choose: _Choose
    if ratio > MAX_SAME_PERIODS:
        choose = partial(interpolate_linearly, hold_previous=hold_previous)
        reach = MAX_BRIDGED_PERIODS
        method = f"it is interpolated from {1e9 / period:.4g} Hz"
    elif is_ramp or ratio * MAX_SAME_PERIODS >= 1.0:
        choose = _take_nearest
        reach = MAX_NEAREST_PERIODS
        method = "each sample has the nearest value"
    else:
        choose = partial(_average_around, period=1e9 / rate)
        reach = 1.0
        method = f"each sample has the mean of its values at {1e9 / period:.4g} Hz"
    reach_ns = max(reach * period, 0.5e9 / rate)
    note = _describe_placement(name, clock, start, rate, period, method)
    return _place_on_grid(log, name, clock, reach_ns, choose), note


def _is_wave_of_rotation(log: xr.Dataset, name: str) -> bool:
    """Return whether a channel repeats, sample by sample, the rotation given by another channel."""
    return name == "toolface" or (
        name.startswith(ROTATION_WAVE_PREFIXES) and "rotation_rate" in log.data_vars
    )


def read_clock(log: xr.Dataset, name: str) -> Clock:
    """Return the time stamps of a channel that has its own."""
    index = log.xindexes.get(f"time_{name}")
    if isinstance(index, TimeGridIndex):
        return Clock(log.sizes[f"time_{name}"], index.start, index.rate)
    stamps = to_nanoseconds(log[f"time_{name}"].values)
    return Clock(stamps.size, stamps=stamps)


def _describe_placement(
    name: str, clock: Clock, start: int, rate: float, period: float, method: str
) -> str:
    """Describe the offset of the stamps from those of the gyro; empty if there is none."""
    place = min(int(clock.count_before(start)), clock.size - 1)
    skew = float(grid_index(start, rate, clock.stamps_between(place, place + 1))[0])
    skew = (skew - round(skew)) / rate
    if abs(skew) < 1e-3 / rate and abs(period * rate / 1e9 - 1.0) < 1e-3:
        return ""
    where = "after" if skew > 0.0 else "before"
    offset = (
        f"its stamps are {abs(skew) * 1e3:.3g} ms {where} those of the gyro; "
        if abs(skew) >= 1e-3 / rate
        else ""
    )
    return f"channel {name}: {offset}{method}"


# -------------------------------------------------------------------------------- chunk by chunk


def _place_on_grid(log: xr.Dataset, name: str, clock: Clock, reach: float, choose: _Choose) -> Any:
    """Return the samples of a channel on the gyro's grid; lazy, in its chunks, if the log is.

    NaN where no value is within reach [ns].
    """
    start, rate, size = first_stamp(log), float(log.attrs["sampling_rate_hz"]), log.sizes["time"]

    def place_values(values: Any, offset: int, low: int, high: int) -> Floats:
        numbers = np.asarray(values, dtype=np.float64)
        stamps = clock.stamps_between(offset, offset + numbers.size)
        good = np.isfinite(numbers)
        if not good.any():
            return np.full(high - low, np.nan)
        instants = grid_times(start, rate, np.arange(low, high))
        return np.asarray(choose(instants, stamps[good], numbers[good], reach))

    signal, data = log[signal_name(log)].transpose("axis", "time").data, log[name].data
    edges = [*range(0, size, _CHUNK_SAMPLES), size]
    if hasattr(signal, "chunks"):
        edges = np.concatenate([[0], np.cumsum(signal.chunks[1])]).tolist()
    pieces = []
    for low, high in pairwise(edges):  # the values that the samples need, and one on either side
        first, last = (int(edge) for edge in grid_times(start, rate, [low, high - 1]))
        begin = max(int(clock.count_before(first - int(reach))) - 1, 0)
        end = min(int(clock.count_before(last + int(reach))) + 1, clock.size)
        pieces.append((data[begin:end], begin, low, high))
    if isinstance(signal, np.ndarray) and isinstance(data, np.ndarray):
        return np.concatenate([place_values(*piece) for piece in pieces])
    import dask
    import dask.array as da

    lazily = dask.delayed(place_values, pure=False)
    return da.concatenate(
        [da.from_delayed(lazily(*piece), (piece[3] - piece[2],), np.float64) for piece in pieces]
    )


def _take_nearest(instants: Ints, stamps: Ints, values: Floats, reach: float) -> Floats:
    """Return the nearest value of each instant, NaN beyond reach."""
    place = np.searchsorted(stamps[1:] + stamps[:-1], 2 * instants)
    return np.where(np.abs(instants - stamps[place]) <= reach, values[place], np.nan)


def interpolate_linearly(
    instants: Ints, stamps: Ints, values: Floats, reach: float, *, hold_previous: bool
) -> Floats:
    """Interpolate linearly, or hold the previous value; NaN across gaps longer than reach."""
    high = np.minimum(np.searchsorted(stamps, instants), stamps.size - 1)
    low = np.where(stamps[high] == instants, high, np.maximum(high - 1, 0))
    inside = (stamps[low] <= instants) & (instants <= stamps[high])
    within_reach = inside & (stamps[high] - stamps[low] <= reach)
    share = (instants - stamps[low]) / np.maximum(stamps[high] - stamps[low], 1)
    line = values[low] + (0.0 if hold_previous else share) * (values[high] - values[low])
    return np.where(within_reach, line, np.nan)


def _average_around(
    instants: Ints, stamps: Ints, values: Floats, reach: float, *, period: float
) -> Floats:
    """Return the mean of the values within half a period of the gyro of each instant."""
    edges = np.append(instants, instants[-1] + round(period)) - round(period / 2.0)
    place = np.searchsorted(edges, stamps, side="right") - 1
    inside = (place >= 0) & (place < instants.size)
    total = np.bincount(place[inside], weights=values[inside], minlength=instants.size)
    count = np.bincount(place[inside], minlength=instants.size)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / count)

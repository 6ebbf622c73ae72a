"""Find the uniform grid of explicit stamps: its rate, and the missing samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import TimeError
from gyrostab.ingest.limits import is_absurd_grid
from gyrostab.time.grid import grid_index
from gyrostab.time.stamps import NANOSECONDS

#: Stamps in memory at one time.
BLOCK_STAMPS = 2**20
#: Largest distance of a stamp from its grid sample [samples]. It allows for rounded stamps, and
#: bounds the error of two pieces that are a fraction of a sample apart: the rate over n samples is
#: off by 0.1 / n. `gyrostab.regularise` accepts more, with a note.
MAX_DEPARTURE_SAMPLES = 0.1

_NAT = np.iinfo(np.int64).min
_ADVICE = (
    "put the samples on a uniform time axis with gyrostab.from_dataarray, or interpolate "
    "them onto one with log.interp(time=...)"
)

#: First stamp, stamp after the last one -> stamps [ns since 1970].
ReadStamps = Callable[[int, int], NDArray[np.int64]]


class UniformGrid(NamedTuple):
    """Samples at ``start + round(n * 1e9 / rate)`` ns; `runs`: sample, stamp, length."""

    start: int
    rate: float
    size: int
    runs: NDArray[np.int64]


class _Steps(NamedTuple):
    """Statistics of the steps between stamps [ns]."""

    span: int
    smallest: int
    median: float


def find_grid(read: ReadStamps, count: int, *, nominal: float | None = None) -> UniformGrid:
    """Find the slowest uniform grid that contains every stamp, reading them in blocks.

    `nominal` is the sampling rate that the log declares [Hz]; it is only a candidate, the stamps
    decide. `TimeError` when stamps are missing, repeated, out of order or not uniform.

    Examples
    --------
    >>> stamps = np.array([0, 10, 20, 50, 60]) * 10**6
    >>> grid = find_grid(lambda a, b: stamps[a:b], 5)
    >>> grid.rate, grid.size, grid.runs.tolist()
    (100.0, 7, [[0, 0, 3], [5, 3, 2]])
    """
    start = int(read(0, 1)[0])
    steps = _measure_steps(read, count)
    if count == 1:
        if nominal is None:
            raise TimeError(
                "the log has one sample and no attribute 'sampling_rate_hz': its sampling rate "
                "is not known"
            )
        return UniformGrid(start, nominal, 1, np.array([[0, 0, 1]], dtype=np.int64))
    bases = [steps.median, float(steps.smallest)]
    if nominal is not None and 0 < nominal < math.inf:
        bases.insert(0, NANOSECONDS / nominal)
    for base in bases:
        fit = _fit_period(read, count, steps.span, base)
        if fit is None:
            continue
        period, samples = fit
        placed = _place_stamps(read, count, start, NANOSECONDS / period)
        if placed is None:
            continue
        slack_ns = 2 * placed[0] * period + 1  # error of the period from the ends of the record
        for rate in _plain_rates(period, samples, slack_ns, nominal):
            plain = _place_stamps(read, count, start, rate)
            if plain is not None:
                return _checked_size(UniformGrid(start, rate, samples + 1, plain[1]), count, steps)
    longest_step = max(int(np.diff(stamps).max()) for _, stamps in _stamp_blocks(read, count))
    shortest, longest = steps.smallest / NANOSECONDS, longest_step / NANOSECONDS
    raise TimeError(
        f"the time of the log is not uniform: its steps of {shortest:.9g} s to {longest:.9g} s "
        "fit no sampling rate, even with samples "
        f"missing; {_ADVICE}"
    )


def _stamp_blocks(read: ReadStamps, count: int) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield blocks of stamps, each with the last stamp of the previous block."""
    for begin in range(0, max(count - 1, 1), BLOCK_STAMPS):
        yield begin, read(begin, min(begin + BLOCK_STAMPS + 1, count))


def _measure_steps(read: ReadStamps, count: int) -> _Steps:
    """Check that the stamps increase, and measure their steps."""
    smallest, medians, first, last = np.iinfo(np.int64).max, [], 0, 0
    for begin, stamps in _stamp_blocks(read, count):
        if np.any(stamps == _NAT):
            raise TimeError(
                f"sample {begin + int(np.argmax(stamps == _NAT))} of the log has no time (NaT); "
                "drop it: log.dropna('time')"
            )
        first = int(stamps[0]) if begin == 0 else first
        last = int(stamps[-1])
        steps = np.diff(stamps)
        if np.any(steps <= 0):
            at = int(np.argmax(steps <= 0))
            raise TimeError(_describe_disorder(begin + at, int(stamps[at]), int(stamps[at + 1])))
        if steps.size:
            smallest = min(smallest, int(steps.min()))
            medians.append(float(np.median(steps)))
    return _Steps(last - first, smallest, float(np.median(medians)) if medians else 0.0)


def _describe_disorder(place: int, before: int, after: int) -> str:
    """Describe which two samples are out of order."""
    first, second = (str(np.datetime64(stamp, "ns")) for stamp in (before, after))
    if before == after:
        return (
            f"samples {place} and {place + 1} of the log have the same time, {first}; keep one "
            "of each: log.drop_duplicates('time')"
        )
    return (
        f"the time of the log runs backwards: sample {place} is at {first} and sample {place + 1} "
        f"at {second}; sort it, "
        "log.sortby('time'), or give overlapping logs to gyrostab.read_log, which joins them"
    )


def _fit_period(read: ReadStamps, count: int, span: int, base: float) -> tuple[float, int] | None:
    """Fit the period [ns] near `base` or a multiple of it; return period and number of steps."""
    unit_sum = unit_count = 0
    for _, stamps in _stamp_blocks(read, count):
        steps = np.diff(stamps)
        single = np.rint(steps / base) == 1
        unit_sum, unit_count = unit_sum + int(steps[single].sum()), unit_count + int(single.sum())
    period = unit_sum / unit_count if unit_count else base
    samples = divisor = 0
    for _, stamps in _stamp_blocks(read, count):
        number = np.rint(np.diff(stamps) / period).astype(np.int64)
        if number.min() < 1:
            return None
        samples += int(number.sum())
        divisor = math.gcd(divisor, int(np.gcd.reduce(number)))
    samples //= divisor
    return span / samples, samples


def _place_stamps(
    read: ReadStamps, count: int, start: int, rate: float
) -> tuple[float, NDArray[np.int64]] | None:
    """Return largest distance from the grid [samples] and runs; None if it is too large."""
    worst, firsts, samples = 0.0, [np.zeros(1, np.int64)], [np.zeros(1, np.int64)]
    for begin, stamps in _stamp_blocks(read, count):
        position = grid_index(start, rate, stamps)
        sample = np.rint(position).astype(np.int64)
        worst = max(worst, float(np.abs(position - sample).max()))
        step = np.diff(sample)
        if worst > MAX_DEPARTURE_SAMPLES or np.any(step < 1):
            return None
        at = np.flatnonzero(step > 1) + 1
        firsts.append(at + begin)
        samples.append(sample[at])
    first, sample = np.concatenate(firsts), np.concatenate(samples)
    return worst, np.stack([sample, first, np.diff(np.append(first, count))], axis=1)


def _plain_rates(
    period: float, samples: int, slack_ns: float, nominal: float | None
) -> Iterator[float]:
    """Yield rates [Hz] that agree with a period within `slack_ns`, plain numbers first."""
    rate = NANOSECONDS / period
    candidates = [] if nominal is None else [nominal / max(1, round(nominal / rate))]
    for digits in range(1, 16):
        candidates += [NANOSECONDS / float(f"{period:.{digits}g}"), float(f"{rate:.{digits}g}")]
    yield from (
        plain for plain in candidates if abs(NANOSECONDS / plain - period) * samples <= slack_ns
    )
    yield rate


def _checked_size(grid: UniformGrid, count: int, steps: _Steps) -> UniformGrid:
    """Refuse a grid that is almost empty."""
    if is_absurd_grid(grid.size, count):
        begin, end = (np.datetime64(stamp, "ns") for stamp in (grid.start, grid.start + steps.span))
        raise TimeError(
            f"the log has {count} samples from {begin} to {end}, which at {grid.rate:.9g} Hz "
            f"would be {grid.size}: cut it into pieces, "
            f"log.sel(time=slice(...)), or {_ADVICE}"
        )
    return grid

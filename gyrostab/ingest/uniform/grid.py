"""Find the uniform grid of explicit stamps: its rate, and the missing samples."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gyrostab.arrays import Ints
from gyrostab.errors import TimeError
from gyrostab.ingest.limits import is_absurd_grid
from gyrostab.time.grid import grid_index
from gyrostab.time.stamps import NANOSECONDS

#: Largest distance of a stamp from its grid sample [samples]. It allows for rounded stamps, and
#: bounds the error of two pieces that are a fraction of a sample apart: the rate over n samples is
#: off by 0.1 / n. `gyrostab.regularise` accepts more, with a note.
MAX_DEPARTURE_SAMPLES = 0.1

_NAT = np.iinfo(np.int64).min
_ADVICE = (
    "put the samples on a uniform time axis with gyrostab.from_dataarray, or interpolate "
    "them onto one with log.interp(time=...)"
)


class UniformGrid(NamedTuple):
    """Samples at ``start + round(n * 1e9 / rate)``, and those of a log that are placed on them."""

    start: int  # stamp of sample 0 [ns since 1970]
    rate: float  # [Hz]
    size: int
    #: (n, 3): first sample of the grid, first sample of the log, length.
    runs: Ints


def find_grid(stamps: Ints, *, nominal: float | None = None) -> UniformGrid:
    """Find the slowest uniform grid that contains every stamp [ns since 1970].

    `nominal` is the sampling rate that the log declares [Hz]; it is only a candidate, the stamps
    decide. `TimeError` when stamps are missing, repeated, out of order or not uniform.

    Examples
    --------
    >>> grid = find_grid(np.array([0, 10, 20, 50, 60]) * 10**6)
    >>> grid.rate, grid.size, grid.runs.tolist()
    (100.0, 7, [[0, 0, 3], [5, 3, 2]])
    """
    _check_order(stamps)
    start, span, steps = int(stamps[0]), int(stamps[-1] - stamps[0]), np.diff(stamps)
    if stamps.size == 1:
        if nominal is None:
            raise TimeError(
                "the log has one sample and no attribute 'sampling_rate_hz': its sampling rate "
                "is not known"
            )
        return UniformGrid(start, nominal, 1, np.array([[0, 0, 1]], dtype=np.int64))
    bases = [float(np.median(steps)), float(steps.min())]
    if nominal is not None and 0 < nominal < math.inf:
        bases.insert(0, NANOSECONDS / nominal)
    for base in bases:
        samples = _count_samples(steps, base)
        if not samples:
            continue
        period = span / samples
        placed = _place_stamps(stamps, NANOSECONDS / period)
        if placed is None:
            continue
        slack_ns = 2 * placed[0] * period + 1  # error of the period from the ends of the record
        for rate in _plain_rates(period, samples, slack_ns, nominal):
            plain = _place_stamps(stamps, rate)
            if plain is not None:
                return _checked_size(UniformGrid(start, rate, samples + 1, plain[1]), stamps)
    shortest, longest = steps.min() / NANOSECONDS, steps.max() / NANOSECONDS
    raise TimeError(
        f"the time of the log is not uniform: its steps of {shortest:.9g} s to {longest:.9g} s "
        "fit no sampling rate, even with samples "
        f"missing; {_ADVICE}"
    )


def _check_order(stamps: Ints) -> None:
    """Refuse stamps that are missing or do not increase."""
    if np.any(stamps == _NAT):
        raise TimeError(
            f"sample {int(np.argmax(stamps == _NAT))} of the log has no time (NaT); drop it: "
            "log.dropna('time')"
        )
    behind = np.diff(stamps) <= 0
    if behind.any():
        at = int(np.argmax(behind))
        first, second = (str(np.datetime64(int(stamp), "ns")) for stamp in stamps[at : at + 2])
        if first == second:
            raise TimeError(
                f"samples {at} and {at + 1} of the log have the same time, {first}; keep one "
                "of each: log.drop_duplicates('time')"
            )
        raise TimeError(
            f"the time of the log runs backwards: sample {at} is at {first} and sample {at + 1} "
            f"at {second}; sort it, "
            "log.sortby('time'), or give overlapping logs to gyrostab.read_log, which joins them"
        )


def _count_samples(steps: Ints, base: float) -> int:
    """Count the samples for a period near `base` [ns] or a multiple of it; 0 if it is too long."""
    single = steps[np.rint(steps / base) == 1]
    period = int(single.sum()) / single.size if single.size else base
    numbers = np.rint(steps / period).astype(np.int64)
    return 0 if numbers.min() < 1 else int(numbers.sum() // np.gcd.reduce(numbers))


def _place_stamps(stamps: Ints, rate: float) -> tuple[float, Ints] | None:
    """Return largest distance from the grid [samples] and runs; None if it is too large."""
    position = grid_index(int(stamps[0]), rate, stamps)
    sample = np.rint(position).astype(np.int64)
    worst, step = float(np.abs(position - sample).max()), np.diff(sample)
    if worst > MAX_DEPARTURE_SAMPLES or np.any(step < 1):
        return None
    first = np.concatenate([[0], np.flatnonzero(step > 1) + 1])
    return worst, np.stack([sample[first], first, np.diff(np.append(first, stamps.size))], axis=1)


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


def _checked_size(grid: UniformGrid, stamps: Ints) -> UniformGrid:
    """Refuse a grid that is almost empty."""
    if is_absurd_grid(grid.size, stamps.size):
        begin, end = (np.datetime64(int(stamp), "ns") for stamp in stamps[[0, -1]])
        raise TimeError(
            f"the log has {stamps.size} samples from {begin} to {end}, which at {grid.rate:.9g} Hz "
            f"would be {grid.size}: cut it into pieces, "
            f"log.sel(time=slice(...)), or {_ADVICE}"
        )
    return grid

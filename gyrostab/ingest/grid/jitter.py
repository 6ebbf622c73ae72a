"""Rows with noisy stamps: the period that explains them best, and the place of every row in order.

A stamp that is the time of arrival tells the time of its sample up to jitter, but thousands of
stamps tell the sampling period to parts per million and the number of lost samples exactly. Rows
stay in order; `gyrostab.kernels.grid.course` finds where samples are missing. Where rows arrive in
packets, or a slow clock gives many rows one stamp, only one row of each group is looked at.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gyrostab.kernels.grid.course import follow
from gyrostab.kernels.grid.stamps import NO_STAMP, piece_sums

__all__ = [
    "GAIN",
    "MIN_SIGMA",
    "TRACE_ROWS",
    "Integers",
    "JitterModel",
    "count_samples",
    "fit_jitter",
    "fit_jitter_near",
    "observe_rows",
]


Integers = NDArray[np.int64]


ObservedStamps = tuple[Integers, Integers]


#: Standard deviation of the jitter that the kernel is given at least [samples].
MIN_SIGMA = 0.1


#: Share of a deviation that the phase takes over, while the period is sought, and once it is known.
#: A sample that is not found missing
#: costs 1 / (4 gain sigma^2) nats before the phase has taken it over: 140 at a scatter of 0.6,
#: against 5 for the loss and 30 for a row
#: that has no sample.
_SEARCH_GAIN, GAIN = 0.02, 0.005


#: Beyond this scatter [samples] those are less than 80.
_MAX_SIGMA = 0.8


#: Share of rows without a sample, and cost of a row [nats], beyond which stamps have no course.
#: Jitter alone costs 0.5 nats, and every
#: second sample missing at random 2.5 more.
_MAX_DROPPED_SHARE, _MAX_NATS = 0.01, 3.0


#: Rows that a course is sought in, candidates for its period, and those of them that are refined.
_SEARCH_ROWS, _MAX_CANDIDATES, _MAX_REFINED = 8_000, 200, 4


#: A period wrong by half of this share lags by a fortieth of a sample behind the phase, which
#: follows with a gain of 0.02.
_PERIOD_STEP = 0.001


TRACE_ROWS = 1 << 13


@dataclass(frozen=True)
class JitterModel:
    """How noisy stamps follow the samples.

    Attributes
    ----------
    period : float
        Sampling period [ns].
    sigma : float
        Standard deviation of the jitter [samples].
    observe : str
        Rows whose stamps are looked at: ``"all"``, the ``"first"`` or the ``"last"`` of each group
        of rows with one stamp.
    group : float
        Rows to one that is looked at.
    nats : float
        Cost of a row.
    fits : bool
        Few rows have no sample, some steps are single ones, and the cost is that of jitter.
    """

    period: float
    sigma: float
    observe: str
    group: float
    nats: float
    fits: bool = True

    @property
    def code_length(self) -> float:
        """Nats that it takes to write a stamp down: those of its course, and of its deviation to the nanosecond."""
        return self.nats + float(np.log(max(self.sigma, MIN_SIGMA) * self.period))

    @classmethod
    def of_sharp(cls, period: float) -> JitterModel:
        """Make the course of stamps that scatter by less than a tenth of a sample."""
        return cls(period, MIN_SIGMA, "all", 1.0, 0.5)


def observe_rows(stamps: Integers, observe: str, period: float) -> Integers:
    """Find the rows whose stamps are looked at; of the last group of a block, the end is not known and taken to be its last row."""
    known = np.flatnonzero(stamps != NO_STAMP)
    if observe == "all" or len(known) == 0:
        return known
    apart = np.diff(stamps[known]) > 0.5 * period
    edge = np.ones(1, dtype=bool)
    return np.asarray(known[np.concatenate([edge, apart] if observe == "first" else [apart, edge])])


def fit_jitter(
    parts: list[Integers], guesses: list[float], observe: str, *, sure: float
) -> JitterModel | None:
    """Find the period [ns] that explains stretches of stamps best, each row being the next sample but for rare losses.

    Parameters
    ----------
    parts : list of ndarray of int64
        Stretches of stamps [ns], all readable.
    guesses : list of float
        Periods [ns] to try in addition to those of the stretches themselves.
    observe : str
        See `JitterModel`.
    sure : float
        Samples over which a first estimate of the period is trusted to count.

    Returns
    -------
    Course or None
        None where nothing explains the stamps.
    """
    seen = _observe_parts(parts, observe, guesses[0])
    lengths = (
        (32, 16) if observe == "all" else (8,)
    )  # few groups in a row are whole where samples are lost
    lines = next(filter(None, (_fit_lines(seen, length) for length in lengths)), None)
    if lines is None or not (lines[0] > 0).any():
        return None
    slope, scatter = (values[lines[0] > 0] for values in lines)
    sigma_ns = float(np.median(scatter))
    group = _rows_per_group(seen)
    if sigma_ns > _MAX_SIGMA * float(np.median(slope)):
        return None
    sure *= max(1.0, group)
    periods = _candidate_periods(seen, slope, group)
    sample = _shorten_parts(seen, _SEARCH_ROWS)
    best = sorted(periods, key=lambda period: _row_cost(sample, period, sigma_ns, sure))[
        :_MAX_REFINED
    ]
    started = [
        *((period, sigma_ns / period) for period in best),
        *((guess, MIN_SIGMA) for guess in guesses),
    ]
    found = [
        _refine_model(seen, JitterModel(period, sigma, observe, group, np.inf), sure)
        for period, sigma in started
    ]
    explained = min(filter(None, found), key=lambda course: course.code_length, default=None)
    return (
        explained if explained is not None and explained.fits else None
    )  # the best may be stamps of rows that are given twice


def fit_jitter_near(
    parts: list[Integers], period: float, observe: str, *, sure: float
) -> JitterModel | None:
    """Give the course with a period near the one given [ns], None where the stamps do not follow it."""
    seen = _observe_parts(parts, observe, period)
    group = _rows_per_group(seen)
    found = _refine_model(
        seen,
        JitterModel(period, 0.5, observe, group, np.inf),
        sure * max(1.0, group),
        most_off=0.02,
    )
    return found if found is not None and found.fits else None


def _rows_per_group(seen: list[ObservedStamps]) -> float:
    """Rows to one that is looked at."""
    return float(
        sum(count[-1] - count[0] for count, _ in seen)
        / max(1, sum(len(count) - 1 for count, _ in seen))
    )


def _observe_parts(parts: list[Integers], observe: str, period: float) -> list[ObservedStamps]:
    taken = []
    for part in parts:
        rows = observe_rows(part, observe, period)[1:-1]
        if len(rows) > 1:
            taken.append((rows, part[rows]))
    return taken


def _fit_lines(
    seen: list[ObservedStamps], length: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Fit lines to stretches of `length` stamps: slopes [ns a row], standard deviations of the residuals [ns]."""
    tables = []
    for count, stamps in seen:
        if len(count) >= length:
            first = np.arange(0, len(count) - length + 1, length // 2)
            at = first[:, None] + np.arange(length)
            tables.append(
                np.stack([count[at] - count[first, None], stamps[at] - stamps[first, None]]).astype(
                    np.float64
                )
            )
    if not tables:
        return None
    count, stamps = np.concatenate(tables, axis=1)
    count -= count.mean(axis=1, keepdims=True)
    stamps -= stamps.mean(axis=1, keepdims=True)
    slope = (count * stamps).sum(axis=1) / (count**2).sum(axis=1)
    rest = stamps - slope[:, None] * count
    return slope, np.sqrt((rest**2).sum(axis=1) / (length - 2))


def _candidate_periods(
    seen: list[ObservedStamps], slope: NDArray[np.float64], group: float
) -> list[float]:
    """Periods [ns] around the slopes of stretches; losses make slopes larger, so the period is among the smaller ones."""
    longer = _fit_lines(seen, 128)
    slopes = longer[0] if longer is not None and len(longer[0]) >= 16 and group < 2 else slope
    slopes = slopes[slopes > 0.2 * np.median(slope)]
    low, high = np.quantile(slopes, [0.05, 0.6])
    low, high = low * 0.995, max(high * 1.005, np.median(slope))
    steps = int(min(np.ceil(np.log(high / low) * group / _PERIOD_STEP), _MAX_CANDIDATES)) + 1
    return [float(period) for period in np.geomspace(low, high, steps)]


def _shorten_parts(seen: list[ObservedStamps], rows: int) -> list[ObservedStamps]:
    most = max(64, rows // len(seen))
    return [(count[:most], stamps[:most]) for count, stamps in seen]


def _row_cost(seen: list[ObservedStamps], period: float, sigma_ns: float, sure: float) -> float:
    """Cost of a row [nats] with a period [ns]."""
    sigma = max(sigma_ns / period, MIN_SIGMA)
    total = sum(
        follow(count, stamps, period, sigma, _SEARCH_GAIN, sure * period, TRACE_ROWS)[3]
        for count, stamps in seen
    )
    return float(total / sum(len(count) for count, _ in seen))


def _refine_model(
    seen: list[ObservedStamps], course: JitterModel, sure: float, *, most_off: float = 0.05
) -> JitterModel | None:
    """Fit period and scatter along the course; None where it is none."""
    if not seen:
        return None
    period, sigma = course.period, course.sigma
    for gain in (_SEARCH_GAIN, _SEARCH_GAIN / 2, GAIN, GAIN):
        cc = ct = nats = rows = dropped = single = steps = 0.0
        offs = []
        for count, stamps in seen:
            known = max(sigma, MIN_SIGMA)
            sample, piece, off, cost = follow(
                count, stamps, period, known, gain, sure * period, TRACE_ROWS
            )
            near = _is_near(off, sigma)
            sums = piece_sums(stamps[near], sample[near], piece[near], period)
            cc, ct = cc + sums[:, 3].sum(), ct + sums[:, 4].sum()
            nats, rows = nats + cost, rows + len(count)
            step, whole = np.diff(sample)[np.diff(piece) == 0], np.diff(count)[np.diff(piece) == 0]
            dropped += (np.maximum(whole - step, 0)).sum()
            single, steps = single + (step == whole).sum(), steps + len(step)
            offs.append(off)
        if cc <= 0:
            return None
        period = float(ct / cc)
        sigma = 1.4826 * float(np.median(np.abs(np.concatenate(offs))))
        if not abs(period / course.period - 1) < most_off or sigma > 2 * _MAX_SIGMA:
            return None
    fits = (
        sigma < _MAX_SIGMA
        and dropped <= 2 + _MAX_DROPPED_SHARE * rows
        and nats < _MAX_NATS * rows
        and single > 0.1 * steps
    )
    return JitterModel(period, sigma, course.observe, course.group, nats / rows, fits)


def _is_near(off: NDArray[np.float64], sigma: float) -> NDArray[np.bool_]:
    """Whether stamps are no outliers: late rows must not pull the period."""
    return np.asarray(np.abs(off) <= 4 * max(sigma, MIN_SIGMA))


def count_samples(
    rows: Integers, stamps: Integers, course: JitterModel, longest: float
) -> tuple[Integers, Integers, Integers]:
    """Stamps [ns], sample numbers and numbers of the piece of the rows of a block that are looked at, without outliers."""
    at = observe_rows(stamps, course.observe, course.period)
    if course.observe != "all":
        at = at[1:-1]  # the groups at both ends may be cut
    sample, piece, off, _ = follow(
        rows[at],
        stamps[at],
        course.period,
        max(course.sigma, MIN_SIGMA),
        GAIN,
        longest,
        TRACE_ROWS,
    )
    near = _is_near(off, course.sigma)
    return stamps[at][near], sample[near], piece[near]

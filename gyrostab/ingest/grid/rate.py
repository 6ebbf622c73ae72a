"""The sampling rate that a file's stamps stand for.

Two hypotheses. *Lattice*: stamps lie near multiples of a period, with jitter, rounding, and rows
missing or doubled; the row's place follows from its stamp. *Counted*: stamps tell when the rows
arrived (in bursts) or are shared by many rows (whole seconds); only the number of rows over a long
stretch tells the rate, and the row's place is its count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import TimeError
from gyrostab.ingest.grid.jitter import JitterModel, fit_jitter, fit_jitter_near
from gyrostab.ingest.grid.period_fit import fit_pieces, longest_step, pool_pieces
from gyrostab.ingest.grid.starting_period import (
    SHARED_SHARE,
    period_of_lines,
    rms_misfit,
    starting_period,
    step_scatter,
)
from gyrostab.ingest.grid.steps import finer_period
from gyrostab.ingest.grid.stretches import SECOND, Stamps, recut_blocks, sample_stretches
from gyrostab.kernels.grid.stamps import NO_STAMP

__all__ = ["RateEstimate", "deviating_stretches", "estimate_near", "estimate_rate", "is_far_worse"]


_MAX_TRUSTED_SAMPLES = 500.0  # samples, of a long log


# share of steps backwards that no jitter makes: 0.12 at a scatter of 0.6 samples, 0.5 in random
# order
_MAX_BACKWARD_SHARE = 0.35


_MIN_SINGLE_SHARE = 0.1  # share of the steps that must be one sample of a rate that is given


#: Scatter of the steps about whole samples up to which single stamps tell the sample: jitter of
#: 0.08 samples, so that half a sample is
#: 6 standard deviations.
_SHARP_SCATTER = 0.12


_FAR_WORSE_NATS = 0.2  # a row


_BLOCK = 1 << 20


@dataclass(frozen=True)
class RateEstimate:
    """A sampling rate and how it was found.

    Attributes
    ----------
    rate : float
        Sampling rate [Hz].
    stderr : float
        Its standard error [Hz].
    counted : bool
        Rows are placed by their count, not by their stamps.
    coarse : bool
        Many rows share one stamp.
    raw : float
        The rate before it was rounded to a plain number [Hz].
    even : float or None
        Rate [Hz] that the stamps would have if no rows were missing that seem to be missing again
        and again; None where none do.
    finer : float or None
        Rate [Hz] that the stamps would have if the same rows were missing again and again; None
        where nothing speaks for one.
    course : Course or None
        How the stamps scatter about the samples, where single stamps do not tell the sample but
        many together do.
    """

    rate: float
    stderr: float
    counted: bool
    coarse: bool
    raw: float
    even: float | None = None
    finer: float | None = None
    course: JitterModel | None = None


def _round_rate(rate: float, error: float, samples: float, counted: bool) -> float:
    """Take a number that people would have chosen, when the estimate cannot tell it from itself."""
    room = error if counted else min(error, 0.5 * rate / max(samples, 1.0))
    candidates = [float(round(rate))] if rate > 0.5 else []
    period_ms = 1000.0 / rate
    if period_ms >= 1.5:
        candidates.append(1000.0 / round(period_ms))
    candidates += [round(rate, digits) for digits in (1, 2, 3)]
    for candidate in candidates:
        if candidate > 0 and abs(candidate - rate) <= room:
            return candidate
    return float(f"{rate:.13g}")


def estimate_rate(stamps: Stamps, *, where: str) -> RateEstimate:
    """Find the sampling rate from the stamps.

    Parameters
    ----------
    stamps : callable
        Gives an iterator over blocks of (row numbers, stamps [ns]).
    where : str
        The file, for messages.

    Returns
    -------
    RateEstimate

    Raises
    ------
    TimeError
        When there are not two different stamps, or time runs backwards.

    Examples
    --------
    >>> stamps = np.rint(np.arange(1000) * 1e3 / 300).astype(np.int64) * 1_000_000  # 300 Hz, written to the millisecond
    >>> estimate_rate(lambda: iter([(np.arange(1000), stamps)]), where="tool.csv").rate
    300.0
    """
    stamps = partial(recut_blocks, stamps, _BLOCK)
    parts = sample_stretches(stamps)
    if not parts:
        raise TimeError(
            f"{where}: there is only one sample with a readable stamp, so no sampling rate can be found; give it with --rate HZ"
        )
    steps = np.concatenate([np.diff(part) for part in parts])
    backwards = float((steps < 0).mean())
    if not (steps > 0).any() or backwards > _MAX_BACKWARD_SHARE:
        what = (
            "time runs backwards"
            if backwards > 1 - _MAX_BACKWARD_SHARE
            else "the rows are in no order of time"
            if backwards
            else "all stamps are the same"
        )
        raise TimeError(
            f"{where}: {what} throughout; check the time column and its unit, or leave it out (--map) and give --rate HZ"
        )
    period, counted, coarse = starting_period(parts)
    sure = _trusted_samples(len(steps))
    finer = None if counted else finer_period(parts, period)
    lost = None if finer is None else _estimate_sharp(stamps, parts, SECOND / finer)
    if lost is not None:
        return replace(lost, even=_mean_rate(parts))
    if (
        counted
        or step_scatter(steps, period) > _SHARP_SCATTER
        or np.mean(steps == 0) >= SHARED_SHARE
    ):
        course = _fit_jitter(parts, period, coarse, sure)
        if course is not None:
            return _estimate_with_jitter(stamps, course, coarse, sure)
    longest = longest_step(parts, period) if counted else sure * period
    estimate = _estimate_pooled(
        fit_pieces(stamps, period, counted, coarse, longest), period, counted, coarse
    )
    return estimate if finer is None else replace(estimate, finer=float(f"{SECOND / finer:.4g}"))


def _fit_jitter(
    parts: list[NDArray[np.int64]], period: float, coarse: bool, sure: float
) -> JitterModel | None:
    """Find the course of noisy stamps: of all rows, or of one row of each group.

    A row with the stamp of the row before is the next sample, which arrived together with it, or
    the same sample given twice. Where few rows are of that kind, both readings are tried, and the
    one that tells a stamp in fewer nats is right. The wrong one has a row without a sample, or a
    loss, wherever two rows share a stamp, or a wrong period.
    """
    if not coarse:
        once = [part[np.append(np.diff(part) != 0, True)] for part in parts]
        rows, apart = sum(map(len, parts)), sum(map(len, once))
        readings = [parts, once] if (1 - SHARED_SHARE) * rows < apart < rows else [parts]
        found = [fit_jitter(reading, [period], "all", sure=sure) for reading in readings]
        best = min(filter(None, found), key=attrgetter("code_length"), default=None)
        if best is not None:
            return best
    return fit_jitter(parts, [period], "first" if coarse else "last", sure=sure)


def _estimate_with_jitter(
    stamps: Stamps, course: JitterModel, coarse: bool, sure: float
) -> RateEstimate:
    """The rate from the whole course of noisy stamps."""
    longest = sure * course.period * max(1.0, course.group)
    pieces = fit_pieces(stamps, course.period, False, False, longest, course)
    return replace(
        _estimate_pooled(pieces, course.period, False, False), coarse=coarse, course=course
    )


def _mean_rate(parts: list[NDArray[np.int64]]) -> float:
    """Rows in a second, those without pauses."""
    rates = [
        SECOND * (len(part) - 1) / (part[-1] - part[0]) for part in parts if part[-1] > part[0]
    ]
    return float(f"{np.median(rates):.4g}")


def _trusted_samples(steps: int) -> float:
    """Samples over which a first estimate of the period, from so many steps, is trusted to count."""
    return min(_MAX_TRUSTED_SAMPLES, max(5.0, steps / 20))


def _estimate_pooled(
    pieces: NDArray[np.float64], period: float, counted: bool, coarse: bool
) -> RateEstimate:
    period, error, samples = pool_pieces(pieces, period, counted and not coarse)
    rate = SECOND / period
    stderr = rate * error / period
    return RateEstimate(
        _round_rate(rate, stderr + 1e-12 * rate, samples, counted and not coarse),
        stderr,
        counted,
        coarse,
        rate,
    )


def estimate_near(stamps: Stamps, rate: float) -> RateEstimate | None:
    """The rate near a nominal one [Hz], where the stamps are samples of it of which some are missing, however regularly.

    They can be samples of `rate` when their steps are whole numbers of its period and some are one
    period, or when rows of that rate with lost samples and jitter explain them (see
    `gyrostab.ingest.grid.jitter`); otherwise the answer is None.

    Examples
    --------
    >>> kept = np.flatnonzero(np.arange(5000) % 5 < 3)
    >>> stamps = lambda: iter([(np.arange(3000), kept * 10_000_000)])
    >>> estimate_rate(stamps, where="tool.csv").rate, estimate_near(stamps, 60.0).rate
    (100.0, 60.0)
    """
    stamps = partial(recut_blocks, stamps, _BLOCK)
    parts = sample_stretches(stamps)
    if not parts:
        return None
    sharp = _estimate_sharp(stamps, parts, rate)
    if sharp is not None:
        return sharp
    sure = _trusted_samples(sum(len(part) - 1 for part in parts))
    for observe in ("all", "last"):
        course = fit_jitter_near(parts, SECOND / rate, observe, sure=sure)
        if course is not None:
            return _estimate_with_jitter(stamps, course, False, sure)
    return None


def is_far_worse(stamps: Stamps, near: RateEstimate, found: RateEstimate) -> bool:
    """Tell whether a rate explains the stamps much worse than the rate found from them: by 20 nats in 100 rows, so by 2000 in 10 000.

    Both are compared along the most likely course of the stamps, also where single stamps tell the
    sample of the rate found.

    Examples
    --------
    >>> stamps = lambda: iter([(np.arange(3000), np.arange(3000) * 10_000_000)])
    >>> is_far_worse(stamps, estimate_near(stamps, 110.0), estimate_rate(stamps, where="tool.csv"))
    True
    """
    theirs = found.course
    if theirs is None and not found.counted:
        parts = sample_stretches(partial(recut_blocks, stamps, _BLOCK))
        theirs = fit_jitter_near(
            parts,
            SECOND / found.raw,
            "all",
            sure=_trusted_samples(sum(len(part) - 1 for part in parts)),
        )
    return (
        near.course is not None
        and theirs is not None
        and near.course.code_length > theirs.code_length + _FAR_WORSE_NATS
    )


def _estimate_sharp(
    stamps: Stamps, parts: list[NDArray[np.int64]], rate: float
) -> RateEstimate | None:
    """The rate near a nominal one [Hz] where steps are whole numbers of its period, and some are one period."""
    period = SECOND / rate
    steps = np.concatenate([np.diff(part) for part in parts]).astype(np.float64)
    single = steps[np.abs(steps / period - 1) < 0.25]
    if (
        len(single) == 0
        or len(single) < _MIN_SINGLE_SHARE * len(steps)
        or rms_misfit(steps, period) > 0.15
    ):
        return None
    if abs(np.median(single) / period - 1) > 0.02:  # another rate, not this one with rows missing
        return None
    return _estimate_pooled(
        fit_pieces(stamps, period, False, False, _trusted_samples(len(steps)) * period),
        period,
        False,
        False,
    )


def deviating_stretches(
    stamps: Stamps, period: float, *, size: int = 1024
) -> list[tuple[int, int, float]]:
    """Stretches whose own rate is more than 2 % off: first row, its stamp [ns], rate [Hz].

    Rows that are merely missing or doubled do not make a stretch odd; steps of another length do.
    """
    found: list[tuple[int, int, float]] = []
    inside = False
    for rows, values in recut_blocks(stamps, 64 * size):
        known = values != NO_STAMP
        rows, values = rows[known], values[known]
        begins, paces = _stretch_paces(values, size)
        far = np.abs(paces / period - 1) >= 0.02
        if not far.any():
            inside = False if len(far) else inside
            continue
        for begin, look in zip(begins.tolist(), far.tolist(), strict=True):
            part = values[begin : begin + size]
            own = period_of_lines([part]) if look else None
            odd = own is not None and abs(own / period - 1) > 0.02
            if odd and not inside and own is not None:
                found.append((int(rows[begin]), int(part[0]), SECOND / own))
            inside = odd
    return found


def _stretch_paces(
    values: NDArray[np.int64], size: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """First row of every stretch of `size` stamps (the last may be shorter), and how far apart its stamps are as a rule [ns]."""
    whole = len(values) // size
    table = np.diff(values[: whole * size].reshape(whole, size)[:, ::16], axis=1)
    paces = np.median(table, axis=1) / 16 if whole else np.empty(0)
    begins = np.arange(whole) * size
    if len(values) - whole * size >= size // 4:
        last = np.median(np.diff(values[whole * size :: 16])) / 16
        begins, paces = np.append(begins, whole * size), np.append(paces, last)
    return begins, paces

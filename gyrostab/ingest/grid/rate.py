"""Find the sampling rate from the stamps of a file.

Two hypotheses. *Stamped*: stamps lie near multiples of a period, with jitter, rounding, and missing
or doubled rows; the stamp of a row gives its sample. *Counted*: stamps are times of arrival (in
bursts) or are shared by many rows (whole seconds); only the number of rows over a long stretch
gives the rate, and the row count gives the sample.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from gyrostab.arrays import Floats, Ints
from gyrostab.errors import TimeError
from gyrostab.ingest.grid.jitter import (
    MIN_SIGMA,
    JitterModel,
    fit_jitter,
    fit_jitter_near,
    fit_pieces,
    longest_step,
    pool_pieces,
)
from gyrostab.ingest.grid.starting_period import (
    LONGEST,
    MIN_TICKS,
    PEAK_WIDTH,
    SECOND,
    SHARED_SHARE,
    Parts,
    Stamps,
    clock_tick,
    comb_peaks,
    fill_stamps,
    find_by_rows,
    find_steps,
    finer_period,
    losses_accumulate,
    packet_rate,
    period_of_lines,
    readable_stamps,
    recut_blocks,
    rms_misfit,
    sample_stretches,
    starting_period,
    step_scatter,
    time_per_row,
    track_period,
)
from gyrostab.kernels.grid.stamps import NO_STAMP

_MAX_TRUSTED_SAMPLES = 500.0  # reached in a long log
# Larger than the share of backward steps by jitter: 0.12 at a scatter of 0.6 samples; random order
# has 0.5.
_MAX_BACKWARD_SHARE = 0.35
_MIN_SINGLE_SHARE = 0.1  # of steps that are one sample of a given rate

#: Largest scatter of the steps about whole samples at which single stamps give the sample: jitter
#: of 0.08 samples, so that half a sample is 6 standard deviations.
_SHARP_SCATTER = 0.12

_FAR_WORSE_NATS = 0.2  # a row

_BLOCK = 1 << 20


@dataclass(frozen=True)
class RateEstimate:
    """A sampling rate, and how it was found."""

    rate: float  # sampling rate [Hz]
    error: float  # three standard errors of it [Hz]
    places_by_count: bool  # whether rows are placed by their count, not by their stamps
    stamps_are_shared: bool  # whether many rows share one stamp
    unrounded: float  # rate before rounding to a plain number [Hz]
    #: Rate [Hz] if the recurring losses found in the stamps are not losses, or if rows arrive in
    #: packets; None without these.
    rate_without_losses: float | None = None
    #: Higher rate [Hz] near whose samples the stamps lie, if rows are missing; None without one.
    rate_with_losses: float | None = None
    #: Jitter of the stamps, if single stamps do not give the sample but many together do.
    jitter: JitterModel | None = None


def _round_rate(rate: float, error: float, samples: float, counted: bool) -> float:
    """Round a rate to a plain number within its error, if there is one."""
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
    """Find the sampling rate from the stamps; `TimeError` if they are all equal or run backwards.

    Examples
    --------
    >>> stamps = np.rint(np.arange(1000) / 0.3).astype(np.int64) * 1_000_000  # 300 Hz in ms
    >>> estimate_rate(lambda: iter([(np.arange(1000), stamps)]), where="tool.csv").rate
    300.0
    """
    stamps, stretches, parts, sure = _sample_stamps(stamps)
    if not parts:
        raise TimeError(
            f"{where}: there is only one sample with a readable stamp, so no sampling rate can "
            "be found; give it with --rate HZ"
        )
    steps = find_steps(parts)
    backwards = float((steps < 0).mean())
    has_order = (steps > 0).any() and backwards <= _MAX_BACKWARD_SHARE
    estimate = _estimate_ordered(stamps, stretches, parts, sure) if has_order else None
    if estimate is None or estimate.rate <= 0.0:
        problem = (
            "time runs backwards"
            if backwards > 1 - _MAX_BACKWARD_SHARE
            else "the rows are in no order of time"
            if backwards
            else "all stamps are the same"
        )
        raise TimeError(
            f"{where}: {problem} throughout; check the time column and its unit, or leave it out "
            "(--map) and give --rate HZ"
        )
    return estimate


def _estimate_ordered(stamps: Stamps, stretches: Parts, parts: Parts, sure: float) -> RateEstimate:
    """Find the sampling rate of stamps that mostly rise; a damaged file may give a negative one."""
    steps = find_steps(parts)
    period, counted, coarse = starting_period(stretches)
    filled = [fill_stamps(stretch) for stretch in stretches]
    finer = None if counted else finer_period(filled, period)
    lost = None if finer is None else _estimate_sharp(stamps, parts, SECOND / finer)
    if lost is not None:
        return replace(lost, rate_without_losses=float(f"{SECOND / time_per_row(stretches):.4g}"))
    is_uneven = step_scatter(steps, period) > _SHARP_SCATTER
    jitter: JitterModel | None = None
    combs: list[tuple[float, float]] = []
    if counted or is_uneven or np.mean(steps == 0) >= SHARED_SHARE:
        peaks = [] if coarse else comb_peaks(parts)
        if peaks and losses_accumulate(parts):
            combs = [peak for peak in peaks if peak[0] > MIN_TICKS * clock_tick(parts)]
        jitter = _fit_jitter(stretches, [(period, MIN_SIGMA), *combs], coarse, sure)
        if jitter is not None:
            finer_rate = _finer_rate(stretches, peaks, jitter, sure)
            estimate = _estimate_with_jitter(stamps, jitter, coarse, sure)
            estimate = replace(estimate, rate_with_losses=finer_rate)
        elif np.mean(steps == 0) >= SHARED_SHARE:  # rows are not doubled: that would fit
            period, counted, coarse = time_per_row(stretches, ticks=True), True, True
    if jitter is None:
        longest = longest_step(parts, period) if counted else sure * period
        estimate = _estimate_pooled(stamps, period, longest, counted=counted, coarse=coarse)
        finer_rate = None if finer is None else float(f"{SECOND / finer:.4g}")
        estimate = replace(estimate, rate_with_losses=finer_rate)
    has_comb = any(abs(SECOND / estimate.unrounded / comb - 1) < PEAK_WIDTH for comb, _ in combs)
    even = None if estimate.places_by_count else packet_rate(stretches, estimate.rate)
    if even is None or not is_uneven or has_comb:
        return replace(estimate, rate_without_losses=even)
    # samples lie near multiples of a period across all pauses, and packets of rows do not
    period = time_per_row(stretches)
    return _estimate_pooled(stamps, period, longest_step(parts, period), counted=True)


def _fit_jitter(
    parts: Parts, guesses: list[tuple[float, float]], coarse: bool, sure: float
) -> JitterModel | None:
    """Fit the jitter of noisy stamps, of all rows or of one row of each group.

    A row with the stamp of the previous row is either the next sample, which arrived together with
    it, or the same sample written twice. If there are few such rows, both hypotheses are tried, and
    the one with the shorter code length is used. The wrong one has a row without a sample, or a
    loss, wherever two rows share a stamp, or a wrong period.
    """
    if not coarse:
        once = [part[np.append(np.diff(part) != 0, True)] for part in parts]
        rows, apart = sum(map(len, parts)), sum(map(len, once))
        readings = [parts, once] if (1 - SHARED_SHARE) * rows < apart < rows else [parts]
        models = [fit_jitter(reading, guesses, "all", sure=sure) for reading in readings]
        best = min(filter(None, models), key=attrgetter("code_length"), default=None)
        if best is not None:
            return best
    return fit_jitter(parts, guesses, "first" if coarse else "last", sure=sure)


def _estimate_with_jitter(
    stamps: Stamps, jitter: JitterModel, coarse: bool, sure: float
) -> RateEstimate:
    """Estimate the rate along the sequence of samples of jittered stamps."""
    longest = sure * jitter.period * max(1.0, jitter.group)
    return _estimate_pooled(stamps, jitter.period, longest, coarse=coarse, jitter=jitter)


def _finer_rate(
    parts: Parts, peaks: list[tuple[float, float]], jitter: JitterModel, sure: float
) -> float | None:
    """Return a higher rate [Hz] that explains the stamps better, with recurring losses."""
    shorter = [period for period, _ in peaks if 1 < jitter.period / period < LONGEST]
    models = [fit_jitter_near(parts, period, "all", sure=sure) for period in shorter]
    best = min(filter(None, models), key=attrgetter("code_length"), default=None)
    if best is None or best.period > 0.9 * jitter.period or best.code_length > jitter.code_length:
        return None
    return float(f"{SECOND / best.period:.4g}")


def _sample_stamps(stamps: Stamps) -> tuple[Stamps, Parts, Parts, float]:
    """Return stamps in even blocks, stretches, their readable stamps, and `_trusted_samples`."""
    stamps = partial(recut_blocks, stamps, _BLOCK)
    stretches = sample_stretches(stamps)
    parts = [readable_stamps(stretch) for stretch in stretches]
    return stamps, stretches, parts, _trusted_samples(parts)


def _trusted_samples(parts: Parts) -> float:
    """Return the samples over which counting by a period from these stretches is reliable."""
    return min(_MAX_TRUSTED_SAMPLES, max(5.0, sum(len(part) - 1 for part in parts) / 20))


def _estimate_pooled(
    stamps: Stamps,
    period: float,
    longest: float,
    *,
    counted: bool = False,
    coarse: bool = False,
    jitter: JitterModel | None = None,
) -> RateEstimate:
    pieces = fit_pieces(stamps, period, counted, coarse, longest, jitter)
    period, error, samples = pool_pieces(pieces, period, counted and not coarse)
    rate = SECOND / period
    rate_error = rate * error / period
    return RateEstimate(
        _round_rate(rate, rate_error + 1e-12 * rate, samples, counted and not coarse),
        rate_error,
        counted,
        coarse,
        rate,
        jitter=jitter,
    )


def estimate_near(stamps: Stamps, rate: float) -> RateEstimate | None:
    """Estimate the rate near a nominal one [Hz], with missing samples; None if impossible.

    It is possible if the steps are whole multiples of the period and some are one period, or if
    rows of that rate with lost samples and jitter explain the stamps (see
    `gyrostab.ingest.grid.jitter`).

    Examples
    --------
    >>> kept = np.flatnonzero(np.arange(5000) % 5 < 3)
    >>> stamps = lambda: iter([(np.arange(3000), kept * 10_000_000)])
    >>> estimate_rate(stamps, where="tool.csv").rate, estimate_near(stamps, 60.0).rate
    (100.0, 60.0)
    """
    stamps, stretches, parts, sure = _sample_stamps(stamps)
    if not parts:
        return None
    sharp = _estimate_sharp(stamps, parts, rate)
    if sharp is not None:
        return sharp
    for observe in ("all", "last"):
        jitter = fit_jitter_near(stretches, SECOND / rate, observe, sure=sure)
        if jitter is not None:
            return _estimate_with_jitter(stamps, jitter, False, sure)
    return None


def is_far_worse(stamps: Stamps, given: RateEstimate, estimated: RateEstimate) -> bool:
    """Return whether a rate explains the stamps worse than the estimated rate by 0.2 nats a row.

    Both are compared along the most likely sequence of samples, also if single stamps give the
    sample at the estimated rate.

    Examples
    --------
    >>> stamps = lambda: iter([(np.arange(3000), np.arange(3000) * 10_000_000)])
    >>> is_far_worse(stamps, estimate_near(stamps, 110.0), estimate_rate(stamps, where="tool.csv"))
    True
    """
    jitter = estimated.jitter
    if jitter is None and not estimated.places_by_count:
        _, stretches, _, sure = _sample_stamps(stamps)
        jitter = fit_jitter_near(stretches, SECOND / estimated.unrounded, "all", sure=sure)
    return (
        given.jitter is not None
        and jitter is not None
        and given.jitter.code_length > jitter.code_length + _FAR_WORSE_NATS
    )


def _estimate_sharp(stamps: Stamps, parts: Parts, rate: float) -> RateEstimate | None:
    """Estimate the rate near a nominal one [Hz] if steps are whole periods, and some are single."""
    period = SECOND / rate
    steps = find_steps(parts)
    single = steps[np.abs(steps / period - 1) < 0.25]
    if (
        len(single) == 0
        or len(single) < _MIN_SINGLE_SHARE * len(steps)
        or rms_misfit(steps, period) > 0.15
    ):
        return None
    if abs(np.median(single) / period - 1) > 0.02:  # a different rate
        return None
    return _estimate_pooled(stamps, period, _trusted_samples(parts) * period)


_STRETCH = 1024  # stretch whose rate is compared with that of the log [stamps]
#: Smallest relative deviation of its rate that is noted. Jitter of 0.2 samples makes 0.0003.
_MIN_DEVIATION = 0.003
_MAX_TRACKED_DEVIATION = 0.02  # largest one at which the samples are counted by the rate of the log


class DeviatingStretch(NamedTuple):
    """Rows whose stamps say another rate than that of the log."""

    first: tuple[int, int]  # row, and its stamp [ns]
    last: tuple[int, int]
    rate: float  # where it begins [Hz]


def deviating_stretches(stamps: Stamps, period: float) -> list[DeviatingStretch]:
    """Find stretches whose rate deviates by more than 0.3 % from one over `period` [ns].

    Only steps of another length count as a deviation, not missing or doubled rows. Within a
    stretch, the rate differs by less than that from the one at its beginning.
    """
    stretches: list[DeviatingStretch] = []
    inside = False
    for rows, values in recut_blocks(stamps, 64 * _STRETCH):
        readable = np.flatnonzero(values != NO_STAMP)
        begins, paces = _stretch_paces(values[readable])
        deviations = np.abs(paces / period - 1)
        if not (deviations >= _MIN_DEVIATION).any():
            inside = False if len(deviations) else inside
            continue
        for begin, deviation in zip(begins.tolist(), deviations.tolist(), strict=True):
            places = readable[begin : begin + _STRETCH]
            part = values[places[0] : places[-1] + 1]
            own_period: float | None = None
            if deviation >= _MAX_TRACKED_DEVIATION:  # steps of 1.25 samples would be losses
                _, own_period = find_by_rows([part], period_of_lines)
            elif deviation >= _MIN_DEVIATION:
                own_period = track_period([values[places]], period)
            is_deviating = own_period is not None and _is_other_period(own_period, period)
            if is_deviating and own_period is not None:
                end = int(rows[places[-1]]), int(part[-1])
                if inside and not _is_other_period(own_period, SECOND / stretches[-1].rate):
                    stretches[-1] = stretches[-1]._replace(last=end)
                else:
                    first = int(rows[places[0]]), int(part[0])
                    stretches.append(DeviatingStretch(first, end, SECOND / own_period))
            inside = is_deviating
    return stretches


def _is_other_period(period: float, other: float) -> bool:
    return abs(period / other - 1) > _MIN_DEVIATION


def _stretch_paces(values: Ints) -> tuple[Ints, Floats]:
    """Return first row and median step [ns] of every stretch."""
    n_stretches = len(values) // _STRETCH
    end = n_stretches * _STRETCH
    table = np.diff(values[:end].reshape(n_stretches, _STRETCH)[:, ::16], axis=1)
    paces = np.median(table, axis=1) / 16 if n_stretches else np.empty(0)
    begins = np.arange(n_stretches) * _STRETCH
    if len(values) - end >= _STRETCH // 4:
        last = np.median(np.diff(values[end::16])) / 16
        begins, paces = np.append(begins, end), np.append(paces, last)
    return begins, paces

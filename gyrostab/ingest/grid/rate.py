"""The sampling rate that a file's stamps stand for.

Two hypotheses. *Lattice*: stamps lie near multiples of a period, with jitter, rounding, and rows
missing or doubled; the row's place follows from its stamp. *Counted*: stamps tell when the rows
arrived (in bursts) or are shared by many rows (whole seconds); only the number of rows over a long
stretch tells the rate, and the row's place is its count.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import TimeError
from gyrostab.ingest.grid.jitter import JitterModel, count_samples, fit_jitter, fit_jitter_near
from gyrostab.ingest.grid.steps import cut_stretches, finer_period, refine_period
from gyrostab.kernels.grid.stamps import NO_STAMP, piece_sums, track
from gyrostab.store.threads import map_in_order

__all__ = [
    "RateEstimate",
    "Stamps",
    "deviating_stretches",
    "estimate_near",
    "estimate_rate",
    "is_far_worse",
    "starting_period",
]

SECOND = 1e9
#: Gives the blocks of row numbers and stamps, from the first on, as often as asked.
Stamps = Callable[[], Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]]
_GAIN = 0.1
_MAX_TRUSTED_SAMPLES = 500.0  # samples, of a long log
_SHARED_SHARE = (
    0.05  # share of rows with the stamp of the row before from which on stamps may be shared
)
# share of steps backwards that no jitter makes: 0.12 at a scatter of 0.6 samples, 0.5 in random
# order
_MAX_BACKWARD_SHARE = 0.35
_MIN_SINGLE_SHARE = 0.1  # share of the steps that must be one sample of a rate that is given
#: Scatter of the steps about whole samples up to which single stamps tell the sample: jitter of
#: 0.08 samples, so that half a sample is
#: 6 standard deviations.
_SHARP_SCATTER = 0.12
_MAX_PIECES = 200_000
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


def _recut_blocks(
    stamps: Stamps, size: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Give the same rows and stamps in blocks of `size`, so that no result depends on how they came."""
    held: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    waiting = 0
    for block in stamps():
        held.append(block)
        waiting += len(block[0])
        if waiting < size:
            continue
        rows, values = _concatenate_blocks(held)
        whole = waiting // size * size
        for begin in range(0, whole, size):
            yield rows[begin : begin + size], values[begin : begin + size]
        held, waiting = [(rows[whole:], values[whole:])], waiting - whole
    if waiting:
        yield _concatenate_blocks(held)


def _concatenate_blocks(
    held: list[tuple[NDArray[np.int64], NDArray[np.int64]]],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Blocks of rows and stamps one after the other; a single one, or what alone is not empty, is not copied."""
    held = [block for block in held if len(block[0])]
    if len(held) == 1:
        return held[0]
    rows, values = (np.concatenate(column) for column in zip(*held, strict=True))
    return rows, values


def _readable_stamps(block: NDArray[np.int64]) -> NDArray[np.int64]:
    """The stamps that could be read; all of them, as nearly always, are not copied."""
    known = block != NO_STAMP
    return block if known.all() else block[known]


def _sample_stretches(
    stamps: Stamps, *, size: int = 8192, most: int = 64
) -> list[NDArray[np.int64]]:
    """Stretches of stamps from all over the log, a few hundred thousand in all."""
    found: list[NDArray[np.int64]] = []
    for _, block in stamps():
        block = _readable_stamps(block)
        found += [block[i : i + size] for i in range(0, len(block), size)]
        if len(found) > 2 * most:
            found = found[::2]
    return [part for part in found if len(part) > 1]


def _residual_range(
    parts: list[NDArray[np.int64]], length: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slope [ns a row] and range of the residuals [ns] of straight lines through stretches of `length` stamps."""
    values = cut_stretches(parts, length)
    x = np.arange(length) - (length - 1) / 2
    slope = values @ x / (x @ x)
    rest = values - slope[:, None] * x
    return slope, np.ptp(rest, axis=1) if len(rest) else np.empty(0)


def _has_shared_stamps(parts: list[NDArray[np.int64]], steps: NDArray[np.float64]) -> bool:
    """Whether many rows share a stamp because the clock ticks slowly, and not because rows are doubled."""
    if np.mean(steps == 0) < _SHARED_SHARE:
        return False
    tick = np.median(steps[steps > 0])
    length = min(512, *(len(part) for part in parts)) if parts else 0
    slope, spread = _residual_range(parts, length) if length >= 8 else (np.empty(0), np.empty(0))
    good = slope > 0
    return bool(good.any() and np.median(spread[good] / np.maximum(tick, slope[good])) < 1.3)


def rms_misfit(steps: NDArray[np.float64], period: float) -> float:
    """How far steps are from whole numbers of samples, root mean square [samples]; 0.29 says that they are anywhere."""
    near = steps[np.abs(steps) < 5.5 * period] / period
    return float(np.sqrt(np.mean((near - np.rint(near)) ** 2))) if len(near) else 0.5


def step_scatter(steps: NDArray[np.float64], period: float) -> float:
    """Robust standard deviation of the steps about whole numbers of samples [samples]; 0.37 says that they are anywhere."""
    near = steps[np.abs(steps) < 5.5 * period] / period
    return 1.4826 * float(np.median(np.abs(near - np.rint(near)))) if len(near) else 0.5


def period_of_lines(parts: list[NDArray[np.int64]]) -> float | None:
    """Period of the stretches in which the row count alone predicts the stamps to less than a sample."""
    length = min(16, max(len(part) for part in parts))
    slope, spread = _residual_range(parts, length)
    good = (slope > 0) & (spread < 0.95 * slope)
    if length < 12 or good.sum() < max(1, 0.03 * len(slope)):
        return None
    period = float(np.median(slope[good]))
    for gain in (0.5, 0.5, 0.2, 0.1, _GAIN):
        time = samples = 0
        for part in parts:
            count, piece = track(part, period, gain, 20 * period)
            same = np.diff(piece) == 0
            time, samples = (
                time + int(np.diff(part)[same].sum()),
                samples + int(np.diff(count)[same].sum()),
            )
        if samples <= 0:
            return None
        period = time / samples
    return period


def starting_period(parts: list[NDArray[np.int64]]) -> tuple[float, bool, bool]:
    """Period [ns] from stretches of stamps, to a part in a thousand or better; whether rows are counted; whether stamps are shared."""
    steps = np.concatenate([np.diff(part) for part in parts]).astype(np.float64)
    rising = steps[steps > 0]
    if _has_shared_stamps(parts, steps):
        return _time_per_row(parts, ticks=True), True, True
    period = period_of_lines(parts)
    if period is None:
        period = refine_period(steps, float(np.quantile(rising, 0.5, method="lower")))
        if (
            rms_misfit(steps, period) > 0.2
        ):  # with most rows missing, the median step is not one sample
            shorter = refine_period(steps, float(np.quantile(rising, 0.1)))
            period = shorter if rms_misfit(steps, shorter) < 0.15 else period
    return (
        (_time_per_row(parts), True, False)
        if _is_bursty(parts, steps, period)
        else (period, False, False)
    )


def _is_bursty(parts: list[NDArray[np.int64]], steps: NDArray[np.float64], period: float) -> bool:
    """Whether the long steps are pauses between bursts: they do not fit the lattice of the short ones, or make up for them."""
    long = steps[(steps > 1.5 * period) & (steps < 50 * period)]
    near = steps[np.abs(steps) < 50 * period]
    if len(long) <= max(10, 0.02 * len(steps)) or near.sum() <= 1.2 * period * len(near):
        return False
    if abs(np.exp(2j * np.pi * long / period).mean()) < 0.2:
        return True
    length = min(256, len(steps) // 16)
    if np.median(long) < 3 * period or length < 16:
        return False
    spans = np.concatenate(
        [(part[length:] - part[:-length])[::length] for part in parts if len(part) > length]
    ).astype(np.float64)
    scatter = 1.4826 * np.median(np.abs(spans - np.median(spans)))
    return bool(scatter**2 < 0.2 * length * near.var())  # samples lost at random would add up


def _time_per_row(parts: list[NDArray[np.int64]], *, ticks: bool = False) -> float:
    """Time a row takes [ns], from long stretches; with `ticks`, from the first to the last change of a shared stamp."""
    rates = []
    for part in parts:
        steps = np.diff(part).astype(np.float64)
        if ticks and (steps > 0).sum() > 1:
            times, counts = _tick_steps(steps)
        else:
            usual = np.median(steps[steps > 0]) if (steps > 0).any() else SECOND
            good = (steps >= 0) & (steps <= max(SECOND, 1000 * usual))
            times, counts = float(steps[good].sum()), int(good.sum())
        if times > 0 and counts > 0:
            rates.append((times, counts))
    found = np.array(rates, dtype=np.float64)
    whole = found[:, 1] >= 0.5 * found[:, 1].max()
    return float(np.median(found[whole, 0] / found[whole, 1]))


def _tick_steps(steps: NDArray[np.float64]) -> tuple[float, int]:
    """Time [ns] and rows between changes of a shared stamp; changes that take three times as long a row as usual are gaps.

    A change and the rows that share the stamp before it are kept or left out together: some stamps
    may be shared by one row and others by five.
    """
    rising = np.flatnonzero(steps > 0)
    times, counts = steps[rising[1:]], np.diff(rising)
    paces = times / counts
    good = paces <= 3 * np.median(np.repeat(paces, counts))
    return float(times[good].sum()), int(counts[good].sum())


def _longest_step(parts: list[NDArray[np.int64]], period: float) -> float:
    """Step [ns] after which counting starts anew when rows are placed by count."""
    steps = np.concatenate([np.diff(part) for part in parts])
    return float(max(SECOND, 50 * period, 10 * np.quantile(np.abs(steps), 0.99)))


def _fit_pieces(
    stamps: Stamps,
    period: float,
    counted: bool,
    coarse: bool,
    longest: float,
    course: JitterModel | None = None,
) -> NDArray[np.float64]:
    """Of every unbroken piece: n, mean count, mean stamp [ns from the first], sums of squares cc, ct, and of the residuals."""
    table = np.empty((0, 6))
    zero: int | None = None
    work = partial(
        _piece_sums, period=period, counted=counted, coarse=coarse, longest=longest, course=course
    )
    for first, sums in map_in_order(work, stamps()):
        if first is None:
            continue
        zero = first[0] if zero is None else zero
        sums[:, 2] += first[1] - zero
        table = np.concatenate([table, sums])
        if len(table) > _MAX_PIECES:  # a log in shreds: the largest pieces tell the rate
            table = table[np.argsort(-table[:, 3], kind="stable")[: _MAX_PIECES // 2]]
            table = table[np.argsort(table[:, 2], kind="stable")]
    return table


def _piece_sums(
    found: tuple[NDArray[np.int64], NDArray[np.int64]],
    *,
    period: float,
    counted: bool,
    coarse: bool,
    longest: float,
    course: JitterModel | None,
) -> tuple[tuple[int, int] | None, NDArray[np.float64]]:
    """Of one block: its first stamp, that from which the sums count, and the sums of its pieces; None where no stamp is readable."""
    rows, block = found
    block = _readable_stamps(block)
    if len(block) == 0:
        return None, np.empty((0, 6))
    first = int(block[0])
    if course is not None:
        block, count, piece = count_samples(np.arange(len(found[1])), found[1], course, longest)
        return (first, int(block[0])) if len(block) else None, piece_sums(
            block, count, piece, period
        )
    if counted:
        known = np.flatnonzero(rows != NO_STAMP)
        piece = np.concatenate([[0], np.cumsum(np.abs(np.diff(block)) > longest)])
        count = known  # a row counts, with or without a stamp
    else:
        count, piece = track(block, period, _GAIN, longest)
    if (
        coarse and (tick := np.flatnonzero(np.diff(block)) + 1).size > 1
    ):  # only there the true time is known
        block, count, piece = block[tick], count[tick], piece[tick]
    return (first, int(block[0])), piece_sums(block, count, piece, period)


def _pool_pieces(
    pieces: NDArray[np.float64], period: float, counted: bool
) -> tuple[float, float, float]:
    """Period [ns], its standard error [ns], and the samples of the longest joined stretch."""
    n, cc, ct, rest = pieces[:, 0], pieces[:, 3], pieces[:, 4], pieces[:, 5]
    if cc.sum() <= 0:
        return period, period, 1.0
    noise = np.sqrt(rest.sum() / max(1.0, n.sum() - 2 * len(n)))
    slope = ct / np.where(cc > 0, cc, 1.0)
    sane = (cc > 0) & (
        np.abs(slope / period - 1) < 0.02 + 5 * noise / period / np.sqrt(np.maximum(cc, 1e-9))
    )
    if sane.any():
        period = float(ct[sane].sum() / cc[sane].sum())
    error = 3.0 * noise / np.sqrt(cc[sane].sum() if sane.any() else cc.sum())
    if counted or not sane.any():  # no piece has the period that was begun with: nothing to join
        return period, error, float(n.max())
    return _join_pieces(pieces[sane], period, error, noise)


def _join_pieces(
    pieces: NDArray[np.float64], period: float, error: float, noise: float
) -> tuple[float, float, float]:
    """Join pieces whose distance is surely a known number of samples, and fit again."""
    for _ in range(3):
        total_cc = total_ct = longest = 0.0
        n, mc, mt, cc, ct = pieces[0, :5]
        for n2, mc2, mt2, cc2, ct2 in pieces[1:, :5]:
            apart = (mt2 - mt) / period
            if apart > 0 and (apart * error + 3 * noise / np.sqrt(min(n, n2))) / period < 0.35:
                shift = np.rint(apart - (mc2 - mc)) + mc2 - mc  # distance of the mean counts
                weight, share = n * n2 / (n + n2), n2 / (n + n2)
                cc, ct = cc + cc2 + weight * shift**2, ct + ct2 + weight * shift * (mt2 - mt)
                mc, mt, n = mc + shift * share, mt + (mt2 - mt) * share, n + n2
            else:
                total_cc, total_ct, longest = total_cc + cc, total_ct + ct, max(longest, n)
                n, mc, mt, cc, ct = n2, mc2, mt2, cc2, ct2
        total_cc, total_ct, longest = total_cc + cc, total_ct + ct, max(longest, n)
        if total_cc > 0:
            period, error = float(total_ct / total_cc), 3.0 * noise / np.sqrt(total_cc)
    return period, error, float(longest)


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
    stamps = partial(_recut_blocks, stamps, _BLOCK)
    parts = _sample_stretches(stamps)
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
        or np.mean(steps == 0) >= _SHARED_SHARE
    ):
        course = _fit_jitter(parts, period, coarse, sure)
        if course is not None:
            return _estimate_with_jitter(stamps, course, coarse, sure)
    longest = _longest_step(parts, period) if counted else sure * period
    estimate = _estimate_pooled(
        _fit_pieces(stamps, period, counted, coarse, longest), period, counted, coarse
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
        readings = [parts, once] if (1 - _SHARED_SHARE) * rows < apart < rows else [parts]
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
    pieces = _fit_pieces(stamps, course.period, False, False, longest, course)
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
    period, error, samples = _pool_pieces(pieces, period, counted and not coarse)
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
    stamps = partial(_recut_blocks, stamps, _BLOCK)
    parts = _sample_stretches(stamps)
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
        parts = _sample_stretches(partial(_recut_blocks, stamps, _BLOCK))
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
        _fit_pieces(stamps, period, False, False, _trusted_samples(len(steps)) * period),
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
    for rows, values in _recut_blocks(stamps, 64 * size):
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

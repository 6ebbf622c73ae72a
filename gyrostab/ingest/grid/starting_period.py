"""Find a first estimate of the sampling period from stretches of stamps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np

from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.grid.stamps import NO_STAMP, track

SECOND = 1e9
_STRETCH = 8192  # longest sampled stretch [stamps]
_MAX_STRETCHES = 128
_PATTERN = 8  # longest pattern of steps [steps]
_ROWS = 17  # further rows in which a pattern must recur
_WHOLE = 0.15  # largest distance of a step of a pattern from whole samples [samples]
LONGEST = 5.0  # longest step of a pattern [samples]
TRACK_GAIN = 0.1  # with which the phase follows stamps near multiples of the period
#: Smallest share of rows with the stamp of the previous row if stamps are shared.
SHARED_SHARE = 0.05

#: Bins of a stretch, bins in the shortest period, and stretches that are used at most.
_BINS, _BINS_PER_PERIOD, _MAX_TABLES = 1 << 15, 4, 64
_MAX_PEAKS = 3
#: Shortest period [ticks of the clock]: of a tick all stamps are multiples, however sampled. The
#: longest tick [ns] that is certainly one, such as that of stamps in milliseconds.
MIN_TICKS, _COMMON_TICK = 1.5, 1e6
PEAK_WIDTH = 0.02  # relative distance of two peaks, at least

#: Rows over which random losses accumulate, at least and at most, and the share of the variance of
#: independent steps below which they do not.
_MIN_SPAN_ROWS, _SPAN_ROWS, _MIN_ACCUMULATION = 16, 256, 0.2

#: Ratio to the mean time per row from which on a period is not that of the rows.
_LONGER = 1.05

#: Least share of the steps that are pauses, of rows in bursts or packets.
_MIN_PAUSE_SHARE = 0.02
Parts = list[Ints]
_Period = TypeVar("_Period", float, float | None)
#: Rows and their stamps, or the stamps that are used of some rows.
Block = tuple[Ints, Ints]
#: Returns a new iterator over all blocks of row numbers and stamps at each call.
Stamps = Callable[[], Iterator[Block]]


def recut_blocks(stamps: Stamps, size: int, ahead: int = 0) -> Iterator[Block]:
    """Yield rows and stamps in blocks of `size`, independent of the input blocks.

    Each block has `ahead` more rows, with which the next one begins; only the last is shorter.
    """
    held: list[Block] = []
    waiting = 0
    for block in stamps():
        held.append(block)
        waiting += len(block[0])
        if waiting < size + ahead:
            continue
        rows, values = _concatenate_blocks(held)
        n_complete = (waiting - ahead) // size * size
        for begin in range(0, n_complete, size):
            end = begin + size + ahead
            yield rows[begin:end], values[begin:end]
        held, waiting = [(rows[n_complete:], values[n_complete:])], waiting - n_complete
    if waiting:
        yield _concatenate_blocks(held)


def _concatenate_blocks(held: list[Block]) -> Block:
    """Concatenate blocks of rows and stamps; a single non-empty block is not copied."""
    held = [block for block in held if len(block[0])]
    if len(held) == 1:
        return held[0]
    rows, values = (np.concatenate(column) for column in zip(*held, strict=True))
    return rows, values


def readable_stamps(block: Ints) -> Ints:
    """Return the readable stamps, without a copy if all are readable."""
    is_readable = block != NO_STAMP
    return block if is_readable.all() else block[is_readable]


def fill_stamps(block: Ints) -> Ints:
    """Return the stamps from the first to the last readable one, the others evenly between them.

    Examples
    --------
    >>> fill_stamps(np.array([NO_STAMP, 10, NO_STAMP, NO_STAMP, 40, 50]))
    array([10, 20, 30, 40, 50])
    """
    rows = np.flatnonzero(block != NO_STAMP)
    if len(rows) in (0, len(block)):
        return block[: len(rows)]
    stamps, first = block[rows], block[rows[0]]
    between = np.interp(np.arange(rows[0], rows[-1] + 1), rows, stamps - first)
    filled: Ints = np.rint(between).astype(np.int64) + first
    filled[rows - rows[0]] = stamps
    return filled


def find_steps(parts: Parts) -> Floats:
    """Return the steps [ns] between successive stamps of each stretch."""
    return np.concatenate([np.diff(part) for part in parts]).astype(np.float64)


def sample_stretches(stamps: Stamps) -> Parts:
    """Return stretches of stamps from the whole log, a few hundred thousand in all.

    Each has at least two readable stamps; unreadable ones are `NO_STAMP`, so that rows can be
    counted.
    """
    stretches: Parts = []
    number, stride = 0, 1  # of all stretches so far; every stride-th is kept
    for _, block in stamps():
        for begin in range(0, len(block), _STRETCH):
            if number % stride == 0:
                stretches.append(block[begin : begin + _STRETCH])
            number += 1
            if len(stretches) > _MAX_STRETCHES:
                stretches, stride = stretches[::2], 2 * stride
    return [part for part in stretches if np.count_nonzero(part != NO_STAMP) > 1]


def cut_stretches(parts: Parts, length: int) -> Floats:
    """Return stretches of `length` stamps, relative to the first stamp of each [ns]."""
    stride = length if sum(map(len, parts)) > 200 * length else 1  # overlap in a short log
    stretches = [
        np.lib.stride_tricks.sliding_window_view(part, length)[::stride]
        for part in parts
        if len(part) >= length
    ]
    table = np.concatenate([*stretches, np.empty((0, length), dtype=np.int64)])
    return np.asarray(table - table[:, :1], dtype=np.float64)


def _refine_period(steps: Floats, period: float) -> float:
    """Refine a first guess of the period [ns] of which the steps are multiples, if there is one."""
    start = period
    for _ in range(30):
        is_near = np.abs(steps) < 5.5 * period
        count = np.rint(steps[is_near] / period).sum()
        if count <= 0 or not 0.3 < period / start < 2.0:  # no common period
            return start
        new = float(steps[is_near].sum() / count)
        if abs(new - period) < 1e-12 * period:
            break
        period = new
    return period


def finer_period(parts: Parts, period: float) -> float | None:
    """Find the period [ns] of recurring steps such as 1, 1, 3, 1, 1, 3; None if there is none.

    In such a log the same two of every five rows are missing, or rows are read in groups; stamps
    alone cannot distinguish these. The rounding of even stamps also makes patterns, but of steps
    that differ by one tick; steps by jitter do not recur; pauses between bursts are longer.
    """
    table = np.diff(cut_stretches(parts, _PATTERN + _ROWS))
    rising = table[table > 0]
    if rising.size == 0:
        return None
    single = _refine_period(table.ravel(), float(np.quantile(rising, 0.1)))
    if single > 0.9 * period:
        return None
    counts = np.rint(table / single)
    is_whole = (np.abs(table / single - counts) < _WHOLE).all(axis=1)
    recurrences = [
        (counts[:, rows:] == counts[:, :-rows]).all(axis=1) for rows in range(2, _PATTERN + 1)
    ]
    uneven = (counts.min(axis=1) == 1) & (counts.max(axis=1) > 2) & (counts.max(axis=1) <= LONGEST)
    return single if (is_whole & np.any(recurrences, axis=0) & uneven).mean() > 0.5 else None


def packet_rate(stretches: Parts, rate: float) -> float | None:
    """Return the rate [Hz] of rows in packets with pauses between them; None for other rows.

    The steps within a packet give the higher `rate` [Hz]; stamps alone cannot distinguish rows that
    arrive in packets from samples that are lost between groups. Random losses have no single steps.

    Examples
    --------
    >>> packets = [np.arange(8000) // 4 * 40_000_000 + np.arange(8000) % 4 * 100_000]
    >>> packet_rate(packets, 10_000.0), packet_rate(packets, 100.0)
    (100.0, None)
    """
    steps = find_steps([readable_stamps(stretch) for stretch in stretches])
    rising, period = steps[steps > 0], SECOND / rate
    mean = SECOND / time_per_row(stretches)
    is_packed = (
        mean < rate / LONGEST
        and np.mean(steps > LONGEST * period) > _MIN_PAUSE_SHARE
        and np.quantile(rising, 0.5, method="lower") < 1.5 * period
    )
    return float(f"{mean:.4g}") if is_packed else None


def _residual_range(parts: Parts, length: int) -> tuple[Floats, Floats]:
    """Fit lines to stretches of `length` stamps: slopes [ns a row], residual ranges [ns]."""
    values = cut_stretches(parts, length)
    x = np.arange(length) - (length - 1) / 2
    slope = values @ x / (x @ x)
    residuals = values - slope[:, None] * x
    return slope, np.ptp(residuals, axis=1)


def _has_shared_stamps(parts: Parts) -> bool:
    """Return whether rows share stamps because the clock is coarse, not by doubling."""
    steps, length = find_steps(parts), min(512, *map(len, parts))
    if np.mean(steps == 0) < SHARED_SHARE or length < 8:
        return False
    tick = np.median(steps[steps > 0])
    slope, spread = _residual_range(parts, length)
    good = slope > 0
    return bool(good.any() and np.median(spread[good] / np.maximum(tick, slope[good])) < 1.3)


def rms_misfit(steps: Floats, period: float) -> float:
    """Return the RMS distance of steps from whole samples [samples]; 0.29 for uniform phases."""
    inliers = steps[np.abs(steps) < 5.5 * period] / period
    return float(np.sqrt(np.mean((inliers - np.rint(inliers)) ** 2))) if len(inliers) else 0.5


def step_scatter(steps: Floats, period: float) -> float:
    """Return the robust scatter of steps about whole samples [samples]; 0.37 for uniform phases."""
    inliers = steps[np.abs(steps) < 5.5 * period] / period
    return 1.4826 * float(np.median(np.abs(inliers - np.rint(inliers)))) if len(inliers) else 0.5


def period_of_lines(parts: Parts) -> float | None:
    """Return the period of stretches whose row count predicts the stamps to less than a sample."""
    length = min(16, max(len(part) for part in parts))
    slope, spread = _residual_range(parts, length)
    good = (slope > 0) & (spread < 0.95 * slope)
    if length < 12 or good.sum() < max(1, 0.03 * len(slope)):
        return None
    # one that occurs: if the rate changes, the mean of the two middle ones does not
    period: float | None = float(np.quantile(slope[good], 0.5, method="lower"))
    for gain in (0.5, 0.5, 0.2, 0.1, TRACK_GAIN):
        period = None if period is None else track_period(parts, period, gain)
    return period


def track_period(parts: Parts, period: float, gain: float = TRACK_GAIN) -> float | None:
    """Return the mean period [ns] of stamps near multiples of one; None if they do not rise."""
    time = samples = 0
    for part in parts:
        count, piece = track(part, period, gain, 20 * period)
        same = np.diff(piece) == 0
        time += int(np.diff(part)[same].sum())
        samples += int(np.diff(count)[same].sum())
    return time / samples if samples > 0 else None


def starting_period(stretches: Parts) -> tuple[float, bool, bool]:
    """Return period [ns] to 0.1 %, whether rows are counted, whether stamps are shared.

    The stretches are those of `sample_stretches`.
    """
    parts = [readable_stamps(stretch) for stretch in stretches]
    if _has_shared_stamps(parts):
        return time_per_row(stretches, ticks=True), True, True
    parts, period = find_by_rows(stretches, _stamped_period)
    if _is_bursty(parts, period):
        return time_per_row(stretches), True, False
    return period, False, False


def find_by_rows(stretches: Parts, find: Callable[[Parts], _Period]) -> tuple[Parts, _Period]:
    """Return the period [ns] that `find` finds from the stamps, and the stamps that it used.

    These are the readable ones. If the period is longer than the mean time per row, few successive
    rows have one, for instance the first row of each packet; all rows are used then.
    """
    parts = [readable_stamps(stretch) for stretch in stretches]
    period = find(parts)
    has_all = sum(map(len, parts)) == sum(map(len, stretches))
    if has_all or period is None or period < _LONGER * time_per_row(stretches):
        return parts, period
    filled = [fill_stamps(stretch) for stretch in stretches]
    return filled, find(filled)


def _stamped_period(parts: Parts) -> float:
    """Return the period [ns] of stamps near multiples of it."""
    steps = find_steps(parts)
    rising = steps[steps > 0]
    period = period_of_lines(parts)
    if period is None:
        period = _refine_period(steps, float(np.quantile(rising, 0.5, method="lower")))
        if rms_misfit(steps, period) > 0.2:
            # with most rows missing, the median step is longer than one sample
            shorter = _refine_period(steps, float(np.quantile(rising, 0.1)))
            # with random losses a single sample is the most frequent step; stamps in whole
            # milliseconds are also multiples of a millisecond
            single = np.argmax(np.bincount(np.rint(rising / shorter).clip(0, 50).astype(int))) == 1
            period = shorter if single and rms_misfit(steps, shorter) < 0.15 else period
    return period


def _is_bursty(parts: Parts, period: float) -> bool:
    """Return whether long steps are pauses between bursts, not multiples of the short ones."""
    steps = find_steps(parts)
    long = steps[(steps > 1.5 * period) & (steps < 50 * period)]
    inliers = steps[np.abs(steps) < 50 * period]
    if len(long) <= max(10, _MIN_PAUSE_SHARE * len(steps)) or inliers.sum() <= 1.2 * period * len(
        inliers
    ):
        return False
    if abs(np.exp(2j * np.pi * long / period).mean()) < 0.2:
        return True
    is_long = len(steps) >= 16 * _MIN_SPAN_ROWS and np.median(long) >= 3 * period
    return bool(is_long) and not losses_accumulate(parts)


def time_per_row(stretches: Parts, *, ticks: bool = False) -> float:
    """Return the mean time per row [ns]; with `ticks`, between changes of a shared stamp.

    Rows without a readable stamp count.
    """
    rates = []
    for stretch in stretches:
        rows = np.flatnonzero(stretch != NO_STAMP)
        steps = np.diff(stretch[rows]).astype(np.float64)
        if ticks and (steps > 0).sum() > 1:
            times, counts = _tick_steps(steps, rows)
        else:
            usual = np.median(steps[steps > 0]) if (steps > 0).any() else SECOND
            good = (steps >= 0) & (steps <= max(SECOND, 1000 * usual))
            times, counts = float(steps[good].sum()), int(np.diff(rows)[good].sum())
        if times > 0 and counts > 0:
            rates.append((times, counts))
    totals = np.array(rates, dtype=np.float64)
    is_long = totals[:, 1] >= 0.5 * totals[:, 1].max()
    return float(np.median(totals[is_long, 0] / totals[is_long, 1]))


def _tick_steps(steps: Floats, rows: Ints) -> tuple[float, int]:
    """Return time [ns] and rows between changes of a shared stamp, without gaps.

    A change whose time per row exceeds three times the median is a gap. Each change is kept or left
    out together with its rows, because some stamps may be shared by one row and others by five.
    """
    rising = np.flatnonzero(steps > 0)
    times, counts = steps[rising[1:]], np.diff(rows[rising + 1])
    paces = times / counts
    good = paces <= 3 * np.median(np.repeat(paces, counts))
    return float(times[good].sum()), int(counts[good].sum())


def losses_accumulate(parts: Parts) -> bool:
    """Return whether the time of many rows varies as much as independent steps make it vary.

    It does if samples are lost at random; pauses between packets of rows do not change the number
    of rows in a long time.
    """
    steps = find_steps(parts)
    length = min(_SPAN_ROWS, len(steps) // 16)
    if length < _MIN_SPAN_ROWS:
        return False
    spans = np.concatenate([part[length:] - part[:-length] for part in parts if len(part) > length])
    longest = max(np.median(spans), np.median(np.abs(steps)))
    usual = steps[np.abs(steps) <= longest]  # pauses, but no outages or damaged stamps
    scatter = 1.4826 * np.median(np.abs(spans - np.median(spans)))
    return bool(scatter**2 >= _MIN_ACCUMULATION * length * usual.var())


def clock_tick(parts: Parts) -> float:
    """Return the largest time [ns] of which all stamps are multiples, from the first on."""
    return float(np.gcd.reduce(np.concatenate([np.diff(part) for part in parts])))


def comb_peaks(parts: Parts) -> list[tuple[float, float]]:
    """Return periods [ns] near multiples of which the stamps lie, and the jitter [samples].

    The power of N stamps at the sampling frequency is 1 + N exp(-4 pi^2 sigma^2) for a jitter of
    sigma samples, whichever samples are missing.
    """
    steps = find_steps(parts)
    steps = steps[steps > 0]
    tick = min(clock_tick(parts), _COMMON_TICK)
    shortest = max(0.7 * float(np.quantile(steps, 0.1)), MIN_TICKS * tick)
    longest = 1.1 * float(np.mean(steps[steps <= 50 * np.median(steps)]))
    width = shortest / _BINS_PER_PERIOD
    counts = [
        table
        for part in parts
        for table in _count_stamps(((part - part.min()) / width).astype(np.int64))
    ]
    counts = counts[:: -(-len(counts) // _MAX_TABLES)]
    rows = np.array([table.sum() for table in counts])
    power = sum(np.abs(np.fft.rfft(table - table.mean())) ** 2 for table in counts) / rows.sum()
    frequency = np.fft.rfftfreq(_BINS, width)
    inside = (frequency > 1 / longest) & (frequency < 1 / shortest)
    frequency, power = frequency[inside], power[inside]
    peaks: list[tuple[float, float]] = []
    level = 1 + 7 / np.sqrt(len(counts)) + 16 / len(counts)  # 1e-6 of chance
    while len(power) and len(peaks) < _MAX_PEAKS:
        best = int(np.argmax(power))
        excess = power[best] / np.median(power)
        if excess < level:
            break
        coherence = min(0.99, power[best] * rows.sum() / (rows**2).sum())
        peaks.append((1 / frequency[best], float(np.sqrt(-np.log(coherence)) / (2 * np.pi))))
        apart = np.abs(frequency / frequency[best] - 1) > PEAK_WIDTH
        frequency, power = frequency[apart], power[apart]
    return peaks


def _count_stamps(bins: Ints) -> list[Floats]:
    """Count the stamps in each bin, in stretches of `_BINS` bins that hold at least 64 stamps."""
    stretch = bins // _BINS
    numbers, rows = np.unique(stretch, return_counts=True)
    return [
        np.bincount(bins[stretch == number] % _BINS, minlength=_BINS).astype(np.float64)
        for number in numbers[rows >= min(64, rows.max())]
    ]

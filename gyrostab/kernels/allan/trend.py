"""Mean and trend of the rate in each window, and the trend as its second differences see it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit

from gyrostab.arrays import Array, Bools, Floats, Ints
from gyrostab.kernels.allan.blocks import windows_from_blocks
from gyrostab.kernels.allan.intervals import valid_intervals
from gyrostab.kernels.compiled import INNER, KERNEL
from gyrostab.kernels.fit.covariance import angle_covariances

#: Moments of a block: present samples, their places, squares of these, rates, rates times places.
_MOMENTS = 5
#: Parts of a window in which the present samples are counted for noise that varies slowly (B, K):
#: its variances are then within 1 %, and 5 % where only a tenth of the window is present.
_PARTS = 64


@njit(**INNER)
def _add_moments(x, angle, base, first, last, out):  # type: ignore[no-untyped-def]
    """Sum the moments of some samples; the rates of angles are their differences."""
    count = place = square = rate = product = 0.0
    for i in range(first, last):
        value = np.float64(x[i + 1]) - np.float64(x[i]) if angle else np.float64(x[i])
        value -= base
        if np.isfinite(value):
            count += 1.0
            place += i
            square += np.float64(i) * i
            rate += value
            product += value * i
    out[0], out[1], out[2], out[3], out[4] = count, place, square, rate, product


@njit(**KERNEL)
def _block_moments(x, angle, base, window, step, n_windows):  # type: ignore[no-untyped-def]
    whole_blocks = window // step
    head = window - whole_blocks * step
    heads = np.zeros((n_windows + whole_blocks, _MOMENTS))
    tails = np.zeros((n_windows + whole_blocks, _MOMENTS))
    for block in range(n_windows + whole_blocks):
        a = block * step
        _add_moments(x, angle, base, a, a + head, heads[block])
        if block < n_windows + whole_blocks - 1:
            _add_moments(x, angle, base, a + head, a + step, tails[block])
    return heads, tails


def _typical_rate(x: Array, present: Bools, angle: bool) -> float:
    """Find the median of some rates; a damaged one would cost the sums of others their digits."""
    apart = max(1, present.size // 256)
    places = np.append(np.argmax(present), apart * np.flatnonzero(present[::apart]))
    rates = x[places + 1].astype(np.float64) - x[places] if angle else x[places]
    return float(np.median(rates))


def window_lines(
    x: Array, *, angle: bool, window: int, step: int, n_windows: int
) -> tuple[Floats, float]:
    """Fit a straight line to the rates of each window.

    The rate over a gap of angles is the difference of those on both sides, with the weight of all
    samples between them.

    Parameters
    ----------
    x : ndarray (n,)
        Rates, or cumulative angles; NaN where missing.
    angle : bool
        Whether these are angles, ``window + 1`` per window.
    window, step, n_windows : int
        Windows start at samples 0, step, 2 step ...

    Returns
    -------
    lines : ndarray (7, n_windows)
        Mean rate [unit of the rate; for angles: of the angle per sample], NaN without a rate; share
        of samples present; slope per sample, and its variance under Q, N, B and K relative to a
        window without gaps, NaN where fewer than two rates are present.
    mean : float
        Mean rate of all blocks.
    """
    finite = np.isfinite(x)
    present = finite[1:] & finite[:-1] if angle else finite
    starts = np.arange(n_windows) * step
    held, lines = None, np.full((7, n_windows), np.nan)
    if angle and not finite.all():
        places = np.flatnonzero(finite)
        shares = np.diff(np.searchsorted(places, [starts, starts + window + 1]), axis=0)
        lines[1] = shares[0] / (window + 1)
        if places.size < 2:
            return lines, np.nan
        held = _HeldAngles(places, starts, window)
        x = np.interp(np.arange(x.size), held.places, x[held.places], left=np.nan, right=np.nan)
        present = np.isfinite(x[1:])
    base = _typical_rate(x, present, angle)
    heads, tails = _block_moments(x, angle, base, window, step, n_windows)
    moments = np.empty((n_windows, _MOMENTS))
    windows_from_blocks(heads, tails, np.full(_MOMENTS, window // step), moments)
    if held is not None:
        held.remove_partial(moments, x, base)
    count, place, square, rate, product = moments.T
    rates = count if held is None else held.last - held.first
    if held is None:
        lines[1] = count / window
    total = (heads + tails).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = base + total[3] / total[0]
        lines[0] = base + rate / count
        spread = np.where(rates > 1, square - place**2 / count, np.nan)
        lines[2] = (product - place * rate / count) / spread
        white = window * (window**2 - 1.0) / 12.0 / spread
        lines[3:] = 1.0
        lines[4] = white
        lossy = np.flatnonzero(rates < window)
        if lossy.size:
            starts, centre = starts[lossy], place[lossy] / count[lossy]
            if held is None:
                edges = _edge_squares(present, starts, window, count[lossy], centre)
                parts = _count_parts(present, starts, window)
            else:
                edges, parts = held.edge_squares(lossy, centre), held.count_parts(lossy)
            edges /= 0.5 * (window**2 - 1.0)
            slow = _slow_responses(*parts, window)
            lines[3:, lossy] = white[lossy] ** 2 * [edges, 1.0 / white[lossy], *slow]
    return lines, float(mean)


class _HeldAngles:
    """Angles that are present, the rates between them, and those of each window."""

    def __init__(self, places: Ints, starts: Ints, window: int) -> None:
        self.places, self.starts, self.window = places, starts, window
        most = places.size - 1
        self.first = np.minimum(np.searchsorted(places, starts), most)
        self.last = np.searchsorted(places, starts + window, side="right") - 1
        self.last = np.maximum(self.last, self.first)
        #: Samples between an angle and the next, and their mean place.
        self.apart = np.diff(places)
        self.middles = places[:-1] + 0.5 * (self.apart - 1.0)

    def remove_partial(self, moments: Floats, x: Floats, base: float) -> None:
        """Remove what lies between an angle in a window and one outside it, from samples of `x`.

        The spread of places between two angles is removed, too, because only their mean is known.
        """
        low, high = self.places[self.first], self.places[self.last]
        stops = self.starts + self.window
        for start, end, at in ((self.starts, low, low - 1), (high, stops, high)):
            at = np.clip(at, 0, x.size - 2)
            length, rate = end - start, x[at + 1] - x[at] - base
            partial = (length > 0) & np.isfinite(rate)
            length, rate, place = length[partial], rate[partial], 0.5 * (start + end - 1)[partial]
            square = place**2 + (length**2.0 - 1.0) / 12.0
            means = [np.ones(length.size), place, square, rate, rate * place]
            moments[partial] -= length[:, None] * np.stack(means, axis=1)
        spreads = np.cumsum(np.append(0.0, self.apart * (self.apart**2.0 - 1.0) / 12.0))
        moments[:, 2] -= spreads[self.last] - spreads[self.first]
        moments[self.last == self.first] = 0.0

    def edge_squares(self, windows: Ints, centre: Floats) -> Floats:
        """Do what `_edge_squares` does: the weights of neighbours are their middles' distance."""
        squares = np.cumsum(np.append(0.0, np.diff(self.middles) ** 2))
        first = np.minimum(self.first[windows], squares.size - 1)
        last = np.maximum(self.last[windows] - 1, first)
        ends = (self.middles[first] - centre) ** 2 + (self.middles[last] - centre) ** 2
        return np.asarray(ends + squares[last] - squares[first])

    def count_parts(self, windows: Ints) -> tuple[Floats, Floats]:
        """Do what `_count_parts` does, with the samples between two angles at their middle."""
        edges, _ = _part_covariances(self.window)
        sums = np.zeros(self.places[-1] + 1)
        np.cumsum(np.repeat(self.middles, self.apart), out=sums[self.places[0] + 1 :])
        low, high = (self.places[at[windows], None] for at in (self.first, self.last))
        starts = self.starts[windows, None]
        bounds = np.clip(starts + edges, low, high)
        counts = np.diff(bounds, axis=1).astype(np.float64)
        return counts, np.diff(sums[bounds], axis=1) - starts * counts


def _edge_squares(
    present: Bools, starts: Ints, window: int, count: Floats, centre: Floats
) -> Floats:
    """Sum the squared weights of the angles in ``sum (place - centre) rate`` of each window.

    Inside a run of rates the weights of neighbours differ by one; at its edges they remain.
    """
    stops = starts + window
    inner_starts = np.flatnonzero(present[1:] & ~present[:-1]) + 1
    inner_lasts = np.flatnonzero(present[:-1] & ~present[1:])
    edges, squares = np.zeros((2, starts.size))
    for bounds in (starts, stops - 1):
        edges += present[bounds]
        squares += present[bounds] * (bounds - centre) ** 2
    for places, low in ((inner_starts, starts + 1), (inner_lasts, starts)):
        between = np.stack(
            [np.searchsorted(places, low), np.searchsorted(places, low + window - 1)]
        )
        number = between[1] - between[0]
        padded = np.append(places, 0).astype(np.float64)
        sums, square_sums = (
            np.where(number > 0, np.add.reduceat(padded**power, between.T.ravel())[::2], 0.0)
            for power in (1, 2)
        )
        edges += number
        squares += square_sums - 2.0 * centre * sums + number * centre**2
    return squares + count - 0.5 * edges


def _count_parts(present: Bools, starts: Ints, window: int) -> tuple[Floats, Floats]:
    """Count the samples in each part of each window, and sum their places as if evenly spread."""
    edges, _ = _part_covariances(window)
    sums = np.zeros(present.size + 1, dtype=np.int32)
    np.cumsum(present, out=sums[1:], dtype=np.int32)
    counts = np.diff(sums[starts[:, None] + edges], axis=1).astype(np.float64)
    return counts, counts * (0.5 * (edges[1:] + edges[:-1] - 1.0))


def _slow_responses(counts: Floats, places: Floats, window: int) -> Floats:
    """Compute the variance of ``sum (place - mean place) rate`` under B and K, (2, n_windows).

    Relative to a window without gaps. `counts` and sums of `places` are (n_windows, parts).
    """
    edges, covariances = _part_covariances(window)
    whole = np.diff(edges).astype(np.float64)
    counts = np.vstack([counts, whole])
    places = np.vstack([places, whole * 0.5 * (edges[1:] + edges[:-1] - 1.0)])
    centres = places.sum(axis=1) / counts.sum(axis=1)
    weights = (places - centres[:, None] * counts)[:, None, :]
    # a product for each window, so that none depends on the others
    variances = [(weights @ covariance @ weights.mT)[:, 0, 0] for covariance in covariances]
    return np.array([variance[:-1] / variance[-1] for variance in variances])


@lru_cache(maxsize=4)
def _part_covariances(window: int) -> tuple[Ints, Floats]:
    """Divide a window; covariance of the mean rates of its parts under B and K, (2, parts, parts).

    Apart from what is common to all rates.
    """
    parts = min(_PARTS, window)
    edges = np.arange(parts + 1) * window // parts
    lengths = np.diff(edges)
    lags = np.abs(edges[:, None] - edges).astype(np.float64)
    angles = np.stack([angle_covariances(term, lags) for term in (2, 3)])
    return edges, np.diff(np.diff(angles, axis=1), axis=2) / np.outer(lengths, lengths)


@njit(**INNER)
def _sum_differences(sums, a, b, k):  # type: ignore[no-untyped-def]
    """Sum the second differences from a to b, from the running sums of the angle."""
    return (
        (sums[b + 2 * k] - sums[a + 2 * k])
        - 2.0 * (sums[b + k] - sums[a + k])
        + (sums[b] - sums[a])
    )


@njit(**INNER)
def _interval_at(end, m, v):  # type: ignore[no-untyped-def]
    """Find the first interval from number v on that does not end before m."""
    while v < end.size and end[v] < m:
        v += 1
    return v


@njit(**INNER)
def _sum_before(m, v, begin, sums, totals, k):  # type: ignore[no-untyped-def]
    """Count and sum the valid second differences before m; `totals` are those before intervals.

    v is the first interval that does not end before m.
    """
    if v < begin.size and begin[v] < m:
        return totals[v, 0] + m - begin[v], totals[v, 1] + _sum_differences(sums, begin[v], m, k)
    return totals[v, 0], totals[v, 1]


@njit(**KERNEL)
def difference_slopes(theta, starts, stops, window, step, n_windows, ks, points):  # type: ignore[no-untyped-def]
    """Average the second differences in unbroken runs of each window, as slopes of the rate.

    Parameters
    ----------
    theta : float64 (n + 1,) or (n,)
        Angle, finite.
    starts, stops : int64 (n_runs,)
        Runs of present samples, or of present angles.
    window, step, n_windows : int
        Windows start at samples 0, step, 2 step ...
    ks : int64 (n_tau,)
        Averaging factors.
    points : int
        As for `valid_intervals`.

    Returns
    -------
    float64 (n_windows, n_tau)
        Slope per sample as of `window_lines`; NaN without second differences.
    """
    out = np.empty((n_windows, ks.size))
    sums = np.zeros(theta.size + 1)
    for m in range(theta.size):  # an assignment to a slice takes 2 s longer to compile
        sums[m + 1] = sums[m] + theta[m]
    for i in range(ks.size):
        k = ks[i]
        begin, end = valid_intervals(starts, stops, k, 2 * k, points)
        totals = np.zeros((begin.size + 1, 2))
        for v in range(begin.size):
            totals[v + 1, 0] = totals[v, 0] + end[v] - begin[v]
            totals[v + 1, 1] = totals[v, 1] + _sum_differences(sums, begin[v], end[v], k)
        first = last = np.int64(0)
        for j in range(n_windows):
            a, b = j * step, j * step + window - 2 * k + 1
            first, last = _interval_at(end, a, first), _interval_at(end, b, last)
            count, total = _sum_before(b, last, begin, sums, totals, k)
            earlier_count, lower = _sum_before(a, first, begin, sums, totals, k)
            slope = (
                (total - lower) / (float(k) * k * (count - earlier_count))
                if count > earlier_count
                else np.nan
            )
            out[j, i] = slope
    return out

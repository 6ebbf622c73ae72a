"""Fit the sampling period to all unbroken pieces of a log."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gyrostab.ingest.grid.jitter import JitterModel, count_samples
from gyrostab.ingest.grid.starting_period import GAIN, SECOND, Stamps, readable_stamps
from gyrostab.kernels.grid.stamps import NO_STAMP, piece_sums, track
from gyrostab.store.threads import map_in_order

_MAX_PIECES = 200_000


def longest_step(parts: list[NDArray[np.int64]], period: float) -> float:
    """Return the step [ns] after which counting restarts when rows are placed by count."""
    steps = np.concatenate([np.diff(part) for part in parts])
    return float(max(SECOND, 50 * period, 10 * np.quantile(np.abs(steps), 0.99)))


def fit_pieces(
    stamps: Stamps,
    period: float,
    counted: bool,
    coarse: bool,
    longest: float,
    jitter: JitterModel | None = None,
) -> NDArray[np.float64]:
    """Sum each unbroken piece: n, mean count, mean stamp [ns], cc, ct, squared residuals."""

    def sum_block(
        block: tuple[NDArray[np.int64], NDArray[np.int64]],
    ) -> tuple[tuple[int, int] | None, NDArray[np.float64]]:
        """Return first stamp, reference stamp and sums of the pieces of a block."""
        values = block[1]
        readable = readable_stamps(values)
        if len(readable) == 0:
            return None, np.empty((0, 6))
        first = int(readable[0])
        if jitter is not None:
            readable, count, piece = count_samples(np.arange(len(values)), values, jitter, longest)
        elif counted:
            piece = np.concatenate([[0], np.cumsum(np.abs(np.diff(readable)) > longest)])
            count = np.flatnonzero(values != NO_STAMP)  # rows without a readable stamp count too
        else:
            count, piece = track(readable, period, GAIN, longest)
        tick = np.flatnonzero(np.diff(readable)) + 1
        if coarse and jitter is None and tick.size > 1:
            # the time is exact only where the stamp changes
            readable, count, piece = readable[tick], count[tick], piece[tick]
        sums = piece_sums(readable, count, piece, period)
        return (first, int(readable[0])) if len(readable) else None, sums

    table = np.empty((0, 6))
    zero: int | None = None
    for first, sums in map_in_order(sum_block, stamps()):
        if first is None:
            continue
        zero = first[0] if zero is None else zero
        sums[:, 2] += first[1] - zero
        table = np.concatenate([table, sums])
        if len(table) > _MAX_PIECES:  # keep the largest pieces
            table = table[np.argsort(-table[:, 3], kind="stable")[: _MAX_PIECES // 2]]
            table = table[np.argsort(table[:, 2], kind="stable")]
    return table


def pool_pieces(
    pieces: NDArray[np.float64], period: float, counted: bool
) -> tuple[float, float, float]:
    """Pool the pieces: period [ns], three standard errors [ns], longest stretch [samples]."""
    n, cc, ct, residuals = pieces[:, 0], pieces[:, 3], pieces[:, 4], pieces[:, 5]
    if cc.sum() <= 0:
        return period, period, 1.0
    noise = np.sqrt(residuals.sum() / max(1.0, n.sum() - 2 * len(n)))
    slope = ct / np.where(cc > 0, cc, 1.0)
    sane = (cc > 0) & (
        np.abs(slope / period - 1) < 0.02 + 5 * noise / period / np.sqrt(np.maximum(cc, 1e-9))
    )
    if sane.any():
        period = float(ct[sane].sum() / cc[sane].sum())
    error = 3.0 * noise / np.sqrt(cc[sane].sum() if sane.any() else cc.sum())
    if counted or not sane.any():  # no piece has the initial period: nothing to join
        return period, error, float(n.max())
    return _join_pieces(pieces[sane], period, error, noise)


def _join_pieces(
    pieces: NDArray[np.float64], period: float, error: float, noise: float
) -> tuple[float, float, float]:
    """Join pieces whose distance is reliably a whole number of samples, and fit again."""
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

"""Find the sampling period, and the most likely sequence of samples, of jittered time stamps.

A stamp that is a time of arrival gives the time of its sample only up to jitter, but thousands of
stamps give the sampling period to parts per million and the number of lost samples exactly. Rows
stay in order; `gyrostab.kernels.grid.course` finds where samples are missing. If rows arrive in
packets, or a slow clock gives many rows one stamp, only one row of each group is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.ingest.grid.starting_period import (
    SECOND,
    TRACK_GAIN,
    Block,
    Parts,
    Stamps,
    find_steps,
    readable_stamps,
)
from gyrostab.kernels.grid.course import LOSS_NATS, follow
from gyrostab.kernels.grid.stamps import NO_STAMP, piece_sums, track
from gyrostab.store.threads import map_in_order

#: Smallest standard deviation of the jitter that is passed to the kernel [samples].
MIN_SIGMA = 0.1

#: Gain with which the phase follows a deviation, in the search for the period and afterwards. An
#: undetected loss costs 1 / (4 gain sigma^2) nats before the phase has absorbed it: 140 at a
#: scatter of 0.6 samples, compared with 5 for a loss and 30 for a row without a sample.
_SEARCH_GAIN, GAIN = 0.02, 0.005

#: Largest scatter [samples]; beyond it, an undetected loss costs less than 80 nats.
_MAX_SIGMA = 0.8

#: Largest scatter of stamps [samples] at which a period is found if losses cost less [nats], with
#: one row in ten after a loss: uniform phases, which agree with any period, scatter by 0.37.
_MAX_LOSSY_SIGMA, _LOSSY_NATS = 0.35, 2.2

#: Largest share of rows without a sample, and largest cost of a row [nats], of stamps that fit the
#: model. Jitter alone costs 0.5 nats; every second sample missing at random costs 2.5 more.
_MAX_DROPPED_SHARE, _MAX_NATS = 0.01, 3.0

#: Rows used in the search, candidates for the period, and candidates that are refined.
_SEARCH_ROWS, _MAX_CANDIDATES, _MAX_REFINED = 8_000, 200, 4

#: Relative step of candidate periods. With half of it as error, the phase, which follows with a
#: gain of 0.02, lags by a fortieth of a sample.
_PERIOD_STEP = 0.001

TRACE_ROWS = 1 << 13
_MAX_PIECES = 200_000  # that are fitted


@dataclass(frozen=True)
class JitterModel:
    """Sampling period and jitter of noisy stamps."""

    period: float  # sampling period [ns]
    sigma: float  # standard deviation of the jitter [samples]
    #: Rows whose stamps are used: ``"all"``, the ``"first"`` or the ``"last"`` of each group of
    #: rows with one stamp.
    observe: str
    group: float  # mean number of rows for each used stamp
    nats: float  # cost of a row
    loss_nats: float = LOSS_NATS  # cost of a loss, in the search for the sequence of samples
    #: Whether few rows have no sample, some steps are single samples, and the cost is that of
    #: jitter.
    fits: bool = True

    @property
    def code_length(self) -> float:
        """Code length of a stamp to the nanosecond, including the cost of its row [nats]."""
        return self.nats + float(np.log(max(self.sigma, MIN_SIGMA) * self.period))


def observe_rows(stamps: Ints, observe: str, period: float) -> Ints:
    """Select the rows whose stamps are used; the last row of a block counts as end of its group."""
    readable = np.flatnonzero(stamps != NO_STAMP)
    if observe == "all" or len(readable) == 0:
        return readable
    apart = np.diff(stamps[readable]) > 0.5 * period
    edge = np.ones(1, dtype=bool)
    return np.asarray(
        readable[np.concatenate([edge, apart] if observe == "first" else [apart, edge])]
    )


def fit_jitter(
    parts: Parts, guesses: list[tuple[float, float]], observe: str, *, sure: float
) -> JitterModel | None:
    """Fit the sampling period that explains stretches of stamps best, with lost samples.

    The stamps are `NO_STAMP` where unreadable. `guesses` are periods [ns] and jitter [samples] to
    try in addition to those found in the stretches; `observe` names the rows to use (see
    `JitterModel`); `sure` is the number of samples over which counting by the first estimate of the
    period is reliable.
    """
    observed = _observe_parts(parts, observe, guesses[0][0])
    group = _rows_per_group(observed)
    sure *= max(1.0, group)
    started = [*_start_on_lines(observed, observe, group, sure), *guesses]
    models = [
        _refine_model(observed, JitterModel(period, sigma, observe, group, np.inf), sure)
        for period, sigma in started
    ]
    known = [
        model
        for model in filter(None, models)
        if model.sigma <= _MAX_LOSSY_SIGMA or model.loss_nats > _LOSSY_NATS
    ]
    explained = min(known, key=lambda jitter: jitter.code_length, default=None)
    # the best may fit stamps of doubled rows
    return explained if explained is not None and explained.fits else None


def _start_on_lines(
    observed: list[Block], observe: str, group: float, sure: float
) -> list[tuple[float, float]]:
    """Return the best periods [ns] near the slopes of stretches, and their jitter [samples]."""
    # with lost samples, only few consecutive groups are complete
    lengths = (32, 16) if observe == "all" else (8,)
    lines = next(filter(None, (_fit_lines(observed, length) for length in lengths)), None)
    if lines is None or not (lines[0] > 0).any():
        return []
    slope, scatter = (values[lines[0] > 0] for values in lines)
    sigma_ns = float(np.median(scatter))
    if sigma_ns > _MAX_SIGMA * float(np.median(slope)):
        return []
    periods = _candidate_periods(observed, slope, group)
    n_rows = max(64, _SEARCH_ROWS // len(observed))
    sample = [(count[:n_rows], stamps[:n_rows]) for count, stamps in observed]
    best = sorted(periods, key=lambda period: _row_cost(sample, period, sigma_ns, sure))
    return [(period, sigma_ns / period) for period in best[:_MAX_REFINED]]


def fit_jitter_near(
    parts: Parts, period: float, observe: str, *, sure: float
) -> JitterModel | None:
    """Fit the jitter model near a given period [ns]; None if the stamps do not fit it."""
    observed = _observe_parts(parts, observe, period)
    group = _rows_per_group(observed)
    model = _refine_model(
        observed,
        JitterModel(period, 0.5, observe, group, np.inf),
        sure * max(1.0, group),
        most_off=0.02,
    )
    return model if model is not None and model.fits else None


def _rows_per_group(observed: list[Block]) -> float:
    """Return the mean number of rows for each used stamp."""
    return float(
        sum(count[-1] - count[0] for count, _ in observed)
        / max(1, sum(len(count) - 1 for count, _ in observed))
    )


def _observe_parts(parts: Parts, observe: str, period: float) -> list[Block]:
    observed = []
    for part in parts:
        rows = observe_rows(part, observe, period)[1:-1]
        if len(rows) > 1:
            observed.append((rows, part[rows]))
    return observed


def _fit_lines(observed: list[Block], length: int) -> tuple[Floats, Floats] | None:
    """Fit lines to stretches of `length` stamps: slopes [ns a row], residual sigma [ns]."""
    tables = [
        np.lib.stride_tricks.sliding_window_view(np.stack(block), length, axis=1)[:, :: length // 2]
        for block in observed
        if len(block[0]) >= length
    ]
    if not tables:
        return None
    table = np.concatenate(tables, axis=1)
    count, stamps = (table - table[:, :, :1]).astype(np.float64)
    count -= count.mean(axis=1, keepdims=True)
    stamps -= stamps.mean(axis=1, keepdims=True)
    slope = (count * stamps).sum(axis=1) / (count**2).sum(axis=1)
    residuals = stamps - slope[:, None] * count
    return slope, np.sqrt((residuals**2).sum(axis=1) / (length - 2))


def _candidate_periods(observed: list[Block], slope: Floats, group: float) -> list[float]:
    """Return candidate periods [ns] near the smaller slopes; losses increase slopes."""
    longer = _fit_lines(observed, 128)
    min_slope = 0.2 * np.median(slope)
    slopes = slope[slope > min_slope]
    if longer is not None and (longer[0] > min_slope).sum() >= 16 and group < 2:
        slopes = longer[0][longer[0] > min_slope]
    low, high = np.quantile(slopes, [0.05, 0.6])
    low, high = low * 0.995, max(high * 1.005, np.median(slope))
    steps = int(min(np.ceil(np.log(high / low) * group / _PERIOD_STEP), _MAX_CANDIDATES)) + 1
    return [float(period) for period in np.geomspace(low, high, steps)]


def _row_cost(observed: list[Block], period: float, sigma_ns: float, sure: float) -> float:
    """Return the mean cost of a row [nats] for a period [ns]."""
    sigma = max(sigma_ns / period, MIN_SIGMA)
    total = sum(
        follow(count, stamps, period, sigma, _SEARCH_GAIN, sure * period, LOSS_NATS, TRACE_ROWS)[3]
        for count, stamps in observed
    )
    return float(total / sum(len(count) for count, _ in observed))


def _follow_rows(
    count: Ints, stamps: Ints, jitter: JitterModel, gain: float, longest: float
) -> tuple[Ints, Ints, Floats, float]:
    """Return sample and piece of each row, its distance from the sample [samples], and the cost."""
    law = jitter.period, max(jitter.sigma, MIN_SIGMA), gain, longest, jitter.loss_nats
    sample, piece, off, nats = follow(count, stamps, *law, TRACE_ROWS)
    return sample, piece, off, nats


def _refine_model(
    observed: list[Block], jitter: JitterModel, sure: float, *, most_off: float = 0.05
) -> JitterModel | None:
    """Refine period and jitter along the sequence of samples; None if the fit fails."""
    if not observed:
        return None
    start, period, sigma = jitter.period, jitter.period, jitter.sigma
    for gain in (_SEARCH_GAIN, _SEARCH_GAIN / 2, GAIN, GAIN):
        cc = ct = nats = rows = dropped = single = steps = 0.0
        offs, losses = [], []
        for count, stamps in observed:
            sample, piece, off, cost = _follow_rows(count, stamps, jitter, gain, sure * period)
            is_near = _is_near(off, sigma)
            sums = piece_sums(stamps[is_near], sample[is_near], piece[is_near], period)
            cc, ct = cc + sums[:, 3].sum(), ct + sums[:, 4].sum()
            nats, rows = nats + cost, rows + len(count)
            is_unbroken = np.diff(piece) == 0
            sample_step, count_step = np.diff(sample)[is_unbroken], np.diff(count)[is_unbroken]
            dropped += (np.maximum(count_step - sample_step, 0)).sum()
            single, steps = single + (sample_step == count_step).sum(), steps + len(sample_step)
            offs.append(off)
            losses.append(np.maximum(sample_step - count_step, 0))
        if cc <= 0:
            return None
        period = float(ct / cc)
        sigma = 1.4826 * float(np.median(np.abs(np.concatenate(offs))))
        correction, loss_nats = _price_losses(np.concatenate(losses), jitter.loss_nats)
        jitter = replace(jitter, period=period, sigma=sigma, loss_nats=loss_nats)
        nats += correction
        if not abs(period / start - 1) < most_off or sigma > 2 * _MAX_SIGMA:
            return None
    fits = (
        sigma < _MAX_SIGMA
        and dropped <= 2 + _MAX_DROPPED_SHARE * rows
        and nats < _MAX_NATS * rows
        and single > 0.1 * steps
    )
    return replace(jitter, nats=nats / rows, fits=fits)


def _price_losses(lost: Ints, loss_nats: float) -> tuple[float, float]:
    """Return corrections of the cost of samples lost before each row, and of a loss [nats].

    The first is the code length of all losses less their cost in the search for the sequence of
    samples; the second cost follows from the share of rows after losses.
    """
    shares = np.unique(lost, return_counts=True)[1] / max(1, len(lost))
    gaps = lost[lost > 0]
    cost = loss_nats * len(gaps) + float(np.log(gaps).sum())
    share = float(np.clip(len(gaps) / max(1, len(lost)), 1e-9, 0.5))
    correction = -len(lost) * float(shares @ np.log(shares)) - cost
    return correction, min(LOSS_NATS, float(np.log((1 - share) / share)))


def _is_near(off: Floats, sigma: float) -> Bools:
    """Return which stamps are not outliers; late rows must not bias the period."""
    return np.asarray(np.abs(off) <= 4 * max(sigma, MIN_SIGMA))


def number_used_rows(
    rows: Ints, stamps: Ints, jitter: JitterModel, longest: float
) -> tuple[Ints, Ints, Ints]:
    """Return stamps [ns], sample numbers and piece numbers of the used rows of a block."""
    at = observe_rows(stamps, jitter.observe, jitter.period)
    if jitter.observe != "all":
        at = at[1:-1]  # the groups at both ends may be cut
    sample, piece, off, _ = _follow_rows(rows[at], stamps[at], jitter, GAIN, longest)
    is_near = _is_near(off, jitter.sigma)
    return stamps[at][is_near], sample[is_near], piece[is_near]


def longest_step(parts: Parts, period: float) -> float:
    """Return the step [ns] after which counting restarts when rows are placed by count."""
    steps = find_steps(parts)
    return float(max(SECOND, 50 * period, 10 * np.quantile(np.abs(steps), 0.99)))


def fit_pieces(
    stamps: Stamps,
    period: float,
    counted: bool,
    coarse: bool,
    longest: float,
    jitter: JitterModel | None = None,
) -> Floats:
    """Sum each unbroken piece: n, mean count, mean stamp [ns], cc, ct, squared residuals."""

    def sum_block(block: Block) -> tuple[Ints, Floats]:
        """Return the first stamp of a block that is used, if any, and the sums of its pieces."""
        values = block[1]
        readable = readable_stamps(values)
        if jitter is not None:
            readable, count, piece = number_used_rows(
                np.arange(len(values)), values, jitter, longest
            )
        elif counted:
            piece = np.cumsum(np.abs(np.diff(readable, prepend=readable[:1])) > longest)
            count = np.flatnonzero(values != NO_STAMP)  # rows without a readable stamp count too
        else:
            count, piece = track(readable, period, TRACK_GAIN, longest)
        tick = np.flatnonzero(np.diff(readable)) + 1
        if coarse and jitter is None and tick.size > 1:
            # the time is exact only where the stamp changes
            readable, count, piece = readable[tick], count[tick], piece[tick]
        return readable[:1], piece_sums(readable, count, piece, period)

    table = np.empty((0, 6))
    zero: int | None = None
    for first, sums in map_in_order(sum_block, stamps()):
        if len(first) == 0:
            continue
        zero = int(first[0]) if zero is None else zero
        sums[:, 2] += int(first[0]) - zero
        table = np.concatenate([table, sums])
        if len(table) > _MAX_PIECES:  # keep the largest pieces
            table = table[np.argsort(-table[:, 3], kind="stable")[: _MAX_PIECES // 2]]
            table = table[np.argsort(table[:, 2], kind="stable")]
    return table


def pool_pieces(pieces: Floats, period: float, counted: bool) -> tuple[float, float, float]:
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
    pieces: Floats, period: float, error: float, noise: float
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

"""How much better block means are explained by two levels between which the bias hops than by free random walk and flicker.

Where the bias stands on which level is told by the means themselves, so the course that they tell
is no column of known form: what it gains as one is only counted beyond what it costs to say it. The
sum is a lower bound of the logarithm of the Bayes factor of the hopping bias, whatever the random
walk and the flicker beside it: for the law q of courses that the means and white noise give,
against the law p that none were seen for, the evidence is at least that of the mean course less
``KL(q, p)`` and less the scatter of q, ``D^2 / 2 sum var / sigma^2``. What Gauss-Markov noise does,
a random walk does better than two levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.products import WIDTHS, Products, mean_products, pairs_of, take_out
from gyrostab.diagnose.evidence.wandering import known_wander
from gyrostab.kernels.regression.evidence import mixed_evidence
from gyrostab.kernels.regression.levels import level_tables, levels_smooth

__all__ = [
    "MEAN_SWITCHES",
    "TelegraphCourses",
    "course_evidence",
    "telegraph_courses",
    "telegraph_evidence",
    "usual_courses",
    "waves",
]

Array = NDArray[np.float64]
#: Parts of a block, each on one level.
PARTS = 4
#: Hops that it takes: one or two are jumps.
MEAN_SWITCHES = 5.0
_SHORTEST, _FIRST = (
    0.5,
    5.0,
)  # blocks: the shortest mean time on a level, and the one that the search begins with
#: Quantiles of the means that may be levels.
STARTS = ((0.05, 0.95), (0.25, 0.75), (0.05, 0.5), (0.5, 0.95))
_TRIAL, _ROUNDS, _MANY_ROUNDS, _STILL = 3, 14, 60, 0.01
_DRIFTS = (0, 8)  # waves of a drift


@dataclass(frozen=True)
class TelegraphCourses:
    """Biases of two levels, one for every record.

    Attributes
    ----------
    share, spread : ndarray, shape (record, block)
        Share of each block on the upper level, and the variance of what is known of it.
    step : ndarray, shape (record,)
        Upper level less the lower one [degree hour-1].
    times : ndarray, shape (record, 2)
        Mean times on the lower and on the upper level [blocks].
    hops : ndarray, shape (record,)
        Expected number.
    cost : ndarray, shape (record,)
        Of saying the course [nats].
    log : ndarray, shape (record,)
        Logarithm of the likelihood of the means, white noise and all.
    scale : ndarray, shape (record,)
        Scatter over the white variance.
    """

    share: Array
    spread: Array
    step: Array
    times: Array
    hops: Array
    cost: Array
    log: Array
    scale: Array


def telegraph_courses(
    values: Array,
    variance: Array,
    present: NDArray[np.bool_],
    beside: Array,
    *,
    starts: Sequence[tuple[float, float]] = STARTS,
    least: float = 1.0,
    components: int = PARTS,
) -> TelegraphCourses:
    """Courses of biases of two levels in white noise, by expectation and maximisation from several starts.

    Parameters
    ----------
    values : ndarray, shape (block, record)
        Block means [degree hour-1].
    variance : ndarray, shape (block,)
        White variance of the means, of which the scatter may be more.
    present : ndarray of bool, shape (block,)
        Blocks that are used.
    beside : ndarray, shape (block, column)
        Columns of free size, the first of them constant.
    starts : sequence of (float, float)
        Quantiles of the means that may be the levels.
    least : float
        Of the white variance, that the scatter may be.
    components : int
        Of a block, at least.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> values = np.repeat([0.0, 1.0, 0.0, 1.0, 0.0, 1.0], 10) + 0.1 * rng.standard_normal(60)
    >>> found = level_courses(values[:, None], np.full(60, 0.01), np.ones(60, bool), np.ones((60, 1)))
    >>> found.step.round(1), found.hops.round()
    (array([1.]), array([5.]))
    """
    y = np.where(present, values.T, 0.0)
    weight = np.where(present, 1.0 / np.where(present, variance, 1.0), 0.0)
    plain = np.linalg.lstsq(beside * np.sqrt(weight)[:, None], (y * np.sqrt(weight)).T, rcond=None)[
        0
    ].T
    level = np.quantile((y - plain @ beside.T)[:, present], np.unique(starts), axis=1)
    tried = []
    for start in starts:
        first, last = (level[int(np.searchsorted(np.unique(starts), one))] for one in start)
        size = np.concatenate([plain, (last - first)[:, None]], axis=1)
        size[:, 0] += first
        fit = _Fit(size, np.full((len(y), 2), _FIRST), np.ones(len(y)))
        tried.append(_improved(fit, y, weight, beside, _TRIAL, least))
    chosen = np.argmax([log for _, log in tried], axis=0)
    size, times, scale = (
        _picked([getattr(fit, name) for fit, _ in tried], chosen)
        for name in ("size", "times", "scale")
    )
    best = _Fit(size, times, scale)
    best, _ = _improved(best, y, weight, beside, _ROUNDS, least)
    told = _told(best, y, weight, beside)
    if components > PARTS:
        finer, _ = _improved(
            _Fit(best.size, best.times, np.ones(len(y)), components),
            y,
            weight,
            beside,
            _MANY_ROUNDS,
            least,
        )
        told = _told(finer, y, weight, beside)
    return told


@dataclass(frozen=True)
class _Fit:
    """Sizes of the columns and of the step (record, column), mean times (record, 2), the scale of the noise (record,); parts of a block."""

    size: Array
    times: Array
    scale: Array
    components: int = PARTS


def _picked(several: Sequence[Array], chosen: NDArray[np.int64]) -> Array:
    """Of several arrays over records the one that is chosen for each record."""
    return np.asarray(np.stack(several)[chosen, np.arange(chosen.size)])


def _smoothed(
    fit: _Fit, y: Array, weight: Array, beside: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Log likelihood, share and its square, steps up, and the sum of squares over the white variance."""
    left = y - fit.size[:, :-1] @ beside.T
    step = fit.size[:, -1]
    levels = step[:, None, None] * np.arange(fit.components + 1) / fit.components
    log = -0.5 * (weight / fit.scale[:, None])[..., None] * (left[..., None] - levels) ** 2
    most = log.max(axis=2)
    chance, rises = level_tables(fit.times[:, 0], fit.times[:, 1], fit.components)
    start = fit.times / fit.times.sum(axis=1, keepdims=True)
    found, share, square, up = levels_smooth(np.exp(log - most[..., None]), chance, rises, start)
    seen = weight > 0.0
    found = (
        found
        + most.sum(axis=1)
        + 0.5 * (np.log(weight[seen] / (2.0 * np.pi)).sum() - seen.sum() * np.log(fit.scale))
    )
    away = (left - step[:, None] * share) ** 2 + step[:, None] ** 2 * (square - share**2)
    return found, share, square, up, away @ weight


def _improved(
    fit: _Fit, y: Array, weight: Array, beside: Array, rounds: int, least: float
) -> tuple[_Fit, Array]:
    """Expectation and maximisation, until nothing moves; and the log likelihood."""
    n, count = y.shape[1], int((weight > 0.0).sum())
    still = _STILL / np.sqrt(np.median(weight[weight > 0.0]))
    gram = (beside * weight[:, None]).T @ beside
    right = (y * weight) @ beside
    log, share, square, up, total = _smoothed(fit, y, weight, beside)
    for _ in range(rounds):
        normal = np.empty((len(y), len(gram) + 1, len(gram) + 1))
        normal[:, :-1, :-1] = gram
        normal[:, -1, :-1] = normal[:, :-1, -1] = (share * weight) @ beside
        normal[:, -1, -1] = square @ weight
        normal += (
            1e-9 * np.eye(len(gram) + 1) * (np.einsum("rii->ri", normal)[:, None, :] + weight.max())
        )
        sums = np.concatenate([right, ((y * share) @ weight)[:, None]], axis=1)
        size = np.linalg.solve(normal, sums[..., None])[..., 0]
        high = share.sum(axis=1)
        down = np.maximum(up + share[:, 0] - share[:, -1], 0.0)
        times = np.stack([(n - high + 0.5) / (up + 0.5), (high + 0.5) / (down + 0.5)], axis=1)
        moved = np.abs(size - fit.size).max()
        slow = rounds == _MANY_ROUNDS and np.abs(np.log(times / fit.times)).max() > _STILL
        fit = _Fit(
            size,
            np.clip(times, _SHORTEST * PARTS / fit.components, n),
            np.maximum(total / count, least),
            fit.components,
        )
        log, share, square, up, total = _smoothed(fit, y, weight, beside)
        if moved < still and not slow:
            break
    return fit, log


def _told(fit: _Fit, y: Array, weight: Array, beside: Array) -> TelegraphCourses:
    """What a fit says, with the upper level above the lower one."""
    log, share, square, up, total = _smoothed(fit, y, weight, beside)
    seen = weight > 0.0
    spread = np.maximum(square - share**2, 0.0)
    expected = -0.5 * (
        total / fit.scale
        - np.log(weight[seen] / (2.0 * np.pi)).sum()
        + seen.sum() * np.log(fit.scale)
    )
    hops = 2.0 * up + share[:, 0] - share[:, -1]
    turned = fit.size[:, -1] < 0.0
    return TelegraphCourses(
        share=np.where(turned[:, None], 1.0 - share, share),
        spread=spread,
        step=np.abs(fit.size[:, -1]),
        times=np.where(turned[:, None], fit.times[:, ::-1], fit.times),
        hops=hops,
        cost=expected - log + _unknown(hops, y.shape[1]),
        log=log,
        scale=fit.scale,
    )


def usual_courses(
    found: TelegraphCourses,
    variance: Array,
    present: NDArray[np.bool_],
    *,
    components: int,
    count: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Logarithms of the likelihood (record,), and shares (record, block), that means of two levels have that hop as it was found.

    Parameters
    ----------
    found : Courses
        Of one record.
    variance, present
        As for `telegraph_courses`.
    components : int
        Of a block.
    count : int
        Records that are drawn.
    """
    n, (low, high) = present.size, found.times[0]
    share = np.stack([_drawn_course(n, low, high, rng) for _ in range(count)])
    noise = np.sqrt(variance * found.scale[0]) * rng.standard_normal(share.shape)
    y = np.where(present, found.step[0] * share + noise, 0.0)
    size = np.tile([0.0, found.step[0]], (count, 1))
    fit = _Fit(
        size, np.tile(found.times[0], (count, 1)), np.full(count, found.scale[0]), components
    )
    return _smoothed(
        fit, y, np.where(present, 1.0 / np.where(present, variance, 1.0), 0.0), np.ones((n, 1))
    )[:2]


def _drawn_course(n: int, low: float, high: float, rng: np.random.Generator) -> Array:
    """Share of n blocks on the upper level, for mean times on both levels [blocks]."""
    first = int(rng.random() < high / (low + high))
    pairs = 16 + int(2.0 * n / (low + high))
    mean = np.array([low, high])[(np.arange(2 * pairs) + first) % 2]
    at, up = [0.0], [0.0]
    while at[-1] < n:
        stay = rng.exponential(mean)
        at += list(at[-1] + np.cumsum(stay))
        up += list(up[-1] + np.cumsum(stay * ((np.arange(2 * pairs) + first) % 2)))
    return np.diff(np.interp(np.arange(n + 1.0), at, up))


def _unknown(hops: Array, block_count: int) -> Array:
    """What it costs that both mean times are not known [nats]: the logarithm of each is, to the root of one over its hops."""
    return np.asarray(
        2.0 * np.log(max(np.log(2.0 * block_count), 1.0))
        + np.maximum(np.log(np.maximum(hops, 1.0) / (4.0 * np.pi)), 0.0)
    )


def telegraph_evidence(
    data: xr.Dataset, baseline: xr.Dataset, *, axis: str, given: Array | None = None
) -> tuple[Array, TelegraphCourses]:
    """Gains of a bias of two levels on an axis.

    Parameters
    ----------
    data : xarray.Dataset
        Reduced data, one record or many with the same gaps: ``mean`` ((record,) axis block) [degree
        hour-1].
    baseline : xarray.Dataset
        As for `gyrostab.diagnose.evidence.held_out.mean_factors`.
    axis : str
    given : ndarray, shape (block, column), optional
        Columns that are in the model with and without it (effects already named).

    Returns
    -------
    evidence_nats : ndarray, shape (record,)
        Lower bound of the log Bayes factor [nats]; -inf where there are fewer than `MEAN_SWITCHES`
        hops.
    courses : Courses
    """
    mean = (data["mean"] - baseline["known_mean"]).sel(axis=axis)
    values = (
        (mean if "record" in mean.dims else mean.expand_dims("record"))
        .transpose("block", "record")
        .values
    )
    variance = baseline["mean_variance"].sel(axis=axis).values
    present = np.asarray(np.isfinite(values).all(axis=1)) & np.isfinite(variance)
    n = present.size
    own = np.empty((n, 0)) if given is None else np.where(np.isfinite(given), given, 0.0)
    most = np.abs(own).max(axis=0)
    own = own / np.where(most > 0.0, most, 1.0)
    frame: dict[str, Any] = {
        "variance": variance,
        "step": float(data["end"][0] - data["begin"][0]),
        "present": present,
        "wander": known_wander(baseline, axis),
    }
    grid: dict[str, Any] = {
        name: baseline[f"grid_{name}"].sel(axis=axis).values for name in ("K", "B")
    }
    log_weight = baseline["grid_prior"].sel(axis=axis).values
    safe = np.where(present[:, None], values, 0.0)
    tried = []
    for count in _DRIFTS:
        found = telegraph_courses(
            safe, variance, present, np.concatenate([waves(n, count), own], axis=1)
        )
        worth = _worth(found, safe, own, frame, grid, log_weight) - np.log(len(_DRIFTS))
        tried.append((np.where(found.hops >= MEAN_SWITCHES, worth, -np.inf), found))
    chosen = np.argmax([evidence_nats for evidence_nats, _ in tried], axis=0)
    best = TelegraphCourses(
        *(
            _picked([getattr(one, item.name) for _, one in tried], chosen)
            for item in fields(TelegraphCourses)
        )
    )
    return _picked([evidence_nats for evidence_nats, _ in tried], chosen), best


def waves(n: int, count: int) -> Array:
    """A constant, and slow waves that stand for a drift while the course is sought."""
    return np.asarray(np.cos(np.pi * (np.arange(n)[:, None] + 0.5) / n * np.arange(count + 1)))


def _worth(
    found: TelegraphCourses,
    values: Array,
    given: Array,
    frame: dict[str, Any],
    grid: dict[str, Any],
    log_weight: Array,
) -> Array:
    """Evidence of the courses over that of none, less what they cost; the scatter of a course counts as a datum that has no step."""
    records, beside = values.shape[1], given.shape[1]
    columns = np.concatenate([found.share.T, given], axis=1)
    present, variance = frame["present"], frame["variance"]
    scatter = found.spread @ np.where(present, 1.0 / np.where(present, variance, 1.0), 0.0)
    white = mean_products(values[:, :0], columns, **frame, K=np.zeros(1), B=np.zeros(1))
    square = np.diagonal(white.gram[0])
    wide = np.where(square[records:] > 0.0, square[records:], 1.0) / WIDTHS[-1] ** 2
    pairs = pairs_of(columns.shape[1], [], beside)
    products = take_out(
        mean_products(values, columns, **frame, **grid, pairs=pairs), beside, np.diag(wide)
    )
    usual = np.diagonal(take_out(white, beside, np.diag(wide)).gram[0])
    weight = log_weight - np.logaddexp.reduce(log_weight)
    out = np.empty(records)
    for r in range(records):
        none, two = course_evidence(products, r, scatter[r], weight, unit=usual[r])
        out[r] = two - none
    return out - found.cost


def course_evidence(
    products: Products, place: int, scatter: float, log_weight: Array, *, unit: float
) -> tuple[float, float]:
    """Logarithms of the evidence of no course and of one, over a grid of the noise.

    Parameters
    ----------
    products : Products
        Of records and courses, in the same number.
    place : int
        Of the record and its course.
    scatter : float
        Of the course, over the white variance.
    log_weight : ndarray, shape (grid,)
        Of the grid points.
    unit : float
        Square of the course over the white variance; the prior of the step has the widths of all
        factors.
    """
    base = (log_weight - 0.5 * (products.square[:, place] + products.log_determinant))[None]
    size = 1.0 / np.sqrt(max(unit + scatter, 1e-300))
    rotated = np.ascontiguousarray((products.cross[:, place, place] * size)[None, None, :, None])
    eigenvalues = np.maximum((products.gram[:, place, place] + scatter) * size**2, 0.0)[
        None, :, None
    ]
    two = float(mixed_evidence(base, rotated, eigenvalues, np.square(WIDTHS))[0, 0])
    return float(np.logaddexp.reduce(base[0])), two

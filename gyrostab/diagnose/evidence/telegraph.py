"""Evidence in block means of a bias that switches between two levels, over free walk and flicker.

The means themselves determine when the bias is on which level. The course is therefore not a column
of known form, and the evidence of its column counts only minus the cost of specifying the course.
The difference is a lower bound of the log Bayes factor, whatever the random walk and flicker are:
with the distribution q of courses given the means and white noise, and p without the means, the
evidence is at least that of the mean course minus ``KL(q, p)`` and minus the scatter of q,
``D^2 / 2 sum var / sigma^2`` (the variational bound). A random walk explains Gauss-Markov noise
better than two levels do.

A bias that follows something that was not recorded also steps up and down, but what drives it
seldom has the same size twice. An arbitrary course of levels, in which each visit to a level has
its own height, therefore competes with two levels. With few visits, or small ones, the means cannot
tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.diagnose.evidence.held_out import mean_residual
from gyrostab.diagnose.evidence.mixture import products_mixture
from gyrostab.diagnose.evidence.products import (
    WIDTHS,
    Products,
    axis_noise,
    column_pairs,
    marginalise,
    mean_products,
    scale_columns,
)
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.regression.evidence import mixed_evidence
from gyrostab.kernels.regression.levels import level_tables, levels_smooth

#: Parts of a block, each on one level. Design choice.
PARTS_PER_BLOCK = 4
_MIN_TIME_BLOCKS = 0.5  # shortest mean time on a level
_START_TIME_BLOCKS = 5.0  # mean time at the start of the search; design choice
#: Quantiles of the means that start the levels.
START_QUANTILES = ((0.05, 0.95), (0.25, 0.75), (0.05, 0.5), (0.5, 0.95))
_TRIAL_ROUNDS, _ROUNDS, _FINE_ROUNDS = 3, 14, 60  # of expectation and maximisation; limit time
_CONVERGED = 0.01  # in white noise deviations, or in the logarithm of a time
DRIFT_WAVES = (0, 8)  # slow cosines in the model while the course is searched; design choice
_HEIGHT_SCATTER = 0.5  # of an arbitrary course, relative to its step; design choice


class TelegraphCourses(NamedTuple):
    """Biases of two levels, one for every record, which is the first dimension."""

    share: Floats  # (record, block): share of each block on the upper level
    spread: Floats  # (record, block): its variance
    step: Floats  # upper minus lower level [degree hour-1]
    times: Floats  # (record, 2): mean times on the lower and on the upper level [blocks]
    switch_count: Floats  # expected number of switches
    cost: Floats  # of specifying the course [nats]
    log: Floats  # log likelihood of the means, including white noise
    scale: Floats  # scatter relative to the expected white variance


def telegraph_courses(
    values: Floats,
    variance: Floats,
    present: Bools,
    columns_given: Floats,
    *,
    starts: Sequence[tuple[float, float]] = START_QUANTILES,
    min_scatter: float = 1.0,
    parts: int = PARTS_PER_BLOCK,
) -> TelegraphCourses:
    """Fit biases of two levels in white noise, by expectation-maximisation from several starts.

    Only the block means (block, record) [degree hour-1] that are `present` count. `min_scatter` is
    the lowest ratio of scatter to white variance (block,). The given columns (block, column) have
    free sizes; the first one is constant. The levels start at quantiles of the means. A block has
    so many parts, at least `PARTS_PER_BLOCK`.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> values = np.repeat([0.0, 1.0, 0.0, 1.0, 0.0, 1.0], 10) + 0.1 * rng.standard_normal(60)
    >>> variance, present, constant = np.full(60, 0.01), np.ones(60, bool), np.ones((60, 1))
    >>> found = telegraph_courses(values[:, None], variance, present, constant)
    >>> found.step.round(1), found.switch_count.round()
    (array([1.]), array([5.]))
    """
    y = np.where(present, values.T, 0.0)
    weight = np.where(present, 1.0 / np.where(present, variance, 1.0), 0.0)
    plain = np.linalg.lstsq(
        columns_given * np.sqrt(weight)[:, None], (y * np.sqrt(weight)).T, rcond=None
    )[0].T
    residual = (y - plain @ columns_given.T)[:, present]
    attempts = []
    for start in starts:
        first, last = np.quantile(residual, start, axis=1)
        size = np.concatenate([plain, (last - first)[:, None]], axis=1)
        size[:, 0] += first
        fit = _Fit(size, np.full((len(y), 2), _START_TIME_BLOCKS), np.ones(len(y)))
        attempts.append(_maximise(fit, y, weight, columns_given, _TRIAL_ROUNDS, min_scatter))
    chosen = np.argmax([log for _, log in attempts], axis=0)
    by_attempt = zip(*((fit.size, fit.times, fit.scale) for fit, _ in attempts), strict=True)
    size, times, scale = (_select_by_record(arrays, chosen) for arrays in by_attempt)
    best = _Fit(size, times, scale)
    best, _ = _maximise(best, y, weight, columns_given, _ROUNDS, min_scatter)
    if parts > PARTS_PER_BLOCK:
        finer = best._replace(scale=np.ones(len(y)), parts=parts)
        best, _ = _maximise(finer, y, weight, columns_given, _FINE_ROUNDS, min_scatter)
    return _make_courses(best, y, weight, columns_given)


class _Fit(NamedTuple):
    """State of the fit by record."""

    size: Floats  # (record, column): sizes of the columns and of the step
    times: Floats  # (record, 2): mean times
    scale: Floats  # (record,): scale of the noise
    parts: int = PARTS_PER_BLOCK  # of a block


def _select_by_record(arrays: Sequence[Floats], chosen: Ints) -> Floats:
    """Select for each record one of several arrays over records."""
    return np.asarray(np.stack(arrays)[chosen, np.arange(chosen.size)])


def _smooth_courses(
    fit: _Fit, y: Floats, weight: Floats, columns_given: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return log likelihood, share and its square, steps up, and sum of weighted squares."""
    residual = y - fit.size[:, :-1] @ columns_given.T
    step = fit.size[:, -1]
    levels = step[:, None, None] * np.arange(fit.parts + 1) / fit.parts
    log = -0.5 * (weight / fit.scale[:, None])[..., None] * (residual[..., None] - levels) ** 2
    largest_log = log.max(axis=2)
    chance, rises = level_tables(fit.times[:, 0], fit.times[:, 1], fit.parts)
    start = fit.times / fit.times.sum(axis=1, keepdims=True)
    log_likelihood, share, square, up = levels_smooth(
        np.exp(log - largest_log[..., None]), chance, rises, start
    )
    present = weight > 0.0
    log_likelihood = (
        log_likelihood
        + largest_log.sum(axis=1)
        + 0.5 * (np.log(weight[present] / (2.0 * np.pi)).sum() - present.sum() * np.log(fit.scale))
    )
    away = (residual - step[:, None] * share) ** 2 + step[:, None] ** 2 * (square - share**2)
    return log_likelihood, share, square, up, away @ weight


def _maximise(
    fit: _Fit, y: Floats, weight: Floats, columns_given: Floats, rounds: int, min_scatter: float
) -> tuple[_Fit, Floats]:
    """Iterate expectation and maximisation until convergence; return also the log likelihood."""
    n, count = y.shape[1], int((weight > 0.0).sum())
    tolerance = _CONVERGED / np.sqrt(np.median(weight[weight > 0.0]))
    gram = (columns_given * weight[:, None]).T @ columns_given
    right = (y * weight) @ columns_given
    log, share, square, up, total = _smooth_courses(fit, y, weight, columns_given)
    for _ in range(rounds):
        normal = np.empty((len(y), len(gram) + 1, len(gram) + 1))
        normal[:, :-1, :-1] = gram
        normal[:, -1, :-1] = normal[:, :-1, -1] = (share * weight) @ columns_given
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
        slow = rounds == _FINE_ROUNDS and np.abs(np.log(times / fit.times)).max() > _CONVERGED
        fit = _Fit(
            size,
            np.clip(times, _MIN_TIME_BLOCKS * PARTS_PER_BLOCK / fit.parts, n),
            np.maximum(total / count, min_scatter),
            fit.parts,
        )
        log, share, square, up, total = _smooth_courses(fit, y, weight, columns_given)
        if moved < tolerance and not slow:
            break
    return fit, log


def _make_courses(fit: _Fit, y: Floats, weight: Floats, columns_given: Floats) -> TelegraphCourses:
    """Return the courses of a fit, with the upper level above the lower one."""
    log, share, square, up, total = _smooth_courses(fit, y, weight, columns_given)
    present = weight > 0.0
    spread = np.maximum(square - share**2, 0.0)
    expected = -0.5 * (
        total / fit.scale
        - np.log(weight[present] / (2.0 * np.pi)).sum()
        + present.sum() * np.log(fit.scale)
    )
    switch_count = 2.0 * up + share[:, 0] - share[:, -1]
    turned = fit.size[:, -1] < 0.0
    return TelegraphCourses(
        share=np.where(turned[:, None], 1.0 - share, share),
        spread=spread,
        step=np.abs(fit.size[:, -1]),
        times=np.where(turned[:, None], fit.times[:, ::-1], fit.times),
        switch_count=switch_count,
        cost=expected - log + _time_cost(switch_count, y.shape[1]),
        log=log,
        scale=fit.scale,
    )


def simulated_courses(
    courses: TelegraphCourses,
    variance: Floats,
    present: Bools,
    *,
    parts: int,
    count: int,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Simulate `count` records of two levels with the parameters of one record.

    Return log likelihoods (record,) and shares (record, block).
    """
    n, (low, high) = present.size, courses.times[0]
    share = np.stack([_simulate_course(n, low, high, rng) for _ in range(count)])
    noise = np.sqrt(variance * courses.scale[0]) * rng.standard_normal(share.shape)
    y = np.where(present, courses.step[0] * share + noise, 0.0)
    size = np.tile([0.0, courses.step[0]], (count, 1))
    fit = _Fit(size, np.tile(courses.times[0], (count, 1)), np.full(count, courses.scale[0]), parts)
    return _smooth_courses(
        fit, y, np.where(present, 1.0 / np.where(present, variance, 1.0), 0.0), np.ones((n, 1))
    )[:2]


def _simulate_course(n: int, low: float, high: float, rng: np.random.Generator) -> Floats:
    """Simulate the share of n blocks on the upper level, for mean times on both levels [blocks]."""
    first = int(rng.random() < high / (low + high))
    pairs = 16 + int(2.0 * n / (low + high))
    mean = np.array([low, high])[(np.arange(2 * pairs) + first) % 2]
    at, up = [0.0], [0.0]
    while at[-1] < n:
        stay = rng.exponential(mean)
        at += list(at[-1] + np.cumsum(stay))
        up += list(up[-1] + np.cumsum(stay * ((np.arange(2 * pairs) + first) % 2)))
    return np.diff(np.interp(np.arange(n + 1.0), at, up))


def _time_cost(switch_count: Floats, block_count: int) -> Floats:
    """Return the cost of both unknown mean times [nats].

    The logarithm of each is known to one over the root of its switches.
    """
    return np.asarray(
        2.0 * np.log(max(np.log(2.0 * block_count), 1.0))
        + np.maximum(np.log(np.maximum(switch_count, 1.0) / (4.0 * np.pi)), 0.0)
    )


def telegraph_evidence(
    data: xr.Dataset,
    baseline: xr.Dataset,
    *,
    axis: str,
    given: Floats | None = None,
    settings: Settings = DEFAULTS,
) -> tuple[Floats, TelegraphCourses]:
    """Compute the evidence of a bias of two levels on an axis, and its course.

    The evidence (record,) is a lower bound of the log Bayes factor [nats], -inf with fewer than
    `min_switches` switches. Data, baseline and given columns are as in
    `gyrostab.diagnose.evidence.held_out.mean_factors`.
    """
    values = mean_residual(data, baseline, axis)
    setup = axis_noise(baseline, axis)
    variance = setup["variance"]
    present = np.asarray(np.isfinite(values).all(axis=1)) & np.isfinite(variance)
    n = present.size
    scaled_given = scale_columns(given, n)
    setup |= {"step": float(data["end"].values[0] - data["begin"].values[0]), "present": present}
    log_weight = axis_values(baseline, "grid_prior", axis)
    safe = np.where(present[:, None], values, 0.0)
    evidence_nats, attempts = [], []
    for count in DRIFT_WAVES:
        columns = np.concatenate([drift_waves(n, count), scaled_given], axis=1)
        courses = telegraph_courses(safe, variance, present, columns)
        worth = _course_evidence_by_record(courses, safe, scaled_given, setup, log_weight)
        has_switches = courses.switch_count >= settings.min_switches
        evidence_nats.append(np.where(has_switches, worth - np.log(len(DRIFT_WAVES)), -np.inf))
        attempts.append(courses)
    chosen = np.argmax(evidence_nats, axis=0)
    by_attempt = zip(*attempts, strict=True)
    best = TelegraphCourses(*(_select_by_record(arrays, chosen) for arrays in by_attempt))
    return _select_by_record(evidence_nats, chosen), best


def drift_waves(n: int, count: int) -> Floats:
    """Return a constant and `count` slow cosines, (n, 1 + count), that approximate a drift."""
    return np.asarray(np.cos(np.pi * (np.arange(n)[:, None] + 0.5) / n * np.arange(count + 1)))


def _course_evidence_by_record(
    courses: TelegraphCourses,
    values: Floats,
    given: Floats,
    setup: dict[str, Any],
    log_weight: Floats,
) -> Floats:
    """Return the evidence of the courses minus their cost; their scatter counts as a datum."""
    records, columns_given = values.shape[1], given.shape[1]
    columns = np.concatenate([courses.share.T, given], axis=1)
    present, variance = setup["present"], setup["variance"]
    scatter = courses.spread @ np.where(present, 1.0 / np.where(present, variance, 1.0), 0.0)
    white = mean_products(values[:, :0], columns, **(setup | {"K": np.zeros(1), "B": np.zeros(1)}))
    square = np.diagonal(white.gram[0])
    wide = np.where(square[records:] > 0.0, square[records:], 1.0) / WIDTHS[-1] ** 2
    pairs = column_pairs(columns.shape[1], [], columns_given)
    products = marginalise(
        mean_products(values, columns, **setup, pairs=pairs), columns_given, np.diag(wide)
    )
    usual = np.diagonal(marginalise(white, columns_given, np.diag(wide)).gram[0])
    weight = log_weight - np.logaddexp.reduce(log_weight)
    out = np.empty(records)
    for r in range(records):
        none, two = course_evidence(products, r, scatter[r], weight, unit=usual[r])
        out[r] = two - none
    return out - courses.cost


def course_evidence(
    products: Products, place: int, scatter: float, log_weight: Floats, *, unit: float
) -> tuple[float, float]:
    """Compute log evidences without and with a course, averaged over a noise grid.

    `place` is the index of the record and its course in the products. The variance of the course,
    `scatter`, and its square, `unit`, are relative to the white variance; the latter is the scale
    of the prior of the step (`WIDTHS`).
    """
    base = (log_weight - 0.5 * (products.square[:, place] + products.log_determinant))[:, None]
    size = 1.0 / np.sqrt(max(unit + scatter, 1e-300))
    rotated = (products.cross[:, place, place] * size)[:, None, None, None]
    eigenvalues = np.maximum((products.gram[:, place, place] + scatter) * size**2, 0.0)
    eigenvalues = eigenvalues[:, None, None]
    two = float(mixed_evidence(base, rotated, eigenvalues, np.square(WIDTHS))[0, 0])
    return float(np.logaddexp.reduce(base[:, 0])), two


class Visits(NamedTuple):
    """Visits to the levels of a bias."""

    #: Log Bayes factor of different heights over equal ones; minus infinity with more visits than
    #: blocks, whose heights cannot be known.
    unequal_nats: float
    switch_count: int  # between visits that have more than half of some block or part
    columns: Floats  # (column, block): visits to the level whose heights differ more


def visit_columns(share: Floats) -> Floats:
    """Split the share of each block on a level into the visits to it, (visit, block).

    A visit has more than half of some block. What is left between two visits belongs to the nearer.

    Examples
    --------
    >>> visit_columns(np.array([0.0, 0.9, 1.0, 0.2, 0.0, 0.8])).tolist()
    [[0.0, 0.9, 1.0, 0.2, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 0.8]]
    """
    inside = np.concatenate([[False], share > 0.5, [False]])
    begin, end = np.flatnonzero(np.diff(inside)).reshape(-1, 2).T
    if not begin.size:
        return np.empty((0, share.size))
    border = (end[:-1] + begin[1:]) / 2.0
    visit = np.searchsorted(border, np.arange(share.size) + 0.5)
    return np.where(visit == np.arange(begin.size)[:, None], share, 0.0)


def compare_visits(
    mean: Floats,
    baseline: xr.Dataset,
    share: Floats,
    *,
    axis: str,
    block_s: float,
    given: Floats | None = None,
) -> Visits:
    """Compute the evidence that the visits to one of the levels have different heights.

    Both levels are equally likely to be that level. The share is that of each block, or (block,
    part) of its parts, on the upper level.
    """
    y = mean - axis_values(baseline, "known_mean", axis)
    present = np.isfinite(y)
    parts = share.reshape(y.size, -1)
    levels = [
        visit_columns(level_share.ravel()).reshape(-1, *parts.shape).mean(axis=2)
        for level_share in (parts, 1.0 - parts)
    ]
    switch_count = max(sum(len(visits) for visits in levels) - 1, 0)
    course = parts.mean(axis=1)
    if switch_count > y.size:
        return Visits(-np.inf, switch_count, course[None])
    effect_columns = scale_columns(given, y.size)
    columns = np.column_stack([course, effect_columns, *(visits.T for visits in levels)])
    products = mean_products(
        np.where(present, y, 0.0)[:, None],
        np.where(present[:, None], columns, 0.0),
        step=block_s,
        present=present,
        **axis_noise(baseline, axis),
    )
    base_count = 1 + effect_columns.shape[1]
    log_weight = axis_values(baseline, "grid_prior", axis)
    same, step = _log_evidence(products, np.arange(base_count), base_count, 0.0, log_weight)
    first = base_count + np.cumsum([0, *(len(visits) for visits in levels)])
    free = [
        _log_evidence(
            products,
            np.concatenate([np.arange(base_count), np.arange(begin, end)]),
            base_count,
            (_HEIGHT_SCATTER * step) ** 2,
            log_weight,
        )[0]
        for begin, end in pairwise(first)
    ]
    evidence_nats = float(np.logaddexp.reduce(free) - np.log(len(free)) - same)
    return Visits(evidence_nats, switch_count, levels[int(np.argmax(free))])


def _log_evidence(
    products: Products, chosen: Ints, base_count: int, variance: float, log_weight: Floats
) -> tuple[float, float]:
    """Return the log evidence of columns, with a prior beyond `base_count`; and the step."""
    part = products._replace(
        cross=products.cross[:, chosen], gram=products.gram[:, chosen[:, None], chosen]
    )
    width = chosen.size - base_count
    if width:
        part = marginalise(part, width, np.eye(width) / variance)
    mixture = products_mixture(part, log_weight)
    return mixture.evidence, float(mixture.weights() @ mixture.mean[:, 0])

"""Evidence in block means that a bias does not return to the same levels.

A bias that follows something that was not recorded also steps up and down, but what drives it
seldom has the same size twice. An arbitrary course of levels, in which each visit to a level has
its own height, therefore competes with two levels. With few visits, or small ones, the means cannot
tell.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.mixture import products_mixture
from gyrostab.diagnose.evidence.products import (
    Products,
    axis_noise,
    marginalise,
    mean_products,
    scale_columns,
)
from gyrostab.diagnose.reduce.schema import axis_values

Array = NDArray[np.float64]
#: Standard deviation of the heights of an arbitrary course over its step. Design choice.
_SCATTER = 0.5


class Visits(NamedTuple):
    """Visits to the levels of a bias."""

    #: Log Bayes factor of different heights over equal ones; minus infinity with more visits than
    #: blocks, whose heights cannot be known.
    unequal_nats: float
    switch_count: int  # between visits that have more than half of some block or part
    columns: Array  # (column, block): visits to the level whose heights differ more


def visit_columns(share: Array) -> Array:
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
    mean: Array,
    baseline: xr.Dataset,
    share: Array,
    *,
    axis: str,
    block_s: float,
    given: Array | None = None,
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
            (_SCATTER * step) ** 2,
            log_weight,
        )[0]
        for begin, end in pairwise(first)
    ]
    evidence_nats = float(np.logaddexp.reduce(free) - np.log(len(free)) - same)
    return Visits(evidence_nats, switch_count, levels[int(np.argmax(free))])


def _log_evidence(
    products: Products,
    chosen: NDArray[np.int64],
    base_count: int,
    variance: float,
    log_weight: Array,
) -> tuple[float, float]:
    """Return the log evidence of columns, those after `own` with a prior variance; and the step."""
    part = products._replace(
        cross=products.cross[:, chosen], gram=products.gram[:, chosen[:, None], chosen]
    )
    width = chosen.size - base_count
    if width:
        part = marginalise(part, width, np.eye(width) / variance)
    mixture = products_mixture(part, log_weight)
    return mixture.evidence, float(mixture.weights() @ mixture.mean[:, 0])

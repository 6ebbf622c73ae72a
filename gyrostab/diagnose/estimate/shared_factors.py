"""Factors of noise that axes share: the record tells their products, and their low-pass no better than the bands do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Variant, rebuild_variant
from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.linear_model import State, cross_column, pair_rows
from gyrostab.diagnose.predict.sizes import component_mixture

__all__ = ["estimate_shared_factors"]

Array = NDArray[np.float64]
_DRAWS = 1000
_ROUNDS = 50
_WIDEST, _NARROWEST, _STEPS, _FINE = 1.5, 40.0, 11, 12  # low-passes, as parts of the sampling rate
_ORDER = 0.05  # by which the level below a low-pass is another where it has two poles
_ENDS = (0.025, 0.975)


def estimate_shared_factors(
    components: Sequence[Component], axes: tuple[str, ...], state: State
) -> dict[str, tuple[float, ...]]:
    """Factor of every axis, with its standard error and the ends of its 95 % interval, and the low-pass of what is shared.

    White noise and low-passes of any bandwidth are weighed by the cross-spectra of all pairs. No
    axis shares more than it has. One pair tells a product alone: its factors then lie anywhere
    between what the other axis and the axis itself have at most.

    Parameters
    ----------
    components : sequence of Part
        In the view "cross".
    axes : tuple of str
        Of the effect.
    state : State
        With all else that is named.

    Returns
    -------
    dict of str to (float, float, float, float)
        Value, standard error, low and high; ``bandwidth`` [Hz] is infinite for white noise.
    """
    name = components[0].variant.columns[0]
    rows = [row for row in pair_rows(state.blocks) if set(row) <= set(axes)]
    rng = np.random.default_rng(0)
    seen = _seen(components[0], rows, axes, state)
    chosen = rng.choice(seen.share.size, size=_DRAWS, p=seen.share)
    product = seen.product[chosen] + seen.error[chosen] * rng.standard_normal((_DRAWS, len(rows)))
    limit = seen.limit[chosen]
    factor = (
        _of_pair(product[:, 0], limit, rng)
        if len(axes) == 2
        else _of_many(product, rows, axes, limit)
    )
    white = np.isinf(seen.width)
    factor *= np.exp(np.where(white[chosen], 0.0, _ORDER) * rng.standard_normal(_DRAWS))[:, None]
    plain = bool(seen.share[white].sum() >= 0.5)
    alike = white[chosen] == plain
    sizes: dict[str, tuple[float, ...]] = {
        name if len(axes) == 1 else f"{name}.{axis}": _told(factor[:, k], alike)
        for k, axis in enumerate(axes)
    }
    if "bandwidth" in components[0].variant.values:
        width = seen.width[chosen][alike]
        sizes["bandwidth"] = (
            (math.inf, 0.0) if plain else _told(width, np.ones(width.size, np.bool_))
        )
    return sizes


def _told(draws: Array, alike: NDArray[np.bool_]) -> tuple[float, float, float, float]:
    """Median of the draws of the likelier kind, and spread and ends of all."""
    low, high = np.quantile(draws, _ENDS)
    return float(np.median(draws[alike])), float((high - low) / 3.919928), float(low), float(high)


class _Seen(NamedTuple):
    """What the cross-spectra say of white noise, and of low-passes.

    Attributes
    ----------
    width : ndarray, shape (point,)
        Bandwidth [Hz].
    share : ndarray, shape (point,)
        Probability.
    product, error : ndarray, shape (point, pair)
        Of the factors.
    limit : ndarray, shape (point, axis)
        The largest factor that the power of the axis leaves room for.
    """

    width: Array
    share: Array
    product: Array
    error: Array
    limit: Array


def _seen(
    component: Component, rows: Sequence[tuple[str, ...]], axes: tuple[str, ...], state: State
) -> _Seen:
    """White noise is as likely beforehand as all low-passes together; what lies between two bandwidths of the grid is smooth."""
    from scipy.interpolate import CubicSpline

    rate = float(state.blocks.attrs["sampling_rate_hz"])
    grid = np.geomspace(rate / _NARROWEST, rate / _WIDEST, _STEPS)
    widths = (
        np.append(grid, math.inf)
        if "bandwidth" in component.variant.values
        else np.array([math.inf])
    )
    table = np.array([_of_width(component, float(width), rows, axes, state) for width in widths])
    prior = np.zeros(1)
    if widths.size > 1:
        fine = np.geomspace(grid[0], grid[-1], _FINE * (_STEPS - 1) + 1)
        between = CubicSpline(np.log(grid), table[:-1])(np.log(fine))
        widths, table = np.append(fine, math.inf), np.concatenate([between, table[-1:]])
        prior = np.append(np.full(fine.size, -math.log(fine.size)), 0.0)
    log, count = prior + table[:, 0], len(rows)
    share = np.exp(log - np.logaddexp.reduce(log))
    return _Seen(
        widths,
        share,
        table[:, 1 : 1 + count],
        table[:, 1 + count : 1 + 2 * count],
        table[:, 1 + 2 * count :],
    )


def _of_width(
    component: Component,
    width: float,
    rows: Sequence[tuple[str, ...]],
    axes: tuple[str, ...],
    state: State,
) -> Array:
    """Logarithm of the likelihood of a low-pass, products of the factors of each pair, their errors, and limits of the axes."""
    variant = component.variant
    if "bandwidth" in variant.values:
        other = replace(variant, values={**variant.values, "bandwidth": width})
        variant = (
            rebuild_variant(component.candidate, other, state.blocks, state.baseline["coefficient"])
            or variant
        )
    moments = [
        component_mixture(replace(component, row=row), state, variant).moments() for row in rows
    ]
    product, square = (
        np.array([float(one.flat[0]) for one in several]) for several in zip(*moments, strict=True)
    )
    limit = [_level(axis, variant, state) for axis in axes]
    return np.concatenate(
        [[0.5 * float((product**2 / square).sum())], product, np.sqrt(square), limit]
    )


def _level(axis: str, variant: Variant, state: State) -> float:
    """The largest factor that the power of an axis leaves room for."""
    blocks = state.blocks
    row = next(number for number, pair in enumerate(pair_rows(blocks)) if axis in pair)
    design = cross_column(variant.design[0], row, blocks).real
    power, shape = (
        blocks[name].sel(axis=axis).transpose("block", "band").values for name in ("power", "shape")
    )
    weight = (
        np.where(np.isfinite(power) & np.isfinite(shape), shape, 0.0)
        / state.weight[state.axes.index(axis)] ** 2
    )
    return math.sqrt(
        float((weight * design * np.nan_to_num(power)).sum() / (weight * design**2).sum())
    )


def _of_pair(product: Array, limit: Array, rng: np.random.Generator) -> Array:
    """Factors of two axes (draw, axis): each as likely at any share of its range, in logarithms."""
    size = np.minimum(np.abs(product), limit.prod(axis=1))
    low, high = size / limit[:, 1], limit[:, 0]
    first = low * (high / low) ** rng.random(size.size)
    return np.stack([first, np.sign(product) * size / first], axis=1)


def _of_many(
    product: Array, rows: Sequence[tuple[str, ...]], axes: tuple[str, ...], limit: Array
) -> Array:
    """Factors (draw, axis) whose products are nearest to those of the pairs, of the sign in which they agree with the first of all."""
    place = {row: number for number, row in enumerate(rows)}
    matrix = np.zeros((product.shape[0], len(axes), len(axes)))
    for (i, one), (j, other) in combinations(enumerate(axes), 2):
        number = place[one, other] if (one, other) in place else place[other, one]
        matrix[:, i, j] = matrix[:, j, i] = product[:, number]
    diagonal = np.arange(len(axes))
    for _ in range(_ROUNDS):
        values, vectors = np.linalg.eigh(matrix)
        factor = vectors[..., -1] * np.sqrt(np.maximum(values[:, -1:], 0.0))
        matrix[:, diagonal, diagonal] = factor**2
    best = np.linalg.eigh(np.median(matrix, axis=0))[1][:, -1]
    best = best * np.sign(best[np.abs(best).argmax()])
    factor = np.where((factor @ best)[:, None] >= 0.0, factor, -factor)
    return np.asarray(np.clip(factor, -limit, limit))

"""Estimate how much of a common noise each axis has.

The record determines only the products of the factors of two axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.predict.average_sizes import Size
from gyrostab.diagnose.predict.candidates import Component, Variant
from gyrostab.diagnose.predict.linear_model import State, cross_column, pair_rows
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.predict.windows import rebuild_variant
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.settings import INTERVAL_TAILS
from gyrostab.noise import NORMAL_95

DRAWS = 1000  # of the posterior: 25 beyond each end of a 95 % interval
FACTOR_ROUNDS = 50  # of the iteration for a matrix of rank 1
# Grid of low-passes: bandwidths as parts of the sampling rate, their number, and interpolation.
WIDEST_PART, NARROWEST_PART, BANDWIDTHS, FINE_STEPS = 1.5, 80.0, 13, 12
ORDER_ERROR = 0.05  # relative change of the level below a low-pass if it has two poles


def estimate_shared_factors(
    components: Sequence[Component], axes: tuple[str, ...], state: State
) -> dict[str, Size]:
    """Estimate the factor of every axis and the low-pass of the common noise.

    The cross-spectra of all pairs weight white noise and low-passes of any bandwidth. No axis has
    more common noise than noise. A single pair determines only a product: each factor then lies
    anywhere between the limits that the other axis and the axis itself set. ``bandwidth`` [Hz] is
    infinite for white noise.
    """
    name = components[0].variant.columns[0]
    rows = [row for row in pair_rows(state.blocks) if set(row) <= set(axes)]
    rng = np.random.default_rng(0)
    width, share, product, error, limit = _weight_bandwidths(components[0], rows, axes, state)
    chosen = rng.choice(share.size, size=DRAWS, p=share)
    product = product[chosen] + error[chosen] * rng.standard_normal((DRAWS, len(rows)))
    limit = limit[chosen]
    factor = (
        _draw_pair_factors(product[:, 0], limit, rng)
        if len(axes) == 2
        else _solve_factors(product, rows, axes, limit)
    )
    white = np.isinf(width)
    factor *= np.exp(np.where(white[chosen], 0.0, ORDER_ERROR) * rng.standard_normal(DRAWS))[
        :, None
    ]
    plain = bool(share[white].sum() >= 0.5)
    is_likelier = white[chosen] == plain
    sizes: dict[str, Size] = {
        name if len(axes) == 1 else f"{name}.{axis}": _summarise_draws(factor[:, k], is_likelier)
        for k, axis in enumerate(axes)
    }
    if "bandwidth" in components[0].variant.values:
        likely = width[chosen][is_likelier]
        sizes["bandwidth"] = (
            (math.inf, 0.0) if plain else _summarise_draws(likely, np.ones(likely.size, np.bool_))
        )
    return sizes


def _summarise_draws(draws: Floats, is_likelier: Bools) -> tuple[float, float, float, float]:
    """Return the median of the likelier draws, and spread and ends of the 95 % interval of all."""
    low, high = np.quantile(draws, INTERVAL_TAILS)
    return (
        float(np.median(draws[is_likelier])),
        float((high - low) / (2.0 * NORMAL_95)),
        float(low),
        float(high),
    )


def _weight_bandwidths(
    component: Component, rows: Sequence[tuple[str, ...]], axes: tuple[str, ...], state: State
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Weight the bandwidths by their likelihood, interpolated between those of the grid.

    White noise has the same prior probability as all low-passes together. Returned are bandwidths
    [Hz] and their probabilities (point,), products of the factors and their errors (point, pair),
    and the largest factor that the power of each axis allows (point, axis).
    """
    from scipy.interpolate import CubicSpline

    rate = float(state.blocks.attrs["sampling_rate_hz"])
    grid = np.geomspace(rate / NARROWEST_PART, rate / WIDEST_PART, BANDWIDTHS)
    widths = (
        np.append(grid, math.inf)
        if "bandwidth" in component.variant.values
        else np.array([math.inf])
    )
    table = np.array(
        [_score_bandwidth(component, float(width), rows, axes, state) for width in widths]
    )
    prior = np.zeros(1)
    if widths.size > 1:
        fine = np.geomspace(grid[0], grid[-1], FINE_STEPS * (BANDWIDTHS - 1) + 1)
        between = CubicSpline(np.log(grid), table[:-1])(np.log(fine))
        widths, table = np.append(fine, math.inf), np.concatenate([between, table[-1:]])
        prior = np.append(np.full(fine.size, -math.log(fine.size)), 0.0)
    log, count = prior + table[:, 0], len(rows)
    share = np.exp(log - np.logaddexp.reduce(log))
    product, error, limit = np.split(table[:, 1:], [count, 2 * count], axis=1)
    return widths, share, product, error, limit


def _score_bandwidth(
    component: Component,
    width: float,
    rows: Sequence[tuple[str, ...]],
    axes: tuple[str, ...],
    state: State,
) -> Floats:
    """Return log likelihood, products of the pairs, their errors, and limits for one bandwidth."""
    variant = component.variant
    if "bandwidth" in variant.values:
        changed = replace(variant, values={**variant.values, "bandwidth": width})
        variant = rebuild_variant(component.candidate, changed, state) or variant
    moments = [
        component_mixture(replace(component, row=row), state, variant).moments() for row in rows
    ]
    product, square = (
        np.array([float(moment.flat[0]) for moment in pair_moments])
        for pair_moments in zip(*moments, strict=True)
    )
    limit = [_max_factor(axis, variant, state) for axis in axes]
    return np.concatenate(
        [[0.5 * float((product**2 / square).sum())], product, np.sqrt(square), limit]
    )


def _max_factor(axis: str, variant: Variant, state: State) -> float:
    """Return the largest factor that the power of an axis allows."""
    blocks = state.blocks
    row = next(number for number, pair in enumerate(pair_rows(blocks)) if axis in pair)
    design = cross_column(variant.design[0], row, blocks).real
    power, shape = (axis_values(blocks, name, axis) for name in ("power", "shape"))
    weight = (
        np.where(np.isfinite(power) & np.isfinite(shape), shape, 0.0)
        / state.expected_power[state.axes.index(axis)] ** 2
    )
    return math.sqrt(
        float((weight * design * np.nan_to_num(power)).sum() / (weight * design**2).sum())
    )


def _draw_pair_factors(product: Floats, limit: Floats, rng: np.random.Generator) -> Floats:
    """Draw the factors of two axes (draw, axis), uniform in the logarithm over their range."""
    size = np.minimum(np.abs(product), limit.prod(axis=1))
    low, high = size / limit[:, 1], limit[:, 0]
    first = low * (high / low) ** rng.random(size.size)
    return np.stack([first, np.sign(product) * size / first], axis=1)


def _solve_factors(
    product: Floats, rows: Sequence[tuple[str, ...]], axes: tuple[str, ...], limit: Floats
) -> Floats:
    """Return the factors (draw, axis) whose products are nearest to those of the pairs.

    Their sign makes the largest of them positive.
    """
    place = {row: number for number, row in enumerate(rows)}
    matrix = np.zeros((product.shape[0], len(axes), len(axes)))
    for (i, axis), (j, other_axis) in combinations(enumerate(axes), 2):
        number = place[axis, other_axis] if (axis, other_axis) in place else place[other_axis, axis]
        matrix[:, i, j] = matrix[:, j, i] = product[:, number]
    diagonal = np.arange(len(axes))
    for _ in range(FACTOR_ROUNDS):
        values, vectors = np.linalg.eigh(matrix)
        factor = vectors[..., -1] * np.sqrt(np.maximum(values[:, -1:], 0.0))
        matrix[:, diagonal, diagonal] = factor**2
    best = np.linalg.eigh(np.median(matrix, axis=0))[1][:, -1]
    best = best * np.sign(best[np.abs(best).argmax()])
    factor = np.where((factor @ best)[:, None] >= 0.0, factor, -factor)
    return np.asarray(np.clip(factor, -limit, limit))

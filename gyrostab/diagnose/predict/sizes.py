"""Sizes of linear parameters and their errors: least squares on block means, weighted on cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.diagnose.evidence.held_out import mean_residual, noise_weight
from gyrostab.diagnose.evidence.mixture import Mixture, products_mixture
from gyrostab.diagnose.evidence.products import axis_noise, mean_products
from gyrostab.diagnose.predict.candidates import Component, Variant
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.kernels.regression.nonnegative import solve_bounded

_RIDGE = 1e-12  # of the trace of the Gram matrix, against singular columns


def mean_mixture(
    state: State, axis: str, columns: Sequence[Floats], *, variance: Floats | None = None
) -> Mixture:
    """Compute the sizes of columns of the block means of an axis, over the grid of K and B.

    The columns (block,) of named effects are free, as is the noise within its grid. The white
    variance of the means (block,) [degree2 hour-2] is that of the baseline unless it is given.
    """
    baseline = state.baseline
    y = mean_residual(state.blocks, baseline, axis)[:, 0]
    all_columns = [*columns, *state.given.get(("mean", axis), [])]
    stacked = np.stack(all_columns, axis=1) if all_columns else np.empty((y.size, 0))
    present = np.isfinite(y)
    size = np.abs(stacked - stacked.mean(axis=0)).max(axis=0)
    size = np.where(size > 0.0, size, 1.0)
    noise = axis_noise(baseline, axis)
    if variance is not None:
        noise["variance"] = variance
    products = mean_products(
        np.where(present, y, 0.0)[:, None],
        stacked / size,
        **noise,
        step=float(state.blocks.attrs["block_s"]),
        present=present,
    )
    mixture = products_mixture(products, noise_weight(baseline, axis, "free"), ridge=_RIDGE)
    own_count = len(columns)
    scale = size[:own_count]
    return Mixture(
        mixture.log_weight - np.log(scale).sum(),
        mixture.mean[:, :own_count] / scale,
        mixture.covariance[:, :own_count, :own_count] / np.outer(scale, scale),
    )


def component_mixture(
    component: Component, state: State, variant: Variant | None = None
) -> Mixture:
    """Compute the sizes of a component's columns, in units of the parameters (or squares).

    All effects of `state` are in the model.
    """
    return component.statistic.mixture(component, state, variant or component.variant)


def linear_mixture(component: Component, state: State, variant: Variant) -> Mixture:
    """Compute the sizes of columns in the linear model of a statistic, as one point.

    Powers that effects add cannot be negative, nor can what is left of the noise.
    """
    candidate = replace(component.candidate, variants=(variant,))
    row = candidate.statistic.rows(candidate, state).index(component.row)
    model = candidate.statistic.model([candidate], row, state.blocks, state)
    # several designs belong to a variant only for the rotation, where the place selects one
    design = model.designs[max(component.line_index, 0) if candidate.statistic.is_rotation else 0]
    columns = np.concatenate([design, model.given], axis=2).reshape(
        -1, design.shape[2] + model.given.shape[2]
    )
    weight = np.where(
        np.isfinite(model.weight) & np.isfinite(model.values[..., 0]), model.weight, 0.0
    ).ravel()
    values = np.where(weight > 0.0, np.nan_to_num(model.values[..., 0]).ravel(), 0.0)
    columns = np.where(np.isfinite(columns), columns, 0.0)
    size = np.sqrt(np.maximum((weight[:, None] * columns**2).sum(axis=0), 1e-300))
    columns = columns / size
    own_count = design.shape[2]
    precision = np.diagonal(model.precision)
    prior = np.concatenate(
        [np.zeros(own_count), np.where(precision < 0.0, 0.0, precision) / size[own_count:] ** 2]
    )
    normal = (columns * weight[:, None]).T @ columns + np.diag(prior + 1e-9)
    projected = columns.T @ (weight * values)
    least = 0.0 if variant.squared and component.statistic.is_power else -np.inf
    low = np.concatenate([np.full(own_count, least), model.low]) * size
    best = solve_bounded(normal, projected, low)
    log_likelihood = best @ projected - 0.5 * best @ normal @ best
    log_weight = log_likelihood - 0.5 * np.linalg.slogdet(normal)[1]
    mean, covariance = _own_sizes(normal, projected, low, own_count)
    scale = size[:own_count]
    # A column that is 0 everywhere has an infinite variance.
    with np.errstate(over="ignore"):
        own_covariance = covariance / np.outer(scale, scale)
    return Mixture(np.array([log_weight]), (mean / scale)[None], own_covariance[None])


def _own_sizes(
    normal: Floats, projected: Floats, low: Floats, own_count: int
) -> tuple[Floats, Floats]:
    """Return the first sizes and their covariance, from the normal equations of all.

    Each of them may be any number, so that its error tells how far from its bound it is, while all
    others are at their bounds or above.
    """
    mean, covariance = np.empty(own_count), np.zeros((own_count, own_count))
    for own in range(own_count):
        others = np.where(np.arange(low.size) == own, -np.inf, low)
        sizes = solve_bounded(normal, projected, others)
        used = np.flatnonzero(sizes > others)
        row = np.linalg.inv(normal[np.ix_(used, used)])[np.searchsorted(used, own)]
        mean[own] = sizes[own]
        is_own = used < own_count
        covariance[own, used[is_own]] = row[is_own]
    return mean, 0.5 * (covariance + covariance.T)


def disagreement_nats(size: Floats, weight: Floats) -> float:
    """Return half the chi-square of sizes of these weights about their mean."""
    mean = (weight * size).sum() / max(weight.sum(), 1e-300)
    return 0.5 * float((weight * (size - mean) ** 2).sum())


def component_size(component: Component, state: State) -> tuple[float, float]:
    """Return size and standard error of the first column."""
    mean, covariance = component_mixture(component, state).moments()
    return float(mean[0]), float(np.sqrt(covariance[0, 0]))

"""Posterior of the noise of one axis: Q and N from band powers, B and K from band powers and block means."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from gyrostab.diagnose.products import mean_products
from gyrostab.kernels.nonnegative import solve_nonnegative
from gyrostab.noise import HOUR

__all__ = ["Fit", "Posterior", "fit_squares", "floor_square", "noise_posterior", "scales", "summed"]

Array = NDArray[np.float64]
_DISAGREE = 8.0  # nats by which spectrum and means may differ about B and K


class Fit(NamedTuple):
    """What the band powers say, averaged over blocks: powers, columns (band, term), and shapes of the bands."""

    power: Array
    columns: Array
    weight: Array


class Posterior(NamedTuple):
    """Noise of one axis.

    Attributes
    ----------
    square, error : ndarray, shape (4,)
        Squares of Q, N, B, K that fit the band powers best, and their errors [squared units of the noise table].
    K, B, weight : ndarray, shape (cell,)
        Fine grid of K and B, and its share of the posterior.
    draws : ndarray, shape (draw, 4)
        Squares of Q, N, B, K in the band powers.
    slow : ndarray, shape (draw, 2)
        Squares of B and K in the block means; the same as in `draws` when `joined`.
    joined : bool
        Band powers and means agree about B and K.
    """

    square: Array
    error: Array
    K: Array
    B: Array
    weight: Array
    draws: Array
    slow: Array
    joined: bool


def summed(power: Array, shape: Array, columns: Array) -> Fit:
    """Average over blocks: power and shape (block, band), columns (block, band, term)."""
    use = np.where(np.isfinite(power) & np.isfinite(shape), shape, 0.0)
    total = use.sum(axis=0)
    some = total > 0.0
    safe = np.where(some, total, 1.0)
    mean = (use * np.nan_to_num(power)).sum(axis=0) / safe
    seen = np.einsum("ij,ijk->jk", use, columns) / safe[:, None]
    return Fit(mean[some], seen[some], total[some])


def fit_squares(fit: Fit) -> tuple[Array, Array]:
    """Non-negative squares of largest gamma likelihood (Whittle), and their Fisher information.

    Examples
    --------
    >>> columns = np.stack([np.arange(1.0, 9.0) ** 2, np.ones(8), 1.0 / np.arange(1.0, 9.0), np.arange(1.0, 9.0) ** -2], axis=1)
    >>> fit_squares(Fit(columns @ [0.1, 2.0, 0.0, 3.0], columns, np.full(8, 100.0)))[0].round(6)
    array([0.1, 2. , 0. , 3. ])
    """
    width = fit.columns.shape[1]
    square = np.zeros(width)
    square[1] = float((fit.weight * fit.power / fit.columns[:, 1]).sum() / fit.weight.sum())
    normal = np.zeros((width, width))
    for _ in range(50):
        spectrum = fit.columns @ square
        weight = fit.weight / spectrum**2
        normal = fit.columns.T @ (weight[:, None] * fit.columns)
        found = np.empty(width)
        solve_nonnegative(normal, fit.columns.T @ (weight * fit.power), (1 << width) - 1, found, 0)
        after = fit.columns @ np.maximum(found, 0.0)
        if not (after > 0.0).all():
            break
        square = np.maximum(found, 0.0)
        if np.abs(after / spectrum - 1.0).max() < 1e-9:
            break
    return square, normal


def floor_square(fit: Fit) -> float:
    """Square of N below which it is not followed: white noise hides in the least of the powers."""
    return 1e-3 * float(fit.power.min()) / HOUR


def scales(density: float, span: float) -> tuple[float, float]:
    """K and B that the means of a record just show, beside white noise of this density [degree2 hour-2 Hz-1]."""
    return float(np.sqrt(HOUR * 3.0 * density) / span), float(np.sqrt(density / span / 0.44))


def _fine_grid(density: float, span: float, step: float) -> tuple[Array, Array]:
    """Values of K and B from what cannot be seen in the means to what hides all white noise."""
    K, B = scales(density, span)
    top = 300.0 * span / step
    return (
        np.geomspace(0.1 * K, 0.1 * K * top, round(6.0 * np.log10(top))),
        np.geomspace(0.1 * B, 3.0 * B * np.sqrt(top), round(4.0 * np.log10(30.0 * np.sqrt(top)))),
    )


def _by_powers(fit: Fit, square: Array, K: Array, B: Array) -> tuple[Array, Array, Array]:
    """Log likelihood of the powers for every K, B (cell,) with the best Q and N; those, unbounded (cell, 2), and their information."""
    weight = fit.weight / (fit.columns @ square) ** 2
    near = fit.columns[:, :2]
    slow = np.outer(B**2, fit.columns[:, 2]) + np.outer(K**2, fit.columns[:, 3])
    normal = near.T @ (weight[:, None] * near)
    right = (weight * (fit.power - slow)) @ near
    best = np.linalg.solve(normal, right.T).T
    alone = np.maximum(right[:, 1] / normal[1, 1], 1e-6 * square[1])
    inside = np.asarray((best > 0.0).all(axis=1))
    used = np.where(inside[:, None], best, np.stack([np.zeros_like(alone), alone], axis=1))
    spectrum = used @ near.T + slow
    return np.asarray(-(fit.weight * (np.log(spectrum) + fit.power / spectrum)).sum(axis=1)), np.asarray(best), np.asarray(normal)


def _draw_near(mean: Array, covariance: Array, rng: np.random.Generator) -> Array:
    """Draws of the squares of Q and N about `mean` (draw, 2), that of Q above 0."""
    sd = float(np.sqrt(covariance[0, 0]))
    low = np.minimum(-mean[:, 0] / sd, 30.0)
    Q = np.maximum(mean[:, 0] - sd * ndtri(rng.random(len(mean)) * ndtr(-low)), 0.0)
    slope = float(covariance[0, 1] / covariance[0, 0])
    rest = float(np.sqrt(covariance[1, 1] - slope * covariance[0, 1]))
    return np.stack([Q, mean[:, 1] + slope * (Q - mean[:, 0]) + rest * rng.standard_normal(len(mean))], axis=1)


def noise_posterior(
    fit: Fit, mean: Array, variance: Array, present: NDArray[np.bool_], *, step: float, draws: int, rng: np.random.Generator
) -> Posterior:
    """Posterior of Q, N, B, K.

    Parameters
    ----------
    fit : Fit
        Band powers of the quiet blocks; columns in the order Q, N, B, K.
    mean, variance : ndarray, shape (block,)
        Block means [degree hour-1] and their white variance.
    present : ndarray of bool, shape (block,)
        Quiet blocks with a mean.
    step : float
        Length of a block [s].
    draws : int
        Draws from the posterior.
    rng : numpy.random.Generator
    """
    square, information = fit_squares(fit)
    density = HOUR * max(float(square[1]), floor_square(fit))
    coarse_K, coarse_B = _fine_grid(density, mean.size * step, step)
    K, B = (part.ravel() for part in np.meshgrid(coarse_K, coarse_B, indexing="ij"))
    values = np.where(present, mean, 0.0)[:, None]
    products = mean_products(values, np.empty((mean.size, 0)), variance=variance, step=step, K=K, B=B, present=present)
    slow = -0.5 * (products.square[:, 0] + products.log_determinant)
    fast, best, normal = _by_powers(fit, np.where(square > 0.0, square, 0.0), K, B)
    joined = bool(slow.max() + fast.max() - (slow + fast).max() < _DISAGREE)
    log = slow + fast if joined else slow
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    cell = rng.choice(weight.size, draws, p=weight)
    jitter = rng.random((draws, 2)) - 0.5
    inner = np.exp(2.0 * jitter * np.log([coarse_B[1] / coarse_B[0], coarse_K[1] / coarse_K[0]]))
    slow_draws = np.stack([B[cell] ** 2, K[cell] ** 2], axis=1) * inner
    scale = np.sqrt(np.diag(information))
    covariance = np.linalg.pinv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    error = np.sqrt(np.diag(covariance))
    if joined:
        spread = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        together = np.concatenate([_draw_near(best[cell], spread, rng), slow_draws], axis=1)
    else:
        together = np.maximum(square + error * rng.standard_normal((draws, 4)), 0.0)
    together[:, 1] = np.maximum(together[:, 1], 0.01 * square[1])
    return Posterior(square, error, K, B, weight, together, slow_draws, joined)

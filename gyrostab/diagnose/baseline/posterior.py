"""Posterior of the noise of one axis: Q and N from band powers, B and K from band powers and block means."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from gyrostab.diagnose.evidence.products import marginalise, mean_products
from gyrostab.kernels.regression.nonnegative import solve_nonnegative
from gyrostab.noise import HOUR

__all__ = [
    "Fit",
    "Posterior",
    "expected_of",
    "fit_squares",
    "floor_square",
    "noise_posterior",
    "scales",
    "summed",
]

Array = NDArray[np.float64]
_DISAGREE = 8.0  # nats by which spectrum and means may differ about B and K
_LEAST = 0.05  # of the expected powers, below which no size of an effect takes them
_AT_ONCE = 64  # points of the grid
_SHORTEST, _EVEN = 1e-3, 1e-12  # steps towards the best fit; and what rounding does to a likelihood
_WIDE = 1e-9  # precision of what effects do to the means, against that of one of them


class Fit(NamedTuple):
    """Band powers as a sum of noise terms and of effects.

    Attributes
    ----------
    power, weight : ndarray, shape (cell,)
        Powers, averaged over blocks, and the shapes of their gamma laws.
    columns : ndarray, shape (cell, 4)
        Of the noise terms.
    known : ndarray, shape (cell,), optional
        Power of effects that is known.
    beside : ndarray, shape (cell, column), optional
        Power of effects per unit of sizes that are free.
    precision : ndarray, shape (column,), optional
        Of normal priors of these sizes about 0.
    start : ndarray, shape (cell,), optional
        Expected powers to begin from; white noise by default.
    """

    power: Array
    columns: Array
    weight: Array
    known: Array | None = None
    beside: Array | None = None
    precision: Array | None = None
    start: Array | None = None

    def rest(self) -> Array:
        """Powers less what is known."""
        return self.power if self.known is None else self.power - self.known

    def free(self) -> tuple[Array, Array]:
        """Columns and precisions of the sizes that are free."""
        beside = np.empty((self.power.size, 0)) if self.beside is None else self.beside
        return beside, np.zeros(beside.shape[1]) if self.precision is None else self.precision


class Posterior(NamedTuple):
    """Noise of one axis.

    Attributes
    ----------
    square, error : ndarray, shape (4,)
        Squares of Q, N, B, K that fit the band powers best, and their errors [squared units of the
        noise table].
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
    """Non-negative squares of largest gamma likelihood (Whittle), and their Fisher information when the effects are free beside them.

    Examples
    --------
    >>> columns = np.stack([np.arange(1.0, 9.0) ** 2, np.ones(8), 1.0 / np.arange(1.0, 9.0), np.arange(1.0, 9.0) ** -2], axis=1)
    >>> fit_squares(Fit(columns @ [0.1, 2.0, 0.0, 3.0], columns, np.full(8, 100.0)))[0].round(6)
    array([0.1, 2. , 0. , 3. ])
    """
    square, normal, _ = _fitted(fit)
    return square, normal


def expected_of(fit: Fit) -> Array:
    """Expected powers where the likelihood is largest."""
    return _fitted(fit)[2]


def _fitted(fit: Fit) -> tuple[Array, Array, Array]:
    """Squares, their information, and the expected powers."""
    width = fit.columns.shape[1]
    square, normal = np.zeros(width), np.zeros((width, width))
    square[1] = max(
        float((fit.weight * fit.rest() / fit.columns[:, 1]).sum() / fit.weight.sum()), 0.0
    )
    spectrum = np.asarray(
        fit.columns @ square if fit.start is None else fit.start, dtype=np.float64
    )
    beside, precision = fit.free()
    alone = (
        not beside.shape[1] and fit.known is None and fit.start is None
    )  # else the likelihood is not that of these powers only
    for _ in range(50):
        weight = fit.weight / spectrum**2
        normal, right, to_noise, to_right = _without(
            beside, precision, fit.columns, fit.rest(), weight
        )
        found = np.empty(width)
        solve_nonnegative(normal, right, (1 << width) - 1, found, 0)
        after = np.asarray(fit.columns @ np.maximum(found, 0.0), dtype=np.float64)
        if beside.shape[1] or fit.known is not None:
            after = (
                after
                + (fit.power - fit.rest())
                + beside @ (to_right - to_noise @ np.maximum(found, 0.0))
            )
            after = np.asarray(np.maximum(after, _LEAST * spectrum))
        if not (after > 0.0).all():
            break
        component = _step(fit, spectrum, after) if alone else 1.0
        square = square + component * (np.maximum(found, 0.0) - square)
        after = spectrum + component * (after - spectrum)
        change = np.abs(after / spectrum - 1.0).max()
        spectrum = after
        if change < 1e-9:
            break
    return square, np.asarray(normal, dtype=np.float64), spectrum


def _step(fit: Fit, spectrum: Array, after: Array) -> float:
    """How far to go towards the next spectrum: all the way, or half as far until that is likelier; scoring goes too far where none fits."""
    least = _log_likelihood(fit, spectrum)
    component = 1.0
    while component > _SHORTEST and _log_likelihood(
        fit, spectrum + component * (after - spectrum)
    ) < least - _EVEN * abs(least):
        component *= 0.5
    return component


def _log_likelihood(fit: Fit, spectrum: Array) -> float:
    return -float((fit.weight * (np.log(spectrum) + fit.power / spectrum)).sum())


def _without(
    beside: Array, precision: Array, columns: Array, power: Array, weight: Array
) -> tuple[Array, Array, Array, Array]:
    """Normal equations of `columns` with the sizes of `beside` solved for; and what these are, ``to_right - to_noise @ squares``."""
    weighted = columns.T * weight
    normal, right = weighted @ columns, weighted @ power
    if not beside.shape[1]:
        return normal, right, np.empty((0, columns.shape[1])), np.empty(0)
    inner = (beside.T * weight) @ beside + np.diag(precision)
    inner += 1e-9 * np.diag(np.maximum(np.diagonal(inner), 1e-300))
    crossed = weighted @ beside
    to_noise = np.asarray(np.linalg.solve(inner, crossed.T), dtype=np.float64)
    to_right = np.asarray(np.linalg.solve(inner, (beside.T * weight) @ power), dtype=np.float64)
    return normal - crossed @ to_noise, right - crossed @ to_right, to_noise, to_right


def floor_square(fit: Fit) -> float:
    """Square of N below which it is not followed: white noise hides in the least of the powers."""
    return 1e-3 * max(float(np.min(fit.power)), np.finfo(float).tiny) / HOUR


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


def _by_powers(fit: Fit, spectrum: Array, K: Array, B: Array) -> tuple[Array, Array, Array]:
    """Log likelihood of the powers for every K, B (point,) with the best of the rest; Q and N, unbounded (point, 2); their information."""
    beside, precision = fit.free()
    weight = fit.weight / spectrum**2
    near = np.concatenate([fit.columns[:, :2], beside], axis=1)
    known = fit.power - fit.rest()
    normal = _normal(near, weight, precision)
    without = _normal(near[:, 1:], weight, precision)
    components = [
        _chunk(
            fit,
            np.outer(b**2, fit.columns[:, 2]) + np.outer(k**2, fit.columns[:, 3]),
            near,
            (normal, without),
            (weight, known, spectrum),
        )
        for b, k in zip(
            np.array_split(B, -(-B.size // _AT_ONCE)),
            np.array_split(K, -(-K.size // _AT_ONCE)),
            strict=True,
        )
    ]
    inverse = np.linalg.inv(normal)[:2, :2] if beside.shape[1] else None
    return (
        np.concatenate([one[0] for one in components]),
        np.concatenate([one[1] for one in components]),
        normal if inverse is None else np.linalg.inv(inverse),
    )


def _normal(near: Array, weight: Array, precision: Array) -> Array:
    normal = near.T @ (weight[:, None] * near)
    if precision.size:
        normal = normal + np.diag([*np.zeros(near.shape[1] - precision.size), *precision])
        normal += 1e-9 * np.diag(np.diagonal(normal))
    return normal


def _chunk(
    fit: Fit,
    slow: Array,
    near: Array,
    normals: tuple[Array, Array],
    frame: tuple[Array, Array, Array],
) -> tuple[Array, Array]:
    """Some points of the grid, `slow` (point, cell) the powers of B and K."""
    weight, known, spectrum = frame
    right = (weight * (fit.rest() - slow)) @ near
    best = np.linalg.solve(normals[0], right.T).T
    alone = np.linalg.solve(normals[1], right[:, 1:].T).T
    alone[:, 0] = np.maximum(alone[:, 0], 1e-12 * float(spectrum.max()) / HOUR)
    inside = np.asarray((best[:, :2] > 0.0).all(axis=1))
    used = np.where(
        inside[:, None], best, np.concatenate([np.zeros((len(best), 1)), alone], axis=1)
    )
    expected = used @ near.T + slow + known
    if near.shape[1] > 2 or fit.known is not None:
        expected = np.maximum(expected, _LEAST * spectrum)
    return np.asarray(
        -(fit.weight * (np.log(expected) + fit.power / expected)).sum(axis=1)
    ), np.asarray(best[:, :2])


def _draw_near(mean: Array, covariance: Array, rng: np.random.Generator) -> Array:
    """Draws of the squares of Q and N about `mean` (draw, 2), that of Q above 0."""
    sd = float(np.sqrt(covariance[0, 0]))
    low = np.minimum(-mean[:, 0] / sd, 30.0)
    Q = np.maximum(mean[:, 0] - sd * ndtri(rng.random(len(mean)) * ndtr(-low)), 0.0)
    slope = float(covariance[0, 1] / covariance[0, 0])
    rest = float(np.sqrt(covariance[1, 1] - slope * covariance[0, 1]))
    return np.stack(
        [Q, mean[:, 1] + slope * (Q - mean[:, 0]) + rest * rng.standard_normal(len(mean))], axis=1
    )


def noise_posterior(
    fit: Fit,
    mean: Array,
    variance: Array,
    present: NDArray[np.bool_],
    *,
    step: float,
    draws: int,
    rng: np.random.Generator,
    effects: Array | None = None,
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
    effects : ndarray, shape (block, column), optional
        What effects do to the means, of any size.
    """
    square, information, spectrum = _fitted(fit)
    density = HOUR * max(float(square[1]), floor_square(fit))
    coarse_K, coarse_B = _fine_grid(density, mean.size * step, step)
    K, B = (component.ravel() for component in np.meshgrid(coarse_K, coarse_B, indexing="ij"))
    values = np.where(present, mean, 0.0)[:, None]
    columns = (
        np.empty((mean.size, 0))
        if effects is None
        else effects / np.maximum(np.abs(effects).max(axis=0), 1e-300)
    )
    products = mean_products(
        values, columns, variance=variance, step=step, K=K, B=B, present=present
    )
    products = marginalise(
        products,
        columns.shape[1],
        _WIDE * np.eye(columns.shape[1]) / np.maximum(variance[present].min(initial=1.0), 1e-300),
    )
    slow = -0.5 * (products.square[:, 0] + products.log_determinant)
    fast, best, normal = _by_powers(fit, spectrum, K, B)
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

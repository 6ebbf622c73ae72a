"""Posterior of the noise of one axis: Q, N from band powers, B, K from these and block means."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.special import ndtr, ndtri

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.baseline.axis_means import AxisMeans
from gyrostab.diagnose.baseline.expected_statistics import B_TERM, K_TERM, N_TERM
from gyrostab.diagnose.evidence.wandering import RandomProcesses, no_processes
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.regression.nonnegative import solve_nonnegative
from gyrostab.units import HOUR

#: Number of draws from the posterior of the noise of an axis; limits memory.
DRAWS = 512
#: Smallest N^2 that is resolved, over that which alone gives the smallest power of a band.
MIN_WHITE_SHARE = 1e-3
_MIN_DRAWN_SHARE = 0.01  # of the fitted N^2, in a draw: white noise is never absent; design choice
_MIN_POWER_WITH_EFFECTS = 0.05  # of expected powers that fitted effects may leave; design choice
_MAX_STEPS, _MIN_CHANGE = 50, 1e-9  # of a fit, and relative change of its powers in the last step
_MIN_STEP = 1e-3  # shortest step towards the best fit, as a share of the whole
_ROUNDING_SHARE = 1e-12  # rounding error of a log likelihood


class BandPowers(NamedTuple):
    """Band powers, and what they are explained by: noise terms and effects."""

    power: Floats  # (cell,): averaged over blocks
    columns: Floats  # (cell, 4): power of the noise terms per squared coefficient
    weight: Floats  # (cell,): shapes of the gamma distributions of the powers
    fixed_power: Floats | None = None  # (cell,): power of effects of fixed size
    free_columns: Floats | None = None  # (cell, column): power of effects per unit of free sizes
    precision: Floats | None = None  # (column,): precisions of normal priors of these sizes about 0
    start: Floats | None = None  # (cell,): expected powers to start from; white noise by default

    def rest(self) -> Floats:
        """Return the powers without those of effects of fixed size."""
        return self.power if self.fixed_power is None else self.power - self.fixed_power

    def free(self) -> tuple[Floats, Floats]:
        """Return columns and precisions of the free sizes."""
        columns, precision = self.free_columns, self.precision
        columns = np.empty((self.power.size, 0)) if columns is None else columns
        return columns, np.zeros(columns.shape[1]) if precision is None else precision


class Posterior(NamedTuple):
    """Noise of one axis."""

    #: (4,): squares of Q, N, B, K that fit the band powers best, and their errors [squared units of
    #: the noise table].
    square: Floats
    error: Floats
    #: (cell,): fine grid of K and B, and its posterior probabilities.
    K: Floats
    B: Floats
    weight: Floats
    draws: Floats  # (draw, 4): squares of Q, N, B, K in the band powers
    #: (draw, 2): squares of B and K in the block means; the same as in `draws` when `joined`.
    slow: Floats
    joined: bool  # whether band powers and means agree about B and K
    #: (4,): squares that fit the bands best which the noise terms explain; None if these are all.
    squares_for_means: Floats | None = None
    angle: float = 0.0  # variance of the angle where blocks meet [arcsec2]


def average_blocks(power: Floats, shape: Floats, columns: Floats) -> BandPowers:
    """Average over blocks; power and shape (block, band), columns (block, band, term)."""
    use = np.where(np.isfinite(power) & np.isfinite(shape), shape, 0.0)
    total = use.sum(axis=0)
    has_data = total > 0.0
    safe = np.where(has_data, total, 1.0)
    mean = (use * np.nan_to_num(power)).sum(axis=0) / safe
    mean_columns = np.einsum("ij,ijk->jk", use, columns) / safe[:, None]
    return BandPowers(mean[has_data], mean_columns[has_data], total[has_data])


def average_groups(
    power: Floats, shape: Floats, columns: Floats, level: Floats, chosen: Bools, count: int
) -> BandPowers:
    """Average the chosen blocks in at most so many groups of similar level (block,)."""
    order = np.argsort(np.where(chosen, level, np.inf), kind="stable")[: int(chosen.sum())]
    groups = np.array_split(order, min(count, order.size))
    averages = [average_blocks(power[group], shape[group], columns[group])[:3] for group in groups]
    return BandPowers(*map(np.concatenate, zip(*averages, strict=True)))


def fit_squares(bands: BandPowers) -> tuple[Floats, Floats, Floats]:
    """Fit non-negative squares by gamma likelihood (Whittle).

    Returned with them are their Fisher information with the effects free, and the expected powers.

    Examples
    --------
    >>> f = np.arange(1.0, 9.0)
    >>> columns = np.stack([f**2, np.ones(8), 1.0 / f, f**-2], axis=1)
    >>> bands = BandPowers(columns @ [0.1, 2.0, 0.0, 3.0], columns, np.full(8, 100.0))
    >>> fit_squares(bands)[0].round(6)
    array([0.1, 2. , 0. , 3. ])
    """
    free_columns, precision = bands.free()
    if not free_columns.shape[1] and bands.fixed_power is None and bands.start is None:
        square, normal, spectrum = _fit_noise_alone(bands, bands.columns[None])
        return square[0], normal[0], spectrum[0]
    width = bands.columns.shape[1]
    square, normal = _white_square(bands, bands.columns), np.zeros((width, width))
    spectrum = bands.columns @ square if bands.start is None else bands.start
    for _ in range(_MAX_STEPS):
        weight = bands.weight / spectrum**2
        normal, right, to_noise, to_right = _eliminate_free_sizes(
            free_columns, precision, bands.columns, bands.rest(), weight
        )
        solution = solve_nonnegative(normal, right)
        power_of_effects = free_columns @ (to_right - to_noise @ solution)
        power_of_effects = power_of_effects + (bands.power - bands.rest())
        next_spectrum = np.maximum(
            bands.columns @ solution + power_of_effects, _MIN_POWER_WITH_EFFECTS * spectrum
        )
        if not (next_spectrum > 0.0).all():
            break
        change = np.abs(next_spectrum / spectrum - 1.0).max()
        square, spectrum = solution, next_spectrum
        if change < _MIN_CHANGE:
            break
    return square, normal, spectrum


def _white_square(bands: BandPowers, columns: Floats) -> Floats:
    """Return squares (..., term) of white noise alone; columns (..., cell, term)."""
    square = np.zeros((*columns.shape[:-2], columns.shape[-1]))
    weighted_squares = bands.weight * bands.rest() / columns[..., N_TERM]
    square[..., N_TERM] = np.maximum(weighted_squares.sum(axis=-1) / bands.weight.sum(), 0.0)
    return square


def _fit_noise_alone(bands: BandPowers, columns: Floats) -> tuple[Floats, Floats, Floats]:
    """Fit the squares of noise without effects, for many sets of columns (set, cell, term) at once.

    Without effects, the likelihood is that of these powers alone: each step is halved until the
    likelihood does not fall.
    """
    square = _white_square(bands, columns)
    normal = np.zeros((*square.shape, square.shape[-1]))
    spectrum = np.einsum("ijk,ik->ij", columns, square)
    open_sets = np.arange(len(columns))
    for _ in range(_MAX_STEPS):
        used, last = columns[open_sets], spectrum[open_sets]
        weighted = np.swapaxes(used, 1, 2) * (bands.weight / last**2)[:, None, :]
        normal[open_sets] = weighted @ used
        solution = solve_nonnegative(normal[open_sets], weighted @ bands.power)
        step = np.einsum("ijk,ik->ij", used, solution) - last
        is_possible = (last + step > 0.0).all(axis=1)
        fraction = np.where(is_possible, _choose_steps(bands, last, step), 0.0)[:, None]
        square[open_sets] += fraction * (solution - square[open_sets])
        spectrum[open_sets] += fraction * step
        change = np.abs(fraction * step / last).max(axis=1)
        open_sets = open_sets[change >= _MIN_CHANGE]
        if not open_sets.size:
            break
    return square, normal, spectrum


def _choose_steps(bands: BandPowers, spectrum: Floats, step: Floats) -> Floats:
    """Return the share (set,) of a step (set, cell) with which the likelihood does not fall."""
    log_likelihood = _log_likelihood(bands, spectrum)
    least = log_likelihood - _ROUNDING_SHARE * np.abs(log_likelihood)
    fraction = np.ones(len(spectrum))
    falls = np.ones(len(spectrum), np.bool_)
    while falls.any():
        with np.errstate(invalid="ignore", divide="ignore"):
            reached = _log_likelihood(bands, spectrum + fraction[:, None] * step)
        falls = (fraction > _MIN_STEP) & ~(reached >= least)
        fraction[falls] *= 0.5
    return fraction


def _log_likelihood(bands: BandPowers, spectrum: Floats) -> Floats:
    """Return the gamma log likelihood (...) of spectra (..., cell)."""
    return np.asarray(-(bands.weight * (np.log(spectrum) + bands.power / spectrum)).sum(axis=-1))


def _eliminate_free_sizes(
    free_columns: Floats, precision: Floats, columns: Floats, power: Floats, weight: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Eliminate free sizes from the normal equations of `columns`.

    The sizes are ``to_right - to_noise @ squares``.
    """
    weighted = columns.T * weight
    normal, right = weighted @ columns, weighted @ power
    inner = (free_columns.T * weight) @ free_columns + np.diag(precision)
    inner += 1e-9 * np.diag(np.maximum(np.diagonal(inner), 1e-300))
    crossed = weighted @ free_columns
    to_noise = np.asarray(np.linalg.solve(inner, crossed.T), np.float64)
    to_right = np.asarray(np.linalg.solve(inner, (free_columns.T * weight) @ power), np.float64)
    return normal - crossed @ to_noise, right - crossed @ to_right, to_noise, to_right


def fit_filter_response(
    responses: Floats, bands_by_axis: Sequence[BandPowers], *, settings: Settings = DEFAULTS
) -> Floats | None:
    """Return the response (band, term) of the filter that describes the powers of all axes best.

    A low-pass or an average removes most of the noise at high frequencies, and leaves that of the
    block means. A fit without the filter would take the steep slope for B and K, and the floor of
    the stopped bands for N.

    All axes pass the one logger: None if the noise terms alone describe some axis about as well.
    """
    nats, quantization = [], []
    for bands in bands_by_axis:
        square, _, expected = _fit_noise_alone(
            bands, bands.columns * np.concatenate([np.ones_like(responses[:1]), responses])
        )
        nats.append(_log_likelihood(bands, expected))
        quantization.append(square[1:, 0])
    nats_without, nats_behind = np.split(np.array(nats), [1], axis=1)
    chosen = choose_filter(nats_behind.sum(axis=0), np.sum(quantization, axis=0), settings)
    is_better = nats_behind[:, chosen] > nats_without[:, 0] + settings.ambiguous_nats
    return np.asarray(responses[chosen]) if is_better.all() else None


def fit_behind(bands: BandPowers, columns: Floats) -> tuple[float, float]:
    """Return the largest log likelihood of powers over noise of these columns, and its Q^2."""
    square, _, expected = fit_squares(bands._replace(columns=columns))
    return float(_log_likelihood(bands, expected)), float(square[0])


def choose_filter(likelihood: Floats, quantization: Floats, settings: Settings) -> int:
    """Return the place of the filter with the least Q^2 among those that fit about as well.

    The log likelihood and Q^2 of each filter are sums over the axes. Q rises where a low-pass
    falls, so that one at too low a cutoff fits with much Q.
    """
    is_close = likelihood > likelihood.max() - settings.ambiguous_nats
    return int(np.where(is_close, quantization, np.inf).argmin())


def with_floor(square: Floats, bands: BandPowers) -> Floats:
    """Return squares with the smallest resolved N^2: white noise hides in the smallest power."""
    least = MIN_WHITE_SHARE * max(float(np.min(bands.power)), np.finfo(float).tiny) / HOUR
    return np.maximum(square, [0.0, least, 0.0, 0.0])


def visible_coefficients(density: float, span: float) -> tuple[float, float]:
    """Return K and B that the means just show in white noise of a density [degree2 hour-2 Hz-1].

    Their Allan variances, K^2 tau / 3 and 0.44 B^2, are equal to that of the white noise over the
    whole span.
    """
    return float(np.sqrt(HOUR * 3.0 * density) / span), float(np.sqrt(density / span / 0.44))


def fine_grid(density: float, span: float, step: float) -> tuple[Floats, Floats]:
    """Return values of K and B, from invisible in the means to far above white noise."""
    K, B = visible_coefficients(density, span)
    top = 300.0 * span / step  # last over first K; the last B is 30 times the root of it
    # six values of K in a decade, and four of B; design choice
    return (
        np.geomspace(0.1 * K, 0.1 * K * top, round(6.0 * np.log10(top))),
        np.geomspace(0.1 * B, 3.0 * B * np.sqrt(top), round(4.0 * np.log10(30.0 * np.sqrt(top)))),
    )


def _likelihood_of_powers(
    bands: BandPowers, spectrum: Floats, K: Floats, B: Floats
) -> tuple[Floats, Floats, Floats]:
    """Compute the log likelihood of the powers for every K and B.

    The best Q and N are returned too, unbounded (point, 2), and their information.
    """
    free_columns, precision = bands.free()
    weight = bands.weight / spectrum**2
    fast_columns = np.concatenate([bands.columns[:, :2], free_columns], axis=1)
    normal = _normal_matrix(fast_columns, weight, precision)
    without_q = _normal_matrix(fast_columns[:, 1:], weight, precision)
    slow = np.outer(B**2, bands.columns[:, B_TERM]) + np.outer(K**2, bands.columns[:, K_TERM])
    right = (weight * (bands.rest() - slow)) @ fast_columns
    best = np.linalg.solve(normal, right.T).T
    best_without_q = np.linalg.solve(without_q, right[:, 1:].T).T
    best_without_q[:, 0] = np.maximum(best_without_q[:, 0], 1e-12 * float(spectrum.max()) / HOUR)
    is_inside = np.all(best[:, :2] > 0.0, axis=1)
    used = np.where(is_inside[:, None], best, np.pad(best_without_q, ((0, 0), (1, 0))))
    expected = used @ fast_columns.T + slow + (bands.power - bands.rest())
    if free_columns.shape[1] or bands.fixed_power is not None:
        expected = np.maximum(expected, _MIN_POWER_WITH_EFFECTS * spectrum)
    likelihood = -(bands.weight * (np.log(expected) + bands.power / expected)).sum(axis=1)
    if free_columns.shape[1]:
        normal = np.linalg.inv(np.linalg.inv(normal)[:2, :2])
    return likelihood, best[:, :2], normal


def _normal_matrix(fast_columns: Floats, weight: Floats, precision: Floats) -> Floats:
    """Return the normal matrix of Q, N and free sizes."""
    normal = fast_columns.T @ (weight[:, None] * fast_columns)
    if precision.size:
        normal = normal + np.diag([*np.zeros(fast_columns.shape[1] - precision.size), *precision])
        normal += 1e-9 * np.diag(np.diagonal(normal))
    return normal


def _draw_near(mean: Floats, covariance: Floats, rng: np.random.Generator) -> Floats:
    """Draw squares of Q and N about `mean` (draw, 2), Q^2 not negative."""
    sd = float(np.sqrt(covariance[0, 0]))
    low = np.minimum(-mean[:, 0] / sd, 30.0)
    Q = np.maximum(mean[:, 0] - sd * ndtri(rng.random(len(mean)) * ndtr(-low)), 0.0)
    slope = float(covariance[0, 1] / covariance[0, 0])
    conditional_sd = float(np.sqrt(covariance[1, 1] - slope * covariance[0, 1]))
    conditional_mean = mean[:, 1] + slope * (Q - mean[:, 0])
    N = conditional_mean + conditional_sd * rng.standard_normal(len(mean))
    return np.stack([Q, N], axis=1)


def _draw_positive(square: Floats, information: Floats, rng: np.random.Generator) -> Floats:
    """Draw squares (draw, 4) about a fit, with the covariance of those that are not zero.

    Those that are zero have the error that they have with all others fixed, on one side.
    """
    is_positive = square > 0.0
    scale = square[is_positive]
    relative = information[np.ix_(is_positive, is_positive)] * np.outer(scale, scale)
    draws = np.abs(rng.standard_normal((DRAWS, square.size)))
    draws /= np.sqrt(np.maximum(np.diagonal(information), np.finfo(float).tiny))
    draws[:, is_positive] = scale * rng.multivariate_normal(
        np.ones(scale.size), np.linalg.pinv(relative), DRAWS, method="eigh"
    )
    return np.maximum(draws, 0.0)


def noise_posterior(
    bands: BandPowers,
    blocks: xr.Dataset,
    row: int,
    variance: Floats,
    use: Bools,
    effects: Floats | None,
    settings: Settings,
    wander: RandomProcesses | None = None,
) -> Posterior:
    """Compute the posterior of Q, N, B, K of an axis from band powers and block means.

    Parameters
    ----------
    bands : BandPowers
        The powers.
    variance : ndarray, shape (block,)
        White variance of the means [degree2 hour-2].
    use : ndarray of bool, shape (block,)
        Blocks whose means are used.
    effects : ndarray, shape (block, column), optional
        Designs of effects in the means, of any size.
    wander : RandomProcesses, optional
        Random processes of effects in the means.
    """
    mean, step = blocks["mean"].values[row], float(blocks.attrs["block_s"])
    present = use & np.isfinite(mean)
    rng = np.random.default_rng(0)  # of any axis, so that their order does not matter
    square, information, spectrum = fit_squares(bands)
    density = HOUR * float(with_floor(square, bands)[N_TERM])
    K_values, B_values = fine_grid(density, mean.size * step, step)
    K, B = (points.ravel() for points in np.meshgrid(K_values, B_values, indexing="ij"))
    means = AxisMeans(
        np.where(present, mean, 0.0)[:, None],
        effects,
        variance,
        step,
        present,
        no_processes(mean.size) if wander is None else wander,
    )
    slow = means.log_likelihood(K, B)
    with_angle = means.with_angle_noise(K, B, slow, settings.ambiguous_nats)
    if with_angle is not means:
        means, slow = with_angle, with_angle.log_likelihood(K, B)
    fast, best, normal = _likelihood_of_powers(bands, spectrum, K, B)
    is_in_grid = square[K_TERM] <= K.max() ** 2 and square[B_TERM] <= B.max() ** 2
    fast_max = fast.max() if is_in_grid else _log_likelihood(bands, spectrum)
    joined = bool(slow.max() + fast_max - (slow + fast).max() < settings.disagreement_nats)
    log = slow + fast if joined else slow
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    cell = rng.choice(weight.size, DRAWS, p=weight)
    jitter = rng.random((DRAWS, 2)) - 0.5
    # each draw lies anywhere in its cell of the grid; squares move twice as far as B and K
    inner = np.exp(2.0 * jitter * np.log([B_values[1] / B_values[0], K_values[1] / K_values[0]]))
    slow_draws = np.stack([B[cell] ** 2, K[cell] ** 2], axis=1) * inner
    scale = np.sqrt(np.diag(information))
    covariance = np.linalg.pinv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    error = np.sqrt(np.diag(covariance))
    if joined:
        fast_covariance = np.asarray(np.linalg.inv(normal), np.float64)
        fast_draws = _draw_near(best[cell], fast_covariance, rng)
        squares = np.concatenate([fast_draws, slow_draws], axis=1)
    else:
        squares = _draw_positive(square, information, rng)
    squares[:, N_TERM] = np.maximum(squares[:, N_TERM], _MIN_DRAWN_SHARE * square[N_TERM])
    return Posterior(
        square, error, K, B, weight, squares, slow_draws, joined, angle=float(means.wander.angle)
    )

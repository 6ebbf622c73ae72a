"""Products of whitened data and designs, and the evidence of designs of unknown size from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import log_ndtr

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.diagnose.evidence.folds import FOLDS
from gyrostab.diagnose.evidence.wandering import RandomProcesses, expected_processes, no_processes
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.kernels.regression.evidence import mixed_evidence, row_products
from gyrostab.kernels.regression.state_space import flicker_states, products_on_grid, whiten
from gyrostab.units import HOUR

#: Standard deviations of the prior of a size, in units of its error in white noise. Design
#: choice: a mixture over three decades needs no prior size.
WIDTHS = (1.0, 10.0, 100.0, 1000.0)
#: Largest width for stronger data. Design choice: given columns that are nearly the same are still
#: separated by more than rounding errors.
_MAX_WIDTH = 1e6
#: A design that keeps a smaller share of its square, after constants and given columns are
#: projected out, counts as absent. Above rounding errors.
_MIN_SQUARE_SHARE = 1e-9
_FEW_COLUMNS = 8  # of which all products are computed in one call; limits time alone
_MAX_PRODUCTS_AT_ONCE = 100_000  # designs times records times grid points; limits memory


class Products(NamedTuple):
    """Products of whitened data y and columns x on some blocks; without a grid, one grid point."""

    square: Floats  # (grid, record): y' y
    cross: Floats  # (grid, column, record): x' y
    gram: Floats  # (grid, column, column): x' x
    log_determinant: Floats  # (grid,): of the covariance


def prior_widths(square: Floats) -> Floats:
    """Return `WIDTHS`, with the last one as large as any size of data with these squares can be.

    Examples
    --------
    >>> prior_widths(np.array([100.0])), prior_widths(np.array([100.0, 1e10]))
    (array([   1.,   10.,  100., 1000.]), array([1.e+00, 1.e+01, 1.e+02, 1.e+05]))
    """
    largest = np.sqrt(np.max(square, initial=0.0))
    return np.array([*WIDTHS[:-1], np.clip(largest, WIDTHS[-1], _MAX_WIDTH)])


def marginalise(products: Products, given: int, precision: Floats) -> Products:
    """Marginalise the last `given` columns, with normal priors of this precision (given, given)."""
    if not given:
        return products
    keep = slice(None, products.gram.shape[1] - given)
    out = slice(products.gram.shape[1] - given, None)
    inner = products.gram[:, out, out] + precision
    to_x = np.linalg.solve(inner, products.gram[:, out, keep])
    to_y = np.linalg.solve(inner, products.cross[:, out])
    return Products(
        square=products.square - (products.cross[:, out] * to_y).sum(axis=1),
        cross=products.cross[:, keep] - products.gram[:, keep, out] @ to_y,
        gram=products.gram[:, keep, keep] - products.gram[:, keep, out] @ to_x,
        log_determinant=products.log_determinant
        + np.linalg.slogdet(inner)[1]
        - np.linalg.slogdet(precision)[1],
    )


def size_errors(before: Floats, after: Floats) -> Floats:
    """Return the error of every size in white noise [1 / unit of its column], 0 if invisible.

    `before` and `after` are the squares of the columns, without and with the constant and the given
    columns projected out.
    """
    is_visible = after > _MIN_SQUARE_SHARE * np.maximum(before, np.finfo(float).tiny)
    return np.where(is_visible, 1.0 / np.sqrt(np.where(is_visible, after, 1.0)), 0.0)


def axis_noise(baseline: xr.Dataset, axis: str) -> dict[str, Any]:
    """Return the noise of the means of an axis, as `mean_products` takes it."""
    return {
        "variance": axis_values(baseline, "mean_variance", axis),
        "K": axis_values(baseline, "grid_K", axis),
        "B": axis_values(baseline, "grid_B", axis),
        "wander": expected_processes(baseline, axis),
    }


def scale_columns(columns: Floats | None, count: int) -> Floats:
    """Return columns (count, column) relative to their largest size, 0 where missing; or None."""
    if columns is None:
        return np.empty((count, 0))
    finite = np.where(np.isfinite(columns), columns, 0.0)
    largest = np.abs(finite).max(axis=0, initial=0.0)
    return np.asarray(finite / np.where(largest > 0.0, largest, 1.0))


def mean_products(
    values: Floats,
    columns: Floats,
    *,
    variance: Floats,
    step: float,
    K: Floats,
    B: Floats,
    present: Bools,
    pairs: tuple[Ints, Ints] | None = None,
    wander: RandomProcesses | None = None,
) -> Products:
    """Compute products of block means and columns, whitened for every pair of K and B.

    The values (block, record) are block means [degree hour-1], or anything where not `present`
    (block,); the columns (block, column) are designs. The noise has the white variance (block,)
    [degree2 hour-2], and random walk K [deg/h^1.5] and flicker B [deg/h] by (grid,). Products of
    columns that are not among `pairs`, from `column_pairs`, are 0; by default all are computed.
    """
    n, width = columns.shape
    stacked = np.ascontiguousarray(np.concatenate([columns, values], axis=1))
    stacked[~present] = 0.0
    white_variance = np.where(present, variance, 1.0)
    steps = np.full(n, step)
    if wander is None:
        wander = no_processes(n)
    if pairs is None and stacked.shape[1] <= _FEW_COLUMNS:
        return _products_of_few(stacked, width, white_variance, steps, present, K, B, wander)
    share, time, white = flicker_states(step, n * step)
    squares, times = np.append(share, wander.square), np.append(time, wander.time)
    shape = (K.size, values.shape[1])
    square, cross = np.empty(shape), np.empty((K.size, width, shape[1]))
    gram, determinant = np.zeros((K.size, width, width)), np.empty(K.size)
    for g, (k, b) in enumerate(zip(K**2 / HOUR, B**2, strict=True)):
        squares[: share.size] = share * b
        used = slice(0 if b > 0.0 else share.size, None)
        whitened, determinant[g] = whiten(
            stacked,
            white_variance + b * white,
            steps,
            present,
            k + wander.walk,
            squares[used],
            times[used],
            float(wander.angle),
        )
        x, y = whitened[:, :width], whitened[:, width:]
        cross[g], square[g] = x.T @ y, np.einsum("ij,ij->j", y, y)
        if pairs is None:
            gram[g] = x.T @ x
        else:
            products = row_products(np.ascontiguousarray(x.T), *pairs)
            gram[g][pairs] = gram[g][pairs[::-1]] = products
    return Products(square, cross, gram, determinant)


def _products_of_few(
    stacked: Floats,
    width: int,
    variance: Floats,
    steps: Floats,
    present: Bools,
    K: Floats,
    B: Floats,
    wander: RandomProcesses,
) -> Products:
    """Compute all products of `width` columns and the block means after them, `stacked`."""
    products, determinant = products_on_grid(
        stacked,
        variance,
        steps,
        present,
        wander.walk,
        K**2 / HOUR,
        B**2,
        flicker_states(steps[0], steps.size * steps[0]),
        wander.square,
        wander.time,
        float(wander.angle),
    )
    square = np.diagonal(products, axis1=1, axis2=2)[:, width:]
    return Products(square, products[:, :width, width:], products[:, :width, :width], determinant)


def column_pairs(width: int, designs: Sequence[Ints], given: int) -> tuple[Ints, Ints]:
    """Return the pairs of columns that meet in a model.

    Each column meets itself, the columns of its design, and the last `given` columns.
    """
    is_pair = np.eye(width, dtype=np.bool_)
    is_pair[:, width - given :] = True
    for chosen in designs:
        is_pair[np.ix_(chosen, chosen)] = True
    first, second = np.nonzero(np.triu(is_pair))
    return first, second


def power_products(residual: Floats, weight: Floats, columns: Floats) -> Products:
    """Compute products of data (cell, record) and columns (cell, column) in independent cells.

    The weight (cell,) is 0 for no data, where the data may have any finite value.
    """
    weighted = (columns * weight[:, None]).T
    square = weight @ (residual * residual)
    return Products(
        square[None], (weighted @ residual)[None], (weighted @ columns)[None], np.zeros(1)
    )


def remove_common_part(values: Floats, weight: Floats, common: Floats, unit: Floats) -> Floats:
    """Subtract the common part of the cells of each block, so that they become independent.

    Under random gaps the powers of all bands of a block vary together: their covariance is ``1 /
    weight`` on the diagonal, plus ``common`` times the product of the units everywhere. Products of
    columns that were transformed here are those of that covariance.

    The values (block, cell, column) are data or designs. The weight (block, cell) is the inverse of
    the variance that is not common, 0 for no data; `common` (block,) is the variance of the common
    part, and `unit` (block, cell) its size in each cell.

    Examples
    --------
    >>> weight, values = np.array([[4.0, 1.0]]), np.array([[[1.0], [3.0]]])
    >>> free = remove_common_part(values, weight, np.array([0.5]), np.ones((1, 2)))
    >>> float((weight[..., None] * free**2).sum().round(9))
    6.0
    >>> float((values[0].T @ np.linalg.inv([[0.75, 0.5], [0.5, 1.5]]) @ values[0])[0, 0].round(9))
    6.0
    """
    total = (weight * unit**2).sum(axis=1)
    factor = np.where(total > 0.0, 1.0 - 1.0 / np.sqrt(1.0 + common * total), 0.0) / np.where(
        total > 0.0, total, 1.0
    )
    common_part = np.einsum("bc,bck->bk", weight * unit, values) * factor[:, None]
    return np.asarray(values - unit[..., None] * common_part[:, None])


def log_evidence(
    products: Products,
    designs: Sequence[Ints],
    limits: Floats,
    log_weight: Floats,
    widths: Floats,
    is_bounded: Sequence[bool] = (),
) -> Floats:
    """Compute the log marginal likelihood without any design, and with each, (1 + design, record).

    A design is the indices of its columns, and may have sizes that cannot be negative. The limits
    (column,) are the errors of the sizes in white noise, 0 for columns without effect. The log
    weights of the grid points (grid,) are not normalised. The widths are those of `prior_widths`.
    """
    bounded = np.array(is_bounded, np.bool_) if len(is_bounded) else np.zeros(len(designs), bool)
    weight = log_weight - np.logaddexp.reduce(log_weight)
    base = weight[:, None] - 0.5 * (products.square + products.log_determinant[:, None])
    out = np.empty((1 + len(designs), base.shape[1]))
    out[0] = np.logaddexp.reduce(base, axis=0)
    at_once = max(1, _MAX_PRODUCTS_AT_ONCE // max(base.size, 1))
    sizes = np.array([chosen.size for chosen in designs], np.int64)
    for size, bound in sorted({*zip(sizes.tolist(), bounded.tolist(), strict=True)}):
        same_kind = np.flatnonzero((sizes == size) & (bounded == bound)).tolist()
        for first in range(0, len(same_kind), at_once):
            batch = same_kind[first : first + at_once]
            out[1 + np.array(batch)] = _equal_size_evidence(
                products,
                np.stack([designs[number] for number in batch]),
                limits,
                base,
                widths,
                bound,
            )
    return out


def _equal_size_evidence(
    products: Products, chosen: Ints, limits: Floats, base: Floats, widths: Floats, is_bounded: bool
) -> Floats:
    """Compute log marginal likelihoods (design, record) of designs (design, column)."""
    scale = limits[chosen]
    gram = products.gram[:, chosen[:, :, None], chosen[:, None, :]] * (
        scale[:, :, None] * scale[:, None, :]
    )
    rotated = products.cross[:, chosen] * scale[..., None]
    if chosen.shape[1] == 1:
        eigenvalues, vectors = gram[..., 0], np.ones_like(gram)
    else:
        eigenvalues, vectors = np.linalg.eigh(gram)
        rotated = vectors.swapaxes(2, 3) @ rotated
    squares = np.maximum(eigenvalues, 0.0)
    if is_bounded:
        return _bounded_evidence(base, rotated, squares, vectors, widths)
    return np.asarray(mixed_evidence(base, rotated, squares, np.square(widths)))


def _bounded_evidence(
    base: Floats, rotated: Floats, eigenvalues: Floats, vectors: Floats, widths: Floats
) -> Floats:
    """Compute the log marginal likelihoods (design, record) of sizes that cannot be negative.

    Their prior is the positive half of the normal one. The likelihood changes by the share of the
    posterior that is positive, divided by that of the prior, each as if the sizes were
    independent.

    `rotated` (grid, design, column, record) is ``x' y`` in the frame of the eigenvectors of ``x'
    x``, whose eigenvalues are (grid, design, column); `base` is (record, grid).
    """
    width = np.square(widths)[:, None, None, None]
    spread = 1.0 + width * eigenvalues
    variance = width / spread  # (width, grid, design, column) of the posterior
    mean = vectors @ (variance[..., None] * rotated)
    sd = np.sqrt(np.einsum("gdij,wgdj->wgdi", np.square(vectors), variance))
    terms = (
        base[:, None]
        - 0.5 * np.log(spread).sum(axis=3)[..., None]
        + 0.5 * (variance[..., None] * rotated**2).sum(axis=3)
        + (log_ndtr(mean / sd[..., None]) + np.log(2.0)).sum(axis=3)
    )
    joined = terms.reshape(-1, *terms.shape[2:])
    return np.asarray(np.logaddexp.reduce(joined, axis=0) - np.log(widths.size))


def held_out_evidence(
    factors: Floats, owner: Sequence[int] | Ints, *, weight: Sequence[float] | Floats | None = None
) -> Floats:
    """Compute the held-out evidence (candidate, record), the largest over the fold lengths [nats].

    It is the sum over the folds of the log Bayes factor on all blocks minus that without the fold.
    The longest interval is the whole record, predicted from nothing: its evidence is the Bayes
    factor itself. What lasts for most of the record is predicted from both sides of any shorter
    interval, also by a random walk.

    Parameters
    ----------
    factors : ndarray, shape (subset, design, record)
        Log Bayes factors [nats] on the subsets of `fold_subsets`, without the column for no design.
        Factors of independent data, such as means and powers, may be added before.
    owner : sequence of int, shape (design,)
        Index of the candidate of each design.
    weight : array_like, shape (design,) or (design, record), optional
        Prior probability of each design relative to the others of its candidate; equal by default.

    Examples
    --------
    >>> factors = np.zeros((5, 2, 1))
    >>> factors[0, 1], factors[1:, 1] = 8.0, 6.0
    >>> for share in (1.0, 9.0):
    ...     print(held_out_evidence(factors, [0, 0], weight=[1.0, share])[0].round(2))
    [7.99]
    [8.]
    """
    owner = np.asarray(owner)
    prior_weight = np.ones(owner.size) if weight is None else np.asarray(weight, dtype=np.float64)
    chance = np.log(prior_weight.reshape(owner.size, -1))
    out = []
    for candidate in range(int(owner.max()) + 1 if owner.size else 0):
        chosen = owner == candidate
        log_prior = chance[chosen] - np.logaddexp.reduce(chance[chosen], axis=0)
        mixed = np.logaddexp.reduce(factors[:, chosen] + log_prior, axis=1)
        parts = (mixed[:1] - mixed[1:]).reshape(-1, FOLDS, mixed.shape[1]).sum(axis=1)
        out.append(np.maximum(parts.max(axis=0), mixed[0]))
    return np.array(out).reshape(len(out), factors.shape[2])

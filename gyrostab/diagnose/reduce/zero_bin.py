"""How wide the cell of a lattice is that the value 0 stands for: a rate that is cut off towards zero has one of two steps there.

Rounding to the nearest value, or to the one below, makes all cells as wide as the step. Cutting off
towards zero takes what is less than a step on either side of zero together, and leaves all other
cells as they are. A loop that sticks at zero makes that cell wider too, but what it takes is
missing beside it.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

__all__ = ["CELLS", "cell_widths", "cut_off", "may_be_cut_off"]

Array = NDArray[np.float64]
#: Cells whose widths are measured: that of 0, and the two beside it.
CELLS = ("zero", "next")
_CUT = np.array([2.0, 1.0])  # widths [steps] of a rate that is cut off towards zero
_FORM = 0.05  # of a width, by which the noise may have another law than the fit
_SURE, _LIKE = (
    5.0,
    3.5,
)  # standard errors by which the cell must be wider than one step, and by which a width may be off
_TOLD = 0.25  # largest standard error of its width, over all axes
_COARSEST = 0.7  # scatters of the samples; beyond, the cells follow no parabola
_REACH, _FEWEST, _MOST = 1.0, 4, 200  # scatters, and cells on either side, that the fit goes out to
_OFF = 0.01  # share of the values that may stand off the lattice
_TURNS = 50


def cell_widths(values: Array, step: float) -> tuple[Array, Array]:
    """Widths of the cell of 0 and of the two beside it, in steps, with their standard errors; NaN where they cannot be told.

    The logarithms of the counts of the cells beyond are a parabola in the rate, as those of normal
    noise are, which says how many values there are to a step.

    Parameters
    ----------
    values : ndarray
        Values on a lattice [degree hour-1]; NaN is passed over.
    step : float
        Of the lattice, which must go through 0 [degree hour-1]; 0 for none.

    Returns
    -------
    width, error : ndarray, shape (2,)
        In the order of `CELLS`.

    Examples
    --------
    >>> noise = np.random.default_rng(1).standard_normal(60_000)
    >>> [cell_widths(how(noise / 0.2) * 0.2, 0.2)[0].round().tolist() for how in (np.rint, np.floor, np.trunc)]
    [[1.0, 1.0], [1.0, 1.0], [2.0, 1.0]]
    """
    nothing = np.full(2, np.nan)
    finite = values[np.isfinite(values)]
    if not step > 0.0 or finite.size < 2:
        return nothing, nothing
    place = np.rint(finite / step)
    scatter = float(finite.std())
    if step > _COARSEST * scatter or (np.abs(finite - place * step) > _OFF * step).mean() > _OFF:
        return nothing, nothing
    reach = int(np.clip(_REACH * scatter / step, _FEWEST, _MOST))
    count = np.bincount(
        (place[np.abs(place) <= reach] + reach).astype(np.int64), minlength=2 * reach + 1
    )
    number = np.arange(-reach, reach + 1)
    beyond = np.abs(number) > 1
    fit = _parabola((number + 0.5 * np.sign(number))[beyond], count[beyond], float(reach))
    if fit is None:
        return nothing, nothing
    size, covariance = fit
    found = [
        (count[reach], np.array([-0.5, 0.5])),
        (count[reach - 1] + count[reach + 1], np.array([-1.5, 1.5])),
    ]
    width, error = np.empty(2), np.empty(2)
    for cell, (seen, at) in enumerate(found):
        columns = _columns(at, float(reach))
        each = np.exp(columns @ size)
        slope = each @ columns / each.sum()
        usual = float(each.mean() if cell == 0 else each.sum())
        width[cell] = seen / usual
        error[cell] = np.hypot(
            np.sqrt(max(seen, 1)) / usual, width[cell] * np.sqrt(slope @ covariance @ slope)
        )
    return width, error


def _columns(at: Array, reach: float) -> Array:
    return np.stack([np.ones(at.size), at / reach, np.square(at / reach)], axis=1)


def _parabola(at: Array, count: NDArray[np.int64], reach: float) -> tuple[Array, Array] | None:
    """Parabola of the logarithm of Poisson counts, by their likelihood, and the covariance of its factors; None where it cannot be told."""
    columns = _columns(at, reach)
    if (count > 0).sum() <= columns.shape[1]:
        return None
    size = np.linalg.lstsq(
        columns * np.sqrt(count)[:, None],
        np.log(np.maximum(count, 0.5)) * np.sqrt(count),
        rcond=None,
    )[0]
    for _ in range(_TURNS):
        expected = np.exp(np.clip(columns @ size, -30.0, 30.0))
        normal = (columns.T * expected) @ columns + 1e-9 * np.eye(columns.shape[1])
        move = np.linalg.solve(normal, columns.T @ (count - expected))
        size = size + move / max(1.0, float(np.abs(columns @ move).max()))
        if np.abs(move).max() < 1e-6:
            return size, np.linalg.inv(normal)
    return None


def cut_off(blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Axes whose rate is cut off towards zero on its lattice; the axes tell it together, since one logger writes all of them in one way.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `gyrostab.diagnose.reduce.block_statistics.reduce_log`.

    Returns
    -------
    ndarray of bool, shape (axis,)
    """
    on_lattice = np.asarray(blocks["lattice"].values > 0.0)
    width, error, known = _widths(blocks)
    like = known & _like_cut(width, error)
    narrower = known & (width[:, 0] < _CUT[0] - _LIKE * np.hypot(error[:, 0], _FORM * _CUT[0]))
    if not like.any() or narrower.any():
        return np.zeros_like(on_lattice)
    weight = error[like, 0] ** -2.0
    together = float(weight @ width[like, 0] / weight.sum())
    sure = weight.sum() ** -0.5 < _TOLD and (together - 1.0) * np.sqrt(weight.sum()) > _SURE
    return np.asarray(on_lattice & sure)


def may_be_cut_off(blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Axes on a lattice of which the cells do not tell that they are not cut off towards zero; the rest as for `cut_off`."""
    width, error, known = _widths(blocks)
    return np.asarray((blocks["lattice"].values > 0.0) & (~known | _like_cut(width, error)))


def _widths(blocks: xr.Dataset) -> tuple[Array, Array, NDArray[np.bool_]]:
    width, error = (
        blocks[name].transpose("axis", "cell").values
        for name in ("cell_width", "cell_width_stderr")
    )
    return width, error, np.isfinite(width).all(axis=1) & np.isfinite(error).all(axis=1)


def _like_cut(width: Array, error: Array) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (np.abs(width - _CUT) <= _LIKE * np.hypot(error, _FORM * _CUT)).all(axis=1)
        )

"""Upper limits of squared coefficients from single cells, and quantiles of chi-square."""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER, KERNEL

__all__ = ["cell_limits", "interpolate_quantile"]


@njit(**INNER)
def _chi_square_quantile(freedom, start, step, curve):  # type: ignore[no-untyped-def]
    """Interpolate the quantile of chi-square over its degrees of freedom, by a cubic."""
    if not freedom > 0.0:
        return 0.0
    position = (np.log(freedom) - start) / step
    i = min(max(int(position), 1), curve.size - 3)
    t = position - i
    if t < -1.0:  # below the table, where the quantile is below the smallest number
        return 0.0
    before, here = curve[i - 1], curve[i]
    after, beyond = curve[i + 1], curve[i + 2]
    value = (
        -t * (t - 1.0) * (t - 2.0) / 6.0 * before + (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0 * here
    )
    value += -(t + 1.0) * t * (t - 2.0) / 2.0 * after + (t + 1.0) * t * (t - 1.0) / 6.0 * beyond
    return np.exp(value / freedom)


@njit(**KERNEL)
def interpolate_quantile(freedom, start, step, curve):  # type: ignore[no-untyped-def]
    """Interpolate the quantile of chi-square over its degrees of freedom.

    Parameters
    ----------
    freedom : float64, any shape
        Degrees of freedom; not above the last node but two.
    start, step : float
        Logarithm of the freedom of the first node, and the distance between nodes.
    curve : float64 (n_nodes,)
        ``nu ln q(nu)``, which is smooth from few degrees of freedom to many.
    """
    out = np.empty(freedom.shape)
    flat, values = freedom.ravel(), out.reshape(-1)
    for i in range(flat.size):
        values[i] = _chi_square_quantile(flat[i], start, step, curve)
    return out


@njit(**INNER)
def _predict_cell(columns, white, quantization, ramp, squares, seen):  # type: ignore[no-untyped-def]
    """Compute the Allan variance of one cell under the fitted model, and per square in `seen`."""
    model = 0.0
    for a in range(5):
        seen[a] = columns[a] * (
            quantization if a == 0 else white if a == 1 else ramp if a == 4 else 1.0
        )
        if squares[a] > 0.0:
            model += seen[a] * squares[a]
    return model


@njit(**INNER)
def _cell_quantile(a, whole, own_dof, share, dof, most, start, step, curve):  # type: ignore[no-untyped-def]
    """Find the quantile of a cell with term `a` alone; `whole` without gaps.

    For a ramp, the degrees of freedom of the cell are used.
    """
    if a == 4:
        return _chi_square_quantile(min(own_dof, most, dof), start, step, curve)
    return whole if share == 1.0 else _chi_square_quantile(min(own_dof, most), start, step, curve)


@njit(**KERNEL)
def cell_limits(  # type: ignore[no-untyped-def]
    avar,
    white,
    quantization,
    ramp,
    factor,
    squares,
    dof,
    columns,
    own_dof,
    ks,
    span,
    most,
    start,
    step,
    curve,
):
    """Find the upper limit of each squared coefficient from one cell, at least its own part.

    The cell is the one with the lowest limit under the fitted model, so that its scatter does not
    influence the choice.

    Parameters
    ----------
    avar, white, quantization, ramp, factor, dof : float64 (n_windows, n_tau)
        Cells, their responses to gaps, and their degrees of freedom under the fitted noise.
    squares : float64 (n_windows, 5)
        Fitted squared coefficients; NaN counts as zero.
    columns : float64 (n_tau, 5)
        Allan variance per squared coefficient.
    own_dof : float64 (5, n_tau)
        Degrees of freedom of a cell in which a term is alone; infinite for a ramp, which is bounded
        by `dof`.
    ks : float64 (n_tau,)
        Averaging factors, rising.
    span : float64 (5,)
        A cell may bound a term if the longest averaging factor of its window is at most this many
        times its own.
    most : float
        Degrees of freedom are not taken above this.
    start, step, curve
        As in `interpolate_quantile`.

    Returns
    -------
    float64 (n_windows, 5)
        Infinite where no cell gives a limit.
    """
    n_windows, n_tau = avar.shape
    out = np.full((n_windows, 5), np.inf)
    whole, seen, lowest = np.empty((n_tau, 5)), np.empty(5), np.empty(5)
    for i in range(n_tau):
        for a in range(5):
            whole[i, a] = _chi_square_quantile(min(own_dof[a, i], most), start, step, curve)
    for w in range(n_windows):
        lowest[:] = np.inf
        last = n_tau - 1
        while last > 0 and not np.isfinite(avar[w, last]):
            last -= 1
        for i in range(n_tau):
            if not np.isfinite(avar[w, i]):
                continue
            model = _predict_cell(
                columns[i], white[w, i], quantization[w, i], ramp[w, i], squares[w], seen
            )
            share = factor[w, i]
            for a in range(5):
                if ks[i] * span[a] < ks[last]:
                    continue
                best = (
                    whole[i, a] if share <= 1.0 else 1.0
                )  # fewer degrees of freedom have a lower quantile
                if model >= lowest[a] * best * seen[a]:
                    continue
                quantile = _cell_quantile(
                    a,
                    whole[i, a],
                    own_dof[a, i] * share,
                    share,
                    dof[w, i],
                    most,
                    start,
                    step,
                    curve,
                )
                reach = 1.0 / (quantile * seen[a]) if quantile > 0.0 else np.inf
                if model * reach < lowest[a]:
                    lowest[a] = model * reach
                    out[w, a] = avar[w, i] * reach
    return out

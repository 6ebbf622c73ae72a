"""Reference implementations: slow, plain versions of the fast paths, in extended precision."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls


def direct_surface(
    x: NDArray[np.float64],
    window: int,
    step: int,
    ks: list[int],
    *,
    shifts: list[int] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Allan variance and number of terms of every window of a rate record, by definition."""
    n_windows = (x.size - window) // step + 1
    avar = np.full((n_windows, len(ks)), np.nan)
    count = np.zeros((n_windows, len(ks)), dtype=np.int64)
    for j in range(n_windows):
        rate = x[j * step : j * step + window].astype(np.longdouble)
        here = np.isfinite(rate)
        if not here.any():
            continue
        rate = np.where(here, rate - rate[here].mean(), 0)
        theta = np.concatenate(([0], np.cumsum(rate)))
        lost = np.concatenate(([0], np.cumsum(~here)))
        for i, k in enumerate(ks):
            d = theta[2 * k :] - 2 * theta[k:-k] + theta[: -2 * k]
            keep = lost[2 * k :] == lost[: -2 * k]
            if shifts is not None:
                keep &= (j * step + np.arange(keep.size)) % 2 ** shifts[i] == 0
            count[j, i] = keep.sum()
            if count[j, i]:
                avar[j, i] = float((d[keep] ** 2).sum() / (2 * np.longdouble(k) ** 2 * count[j, i]))
    return avar, count


def direct_angle_surface(
    theta: NDArray[np.float64], window: int, step: int, ks: list[int], interval: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The same for a record of cumulative angles, with ``window + 1`` angles per window."""
    n_windows = (theta.size - 1 - window) // step + 1
    avar = np.full((n_windows, len(ks)), np.nan)
    count = np.zeros((n_windows, len(ks)), dtype=np.int64)
    for j in range(n_windows):
        part = theta[j * step : j * step + window + 1].astype(np.longdouble)
        for i, k in enumerate(ks):
            d = part[2 * k :] - 2 * part[k:-k] + part[: -2 * k]
            d = d[np.isfinite(d)]
            count[j, i] = d.size
            if d.size:
                avar[j, i] = float((d**2).mean() / (2 * (k * interval) ** 2))
    return avar, count


def cluster_cell(
    x: NDArray[np.float64], k: int, *, stride: int = 1, first: int = 0
) -> dict[str, float]:
    """One cell by weighted cluster means, from a matrix of pairs of clusters (rows) by samples.

    Pairs begin where ``first + m`` is a multiple of `stride`. Degrees of freedom are those under
    white noise.
    """
    here = np.isfinite(x)
    rows, offered = [], 0
    for m in range(-first % stride, x.size - 2 * k + 1, stride):
        offered += 1
        clusters = np.zeros((2, x.size))
        clusters[0, m : m + k], clusters[1, m + k : m + 2 * k] = (
            here[m : m + k],
            here[m + k : m + 2 * k],
        )
        number = clusters.sum(axis=1)
        if (2 * number >= k).all():
            rows.append((number.prod(), clusters[1] / number[1] - clusters[0] / number[0]))
    if not rows:
        return {"count": 0}
    weight = np.array([row[0] for row in rows])
    design = np.array([row[1] for row in rows]) * np.sqrt(weight)[:, None]
    values = np.where(here, x - x[here].mean(), 0.0)
    angles = -np.diff(
        design, axis=1, prepend=0.0, append=0.0
    )  # the same terms of an angle instead of its differences
    pairs = design @ design.T
    return {
        "count": len(rows),
        "avar": float(((design @ values) ** 2).sum() / (2 * weight.sum())),
        "white_response": float((design**2).sum() / (2 * weight.sum()) * k),
        "quantization_response": float((angles**2).sum() / (2 * weight.sum()) * k**2 / 3),
        "ramp_response": float(((design @ np.arange(x.size)) ** 2).sum() / (weight.sum() * k**2)),
        "coverage": float(weight.sum() / (offered * float(k) ** 2)),
        "edf": float(np.trace(pairs) ** 2 / (pairs**2).sum()),
    }


def fit_window_plainly(
    y: NDArray[np.float64],
    white: NDArray[np.float64],
    quantization: NDArray[np.float64],
    ramp: NDArray[np.float64],
    factor: NDArray[np.float64],
    tables: Any,
) -> dict[str, NDArray[np.float64]]:
    """Iterated non-negative generalised least squares of one window, with numpy and scipy.

    Per term the squared coefficient, its standard error, its estimate free of sign, and the
    variance of that without the term, its growth with the term and with the square of the term;
    chi-square; the share by which the variances had to be widened at last for a covariance that is
    positive definite. `tables` are those of `gyrostab.allan.fit`.
    """
    ok = np.isfinite(y) & (y > 0) & (factor > 0)
    y, white, quantization, ramp, factor = y[ok], white[ok], quantization[ok], ramp[ok], factor[ok]
    bare, weight = tables.columns[ok], tables.weight[ok] * factor
    pairs, ramps = tables.pairs[:, :, ok][..., ok], tables.ramps[:, ok][..., ok]
    design = bare * np.stack([quantization, white, *np.ones((2, y.size)), ramp], axis=1)
    excess = np.maximum(quantization - 1, 0) * bare[:, 0] / bare[:, 1]

    def covariance(s: NDArray[np.float64]) -> NDArray[np.float64]:
        ones = np.ones(y.size)
        amounts = np.stack(
            [
                s[0] * np.minimum(quantization, 1),
                s[1] * white + s[0] * excess,
                s[2] * ones,
                s[3] * ones,
            ]
        )
        roots = np.sqrt(amounts * tables.to_samples[:4, None])
        outer = roots[:, :, None] * roots[:, None, :]
        total = np.einsum("aij,bij,abij->ij", outer, outer, pairs)
        total += (
            s[4]
            * tables.to_samples[4]
            * np.sqrt(np.multiply.outer(ramp, ramp))
            * np.einsum("aij,aij->ij", outer, ramps)
        )
        return total / np.maximum.outer(factor, factor)

    def solve(whitener: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = whitener @ design
        scale = np.linalg.norm(columns, axis=0)
        return nnls(columns / scale, whitener @ y, maxiter=1000)[0] / scale

    squares = solve(
        np.diag(np.sqrt(weight) / (np.maximum.accumulate(y / design[:, 0]) * design[:, 0]))
    )
    for _ in range(6):
        previous = squares
        spread, jitter = covariance(squares), 1e-7
        while (
            np.linalg.eigvalsh(spread + np.diag(jitter * np.diag(spread) + 1e-16 * y**2)).min() <= 0
        ):
            jitter *= 10
        whitener = np.linalg.inv(
            np.linalg.cholesky(spread + np.diag(jitter * np.diag(spread) + 1e-16 * y**2))
        )
        squares = solve(whitener)
        if (abs(squares - previous) <= 1e-4 * previous).all():
            break
    rows = np.empty((5, 6))
    for a in range(5):
        members = np.flatnonzero((squares > 0) | (np.arange(5) == a))
        columns = whitener @ design[:, members]
        scale = np.linalg.norm(columns, axis=0)
        estimator = (np.linalg.pinv(columns / scale) / scale[:, None] @ whitener)[
            list(members).index(a)
        ]
        trial = np.where(np.arange(5) == a, 0.0, squares)
        cell, stand_in = {0: (0, 1), 2: (-1, 3), 4: (-1, 3)}.get(a, (0, None))
        if stand_in is not None:
            trial[stand_in] += squares[a] * design[cell, a] / design[cell, stand_in]
        unit = np.eye(5)[a]
        null, both, own = (
            estimator @ covariance(s) @ estimator for s in (trial, trial + unit, unit)
        )
        place = list(members).index(a)
        error = (
            np.sqrt(np.linalg.inv((columns / scale).T @ (columns / scale))[place, place])
            / scale[place]
        )
        rows[a] = squares[a], error, estimator @ y, null, both - null - own, own
    names = (
        "square",
        "square_stderr",
        "free",
        "variance_null",
        "variance_linear",
        "variance_square",
    )
    out = dict(zip(names, rows.T, strict=True))
    return {
        **out,
        "chi2": np.asarray(np.sum((whitener @ (y - design @ squares)) ** 2)),
        "jitter": np.asarray(jitter),
    }

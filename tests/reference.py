"""Reference implementations: slow, plain versions of the fast paths, in extended precision."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from scipy.optimize import nnls

from gyrostab.arrays import Floats, Ints
from gyrostab.noise import NORMAL_95


def direct_surface(
    x: Floats,
    window: int,
    step: int,
    ks: list[int],
) -> tuple[Floats, Ints]:
    """Allan variance and number of terms of every window of a rate record, by definition."""
    n_windows = (x.size - window) // step + 1
    avar = np.full((n_windows, len(ks)), np.nan)
    count = np.zeros((n_windows, len(ks)), dtype=np.int64)
    for j in range(n_windows):
        rate = x[j * step : j * step + window].astype(np.longdouble)
        is_finite = np.isfinite(rate)
        if not is_finite.any():
            continue
        rate = np.where(is_finite, rate - rate[is_finite].mean(), 0)
        theta = np.concatenate(([0], np.cumsum(rate)))
        lost = np.concatenate(([0], np.cumsum(~is_finite)))
        for i, k in enumerate(ks):
            d = theta[2 * k :] - 2 * theta[k:-k] + theta[: -2 * k]
            keep = lost[2 * k :] == lost[: -2 * k]
            count[j, i] = keep.sum()
            if count[j, i]:
                avar[j, i] = float((d[keep] ** 2).sum() / (2 * np.longdouble(k) ** 2 * count[j, i]))
    return avar, count


def direct_angle_surface(
    theta: Floats, window: int, step: int, ks: list[int], interval: float
) -> tuple[Floats, Ints]:
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


def cluster_cell(x: Floats, k: int, *, stride: int = 1, first: int = 0) -> dict[str, float]:
    """One cell by weighted cluster means, from a matrix of pairs of clusters (rows) by samples.

    Pairs begin where ``first + m`` is a multiple of `stride`. Degrees of freedom are those under
    white noise.
    """
    is_finite = np.isfinite(x)
    rows, offered = [], 0
    for m in range(-first % stride, x.size - 2 * k + 1, stride):
        offered += 1
        clusters = np.zeros((2, x.size))
        clusters[0, m : m + k], clusters[1, m + k : m + 2 * k] = (
            is_finite[m : m + k],
            is_finite[m + k : m + 2 * k],
        )
        number = clusters.sum(axis=1)
        if (2 * number >= k).all():
            rows.append((number.prod(), clusters[1] / number[1] - clusters[0] / number[0]))
    if not rows:
        return {"count": 0}
    weight = np.array([row[0] for row in rows])
    design = np.array([row[1] for row in rows]) * np.sqrt(weight)[:, None]
    values = np.where(is_finite, x - x[is_finite].mean(), 0.0)
    angles = -np.diff(
        design, axis=1, prepend=0.0, append=0.0
    )  # the same terms of an angle instead of its differences
    pairs, ramp = design @ design.T, design @ np.arange(x.size)
    return {
        "count": len(rows),
        "avar": float(((design @ values) ** 2).sum() / (2 * weight.sum())),
        "white_response": float((design**2).sum() / (2 * weight.sum()) * k),
        "quantization_response": float((angles**2).sum() / (2 * weight.sum()) * k**2 / 3),
        "ramp_response": float((ramp**2).sum() / (weight.sum() * k**2)),
        "slope": float((design @ values) @ ramp / (ramp @ ramp)),
        "coverage": float(weight.sum() / (offered * float(k) ** 2)),
        "edf": float(np.trace(pairs) ** 2 / (pairs**2).sum()),
    }


def fit_window_plainly(
    y: Floats,
    white: Floats,
    quantization: Floats,
    ramp: Floats,
    factor: Floats,
    trend: Floats,
    tables: Any,
) -> dict[str, Any]:
    """Iterated non-negative generalised least squares of one window, with numpy and scipy.

    Squared coefficients, that of a ramp from the trend; chi-square; the share by which the
    variances had to be widened at last for a covariance that is positive definite; data and normal
    matrix in four sums of the cells, and their covariance as a function of the squares. `tables`
    are those of `gyrostab.allan.fit`.
    """
    ok = np.isfinite(y) & (y > 0) & (factor > 0)
    y, white, quantization, ramp, factor = y[ok], white[ok], quantization[ok], ramp[ok], factor[ok]
    bare, weight = tables.columns[ok], tables.weight[ok] * factor
    pairs = tables.trend.pairs[:, :, ok][..., ok]
    ramps = tables.trend.ramps[:, ok][..., ok]
    part = (bare[:, 4] * ramp)[:, None]
    design = bare[:, :4] * np.stack([quantization, white, *np.ones((2, y.size))], axis=1)
    design -= part * trend[:4]
    excess = np.maximum(quantization - 1, 0) * bare[:, 0] / bare[:, 1]
    # one sample of jumps across gaps at all averaging times; pairs of clusters that are left out
    jumps = bare[:, 0] * np.sqrt(2 * np.maximum(quantization - 1, 0) / tables.weight[ok])
    thinned = np.minimum(quantization, 1) ** 2 / factor * tables.diagonal[14, ok] * (white > 1)
    thinned *= tables.to_samples[0] ** 2
    z = y - part[:, 0] * trend[4]

    def covariance(s: Floats) -> Floats:
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
            * trend[5]
            * tables.to_samples[4]
            * np.sqrt(np.multiply.outer(ramp, ramp))
            * np.einsum("aij,aij->ij", outer, ramps)
        )
        gaps = np.outer(jumps, jumps) + np.diag(thinned)
        return total / np.maximum.outer(factor, factor) + s[0] ** 2 * gaps

    def solve(whitener: Floats) -> Floats:
        columns = whitener @ design
        scale = np.linalg.norm(columns, axis=0)
        squares = nnls(columns / scale, whitener @ z, maxiter=1000)[0] / scale
        return np.append(squares, max(trend[4] - trend[:4] @ squares, 0.0))

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
    reduced = whitener.T @ whitener @ design
    return {
        "square": squares,
        "data": reduced.T @ z,
        "normal": reduced.T @ design,
        "products": lambda s: reduced.T @ covariance(s) @ reduced,
        "chi2": np.asarray(np.sum((whitener @ (z - design @ squares[:4])) ** 2)),
        "jitter": np.asarray(jitter),
    }


def average_plainly(plain: dict[str, Any]) -> dict[str, Floats]:
    """Average a window of `fit_window_plainly` over the submodels of four terms, with numpy."""
    data, normal = plain["data"], plain["normal"]
    spread = 1.0 / np.sqrt(np.diag(normal))
    fits = []
    for members in (
        list(chosen) for size in range(1, 5) for chosen in combinations(range(4), size)
    ):
        squares = np.where(np.isin(np.arange(4), members), plain["square"][:4], 0.0)
        squares[members] = np.where(squares[members] > 0, squares[members], 0.1 * spread[members])
        for _ in range(3):
            covariance = plain["products"](np.append(np.maximum(squares, 0), plain["square"][4]))
            if not covariance.any():
                break
            scaled = covariance * np.outer(spread, spread)
            inverse = np.linalg.inv(scaled + 1e-9 * np.diag(np.diag(scaled)))
            inverse *= np.outer(spread, spread)
            columns = normal[:, members] * spread[members]
            rows = np.linalg.solve(columns.T @ inverse @ columns, columns.T @ inverse)
            rows *= spread[members][:, None]
            squares = np.zeros(4)
            squares[members] = rows @ data
        misfit = data - normal @ squares
        likelihood = -0.5 * (np.linalg.slogdet(scaled)[1] + misfit @ inverse @ misfit)
        if covariance.any():
            below = np.minimum(squares[members], 0.0) ** 2
            costs = np.zeros(4)
            costs[members] = below / np.einsum("pi,ij,pj->p", rows, covariance, rows)
            fits.append((members, squares, rows, likelihood, costs))

    def weigh(fits: list[Any], a: int | None = None) -> Any:
        costs = [0.0 if a is None else fit[4].sum() - fit[4][a] for fit in fits]
        logs = np.array([fit[3] for fit in fits]) - costs
        return np.exp(logs - logs.max())

    feasible = [fit for fit in fits if (fit[1][fit[0]] > 0).all()]
    weights = weigh(feasible)
    average = np.average([fit[1] for fit in feasible], axis=0, weights=weights)
    out = np.full((4, 10), np.nan)
    for a in range(4):
        able = [fit for fit in fits if a in fit[0] and all(fit[1][b] > 0 for b in fit[0] if b != a)]
        having = [fit for fit in fits if a in fit[0]]
        free, penalised = np.array([fit[1][a] for fit in having]), weigh(having, a)
        mean = np.average(free, weights=penalised)
        best = [
            max((fit[3] for fit in feasible if (a in fit[0]) == included), default=-np.inf)
            for included in (True, False)
        ]

        def scatter(
            fits: list[Any], weights: Any, noise: Floats, a: int = a
        ) -> tuple[float, float, float]:
            rows = [fit[2][fit[0].index(a)] for fit in fits]

            def variance(squares: Floats) -> Any:
                covariance = plain["products"](squares)
                return np.average([row @ covariance @ row for row in rows], weights=weights)

            noise = np.where(np.arange(5) == a, 0.0, noise)
            unit = np.eye(5)[a] * spread[a]
            null, combined, own = variance(noise), variance(noise + unit), variance(unit)
            return null, (combined - null - own) / spread[a], own / spread[a] ** 2

        noise = np.append(average, plain["square"][4])
        null, linear, own = scatter(able, weigh(able), noise)
        covariance = plain["products"](noise)
        shared = np.zeros((len(having), 4))
        for fit, line in zip(having, shared, strict=True):
            line[fit[0]] = fit[2] @ covariance @ fit[2][fit[0].index(a)]
        others = np.average(shared, axis=0, weights=penalised)
        inside = np.array([any(fit is other for other in able) for fit in having])
        wide = weigh(able) * shared[inside, a] ** 2
        low, error = np.average([free[inside], shared[inside, a]], axis=1, weights=wide)
        fall = min(max(low, 0.0), NORMAL_95 * np.sqrt(error))
        rise = np.maximum(-others / others[a], 0.0) * fall
        out[a] = (
            average[a],
            mean,
            2 * (best[0] - best[1]),
            null + np.average((free - mean) ** 2, weights=penalised),
            linear,
            own,
            low,
            *scatter(able, wide, noise + np.append(rise, 0.0)),
        )
        out[a, 7] += np.average((free[inside] - low) ** 2, weights=wide)
    return dict(
        zip(
            (
                "square",
                "free",
                "likelihood_ratio",
                "variance_null",
                "variance_linear",
                "variance_square",
                "low",
                "low_null",
                "low_linear",
                "low_square",
            ),
            out.T,
            strict=True,
        )
    )

"""The algorithms of the papers, for tests, benchmarks and the pages that compare with them.

`published_davar` has the classical and the recursive DAVAR of P16, `fit_deviations` the fit of P15.

References
----------
P16: Wang et al., Sensors 16 (2016): Eq. 16-17 (classical), 19-20 (recursion), 21-22 (missing data).
P15: Wang et al., Measurement 75 (2015) 263, Eq. 3-4.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr
from numba import njit

from gyrostab import davar, fit_noise
from gyrostab.arrays import Array, Floats, Ints
from gyrostab.kernels.compiled import INNER, KERNEL
from gyrostab.noise import TERMS, avar_columns

#: Smallest share of the terms of a cell.
MIN_COVERAGE = 0.1


def published_davar(
    log: xr.Dataset, *, method: str, paper: bool = False, zero_fill: bool = False, **options: Any
) -> xr.Dataset:
    """Compute a surface of rates by a published algorithm.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log of rates.
    method : {"direct", "recursive"}
        Classical DAVAR (Eq. 16), or the recursion (Eq. 19), which adds the newest and subtracts the
        oldest square. Differences of nearly equal sums lose all precision after a shock.
    paper : bool
        Use one angle per sample, so that a window has ``W - 2k`` terms, and omit the last window.
    zero_fill : bool
        Divide by the number of terms without gaps, instead of the number of terms.
    **options
        Options of `gyrostab.davar`.

    Returns
    -------
    xarray.Dataset
        As from `gyrostab.davar`; what the algorithm does not give is lazy.
    """
    surface = davar(log.chunk(time=-1), **options)
    window, step = (int(surface.attrs[f"{name}_samples"]) for name in ("window", "step"))
    ks = np.rint(surface["tau"].values * surface.attrs["sampling_rate_hz"]).astype(np.int64)
    surface = surface.isel(time=slice(surface.sizes["time"] - paper))
    shape = method, window, step, surface.sizes["time"], ks
    cells = [
        published_sums(np.asarray(x, np.float64), *shape, paper=paper) for x in log["rate"].data
    ]
    sums, counts = (np.stack(part) for part in zip(*cells, strict=True))
    full = (window + 1 - paper - 2 * ks).astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        avar = sums / (2.0 * ks.astype(np.float64) ** 2 * (full if zero_fill else counts))
    coverage = counts / full
    ones = np.ones_like(avar)
    cubes = {
        "avar": np.where(zero_fill | (coverage >= MIN_COVERAGE), avar, np.nan),
        "count": counts,
        "coverage": coverage,
        "gap_factor": coverage,
        "estimator": ones.astype(np.int8),
        "difference_trend": np.nan * ones,
        **{f"{name}_response": ones for name in ("white", "quantization", "ramp")},
    }
    return surface.assign({name: surface[name].copy(data=cube) for name, cube in cubes.items()})


def published_sums(
    x: Floats,
    method: str,
    window: int,
    step: int,
    n_windows: int,
    ks: Ints,
    *,
    paper: bool = False,
) -> tuple[Floats, Ints]:
    """Sum and count the squared second differences of a record alone, (n_windows, n_tau)."""
    run = {"direct": _direct_sums, "recursive": _recursive_sums}[method]
    return run(*_integrate_rates(x, paper=paper), window + 1 - paper, step, n_windows, ks)


def _integrate_rates(x: Floats, *, paper: bool) -> tuple[Floats, Ints, Ints]:
    """Integrate a record, with the missing samples before the first and after the last angle.

    A term is valid if none is missing between: with `paper`, also that of its first angle.
    """
    finite = np.isfinite(x)
    theta = np.append(0.0, np.cumsum(np.where(finite, x, 0.0)))
    missing = np.append(0, np.cumsum(~finite))
    return theta[paper:], missing[: missing.size - paper], missing[paper:]


def _direct_sums(
    theta: Floats,
    before: Ints,
    after: Ints,
    points: int,
    step: int,
    n_windows: int,
    ks: Ints,
) -> tuple[Floats, Ints]:
    """Sum and count the squares of every window anew, (n_windows, n_tau)."""
    sums = np.zeros((n_windows, ks.size))
    counts = np.zeros((n_windows, ks.size), dtype=np.int64)
    for j in range(n_windows):
        part = slice(j * step, j * step + points)
        angle, first, last = theta[part] - theta[j * step], before[part], after[part]
        for i, k in enumerate(ks):
            d = angle[2 * k :] - 2.0 * angle[k:-k] + angle[: -2 * k]
            valid = last[2 * k :] == first[: -2 * k]
            sums[j, i] = np.sum(d[valid] ** 2)
            counts[j, i] = np.count_nonzero(valid)
    return sums, counts


@njit(**INNER)
def _square_differences(theta, before, after, k, squares, valid):  # type: ignore[no-untyped-def]
    """Compute the square of each second difference; zero where it is missing."""
    first, middle, last = theta, theta[k:], theta[2 * k :]
    for m in range(last.size):
        is_valid = after[m + 2 * k] == before[m]
        difference = last[m] - 2.0 * middle[m] + first[m]
        squares[m] = difference * difference if is_valid else 0.0
        valid[m] = is_valid


@njit(**KERNEL)
def _recursive_sums(theta, before, after, points, step, n_windows, ks):  # type: ignore[no-untyped-def]
    """Do what `_direct_sums` does by recursion."""
    sums = np.zeros((n_windows, ks.size))
    counts = np.zeros((n_windows, ks.size), np.int64)
    squares, valid = np.zeros(theta.size), np.zeros(theta.size, np.int8)
    for i in range(ks.size):
        length = points - 2 * ks[i]
        _square_differences(theta, before, after, ks[i], squares, valid)
        total, count = 0.0, 0
        for m in range(length):  # the starting value, Eq. 20
            total += squares[m]
            count += valid[m]
        sums[0, i], counts[0, i] = total, count
        newest, newest_valid = squares[length:], valid[length:]
        for j in range(1, n_windows):
            for n in range((j - 1) * step, j * step):
                total += newest[n] - squares[n]
                count += newest_valid[n] - valid[n]
            sums[j, i], counts[j, i] = total, count
    return sums, counts


def fit_deviations(surface: xr.Dataset, *, terms: Iterable[str] = "QNBKR") -> xr.Dataset:
    """Fit the Allan deviation of each window in half-integer powers of tau, without weights (P15).

    It adds deviations although variances add, and gives no errors.
    """
    product = fit_noise(surface, terms=terms, tau_min="all")
    deviation = np.sqrt(surface["avar"].values)
    members = [TERMS.index(term) for term in terms]
    columns = np.sqrt(avar_columns(surface["tau"].values))[:, members]
    scale = np.linalg.norm(columns, axis=0)
    values = np.full((*deviation.shape[:2], len(TERMS)), np.nan)
    for where in np.ndindex(deviation.shape[:2]):
        valid = np.isfinite(deviation[where])
        if np.count_nonzero(valid) >= len(members):
            solution = np.linalg.lstsq(columns[valid] / scale, deviation[where][valid], rcond=None)
            values[where][members] = np.abs(solution[0] / scale)
    planes: dict[str, Array] = {"observable": np.where(np.isfinite(values), 2, 0)}
    nothing = np.full(deviation.shape[:2], np.nan)
    for i, term in enumerate(TERMS):
        planes |= {term: values[..., i], f"{term}_stderr": nothing, f"{term}_upper": nothing}
        if f"{term}_squared" in product:
            planes[f"{term}_squared"] = values[..., i] ** 2
    planes |= {"fit_chi2": nothing, "fit_dof": nothing}
    return product.assign({name: product[name].copy(data=plane) for name, plane in planes.items()})

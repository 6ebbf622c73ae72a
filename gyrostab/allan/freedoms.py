"""Degrees of freedom of the cells of a surface, from a quick fit of the noise.

Imports neither xarray nor dask, so that `gyrostab.allan.compile_fit` starts soon.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gyrostab.allan.variance import variance_columns, white_freedoms
from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.allan.clusters import cluster_strides
from gyrostab.kernels.allan.surface import Cells
from gyrostab.kernels.fit.covariance import product_tables
from gyrostab.kernels.fit.freedoms import cell_freedoms, combine_diagonal
from gyrostab.kernels.fit.least_squares import identify_noise
from gyrostab.kernels.fit.mixture import Curves
from gyrostab.noise import sample_squares

if TYPE_CHECKING:
    from gyrostab.allan.plan import SurfacePlan

#: Largest number of averaging times in a fit; more add no information and cost the cube of their
#: number.
MOST_TAUS = 48


def thin_factors(ks: Ints) -> Ints:
    """Choose the averaging factors to fit: all, or `MOST_TAUS` of them, evenly spaced in log."""
    if ks.size <= MOST_TAUS:
        return np.arange(ks.size)
    targets = np.geomspace(ks[0], ks[-1], MOST_TAUS)
    return np.unique(np.abs(np.log(ks)[:, None] - np.log(targets)[None, :]).argmin(axis=0))


class NoiseTables(NamedTuple):
    """Arguments of `identify_noise` and `cell_freedoms` that all windows share."""

    chosen: Ints
    columns: Floats
    weight: Floats
    to_samples: Floats
    diagonal: Floats


def make_noise_tables(plan: SurfacePlan) -> NoiseTables:
    """Make the tables for the degrees of freedom of a plan."""
    unit = plan.unit
    return tabulate_noise(unit.window, tuple(unit.ks.tolist()), plan.rate, unit.variance)


@lru_cache(maxsize=4)
def tabulate_noise(
    window: int, factors: tuple[int, ...], rate: float, variance: str
) -> NoiseTables:
    """Make the tables for the degrees of freedom, once for all parts of a log."""
    ks = np.array(factors, dtype=np.int64)
    columns = variance_columns(variance, ks, rate)
    pairs, ramps = product_tables(window, ks, variance=variance, diagonal=True)
    weight = white_freedoms(variance, window, ks, pairs)
    diagonal = combine_diagonal(pairs, ramps, cluster_strides(window, ks))
    return NoiseTables(thin_factors(ks), columns, weight, sample_squares(rate), diagonal)


def estimate_freedoms(cells: Cells, tables: NoiseTables) -> Floats:
    """Compute the degrees of freedom of cells (n_windows, n_tau) from a quick fit of the noise."""
    chosen, columns, weight, to_samples, diagonal = tables
    fields = Curves(cells.avar, *cells[5:8], cells.gap_factor)
    few = Curves(*(np.ascontiguousarray(field[:, chosen]) for field in fields))
    squares = identify_noise(few, columns[chosen], weight[chosen], to_samples)
    return np.asarray(cell_freedoms(squares, fields, columns, to_samples, diagonal))

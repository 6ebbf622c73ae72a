"""Held-out evidence of designs, for many records and many designs from the same few products.

The data are block means, ``y ~ Normal(X beta, V)`` with V from
`gyrostab.kernels.regression.state_space`, and band powers, ``P / S - 1 ~ Normal(X beta, 1 /
shape)`` in every cell. The sizes beta have a normal prior whose width is one of `prior_widths`
times the error of beta in white noise. Widths, and random walk K and flicker B on a grid, are
averaged over. A design therefore enters only by products of whitened columns. They take time linear
in the number of blocks, and records with the same gaps share them.

A *design* is an array of columns, a *candidate* a list of designs, one for every value of its
nuisance parameters, of equal weight. A *factor* is always a log Bayes factor [nats], that of a
design against the model without it. The held-out evidence of a candidate is the sum over the folds
of the loss of its factor when the fold is held out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from typing import Literal, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.diagnose.evidence.folds import FOLDS, fold_blocks, fold_subsets
from gyrostab.diagnose.evidence.products import (
    Products,
    axis_noise,
    column_pairs,
    log_evidence,
    marginalise,
    mean_products,
    power_products,
    prior_widths,
    remove_common_part,
    size_errors,
)
from gyrostab.diagnose.evidence.wandering import RandomProcesses
from gyrostab.diagnose.reduce.schema import axis_values

#: "free": the noise may differ from the calibrated one (to name an effect); "calibrated": it is the
#: calibrated one (to detect an effect).
Tier = Literal["free", "calibrated"]
#: Standard deviation by which each squared coefficient may change, in units of its value and error;
#: `noise_columns` gives the reasons. That of N leaves it free.
_FREEDOM = {"Q": 1.0, "N": 1e3, "B": 3.0, "K": 3.0}


def _number_columns(designs: Sequence[Floats]) -> list[Ints]:
    """Return the indices of the columns of each design, the last dimension, among those of all."""
    ends = np.cumsum([design.shape[-1] for design in designs])
    return [
        np.arange(end - design.shape[-1], end) for design, end in zip(designs, ends, strict=True)
    ]


def mean_residual(data: xr.Dataset, baseline: xr.Dataset, axis: str) -> Floats:
    """Return the block means of an axis less those of known effects, (block, record)."""
    mean = data.variables["mean"].isel(axis=data.variables["axis"].values.tolist().index(axis))
    by_record = mean.transpose("block", ...).values.reshape(data.sizes["block"], -1)
    return np.asarray(by_record - axis_values(baseline, "known_mean", axis)[:, None])


def noise_weight(baseline: xr.Dataset, axis: str, tier: Tier) -> Floats:
    """Return the log weights of the grid of K and B, (grid,)."""
    name = "grid_prior" if tier == "free" else "grid_calibrated"
    return np.asarray(axis_values(baseline, name, axis), dtype=np.float64)


def mean_factors(
    data: xr.Dataset,
    baseline: xr.Dataset,
    designs: Sequence[Floats],
    *,
    axis: str,
    tier: Tier = "free",
    given: Floats | None = None,
    folds: xr.DataArray | None = None,
    wander: RandomProcesses | None = None,
) -> Floats:
    """Compute factors of designs in the block means of an axis, one record or many of equal gaps.

    Parameters
    ----------
    designs : sequence of ndarray, shape (block,) or (block, column)
        Columns in any unit.
    given : ndarray, shape (block, column), optional
        Columns in the model with and without the design (effects already named).
    wander : RandomProcesses, optional
        Random processes in the means; those of the baseline by default.

    Returns
    -------
    ndarray, shape (subset, 1 + design, record)
        Log Bayes factors on the subsets of `fold_subsets` [nats]; the first column is the log
        evidence without any design.
    """
    n = data.sizes["block"]
    values = mean_residual(data, baseline, axis)
    flat = [np.asarray(design, dtype=np.float64).reshape(n, -1) for design in designs]
    columns_given = (
        np.empty((n, 0)) if given is None else np.asarray(given, dtype=np.float64).reshape(n, -1)
    )
    columns = np.concatenate(
        [*(np.where(np.isfinite(design), design, 0.0) for design in flat), columns_given], axis=1
    )
    numbers, design_width = _number_columns(flat), columns.shape[1] - columns_given.shape[1]
    present = np.asarray(np.isfinite(values).all(axis=1))
    setup = axis_noise(baseline, axis) | {
        "step": float(data.variables["end"].values[0] - data.variables["begin"].values[0]),
        "pairs": column_pairs(columns.shape[1], numbers, columns_given.shape[1]),
    }
    if wander is not None:
        setup["wander"] = wander
    white = mean_products(
        values, columns, **(setup | {"K": np.zeros(1), "B": np.zeros(1)}), present=present
    )
    widths = prior_widths(white.square)
    raw_square = (columns[present] ** 2 / setup["variance"][present, None]).sum(axis=0)
    errors = size_errors(raw_square, np.diagonal(white.gram[0]))[design_width:]
    precision = np.diag(1.0 / np.square(np.where(errors > 0.0, errors, 1.0) * widths[-1]))
    without_given = marginalise(white, columns_given.shape[1], precision)
    limits = size_errors(raw_square[:design_width], np.diagonal(without_given.gram[0]))
    log_weight = noise_weight(baseline, axis, tier)
    subsets = fold_subsets(fold_blocks(data) if folds is None else folds)
    by_subset = (
        mean_products(values, columns, **setup, present=present & subset) for subset in subsets
    )
    return _factors_by_subset(by_subset, precision, numbers, limits, log_weight, widths)


def _factors_by_subset(
    by_subset: Iterable[Products],
    precision: Floats,
    designs: Sequence[Ints],
    limits: Floats,
    log_weight: Floats,
    widths: Floats,
    is_bounded: Sequence[bool] = (),
) -> Floats:
    """Return the factors of designs from products, whose last columns have this prior precision."""
    out = np.stack(
        [
            log_evidence(
                marginalise(part, len(precision), precision),
                designs,
                limits,
                log_weight,
                widths,
                is_bounded,
            )
            for part in by_subset
        ]
    )
    out[:, 1:] -= out[:, :1]
    return out


def noise_columns(baseline: xr.Dataset, *, axis: str) -> tuple[Floats, Floats, Floats]:
    """Return the relative change of the spectrum per noise coefficient, with prior and least size.

    N may take any value; Q changes by its value and error, B and K by three times that, because the
    spectrum cannot fall below what the other terms leave. The error of Q is that of its posterior,
    which ends at zero: Q cannot explain a spectrum that falls towards its end, for instance after a
    filter.

    Returns
    -------
    columns : ndarray, shape (block, band, term)
        Per unit of the squared coefficient [1 / unit], for terms with an error.
    precision : ndarray, shape (term, term)
        For changes of the squared coefficients.
    low : ndarray, shape (term,)
        Least changes, at which no noise of a term is left; none for N, which may be extrapolated to
        a temperature far from all of the record.
    """
    spectrum = axis_values(baseline, "spectrum", axis)
    columns = axis_values(baseline, "columns", axis) / spectrum[..., None]
    square = axis_values(baseline, "square", axis)
    error = axis_values(baseline, "square_stderr", axis)
    names = [str(name) for name in baseline["noise"].values]
    freedom = np.array([_FREEDOM[name] for name in names])
    if "posterior" in baseline:
        within = axis_values(baseline, "posterior", axis).std(axis=0)
        error = np.where(np.array(names) == "Q", np.minimum(error, within), error)
    error = freedom * np.hypot(square, error)
    free = error > 0.0
    low = np.where(np.array(names) == "N", -np.inf, -square)
    return columns[..., free], np.diag(1.0 / np.square(error[free])), low[free]


class LinearModel(NamedTuple):
    """A linear model of data that are independent from cell to cell."""

    values: Floats  # (block, cell, record)
    weight: Floats  # (block, cell): inverse variance; 0 for no data
    designs: list[Floats]  # (block, cell, column) each
    given: Floats  # (block, cell, column): columns in the model with and without a design
    #: (column, column): for the given columns; negative on the diagonal for a nearly free column,
    #: whose precision is taken from the data.
    precision: Floats
    is_bounded: Sequence[bool] = ()  # for each design, whether its sizes cannot be negative
    low: Floats = np.empty(0)  # (column,): least sizes of the given columns

    def usable_weight(self) -> Floats:
        """Return the weight, 0 where it is unknown or a record has no value."""
        usable = np.isfinite(self.weight) & np.isfinite(self.values).all(axis=2)
        return np.where(usable, self.weight, 0.0)


def with_independent_cells(model: LinearModel, common: Floats, unit: Floats) -> LinearModel:
    """Transform a model whose cells vary together to independent cells; `remove_common_part`."""
    weight = model.usable_weight()
    present = weight[..., None] > 0.0
    values, given, *designs = (
        remove_common_part(np.where(present & np.isfinite(array), array, 0.0), weight, common, unit)
        for array in (model.values, model.given, *model.designs)
    )
    return model._replace(values=values, weight=weight, designs=designs, given=given)


def linear_model_factors(model: LinearModel, folds: xr.DataArray) -> Floats:
    """Compute factors of designs in independent cells, in the shape of `mean_factors`."""
    records = model.values.shape[2]
    weight = model.usable_weight()
    values = np.where(weight[..., None] > 0.0, model.values, 0.0)
    count = model.given.shape[2]
    flat = [np.where(np.isfinite(array), array, 0.0) for array in (*model.designs, model.given)]
    columns = np.concatenate(flat, axis=2)
    numbers = _number_columns(model.designs)
    classes, member = np.unique(folds.values.T, axis=0, return_inverse=True)
    products = []
    for number in range(len(classes)):
        chosen = member.ravel() == number
        cells = values[chosen].reshape(-1, records), weight[chosen].ravel()
        size = cells[1].size
        products.append(power_products(*cells, columns[chosen].reshape(size, -1)))
    total = _sum_products(products)
    design_width = columns.shape[2] - count
    raw_square = np.asarray(np.diagonal(total.gram[0]))
    widths = prior_widths(total.square)
    precision = _fill_free_precision(model.precision, raw_square[design_width:], widths[-1])
    without_given = marginalise(total, count, precision)
    limits = size_errors(raw_square[:design_width], np.diagonal(without_given.gram[0]))
    subset_products = [total]
    for length in range(classes.shape[1]):
        for number in range(FOLDS):
            of_fold = zip(products, classes[:, length] == number, strict=True)
            held = _sum_products([part for part, is_held in of_fold if is_held])
            subset_products.append(Products(*(a - b for a, b in zip(total, held, strict=True))))
    return _factors_by_subset(
        subset_products, precision, numbers, limits, np.zeros(1), widths, model.is_bounded
    )


def _sum_products(products: Sequence[Products]) -> Products:
    return Products(*(reduce(np.add, arrays) for arrays in zip(*products, strict=True)))


def _fill_free_precision(precision: Floats, square: Floats, width: float) -> Floats:
    """Return precisions of given columns, negative ones replaced by a prior of this width."""
    diagonal = np.diagonal(precision)
    free = np.where(square > 0.0, square, 1.0) / width**2
    return np.diag(np.where(diagonal < 0.0, free, diagonal))

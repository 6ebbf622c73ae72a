"""What a design explains on time that was held out, for many records and many designs in the same few products.

The data are block means, ``y ~ Normal(X beta, V)`` with V from
`gyrostab.kernels.regression.state_space`, and band powers, ``P / S - 1 ~ Normal(X beta, 1 /
shape)`` in every cell. Factors beta have a normal prior whose width is one of `WIDTHS` times the
error that beta would have in white noise alone; widths, and random walk K and flicker B on a grid,
are averaged over. So all there is to know of a design are products of whitened columns. They are
linear in the number of blocks, and records with the same gaps share them.

A *design* is an array of columns, a *candidate* a list of designs, one for every value of its
nuisance parameters, of equal weight. The *factor* of a design is the logarithm of its Bayes factor
against the model without it, and the held-out gain of a candidate is the sum over the folds of what
its factor loses when the fold is taken out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.folds import FOLDS, fold_blocks, fold_subsets
from gyrostab.diagnose.evidence.products import (
    WIDTHS,
    Array,
    Products,
    evidence,
    limits_of,
    mean_products,
    pairs_of,
    power_products,
    score,
    share_out,
    take_out,
)
from gyrostab.diagnose.evidence.wandering import known_wander
from gyrostab.errors import OptionError

__all__ = [
    "LinearModel",
    "Tier",
    "independent",
    "linear_model_factors",
    "mean_evidence",
    "mean_factors",
    "noise_columns",
    "power_evidence",
    "power_factors",
    "score",
]

#: "free": any noise may be there (to name an effect); "calibrated": the noise is the calibrated one
#: (to detect that something is there).
Tier = Literal["free", "calibrated"]


def _columns(
    designs: Sequence[Array], shape: tuple[int, ...]
) -> tuple[Array, list[NDArray[np.int64]]]:
    """All designs beside each other as (cell, column), and the numbers of the columns of each."""
    components, numbers, first = [], [], 0
    for design in designs:
        array = np.asarray(design, dtype=np.float64)
        if array.shape[: len(shape)] != shape or array.ndim > len(shape) + 1:
            raise OptionError(
                f"a design has the shape {array.shape}; it must be {shape}, or that with the number of its columns behind"
            )
        flat = array.reshape(int(np.prod(shape)), -1)
        components.append(np.where(np.isfinite(flat), flat, 0.0))
        numbers.append(np.arange(first, first + flat.shape[1]))
        first += flat.shape[1]
    return np.concatenate([*components, np.empty((int(np.prod(shape)), 0))], axis=1), numbers


def _records(values: xr.DataArray, *dims: str) -> Array:
    """Values with `dims` first and the records last, one record when there is no such dimension."""
    array = values if "record" in values.dims else values.expand_dims("record")
    return np.asarray(array.transpose(*dims, "record").values, dtype=np.float64)


def _log_weight(baseline: xr.Dataset, axis: str, tier: Tier) -> Array:
    if tier not in ("free", "calibrated"):
        raise OptionError(f"tier={tier!r}: there are 'free' and 'calibrated'")
    name = "grid_prior" if tier == "free" else "grid_calibrated"
    return np.asarray(baseline[name].sel(axis=axis).values, dtype=np.float64)


def mean_factors(
    data: xr.Dataset,
    baseline: xr.Dataset,
    designs: Sequence[Array],
    *,
    axis: str,
    tier: Tier = "free",
    given: Array | None = None,
    folds: xr.DataArray | None = None,
) -> Array:
    """Factors of designs in the block means.

    Parameters
    ----------
    data : xarray.Dataset
        Reduced data, one record or many with the same gaps: ``mean`` ((record,) axis block) [degree
        hour-1].
    baseline : xarray.Dataset
        ``known_mean``, ``mean_variance``, ``grid_K``, ``grid_B``, ``grid_prior``,
        ``grid_calibrated``.
    designs : sequence of ndarray, shape (block,) or (block, column)
        Columns in any unit.
    axis : str
        Axis looked at.
    tier : {"free", "calibrated"}
        What the noise may be.
    given : ndarray, shape (block, column), optional
        Columns that are in the model with and without the design (effects already named).
    folds : xarray.DataArray, optional
        From `fold_blocks`.

    Returns
    -------
    ndarray, shape (subset, 1 + design, record)
        Logarithms of Bayes factors on the subsets of `fold_subsets` [nats]; the first of the
        designs is the log evidence without any.
    """
    n = data.sizes["block"]
    values = _records((data["mean"] - baseline["known_mean"]).sel(axis=axis), "block")
    columns, numbers = _columns(designs, (n,))
    beside = (
        np.empty((n, 0)) if given is None else np.asarray(given, dtype=np.float64).reshape(n, -1)
    )
    own = columns.shape[1]
    columns = np.concatenate([columns, beside], axis=1)
    present = np.asarray(np.isfinite(values).all(axis=1))
    frame: dict[str, Any] = {
        "variance": np.asarray(baseline["mean_variance"].sel(axis=axis).values, dtype=np.float64),
        "step": float(data["end"][0] - data["begin"][0]),
        "pairs": pairs_of(columns.shape[1], numbers, beside.shape[1]),
        "wander": known_wander(baseline, axis),
    }
    white = mean_products(
        values[:, :0], columns, **frame, K=np.zeros(1), B=np.zeros(1), present=present
    )
    before = (np.where(present[:, None], columns, 0.0) ** 2 / frame["variance"][:, None])[
        present
    ].sum(axis=0)
    wide = limits_of(before, np.diagonal(white.gram[0]))[own:]
    precision = np.diag(1.0 / np.square(np.where(wide > 0.0, wide, 1.0) * WIDTHS[-1]))
    limits = limits_of(
        before[:own], np.diagonal(take_out(white, beside.shape[1], precision).gram[0])
    )
    grid: dict[str, Any] = {
        "K": baseline["grid_K"].sel(axis=axis).values,
        "B": baseline["grid_B"].sel(axis=axis).values,
    }
    log_weight = _log_weight(baseline, axis, tier)
    subsets = fold_subsets(fold_blocks(data) if folds is None else folds)
    out = np.empty((len(subsets), 1 + len(designs), values.shape[1]))
    for number, subset in enumerate(subsets):
        products = mean_products(values, columns, **frame, **grid, present=present & subset)
        out[number] = evidence(
            take_out(products, beside.shape[1], precision), numbers, limits, log_weight
        )
    out[:, 1:] -= out[:, :1]
    return out


def noise_columns(baseline: xr.Dataset, *, axis: str, tier: Tier = "free") -> tuple[Array, Array]:
    """Relative change of the spectrum by constant changes of the noise coefficients, and the precision of its prior.

    N may take any value in the tier "free"; Q changes by its value and error, B and K by three
    times that, because the spectrum cannot fall below what the other terms leave. The error of Q is
    that of its posterior, which ends at zero: a spectrum that falls towards its end, as a filter
    makes it, is no Q. In the tier "calibrated" all change by their errors.

    Returns
    -------
    columns : ndarray, shape (block, band, term)
        Per unit of the squared coefficient [1 / unit], of the terms that may change: one that is
        exactly known stays.
    precision : ndarray, shape (term, term)
        Of the change of the squared coefficient.
    """
    spectrum = baseline["spectrum"].sel(axis=axis).transpose("block", "band").values
    columns = (
        baseline["columns"].sel(axis=axis).transpose("block", "band", "noise").values
        / spectrum[..., None]
    )
    square = baseline["square"].sel(axis=axis).values
    error = baseline["square_stderr"].sel(axis=axis).values
    if tier == "free":
        names = [str(name) for name in baseline["noise"].values]
        freedom = np.array([{"Q": 1.0, "N": 1e3, "B": 3.0, "K": 3.0}[name] for name in names])
        if "posterior" in baseline:
            within = (
                baseline["posterior"].sel(axis=axis).transpose("draw", "noise").values.std(axis=0)
            )
            error = np.where(np.array(names) == "Q", np.minimum(error, within), error)
        error = freedom * np.hypot(square, error)
    free = error > 0.0
    return columns[..., free], np.diag(1.0 / np.square(error[free]))


class LinearModel(NamedTuple):
    """Data that are independent from cell to cell, as a linear model.

    Attributes
    ----------
    values : ndarray, shape (block, cell, record)
    weight : ndarray, shape (block, cell)
        One over the variance; 0 where there are no data.
    designs : list of ndarray, shape (block, cell, column)
    given : ndarray, shape (block, cell, column)
        Columns that are in the model with and without a design.
    precision : ndarray, shape (column, column)
        Of the given columns; negative on the diagonal where it is to be taken from the data (nearly
        free).
    """

    values: Array
    weight: Array
    designs: list[Array]
    given: Array
    precision: Array


def independent(cells: LinearModel, common: Array, unit: Array | None = None) -> LinearModel:
    """The same model with independent cells, where those of a block rise and fall together; see `share_out`."""
    weight = np.where(
        np.isfinite(cells.weight) & np.isfinite(cells.values).all(axis=2), cells.weight, 0.0
    )
    seen = weight[..., None] > 0.0
    values, given, *designs = (
        share_out(np.where(seen & np.isfinite(one), one, 0.0), weight, common, unit)
        for one in (cells.values, cells.given, *cells.designs)
    )
    return LinearModel(values, weight, designs, given, cells.precision)


def linear_model_factors(cells: LinearModel, folds: xr.DataArray) -> Array:
    """Factors of designs in independent cells.

    Parameters
    ----------
    cells : Cells
    folds : xarray.DataArray
        From `fold_blocks`.

    Returns
    -------
    ndarray, shape (subset, 1 + design, record)
        As in `mean_factors`.
    """
    _, width, records = cells.values.shape
    weight = np.where(
        np.isfinite(cells.weight) & np.isfinite(cells.values).all(axis=2), cells.weight, 0.0
    )
    values = np.where(weight[..., None] > 0.0, cells.values, 0.0)
    count = cells.given.shape[2]
    flat = [np.where(np.isfinite(one), one, 0.0) for one in (*cells.designs, cells.given)]
    columns = np.concatenate(flat, axis=2)
    ends = np.cumsum([one.shape[2] for one in cells.designs])
    numbers = [
        np.arange(end - one.shape[2], end) for one, end in zip(cells.designs, ends, strict=True)
    ]
    classes, member = np.unique(
        folds.transpose("block", "length").values, axis=0, return_inverse=True
    )
    components = []
    for number in range(len(classes)):
        chosen = member.ravel() == number
        size = int(chosen.sum()) * width
        components.append(
            power_products(
                values[chosen].reshape(size, records),
                weight[chosen].ravel(),
                columns[chosen].reshape(size, -1),
            )
        )
    total = _summed(components)
    own = columns.shape[2] - count
    before = np.asarray(np.diagonal(total.gram[0]))
    precision = _nearly_free(cells.precision, before[own:])
    limits = limits_of(
        before[:own], np.asarray(np.diagonal(take_out(total, count, precision).gram[0]))
    )
    found = [total]
    for length in range(classes.shape[1]):
        for number in range(FOLDS):
            held = _summed(
                [
                    component
                    for component, label in zip(components, classes[:, length], strict=True)
                    if label == number
                ],
                total,
            )
            found.append(
                Products(*[a - b for a, b in zip(_fields(total), _fields(held), strict=True)])
            )
    out = np.stack(
        [
            evidence(take_out(component, count, precision), numbers, limits, np.zeros(1))
            for component in found
        ]
    )
    out[:, 1:] -= out[:, :1]
    return out


def _fields(products: Products) -> tuple[Array, ...]:
    return products.square, products.cross, products.gram, products.log_determinant


def _summed(components: Sequence[Products], like: Products | None = None) -> Products:
    if not components and like is not None:
        return Products(*[np.zeros_like(one) for one in _fields(like)])
    return Products(
        *[np.sum(several, axis=0) for several in zip(*map(_fields, components), strict=True)]
    )


def _nearly_free(precision: Array, square: Array) -> Array:
    """Precisions of given columns, those that are negative from the widest prior of a design."""
    known = np.diagonal(precision)
    free = np.where(square > 0.0, square, 1.0) / WIDTHS[-1] ** 2
    return np.diag(np.where(known < 0.0, free, known))


def power_factors(
    data: xr.Dataset,
    baseline: xr.Dataset,
    designs: Sequence[Array],
    *,
    axis: str,
    tier: Tier = "free",
    given: Array | None = None,
    folds: xr.DataArray | None = None,
) -> Array:
    """Factors of designs in the band powers, for changes that are small against the spectrum.

    Parameters
    ----------
    data : xarray.Dataset
        Reduced data, one record or many with the same gaps: ``power`` ((record,) axis block band).
    baseline : xarray.Dataset
        ``spectrum``, ``shape_alone``, ``common``, and what `noise_columns` reads.
    designs : sequence of ndarray, shape (block, band) or (block, band, column)
        Change of the spectrum as a share of it, for a unit of the factor.
    axis, tier, given, folds
        As in `mean_factors`; `given` has the shape (block, band, column), and the level of the
        noise is always given.

    Returns
    -------
    ndarray, shape (subset, 1 + design, record)
        As in `mean_factors`.
    """
    shape = (data.sizes["block"], data.sizes["band"])
    values = _records((data["power"] / baseline["spectrum"] - 1.0).sel(axis=axis), "block", "band")
    weight = np.asarray(
        baseline["shape_alone"].sel(axis=axis).transpose("block", "band").values, dtype=np.float64
    )
    level, precision = noise_columns(baseline, axis=axis, tier=tier)
    beside = (
        np.empty((*shape, 0))
        if given is None
        else np.asarray(given, dtype=np.float64).reshape(*shape, -1)
    )
    wide = np.diag([*np.diagonal(precision), *[-1.0] * beside.shape[2]])
    columns, numbers = _columns(designs, shape)
    each = [columns[:, chosen].reshape(*shape, -1) for chosen in numbers]
    cells = LinearModel(values, weight, each, np.concatenate([level, beside], axis=2), wide)
    return linear_model_factors(
        independent(cells, baseline["common"].sel(axis=axis).values),
        fold_blocks(data) if folds is None else folds,
    )


def _gains(factors: Array, candidates: Mapping[str, Sequence[Array]]) -> xr.DataArray:
    owner = np.repeat(np.arange(len(candidates)), [len(designs) for designs in candidates.values()])
    return xr.DataArray(
        score(factors[:, 1:], owner),
        dims=("candidate", "record"),
        coords={"candidate": list(candidates)},
        name="gain",
        attrs={"units": "1", "long_name": "log likelihood gained on held-out time [nats]"},
    )


def mean_evidence(
    data: xr.Dataset,
    baseline: xr.Dataset,
    candidates: Mapping[str, Sequence[Array]],
    *,
    axis: str,
    tier: Tier = "free",
    **more: Any,
) -> xr.DataArray:
    """Held-out gains of candidates in the block means.

    Parameters
    ----------
    data, baseline, axis, tier
        As in `mean_factors`, and `more` are its further options.
    candidates : mapping of str to sequence of ndarray
        Name -> designs, one for every value of the nuisance parameters.

    Returns
    -------
    xarray.DataArray
        ``gain(candidate, record)`` [nats].
    """
    designs = [design for several in candidates.values() for design in several]
    return _gains(mean_factors(data, baseline, designs, axis=axis, tier=tier, **more), candidates)


def power_evidence(
    data: xr.Dataset,
    baseline: xr.Dataset,
    candidates: Mapping[str, Sequence[Array]],
    *,
    axis: str,
    tier: Tier = "free",
    **more: Any,
) -> xr.DataArray:
    """Held-out gains of candidates in the band powers; as `mean_evidence`, with the designs of `power_factors`."""
    designs = [design for several in candidates.values() for design in several]
    return _gains(power_factors(data, baseline, designs, axis=axis, tier=tier, **more), candidates)

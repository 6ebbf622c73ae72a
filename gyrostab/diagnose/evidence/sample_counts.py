"""Counts of odd samples: gains of what is not linear in a few designs."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.folds import FOLDS

__all__ = [
    "COUNTS",
    "GRID_COUNTS",
    "Expected",
    "beyond_ends",
    "expected_counts",
    "has_coarse_grid",
    "kurtosis_evidence",
    "sample_count_evidence",
    "still_scatter",
]

Array = NDArray[Any]
#: Counts of blocks that effects raise.
COUNTS = ("outliers", "repeats", "extremes", "stuck", "filled")
#: Statistics of the distribution that a coarse lattice makes by itself.
GRID_COUNTS = ("repeats", "extremes", "zeros", "stuck", "filled", "kurtosis")
_COARSE, _STILL = (
    0.2,
    0.1,
)  # step in scatters of the samples; share of the blocks that tell the scatter at rest
_ENDS = 2  # samples that are the smallest and the largest of any record
_SHAPE, _RATE = 0.5, 0.05  # of the prior of the factor by which a count is raised


def has_coarse_grid(blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Axes whose lattice is so coarse that equal samples, zeros and tails are its own, and tell of nothing else.

    Parameters
    ----------
    blocks : xarray.Dataset
        Recording or null records.

    Returns
    -------
    ndarray of bool, shape (axis,)

    Examples
    --------
    >>> one = {"lattice": ("axis", [3.0, 0.1]), "power": (("axis", "block", "band"), np.full((2, 9, 1), 0.5))}
    >>> coarse_lattice(xr.Dataset(one, coords={"band_low": ("band", [0.0]), "band_high": ("band", [100.0])}))
    array([ True, False])
    """
    if "lattice" not in blocks:
        return np.zeros(blocks.sizes["axis"], np.bool_)
    return np.asarray(blocks["lattice"].values > _COARSE * still_scatter(blocks))


def still_scatter(blocks: xr.Dataset) -> NDArray[np.float64]:
    """Scatter of the samples of every axis in its quiet blocks [degree hour-1]; inf without any."""
    width = blocks["band_high"].values - blocks["band_low"].values
    power = blocks["power"].transpose("axis", ..., "band").values
    square = 2.0 * (power @ width).reshape(len(power), -1)
    return np.sqrt(
        [
            np.quantile(row[np.isfinite(row)], _STILL) if np.isfinite(row).any() else np.inf
            for row in square
        ]
    )


def beyond_ends(values: NDArray[Any]) -> NDArray[Any]:
    """Samples at the ends of the range, less the first two of the record: one at either end is what any record has.

    A count of which two are certain has no Poisson law: without a lattice chance never brings a
    third one.

    Parameters
    ----------
    values : ndarray, shape (..., block)
        Samples equal to the smallest or largest of the record.

    Returns
    -------
    ndarray, shape (..., block)

    Examples
    --------
    >>> beyond_ends(np.array([[0, 1, 0, 1], [1, 3, 0, 2]]))
    array([[0, 0, 0, 0],
           [0, 2, 0, 2]])
    """
    beyond = np.maximum(np.cumsum(values, axis=-1) - _ENDS, 0)
    return np.asarray(np.diff(beyond, axis=-1, prepend=0))


class Expected:
    """Mean and overdispersion of the counts of null records, by axis, gathered chunk by chunk."""

    def __init__(self) -> None:
        self.sums: dict[str, list[Array]] = {name: [] for name in (*COUNTS, "kurtosis")}

    def add(self, nulls: xr.Dataset) -> None:
        """Take in some null records."""
        for name in self.sums:
            if name in nulls:
                values = nulls[name].transpose("record", "axis", "block").values.astype(np.float64)
                self.sums[name].append(beyond_ends(values) if name == "extremes" else values)

    def block_count(self, name: str) -> Array:
        """(record, axis, block)."""
        return np.concatenate(self.sums[name])


def expected_counts(values: Array) -> tuple[Array, Array]:
    """Mean count of every block (axis, block), and overdispersion of the record's (axis,), from null records (record, axis, block).

    Blocks of few samples, and those far from a value that is counted, have few. One record in which
    all blocks have the same is added, so that none is expected to have nothing at all.
    """
    records, _, block_count = values.shape
    total = values.sum(axis=2)
    mean = np.maximum(total.mean(axis=0), 1.0 / records)
    spread = np.maximum(total.var(axis=0) / mean, 1.0)
    even = np.broadcast_to(mean[:, None] / block_count, values.shape[1:])
    own = np.where(total.any(axis=0)[:, None], values.mean(axis=0), even)
    return (records * own + even) / (records + 1.0), spread


def _log_ratio(count: Array, mean: Array) -> Array:
    """Log Bayes factor of a count that is raised by an unknown factor, over one that is not."""
    from scipy.special import gammaln

    a, b = _SHAPE, _RATE
    raised = (
        gammaln(count + a)
        - gammaln(a)
        + a * np.log(b)
        - (count + a) * np.log(b + mean)
        + count * np.log(mean)
    )
    even = -mean + count * np.log(mean)
    return np.asarray(np.where(count > mean, raised - even, np.minimum(raised - even, 0.0)))


def _held_out(evidence: Array, lengths: int) -> Array:
    """Largest over the lengths of the sum over folds, from (subset, ...)."""
    components = evidence[1:].reshape(lengths, FOLDS, *evidence.shape[1:])
    return np.asarray((evidence[0] - components).sum(axis=1).max(axis=0))


def sample_count_evidence(
    values: Array, mean: Array, spread: Array, subsets: NDArray[np.bool_]
) -> Array:
    """Held-out gain of a raised count.

    Parameters
    ----------
    values : ndarray, shape (record, axis, block)
    mean, spread : ndarray, shapes (axis, block) and (axis,)
        From `expected_counts`.
    subsets : ndarray of bool, shape (subset, block)
        From `fold_subsets`.

    Returns
    -------
    ndarray, shape (record, axis)
    """
    found = []
    for subset in subsets:
        count = values[:, :, subset].sum(axis=2) / spread
        found.append(_log_ratio(count, mean[:, subset].sum(axis=1) / spread))
    return _held_out(np.stack(found), (len(subsets) - 1) // FOLDS)


def kurtosis_evidence(
    values: Array, mean: Array, spread: Array, subsets: NDArray[np.bool_]
) -> Array:
    """Held-out gain of a higher kurtosis; `mean` and `spread` are those of a block, (axis,); the rest as in `sample_count_evidence`."""
    z = np.clip(
        np.where(np.isfinite(values), (values - mean[:, None]) / spread[:, None], 0.0), -8.0, 8.0
    )
    found = []
    for subset in subsets:
        total = z[:, :, subset].sum(axis=2) / np.sqrt(subset.sum())
        size = 100.0  # prior variance, of the total of the whole record
        component = size * subset.mean()
        found.append(
            0.5 * total**2 * component / (1.0 + component) * (total > 0) - 0.5 * np.log1p(component)
        )
    return _held_out(np.stack(found), (len(subsets) - 1) // FOLDS)

"""What null records have in common between axes, where the model says that axes share an effect: powers, cross-spectra, block means."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.linear_model import pair_rows

__all__ = ["Shared", "shared_by", "shared_spectra", "shared_white"]

Array = NDArray[np.float64]
_LEAST = 1e-9  # eigenvalue of a coherence: gaps may make one of nearly equal axes less than nothing


class Shared(NamedTuple):
    """What axes have in common.

    Attributes
    ----------
    root : ndarray of complex, shape (block, band, axis, axis)
        Square root of their coherency.
    pairs : list of (int, int)
        Axes of each pair.
    own : ndarray, shape (axis, block, band)
        Shape of the gamma distribution of each power.
    both : ndarray, shape (pair, block, band)
        The same for the samples that both axes of a pair have.
    white : ndarray, shape (block, axis, axis)
        Square root of the correlation of the white noise of the block means.
    """

    root: NDArray[np.complex128]
    pairs: list[tuple[int, int]]
    own: Array
    both: Array
    white: Array


def shared_by(blocks: xr.Dataset, baseline: xr.Dataset) -> Shared | None:
    """What axes have in common by the baseline; None where that is nothing."""
    if "cross" not in baseline:
        return None
    axes = [str(axis) for axis in blocks["axis"].values]
    pairs = [(axes.index(a), axes.index(b)) for a, b in pair_rows(blocks)]
    spectrum, own = (
        baseline[name].transpose("axis", "block", "band").values
        for name in ("spectrum", "shape_alone")
    )
    cross = baseline["cross"].transpose("pair", "block", "band").values
    samples, together = (
        blocks["samples"].transpose("axis", "block").values,
        blocks["cross_samples"].transpose("pair", "block").values,
    )
    matrix = np.zeros((*spectrum.shape[1:], len(axes), len(axes)), np.complex128)
    matrix[..., range(len(axes)), range(len(axes))] = 1.0
    white = matrix[:, 0].real.copy()
    for number, (a, b) in enumerate(pairs):
        with np.errstate(divide="ignore", invalid="ignore"):
            coherency = np.nan_to_num(cross[number] / np.sqrt(spectrum[a] * spectrum[b]))
            overlap = np.nan_to_num(together[number] / np.sqrt(samples[a] * samples[b]))
        matrix[..., a, b], matrix[..., b, a] = coherency, coherency.conj()
        white[:, a, b] = white[:, b, a] = coherency[:, 0].real * overlap
    return Shared(
        _root(matrix),
        pairs,
        own,
        blocks["cross_shape"].transpose("pair", "block", "band").values,
        _root(white),
    )


def _root(matrix: NDArray[Any]) -> NDArray[Any]:
    """Square root of correlations (..., axis, axis), the diagonal of whose square is 1."""
    values, vectors = np.linalg.eigh(matrix)
    root = (vectors * np.sqrt(np.maximum(values, _LEAST))[..., None, :]) @ vectors.conj().swapaxes(
        -1, -2
    )
    return np.asarray(root / np.sqrt((np.abs(root) ** 2).sum(axis=-1, keepdims=True)))


def shared_spectra(
    shared: Shared, count: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.complex128]]:
    """Draw powers and cross-spectra over their expectation, and over the root of the product of those of both axes.

    The law is that of Wishart, by the triangular factors of Bartlett: as many independent ordinates
    as the shape says, for each axis its own number. Samples that only one axis of a pair has add a
    scatter that they do not share.

    Returns
    -------
    power : ndarray, shape (record, axis, block, band)
    cross : ndarray of complex, shape (record, pair, block, band)
    """
    own = np.where(np.isfinite(shared.own) & (shared.own > 0.0), shared.own, 1.0)
    power = np.empty((count, *own.shape))
    cross = np.empty((count, len(shared.pairs), *own.shape[1:]), np.complex128)
    beside = [
        _beside(shared.both[number], own[a], own[b]) for number, (a, b) in enumerate(shared.pairs)
    ]
    for record in range(count):
        mixed = np.einsum("bfij,jkbf->ikbf", shared.root, _triangular(own, rng))
        power[record] = (mixed.real**2 + mixed.imag**2).sum(axis=1)
        for number, (a, b) in enumerate(shared.pairs):
            alone = rng.standard_normal((2, *own.shape[1:])) * beside[number]
            cross[record, number] = (
                (mixed[a] * mixed[b].conj()).sum(axis=0) + alone[0] + 1j * alone[1]
            )
    return power, cross


def _triangular(own: Array, rng: np.random.Generator) -> NDArray[np.complex128]:
    """Triangular factor (axis, axis, block, band) of independent ordinates, over the root of their number."""
    out = np.zeros((len(own), *own.shape), np.complex128)
    for row, shape in enumerate(own):
        out[row, row] = np.sqrt(rng.standard_gamma(np.maximum(shape - row, 0.0)) / shape)
        for column in range(row):
            size = rng.standard_gamma(np.clip(shape - column, 0.0, 1.0)) / shape
            out[row, column] = np.sqrt(size) * np.exp(2j * np.pi * rng.random(shape.shape))
    return out


def _beside(both: Array, one: Array, other: Array) -> Array:
    """Standard deviation of the real and of the imaginary part that samples without a partner add to a cross-spectrum."""
    with np.errstate(divide="ignore", invalid="ignore"):
        more = 1.0 / both - 1.0 / np.minimum(one, other)
    return np.sqrt(np.maximum(np.nan_to_num(more, posinf=0.0), 0.0) / 2.0)


def shared_white(shared: Shared, count: int, rng: np.random.Generator) -> Array:
    """White noise of unit variance, (record, axis, block), that axes share as far as their lowest band says."""
    return np.asarray(
        np.einsum(
            "bij,rjb->rib",
            shared.white,
            rng.standard_normal((count, len(shared.own), len(shared.white))),
        )
    )

"""Noise that axes have in common: its coherency in the baseline, and spectra drawn with it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Complexes, Floats, Ints
from gyrostab.diagnose.reduce.schema import pair_indices

_MIN_EIGENVALUE = 1e-9  # of a coherence: with gaps it may be negative for nearly equal axes


class SharedNoise(NamedTuple):
    """Noise that axes have in common."""

    root: Complexes  # (block, band, axis, axis): square root of the coherency matrix
    pairs: Ints  # (pair, 2): indices of the axes of each pair
    axis_shape: Floats  # (axis, block, band): shape of the gamma distribution of each power
    pair_shape: Floats  # (pair, block, band): the same for samples that both axes of a pair have
    #: (block, axis, axis): square root of the correlation matrix of the white noise of the block
    #: means.
    white: Floats


def find_shared_noise(blocks: xr.Dataset, baseline: xr.Dataset) -> SharedNoise | None:
    """Return the noise that axes have in common in the baseline; None without any."""
    if "cross" not in baseline:
        return None
    pairs, axes = pair_indices(blocks).T, blocks.sizes["axis"]
    spectrum, axis_shape = (baseline[name].values for name in ("spectrum", "shape_alone"))
    cross = baseline["cross"].values
    samples, joint_samples = blocks["samples"].values, blocks["cross_samples"].values
    matrix = np.zeros((*spectrum.shape[1:], axes, axes), np.complex128)
    matrix[...] = np.eye(axes)
    white = matrix[:, 0].real.copy()
    for number, (a, b) in enumerate(pairs):
        with np.errstate(divide="ignore", invalid="ignore"):
            coherency = np.nan_to_num(cross[number] / np.sqrt(spectrum[a] * spectrum[b]))
            overlap = np.nan_to_num(joint_samples[number] / np.sqrt(samples[a] * samples[b]))
        matrix[..., a, b], matrix[..., b, a] = coherency, coherency.conj()
        white[:, a, b] = white[:, b, a] = coherency[:, 0].real * overlap
    pair_shape = blocks["cross_shape"].values
    return SharedNoise(
        _correlation_root(matrix), pairs, axis_shape, pair_shape, _correlation_root(white)
    )


def _correlation_root(matrix: Array) -> Array:
    """Return square roots of correlation matrices (..., axis, axis)."""
    values, vectors = np.linalg.eigh(matrix)
    root = (
        vectors * np.sqrt(np.maximum(values, _MIN_EIGENVALUE))[..., None, :]
    ) @ vectors.conj().swapaxes(-1, -2)
    return np.asarray(root / np.sqrt((np.abs(root) ** 2).sum(axis=-1, keepdims=True)))


def draw_shared_spectra(
    shared: SharedNoise, count: int, rng: np.random.Generator
) -> tuple[Floats, Complexes]:
    """Draw powers relative to expectation, and cross-spectra to the root of both expectations.

    The shapes are (record, axis or pair, block, band). They are Wishart distributed, drawn by the
    Bartlett decomposition: as many independent frequencies as the shape of each axis. Samples of
    only one axis of a pair add scatter that is not common.
    """
    axis_shape = np.where(
        np.isfinite(shared.axis_shape) & (shared.axis_shape > 0.0), shared.axis_shape, 1.0
    )
    power = np.empty((count, *axis_shape.shape))
    cross = np.empty((count, len(shared.pairs), *axis_shape.shape[1:]), np.complex128)
    unpaired = [
        _unpaired_scatter(shared.pair_shape[number], axis_shape[a], axis_shape[b])
        for number, (a, b) in enumerate(shared.pairs)
    ]
    for record in range(count):
        mixed = np.einsum("bfij,jkbf->ikbf", shared.root, _bartlett_factor(axis_shape, rng))
        power[record] = (mixed.real**2 + mixed.imag**2).sum(axis=1)
        for number, (a, b) in enumerate(shared.pairs):
            scatter = rng.standard_normal((2, *axis_shape.shape[1:])) * unpaired[number]
            cross[record, number] = (
                (mixed[a] * mixed[b].conj()).sum(axis=0) + scatter[0] + 1j * scatter[1]
            )
    return power, cross


def _bartlett_factor(axis_shape: Floats, rng: np.random.Generator) -> Complexes:
    """Return Bartlett's factor (axis, axis, block, band), divided by the root of the shape."""
    out = np.zeros((len(axis_shape), *axis_shape.shape), np.complex128)
    for row, shape in enumerate(axis_shape):
        out[row, row] = np.sqrt(rng.standard_gamma(np.maximum(shape - row, 0.0)) / shape)
        for column in range(row):
            size = rng.standard_gamma(np.clip(shape - column, 0.0, 1.0)) / shape
            out[row, column] = np.sqrt(size) * np.exp(2j * np.pi * rng.random(shape.shape))
    return out


def _unpaired_scatter(pair_shape: Floats, first_shape: Floats, second_shape: Floats) -> Floats:
    """Return the scatter of a cross-spectrum from samples without a partner (real, imaginary)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = 1.0 / pair_shape - 1.0 / np.minimum(first_shape, second_shape)
    return np.sqrt(np.maximum(np.nan_to_num(excess, posinf=0.0), 0.0) / 2.0)

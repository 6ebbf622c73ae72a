"""Assemble the noise of all axes as a baseline."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.baseline.expected_statistics import (
    B_TERM,
    K_TERM,
    N_TERM,
    NOISE,
    common_variance,
    noise_powers,
    sum_noise,
    white_variance,
)
from gyrostab.diagnose.baseline.foreign_bands import MIN_BANDS, is_foreign
from gyrostab.diagnose.baseline.posterior import MIN_WHITE_SHARE, Posterior, visible_coefficients
from gyrostab.diagnose.baseline.quiescent import significant_level
from gyrostab.diagnose.evidence.products import mean_products
from gyrostab.diagnose.reduce.schema import BASELINE, label_variables, weighted_mean
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.noise import TERMS
from gyrostab.units import HOUR

#: Values of K and B on the coarse grid, as multiples of the calibrated ones. Design choice.
_FACTORS = {"K": (0.0, 1.0 / 3.0, 1.0, 3.0, 10.0, 30.0), "B": (0.0, 1.0, 3.0, 10.0)}
#: Share of the draws that may lie beyond the coarse grid: a tenth of the share of null records that
#: exceeds the threshold.
_SHARE_ABOVE = 1e-3
_MIN_LOW_SHAPE = 20.0  # of the lowest bands, which define the white noise of a block mean
_MIN_CELL_PROBABILITY = 1e-12  # of a point of the coarse grid, so that its logarithm is finite
#: Least factor that a filter or an effect on the lowest band has on the white variance of a mean.
#: Design choice: no mean is exact.
MIN_MEAN_NOISE_FACTOR = 0.1


def _mean_noise_excess(
    power: Floats, shape: Floats, spectrum: Floats, quiescent: Bools, settings: Settings
) -> Floats:
    """Return the excess factor of the white variance of each mean, from the lowest bands.

    Bands that the noise does not explain in quiescent blocks tell nothing of the noise of a mean.
    Inputs (block, band).
    """
    ratio, total = weighted_mean(power / spectrum, np.where(quiescent[:, None], shape, 0.0))
    explained = ~is_foreign(ratio, total, settings)
    if explained.sum() >= MIN_BANDS:
        power, shape, spectrum = power[:, explained], shape[:, explained], spectrum[:, explained]
    count = np.nan_to_num(shape).sum(axis=0) / max(1, int(np.isfinite(shape).all(axis=1).sum()))
    low = max(2, int(np.searchsorted(np.cumsum(count), _MIN_LOW_SHAPE)) + 1)
    return significant_level(power[:, :low] / spectrum[:, :low] - 1.0, shape[:, :low], settings)


def grid_values(term: str, centre: float, scale: float, *, more: int = 0) -> Floats:
    """Return values of K or B, from 0 to far above the calibrated and the just visible ones.

    `more` values continue them in half decades.
    """
    values = [
        factor * (max(centre, scale) if factor > 1.0 else centre) for factor in _FACTORS[term]
    ]
    return np.array([*values, *(values[-1] * 10.0 ** (np.arange(1, more + 1) / 2.0))])


def _coarse_grids(
    posteriors: Sequence[Posterior], densities: Floats, span: float
) -> list[tuple[Floats, Floats, Floats]]:
    """Return K and B of the coarse grid of each axis, and the log posterior around every point.

    The largest draws have a value of the grid within a quarter of a decade; with less noise, any
    slow drift of such a null record would be evidence of an effect. All axes have as many values as
    the one that needs most.
    """
    visible = [visible_coefficients(density, span) for density in densities]  # K, B
    values = {}
    for column, term in enumerate("BK"):  # as in `Posterior.slow`
        slow = [np.sqrt(posterior.slow[:, column]) for posterior in posteriors]
        centres_and_scales = [
            (float(np.median(draws)), limits["KB".index(term)])
            for draws, limits in zip(slow, visible, strict=True)
        ]
        excess = max(
            np.quantile(draws, 1.0 - _SHARE_ABOVE) / grid_values(term, *centre_and_scale)[-1]
            for draws, centre_and_scale in zip(slow, centres_and_scales, strict=True)
        )
        more = round(2.0 * math.log10(max(excess, 1.0)))
        values[term] = [
            grid_values(term, *centre_and_scale, more=more)
            for centre_and_scale in centres_and_scales
        ]
    return [_weigh_grid(*axis) for axis in zip(posteriors, values["K"], values["B"], strict=True)]


def _weigh_grid(posterior: Posterior, K: Floats, B: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the points of a grid of K and B, and the log posterior around each."""
    place = []
    for fine, coarse in ((posterior.K, K), (posterior.B, B)):
        between = np.sqrt(coarse[1:-1] * coarse[2:])
        place.append(np.searchsorted(np.concatenate([[coarse[1] / np.sqrt(3.0)], between]), fine))
    mass = np.full((K.size, B.size), _MIN_CELL_PROBABILITY)
    np.add.at(mass, tuple(place), posterior.weight)
    grid = [values.ravel() for values in np.meshgrid(K, B, indexing="ij")]
    return grid[0], grid[1], np.log(mass.ravel() / mass.sum())


def assemble_baseline(
    blocks: xr.Dataset,
    posteriors: list[Posterior],
    *,
    quiescent: Bools,
    attrs: Mapping[str, Any],
    known_mean: Floats | None = None,
    spectrum: Floats | None = None,
    settings: Settings = DEFAULTS,
) -> xr.Dataset:
    """Assemble the noise of all axes as the Dataset described in `calibrate_noise`.

    Every baseline is made here: of calibrated noise, of a model, or of a simulated log.

    Parameters
    ----------
    posteriors : list of Posterior
        Noise of each axis.
    quiescent : ndarray of bool, shape (axis, block)
        Blocks that it is calibrated on.
    attrs : mapping
        Attributes of the baseline.
    known_mean : ndarray, shape (axis, block), optional
        Known means of effects [degree hour-1].
    spectrum : ndarray, shape (axis, block, band), optional
        Expected power including effects; that of the noise by default.
    """
    columns = noise_powers(blocks)
    square = np.stack([posterior.square for posterior in posteriors])
    expected = sum_noise(columns, square) if spectrum is None else spectrum
    floor = np.array([MIN_WHITE_SHARE * levels.min() / HOUR for levels in expected])  # of N^2
    white, excess = _variance_of_means(
        blocks, posteriors, columns, expected, floor, quiescent, settings
    )
    span = blocks.sizes["block"] * float(blocks.attrs["block_s"])
    densities = np.maximum(square[:, N_TERM], floor) * HOUR
    grid_K, grid_B, grid_weight = np.stack(_coarse_grids(posteriors, densities, span), axis=1)
    common, shape_alone = common_variance(blocks)
    value, error = _average_coefficients(posteriors)
    ramp_error = _ramp_error(blocks, white, value, quiescent)
    variables = {
        "coefficient": np.pad(value, ((0, 0), (0, 1))),
        "stderr": np.column_stack([error, ramp_error]),
        "quiet": quiescent,
        "spectrum": expected,
        "known_mean": np.zeros(quiescent.shape) if known_mean is None else known_mean,
        "mean_variance": white * excess,
        "angle_variance": np.array([posterior.angle for posterior in posteriors]),
        "common": common,
        "shape_alone": shape_alone,
        "columns": columns,
        "square": square,
        "square_stderr": np.stack([posterior.error for posterior in posteriors]),
        "posterior": np.stack([posterior.draws for posterior in posteriors]),
        "posterior_slow": np.stack([posterior.slow for posterior in posteriors]),
        "grid_K": grid_K,
        "grid_B": grid_B,
        "grid_prior": np.full(grid_K.shape, -np.log(grid_K.shape[1])),
        "grid_calibrated": grid_weight,
    }
    coordinates = {
        name: blocks[name]
        for name in ("axis", "time", "begin", "end", "frequency", "band_low", "band_high")
        if name in blocks
    }
    axis_posteriors = [*zip(map(str, blocks["axis"].values), posteriors, strict=True)]
    return xr.Dataset(
        label_variables(variables, BASELINE),
        coords={**coordinates, "term": list(TERMS), "noise": list(NOISE), "slow": ["B", "K"]},
        attrs={
            **attrs,
            "slow_noise_apart": [
                axis for axis, posterior in axis_posteriors if not posterior.joined
            ],
            "white_noise_of_means_apart": [
                axis
                for axis, posterior in axis_posteriors
                if posterior.squares_for_means is not None
            ],
        },
    )


def _variance_of_means(
    blocks: xr.Dataset,
    posteriors: list[Posterior],
    columns: Floats,
    expected: Floats,
    floor: Floats,
    quiescent: Bools,
    settings: Settings,
) -> tuple[Floats, Floats]:
    """Return the white variance of the block means, and its excess factor, (axis, block).

    What effects do to the lowest band they do to the white noise of the means. `columns` are those
    of `noise_powers`, `expected` is the power with effects (axis, block, band), and N^2 of an axis
    is at least `floor`.
    """
    power, shape = blocks["power"].values, blocks["shape"].values
    squares = np.stack([posterior.square for posterior in posteriors])
    noise, spectrum = sum_noise(columns, squares), expected.copy()
    for row, posterior in enumerate(posteriors):
        if posterior.squares_for_means is not None:
            squares[row] = posterior.squares_for_means
            spectrum[row] *= columns[row] @ posterior.squares_for_means / noise[row]
    squares[:, N_TERM] = np.maximum(squares[:, N_TERM], floor)
    white = white_variance(blocks, squares)
    white = white * np.maximum(expected[..., 0] / noise[..., 0], MIN_MEAN_NOISE_FACTOR)
    excess = [
        _mean_noise_excess(*arrays, settings)
        for arrays in zip(power, shape, spectrum, quiescent, strict=True)
    ]
    return white, np.stack(excess)


def _average_coefficients(posteriors: list[Posterior]) -> tuple[Floats, Floats]:
    """Return Q, N, B, K and their standard errors, (axis, 4); B and K are those of the means."""
    roots = [
        np.sqrt(np.concatenate([posterior.draws[:, :2], posterior.slow], axis=1))
        for posterior in posteriors
    ]
    return np.mean(roots, axis=1), np.std(roots, axis=1)


def _ramp_error(blocks: xr.Dataset, white: Floats, value: Floats, quiescent: Bools) -> Floats:
    """Return the error of a ramp fitted to the quiescent means [deg/h^2]."""
    hours = (blocks["begin"].values + blocks["end"].values)[:, None] / (2.0 * HOUR)
    present = quiescent & np.isfinite(blocks["mean"].values)
    step = float(blocks.attrs["block_s"])
    error = np.full(len(white), np.inf)
    for row, variance in enumerate(white):
        K, B = value[row, [K_TERM]], value[row, [B_TERM]]
        information = mean_products(
            hours[:, :0], hours, variance=variance, step=step, K=K, B=B, present=present[row]
        ).gram[0, 0, 0]
        if information > 0.0:
            error[row] = 1.0 / np.sqrt(information)
    return error

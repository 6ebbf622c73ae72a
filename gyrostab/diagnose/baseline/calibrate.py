"""Calibration of the stationary noise that a record is compared with, on its quiescent time.

Band powers of the quiescent blocks give Q, N and part of B and K; block means give the slow part of
B and K. The posterior is kept as draws, so that null records include the calibration error.
"""

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
    reduced_shape,
    sum_noise,
    white_variance,
)
from gyrostab.diagnose.baseline.posterior import (
    MIN_WHITE_SHARE,
    BandPowers,
    Posterior,
    average_blocks,
    fit_filter_response,
    fit_squares,
    noise_posterior,
    visible_coefficients,
    with_floor,
)
from gyrostab.diagnose.baseline.quiescent import (
    find_quiescent_blocks,
    find_quiescent_spans,
    significant_level,
)
from gyrostab.diagnose.evidence.products import mean_products
from gyrostab.diagnose.reduce.schema import BASELINE, label_variables, weighted_mean
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.errors import SchemaError
from gyrostab.noise import TERMS
from gyrostab.units import HOUR

#: Values of K and B on the coarse grid, as multiples of the calibrated ones. Design choice.
_FACTORS = {"K": (0.0, 1.0 / 3.0, 1.0, 3.0, 10.0, 30.0), "B": (0.0, 1.0, 3.0, 10.0)}
#: Share of the draws that may lie beyond the coarse grid: a tenth of the share of null records that
#: exceeds the threshold.
_SHARE_ABOVE = 1e-3
#: Bands that the noise terms are fitted to, with any spectral shape.
MIN_BANDS = 6
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
    explained = ~_is_foreign(ratio, total, settings)
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


def calibrate_noise(
    blocks: xr.Dataset, *, quiet: Any = None, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Calibrate the noise of every axis on quiescent blocks.

    Parameters
    ----------
    quiet : (start, end) or several of these, optional
        Known quiescent time: seconds since the start, or ISO times. By default blocks with little
        vibration, steady temperature, no rotation, some time after a restart, and no more noise
        than most.

    Returns
    -------
    xarray.Dataset
        Variables of `gyrostab.diagnose.reduce.schema.BASELINE`. A ramp is an effect, so that R is
        0, with its error.

    Raises
    ------
    OptionError
        If `quiet` lies outside the record.
    SchemaError
        If an axis has no spectra to calibrate on.

    Examples
    --------
    >>> from gyrostab.diagnose.reduce.block_statistics import reduce_log
    >>> from gyrostab.simulate import simulate
    >>> model = {"log": {"axes": ["x"]}, "noise": {"N": 0.003}}
    >>> baseline = calibrate_noise(reduce_log(simulate(model, duration="1h", rate=10.0, seed=3)))
    >>> N = baseline.sel(axis="x", term="N")
    >>> error = (N.coefficient - 0.003) / N.stderr
    >>> bool(abs(error) < 4.0), baseline.attrs["source"]
    (True, 'calibrated')
    """
    quiescent = find_quiescent_blocks(blocks, quiet, settings=settings)
    attrs = {"source": "calibrated", "calibrated_on": find_quiescent_spans(blocks, quiescent)}
    posteriors = calibrate_axes(blocks, quiescent, settings)
    return assemble_baseline(
        blocks, posteriors, quiescent=quiescent, attrs=attrs, settings=settings
    )


def calibrate_on_training_blocks(
    blocks: xr.Dataset, baseline: xr.Dataset, training: Bools, *, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Calibrate the noise again on the quiescent blocks among the training blocks (block,).

    A baseline that is not that of `calibrate_noise` is returned as it is, and so is one of which
    too few such blocks have a spectrum.
    """
    has_spectrum = np.isfinite(blocks["power"].values).any(axis=-1)
    quiescent = baseline["quiet"].values & training & has_spectrum
    if (
        baseline.attrs.get("source") != "calibrated"
        or "recalibrated" in baseline.attrs
        or quiescent.sum(axis=1).min() < settings.min_quiescent_blocks
    ):
        return baseline
    posteriors = calibrate_axes(blocks, quiescent, settings)
    return assemble_baseline(
        blocks, posteriors, quiescent=quiescent, attrs=baseline.attrs, settings=settings
    )


def calibrate_axes(blocks: xr.Dataset, quiescent: Bools, settings: Settings) -> list[Posterior]:
    """Compute the noise of every axis from its quiescent blocks (axis, block)."""
    posteriors = []
    for row, bands in enumerate(_fit_quiescent_powers(blocks, quiescent, settings)):
        explained = _keep_explained_bands(bands, settings)
        square = with_floor(fit_squares(explained)[0], explained)
        variance = white_variance(blocks, square[None])[row]
        levels = _level_columns(quiescent[row], settings.min_quiescent_blocks)
        posterior = noise_posterior(bands, blocks, row, variance, quiescent[row], levels, settings)
        squares_for_means = None if explained is bands else square
        posteriors.append(posterior._replace(squares_for_means=squares_for_means))
    return posteriors


def _level_columns(quiescent: Bools, min_blocks: int) -> Floats:
    """Return steps that give each quiescent stretch its own level, (block, step).

    What moves the bias between two stretches, vibration for instance, is not noise of either. A
    stretch that is shorter than `min_blocks` continues with the next: the level of each costs one
    increment of the random walk in `min_blocks`.

    Examples
    --------
    >>> _level_columns(np.array([1, 1, 0, 1, 1, 0, 0, 1], bool), 2).T
    array([[0., 0., 0., 1., 1., 1., 1., 1.],
           [0., 0., 0., 0., 0., 0., 0., 1.]])
    >>> _level_columns(np.array([1, 1, 0, 1, 1, 0, 0, 1], bool), 3).T
    array([[0., 0., 0., 0., 0., 0., 0., 1.]])
    """
    starts = np.flatnonzero(quiescent & ~np.append(False, quiescent[:-1]))
    block = np.arange(quiescent.size)
    columns: list[Floats] = []
    last = 0
    for first in starts.tolist():
        if quiescent[last:first].sum() >= min_blocks:
            columns.append((block >= first).astype(np.float64))
            last = first
    return np.stack(columns, axis=1) if columns else np.empty((quiescent.size, 0))


def _fit_quiescent_powers(
    blocks: xr.Dataset, quiescent: Bools, settings: Settings
) -> list[BandPowers]:
    """Return the powers of every axis as a sum of noise terms, behind a filter if it takes one.

    It does where some bands are foreign to the noise terms alone, and none behind the filter.
    """
    bands_by_axis = _average_quiescent(blocks, quiescent, noise_powers(blocks))
    if (
        not any(_has_foreign_bands(bands, settings) for bands in bands_by_axis)
        or min(bands.power.size for bands in bands_by_axis) < blocks.sizes["band"]
    ):
        return bands_by_axis
    response = fit_filter_response(blocks, bands_by_axis, settings=settings)
    if response is None:
        return bands_by_axis
    filtered = _average_quiescent(blocks, quiescent, noise_powers(blocks, response))
    return (
        bands_by_axis
        if any(_has_foreign_bands(bands, settings) for bands in filtered)
        else filtered
    )


def _average_quiescent(blocks: xr.Dataset, quiescent: Bools, columns: Floats) -> list[BandPowers]:
    """Average the quiescent powers of every axis; columns (axis, block, band, term)."""
    power, shape = blocks["power"].values, reduced_shape(blocks)
    bands_by_axis = []
    for row, axis in enumerate(blocks["axis"].values):
        use = quiescent[row]
        bands = average_blocks(power[row][use], shape[row][use], columns[row][use])
        band_count = np.count_nonzero(bands.power > 0.0)
        if band_count < 4:
            raise SchemaError(
                f"axis {axis}: the quiescent blocks hold noise in {band_count} bands, too few to "
                "calibrate on; give other stretches with --quiet, leave the axis out (--axis), or "
                "diagnose a part of the record with fewer gaps"
            )
        bands_by_axis.append(bands)
    return bands_by_axis


def _has_foreign_bands(bands: BandPowers, settings: Settings) -> bool:
    """Return whether the noise terms miss the larger part of the power of a band."""
    return bool(_is_foreign(_power_ratio(bands), bands.weight, settings).any())


def _is_foreign(ratio: Floats, weight: Floats, settings: Settings) -> Bools:
    """Return whether the larger part of a power, or of its expected value, is not in the other.

    `ratio` is power divided by expected power, with a gamma distribution of the shape `weight`.
    """
    off = np.abs(ratio - 1.0) * np.sqrt(weight) > settings.excess_sigma
    return np.asarray(
        off & ((ratio < settings.majority_share) | (ratio * settings.majority_share > 1.0))
    )


def _keep_explained_bands(bands: BandPowers, settings: Settings) -> BandPowers:
    """Drop the bands that the noise terms do not explain, the worst first.

    Lines and humps would raise the noise of block means, to which they add nothing. A spectrum
    that the terms describe to a factor of two keeps all bands.
    """
    if not _has_foreign_bands(bands, settings):
        return bands
    while bands.power.size > MIN_BANDS:
        off = np.abs(_power_ratio(bands) - 1.0) * np.sqrt(bands.weight)
        worst = int(off.argmax())
        if off[worst] <= settings.excess_sigma:
            break
        bands = BandPowers(
            *(np.delete(part, worst, axis=0) for part in (bands.power, bands.columns, bands.weight))
        )
    return bands


def _power_ratio(bands: BandPowers) -> Floats:
    """Return the powers divided by those of the noise terms that fit them best."""
    return np.asarray(bands.power / (bands.columns @ fit_squares(bands)[0]))


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

"""Known effects of a model in a record: means, band powers, cross-spectra, lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Bools, Complexes, Floats
from gyrostab.diagnose.baseline.expected_statistics import (
    N_TERM,
    NOISE,
    band_columns,
    line_columns,
    undo_transfer,
)
from gyrostab.diagnose.baseline.known_lines import (
    LinePower,
    expect_lines,
    independent_line_share,
    line_factors,
    predict_resonance,
)
from gyrostab.diagnose.predict.filter_response import band_response
from gyrostab.diagnose.predict.linear_model import (
    average_in_bands,
    cross_without,
    moves_within_blocks,
    spread_by_gaps,
    with_correlated_powers,
)
from gyrostab.diagnose.predict.windows import complex_factors, predict_effect
from gyrostab.diagnose.reduce.schema import pair_indices
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.physics.base import Effect
from gyrostab.physics.prediction import Prediction
from gyrostab.physics.sampling import LoggerFilter
from gyrostab.simulate.model import Model
from gyrostab.units import HOUR

#: Mark of a quantization grid, which every sample has: calibrated noise includes what it does.
GRID_MARK = "lattice"


class KnownEffects(NamedTuple):
    """Known effects of a model in the statistics of a record."""

    mean: Floats  # (axis, block): [degree hour-1]
    #: (axis, block, band): expected power of noise and effects [degree2 hour-2 Hz-1].
    spectrum: Floats
    #: (axis, block): share of the lowest band that is white noise of the means.
    white_share: Floats
    #: Further variables of `gyrostab.diagnose.reduce.schema.BASELINE`, if there are any: the
    #: cross-spectrum, lines at full resolution, and random processes in the means.
    variables: dict[str, Array]
    shown_elsewhere: list[str]  # effects that also show elsewhere


def expect_known_effects(blocks: xr.Dataset, model: Model, square: Floats) -> KnownEffects:
    """Predict the known effects of a model in the record, given squares of the noise (axis, 4).

    Raises
    ------
    SchemaError
        If the recording lacks the channel of an effect.
    """
    axes = [str(axis) for axis in blocks["axis"].values]
    shape = (len(axes), blocks.sizes["block"], blocks.sizes["band"])
    mean = np.zeros(shape[:2])
    noise_left = np.ones(shape[:2])  # share of the noise
    squares = np.repeat(square[:, None], shape[1], axis=1)
    # factors of filters on the noise terms, (axis, band, term)
    added, response = np.zeros(shape), np.ones((shape[0], shape[2], len(NOISE)))
    line_powers: list[LinePower] = []
    shared_powers: list[tuple[Complexes, Floats]] = []  # factor of each axis, and the density
    processes_on_rows: list[ProcessesOnRows] = []
    shown_elsewhere = []
    for effect, rows in _effects_on_rows(model, axes):
        axis_names = tuple(axes[row] for row in rows)
        sizes = partial(effect.expand_to_axes, axes=axis_names)
        prediction = with_correlated_powers(predict_effect(effect, blocks, axis_names), blocks)
        has_anomalous_samples = bool({*prediction.marks} - {GRID_MARK})
        if has_anomalous_samples or _shows_elsewhere(prediction):
            shown_elsewhere.append(effect.name)
        noise_left[rows] *= _share_left(effect, model, rows, blocks)
        if has_anomalous_samples or _switches_slowly(prediction, blocks):
            continue  # such blocks are found and left out
        for name, values in prediction.mean.items():
            mean[rows] += sizes(name)[:, None] * values
        for (term, name), values in prediction.level.items():
            place = NOISE.index(term)
            squares[rows, :, place] += square[rows, None, place] * sizes(name)[:, None] * values
        if prediction.response:
            response[rows] *= band_response(effect, blocks)
        for factor, density in _added_powers(effect, prediction, rows, blocks):
            power = np.abs(factor[:, None, None]) ** 2 * density
            added += power
            if prediction.coherent:
                shared_powers.append((factor, density))
            if prediction.line is not None and factor.any():
                line_powers.append(LinePower(effect, rows, power))
        processes_on_rows.append(ProcessesOnRows(prediction, rows, sizes))
    white_response = response[:, None, :, N_TERM]
    noise = np.einsum("fn,afn,abn->abf", band_columns(blocks), response, np.maximum(squares, 0.0))
    spectrum = spread_by_gaps((noise + added * white_response) * noise_left[..., None], blocks)
    variables = _shared_cross(shared_powers, white_response, blocks)
    if (response != 1.0).any():
        variables["line_noise"] = _filtered_lines(model, square, blocks)
    if line_powers:
        variables |= expect_lines(blocks, line_powers, white_response[:, 0])
    processes, power = random_means(processes_on_rows, shape)
    white_share = 1.0 - power / np.maximum(spectrum[..., 0], np.finfo(float).tiny)
    return KnownEffects(mean, spectrum, white_share, variables | processes, shown_elsewhere)


def _effects_on_rows(model: Model, axes: list[str]) -> Iterator[tuple[Effect, list[int]]]:
    """Yield the effects of a model, each with the rows of the axes that it acts on."""
    for effect in model.effects:
        if isinstance(effect, LoggerFilter):
            effect = effect.at_oversampling(int(model.log.get("oversampling", 1)))
        yield (
            effect,
            [row for row, axis in enumerate(axes) if not effect.axes or axis in effect.axes],
        )


def _filtered_lines(model: Model, square: Floats, blocks: xr.Dataset) -> Floats:
    """Return the density of the noise behind filters at full resolution, (axis, line)."""
    axes = [str(axis) for axis in blocks["axis"].values]
    columns = line_columns(blocks)
    factor = np.ones((len(axes), *columns.shape))
    for effect, rows in _effects_on_rows(model, axes):
        if isinstance(effect, LoggerFilter):
            factor[rows] *= line_factors(effect, blocks)
    return np.asarray(np.einsum("lt,alt,at->al", columns, factor, square))


def with_filtered_shapes(blocks: xr.Dataset, model: Model) -> xr.Dataset:
    """Return blocks with the degrees of freedom that powers have behind the filters of a model.

    Where some lines of a band dominate, its power has those of fewer lines.
    """
    if not any(isinstance(effect, LoggerFilter) for effect in model.effects):
        return blocks
    axes = map(str, blocks["axis"].values)
    square = np.array([[model.coefficients(axis)[term] ** 2 for term in NOISE] for axis in axes])
    share = independent_line_share(_filtered_lines(model, square, blocks), blocks)[:, None]
    first, second = pair_indices(blocks)
    return blocks.assign(
        shape=blocks["shape"] * share,
        cross_shape=blocks["cross_shape"] * np.sqrt(share[first] * share[second]),
    )


def _share_left(effect: Effect, model: Model, rows: list[int], blocks: xr.Dataset) -> Floats:
    """Return the share of the noise that an effect on single samples leaves, (row, block)."""
    share = np.ones((len(rows), blocks.sizes["block"]))
    if effect.transfer(np.zeros(1)) is None:
        return share
    rate = float(blocks.attrs["sampling_rate_hz"]) * float(model.log.get("oversampling", 1))
    for place, row in enumerate(rows):
        variance = model.coefficients(str(blocks["axis"].values[row]))["N"] ** 2 * HOUR * rate
        mean = blocks["mean"].values[row]
        share[place] = undo_transfer(effect.transfer, mean, variance, variance_is_before=True).share
    return share


def _added_powers(
    effect: Effect, prediction: Prediction, rows: list[int], blocks: xr.Dataset
) -> Iterator[tuple[Complexes, Floats]]:
    """Yield the factor on each axis and the density (axis, block, band) of each spectrum."""
    axes = tuple(str(axis) for axis in blocks["axis"].values[rows])
    shape = tuple(blocks.sizes[name] for name in ("axis", "block", "band"))
    for name, values in prediction.spectrum.items():
        factor, density = np.zeros(shape[0], np.complex128), np.zeros(shape)
        factor[rows] = complex_factors(effect, name, axes)
        peak = predict_resonance(effect, name, blocks, axes)
        density[rows] = (
            values.reshape(*values.shape[:-1], shape[2], -1).mean(axis=-1)
            if peak is None
            else average_in_bands(peak, blocks)
        )
        yield factor, density


class ProcessesOnRows(NamedTuple):
    """An effect whose random processes may move the block means."""

    prediction: Prediction
    rows: list[int]  # of the axes
    sizes: Callable[[str], Floats]  # parameter -> its size on each of these rows


def random_means(
    processes_on_rows: Sequence[ProcessesOnRows], shape: tuple[int, ...]
) -> tuple[dict[str, Array], Floats]:
    """Return the steady processes of effects as variables, and their power in the lowest band.

    Whatever they add there is not white noise of the means.
    """
    processes: list[tuple[Floats, float]] = []  # variance on each axis, correlation time
    walk, power = np.zeros((2, *shape[:2]))  # variance rate of random walks, and power of all
    for prediction, rows, sizes in processes_on_rows:
        for name, (time, variance) in prediction.wander.items():
            if prediction.levels or not _is_steady(time, variance):
                continue
            square = np.zeros(shape[0])
            square[rows] = sizes(name) ** 2
            if np.isinf(time):
                walk += square[:, None] * variance
            else:
                processes.append((square * variance[0], time))
            if name in prediction.spectrum:
                density = np.asarray(prediction.spectrum[name])
                by_band = density.reshape(-1, *shape[1:], density.shape[-1] // shape[2])
                power += square[:, None] * by_band[0, :, 0].mean(axis=-1)
    squares = np.array([square for square, _ in processes]).reshape(-1, shape[0]).T
    if not (squares.any() or walk.any()):
        return {}, power
    times = np.array([time for _, time in processes])
    return {"wander_square": squares, "wander_time": times, "wander_walk": walk}, power


def _shows_elsewhere(prediction: Prediction) -> bool:
    """Return whether an effect also shows outside means, powers and cross-spectra."""
    # the variance describes random means of a constant correlation time without steps
    is_steady = not prediction.levels and all(
        _is_steady(*process) for process in prediction.wander.values()
    )
    elsewhere = prediction.marks or prediction.transfer or prediction.order
    if elsewhere or prediction.phase_locked or not is_steady:
        return True
    is_shown = prediction.mean or prediction.level or prediction.spectrum
    return not is_shown and not prediction.response


def _switches_slowly(prediction: Prediction, blocks: xr.Dataset) -> bool:
    """Return whether a bias of levels stays on one for blocks, so that the means show when."""
    times = [time for time, _ in prediction.wander.values()]
    return bool(prediction.levels) and min(times, default=0.0) >= float(blocks.attrs["block_s"])


def _is_steady(time: float, variance: Floats) -> bool:
    """Return whether a process has a constant variance, or is a walk."""
    return bool(np.isinf(time) or np.ptp(variance) == 0.0)


def _shared_cross(
    shared_powers: Sequence[tuple[Complexes, Floats]], response: Floats, blocks: xr.Dataset
) -> dict[str, Array]:
    """Return the cross-spectrum of coherent effects after a filter (axis, 1, band), if any.

    An effect has a factor on each axis, and a density (axis, block, band) for a factor of 1.
    """
    first, second = pair_indices(blocks)
    shared = np.zeros(blocks["cross"].shape, np.complex128)
    for factor, density in shared_powers:
        product = factor[first] * np.conj(factor[second])
        shared += product[:, None, None] * np.sqrt(density[first] * density[second])
    shared *= np.sqrt(response[first] * response[second])
    return {"cross": spread_by_gaps(shared, blocks, "pair")} if shared.any() else {}


def find_blocks_with_known_motion(
    blocks: xr.Dataset, baseline: xr.Dataset, *, settings: Settings = DEFAULTS
) -> Bools:
    """Find the blocks in which a known mean moves far above its noise, (axis, block).

    None on an axis where most blocks move. The mean of such a block is known, but not the motion
    within it, whose spectrum would be compared with that of noise.
    """
    return moves_within_blocks(
        baseline["known_mean"].values, baseline["spectrum"].values[..., 0], blocks, settings
    )


def remove_known_motion(
    blocks: xr.Dataset, baseline: xr.Dataset, *, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Drop powers, kurtosis and cross-spectra of blocks in which a known mean moves."""
    moving = find_blocks_with_known_motion(blocks, baseline, settings=settings)
    if not moving.any():
        return blocks
    still = xr.DataArray(~moving, dims=("axis", "block"))
    return blocks.assign(
        power=blocks["power"].where(still),
        kurtosis=blocks["kurtosis"].where(still),
        cross=cross_without(blocks, moving),
    )

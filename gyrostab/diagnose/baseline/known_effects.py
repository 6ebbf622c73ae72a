"""Known effects of a model in a record: means, band powers, cross-spectra, lines."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.expected_statistics import NOISE, band_columns
from gyrostab.diagnose.baseline.wandering import (
    Wandering,
    add_up_wandering,
    is_described_by_variance,
)
from gyrostab.diagnose.evidence.spectral_lines import LEAK_LINES, expected_lines
from gyrostab.diagnose.predict.filter_response import band_response, frequencies_in_bands
from gyrostab.diagnose.predict.linear_model import (
    cross_without,
    moves_within_blocks,
    pair_rows,
    spread_by_gaps,
    unspread_share,
)
from gyrostab.diagnose.predict.windows import make_windows
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.spectra.periodogram import band_edges, ordinates, taper
from gyrostab.physics.base import Effect, driver_error
from gyrostab.physics.logger import LoggerFilter
from gyrostab.physics.prediction import Prediction
from gyrostab.simulate.model import Model

__all__ = [
    "KnownEffects",
    "expect_known_effects",
    "expect_known_motion",
    "find_drivers",
    "independent_line_share",
    "remove_known_lines",
    "remove_known_motion",
]

Array = NDArray[np.float64]
_LEAK_LINES = 100  # on either side, that a line leaks into; limits time
_PLACES_BETWEEN = 4  # positions of a line on either side of a frequency of the spectrum
_PEAK_POINTS = 1000  # within a step of a density
_EVERYWHERE = "lattice"  # the anomaly of every sample


class KnownEffects(NamedTuple):
    """Known effects of a model in the statistics of a record.

    Attributes
    ----------
    mean : ndarray, shape (axis, block)
        [degree hour-1]
    spectrum : ndarray, shape (axis, block, band)
        Expected power of noise and effects [degree2 hour-2 Hz-1].
    cross : ndarray of complex, shape (pair, block, band), or None
        Expected cross-spectrum [degree2 hour-2 Hz-1]; None if the axes have nothing in common.
    lines : dict of str to ndarray
        At full resolution (axis, line): steady ``lines``, their largest possible power at each
        frequency (``lines_most``), and broad ``peaks``. And ``line_spectrum`` (axis, band): their
        power in the bands, without leakage [degree2 hour-2 Hz-1]. Empty without lines.
    wandering : Wandering
        Random processes in the means.
    left_out : list of str
        Effects that also show elsewhere.
    """

    mean: Array
    spectrum: Array
    cross: NDArray[np.complex128] | None
    lines: dict[str, Array]
    wandering: Wandering
    left_out: list[str]


def expect_known_effects(blocks: xr.Dataset, model: Model, square: Array) -> KnownEffects:
    """Predict the known effects of a model in the record.

    Parameters
    ----------
    square : ndarray, shape (axis, 4)
        Squared noise coefficients.

    Raises
    ------
    SchemaError
        If the recording lacks the channel of an effect.
    """
    acting = [
        _act_on_record(effect, blocks)
        for effect in map(_effect_of_instrument(model), model.effects)
    ]
    # Blocks with anomalous samples are found and left out.
    described = [active for active in acting if not _has_anomalous_samples(active)]
    powers = [power for active in described for power in _added_powers(active, blocks)]
    response = _filter_response(described, blocks)
    noise = np.einsum(
        "fn,abn->abf",
        band_columns(blocks),
        np.maximum(_expected_squares(described, square, blocks), 0.0),
    )
    added = np.zeros(noise.shape)
    for power in powers:
        added += power.on_axes
    narrow = [
        (added_power.acting.effect, added_power.acting.rows, added_power.on_axes)
        for added_power in powers
        if added_power.acting.prediction.line is not None and added_power.factor.any()
    ]
    sizes = {
        "bands": blocks.sizes["band"],
        "block_count": blocks.sizes["block"],
        "axes": blocks.sizes["axis"],
    }
    return KnownEffects(
        mean=_expected_means(described, blocks),
        spectrum=spread_by_gaps((noise + added) * response, blocks),
        cross=_shared_cross(powers, response, blocks),
        lines=_known_lines(blocks, narrow, response[:, 0])
        if narrow and "line_power" in blocks
        else {},
        wandering=add_up_wandering(
            [(_process_squares(active, blocks), active.prediction) for active in described], **sizes
        ),
        left_out=[
            active.effect.name
            for active in acting
            if _has_anomalous_samples(active) or _shows_elsewhere(active)
        ],
    )


class _ActingEffect(NamedTuple):
    """An effect of a model on a record.

    Attributes
    ----------
    rows : list of int
        Indices of the axes that it acts on.
    axes : tuple of str
        Names of these axes.
    prediction : Prediction
        Its prediction.
    """

    effect: Effect
    rows: list[int]
    axes: tuple[str, ...]
    prediction: Prediction


class _AddedPower(NamedTuple):
    """Power added by an effect.

    Attributes
    ----------
    factor : ndarray of complex, shape (axis,)
    density : ndarray, shape (axis, block, band)
        For a factor of 1 [degree2 hour-2 Hz-1 per squared unit].
    """

    acting: _ActingEffect
    factor: NDArray[np.complex128]
    density: Array

    @property
    def on_axes(self) -> Array:
        """Power on each axis, (axis, block, band) [degree2 hour-2 Hz-1]."""
        return np.asarray(np.abs(self.factor[:, None, None]) ** 2 * self.density)


def _act_on_record(effect: Effect, blocks: xr.Dataset) -> _ActingEffect:
    """Predict an effect on the axes that it acts on."""
    axes = [str(axis) for axis in blocks["axis"].values]
    rows = [row for row, axis in enumerate(axes) if not effect.axes or axis in effect.axes]
    axis_names = tuple(axes[row] for row in rows)
    return _ActingEffect(effect, rows, axis_names, _predict_effect(effect, blocks, axis_names))


def _has_anomalous_samples(active: _ActingEffect) -> bool:
    """Return whether an effect changes sample counts other than by a quantization grid."""
    return bool({*active.prediction.marks} - {_EVERYWHERE})


def _shows_elsewhere(active: _ActingEffect) -> bool:
    """Return whether an effect also shows outside means, powers and cross-spectra."""
    prediction = active.prediction
    elsewhere = (
        prediction.marks
        or not is_described_by_variance(prediction)
        or prediction.transfer
        or prediction.order
        or prediction.phase_locked
    )
    return bool(
        elsewhere
        or not (
            prediction.mean
            or prediction.level
            or prediction.spectrum
            or prediction.response is not None
        )
    )


def _expected_means(acting: Sequence[_ActingEffect], blocks: xr.Dataset) -> Array:
    """Return the rates that effects add, (axis, block) [degree hour-1]."""
    mean = np.zeros((blocks.sizes["axis"], blocks.sizes["block"]))
    for active in acting:
        for name, values in active.prediction.mean.items():
            mean[active.rows] += _sizes_by_axis(active.effect, name, active.axes)[:, None] * values
    return mean


def _expected_squares(acting: Sequence[_ActingEffect], square: Array, blocks: xr.Dataset) -> Array:
    """Return squared noise coefficients including effects, (axis, block, noise)."""
    level = np.repeat(square[:, None], blocks.sizes["block"], axis=1)
    for active in acting:
        for (term, name), values in active.prediction.level.items():
            axis_square = square[active.rows, None, NOISE.index(term)]
            level[active.rows, :, NOISE.index(term)] += (
                axis_square * _sizes_by_axis(active.effect, name, active.axes)[:, None] * values
            )
    return level


def _added_powers(active: _ActingEffect, blocks: xr.Dataset) -> list[_AddedPower]:
    """Return the powers that an effect adds, one for each of its spectra."""
    out, bands = [], blocks.sizes["band"]
    for name, values in active.prediction.spectrum.items():
        factor = np.zeros(blocks.sizes["axis"], np.complex128)
        factor[active.rows] = _complex_factors(active.effect, name, active.axes)
        density = np.zeros((factor.size, blocks.sizes["block"], bands))
        peak = _resonance_density(active.effect, name, blocks, active.axes)
        density[active.rows] = (
            values.reshape(*values.shape[:-1], bands, -1).mean(axis=-1)
            if peak is None
            else _average_in_bands(peak, blocks)
        )
        out.append(_AddedPower(active, factor, density))
    return out


def _filter_response(acting: Sequence[_ActingEffect], blocks: xr.Dataset) -> Array:
    """Return the power response of filters, (axis, 1, band)."""
    response = np.ones((blocks.sizes["axis"], 1, blocks.sizes["band"]))
    for active in acting:
        if active.prediction.response is not None:
            response[active.rows] *= band_response(active.effect, blocks)
    return response


def _shared_cross(
    powers: Sequence[_AddedPower], response: Array, blocks: xr.Dataset
) -> NDArray[np.complex128] | None:
    """Return the cross-spectrum of coherent effects after a filter (axis, 1, band)."""
    if "cross" not in blocks:
        return None
    axes = [str(axis) for axis in blocks["axis"].values]
    pairs = [(axes.index(a), axes.index(b)) for a, b in pair_rows(blocks)]
    shared = np.zeros((len(pairs), blocks.sizes["block"], blocks.sizes["band"]), np.complex128)
    for power in (power for power in powers if power.acting.prediction.coherent):
        for number, (row, other_row) in enumerate(pairs):
            factor_product = power.factor[row] * np.conj(power.factor[other_row])
            shared[number] += factor_product * np.sqrt(
                power.density[row] * power.density[other_row]
            )
    for number, (row, other_row) in enumerate(pairs):
        shared[number] *= np.sqrt(response[row] * response[other_row])
    return spread_by_gaps(shared, blocks, "pair") if shared.any() else None


def _process_squares(active: _ActingEffect, blocks: xr.Dataset) -> dict[str, Array]:
    """Return squared sizes of random processes in the means, (axis,) each."""
    squares = {}
    for name in active.prediction.wander:
        squares[name] = np.zeros(blocks.sizes["axis"])
        squares[name][active.rows] = _sizes_by_axis(active.effect, name, active.axes) ** 2
    return squares


def expect_known_motion(
    blocks: xr.Dataset, baseline: xr.Dataset, *, settings: Settings = DEFAULTS
) -> NDArray[np.bool_]:
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
    moving = expect_known_motion(blocks, baseline, settings=settings)
    if not moving.any():
        return blocks
    still = xr.DataArray(~moving, dims=("axis", "block"))
    out = blocks.assign(
        {name: blocks[name].where(still) for name in ("power", "kurtosis") if name in blocks}
    )
    return out.assign(cross=cross_without(blocks, moving)) if "cross" in blocks else out


def _known_lines(
    blocks: xr.Dataset, narrow: Sequence[tuple[Effect, list[int], Array]], response: Array
) -> dict[str, Array]:
    """Return lines of effects after a filter (axis, band), as in `KnownEffects.lines`.

    The effects come with their axes and their power in the bands.
    """
    axes = [str(axis) for axis in blocks["axis"].values]
    frequency, bands = blocks["line_frequency"].values, blocks["frequency"].values
    passed = np.stack(
        [np.interp(np.log(frequency), np.log(bands), axis_response) for axis_response in response]
    )
    steady, largest, broad = (np.zeros(passed.shape) for _ in range(3))
    near, band_power = unspread_share(blocks)[..., None], np.zeros((len(axes), bands.size))
    leak = _line_leakage(int(blocks.attrs["block_samples"]))
    for effect, rows, density in narrow:
        chosen = tuple(axes[row] for row in rows)
        prediction = _predict_effect(effect, blocks, chosen, frequency)
        band_power += (near * density).mean(axis=1) * response
        for name, values in prediction.spectrum.items():
            size = np.abs(_complex_factors(effect, name, chosen)[:, None]) ** 2 * values.mean(
                axis=-2
            )
            places = 0 if prediction.line is None else prediction.line.size // blocks.sizes["block"]
            alone = np.count_nonzero(values, axis=-1).max() <= places
            peak = _resonance_density(effect, name, blocks, chosen)
            if peak is not None:
                broad[rows] += (
                    np.abs(_complex_factors(effect, name, chosen)[:, None]) ** 2
                    * peak
                    * passed[rows]
                )
                continue
            own_leak = leak[1]
            if (
                alone
                and places == 1
                and prediction.line is not None
                and np.ptp(prediction.line) == 0.0
            ):
                apart = (
                    float(prediction.line.flat[0])
                    - frequency[int(np.argmax(values.reshape(-1, frequency.size)[0]))]
                )
                own_leak = _line_leakage(
                    int(blocks.attrs["block_samples"]), apart * float(blocks.attrs["block_s"])
                )[0]
            for row, power in zip(rows, size * passed[rows], strict=True):
                (steady if alone else broad)[row] += np.convolve(
                    power, own_leak if alone else leak[0], "same"
                )
                largest[row] += np.convolve(power, leak[2], "same") if alone else 0.0
    return {"lines": steady, "lines_most": largest, "peaks": broad, "line_spectrum": band_power}


def _resonance_density(
    effect: Effect, name: str, blocks: xr.Dataset, axes: tuple[str, ...]
) -> Array | None:
    """Return the tapered density of a resonance per squared unit, (line,); None without resonance.

    Its peak may be narrower than the width of the taper.
    """
    if not math.isfinite(getattr(effect, "quality", math.inf)) or "line_frequency" not in blocks:
        return None
    frequency = blocks["line_frequency"].values
    finer = 2 * _PLACES_BETWEEN
    size = int(blocks.attrs["block_samples"])
    fine = frequency[0] / finer * np.arange(1, finer * frequency.size + 1)
    prediction = _predict_effect(effect, blocks, axes, fine)
    density = prediction.spectrum[name].reshape(-1, fine.size)[0].copy()
    centre = (
        fine.size
        if prediction.line is None
        else int(np.argmin(np.abs(fine - prediction.line.flat[0])))
    )
    inside = (np.arange(_PEAK_POINTS) + 0.5) / _PEAK_POINTS - 0.5
    # The peak may be narrower than the steps of the density.
    for place in range(max(centre - 1, 0), min(centre + 2, fine.size)):
        frequencies = fine[place] + (fine[1] - fine[0]) * inside
        density[place] = (
            _predict_effect(effect, blocks, axes, frequencies)
            .spectrum[name]
            .reshape(-1, inside.size)[0]
            .mean()
        )
    window = np.abs(np.fft.fft(taper(size), size * finer)) ** 2
    reach = min(_LEAK_LINES, frequency.size // 2) * finer
    window = np.concatenate([window[-reach:], window[: reach + 1]])
    tapered = np.convolve(
        np.concatenate([density[::-1], density[:1], density]), window / window.sum(), "same"
    )
    return np.asarray(tapered[fine.size + finer :: finer])


def _average_in_bands(density: Array, blocks: xr.Dataset) -> Array:
    """Average a density over the lines of every band."""
    edges = band_edges(int(blocks.attrs["block_samples"])) - 1
    return np.asarray(np.add.reduceat(density, edges[:-1]) / np.diff(edges))


def independent_line_share(density: Array, blocks: xr.Dataset) -> Array:
    """Return the equivalent share of independent lines of a band (axis, band).

    It is below 1 if the density (axis, line) is dominated by some lines.
    """
    return np.stack(
        [
            _average_in_bands(axis_density, blocks) ** 2
            / _average_in_bands(axis_density**2, blocks)
            for axis_density in density
        ]
    )


def _line_leakage(size: int, apart: float = 0.0) -> tuple[Array, Array, Array]:
    """Return the share of a line in the lines around it: at an offset, on average, at most.

    The offset `apart` from the middle line is in lines.
    """
    weights = taper(size)
    reach = min(_LEAK_LINES, ordinates(size) // 2)
    finer = 2 * _PLACES_BETWEEN
    turned = weights * np.exp(2j * np.pi * apart * np.arange(size) / size)
    padded = np.abs(np.fft.fft(turned, size * finer)) ** 2 / (size * (weights**2).sum())
    place = np.arange(-reach, reach + 1) * finer
    inside = padded[place[:, None] + np.arange(-_PLACES_BETWEEN, _PLACES_BETWEEN + 1)]
    ends = np.array([0.5, *[1.0] * (2 * _PLACES_BETWEEN - 1), 0.5])
    return inside[:, _PLACES_BETWEEN], np.average(inside, axis=1, weights=ends), inside.max(axis=1)


def remove_known_lines(
    blocks: xr.Dataset, baseline: xr.Dataset, *, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Subtract the known steady lines from the line spectrum.

    The excess over a known line stays if it exceeds the model error of an effect and the scatter of
    the noise.
    """
    if "lines" not in baseline:
        return blocks
    power, weight = blocks["line_power"], blocks["line_weight"]
    noise = expected_lines(baseline, blocks["line_frequency"].values)[:, None]
    known, largest = (baseline[name].values[:, None] for name in ("lines", "lines_most"))
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = np.sqrt((noise**2 + 2.0 * noise * largest) / weight.values[..., None])
    above = power.values - noise - known
    error = settings.spectrum_error_share
    exceeds = power.values - noise - largest > error * largest + settings.known_line_sigma * scatter
    padded_lines = np.pad(exceeds, ((0, 0), (0, 0), (LEAK_LINES, LEAK_LINES)))
    # With the lines that it leaks into.
    exceeds = np.lib.stride_tricks.sliding_window_view(
        padded_lines, 2 * LEAK_LINES + 1, axis=-1
    ).any(axis=-1)
    freed = noise + np.where(exceeds | (largest < error * noise), above, 0.0)
    freed = np.where(known > 0.0, np.maximum(freed, 0.0), power.values)
    return blocks.assign(
        line_power=power.copy(data=np.where(np.isfinite(power.values), freed, np.nan))
    )


def _effect_of_instrument(model: Model) -> Callable[[Effect], Effect]:
    """Return the filter of effects at the rate of the model's instrument."""
    instrument = float(model.log.get("oversampling", 1))
    return lambda effect: (
        replace(effect, instrument=instrument) if isinstance(effect, LoggerFilter) else effect
    )


def find_drivers(effect: Effect) -> dict[str, str]:
    """Return the names in the log of an effect's channels."""
    return {role: effect.channel_names()[role] for role in effect.needs()}


def _predict_effect(
    effect: Effect, blocks: xr.Dataset, axes: tuple[str, ...], frequency: Array | None = None
) -> Prediction:
    """Predict an effect on some axes, with many frequencies in each band for narrow peaks."""
    drivers = find_drivers(effect)
    present = [
        str(name).removeprefix("channel_")
        for name in blocks.data_vars
        if str(name).startswith("channel_")
    ]
    for role, name in drivers.items():
        if name not in present:
            raise driver_error(effect, role, present)
    return effect.explain(
        replace(
            make_windows(blocks, drivers),
            axes=axes,
            frequency=frequencies_in_bands(blocks) if frequency is None else frequency,
        )
    )


def _sizes_by_axis(effect: Effect, name: str, axes: tuple[str, ...]) -> Array:
    """Return a parameter for each axis."""
    known = {parameter.name: parameter for parameter in effect.parameters()}
    return (
        effect.each(name, axes)
        if known[name].many
        else np.full(len(axes), float(getattr(effect, name)))
    )


def _complex_factors(effect: Effect, name: str, axes: tuple[str, ...]) -> NDArray[np.complex128]:
    """Return the complex factor of a spectrum for each axis: size, direction, phase."""
    known = {parameter.name: parameter for parameter in effect.parameters()}
    factor = _sizes_by_axis(effect, name, axes).astype(np.complex128)
    if "direction" in known:
        factor *= _sizes_by_axis(effect, "direction", axes)
    if "phase" in known and known["phase"].many:
        factor *= np.exp(1j * np.radians(_sizes_by_axis(effect, "phase", axes)))
    return factor

"""What the effects of a model make of a record, as far as they are known beforehand: means, band powers, cross-spectra, lines."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.calibration.noise_statistics import NOISE, band_columns
from gyrostab.diagnose.calibration.wandering import Wandering, told_in_full, wandering
from gyrostab.diagnose.effects.candidates import windows_of
from gyrostab.diagnose.effects.cells import cross_without, effective, in_place, pair_rows
from gyrostab.diagnose.effects.response import inside_bands, response_of
from gyrostab.diagnose.gains.lines import LEAK, expected_lines
from gyrostab.kernels.periodogram import band_edges, ordinates, taper
from gyrostab.physics.base import Effect, driver_error
from gyrostab.physics.logger import LoggerFilter
from gyrostab.physics.prediction import Prediction
from gyrostab.simulate.model import Model

__all__ = ["Known", "drivers_of", "evenness", "known_effects", "known_motion", "without_known_lines", "without_known_motion"]

Array = NDArray[np.float64]
_REACH, _BETWEEN = 100, 4  # ordinates on either side that a line leaks into; places of it between one and the next, on either side
_SIZE_ERROR = 0.1  # of the power of a known line: twice the share of its amplitude by which a form may be wrong, and more
_INSIDE_PEAK = 1000  # places within a step of a density
_IN_ALL = "lattice"  # what is odd about every sample
_MOVES, _USUAL = 5.0, 0.5  # of the noise of a mean, its square, that counts as moving; share of the blocks that may be left out
_CHANCE = 5.0  # standard deviations
_SLIGHT = 0.1  # of the noise, below which what leaks from a line is taken off as it is


class Known(NamedTuple):
    """Effects of a model in the statistics of a record.

    Attributes
    ----------
    mean : ndarray, shape (axis, block)
        [degree hour-1]
    spectrum : ndarray, shape (axis, block, band)
        Expected power of noise and effects [degree2 hour-2 Hz-1].
    cross : ndarray of complex, shape (pair, block, band), or None
        Expected cross-spectrum [degree2 hour-2 Hz-1]; None where the axes share nothing.
    lines : dict of str to ndarray
        At full resolution (axis, line): steady ``lines``, the most that each ordinate may have of them (``lines_most``), and ``peaks``
        of some width. And ``line_spectrum`` (axis, band): what they have in the bands, at their own place [degree2 hour-2 Hz-1].
        Empty without any.
    wandering : Wandering
        What they do to the means at random.
    left_out : list of str
        Effects that show elsewhere too.
    """

    mean: Array
    spectrum: Array
    cross: NDArray[np.complex128] | None
    lines: dict[str, Array]
    wandering: Wandering
    left_out: list[str]


def known_effects(reduced: xr.Dataset, model: Model, square: Array) -> Known:
    """What the effects of a model make of the record.

    Parameters
    ----------
    reduced : xarray.Dataset
    model : Model
    square : ndarray, shape (axis, 4)
        Squared noise coefficients.

    Raises
    ------
    SchemaError
        When the recording lacks the channel of an effect.
    """
    axes = [str(axis) for axis in reduced["axis"].values]
    blocks, bands = reduced.sizes["block"], reduced.sizes["band"]
    mean, level = np.zeros((len(axes), blocks)), np.repeat(square[:, None], blocks, axis=1)
    added, response, left_out = np.zeros((len(axes), blocks, bands)), np.ones((len(axes), 1, bands)), []
    pairs = [(axes.index(a), axes.index(b)) for a, b in pair_rows(reduced)] if "cross" in reduced else []
    shared = np.zeros((len(pairs), blocks, bands), np.complex128)
    narrow: list[tuple[Effect, list[int], Array]] = []
    random: list[tuple[dict[str, Array], Prediction]] = []
    for effect in map(_simulated(model), model.effects):
        rows = [row for row, axis in enumerate(axes) if not effect.axes or axis in effect.axes]
        own = tuple(axes[row] for row in rows)
        seen = _explained(effect, reduced, own)
        if {*seen.marks} - {_IN_ALL}:  # the blocks with odd samples are found, and left out
            left_out.append(effect.name)
            continue
        for name, values in seen.mean.items():
            mean[rows] += _sizes(effect, name, own)[:, None] * values
        for (term, name), values in seen.level.items():
            level[rows, :, NOISE.index(term)] += square[rows, None, NOISE.index(term)] * _sizes(effect, name, own)[:, None] * values
        for name, values in seen.spectrum.items():
            factor = np.zeros(len(axes), np.complex128)
            factor[rows] = _factors(effect, name, own)
            density = np.zeros((len(axes), blocks, bands))
            peak = _peak(effect, name, reduced, own)
            density[rows] = values.reshape(*values.shape[:-1], bands, -1).mean(axis=-1) if peak is None else _over_bands(peak, reduced)
            added += np.abs(factor[:, None, None]) ** 2 * density
            for number, (one, other) in enumerate(pairs if seen.coherent else ()):
                shared[number] += factor[one] * np.conj(factor[other]) * np.sqrt(density[one] * density[other])
            if seen.line is not None and factor.any():
                narrow.append((effect, rows, np.abs(factor[:, None, None]) ** 2 * density))
        if seen.response is not None:
            response[rows] *= response_of(effect, reduced)
        random.append(({name: _on(rows, len(axes), _sizes(effect, name, own) ** 2) for name in seen.wander}, seen))
        elsewhere = seen.marks or not told_in_full(seen) or seen.transfer or seen.order or seen.phase_locked
        if elsewhere or not (seen.mean or seen.level or seen.spectrum or seen.response is not None):
            left_out.append(effect.name)
    spectrum = (np.einsum("fn,abn->abf", band_columns(reduced), np.maximum(level, 0.0)) + added) * response
    for number, (one, other) in enumerate(pairs):
        shared[number] *= np.sqrt(response[one] * response[other])
    cross = effective(shared, reduced, "pair") if shared.any() else None
    lines = _known_lines(reduced, narrow, response[:, 0]) if narrow and "line_power" in reduced else {}
    return Known(mean, effective(spectrum, reduced), cross, lines, wandering(random, bands=bands, blocks=blocks, axes=len(axes)), left_out)


def _on(rows: Sequence[int], axes: int, values: Array) -> Array:
    """Values of some axes among all of them."""
    out = np.zeros(axes)
    out[list(rows)] = values
    return out


def known_motion(reduced: xr.Dataset, baseline: xr.Dataset) -> NDArray[np.bool_]:
    """Blocks in which what is known of an axis moves far above its noise, (axis, block); none on an axis where that is the usual thing.

    The mean of such a block is known, and what moves inside it is not: its spectrum would be compared with that of noise.

    Parameters
    ----------
    reduced, baseline : xarray.Dataset
    """
    step = np.abs(np.diff(baseline["known_mean"].transpose("axis", "block").values, axis=1))
    moved = np.maximum(np.pad(step, ((0, 0), (0, 1))), np.pad(step, ((0, 0), (1, 0))))
    noise = baseline["spectrum"].transpose("axis", "block", "band").values[..., 0]
    moving = moved**2 * float(reduced.attrs["block_s"]) > _MOVES * noise
    return np.asarray(moving & (moving.mean(axis=1, keepdims=True) <= _USUAL))


def without_known_motion(reduced: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
    """The record without what blocks say of their inside where what is known of an axis moves: powers, kurtosis, and what axes share there.

    Parameters
    ----------
    reduced, baseline : xarray.Dataset
    """
    moving = known_motion(reduced, baseline)
    if not moving.any():
        return reduced
    still = xr.DataArray(~moving, dims=("axis", "block"))
    out = reduced.assign({name: reduced[name].where(still) for name in ("power", "kurtosis") if name in reduced})
    return out.assign(cross=cross_without(reduced, moving)) if "cross" in reduced else out


def _known_lines(reduced: xr.Dataset, narrow: Sequence[tuple[Effect, list[int], Array]], response: Array) -> dict[str, Array]:
    """Lines of effects (with their axes, and their power in the bands), behind a filter (axis, band), as `Known.lines` has them."""
    axes = [str(axis) for axis in reduced["axis"].values]
    frequency, bands = reduced["line_frequency"].values, reduced["frequency"].values
    passed = np.stack([np.interp(np.log(frequency), np.log(bands), one) for one in response])
    steady, most, broad = (np.zeros(passed.shape) for _ in range(3))
    near, own = in_place(reduced)[..., None], np.zeros((len(axes), bands.size))
    leak = _leak(int(reduced.attrs["block_samples"]))
    for effect, rows, density in narrow:
        chosen = tuple(axes[row] for row in rows)
        seen = _explained(effect, reduced, chosen, frequency)
        own += (near * density).mean(axis=1) * response
        for name, values in seen.spectrum.items():
            size = np.abs(_factors(effect, name, chosen)[:, None]) ** 2 * values.mean(axis=-2)
            places = 0 if seen.line is None else seen.line.size // reduced.sizes["block"]
            alone = np.count_nonzero(values, axis=-1).max() <= places
            peak = _peak(effect, name, reduced, chosen)
            if peak is not None:
                broad[rows] += np.abs(_factors(effect, name, chosen)[:, None]) ** 2 * peak * passed[rows]
                continue
            own_leak = leak[1]
            if alone and places == 1 and seen.line is not None and np.ptp(seen.line) == 0.0:
                apart = float(seen.line.flat[0]) - frequency[int(np.argmax(values.reshape(-1, frequency.size)[0]))]
                own_leak = _leak(int(reduced.attrs["block_samples"]), apart * float(reduced.attrs["block_s"]))[0]
            for row, one in zip(rows, size * passed[rows], strict=True):
                (steady if alone else broad)[row] += np.convolve(one, own_leak if alone else leak[0], "same")
                most[row] += np.convolve(one, leak[2], "same") if alone else 0.0
    return {"lines": steady, "lines_most": most, "peaks": broad, "line_spectrum": own}


def _peak(effect: Effect, name: str, reduced: xr.Dataset, axes: tuple[str, ...]) -> Array | None:
    """Density of a resonance per squared unit as the taper shows it, (line,): its peak may be narrower than the taper's own width.

    None of an effect that has none.
    """
    if not math.isfinite(getattr(effect, "quality", math.inf)) or "line_frequency" not in reduced:
        return None
    frequency, finer, size = reduced["line_frequency"].values, 2 * _BETWEEN, int(reduced.attrs["block_samples"])
    fine = frequency[0] / finer * np.arange(1, finer * frequency.size + 1)
    seen = _explained(effect, reduced, axes, fine)
    density = seen.spectrum[name].reshape(-1, fine.size)[0].copy()
    centre = fine.size if seen.line is None else int(np.argmin(np.abs(fine - seen.line.flat[0])))
    inside = (np.arange(_INSIDE_PEAK) + 0.5) / _INSIDE_PEAK - 0.5
    for place in range(max(centre - 1, 0), min(centre + 2, fine.size)):  # where the peak may be narrower than the steps of the density
        there = fine[place] + (fine[1] - fine[0]) * inside
        density[place] = _explained(effect, reduced, axes, there).spectrum[name].reshape(-1, inside.size)[0].mean()
    window = np.abs(np.fft.fft(taper(size), size * finer)) ** 2
    reach = min(_REACH, frequency.size // 2) * finer
    window = np.concatenate([window[-reach:], window[: reach + 1]])
    shown = np.convolve(np.concatenate([density[::-1], density[:1], density]), window / window.sum(), "same")
    return np.asarray(shown[fine.size + finer :: finer])


def _over_bands(density: Array, reduced: xr.Dataset) -> Array:
    """Mean of every band of a density of all ordinates."""
    edges = band_edges(int(reduced.attrs["block_samples"])) - 1
    return np.asarray(np.add.reduceat(density, edges[:-1]) / np.diff(edges))


def evenness(density: Array, reduced: xr.Dataset) -> Array:
    """Share of the ordinates of a band (axis, band) that scatter by themselves where one of them is louder than others (axis, line)."""
    return np.stack([_over_bands(one, reduced) ** 2 / _over_bands(one**2, reduced) for one in density])


def _leak(size: int, apart: float = 0.0) -> tuple[Array, Array, Array]:
    """Share of a line in the ordinates about it, so far `apart` from the middle one; the mean over such places, and the most at any."""
    weights = taper(size)
    reach = min(_REACH, ordinates(size) // 2)
    finer = 2 * _BETWEEN
    turned = weights * np.exp(2j * np.pi * apart * np.arange(size) / size)
    padded = np.abs(np.fft.fft(turned, size * finer)) ** 2 / (size * (weights**2).sum())
    place = np.arange(-reach, reach + 1) * finer
    inside = padded[place[:, None] + np.arange(-_BETWEEN, _BETWEEN + 1)]
    ends = np.array([0.5, *[1.0] * (2 * _BETWEEN - 1), 0.5])
    return inside[:, _BETWEEN], np.average(inside, axis=1, weights=ends), inside.max(axis=1)


def without_known_lines(reduced: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
    """The record with its line spectrum freed of the steady lines that the baseline knows.

    A line is left as it is above what is known of it where it is stronger than the form of an effect may be wrong and the noise
    beside it may do.

    Parameters
    ----------
    reduced, baseline : xarray.Dataset
    """
    if "lines" not in baseline:
        return reduced
    power, weight = reduced["line_power"].transpose("axis", "part", "line"), reduced["line_weight"].transpose("axis", "part")
    noise = expected_lines(baseline, reduced["line_frequency"].values)[:, None]
    known, most = (baseline[name].values[:, None] for name in ("lines", "lines_most"))
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = np.sqrt((noise**2 + 2.0 * noise * most) / weight.values[..., None])
    above = power.values - noise - known
    stands = power.values - noise - most > _SIZE_ERROR * most + _CHANCE * scatter
    beside = np.pad(stands, ((0, 0), (0, 0), (LEAK, LEAK)))
    stands = np.lib.stride_tricks.sliding_window_view(beside, 2 * LEAK + 1, axis=-1).any(axis=-1)  # with what it leaks into
    freed = noise + np.where(stands | (most < _SLIGHT * noise), above, 0.0)
    freed = np.where(known > 0.0, np.maximum(freed, 0.0), power.values)
    return reduced.assign(line_power=power.copy(data=np.where(np.isfinite(power.values), freed, np.nan)))


def _simulated(model: Model) -> Callable[[Effect], Effect]:
    """Effects as the model simulates them: a filter works at the rate of the model's instrument."""
    instrument = float(model.log.get("oversampling", 1))
    return lambda effect: replace(effect, instrument=instrument) if isinstance(effect, LoggerFilter) else effect


def drivers_of(effect: Effect) -> dict[str, str]:
    """Channel of the effect -> its name in the log."""
    return {role: effect.channel_names()[role] for role in effect.needs()}


def _explained(effect: Effect, reduced: xr.Dataset, axes: tuple[str, ...], frequency: Array | None = None) -> Prediction:
    """What an effect predicts for the record on some of its axes; spectra at many frequencies in each band, since a peak may be narrow."""
    drivers = drivers_of(effect)
    present = [str(name).removeprefix("channel_") for name in reduced.data_vars if str(name).startswith("channel_")]
    for role, name in drivers.items():
        if name not in present:
            raise driver_error(effect, role, present)
    return effect.explain(
        replace(windows_of(reduced, drivers), axes=axes, frequency=inside_bands(reduced) if frequency is None else frequency)
    )


def _sizes(effect: Effect, name: str, axes: tuple[str, ...]) -> Array:
    """A parameter for each axis."""
    known = {one.name: one for one in effect.parameters()}
    return effect.each(name, axes) if known[name].many else np.full(len(axes), float(getattr(effect, name)))


def _factors(effect: Effect, name: str, axes: tuple[str, ...]) -> NDArray[np.complex128]:
    """Factor that each axis has of a spectrum: its size, the share of its direction, the phase of a steady line."""
    known = {one.name: one for one in effect.parameters()}
    factor = _sizes(effect, name, axes).astype(np.complex128)
    if "direction" in known:
        factor *= _sizes(effect, "direction", axes)
    if "phase" in known and known["phase"].many:
        factor *= np.exp(1j * np.radians(_sizes(effect, "phase", axes)))
    return factor

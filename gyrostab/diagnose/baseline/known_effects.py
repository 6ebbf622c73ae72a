"""What the effects of a model make of a record, as far as they are known beforehand: means, band powers, cross-spectra, lines."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.expected_statistics import NOISE, band_columns
from gyrostab.diagnose.baseline.wandering import Wandering, told_in_full, wandering
from gyrostab.diagnose.evidence.spectral_lines import LEAK_LINES, expected_lines
from gyrostab.diagnose.predict.candidates import make_windows
from gyrostab.diagnose.predict.filter_response import band_response, frequencies_in_bands
from gyrostab.diagnose.predict.linear_model import (
    cross_without,
    pair_rows,
    spread_by_gaps,
    unspread_share,
)
from gyrostab.kernels.spectra.periodogram import band_edges, ordinates, taper
from gyrostab.physics.base import Effect, driver_error
from gyrostab.physics.logger import LoggerFilter
from gyrostab.physics.prediction import Prediction
from gyrostab.simulate.model import Model

__all__ = [
    "KnownEffects",
    "evenness",
    "expect_known_effects",
    "expect_known_motion",
    "find_drivers",
    "remove_known_lines",
    "remove_known_motion",
]

Array = NDArray[np.float64]
_REACH, _BETWEEN = (
    100,
    4,
)  # ordinates on either side that a line leaks into; places of it between one and the next, on either side
# of the power of a known line: twice the share of its amplitude by which a form may be wrong, and
# more
_SIZE_ERROR = 0.1
_INSIDE_PEAK = 1000  # places within a step of a density
_IN_ALL = "lattice"  # what is odd about every sample
_MOVES, _USUAL = (
    5.0,
    0.5,
)  # of the noise of a mean, its square, that counts as moving; share of the blocks that may be left out
_CHANCE = 5.0  # standard deviations
_SLIGHT = 0.1  # of the noise, below which what leaks from a line is taken off as it is


class KnownEffects(NamedTuple):
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
        At full resolution (axis, line): steady ``lines``, the most that each ordinate may have of
        them (``lines_most``), and ``peaks`` of some width. And ``line_spectrum`` (axis, band): what
        they have in the bands, at their own place [degree2 hour-2 Hz-1]. Empty without any.
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


def expect_known_effects(blocks: xr.Dataset, model: Model, square: Array) -> KnownEffects:
    """What the effects of a model make of the record.

    Parameters
    ----------
    blocks : xarray.Dataset
    model : Model
    square : ndarray, shape (axis, 4)
        Squared noise coefficients.

    Raises
    ------
    SchemaError
        When the recording lacks the channel of an effect.
    """
    acting = [_acting(effect, blocks) for effect in map(_simulated(model), model.effects)]
    shown = [
        one for one in acting if not _leaves_odd_samples(one)
    ]  # the blocks with odd samples are found, and left out
    powers = [power for one in shown for power in _powers(one, blocks)]
    response = _response(shown, blocks)
    noise = np.einsum(
        "fn,abn->abf", band_columns(blocks), np.maximum(_levels(shown, square, blocks), 0.0)
    )
    added = np.zeros(noise.shape)
    for power in powers:
        added += power.own
    narrow = [
        (one.acting.effect, one.acting.rows, one.own)
        for one in powers
        if one.acting.seen.line is not None and one.factor.any()
    ]
    sizes = {
        "bands": blocks.sizes["band"],
        "block_count": blocks.sizes["block"],
        "axes": blocks.sizes["axis"],
    }
    return KnownEffects(
        mean=_means(shown, blocks),
        spectrum=spread_by_gaps((noise + added) * response, blocks),
        cross=_cross(powers, response, blocks),
        lines=_known_lines(blocks, narrow, response[:, 0])
        if narrow and "line_power" in blocks
        else {},
        wandering=wandering([(_wander_squares(one, blocks), one.seen) for one in shown], **sizes),
        left_out=[
            one.effect.name for one in acting if _leaves_odd_samples(one) or _shows_elsewhere(one)
        ],
    )


class _Acting(NamedTuple):
    """An effect of a model on a record.

    Attributes
    ----------
    effect : Effect
    rows : list of int
        Axes that it acts on.
    axes : tuple of str
        Their names.
    seen : Prediction
        What it does there.
    """

    effect: Effect
    rows: list[int]
    axes: tuple[str, ...]
    seen: Prediction


class _Power(NamedTuple):
    """Power that an effect adds.

    Attributes
    ----------
    acting : _Acting
    factor : ndarray of complex, shape (axis,)
    density : ndarray, shape (axis, block, band)
        For a factor of 1 [degree2 hour-2 Hz-1 per squared unit].
    """

    acting: _Acting
    factor: NDArray[np.complex128]
    density: Array

    @property
    def own(self) -> Array:
        """On each axis, (axis, block, band) [degree2 hour-2 Hz-1]."""
        return np.asarray(np.abs(self.factor[:, None, None]) ** 2 * self.density)


def _acting(effect: Effect, blocks: xr.Dataset) -> _Acting:
    axes = [str(axis) for axis in blocks["axis"].values]
    rows = [row for row, axis in enumerate(axes) if not effect.axes or axis in effect.axes]
    own = tuple(axes[row] for row in rows)
    return _Acting(effect, rows, own, _explained(effect, blocks, own))


def _leaves_odd_samples(one: _Acting) -> bool:
    return bool({*one.seen.marks} - {_IN_ALL})


def _shows_elsewhere(one: _Acting) -> bool:
    """Whether means, powers and cross-spectra do not hold all that an effect does."""
    seen = one.seen
    elsewhere = (
        seen.marks or not told_in_full(seen) or seen.transfer or seen.order or seen.phase_locked
    )
    return bool(
        elsewhere or not (seen.mean or seen.level or seen.spectrum or seen.response is not None)
    )


def _means(acting: Sequence[_Acting], blocks: xr.Dataset) -> Array:
    """Rates that effects add, (axis, block) [degree hour-1]."""
    mean = np.zeros((blocks.sizes["axis"], blocks.sizes["block"]))
    for one in acting:
        for name, values in one.seen.mean.items():
            mean[one.rows] += _sizes(one.effect, name, one.axes)[:, None] * values
    return mean


def _levels(acting: Sequence[_Acting], square: Array, blocks: xr.Dataset) -> Array:
    """Squared noise coefficients with what effects add to them, (axis, block, noise)."""
    level = np.repeat(square[:, None], blocks.sizes["block"], axis=1)
    for one in acting:
        for (term, name), values in one.seen.level.items():
            own = square[one.rows, None, NOISE.index(term)]
            level[one.rows, :, NOISE.index(term)] += (
                own * _sizes(one.effect, name, one.axes)[:, None] * values
            )
    return level


def _powers(one: _Acting, blocks: xr.Dataset) -> list[_Power]:
    """Power that an effect adds, one for each of its spectra."""
    out, bands = [], blocks.sizes["band"]
    for name, values in one.seen.spectrum.items():
        factor = np.zeros(blocks.sizes["axis"], np.complex128)
        factor[one.rows] = _factors(one.effect, name, one.axes)
        density = np.zeros((factor.size, blocks.sizes["block"], bands))
        peak = _peak(one.effect, name, blocks, one.axes)
        density[one.rows] = (
            values.reshape(*values.shape[:-1], bands, -1).mean(axis=-1)
            if peak is None
            else _over_bands(peak, blocks)
        )
        out.append(_Power(one, factor, density))
    return out


def _response(acting: Sequence[_Acting], blocks: xr.Dataset) -> Array:
    """Share of the power that filters let pass, (axis, 1, band)."""
    response = np.ones((blocks.sizes["axis"], 1, blocks.sizes["band"]))
    for one in acting:
        if one.seen.response is not None:
            response[one.rows] *= band_response(one.effect, blocks)
    return response


def _cross(
    powers: Sequence[_Power], response: Array, blocks: xr.Dataset
) -> NDArray[np.complex128] | None:
    """Cross-spectrum of what the axes share, behind a filter (axis, 1, band), as `Known.cross` has it."""
    if "cross" not in blocks:
        return None
    axes = [str(axis) for axis in blocks["axis"].values]
    pairs = [(axes.index(a), axes.index(b)) for a, b in pair_rows(blocks)]
    shared = np.zeros((len(pairs), blocks.sizes["block"], blocks.sizes["band"]), np.complex128)
    for power in (power for power in powers if power.acting.seen.coherent):
        for number, (one, other) in enumerate(pairs):
            both = power.factor[one] * np.conj(power.factor[other])
            shared[number] += both * np.sqrt(power.density[one] * power.density[other])
    for number, (one, other) in enumerate(pairs):
        shared[number] *= np.sqrt(response[one] * response[other])
    return spread_by_gaps(shared, blocks, "pair") if shared.any() else None


def _wander_squares(one: _Acting, blocks: xr.Dataset) -> dict[str, Array]:
    """Squared sizes of what an effect does to the means at random, (axis,) each."""
    squares = {}
    for name in one.seen.wander:
        squares[name] = np.zeros(blocks.sizes["axis"])
        squares[name][one.rows] = _sizes(one.effect, name, one.axes) ** 2
    return squares


def expect_known_motion(blocks: xr.Dataset, baseline: xr.Dataset) -> NDArray[np.bool_]:
    """Blocks in which what is known of an axis moves far above its noise, (axis, block); none on an axis where that is the usual thing.

    The mean of such a block is known, and what moves inside it is not: its spectrum would be
    compared with that of noise.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
    """
    step = np.abs(np.diff(baseline["known_mean"].transpose("axis", "block").values, axis=1))
    moved = np.maximum(np.pad(step, ((0, 0), (0, 1))), np.pad(step, ((0, 0), (1, 0))))
    noise = baseline["spectrum"].transpose("axis", "block", "band").values[..., 0]
    moving = moved**2 * float(blocks.attrs["block_s"]) > _MOVES * noise
    return np.asarray(moving & (moving.mean(axis=1, keepdims=True) <= _USUAL))


def remove_known_motion(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
    """The record without what blocks say of their inside where what is known of an axis moves: powers, kurtosis, and what axes share there.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
    """
    moving = expect_known_motion(blocks, baseline)
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
    """Lines of effects (with their axes, and their power in the bands), behind a filter (axis, band), as `Known.lines` has them."""
    axes = [str(axis) for axis in blocks["axis"].values]
    frequency, bands = blocks["line_frequency"].values, blocks["frequency"].values
    passed = np.stack([np.interp(np.log(frequency), np.log(bands), one) for one in response])
    steady, most, broad = (np.zeros(passed.shape) for _ in range(3))
    near, own = unspread_share(blocks)[..., None], np.zeros((len(axes), bands.size))
    leak = _leak(int(blocks.attrs["block_samples"]))
    for effect, rows, density in narrow:
        chosen = tuple(axes[row] for row in rows)
        seen = _explained(effect, blocks, chosen, frequency)
        own += (near * density).mean(axis=1) * response
        for name, values in seen.spectrum.items():
            size = np.abs(_factors(effect, name, chosen)[:, None]) ** 2 * values.mean(axis=-2)
            places = 0 if seen.line is None else seen.line.size // blocks.sizes["block"]
            alone = np.count_nonzero(values, axis=-1).max() <= places
            peak = _peak(effect, name, blocks, chosen)
            if peak is not None:
                broad[rows] += (
                    np.abs(_factors(effect, name, chosen)[:, None]) ** 2 * peak * passed[rows]
                )
                continue
            own_leak = leak[1]
            if alone and places == 1 and seen.line is not None and np.ptp(seen.line) == 0.0:
                apart = (
                    float(seen.line.flat[0])
                    - frequency[int(np.argmax(values.reshape(-1, frequency.size)[0]))]
                )
                own_leak = _leak(
                    int(blocks.attrs["block_samples"]), apart * float(blocks.attrs["block_s"])
                )[0]
            for row, one in zip(rows, size * passed[rows], strict=True):
                (steady if alone else broad)[row] += np.convolve(
                    one, own_leak if alone else leak[0], "same"
                )
                most[row] += np.convolve(one, leak[2], "same") if alone else 0.0
    return {"lines": steady, "lines_most": most, "peaks": broad, "line_spectrum": own}


def _peak(effect: Effect, name: str, blocks: xr.Dataset, axes: tuple[str, ...]) -> Array | None:
    """Density of a resonance per squared unit as the taper shows it, (line,): its peak may be narrower than the taper's own width.

    None of an effect that has none.
    """
    if not math.isfinite(getattr(effect, "quality", math.inf)) or "line_frequency" not in blocks:
        return None
    frequency, finer, size = (
        blocks["line_frequency"].values,
        2 * _BETWEEN,
        int(blocks.attrs["block_samples"]),
    )
    fine = frequency[0] / finer * np.arange(1, finer * frequency.size + 1)
    seen = _explained(effect, blocks, axes, fine)
    density = seen.spectrum[name].reshape(-1, fine.size)[0].copy()
    centre = fine.size if seen.line is None else int(np.argmin(np.abs(fine - seen.line.flat[0])))
    inside = (np.arange(_INSIDE_PEAK) + 0.5) / _INSIDE_PEAK - 0.5
    for place in range(
        max(centre - 1, 0), min(centre + 2, fine.size)
    ):  # where the peak may be narrower than the steps of the density
        there = fine[place] + (fine[1] - fine[0]) * inside
        density[place] = (
            _explained(effect, blocks, axes, there)
            .spectrum[name]
            .reshape(-1, inside.size)[0]
            .mean()
        )
    window = np.abs(np.fft.fft(taper(size), size * finer)) ** 2
    reach = min(_REACH, frequency.size // 2) * finer
    window = np.concatenate([window[-reach:], window[: reach + 1]])
    shown = np.convolve(
        np.concatenate([density[::-1], density[:1], density]), window / window.sum(), "same"
    )
    return np.asarray(shown[fine.size + finer :: finer])


def _over_bands(density: Array, blocks: xr.Dataset) -> Array:
    """Mean of every band of a density of all ordinates."""
    edges = band_edges(int(blocks.attrs["block_samples"])) - 1
    return np.asarray(np.add.reduceat(density, edges[:-1]) / np.diff(edges))


def evenness(density: Array, blocks: xr.Dataset) -> Array:
    """Share of the ordinates of a band (axis, band) that scatter by themselves where one of them is louder than others (axis, line)."""
    return np.stack(
        [_over_bands(one, blocks) ** 2 / _over_bands(one**2, blocks) for one in density]
    )


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


def remove_known_lines(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
    """The record with its line spectrum freed of the steady lines that the baseline knows.

    A line is left as it is above what is known of it where it is stronger than the form of an
    effect may be wrong and the noise beside it may do.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
    """
    if "lines" not in baseline:
        return blocks
    power, weight = (
        blocks["line_power"].transpose("axis", "part", "line"),
        blocks["line_weight"].transpose("axis", "part"),
    )
    noise = expected_lines(baseline, blocks["line_frequency"].values)[:, None]
    known, most = (baseline[name].values[:, None] for name in ("lines", "lines_most"))
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = np.sqrt((noise**2 + 2.0 * noise * most) / weight.values[..., None])
    above = power.values - noise - known
    stands = power.values - noise - most > _SIZE_ERROR * most + _CHANCE * scatter
    beside = np.pad(stands, ((0, 0), (0, 0), (LEAK_LINES, LEAK_LINES)))
    stands = np.lib.stride_tricks.sliding_window_view(beside, 2 * LEAK_LINES + 1, axis=-1).any(
        axis=-1
    )  # with what it leaks into
    freed = noise + np.where(stands | (most < _SLIGHT * noise), above, 0.0)
    freed = np.where(known > 0.0, np.maximum(freed, 0.0), power.values)
    return blocks.assign(
        line_power=power.copy(data=np.where(np.isfinite(power.values), freed, np.nan))
    )


def _simulated(model: Model) -> Callable[[Effect], Effect]:
    """Effects as the model simulates them: a filter works at the rate of the model's instrument."""
    instrument = float(model.log.get("oversampling", 1))
    return lambda effect: (
        replace(effect, instrument=instrument) if isinstance(effect, LoggerFilter) else effect
    )


def find_drivers(effect: Effect) -> dict[str, str]:
    """Channel of the effect -> its name in the log."""
    return {role: effect.channel_names()[role] for role in effect.needs()}


def _explained(
    effect: Effect, blocks: xr.Dataset, axes: tuple[str, ...], frequency: Array | None = None
) -> Prediction:
    """What an effect predicts for the record on some of its axes; spectra at many frequencies in each band, since a peak may be narrow."""
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


def _sizes(effect: Effect, name: str, axes: tuple[str, ...]) -> Array:
    """A parameter for each axis."""
    known = {one.name: one for one in effect.parameters()}
    return (
        effect.each(name, axes)
        if known[name].many
        else np.full(len(axes), float(getattr(effect, name)))
    )


def _factors(effect: Effect, name: str, axes: tuple[str, ...]) -> NDArray[np.complex128]:
    """Factor that each axis has of a spectrum: its size, the share of its direction, the phase of a steady line."""
    known = {one.name: one for one in effect.parameters()}
    factor = _sizes(effect, name, axes).astype(np.complex128)
    if "direction" in known:
        factor *= _sizes(effect, "direction", axes)
    if "phase" in known and known["phase"].many:
        factor *= np.exp(1j * np.radians(_sizes(effect, "phase", axes)))
    return factor

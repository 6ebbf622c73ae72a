"""Known lines and resonances of a model in the spectra at full resolution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Floats
from gyrostab.diagnose.evidence.spectral_lines import expected_lines, merge_parts
from gyrostab.diagnose.predict.filter_response import filter_factors
from gyrostab.diagnose.predict.linear_model import (
    average_in_bands,
    unspread_share,
    unspread_share_of_lines,
)
from gyrostab.diagnose.predict.windows import complex_factors, predict_effect
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.spectra.line_levels import LEAK_LINES
from gyrostab.kernels.spectra.periodogram import ordinates, taper
from gyrostab.noise import sampled_psd
from gyrostab.physics.base import Effect

_LEAKAGE_REACH_LINES = 100  # on either side, that a line leaks into; limits time
_PLACES_BETWEEN = 4  # positions of a line on either side of a frequency of the spectrum
_FINER = 2 * _PLACES_BETWEEN  # frequencies for each line
_PEAK_POINTS = 1000  # within a step of a density


class LinePower(NamedTuple):
    """An effect that makes lines."""

    effect: Effect
    rows: list[int]  # of the axes
    power: Floats  # (axis, block, band)


def expect_lines(
    blocks: xr.Dataset, line_powers: Sequence[LinePower], response: Floats
) -> dict[str, Floats]:
    """Return lines of effects after a filter (axis, band), as variables of a baseline."""
    axes = [str(axis) for axis in blocks["axis"].values]
    frequency, bands = blocks["line_frequency"].values, blocks["frequency"].values
    passed = np.stack(
        [np.interp(np.log(frequency), np.log(bands), axis_response) for axis_response in response]
    )
    steady, largest, broad = (np.zeros(passed.shape) for _ in range(3))
    unspread, band_power = unspread_share(blocks)[..., None], np.zeros((len(axes), bands.size))
    block_size = int(blocks.attrs["block_samples"])
    leak, mean_leak, largest_leak = _line_leakage(block_size)
    for effect, rows, density in line_powers:
        chosen = tuple(axes[row] for row in rows)
        prediction = predict_effect(effect, blocks, chosen, frequency)
        band_power += (unspread * density).mean(axis=1) * response
        for name, values in prediction.spectrum.items():
            square = np.abs(complex_factors(effect, name, chosen)[:, None]) ** 2
            size = square * values.mean(axis=-2)
            places = 0 if prediction.line is None else prediction.line.size // blocks.sizes["block"]
            is_line = np.count_nonzero(values, axis=-1).max() <= places
            peak = predict_resonance(effect, name, blocks, chosen)
            if peak is not None:
                broad[rows] += square * peak * passed[rows]
                continue
            own_leak = mean_leak if is_line else leak
            line = prediction.line
            if is_line and line is not None and places == 1 and np.ptp(line) == 0.0:
                nearest = frequency[int(np.argmax(values.reshape(-1, frequency.size)[0]))]
                apart = (float(line.flat[0]) - nearest) * float(blocks.attrs["block_s"])
                own_leak = _line_leakage(block_size, apart)[0]
            for row, power in zip(rows, size * passed[rows], strict=True):
                (steady if is_line else broad)[row] += np.convolve(power, own_leak, "same")
                largest[row] += np.convolve(power, largest_leak, "same") if is_line else 0.0
    return {
        "lines": steady,
        "lines_most": largest,
        "broad_peaks": broad,
        "line_spectrum": band_power,
    }


def predict_resonance(
    effect: Effect, name: str, blocks: xr.Dataset, axes: tuple[str, ...]
) -> Floats | None:
    """Return the tapered density of a resonance per squared unit, (line,); None without resonance.

    Its peak may be narrower than the width of the taper.
    """
    # the quality of aliased vibration is that of a mount, above the frequencies of the record
    if not (hasattr(effect, "frequency") and math.isfinite(getattr(effect, "quality", math.inf))):
        return None
    frequency = blocks["line_frequency"].values
    fine = _between_lines(frequency)
    prediction = predict_effect(effect, blocks, axes, fine)
    density = prediction.spectrum[name].reshape(-1, fine.size)[0].copy()
    line = prediction.line
    centre = fine.size if line is None else int(np.argmin(np.abs(fine - line.flat[0])))
    inside = (np.arange(_PEAK_POINTS) + 0.5) / _PEAK_POINTS - 0.5
    # The peak may be narrower than the steps of the density.
    for place in range(max(centre - 1, 0), min(centre + 2, fine.size)):
        frequencies = fine[place] + (fine[1] - fine[0]) * inside
        finest = predict_effect(effect, blocks, axes, frequencies).spectrum[name]
        density[place] = finest.reshape(-1, inside.size)[0].mean()
    return _average_over_taper(density, int(blocks.attrs["block_samples"]))


def line_factors(effect: Effect, blocks: xr.Dataset) -> Array:
    """Return the factor (line, term) of a filter on the tapered density of Q, N, B and K."""
    frequency, rate = blocks["line_frequency"].values, float(blocks.attrs["sampling_rate_hz"])
    fine = _between_lines(frequency)
    at_lines = slice(_FINER - 1, None, _FINER)
    factors = []
    for symbol, factor in filter_factors(effect, blocks, fine).items():
        if symbol in "QN":  # the filter leaves less of some lines than others leak into them
            density = sampled_psd(symbol, fine, rate)
            tapered = _average_over_taper(density * factor, int(blocks.attrs["block_samples"]))
            factors.append(tapered / density[at_lines])
        else:
            factors.append(factor[at_lines])
    return np.stack(factors, axis=-1)


def _between_lines(frequency: Floats) -> Floats:
    """Return frequencies up to the highest one, `_FINER` for each line."""
    return np.asarray(frequency[0] / _FINER * np.arange(1, _FINER * frequency.size + 1))


def _average_over_taper(density: Floats, size: int) -> Floats:
    """Return the density that the lines of a tapered block of `size` samples have.

    The density is at the frequencies of `_between_lines`.
    """
    window = np.abs(np.fft.fft(taper(size), size * _FINER)) ** 2
    reach = min(_LEAKAGE_REACH_LINES * _FINER, density.size // 2)
    window = np.concatenate([window[-reach:], window[: reach + 1]])
    around = np.concatenate([density[::-1], density[:1], density, density[::-1]])
    tapered = np.convolve(around, window / window.sum(), "same")
    return np.asarray(tapered[density.size + _FINER : 2 * density.size + 1 : _FINER])


def _take_leakage(lines: Array) -> Array:
    """Return each line (..., line) and those that it leaks into, along another dimension."""
    padded = np.pad(lines, [(0, 0)] * (lines.ndim - 1) + [(LEAK_LINES, LEAK_LINES)])
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * LEAK_LINES + 1, axis=-1)


def independent_line_share(density: Floats, blocks: xr.Dataset) -> Floats:
    """Return the equivalent share of independent lines of a band (axis, band).

    It is below 1 if the density (axis, line) is dominated by some lines.
    """
    return average_in_bands(density, blocks) ** 2 / average_in_bands(density**2, blocks)


def _line_leakage(size: int, apart: float = 0.0) -> tuple[Floats, Floats, Floats]:
    """Return the share of a line in the lines around it: at an offset, on average, at most.

    The offset `apart` from the middle line is in lines.
    """
    weights = taper(size)
    reach = min(_LEAKAGE_REACH_LINES, (ordinates(size) - 1) // 2)
    turned = weights * np.exp(2j * np.pi * apart * np.arange(size) / size)
    padded = np.abs(np.fft.fft(turned, size * _FINER)) ** 2 / (size * (weights**2).sum())
    place = np.arange(-reach, reach + 1) * _FINER
    inside = padded[place[:, None] + np.arange(-_PLACES_BETWEEN, _PLACES_BETWEEN + 1)]
    ends = np.array([0.5, *[1.0] * (2 * _PLACES_BETWEEN - 1), 0.5])
    return inside[:, _PLACES_BETWEEN], np.average(inside, axis=1, weights=ends), inside.max(axis=1)


def remove_known_lines(
    blocks: xr.Dataset, baseline: xr.Dataset, *, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Subtract the known steady lines from the line spectrum and from the sines.

    The excess over a known line stays in the parts of the record, as `spectral_line` divides it,
    where it exceeds the model error of an effect and the scatter of the noise.
    """
    if "lines" not in baseline:
        return blocks
    power, weight = blocks["line_power"], blocks["line_weight"]
    noise = expected_lines(baseline, blocks["line_frequency"].values)[:, None]
    without_gaps = [baseline[name].values for name in ("lines", "lines_most")]
    share = unspread_share_of_lines(blocks)[:, None]
    known_power, largest_power = ((share * lines)[:, None] for lines in without_gaps)
    used_weight = np.broadcast_to(np.nan_to_num(weight.values)[..., None], power.shape)
    merged_weight = merge_parts(used_weight)
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = np.sqrt((noise**2 + 2.0 * noise * largest_power) / merged_weight)
        mean_power = merge_parts(np.nan_to_num(power.values) * used_weight) / merged_weight
    above = power.values - noise - known_power
    error = settings.spectrum_error_share
    exceeds = (
        mean_power - noise - largest_power
        > error * largest_power + settings.known_line_sigma * scatter
    )
    exceeds = _take_leakage(exceeds).any(axis=-1)
    exceeds = np.repeat(exceeds, power.sizes["part"] // exceeds.shape[-2], axis=-2)
    freed = noise + np.where(exceeds | (largest_power < error * noise), above, 0.0)
    freed = np.where(known_power > 0.0, np.maximum(freed, 0.0), power.values)
    square, stderr = (blocks[f"sine_square{end}"].values for end in ("", "_stderr"))
    step = float(blocks["line_frequency"][0])
    known_square, largest_square = (
        4.0 * step * _take_leakage(lines).sum(axis=-1) for lines in without_gaps
    )
    exceeds = square - largest_square > error * largest_square + settings.clear_sigma * stderr
    broad = _take_leakage(baseline["broad_peaks"].values).sum(axis=-1)
    in_peak = broad > error * noise[:, 0]
    new = (exceeds | (largest_square == 0.0)) & ~in_peak
    return blocks.assign(
        line_power=power.copy(data=np.where(np.isfinite(power.values), freed, np.nan)),
        sine_nats=blocks["sine_nats"].where(new, -np.inf),
        sine_square=blocks["sine_square"] - known_square,
    )

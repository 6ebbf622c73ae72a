"""What a simulated log has in addition to five noise terms: spectral shape, coherency, lines."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import chdtrc

from gyrostab.diagnose.evidence.spectral_lines import (
    expected_lines,
    line_evidence,
    line_skirt,
)
from gyrostab.diagnose.predict.linear_model import band_widths, unspread_share
from gyrostab.diagnose.reduce.block_statistics import pair_indices
from gyrostab.diagnose.reduce.schema import BASELINE, label_variables
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.spectra.line_levels import local_level

Array = NDArray[np.float64]
_MAX_LINES = 100  # on an axis; limits time
_SMOOTHING_LINES = 5  # over which a peak is smoothed; design choice


class ExtraStatistics(NamedTuple):
    """Stationary statistics of a simulation in addition to its noise terms."""

    form: Array  # (axis, band): its powers over those of the noise terms; 1 on axes that agree
    #: (axis, band): shape of the gamma distribution of `form`; infinite if it is 1.
    form_shape: Array
    coherency: NDArray[np.complex128]  # (pair, band): coherency of the axes; 0 if not significant
    #: (pair, band): standard deviation of its real and imaginary parts; 0 if it is 0.
    coherency_error: Array
    #: (axis, line): power of steady lines, at most, and other power missing in the noise terms
    #: near unexplained bands [degree2 hour-2 Hz-1].
    lines: Array
    lines_most: Array
    peaks: Array


def worst_band(simulated: xr.Dataset, expected: Array, *, min_sigma: float) -> NDArray[np.bool_]:
    """Find the band (axis, band) that differs most from the noise terms, if significantly.

    `expected` (axis, block, band) is the power of the noise terms, with their level over time.
    """
    form, shape = _spectral_form(simulated, expected)
    off = np.abs(form - 1.0) * np.sqrt(shape)
    return np.asarray((off > min_sigma) & (off == off.max(axis=1, keepdims=True)))


def measure_extra_statistics(
    simulated: xr.Dataset,
    expected: Array,
    unexplained: NDArray[np.bool_],
    *,
    settings: Settings = DEFAULTS,
) -> ExtraStatistics:
    """Measure what a simulation has in addition to its noise terms.

    `expected` is as in `worst_band`, `unexplained` (axis, band) are bands that they do not explain.
    """
    form, shape = _spectral_form(simulated, expected)
    # An unexplained band reaches into others.
    measured = unexplained.any(axis=1, keepdims=True)
    form, form_shape = np.where(measured, form, 1.0), np.where(measured, shape, np.inf)
    coherency, error = _measure_coherency(
        simulated, expected * form[:, None], settings.coherency_probability
    )
    return ExtraStatistics(
        form,
        form_shape,
        coherency,
        error,
        *_measure_lines(simulated, expected, unexplained, settings),
    )


def _spectral_form(simulated: xr.Dataset, expected: Array) -> tuple[Array, Array]:
    """Return powers over expected powers, (axis, band), and the shape of their distribution."""
    power, shape = (simulated[name].values for name in ("power", "shape"))
    return _weighted_mean(power / expected, shape)


def _weighted_mean(values: NDArray[Any], shape: Array) -> tuple[NDArray[Any], Array]:
    """Return the mean over the blocks, and the sum of the shapes."""
    good = np.isfinite(values) & np.isfinite(shape) & (shape > 0.0)
    weight = np.where(good, shape, 0.0)
    total = weight.sum(axis=1)
    return (weight * np.where(good, values, 0.0)).sum(axis=1) / np.where(
        total > 0.0, total, 1.0
    ), total


def _measure_coherency(
    simulated: xr.Dataset, expected: Array, p_value: float
) -> tuple[NDArray[np.complex128], Array]:
    """Return the coherency of the axes and its error, 0 if not significant."""
    if "cross" not in simulated:
        return np.zeros((0, expected.shape[2]), np.complex128), np.zeros((0, expected.shape[2]))
    cross, shape = (simulated[name].values for name in ("cross", "cross_shape"))
    first, second = pair_indices(simulated)
    geometric_mean = np.sqrt(expected[first] * expected[second])
    coherency, coherency_shape = _weighted_mean(cross / geometric_mean, shape)
    total = 2.0 * (np.abs(coherency) ** 2 * coherency_shape).sum(axis=1, keepdims=True)
    significant = (coherency_shape > 0.0) & (
        chdtrc(2.0 * (coherency_shape > 0.0).sum(axis=1, keepdims=True), total) < p_value
    )
    with np.errstate(divide="ignore"):
        return np.where(significant, coherency, 0.0), np.where(
            significant, 1.0 / np.sqrt(2.0 * coherency_shape), 0.0
        )


def _measure_lines(
    simulated: xr.Dataset, expected: Array, unexplained: NDArray[np.bool_], settings: Settings
) -> tuple[Array, Array, Array]:
    """Return the power of significant lines and the most it may be, and of unexplained peaks."""
    power, weight = simulated["line_power"].values, simulated["line_weight"].values
    frequency = simulated["line_frequency"].values
    slope = expected_lines(
        xr.Dataset(
            {"spectrum": (("axis", "block", "band"), expected)},
            coords={"axis": simulated["axis"], "frequency": simulated["frequency"]},
        ),
        frequency,
    )
    evidence_nats = line_evidence(power[None], weight, slope)[0]
    lines, largest, peaks = (np.zeros(evidence_nats.shape) for _ in range(3))
    inside, near_unexplained = _lines_in_bands(simulated), unexplained.copy()
    near_unexplained[:, 1:] |= unexplained[:, :-1]
    near_unexplained[:, :-1] |= unexplained[:, 1:]
    for row, axis in enumerate(simulated["axis"].values):
        in_skirt = np.zeros(evidence_nats.shape[1], np.bool_)
        for _ in range(_MAX_LINES):
            place = int(np.argmax(np.where(in_skirt, -np.inf, evidence_nats[row])))
            if in_skirt[place] or not evidence_nats[row, place] > settings.line_nats:
                break
            in_skirt |= line_skirt(simulated, str(axis), place, settings)
        good = (weight[row] > 0.0) & np.isfinite(power[row]).all(axis=1)
        if not good.any():
            continue
        mean = np.average(power[row][good], axis=0, weights=weight[row][good])
        level = np.where(in_skirt, local_level(mean[None])[0], mean)
        lines[row] = np.maximum(mean - level, 0.0)
        if "sine_nats" in simulated:
            weak = (simulated["sine_nats"].values[row] > settings.line_nats) & ~in_skirt
            square, stderr = (
                simulated[f"sine_square{end}"].values[row] / (4.0 * frequency[0])
                for end in ("", "_stderr")
            )
            lines[row] = np.where(weak, square, lines[row])
            largest[row] = np.where(weak, square + settings.clear_sigma * stderr, 0.0)
        largest[row] = np.maximum(largest[row], lines[row])
        smooth = np.convolve(
            np.pad(level, _SMOOTHING_LINES // 2, mode="edge"),
            np.full(_SMOOTHING_LINES, 1.0 / _SMOOTHING_LINES),
            "valid",
        )
        peaks[row] = np.where(inside[near_unexplained[row]].any(axis=0), smooth - slope[row], 0.0)
    return lines, largest, peaks


def _lines_in_bands(blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Return whether a line is in a band, (band, line)."""
    frequency = blocks["line_frequency"].values
    return np.asarray(
        (frequency >= blocks["band_low"].values[:, None])
        & (frequency < blocks["band_high"].values[:, None])
    )


def add_extra_statistics(
    baseline: xr.Dataset, extra: ExtraStatistics, blocks: xr.Dataset
) -> xr.Dataset:
    """Add what null records and statistics need of a simulation to the baseline.

    The spectrum of the baseline includes the form already. Added are ``form_shape(axis, band)``; if
    axes have something in common, ``cross(pair, block, band)`` and ``cross_error(pair, band)``, the
    latter over the root of the powers of both; and with lines the variables that
    `remove_known_lines` reads.
    """
    arrays: dict[str, Any] = {"form_shape": extra.form_shape}
    if extra.coherency.any():
        spectrum, (first, second) = baseline["spectrum"].values, pair_indices(blocks)
        geometric_mean = np.sqrt(spectrum[first] * spectrum[second])
        arrays["cross"] = extra.coherency[:, None] * geometric_mean
        arrays["cross_error"] = extra.coherency_error
    if extra.lines.any() or extra.peaks.any():
        line_power = (
            (extra.lines + extra.peaks)
            @ _lines_in_bands(blocks).T
            * blocks["line_frequency"].values[0]
            / band_widths(blocks)
        )
        arrays["line_spectrum"] = line_power * unspread_share(blocks).mean(axis=1)[:, None]
        arrays |= {"lines": extra.lines, "lines_most": extra.lines_most, "peaks": extra.peaks}
    return baseline.assign(label_variables(arrays, BASELINE))

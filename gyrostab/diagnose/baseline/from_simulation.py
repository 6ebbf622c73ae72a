"""The baseline of a simulated log: noise, its level over time, spectral shape, coherency, lines."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from scipy.ndimage import binary_dilation
from scipy.special import chdtrc

from gyrostab.arrays import Array, Bools, Floats
from gyrostab.diagnose.baseline.assemble import assemble_baseline
from gyrostab.diagnose.baseline.calibrate import calibrate_axes
from gyrostab.diagnose.baseline.expected_statistics import noise_powers, sum_noise
from gyrostab.diagnose.baseline.foreign_bands import MIN_BANDS
from gyrostab.diagnose.baseline.from_model import scale_to_quiescent
from gyrostab.diagnose.baseline.posterior import Posterior
from gyrostab.diagnose.baseline.quiescent import (
    find_quiescent_blocks,
    find_quiescent_spans,
    given_quiescent_blocks,
    significant_level,
)
from gyrostab.diagnose.evidence.spectral_lines import expected_lines, line_evidence, line_skirt
from gyrostab.diagnose.predict.linear_model import (
    average_in_bands,
    unspread_share,
    unspread_share_of_lines,
)
from gyrostab.diagnose.reduce.schema import BASELINE, label_variables, pair_indices, weighted_mean
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.spectra.line_levels import local_level
from gyrostab.kernels.spectra.periodogram import band_edges

_MAX_LINES = 100  # on an axis; limits time
_SMOOTHING_LINES = 5  # over which a peak is smoothed; design choice


def baseline_from_simulation(
    blocks: xr.Dataset, simulated: xr.Dataset, *, quiet: Any = None, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Take the noise of a simulated log with its calibration error, and its level over time.

    Its stationary statistics other than the five noise terms are taken as measured: the shape of
    its spectrum, coherency of axes, steady lines. What a simulation does to the means over time is
    indistinguishable from its random walk and therefore not known; `baseline_from_model` knows it.
    Both have the same blocks and axes (`gyrostab.diagnose.task.read_simulation`).

    Parameters
    ----------
    quiet : (start, end) or several of these, optional
        Quiescent time of the recording: one factor for each axis fits the noise of the simulation
        to it.
    """
    chosen = find_quiescent_blocks(simulated, settings=settings)
    posteriors, level, unexplained = _calibrate_simulation(simulated, chosen, settings)
    squares = [posterior.square for posterior in posteriors]
    plain = sum_noise(noise_powers(simulated), squares) * level[..., None]
    form, form_shape = weighted_mean(
        simulated["power"].values / plain, simulated["shape"].values, axis=1
    )
    # An unexplained band reaches into others.
    is_measured = unexplained.any(axis=1, keepdims=True)
    form, form_shape = np.where(is_measured, form, 1.0), np.where(is_measured, form_shape, np.inf)
    spectrum = sum_noise(noise_powers(blocks), squares) * level[..., None] * form[:, None]
    spans = find_quiescent_spans(simulated, chosen)
    given_blocks = given_quiescent_blocks(blocks, quiet, settings=settings)
    if given_blocks is not None:
        chosen, spans = given_blocks, find_quiescent_spans(blocks, given_blocks)
        posteriors, factor = scale_to_quiescent(
            blocks, posteriors, spectrum, 0.0 * spectrum, chosen
        )
        spectrum = spectrum * factor[:, None, None]
    extra = (
        {"form_shape": form_shape}
        | _shared_statistics(
            simulated, plain * form[:, None], spectrum, settings.coherency_probability
        )
        | _line_statistics(simulated, blocks, plain, unexplained, settings)
    )
    baseline = assemble_baseline(
        blocks,
        posteriors,
        quiescent=chosen,
        attrs={"source": "simulation", "calibrated_on": spans},
        spectrum=spectrum,
        settings=settings,
    )
    return baseline.assign(label_variables(extra, BASELINE))


def _calibrate_simulation(
    simulated: xr.Dataset, chosen: Bools, settings: Settings
) -> tuple[list[Posterior], Floats, Bools]:
    """Calibrate a simulation on the bands that the noise terms explain.

    Returns the noise of every axis, its level over time (axis, block), and the unexplained bands
    (axis, band).
    """
    columns = noise_powers(simulated)
    unexplained = np.zeros((simulated.sizes["axis"], simulated.sizes["band"]), np.bool_)
    while True:
        explained = simulated.assign(
            power=simulated["power"].where(~xr.DataArray(unexplained, dims=("axis", "band")))
        )
        posteriors = calibrate_axes(explained, chosen, settings)
        plain = sum_noise(columns, [posterior.square for posterior in posteriors])
        ratio, shape = explained["power"].values / plain, explained["shape"].values
        level = np.array(
            [significant_level(*axis, settings) for axis in zip(ratio - 1.0, shape, strict=True)]
        )
        form, shape = weighted_mean(
            explained["power"].values / (plain * level[..., None]), shape, axis=1
        )
        off = np.abs(form - 1.0) * np.sqrt(shape)
        is_worst = (off > settings.excess_sigma) & (off == off.max(axis=1, keepdims=True))
        is_enough = unexplained.sum(axis=1, keepdims=True) < unexplained.shape[1] - MIN_BANDS
        newly_unexplained = is_worst & is_enough
        if not newly_unexplained.any():
            return posteriors, level, unexplained
        unexplained |= newly_unexplained


def _shared_statistics(
    simulated: xr.Dataset, expected: Floats, spectrum: Floats, p_value: float
) -> dict[str, Array]:
    """Return the cross-spectrum of the axes and the error of the coherency, where significant.

    `expected` is the power of the simulation (axis, block, band), `spectrum` that of the baseline.
    """
    cross, shape = (simulated[name].values for name in ("cross", "cross_shape"))
    first, second = pair_indices(simulated)
    coherency, coherency_shape = weighted_mean(
        cross / np.sqrt(expected[first] * expected[second]), shape, axis=1
    )
    has_data = coherency_shape > 0.0
    total = 2.0 * (np.abs(coherency) ** 2 * coherency_shape).sum(axis=1, keepdims=True)
    significant = has_data & (chdtrc(2.0 * has_data.sum(axis=1, keepdims=True), total) < p_value)
    coherency = np.where(significant, coherency, 0.0)
    if not coherency.any():
        return {}
    with np.errstate(divide="ignore"):
        error = np.where(significant, 1.0 / np.sqrt(2.0 * coherency_shape), 0.0)
    geometric_mean = np.sqrt(spectrum[first] * spectrum[second])
    return {"cross": coherency[:, None] * geometric_mean, "cross_error": error}


def _line_statistics(
    simulated: xr.Dataset,
    blocks: xr.Dataset,
    expected: Floats,
    unexplained: Bools,
    settings: Settings,
) -> dict[str, Floats]:
    """Return significant lines, the most that they may be, and unexplained peaks, if any.

    `expected` (axis, block, band) is the power of the noise terms in the simulation, with their
    level over time; `unexplained` (axis, band) are bands that they do not explain.
    """
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
    near_unexplained = binary_dilation(unexplained, np.ones((1, 3), np.bool_))
    lines_per_band = np.diff(band_edges(int(simulated.attrs["block_samples"])))
    near_unexplained = np.repeat(near_unexplained, lines_per_band, axis=1)
    share = unspread_share_of_lines(simulated)
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
        lines[row] = np.maximum(mean - level, 0.0) / share[row]
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
        peaks[row] = np.where(near_unexplained[row], smooth - slope[row], 0.0)
    if not (lines.any() or peaks.any()):
        return {}
    in_bands = average_in_bands(lines + peaks, blocks)
    return {
        "lines": lines,
        "lines_most": largest,
        "broad_peaks": peaks,
        "line_spectrum": in_bands * unspread_share(blocks).mean(axis=1)[:, None],
    }

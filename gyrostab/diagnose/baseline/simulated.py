"""What a simulated log shows beside the five noise terms: the form of its spectrum, what its axes share, its steady lines."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.spectral_lines import (
    expected_lines,
    line_evidence,
    line_skirt,
    local_level,
)
from gyrostab.diagnose.predict.linear_model import band_widths, pair_rows, unspread_share

__all__ = ["Shown", "odd_band", "shown_by", "with_shown"]

Array = NDArray[np.float64]
_POWER = "degree2 hour-2 Hz-1"
_SURE = 4.0  # standard deviations beyond which a band is known to differ from the noise terms
_CHANCE = 1e-4  # with which two axes that share nothing are taken to share what they show
_LINE = 12.0  # nats from which on a line is known
_MOST_LINES = 100  # that are looked for on an axis
_SMOOTH = 5  # lines over which a peak is smoothed


class Shown(NamedTuple):
    """What the simulation shows all the time beside its noise terms.

    Attributes
    ----------
    form : ndarray, shape (axis, band)
        Its powers over those of the noise terms; 1 on axes where they agree.
    form_shape : ndarray, shape (axis, band)
        Shape of the gamma distribution of `form`; infinite where it is 1.
    coherency : ndarray of complex, shape (pair, band)
        Of the axes; 0 where chance may do as much.
    coherency_error : ndarray, shape (pair, band)
        Standard deviation of its real and of its imaginary part; 0 where it is 0.
    lines, peaks : ndarray, shape (axis, line)
        Power of steady lines, and of what else the noise terms do not have near the odd bands
        [degree2 hour-2 Hz-1].
    """

    form: Array
    form_shape: Array
    coherency: NDArray[np.complex128]
    coherency_error: Array
    lines: Array
    peaks: Array


def odd_band(simulated: xr.Dataset, expected: Array) -> NDArray[np.bool_]:
    """The band of each axis in which a simulation differs most from its noise terms, (axis, band); none where that may be chance.

    Parameters
    ----------
    simulated : xarray.Dataset
        From `reduce_log`; bands whose powers are missing are passed over.
    expected : ndarray, shape (axis, block, band)
        Power of its noise terms, with their level over time.
    """
    form, known = _form(simulated, expected)
    off = np.abs(form - 1.0) * np.sqrt(known)
    return np.asarray((off > _SURE) & (off == off.max(axis=1, keepdims=True)))


def shown_by(simulated: xr.Dataset, expected: Array, odd: NDArray[np.bool_]) -> Shown:
    """Measure what a simulation shows beside its noise terms.

    Parameters
    ----------
    simulated : xarray.Dataset
        From `reduce_log`.
    expected : ndarray, shape (axis, block, band)
        Power of its noise terms, with their level over time.
    odd : ndarray of bool, shape (axis, band)
        Bands that the noise terms do not explain.
    """
    form, known = _form(simulated, expected)
    measured = odd.any(axis=1, keepdims=True)  # what makes a band odd reaches into others
    form, form_shape = np.where(measured, form, 1.0), np.where(measured, known, np.inf)
    coherency, error = _coherency(simulated, expected * form[:, None])
    return Shown(form, form_shape, coherency, error, *_lines(simulated, expected, odd))


def _form(simulated: xr.Dataset, expected: Array) -> tuple[Array, Array]:
    """Powers over those expected, (axis, band), and the shape of their gamma distribution."""
    power, shape = (
        simulated[name].transpose("axis", "block", "band").values for name in ("power", "shape")
    )
    return _mean(power / expected, shape)


def _mean(values: NDArray[Any], shape: Array) -> tuple[NDArray[Any], Array]:
    """Mean over the blocks, and the sum of the shapes."""
    good = np.isfinite(values) & np.isfinite(shape) & (shape > 0.0)
    weight = np.where(good, shape, 0.0)
    total = weight.sum(axis=1)
    return (weight * np.where(good, values, 0.0)).sum(axis=1) / np.where(
        total > 0.0, total, 1.0
    ), total


def _coherency(simulated: xr.Dataset, expected: Array) -> tuple[NDArray[np.complex128], Array]:
    from scipy.stats import chi2

    if "cross" not in simulated:
        return np.zeros((0, expected.shape[2]), np.complex128), np.zeros((0, expected.shape[2]))
    axes = [str(axis) for axis in simulated["axis"].values]
    cross, shape = (
        simulated[name].transpose("pair", "block", "band").values
        for name in ("cross", "cross_shape")
    )
    pairs = [(axes.index(one), axes.index(other)) for one, other in pair_rows(simulated)]
    both = (
        np.stack([np.sqrt(expected[one] * expected[other]) for one, other in pairs])
        if pairs
        else np.empty(cross.shape)
    )
    found, known = _mean(cross / both, shape)
    total = 2.0 * (np.abs(found) ** 2 * known).sum(axis=1, keepdims=True)
    there = (known > 0.0) & (
        chi2.sf(total, 2.0 * (known > 0.0).sum(axis=1, keepdims=True)) < _CHANCE
    )
    with np.errstate(divide="ignore"):
        return np.where(there, found, 0.0), np.where(there, 1.0 / np.sqrt(2.0 * known), 0.0)


def _lines(simulated: xr.Dataset, expected: Array, odd: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Power of the lines that stand out, with what they leak into; and what else there is near the odd bands, (axis, line)."""
    power, weight = (
        simulated["line_power"].transpose("axis", "part", "line").values,
        simulated["line_weight"].values,
    )
    slope = expected_lines(
        xr.Dataset(
            {"spectrum": (("axis", "block", "band"), expected)},
            coords={"axis": simulated["axis"], "frequency": simulated["frequency"]},
        ),
        simulated["line_frequency"].values,
    )
    evidence_nats = line_evidence(power[None], weight, slope)[0]
    lines, peaks = np.zeros(evidence_nats.shape), np.zeros(evidence_nats.shape)
    inside, near = _inside(simulated), odd.copy()
    near[:, 1:] |= odd[:, :-1]
    near[:, :-1] |= odd[:, 1:]
    for row, axis in enumerate(simulated["axis"].values):
        known = np.zeros(evidence_nats.shape[1], np.bool_)
        for _ in range(_MOST_LINES):
            place = int(np.argmax(np.where(known, -np.inf, evidence_nats[row])))
            if known[place] or not evidence_nats[row, place] > _LINE:
                break
            known |= line_skirt(simulated, str(axis), place)
        good = (weight[row] > 0.0) & np.isfinite(power[row]).all(axis=1)
        if not good.any():
            continue
        mean = np.average(power[row][good], axis=0, weights=weight[row][good])
        level = np.where(known, local_level(mean[None])[0], mean)
        lines[row] = np.maximum(mean - level, 0.0)
        smooth = np.convolve(
            np.pad(level, _SMOOTH // 2, mode="edge"), np.full(_SMOOTH, 1.0 / _SMOOTH), "valid"
        )
        peaks[row] = np.where(inside[near[row]].any(axis=0), smooth - slope[row], 0.0)
    return lines, peaks


def _inside(blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Whether a line lies in a band, (band, line)."""
    frequency = blocks["line_frequency"].values
    return np.asarray(
        (frequency >= blocks["band_low"].values[:, None])
        & (frequency < blocks["band_high"].values[:, None])
    )


def with_shown(baseline: xr.Dataset, shown: Shown, blocks: xr.Dataset) -> xr.Dataset:
    """The baseline, whose spectrum has the form already, with what null records and views ask of the rest.

    Added are ``form_shape(axis, band)``; where axes share something ``cross(pair, block, band)``
    and ``cross_error(pair, band)``, the latter over the root of the powers of both; and where there
    are lines what `without_known_lines` reads.
    """
    out = baseline.assign(
        form_shape=(
            ("axis", "band"),
            shown.form_shape,
            {"long_name": "shape of what the form is known by", "units": "1"},
        )
    )
    if shown.coherency.any():
        axes = [str(axis) for axis in blocks["axis"].values]
        spectrum = baseline["spectrum"].transpose("axis", "block", "band").values
        both = np.stack(
            [
                np.sqrt(spectrum[axes.index(one)] * spectrum[axes.index(other)])
                for one, other in pair_rows(blocks)
            ]
        )
        out["cross"] = (
            ("pair", "block", "band"),
            shown.coherency[:, None] * both,
            {"long_name": "cross-spectrum", "units": _POWER},
        )
        out["cross_error"] = (
            ("pair", "band"),
            shown.coherency_error,
            {"long_name": "error of the coherency", "units": "1"},
        )
    if shown.lines.any() or shown.peaks.any():
        own = (
            (shown.lines + shown.peaks)
            @ _inside(blocks).T
            * blocks["line_frequency"].values[0]
            / band_widths(blocks)
        )
        attrs = {"long_name": "power of lines", "units": _POWER}
        out["line_spectrum"] = (
            ("axis", "band"),
            own * unspread_share(blocks).mean(axis=1)[:, None],
            attrs,
        )
        for name, values in (
            ("lines", shown.lines),
            ("lines_most", shown.lines),
            ("peaks", shown.peaks),
        ):
            out[name] = (("axis", "line"), values, attrs)
    return out

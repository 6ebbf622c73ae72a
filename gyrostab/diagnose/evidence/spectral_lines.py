"""Evidence of spectral lines that exceed the lines on both sides in all parts of a record."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Bools
from gyrostab.diagnose.evidence.folds import FOLDS
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.spectra.line_levels import EDGE_LINES, LEAK_LINES, level_around, local_level

#: Parts of a record in which a steady line, or a steady change of level, is judged. Design choice.
JUDGED_PARTS = 8
_MIN_LEVEL_RATIO = 1e-3  # of the spectrum, that known lines leave; design choice
_MAX_SKIRT_LINES = 40  # design choice
_POWERS_AT_ONCE = 100_000  # of null records; so many fit in the cache of a processor


def expected_lines(baseline: xr.Dataset, frequency: Array) -> Array:
    """Return the expected density (axis, line) at frequencies [Hz], without known steady lines."""
    spectrum = baseline["spectrum"].mean("block").values
    if "line_spectrum" in baseline:
        spectrum = np.maximum(
            spectrum - baseline["line_spectrum"].values, _MIN_LEVEL_RATIO * spectrum
        )
    smooth = interpolate_bands(spectrum, frequency, baseline["frequency"].values)
    if "line_shape" in baseline:
        smooth = smooth * baseline["line_shape"].values
    return smooth + baseline["broad_peaks"].values if "broad_peaks" in baseline else smooth


def interpolate_bands(values: Array, frequency: Array, bands: Array) -> Array:
    """Interpolate positive values (axis, band) at frequencies (axis, line), as powers of both."""
    places, centres = np.log(frequency), np.log(bands)
    return np.stack([np.exp(np.interp(places, centres, np.log(row))) for row in values])


def merge_parts(sums: Array) -> Array:
    """Add up sums (..., part, line) of the parts of a record to those in `JUDGED_PARTS` parts.

    Examples
    --------
    >>> merge_parts(np.ones((16, 3))).shape
    (8, 3)
    """
    *leading, parts, lines = sums.shape
    return np.asarray(
        sums.reshape(*leading, JUDGED_PARTS, parts // JUDGED_PARTS, lines).sum(axis=-2)
    )


def line_evidence(power: Array, weight: Array, expected: Array | None = None) -> Array:
    """Compute the held-out evidence of a steady line, minus the log of the number of lines.

    It is by record, axis, line. The level is that of the surrounding lines in each part of the
    record, and at least that of the adjacent lines on either side, so that slopes and broad humps
    are not lines. The lowest two lines have no lines below them and never count.

    Parameters
    ----------
    power : ndarray, shape (record, axis, part, line)
        Mean periodograms.
    weight : ndarray, shape (axis, part)
        Independent periodograms in each mean.
    expected : ndarray, shape (axis, line), optional
        Density that defines the slope of the level; flat by default.
    """
    usable = (weight > 0) & np.isfinite(power).all(axis=(0, 3))
    share = np.where(usable, weight, 0.0)[..., None]
    slope = np.ones(power.shape[-1]) if expected is None else expected[:, None]
    fold = np.arange(power.shape[2]) % FOLDS
    in_training = (fold != np.arange(FOLDS)[:, None]).astype(float)  # (fold, part)
    evidence_nats = np.empty((*power.shape[:2], power.shape[-1]))
    at_once = max(1, _POWERS_AT_ONCE // power[0].size)
    for first in range(0, len(power), at_once):
        records = slice(first, first + at_once)
        clean = np.where(usable[..., None], power[records] / slope, 1.0)
        level = level_around(clean)
        precision = share / level**2
        total = np.maximum(in_training @ precision, 1e-300)  # by record, axis, fold, line
        square = np.maximum(in_training @ ((clean - level) * precision) / total, 0.0)
        excess = square[:, :, fold] / level
        nats = share * (clean / level * excess / (1.0 + excess) - np.log1p(excess))
        evidence_nats[records] = nats.sum(axis=2)
    evidence_nats[..., :EDGE_LINES] = -np.inf
    return np.asarray(evidence_nats - np.log(power.shape[3]))


def mean_line_power(blocks: xr.Dataset, axis: str) -> tuple[Array, float]:
    """Return the mean periodogram (line,) of the record on an axis, and how many it has."""
    weight, power = (axis_values(blocks, name, axis) for name in ("line_weight", "line_power"))
    good = (weight > 0) & np.isfinite(power).all(axis=1)
    count = float(weight[good].sum())
    return (power[good] * weight[good, None]).sum(axis=0) / max(count, 1e-300), count


def line_skirt(blocks: xr.Dataset, axis: str, place: int, settings: Settings = DEFAULTS) -> Bools:
    """Find the lines that belong to the one at `place`: its leakage and its skirt.

    The skirt extends on both sides until the power falls to the level. A line with a wandering
    phase is wider than the leakage; its slopes are not further lines.
    """
    total, count = mean_line_power(blocks, axis)
    limit = local_level(total) * (1.0 + settings.clear_sigma / np.sqrt(max(count, 1.0)))
    in_skirt = np.abs(np.arange(total.size) - place) <= LEAK_LINES
    for step in (-1, 1):
        line = place + step
        while (
            0 <= line < total.size
            and abs(line - place) <= _MAX_SKIRT_LINES
            and total[line] > limit[line]
        ):
            in_skirt[line] = True
            line += step
    return np.asarray(in_skirt)

"""Whether a quantization grid is that of a rounded rate, or of a rounded angle.

Both have the same grid. Rounding the rate to steps s adds an independent error of variance s^2 / 12
to every sample, which is white. Differences of an angle rounded to steps s dt have errors that the
next sample takes back: the angle quantization Q = s dt / sqrt(12), which raises the power at the
highest frequency by s^2 / 3 divided by the variance of a sample, and which the baseline includes. A
rounded rate is therefore reported if the spectrum rules out the Q of a rounded angle. From n
samples Q^2 is known to about 1 / sqrt(n) of the variance of a sample: with 10^5 of them, a step of
half their scatter is detectable. A grid whose zero bin is two steps wide is that of a rate
truncated towards zero, however fine: an angle has no zero.
"""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Bools, Floats
from gyrostab.diagnose.baseline.posterior import average_blocks, fit_squares
from gyrostab.diagnose.reduce.zero_bin import truncated_axes
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.noise import URAD_PER_S
from gyrostab.units import HOUR

_SERIES_TERMS = 40  # of the correlation series of `angle_share`


def rounded_rates(
    blocks: xr.Dataset, baseline: xr.Dataset, *, settings: Settings = DEFAULTS
) -> Bools:
    """Find the axes (axis,) with a rounded or truncated rate, by the spectrum and the zero bin.

    If the baseline is not calibrated on this record, the record's own noise is estimated.
    """
    step = blocks["quantization_step"].values
    if not (step > 0.0).any():
        return np.zeros(step.shape, np.bool_)
    return np.asarray(
        truncated_axes(blocks) | _rounded_by_spectrum(blocks, baseline, step, settings)
    )


def _rounded_by_spectrum(
    blocks: xr.Dataset, baseline: xr.Dataset, step: Floats, settings: Settings
) -> Bools:
    """Return the axes whose spectrum rules out the Q of an angle grid.

    The Q^2 of a rounded rate is nearer to 0 than to that of a counter of angles, on either side: a
    filter takes more from the highest frequencies.
    """
    if baseline.attrs.get("source") != "calibrated":
        from gyrostab.diagnose.baseline.calibrate import calibrate_noise

        baseline = calibrate_noise(blocks, settings=settings)
    rate = float(blocks.attrs["sampling_rate_hz"])
    white = baseline["square"].sel(noise="N").values * HOUR * rate
    quiescent = baseline["quiet"].values
    share = np.ones(step.size)
    for row, mean in enumerate(blocks["mean"].values):
        good = quiescent[row] & np.isfinite(mean)
        if step[row] > 0.0 and good.any():
            scatter = math.sqrt(white[row]) / step[row]
            share[row] = angle_share(mean[good] / step[row], scatter).mean()
    angle_square = np.where(step > 0.0, share * step**2 / 12.0 / (rate * URAD_PER_S) ** 2, np.nan)
    ratio = _fit_q_square(blocks, baseline) / angle_square
    error = baseline["square_stderr"].sel(noise="Q").values / angle_square
    with np.errstate(divide="ignore", invalid="ignore"):
        is_testable = step**2 / 12.0 > settings.form_error_share * white
        is_testable &= np.isfinite(ratio) & (error > 0.0)
        shortfall = (1.0 - ratio) / error
    if not is_testable.any():
        return is_testable
    weight = error[is_testable] ** -2.0  # one logger writes all axes in one way
    mean_ratio = float(weight @ ratio[is_testable] / weight.sum())
    falls_short = (1.0 - mean_ratio) * np.sqrt(weight.sum()) >= settings.excess_sigma
    if not falls_short or abs(mean_ratio) > settings.majority_share:
        return np.zeros(step.shape, np.bool_)
    return np.asarray(
        is_testable & (ratio < settings.majority_share) & (shortfall > settings.visible_sigma)
    )


def _fit_q_square(blocks: xr.Dataset, baseline: xr.Dataset) -> Floats:
    """Return the Q^2 that fits the quiescent powers best; negative if they fall at the end."""
    out = []
    for number in range(blocks.sizes["axis"]):
        quiescent = baseline["quiet"].values[number]
        power, shape = (blocks[name].values[number][quiescent] for name in ("power", "shape"))
        columns = baseline["columns"].values[number][quiescent]
        bands = average_blocks(power, shape, columns)
        square = fit_squares(bands)[0]
        weight = bands.weight / (bands.columns @ square) ** 2
        used = (square > 0.0) | np.array([True, True, False, False])
        normal = (bands.columns.T * weight) @ bands.columns
        right = (bands.columns.T * weight) @ bands.power
        out.append(
            np.linalg.lstsq(normal[np.ix_(used, used)], right[used], rcond=None)[0][0]
            if bands.power.size
            else np.nan
        )
    return np.array(out)


def angle_share(mean: Array, scatter: float) -> Floats:
    """Return the ratio of the Q^2 of an angle counter to that of independent rounding errors.

    The rounding error is uniform; its correlation from one sample to the next is (6 / pi^2) sum
    exp(-2 (pi n s)^2) cos(2 pi n m) / n^2 for normal increments of mean m and standard deviation s
    [steps].

    Examples
    --------
    >>> angle_share(np.array([0.0, 0.25, 0.5]), 0.0).round(2)
    array([0.02, 1.12, 1.5 ])
    >>> angle_share(np.array([0.0]), 0.5).round(2)
    array([1.])
    """
    n = np.arange(1, _SERIES_TERMS + 1)
    weight = 6.0 / np.pi**2 / n**2 * np.exp(-2.0 * (np.pi * n * scatter) ** 2)
    return np.asarray(
        1.0 - np.cos(2.0 * np.pi * np.multiply.outer(np.asarray(mean, np.float64), n)) @ weight
    )

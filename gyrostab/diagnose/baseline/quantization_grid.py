"""Whether values on a lattice are a rounded rate, or differences of an angle that is counted in steps.

Both stand on the same lattice. Rounding the rate to steps s adds the same error of variance s^2 /
12 to every sample by itself, which is white. Differences of an angle that is rounded to steps s dt
have errors that the next sample takes back: the angle quantization Q = s dt / sqrt(12) of the
noise, which raises the power at the highest frequency by s^2 / 3 over the variance of a sample, and
which the baseline holds. So a rounded rate is claimed where the spectrum rules out the Q that the
lattice would make if it were one of angles. From n samples Q^2 is known to about 1 / sqrt(n) of the
variance of a sample: with 10^5 of them, a step of half their scatter can be told. A lattice whose
cell of zero is two steps wide is one of rates that are cut off towards zero, however fine it is:
angles know no zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.posterior import fit_squares, summed
from gyrostab.diagnose.reduce.zero_bin import truncated_axes
from gyrostab.noise import HOUR, URAD_PER_S

__all__ = ["angle_share", "rounded_rates"]

_SURE, _OWN = (
    4.0,
    2.0,
)  # standard errors by which all axes together, and each by itself, must fall short of the Q of a counter
# of that Q: a rounded rate is nearer to none than to that, on either side; a filter takes more from
# the highest frequencies
_NEAR = 0.5
_SHOWN = 0.01  # of the variance of a sample: the form of the spectrum is not known better
_TERMS = 40


def rounded_rates(blocks: xr.Dataset, baseline: xr.Dataset) -> NDArray[np.bool_]:
    """Axes whose values stand on a lattice because the rate was rounded, as far as the spectrum and the cell of zero can tell.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `gyrostab.diagnose.reduce.block_statistics.reduce_log`.
    baseline : xarray.Dataset
        From `calibrate_noise`; where it is not calibrated on this record, the noise of this record
        is looked up anew.

    Returns
    -------
    ndarray of bool, shape (axis,)
    """
    step = blocks["lattice"].values
    if not (step > 0.0).any():
        return np.zeros(step.shape, np.bool_)
    return np.asarray(truncated_axes(blocks) | _by_spectrum(blocks, baseline, step))


def _by_spectrum(
    blocks: xr.Dataset, baseline: xr.Dataset, step: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Axes of which the spectrum rules out the Q that their lattice would make if it were one of angles."""
    if baseline.attrs.get("source") != "calibrated":
        from gyrostab.diagnose.baseline.calibrate import calibrate_noise

        baseline = calibrate_noise(blocks)
    rate = float(blocks.attrs["sampling_rate_hz"])
    white = baseline["square"].sel(noise="N").values * HOUR * rate
    quiet = baseline["quiet"].transpose("axis", "block").values
    share = np.array(
        [
            _own_share(*row)
            for row in zip(blocks["mean"].values, quiet, step, np.sqrt(white), strict=True)
        ]
    )
    of_angles = np.where(step > 0.0, share * step**2 / 12.0 / (rate * URAD_PER_S) ** 2, np.nan)
    ratio, error = (
        _own_square(blocks, baseline) / of_angles,
        baseline["square_stderr"].sel(noise="Q").values / of_angles,
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        known = (step**2 / 12.0 > _SHOWN * white) & np.isfinite(ratio) & (error > 0.0)
        short = (1.0 - ratio) / error
    if not known.any():
        return known
    weight = error[known] ** -2.0  # one logger writes all axes in one way
    together = float(weight @ ratio[known] / weight.sum())
    if (1.0 - together) * np.sqrt(weight.sum()) < _SURE or abs(together) > _NEAR:
        return np.zeros(step.shape, np.bool_)
    return np.asarray(known & (ratio < _NEAR) & (short > _OWN))


def _own_square(blocks: xr.Dataset, baseline: xr.Dataset) -> NDArray[np.float64]:
    """Square of Q that fits the powers of the quiet blocks best on every axis, less than 0 where these fall towards the end."""
    out = []
    for number in range(blocks.sizes["axis"]):
        quiet = baseline["quiet"].transpose("axis", "block").values[number]
        power, shape = (
            blocks[name].transpose("axis", "block", "band").values[number][quiet]
            for name in ("power", "shape")
        )
        columns = (
            baseline["columns"].transpose("axis", "block", "band", "noise").values[number][quiet]
        )
        fit = summed(power, shape, columns)
        square = fit_squares(fit)[0]
        weight = fit.weight / (fit.columns @ square) ** 2
        used = (square > 0.0) | np.array([True, True, False, False])
        normal = (fit.columns.T * weight) @ fit.columns
        right = (fit.columns.T * weight) @ fit.power
        out.append(
            np.linalg.lstsq(normal[np.ix_(used, used)], right[used], rcond=None)[0][0]
            if fit.power.size
            else np.nan
        )
    return np.array(out)


def _own_share(mean: NDArray[Any], quiet: NDArray[np.bool_], step: float, scatter: float) -> float:
    good = quiet & np.isfinite(mean)
    if not step > 0.0 or not good.any():
        return 1.0
    return float(np.mean(angle_share(mean[good] / step, scatter / step)))


def angle_share(mean: NDArray[Any], scatter: float) -> NDArray[np.float64]:
    """Square of the Q that an angle counter makes, over that of errors which are independent from sample to sample.

    Parameters
    ----------
    mean : ndarray
        Mean increments of the angle [steps].
    scatter : float
        Their standard deviation [steps].

    Notes
    -----
    The error of rounding is uniform; its correlation from one sample to the next is (6 / pi^2) sum
    exp(-2 (pi n s)^2) cos(2 pi n m) / n^2 for normal increments of mean m and standard deviation s.

    Examples
    --------
    >>> angle_share(np.array([0.0, 0.25, 0.5]), 0.0).round(2), angle_share(np.array([0.0]), 0.5).round(2)
    (array([0.02, 1.12, 1.5 ]), array([1.]))
    """
    n = np.arange(1, _TERMS + 1)
    weight = 6.0 / np.pi**2 / n**2 * np.exp(-2.0 * (np.pi * n * scatter) ** 2)
    return np.asarray(
        1.0 - np.cos(2.0 * np.pi * np.multiply.outer(np.asarray(mean, np.float64), n)) @ weight
    )

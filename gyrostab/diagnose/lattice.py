"""Whether values on a lattice are a rounded rate, or differences of an angle that is counted in steps.

Both stand on the same lattice. Rounding the rate to steps s adds the same error of variance s^2 / 12 to every sample by itself, which is
white. Differences of an angle that is rounded to steps s dt have errors that the next sample takes back: the angle quantization
Q = s dt / sqrt(12) of the noise, which the baseline holds. So a rounded rate is claimed only where its white noise is large enough to
be seen, and where the Q that is seen is less than what the lattice would make if it were one of angles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.noise import HOUR, URAD_PER_S

__all__ = ["angle_share", "rounded_rates"]

_SEEN = 3.0  # standard errors
_LESS = 0.5  # of the Q of a lattice of angles: its error is a sawtooth, not white, where the noise is less than a step
_TERMS = 40


def rounded_rates(reduced: xr.Dataset, baseline: xr.Dataset) -> NDArray[np.bool_]:
    """Axes whose values stand on a lattice because the rate was rounded, as far as the spectrum can tell.

    Parameters
    ----------
    reduced : xarray.Dataset
        From `gyrostab.diagnose.reduced.reduce_log`.
    baseline : xarray.Dataset
        From `gyrostab.diagnose.baseline`; where it is not calibrated on this record, the noise of this record is looked up anew.

    Returns
    -------
    ndarray of bool, shape (axis,)
    """
    step = reduced["lattice"].values
    if not (step > 0.0).any():
        return np.zeros(step.shape, np.bool_)
    if baseline.attrs.get("source") != "calibrated":
        from gyrostab.diagnose.baseline import calibrate

        baseline = calibrate(reduced)
    rate = float(reduced.attrs["sampling_rate_hz"])
    Q, N = (baseline["square"].sel(noise=term).values for term in "QN")
    Q_error, N_error = (baseline["square_stderr"].sel(noise=term).values for term in "QN")
    variance = step**2 / 12.0
    of_angles = variance / (rate * URAD_PER_S) ** 2
    seen = variance / (HOUR * rate) > _SEEN * N_error
    quiet = baseline["quiet"].transpose("axis", "block").values
    share = np.array([_own_share(*row) for row in zip(reduced["mean"].values, quiet, step, np.sqrt(N * HOUR * rate), strict=True)])
    return np.asarray((step > 0.0) & seen & (Q + _SEEN * Q_error < _LESS * share * of_angles))


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
    The error of rounding is uniform; its correlation from one sample to the next is
    (6 / pi^2) sum exp(-2 (pi n s)^2) cos(2 pi n m) / n^2 for normal increments of mean m and standard deviation s.

    Examples
    --------
    >>> angle_share(np.array([0.0, 0.25, 0.5]), 0.0).round(2), angle_share(np.array([0.0]), 0.5).round(2)
    (array([0.02, 1.12, 1.5 ]), array([1.]))
    """
    n = np.arange(1, _TERMS + 1)
    weight = 6.0 / np.pi**2 / n**2 * np.exp(-2.0 * (np.pi * n * scatter) ** 2)
    return np.asarray(1.0 - np.cos(2.0 * np.pi * np.multiply.outer(np.asarray(mean, np.float64), n)) @ weight)

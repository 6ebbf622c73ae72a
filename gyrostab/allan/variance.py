"""What a unit of each noise term gives in the variance of a surface, and how it scatters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.allan.pairs import white_pair_sum
from gyrostab.kernels.allan.variances import VARIANCES
from gyrostab.kernels.fit.covariance import third_columns
from gyrostab.noise import avar_columns, sample_squares

if TYPE_CHECKING:
    import xarray as xr


def variance_columns(variance: str, ks: Ints, rate: float) -> Floats:
    """Compute the design matrix of the five-term model: the variance per squared coefficient.

    Parameters
    ----------
    variance : str
        One of `gyrostab.kernels.allan.variances.VARIANCES`.
    ks : int64 (n_tau,)
        Averaging factors.
    rate : float
        Sampling rate [Hz].

    Returns
    -------
    ndarray (n_tau, 5)
        As `gyrostab.noise.avar_columns`; the Hadamard variance does not see a ramp.
    """
    if variance == "avar":
        return avar_columns(ks / rate)
    return third_columns(variance, ks) * sample_squares(rate)


def white_freedoms(variance: str, window: int, ks: Ints, pairs: Floats) -> Floats:
    """Compute the degrees of freedom under white noise, (n_tau,).

    `pairs` (4, 4, n_tau) holds the variance of each cell per product of squares, see
    `gyrostab.kernels.fit.covariance.product_tables`.
    """
    if variance == "avar":
        terms = window - 2 * ks + 1
        return np.array([n**2 / white_pair_sum(n, k) for n, k in zip(terms, ks, strict=True)])
    return np.asarray(2.0 * third_columns(variance, ks)[:, 1] ** 2 / pairs[1, 1])


def variance_name(surface: xr.Dataset) -> str:
    """Name the variance of a surface: Allan, Hadamard or modified Allan."""
    return VARIANCES[surface.attrs.get("variance", "avar")].text


def surface_columns(surface: xr.Dataset) -> Floats:
    """Compute the `variance_columns` of the averaging times of a surface, (n_tau, 5)."""
    rate = float(surface.attrs["sampling_rate_hz"])
    ks = np.rint(np.asarray(surface["tau"].values) * rate).astype(np.int64)
    return variance_columns(surface.attrs.get("variance", "avar"), ks, rate)

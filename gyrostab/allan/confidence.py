"""Confidence intervals of the Allan variance from its equivalent degrees of freedom."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.allan.variance import variance_name
from gyrostab.errors import OptionError
from gyrostab.schema import check_surface


def confidence_interval(surface: xr.Dataset, *, level: float = 0.95) -> xr.Dataset:
    """Compute the confidence interval of the Allan variance of each cell.

    ``edf * avar / true`` is taken as chi-square distributed with ``edf`` degrees of freedom. In
    windows with gaps the true value is the law times its response to the gaps (``white_response``,
    ``quantization_response``, ``ramp_response``).

    Parameters
    ----------
    surface : xarray.Dataset
        Surface or product with ``avar`` [degree2 hour-2] and ``edf``.
    level : float
        Confidence level, between 0 and 1.

    Returns
    -------
    xarray.Dataset
        ``avar_lower, avar_upper (axis, time, tau)`` [degree2 hour-2]; NaN where there is no
        estimate; dask if `surface` is.

    Raises
    ------
    SchemaError
        If `surface` is not a surface.
    OptionError
        If `level` is not between 0 and 1.

    References
    ----------
    IEEE Std 1139-2008, annex; Greenhall and Riley, PTTI 2003.

    Examples
    --------
    >>> from gyrostab.allan.davar import davar
    >>> from gyrostab.ingest.make_log import make_log
    >>> noise = np.random.default_rng(1).standard_normal(6000)
    >>> surface = davar(make_log(noise, rate=100.0, unit="deg/h"), window="60s", taus=[1.0])
    >>> limits = confidence_interval(surface)
    >>> bool((limits.avar_lower < 0.01) & (0.01 < limits.avar_upper))
    True
    """
    check_surface(surface)
    if not 0.0 < level < 1.0:
        raise OptionError(f"level={level!r}: give a probability between 0 and 1, such as 0.95")
    out = xr.Dataset()
    for name, side, end in (
        ("avar_lower", 0.5 + level / 2, "lower"),
        ("avar_upper", 0.5 - level / 2, "upper"),
    ):
        limit = xr.apply_ufunc(
            _interval_limit,
            surface["avar"],
            surface["edf"],
            side,
            dask="parallelized",
            output_dtypes=[np.float64],
            keep_attrs=False,
        )
        out[name] = limit.assign_attrs(
            units=surface["avar"].attrs["units"],
            long_name=f"{end} end of the {100 * level:g} % interval of the "
            f"{variance_name(surface)} variance",
        )
    return out


def _interval_limit(avar: NDArray[np.float64], edf: NDArray[np.float64], side: float) -> Any:
    from scipy.special import gammaincinv

    with np.errstate(divide="ignore", invalid="ignore"):
        quantile = 2.0 * gammaincinv(edf / 2.0, side)  # of chi-square
        return np.where(edf > 0, edf * avar / quantile, np.nan)

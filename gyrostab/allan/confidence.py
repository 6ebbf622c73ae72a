"""Confidence intervals of the Allan variance from its equivalent degrees of freedom."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from gyrostab.allan.variance import variance_name
from gyrostab.errors import OptionError
from gyrostab.schema import check_surface, with_axis


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
    surface = with_axis(surface)
    check_surface(surface)
    if not (isinstance(level, int | float | np.number) and 0.0 < level < 1.0):
        raise OptionError(f"level={level!r}: give a probability between 0 and 1, such as 0.95")
    limits = xr.apply_ufunc(
        interval_limits,
        surface["avar"],
        surface["edf"],
        level,
        output_core_dims=[[], []],
        dask="parallelized",
        output_dtypes=[np.float64, np.float64],
        keep_attrs=False,
    )
    interval = f"the {100 * level:g} % interval of the {variance_name(surface)} variance"
    return xr.Dataset(
        {
            f"avar_{end}": limit.assign_attrs(
                units=surface["avar"].attrs["units"], long_name=f"{end} end of {interval}"
            )
            for end, limit in zip(("lower", "upper"), limits, strict=True)
        }
    )


def interval_limits(avar: Any, edf: Any, level: float = 0.95) -> tuple[Any, Any]:
    """Compute the ends of the interval of a variance that is chi-square distributed.

    Parameters
    ----------
    avar : array_like
        Allan variance, any unit.
    edf : array_like
        Equivalent degrees of freedom [1].
    level : float
        Probability that the interval holds the true value.

    Returns
    -------
    low, high : ndarray
        In the unit of `avar`; NaN without degrees of freedom.

    Examples
    --------
    >>> low, high = interval_limits(1.0, 10.0)
    >>> round(float(low), 3), round(float(high), 3)
    (0.488, 3.08)
    """
    from scipy.special import gammaincinv

    avar, edf = np.asarray(avar, dtype=np.float64), np.asarray(edf, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return tuple(
            np.where(edf > 0, edf * avar / (2.0 * gammaincinv(edf / 2.0, side)), np.nan)
            for side in (0.5 + level / 2, 0.5 - level / 2)
        )  # type: ignore[return-value]

"""Fit of Q, N, B, K and R to every window of a surface, with errors, limits and observability."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import dask.array as da
import numpy as np
import xarray as xr

from gyrostab.allan.band_limit import BandLimit, choose_windows, filter_response, find_band_limit
from gyrostab.allan.fit_inputs import FIT_VARIABLES, prepare_fit, resolve_fit_options, term_bits
from gyrostab.allan.window_fit import fit_block
from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.fit.covariance import STOCHASTIC
from gyrostab.noise import TERMS
from gyrostab.schema import attributes, with_axis

#: Band limit of each axis, by its name.
Bands = Mapping[str, tuple[float, ...]]


def fit_noise(
    surface: xr.Dataset,
    *,
    terms: str | Iterable[str] = "QNBKR",
    tau_min: Any = None,
    tau_max: Any = None,
    observed_only: bool = True,
) -> xr.Dataset:
    """Fit the five-term noise model to every window of a surface.

    The Allan variance is linear in the squared coefficients,

        avar(tau) = 3 Q^2 / tau^2 + N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 + R^2 tau^2 / 2,

    so they follow from non-negative generalised least squares, averaged over the submodels of Q,
    N, B and K with their likelihoods as weights. R is the trend of the window. The covariance
    between averaging times (overlapping estimates share data) is computed from the fitted noise, by
    iteration. Where gaps required weighted cluster means, the columns of Q, N and R are predicted
    from the mask.

    Parameters
    ----------
    surface : xarray.Dataset
        Surface of `gyrostab.davar`, or some of its axes, windows or averaging times. A lazy surface
        stays lazy; only the search for a filter computes parts of it.
    terms : str or iterable of str
        Terms to fit, a selection of Q, N, B, K, R; the others are taken as zero.
    tau_min, tau_max : float or str, optional
        Averaging times to fit [s]. By default all, but of a sensor with a filter those that are
        longer than the memory of the filter, whose effect on white noise is taken into account; up
        to 24 windows are computed at once to find it (``docs/method.md``). With a number, or
        ``"all"``, no filter is sought: start above effects that are not noise, such as a spectral
        line or resets of the feedback.
    observed_only : bool
        Give a coefficient and its standard error only where the term is observed, a limit only
        where it is not, and NaN elsewhere. With False they are given for every window, for the
        fitted curve or to study the estimator; a submodel without the term counts as zero where
        the term is not observed.

    Returns
    -------
    xarray.Dataset
        The surface, and per ``(axis, time)``: ``Q`` [urad], ``N`` [deg/sqrt(h)], ``B`` [deg/h],
        ``K`` [deg/h^1.5], ``R`` [deg/h^2], ``*_stderr``, ``*_upper`` (95 % upper limit where the
        term is not observed), ``N_squared, K_squared``, ``fit_chi2``, ``fit_dof``;
        ``observable(axis, time, term)``: 0 not observable, 1 upper limit only, 2 observed (noise
        without the term would do that in 1 % of windows, at most 3 %). No term is observed in a
        window that the five terms do not describe (``docs/method.md``). ``edf`` is that of the
        fitted noise if all averaging times are fitted, else (with more than 48 of them, or with
        `tau_min` or `tau_max`) that of the surface. Per axis: ``fit_tau_min``, the shortest
        averaging time of the fit [s], and ``filter_time_constant`` [s], 0 if no filter was found;
        with a filter, Q is not observable.

    Raises
    ------
    OptionError
        If a term is unknown, or no averaging time lies between `tau_min` and `tau_max`.
    SchemaError
        If `surface` is not a surface.

    References
    ----------
    IEEE Std 952-1997, annex C.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> # 6 deg/h at 100 Hz: N = 0.6 / 60 deg/sqrt(h)
    >>> noise = 6.0 * np.random.default_rng(1).standard_normal(60_000)
    >>> from gyrostab.allan.davar import davar
    >>> product = fit_noise(davar(make_log(noise, rate=100.0, unit="deg/h"), window="1min"))
    >>> round(float(product.N.mean()), 3)
    0.01
    """
    options = {"terms": terms, "tau_min": tau_min, "tau_max": tau_max}
    return _fit_checked(surface, **options, observed_only=observed_only)


def refit(product: xr.Dataset, **options: Any) -> xr.Dataset:
    """Fit the windows of a product again, with estimates of all terms, observed or not.

    Parameters
    ----------
    product : xarray.Dataset
        Product of `fit_noise`, or some of its windows.
    **options
        Options of `fit_noise` that differ from those of the product. A product without the trend
        of each window, as earlier versions wrote them, is fitted without R.

    Returns
    -------
    xarray.Dataset
        As from ``fit_noise(..., observed_only=False)``: the coefficients of the fitted curve.

    Examples
    --------
    >>> from gyrostab.allan.davar import davar
    >>> from gyrostab.ingest.make_log import make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(60_000), rate=100.0, unit="deg/h")
    >>> product = fit_noise(davar(log, window="1min"), terms="NB")
    >>> bool(product.B.isnull().any()), bool(refit(product).B.isnull().any())
    (True, False)
    """
    option_attributes = {
        "terms": "fit_terms",
        "tau_min": "fit_tau_min_s",
        "tau_max": "fit_tau_max_s",
    }
    stored_options = {
        name: product.attrs[attribute]
        for name, attribute in option_attributes.items()
        if attribute in product.attrs
    }
    if "fit_tau_min" in product and "tau_min" not in options:
        stored = [product[name].values for name in _BAND_VARIABLES if name in product]
        axes = map(str, product["axis"].values)
        stored_options["bands"] = dict(zip(axes, zip(*stored, strict=True), strict=True))
    if "window_trend" not in product:  # of an earlier version: without the ramp
        none = xr.zeros_like(product["window_mean"])
        product = product.assign(window_trend=none, trend_response=none)
        stored_options["terms"] = str(stored_options.get("terms", "QNBK")).replace("R", "")
    return _fit_checked(product, **{**stored_options, "observed_only": False, **options})


def fit_part(surface: xr.Dataset, **options: Any) -> xr.Dataset:
    """Fit a part of a surface, immediately and in the calling thread.

    Parameters
    ----------
    surface : xarray.Dataset
        Surface of `gyrostab.allan.davar.davar_part`.
    **options
        Options of `fit_noise`, and ``bands`` as from `find_band_limits`; without it, the filter is
        sought in this part.

    Returns
    -------
    xarray.Dataset
        As from `fit_noise`, bit for bit.

    Examples
    --------
    >>> from gyrostab.allan.davar import davar_part
    >>> from gyrostab.ingest.make_log import make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(60_000), rate=100.0, unit="deg/h")
    >>> surface = davar_part(log, part=slice(0, 4), window="1min")
    >>> fit_part(surface, terms="NK").equals(fit_noise(surface, terms="NK"))
    True
    """
    return _fit_checked(surface, **options, immediate=True)


def _fit_checked(
    surface: xr.Dataset,
    *,
    terms: str | Iterable[str] = "QNBKR",
    tau_min: Any = None,
    tau_max: Any = None,
    observed_only: bool = True,
    immediate: bool = False,
    bands: Bands | None = None,
) -> xr.Dataset:
    surface = with_axis(surface)
    fitted_terms, chosen = resolve_fit_options(surface, terms, tau_min, tau_max)
    if bands is None:
        bands = find_band_limits(surface, terms=fitted_terms, tau_min=tau_min, tau_max=tau_max)
    limits = [BandLimit(*bands[str(axis)]) for axis in surface["axis"].values]
    product = _fit_windows(
        surface,
        term_bits(fitted_terms),
        chosen,
        limits,
        immediate=immediate,
        observed_only=observed_only,
    )
    band_variables = {
        name: ("axis", np.array(values), attributes(name))
        for name, values in zip(_BAND_VARIABLES, zip(*limits, strict=True), strict=True)
    }
    return product.assign(band_variables).assign_attrs(
        fit_terms="".join(fitted_terms),
        fit_tau_min_s=min(limit.tau_min for limit in limits),
        fit_tau_max_s=surface["tau"].values[chosen[-1]],
    )


#: Product variables of the fields of a `BandLimit`.
_BAND_VARIABLES = ("fit_tau_min", "filter_time_constant", "filter_white_error")


def find_band_limits(
    surface: xr.Dataset,
    *,
    terms: str | Iterable[str] = "QNBKR",
    tau_min: Any = None,
    tau_max: Any = None,
) -> Bands:
    """Find the band limit of each axis of a surface, as `fit_noise` does.

    Parameters
    ----------
    surface : xarray.Dataset
        Surface of `gyrostab.davar`, or windows of it that are spread over the record.
    terms, tau_min, tau_max
        Options of `fit_noise`. With `tau_min`, that is the shortest averaging time, without a
        filter, which is also not sought in Hadamard and modified Allan variances.

    Returns
    -------
    dict
        Axis to shortest averaging time to fit [s], time constant of the filter [s], and relative
        standard error of N by that of the time constant [1].

    Examples
    --------
    >>> from gyrostab.allan.davar import davar
    >>> from gyrostab.ingest.make_log import make_log
    >>> noise = np.random.default_rng(1).standard_normal(60_000)
    >>> smooth = np.convolve(noise, np.ones(9) / 9, mode="valid")  # time constant 80 / 27 samples
    >>> find_band_limits(davar(make_log(smooth, rate=100.0, unit="deg/h"), window="1min"))
    {'x': BandLimit(tau_min=0.13, time_constant=0.0292, white_error=0.0122)}
    """
    fitted_terms, chosen = resolve_fit_options(surface, terms, tau_min, tau_max)
    tau, axes = surface["tau"].values, list(map(str, surface["axis"].values))
    allan = surface.attrs.get("variance", "avar") == "avar"
    if tau_min is not None or not allan:
        return {axis: BandLimit(float(tau[chosen[0]]), 0.0) for axis in axes}
    window = int(surface.attrs.get("window_samples", 1))
    step = int(surface.attrs.get("step_samples", window))
    part = surface[[name for name in (*FIT_VARIABLES, "difference_trend") if name in surface]]
    part = part.isel(time=choose_windows(part.sizes["time"], window, step)).compute()
    cells, tables, chosen = prepare_fit(part, chosen, term_bits(fitted_terms))
    return {
        axis: find_band_limit(
            tau[chosen],
            [cell[row][:, chosen] for cell in cells[:5]],
            cells[5][row, :, 0],
            np.stack([cell[row, :, 0] for cell in cells[6:10]], axis=-1),
            allowed=term_bits(fitted_terms),
            tables=tables,
        )
        for row, axis in enumerate(axes)
    }


def _fit_windows(
    surface: xr.Dataset,
    allowed: int,
    within: Ints,
    limits: list[BandLimit],
    *,
    immediate: bool,
    observed_only: bool,
) -> xr.Dataset:
    if surface.attrs.get("variance") == "hadamard":  # which does not see a ramp
        allowed &= ~(1 << STOCHASTIC)
    cells, tables, chosen = prepare_fit(surface, within, allowed)
    tau = surface["tau"].values
    tau_min, constant, error = (
        np.array(values)[:, None, None] for values in zip(*limits, strict=True)
    )
    below = tau < tau_min * (1 - 1e-9)
    if (constant > 0).any():
        cells[0] = np.where(below, np.nan, cells[0])
        cells[1] = cells[1] * filter_response(tau, constant)
    cells += [np.broadcast_to(values, cells[-1].shape) for values in (constant, error)]

    width = len(TERMS) * 4 + 2 + chosen.size
    fit_cells = partial(
        _fit_cells,
        chosen=chosen,
        tables=tables,
        width=width,
        allowed=allowed,
        observed_only=observed_only,
    )
    fitted = fit_cells(*cells) if immediate else _map_blocks(fit_cells, cells, width)
    out = _label_fit(fitted)
    # otherwise that of davar is kept, for every averaging time and from more of them
    if surface.sizes["tau"] == chosen.size > allowed.bit_count():
        edf = np.where(below, surface["edf"].data, fitted[..., 4 * len(TERMS) + 2 :])
        out["edf"] = (("axis", "time", "tau"), edf, surface["edf"].attrs)
    return surface.drop_dims("term", errors="ignore").assign(out)  # of an earlier fit


def _fit_cells(
    *arrays: Floats,
    chosen: Ints,
    tables: Any,
    width: int,
    allowed: int,
    observed_only: bool,
) -> Floats:
    """Fit windows (axis, time), with or without a filter; the results have the size `width`."""
    flat = [
        np.ascontiguousarray(a[..., chosen].reshape(-1, chosen.size), dtype=np.float64)
        for a in arrays[:5]
    ]
    trend, *shares, exact, filtered, white_error = (
        np.asarray(a, dtype=np.float64).reshape(-1) for a in arrays[5:]
    )
    responses = np.stack(shares, axis=-1)
    fitted = np.empty((filtered.size, width))
    for rows, terms in ((filtered == 0, allowed), (filtered > 0, allowed & ~term_bits("Q"))):
        if rows.any():
            fitted[rows] = fit_block(
                [a[rows] for a in flat],
                trend[rows],
                responses[rows],
                exact[rows],
                tables,
                white_error=white_error[rows],
                allowed=terms,
                observed_only=observed_only,
            )
    return fitted.reshape(*arrays[0].shape[:2], width)


def _map_blocks(fit_cells: Callable[..., Floats], cells: list[Any], width: int) -> Any:
    """Fit the cells block by block; lazily if they are lazy."""
    lazy = isinstance(cells[0], da.Array)
    chunks = (*cells[0].chunks[:2], -1) if lazy else (1, 256, -1)
    chunked = [
        cell.rechunk(chunks) if isinstance(cell, da.Array) else da.from_array(cell, chunks)
        for cell in cells
    ]
    fitted = da.map_blocks(
        fit_cells,
        *chunked,
        chunks=(*chunked[0].chunks[:2], (width,)),
        meta=np.empty((0, 0, 0)),  # without it, dask calls the function with empty arrays
    )
    return fitted if lazy else fitted.compute()


def _label_fit(fitted: Any) -> dict[str, Any]:
    """Make the variables of a fit from the results of `fit_block` (axis, time, result)."""
    n = len(TERMS)
    plane = ("axis", "time")
    out: dict[str, Any] = {}
    for i, symbol in enumerate(TERMS):
        for part, end in enumerate(("", "_stderr", "_upper")):
            out[f"{symbol}{end}"] = (plane, fitted[..., part * n + i])
        if symbol in "NK":
            out[f"{symbol}_squared"] = (plane, fitted[..., i] ** 2)
    out["observable"] = ((*plane, "term"), fitted[..., 3 * n : 4 * n].astype(np.int8))
    out |= {"fit_chi2": (plane, fitted[..., 4 * n]), "fit_dof": (plane, fitted[..., 4 * n + 1])}
    out["term"] = ("term", list(TERMS))
    return {name: (*variable, attributes(name)) for name, variable in out.items()}

"""All the figures of a product, as files."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from gyrostab.correlate import correlate
from gyrostab.errors import OptionError
from gyrostab.plot.adev import plot_adev
from gyrostab.plot.coefficients import plot_coefficients
from gyrostab.plot.correlation import plot_correlation
from gyrostab.plot.style import PAGE_MM, axis_names, save_png
from gyrostab.plot.surface import plot_davar, plot_davar_3d
from gyrostab.schema import check_product, with_axis
from gyrostab.store.output import check_folder, new_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def product_figures(
    product: xr.Dataset, *, width: float = PAGE_MM
) -> dict[str, Callable[[], Figure]]:
    """List the figures of a product by name, as functions that draw them in a width [mm].

    They are ``coefficients``, ``davar``, ``davar_change``, ``temperature`` if the product holds
    values of one, and for each axis ``adev_<axis>`` and ``davar_3d_<axis>`` (the latter only with
    at least two windows and two averaging times).
    """
    product = with_axis(product)
    check_product(product)
    figures: dict[str, Callable[..., Figure]] = {
        "coefficients": partial(plot_coefficients, product),
        "davar": partial(plot_davar, product),
        "davar_change": partial(plot_davar, product, relative=True),
    }
    temperature = product.get("temperature", xr.DataArray(np.nan))
    if temperature.dims == ("time",) and np.isfinite(temperature).any():
        figures["temperature"] = partial(_plot_temperature, product)
    for axis in axis_names(product):
        figures[f"adev_{axis}"] = partial(plot_adev, product, axis)
        if min(product.sizes["time"], product.sizes["tau"]) > 1:
            figures[f"davar_3d_{axis}"] = partial(plot_davar_3d, product, axis=axis)
    return {name: partial(draw, width=width) for name, draw in figures.items()}


def _plot_temperature(product: xr.Dataset, *, width: float) -> Figure:
    """Draw the correlation with temperature: that of the product, or a new one."""
    drivers = product["driver"].values if "driver" in product.coords else ()
    correlation = product if "temperature" in drivers else correlate(product)
    return plot_correlation(correlation, driver="temperature", width=width)


def save_figures(
    product: xr.Dataset,
    folder: str | os.PathLike[str],
    *,
    width: float = PAGE_MM,
    dpi: int = 300,
    overwrite: bool = False,
) -> list[Path]:
    """Write all figures of a product into a folder, as PNG files.

    Parameters
    ----------
    product : xarray.Dataset
        What `gyrostab.fit_noise` returns or `gyrostab.open_product` opens.
    folder : path-like
        Folder to write to; created if it does not exist.
    width : float
        Width of the figures [mm]: 180 for a page, 85 for a column.
    dpi : int
        Pixels per inch.
    overwrite : bool
        Replace figures that exist.

    Returns
    -------
    list of pathlib.Path
        Files, named as in `product_figures`. Names that no file can have, or that differ only by
        case, get underscores.

    Raises
    ------
    SchemaError, OptionError
        If `product` is not a product, or `width` or `dpi` are impossible.
    OutputError
        If a figure exists and `overwrite` is False, or the folder cannot be written to; then no
        figure is written.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from gyrostab import davar, fit_noise, make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> product = fit_noise(davar(log, window="20s"))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in save_figures(product, folder, dpi=30)]
    ['coefficients.png', 'davar.png', 'davar_change.png', 'adev_x.png', 'davar_3d_x.png']
    """
    if not (isinstance(dpi, int | float | np.number) and dpi > 0):
        raise OptionError(f"dpi={dpi!r}: give pixels per inch, above 0, for instance 300")
    folder = Path(folder)
    figures: dict[str, Callable[[], Figure]] = {}
    for name, draw in product_figures(product, width=width).items():
        stem = re.sub(r"[^\w.-]", "_", name)
        while f"{stem}.png".casefold() in map(str.casefold, figures):
            stem += "_"
        figures[f"{stem}.png"] = draw
    check_folder(folder, figures, overwrite=overwrite)
    with new_folder(folder, overwrite=overwrite) as temporary:
        for name, draw in figures.items():
            save_png(draw(), temporary / name, dpi=dpi)
    return [folder / name for name in figures]

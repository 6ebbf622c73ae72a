"""Write the windows of a product as one CSV table, for spreadsheets."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.noise import LAWS
from gyrostab.schema import check_product
from gyrostab.store.output import new_output


def to_csv(product: xr.Dataset, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Write a product as a CSV table with a row for each window and axis.

    Parameters
    ----------
    product : xarray.Dataset
        What `gyrostab.fit_noise` or `gyrostab.open_product` returns.
    path : path
        File to write.
    overwrite : bool
        Replace an existing file.

    Returns
    -------
    Path
        The file. Its columns are ``time`` (centre of the window, UTC), ``axis``, ``window_mean``,
        each coefficient with its error (``N_stderr``) and 95 % upper limit (``N_upper``), and the
        channels, with units in square brackets. Missing values are empty cells.

    Raises
    ------
    OutputError, SchemaError
        When the file exists or cannot be written, or `product` is not a product.
    """
    check_product(product)
    units = {name: law.label for name, law in LAWS.items()}
    units |= {f"{name}_{end}": units[name] for name in LAWS for end in ("stderr", "upper")}
    names = ["window_mean", *(f"{name}{end}" for name in LAWS for end in ("", "_stderr", "_upper"))]
    names += [str(name) for name, part in product.data_vars.items() if part.dims == ("time",)]
    table = pd.DataFrame(
        {
            "time": np.repeat(product["time"].values, product.sizes["axis"]),
            "axis": np.tile(product["axis"].values, product.sizes["time"]),
        }
    )
    for name in names:
        unit = units.get(name) or str(product[name].attrs.get("units", "1"))
        cells = product[name].broadcast_like(product["window_mean"]).transpose("time", "axis")
        table[f"{name} [{unit}]"] = cells.values.ravel()
    with new_output(Path(path), overwrite=overwrite) as temporary:
        table.to_csv(temporary, index=False, date_format="%Y-%m-%dT%H:%M:%S.%fZ")
    return Path(path)

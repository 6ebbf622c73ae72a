"""Lazy datasets of xarray whose errors name the file, whenever the read fails."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core.indexing import IndexingSupport, LazilyIndexedArray, explicit_indexing_adapter

from gyrostab.errors import reading_of

__all__ = ["name_file_in_errors"]


class _FileArray(BackendArray):
    """A lazy variable whose failed reads raise `gyrostab.errors.DamageError`."""

    __slots__ = ("path", "variable")

    def __init__(self, variable: xr.Variable, path: Path):
        self.variable, self.path = variable, path

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the dimensions."""
        return self.variable.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values."""
        dtype: np.dtype[Any] = self.variable.dtype
        return dtype

    def __getitem__(self, key: Any) -> Any:
        return explicit_indexing_adapter(key, self.shape, IndexingSupport.OUTER, self._read_values)

    def _read_values(self, place: tuple[Any, ...]) -> NDArray[Any]:
        with reading_of(self.path):
            return self.variable[place].values


def name_file_in_errors(opened: xr.Dataset, path: Path) -> xr.Dataset:
    """Make the errors of later reads from a lazy dataset name its file.

    Parameters
    ----------
    opened : xarray.Dataset
        Result of `xarray.open_dataset` with ``chunks=None`` and without default indexes.
    path : Path
        The file.

    Returns
    -------
    xarray.Dataset
        The same dataset, still lazy and without dask arrays.
    """
    named = {
        name: xr.Variable(
            variable.dims,
            LazilyIndexedArray(_FileArray(variable, path)),
            variable.attrs,
            variable.encoding,
        )
        for name, variable in opened.variables.items()
    }
    coords = xr.Coordinates({name: named.pop(name) for name in opened.coords}, indexes={})
    dataset = xr.Dataset(named, coords, opened.attrs)
    dataset.encoding = opened.encoding
    dataset.set_close(opened.close)
    return dataset

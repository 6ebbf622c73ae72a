"""What gyrostab adds to xarray: the engine ``gyrostab`` and the accessor ``.gyro``.

Importing this module registers the accessor. xarray imports it by its entry point as soon as it
looks for an engine, so it imports nothing else at once.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import ExitStack
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

import gyrostab

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from gyrostab.arrays import Array


@xr.register_dataset_accessor("gyro")  # type: ignore[no-untyped-call]
@xr.register_dataarray_accessor("gyro")  # type: ignore[no-untyped-call]
class GyroAccessor:
    """Functions of gyrostab as methods of a log, a surface, a product, or a signal with units.

    Parameters
    ----------
    data : xarray.Dataset or xarray.DataArray
        What `gyrostab.davar` accepts, or what it or `gyrostab.fit_noise` returned.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(6000) * np.timedelta64(10, "ms") + np.datetime64("2026-01-01", "ns")
    >>> values = np.random.default_rng(1).standard_normal(6000)
    >>> signal = xr.DataArray(values, {"time": time}, attrs={"units": "deg/h"})
    >>> signal.gyro.fit(window="20s").gyro
    <gyrostab product: axis 1, time 21, tau 34, bnds 2, term 5>
    """

    def __init__(self, data: xr.Dataset | xr.DataArray):
        self._data: Any = data

    def davar(self, **options: Any) -> xr.Dataset:
        """Compute the dynamic Allan variance of a log or signal; options of `gyrostab.davar`."""
        return gyrostab.davar(self._data, **options)

    def fit(self, **options: Any) -> xr.Dataset:
        """Fit the noise terms to a surface; options of `gyrostab.fit_noise`.

        Compute the surface first if this is a log or signal; the options are then those of
        `gyrostab.davar` (also ``tau_max``), and the others of `gyrostab.fit_noise`.
        """
        if self._holds_variable("avar"):
            return gyrostab.fit_noise(self._data, **options)
        of_fit = {*signature(gyrostab.fit_noise).parameters}
        of_fit -= {*signature(gyrostab.davar).parameters}
        fitting = {name: options.pop(name) for name in of_fit & {*options}}
        return gyrostab.fit_noise(self.davar(**options), **fitting)

    def plot(self, **options: Any) -> Figure:
        """Draw a log or signal, a surface, or the coefficients of a product.

        The options are those of `gyrostab.plot_signal`, `gyrostab.plot_davar` and
        `gyrostab.plot_coefficients`.
        """
        if self._holds_variable("observable"):
            return gyrostab.plot_coefficients(self._data, **options)
        if self._holds_variable("avar"):
            return gyrostab.plot_davar(self._data, **options)
        return gyrostab.plot_signal(self._data, **options)

    def _holds_variable(self, name: str) -> bool:
        return isinstance(self._data, xr.Dataset) and name in self._data.variables

    def __repr__(self) -> str:
        kind = "surface" if self._holds_variable("avar") else "log"
        kind = "product" if self._holds_variable("observable") else kind
        kind = "coefficient" if "unit_label" in self._data.attrs else kind
        sizes = ", ".join(f"{dim} {size}" for dim, size in self._data.sizes.items())
        return f"<gyrostab {kind}: {sizes}>"


class GyrostabBackend(BackendEntrypoint):
    """Open logs, surfaces and products: ``xr.open_dataset("log.nc", engine="gyrostab")``.

    Dimensions, units and the computed ``time`` are the same as in `gyrostab.open_log`,
    `gyrostab.open_surface` and `gyrostab.open_product`. Values stay in the file until they are
    used, in dask arrays if ``chunks`` is given. ``strict=True`` raises an error for a damaged chunk
    of a log instead of leaving a gap.
    """

    description = "Open gyro logs, dynamic Allan variances and products of gyrostab"
    open_dataset_parameters = ("filename_or_obj", "drop_variables", "strict")
    supports_groups = True

    def open_dataset(  # type: ignore[override]
        self,
        filename_or_obj: str | os.PathLike[str],
        *,
        drop_variables: str | Iterable[str] | None = None,
        strict: bool = False,
    ) -> xr.Dataset:
        """Open a NetCDF file or a Zarr directory that holds a log, a surface or a product."""
        from gyrostab.io.opening import open_content

        opened = open_content(os.fspath(filename_or_obj), strict=strict)
        lazy = opened.assign(
            {
                name: _without_dask(array.variable)
                for name, array in opened.data_vars.items()
                if array.chunks is not None
            }
        )
        dropped = [drop_variables] if isinstance(drop_variables, str) else drop_variables or ()
        lazy = lazy.drop_vars(dropped, errors="ignore")
        lazy.set_close(opened.close)
        return lazy

    def open_groups_as_dict(  # type: ignore[override]
        self,
        filename_or_obj: str | os.PathLike[str],
        *,
        drop_variables: str | Iterable[str] | None = None,
        strict: bool = False,
    ) -> dict[str, xr.Dataset]:
        """Open the products in a folder of ``gyrostab fleet``, by the names of their runs."""
        folder = Path(filename_or_obj)
        paths = sorted(folder.rglob("*.nc"))
        if not paths:
            from gyrostab.errors import FormatError

            raise FormatError(
                f"{folder}: not a folder with products (.nc) of gyrostab fleet; engine='zarr' "
                "opens those of a Zarr store, and xarray.open_dataset opens one file"
            )
        groups = {"/": xr.Dataset()}
        with ExitStack() as on_error:
            for path in paths:
                name = path.relative_to(folder).as_posix().removesuffix(".nc")
                groups[f"/{name}"] = self.open_dataset(
                    path, drop_variables=drop_variables, strict=strict
                )
                on_error.callback(groups[f"/{name}"].close)
            on_error.pop_all()
        return groups

    def open_datatree(  # type: ignore[override]
        self, filename_or_obj: str | os.PathLike[str], **options: Any
    ) -> xr.DataTree:
        """Open a folder of ``gyrostab fleet`` as a tree with one node for each run."""
        return xr.DataTree.from_dict(self.open_groups_as_dict(filename_or_obj, **options))

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Return False: without ``engine``, xarray opens these files with its own engines."""
        return False


def _without_dask(variable: xr.Variable) -> xr.Variable:
    """Convert a dask array to a lazy array of xarray, whose ``chunks`` option decides on dask."""
    assert variable.chunks is not None
    chunks = {dim: sizes[0] for dim, sizes in zip(variable.dims, variable.chunks, strict=True)}
    data = indexing.LazilyIndexedArray(_FileArray(variable.data))
    encoding = {**variable.encoding, "preferred_chunks": chunks}
    return xr.Variable(variable.dims, data, variable.attrs, encoding)


class _FileArray(BackendArray):
    """An array that is read in boxes, from its source if it has one."""

    def __init__(self, array: Any):
        from gyrostab.store.lazy import find_source

        self.array = array if (source := find_source(array)) is None else source
        self.shape, self.dtype = array.shape, array.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        """Read the values of an indexer of xarray."""
        # xarray before 2026.2 writes the end of a reversed slice as -1, the last value
        parts = [
            slice(part.start, None, part.step)
            if isinstance(part, slice) and part.stop == -1 and part.step < 0
            else part
            for part in key.tuple
        ]
        return indexing.explicit_indexing_adapter(
            type(key)(tuple(parts)), self.shape, indexing.IndexingSupport.BASIC, self._read_key
        )

    def _read_key(self, key: tuple[Any, ...]) -> Array:
        from gyrostab.store.lazy import read_box

        single = [not isinstance(part, slice) for part in key]
        box = [
            slice(part, part + 1) if is_single else part
            for part, is_single in zip(key, single, strict=True)
        ]
        values = read_box(self.array, box)
        return np.asarray(values[tuple(0 if is_single else slice(None) for is_single in single)])

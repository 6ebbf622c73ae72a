"""The working store: how long variables of a log are written in chunks and read lazily.

One chunk holds about 20 minutes of one axis. What a source delivered as integers is kept as
integers with their factor, if that gives back the same doubles. A chunk that is missing or damaged
becomes a gap, and a warning says where.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gyrostab.store.file_errors import name_file_in_errors as name_file_in_errors
    from gyrostab.store.layout import read_attribute as read_attribute
    from gyrostab.store.netcdf_compression import append_compressed as append_compressed
    from gyrostab.store.netcdf_compression import large_variables as large_variables
    from gyrostab.store.netcdf_lock import library_lock as library_lock
    from gyrostab.store.read import open_stored as open_stored
    from gyrostab.store.write import NotCountsError as NotCountsError
    from gyrostab.store.write import Progress as Progress
    from gyrostab.store.write import append_netcdf as append_netcdf
    from gyrostab.store.write import append_zarr as append_zarr
    from gyrostab.store.write import as_counts as as_counts
    from gyrostab.store.write import chunk_samples as chunk_samples
    from gyrostab.store.write import common_packing as common_packing
    from gyrostab.store.write import long_variables as long_variables

#: Public name -> module, imported on first use: the command line needs `output` only.
_MODULES = {
    "NotCountsError": "write",
    "Progress": "write",
    "append_compressed": "netcdf_compression",
    "append_netcdf": "write",
    "append_zarr": "write",
    "as_counts": "write",
    "chunk_samples": "write",
    "common_packing": "write",
    "large_variables": "netcdf_compression",
    "library_lock": "netcdf_lock",
    "long_variables": "write",
    "name_file_in_errors": "file_errors",
    "open_stored": "read",
    "read_attribute": "layout",
}

__all__ = [
    "NotCountsError",
    "Progress",
    "append_compressed",
    "append_netcdf",
    "append_zarr",
    "as_counts",
    "chunk_samples",
    "common_packing",
    "large_variables",
    "library_lock",
    "long_variables",
    "name_file_in_errors",
    "open_stored",
    "read_attribute",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)

"""The working store: how the long variables of a log lie on disk in chunks, and how they are read back lazily.

One chunk holds about 20 minutes of one axis. What a source delivered as integers is kept as
integers with their factor, if that gives back the same doubles. A chunk that is missing or damaged
becomes a gap, and a warning says where; never does it in silence.
"""

from gyrostab.store.file_errors import name_file_in_errors
from gyrostab.store.layout import read_attribute
from gyrostab.store.netcdf_compression import append_compressed, large_variables
from gyrostab.store.netcdf_lock import library_lock
from gyrostab.store.read import open_stored
from gyrostab.store.write import (
    NotCountsError,
    Progress,
    append_netcdf,
    append_zarr,
    as_counts,
    chunk_samples,
    common_packing,
    long_variables,
)

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

"""One thread at a time in the NetCDF library."""

from __future__ import annotations

from typing import Any

__all__ = ["library_lock"]


def library_lock() -> Any:
    """The lock that xarray holds too while it is in the NetCDF library."""
    from xarray.backends.netCDF4_ import NETCDF4_PYTHON_LOCK

    return NETCDF4_PYTHON_LOCK

"""The lock that admits one thread at a time to the NetCDF library."""

from __future__ import annotations

from typing import Any

__all__ = ["library_lock"]


def library_lock() -> Any:
    """Return the lock that xarray holds, too, while it calls the NetCDF library."""
    from xarray.backends.netCDF4_ import NETCDF4_PYTHON_LOCK

    return NETCDF4_PYTHON_LOCK

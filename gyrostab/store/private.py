"""What gyrostab needs of xarray beyond its public interface, each with a fallback.

docs/decisions/0009-private-interfaces.md lists them with their reasons.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

_OWN_LOCK = threading.RLock()


def library_lock() -> Any:
    """Return the lock that xarray, too, holds while it calls the NetCDF library.

    Without it, a lock of gyrostab; then only reads of gyrostab wait for each other.
    """
    try:
        from xarray.backends.netCDF4_ import NETCDF4_PYTHON_LOCK
    except ImportError:
        return _OWN_LOCK
    return NETCDF4_PYTHON_LOCK


def is_in_memory(variable: Any) -> bool:
    """Whether the values of a variable are in memory; False if xarray does not say."""
    return bool(getattr(variable, "_in_memory", False))


def close_function(dataset: Any) -> Callable[[], None] | None:
    """Return what closes the files of a dataset; it does not refer to the dataset if possible."""
    close: Callable[[], None] | None = getattr(dataset, "_close", dataset.close)
    return close

"""Return memory to the system: the C library of Linux (glibc) keeps most of what is freed."""

from __future__ import annotations

import contextlib
import ctypes

__all__ = ["release_memory", "return_large_arrays"]

_M_MMAP_THRESHOLD = -3  # of malloc.h of glibc
_LARGE_BYTES = 2**17  # its first value, which it raises up to 32 MiB unless it is set


def return_large_arrays() -> None:
    """Let glibc return each large array to the system when it is freed, not only at first."""
    with contextlib.suppress(TypeError, AttributeError):  # on Windows and without glibc
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)


def release_memory() -> None:
    """Return memory that is free in the C library to the system; glibc alone keeps it."""
    with contextlib.suppress(TypeError, AttributeError):  # on Windows and without glibc
        ctypes.CDLL(None).malloc_trim(0)

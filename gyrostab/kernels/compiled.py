"""Options for numba that avoid compiling unused code, so that the first run starts sooner.

In addition to the code of a function, numba makes an entry point for Python and one for C, and
optimises both; for twenty arrays an entry point is longer than a short kernel. A function that only
other kernels call needs neither.
"""

from __future__ import annotations

from typing import Any

from numba import njit


def _has_cache() -> bool:
    """Whether numba finds a folder for compiled code.

    It looks for ``NUMBA_CACHE_DIR``, the folder of the package and that of the user. An account
    without a home that uses a package of another account has none of them, and compiles in every
    process.
    """
    try:
        njit(cache=True)(_has_cache)
    except RuntimeError:
        return False
    return True


#: Options of a function that Python calls. A division by zero gives infinity or NaN; a test for it
#: would prevent vectorisation. A literal integer in a call, such as 0, makes numba compile the
#: callee again for this number; `np.int64(0)` does not.
KERNEL: dict[str, Any] = {
    "nogil": True,
    "cache": _has_cache(),
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}
#: Options of a function that only kernels call. It is inlined in its callers and cached with them.
#: A separate copy, which only the process that compiles it would call, may add in another order
#: than the inlined ones: the last digits of a first run would differ.
INNER: dict[str, Any] = {**KERNEL, "cache": False, "no_cpython_wrapper": True, "forceinline": True}
#: Fast-math flags that let the compiler add in another order, which it needs for vector code; the
#: order is the same on every call. NaN and infinity keep their meaning.
REORDER = {"reassoc", "contract", "nsz"}

"""How numba compiles the kernels: what is not used is not compiled, and the first run waits less.

For every function numba makes, beside the code, an entry for Python and one for C, and both are
optimised with it; for twenty arrays the entry is longer than a short kernel. A function that only
other kernels call needs neither.
"""

from __future__ import annotations

from typing import Any

__all__ = ["INNER", "KERNEL"]

#: Options of a function that Python calls. A division by zero gives infinity or NaN; a test for it
#: would cost loops their vectors.
#: A whole number that stands in a call, as 0, makes numba compile the callee once more for this
#: number: `np.int64(0)` does not.
KERNEL: dict[str, Any] = {
    "nogil": True,
    "cache": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}
#: Options of a function that only kernels call. It is part of its callers, and kept on disk with
#: them. A copy by itself, which only the
#: process that compiles would call, may add in another order than those in the callers: a first run
#: would have last digits of its own.
INNER: dict[str, Any] = {**KERNEL, "cache": False, "no_cpython_wrapper": True, "forceinline": True}

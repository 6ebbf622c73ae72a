"""Options for numba that avoid compiling unused code, so that the first run starts sooner.

In addition to the code of a function, numba makes an entry point for Python and one for C, and
optimises both; for twenty arrays an entry point is longer than a short kernel. A function that only
other kernels call needs neither.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from numba import njit


def delete_stale_code(folder: Path) -> None:
    """Delete the compiled code next to the sources in a folder, if any of them has changed.

    numba compiles a function again if its own file has changed, but not if only that of a function
    that it calls has: after an update, results would be those of neither version. What the sources
    were is noted in ``__pycache__/sources.txt``.
    """
    note = folder / "__pycache__" / "sources.txt"
    try:
        sources = [(path, path.stat()) for path in sorted(folder.rglob("*.py"))]
        state = "".join(
            f"{path.relative_to(folder).as_posix()} {stat.st_mtime_ns} {stat.st_size}\n"
            for path, stat in sources
        )
        if note.exists() and note.read_text(encoding="utf-8") == state:
            return
        for compiled in folder.rglob("*.nb[ic]"):
            compiled.unlink(missing_ok=True)
        note.parent.mkdir(exist_ok=True)
        part = note.with_suffix(f".{os.getpid()}")
        part.write_text(state, encoding="utf-8")
        part.replace(note)
    except OSError:  # nobody may write here, and numba keeps its code elsewhere
        return


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


delete_stale_code(Path(__file__).parent)
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

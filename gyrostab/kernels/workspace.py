"""Memory that units of work reuse: a new large array costs as much as the sums that fill it."""

from __future__ import annotations

import math
import threading

import numpy as np

from gyrostab.arrays import Floats

# Bytes of a line of the cache; vectors that begin with one are loaded at once.
_LINE = 64


class Workspace:
    """Arrays of doubles by name, for one thread; an array is valid until its name is used again.

    Examples
    --------
    >>> space = Workspace()
    >>> angle = space.array("angle", 3, 1000)
    >>> angle.shape, angle.ctypes.data % 64, np.shares_memory(angle, space.array("angle", 500))
    ((3, 1000), 0, True)
    """

    def __init__(self) -> None:
        self._kept: dict[str, Floats] = {}

    def array(self, name: str, *shape: int) -> Floats:
        """Return an uninitialised array that begins at a cache line."""
        size = math.prod(shape)
        if name not in self._kept or self._kept[name].size < size:
            self._kept.pop(name, None)
            memory = np.empty(size + _LINE // 8)
            begin = -memory.ctypes.data % _LINE // 8
            self._kept[name] = memory[begin : begin + size]
        return self._kept[name][:size].reshape(shape)


class Workspaces(threading.local):
    """A separate `Workspace` for each thread, as ``own``; empty in another process."""

    def __init__(self) -> None:
        self.own = Workspace()

    def __reduce__(self) -> tuple[type[Workspaces], tuple[()]]:
        return Workspaces, ()

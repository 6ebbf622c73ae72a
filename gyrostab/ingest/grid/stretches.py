"""Blocks and stretches of stamps, for the estimate of the sampling rate."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from gyrostab.kernels.grid.stamps import NO_STAMP

__all__ = ["SECOND", "Stamps", "readable_stamps", "recut_blocks", "sample_stretches"]


SECOND = 1e9


#: Returns a new iterator over all blocks of row numbers and stamps at each call.
Stamps = Callable[[], Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]]


def recut_blocks(
    stamps: Stamps, size: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield rows and stamps in blocks of `size`, independent of the input blocks."""
    held: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    waiting = 0
    for block in stamps():
        held.append(block)
        waiting += len(block[0])
        if waiting < size:
            continue
        rows, values = _concatenate_blocks(held)
        whole = waiting // size * size
        for begin in range(0, whole, size):
            yield rows[begin : begin + size], values[begin : begin + size]
        held, waiting = [(rows[whole:], values[whole:])], waiting - whole
    if waiting:
        yield _concatenate_blocks(held)


def _concatenate_blocks(
    held: list[tuple[NDArray[np.int64], NDArray[np.int64]]],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Concatenate blocks of rows and stamps; a single non-empty block is not copied."""
    held = [block for block in held if len(block[0])]
    if len(held) == 1:
        return held[0]
    rows, values = (np.concatenate(column) for column in zip(*held, strict=True))
    return rows, values


def readable_stamps(block: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the readable stamps, without a copy if all are readable."""
    known = block != NO_STAMP
    return block if known.all() else block[known]


def sample_stretches(
    stamps: Stamps, *, size: int = 8192, most: int = 64
) -> list[NDArray[np.int64]]:
    """Return stretches of stamps from the whole log, a few hundred thousand in all."""
    found: list[NDArray[np.int64]] = []
    for _, block in stamps():
        block = readable_stamps(block)
        found += [block[i : i + size] for i in range(0, len(block), size)]
        if len(found) > 2 * most:
            found = found[::2]
    return [part for part in found if len(part) > 1]

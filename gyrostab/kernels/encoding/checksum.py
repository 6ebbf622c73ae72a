"""Checksum of the chunks of a log: fletcher32 as HDF5 computes it."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.compiled import KERNEL


def fletcher32(data: NDArray[np.uint8]) -> int:
    """Compute Fletcher's 32-bit checksum of big-endian 16-bit words, as in HDF5 and numcodecs.

    An odd last byte is the higher half of a word. The GIL is released.

    Parameters
    ----------
    data : ndarray of uint8, shape (bytes,)
        Contiguous.

    Returns
    -------
    int
        Sum of the sums in the upper 16 bits, sum of the words in the lower ones.

    References
    ----------
    HDF5, H5checksum.c, ``H5_checksum_fletcher32``.

    Examples
    --------
    >>> hex(fletcher32(np.frombuffer(b"abcde", np.uint8)))
    '0x4ff029c7'
    """
    even = data.size // 2
    total, sums, nonzero = _add_words(data[: 2 * even].view("<u2"))
    if data.size % 2:
        last = int(data[-1])
        total, sums, nonzero = total + last, sums + total + last, nonzero | last
    return _half_sum(sums, nonzero) << 16 | _half_sum(total, nonzero)


def _half_sum(amount: int, nonzero: int) -> int:
    """Fold a sum of words whose bytes are swapped; nonzero input gives 65535, never 0."""
    return int(amount) * 256 % 65535 or (65535 if nonzero else 0)


@njit(**KERNEL)
def _add_words(words):  # type: ignore[no-untyped-def]
    """Sum the words and their running sums modulo 65535, and whether any word is not 0."""
    total, sums, nonzero = np.int64(0), np.int64(0), np.int64(0)
    for begin in range(0, words.size, 256):
        block = words[begin : begin + 256]
        plain, weighted = np.int64(0), np.int64(0)
        for i in range(block.size):
            plain += block[i]
            weighted += (block.size - i) * np.int64(block[i])
        sums = (sums + block.size * total + weighted) % 65535
        total = (total + plain) % 65535
        nonzero |= plain
    return total, sums, nonzero

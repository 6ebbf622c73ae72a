"""Messages with sync bytes and a checksum in a stream of bytes, and the counters in them.

A message begins with its sync bytes and ends with the CRC-32/MPEG-2 of all bytes before it
(polynomial 0x04C11DB7, start 0xFFFFFFFF, not reflected), padded with zeros to a multiple of four
bytes, most significant byte first.

References
----------
KVH Industries, 1775 IMU technical manual 56-0298, section 5; Sensonor, STIM300 datasheet TS1524.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

CRC_BYTES = 4
_POLYNOMIAL = np.uint32(0x04C11DB7)
#: Bytes that are searched at one time.
_BLOCK = 2**18


@cache
def _crc_table() -> NDArray[Any]:
    remainders = np.arange(256, dtype=np.uint32) << 24
    for _ in range(8):
        remainders = remainders << 1 ^ (remainders >> 31) * _POLYNOMIAL
    return remainders


def crc32_mpeg2(rows: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Return the checksum of each row of bytes, padded with zeros to a multiple of four bytes.

    Examples
    --------
    >>> rows = np.frombuffer(b"12345678", np.uint8)[None]
    >>> hex(crc32_mpeg2(rows)[0])
    '0x49e3c2fb'
    """
    table, checksums = _crc_table(), np.full(len(rows), 0xFFFFFFFF, dtype=np.uint32)
    for column in np.pad(rows, ((0, 0), (0, -rows.shape[1] % 4))).T:
        checksums = checksums << 8 ^ table[checksums >> 24 ^ column]
    return checksums


def find_messages(raw: NDArray[np.uint8], sync: bytes, size: int) -> NDArray[np.int64]:
    """Return the first byte of each message that is complete and whose checksum is right.

    `raw` is the stream, such as a memory map of a file; a message begins with `sync` and has `size`
    bytes with sync bytes and checksum.
    """
    message_starts = [np.empty(0, dtype=np.int64)]
    for begin in range(0, max(len(raw) - size + 1, 0), _BLOCK):
        part = np.asarray(raw[begin : begin + _BLOCK + size - 1])
        starts = np.flatnonzero(part[: len(part) - size + 1] == sync[0])
        for place, byte in enumerate(sync[1:], 1):
            starts = starts[part[starts + place] == byte]
        rows = sliding_window_view(part, size)[starts]
        sums = np.ascontiguousarray(rows[:, -CRC_BYTES:]).view(">u4")[:, 0]
        message_starts.append(starts[crc32_mpeg2(rows[:, :-CRC_BYTES]) == sums] + begin)
    return np.concatenate(message_starts)


def unwrap_counter(counter: NDArray[Any], modulus: int) -> NDArray[np.int64]:
    """Return the sum of the steps of a counter that restarts from 0 after `modulus` - 1.

    A loss of a whole turn of the counter is not visible.

    Examples
    --------
    >>> unwrap_counter(np.array([126, 127, 0, 3]), 128).tolist()
    [0, 1, 2, 5]
    """
    steps = np.diff(counter.astype(np.int64), prepend=counter[:1].astype(np.int64))
    return np.cumsum(np.remainder(steps, modulus), dtype=np.int64)

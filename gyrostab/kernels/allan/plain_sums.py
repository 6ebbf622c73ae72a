"""The inner loop of the Allan variance in plain numba: the sums of `vectors`, lag by lag.

Used where the vectors of `gyrostab.kernels.allan.vectors` cannot be built, and in tests, as their
reference implementation.
"""

from __future__ import annotations

from numba import njit

from gyrostab.kernels.compiled import KERNEL, REORDER

#: Elements of a vector.
LANES = 8
#: Most lags in one pass, and most of lags that follow each other.
MAX_LAGS, CONSECUTIVE_LAGS = 4, 8


@njit(fastmath=REORDER, **KERNEL)
def split_sums(theta, first, count, lags, at, splits, sizes, heads, tails, place):  # type: ignore[no-untyped-def]
    """Add squared second differences in two parts, as `split_sums` of `vectors`."""
    for q in range(count):
        k, split, size = lags[at + q], splits[q], sizes[q]
        early = theta[first : first + size]
        middle = theta[first + k : first + k + size]
        late = theta[first + 2 * k : first + 2 * k + size]
        head = tail = 0.0
        for m in range(split):
            difference = late[m] - 2.0 * middle[m] + early[m]
            head += difference * difference
        for m in range(split, size):
            difference = late[m] - 2.0 * middle[m] + early[m]
            tail += difference * difference
        heads[place + q] += head
        tails[place + q] += tail

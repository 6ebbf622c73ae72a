"""Compare the scatter of the samples next to gaps with that of the other samples of a window.

If samples are lost independently of the noise, both are equal, and their ratio is 1. If samples are
lost while the noise is high, the samples that are left next to the gaps are noisier, and the window
underestimates the noise of the record.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import KERNEL

#: Samples on either side of a gap that count as next to it: few enough that a fifth of the samples
#: lost one by one leaves others.
EDGE_SAMPLES = 8
#: Smallest number of second differences of either kind; in white noise the ratio then has a
#: standard deviation of at most 15 %.
MIN_DIFFERENCES = 100


@njit(**KERNEL)
def gap_edge_ratio(x, starts, length):  # type: ignore[no-untyped-def]
    """Compute the ratio of mean absolute second differences next to gaps and elsewhere.

    Parameters
    ----------
    x : ndarray, shape (n_samples,)
        Samples, NaN where missing; rates, or cumulative angles.
    starts : ndarray of int64, shape (n_windows,)
        First sample of each window.
    length : int
        Samples of a window.

    Returns
    -------
    ndarray of float64, shape (n_windows,)
        NaN with fewer than `MIN_DIFFERENCES` of either kind. A gap outside the window has no
        effect.
    """
    out = np.full(starts.size, np.nan)
    missing = 0
    for i in range(x.size):
        missing += 0 if np.isfinite(x[i]) else 1
    if missing == 0:
        return out
    total = np.zeros((x.size + 1, 2))  # sums and counts before each sample: near gaps, elsewhere
    count = np.zeros((x.size + 1, 2), np.int32)
    first = 0
    while first < x.size:
        last = first
        while last < x.size and np.isfinite(x[last]):
            last += 1
        for i in range(first + 1, last - 1):
            difference = abs(np.float64(x[i - 1]) - 2.0 * np.float64(x[i]) + np.float64(x[i + 1]))
            early = first > 0 and i - 1 - first < EDGE_SAMPLES
            late = last < x.size and last - (i + 2) < EDGE_SAMPLES
            kind = 0 if early or late else 1
            total[i + 1, kind] = difference
            count[i + 1, kind] = 1
        first = last + 1
    for i in range(x.size):
        for kind in range(2):
            total[i + 1, kind] += total[i, kind]
            count[i + 1, kind] += count[i, kind]
    for window in range(starts.size):
        low = starts[window] + EDGE_SAMPLES + 1
        high = starts[window] + length - EDGE_SAMPLES - 1
        if high <= low or high > x.size:
            continue
        near_gaps, elsewhere = count[high] - count[low]
        if min(near_gaps, elsewhere) >= MIN_DIFFERENCES:
            sums = total[high] - total[low]
            if sums[1] > 0.0:
                out[window] = (sums[0] / near_gaps) / (sums[1] / elsewhere)
    return out

"""Weighted cluster means: the Allan variance of a rate log so full of gaps that few unbroken runs are left.

Each cluster mean uses the samples that are there; a pair of clusters with n1 and n2 samples has weight n1 n2, and both
must be at least half full. Random walk, flicker and ramp come out right. White and quantization noise come out too high
by factors that the mask alone determines; those responses are returned, so that a fit can use them as its columns.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER

__all__ = ["cluster_cell", "cluster_prefix"]


@njit(**INNER)
def cluster_prefix(starts, stops, n):  # type: ignore[no-untyped-def]
    """From runs of present samples: the mask (n,), and the number of present samples and of run starts before each, (n + 1,)."""
    present = np.zeros(n, np.bool_)
    samples = np.zeros(n + 1, np.int32)
    runs = np.zeros(n + 1, np.int32)
    count = 0
    for r in range(starts.size):
        present[starts[r] : stops[r]] = True
        inside = samples[starts[r] + 1 : stops[r] + 1]
        for i in range(inside.size):
            inside[i] = count + i + 1
        count += inside.size
        following = starts[r + 1] if r + 1 < starts.size else n
        samples[stops[r] + 1 : following + 1] = count
        runs[starts[r] + 1 : following + 1] = r + 1
    return present, samples, runs


@njit(**INNER)
def _runs_within(runs, present, a, b):  # type: ignore[no-untyped-def]
    """Runs of present samples that touch [a, b)."""
    continued = a > 0 and present[a - 1] and a < present.size and present[a]
    return runs[b] - runs[a] + (1 if continued else 0)


@njit(**INNER)
def _common(samples, a1, b1, a2, b2):  # type: ignore[no-untyped-def]
    """Present samples in the intersection of [a1, b1) and [a2, b2)."""
    a, b = max(a1, a2), min(b1, b2)
    return samples[b] - samples[a] if b > a else 0


@njit(**INNER)
def _gap_factor(samples, first, length, k):  # type: ignore[no-untyped-def]
    """Degrees of freedom under white noise, seen through this mask, as a share of the gap-free window's."""
    stride = max(1, k // 4)
    total = (length + stride - 1) // stride
    variance = 0.0
    expected = 0.0
    full = 0.0
    for i in range(total):
        m = first + i * stride
        n1 = samples[m + k] - samples[m]
        n2 = samples[m + 2 * k] - samples[m + k]
        full += 1.0
        for j in range(i + 1, min(total, i + 1 + 2 * k // stride)):
            lag = (j - i) * stride
            rho = 1.0 - 1.5 * lag / k if lag <= k else 0.5 * lag / k - 1.0
            if lag < 2 * k:
                full += 2.0 * rho * rho
        if 2 * n1 < k or 2 * n2 < k:
            continue
        weight = float(n1 * n2)
        own = 1.0 / n1 + 1.0 / n2
        expected += weight * own
        variance += (weight * own) ** 2
        for j in range(i + 1, min(total, i + 1 + 2 * k // stride)):
            p = first + j * stride
            p1 = samples[p + k] - samples[p]
            p2 = samples[p + 2 * k] - samples[p + k]
            if 2 * p1 < k or 2 * p2 < k:
                continue
            shared = _common(samples, m, m + k, p, p + k) / (n1 * p1)
            shared += _common(samples, m + k, m + 2 * k, p + k, p + 2 * k) / (n2 * p2)
            shared -= _common(samples, m + k, m + 2 * k, p, p + k) / (n2 * p1)
            variance += 2.0 * weight * p1 * p2 * shared * shared
    if variance == 0.0:
        return 0.0
    return expected * expected / variance * full / (float(total) * total)


@njit(**INNER)
def cluster_cell(theta, present, samples, runs, first, window, k):  # type: ignore[no-untyped-def]
    """One cell of the surface by weighted cluster means.

    Parameters
    ----------
    theta : float64 (n + 1,)
        Integral of the rate over present samples, gaps adding nothing.
    present : bool (n,); samples, runs : int32 (n + 1,)
        As from `cluster_prefix`.
    first, window, k : int
        First sample of the window, its length, averaging factor.

    Returns
    -------
    variance : float
        Weighted mean of ``(mean2 - mean1)^2 / 2`` [square of the rate's unit].
    count : int
        Cluster pairs used.
    coverage : float
        Weight used, as a share of the gap-free weight.
    white, quantization : float
        Responses to unit white and quantization noise, relative to the gap-free laws.
    factor : float
        Degrees of freedom as a share of the gap-free window's.
    """
    length = window - 2 * k + 1
    stride = max(1, k // 16)
    total_weight = 0.0
    variance = 0.0
    white = 0.0
    quantization = 0.0
    count = 0
    for m in range(first, first + length, stride):
        n1 = samples[m + k] - samples[m]
        n2 = samples[m + 2 * k] - samples[m + k]
        if 2 * n1 < k or 2 * n2 < k:
            continue
        d = (theta[m + 2 * k] - theta[m + k]) / n2 - (theta[m + k] - theta[m]) / n1
        weight = float(n1 * n2)
        total_weight += weight
        variance += weight * d * d
        white += weight * (1.0 / n1 + 1.0 / n2)
        edges = 2.0 * _runs_within(runs, present, m, m + k) / (float(n1) * n1)
        edges += 2.0 * _runs_within(runs, present, m + k, m + 2 * k) / (float(n2) * n2)
        if present[m + k - 1] and present[m + k]:
            edges += 2.0 / (float(n1) * n2)
        quantization += weight * edges
        count += 1
    if count == 0:
        return np.nan, 0, 0.0, np.nan, np.nan, 0.0
    offered = (length + stride - 1) // stride
    return (
        variance / (2.0 * total_weight),
        count,
        total_weight / (offered * float(k) * k),
        white / (2.0 * total_weight) * k,
        quantization / (2.0 * total_weight) * k * k / 3.0,
        _gap_factor(samples, first, length, k),
    )

"""Stamps of known samples with jitter, packets, late rows and losses, for tests and benchmarks."""

from __future__ import annotations

import numpy as np

from gyrostab.arrays import Floats, Ints
from tests.support.raw_rows import START

JITTER = ("normal", "uniform", "sorted", "latest", "packets", "late")
LOSSES = ("none", "single", "bursts", "gap")
UNITS = {"ns": 1, "us": 1000, "ms": 1_000_000}
PACKET = 7  # rows


def lose_samples(kind: str, rows: int, random: np.random.Generator) -> Ints:
    """Return the true samples of about `rows` rows, with losses of the given kind."""
    if kind == "single":
        samples = np.flatnonzero(random.random(int(rows * 1.01)) >= 0.01)
    elif kind == "bursts":
        is_kept = np.ones(int(rows / 0.7), dtype=bool)
        while is_kept.mean() > 0.7:
            begin = random.integers(0, len(is_kept))
            is_kept[begin : begin + random.integers(5, 100)] = False
        samples = np.flatnonzero(is_kept)
    else:
        samples = np.arange(rows)
        samples[rows // 2 :] += 123_457 * (kind == "gap")
    return samples - samples[0]


def scatter_stamps(samples: Ints, kind: str, scatter: float, random: np.random.Generator) -> Floats:
    """Return times of arrival [samples] with a jitter of `scatter` (half range if uniform)."""
    noise = (
        random.uniform(-scatter, scatter, len(samples))
        if kind == "uniform"
        else random.normal(0, scatter, len(samples))
    )
    times = samples + noise
    if kind == "sorted":
        return np.sort(times)
    if kind == "latest":
        return np.maximum.accumulate(times)
    if kind == "packets":  # all rows of a packet arrive when it is complete
        packet = samples // PACKET
        return (packet + 1) * PACKET + np.abs(random.normal(0, scatter, packet[-1] + 1))[packet]
    if kind == "late":
        for begin in random.integers(0, len(samples) - 60, max(3, len(samples) // 2000)):
            end = begin + random.integers(5, 50)
            if samples[end] - samples[begin] == end - begin:
                times[begin:end] = np.maximum(times[begin:end], times[end])
    return times


def round_stamps(times: Floats, rate: float, unit: str) -> Ints:
    """Round times of arrival to stamps [ns] in a unit."""
    return START + np.rint(times / rate * 1e9 / UNITS[unit]).astype(np.int64) * UNITS[unit]

"""Nuisance alternatives: generic changes of noise and bias that compete with the effects.

If one of them wins, the answer is "unknown".
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Candidate, Variant
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.noise import sampled_psd

Array = NDArray[np.float64]
#: Name -> description.
NUISANCE_ALTERNATIVES = {
    "~bias(t)": "the bias wanders",
    "~levels": "the bias steps between levels that differ",
    "~N(t)": "the noise level changes",
    "~burst": "the noise level is higher for a while",
    "~S(f)": "the spectrum has another shape",
    "~cov": "the axes have noise in common",
    "~outliers": "the distribution has heavy tails",
    "~red": "slow noise is stronger than calibrated",
}
_SPLINE_KNOTS = 12  # over the record; design choice
_MAX_INTERVALS = 240  # intervals of a burst that are tried; limits time


def burst_intervals(block_count: int) -> NDArray[np.int64]:
    """List intervals of blocks, (interval, 2) as first and stop: 1, 2, 4, ... up to half of all.

    Each starts half its length after the one before. If there are too many of a length, only the
    first and the last are kept, because a trend in time differs from a short event only there.

    Examples
    --------
    >>> burst_intervals(4).tolist()
    [[0, 1], [1, 2], [2, 3], [3, 4], [0, 2], [1, 3], [2, 4]]
    >>> burst_intervals(1000)[:4].tolist(), len(burst_intervals(1000)) <= 240
    ([[0, 1], [999, 1000], [0, 2], [998, 1000]], True)
    """
    lengths = [2**power for power in range(max(1, block_count // 2).bit_length())]
    first = [np.arange(0, block_count - length + 1, max(1, length // 2)) for length in lengths]
    while sum(starts.size for starts in first) > _MAX_INTERVALS:
        # The shortest intervals are the most numerous.
        longest = next(number for number, starts in enumerate(first) if starts.size > 2)
        first[longest] = np.array([0, block_count - lengths[longest]])
    return np.concatenate(
        [
            np.stack([starts, starts + length], axis=1)
            for starts, length in zip(first, lengths, strict=True)
        ]
    )


def hat_functions(begin: Array, end: Array, knots: int = _SPLINE_KNOTS) -> Array:
    """Return piecewise linear hat functions over the record, (knot, block).

    Examples
    --------
    >>> hat_functions(np.arange(4.0), np.arange(1.0, 5.0), 2).sum(axis=0)
    array([1., 1., 1., 1.])
    """
    middle = (begin + end) / 2.0
    places = np.linspace(begin[0], end[-1], knots)
    return np.stack([np.interp(middle, places, row) for row in np.eye(knots)])


def nuisance_alternatives(blocks: xr.Dataset) -> list[Candidate]:
    """Build the nuisance alternatives in all statistics of the record."""
    hats = hat_functions(blocks["begin"].values, blocks["end"].values)
    white = sampled_psd("N", blocks["frequency"].values, float(blocks.attrs["sampling_rate_hz"]))
    bands = blocks.sizes["band"]
    level = hats[:, None, :, None] * white
    shapes = np.eye(bands)[:, None, None, :]
    bursts = tuple(
        _burst_variant(first, stop, blocks, white)
        for first, stop in burst_intervals(blocks.sizes["block"]).tolist()
    )
    hat_columns = _numbered_columns(len(hats))
    variants: dict[tuple[str, str], tuple[Variant, ...]] = {
        ("~bias(t)", "mean"): (Variant({}, hat_columns, hats[:, None, :]),),
        ("~levels", "telegraph"): (Variant({}, ("0",), np.empty(0)),),
        ("~N(t)", "power"): (Variant({}, hat_columns, level),),
        ("~burst", "power"): bursts,
        ("~S(f)", "power"): (
            *_single_designs(shapes),
            Variant({}, _numbered_columns(bands), shapes),
        ),
        ("~outliers", "sample_counts"): (Variant({}, ("kurtosis",), np.empty(0)),),
    }
    if "cross" in blocks and blocks.sizes["pair"]:
        variants["~cov", "cross_spectrum"] = _covariance_variants(bands)
    return [
        Candidate(name, find_statistic(statistic), (), tried)
        for (name, statistic), tried in variants.items()
    ]


def _burst_variant(first: int, stop: int, blocks: xr.Dataset, white: Array) -> Variant:
    """Return white noise with a higher level in some blocks."""
    block = np.arange(blocks.sizes["block"])
    inside = ((block >= first) & (block < stop)).astype(np.float64)
    values = {"begin": float(blocks["begin"][first]), "end": float(blocks["end"][stop - 1])}
    return Variant(values, ("0",), inside[None, None, :, None] * white)


def _numbered_columns(count: int) -> tuple[str, ...]:
    """Return column names for numbered columns."""
    return tuple(str(number) for number in range(count))


def _single_designs(designs: Array) -> tuple[Variant, ...]:
    """Return a variant for each design alone."""
    return tuple(
        Variant({"band": float(number)}, ("0",), design[None])
        for number, design in enumerate(designs)
    )


def _covariance_variants(bands: int) -> tuple[Variant, ...]:
    """Return covariances in each band, or in four groups of bands, with any phase."""
    single_bands = [np.eye(bands)[number] for number in range(bands)]
    groups = [
        np.isin(np.arange(bands), group).astype(float)
        for group in np.array_split(np.arange(bands), min(4, bands))
    ]
    variants = [_any_phase([band]) for band in single_bands]
    return (*variants, _any_phase(groups))


def _any_phase(rows: list[Array]) -> Variant:
    """Return cross-densities of any phase in these bands."""
    columns = np.array([factor * row for row in rows for factor in (1.0 + 0j, 1j)])
    return Variant({}, _numbered_columns(len(columns)), columns[:, None, None, :])

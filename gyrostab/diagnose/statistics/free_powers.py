"""Changes of the noise of any course or shape, which compete with the effects on the powers."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Variant, numbered_columns
from gyrostab.diagnose.predict.windows import hat_functions
from gyrostab.noise import sampled_psd

Array = NDArray[np.float64]
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


def _burst_variant(first: int, stop: int, blocks: xr.Dataset, white: Array) -> Variant:
    """Return white noise with a higher level in some blocks."""
    block = np.arange(blocks.sizes["block"])
    inside = ((block >= first) & (block < stop)).astype(np.float64)
    values = {"begin": float(blocks["begin"][first]), "end": float(blocks["end"][stop - 1])}
    return Variant(values, ("0",), inside[None, None, :, None] * white)


def _single_designs(designs: Array) -> tuple[Variant, ...]:
    """Return a variant for each design alone."""
    return tuple(
        Variant({"band": float(number)}, ("0",), design[None])
        for number, design in enumerate(designs)
    )


def free_powers(blocks: xr.Dataset) -> dict[str, tuple[Variant, ...]]:
    """Return the powers of nuisance alternatives, by name: any course, bursts and any spectrum."""
    white = sampled_psd("N", blocks["frequency"].values, float(blocks.attrs["sampling_rate_hz"]))
    hats = hat_functions(blocks["begin"].values, blocks["end"].values)
    bands = blocks.sizes["band"]
    shapes = np.eye(bands)[:, None, None, :]
    return {
        "~N(t)": (Variant({}, numbered_columns(len(hats)), hats[:, None, :, None] * white),),
        "~burst": tuple(
            _burst_variant(first, stop, blocks, white)
            for first, stop in burst_intervals(blocks.sizes["block"]).tolist()
        ),
        "~S(f)": (*_single_designs(shapes), Variant({}, numbered_columns(bands), shapes)),
    }

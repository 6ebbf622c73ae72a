"""What noise and bias may do without a name: generic changes that compete with the effects, so that "unknown" is an answer."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Candidate, Variant
from gyrostab.noise import sampled_psd

__all__ = ["NUISANCE_ALTERNATIVES", "nuisance_alternatives", "splines", "stretches"]

Array = NDArray[np.float64]
#: Name -> what it stands for.
NUISANCE_ALTERNATIVES = {
    "~bias(t)": "the bias wanders",
    "~N(t)": "the noise level changes",
    "~burst": "the noise is louder for a while",
    "~S(f)": "the spectrum has another shape",
    "~cov": "the axes have noise in common",
    "~outliers": "the distribution has heavy tails",
    "~red": "slow noise is stronger than calibrated",
}
_KNOTS = 12
_STRETCHES = 240  # stretches of time that are tried


def stretches(block_count: int, most: int = _STRETCHES) -> NDArray[np.int64]:
    """First block and the one behind the last of stretches of time, (stretch, 2): single blocks, two, four and so on, up to half of them.

    Each begins half its length behind the one before. Where there are too many of a length, these
    are left out but at both ends of the record, where all that a law of time says of a short event
    is said.

    Examples
    --------
    >>> stretches(4).tolist()
    [[0, 1], [1, 2], [2, 3], [3, 4], [0, 2], [1, 3], [2, 4]]
    >>> stretches(1000)[:4].tolist(), len(stretches(1000)) <= 240
    ([[0, 1], [999, 1000], [0, 2], [998, 1000]], True)
    """
    lengths = [2**power for power in range(max(1, block_count // 2).bit_length())]
    first = [np.arange(0, block_count - length + 1, max(1, length // 2)) for length in lengths]
    while sum(one.size for one in first) > most:
        longest = next(
            number for number, one in enumerate(first) if one.size > 2
        )  # of the stretches that are many these are the shortest
        first[longest] = np.array([0, block_count - lengths[longest]])
    return np.concatenate(
        [np.stack([one, one + length], axis=1) for one, length in zip(first, lengths, strict=True)]
    )


def splines(begin: Array, end: Array, knots: int = _KNOTS) -> Array:
    """Hat functions over the record, (knot, block).

    Examples
    --------
    >>> splines(np.arange(4.0), np.arange(1.0, 5.0), 2).sum(axis=0)
    array([1., 1., 1., 1.])
    """
    middle = (begin + end) / 2.0
    places = np.linspace(begin[0], end[-1], knots)
    return np.stack([np.interp(middle, places, row) for row in np.eye(knots)])


def nuisance_alternatives(blocks: xr.Dataset) -> list[Candidate]:
    """Generics of all views that the record has."""
    hats = splines(blocks["begin"].values, blocks["end"].values)
    white = sampled_psd("N", blocks["frequency"].values, float(blocks.attrs["sampling_rate_hz"]))
    bands = blocks.sizes["band"]
    level = hats[:, None, :, None] * white
    shapes = np.eye(bands)[:, None, None, :]
    bursts = tuple(
        _burst(first, stop, blocks, white)
        for first, stop in stretches(blocks.sizes["block"]).tolist()
    )
    found = [
        Candidate("~bias(t)", "mean", (), (Variant({}, _numbered(len(hats)), hats[:, None, :]),)),
        Candidate("~N(t)", "power", (), (Variant({}, _numbered(len(hats)), level),)),
        Candidate("~burst", "power", (), bursts),
        Candidate("~S(f)", "power", (), (*_alone(shapes), Variant({}, _numbered(bands), shapes))),
        Candidate(
            "~outliers",
            "marks",
            (),
            (Variant({}, ("kurtosis",), np.empty(0)),),
            marks=("kurtosis",),
        ),
    ]
    if "cross" in blocks and blocks.sizes["pair"]:
        found.append(Candidate("~cov", "cross", (), _covariances(bands)))
    return found


def _burst(first: int, stop: int, blocks: xr.Dataset, white: Array) -> Variant:
    """White noise that is louder in some blocks."""
    block = np.arange(blocks.sizes["block"])
    inside = ((block >= first) & (block < stop)).astype(np.float64)
    values = {"begin": float(blocks["begin"][first]), "end": float(blocks["end"][stop - 1])}
    return Variant(values, ("0",), inside[None, None, :, None] * white)


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(str(number) for number in range(count))


def _alone(designs: Array) -> tuple[Variant, ...]:
    return tuple(
        Variant({"band": float(number)}, ("0",), one[None]) for number, one in enumerate(designs)
    )


def _covariances(bands: int) -> tuple[Variant, ...]:
    """Covariance in any one band, or in four groups of bands, with any phase."""
    alone = [np.eye(bands)[number] for number in range(bands)]
    groups = [
        np.isin(np.arange(bands), component).astype(float)
        for component in np.array_split(np.arange(bands), min(4, bands))
    ]
    variants = [_phased([one]) for one in alone]
    return (*variants, _phased(groups))


def _phased(rows: list[Array]) -> Variant:
    columns = np.array([factor * row for row in rows for factor in (1.0 + 0j, 1j)])
    return Variant({}, _numbered(len(columns)), columns[:, None, None, :])

"""Held-out intervals: four interleaved folds, at three lengths.

Short folds show events; long ones show slow drifts, which a random walk bridges in a short gap.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools

#: Folds of each length; consecutive intervals belong to them in turn.
FOLDS = 4
#: Length of an interval [s], and its largest share of the record. Design choice.
LENGTHS = ((100.0, 1.0 / 36.0), (350.0, 1.0 / 10.0), (900.0, 1.0 / 4.0))


def fold_blocks(blocks: xr.Dataset) -> xr.DataArray:
    """Assign every block to a fold, 0 to 3, at every length: ``fold(length, block)``.

    The coordinate ``length`` of an interval [s] is a whole number of blocks.

    Examples
    --------
    >>> edges = np.arange(181) * 20.0
    >>> blocks = xr.Dataset({"begin": ("block", edges[:-1]), "end": ("block", edges[1:])})
    >>> folds = fold_blocks(blocks)
    >>> folds.length.values, folds[0, ::5][:6].values
    (array([100., 360., 900.]), array([0, 1, 2, 3, 0, 1]))
    """
    begin, end = blocks["begin"].values, blocks["end"].values
    n = begin.size
    step = float(end[0] - begin[0])
    span = n * step
    block_count = [max(1, round(min(seconds, share * span) / step)) for seconds, share in LENGTHS]
    fold = np.stack([np.arange(n) // count % FOLDS for count in block_count])
    attributes = {"units": "s", "long_name": "length of a held-out interval"}
    return xr.DataArray(
        fold,
        dims=("length", "block"),
        coords={"length": ("length", step * np.array(block_count, dtype=np.float64), attributes)},
        name="fold",
        attrs={"units": "1", "long_name": "fold in which the block is held out"},
    )


def fold_subsets(fold: xr.DataArray) -> Bools:
    """Return the blocks used (1 + lengths * FOLDS, block): all, then all but each fold.

    The folds of a length follow each other.
    """
    values = fold.values
    subsets = [values != number for number in range(FOLDS)]
    held = np.stack(subsets, axis=1).reshape(-1, values.shape[1])
    return np.concatenate([np.ones((1, values.shape[1]), np.bool_), held])

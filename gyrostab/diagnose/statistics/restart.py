"""Score of the transients after restarts, with all restarts superposed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.diagnose.statistics.base import Statistic
from gyrostab.diagnose.statistics.mean import MeanNoise, apply_precision, mean_noise
from gyrostab.diagnose.statistics.mismatch_wording import axes_text
from gyrostab.diagnose.statistics.scores import BlockWindows, statistic_dataset

_DECAY_BLOCKS = (2, 6, 18)  # in which a transient falls to 1/e; design choice
_SIDE_BLOCKS = 15  # before and after a restart, that are compared; design choice


class Restart(Statistic):
    """Transients after restarts, with all restarts superposed."""

    name = "restart"
    view = "restart"
    grows_in_time = False

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
        """Score transients that begin equally at every restart, and a jump of the mean at each.

        Both are independent of a constant of the record, and have the noise of the simulation.
        ``estimate`` is the transient at the restart, or the jump [degree hour-1].
        """
        restarts = _restart_blocks(blocks)
        if restarts.size == 0:
            return None
        block, block_count = float(blocks.attrs["block_s"]), blocks.sizes["block"]
        designs, windows = _restart_designs(restarts, block_count)
        residual = blocks["mean"].values - baseline["known_mean"].values
        z, estimate = (np.full((*residual.shape[:-1], len(designs)), np.nan) for _ in range(2))
        for axis in range(blocks.sizes["axis"]):
            series = residual[..., axis, :]
            noise = mean_noise(blocks, baseline, axis, series)
            amount, information = _matched_filter(series, designs, noise)
            with np.errstate(divide="ignore", invalid="ignore"):
                z[..., axis, :] = amount / np.sqrt(information)
                estimate[..., axis, :] = amount / information
        # Each window has only one column.
        kinds = [f"transient of {k} blocks" for k in _DECAY_BLOCKS] + ["jump"]
        column = np.concatenate(
            [np.arange(len(_DECAY_BLOCKS)), np.full(restarts.size, len(_DECAY_BLOCKS))]
        )
        scores = np.full((*z.shape, len(kinds)), np.nan)
        size, place = scores.copy(), np.arange(column.size)
        scores[..., place, column], size[..., place, column] = z, estimate
        tau = np.array([*_DECAY_BLOCKS, _SIDE_BLOCKS], dtype=float) * block
        return statistic_dataset(
            blocks,
            windows=windows,
            columns={"quantity": kinds, "tau_min_s": block, "tau_max_s": tau},
            z=scores,
            ratio=np.abs(scores),
            estimate=size,
        )

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        return (
            f"The rate of {axes_text(region['axes'])} after gaps in which the tool may have been "
            f"off is not what it was before them, {when}"
        )


def _restart_blocks(blocks: xr.Dataset) -> np.ndarray:
    """Return the first block after each restart, by most of its samples, with blocks before it."""
    begin, end = blocks["begin"].values, blocks["end"].values
    lost, back = (blocks[name].values[:, None] for name in ("restart_begin", "restart_end"))
    first_blocks = (end - back <= np.maximum(lost - begin, 0.0)).sum(axis=1)
    return np.unique(first_blocks[(first_blocks > 0) & (first_blocks < blocks.sizes["block"])])


def _restart_designs(restarts: np.ndarray, block_count: int) -> tuple[Floats, BlockWindows]:
    """Return the designs of all transients and jumps, and their windows."""
    age = np.full(block_count, np.inf)
    for start in restarts:
        age[start:] = np.arange(block_count - start)
    rows = [np.exp(-age / k) for k in _DECAY_BLOCKS]
    first = [int(restarts[0])] * len(_DECAY_BLOCKS)
    stop = [int(min(restarts[-1] + 2 * k, block_count)) for k in _DECAY_BLOCKS]
    for start in restarts:
        row = np.zeros(block_count)
        low, high = max(start - _SIDE_BLOCKS, 0), min(start + _SIDE_BLOCKS, block_count)
        row[low:start], row[start:high] = -0.5, 0.5
        rows.append(row)
        first.append(int(start))
        stop.append(int(high))
    return np.array(rows), BlockWindows(
        np.array(first, dtype=np.int64), np.array(stop, dtype=np.int64)
    )


def _matched_filter(residual: Floats, designs: Floats, noise: MeanNoise) -> tuple[Floats, Floats]:
    """Return filter output and information of each design, both independent of a constant."""
    weighted = apply_precision(designs, noise)
    weighted_ones = apply_precision(np.ones((1, designs.shape[-1])), noise)[0]
    weighted = weighted - np.outer(weighted.sum(axis=-1) / weighted_ones.sum(), weighted_ones)
    information = (weighted * designs).sum(axis=-1)
    return np.nan_to_num(residual) @ weighted.T, np.where(information > 0, information, np.nan)

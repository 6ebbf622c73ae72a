"""What happens after a restart, all restarts laid on top of each other."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.diagnose.statistics.mean import MeanNoise, mean_noise, precision
from gyrostab.diagnose.statistics.scores import Array, Windows, statistic_dataset, values_of

__all__ = ["score"]

_TIMES = (2, 6, 18)  # blocks in which a transient falls to 1/e
_BESIDE = 15  # blocks before and after a restart that are compared


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
    """Score transients that begin at every restart alike, and a jump of the mean at each.

    Both are free from a constant of the record, and have the noise of the simulation.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records, and what the simulation expects.

    Returns
    -------
    xarray.Dataset or None
        None without restarts. ``estimate`` is the transient at the restart, or the jump [degree
        hour-1].
    """
    at = restart_blocks(blocks)
    if at.size == 0:
        return None
    block, block_count = float(blocks.attrs["block_s"]), blocks.sizes["block"]
    designs, windows = _designs(at, block_count)
    residual = values_of(blocks, "mean", "axis", "block") - values_of(
        baseline, "known_mean", "axis", "block"
    )
    z, estimate = (np.full((*residual.shape[:-1], len(designs)), np.nan) for _ in range(2))
    for axis in range(blocks.sizes["axis"]):
        present = np.isfinite(residual[..., axis, :]).reshape(-1, block_count).any(axis=0)
        noise = mean_noise(blocks, baseline, axis, present)
        amount, information = _matched(residual[..., axis, :], designs, noise)
        with np.errstate(divide="ignore", invalid="ignore"):
            z[..., axis, :] = amount / np.sqrt(information)
            estimate[..., axis, :] = amount / information
    # a window has one column only that it speaks of
    what = [f"transient of {k} blocks" for k in _TIMES] + ["jump"]
    column = np.concatenate([np.arange(len(_TIMES)), np.full(at.size, len(_TIMES))])
    spread = np.full((*z.shape, len(what)), np.nan)
    size = spread.copy()
    spread[..., np.arange(column.size), column], size[..., np.arange(column.size), column] = (
        z,
        estimate,
    )
    tau = np.array([*_TIMES, _BESIDE], dtype=float) * block
    return statistic_dataset(
        "restart",
        blocks,
        windows=windows,
        columns={"what": what, "tau_min_s": block, "tau_max_s": tau},
        z=spread,
        ratio=np.abs(spread),
        estimate=size,
        units="degree hour-1",
    )


def restart_blocks(blocks: xr.Dataset) -> np.ndarray:
    """First whole block after each restart that has blocks on both sides."""
    if "restart_end" not in blocks:
        return np.empty(0, np.int64)
    found = np.searchsorted(blocks["begin"].values, blocks["restart_end"].values - 1e-9)
    return np.unique(found[(found > 0) & (found < blocks.sizes["block"])])


def _designs(at: np.ndarray, block_count: int) -> tuple[Array, Windows]:
    since = np.full(block_count, np.inf)
    for start in at:
        since[start:] = np.arange(block_count - start)
    rows = [np.exp(-since / k) for k in _TIMES]
    first, stop = (
        [int(at[0])] * len(_TIMES),
        [int(min(at[-1] + 2 * k, block_count)) for k in _TIMES],
    )
    for start in at:
        row = np.zeros(block_count)
        low, high = max(start - _BESIDE, 0), min(start + _BESIDE, block_count)
        row[low:start], row[start:high] = -0.5, 0.5
        rows.append(row)
        first.append(int(start))
        stop.append(int(high))
    return np.array(rows), Windows(np.array(first, dtype=np.int64), np.array(stop, dtype=np.int64))


def _matched(residual: Array, designs: Array, noise: MeanNoise) -> tuple[Array, Array]:
    weighted, one = precision(designs, noise), precision(np.ones((1, designs.shape[-1])), noise)[0]
    weighted = weighted - np.outer(weighted.sum(axis=-1) / one.sum(), one)
    information = (weighted * designs).sum(axis=-1)
    return np.nan_to_num(residual) @ weighted.T, np.where(information > 0, information, np.nan)

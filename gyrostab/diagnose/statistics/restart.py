"""What happens after a restart, all restarts laid on top of each other."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.diagnose.statistics.mean import MeanNoise, mean_noise, precision
from gyrostab.diagnose.statistics.scores import Array, Windows, statistic_dataset, values_of

__all__ = ["score"]

_TIMES = (2, 6, 18)  # blocks in which a transient falls to 1/e
_BESIDE = 15  # blocks before and after a restart that are compared


def score(reduced: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
    """Score transients that begin at every restart alike, and a jump of the mean at each.

    Both are free from a constant of the record, and have the noise of the simulation.

    Parameters
    ----------
    reduced, baseline : xarray.Dataset
        Recording or null records, and what the simulation expects.

    Returns
    -------
    xarray.Dataset or None
        None without restarts. ``estimate`` is the transient at the restart, or the jump [degree
        hour-1].
    """
    at = restart_blocks(reduced)
    if at.size == 0:
        return None
    block, blocks = float(reduced.attrs["block_s"]), reduced.sizes["block"]
    designs, windows = _designs(at, blocks)
    residual = values_of(reduced, "mean", "axis", "block") - values_of(
        baseline, "known_mean", "axis", "block"
    )
    z, estimate = (np.full((*residual.shape[:-1], len(designs)), np.nan) for _ in range(2))
    for axis in range(reduced.sizes["axis"]):
        present = np.isfinite(residual[..., axis, :]).reshape(-1, blocks).any(axis=0)
        noise = mean_noise(reduced, baseline, axis, present)
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
        reduced,
        windows=windows,
        columns={"what": what, "tau_min_s": block, "tau_max_s": tau},
        z=spread,
        ratio=np.abs(spread),
        estimate=size,
        units="degree hour-1",
    )


def restart_blocks(reduced: xr.Dataset) -> np.ndarray:
    """First whole block after each restart that has blocks on both sides."""
    if "restart_end" not in reduced:
        return np.empty(0, np.int64)
    found = np.searchsorted(reduced["begin"].values, reduced["restart_end"].values - 1e-9)
    return np.unique(found[(found > 0) & (found < reduced.sizes["block"])])


def _designs(at: np.ndarray, blocks: int) -> tuple[Array, Windows]:
    since = np.full(blocks, np.inf)
    for start in at:
        since[start:] = np.arange(blocks - start)
    rows = [np.exp(-since / k) for k in _TIMES]
    first, stop = [int(at[0])] * len(_TIMES), [int(min(at[-1] + 2 * k, blocks)) for k in _TIMES]
    for start in at:
        row = np.zeros(blocks)
        low, high = max(start - _BESIDE, 0), min(start + _BESIDE, blocks)
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

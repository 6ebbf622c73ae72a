"""Score of rates that repeat with the tool rotation or with the feedback ramp."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.diagnose.reduce.block_statistics import noise_at_orders
from gyrostab.diagnose.statistics.scores import (
    Array,
    Windows,
    cube_root_score,
    exponential_score,
    statistic_dataset,
    sum_over_windows,
    values_in_order,
    window_set,
)

__all__ = ["LENGTHS", "score"]

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (5, 15)


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
    """Score the harmonics that are phase-locked to the rotation, and the mean by ramp phase.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records, and the expectation of the simulation.

    Returns
    -------
    xarray.Dataset or None
        None with neither channel. ``estimate`` is the amplitude, or the rms over the phase [degree
        hour-1].
    """
    windows = window_set(blocks.sizes["block"], LENGTHS)
    rate, block = float(blocks.attrs["sampling_rate_hz"]), float(blocks.attrs["block_s"])
    scored: list[tuple[Array, ...]] = []
    what: list[str] = []
    tau_min, tau_max = [], []
    if "order" in blocks:
        scored.append(_score_orders(blocks, baseline, windows))
        what += [f"order {h}" for h in range(1, blocks.sizes["harmonic"] + 1)]
        turning = _turns_per_second(blocks)
        turning_blocks = turning[turning > 0]
        low, high = (
            (float(turning_blocks.min()), float(turning_blocks.max()))
            if turning_blocks.size
            else (1.0 / block, rate / 2.0)
        )
        tau_min += [0.371 / (h * high) for h in range(1, blocks.sizes["harmonic"] + 1)]
        tau_max += [0.371 / (h * low) for h in range(1, blocks.sizes["harmonic"] + 1)]
    if "profile" in blocks:
        scored.append(_score_profile(blocks, baseline, windows))
        what.append("ramp phase")
        tau_min.append(1.0 / rate)
        tau_max.append(block)
    if not scored:
        return None
    z, ratio, estimate = (np.concatenate(values, axis=-1) for values in zip(*scored, strict=True))
    return statistic_dataset(
        "spectrum",
        blocks,
        windows=windows,
        columns={"what": what, "tau_min_s": tau_min, "tau_max_s": tau_max},
        z=z,
        ratio=ratio,
        estimate=estimate,
        units="degree hour-1",
        one_sided=True,
    )


def _turns_per_second(blocks: xr.Dataset) -> Array:
    """Return turns per second in each block."""
    if "channel_rotation_rate" not in blocks:
        return np.zeros(blocks.sizes["block"])
    return np.asarray(np.nan_to_num(np.abs(blocks["channel_rotation_rate"].values) / 360.0))


def _score_orders(blocks: xr.Dataset, baseline: xr.Dataset, windows: Windows) -> tuple[Array, ...]:
    """Return score, ratio and amplitude of the coherent sum by (record), axis, window, harmonic."""
    order = values_in_order(blocks, "order", "axis", "block", "harmonic")
    samples = values_in_order(blocks, "samples", "axis", "block")
    rate = float(blocks.attrs["sampling_rate_hz"])
    turning, spectrum = (
        _turns_per_second(blocks),
        baseline["spectrum"].transpose("axis", "block", "band").values,
    )
    bands = np.log(baseline["frequency"].values)
    log_frequency = np.log(
        np.clip(
            turning[:, None] * np.arange(1, order.shape[-1] + 1),
            np.exp(bands[0]),
            np.exp(bands[-1]),
        )
    )
    density = np.empty((*spectrum.shape[:2], order.shape[-1]))
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, block in np.ndindex(spectrum.shape[:2]):
            density[axis, block] = np.exp(
                np.interp(log_frequency[block], bands, np.log(spectrum[axis, block]))
            )
        density = noise_at_orders(blocks, density)
        # Of |order|^2: two parts of 2 S rate / n each.
        variance = 4.0 * density * rate / samples[..., None]
        present = (
            np.isfinite(order)
            & np.isfinite(variance)
            & (variance > 0)
            & (turning > 0.5 / float(blocks.attrs["block_s"]))[:, None]
        )
        weight = np.where(present, 1.0 / variance, 0.0)
        sums = sum_over_windows(np.where(present, order, 0.0) * weight, windows)
        total = sum_over_windows(weight, windows)
        ratio = np.where(total > 0, np.abs(sums) ** 2 / total, np.nan)
        amplitude = np.abs(sums) / total
    return exponential_score(ratio), ratio, amplitude


def _score_profile(blocks: xr.Dataset, baseline: xr.Dataset, windows: Windows) -> tuple[Array, ...]:
    """Return score, ratio and rms of the mean by phase, by (record), axis, window, 1."""
    profile = values_in_order(blocks, "profile", "axis", "block", "phase")
    samples = values_in_order(blocks, "profile_samples", "axis", "block", "phase")
    width = (blocks["band_high"] - blocks["band_low"]).values
    variance = (
        2.0
        * (baseline["spectrum"].transpose("axis", "block", "band").values * width).sum(axis=-1)[
            ..., None
        ]
    )
    present = np.isfinite(profile) & (samples > 0) & np.isfinite(variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(present, samples / variance, 0.0)
        sums, total = (
            sum_over_windows(np.where(present, profile, 0.0) * weight, windows),
            sum_over_windows(weight, windows),
        )
        used = (total > 0).sum(axis=-1, keepdims=True)
        square = np.where(total > 0, sums**2 / total, 0.0).sum(axis=-1, keepdims=True)
        ratio = np.where(used > 1, square / used, np.nan)
        excess = np.maximum(square - used, 0.0) / total.sum(axis=-1, keepdims=True)
    return cube_root_score(ratio, np.where(used > 1, used / 2.0, np.nan)), ratio, np.sqrt(excess)

"""Score of slow motion common to axes, which each axis alone could have as its own random walk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.diagnose.evidence.wandering import expected_processes
from gyrostab.diagnose.statistics.base import Statistic
from gyrostab.diagnose.statistics.cross_spectrum import correlation_score
from gyrostab.diagnose.statistics.mean import slow_coefficients
from gyrostab.diagnose.statistics.mismatch_wording import capitalise_axes, taus_text
from gyrostab.diagnose.statistics.scores import (
    BlockWindows,
    cube_root_score,
    moving_sum,
    statistic_dataset,
    sum_over_windows,
    window_set,
)
from gyrostab.kernels.regression.state_space import flicker_states, whiten
from gyrostab.units import HOUR

#: Indices of the first and of the second axis of each pair.
Pairs = tuple[Ints, Ints]
#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (60,)
#: Blocks over which the increments are averaged.
SPANS = (1, 2, 4, 8, 16, 32, 64)
_MIN_AVERAGES = 8.0  # independent averages, for a meaningful correlation; design choice
#: Independent averages per non-overlapping one, if they overlap.
_OVERLAP_FACTOR = 1.5
_MIN_LOG_DETERMINANT = -27.0  # that of a singular matrix, up to rounding
#: Probe series of white noise, which measure the response of the increments to a known covariance.
_PROBE_COUNT, _PROBE_SEED = 64, 20


class CommonMode(Statistic):
    """Slow motion common to axes."""

    name = "common_mode"
    view = "cross_axis"

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
        """Score the correlation of the increments of block means between axes, over 1 to 64 blocks.

        The block means of each axis are whitened by its noise: the increment is the part that the
        means before do not predict, that is the increment of a random walk or the mean of white
        noise. The noise of different axes is independent, whatever its size. The score is therefore
        the correlation, which no calibration error changes. The increments are averaged over
        several blocks, because the common motion may be slow.

        A pair of axes has a row, whose ``ratio`` and ``estimate`` are the correlation. Three axes
        or more have a row of all together, by the determinant of their correlations; its
        ``estimate`` is the root of their mean square. None with one axis, or for too short a
        record.
        """
        axes = [str(axis) for axis in blocks["axis"].values]
        block_count = blocks.sizes["block"]
        spans = [span for span in SPANS if _OVERLAP_FACTOR * block_count / span >= _MIN_AVERAGES]
        if len(axes) < 2 or not spans:
            return None
        windows = window_set(block_count, LENGTHS)
        residual = blocks["mean"].values - baseline["known_mean"].values
        present = np.isfinite(residual).reshape(-1, *residual.shape[-2:]).all(axis=0)
        increments = _whiten_means(residual, present, blocks, baseline)
        pairs = np.triu_indices(len(axes), 1)
        shared = (
            _shared_increments(present, pairs, blocks, baseline) if "cross" in baseline else None
        )
        correlations = [
            _correlate_pairs(increments, present, pairs, windows, span, shared) for span in spans
        ]
        r, count = (np.stack(part, axis=-1) for part in zip(*correlations, strict=True))
        z = correlation_score(r, np.broadcast_to(count, r.shape))
        rows = [f"{axes[a]} {axes[b]}" for a, b in zip(*pairs, strict=True)]
        if len(rows) > 1:
            z = np.concatenate(
                [z, _score_all_axes(r, count, pairs, len(axes))[..., None, :, :]], axis=-3
            )
            r = np.concatenate([r, np.sqrt((r**2).mean(axis=-3, keepdims=True))], axis=-3)
            rows = [*rows, " ".join(axes)]
        block = float(blocks.attrs["block_s"])
        return statistic_dataset(
            blocks,
            rows=rows,
            windows=windows,
            columns={
                "quantity": "slow",
                "tau_min_s": block * np.array(spans, dtype=float),
                "tau_max_s": block * block_count / 2.0,
            },
            z=z,
            ratio=np.abs(r),
            estimate=r,
        )

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        return (
            f"{capitalise_axes(region['axes'])} drift together (correlation "
            f"{region['estimate']:.2g}) {when}, at {taus_text(region)}, which the random walks of "
            "independent gyros do not"
        )


def _whiten_means(
    residual: Floats, available: Bools, blocks: xr.Dataset, baseline: xr.Dataset
) -> Floats:
    """Whiten block means by (record), axis, block; zero where missing."""
    white = baseline["mean_variance"].values
    begin = blocks["begin"].values
    end = blocks["end"].values
    block = float(blocks.attrs["block_s"])
    share, times, faster = flicker_states(block, float(end[-1] - begin[0]))
    increments = np.empty_like(residual)
    for axis in range(residual.shape[-2]):
        b, k = slow_coefficients(baseline, axis)
        present = available[axis] & np.isfinite(white[axis]) & (white[axis] > 0)
        variance = np.where(present, white[axis] + b**2 * faster, 1.0)
        series = residual[..., axis, :].reshape(-1, residual.shape[-1])
        columns = np.ascontiguousarray(np.where(present, series, 0.0).T)
        processes = expected_processes(baseline, axis)
        states = np.append(b**2 * share, processes.square), np.append(times, processes.time)
        whitened, _ = whiten(
            columns,
            variance,
            end - begin,
            present,
            k**2 / HOUR + processes.walk,
            *states,
            float(processes.angle),
        )
        increments[..., axis, :] = whitened.T.reshape(increments[..., axis, :].shape)
    return increments


def _shared_increments(
    present: Bools, pairs: Pairs, blocks: xr.Dataset, baseline: xr.Dataset
) -> tuple[Floats, Floats]:
    """Return increments of one white noise (probe, axis, block), and the share of each pair."""
    series = np.random.default_rng(_PROBE_SEED).standard_normal((_PROBE_COUNT, 1, present.shape[1]))
    series = series * np.sqrt(np.nan_to_num(baseline["mean_variance"].values))
    spectrum = baseline["spectrum"].values[..., 0]
    cross = baseline["cross"].values[..., 0].real
    first, second = pairs
    with np.errstate(divide="ignore", invalid="ignore"):
        share = cross / np.sqrt(spectrum[first] * spectrum[second])
    return _whiten_means(series, present, blocks, baseline), np.nan_to_num(
        np.nanmean(share, axis=-1)
    )


def _correlate_pairs(
    increments: Floats,
    present: Bools,
    pairs: Pairs,
    windows: BlockWindows,
    span: int,
    shared: tuple[Floats, Floats] | None,
) -> tuple[Floats, Floats]:
    """Correlate pairs by (record), pair, window, averaged over `span` blocks; count averages."""
    first, second = pairs

    def products(values: Floats) -> Floats:
        product = values[..., first, :] * values[..., second, :]
        return np.asarray(sum_over_windows(product, windows, axis=-1))

    averages = moving_sum(increments, span)
    square, product = sum_over_windows(averages**2, windows, axis=-1), products(averages)
    if shared is not None:
        product = product - shared[1][:, None] * products(moving_sum(shared[0], span)).mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        r = np.clip(product / np.sqrt(square[..., first, :] * square[..., second, :]), -1.0, 1.0)
    share = _OVERLAP_FACTOR / span if span > 1 else 1.0  # of an average that is independent
    joint = (present[first] & present[second]).astype(float)
    count = sum_over_windows(joint, windows, axis=-1) * share
    memory = _blocks_per_value(averages, pairs)[..., None] * share
    return np.where(count >= _MIN_AVERAGES, r, np.nan), count / np.maximum(memory, 1.0)


def _blocks_per_value(averages: Floats, pairs: Pairs) -> Floats:
    """Return the blocks per independent value of each pair (Bartlett 1935).

    It is the sum of the products of their autocorrelations.
    """
    n = averages.shape[-1]
    power = np.abs(np.fft.rfft(averages, 2 * n, axis=-1)) ** 2
    autocorrelation = np.fft.irfft(power, 2 * n, axis=-1)[..., : n // 4]
    with np.errstate(divide="ignore", invalid="ignore"):
        autocorrelation = np.nan_to_num(autocorrelation / autocorrelation[..., :1])
    first, second = (autocorrelation[..., side, :] for side in pairs)
    return np.asarray(2.0 * (first * second).sum(axis=-1) - 1.0)


def _score_all_axes(r: Floats, count: Floats, pairs: Pairs, axes: int) -> Floats:
    """Score all correlations by (record), window, span, jointly (Bartlett 1954)."""
    matrix = np.broadcast_to(np.eye(axes), (*r.shape[:-3], *r.shape[-2:], axes, axes)).copy()
    matrix[(..., *pairs)] = matrix[(..., *pairs[::-1])] = np.moveaxis(r, -3, -1)
    is_complete = np.asarray(np.isfinite(matrix).all(axis=(-2, -1)))
    sign, logarithm = np.linalg.slogdet(
        np.where(is_complete[..., None, None], matrix, np.eye(axes))
    )
    logarithm = np.maximum(np.where(sign > 0, logarithm, -np.inf), _MIN_LOG_DETERMINANT)
    samples = np.maximum(count.min(axis=-3) - (2.0 * axes + 5.0) / 6.0, 1.0)
    freedom = r.shape[-3]
    value = -samples * logarithm / freedom
    z = cube_root_score(value, np.full(value.shape, freedom / 2.0))
    return np.where(is_complete, z, np.nan)

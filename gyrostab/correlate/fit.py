"""Fit window means or coefficients on a driver: slopes, lags and p-values, in blocks of windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.correlate.drivers import Driver
from gyrostab.correlate.judge import driver_limits
from gyrostab.kernels.regression.coupling import (
    Laws,
    average_windows,
    calibrated,
    decompose,
    fit_lags,
    noise_laws,
    null_weights,
    p_values,
    project_out,
    simulate_p_values,
    slope_interval,
    uncalibrated,
    weights,
)

_MAX_BLOCKS = 160  # longer records are averaged further
_MAX_WINDOWS_PER_LENGTH = 8  # more add no information
_MIN_BLOCKS = 12
#: Level at which a coupling is significant.
SIGNIFICANCE = 0.05
_NOISE_DRAWS = (300, 4000)  # the second where the result of the first may be significant
#: Smallest share of the variance of a driver that the other drivers do not explain.
_MIN_UNEXPLAINED = 1e-3
#: Keys of `_estimate_sensitivity`, and those of the same numbers given the other drivers.
_PARTIAL = {
    "slope": "partial",
    "stderr": "partial_stderr",
    "low": "partial_low",
    "high": "partial_high",
    "p_value": "p_partial",
}
#: Largest share of one block in the variance of the driver; above it, that block decides alone.
_MAX_LEVERAGE = 0.35


class Blocks(NamedTuple):
    """Blocks of the windows that some series share, and the model terms besides the driver."""

    average: Any
    windows: Ints
    pieces: Ints
    offsets: Floats
    trend: Floats
    laws: Laws


@dataclass
class _Design:
    """A driver in the blocks of some series, and the terms and noise laws to fit with it."""

    blocks: Blocks
    driver: Floats  # (block, lag)
    limits: set[str]  # what limits the verdict on any series
    nuisance: Floats  # (block, term): terms fitted with the driver
    timed: Floats  # offsets and trend
    with_channels: Floats  # offsets, trend and the other channels

    @cached_property
    def laws(self) -> Laws:
        """Noise laws without the nuisance terms."""
        return project_out(self.blocks.laws, self.nuisance)

    @cached_property
    def white_laws(self) -> Laws:
        """The law of white noise alone, without the nuisance terms."""
        return project_out(decompose([_law_covariance(self.blocks, 0)], np.zeros(1)), self.nuisance)


def make_blocks(
    mask: Bools, time: Floats, length: float, step: float, share: Floats
) -> Blocks | None:
    """Group windows into blocks at least as long as a window; None if there are too few."""
    windows = np.flatnonzero(mask)
    every = max(1, round(length / step / _MAX_WINDOWS_PER_LENGTH))
    spans = np.rint(time[windows] / step).astype(np.int64) // every
    windows = windows[np.unique(spans, return_index=True)[1]]  # the first known one of each span
    if windows.size < _MIN_BLOCKS:
        return None
    centres_s = time[windows]
    block_length = max(length, step)
    numbers = _number_blocks(centres_s, block_length)
    while numbers[-1] + 1 > _MAX_BLOCKS:
        block_length *= (numbers[-1] + 1) / _MAX_BLOCKS
        numbers = _number_blocks(centres_s, block_length)
    if numbers[-1] + 1 < _MIN_BLOCKS:
        return None
    average = average_windows(numbers)
    centre = np.asarray(average @ centres_s)
    spacing = np.diff(centre)
    covered = (numbers[-1] + 1) * block_length
    pieces = np.concatenate(
        [[0], np.cumsum(spacing > max(3 * length + block_length, 0.1 * covered))]
    )
    pieces = pieces.astype(np.int64)
    offsets = (pieces[:, None] == np.arange(pieces[-1] + 1)).astype(np.float64)
    trend = ((centre - centre.mean()) / (np.ptp(centre) or 1.0))[:, None]
    laws = noise_laws(average, centres_s, length, np.clip(share[windows], 0.05, 1.0))
    return Blocks(average, windows, pieces, offsets, trend, laws)


def _number_blocks(centres_s: Floats, length: float) -> Ints:
    """Number the blocks of this length that hold a window, and return the number by window."""
    return np.unique((centres_s / length).astype(np.int64), return_inverse=True)[1]


def fit_driver(
    blocks: Blocks | None,
    series: Floats,
    driver: Driver,
    other_series: list[Floats],
    lags: Floats,
    level: float,
) -> list[dict[str, Any]]:
    """Fit one driver to series (rows) that share their windows, with one entry per series."""
    if blocks is None:
        reason = "too_few" if np.isfinite(driver.values).any() else "no_values"
        return [_empty_entry({reason}) for _ in series]
    design = _make_design(blocks, driver, other_series)
    if design.limits & {"constant", "too_few", "one_moment"}:
        return [_empty_entry(design.limits, windows=blocks.windows.size) for _ in series]
    y = np.asarray(blocks.average @ series[:, blocks.windows].T)
    return [_fit_series(design, row, lags, level) for row in y.T]


def _make_design(blocks: Blocks, driver: Driver, other_series: list[Floats]) -> _Design:
    """Average a driver over blocks, find what limits a fit of it, and the terms to fit with it."""
    x = np.asarray(blocks.average @ driver.values[:, blocks.windows].T)
    limits = driver_limits(x[:, 0], blocks.pieces, driver.units, derived=driver.derived)
    timed = np.concatenate([blocks.offsets, blocks.trend], axis=1)
    nuisance = blocks.offsets if "no_reversal" in limits else timed
    if "constant" not in limits:
        if x.shape[0] - nuisance.shape[1] - 1 < _MIN_BLOCKS // 2:
            limits = limits | {"too_few"}
        elif _largest_leverage(x[:, 0], nuisance) > _MAX_LEVERAGE:
            limits = limits | {"one_moment"}
    averages = [
        np.asarray(blocks.average @ row[blocks.windows])
        for row in other_series
        if np.isfinite(row[blocks.windows]).all()
    ]
    with_channels = np.concatenate(
        [timed, *(_standardise_series(row)[:, None] for row in averages if np.ptp(row) > 0)],
        axis=1,
    )
    return _Design(blocks, x, limits, nuisance, timed, with_channels)


def _fit_series(design: _Design, row: Floats, lags: Floats, level: float) -> dict[str, Any]:
    """Fit the block means of one series on a driver."""
    blocks, x, limits, nuisance = design.blocks, design.driver, design.limits, design.nuisance
    if np.ptp(row) == 0.0:
        return _empty_entry(limits | {"constant_series"}, windows=blocks.windows.size)
    entry = _estimate_sensitivity(design.laws, row, x, lags, level) | {
        "limits": set(limits),
        "windows": blocks.windows.size,
    }
    column = x[:, entry["best"]]
    entry |= {
        "correlation": _partial_correlation(row, column, np.ones((row.size, 1))),
        "partial_time": _partial_correlation(row, column, design.timed),
        "partial_channels": _partial_correlation(row, column, design.with_channels),
        "effective": _effective_samples(row, column, nuisance, entry["stderr"]),
    }
    entry |= _fit_ramps(blocks, entry["law"], nuisance, row[:, None], column[:, None])
    if "no_reversal" in limits:
        white = _estimate_sensitivity(design.white_laws, row, x, lags, level)
        entry |= {
            f"{key}_white": white[white_key]
            for key, white_key in (("p", "p_search"), ("slope", "slope"), ("lag", "lag"))
        }
    if design.timed.shape[1] < design.with_channels.shape[1] < row.size - 3:
        channel_fit = fit_lags(
            project_out(blocks.laws, design.with_channels),
            row[:, None] / np.std(row),
            _standardise_series(column)[:, None],
        )
        entry["p_channels"] = float(p_values(channel_fit)[0, 0])
    return entry


def fit_partial_effects(
    blocks: Blocks | None,
    series: Floats,
    drivers: list[Driver],
    entries: Sequence[dict[str, Any]],
    level: float,
) -> None:
    """Fit one series on every driver, given the others at their best-fitting lags.

    Drivers without a fit of one driver alone are left out.
    """
    for entry in entries:
        entry |= dict.fromkeys(_PARTIAL.values(), np.nan)
    fitted = [d for d, entry in enumerate(entries) if "best" in entry]
    if blocks is None:
        return
    y = np.asarray(blocks.average @ series[blocks.windows])
    columns = {
        d: np.asarray(blocks.average @ drivers[d].values[entries[d]["best"], blocks.windows])
        for d in fitted
    }
    for d in fitted:
        other_columns = [_standardise_series(columns[e])[:, None] for e in fitted if e != d]
        nuisance = np.concatenate([blocks.offsets, blocks.trend, *other_columns], axis=1)
        if (
            y.size - nuisance.shape[1] - 1 < _MIN_BLOCKS // 2
            or _unexplained_share(columns[d], nuisance) < _MIN_UNEXPLAINED
        ):
            continue
        sensitivity = _estimate_sensitivity(
            project_out(blocks.laws, nuisance), y, columns[d][:, None], np.zeros(1), level
        )
        entries[d].update({partial: sensitivity[name] for name, partial in _PARTIAL.items()})


def _unexplained_share(x: Floats, columns: Floats) -> float:
    """Compute the share of the variance of a series that a linear fit leaves."""
    return float(np.sum(_subtract_fit(x, columns) ** 2) / max(float(np.var(x)) * x.size, 1e-300))


def _estimate_sensitivity(
    laws: Laws, y: Floats, x: Floats, lags: Floats, level: float
) -> dict[str, Any]:
    """Find lag, slope and interval of one series, and its p-values at that lag and at any lag.

    The p-values are from noise that is simulated under the laws by their weights. The interval
    excludes 0 exactly where the p-value at that lag is below one minus the level.
    """
    scale, driver_scale = float(np.std(y)), np.maximum(np.std(x, axis=0), 1e-300)
    driver = (x - x.mean(axis=0)) / driver_scale
    fit = fit_lags(laws, ((y - y.mean()) / scale)[:, None], driver)
    p_of_lags = p_values(fit)[0]
    best = int(np.argmin(p_of_lags))
    for draws in _NOISE_DRAWS:
        p_of_noise = simulate_p_values(laws, driver, null_weights(fit, 0), draws)
        p_at_lag = p_of_noise[:, best]
        p_value = calibrated(float(p_of_lags[best]), p_at_lag)
        p_search = max(p_value, calibrated(float(p_of_lags[best]), p_of_noise.min(axis=1)))
        if p_search > SIGNIFICANCE:
            break
    interval = slope_interval(fit, 0, best, uncalibrated(1.0 - level, p_at_lag))
    slope, error, low, high = (value * scale / float(driver_scale[best]) for value in interval)
    entry = {
        "best": best,
        "lag": float(lags[best]),
        "law": int(np.argmax(weights(fit)[:, 0, best])),
        "p_value": p_value,
        "p_search": p_search,
    }
    return entry | {"slope": slope, "stderr": error, "low": low, "high": high}


def _law_covariance(blocks: Blocks, law: int) -> Floats:
    return np.asarray(blocks.laws.factor[law] @ blocks.laws.factor[law].T)


def _empty_entry(limits: set[str], *, windows: int = 0) -> dict[str, Any]:
    names = "lag slope stderr low high p_value p_search correlation partial_time partial_channels"
    names += " effective rising rising_stderr falling falling_stderr"
    return {**dict.fromkeys(names.split(), np.nan), "limits": limits, "windows": windows}


def _largest_leverage(x: Floats, columns: Floats) -> float:
    """Find the largest share of one block in the variance of the driver."""
    squares = _subtract_fit(x, columns) ** 2
    return float(squares.max() / max(float(squares.sum()), 1e-300))


def _subtract_fit(x: Floats, columns: Floats) -> Floats:
    """Return what the least-squares fit of the `columns` leaves of a series."""
    q, _ = np.linalg.qr(columns)
    return np.asarray(x - q @ (q.T @ x))


def _standardise_series(row: Floats) -> Floats:
    return np.asarray((row - row.mean()) / np.std(row))


def _partial_correlation(y: Floats, x: Floats, columns: Floats) -> float:
    y, x = _subtract_fit(y, columns), _subtract_fit(x, columns)
    size = float(np.sqrt((y @ y) * (x @ x)))
    return float(np.clip(y @ x / size, -1.0, 1.0)) if size > 0 else np.nan


def _effective_samples(y: Floats, x: Floats, nuisance: Floats, error: float) -> float:
    """Count the independent samples whose ordinary regression would have this standard error.

    The count is at most the number of blocks.
    """
    residual = _subtract_fit(y, np.concatenate([nuisance, x[:, None]], axis=1))
    driver_residual = _subtract_fit(x, nuisance)
    samples = (
        float(residual.var() / (max(float(driver_residual.var()), 1e-300) * error**2))
        if error > 0
        else np.inf
    )
    return float(min(y.size, samples + nuisance.shape[1] + 1))


def _fit_ramps(
    blocks: Blocks, law: int, nuisance: Floats, y: Floats, x: Floats
) -> dict[str, float]:
    """Fit the slope while the driver rises and while it falls, each with a separate constant."""
    rises = np.gradient(x[:, 0]) > 0
    covariance = _law_covariance(blocks, law)
    out = {}
    for name, part in (("rising", rises), ("falling", ~rises)):
        chosen = np.flatnonzero(part)
        out[name] = out[f"{name}_stderr"] = np.nan
        columns = nuisance[chosen][:, 1:]  # the offsets of all segments add up to the constant
        columns = np.concatenate(
            [
                np.ones((chosen.size, 1)),
                columns[:, np.ptp(columns, axis=0) > 0] if chosen.size else columns,
            ],
            axis=1,
        )
        if chosen.size < _MIN_BLOCKS // 2 + columns.shape[1] or np.ptp(x[chosen]) < 0.1 * np.ptp(x):
            continue
        if (
            np.linalg.matrix_rank(
                np.concatenate([columns, _standardise_series(x[chosen, 0])[:, None]], axis=1)
            )
            <= columns.shape[1]
        ):
            continue
        fit = fit_lags(
            project_out(decompose([covariance[np.ix_(chosen, chosen)]], np.zeros(1)), columns),
            y[chosen],
            x[chosen],
        )
        out[name], out[f"{name}_stderr"] = float(fit.slope[0, 0, 0]), float(fit.stderr[0, 0, 0])
    return out

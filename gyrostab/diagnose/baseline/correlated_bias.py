"""Evidence of an exponentially correlated bias next to the noise of an axis.

Its spectrum is level at low frequencies and falls beyond a corner. Flicker and random walk of the
right size come close to either part, but not to both. Block means and band powers must therefore be
explained together, with the same flicker and random walk; each alone, with its own, shows only a
part of the evidence. Where the powers scatter more about the best fit than their own statistics
say, because of lines or of the steep spectrum that leaks into all bands, they count less.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.optimize import OptimizeResult

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.diagnose.baseline.axis_means import AxisMeans, maximise_likelihood
from gyrostab.diagnose.baseline.expected_statistics import reduced_shape
from gyrostab.diagnose.baseline.posterior import (
    BandPowers,
    average_groups,
    fine_grid,
    fit_squares,
    with_floor,
)
from gyrostab.diagnose.evidence.held_out import mean_residual
from gyrostab.diagnose.evidence.wandering import add_correlated, expected_processes
from gyrostab.diagnose.predict.condition import SCORING_STEPS, fit_powers
from gyrostab.diagnose.predict.linear_model import (
    State,
    band_widths,
    correlated_band_powers,
    unspread_share,
)
from gyrostab.diagnose.reduce.block_statistics import MIN_BLOCKS
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.kernels.regression.nonnegative import solve_nonnegative
from gyrostab.units import HOUR

_MIN_NOISE_SHARE = 0.05  # of the power of Q and N, that effects may leave; design choice

_MIN_CHANGE = 1e-6  # of the expected powers, from which effects change them; above rounding errors
_SEARCH_GROUPS = 30  # of blocks of similar power, where effects change it; limits time
#: Range of the ratio of the low-frequency density of the bias to that of white noise. Design
#: choice.
_DENSITY_RATIOS = np.array([0.1, 1e6])
#: Times at which powers are computed. Between them they are interpolated, to 2e-5 in records of
#: 10 min to 4 h at 10 and 400 Hz.
_TIMES = 24
#: Values of every parameter, evenly spaced in log, from which a search may start. With 9, the
#: evidence of 16 records changed by 0.06 nats or less.
_STARTS = 7
#: K and B without a bias, relative to those where a search with it may start. Design choice: where
#: K and B are hidden, their gradient is zero; a search from there found 3 nats less in one of 16
#: records.
_SMALLER = 10.0
_STEP = 0.05  # of a logarithm, for the curvature of the likelihood by differences


class CorrelatedBias(NamedTuple):
    """A bias that explains the slow noise of an axis best."""

    #: Log Bayes factor against the noise without it, for any rms and time, equally likely in log.
    nats: float
    rms: float  # degree hour-1
    time: float  # correlation time [s]
    covariance: Floats  # (2, 2): of the logarithms of rms and time


@dataclass(frozen=True)
class _AxisRecord:
    """Means and powers of an axis, and what they are explained by."""

    blocks: xr.Dataset
    bands: BandPowers
    noise: Floats  # (cell,): power of Q and N that fit best without slow noise
    effects: Floats  # (cell,): power of the effects in the model
    band: Ints  # (cell,)
    unspread: Floats  # (cell,): share of a density that gaps leave in its band
    means: AxisMeans
    #: (parameter, 2): ends of the ranges of the logarithms of K [deg/h^1.5], B [deg/h], and of a
    #: bias: of its rms times the root of its time [deg/h s^0.5], and of its time [s].
    ends: Floats
    log_power: CubicSpline  # of a bias of unit variance (band,), by the logarithm of its time

    def log_likelihoods(self, points: Floats) -> Floats:
        """Return the log likelihoods of means and powers, (2, point), with these parameters.

        They are the logarithms of K and B, and of a bias if there is one, (point, parameter). Q and
        N are the likeliest ones in the powers; the means have the white noise of the calibration.
        """
        K, B, *bias = np.exp(np.clip(points, *self.ends[: points.shape[1]].T)).T
        added = self.effects + np.square([B, K]).T @ self.bands.columns[:, 2:].T
        means = [self.means] * len(points)
        if bias:
            variance, time = bias[0] ** 2 / bias[1], bias[1]
            means = [
                self.means._replace(wander=add_correlated(self.means.wander, *process))
                for process in zip(variance.tolist(), time.tolist(), strict=True)
            ]
            added = added + variance[:, None] * self._unit_powers(time)
        mean_nats = [
            axis_means.log_likelihood(K[[i]], B[[i]])[0] for i, axis_means in enumerate(means)
        ]
        expected = self._fit_fast_noise(added)
        power_nats = -((np.log(expected) + self.bands.power / expected) @ self.bands.weight)
        return np.array([mean_nats, power_nats])

    def _fit_fast_noise(self, added: Floats) -> Floats:
        """Return the expected powers, those of the likeliest Q and N added (Fisher scoring)."""
        columns, least = self.bands.columns[:, :2], _MIN_NOISE_SHARE * self.noise
        expected = np.maximum(self.noise + added, least)
        for _ in range(SCORING_STEPS):
            weighted = columns.T * (self.bands.weight / expected**2)[:, None]
            right = (weighted @ (self.bands.power - added)[..., None])[..., 0]
            square = solve_nonnegative(weighted @ columns, right)
            expected = np.maximum(square @ columns.T + added, least)
        return expected

    def with_scatter_about(self, point: Floats) -> _AxisRecord:
        """Return the record with powers that count less where they scatter more than expected.

        Their scatter about those of these parameters is their deviance per degree of freedom,
        1 for a good fit (McCullagh and Nelder 1989, Generalized Linear Models, sec. 8.3).
        """
        power_nats = float(self.log_likelihoods(point[None])[1, 0])
        weight, power = self.bands.weight, self.bands.power
        deviance = 2.0 * (-float((weight * (np.log(power) + 1.0)).sum()) - power_nats)
        scatter = max(deviance / max(power.size - point.size - 2, 1), 1.0)
        return replace(self, bands=self.bands._replace(weight=weight / scatter))

    def start_grid(self) -> Floats:
        """Return the values of each parameter from which a search may start, (parameter, value)."""
        low, high = self.ends.T
        return np.linspace(low, high, _STARTS, axis=-1)

    def _unit_powers(self, time: Floats) -> Floats:
        """Return the powers (time, cell) of a bias of unit variance, gaps included."""
        power, width = np.exp(self.log_power(np.log(time))), band_widths(self.blocks)
        level = power @ width / width.sum()
        return np.asarray(
            self.unspread * power[:, self.band] + (1.0 - self.unspread) * level[:, None]
        )

    def find_best(self, points: Floats) -> Floats:
        """Return the most likely of several points, (parameter,)."""
        return np.asarray(points[self.negative_likelihood(points).argmin()])

    def maximise_likelihood(self, starts: Sequence[Floats]) -> list[OptimizeResult]:
        """Find the largest likelihood from several starts; the best first."""
        return maximise_likelihood(self.negative_likelihood, starts, self.ends[: starts[0].size])

    def integrate_likelihood(self, peak: OptimizeResult) -> tuple[float, Floats]:
        """Return the evidence by Laplace's approximation, and the covariance of the parameters."""
        count = peak.x.size
        precision = _measure_curvature(self.negative_likelihood, peak.x)
        volume = float(np.log(np.diff(self.ends[:count])).sum())
        width = 0.5 * (count * math.log(2.0 * math.pi) - float(np.linalg.slogdet(precision)[1]))
        return width - float(peak.fun) - volume, np.asarray(np.linalg.inv(precision))

    def negative_likelihood(self, points: Floats) -> Floats:
        """Return the negative log likelihood of means and powers together, (point,)."""
        return np.asarray(-self.log_likelihoods(points).sum(axis=0))


def find_correlated_bias(state: State, axis: str) -> CorrelatedBias | None:
    """Find the correlated bias that explains the slow noise of an axis best, with its evidence.

    Parameters
    ----------
    state : State
        With all other effects in the model.

    Returns
    -------
    CorrelatedBias or None
        None where the record has too few blocks or powers.

    References
    ----------
    Laplace's approximation of the evidence: MacKay 2003, Information Theory, Inference, and
    Learning Algorithms, ch. 27.
    """
    record = _axis_record(state, axis)
    if record is None:
        return None
    K, B, sizes, times = record.start_grid()
    without = record.maximise_likelihood(
        [record.find_best(_combine_values([k], B)) for k in K[::2]]
    )
    # next to a bias, K and B are each about as large as without it, or much smaller
    smaller = np.maximum(without[0].x - math.log(_SMALLER), record.ends[:2, 0])
    noise = _combine_values(*np.column_stack([without[0].x, smaller]))
    with_bias = record.maximise_likelihood(
        [record.find_best(_combine_values(*slow[:, None], sizes, times)) for slow in noise]
    )
    record = record.with_scatter_about(with_bias[0].x)
    without, with_bias = (
        record.maximise_likelihood([peak.x for peak in peaks]) for peaks in (without, with_bias)
    )
    evidence, covariance = record.integrate_likelihood(with_bias[0])
    to_rms = np.array([[1.0, -0.5], [0.0, 1.0]])
    return CorrelatedBias(
        evidence - record.integrate_likelihood(without[0])[0],
        *_rms_and_time(with_bias[0]),
        to_rms @ covariance[-2:, -2:] @ to_rms.T,
    )


def fit_rms(state: State, axis: str, time: float) -> float | None:
    """Find the likeliest rms [deg/h] of a bias with this correlation time [s].

    None as for `find_correlated_bias`.
    """
    record = _axis_record(state, axis)
    if record is None:
        return None
    log_time = math.log(time)
    record = replace(record, ends=np.vstack([record.ends[:-1], [log_time, log_time]]))
    K, B, sizes, _ = record.start_grid()
    start = record.find_best(_combine_values(K[::2], B[::2], sizes, [log_time]))
    point = record.maximise_likelihood([start])[0].x
    return _rms_and_time(record.with_scatter_about(point).maximise_likelihood([point])[0])[0]


def _rms_and_time(peak: OptimizeResult) -> tuple[float, float]:
    size, log_time = peak.x[-2:]
    return math.exp(size - 0.5 * log_time), math.exp(log_time)


def _combine_values(*values: ArrayLike) -> Floats:
    """Return all combinations of the values of each parameter, (point, parameter)."""
    return np.stack(np.meshgrid(*values, indexing="ij"), axis=-1).reshape(-1, len(values))


def _measure_curvature(objective: Callable[[Floats], Floats], best: Floats) -> Floats:
    """Return the Hessian at a minimum, with curvatures of at least 1.

    A parameter that the record hardly determines may then have any value within a few octaves.
    """
    steps = _STEP * np.eye(best.size)
    i, j = np.triu_indices(best.size, 1)
    points = [best[None], best + steps, best - steps, best + steps[i] + steps[j]]
    ends = np.cumsum([len(point) for point in points])[:-1]
    (least,), up, down, crossed = np.split(objective(np.concatenate(points)), ends)
    hessian = np.diag(up + down - 2.0 * least)
    hessian[i, j] = hessian[j, i] = crossed - up[i] - up[j] + least
    values, vectors = np.linalg.eigh(hessian / _STEP**2)
    return np.asarray((vectors * np.maximum(values, 1.0)) @ vectors.T)


def _power_of_effects(state: State, axis: str) -> Floats:
    """Return the power of the effects in the model of an axis, as they fit best, (block, band)."""
    baseline = state.baseline
    noise = axis_values(baseline, "columns", axis) @ axis_values(baseline, "square", axis)
    power = axis_values(baseline, "spectrum", axis) - noise
    count = len(state.power_columns(axis))
    if count:
        without = fit_powers(state, axis, np.ones(count, np.bool_))
        power = power + fit_powers(state, axis) - without
    return power


def _find_free_bands(state: State, axis: str) -> Bools:
    """Find the bands (band,) that have power of any size in the model, such as those of lines."""
    out = np.zeros(state.blocks.sizes["band"], np.bool_)
    for column in state.power_columns(axis):
        shown = np.broadcast_to(column != 0.0, state.expected_power.shape[1:]).any(axis=0)
        out |= shown & (shown.sum() == 1)
    return out


def _axis_record(state: State, axis: str) -> _AxisRecord | None:
    """Collect the means and powers of an axis, averaged over blocks of similar power."""
    blocks, baseline = state.blocks, state.baseline
    values = mean_residual(blocks, baseline, axis)
    present = np.isfinite(values[:, 0])
    bands = _average_bands(state, axis)
    if bands is None or present.sum() < MIN_BLOCKS:
        return None
    columns = bands.columns
    bands = BandPowers(bands.power, columns[:, :4], bands.weight)
    square = with_floor(fit_squares(bands)[0], bands)
    block, variance = float(blocks.attrs["block_s"]), axis_values(baseline, "mean_variance", axis)
    means = AxisMeans(
        np.where(present[:, None], values, 0.0),
        state.given_to("mean", axis),
        variance,
        block,
        present,
        expected_processes(baseline, axis),
    )
    span = len(values) * block
    times = np.array([0.5 * block, span / 4.0])
    if times[1] <= 2.0 * times[0]:
        return None
    sizes = np.sqrt(block * float(np.nanmedian(variance)) * _DENSITY_RATIOS / 2.0)
    slow_noise = means.noise_ranges(*fine_grid(HOUR * float(square[1]), span, block))
    ends = np.vstack([slow_noise, np.log([sizes, times])])
    log_times = np.linspace(ends[-1, 0], ends[-1, 1], _TIMES)
    powers = state.recall(
        lambda: [correlated_band_powers(blocks, float(time)) for time in np.exp(log_times)],
        b"powers of correlated biases",
    )
    return _AxisRecord(
        blocks,
        bands,
        bands.columns[:, :2] @ square[:2],
        columns[:, 6],
        np.rint(columns[:, 4]).astype(np.int64),
        columns[:, 5],
        means,
        ends,
        CubicSpline(log_times, np.log(powers)),
    )


def _average_bands(state: State, axis: str) -> BandPowers | None:
    """Average powers and columns of an axis over blocks of similar power; None if they are few.

    The columns are those of the noise, the number of the band, the share that is not spread, and
    the power of effects.
    """
    blocks, baseline, row = state.blocks, state.baseline, state.axes.index(axis)
    power, shape = blocks["power"].values[row], reduced_shape(blocks)[row]
    power = np.where(_find_free_bands(state, axis), np.nan, power)
    chosen = ~state.masked[row] & (np.isfinite(power) & np.isfinite(shape)).any(axis=1)
    if chosen.sum() < MIN_BLOCKS:
        return None
    band_count = blocks.sizes["band"]
    columns, fixed_power = axis_values(baseline, "columns", axis), _power_of_effects(state, axis)
    cells = np.stack(
        [
            *columns.transpose(2, 0, 1),
            np.broadcast_to(np.arange(band_count, dtype=np.float64), power.shape),
            np.broadcast_to(unspread_share(blocks)[row][:, None], power.shape),
            fixed_power,
        ],
        axis=-1,
    )
    varies = np.ptp(fixed_power[chosen], axis=0).max() > _MIN_CHANGE * np.nanmin(power[chosen])
    return average_groups(
        power,
        shape,
        np.nan_to_num(cells),
        state.expected_power[row].mean(axis=1),
        chosen,
        _SEARCH_GROUPS if varies else 1,
    )

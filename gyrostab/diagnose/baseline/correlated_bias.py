"""Evidence of an exponentially correlated bias next to the noise of an axis.

Its spectrum is level at low frequencies and falls beyond a corner. Flicker and random walk of the
right size come close to either part, but not to both. Block means and band powers must therefore be
explained together, with the same flicker and random walk; each alone, with its own, shows only a
part of the evidence. Where the powers scatter more about the best fit than their own statistics
say, because of lines or of the steep spectrum that leaks into all bands, they count less.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import Bounds, minimize

from gyrostab.diagnose.baseline.axis_means import MAX_SCATTER, AxisMeans
from gyrostab.diagnose.baseline.expected_statistics import (
    common_variance,
    separate_share,
)
from gyrostab.diagnose.baseline.posterior import (
    Fit,
    average_blocks,
    fine_grid,
    fit_squares,
    floor_square,
)
from gyrostab.diagnose.evidence.held_out import mean_residual
from gyrostab.diagnose.evidence.wandering import (
    add_correlated,
    expected_processes,
)
from gyrostab.diagnose.predict.condition import fit_powers
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

Array = NDArray[np.float64]
_MIN_NOISE_SHARE = 0.05  # of the power of Q and N, that effects may leave; design choice
_SCORING_STEPS = 4  # of Fisher scoring, as in `gyrostab.diagnose.predict.condition`
_MIN_CHANGE = 1e-6  # of the expected powers, from which effects change them; above rounding errors
_LEVEL_GROUPS = 30  # of blocks of similar power, where effects change it; limits time
#: Range of the density of the bias at low frequencies, over that of white noise. Design choice.
_DENSITY_RATIOS = np.array([0.1, 1e6])
#: Times at which powers are computed. Between them they are interpolated, to 2e-5 in records of
#: 10 min to 4 h at 10 and 400 Hz.
_TIMES = 24
#: Values of every parameter, evenly spaced in log, from which a search may start. With 9, the
#: evidence of 16 records changed by 0.06 nats or less.
_STARTS = 7
#: K and B without a bias, over those from which a search with it may start. Design choice: where K
#: and B are hidden, their gradient is zero; a search from there found 3 nats less in one of 16
#: records.
_SMALLER = 10.0
_STEP = 0.05  # of a logarithm, for the curvature of the likelihood by differences
_SHORT_STEP = 1e-3  # of a logarithm, for its gradient; far below any error, above rounding


class CorrelatedBias(NamedTuple):
    """A bias that explains the slow noise of an axis best."""

    #: Log Bayes factor over the noise without it, for any rms and time, equally likely in log.
    nats: float
    rms: float  # degree hour-1
    time: float  # correlation time [s]
    covariance: Array  # (2, 2): of the logarithms of rms and time


class _Peak(NamedTuple):
    """Largest likelihood that a search found."""

    point: Array  # (parameter,)
    likelihood: float  # its logarithm
    others: list[Array]  # where it ended from each start, (parameter,) each


@dataclass(frozen=True)
class _AxisRecord:
    """Means and powers of an axis, and what they are explained by."""

    blocks: xr.Dataset
    fit: Fit
    noise: Array  # (cell,): power of Q and N that fit best without slow noise
    effects: Array  # (cell,): power of the effects in the model
    band: NDArray[np.int64]  # (cell,)
    unspread: Array  # (cell,): share of a density that gaps leave in its band
    means: AxisMeans
    #: (parameter,): ends of the ranges of the logarithms of K [deg/h^1.5], B [deg/h], and of a
    #: bias: of its rms times the root of its time [deg/h s^0.5], and of its time [s].
    low: Array
    high: Array
    log_power: CubicSpline  # of a bias of unit variance (band,), by the logarithm of its time

    def log_likelihoods(self, points: Array) -> Array:
        """Return the log likelihoods of means and powers, (2, point), with these parameters.

        They are the logarithms of K and B, and of a bias if there is one, (point, parameter). Q and
        N are the likeliest ones in the powers; the means have the white noise of the calibration.
        """
        width = points.shape[1]
        K, B, *bias = np.exp(np.clip(points, self.low[:width], self.high[:width])).T
        added = self.effects + np.square([B, K]).T @ self.fit.columns[:, 2:].T
        means = [self.means] * len(points)
        if bias:
            variance, time = bias[0] ** 2 / bias[1], bias[1]
            means = [
                self.means._replace(wander=add_correlated(self.means.wander, *process))
                for process in zip(variance.tolist(), time.tolist(), strict=True)
            ]
            added = added + variance[:, None] * self._unit_powers(time)
        of_means = [
            axis_means.log_likelihood(K[[i]], B[[i]])[0] for i, axis_means in enumerate(means)
        ]
        expected = self._fit_fast_noise(added)
        of_powers = (np.log(expected) + self.fit.power / expected) @ self.fit.weight
        return np.array([of_means, -of_powers])

    def _fit_fast_noise(self, added: Array) -> Array:
        """Return the expected powers, those of the likeliest Q and N added (Fisher scoring)."""
        columns, least = self.fit.columns[:, :2], _MIN_NOISE_SHARE * self.noise
        expected = np.maximum(self.noise + added, least)
        for _ in range(_SCORING_STEPS):
            weighted = columns.T * (self.fit.weight / expected**2)[:, None]
            right = (weighted @ (self.fit.power - added)[..., None])[..., 0]
            square = solve_nonnegative(weighted @ columns, right)
            expected = np.maximum(square @ columns.T + added, least)
        return expected

    def with_scatter_about(self, point: Array) -> _AxisRecord:
        """Return the record with powers that count less where they scatter more than expected.

        Their scatter about those of these parameters is their deviance over its degrees of freedom,
        1 for a good fit (McCullagh and Nelder 1989, Generalized Linear Models, sec. 8.3).
        """
        of_powers = float(self.log_likelihoods(point[None])[1, 0])
        weight, power = self.fit.weight, self.fit.power
        deviance = 2.0 * (-float((weight * (np.log(power) + 1.0)).sum()) - of_powers)
        scatter = max(deviance / max(power.size - point.size - 2, 1), 1.0)
        return replace(self, fit=self.fit._replace(weight=weight / scatter))

    def start_grid(self) -> Array:
        """Return the values of each parameter from which a search may start, (parameter, value)."""
        return np.linspace(self.low, self.high, _STARTS, axis=-1)

    def _unit_powers(self, time: Array) -> Array:
        """Return the powers (time, cell) of a bias of unit variance, gaps included."""
        power, width = np.exp(self.log_power(np.log(time))), band_widths(self.blocks)
        level = power @ width / width.sum()
        return np.asarray(
            self.unspread * power[:, self.band] + (1.0 - self.unspread) * level[:, None]
        )

    def find_best(self, points: Array) -> Array:
        """Return the most likely of several points, (parameter,)."""
        return np.asarray(points[self._negative_likelihood(points).argmin()])

    def find_peak(self, starts: Iterable[Array]) -> _Peak:
        """Find the largest likelihood from several starts."""
        ends = np.stack([self.low, self.high])
        searches = [
            minimize(
                self._likelihood_and_gradient,
                start,
                jac=True,
                bounds=Bounds(*ends[:, : start.size]),
            )
            for start in starts
        ]
        best = min(searches, key=lambda result: float(result.fun))
        return _Peak(best.x, -float(best.fun), [result.x for result in searches])

    def measure_evidence(self, peak: _Peak) -> tuple[float, Array]:
        """Return the evidence by Laplace's approximation, and the covariance of the parameters."""
        count = peak.point.size
        precision = _measure_curvature(self._negative_likelihood, peak.point)
        volume = float(np.log(self.high[:count] - self.low[:count]).sum())
        width = 0.5 * (count * math.log(2.0 * math.pi) - float(np.linalg.slogdet(precision)[1]))
        return peak.likelihood + width - volume, np.asarray(np.linalg.inv(precision))

    def _negative_likelihood(self, points: Array) -> Array:
        return np.asarray(-self.log_likelihoods(points).sum(axis=0))

    def _likelihood_and_gradient(self, point: Array) -> tuple[float, Array]:
        """Return the negative likelihood and its gradient by differences, within the ranges."""
        inside = np.where(point + _SHORT_STEP <= self.high[: point.size], _SHORT_STEP, -_SHORT_STEP)
        least, *shifted = self._negative_likelihood(np.vstack([point, point + np.diag(inside)]))
        return float(least), (np.array(shifted) - least) / inside


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
    without = record.find_peak(record.find_best(_combine_values([k], B)) for k in K[::2])
    # next to a bias, K and B are each about as large as without it, or much smaller
    smaller = np.maximum(without.point - math.log(_SMALLER), record.low[:2])
    noise = _combine_values(*np.column_stack([without.point, smaller]))
    peak = record.find_peak(
        record.find_best(_combine_values(*slow[:, None], sizes, times)) for slow in noise
    )
    record = record.with_scatter_about(peak.point)
    without, peak = (record.find_peak(before.others) for before in (without, peak))
    evidence, covariance = record.measure_evidence(peak)
    to_rms = np.array([[1.0, -0.5], [0.0, 1.0]])
    return CorrelatedBias(
        evidence - record.measure_evidence(without)[0],
        *_rms_and_time(peak),
        to_rms @ covariance[-2:, -2:] @ to_rms.T,
    )


def fit_rms(state: State, axis: str, time: float) -> float | None:
    """Find the likeliest rms [deg/h] of a bias with this correlation time [s].

    None as for `find_correlated_bias`.
    """
    record = _axis_record(state, axis)
    if record is None:
        return None
    low, high = (np.append(ends[:-1], math.log(time)) for ends in (record.low, record.high))
    record = replace(record, low=low, high=high)
    K, B, sizes, _ = record.start_grid()
    peak = record.find_peak([record.find_best(_combine_values(K[::2], B[::2], sizes, low[-1:]))])
    peak = record.with_scatter_about(peak.point).find_peak(peak.others)
    return _rms_and_time(peak)[0]


def _rms_and_time(peak: _Peak) -> tuple[float, float]:
    size, log_time = peak.point[-2:]
    return math.exp(size - 0.5 * log_time), math.exp(log_time)


def _combine_values(*values: ArrayLike) -> Array:
    """Return all combinations of the values of each parameter, (point, parameter)."""
    return np.stack(np.meshgrid(*values, indexing="ij"), axis=-1).reshape(-1, len(values))


def _measure_curvature(objective: Callable[[Array], Array], best: Array) -> Array:
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


def _power_of_effects(state: State, axis: str) -> Array:
    """Return the power of the effects in the model of an axis, as they fit best, (block, band)."""
    baseline = state.baseline
    noise = axis_values(baseline, "columns", axis) @ axis_values(baseline, "square", axis)
    power = axis_values(baseline, "spectrum", axis) - noise
    count = len(state.power_columns(axis))
    if count:
        without = fit_powers(state, axis, np.ones(count, np.bool_))
        power = power + fit_powers(state, axis) - without
    return power


def _find_free_bands(state: State, axis: str) -> NDArray[np.bool_]:
    """Find the bands (band,) that have power of any size in the model, such as those of lines."""
    out = np.zeros(state.blocks.sizes["band"], np.bool_)
    for column in state.power_columns(axis):
        shown = np.broadcast_to(column != 0.0, state.weight.shape[1:]).any(axis=0)
        out |= shown & (shown.sum() == 1)
    return out


def _find_ranges(
    means: Array, density: float, variance: Array, block: float
) -> tuple[Array, Array]:
    """Return the ends of the ranges of all parameters, `low` and `high` of `_AxisRecord`.

    Parameters
    ----------
    means, variance : ndarray, shape (block,)
        Block means [degree hour-1], and their white variance.
    density : float
        Of the white noise in the powers [degree2 hour-2 Hz-1].
    block : float
        Length of a block [s].
    """
    span = means.size * block
    K, B = fine_grid(density, span, block)
    scatter = MAX_SCATTER * float(np.nanstd(np.diff(means[np.isfinite(means)])))
    sizes = np.sqrt(block * float(np.nanmedian(variance)) * _DENSITY_RATIOS / 2.0)
    ranges = [
        (K[0], max(K[-1], scatter * math.sqrt(HOUR / block))),
        (B[0], max(B[-1], scatter)),
        (sizes[0], sizes[1]),
        (0.5 * block, span / 4.0),
    ]
    low, high = np.log(np.array(ranges)).T
    return low, high


def _axis_record(state: State, axis: str) -> _AxisRecord | None:
    """Collect the means and powers of an axis, averaged over blocks of similar power."""
    blocks, baseline, row = state.blocks, state.baseline, state.axes.index(axis)
    power, shape = (blocks[name].values[row] for name in ("power", "shape"))
    power = np.where(_find_free_bands(state, axis), np.nan, power)
    chosen = ~state.masked[row] & (np.isfinite(power) & np.isfinite(shape)).any(axis=1)
    values = mean_residual(blocks, baseline, axis)
    present = np.isfinite(values[:, 0])
    if chosen.sum() < MIN_BLOCKS or present.sum() < MIN_BLOCKS:
        return None
    bands = blocks.sizes["band"]
    common, shape_alone = (array[row] for array in common_variance(blocks))
    columns, known = axis_values(baseline, "columns", axis), _power_of_effects(state, axis)
    cells = np.stack(
        [
            *columns.transpose(2, 0, 1),
            np.broadcast_to(np.arange(bands, dtype=np.float64), power.shape),
            np.broadcast_to(unspread_share(blocks)[row][:, None], power.shape),
            known,
        ],
        axis=-1,
    )
    order = np.argsort(np.where(chosen, state.weight[row].mean(axis=1), np.inf), kind="stable")
    varies = np.ptp(known[chosen], axis=0).max() > _MIN_CHANGE * np.nanmin(power[chosen])
    count = min(_LEVEL_GROUPS, int(chosen.sum())) if varies else 1
    groups = np.array_split(order[: int(chosen.sum())], count)
    cells = np.nan_to_num(cells)
    fits = [average_blocks(power[group], shape[group], cells[group]) for group in groups]
    mean, columns, weight = (
        np.concatenate([getattr(fit, name) for fit in fits])
        for name in ("power", "columns", "weight")
    )
    weight = weight * separate_share(shape[chosen], shape_alone[chosen], common[chosen])
    fit = Fit(mean, columns[:, :4], weight)
    square, _, _ = fit_squares(fit)
    block, variance = float(blocks.attrs["block_s"]), axis_values(baseline, "mean_variance", axis)
    square[1] = max(float(square[1]), floor_square(fit))
    low, high = _find_ranges(values[:, 0], HOUR * float(square[1]), variance, block)
    if high[-1] <= low[-1] + math.log(2.0):
        return None
    log_times = np.linspace(low[-1], high[-1], _TIMES)
    powers = state.recall(
        lambda: [correlated_band_powers(blocks, float(time)) for time in np.exp(log_times)],
        b"powers of correlated biases",
    )
    return _AxisRecord(
        blocks,
        fit,
        fit.columns[:, :2] @ square[:2],
        columns[:, 6],
        np.rint(columns[:, 4]).astype(np.int64),
        columns[:, 5],
        AxisMeans(
            np.where(present[:, None], values, 0.0),
            state.given_to("mean", axis),
            variance,
            block,
            present,
            expected_processes(baseline, axis),
        ),
        low,
        high,
        CubicSpline(log_times, np.log(powers)),
    )

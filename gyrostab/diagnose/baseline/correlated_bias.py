"""Evidence of an exponentially correlated bias next to the noise of an axis.

Its spectrum is level at low frequencies and falls beyond a corner. Flicker and random walk of the
right size come close to either part, but not to both. Block means and band powers must therefore be
explained together, with the same flicker and random walk; each alone, with its own, shows only a
part of the evidence. Where the powers scatter more about the best fit than their own statistics say, because of
lines or of the steep spectrum that leaks into all bands, they count less.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize

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
    likelihood_of_means,
)
from gyrostab.diagnose.evidence.held_out import mean_residual
from gyrostab.diagnose.evidence.wandering import (
    RandomProcesses,
    add_correlated,
    expected_processes,
)
from gyrostab.diagnose.predict.condition import fit_powers
from gyrostab.diagnose.predict.correlated_powers import correlated_band_powers
from gyrostab.diagnose.predict.linear_model import State, band_widths, unspread_share
from gyrostab.diagnose.reduce.block_statistics import MIN_BLOCKS
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.kernels.regression.nonnegative import solve_nonnegative
from gyrostab.units import HOUR

Array = NDArray[np.float64]
_MIN_NOISE_SHARE = 0.05  # of the power of Q and N, that effects may leave; design choice
#: K and B are tried up to this multiple of the scatter of neighbouring means. Design choice: far
#: above, because too low a limit makes a bias of what is noise.
_MAX_SCATTER = 3.0
_SCORING_STEPS = 4  # of Fisher scoring, as in `gyrostab.diagnose.predict.condition`
_MIN_CHANGE = 1e-6  # of the expected powers, from which effects change them; above rounding errors
_LEVEL_GROUPS = 30  # of blocks of similar power, where effects change it; limits time
#: Range of the density of the bias at low frequencies, over that of white noise. Design choice.
_DENSITY_RATIOS = np.array([0.1, 1e6])
_TIMES = 24  # at which powers are computed; between them, they are interpolated
#: Values of every parameter, evenly spaced in log, from which a search may start. With 9, and twice
#: as many combinations, 19 fits were the same to the digits printed.
_STARTS = 7
_STEP = 0.05  # of a logarithm, for the curvature of the likelihood by differences


class CorrelatedBias(NamedTuple):
    """A bias that explains the slow noise of an axis best."""

    #: Log Bayes factor over the noise without it, for any rms and time, equally likely in log.
    nats: float
    rms: float  # degree hour-1
    time: float  # correlation time [s]
    covariance: Array  # (2, 2): of the logarithms of rms and time


class _Peak(NamedTuple):
    """Largest likelihood, and the evidence around it."""

    point: Array  # (parameter,)
    evidence: float
    covariance: Array  # (parameter, parameter)


@dataclass(frozen=True)
class _AxisRecord:
    """Means and powers of an axis, and what they are explained by."""

    blocks: xr.Dataset
    fit: Fit
    noise: Array  # (cell,): power of Q and N that fit best without slow noise
    effects: Array  # (cell,): power of the effects in the model
    band: NDArray[np.int64]  # (cell,)
    unspread: Array  # (cell,): share of a density that gaps leave in its band
    wander: RandomProcesses  # already in the model
    means: dict[str, Any]  # other arguments of `likelihood_of_means`
    #: (parameter,): ends of the ranges of the logarithms of K [deg/h^1.5], B [deg/h], and of a
    #: bias: of its rms times the root of its time [deg/h s^0.5], and of its time [s].
    low: Array
    high: Array
    log_power: CubicSpline  # of a bias of unit variance (band,), by the logarithm of its time

    def log_likelihoods(self, point: Array) -> tuple[float, float]:
        """Return the log likelihoods of means and powers with these parameters.

        They are the logarithms of K and B, and of a bias if there is one. Q and N are the likeliest
        ones in the powers; the means have the white noise of the calibration.
        """
        K, B, *bias = np.exp(np.clip(point, self.low[: point.size], self.high[: point.size]))
        wander = self.wander
        added = self.effects + self.fit.columns[:, 2:] @ np.square([B, K])
        if bias:
            variance, time = float(bias[0] ** 2 / bias[1]), float(bias[1])
            wander = add_correlated(wander, variance, time)
            added = added + variance * self._unit_power(time)
        of_means = likelihood_of_means(
            **self.means, K=np.array([K]), B=np.array([B]), wander=wander
        )
        weight, power = self.fit.weight, self.fit.power
        expected = self._fit_fast_noise(added)
        return float(of_means[0]), -float((weight * (np.log(expected) + power / expected)).sum())

    def _fit_fast_noise(self, added: Array) -> Array:
        """Return the expected powers, those of the likeliest Q and N added (Fisher scoring)."""
        columns, least = self.fit.columns[:, :2], _MIN_NOISE_SHARE * self.noise
        expected = np.maximum(self.noise + added, least)
        for _ in range(_SCORING_STEPS):
            weighted = columns.T * (self.fit.weight / expected**2)
            square = solve_nonnegative(weighted @ columns, weighted @ (self.fit.power - added))
            expected = np.maximum(columns @ square + added, least)
        return expected

    def dispersion(self, point: Array) -> float:
        """Return the scatter of the powers about those of these parameters, 1 for a good fit.

        It is their deviance over its degrees of freedom (McCullagh and Nelder 1989, Generalized
        Linear Models, sec. 8.3).
        """
        _, of_powers = self.log_likelihoods(point)
        weight, power = self.fit.weight, self.fit.power
        deviance = 2.0 * (-float((weight * (np.log(power) + 1.0)).sum()) - of_powers)
        return deviance / max(power.size - point.size - 2, 1)

    def _unit_power(self, time: float) -> Array:
        """Return the powers (cell,) of a bias of unit variance, with the gaps of the record."""
        power, width = np.exp(self.log_power(math.log(time))), band_widths(self.blocks)
        level = float((power * width).sum() / width.sum())
        return np.asarray(self.unspread * power[self.band] + (1.0 - self.unspread) * level)

    def find_peak(self, groups: Iterable[Iterable[Array]]) -> _Peak:
        """Find the largest likelihood from the best start of each group, and the evidence there.

        The evidence is Laplace's approximation.
        """

        def objective(point: Array) -> float:
            return -sum(self.log_likelihoods(point))

        starts = [min(group, key=objective) for group in groups]
        bounds = list(zip(self.low[: starts[0].size], self.high[: starts[0].size], strict=True))
        best = min(
            (
                minimize(objective, start, bounds=bounds, options={"eps": 1e-3, "maxiter": 40})
                for start in starts
            ),
            key=lambda result: float(result.fun),
        )
        precision = _measure_curvature(objective, best.x)
        volume = float(np.log(np.diff(bounds)).sum())
        evidence = (
            -float(best.fun)
            + 0.5 * best.x.size * math.log(2.0 * math.pi)
            - 0.5 * float(np.linalg.slogdet(precision)[1])
            - volume
        )
        return _Peak(best.x, evidence, np.asarray(np.linalg.inv(precision)))


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
    if record is None or record.high[-1] <= record.low[-1] + math.log(2.0):
        return None
    without, peak = _find_peaks(record)
    dispersion = record.dispersion(peak.point)
    if dispersion > 1.0:
        fit = record.fit._replace(weight=record.fit.weight / dispersion)
        without, peak = _find_peaks(replace(record, fit=fit))
    size, time = peak.point[-2:]
    to_rms = np.array([[1.0, -0.5], [0.0, 1.0]])
    return CorrelatedBias(
        peak.evidence - without.evidence,
        math.exp(size - 0.5 * time),
        math.exp(time),
        to_rms @ peak.covariance[-2:, -2:] @ to_rms.T,
    )


def _find_peaks(record: _AxisRecord) -> tuple[_Peak, _Peak]:
    """Find the most likely noise without a bias, and noise and bias."""
    grid = [np.linspace(*ends, _STARTS) for ends in zip(record.low, record.high, strict=True)]
    without = record.find_peak((np.array([K, B]) for B in grid[1]) for K in grid[0][::2])
    # next to a bias, K and B are as without it, or hidden
    noise = (without.point, record.low[:2])
    peak = record.find_peak(
        (np.array([*slow, *bias]) for bias in product(*grid[2:])) for slow in noise
    )
    return without, peak


def _measure_curvature(objective: Callable[[Array], float], best: Array) -> Array:
    """Return the Hessian at a minimum, with curvatures of at least 1.

    A parameter that the record hardly determines may then have any value within a few octaves.
    """
    steps = _STEP * np.eye(best.size)
    least = objective(best)
    up, down = (np.array([objective(best + sign * step) for step in steps]) for sign in (1, -1))
    hessian = np.diag(up + down - 2.0 * least)
    for i, j in combinations(range(best.size), 2):
        crossed = objective(best + steps[i] + steps[j]) - up[i] - up[j] + least
        hessian[i, j] = hessian[j, i] = crossed
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


def _axis_record(state: State, axis: str) -> _AxisRecord | None:
    """Collect the means and powers of an axis, averaged over blocks of similar power."""
    blocks, baseline, row = state.blocks, state.baseline, state.axes.index(axis)
    power, shape = (blocks[name].values[row] for name in ("power", "shape"))
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
    span = len(values) * block
    square[1] = max(float(square[1]), floor_square(fit))
    K, B = fine_grid(HOUR * square[1], span, block)
    densities = block * float(np.nanmedian(variance)) * _DENSITY_RATIOS
    scatter = _MAX_SCATTER * float(np.nanstd(np.diff(values[present, 0])))
    ranges = [
        (K[0], max(K[-1], scatter * math.sqrt(HOUR / block))),
        (B[0], max(B[-1], scatter)),
        np.sqrt(densities / 2.0),
        np.array([0.5 * block, span / 4.0]),
    ]
    low, high = np.log(np.array(ranges)).T
    log_times = np.linspace(low[-1], high[-1], _TIMES)
    powers = [correlated_band_powers(blocks, float(time)) for time in np.exp(log_times)]
    return _AxisRecord(
        blocks,
        fit,
        fit.columns[:, :2] @ square[:2],
        columns[:, 6],
        np.rint(columns[:, 4]).astype(np.int64),
        columns[:, 5],
        expected_processes(baseline, axis),
        {
            "values": np.where(present[:, None], values, 0.0),
            "effects": state.given_to("mean", axis),
            "variance": variance,
            "step": block,
            "present": present,
        },
        low,
        high,
        CubicSpline(log_times, np.log(powers)),
    )

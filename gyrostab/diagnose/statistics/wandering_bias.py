"""An exponentially correlated bias: its evidence in means and powers together."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.diagnose.baseline.correlated_bias import CorrelatedBias, find_correlated_bias, fit_rms
from gyrostab.diagnose.baseline.expected_statistics import sum_noise
from gyrostab.diagnose.evidence.held_out import mean_residual
from gyrostab.diagnose.evidence.products import axis_noise
from gyrostab.diagnose.evidence.wandering import expected_processes, with_process
from gyrostab.diagnose.predict.average_sizes import Size
from gyrostab.diagnose.predict.candidates import (
    Candidate,
    CandidateEvidence,
    Component,
    Prospect,
    Variant,
)
from gyrostab.diagnose.predict.linear_model import (
    State,
    correlated_band_powers,
    is_correlated_bias,
    power_column,
)
from gyrostab.diagnose.predict.search import Trial
from gyrostab.diagnose.statistics.base import Competitor, SizeFit, Sizes
from gyrostab.diagnose.statistics.power import Power, parts_of_record
from gyrostab.diagnose.statistics.random_process import RandomProcess
from gyrostab.noise import NORMAL_95

Result = TypeVar("Result")


class WanderingBias(RandomProcess):
    """An exponentially correlated bias, in block means and band powers with the same noise.

    A faster one shows in the powers alone, and a bias of two levels by its course.
    """

    name = "wandering_bias"
    is_random_bias = True
    is_tried_last = True  # it resembles any slow course

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield a bias without a course that the block means show."""
        for name, (time, variance) in prospect.prediction.wander.items():
            if is_correlated_bias(name, prospect.prediction, prospect.blocks):
                yield Variant(
                    prospect.values, (name,), np.asarray(variance)[None], squared=True, time=time
                )

    def nuisance_alternatives(self, blocks: xr.Dataset) -> list[Candidate]:
        return []

    def evidence(self, group: Sequence[Candidate], trial: Trial) -> list[CandidateEvidence]:
        """Compute the Bayes factor of a bias of any rms and correlation time.

        No null records are tried: averaged over the noise that it allows for, a Bayes factor
        exceeds x in noise with a probability of at most 1 / x (Markov's inequality).
        """
        state = trial.state
        if trial.is_null:
            return []
        out = []
        for candidate in group:
            biases = [  # one on every axis
                None
                if expected_processes(state.baseline, axis).square.size
                else _find_bias(state, axis)
                for axis in state.axes
            ]
            evidence_nats = np.array([[-np.inf if bias is None else bias.nats for bias in biases]])
            plain = candidate.variants[0]
            best = tuple(plain if bias is None else _with_time(plain, bias.time) for bias in biases)
            rows = self.rows(candidate, state)
            out.append(CandidateEvidence(candidate, rows, evidence_nats, best))
        return out

    def axis_competitors(self, component: Component, state: State) -> Iterator[Competitor]:
        """Yield other sizes in the eighths of the record, by their powers."""
        power = correlated_band_powers(state.blocks, component.variant.time)[None, None, None]
        variant = replace(component.variant, design=power)
        candidate = replace(component.candidate, statistic=Power(), variants=(variant,))
        return parts_of_record(replace(component, candidate=candidate, variant=variant), state)

    def condition(self, state: State, component: Component) -> State:
        """Put the bias into the noise of the means and of the powers, unless it is in both."""
        axis, time = component.row[0], component.variant.time
        if state.is_recalibrated(axis):
            return state
        rms = _recall_fit(partial(fit_rms, state, axis, time), b"rms", axis, state, np.array(time))
        if rms is None:
            return state
        power = correlated_band_powers(state.blocks, time)[None, None]
        column = power_column(power, state.axes.index(axis), state)
        variance = rms**2 * component.variant.design[0]
        process = with_process(state.baseline, axis, variance, time)
        return replace(state.with_columns("added_power", axis, [column]), baseline=process)

    def has_power_of_effect(self, component: Component, state: State) -> bool:
        return True

    def estimate(self, fit: SizeFit) -> Sizes:
        """Estimate the rms of every axis, and the correlation time that they have in common."""
        out: dict[str, Size] = {}
        times = []
        for component in fit.components:
            (name,), axis = component.variant.columns, component.row[0]
            bias = _find_bias(fit.state, axis)
            if bias is not None:
                out[fit.key(name, axis)] = _log_normal(
                    math.log(bias.rms), float(bias.covariance[0, 0])
                )
                times.append((math.log(bias.time), 1.0 / float(bias.covariance[1, 1])))
        if times:
            log_time, weight = np.array(times).T
            mean = float(weight @ log_time / weight.sum())
            out["correlation_time"] = _log_normal(mean, 1.0 / float(weight.sum()))
        return out


def _with_time(variant: Variant, time: float) -> Variant:
    return replace(variant, time=time, values={**variant.values, "correlation_time": time})


def _find_bias(state: State, axis: str) -> CorrelatedBias | None:
    """Find the bias of an axis next to all other effects."""
    if state.is_recalibrated(axis):  # with this bias
        without = state.baseline.drop_vars(
            ["wander_square", "wander_time", "wander_walk"], errors="ignore"
        )
        noise = sum_noise(without["columns"].values, without["square"].values)
        spectrum = without["spectrum"].copy(data=noise)
        state = replace(state, baseline=without.assign(spectrum=spectrum))
    return _recall_fit(partial(find_correlated_bias, state, axis), b"correlated bias", axis, state)


def _recall_fit(
    compute: Callable[[], Result], name: bytes, axis: str, state: State, *inputs: Array
) -> Result:
    """Fit a bias of an axis next to all other effects, or recall the fit if nothing has changed."""
    processes, columns = axis_noise(state.baseline, axis), state.power_columns(axis)
    row = state.axes.index(axis)
    return state.recall(
        compute,
        name,
        *inputs,
        np.array(row),
        mean_residual(state.blocks, state.baseline, axis),
        state.given_to("mean", axis),
        processes["variance"],
        *processes["wander"],
        state.masked[row],
        np.stack(columns) if columns else None,
    )


def _log_normal(log_median: float, variance: float) -> tuple[float, float, float, float]:
    """Return a size with its standard deviation and 95 % interval; the variance is of its log."""
    sd, median = math.sqrt(variance), math.exp(log_median)
    low, high = (median * math.exp(sign * NORMAL_95 * sd) for sign in (-1.0, 1.0))
    return median, median * sd, low, high

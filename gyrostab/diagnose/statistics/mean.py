"""Score of the window means, which the Allan variance does not show, against the simulation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.evidence.held_out import mean_factors, mean_residual, noise_weight
from gyrostab.diagnose.evidence.mixture import Mixture
from gyrostab.diagnose.evidence.products import axis_noise
from gyrostab.diagnose.evidence.wandering import expected_processes
from gyrostab.diagnose.predict.candidates import (
    TIME_PARAMETER,
    Candidate,
    Component,
    Prospect,
    Variant,
    numbered_columns,
)
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State, moves_within_blocks
from gyrostab.diagnose.predict.search import Trial
from gyrostab.diagnose.predict.sizes import mean_mixture
from gyrostab.diagnose.predict.windows import hat_functions, power_on_times
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics.base import Competitor, Region, Statistic, choose_columns
from gyrostab.diagnose.statistics.jump_forms import (
    jump_competitors,
    restart_competitors,
    scatter_competitors,
)
from gyrostab.diagnose.statistics.mismatch_wording import axes_text, is_higher
from gyrostab.diagnose.statistics.scores import (
    BlockWindows,
    statistic_dataset,
    sum_over_windows,
    window_set,
)
from gyrostab.kernels.regression.boxcars import (
    boxcar_information,
    filter_gains,
    precision_times,
    remaining_information,
)
from gyrostab.kernels.regression.state_space import flicker_states
from gyrostab.kernels.spectra.expected import interval_variance
from gyrostab.physics.base import Effect
from gyrostab.physics.prediction import Windows
from gyrostab.units import HOUR

#: Lengths of the windows [blocks].
LENGTHS = (1, 5, 15, 45)


class MeanNoise(NamedTuple):
    """Covariance of the block means of one axis, as the filters need it."""

    present: Floats
    innovation: Floats
    gain: Floats
    decay: Floats
    remaining: Floats


class BlockMeanStatistic(Statistic):
    """What statistics of effects in the block means share."""

    view = "mean"
    explained_views: tuple[str, ...] = (
        "mean",
        "restart",
        "davar",
        "distribution",
        "cross_axis",
        "spectrum",
    )
    containing_views: tuple[str, ...] = ("davar", "mean", "restart", "cross_axis")
    modelled_views = explained_views
    unsupported_as = "~bias(t)"

    def condition(self, state: State, component: Component) -> State:
        """Put columns into the means, and mask blocks in which the effect moves much."""
        axis = component.row[0]
        row = state.axes.index(axis)
        columns = mean_columns(component.variant, row)
        state = state.with_columns("mean", axis, columns)
        return replace(state, masked=state.masked | _moving_blocks(state, row, columns))

    def mixture(self, component: Component, state: State, variant: Variant) -> Mixture:
        """Compute sizes over the grid of random walk and flicker."""
        columns = mean_columns(variant, state.axes.index(component.row[0]))
        return mean_mixture(state, component.row[0], columns)

    def can_explain(
        self, component: Component, region: Region, blocks: xr.Dataset, settings: Settings
    ) -> bool:
        """Return whether the mismatch is one of means; of several axes only a slow one."""
        is_slow = region["view"] != "cross_axis" or region["quantity"] == "slow"
        return region["view"] in self.explained_views and bool(is_slow)

    def averaging_times(self, component: Component, blocks: xr.Dataset) -> tuple[float, float]:
        return float(blocks.attrs["block_s"]), float(blocks["end"].values[-1]) / 2.0


class Mean(BlockMeanStatistic):
    """Block means, which the Allan variance does not show."""

    name = "mean"
    error_shows_in = ("telegraph",)
    null_variable = "mean"
    is_in_means = True
    is_linear_in_means = True
    has_course = True
    grows_in_time = False

    def competitors(
        self, components: Sequence[Component], state: State, error: float
    ) -> Iterator[Competitor]:
        return jump_competitors(components, state, error)

    def axis_competitors(self, component: Component, state: State) -> Iterator[Competitor]:
        yield from restart_competitors(component, state)
        yield from scatter_competitors(component, state)

    def nuisance_alternatives(self, blocks: xr.Dataset) -> list[Candidate]:
        """Return a bias that wanders in any way."""
        hats = hat_functions(blocks["begin"].values, blocks["end"].values)
        wander = Variant({}, numbered_columns(len(hats)), hats[:, None, :])
        return [Candidate("~bias(t)", self, (), (wander,))]

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
        """Score the mean of windows of four lengths against the rest of the record.

        The score is that of a constant added only in the window, by generalised least squares with
        the noise of the simulation and a constant of the record. For white noise it is the window's
        mean minus that of the rest, divided by its standard deviation; for slow noise, neighbours
        count more. ``estimate`` is the constant [degree hour-1].
        """
        windows = window_set(blocks.sizes["block"], LENGTHS, whole=False)
        amount, information = window_means(blocks, baseline, windows)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (amount / np.sqrt(information))[..., None]
            estimate = (amount / information)[..., None]
        block = float(blocks.attrs["block_s"])
        return statistic_dataset(
            blocks,
            windows=windows,
            columns={
                "quantity": "mean",
                "tau_min_s": [block],
                "tau_max_s": [block * max(windows.length, default=1)],
            },
            z=z,
            ratio=np.abs(z),
            estimate=estimate,
        )

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield designs of the mean that are not constant; the constant is free."""
        columns = {}
        for name, design in prospect.prediction.mean.items():
            moved = design - design.mean(axis=-1, keepdims=True)
            if np.isfinite(moved).all() and np.abs(moved).max() > 1e-9 * np.abs(design).max(
                initial=1e-300
            ):
                columns[name] = design
        yield from choose_columns(prospect.values, columns)

    def complete_candidate(
        self, candidate: Candidate, kind: type[Effect], windows: Windows
    ) -> Candidate:
        """Let a step at a given time occur at every restart."""
        return replace(candidate, variants=_with_steps_at_restarts(candidate.variants, windows))

    def row_factors(self, group: Sequence[Candidate], row: int, trial: Trial) -> Floats:
        axis = trial.state.axes[row]
        designs = [
            np.stack(mean_columns(variant, row), axis=-1)
            for candidate in group
            for variant in candidate.variants
        ]
        compute = partial(
            mean_factors,
            trial.data,
            trial.state.baseline,
            designs,
            axis=axis,
            given=trial.state.given_to("mean", axis),
            folds=trial.folds,
        )
        return trial.recall(compute, group, *mean_inputs(trial, axis))

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        axes, estimate = axes_text(region["axes"]), region.get("estimate", np.nan)
        if region.get("sign", 1) == 0:
            return (
                f"The mean rate of {axes} wanders {when}, by up to {abs(estimate):.3g} deg/h, more "
                "than drift and noise allow"
            )
        size = f"{abs(estimate):.3g} deg/h " if np.isfinite(estimate) else ""
        return (
            f"The mean rate of {axes} is {size}{'above' if is_higher(region) else 'below'} its "
            f"expected value {when}, more than drift and noise allow"
        )


def mean_inputs(trial: Trial, axis: str) -> list[Floats | None]:
    """Return all that the evidence of means of an axis is computed from, but for the designs."""
    baseline = trial.state.baseline
    noise = axis_noise(baseline, axis)
    return [
        np.array(trial.state.axes.index(axis)),
        mean_residual(trial.data, baseline, axis),
        trial.state.given_to("mean", axis),
        noise_weight(baseline, axis, "free"),
        *(noise[name] for name in ("variance", "K", "B")),
        *noise["wander"],
    ]


def _with_steps_at_restarts(variants: tuple[Variant, ...], windows: Windows) -> tuple[Variant, ...]:
    """Add a variant in which the level changes at every restart, each time by another size.

    A single step leaves the others, which free random walk explains as well as that step. With all
    of them in one design, the parts between the restarts show how small the random walk is. The
    design has half of the prior probability of steps at restarts.
    """
    if not all(TIME_PARAMETER in variant.values for variant in variants):
        return variants
    restarts = power_on_times(windows)
    at_restart = [
        bool(np.isclose(restarts, variant.values[TIME_PARAMETER]).any()) for variant in variants
    ]
    steps = [
        variant
        for variant, at_one in zip(variants, at_restart, strict=True)
        if at_one and len(variant.columns) == 1
    ]
    if len(steps) < 2:
        return variants
    every = replace(
        steps[0],
        columns=tuple(name for variant in steps for name in variant.columns),
        design=np.concatenate([variant.design for variant in steps]),
        weight=0.5 * sum(variant.weight for variant in steps),
    )
    halved = [
        replace(variant, weight=0.5 * variant.weight) if at_one else variant
        for variant, at_one in zip(variants, at_restart, strict=True)
    ]
    return (*halved, every)


def window_means(
    blocks: xr.Dataset, baseline: xr.Dataset, windows: BlockWindows
) -> tuple[Floats, Floats]:
    """Compute matched filter and information of every window; their ratio is the constant in it.

    By (record), axis, window [degree-1 hour], and by axis, window [degree-2 hour2]; NaN if too
    little of the window is present. The constant of the whole record is free.
    """
    residual = blocks["mean"].values - baseline["known_mean"].values
    amount = np.full((*residual.shape[:-1], windows.first.size), np.nan)
    information = np.full((residual.shape[-2], windows.first.size), np.nan)
    for axis in range(residual.shape[-2]):
        series = residual[..., axis, :]
        noise = mean_noise(blocks, baseline, axis, series)
        amount[..., axis, :], information[axis] = _matched_filter(series, noise, windows)
    return amount, information


def _matched_filter(
    residual: Floats, noise: MeanNoise, windows: BlockWindows
) -> tuple[Floats, Floats]:
    """Return filter output and information of each window, both independent of a constant."""
    weighted = apply_precision(residual, noise)
    weighted_ones = apply_precision(np.ones(residual.shape[-1]), noise)
    total = weighted_ones.sum()
    weighted = weighted - weighted_ones * (weighted.sum(axis=-1, keepdims=True) / total)
    boxcar = boxcar_information(windows.first, windows.stop, *noise[1:])
    across = sum_over_windows(weighted_ones, windows, axis=-1)
    count = sum_over_windows(noise.present, windows, axis=-1)
    information = boxcar - across**2 / total
    enough = (count >= 0.25 * windows.length) & (information > 1e-3 * boxcar)
    amount = sum_over_windows(weighted, windows, axis=-1)
    return amount, np.where(enough, information, np.nan)


def slow_coefficients(baseline: xr.Dataset, axis: int) -> tuple[float, float]:
    """Return B and K of the means of an axis."""
    B, K = baseline["coefficient"].isel(axis=axis).sel(term=["B", "K"]).values.tolist()
    return B, K


def mean_noise(blocks: xr.Dataset, baseline: xr.Dataset, axis: int, series: Floats) -> MeanNoise:
    """Return the covariance of the means (..., block) of an axis, with all known processes."""
    b, k = slow_coefficients(baseline, axis)
    begin, end = blocks["begin"].values, blocks["end"].values
    step = np.diff((begin + end) / 2.0, append=end[-1])
    block, span = float(blocks.attrs["block_s"]), float(end[-1] - begin[0])
    share, times, white = flicker_states(block, span)
    processes = expected_processes(baseline, axis)
    slow = np.append(b**2 * share, processes.square * interval_variance(block / processes.time))
    times = np.append(times, processes.time)
    decay = np.exp(-step[:, None] / np.append(np.inf, times))  # the random walk does not relax
    variance = baseline["mean_variance"].values[axis] + b**2 * white
    n = variance.size
    shared = np.zeros(1 + slow.size)
    if processes.angle > 0.0:  # the angle at the start of a block; that at its end is white noise
        at_end = processes.angle / block**2
        slow, shared = np.append(slow, at_end), np.append(shared, -at_end)
        decay, variance = np.column_stack([decay, np.zeros(n)]), variance + at_end
    present = np.isfinite(series).reshape(-1, n).any(axis=0)
    present = present & np.isfinite(variance) & (variance > 0)
    walk = (k**2 / HOUR + processes.walk) * step
    innovation, gain = filter_gains(variance, present, walk, slow, decay, shared)
    remaining = remaining_information(innovation, gain, decay)
    return MeanNoise(present.astype(float), innovation, gain, decay, remaining)


def apply_precision(series: Floats, noise: MeanNoise) -> Floats:
    """Multiply each series (..., block) by the inverse covariance; zero at missing blocks."""
    rows = np.ascontiguousarray(series.reshape(-1, series.shape[-1]), dtype=np.float64)
    out = precision_times(rows, noise.innovation, noise.gain, noise.decay)
    return np.asarray(out.reshape(series.shape))


def region_mean(blocks: xr.Dataset, baseline: xr.Dataset, axis: int, inside: Bools) -> float:
    """Return the constant added only in some blocks of a recording [degree hour-1].

    By generalised least squares with a constant of the record.
    """
    residual = blocks["mean"].values[axis] - baseline["known_mean"].values[axis]
    noise = mean_noise(blocks, baseline, axis, residual)
    columns = np.stack([np.ones(residual.size), inside.astype(float)])
    rows = apply_precision(columns, noise)
    solved = np.linalg.lstsq(rows @ columns.T, rows @ np.nan_to_num(residual), rcond=None)[0]
    return float(solved[1])


def _moving_blocks(state: State, row: int, columns: list[Floats]) -> Bools:
    """Return the blocks in which the effect moves enough to show in the power of the axis."""
    blocks = state.blocks
    y = blocks["mean"].values[row] - state.baseline["known_mean"].values[row]
    good = np.isfinite(y)
    design = np.nan_to_num(np.stack([np.ones(y.size), *columns], axis=1))
    largest = np.abs(design).max(axis=0)
    design = design[:, largest > 0.0] / largest[largest > 0.0]
    size, *_ = np.linalg.lstsq(design[good], y[good], rcond=None)
    curve = design @ size
    mask = np.zeros_like(state.masked)
    mask[row] = moves_within_blocks(curve, state.expected_power[row, :, 0], blocks, state.settings)
    return mask

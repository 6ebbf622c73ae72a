"""Amplitudes at multiples of the rotation of the tool."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Bools
from gyrostab.diagnose.evidence.held_out import LinearModel
from gyrostab.diagnose.evidence.spectral_lines import interpolate_bands
from gyrostab.diagnose.predict.average_sizes import Size
from gyrostab.diagnose.predict.candidates import Candidate, Component, Prospect, Variant
from gyrostab.diagnose.predict.condition import free_covariance
from gyrostab.diagnose.predict.linear_model import (
    State,
    linear_model,
    real_and_imaginary,
    records_last,
)
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.reduce.rotation_orders import noise_at_orders
from gyrostab.diagnose.statistics.base import NullDraw, SizeFit, Sizes, Statistic
from gyrostab.diagnose.statistics.scores import BlockWindows, exponential_score, sum_over_windows
from gyrostab.noise import NORMAL_95
from gyrostab.physics.base import Effect
from gyrostab.physics.prediction import Windows

EARTH_RATE = 15.041067  # deg/h: 360 degrees in a sidereal day of 23.934470 h


class RotationOrder(Statistic):
    """Amplitudes at multiples of the rotation of the tool.

    Their score is part of that of `RampPhase`: both are phase-locked, and share one threshold.
    """

    name = "rotation_order"
    view = "spectrum"
    explained_views = ("spectrum", "davar", "mean", "distribution", "cross_axis")
    containing_views = ("davar",)
    error_shows_in = ("power", "cross_spectrum")
    is_power_weighted = True
    is_phase_locked = True
    is_rotation = True

    def null(self, draw: NullDraw) -> Mapping[str, Array]:
        """Draw Gaussian amplitudes at the rotation orders, with the density near that frequency."""
        if "order" not in draw.blocks:
            return {}
        blocks, expected = draw.blocks, draw.expected
        rate = float(blocks.attrs["sampling_rate_hz"])
        samples = np.maximum(blocks["order_samples"].values, 1.0)
        turning = turns_per_second(blocks)
        bands = np.log(blocks["frequency"].values)
        density = np.empty((len(expected), *blocks["order"].shape))
        for place, harmonic in enumerate(blocks["harmonic"].values):
            folded = np.abs((turning * harmonic + rate / 2.0) % rate - rate / 2.0)
            at = np.interp(np.log(np.maximum(folded, 1e-9)), bands, np.arange(bands.size))
            low = np.minimum(at.astype(int), bands.size - 2)
            block = np.arange(turning.size)
            density[..., place] = expected[:, :, block, low] * (1.0 - (at - low)) + expected[
                :, :, block, low + 1
            ] * (at - low)
        noise = draw.rng.standard_normal((*density.shape, 2)) @ np.array([1.0, 1j])
        variance = 2.0 * noise_at_orders(blocks, density) * rate / samples
        return {"order": np.sqrt(variance) * noise}

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield patterns of the harmonics over the axes."""
        if "order" not in prospect.blocks:
            return
        count = prospect.blocks.sizes["harmonic"]
        for name, pattern in prospect.prediction.order.items():
            yield Variant(prospect.values, (name,), pattern[None, :, :count])

    def complete_candidate(
        self, candidate: Candidate, kind: type[Effect], windows: Windows
    ) -> Candidate:
        """Give all axes one size unless the effect has several."""
        many = {item.name for item in kind.parameters() if item.many}
        return replace(candidate, is_per_axis=bool(many & set(candidate.variants[0].columns)))

    def rows(self, candidate: Candidate, state: State) -> list[tuple[str, ...]]:
        """Return each axis, or all axes of one size together."""
        if candidate.is_per_axis:
            return super().rows(candidate, state)
        pattern = np.abs(candidate.variants[0].design[0]).max(axis=-1)
        return [tuple(axis for axis, size in zip(state.axes, pattern, strict=True) if size > 0)]

    def model(
        self, candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
    ) -> LinearModel:
        """Build the model of the rotation orders of an axis, or of all axes together."""
        order, weight = records_last(data["order"].values, 3), order_weight(state)
        count = weight.shape[-1]
        is_per_axis = candidates[0].is_per_axis
        # The cells of all axes side by side.
        axes: Sequence[int] = [row] if is_per_axis else range(len(state.axes))
        values = np.concatenate([real_and_imaginary(order[axis], axis=1) for axis in axes], axis=1)
        cell_weight = np.concatenate([weight[axis] for axis in axes for _ in range(2)], axis=1)
        if is_per_axis:
            designs = [
                order_columns(np.ones(count, complex), chosen) for chosen in harmonic_sets(count)
            ] * len(candidates)
        else:
            designs = [
                [
                    np.concatenate(columns)
                    for columns in zip(
                        *(order_columns(factor, (0,)) for factor in pattern), strict=True
                    )
                ]
                for candidate in candidates
                for variant in candidate.variants
                for pattern in (variant.design[0], np.conj(variant.design[0]))
            ]
        given = []
        for place, axis in enumerate(axes):
            for column in state.given.get(("order", state.axes[axis]), []):
                wide = np.zeros(cell_weight.shape)
                wide[:, place * 2 * count : (place + 1) * 2 * count] = column
                given.append(wide)
        return linear_model(values, cell_weight, designs, given)

    def moves_means(self, component: Component) -> bool:
        """Return True: a slow rotation moves the means."""
        return True

    def condition(self, state: State, component: Component) -> State:
        """Condition on a component in the rotation orders, and where it shows in the spectrum.

        An uneven rotation or gaps spread a harmonic over many bands and lines.
        """
        count = state.blocks.sizes["harmonic"]
        if component.candidate.is_per_axis:
            chosen = harmonic_sets(count)[component.line_index]
            patterns = [(axis, np.ones(count, np.complex128)) for axis in component.row]
        else:
            chosen, pattern = (0,), component.variant.design[0]
            if is_reversed(component):
                pattern = np.conj(pattern)
            patterns = [(axis, pattern[state.axes.index(axis)]) for axis in component.row]
        mean, _ = component_mixture(component, state).moments()
        sizes = np.hypot(*mean[: 2 * len(chosen)].reshape(-1, 2).T)  # of a pattern of 1
        masked = np.zeros(state.blocks.sizes["line"], np.bool_)
        for axis, pattern in patterns:
            state = state.with_columns("order", axis, order_columns(pattern, chosen))
            for k, size in zip(chosen, sizes, strict=True):
                square = (size * abs(pattern[k])) ** 2
                density = square * state.blocks["turn_power"].values[k]
                for band in np.flatnonzero(_visible_bands(density, axis, state)):
                    column = np.zeros_like(density)
                    column[:, band] = density[:, band] / density[:, band].max()
                    state = state.with_columns("power", axis, [column])
                    state = free_covariance(state, axis, column)
                line_power = square * state.blocks["turn_line_power"].values[k]
                masked |= _visible_lines(line_power, axis, state)
        return state.with_columns("line", "all", [masked])

    def estimate(self, fit: SizeFit) -> Sizes:
        """Return amplitude and phase of components locked to the rotation.

        For the earth rate these are latitude and toolface of a tool that points down. Angles get
        the error of the form of the amplitude: a share of an angle has no meaning.
        """
        out: dict[str, Size] = {}
        for component in fit.components:
            size, sd, angle = fit_amplitude(component, fit.state)
            error = math.hypot(sd / max(size, 1e-300), fit.state.settings.size_error_share)
            if not component.candidate.is_per_axis:
                across = size * float(np.abs(component.variant.design).max())
                return {
                    "latitude": _latitude_from_rate(across, error * across),
                    "toolface": (angle, math.degrees(error)),
                }
            axis = component.row[0]
            out[fit.key("amplitude", axis)] = (size, sd)
            out[fit.key("phase", axis)] = (angle, math.degrees(error))
            harmonics = fit.state.blocks["harmonic"].values
            out["order"] = (float(harmonics[component.line_index % harmonics.size]), 0.0)
        return out


def is_reversed(component: Component) -> bool:
    """Return whether the rotation is reversed: y at -90 degrees from x, or a reversed channel."""
    return (
        component.statistic.is_rotation
        and not component.candidate.is_per_axis
        and component.line_index % 2 == 1
    )


def order_weight(state: State) -> Array:
    """Return (axis, block, harmonic): inverse variance of each part of an amplitude."""
    blocks = state.blocks
    rate, frequency = float(blocks.attrs["sampling_rate_hz"]), blocks["frequency"].values
    place = turns_per_second(blocks)[:, None] * blocks["harmonic"].values
    good = (
        np.isfinite(blocks["order"].values)
        & (place * float(blocks.attrs["block_s"]) >= 2.0)
        & (place < rate / 2.0)
    )
    nearest = np.abs(np.log(np.maximum(place, frequency[0])[..., None] / frequency)).argmin(axis=-1)
    level = np.take_along_axis(
        state.expected_power,
        np.broadcast_to(nearest, (state.expected_power.shape[0], *nearest.shape)),
        axis=2,
    )
    level = noise_at_orders(blocks, level)
    seconds = blocks["order_samples"].values / rate
    return np.where(good, seconds / (2.0 * level), 0.0)


def harmonic_sets(count: int) -> list[tuple[int, ...]]:
    """Return each harmonic alone, and all together."""
    return [*((k,) for k in range(count)), *([tuple(range(count))] if count > 1 else [])]


def order_columns(pattern: Array, chosen: tuple[int, ...]) -> list[Array]:
    """Return columns (cell,) of a complex factor for each chosen harmonic.

    The cells are the real parts, then the imaginary parts of the harmonics.
    """
    columns = []
    for k in chosen:
        harmonic = np.zeros_like(pattern)
        harmonic[..., k] = pattern[..., k]
        columns += [real_and_imaginary(harmonic), real_and_imaginary(1j * harmonic)]
    return columns


def _latitude_from_rate(across: float, error: float) -> tuple[float, float, float, float]:
    """Return the latitude of a tool that points down, from the earth rate across it [deg/h].

    The result [deg] has the standard error and the ends of the 95 % interval.
    """
    low, middle, high = (
        math.degrees(math.acos(min(max(rate, 0.0) / EARTH_RATE, 1.0)))
        for rate in (across + NORMAL_95 * error, across, across - NORMAL_95 * error)
    )
    return middle, max((high - low) / (2.0 * NORMAL_95), 1e-12), low, high


def fit_amplitude(component: Component, state: State) -> tuple[float, float, float]:
    """Return amplitude, standard error and phase [deg] of the first harmonic of a component."""
    mean, covariance = component_mixture(component, state).moments()
    sd = float(math.sqrt(np.trace(covariance[:2, :2]) / 2.0))
    return float(math.hypot(mean[0], mean[1])), sd, math.degrees(math.atan2(mean[1], mean[0]))


def _visible_bands(density: Array, axis: str, state: State) -> Bools:
    """Find the bands in which an added density (block, band) is visible in the record."""
    row = state.axes.index(axis)
    shape = np.nan_to_num(state.blocks["shape"].values[row])
    ratio = density / state.expected_power[row]
    return np.asarray((shape * ratio**2).sum(axis=0) >= state.settings.visible_sigma**2)


def _visible_lines(line_power: Array, axis: str, state: State) -> Bools:
    """Find the lines at which an added density (line,) is visible in the record."""
    row, blocks = state.axes.index(axis), state.blocks
    bands, lines = blocks["frequency"].values, blocks["line_frequency"].values
    noise = interpolate_bands(state.expected_power[row].mean(axis=0)[None], lines, bands)[0]
    count = blocks["line_weight"].values[row].sum()
    return np.asarray(line_power / noise * math.sqrt(count) >= state.settings.visible_sigma)


def turns_per_second(blocks: xr.Dataset) -> Array:
    """Return turns per second in each block."""
    return np.asarray(np.nan_to_num(np.abs(blocks["channel_rotation_rate"].values) / 360.0))


def score_orders(
    blocks: xr.Dataset, baseline: xr.Dataset, windows: BlockWindows
) -> tuple[Array, ...]:
    """Return score, ratio and amplitude of the coherent sum by (record), axis, window, harmonic."""
    order = blocks["order"].values
    samples = blocks["order_samples"].values
    rate = float(blocks.attrs["sampling_rate_hz"])
    turning, spectrum = turns_per_second(blocks), baseline["spectrum"].values
    bands, orders = baseline["frequency"].values, np.arange(1, order.shape[-1] + 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_block = [
            interpolate_bands(spectrum[:, block], rate_hz * orders, bands)
            for block, rate_hz in enumerate(turning)
        ]
        density = noise_at_orders(blocks, np.stack(by_block, axis=1))
        # Of |order|^2: two parts of 2 S rate / n each.
        variance = 4.0 * density * rate / samples
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

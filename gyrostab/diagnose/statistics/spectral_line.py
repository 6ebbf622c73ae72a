"""Score of spectral lines that exceed the spectrum around them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.evidence.spectral_lines import (
    JUDGED_PARTS,
    expected_lines,
    line_evidence,
    line_skirt,
    mean_line_power,
    merge_parts,
)
from gyrostab.diagnose.predict.candidates import (
    Candidate,
    CandidateEvidence,
    Component,
    Prospect,
    Variant,
)
from gyrostab.diagnose.predict.condition import find_bands, free_covariance
from gyrostab.diagnose.predict.linear_model import (
    State,
    average_in_bands,
    band_widths,
    mix_with_mean,
    unspread_share,
    unspread_share_of_lines,
)
from gyrostab.diagnose.predict.search import Trial
from gyrostab.diagnose.reduce.block_statistics import MIN_BLOCKS
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics.base import Region, SizeFit, Sizes, Statistic
from gyrostab.diagnose.statistics.mismatch_wording import axes_text
from gyrostab.diagnose.statistics.scores import (
    SINE_TAU_CYCLES,
    BlockWindows,
    cube_root_score,
    cumulative,
    moving_sum,
    part_windows,
    statistic_dataset,
    sum_over_windows,
)
from gyrostab.kernels.spectra.line_levels import LEAK_LINES, local_level

_WIDTH_LINES = 5  # of a line with its leakage
_CERTAIN_SIGMA = 3.0  # by which the power of a line varies more than that of noise; design choice
_MAX_COHERENCE_BLOCKS = 3.0  # longest coherence time that the scatter of block powers determines
_AROUND_LINES = 40  # lines on either side that define the level; design choice


class SpectralLineStatistic(Statistic):
    """Spectral lines that exceed the spectrum around them."""

    name = "spectral_line"
    view = "spectrum"
    explained_views = ("spectrum", "davar", "distribution", "cross_axis")
    containing_views = ("davar", "cross_axis")
    modelled_views = ("cross_axis",)  # lines that axes have in common
    is_line = True
    has_size = False
    uses_line_spectra = True

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
        """Score every line of the spectrum, in parts of the record and in the whole.

        ``estimate`` is the amplitude of a sine with the same excess [degree hour-1].
        """
        power, weight = blocks["line_power"].values, blocks["line_weight"].values
        frequency = blocks["line_frequency"].values
        windows = part_windows(blocks, JUDGED_PARTS)
        expected = expected_lines(baseline, frequency)[:, None, :]
        flat = power / expected
        present = np.isfinite(flat) & (weight > 0)[..., None]
        used_weight = np.where(present, weight[..., None], 0.0)
        flat = merge_parts(np.where(present, flat, 0.0) * used_weight)
        used_weight = merge_parts(used_weight)
        with np.errstate(divide="ignore", invalid="ignore"):
            record_sum = flat.sum(axis=-2, keepdims=True)
            count = np.concatenate([used_weight, used_weight.sum(axis=-2, keepdims=True)], axis=-2)
            flat = np.concatenate([flat, record_sum], axis=-2) / count
            count = count * _equal_block_share(blocks, windows)
            around = _mean_around(flat)
            ratio = flat / around
        # A quarter of squared amplitude times block for a sine; only a recording needs it.
        excess = (
            moving_sum(flat - around, _WIDTH_LINES) * expected if flat.ndim == 3 else np.zeros(1)
        )
        z = cube_root_score(ratio, count / (1.0 + 1.0 / (2.0 * _AROUND_LINES)))
        half = SINE_TAU_CYCLES / frequency  # at which the Allan variance of a sine is largest
        return statistic_dataset(
            blocks,
            windows=windows,
            columns={
                "quantity": "line",
                "tau_min_s": half,
                "tau_max_s": half,
                "frequency": frequency,
            },
            z=z,
            ratio=ratio,
            estimate=2.0 * np.sqrt(np.maximum(excess, 0.0) / float(blocks.attrs["block_s"])),
            one_sided=True,
        )

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield a line of constant frequency; the spectrum itself determines the frequency."""
        if (
            prospect.prediction.line is None
            or not prospect.prediction.coherent
            or np.ptp(prospect.prediction.line) > 0
        ):
            return
        yield Variant({}, tuple(prospect.prediction.spectrum), np.empty(0), squared=True)

    def evidence(self, group: Sequence[Candidate], trial: Trial) -> list[CandidateEvidence]:
        """Compute the evidence of one line on all axes, of any phase or of constant phase.

        Null records have no sines: in noise alone their evidence is below zero.
        """
        power = trial.data["line_power"].values
        power = power if power.ndim == 4 else power[None]
        expected = expected_lines(trial.state.baseline, trial.state.blocks["line_frequency"].values)
        evidence_nats = line_evidence(power, trial.state.blocks["line_weight"].values, expected)
        if not trial.is_null:
            evidence_nats = np.logaddexp(evidence_nats, trial.data["sine_nats"].values) - np.log(2)
        evidence_nats = np.where(explained_lines(trial.state), -np.inf, evidence_nats)
        # (record,), one line for all axes
        place = np.maximum(evidence_nats, 0.0).sum(axis=1).argmax(axis=-1)
        best = np.take_along_axis(evidence_nats, place[:, None, None], axis=2)[..., 0]
        best = np.where(np.isfinite(best), best, -np.log(power.shape[-1]))
        rows = self.rows(group[0], trial.state)
        places = np.repeat(place[:, None], len(rows), axis=1)
        return [
            CandidateEvidence(
                candidate, rows, best, tuple(candidate.variants[0] for _ in rows), places
            )
            for candidate in group
        ]

    def condition(self, state: State, component: Component) -> State:
        frequency = float(state.blocks["line_frequency"].values[component.line_index])
        axis = component.row[0]
        power_columns = state.power_columns(axis)
        for band in find_bands(state.blocks, frequency):
            column = np.zeros(state.expected_power.shape[1:])
            column[:, band] = 1.0
            if any(np.array_equal(column, other) for other in power_columns):
                continue  # another line in the same band is already given
            state = state.with_columns("power", axis, [column])
            state = free_covariance(state, axis, column)
        skirt = line_skirt(state.blocks, axis, component.line_index, state.settings)
        return state.with_columns("line", "all", [skirt])

    def noise_shares(
        self, component: Component, axis: str, state: State, expected_power: Floats
    ) -> tuple[Floats | float, list[Floats], list[Floats]]:
        """Return the power of the line and its skirt above the spectrum around them.

        The power of the bands of a resonance is free: its slopes are not known.
        """
        blocks, place = state.blocks, component.line_index
        if math.isfinite(line_quality(blocks, state.baseline, axis, place)):
            return super().noise_shares(component, axis, state, expected_power)
        total, _ = mean_line_power(blocks, axis)
        skirt = line_skirt(blocks, axis, place, state.settings)
        above = np.where(skirt, total - local_level(total), 0.0)
        row = state.axes.index(axis)
        density = np.maximum(average_in_bands(above, blocks), 0.0)
        share = unspread_share_of_lines(blocks)[row]
        power = mix_with_mean(density / share, unspread_share(blocks)[row], band_widths(blocks))
        return power, [], []

    def is_only_in_phase(self, component: Component, blocks: xr.Dataset) -> bool:
        """Return whether the component is a sine of constant phase.

        The powers of bands show little of it, and slow noise is fitted to that of a slow one.
        """
        return _has_constant_phase(blocks.sel(axis=component.row[0]), component.line_index)

    def estimate(self, fit: SizeFit) -> Sizes:
        """Estimate amplitudes and the frequency, from the power about the line.

        A sample is the mean over its interval, which attenuates the line by sinc(f / fs). The size
        of real rotation is the rms rate, not the amplitude.
        """
        blocks = fit.state.blocks
        is_sway = fit.components[0].candidate.effect == "real_motion"
        name = "sway" if is_sway else fit.components[0].variant.columns[0]
        out: dict[str, tuple[float, float]] = {}
        # the strongest of several lines of an axis is last
        for component in sorted(fit.components, key=lambda component: component.evidence_nats):
            amplitude, frequency = estimate_line(
                blocks, component.row[0], component.line_index, fit.state.settings
            )
            response = np.sinc(frequency[0] / float(blocks.attrs["sampling_rate_hz"]))
            if is_sway:
                response *= math.sqrt(2.0)
            key = name if is_sway else fit.key(name, component.row[0])
            out[key] = (amplitude[0] / response, amplitude[1] / response)
            out["frequency"] = frequency
        return out

    def can_explain(
        self, component: Component, region: Region, blocks: xr.Dataset, settings: Settings
    ) -> bool:
        """Return whether a mismatch is at the frequency of the line, or of samples."""
        if region["view"] not in self.explained_views:
            return False
        if region["view"] == "cross_axis":
            return region["quantity"] != "slow"
        if region["view"] == "distribution":
            return True
        lines = blocks["line_frequency"].values
        mine = float(lines[component.line_index])
        if np.isfinite(region["frequency"]):
            return bool(
                abs(region["frequency"] - mine)
                <= LEAK_LINES * (lines[1] - lines[0]) + settings.line_width_share * mine
            )
        tau = SINE_TAU_CYCLES / mine  # where the Allan variance of a sine is largest
        return region["quantity"].startswith(("avar", "level", "variance")) and bool(
            region["tau_min_s"] / settings.line_tau_ratio
            <= tau
            <= region["tau_max_s"] * settings.line_tau_ratio
        )

    def averaging_times(self, component: Component, blocks: xr.Dataset) -> tuple[float, float]:
        """Return the averaging time at which the Allan variance of the line is largest."""
        tau = SINE_TAU_CYCLES / float(blocks["line_frequency"].values[component.line_index])
        return tau, tau

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        return (
            f"The spectrum of {axes_text(region['axes'])} has a line at "
            f"{region.get('frequency', np.nan):.5g} Hz {when}, at {region['ratio']:.3g} times the "
            "noise level"
        )


def explained_lines(state: State) -> Bools:
    """Return the lines (axis, line) that the effects in the model explain."""
    nothing = np.zeros(state.blocks.sizes["line"], np.bool_)
    of_all = state.given.get(("line", "all"), [])
    return np.stack(
        [
            np.any([nothing, *of_all, *state.given.get(("line", axis), [])], axis=0)
            for axis in state.axes
        ]
    )


def _equal_block_share(blocks: xr.Dataset, windows: BlockWindows) -> Floats:
    """Return the equivalent share of equal-power blocks in a mean, by window and line."""
    power, shape = (blocks[name].values for name in ("power", "shape"))
    present = np.isfinite(power) & (shape > 0)
    power, present_count = np.where(present, power, 0.0), present.astype(float)
    square = np.where(present, power**2 * shape / (1.0 + shape), 0.0)
    count, first, second = (
        sum_over_windows(values, windows) for values in (present_count, power, square)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        even = np.where(second > 0, first**2 / (count * second), 1.0)
    bands, lines = np.log(blocks["frequency"].values), np.log(blocks["line_frequency"].values)
    place = np.clip(np.searchsorted(bands, lines), 1, bands.size - 1)
    share = np.clip((lines - bands[place - 1]) / (bands[place] - bands[place - 1]), 0.0, 1.0)
    even = np.minimum(even, 1.0)
    return np.asarray(even[..., place - 1] * (1.0 - share) + even[..., place] * share)


def _mean_around(flat: Floats) -> Floats:
    """Return the mean of the lines around each, without its leakage; one-sided near the ends."""
    n = flat.shape[-1]
    total = cumulative(flat)
    width = min(2 * _AROUND_LINES + _WIDTH_LINES, n)
    low = np.clip(np.arange(n) - width // 2, 0, n - width)
    outer = np.take(total, low + width, axis=-1) - np.take(total, low, axis=-1)
    inner, count = moving_sum(flat, _WIDTH_LINES), moving_sum(np.ones(n), _WIDTH_LINES)
    return np.asarray((outer - inner) / np.maximum(width - count, 1.0))


def estimate_line(
    blocks: xr.Dataset, axis: str, place: int, settings: Settings = DEFAULTS
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Estimate amplitude [degree hour-1] and frequency [Hz] of a line, each with its error.

    The amplitude follows from the power about the line that exceeds the local level, in the whole
    record if a sine of constant phase has more evidence than a line, and else in blocks.
    """
    axis_blocks = blocks.sel(axis=axis)
    if _has_constant_phase(axis_blocks, place):
        sine = axis_blocks.isel(line=place)
        return _root_of_square(float(sine["sine_square"]), float(sine["sine_square_stderr"])), (
            float(sine["sine_frequency"]),
            0.5 * float(sine["sine_resolution"]),
        )
    lines = blocks["line_frequency"].values
    total, count = mean_line_power(blocks, axis)
    level = local_level(total)
    skirt = line_skirt(blocks, axis, place, settings)
    step = float(np.diff(lines[:2])[0])
    share = float(unspread_share_of_lines(blocks.sel(axis=[axis]))[0])
    above = (total[skirt] - level[skirt]) / share
    # Power N and a line S have the variance N^2 + 2 N S.
    variance = level[skirt] * np.maximum(2.0 * total[skirt] - level[skirt], level[skirt])
    noise = 4.0 * step / share * float(np.sqrt(variance.sum() / count))
    positive = np.maximum(above, 0.0)
    frequency = float((positive * lines[skirt]).sum() / max(positive.sum(), 1e-300))
    return _root_of_square(4.0 * float(above.sum()) * step, noise), (frequency, 0.5 * step)


def _has_constant_phase(axis_blocks: xr.Dataset, place: int) -> bool:
    """Return whether a sine of constant phase has more evidence than a line of this axis."""
    power, weight = (axis_blocks[name].values for name in ("line_power", "line_weight"))
    evidence = line_evidence(power[None, None], weight[None])[0, 0, place]
    return bool(axis_blocks["sine_nats"].values[place] > evidence)


def _root_of_square(square: float, stderr: float) -> tuple[float, float]:
    """Return the amplitude and its error from its square."""
    amplitude = math.sqrt(max(square, 0.0))
    return amplitude, stderr / (2.0 * max(amplitude, math.sqrt(stderr)))


def line_quality(blocks: xr.Dataset, baseline: xr.Dataset, axis: str, place: int) -> float:
    """Estimate the quality of a line from how much its power varies from block to block.

    The power of a steady line is constant. That of an oscillator driven by noise, averaged over
    blocks of the length T, has the relative variance ``x - x^2 / 2 (1 - exp(-2 / x))`` for x = t /
    T and the coherence time t = Q / (pi f). Infinite for a sine of constant phase, a line whose
    power varies no more than noise of the band does, and one that is weaker than that noise.
    """
    if _has_constant_phase(blocks.sel(axis=axis), place):
        return math.inf
    frequency = float(blocks["line_frequency"].values[place])
    band = int(np.abs(np.log(blocks["frequency"].values / frequency)).argmin())
    power, shape = (axis_values(blocks, name, axis)[:, band] for name in ("power", "shape"))
    noise = axis_values(baseline, "spectrum", axis)[:, band]
    good = np.isfinite(power) & (shape > 0.0)
    if good.sum() < MIN_BLOCKS:
        return math.inf
    power, shape = power[good], shape[good]
    line = float(power.mean() - noise[good].mean())
    if not line > 0.5 * power.mean():
        return math.inf
    by_chance = float((power.mean() ** 2 / shape).mean())
    error = math.sqrt(2.0 / power.size) * by_chance
    excess = float(power.var(ddof=1)) - by_chance
    if excess < _CERTAIN_SIGMA * error:
        return math.inf
    ratios = np.geomspace(1e-3, _MAX_COHERENCE_BLOCKS, 200)
    variance = ratios + 0.5 * ratios**2 * np.expm1(-2.0 / ratios)
    coherence = float(np.interp(excess / line**2, variance, ratios))
    return math.pi * frequency * coherence * float(blocks.attrs["block_s"])

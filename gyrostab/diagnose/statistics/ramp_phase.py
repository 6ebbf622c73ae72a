"""Score of rates that repeat with the tool rotation or with the feedback ramp."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.evidence.held_out import LinearModel
from gyrostab.diagnose.predict.candidates import Candidate, Component, Prospect, Variant
from gyrostab.diagnose.predict.condition import free_shape
from gyrostab.diagnose.predict.linear_model import (
    State,
    linear_model,
    records_last,
    variant_designs,
)
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.statistics.base import NullDraw, Statistic, choose_columns
from gyrostab.diagnose.statistics.mismatch_wording import axes_text
from gyrostab.diagnose.statistics.rotation_order import score_orders, turns_per_second
from gyrostab.diagnose.statistics.scores import (
    SINE_TAU_CYCLES,
    BlockWindows,
    cube_root_score,
    statistic_dataset,
    sum_over_windows,
    window_set,
)
from gyrostab.kernels.spectra.line_levels import LEAK_LINES
from gyrostab.physics.phase import fold

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (5, 15)


class RampPhase(Statistic):
    """The mean rate by phase of the feedback ramp."""

    name = "ramp_phase"
    view = "spectrum"
    explained_views = ("spectrum", "davar", "distribution", "mean")
    containing_views = ("davar",)
    is_power_weighted = True
    is_phase_locked = True

    def null(self, draw: NullDraw) -> Mapping[str, Floats]:
        if "profile" not in draw.blocks:
            return {}
        samples = draw.blocks["profile_samples"].values.astype(np.float64)
        safe = np.maximum(samples, 1.0)
        noise = draw.rng.standard_normal((draw.record_count, *samples.shape))
        noise = noise * draw.sample_sd[:, :1, None] / np.sqrt(safe)
        noise -= (noise * samples).sum(axis=-1, keepdims=True) / np.maximum(
            samples.sum(axis=-1), 1.0
        )[..., None]
        return {"profile": noise}

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
        """Score the harmonics that are phase-locked to the rotation, and the mean by ramp phase.

        ``estimate`` is the amplitude, or the rms over the phase [degree hour-1].
        """
        windows = window_set(blocks.sizes["block"], LENGTHS)
        rate, block = float(blocks.attrs["sampling_rate_hz"]), float(blocks.attrs["block_s"])
        scored: list[tuple[Floats, ...]] = []
        kinds: list[str] = []
        tau_min, tau_max = [], []
        if "order" in blocks:
            scored.append(score_orders(blocks, baseline, windows))
            harmonics = range(1, blocks.sizes["harmonic"] + 1)
            kinds += [f"order {h}" for h in harmonics]
            turning = turns_per_second(blocks)
            turning_blocks = turning[turning > 0]
            low, high = (
                (float(turning_blocks.min()), float(turning_blocks.max()))
                if turning_blocks.size
                else (1.0 / block, rate / 2.0)
            )
            tau_min += [SINE_TAU_CYCLES / (h * high) for h in harmonics]
            tau_max += [SINE_TAU_CYCLES / (h * low) for h in harmonics]
        if "profile" in blocks:
            scored.append(_score_profile(blocks, baseline, windows))
            kinds.append("ramp phase")
            tau_min.append(1.0 / rate)
            tau_max.append(block)
        if not scored:
            return None
        z, ratio, estimate = (
            np.concatenate(values, axis=-1) for values in zip(*scored, strict=True)
        )
        return statistic_dataset(
            blocks,
            windows=windows,
            columns={"quantity": kinds, "tau_min_s": tau_min, "tau_max_s": tau_max},
            z=z,
            ratio=ratio,
            estimate=estimate,
            one_sided=True,
        )

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield profiles that change over the phase."""
        if "profile" not in prospect.blocks:
            return
        profiles = {
            name: design
            for name, design in prospect.prediction.phase_locked.items()
            if np.isfinite(design).all() and np.ptp(design) > 0
        }
        yield from choose_columns(prospect.values, profiles)

    def model(
        self, candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
    ) -> LinearModel:
        values = records_last(data["profile"].values, 3)[row]
        rate = float(state.blocks.attrs["sampling_rate_hz"])
        width = (state.blocks["band_high"] - state.blocks["band_low"]).values
        variance = rate * (state.expected_power[row] * width).sum(axis=-1) / width.sum()
        weight = state.blocks["profile_samples"].values[row] / variance[:, None]
        given = [np.ones(weight.shape[1]), *state.given.get(("phase_locked", state.axes[row]), [])]
        return linear_model(values, weight, variant_designs(candidates), given)

    def condition(self, state: State, component: Component) -> State:
        state = state.with_columns("phase_locked", component.row[0], list(component.variant.design))
        state = state.with_columns("line", component.row[0], [_ramp_lines(state)])
        return free_shape(state, component.row[0])

    def noise_shares(
        self, component: Component, axis: str, state: State, expected_power: Floats
    ) -> tuple[Floats | float, list[Floats], list[Floats]]:
        """Return the power of the aliased lines of the profile."""
        blocks = state.blocks
        state = replace(state, expected_power=expected_power)
        mean, _ = component_mixture(component, state).moments()
        profile = np.tensordot(mean, component.variant.design, axes=1)
        square = np.abs(np.fft.rfft(profile)[1:] / profile.size) ** 2
        turns, rate = np.abs(blocks["ramp_turns"].values), float(blocks.attrs["sampling_rate_hz"])
        turns = np.where(np.isfinite(turns), turns, 0.0)
        low, high = blocks["band_low"].values, blocks["band_high"].values
        out = np.zeros((turns.size, low.size))
        for number, size in enumerate(square, start=1):
            place = fold(number * turns, rate)[:, None]
            out += np.where(
                (place >= low) & (place < high) & (turns > 0.0)[:, None], size / (high - low), 0.0
            )
        return out, [], []

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        kind = region["quantity"]
        component = (
            f"The rate of {axes_text(region['axes'])} has a component of "
            f"{region['estimate']:.3g} deg/h"
        )
        if kind == "ramp phase":
            return f"{component} rms that is locked to the phase of the feedback ramp {when}"
        order = kind.removeprefix("order ")
        multiple = "" if order == "1" else f"{order} times "
        return f"{component} at {multiple}the rotation rate of the tool {when}"


def _score_profile(
    blocks: xr.Dataset, baseline: xr.Dataset, windows: BlockWindows
) -> tuple[Floats, ...]:
    """Return score, ratio and rms of the mean by phase, by (record), axis, window, 1."""
    profile = blocks["profile"].values
    samples = blocks["profile_samples"].values
    width = (blocks["band_high"] - blocks["band_low"]).values
    variance = 2.0 * (baseline["spectrum"].values * width).sum(axis=-1)[..., None]
    present = np.isfinite(profile) & (samples > 0) & np.isfinite(variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(present, samples / variance, 0.0)
        sums = sum_over_windows(np.where(present, profile, 0.0) * weight, windows)
        total = sum_over_windows(weight, windows)
        used = (total > 0).sum(axis=-1, keepdims=True)
        square = np.where(total > 0, sums**2 / total, 0.0).sum(axis=-1, keepdims=True)
        ratio = np.where(used > 1, square / used, np.nan)
        excess = np.maximum(square - used, 0.0) / total.sum(axis=-1, keepdims=True)
    return cube_root_score(ratio, np.where(used > 1, used / 2.0, np.nan)), ratio, np.sqrt(excess)


def _ramp_lines(state: State) -> Bools:
    """Return the lines at multiples of the ramp frequency, aliased by the sampling."""
    lines = state.blocks["line_frequency"].values
    rate = float(state.blocks.attrs["sampling_rate_hz"])
    turns = np.abs(state.blocks["ramp_turns"].values)
    turns = turns[np.isfinite(turns)]
    if not turns.size:
        return np.zeros(lines.size, np.bool_)
    number = np.arange(1, max(2, int(rate / max(turns.mean(), lines[0]))))
    low, high = (fold(number * turn_rate, rate) for turn_rate in (turns.min(), turns.max()))
    reach = LEAK_LINES * lines[0]
    near_ramp = (lines[:, None] >= np.minimum(low, high) - reach) & (
        lines[:, None] <= np.maximum(low, high) + reach
    )
    return np.asarray(near_ramp.any(axis=1))

"""Find effects that the data cannot separate, and reject sizes that physics does not allow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gyrostab.diagnose.evidence.telegraph import telegraph_evidence
from gyrostab.diagnose.identify.effect_candidates import largest_size
from gyrostab.diagnose.identify.identification import Identification, Unidentified, components_of
from gyrostab.diagnose.identify.jumps import is_lasting, is_sudden, lead_to_levels
from gyrostab.diagnose.identify.logger_filters import fits_all_axes
from gyrostab.diagnose.identify.steady import is_always_present
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.reduce.block_statistics import measured
from gyrostab.diagnose.reduce.zero_bin import possibly_truncated_axes
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics.telegraph import add_fast_switching, fast_switching_evidence
from gyrostab.physics.registry import effects

__all__ = [
    "EQUIVALENTS",
    "OBSERVATIONALLY_EQUIVALENT",
    "find_equivalent_effects",
    "find_plainer_effect",
    "is_physical",
    "without_pulses",
]

#: Effect -> effects that look the same in block statistics, whatever the excitation.
OBSERVATIONALLY_EQUIVALENT: dict[str, tuple[str, ...]] = {
    "gauss_markov": ("telegraph",),
    "spectral_line": ("real_motion", "supply_bias"),
}
#: Effect -> effect that it becomes at the end of the range of a parameter: without a dead band,
#: hysteresis is proportional to temperature.
EQUIVALENTS = {"thermal_hysteresis": "temperature_bias"}


def without_pulses(
    chosen: Sequence[Identification | Unidentified], *, settings: Settings = DEFAULTS
) -> list[Identification | Unidentified]:
    """Drop spikes on axes that have a comb of lines or a profile of the feedback ramp.

    A comb is a periodic pulse, and the outliers are the pulse itself. Bad samples would make no
    lines.
    """
    lines: Counter[str] = Counter()
    for component in components_of(chosen):
        has_profile = component.statistic.is_phase_locked and not component.statistic.is_rotation
        weight = settings.min_comb_lines if has_profile else int(component.statistic.is_line)
        lines.update(dict.fromkeys(component.row, weight))
    out: list[Identification | Unidentified] = []
    for one in chosen:
        if isinstance(one, Identification) and one.effect == "spikes":
            kept = tuple(
                component
                for component in one.components
                if lines[component.row[0]] < settings.min_comb_lines
            )
            out += (
                [replace(one, components=kept, axes=tuple(component.row[0] for component in kept))]
                if kept
                else []
            )
        else:
            out.append(one)
    return out


def is_physical(
    components: Sequence[Component], state: State, *, error: float = 0.0
) -> list[Component]:
    """Return the components of an effect whose sizes are possible.

    Without an effect on an axis, chance may fit an impossible size. `error` is what errors of the
    form of all other effects may leave to this one [nats].
    """
    whole = (
        fits_all_axes(components, state)
        and is_sudden(components, state, error=error)
        and is_lasting(components, state)
        and lead_to_levels(components, state)
    )
    return (
        [component for component in components if _is_component_physical(component, state)]
        if whole
        else []
    )


def find_plainer_effect(components: Sequence[Component], state: State) -> str | None:
    """Return the effect that explains the same more plainly, or None.

    An axis senses a real rotation by the cosine of its angle to it, which is rarely small; errors
    of the scale factor are.
    """
    effect = components[0].candidate.effect
    if effect == "real_motion" and all(
        _is_rotation(component)
        and _rotation_share(component, state) < state.settings.max_misalignment_share
        for component in components
    ):
        return "scale_factor"
    return EQUIVALENTS.get(effect)


def _is_rotation(component: Component) -> bool:
    """Return whether a component is that of an axis that senses the rotation of the tool."""
    return (
        component.candidate.effect == "real_motion"
        and component.statistic.is_linear_in_means
        and component.variant.columns == ("spin",)
    )


def _rotation_share(component: Component, state: State) -> float:
    from gyrostab.diagnose.predict.sizes import component_size

    return abs(component_size(component, state)[0])


def _is_component_physical(component: Component, state: State) -> bool:
    from gyrostab.diagnose.predict.sizes import component_mixture, component_size

    effect, statistic = component.candidate.effect, component.statistic
    if (
        effect == "misalignment"
        and statistic.is_transfer
        and not _is_moving(component.candidate.reference[0], state)
    ):
        return False
    if (
        _is_rotation(component)
        and _rotation_share(component, state) < state.settings.min_rotation_share
    ):
        return False
    if (
        effect == "fringe_hop"
        and abs(component_size(component, state)[0]) * np.abs(component.variant.design).max()
        < state.settings.min_fringe_step
    ):
        return False
    largest = largest_size(effect, state.settings)
    if np.isfinite(largest) and component.variant.columns[0] != "any":
        return bool(np.abs(component_mixture(component, state).moments()[0]).max() <= largest)
    if statistic.is_linear_in_means and not _is_in_range(component, state):
        return False
    if statistic.is_power and not _is_above_least(component, state):
        return False
    if statistic.is_switching and _has_more_levels(component, state):
        return False
    if not is_always_present(component, state):
        return False
    return not (
        component.variant.squared
        and statistic.is_power
        and component_size(component, state)[0] <= 0.0
    )


def _is_in_range(component: Component, state: State) -> bool:
    """Return whether the sizes of a mean can lie in the ranges that the registry allows."""
    from gyrostab.diagnose.predict.sizes import component_mixture

    largest = {
        item.name: max(abs(item.low), abs(item.high))
        for item in effects()[component.candidate.effect].parameters()
    }
    sizes, covariance = component_mixture(component, state).moments()
    least = np.abs(sizes) - state.settings.clear_sigma * np.sqrt(np.diagonal(covariance))
    return all(
        size <= largest.get(name, np.inf)
        for name, size in zip(component.variant.columns, least, strict=True)
    )


def _is_above_least(component: Component, state: State) -> bool:
    """Return whether the size of a noise level can be above the least that the registry allows.

    Ageing, for example, does not improve a gyro.
    """
    from gyrostab.diagnose.predict.sizes import component_size

    if component.variant.squared or len(component.variant.columns) != 1:
        return True
    least = {
        item.name: item.low for item in effects()[component.candidate.effect].parameters()
    }.get(component.variant.columns[0])
    if least is None or not np.isfinite(least):
        return True
    size, error = component_size(component, state)
    return size >= least - state.settings.clear_sigma * error


def _has_more_levels(component: Component, state: State) -> bool:
    """Return whether the bias still switches with two levels in the model: it has three or more."""
    axis, settings = component.row[0], state.settings
    allowed = settings.ambiguous_nats + settings.form_error_share * component.evidence_nats
    if component.variant.inside.size:
        within = fast_switching_evidence(state.blocks, add_fast_switching(state, component), axis)
        return within is not None and within.evidence_nats > allowed
    given = np.stack(
        [*state.given.get(("mean", axis), []), component.variant.design[0, 0]], axis=-1
    )
    evidence_nats, _ = telegraph_evidence(
        state.blocks, state.baseline, axis=axis, given=given, settings=settings
    )
    return bool(evidence_nats[0] > allowed)


def _is_moving(axis: str, state: State) -> bool:
    """Return whether an axis exceeds its noise at some frequency; what is at rest cannot leak."""
    row = state.axes.index(axis)
    expected = state.baseline["spectrum"].values[row]
    return bool(
        np.nanmax(np.nanmean(measured(state.blocks, "power").values[row] / expected, axis=0))
        > state.settings.moving_power_ratio
    )


def find_equivalent_effects(
    effect: str, components: Sequence[Component], state: State, *, lines: int = 0
) -> list[str]:
    """Return effects that the data cannot separate from this one; `lines` counts all lines."""
    out = list(OBSERVATIONALLY_EQUIVALENT.get(effect, ()))
    blocks = state.blocks
    if (
        effect == "spectral_line"
        and "profile" not in blocks
        and lines >= state.settings.min_comb_lines
    ):
        out.append("feedback_reset")
    if (
        effect == "dead_zone" and len(state.axes) == 1
    ):  # no other axis shows whether the sample was lost
        out.append("held_samples")
    if effect == "dead_zone" and any(
        possibly_truncated_axes(blocks)[state.axes.index(component.row[0])]
        for component in components
    ):
        out.append("rate_quantization")  # truncation towards zero makes the zero bin twice as wide
    if effect == "telegraph" and not any(
        component.statistic.is_switching for component in components
    ):
        out.append("gauss_markov")  # two levels show only in the means
    if effect == "vibration_rectification":
        vibration = blocks[f"channel_{components[0].candidate.driver[0]}"].values
        good = np.isfinite(vibration)
        if (
            np.corrcoef(vibration[good], vibration[good] ** 2)[0, 1]
            > state.settings.level_correlation
        ):
            out.append("g_sensitivity")
    return out

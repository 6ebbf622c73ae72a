"""Find effects that the data cannot separate, and reject sizes that physics does not allow."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.telegraph import telegraph_evidence
from gyrostab.diagnose.evidence.visits import compare_visits
from gyrostab.diagnose.identify.effect_candidates import largest_size
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identification import (
    Identification,
    Selection,
    components_of,
)
from gyrostab.diagnose.identify.jumps import event_nats, gradual_nats, scatter_nats
from gyrostab.diagnose.identify.logger_filters import separate_axes_nats
from gyrostab.diagnose.identify.steady import intermittent_nats
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.reduce.block_statistics import measured
from gyrostab.diagnose.reduce.zero_bin import possibly_truncated_axes
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics.telegraph import add_fast_switching, fast_switching_evidence
from gyrostab.physics.registry import effects

__all__ = [
    "EQUIVALENTS",
    "OBSERVATIONALLY_EQUIVALENT",
    "find_better_form",
    "find_equivalent_effects",
    "find_plainer_effect",
    "find_spectral_alternatives",
    "is_physical",
    "without_pulses",
]

Array = NDArray[np.float64]
_PPM = 1e6  # in one
_JUMP_CHANGES = 2  # from block to block, in the column of a jump within a block
#: Effect -> effects that look the same in block statistics, whatever the excitation.
OBSERVATIONALLY_EQUIVALENT: dict[str, tuple[str, ...]] = {
    "gauss_markov": ("telegraph",),
    "spectral_line": ("real_motion", "supply_bias"),
}
#: Effect -> effects that follow the same channel with another spectrum, which may be any that a
#: mount, a filter or aliasing gives them.
DIFFERENT_SPECTRUM: dict[str, tuple[str, ...]] = {
    "aliased_vibration": ("vibration_noise",),
    "vibration_noise": ("aliased_vibration",),
}
#: Effect -> effect that it becomes at the end of the range of a parameter: without a dead band,
#: hysteresis is proportional to temperature.
EQUIVALENTS = {"thermal_hysteresis": "temperature_bias"}


def without_pulses(chosen: Sequence[Selection], settings: Settings) -> list[Selection]:
    """Drop spikes on axes that have a comb of lines or a profile of the feedback ramp.

    A comb is a periodic pulse, and the outliers are the pulse itself. Bad samples would make no
    lines.
    """
    lines: Counter[str] = Counter()
    for component in components_of(chosen):
        has_profile = component.statistic.is_phase_locked and not component.statistic.is_rotation
        weight = settings.min_comb_lines if has_profile else int(component.statistic.is_line)
        lines.update(dict.fromkeys(component.row, weight))
    out: list[Selection] = []
    for selection in chosen:
        if isinstance(selection, Identification) and selection.effect == "spikes":
            remaining = tuple(
                component
                for component in selection.components
                if lines[component.row[0]] < settings.min_comb_lines
            )
            out += (
                [
                    replace(
                        selection,
                        components=remaining,
                        axes=tuple(component.row[0] for component in remaining),
                    )
                ]
                if remaining
                else []
            )
        else:
            out.append(selection)
    return out


def is_physical(
    components: Sequence[Component], state: State, *, error: float = 0.0
) -> list[Component]:
    """Return the components of an effect that no other form explains better, of possible sizes.

    Without an effect on an axis, chance may fit an impossible size. `error` is what errors of the
    form of all other effects may leave to this one [nats].
    """
    if _find_other_course(components, state, error):
        return []
    return [component for component in components if not _find_other_form(component, state)]


def find_better_form(
    components: Sequence[Component], state: State, *, error: float = 0.0
) -> tuple[str, float] | None:
    """Return the form that excludes an effect, and by how much it explains more [nats].

    NaN for sizes that physics excludes; None where some component is left.

    Parameters
    ----------
    components : sequence of Component
        Components of the effect, the strongest first.
    state, error : State, float
        As for `is_physical`.
    """
    other_course = _find_other_course(components, state, error)
    forms = (
        [_find_other_form(component, state) for component in components] if not other_course else []
    )
    return other_course or (forms[0] if forms and all(forms) else None)


def _find_other_course(
    components: Sequence[Component], state: State, error: float
) -> tuple[str, float] | None:
    """Return another course on all axes that explains more, and by how much [nats]."""
    forms: tuple[tuple[str, Callable[[], float]], ...] = (
        ("a filter on each axis", lambda: separate_axes_nats(components, state)),
        ("a gradual change", lambda: gradual_nats(components, state, error=error)),
        ("an event that ends", lambda: event_nats(components, state)),
        ("means that scatter for a while", lambda: scatter_nats(components, state)),
        ("levels that differ", lambda: _unequal_levels_nats(components, state, error=error)),
    )
    return next(((name, nats) for name, find in forms if (nats := find())), None)


def find_plainer_effect(components: Sequence[Component], state: State) -> str | None:
    """Return the effect that explains the same more plainly, or None.

    An axis senses a real rotation by the cosine of its angle to it, which is rarely small; errors
    of the scale factor are, and physics excludes large ones.
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
    """Return the share of the rotation of the tool that an axis senses, or that an error is."""
    from gyrostab.diagnose.predict.sizes import component_mixture, component_size

    if _is_rotation(component):
        return abs(component_size(component, state)[0])
    row = state.axes.index(component.row[0])
    error = component_mixture(component, state).moments()[0] @ mean_columns(component.variant, row)
    per_ppm = next(
        mean_columns(variant, row)[0]
        for variant in component.candidate.variants
        if variant.columns == ("linear",)
    )
    return float(np.nanstd(error) / (_PPM * np.nanstd(per_ppm)))


def _find_other_form(component: Component, state: State) -> tuple[str, float] | None:
    """Return what excludes a component, and by how much it explains more [nats]."""
    if not _is_possible(component, state):
        return "an impossible size", math.nan
    forms: tuple[tuple[str, Callable[[Component, State], float]], ...] = (
        ("more than two levels", _further_level_nats),
        ("an effect in a part of the record", intermittent_nats),
    )
    return next(((name, nats) for name, find in forms if (nats := find(component, state))), None)


def _is_possible(component: Component, state: State) -> bool:
    """Return whether physics allows the size of a component, and its cause is present."""
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
        effect == "scale_factor"
        and statistic.is_linear_in_means
        and _rotation_share(component, state) > state.settings.max_misalignment_share
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
    smallest_sizes = np.abs(sizes) - state.settings.clear_sigma * np.sqrt(np.diagonal(covariance))
    return all(
        size <= largest.get(name, np.inf)
        for name, size in zip(component.variant.columns, smallest_sizes, strict=True)
    )


def _is_above_least(component: Component, state: State) -> bool:
    """Return whether the size of a noise level can be above the least that the registry allows.

    Ageing, for example, does not improve a gyro.
    """
    from gyrostab.diagnose.predict.sizes import component_size

    if component.variant.squared or len(component.variant.columns) != 1:
        return True
    lower_bound = {
        item.name: item.low for item in effects()[component.candidate.effect].parameters()
    }.get(component.variant.columns[0])
    if lower_bound is None or not np.isfinite(lower_bound):
        return True
    size, error = component_size(component, state)
    return size >= lower_bound - state.settings.clear_sigma * error


def _further_level_nats(component: Component, state: State) -> float:
    """Return the evidence that the bias still switches with two levels in the model [nats].

    Zero unless it is clear. The bias then has three levels or more.
    """
    if not component.statistic.is_switching:
        return 0.0
    axis, settings = component.row[0], state.settings
    allowed = settings.ambiguous_nats + settings.form_error_share * component.evidence_nats
    if component.variant.inside.size:
        switching = fast_switching_evidence(
            state.blocks, add_fast_switching(state, component), axis
        )
        nats = switching.evidence_nats if switching is not None else 0.0
        return nats if nats > allowed else 0.0
    given_columns = np.stack(
        [*state.given.get(("mean", axis), []), component.variant.design[0, 0]], axis=-1
    )
    evidence_nats, _ = telegraph_evidence(
        state.blocks, state.baseline, axis=axis, given=given_columns, settings=settings
    )
    return float(evidence_nats[0]) if evidence_nats[0] > allowed else 0.0


def _unequal_levels_nats(components: Sequence[Component], state: State, *, error: float) -> float:
    """Return by how much levels that differ at each visit explain more than two levels [nats].

    Zero if two levels explain clearly more, with enough switches. Otherwise the bias may follow
    something that was not recorded. Axes of one course show the same visits: that these are equal
    counts once.
    """
    levels = [component for component in components if component.statistic.is_switching]
    if not levels:
        return 0.0
    unequal = np.array([_unequal_nats(component, state) for component in levels])
    nats = float(unequal.min() + np.maximum(unequal, 0.0)[unequal > unequal.min()].sum())
    return max(nats + error + state.settings.ambiguous_nats, 0.0)


def _unequal_nats(component: Component, state: State) -> float:
    """Return the evidence of an axis for levels that differ [nats], 0 or more with few switches.

    Jumps that were named first may be switches. The switches are therefore also found without them.
    """
    variant, axis = component.variant, component.row[0]
    given_columns = state.given.get(("mean", axis), [])
    share = variant.inside if variant.inside.size else variant.design[0, 0]
    courses = [(share, given_columns)]
    without_jumps = [
        column for column in given_columns if np.count_nonzero(np.diff(column)) > _JUMP_CHANGES
    ]
    if len(without_jumps) < len(given_columns) and not variant.inside.size:
        _, telegraph = telegraph_evidence(
            state.blocks,
            state.baseline,
            axis=axis,
            given=np.stack(without_jumps, axis=-1) if without_jumps else None,
            settings=state.settings,
        )
        courses.append((telegraph.share[0], without_jumps))
    return min(_compare_course(share, axis, columns, state) for share, columns in courses)


def _compare_course(share: Array, axis: str, given_columns: Sequence[Array], state: State) -> float:
    """Return the evidence of a course for levels that differ, at least 0 with few switches."""
    visits = compare_visits(
        state.blocks["mean"].sel(axis=axis).values,
        state.baseline,
        share,
        axis=axis,
        block_s=float(state.blocks.attrs["block_s"]),
        given=np.stack(given_columns, axis=-1) if given_columns else None,
    )
    is_known = visits.switch_count >= state.settings.min_switches
    return visits.unequal_nats if is_known else max(visits.unequal_nats, 0.0)


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


def find_spectral_alternatives(
    effect: str,
    components: Sequence[Component],
    state: State,
    examination: Examination,
) -> list[str]:
    """Return effects of the same channel, if a spectrum of another form explains clearly more.

    The forms that were tried then do not tell the effects apart: vibration through the resonance of
    a mount has a hump like an aliased band. `state` has all other effects in the model.
    """
    powers = [component for component in components if component.statistic.is_power]
    if effect not in DIFFERENT_SPECTRUM or not powers:
        return []
    own_nats = sum(component.evidence_nats for component in powers)
    free = 0.0
    for component in powers:
        evidence = examination.compute_evidence([_any_spectrum(component, state)], state)[0]
        free += float(evidence.evidence_nats[0, evidence.rows.index(component.row)])
    allowed = state.settings.ambiguous_nats + state.settings.form_error_share * own_nats
    return list(DIFFERENT_SPECTRUM[effect]) if free - own_nats > allowed else []


def _any_spectrum(component: Component, state: State) -> Candidate:
    """Return a power of any spectrum with the course of a component over time."""
    design = component.variant.design
    row = state.axes.index(component.row[0]) if design.shape[1] > 1 else 0
    course = design[0, row].mean(axis=-1)
    bands = np.eye(design.shape[-1])
    variant = Variant(
        {}, tuple(map(str, range(len(bands)))), course[None, None, :, None] * bands[:, None, None]
    )
    return Candidate("~S(f)", component.statistic, component.candidate.driver, (variant,))

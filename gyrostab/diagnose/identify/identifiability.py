"""What the data cannot tell by their nature, and sizes that physics does not allow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gyrostab.diagnose.evidence.telegraph import telegraph_evidence
from gyrostab.diagnose.identify.identification import Identification, Unidentified
from gyrostab.diagnose.identify.jumps import is_lasting, is_sudden, levels
from gyrostab.diagnose.identify.logger_filters import on_all_axes
from gyrostab.diagnose.identify.steady import is_always_present
from gyrostab.diagnose.predict.candidates import LARGEST_SIZE
from gyrostab.diagnose.predict.condition import Component, add_fast_switching
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import fast_switching_evidence
from gyrostab.diagnose.reduce.block_statistics import measured
from gyrostab.diagnose.reduce.zero_bin import possibly_truncated_axes
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
#: Effect -> effect that it becomes where a parameter goes to its end: without play, hysteresis is
#: proportional to temperature.
EQUIVALENTS = {"thermal_hysteresis": "temperature_bias"}
_SMALLEST_FRINGE = 6e4  # deg/h: 5 km of fibre on 30 cm
_SURE = 3.0  # standard errors beyond its range, from which on a size is impossible
_COMB = 3  # lines that may be one comb
_MOVING = 1.5  # times the expected power, from which on an axis moves
_MORE, _FORM = 3.0, 0.01  # nats that further levels may gain, and of the first two's
_LEAN, _SQUARE = (
    2e-2,
    1e-5,
)  # shares of the turning: of an axis that is across it, at most; and to which one can be squared up
_LEVELS = 0.97  # correlation of g and g^2 above which vibration has one level


def without_pulses(
    chosen: Sequence[Identification | Unidentified],
) -> list[Identification | Unidentified]:
    """What is chosen, without spikes on axes that have a comb of lines or a profile of the ramp.

    A comb is a pulse that comes again and again, and what jumps out there is the pulse itself:
    wrong samples would make no lines.
    """
    lines: Counter[str] = Counter()
    for component in (component for one in chosen for component in one.components):
        weight = {"line": 1, "phase_locked": _COMB}.get(component.candidate.statistic, 0)
        lines.update(dict.fromkeys(component.row, weight))
    out: list[Identification | Unidentified] = []
    for one in chosen:
        if isinstance(one, Identification) and one.effect == "spikes":
            kept = tuple(
                component for component in one.components if lines[component.row[0]] < _COMB
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
    """Those parts of an effect whose sizes are possible; on an axis without it chance may fit a size that is not.

    `error` is what errors of the form of all else that is named may leave to the effect [nats].
    """
    whole = (
        on_all_axes(components, state)
        and is_sudden(components, state, error=error)
        and is_lasting(components, state)
        and levels(components, state)
    )
    return [component for component in components if _possible(component, state)] if whole else []


def find_plainer_effect(components: Sequence[Component], state: State) -> str | None:
    """Effect that says the same more plainly; None where there is none.

    A real turning is seen by the cosine of the angle to the axis, which is rarely small; errors of
    the scale factor are.
    """
    effect = components[0].candidate.effect
    if effect == "real_motion" and all(
        _spin(component) and _share(component, state) < _LEAN for component in components
    ):
        return "scale_factor"
    return EQUIVALENTS.get(effect)


def _spin(component: Component) -> bool:
    """Whether a part says that an axis sees the turning of the tool."""
    return (
        component.candidate.effect == "real_motion"
        and component.candidate.statistic == "mean"
        and component.variant.columns == ("spin",)
    )


def _share(component: Component, state: State) -> float:
    from gyrostab.diagnose.predict.sizes import component_size

    return abs(component_size(component, state)[0])


def _possible(component: Component, state: State) -> bool:
    from gyrostab.diagnose.predict.sizes import component_mixture, component_size

    effect, statistic = component.candidate.effect, component.candidate.statistic
    if (
        effect == "misalignment"
        and statistic == "transfer"
        and not _moves(component.candidate.witness[0], state)
    ):
        return False
    if _spin(component) and _share(component, state) < _SQUARE:
        return False
    if (
        effect == "fringe_hop"
        and abs(component_size(component, state)[0]) * np.abs(component.variant.design).max()
        < _SMALLEST_FRINGE
    ):
        return False
    if effect in LARGEST_SIZE and component.variant.columns[0] != "any":
        return bool(
            np.abs(component_mixture(component, state).moments()[0]).max() <= LARGEST_SIZE[effect]
        )
    if statistic == "mean" and not _in_range(component, state):
        return False
    if statistic == "power" and not _from_least(component, state):
        return False
    if statistic == "levels" and _more_levels(component, state):
        return False
    if not is_always_present(component, state):
        return False
    return not (
        component.variant.squared
        and statistic == "power"
        and component_size(component, state)[0] <= 0.0
    )


def _in_range(component: Component, state: State) -> bool:
    """Whether the sizes of block means can lie where the registry allows the parameters: an instrument that has others is broken."""
    from gyrostab.diagnose.predict.sizes import component_mixture

    largest = {
        item.name: max(abs(item.low), abs(item.high))
        for item in effects()[component.candidate.effect].parameters()
    }
    sizes, covariance = component_mixture(component, state).moments()
    least = np.abs(sizes) - _SURE * np.sqrt(np.diagonal(covariance))
    return all(
        size <= largest.get(name, np.inf)
        for name, size in zip(component.variant.columns, least, strict=True)
    )


def _from_least(component: Component, state: State) -> bool:
    """Whether the size of a level of the noise lies above the least that the registry allows: what ages does not get better."""
    from gyrostab.diagnose.predict.sizes import component_size

    if component.variant.squared or len(component.variant.columns) != 1:
        return True
    least = {
        item.name: item.low for item in effects()[component.candidate.effect].parameters()
    }.get(component.variant.columns[0])
    if least is None or not np.isfinite(least):
        return True
    size, error = component_size(component, state)
    return size >= least - _SURE * error


def _more_levels(component: Component, state: State) -> bool:
    """Whether, beside the two levels, the bias hops once more: then it has three or more."""
    axis = component.row[0]
    if component.variant.inside.size:
        within = fast_switching_evidence(state.blocks, add_fast_switching(state, component), axis)
        return within is not None and within.evidence_nats > _MORE + _FORM * component.evidence_nats
    given = np.stack(
        [*state.given.get(("mean", axis), []), component.variant.design[0, 0]], axis=-1
    )
    evidence_nats, _ = telegraph_evidence(state.blocks, state.baseline, axis=axis, given=given)
    return bool(evidence_nats[0] > _MORE + _FORM * component.evidence_nats)


def _moves(axis: str, state: State) -> bool:
    """Whether an axis shows more than its noise at some frequency: what is at rest cannot leak in."""
    row = state.axes.index(axis)
    expected = state.baseline["spectrum"].transpose("axis", "block", "band").values[row]
    return bool(
        np.nanmax(np.nanmean(measured(state.blocks, "power").values[row] / expected, axis=0))
        > _MOVING
    )


def find_equivalent_effects(
    effect: str, components: Sequence[Component], state: State, *, lines: int = 0
) -> list[str]:
    """Effects that are part of the answer by their nature; `lines` are named in all."""
    out = list(OBSERVATIONALLY_EQUIVALENT.get(effect, ()))
    blocks = state.blocks
    if effect == "spectral_line" and "profile" not in blocks and lines >= _COMB:
        out.append("feedback_reset")
    if (
        effect == "dead_zone" and len(state.axes) == 1
    ):  # no other axis says whether the sample was lost
        out.append("held_samples")
    if effect == "dead_zone" and any(
        possibly_truncated_axes(blocks)[state.axes.index(component.row[0])]
        for component in components
    ):
        out.append("rate_quantization")  # cut off towards zero, its cell of zero is twice as wide
    if effect == "telegraph" and not any(
        component.candidate.statistic == "levels" for component in components
    ):
        out.append("gauss_markov")  # two levels show in the means only
    if effect == "vibration_rectification":
        vibration = blocks[f"channel_{components[0].candidate.driver[0]}"].values
        good = np.isfinite(vibration)
        if np.corrcoef(vibration[good], vibration[good] ** 2)[0, 1] > _LEVELS:
            out.append("g_sensitivity")
    return out

"""What the data cannot tell by their nature, and sizes that physics does not allow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gyrostab.diagnose.evidence.telegraph import level_gains
from gyrostab.diagnose.identify.identification import Claim, Unknown
from gyrostab.diagnose.identify.jumps import levels, stays, sudden
from gyrostab.diagnose.identify.logger_filters import on_all_axes
from gyrostab.diagnose.identify.steady import always_there
from gyrostab.diagnose.predict.candidates import LARGEST
from gyrostab.diagnose.predict.condition import Part, with_hops
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import hops_within
from gyrostab.diagnose.reduce.block_statistics import measured
from gyrostab.diagnose.reduce.zero_bin import may_be_cut_off
from gyrostab.physics.registry import effects

__all__ = ["PLAINER", "STRUCTURAL", "plainer_effect", "possible", "structural", "without_pulses"]

#: Effect -> effects that look the same in block statistics, whatever the excitation.
STRUCTURAL: dict[str, tuple[str, ...]] = {
    "gauss_markov": ("telegraph",),
    "spectral_line": ("real_motion", "supply_bias"),
}
#: Effect -> effect that it becomes where a parameter goes to its end: without play, hysteresis is proportional to temperature.
PLAINER = {"thermal_hysteresis": "temperature_bias"}
_SMALLEST_FRINGE = 6e4  # deg/h: 5 km of fibre on 30 cm
_SURE = 3.0  # standard errors beyond its range, from which on a size is impossible
_COMB = 3  # lines that may be one comb
_MOVING = 1.5  # times the expected power, from which on an axis moves
_MORE, _FORM = 3.0, 0.01  # nats that further levels may gain, and of the first two's
_LEAN, _SQUARE = 2e-2, 1e-5  # shares of the turning: of an axis that is across it, at most; and to which one can be squared up
_LEVELS = 0.97  # correlation of g and g^2 above which vibration has one level


def without_pulses(chosen: Sequence[Claim | Unknown]) -> list[Claim | Unknown]:
    """What is chosen, without spikes on axes that have a comb of lines or a profile of the ramp.

    A comb is a pulse that comes again and again, and what jumps out there is the pulse itself: wrong samples would make no lines.
    """
    lines: Counter[str] = Counter()
    for part in (part for one in chosen for part in one.parts):
        weight = {"line": 1, "phase_locked": _COMB}.get(part.candidate.view, 0)
        lines.update(dict.fromkeys(part.row, weight))
    out: list[Claim | Unknown] = []
    for one in chosen:
        if isinstance(one, Claim) and one.effect == "spikes":
            kept = tuple(part for part in one.parts if lines[part.row[0]] < _COMB)
            out += [replace(one, parts=kept, axes=tuple(part.row[0] for part in kept))] if kept else []
        else:
            out.append(one)
    return out


def possible(parts: Sequence[Part], state: State, *, error: float = 0.0) -> list[Part]:
    """Those parts of an effect whose sizes are possible; on an axis without it chance may fit a size that is not.

    `error` is what errors of the form of all else that is named may leave to the effect [nats].
    """
    whole = on_all_axes(parts, state) and sudden(parts, state, error=error) and stays(parts, state) and levels(parts, state)
    return [part for part in parts if _possible(part, state)] if whole else []


def plainer_effect(parts: Sequence[Part], state: State) -> str | None:
    """Effect that says the same more plainly; None where there is none.

    A real turning is seen by the cosine of the angle to the axis, which is rarely small; errors of the scale factor are.
    """
    effect = parts[0].candidate.effect
    if effect == "real_motion" and all(_spin(part) and _share(part, state) < _LEAN for part in parts):
        return "scale_factor"
    return PLAINER.get(effect)


def _spin(part: Part) -> bool:
    """Whether a part says that an axis sees the turning of the tool."""
    return part.candidate.effect == "real_motion" and part.candidate.view == "mean" and part.variant.columns == ("spin",)


def _share(part: Part, state: State) -> float:
    from gyrostab.diagnose.predict.sizes import part_size

    return abs(part_size(part, state)[0])


def _possible(part: Part, state: State) -> bool:
    from gyrostab.diagnose.predict.sizes import part_mixture, part_size

    effect, view = part.candidate.effect, part.candidate.view
    if effect == "misalignment" and view == "transfer" and not _moves(part.candidate.witness[0], state):
        return False
    if _spin(part) and _share(part, state) < _SQUARE:
        return False
    if effect == "fringe_hop" and abs(part_size(part, state)[0]) * np.abs(part.variant.design).max() < _SMALLEST_FRINGE:
        return False
    if effect in LARGEST and part.variant.columns[0] != "any":
        return bool(np.abs(part_mixture(part, state).moments()[0]).max() <= LARGEST[effect])
    if view == "mean" and not _in_range(part, state):
        return False
    if view == "power" and not _from_least(part, state):
        return False
    if view == "levels" and _more_levels(part, state):
        return False
    if not always_there(part, state):
        return False
    return not (part.variant.squared and view == "power" and part_size(part, state)[0] <= 0.0)


def _in_range(part: Part, state: State) -> bool:
    """Whether the sizes of block means can lie where the registry allows the parameters: an instrument that has others is broken."""
    from gyrostab.diagnose.predict.sizes import part_mixture

    largest = {item.name: max(abs(item.low), abs(item.high)) for item in effects()[part.candidate.effect].parameters()}
    sizes, covariance = part_mixture(part, state).moments()
    least = np.abs(sizes) - _SURE * np.sqrt(np.diagonal(covariance))
    return all(size <= largest.get(name, np.inf) for name, size in zip(part.variant.columns, least, strict=True))


def _from_least(part: Part, state: State) -> bool:
    """Whether the size of a level of the noise lies above the least that the registry allows: what ages does not get better."""
    from gyrostab.diagnose.predict.sizes import part_size

    if part.variant.squared or len(part.variant.columns) != 1:
        return True
    least = {item.name: item.low for item in effects()[part.candidate.effect].parameters()}.get(part.variant.columns[0])
    if least is None or not np.isfinite(least):
        return True
    size, error = part_size(part, state)
    return size >= least - _SURE * error


def _more_levels(part: Part, state: State) -> bool:
    """Whether, beside the two levels, the bias hops once more: then it has three or more."""
    axis = part.row[0]
    if part.variant.inside.size:
        within = hops_within(state.reduced, with_hops(state, part), axis)
        return within is not None and within.gain > _MORE + _FORM * part.gain
    given = np.stack([*state.given.get(("mean", axis), []), part.variant.design[0, 0]], axis=-1)
    gain, _ = level_gains(state.reduced, state.baseline, axis=axis, given=given)
    return bool(gain[0] > _MORE + _FORM * part.gain)


def _moves(axis: str, state: State) -> bool:
    """Whether an axis shows more than its noise at some frequency: what is at rest cannot leak in."""
    row = state.axes.index(axis)
    expected = state.baseline["spectrum"].transpose("axis", "block", "band").values[row]
    return bool(np.nanmax(np.nanmean(measured(state.reduced, "power").values[row] / expected, axis=0)) > _MOVING)


def structural(effect: str, parts: Sequence[Part], state: State, *, lines: int = 0) -> list[str]:
    """Effects that are part of the answer by their nature; `lines` are named in all."""
    out = list(STRUCTURAL.get(effect, ()))
    reduced = state.reduced
    if effect == "spectral_line" and "profile" not in reduced and lines >= _COMB:
        out.append("feedback_reset")
    if effect == "dead_zone" and len(state.axes) == 1:  # no other axis says whether the sample was lost
        out.append("held_samples")
    if effect == "dead_zone" and any(may_be_cut_off(reduced)[state.axes.index(part.row[0])] for part in parts):
        out.append("rate_quantization")  # cut off towards zero, its cell of zero is twice as wide
    if effect == "telegraph" and not any(part.candidate.view == "levels" for part in parts):
        out.append("gauss_markov")  # two levels show in the means only
    if effect == "vibration_rectification":
        vibration = reduced[f"channel_{parts[0].candidate.driver[0]}"].values
        good = np.isfinite(vibration)
        if np.corrcoef(vibration[good], vibration[good] ** 2)[0, 1] > _LEVELS:
            out.append("g_sensitivity")
    return out

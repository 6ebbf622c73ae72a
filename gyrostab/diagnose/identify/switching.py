"""Biases of two levels among the names: what follows a channel comes first, and the course is sought anew with all else in the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gyrostab.diagnose.evidence.telegraph import telegraph_evidence
from gyrostab.diagnose.identify.components import axes_of, evidence_of
from gyrostab.diagnose.identify.identification import Identification, Identifications, Unidentified
from gyrostab.diagnose.identify.jumps import jumps_at_will
from gyrostab.diagnose.predict.condition import Component, mean_columns
from gyrostab.diagnose.predict.designs import Candidate
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import Found

__all__ = ["followed_first", "hops_alone", "identify_switching", "remove_telegraph_bias", "renewed"]

_VIEW = "levels"
# of the variance of a course of hops, from which on a channel that explains it may be their cause
_LED = 0.5


def followed_first(
    passing: list[str], parts: Mapping[str, Sequence[Component]], state: State
) -> list[str]:
    """Keys without those of two levels, as long as a mean that follows a channel passes too and may be why they hop.

    A channel that switches makes two levels as well, and what its mean leaves, since its form is
    not exact, hops where it hops. So the channel comes first where it brings more on the same axis,
    or where half of the course of the hops is its own.
    """
    led = [
        part
        for key in passing
        for part in parts[key]
        if part.candidate.view == "mean" and any(part.candidate.driver)
    ]
    return [key for key in passing if not any(_may_be_led(part, led, state) for part in parts[key])]


def _may_be_led(part: Component, led: Sequence[Component], state: State) -> bool:
    beside = [one for one in led if part.candidate.view == _VIEW and one.row == part.row]
    return any(one.gain >= part.gain or _share_of(part, one, state) > _LED for one in beside)


def _share_of(part: Component, other: Component, state: State) -> float:
    """Share of the variance of the first column of a part that the columns of another one on the same axis explain."""
    row = state.axes.index(part.row[0])
    course, beside = (
        mean_columns(part.variant, row)[0],
        np.stack(mean_columns(other.variant, row), axis=1),
    )
    good = (
        np.isfinite(state.reduced["mean"].values[row])
        & np.isfinite(beside).all(axis=1)
        & np.isfinite(course)
    )
    course, beside = course[good] - course[good].mean(), beside[good] - beside[good].mean(axis=0)
    size, *_ = np.linalg.lstsq(beside, course, rcond=None)
    return float(
        1.0 - np.square(course - beside @ size).sum() / max(float(np.square(course).sum()), 1e-300)
    )


def identify_switching(
    passing: list[str], parts: Mapping[str, Sequence[Component]], state: State
) -> list[str]:
    """Keys of biases that hop within blocks, unless a mean that follows a channel may be why; once on an axis.

    What hops beside hops that are named is no reason for powers and tails that these have not taken
    yet, and may be a jump.
    """
    return [
        key
        for key in followed_first(passing, parts, state)
        if any(
            part.variant.inside.size and not state.given.get(("inner", part.row[0]))
            for part in parts[key]
        )
    ]


def hops_alone(
    chosen: Sequence[Identification | Unidentified],
    state_with: Callable[[Sequence[Identification | Unidentified]], State],
    gains: Callable[[Sequence[Candidate], State], list[Found]],
    threshold: float,
) -> list[Identification | Unidentified]:
    """What is chosen, without jumps on the axis of hops that the hops explain as well when they are sought without them.

    The first and the last of few hops are jumps too, of the same step, and the hops that are found
    beside these lack them.

    Parameters
    ----------
    chosen : sequence of Claim or Unknown
        With the gains with which they were chosen.
    state_with : callable
        The state with some of them in the model.
    gains : callable
        Gains of candidates in a state.
    threshold : float
        What jumps must bring beside the hops [nats].
    """
    out = list(chosen)
    for part in [part for one in chosen for part in one.parts if part.candidate.view == _VIEW]:
        jumps = _jumps_beside(part, out, state_with([]))
        for some in [jumps, *([one] for one in jumps if len(jumps) > 1)]:
            if not some or not _holds(out, some):
                continue
            beside, alone = (
                state_with(_without(out, left_out)) for left_out in ([part], [part, *some])
            )
            own = _of_blocks(part, beside)
            if (
                np.isfinite(own)
                and own + sum(jump.gain for jump in some) < _of_blocks(part, alone) + threshold
            ):
                instead = _sought(part, gains([part.candidate], alone))
                out = [_with_part(one, part, instead) for one in _without(out, some)]
                part = instead
    return out


def _of_blocks(part: Component, state: State) -> float:
    """What two levels gain in the means of blocks [nats], which can be compared: those of pieces know more, and are not always there."""
    given = state.given.get(("mean", part.row[0]))
    gain, _ = telegraph_evidence(
        state.reduced,
        state.baseline,
        axis=part.row[0],
        given=np.stack(given, axis=-1) if given else None,
    )
    return float(gain[0])


def _holds(chosen: Sequence[Identification | Unidentified], parts: Sequence[Component]) -> bool:
    return all(any(part is own for one in chosen for own in one.parts) for part in parts)


def _with_part(
    claim: Identification | Unidentified, part: Component, instead: Component
) -> Identification | Unidentified:
    return replace(claim, parts=tuple(instead if own is part else own for own in claim.parts))


def _jumps_beside(
    part: Component, chosen: Sequence[Identification | Unidentified], state: State
) -> list[Component]:
    return [
        one
        for claim in chosen
        for one in claim.parts
        if one.row == part.row and jumps_at_will(one, state)
    ]


def _without(
    chosen: Sequence[Identification | Unidentified], left_out: Sequence[Component]
) -> list[Identification | Unidentified]:
    """What is chosen without some of its parts; claims of which nothing is left are none."""
    out = []
    for one in chosen:
        kept = tuple(part for part in one.parts if not any(part is other for other in left_out))
        if len(kept) < len(one.parts):
            gain = one.gain - sum(part.gain for part in one.parts) + sum(part.gain for part in kept)
            one = replace(one, parts=kept, axes=axes_of(kept, list(one.axes)), gain=gain)
            if not kept:
                continue
        out.append(one)
    return out


def _sought(part: Component, found: Sequence[Found]) -> Component:
    """The part as it was found anew."""
    (one,) = found
    row = one.rows.index(part.row)
    return replace(part, variant=one.best[row], gain=float(one.gain[0, row]))


def renewed(parts: Sequence[Component], part: Component) -> Component:
    """A part with its gain among `parts`, which were found with all others in the model; and with the course that was found then."""
    fresh = replace(part, gain=evidence_of(parts, part))
    if part.candidate.view != _VIEW:
        return fresh
    return next(
        (
            replace(fresh, variant=one.variant)
            for one in parts
            if (one.candidate.view, one.row) == (_VIEW, part.row)
        ),
        fresh,
    )


def remove_telegraph_bias(naming: Identifications) -> tuple[Identifications, float]:
    """The naming without biases of two levels, whose course no other time tells; and what these gain [nats]."""
    those = [
        claim
        for claim in naming.claims
        if any(part.candidate.view == _VIEW for part in claim.parts)
    ]
    kept = tuple(claim for claim in naming.claims if claim not in those)
    return replace(naming, claims=kept), sum(claim.gain for claim in those)

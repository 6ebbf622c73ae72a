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
from gyrostab.diagnose.predict.search import CandidateEvidence

__all__ = ["followed_first", "hops_alone", "identify_switching", "remove_telegraph_bias", "renewed"]

_VIEW = "levels"
# of the variance of a course of hops, from which on a channel that explains it may be their cause
_LED = 0.5


def followed_first(
    passing: list[str], components: Mapping[str, Sequence[Component]], state: State
) -> list[str]:
    """Keys without those of two levels, as long as a mean that follows a channel passes too and may be why they hop.

    A channel that switches makes two levels as well, and what its mean leaves, since its form is
    not exact, hops where it hops. So the channel comes first where it brings more on the same axis,
    or where half of the course of the hops is its own.
    """
    led = [
        component
        for key in passing
        for component in components[key]
        if component.candidate.statistic == "mean" and any(component.candidate.driver)
    ]
    return [
        key
        for key in passing
        if not any(_may_be_led(component, led, state) for component in components[key])
    ]


def _may_be_led(component: Component, led: Sequence[Component], state: State) -> bool:
    beside = [
        one for one in led if component.candidate.statistic == _VIEW and one.row == component.row
    ]
    return any(
        one.evidence_nats >= component.evidence_nats or _share_of(component, one, state) > _LED
        for one in beside
    )


def _share_of(component: Component, other: Component, state: State) -> float:
    """Share of the variance of the first column of a part that the columns of another one on the same axis explain."""
    row = state.axes.index(component.row[0])
    course, beside = (
        mean_columns(component.variant, row)[0],
        np.stack(mean_columns(other.variant, row), axis=1),
    )
    good = (
        np.isfinite(state.blocks["mean"].values[row])
        & np.isfinite(beside).all(axis=1)
        & np.isfinite(course)
    )
    course, beside = course[good] - course[good].mean(), beside[good] - beside[good].mean(axis=0)
    size, *_ = np.linalg.lstsq(beside, course, rcond=None)
    return float(
        1.0 - np.square(course - beside @ size).sum() / max(float(np.square(course).sum()), 1e-300)
    )


def identify_switching(
    passing: list[str], components: Mapping[str, Sequence[Component]], state: State
) -> list[str]:
    """Keys of biases that hop within blocks, unless a mean that follows a channel may be why; once on an axis.

    What hops beside hops that are named is no reason for powers and tails that these have not taken
    yet, and may be a jump.
    """
    return [
        key
        for key in followed_first(passing, components, state)
        if any(
            component.variant.inside.size and not state.given.get(("inner", component.row[0]))
            for component in components[key]
        )
    ]


def hops_alone(
    chosen: Sequence[Identification | Unidentified],
    state_with: Callable[[Sequence[Identification | Unidentified]], State],
    gains: Callable[[Sequence[Candidate], State], list[CandidateEvidence]],
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
    for component in [
        component
        for one in chosen
        for component in one.components
        if component.candidate.statistic == _VIEW
    ]:
        jumps = _jumps_beside(component, out, state_with([]))
        for some in [jumps, *([one] for one in jumps if len(jumps) > 1)]:
            if not some or not _holds(out, some):
                continue
            beside, alone = (
                state_with(_without(out, left_out))
                for left_out in ([component], [component, *some])
            )
            own = _of_blocks(component, beside)
            if (
                np.isfinite(own)
                and own + sum(jump.evidence_nats for jump in some)
                < _of_blocks(component, alone) + threshold
            ):
                instead = _sought(component, gains([component.candidate], alone))
                out = [_with_part(one, component, instead) for one in _without(out, some)]
                component = instead
    return out


def _of_blocks(component: Component, state: State) -> float:
    """What two levels gain in the means of blocks [nats], which can be compared: those of pieces know more, and are not always there."""
    given = state.given.get(("mean", component.row[0]))
    evidence_nats, _ = telegraph_evidence(
        state.blocks,
        state.baseline,
        axis=component.row[0],
        given=np.stack(given, axis=-1) if given else None,
    )
    return float(evidence_nats[0])


def _holds(
    chosen: Sequence[Identification | Unidentified], components: Sequence[Component]
) -> bool:
    return all(
        any(component is own for one in chosen for own in one.components)
        for component in components
    )


def _with_part(
    identification: Identification | Unidentified, component: Component, instead: Component
) -> Identification | Unidentified:
    return replace(
        identification,
        components=tuple(instead if own is component else own for own in identification.components),
    )


def _jumps_beside(
    component: Component, chosen: Sequence[Identification | Unidentified], state: State
) -> list[Component]:
    return [
        one
        for identification in chosen
        for one in identification.components
        if one.row == component.row and jumps_at_will(one, state)
    ]


def _without(
    chosen: Sequence[Identification | Unidentified], left_out: Sequence[Component]
) -> list[Identification | Unidentified]:
    """What is chosen without some of its parts; claims of which nothing is left are none."""
    out = []
    for one in chosen:
        kept = tuple(
            component
            for component in one.components
            if not any(component is other for other in left_out)
        )
        if len(kept) < len(one.components):
            evidence_nats = (
                one.evidence_nats
                - sum(component.evidence_nats for component in one.components)
                + sum(component.evidence_nats for component in kept)
            )
            one = replace(
                one,
                components=kept,
                axes=axes_of(kept, list(one.axes)),
                evidence_nats=evidence_nats,
            )
            if not kept:
                continue
        out.append(one)
    return out


def _sought(component: Component, found: Sequence[CandidateEvidence]) -> Component:
    """The part as it was found anew."""
    (one,) = found
    row = one.rows.index(component.row)
    return replace(component, variant=one.best[row], evidence_nats=float(one.evidence_nats[0, row]))


def renewed(components: Sequence[Component], component: Component) -> Component:
    """A part with its gain among `components`, which were found with all others in the model; and with the course that was found then."""
    fresh = replace(component, evidence_nats=evidence_of(components, component))
    if component.candidate.statistic != _VIEW:
        return fresh
    return next(
        (
            replace(fresh, variant=one.variant)
            for one in components
            if (one.candidate.statistic, one.row) == (_VIEW, component.row)
        ),
        fresh,
    )


def remove_telegraph_bias(identifications: Identifications) -> tuple[Identifications, float]:
    """The naming without biases of two levels, whose course no other time tells; and what these gain [nats]."""
    those = [
        identification
        for identification in identifications.identified
        if any(component.candidate.statistic == _VIEW for component in identification.components)
    ]
    kept = tuple(
        identification
        for identification in identifications.identified
        if identification not in those
    )
    return replace(identifications, identified=kept), sum(
        identification.evidence_nats for identification in those
    )

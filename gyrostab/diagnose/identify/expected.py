"""Effects that the simulation has as well, and whose size or course only the recording tells: odd samples, lines of the turning, levels."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gyrostab.diagnose.identify.components import LEAST, axes_of, by_key, sum_evidence
from gyrostab.diagnose.identify.identification import Identification
from gyrostab.diagnose.predict.candidates import Candidate
from gyrostab.diagnose.predict.condition import Component, condition_on
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import CandidateEvidence
from gyrostab.physics.base import Effect

__all__ = ["identify_expected_effects"]

_ROUNDS = 6
_ONCE = {"telegraph": "bias_jump"}  # a hop that does not come back


def identify_expected_effects(
    known: Sequence[Effect],
    candidates: Sequence[Candidate],
    start: State,
    gains: Callable[[Sequence[Candidate], State], list[CandidateEvidence]],
) -> tuple[list[Identification], State]:
    """Claims of effects that are expected, and the state with them in it; whatever else is named has to stand beside them.

    Their sizes are free, for the model says how often something happens and the recording when. The
    strongest comes first, but odd samples before all: they raise powers and means too. An effect
    that holds several parts of a kind, as two jumps or two lines do, is taken as often as it brings
    something.

    Parameters
    ----------
    known : sequence of Effect
        Effects of the model that its baseline leaves out.
    candidates : sequence of Candidate
        All that are tried on this recording.
    start : State
        With nothing named.
    gains : callable
        Gains of candidates in a state.
    """
    identified: list[Identification] = []
    state, left = start, list(known)
    rounds = _ROUNDS * len(left)
    while left and rounds > 0:
        rounds -= 1
        found = [(_parts(effect, candidates, state, gains), effect) for effect in left]
        left = [effect for components, effect in found if sum_evidence(components) > LEAST]
        components, effect = max(found, key=lambda one: (_odd(one[0]), sum_evidence(one[0])))
        if sum_evidence(components) <= LEAST:
            break
        identified.append(_claim(components, state))
        state = condition_on(state, components)
        if _odd(components):  # their counts cannot be taken out
            left = [one for one in left if one is not effect]
    return identified, state


def _odd(components: Sequence[Component]) -> bool:
    return (
        bool(components)
        and components[0].candidate.statistic == "marks"
        and sum_evidence(components) > LEAST
    )


def _follows(candidate: Candidate, effect: Effect) -> bool:
    """Whether a candidate is this effect of a model, with the channels that it has there; or what it is where it happens once."""
    named = {*filter(None, candidate.driver)}
    return candidate.effect in (effect.name, _ONCE.get(effect.name)) and named <= {
        *effect.channel_names().values()
    }


def _parts(
    effect: Effect,
    candidates: Sequence[Candidate],
    state: State,
    gains: Callable[[Sequence[Candidate], State], list[CandidateEvidence]],
) -> list[Component]:
    """What an effect brings on its axes, in the views and with the channels in which it brings most."""
    by = by_key(gains([one for one in candidates if _follows(one, effect)], state))
    own = [
        [
            component
            for component in components
            if not effect.axes or set(component.row) <= set(effect.axes)
        ]
        for components in by.values()
    ]
    return max(own, key=sum_evidence, default=[])


def _claim(components: Sequence[Component], state: State) -> Identification:
    first = components[0].candidate
    return Identification(
        first.effect,
        first.driver,
        axes_of(components, state.axes),
        tuple(components),
        sum_evidence(components),
        LEAST,
    )

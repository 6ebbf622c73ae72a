"""Identify effects of the simulation whose size or time only the recording shows.

These are anomalous samples, lines locked to the rotation, and telegraph biases.
"""

from __future__ import annotations

from dataclasses import replace

from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identification import Selection, make_selection
from gyrostab.diagnose.predict.candidates import Candidate, Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.physics.base import Effect

MAX_ROUNDS_PER_EFFECT = 6  # components of one kind that an effect may add, one in each round


def identify_expected_effects(examination: Examination) -> Examination:
    """Identify effects that are expected, and put them into the model before any others.

    Their sizes are free: the model says how often something happens, and the recording when. The
    strongest comes first, but anomalous samples before all others, because they raise powers and
    means too. An effect with several components of a kind, such as two jumps, is taken as long as
    it adds evidence.
    """
    identified: list[Selection] = []
    state, remaining = examination.start, list(examination.known)
    needed = examination.settings.component_nats
    rounds = MAX_ROUNDS_PER_EFFECT * len(remaining)
    while remaining and rounds > 0:
        rounds -= 1
        choices = [(_best_components(effect, examination, state), effect) for effect in remaining]
        choices = [choice for choice in choices if sum_evidence(choice[0]) > needed]
        if not choices:
            break
        components, effect = max(
            choices, key=lambda choice: (choice[0][0].statistic.is_count, sum_evidence(choice[0]))
        )
        identified.append(make_selection(components, needed, order=state.axes))
        state = condition_on(state, components)
        # counts of anomalous samples cannot be taken out
        ended = effect if components[0].statistic.is_count else None
        remaining = [other for _, other in choices if other is not ended]
    return replace(examination, expected=tuple(identified), start=state)


def _is_candidate_of(candidate: Candidate, effect: Effect) -> bool:
    """Return whether a candidate is this effect with its channels, or its single event."""
    named = {*filter(None, candidate.driver)}
    names = (effect.name, *effect.look_alikes("single event"))
    return candidate.effect in names and named <= {*effect.channel_names().values()}


def _best_components(effect: Effect, examination: Examination, state: State) -> list[Component]:
    """Return the components of an effect with the most evidence on its axes."""
    candidates = [
        candidate for candidate in examination.candidates if _is_candidate_of(candidate, effect)
    ]
    components_on_axes = [
        [
            component
            for component in components
            if not effect.axes or set(component.row) <= set(effect.axes)
        ]
        for components in examination.find_components(candidates, state).values()
    ]
    return max(components_on_axes, key=sum_evidence, default=[])

"""Evaluate identifications with several components in the same row, such as two jumps of one bias.

Each component is evaluated with those before it in the model.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

from gyrostab.diagnose.identify.components import candidates_of, group_components
from gyrostab.diagnose.predict.candidates import Candidate, CandidateEvidence, Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State

__all__ = ["find_layers_again", "split_layers"]


def split_layers(components: Sequence[Component]) -> list[list[Component]]:
    """Split components by how often their statistic, row and reference channel occurred before."""
    out: list[list[Component]] = []
    seen: Counter[tuple[object, ...]] = Counter()
    for component in components:
        place = component.statistic, component.row, component.candidate.reference
        if seen[place] == len(out):
            out.append([])
        out[seen[place]].append(component)
        seen[place] += 1
    return out


def find_layers_again(
    components: Sequence[Component],
    first: Sequence[Component],
    state: State,
    gains: Callable[[Sequence[Candidate], State], list[CandidateEvidence]],
) -> list[list[Component]]:
    """Find the components of each layer again, with the layers before it in the model.

    The evidence of several variants together is not that of one of them: the first of two opposite
    jumps explains little alone.

    Parameters
    ----------
    components : sequence of Component
        Components of the identification.
    first : sequence of Component
        Those found with none of the identification in the model.
    state : State
        With all other identifications in the model.
    gains : callable
        Computes the evidence of candidates in a state.
    """
    out = [list(first)]
    weight, key = state.weight, components[0].candidate.key
    axes = {axis for component in components for axis in component.row}
    for before, layer in pairwise(split_layers(components)):
        state = replace(condition_on(state, before), weight=weight)
        again = group_components(gains(candidates_of(layer), state), settings=state.settings).get(
            key, []
        )
        out.append([component for component in again if set(component.row) & axes])
    return out

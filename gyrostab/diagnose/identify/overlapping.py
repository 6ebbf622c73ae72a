"""Claims that hold the same row of a view more than once, as two jumps of one bias: each part is judged beside those before it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

from gyrostab.diagnose.identify.components import by_key, tried_again
from gyrostab.diagnose.predict.candidates import Candidate
from gyrostab.diagnose.predict.condition import Component, condition_on
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import CandidateEvidence

__all__ = ["found_again", "layers"]


def layers(components: Sequence[Component]) -> list[list[Component]]:
    """Parts by how often their view, row and witness have come before."""
    out: list[list[Component]] = []
    seen: Counter[tuple[object, ...]] = Counter()
    for component in components:
        place = component.candidate.statistic, component.row, component.candidate.witness
        if seen[place] == len(out):
            out.append([])
        out[seen[place]].append(component)
        seen[place] += 1
    return out


def found_again(
    components: Sequence[Component],
    first: Sequence[Component],
    state: State,
    gains: Callable[[Sequence[Candidate], State], list[CandidateEvidence]],
) -> list[list[Component]]:
    """For each layer of a claim what is found of it anew with the layers before it in the model.

    What several variants explain together is no gain of one of them: the first of two opposite
    jumps explains little alone.

    Parameters
    ----------
    components : sequence of Part
        Of the claim.
    first : sequence of Part
        What was found of it with nothing of the claim in the model.
    state : State
        With all other claims in the model.
    gains : callable
        Gains of candidates in a state.
    """
    out = [list(first)]
    weight, key = state.weight, components[0].candidate.key
    axes = {axis for component in components for axis in component.row}
    for before, layer in pairwise(layers(components)):
        state = replace(condition_on(state, before), weight=weight)
        again = by_key(gains(tried_again(layer), state)).get(key, [])
        out.append([component for component in again if set(component.row) & axes])
    return out

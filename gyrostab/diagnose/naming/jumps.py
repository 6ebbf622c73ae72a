"""Jumps of a bias at instants that nothing else tells of: whether the means step there, or go over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gyrostab.diagnose.effects.cells import State
from gyrostab.diagnose.effects.explained import Part
from gyrostab.diagnose.effects.sizes import part_mixture

__all__ = ["jumps_at_will", "sudden"]

_JUMP, _INSTANT = "bias_jump", "at"
_BLOCKS = (4, 8)  # lengths of a transition that is no jump
_BETTER, _FORM = 3.0, 0.01  # nats by which it must do better, and of what the jump gains


def jumps_at_will(part: Part, state: State) -> bool:
    """Whether a part is a jump at an instant of its own choice, and not one at which power came back."""
    if part.candidate.effect != _JUMP or part.candidate.view != "mean" or _INSTANT not in part.variant.values:
        return False
    ends = state.reduced["restart_end"].values if "restart_end" in state.reduced else np.empty(0)
    return not np.isclose(ends, float(part.variant.values[_INSTANT])).any()


def sudden(parts: Sequence[Part], state: State, *, error: float = 0.0) -> bool:
    """Whether jumps step, rather than go over from one level to the other within some blocks.

    Where a straight way of four or eight blocks about the same instant says more on all axes together, something else came and went.

    Parameters
    ----------
    parts : sequence of Part
        Of an effect.
    state : State
        With all else that is named.
    error : float
        What errors of the form of that may leave [nats].
    """
    jumps = [part for part in parts if jumps_at_will(part, state)]
    if not jumps:
        return True
    step = sum(_evidence(part, state, 0) for part in jumps)
    over = max(sum(_evidence(part, state, length) for part in jumps) for length in _BLOCKS)
    return over - step <= _BETTER + error + _FORM * sum(max(part.gain, 0.0) for part in jumps)


def _evidence(part: Part, state: State, length: int) -> float:
    """Logarithm of the evidence of a level that goes over within so many blocks, whatever its size; 0 for the jump itself."""
    variant = part.variant
    if length:
        block = float(state.reduced.attrs["block_s"])
        middle = (np.arange(state.reduced.sizes["block"]) + 0.5) * block - float(variant.values[_INSTANT])
        way = np.clip(middle / (length * block) + 0.5, 0.0, 1.0)
        variant = replace(variant, design=np.broadcast_to(way, variant.design.shape))
    return float(np.logaddexp.reduce(part_mixture(part, state, variant).log_weight))

"""Jumps of a bias at instants that nothing else tells of: whether the means step there, or go over, and stay where they went."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import Mixture, component_mixture, mean_mixture

__all__ = ["is_lasting", "is_sudden", "jumps_at_will", "levels"]

Array = NDArray[np.float64]
_JUMP, _INSTANT = "bias_jump", "at"
_BLOCKS = (4, 8)  # lengths of a transition that is no jump
_BETTER, _FORM = 3.0, 0.01  # nats by which it must do better, and of what the jump gains
_LENGTHS, _SHORT = (
    48,
    0.1,
)  # lengths of an event that are tried; of the record, that it lasts at most, but for eight blocks
_LEAST_BESIDE = 3  # blocks before and behind an event, that tell the level there
_LOUDER = (10.0, 100.0, 1e3, 1e4, 1e5)  # times the usual variance of the means
_SURE = 3.0  # standard errors of the level after an event, from which on it is another than before


def jumps_at_will(component: Component, state: State) -> bool:
    """Whether a part is a jump at an instant of its own choice, and not one at which power came back."""
    if (
        component.candidate.effect != _JUMP
        or component.candidate.statistic != "mean"
        or _INSTANT not in component.variant.values
    ):
        return False
    ends = state.blocks["restart_end"].values if "restart_end" in state.blocks else np.empty(0)
    return not np.isclose(ends, float(component.variant.values[_INSTANT])).any()


def is_sudden(components: Sequence[Component], state: State, *, error: float = 0.0) -> bool:
    """Whether jumps step, rather than go over from one level to the other within some blocks.

    Where a straight way of four or eight blocks about the same instant says more on all axes
    together, something else came and went.

    Parameters
    ----------
    components : sequence of Part
        Of an effect.
    state : State
        With all else that is named.
    error : float
        What errors of the form of that may leave [nats].
    """
    jumps = [component for component in components if jumps_at_will(component, state)]
    if not jumps:
        return True
    step = sum(_evidence(component, state, 0) for component in jumps)
    over = max(
        sum(_evidence(component, state, length) for component in jumps) for length in _BLOCKS
    )
    return over - step <= _BETTER + error + _FORM * sum(
        max(component.evidence_nats, 0.0) for component in jumps
    )


def is_lasting(components: Sequence[Component], state: State) -> bool:
    """Whether the means stay on another level after jumps, rather than come back.

    What lasts for two blocks to a tenth of the record before or after the instant, and says more
    than a level that stays, on all axes together, is an event that ends. It is none where the level
    behind it is another than the one before: then there are two jumps.

    Parameters
    ----------
    components : sequence of Part
        Of an effect.
    state : State
        With all else that is named.
    """
    jumps = [component for component in components if jumps_at_will(component, state)]
    if not jumps:
        return True
    step = sum(_evidence(component, state, 0) for component in jumps)
    spans = _spans(jumps[0], state)
    if not spans:
        return True
    events = [
        sum(
            float(np.logaddexp.reduce(_events(component, state, span)[0].log_weight))
            for component in jumps
        )
        for span in spans
    ]
    best = int(np.argmax(events))
    if events[best] - step <= _BETTER + np.log(len(spans)) + _FORM * sum(
        max(component.evidence_nats, 0.0) for component in jumps
    ):
        return True
    return any(_other_level(component, state, spans[best]) for component in jumps)


def levels(components: Sequence[Component], state: State) -> bool:
    """Whether jumps lead to levels, and are not the wildest of means that scatter more for a while.

    Waves slower than a block make means scatter, and of such means any two that follow each other
    are a jump. So the jumps must say something, but for 3 nats of chance, where the white noise of
    the means may be louder for some stretch about the instant, with and without them.

    Parameters
    ----------
    components : sequence of Part
        Of an effect.
    state : State
        With all else that is named.
    """
    jumps = [component for component in components if jumps_at_will(component, state)]
    return not jumps or sum(_beside_scatter(component, state) for component in jumps) > -_BETTER


def _beside_scatter(component: Component, state: State) -> float:
    """Logarithm of the Bayes factor of a jump of about the size that it has, where the means may scatter more for a while [nats]."""
    variances = _scatter(component, state)
    jump = [component_mixture(component, state, variance=one) for one in variances]
    none = [mean_mixture(state, component.row[0], [], variance=one) for one in variances]
    with_it, without = (
        np.array([np.logaddexp.reduce(one.log_weight) for one in several])
        for several in (jump, none)
    )
    likely = jump[int(with_it.argmax())]
    size, covariance = likely.moments()
    wide = max(abs(float(size[0])), float(np.sqrt(covariance[0, 0]))) * float(
        np.ptp(component.variant.design)
    )
    instants = np.log(len(component.candidate.variants))
    return float(
        np.logaddexp.reduce(with_it) - np.logaddexp.reduce(without) - np.log(wide) - 0.5 - instants
    )


def _scatter(component: Component, state: State) -> list[Array]:
    """White variances of the means: the usual one, and louder ones for stretches before, after and about the instant of a jump."""
    axis, block_count = component.row[0], state.blocks.sizes["block"]
    block = np.arange(block_count)
    at = round(float(component.variant.values[_INSTANT]) / float(state.blocks.attrs["block_s"]))
    lengths = [2**power for power in range(1, max(block_count, 2).bit_length())]
    spans = {
        (max(at - one, 0), min(at + two, block_count))
        for length in lengths
        for one, two in ((length, length), (0, length), (length, 0))
    }
    usual = state.baseline["mean_variance"].sel(axis=axis).values
    inside = [(block >= first) & (block < stop) for first, stop in sorted(spans)]
    return [
        usual,
        *(np.where(here, factor * usual, usual) for here in inside for factor in _LOUDER),
    ]


def _spans(component: Component, state: State) -> list[tuple[int, int]]:
    """First block and the one behind the last of events that begin or end at the instant of a jump, and at no end of the record."""
    block, block_count = float(state.blocks.attrs["block_s"]), state.blocks.sizes["block"]
    at = round(float(component.variant.values[_INSTANT]) / block)
    lengths = np.unique(
        np.geomspace(2.0, max(_SHORT * block_count, 8.0), _LENGTHS).astype(int)
    ).tolist()
    both = [span for length in lengths for span in ((at, at + length), (at - length, at))]
    return [
        (first, stop)
        for first, stop in both
        if first >= _LEAST_BESIDE and stop <= block_count - _LEAST_BESIDE
    ]


def _events(component: Component, state: State, span: tuple[int, int]) -> tuple[Mixture, Mixture]:
    """Sizes of an event of so many blocks; and those of it and of the level behind it."""
    block = np.arange(state.blocks.sizes["block"])
    shape = component.variant.design.shape
    during = np.broadcast_to(((block >= span[0]) & (block < span[1])).astype(np.float64), shape)
    behind = np.broadcast_to((block >= span[1]).astype(np.float64), shape)
    alone, both = (
        replace(component.variant, design=one) for one in (during, np.concatenate([during, behind]))
    )
    return component_mixture(component, state, alone), component_mixture(component, state, both)


def _other_level(component: Component, state: State, span: tuple[int, int]) -> bool:
    """Whether the level behind an event is surely another than the one before it."""
    size, covariance = _events(component, state, span)[1].moments()
    return bool(abs(size[-1]) > _SURE * np.sqrt(covariance[-1, -1]))


def _evidence(component: Component, state: State, length: int) -> float:
    """Logarithm of the evidence of a level that goes over within so many blocks, whatever its size; 0 for the jump itself."""
    variant = component.variant
    if length:
        block = float(state.blocks.attrs["block_s"])
        middle = (np.arange(state.blocks.sizes["block"]) + 0.5) * block - float(
            variant.values[_INSTANT]
        )
        way = np.clip(middle / (length * block) + 0.5, 0.0, 1.0)
        variant = replace(variant, design=np.broadcast_to(way, variant.design.shape))
    return float(np.logaddexp.reduce(component_mixture(component, state, variant).log_weight))

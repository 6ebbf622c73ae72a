"""Check jumps at free instants: whether the means step there, and stay at the new level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.mixture import Mixture
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture, mean_mixture
from gyrostab.diagnose.predict.windows import TIME_PARAMETER
from gyrostab.diagnose.reduce.schema import axis_values

Array = NDArray[np.float64]
_JUMP = "bias_jump"
_TRANSITION_BLOCKS = (4, 8)  # lengths of the gradual changes that a jump is compared with
EVENT_LENGTHS = 48  # that are tried, from two blocks up
MIN_EVENT_LIMIT_BLOCKS = 8.0
MIN_LEVEL_BLOCKS = 3  # before and after an event, that determine the level there
_VARIANCE_FACTORS = (10.0, 100.0, 1e3, 1e4, 1e5)  # over the usual variance of the means


def is_step(component: Component) -> bool:
    """Return whether a component is a step of the mean at a given time."""
    return component.statistic.is_linear_in_means and TIME_PARAMETER in component.variant.values


def is_free_jump(component: Component, state: State) -> bool:
    """Return whether a component is a jump at a free instant, not at a restart."""
    if component.candidate.effect != _JUMP or not is_step(component):
        return False
    ends = state.blocks["restart_end"].values if "restart_end" in state.blocks else np.empty(0)
    return not np.isclose(ends, float(component.variant.values[TIME_PARAMETER])).any()


def gradual_nats(components: Sequence[Component], state: State, *, error: float = 0.0) -> float:
    """Return by how much a gradual change explains more than jumps [nats], 0 unless clearly.

    A straight transition over four or eight blocks about the same instant competes on all axes
    together.

    Parameters
    ----------
    state : State
        With all other effects in the model.
    error : float
        What errors of the form of these may leave [nats].
    """
    jumps = [component for component in components if is_free_jump(component, state)]
    if not jumps:
        return 0.0
    step = sum(_transition_evidence(component, state, 0) for component in jumps)
    gradual = max(
        sum(_transition_evidence(component, state, length) for component in jumps)
        for length in _TRANSITION_BLOCKS
    )
    return gradual - step if gradual - step > error + _allowed_nats(jumps, state) else 0.0


def event_nats(components: Sequence[Component], state: State) -> float:
    """Return by how much an event that ends explains more than jumps [nats], 0 unless clearly.

    It lasts for two blocks to a tenth of the record, before or after the instant, on all axes. It
    is two jumps if the level after it differs from that before.

    Parameters
    ----------
    state : State
        With all other effects in the model.
    """
    jumps = [component for component in components if is_free_jump(component, state)]
    if not jumps:
        return 0.0
    step = sum(_transition_evidence(component, state, 0) for component in jumps)
    spans = _event_spans(jumps[0], state)
    if not spans:
        return 0.0
    events = [
        sum(_fit_event(component, state, span)[0].evidence for component in jumps) for span in spans
    ]
    best = int(np.argmax(events))
    if events[best] - step <= np.log(len(spans)) + _allowed_nats(jumps, state):
        return 0.0
    is_other_level = any(_is_other_level(component, state, spans[best]) for component in jumps)
    return 0.0 if is_other_level else events[best] - step


def scatter_nats(components: Sequence[Component], state: State) -> float:
    """Return by how much noisy means explain more than jumps to levels [nats], 0 unless clearly.

    Waves slower than a block make the means scatter, and any two such neighbours look like a jump.
    Therefore jumps must keep their evidence, but for 3 nats of chance, when the white noise of the
    means may be larger for some time about the instant, with and without the jumps.

    Parameters
    ----------
    state : State
        With all other effects in the model.
    """
    jumps = [component for component in components if is_free_jump(component, state)]
    if not jumps:
        return 0.0
    evidence = sum(_evidence_in_scatter(component, state) for component in jumps)
    # the search of the instant counts once: on other axes it is the same
    search = np.log(len(jumps[0].candidate.variants)) + (len(jumps) - 1) * np.log(2.0)
    scatter = float(search - evidence)
    return scatter if scatter >= state.settings.ambiguous_nats else 0.0


def _allowed_nats(jumps: Sequence[Component], state: State) -> float:
    """Return what chance and errors of the form may leave to another form than jumps [nats]."""
    evidence = sum(max(component.evidence_nats, 0.0) for component in jumps)
    return state.settings.ambiguous_nats + state.settings.form_error_share * evidence


def _evidence_in_scatter(component: Component, state: State) -> float:
    """Return the log Bayes factor of a jump in means that may be noisy for a while [nats]."""
    variances = _possible_variances(component, state)
    jump = [component_mixture(component, state, variance=variance) for variance in variances]
    none = [mean_mixture(state, component.row[0], [], variance=variance) for variance in variances]
    with_jump, without = (
        np.array([mixture.evidence for mixture in mixtures]) for mixtures in (jump, none)
    )
    likely = jump[int(with_jump.argmax())]
    size, covariance = likely.moments()
    wide = max(abs(float(size[0])), float(np.sqrt(covariance[0, 0]))) * float(
        np.ptp(component.variant.design)
    )
    return float(np.logaddexp.reduce(with_jump) - np.logaddexp.reduce(without) - np.log(wide) - 0.5)


def _possible_variances(component: Component, state: State) -> list[Array]:
    """Return white variances of the means: the usual, and larger ones for a time near the jump."""
    axis, block_count = component.row[0], state.blocks.sizes["block"]
    block = np.arange(block_count)
    at = round(
        float(component.variant.values[TIME_PARAMETER]) / float(state.blocks.attrs["block_s"])
    )
    lengths = [2**power for power in range(1, max(block_count, 2).bit_length())]
    spans = {
        (max(at - blocks_before, 0), min(at + blocks_after, block_count))
        for length in lengths
        for blocks_before, blocks_after in ((length, length), (0, length), (length, 0))
    }
    usual = axis_values(state.baseline, "mean_variance", axis)
    inside = [(block >= first) & (block < stop) for first, stop in sorted(spans)]
    return [
        usual,
        *(
            np.where(is_inside, factor * usual, usual)
            for is_inside in inside
            for factor in _VARIANCE_FACTORS
        ),
    ]


def _event_spans(component: Component, state: State) -> list[tuple[int, int]]:
    """Return the first and last edges of events that begin or end at a jump."""
    block, block_count = float(state.blocks.attrs["block_s"]), state.blocks.sizes["block"]
    at = round(float(component.variant.values[TIME_PARAMETER]) / block)
    lengths = np.unique(
        np.geomspace(
            2.0,
            max(state.settings.max_event_share * block_count, MIN_EVENT_LIMIT_BLOCKS),
            EVENT_LENGTHS,
        ).astype(int)
    ).tolist()
    spans = [span for length in lengths for span in ((at, at + length), (at - length, at))]
    return [
        (first, stop)
        for first, stop in spans
        if first >= MIN_LEVEL_BLOCKS and stop <= block_count - MIN_LEVEL_BLOCKS
    ]


def _fit_event(
    component: Component, state: State, span: tuple[int, int]
) -> tuple[Mixture, Mixture]:
    """Fit an event over these blocks, alone, and together with the level after it."""
    block = np.arange(state.blocks.sizes["block"])
    shape = component.variant.design.shape
    during = np.broadcast_to(((block >= span[0]) & (block < span[1])).astype(np.float64), shape)
    behind = np.broadcast_to((block >= span[1]).astype(np.float64), shape)
    event, event_with_level = (
        replace(component.variant, design=design)
        for design in (during, np.concatenate([during, behind]))
    )
    return component_mixture(component, state, event), component_mixture(
        component, state, event_with_level
    )


def _is_other_level(component: Component, state: State, span: tuple[int, int]) -> bool:
    """Return whether the level after an event clearly differs from that before it."""
    size, covariance = _fit_event(component, state, span)[1].moments()
    return bool(abs(size[-1]) > state.settings.clear_sigma * np.sqrt(covariance[-1, -1]))


def _transition_evidence(component: Component, state: State, length: int) -> float:
    """Return the log evidence of a change of level over so many blocks; 0 is the jump itself."""
    variant = component.variant
    if length:
        block = float(state.blocks.attrs["block_s"])
        middle = (np.arange(state.blocks.sizes["block"]) + 0.5) * block - float(
            variant.values[TIME_PARAMETER]
        )
        way = np.clip(middle / (length * block) + 0.5, 0.0, 1.0)
        variant = replace(variant, design=np.broadcast_to(way, variant.design.shape))
    return component_mixture(component, state, variant).evidence

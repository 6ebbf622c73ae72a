"""Jumps at free instants, and other courses of the means that compete with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from gyrostab.arrays import Floats, Ints
from gyrostab.diagnose.predict.candidates import Component, Variant
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture, mean_mixture
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.statistics.base import Competitor

_JUMP = "bias_jump"
_TRANSITION_BLOCKS = (4, 8)  # lengths of the gradual changes that a jump is compared with
EVENT_LENGTHS = 48  # that are tried, from two blocks up
MIN_EVENT_LIMIT_BLOCKS = 8.0
MIN_LEVEL_BLOCKS = 3  # before and after an event, that determine the level there
_SHIFTS = 40  # of all restarts: a share of 5 % is two of 41; limits time
_VARIANCE_FACTORS = (10.0, 100.0, 1e3, 1e4, 1e5)  # relative to white and angle noise of a mean


def is_free_jump(component: Component, state: State) -> bool:
    """Return whether a component is a jump at a free instant, not at a restart."""
    if component.candidate.effect != _JUMP or not component.is_step:
        return False
    return not np.isclose(state.blocks["restart_end"].values, component.step_time).any()


def jump_competitors(
    components: Sequence[Component], state: State, error: float
) -> Iterator[Competitor]:
    """Yield other courses of the means than jumps, on all axes together.

    A gradual change is a straight transition over four or eight blocks about the same instant.

    An event that ends lasts for two blocks to a tenth of the record, before or after the instant.
    It is two jumps if the level after it differs from that before.

    Waves slower than a block make the means scatter, and any two such neighbours look like a jump.
    Therefore jumps must keep their evidence when the white noise of the means may be larger for
    some time about the instant, with and without the jumps.
    """
    jumps = [component for component in components if is_free_jump(component, state)]
    if not jumps:
        return
    settings = state.settings
    evidence = sum(max(component.evidence_nats, 0.0) for component in jumps)
    allowed = settings.allow_form_error(evidence)
    step = sum(component_mixture(jump, state).evidence for jump in jumps)
    block = float(state.blocks.attrs["block_s"])
    middle = (np.arange(state.blocks.sizes["block"]) + 0.5) * block
    after = [middle - jump.step_time for jump in jumps]
    gradual = max(
        _sum_evidence(
            jumps, state, [np.clip(time / (length * block) + 0.5, 0.0, 1.0) for time in after]
        )
        for length in _TRANSITION_BLOCKS
    )
    yield Competitor("a gradual change", gradual - step, error + allowed)
    spans = _event_spans(jumps[0], state)
    events = [
        _sum_evidence(jumps, state, [_event_course(state, span)] * len(jumps)) for span in spans
    ]
    if spans:
        best = int(np.argmax(events))
        nats, needed = events[best] - step, np.log(len(spans)) + allowed
        if nats > needed and not any(_is_other_level(jump, state, spans[best]) for jump in jumps):
            yield Competitor("an event that ends", nats, needed)
    # the search of the instant counts once: on other axes it is the same
    search = np.log(len(jumps[0].candidate.variants)) + (len(jumps) - 1) * np.log(2.0)
    scatter = float(search - sum(_evidence_in_scatter(jump, state) for jump in jumps))
    yield Competitor("means that scatter for a while", scatter, settings.ambiguous_nats)


def scatter_competitors(component: Component, state: State) -> Iterator[Competitor]:
    """Yield means that scatter for a while, which compete with a jump on one axis.

    A real change of another axis at another time does not support this jump. That the instant
    was sought counts for all axes together, in `jump_competitors`.
    """
    if is_free_jump(component, state):
        nats = -_evidence_in_scatter(component, state)
        yield Competitor("means that scatter for a while", nats, 0.0)


def restart_competitors(component: Component, state: State) -> Iterator[Competitor]:
    """Yield what competes with jumps at every restart on an axis.

    As many free sizes follow any slow course, such as motion of the tool. The parts of a gradual
    change are straight, about each restart up to the middle between two of them.

    As many jumps at other instants are those at the restarts, all shifted round the record by the
    same time. The restarts must explain more than all but the usual share of them. Shifts by which
    most restarts meet others do not count: restarts at equal intervals repeat themselves.
    """
    if component.candidate.effect != _JUMP or len(component.variant.columns) < 2:
        return
    settings, block_count = state.settings, state.blocks.sizes["block"]
    steps = component.variant.design[:, 0]
    at_restarts = component_mixture(component, state).evidence

    edge = (1.0 - steps).sum(axis=1)
    edges = np.concatenate([[0.0], (edge[1:] + edge[:-1]) / 2.0, [block_count]])
    middle = np.arange(block_count) + 0.5
    courses = np.clip((middle - edges[:-1, None]) / np.diff(edges)[:, None], 0.0, 1.0)
    gradual = component_mixture(component, state, _with_course(component, *courses)).evidence
    allowed = settings.allow_form_error(component.evidence_nats)
    yield Competitor("a gradual change", gradual - at_restarts, allowed)

    changes = np.diff(steps, prepend=0.0)
    elsewhere = [
        component_mixture(
            component,
            state,
            _with_course(component, *np.roll(changes, shift, axis=1).cumsum(axis=1)),
        ).evidence
        for shift in _restart_shifts(changes.argmax(axis=1), state)
    ]
    counted = int(settings.surrogate_share * (1 + len(elsewhere)))
    if counted:
        nats = float(np.sort(elsewhere)[-counted]) - at_restarts
        yield Competitor("jumps at other instants", nats, 0.0)


def _restart_shifts(restarts: Ints, state: State) -> Ints:
    """Return shifts [blocks] of restarts (restart,) round the record that meet few others."""
    block_count = state.blocks.sizes["block"]
    shifts = np.unique(np.linspace(0, block_count, _SHIFTS + 1, endpoint=False).astype(int))[1:]
    shifted = (restarts + shifts[:, None, None]) % block_count
    is_met = (np.abs(shifted - restarts[:, None]) <= 1).any(axis=1)
    return np.asarray(shifts[is_met.mean(axis=1) <= state.settings.majority_share])


def _sum_evidence(jumps: Sequence[Component], state: State, courses: Sequence[Floats]) -> float:
    """Return the log evidence of other courses (block,), one for each jump, of free size."""
    return sum(
        component_mixture(jump, state, _with_course(jump, course)).evidence
        for jump, course in zip(jumps, courses, strict=True)
    )


def _with_course(jump: Component, *courses: Floats) -> Variant:
    """Return the variant of a jump with courses (block,) instead of the step."""
    shape = jump.variant.design[:1].shape
    design = np.concatenate([np.broadcast_to(course, shape) for course in courses])
    return replace(jump.variant, design=design)


def _event_course(state: State, span: tuple[int, int]) -> Floats:
    block = np.arange(state.blocks.sizes["block"])
    return ((block >= span[0]) & (block < span[1])).astype(np.float64)


def _evidence_in_scatter(component: Component, state: State) -> float:
    """Return the log Bayes factor of a jump in means that may be noisy for a while [nats]."""
    axis, variances = component.row[0], _possible_variances(component, state)
    columns = mean_columns(component.variant, state.axes.index(axis))
    jump, none = (
        [mean_mixture(state, axis, with_or_without, variance=variance) for variance in variances]
        for with_or_without in (columns, [])
    )
    with_jump, without = (
        np.array([mixture.evidence for mixture in mixtures]) for mixtures in (jump, none)
    )
    likely = jump[int(with_jump.argmax())]
    size, covariance = likely.moments()
    wide = max(abs(float(size[0])), float(np.sqrt(covariance[0, 0])))
    return float(np.logaddexp.reduce(with_jump) - np.logaddexp.reduce(without) - np.log(wide) - 0.5)


def _possible_variances(component: Component, state: State) -> list[Floats]:
    """Return white variances of the means: the usual, and larger ones for a time near the jump."""
    axis, block_count = component.row[0], state.blocks.sizes["block"]
    block = np.arange(block_count)
    block_s = float(state.blocks.attrs["block_s"])
    at = round(component.step_time / block_s)
    lengths = [2**power for power in range(1, max(block_count, 2).bit_length())]
    spans = {
        (max(at - blocks_before, 0), min(at + blocks_after, block_count))
        for length in lengths
        for blocks_before, blocks_after in ((length, length), (0, length), (length, 0))
    }
    usual = axis_values(state.baseline, "mean_variance", axis)
    of_angle = 2.0 * float(axis_values(state.baseline, "angle_variance", axis)) / block_s**2
    inside = [(block >= first) & (block < stop) for first, stop in sorted(spans)]
    return [
        usual,
        *(
            np.where(is_inside, factor * (usual + of_angle), usual)
            for is_inside in inside
            for factor in _VARIANCE_FACTORS
        ),
    ]


def _event_spans(component: Component, state: State) -> list[tuple[int, int]]:
    """Return the first and last edges of events that begin or end at a jump."""
    block, block_count = float(state.blocks.attrs["block_s"]), state.blocks.sizes["block"]
    at = round(component.step_time / block)
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


def _is_other_level(jump: Component, state: State, span: tuple[int, int]) -> bool:
    """Return whether the level after an event clearly differs from that before it."""
    behind = (np.arange(state.blocks.sizes["block"]) >= span[1]).astype(np.float64)
    with_level = _with_course(jump, _event_course(state, span), behind)
    size, covariance = component_mixture(jump, state, with_level).moments()
    return bool(abs(size[-1]) > state.settings.clear_sigma * np.sqrt(covariance[-1, -1]))

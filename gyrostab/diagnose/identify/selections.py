"""Define what a selection puts into the model, and the state with selections in the model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from gyrostab.diagnose.identify.components import are_lines, axes_of, sum_evidence
from gyrostab.diagnose.predict.candidates import Component, is_nuisance
from gyrostab.diagnose.predict.condition import condition_on_components, refit_powers
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.settings import Settings

#: What filters the noise of the log, and would explain an error in the spectrum of another effect.
_FILTER = "logger_filter"


@dataclass(frozen=True, eq=False)
class Selection:
    """What forward selection puts into the model: an effect, or a nuisance alternative.

    It is equal only to itself. A variable `identification` holds a selection that `is_named`, one
    called `selection` may hold either.
    """

    effect: str  # name in the registry, or one of `NUISANCE_ALTERNATIVES`
    driver: tuple[str, ...]  # channels of the log that it follows, in the order of the effect's
    axes: tuple[str, ...]
    components: tuple[Component, ...]  # statistics and rows in which it shows
    evidence_nats: float  # held-out log Bayes factor with all others in the model [nats]
    threshold: float  # evidence that it needed [nats]
    #: Effects that these data do not separate from it; for a nuisance alternative those that come
    #: nearest, or whose channel is missing.
    alternatives: tuple[str, ...] = ()
    #: Key of each candidate that could take its place -> evidence there [nats].
    instead: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_named(self) -> bool:
        """Whether it is an effect."""
        return not is_nuisance(self.effect)


def components_of(chosen: Iterable[Selection]) -> list[Component]:
    """Return the components of several selections, in order."""
    return [component for selection in chosen for component in selection.components]


def condition_on_selections(
    start: State, chosen: Sequence[Selection], without: Selection | None = None
) -> State:
    """Return the state with all selections but one in the model."""
    return [
        start,
        *conditioned_states(start, [selection for selection in chosen if selection is not without]),
    ][-1]


def conditioned_states(start: State, chosen: Sequence[Selection]) -> Iterator[State]:
    """Yield the state with the first selection in the model, with the first two, and so on.

    What consecutive lines add to the powers is fitted once for all of them, after the last.
    """
    state = start
    is_line_only = [are_lines(selection.components) for selection in chosen]
    for number, selection in enumerate(chosen):
        state = condition_on_components(state, selection.components)
        if not all(is_line_only[number : number + 2]) or number + 1 == len(chosen):
            state = refit_powers(state)
        yield state


def add_selection(chosen: Sequence[Selection], addition: Selection) -> list[Selection]:
    """Return the list with another selection; one of the same effect and channel is merged with it.

    Lines of other frequencies are not merged.
    """
    for place, other in enumerate(chosen):
        if addition.is_named and _is_same_effect(addition, other):
            axes = tuple(sorted({*other.axes, *addition.axes}))
            alternatives = tuple(dict.fromkeys([*other.alternatives, *addition.alternatives]))
            merged = replace(
                other,
                axes=axes,
                components=(*other.components, *addition.components),
                evidence_nats=other.evidence_nats + addition.evidence_nats,
                alternatives=alternatives,
            )
            return [*chosen[:place], merged, *chosen[place + 1 :]]
    return [*chosen, addition]


def with_axes_of(
    identification: Selection,
    components_by_key: Mapping[str, Sequence[Component]],
    settings: Settings,
) -> Selection:
    """Return an identification without the axes on which it adds no evidence.

    `components_by_key` has the components that were found with all others in the model.
    """
    shown_axes = {
        axis
        for component in components_by_key.get(identification.components[0].candidate.key, [])
        if component.evidence_nats > settings.component_nats
        for axis in component.row
    }
    components = [
        component for component in identification.components if set(component.row) <= shown_axes
    ]
    return reduce_selection(identification, components) if components else identification


def reduce_selection(
    selection: Selection, components: Sequence[Component], evidence_nats: float | None = None
) -> Selection:
    """Return a selection with some of its components, on their axes, and perhaps other evidence.

    Its alternatives are compared with it, and lose the same axes.
    """
    if evidence_nats is None:
        evidence_nats = selection.evidence_nats
    change_nats = evidence_nats - selection.evidence_nats
    return replace(
        selection,
        axes=axes_of(components, selection.axes),
        components=tuple(components),
        evidence_nats=evidence_nats,
        instead={key: nats + change_nats for key, nats in selection.instead.items()},
    )


def _is_same_effect(first: Selection, other: Selection) -> bool:
    lines = {
        component.line_index
        for component in components_of((first, other))
        if component.statistic.is_line
    }
    return (first.effect, first.driver) == (other.effect, other.driver) and len(lines) < 2


def make_selection(
    components: Sequence[Component],
    threshold: float,
    *,
    order: Sequence[str] = (),
    alternatives: Iterable[str] = (),
) -> Selection:
    """Make a selection of components that passed a threshold, with its axes in order."""
    first = components[0].candidate
    return Selection(
        first.effect,
        first.driver,
        axes_of(components, order),
        tuple(components),
        sum_evidence(components),
        threshold,
        tuple(dict.fromkeys(name for name in alternatives if name != first.effect)),
    )


def own_form_error(
    components: Sequence[Component], evidence_nats: float, settings: Settings
) -> float:
    """Return what an error of its form may cost an effect with this evidence [nats].

    The evidence of a size grows with its square, and so does what an error of its form costs. That
    of a random walk has no such error: another walk that explains more is another one.
    """
    has_size = all(component.statistic.has_size for component in components)
    return settings.form_error_share * max(evidence_nats, 0.0) * has_size


def ambiguous_evidence(
    components: Sequence[Component], evidence_nats: float, settings: Settings
) -> float:
    """Return the least evidence of an alternative to an effect with this evidence [nats]."""
    error = own_form_error(components, evidence_nats, settings)
    return evidence_nats - settings.ambiguous_nats - error


def form_error(
    components: Sequence[Component], chosen: Sequence[Selection], settings: Settings
) -> float:
    """Return what errors of the form of other effects may leave to these components [nats].

    Only effects in the same statistics and axes count. A steady line leaves nothing at other
    frequencies, because what it leaks into is taken out with it. The record shows the course in
    time of a driven noise well, but its spectrum is that of a simple law, without mounts and
    decimators. A filter, or another noise of the same channel, would explain what this leaves over
    frequency.
    """
    error = 0.0
    for selection in chosen:
        for component in selection.components:
            statistic = component.statistic
            affected = [
                own.candidate
                for own in components
                if not own.statistic.is_line
                and own.statistic.name in (statistic.name, *statistic.error_shows_in)
                and {*own.row} & {*component.row}
            ]
            is_spectral = any(
                candidate.effect == _FILTER or candidate.driver == selection.driver
                for candidate in affected
                if statistic.is_power and selection.driver
            )
            share = settings.spectrum_error_share if is_spectral else settings.form_error_share
            error += share * component.evidence_nats if affected else 0.0
    return error

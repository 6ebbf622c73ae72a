"""Select effects one after the other, by their evidence with all others in the model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.identify.components import (
    PLAIN_LINE,
    are_lines,
    axes_of,
    candidates_of,
    find_components,
    find_layers_again,
    group_components,
    merge_lines,
    split_layers,
    sum_evidence,
)
from gyrostab.diagnose.identify.identifiability import (
    find_equivalent_effects,
    find_spectral_alternatives,
    is_physical,
    without_pulses,
)
from gyrostab.diagnose.identify.identification import (
    Identification,
    Rejection,
    Selection,
    Unidentified,
    add_identification,
    components_of,
    condition_on_selections,
    find_unidentified,
    form_error,
    with_axes_of,
)
from gyrostab.diagnose.identify.jumps import is_step
from gyrostab.diagnose.identify.naming_order import order_passing, order_rivals
from gyrostab.diagnose.identify.rejected import find_rejections
from gyrostab.diagnose.identify.surrogates import passes_time_shift_test
from gyrostab.diagnose.identify.switching import (
    drop_explained_jumps,
    renew_component,
)
from gyrostab.diagnose.identify.withdrawal import Withdrawal
from gyrostab.diagnose.predict.candidates import Candidate, CandidateEvidence, Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import compute_evidence, reusable_evidence
from gyrostab.diagnose.settings import DEFAULTS, Settings

__all__ = ["Search"]

# Limits of the time of a search; a record has fewer effects.
MAX_EFFECTS = 10
#: Lines are counted apart: whatever rotates or switches makes combs of them.
MAX_LINES = 40
#: Sample counts of zeros: a sample is zero for one reason only.
_ZERO_COUNTS = {"stuck", "filled"}


@dataclass(frozen=True)
class Search:
    """Forward selection over the candidates.

    Attributes
    ----------
    candidates : sequence of Candidate
        Effects and nuisance alternatives.
    folds : xarray.DataArray
        From `gyrostab.diagnose.evidence.folds.fold_blocks`.
    count_evidence : CountEvidence
        Evidence from sample counts.
    threshold : float
        Evidence [nats] that noise alone exceeds with the false-alarm probability.
    expected : tuple of Identification
        Effects that the simulation contains as well.
    """

    candidates: Sequence[Candidate]
    folds: xr.DataArray
    count_evidence: CountEvidence
    threshold: float
    expected: tuple[Identification, ...] = ()
    settings: Settings = DEFAULTS

    def run(
        self, start: State
    ) -> tuple[list[Identification], list[Unidentified], list[Rejection], State]:
        """Select effects until none passes, then test each again with the others.

        Parameters
        ----------
        start : State
            With the expected effects in the model.

        Returns
        -------
        identified : list of Identification
            The strongest first.
        unidentified : list of Unidentified
        rejected : list of Rejection
            What beats each of the other effects.
        state : State
            With all of these in the model.
        """
        selected, all_evidence = self._select_all(start)
        chosen = drop_explained_jumps(
            selected,
            lambda selections: condition_on_selections(start, selections),
            self._evidence,
            self.threshold,
        )
        chosen = self._prune(start, without_pulses(chosen, settings=self.settings))
        chosen, identified = self._settle(start, chosen)
        unidentified = [selection for selection in chosen if isinstance(selection, Unidentified)]
        state = condition_on_selections(start, [*identified, *unidentified])
        withdrawal = Withdrawal(start, self.candidates, self.folds, self.threshold, self.settings)
        remaining, withdrawn = withdrawal.run(state, identified, unidentified)
        unidentified += withdrawn
        if len(remaining) < len(identified) or withdrawn:
            state = condition_on_selections(start, [*remaining, *unidentified])
        remaining = sorted(remaining, key=lambda identification: -identification.evidence_nats)
        is_unchanged = _variants_by_row(selected) == _variants_by_row([*remaining, *unidentified])
        rejected = self._reject_others(
            start, remaining, unidentified, state, all_evidence if is_unchanged else ()
        )
        return remaining, unidentified, rejected, state

    def _select_all(self, start: State) -> tuple[list[Selection], list[CandidateEvidence]]:
        """Select the best candidate, put it into the model, and repeat while one passes.

        The second result is the evidence of the others, with all of these in the model.
        """
        chosen: list[Selection] = []
        state = previous = start
        barred = {
            key
            for identification in self.expected
            for key in (
                identification.components[0].candidate.key,
                *self._explained_count_keys(identification),
            )
        }
        effects_left, lines_left = MAX_EFFECTS, MAX_LINES
        all_evidence: list[CandidateEvidence] = []
        while effects_left:
            known_evidence = reusable_evidence(all_evidence, previous, state)
            all_evidence, previous = self._score_candidates(state, barred, known_evidence), state
            selected = self._select_next(all_evidence, state, chosen)
            if selected is None:
                return chosen, all_evidence
            selection, rejected = selected
            barred |= rejected
            if selection is not None and are_lines(selection.components):
                lines_left -= 1
                barred |= set() if lines_left else {PLAIN_LINE}
            else:
                effects_left -= 1
            if selection is not None:
                chosen = add_identification(chosen, selection)
                barred |= self._explained_count_keys(selection)
                state = condition_on(state, list(selection.components))
        return chosen, []

    def _explained_count_keys(self, selection: Selection) -> set[str]:
        """Return the keys of candidates for sample counts that a selection explains.

        Counts have no columns to put into the model, so that these candidates are barred instead.
        """
        components = selection.components
        if any(
            component.candidate.effect in ("logger_filter", "~S(f)") for component in components
        ):
            return {"~outliers"}  # the kurtosis of a block is that of other noise
        if not any(component.statistic.is_count for component in components):
            return set()
        counts = {name for component in components for name in component.variant.columns}
        counts |= {"kurtosis"}
        counts |= _ZERO_COUNTS if counts & _ZERO_COUNTS else set()
        return {
            candidate.key
            for candidate in self.candidates
            if candidate.statistic.is_count and counts & candidate.columns
        }

    def _evidence(self, candidates: Sequence[Candidate], state: State) -> list[CandidateEvidence]:
        return compute_evidence(
            candidates, state.blocks, state, self.folds, count_evidence=self.count_evidence
        )

    def _score_candidates(
        self, state: State, barred: set[str], known_evidence: Sequence[CandidateEvidence] = ()
    ) -> list[CandidateEvidence]:
        """Compute the evidence of all candidates that are not barred; `known_evidence` is reused.

        Powers are weighted with the strongest effect in the powers, because its noise is in every
        statistic.
        """
        is_known = {id(evidence.candidate) for evidence in known_evidence}
        sought = [
            candidate
            for candidate in self.candidates
            if candidate.key not in barred and id(candidate) not in is_known
        ]
        all_evidence = [
            *(evidence for evidence in known_evidence if evidence.candidate.key not in barred),
            *self._evidence(sought, state),
        ]
        weighted = [
            evidence.candidate
            for evidence in all_evidence
            if evidence.candidate.statistic.is_power_weighted
        ]
        is_new = any(candidate.statistic.is_power_weighted for candidate in sought)
        for _ in range(2 if is_new else 0):
            powers = [
                evidence for evidence in all_evidence if evidence.candidate.statistic.is_power
            ]
            strongest = max(powers, key=_positive_evidence, default=None)
            if (
                strongest is None
                or _positive_evidence(strongest)
                < self.settings.reweight_thresholds * self.threshold
            ):
                break
            trial = condition_on(state, find_components(strongest, settings=self.settings))
            weighted_evidence = compute_evidence(
                weighted, state.blocks, replace(state, weight=trial.weight), self.folds
            )
            all_evidence = [
                evidence
                for evidence in all_evidence
                if not evidence.candidate.statistic.is_power_weighted
            ] + weighted_evidence
        return all_evidence

    def _select_next(
        self, all_evidence: list[CandidateEvidence], state: State, chosen: Sequence[Selection]
    ) -> tuple[Selection | None, set[str]] | None:
        """Select the next effect, or the nuisance alternative that explains more.

        Returns
        -------
        selection : Identification, Unidentified or None
            None when only effects passed that fail the time-shift test.
        rejected : set of str
            Keys that fail it. Instead of both, None when nothing passes.
        """
        components = merge_lines(group_components(all_evidence, settings=self.settings))
        required = {
            key: self.threshold
            + form_error(effect_components, [*self.expected, *chosen], settings=self.settings)
            for key, effect_components in components.items()
        }
        for key, effect_components in list(components.items()):
            if not key.startswith("~") and sum_evidence(effect_components) > required[key]:
                components[key] = is_physical(
                    effect_components, state, error=required[key] - self.threshold
                )
        passing = order_passing(components, required, state, self.folds)
        if not passing:
            return None
        rivals = order_rivals(passing, components, state, self.candidates, settings=self.settings)
        pair = None if rivals else self._find_pair(passing, components, required, state)
        if pair is not None:
            key, components[key], state = pair
            rivals = [key]
        rejected: set[str] = set()
        for key in rivals:
            shifts = passes_time_shift_test(components[key], state, self.folds)
            if shifts.passed:
                min_nats = sum_evidence(components[key]) - self.settings.ambiguous_nats
                close = [
                    components[other][0].candidate.effect
                    for other in rivals
                    if other != key
                    and other not in rejected
                    and sum_evidence(components[other]) >= min_nats
                ]
                return self._identify(
                    components[key], required[key], close, shifts.p_value
                ), rejected
            rejected.add(key)
        if rejected:
            return None, rejected
        alternative = passing[0]
        effects = [key for key in passing if not key.startswith("~")]
        nearest = [components[key][0].candidate.effect for key in effects[:3]]
        return find_unidentified(
            alternative, components[alternative], required[alternative], nearest
        ), set()

    def _find_pair(
        self,
        passing: list[str],
        components: dict[str, list[Component]],
        required: dict[str, float],
        state: State,
    ) -> tuple[str, list[Component], State] | None:
        """Find two effects that together explain more than the nuisance alternative.

        Two jumps are such a pair if the alternative is a course of levels. An alternative of any
        form explains more than each of them while the other is not in the model. The evidence of a
        pair is the lower one of both orders: an effect that is fitted alone to both may have a form
        that the second one has to undo.

        Returns
        -------
        key : str
            The stronger effect.
        components : list of Component
            What it explains with the other in the model.
        state : State
            With the other in the model.
        """
        alternative = components[passing[0]]
        is_course = alternative[0].statistic.is_switching  # of levels, as jumps make it
        keys = [
            key
            for key in passing
            if not key.startswith("~")
            and (
                components[key][0].statistic is alternative[0].statistic
                or (is_course and components[key][0].statistic.is_linear_in_means)
            )
        ]
        companions = {
            key: self._find_beside(keys, components[key], required[key], state) for key in keys
        }
        totals = {
            (first, second): sum_evidence(components[first])
            + sum_evidence(components_beside[second])
            for first, (_, components_beside) in companions.items()
            for second in components_beside
        }
        pairs = {
            pair: min(totals[pair], totals[pair[::-1]])
            for pair in combinations_with_replacement(keys, 2)
            if pair in totals
            and pair[::-1] in totals
            and (pair[0] != pair[1] or (is_course and is_step(components[pair[0]][0])))
        }
        best = max(pairs, key=lambda pair: pairs[pair], default=None)
        if best is None or pairs[best] <= sum_evidence(alternative):
            return None
        with_other, components_beside = companions[best[1]]
        return best[0], components_beside[best[0]], with_other

    def _find_beside(
        self, keys: Sequence[str], components: list[Component], required: float, state: State
    ) -> tuple[State, dict[str, list[Component]]]:
        """Return which of some effects pass with these components in the model."""
        chosen = [self._identify(components, required, (), math.nan)]
        with_first = condition_on(state, components)
        sought = [candidate for candidate in self.candidates if candidate.key in keys]
        components_beside = {}
        for key, effect_components in group_components(
            self._evidence(sought, with_first), settings=self.settings
        ).items():
            error = form_error(effect_components, chosen, settings=self.settings)
            physical = is_physical(effect_components, with_first, error=error)
            if sum_evidence(physical) > self.threshold + error:
                components_beside[key] = physical
        return with_first, components_beside

    def _identify(
        self, components: list[Component], threshold: float, names: Sequence[str], p_value: float
    ) -> Identification:
        """Make an identification of these components; `names` are effects close to it."""
        first = components[0].candidate
        return Identification(
            first.effect,
            first.driver,
            axes_of(components, ()),
            tuple(components),
            sum_evidence(components),
            threshold,
            tuple(dict.fromkeys(name for name in names if name != first.effect)),
            p_value,
        )

    def _prune(self, start: State, chosen: list[Selection]) -> list[Selection]:
        """Drop what fails the threshold with the others in the model, the weakest first.

        Unidentified ones are tested before identifications, and these lose the axes that no longer
        show them. The first selection stays, unless it is of anomalous samples, which come first
        whatever their evidence.
        """
        for selection in sorted(
            chosen,
            key=lambda selection: (isinstance(selection, Identification), selection.evidence_nats),
        ):
            if len(chosen) < 2:
                break
            state = condition_on_selections(start, chosen, selection)
            components_by_key = group_components(
                self._evidence(candidates_of(selection.components), state), settings=self.settings
            )
            is_leading = (
                selection is chosen[0]
                and isinstance(selection, Identification)
                and not selection.components[0].statistic.is_count
            )
            best = max(
                (sum_evidence(components) for components in components_by_key.values()), default=0.0
            )
            if not is_leading and best < self.threshold:
                chosen = [other for other in chosen if other is not selection]
            elif isinstance(selection, Identification):
                reduced = with_axes_of(selection, components_by_key, settings=self.settings)
                chosen = [reduced if other is selection else other for other in chosen]
        return chosen

    def _settle(
        self, start: State, chosen: list[Selection]
    ) -> tuple[list[Selection], list[Identification]]:
        """Finish the identifications, and drop the weakest until all reach their threshold."""
        while True:
            identified = {
                place: self._finish(start, selection, chosen)
                for place, selection in enumerate(chosen)
                if isinstance(selection, Identification)
            }
            margin = {
                place: identification.evidence_nats
                - self._required_nats(identification, identified)
                for place, identification in identified.items()
            }
            weakest = min(margin, key=lambda place: margin[place], default=None)
            if weakest is None or margin[weakest] >= 0.0:
                return chosen, list(identified.values())
            chosen = [*chosen[:weakest], *chosen[weakest + 1 :]]

    def _required_nats(
        self, identification: Identification, identified: dict[int, Identification]
    ) -> float:
        """Return the evidence that an identification needs, whatever was named first."""
        other_identifications = [
            *self.expected,
            *(other for other in identified.values() if other is not identification),
        ]
        return max(
            identification.threshold,
            self.threshold
            + form_error(identification.components, other_identifications, settings=self.settings),
        )

    def _finish(
        self, start: State, identification: Identification, chosen: Sequence[Selection]
    ) -> Identification:
        """Return an identification with its evidence and its rivals, all others in the model."""
        state = condition_on_selections(start, chosen, identification)
        key = identification.components[0].candidate.key
        on_axes, weighted = self._find_instead(identification, state)
        layers = find_layers_again(
            identification.components, on_axes.get(key, []), weighted, self._evidence
        )
        evidence_nats = (
            sum(max(sum_evidence(layer), 0.0) for layer in layers) or identification.evidence_nats
        )
        min_nats = evidence_nats - self.settings.ambiguous_nats
        rivals = [
            components[0].candidate.effect
            for other, components in on_axes.items()
            if components
            and other != key
            and not other.startswith("~")
            and sum_evidence(components) >= min_nats
            and sum_evidence(is_physical(components, state)) >= min_nats
        ]
        lines = {
            component.place
            for component in components_of(chosen)
            if component.candidate.effect == PLAIN_LINE
        }
        rivals += find_equivalent_effects(
            identification.effect, identification.components, state, lines=len(lines)
        )
        of_any_spectrum = find_spectral_alternatives(
            identification.effect,
            [component for layer in layers for component in layer],
            weighted,
            self._evidence,
        )
        rivals += of_any_spectrum
        alternatives = dict.fromkeys([*identification.alternatives, *rivals])
        alternatives.pop(identification.effect, None)
        components = tuple(
            renew_component(layer_components, component)
            for layer, layer_components in zip(
                split_layers(identification.components), layers, strict=True
            )
            for component in layer
        )
        return replace(
            identification,
            evidence_nats=evidence_nats,
            alternatives=tuple(alternatives),
            components=components,
            # as probable as this effect, whatever their own form explains
            instead=_sum_by_key(on_axes) | dict.fromkeys(of_any_spectrum, evidence_nats),
        )

    def _find_instead(
        self, selection: Selection, state: State
    ) -> tuple[dict[str, list[Component]], State]:
        """Return the components of candidates that could take the place of a selection.

        They are in its statistics and on its axes. `state` has all others in the model; it is
        returned with the weights that it has with the selection.
        """
        weighted = replace(state, weight=condition_on(state, list(selection.components)).weight)
        statistics = {component.statistic for component in selection.components}
        candidates = [
            candidate for candidate in self.candidates if candidate.statistic in statistics
        ]
        axes = set(selection.axes)
        components_by_key = group_components(
            self._evidence(candidates, weighted), settings=self.settings
        )
        return {
            key: [component for component in components if set(component.row) & axes]
            for key, components in components_by_key.items()
        }, weighted

    def _reject_others(
        self,
        start: State,
        identified: Sequence[Identification],
        unidentified: Sequence[Unidentified],
        state: State,
        known_evidence: Sequence[CandidateEvidence],
    ) -> list[Rejection]:
        """Return what beats each effect that is not among the identified.

        `state` has all of them in the model, and `known_evidence` is valid in it.
        """
        chosen: list[Selection] = [
            *identified,
            *(
                replace(
                    selection,
                    instead=_sum_by_key(
                        self._find_instead(
                            selection,
                            condition_on_selections(start, [*identified, *unidentified], selection),
                        )[0]
                    ),
                )
                if selection.components
                else selection
                for selection in unidentified
            ),
        ]
        all_evidence = self._score_candidates(state, set(), known_evidence)
        return find_rejections(
            merge_lines(group_components(all_evidence, settings=self.settings)),
            chosen,
            self.expected,
            self.threshold,
            state,
            self.folds,
        )


def _variants_by_row(chosen: Sequence[Selection]) -> set[tuple[str, tuple[str, ...], int]]:
    """Return what the selections put into the model: rows and identities of the variants."""
    return {
        (component.candidate.key, component.row, id(component.variant))
        for component in components_of(chosen)
    }


def _sum_by_key(components: Mapping[str, Sequence[Component]]) -> dict[str, float]:
    return {
        key: sum_evidence(effect_components)
        for key, effect_components in components.items()
        if effect_components
    }


def _positive_evidence(evidence: CandidateEvidence) -> float:
    return float(np.maximum(evidence.evidence_nats[0], 0.0).sum())

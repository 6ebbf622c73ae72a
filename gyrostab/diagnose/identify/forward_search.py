"""Identify effects one after the other, by their evidence with all others in the model."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from gyrostab.diagnose.identify.components import (
    PLAIN_LINE,
    are_lines,
    group_components,
    merge_lines,
    select_components,
    sum_evidence,
)
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identifiability import keep_physical, passes_time_shift_test
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.naming_order import SearchRound
from gyrostab.diagnose.identify.selections import (
    Selection,
    add_selection,
    ambiguous_evidence,
    make_selection,
)
from gyrostab.diagnose.identify.settling import prune_selections, settle_selections
from gyrostab.diagnose.identify.withdrawal import withdraw_effects, without_pulses
from gyrostab.diagnose.predict.candidates import CandidateEvidence, Component, is_nuisance
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import combine_rows
from gyrostab.physics.base import Effect

# Limits of the time of a search; a record has fewer effects.
MAX_EFFECTS = 10
MAX_ROUNDS_PER_EFFECT = 6  # components of one kind that an expected effect may add, one each round
#: Lines are counted apart: whatever rotates or switches makes combs of them.
MAX_LINES = 40
#: Sample counts of zeros: a sample is zero for one reason only.
_ZERO_COUNTS = {"stuck", "filled"}


def identify_effects(examination: Examination) -> Identifications:
    """Identify the effects that a recording shows beyond its baseline.

    Effects are selected one after the other, by how much better they predict held-out data, until
    none passes. Then each is tested again with the others.
    """
    examination = identify_expected_effects(examination)
    selected, beaten = _select_all(examination)
    pruned = prune_selections(examination, selected)
    unidentified, identified = settle_selections(examination, pruned)
    identified = without_pulses(identified, examination.settings)
    remaining, withdrawn = withdraw_effects(examination, identified, unidentified)
    unidentified += withdrawn
    return Identifications(
        examination,
        tuple(sorted(remaining, key=lambda identification: -identification.evidence_nats)),
        tuple(unidentified),
        examination.state_with([*remaining, *unidentified]),
        examination.expected,
        beaten,
    )


def _select_all(examination: Examination) -> tuple[list[Selection], dict[str, tuple[str, float]]]:
    """Select the best candidate, put it into the model, and repeat while one passes.

    What wanders without a course comes last, once no other effect passes. The second result is
    `beaten` of `Identifications`.
    """
    chosen: list[Selection] = []
    state = examination.start
    barred: set[str] = set()
    for identification in examination.expected:
        barred.add(identification.components[0].candidate.key)
        barred |= _explained_count_keys(examination, identification)
    effects_left, lines_left = MAX_EFFECTS, MAX_LINES
    beaten: dict[str, tuple[str, float]] = {}
    includes_last_resorts = False
    while effects_left > 0:
        all_evidence = score_candidates(
            examination, state, barred, includes_last_resorts=includes_last_resorts
        )
        selections, shifted = _select_next(examination, all_evidence, state, chosen, beaten)
        beaten |= shifted
        barred |= shifted.keys()
        if shifted and not selections:
            continue
        if not includes_last_resorts and not any(choice.is_named for choice in selections):
            includes_last_resorts = True  # nothing else passes
            continue
        if not selections:
            break
        includes_last_resorts = False
        for selection in selections:
            is_line = are_lines(selection.components)
            lines_left, effects_left = lines_left - is_line, effects_left - (not is_line)
            if lines_left == 0:
                barred.add(PLAIN_LINE)
            chosen = add_selection(chosen, selection)
            barred |= _explained_count_keys(examination, selection)
            state = condition_on(state, selection.components)
    return chosen, beaten


def _explained_count_keys(examination: Examination, selection: Selection) -> set[str]:
    """Return the keys of candidates for sample counts that a selection explains.

    Counts have no columns to put into the model, so that these candidates are barred instead.
    """
    components = selection.components
    if any(component.candidate.effect in ("logger_filter", "~S(f)") for component in components):
        return {"~outliers"}  # the kurtosis of a block is that of other noise
    if not any(component.statistic.is_count for component in components):
        return set()
    counts = {"kurtosis", *(name for part in components for name in part.variant.columns)}
    counts |= _ZERO_COUNTS if counts & _ZERO_COUNTS else set()
    return {
        candidate.key
        for candidate in examination.candidates
        if candidate.statistic.is_count and counts & candidate.columns
    }


def score_candidates(
    examination: Examination,
    state: State,
    barred: Collection[str],
    *,
    includes_last_resorts: bool = True,
) -> list[CandidateEvidence]:
    """Compute the evidence of all candidates that are not barred, last resorts as an option.

    These are in statistics that are tried last (`is_tried_last`).
    Powers are weighted with the strongest effect in the powers, because its noise is in every
    statistic.
    """
    sought = [
        candidate
        for candidate in examination.candidates
        if candidate.key not in barred
        and (includes_last_resorts or not candidate.statistic.is_tried_last)
    ]
    all_evidence = examination.compute_evidence(sought, state)
    weighted = [candidate for candidate in sought if candidate.statistic.is_power_weighted]
    others = [item for item in all_evidence if not item.candidate.statistic.is_power_weighted]
    settings = examination.settings
    min_nats = settings.reweight_thresholds * examination.threshold
    for _ in range(2):
        powers = [item for item in all_evidence if item.candidate.statistic.is_power]
        strongest = max(powers, key=_sum_rows, default=None)
        if strongest is None or _sum_rows(strongest) < min_nats:
            break
        trial = condition_on(state, select_components(strongest, settings))
        weighted_state = replace(state, expected_power=trial.expected_power)
        all_evidence = others + examination.compute_evidence(weighted, weighted_state)
    return all_evidence


def _select_next(
    examination: Examination,
    all_evidence: list[CandidateEvidence],
    state: State,
    chosen: Sequence[Selection],
    beaten: dict[str, tuple[str, float]],
) -> tuple[list[Selection], dict[str, tuple[str, float]]]:
    """Select the next effect or pair of effects, or the nuisance alternative that explains more.

    Effects that another form beats are added to `beaten`. The second result is by how much a
    time-shifted channel explains more than each effect that fails this test. If all effects that
    pass otherwise fail it, or none passes, the list of selections is empty.
    """
    search = _begin_round(examination, all_evidence, state, chosen, beaten)
    components, required = search.components, search.required
    passing = search.order_passing()
    if not passing:
        return [], {}
    rivals = search.order_rivals(passing)
    options = [[(key, components[key], state)] for key in rivals] or [search.find_pair(passing)]
    failed: dict[str, tuple[str, float]] = {}
    for option in filter(None, options):
        shifted = {
            key: ("a time-shifted channel", nats)
            for key, own, with_other in option
            for passed, _, nats in [passes_time_shift_test(own, with_other)]
            if not passed
        }
        failed |= shifted
        if shifted:
            continue
        best = option[0][1]
        min_nats = ambiguous_evidence(best, sum_evidence(best), examination.settings)
        close = [
            components[other][0].candidate.effect
            for other in rivals
            if other not in failed and search.nats(other) >= min_nats
        ]
        return [
            make_selection(own, required[key], alternatives=close) for key, own, _ in option
        ], failed
    if failed:
        return [], failed
    effects = [components[key][0].candidate.effect for key in passing if not is_nuisance(key)]
    alternative = passing[0]
    return [
        make_selection(components[alternative], required[alternative], alternatives=effects[:3])
    ], {}


def _begin_round(
    examination: Examination,
    all_evidence: list[CandidateEvidence],
    state: State,
    chosen: Sequence[Selection],
    beaten: dict[str, tuple[str, float]],
) -> SearchRound:
    """Collect what each candidate explains, without axes on which its size would be impossible.

    Only effects that would pass are tested. Those that another form beats are added to `beaten`.
    """
    components = merge_lines(group_components(all_evidence, examination.settings))
    required = {}
    for key, own in components.items():
        required[key] = examination.required_nats(own, chosen)
        if is_nuisance(key) or sum_evidence(own) <= required[key]:
            continue
        error = required[key] - examination.threshold
        components[key], better_form = keep_physical(own, state, error=error)
        if better_form:
            beaten[key] = better_form
        else:
            beaten.pop(key, None)
            required[key] = examination.required_nats(components[key], chosen)
    return SearchRound(examination, state, components, required, chosen)


def _sum_rows(evidence: CandidateEvidence) -> float:
    return float(combine_rows(evidence.evidence_nats[0]))


def identify_expected_effects(examination: Examination) -> Examination:
    """Identify effects that are expected, and put them into the model before any others.

    Their sizes are free: the model says how often something happens, and the recording when. The
    strongest comes first, but anomalous samples before all others, because they raise powers and
    means too. An effect with several components of a kind, such as two jumps, is taken as long as
    it adds evidence.
    """
    identified: list[Selection] = []
    state, remaining = examination.start, list(examination.model_effects)
    needed = examination.settings.component_nats
    for _ in range(MAX_ROUNDS_PER_EFFECT * len(remaining)):
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
        is_over = components[0].statistic.is_count
        remaining = [other for _, other in choices if not (is_over and other is effect)]
    return replace(examination, expected=tuple(identified), start=state)


def _best_components(effect: Effect, examination: Examination, state: State) -> list[Component]:
    """Return the components of an effect, or its single event, with the most evidence."""
    names = (effect.name, *effect.look_alikes("single event"))
    channels = {"", *effect.channel_names().values()}
    candidates = [
        candidate
        for candidate in examination.candidates
        if candidate.effect in names and channels.issuperset(candidate.driver)
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

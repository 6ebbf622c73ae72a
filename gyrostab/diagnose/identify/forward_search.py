"""Name the physics: forward selection of effects by what they explain on held-out time, against thresholds from null records."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.quantization_grid import rounded_rates
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.evidence.sample_counts import ExpectedCounts
from gyrostab.diagnose.identify.completeness import (
    excess_low_frequency_noise,
    flexible,
    variance_fluctuation,
)
from gyrostab.diagnose.identify.components import (
    PLAIN_LINE,
    axes_of,
    by_key,
    find_components,
    lines_only,
    sum_evidence,
    tried_again,
    without_lines,
)
from gyrostab.diagnose.identify.expected import identify_expected_effects
from gyrostab.diagnose.identify.identifiability import (
    find_equivalent_effects,
    find_plainer_effect,
    is_physical,
    without_pulses,
)
from gyrostab.diagnose.identify.identification import (
    Identification,
    Identifications,
    Unidentified,
    add_identification,
    find_unidentified,
    form_error,
    with_axes_of,
)
from gyrostab.diagnose.identify.logger_filters import without_slopes
from gyrostab.diagnose.identify.overlapping import found_again, layers
from gyrostab.diagnose.identify.surrogates import passes_time_shift_test
from gyrostab.diagnose.identify.switching import (
    followed_first,
    hops_alone,
    identify_switching,
    renewed,
)
from gyrostab.diagnose.predict.candidates import Candidate, effect_candidates
from gyrostab.diagnose.predict.condition import (
    Component,
    condition_on,
    condition_on_components,
    refit_weights,
)
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.predict.nuisance import nuisance_alternatives
from gyrostab.diagnose.predict.search import (
    CandidateEvidence,
    CountEvidence,
    compute_evidence,
    evidence_by_effect,
    reusable_mean_evidence,
)
from gyrostab.errors import OptionError
from gyrostab.physics.base import Effect
from gyrostab.progress import Stage, no_stage

__all__ = ["Identification", "Identifications", "Unidentified", "name_effects", "tail_level"]

Array = NDArray[np.float64]
#: An effect that comes this close to the one named may be meant as well [nats].
AMBIGUOUS = 3.0
#: Of the gain of what is named, what an error of its form may leave: 10 % of its size.
FORM = 0.01
_ROUNDS, _LINES = (
    10,
    40,
)  # names that are sought in turn: of lines as many beside, for what turns or switches makes combs of them
_LEAST_NULLS = 40
_LEFT = 2.0  # nats that may be left, beside errors of the form
_SHAPES = ("logger_filter", "held_samples", "gauss_markov", "telegraph")
_LOCKED = ("order", "phase_locked")
_WEIGHED = (
    "power",
    "cross",
    "order",
    "phase_locked",
    "transfer",
)  # views whose weights are the expected powers
_TAIL = 0.25
_OF_ZEROS = {"stuck", "filled"}  # a sample that is zero is so for one reason


def name_effects(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    nulls: Iterable[xr.Dataset],
    *,
    level: float = 0.005,
    seed: int = 0,
    known: Sequence[Effect] = (),
    progress: Stage = no_stage,
) -> Identifications:
    """Name the effects that a recording shows beyond its baseline.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `reduce_log`.
    baseline : xarray.Dataset
        From `gyrostab.diagnose.baseline.calibrate`.
    nulls : iterable of xarray.Dataset
        Null records, some with a leading dimension ``record`` at a time.
    level : float
        Probability that noise alone gets a name, or is called unknown.
    seed : int
        Of the draws for views that the null records do not hold.
    known : sequence of Effect
        That the simulation has as well, but not the baseline: they are in the model before anything
        is named.
    progress : Stage
        Is told of the null records done.

    Returns
    -------
    Naming

    Raises
    ------
    OptionError
        When there are too few null records.
    """
    folds = fold_blocks(blocks)
    tried, reasons = effect_candidates(blocks, baseline["coefficient"])
    candidates = [*tried, *nuisance_alternatives(blocks)]
    state = initial_state(blocks, baseline)
    best, count_evidence = _null_best(
        candidates, nulls, state, folds, np.random.default_rng(seed), progress
    )
    if not count_evidence.rounded.any() and (blocks["lattice"] > 0.0).any():
        reasons |= {
            "rate_quantization": "not identifiable: the lattice of values is that of angles, or too fine to show"
        }
    expected, state = identify_expected_effects(
        known,
        tried,
        state,
        lambda some, now: compute_evidence(
            some, now.blocks, now, folds, count_evidence=count_evidence
        ),
    )
    search = _Search(candidates, folds, count_evidence, tail_level(best, level), tuple(expected))
    identified, unknown, state = search.run(state)
    return Identifications(
        tuple(identified),
        tuple(unknown),
        search.threshold,
        best,
        reasons,
        tuple(candidates),
        state,
        folds,
        count_evidence,
        tuple(expected),
    )


def _null_best(
    candidates: Sequence[Candidate],
    nulls: Iterable[xr.Dataset],
    state: State,
    folds: xr.DataArray,
    rng: np.random.Generator,
    progress: Stage,
) -> tuple[Array, CountEvidence]:
    """Largest gain of any effect in each null record; and what the records say of counts."""
    expected = ExpectedCounts()
    linear = [one for one in candidates if one.statistic != "marks"]
    marks = [one for one in candidates if one.statistic == "marks"]
    sums: list[dict[str, Array]] = []
    kept: list[xr.Dataset] = []
    records = 0
    for chunk in nulls:
        expected.add(chunk)
        sums.append(evidence_by_effect(compute_evidence(linear, chunk, state, folds, rng=rng)))
        kept.append(chunk[[name for name in expected.sums if name in chunk]])
        records += chunk.sizes["record"]
        progress("naming", 0, records)
    if records < _LEAST_NULLS:
        raise OptionError(
            f"{records} null records are too few to tell how often noise alone does as much; give nulls=400"
        )
    count_evidence = CountEvidence.gathered(expected, rounded_rates(state.blocks, state.baseline))
    best = []
    for total, chunk in zip(sums, kept, strict=True):
        counted = evidence_by_effect(
            compute_evidence(marks, chunk, state, folds, count_evidence=count_evidence)
        )
        keys = {*total, *counted}
        nothing = np.zeros(chunk.sizes["record"])
        best.append(
            np.max([total.get(key, nothing) + counted.get(key, nothing) for key in keys], axis=0)
        )
    return np.sort(np.concatenate(best)), count_evidence


def tail_level(best: Array, level: float) -> float:
    """Value that the largest gain of a null record passes with probability `level`, from an exponential tail beyond its upper quarter.

    Examples
    --------
    >>> sample = np.random.default_rng(1).exponential(size=100_000)
    >>> abs(tail_level(sample, 0.001) - np.log(1000)) < 0.1
    np.True_
    """
    start = float(np.quantile(best, 1.0 - _TAIL))
    above = best[best > start]
    scale = max(float(np.mean(above - start)) if above.size else 0.0, 0.1)
    return (
        start + scale * math.log(_TAIL / level)
        if level < _TAIL
        else float(np.quantile(best, 1.0 - level))
    )


@dataclass(frozen=True)
class _Search:
    """Forward selection over the candidates."""

    candidates: Sequence[Candidate]
    folds: xr.DataArray
    count_evidence: CountEvidence
    threshold: float
    expected: tuple[Identification, ...] = ()

    def run(self, start: State) -> tuple[list[Identification], list[Unidentified], State]:
        """Name one effect after the other, look again at each with the others in, and see what is left."""
        chosen: list[Identification | Unidentified] = []
        state = start
        barred = {
            key
            for one in self.expected
            for key in (one.components[0].candidate.key, *self._counted(one))
        }
        rounds, lines = _ROUNDS, _LINES
        found: list[CandidateEvidence] = []
        before = start
        while rounds and lines:
            found, before = (
                self._ranked(state, barred, reusable_mean_evidence(found, before, state)),
                state,
            )
            pick = self._pick(found, state, chosen)
            if pick is None:
                break
            one, rejected = pick
            barred |= rejected
            line = one is not None and lines_only(one.components)
            rounds, lines = rounds - (not line), lines - line
            if one is not None:
                chosen = add_identification(chosen, one)
                barred |= self._counted(one)
                state = condition_on(state, list(one.components))
        chosen = hops_alone(chosen, lambda some: self._with(start, some), self._of, self.threshold)
        chosen = self._pruned(start, without_pulses(chosen))
        chosen, identified = self._settled(start, chosen)
        unknown = [one for one in chosen if isinstance(one, Unidentified)]
        state = self._with(start, [*identified, *unknown])
        kept, withdrawn = self._complete(start, state, identified, unknown)
        unknown += withdrawn
        same = len(kept) == len(identified) and not withdrawn
        return (
            sorted(kept, key=lambda one: -one.evidence_nats),
            unknown,
            state if same else self._with(start, [*kept, *unknown]),
        )

    def _counted(self, one: Identification | Unidentified) -> set[str]:
        """Keys that stand for counts which are explained now: there is nothing to take out of a count."""
        if any(
            component.candidate.effect in ("logger_filter", "~S(f)") for component in one.components
        ):
            return {"~outliers"}  # the kurtosis of a block is that of other noise
        if not any(component.candidate.statistic == "marks" for component in one.components):
            return set()
        marks = {mark for component in one.components for mark in component.variant.columns} | {
            "kurtosis"
        }
        marks |= _OF_ZEROS if marks & _OF_ZEROS else set()
        return {
            other.key
            for other in self.candidates
            if other.statistic == "marks" and marks & set(other.marks)
        }

    def _of(self, candidates: Sequence[Candidate], state: State) -> list[CandidateEvidence]:
        return compute_evidence(
            candidates, state.blocks, state, self.folds, count_evidence=self.count_evidence
        )

    def _ranked(
        self, state: State, barred: set[str], known: Sequence[CandidateEvidence] = ()
    ) -> list[CandidateEvidence]:
        """Gains of all that is not barred, with weights that suit the best in the powers: what is loud is loud in every view.

        Those that are known are not sought again.
        """
        there = {id(one.candidate) for one in known}
        sought = [one for one in self.candidates if one.key not in barred and id(one) not in there]
        found = [
            *(one for one in known if one.candidate.key not in barred),
            *self._of(sought, state),
        ]
        weighed = [one.candidate for one in found if one.candidate.statistic in _WEIGHED]
        for _ in range(2):
            powers = [one for one in found if one.candidate.statistic == "power"]
            strong = max(
                powers,
                key=lambda one: float(np.maximum(one.evidence_nats[0], 0.0).sum()),
                default=None,
            )
            if (
                strong is None
                or np.maximum(strong.evidence_nats[0], 0.0).sum() < 3.0 * self.threshold
            ):
                break
            trial = condition_on(state, find_components(strong))
            again = compute_evidence(
                weighed, state.blocks, replace(state, weight=trial.weight), self.folds
            )
            found = [one for one in found if one.candidate.statistic not in _WEIGHED] + again
        return found

    def _pick(
        self,
        found: list[CandidateEvidence],
        state: State,
        chosen: Sequence[Identification | Unidentified],
    ) -> tuple[Identification | Unidentified | None, set[str]] | None:
        """The next effect, or generic; None when nothing passes. Second: keys that are out of the race from now on."""
        components = without_lines(by_key(found))
        need = {
            key: self.threshold + form_error(several, [*self.expected, *chosen], share=FORM)
            for key, several in components.items()
        }
        for key in [
            key
            for key in components
            if not key.startswith("~") and sum_evidence(components[key]) > need[key]
        ]:
            components[key] = is_physical(components[key], state, error=need[key] - self.threshold)
        ranked = sorted(components, key=lambda key: -sum_evidence(components[key]))
        passing = [key for key in ranked if sum_evidence(components[key]) > need[key]]
        odd = [
            key
            for key in passing
            if components[key][0].candidate.statistic == "marks" and not key.startswith("~")
        ]
        shared = [
            key for key in passing if sum_evidence(_witnessed(components[key], state)) > need[key]
        ]
        # odd samples first: they raise powers and means too, and not the other way round; then
        # motion that another sensor sees as well
        hops = identify_switching(
            passing, components, state
        )  # what hops within blocks has a spectrum, tails and a level of the noise that changes
        odd = (
            [] if hops and passing.index(hops[0]) < min(map(passing.index, odd), default=0) else odd
        )
        passing = (
            odd
            or shared
            or hops
            or without_slopes(
                self._without_locked_lines(passing, components, state),
                components,
                state,
                self.folds,
            )
        )
        passing = followed_first(passing, components, state)
        if not passing:
            return None
        top = sum_evidence(components[passing[0]])
        rivals = [
            key
            for key in passing
            if not key.startswith("~")
            and sum_evidence(components[key]) >= top - AMBIGUOUS - FORM * top
        ]
        effects = {components[key][0].candidate.effect for key in rivals}
        later = {
            key: self._lonely(components[key])
            or find_plainer_effect(components[key], state) in effects
            for key in rivals
        }
        rivals.sort(key=lambda key: -sum_evidence(components[key]) + AMBIGUOUS * later[key])
        rejected: set[str] = set()
        for key in rivals:
            passed, p_value = passes_time_shift_test(components[key], state, self.folds)
            if not passed:
                rejected.add(key)
                continue
            close = [
                one
                for one in rivals
                if one != key
                and one not in rejected
                and sum_evidence(components[one]) >= sum_evidence(components[key]) - AMBIGUOUS
            ]
            return self._claim(
                components[key],
                need[key],
                [components[one][0].candidate.effect for one in close],
                p_value,
            ), rejected
        if rejected:
            return None, rejected
        generic = passing[0]
        near = [components[one][0].candidate.effect for one in passing if not one.startswith("~")][
            :3
        ]
        return find_unidentified(generic, components[generic], need[generic], near), set()

    def _without_locked_lines(
        self, passing: list[str], components: dict[str, list[Component]], state: State
    ) -> list[str]:
        """Keys without a line that is locked to a channel: what is locked makes lines, at frequencies of its own."""
        locked = [key for key in passing if components[key][0].candidate.statistic in _LOCKED]
        lines = [key for key in passing if components[key][0].candidate.statistic == "line"]
        taken = [
            mask
            for key in locked
            if lines
            for mask in condition_on(state, components[key]).given.get(("line", "all"), [])
        ]
        return [
            key
            for key in passing
            if key not in lines or not any(mask[components[key][0].place] for mask in taken)
        ]

    def _lonely(self, components: Sequence[Component]) -> bool:
        """An effect that should be one process on all axes, and shows on a single one."""
        key = components[0].candidate.key
        coherent = any(one.key == key and one.statistic == "cross" for one in self.candidates)
        return coherent and len({axis for component in components for axis in component.row}) == 1

    def _claim(
        self, components: list[Component], threshold: float, names: Sequence[str], p_value: float
    ) -> Identification:
        first = components[0].candidate
        axes = axes_of(components, list(map(str, self.folds.attrs.get("axes", ()))))
        others = tuple(dict.fromkeys(name for name in names if name != first.effect))
        return Identification(
            first.effect,
            first.driver,
            axes,
            tuple(components),
            sum_evidence(components),
            threshold,
            others,
            p_value,
        )

    def _with(
        self,
        start: State,
        chosen: Sequence[Identification | Unidentified],
        without: Identification | Unidentified | None = None,
    ) -> State:
        state, waiting = start, False
        for one in (one for one in chosen if one is not without):
            if lines_only(
                one.components
            ):  # what they add to the powers is fitted once for all of a comb
                state, waiting = condition_on_components(state, one.components), True
                continue
            state = condition_on(refit_weights(state) if waiting else state, list(one.components))
            waiting = False
        return refit_weights(state) if waiting else state

    def _pruned(
        self, start: State, chosen: list[Identification | Unidentified]
    ) -> list[Identification | Unidentified]:
        """Without what no longer passes when the others are in, the weakest first; and claims only on axes that still show them."""
        for one in sorted(
            chosen, key=lambda one: (isinstance(one, Identification), one.evidence_nats)
        ):  # what has no name the first
            if len(chosen) < 2:
                break
            state = self._with(start, chosen, one)
            again = by_key(
                compute_evidence(
                    tried_again(one.components),
                    state.blocks,
                    state,
                    self.folds,
                    count_evidence=self.count_evidence,
                )
            )
            leading = (
                one is chosen[0]
                and isinstance(one, Identification)
                and one.components[0].candidate.statistic != "marks"
            )  # odd samples come first
            if (
                not leading
                and max((sum_evidence(components) for components in again.values()), default=0.0)
                < self.threshold
            ):
                chosen = [other for other in chosen if other is not one]
            elif isinstance(one, Identification):
                chosen = [with_axes_of(one, again) if other is one else other for other in chosen]
        return chosen

    def _settled(
        self, start: State, chosen: list[Identification | Unidentified]
    ) -> tuple[list[Identification | Unidentified], list[Identification]]:
        """What is chosen, and its claims with their last gains; without those that beside the others no longer reach their threshold."""
        while True:
            identified = {
                place: self._finished(start, one, chosen)
                for place, one in enumerate(chosen)
                if isinstance(one, Identification)
            }
            spare = {
                place: one.evidence_nats - self._needed(one, identified)
                for place, one in identified.items()
            }
            weak = min(spare, key=lambda place: spare[place], default=None)
            if weak is None or spare[weak] >= 0.0:
                return chosen, list(identified.values())
            chosen = [*chosen[:weak], *chosen[weak + 1 :]]

    def _needed(
        self, identification: Identification, identified: dict[int, Identification]
    ) -> float:
        """What a claim must gain beside the others, whichever was named first."""
        others = [
            *self.expected,
            *(one for one in identified.values() if one is not identification),
        ]
        return max(
            identification.threshold,
            self.threshold + form_error(identification.components, others, share=FORM),
        )

    def _finished(
        self,
        start: State,
        identification: Identification,
        chosen: Sequence[Identification | Unidentified],
    ) -> Identification:
        """The claim with its gain and its rivals when all the others are in the model."""
        state = self._with(start, chosen, identification)
        weight = condition_on(state, list(identification.components)).weight
        statistics = {component.candidate.statistic for component in identification.components}
        near = [one for one in self.candidates if one.statistic in statistics]
        components = by_key(
            compute_evidence(
                near,
                state.blocks,
                replace(state, weight=weight),
                self.folds,
                count_evidence=self.count_evidence,
            )
        )
        axes = set(identification.axes)
        mine = {
            key: [one for one in several if set(one.row) & axes]
            for key, several in components.items()
        }
        key = identification.components[0].candidate.key
        again = found_again(
            identification.components, mine.get(key, []), replace(state, weight=weight), self._of
        )
        evidence_nats = (
            sum(max(sum_evidence(one), 0.0) for one in again) or identification.evidence_nats
        )
        rivals = [
            several[0].candidate.effect
            for other, several in mine.items()
            if several
            and other != key
            and not other.startswith("~")
            and sum_evidence(several) >= evidence_nats - AMBIGUOUS
            and sum_evidence(is_physical(several, state)) >= evidence_nats - AMBIGUOUS
        ]
        lines = {
            component.place
            for other in chosen
            for component in other.components
            if component.candidate.effect == PLAIN_LINE
        }
        rivals += find_equivalent_effects(
            identification.effect, identification.components, state, lines=len(lines)
        )
        others = tuple(
            dict.fromkeys(
                name
                for name in [*identification.alternatives, *rivals]
                if name != identification.effect
            )
        )
        fresh = [
            renewed(found, component)
            for layer, found in zip(layers(identification.components), again, strict=True)
            for component in layer
        ]
        return replace(
            identification,
            evidence_nats=evidence_nats,
            alternatives=others,
            components=tuple(fresh),
        )

    def _complete(
        self,
        start: State,
        state: State,
        identified: list[Identification],
        unknown: Sequence[Unidentified],
    ) -> tuple[list[Identification], list[Unidentified]]:
        """Names are withdrawn where, with them in the model, means are still redder than calibrated, or powers still restless."""
        kept, withdrawn = list(identified), []
        for axis in state.axes:
            named = _on(kept, "mean", axis)
            part_of = _of_a_drift(named, unknown, axis)
            kept = [one for one in kept if one not in part_of]
            if any(
                one.generic in ("~bias(t)", "~S(f)", "~cov") and axis in one.axes for one in unknown
            ):
                continue
            if any(
                component.candidate.effect in _SHAPES and axis in component.row
                for one in kept
                for component in one.components
            ):
                continue  # the white variance of the means is not what the calibration took it for
            red = excess_low_frequency_noise(flexible(state, named, axis), axis, self.folds)
            weak, strength = _weak(named, red)
            if weak or red > self.threshold + FORM * strength:
                kept = [one for one in kept if one not in weak]
                withdrawn.append(
                    Unidentified(
                        "~red", (axis,), red, self.threshold, tuple(one.effect for one in weak)
                    )
                )
        for axis in state.axes:
            weak, _ = (
                _weak(_on(kept, "power", axis), variance_fluctuation(self._with(start, kept), axis))
                if _on(kept, "power", axis)
                else ([], 0.0)
            )
            if weak:
                kept = [one for one in kept if one not in weak]
                withdrawn += self._restless(self._with(start, [*kept, *unknown]), axis, weak)
        return kept, withdrawn

    def _restless(
        self, state: State, axis: str, weak: Sequence[Identification]
    ) -> list[Unidentified]:
        """What a free course of the noise explains on an axis, in place of names that do not."""
        free = [one for one in self.candidates if one.effect == "~N(t)"]
        components = by_key(compute_evidence(free, state.blocks, state, self.folds)).get(
            "~N(t)", []
        )
        mine = [
            component
            for component in components
            if component.row == (axis,) and component.evidence_nats > self.threshold
        ]
        return (
            [find_unidentified("~N(t)", mine, self.threshold, [one.effect for one in weak])]
            if mine
            else []
        )


def _on(identified: Sequence[Identification], statistic: str, axis: str) -> list[Identification]:
    return [
        one
        for one in identified
        if any(
            component.candidate.statistic == statistic and component.row == (axis,)
            for component in one.components
        )
    ]


def _of_a_drift(
    named: Sequence[Identification], unknown: Sequence[Unidentified], axis: str
) -> list[Identification]:
    """Claims that a drift of no name on the same axis makes doubtful: no channel tells of them, and it brings more than they do."""
    drift = sum(
        one.evidence_nats for one in unknown if one.generic == "~bias(t)" and axis in one.axes
    )
    return [one for one in named if not any(one.driver) and one.evidence_nats < drift]


def _weak(named: Sequence[Identification], left: float) -> tuple[list[Identification], float]:
    """Claims that do not do enough beside what they leave [nats], and what all of them gain."""
    strength = sum(one.evidence_nats for one in named)
    return [
        one for one in named if left > max(_LEFT + FORM * strength, 0.1 * one.evidence_nats)
    ], strength


def _witnessed(components: Sequence[Component], state: State) -> list[Component]:
    """Parts that a channel sees as well, which is no axis of the gyro itself."""
    return [
        component
        for component in components
        if component.candidate.statistic == "transfer"
        and component.candidate.witness[0] not in state.axes
    ]

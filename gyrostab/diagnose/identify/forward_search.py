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
from gyrostab.diagnose.evidence.sample_counts import Expected
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
    reweighted,
)
from gyrostab.diagnose.predict.linear_model import State, begin_state
from gyrostab.diagnose.predict.nuisance import nuisance_alternatives
from gyrostab.diagnose.predict.search import (
    CountEvidence,
    Found,
    compute_evidence,
    of_means,
    totals,
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
    reduced: xr.Dataset,
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
    reduced : xarray.Dataset
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
    folds = fold_blocks(reduced)
    tried, reasons = effect_candidates(reduced, baseline["coefficient"])
    candidates = [*tried, *nuisance_alternatives(reduced)]
    state = begin_state(reduced, baseline)
    best, tallies = _null_best(
        candidates, nulls, state, folds, np.random.default_rng(seed), progress
    )
    if not tallies.rounded.any() and (reduced["lattice"] > 0.0).any():
        reasons |= {
            "rate_quantization": "not identifiable: the lattice of values is that of angles, or too fine to show"
        }
    expected, state = identify_expected_effects(
        known,
        tried,
        state,
        lambda some, now: compute_evidence(some, now.reduced, now, folds, tallies=tallies),
    )
    search = _Search(candidates, folds, tallies, tail_level(best, level), tuple(expected))
    claims, unknown, state = search.run(state)
    return Identifications(
        tuple(claims),
        tuple(unknown),
        search.threshold,
        best,
        reasons,
        tuple(candidates),
        state,
        folds,
        tallies,
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
    expected = Expected()
    linear = [one for one in candidates if one.view != "marks"]
    marks = [one for one in candidates if one.view == "marks"]
    sums: list[dict[str, Array]] = []
    kept: list[xr.Dataset] = []
    records = 0
    for chunk in nulls:
        expected.add(chunk)
        sums.append(totals(compute_evidence(linear, chunk, state, folds, rng=rng)))
        kept.append(chunk[[name for name in expected.sums if name in chunk]])
        records += chunk.sizes["record"]
        progress("naming", 0, records)
    if records < _LEAST_NULLS:
        raise OptionError(
            f"{records} null records are too few to tell how often noise alone does as much; give nulls=400"
        )
    tallies = CountEvidence.gathered(expected, rounded_rates(state.reduced, state.baseline))
    best = []
    for total, chunk in zip(sums, kept, strict=True):
        counted = totals(compute_evidence(marks, chunk, state, folds, tallies=tallies))
        keys = {*total, *counted}
        nothing = np.zeros(chunk.sizes["record"])
        best.append(
            np.max([total.get(key, nothing) + counted.get(key, nothing) for key in keys], axis=0)
        )
    return np.sort(np.concatenate(best)), tallies


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
    tallies: CountEvidence
    threshold: float
    expected: tuple[Identification, ...] = ()

    def run(self, start: State) -> tuple[list[Identification], list[Unidentified], State]:
        """Name one effect after the other, look again at each with the others in, and see what is left."""
        chosen: list[Identification | Unidentified] = []
        state = start
        barred = {
            key
            for one in self.expected
            for key in (one.parts[0].candidate.key, *self._counted(one))
        }
        rounds, lines = _ROUNDS, _LINES
        found: list[Found] = []
        before = start
        while rounds and lines:
            found, before = self._ranked(state, barred, of_means(found, before, state)), state
            pick = self._pick(found, state, chosen)
            if pick is None:
                break
            one, rejected = pick
            barred |= rejected
            line = one is not None and lines_only(one.parts)
            rounds, lines = rounds - (not line), lines - line
            if one is not None:
                chosen = add_identification(chosen, one)
                barred |= self._counted(one)
                state = condition_on(state, list(one.parts))
        chosen = hops_alone(chosen, lambda some: self._with(start, some), self._of, self.threshold)
        chosen = self._pruned(start, without_pulses(chosen))
        chosen, claims = self._settled(start, chosen)
        unknown = [one for one in chosen if isinstance(one, Unidentified)]
        state = self._with(start, [*claims, *unknown])
        kept, withdrawn = self._complete(start, state, claims, unknown)
        unknown += withdrawn
        same = len(kept) == len(claims) and not withdrawn
        return (
            sorted(kept, key=lambda one: -one.gain),
            unknown,
            state if same else self._with(start, [*kept, *unknown]),
        )

    def _counted(self, one: Identification | Unidentified) -> set[str]:
        """Keys that stand for counts which are explained now: there is nothing to take out of a count."""
        if any(part.candidate.effect in ("logger_filter", "~S(f)") for part in one.parts):
            return {"~outliers"}  # the kurtosis of a block is that of other noise
        if not any(part.candidate.view == "marks" for part in one.parts):
            return set()
        marks = {mark for part in one.parts for mark in part.variant.columns} | {"kurtosis"}
        marks |= _OF_ZEROS if marks & _OF_ZEROS else set()
        return {
            other.key
            for other in self.candidates
            if other.view == "marks" and marks & set(other.marks)
        }

    def _of(self, candidates: Sequence[Candidate], state: State) -> list[Found]:
        return compute_evidence(candidates, state.reduced, state, self.folds, tallies=self.tallies)

    def _ranked(self, state: State, barred: set[str], known: Sequence[Found] = ()) -> list[Found]:
        """Gains of all that is not barred, with weights that suit the best in the powers: what is loud is loud in every view.

        Those that are known are not sought again.
        """
        there = {id(one.candidate) for one in known}
        sought = [one for one in self.candidates if one.key not in barred and id(one) not in there]
        found = [
            *(one for one in known if one.candidate.key not in barred),
            *self._of(sought, state),
        ]
        weighed = [one.candidate for one in found if one.candidate.view in _WEIGHED]
        for _ in range(2):
            powers = [one for one in found if one.candidate.view == "power"]
            strong = max(
                powers, key=lambda one: float(np.maximum(one.gain[0], 0.0).sum()), default=None
            )
            if strong is None or np.maximum(strong.gain[0], 0.0).sum() < 3.0 * self.threshold:
                break
            trial = condition_on(state, find_components(strong))
            again = compute_evidence(
                weighed, state.reduced, replace(state, weight=trial.weight), self.folds
            )
            found = [one for one in found if one.candidate.view not in _WEIGHED] + again
        return found

    def _pick(
        self, found: list[Found], state: State, chosen: Sequence[Identification | Unidentified]
    ) -> tuple[Identification | Unidentified | None, set[str]] | None:
        """The next effect, or generic; None when nothing passes. Second: keys that are out of the race from now on."""
        parts = without_lines(by_key(found))
        need = {
            key: self.threshold + form_error(several, [*self.expected, *chosen], share=FORM)
            for key, several in parts.items()
        }
        for key in [
            key for key in parts if not key.startswith("~") and sum_evidence(parts[key]) > need[key]
        ]:
            parts[key] = is_physical(parts[key], state, error=need[key] - self.threshold)
        ranked = sorted(parts, key=lambda key: -sum_evidence(parts[key]))
        passing = [key for key in ranked if sum_evidence(parts[key]) > need[key]]
        odd = [
            key
            for key in passing
            if parts[key][0].candidate.view == "marks" and not key.startswith("~")
        ]
        shared = [key for key in passing if sum_evidence(_witnessed(parts[key], state)) > need[key]]
        # odd samples first: they raise powers and means too, and not the other way round; then
        # motion that another sensor sees as well
        hops = identify_switching(
            passing, parts, state
        )  # what hops within blocks has a spectrum, tails and a level of the noise that changes
        odd = (
            [] if hops and passing.index(hops[0]) < min(map(passing.index, odd), default=0) else odd
        )
        passing = (
            odd
            or shared
            or hops
            or without_slopes(
                self._without_locked_lines(passing, parts, state), parts, state, self.folds
            )
        )
        passing = followed_first(passing, parts, state)
        if not passing:
            return None
        top = sum_evidence(parts[passing[0]])
        rivals = [
            key
            for key in passing
            if not key.startswith("~") and sum_evidence(parts[key]) >= top - AMBIGUOUS - FORM * top
        ]
        effects = {parts[key][0].candidate.effect for key in rivals}
        later = {
            key: self._lonely(parts[key]) or find_plainer_effect(parts[key], state) in effects
            for key in rivals
        }
        rivals.sort(key=lambda key: -sum_evidence(parts[key]) + AMBIGUOUS * later[key])
        rejected: set[str] = set()
        for key in rivals:
            passed, p_value = passes_time_shift_test(parts[key], state, self.folds)
            if not passed:
                rejected.add(key)
                continue
            close = [
                one
                for one in rivals
                if one != key
                and one not in rejected
                and sum_evidence(parts[one]) >= sum_evidence(parts[key]) - AMBIGUOUS
            ]
            return self._claim(
                parts[key], need[key], [parts[one][0].candidate.effect for one in close], p_value
            ), rejected
        if rejected:
            return None, rejected
        generic = passing[0]
        near = [parts[one][0].candidate.effect for one in passing if not one.startswith("~")][:3]
        return find_unidentified(generic, parts[generic], need[generic], near), set()

    def _without_locked_lines(
        self, passing: list[str], parts: dict[str, list[Component]], state: State
    ) -> list[str]:
        """Keys without a line that is locked to a channel: what is locked makes lines, at frequencies of its own."""
        locked = [key for key in passing if parts[key][0].candidate.view in _LOCKED]
        lines = [key for key in passing if parts[key][0].candidate.view == "line"]
        taken = [
            mask
            for key in locked
            if lines
            for mask in condition_on(state, parts[key]).given.get(("line", "all"), [])
        ]
        return [
            key
            for key in passing
            if key not in lines or not any(mask[parts[key][0].place] for mask in taken)
        ]

    def _lonely(self, parts: Sequence[Component]) -> bool:
        """An effect that should be one process on all axes, and shows on a single one."""
        key = parts[0].candidate.key
        coherent = any(one.key == key and one.view == "cross" for one in self.candidates)
        return coherent and len({axis for part in parts for axis in part.row}) == 1

    def _claim(
        self, parts: list[Component], threshold: float, names: Sequence[str], p_value: float
    ) -> Identification:
        first = parts[0].candidate
        axes = axes_of(parts, list(map(str, self.folds.attrs.get("axes", ()))))
        others = tuple(dict.fromkeys(name for name in names if name != first.effect))
        return Identification(
            first.effect,
            first.driver,
            axes,
            tuple(parts),
            sum_evidence(parts),
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
                one.parts
            ):  # what they add to the powers is fitted once for all of a comb
                state, waiting = condition_on_components(state, one.parts), True
                continue
            state = condition_on(reweighted(state) if waiting else state, list(one.parts))
            waiting = False
        return reweighted(state) if waiting else state

    def _pruned(
        self, start: State, chosen: list[Identification | Unidentified]
    ) -> list[Identification | Unidentified]:
        """Without what no longer passes when the others are in, the weakest first; and claims only on axes that still show them."""
        for one in sorted(
            chosen, key=lambda one: (isinstance(one, Identification), one.gain)
        ):  # what has no name the first
            if len(chosen) < 2:
                break
            state = self._with(start, chosen, one)
            again = by_key(
                compute_evidence(
                    tried_again(one.parts), state.reduced, state, self.folds, tallies=self.tallies
                )
            )
            leading = (
                one is chosen[0]
                and isinstance(one, Identification)
                and one.parts[0].candidate.view != "marks"
            )  # odd samples come first
            if (
                not leading
                and max((sum_evidence(parts) for parts in again.values()), default=0.0)
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
            claims = {
                place: self._finished(start, one, chosen)
                for place, one in enumerate(chosen)
                if isinstance(one, Identification)
            }
            spare = {place: one.gain - self._needed(one, claims) for place, one in claims.items()}
            weak = min(spare, key=lambda place: spare[place], default=None)
            if weak is None or spare[weak] >= 0.0:
                return chosen, list(claims.values())
            chosen = [*chosen[:weak], *chosen[weak + 1 :]]

    def _needed(self, claim: Identification, claims: dict[int, Identification]) -> float:
        """What a claim must gain beside the others, whichever was named first."""
        others = [*self.expected, *(one for one in claims.values() if one is not claim)]
        return max(claim.threshold, self.threshold + form_error(claim.parts, others, share=FORM))

    def _finished(
        self, start: State, claim: Identification, chosen: Sequence[Identification | Unidentified]
    ) -> Identification:
        """The claim with its gain and its rivals when all the others are in the model."""
        state = self._with(start, chosen, claim)
        weight = condition_on(state, list(claim.parts)).weight
        views = {part.candidate.view for part in claim.parts}
        near = [one for one in self.candidates if one.view in views]
        parts = by_key(
            compute_evidence(
                near, state.reduced, replace(state, weight=weight), self.folds, tallies=self.tallies
            )
        )
        axes = set(claim.axes)
        mine = {
            key: [one for one in several if set(one.row) & axes] for key, several in parts.items()
        }
        key = claim.parts[0].candidate.key
        again = found_again(claim.parts, mine.get(key, []), replace(state, weight=weight), self._of)
        gain = sum(max(sum_evidence(one), 0.0) for one in again) or claim.gain
        rivals = [
            several[0].candidate.effect
            for other, several in mine.items()
            if several
            and other != key
            and not other.startswith("~")
            and sum_evidence(several) >= gain - AMBIGUOUS
            and sum_evidence(is_physical(several, state)) >= gain - AMBIGUOUS
        ]
        lines = {
            part.place
            for other in chosen
            for part in other.parts
            if part.candidate.effect == PLAIN_LINE
        }
        rivals += find_equivalent_effects(claim.effect, claim.parts, state, lines=len(lines))
        others = tuple(
            dict.fromkeys(name for name in [*claim.alternatives, *rivals] if name != claim.effect)
        )
        fresh = [
            renewed(found, part)
            for layer, found in zip(layers(claim.parts), again, strict=True)
            for part in layer
        ]
        return replace(claim, gain=gain, alternatives=others, parts=tuple(fresh))

    def _complete(
        self,
        start: State,
        state: State,
        claims: list[Identification],
        unknown: Sequence[Unidentified],
    ) -> tuple[list[Identification], list[Unidentified]]:
        """Names are withdrawn where, with them in the model, means are still redder than calibrated, or powers still restless."""
        kept, withdrawn = list(claims), []
        for axis in state.axes:
            named = _on(kept, "mean", axis)
            part_of = _of_a_drift(named, unknown, axis)
            kept = [one for one in kept if one not in part_of]
            if any(
                one.generic in ("~bias(t)", "~S(f)", "~cov") and axis in one.axes for one in unknown
            ):
                continue
            if any(
                part.candidate.effect in _SHAPES and axis in part.row
                for one in kept
                for part in one.parts
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
        parts = by_key(compute_evidence(free, state.reduced, state, self.folds)).get("~N(t)", [])
        mine = [part for part in parts if part.row == (axis,) and part.gain > self.threshold]
        return (
            [find_unidentified("~N(t)", mine, self.threshold, [one.effect for one in weak])]
            if mine
            else []
        )


def _on(claims: Sequence[Identification], view: str, axis: str) -> list[Identification]:
    return [
        one
        for one in claims
        if any(part.candidate.view == view and part.row == (axis,) for part in one.parts)
    ]


def _of_a_drift(
    named: Sequence[Identification], unknown: Sequence[Unidentified], axis: str
) -> list[Identification]:
    """Claims that a drift of no name on the same axis makes doubtful: no channel tells of them, and it brings more than they do."""
    drift = sum(one.gain for one in unknown if one.generic == "~bias(t)" and axis in one.axes)
    return [one for one in named if not any(one.driver) and one.gain < drift]


def _weak(named: Sequence[Identification], left: float) -> tuple[list[Identification], float]:
    """Claims that do not do enough beside what they leave [nats], and what all of them gain."""
    strength = sum(one.gain for one in named)
    return [one for one in named if left > max(_LEFT + FORM * strength, 0.1 * one.gain)], strength


def _witnessed(parts: Sequence[Component], state: State) -> list[Component]:
    """Parts that a channel sees as well, which is no axis of the gyro itself."""
    return [
        part
        for part in parts
        if part.candidate.view == "transfer" and part.candidate.witness[0] not in state.axes
    ]

"""Name the physics: forward selection of effects by what they explain on held-out time, against thresholds from null records."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.candidates import Candidate, effect_candidates
from gyrostab.diagnose.cells import State, begin_state
from gyrostab.diagnose.claims import Claim, Naming, Unknown
from gyrostab.diagnose.explained import Part, explain_away, mean_columns
from gyrostab.diagnose.folds import fold_blocks
from gyrostab.diagnose.gain import mean_factors
from gyrostab.diagnose.generics import generic_candidates
from gyrostab.diagnose.search import Found, Tallies, gains, together, totals
from gyrostab.diagnose.sizes import mean_mixture
from gyrostab.diagnose.structure import allowed, structural
from gyrostab.diagnose.surrogates import beats_slides
from gyrostab.diagnose.tallies import Expected
from gyrostab.errors import OptionError
from gyrostab.noise import HOUR
from gyrostab.progress import Stage, no_stage

__all__ = ["Claim", "Naming", "Unknown", "name_effects", "tail_level"]

Array = NDArray[np.float64]
#: An effect that comes this close to the one named may be meant as well [nats].
AMBIGUOUS = 3.0
#: Of the gain of what is named, what an error of its form may leave: 10 % of its size.
FORM = 0.01
_ROW = 2.0  # nats that an axis must bring to be named with the others
_ROUNDS = 10
_LEAST_NULLS = 40
_SHAPES = ("logger_filter", "held_samples", "gauss_markov", "telegraph")
_LOCKED = ("order", "phase_locked", "transfer")
_TAIL = 0.25


def name_effects(
    reduced: xr.Dataset,
    baseline: xr.Dataset,
    nulls: Iterable[xr.Dataset],
    *,
    level: float = 0.005,
    seed: int = 0,
    progress: Stage = no_stage,
) -> Naming:
    """Name the effects that a recording shows beyond its baseline.

    Parameters
    ----------
    reduced : xarray.Dataset
        From `reduce_log`.
    baseline : xarray.Dataset
        From `gyrostab.diagnose.baseline`.
    nulls : iterable of xarray.Dataset
        Null records, some with a leading dimension ``record`` at a time.
    level : float
        Probability that noise alone gets a name, or is called unknown.
    seed : int
        Of the draws for views that the null records do not hold.
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
    known, reasons = effect_candidates(reduced, baseline["coefficient"])
    candidates = [*known, *generic_candidates(reduced)]
    state = begin_state(reduced, baseline)
    best, tallies = _null_best(candidates, nulls, state, folds, np.random.default_rng(seed), progress)
    search = _Search(candidates, folds, tallies, tail_level(best, level))
    claims, unknown, state = search.run(state)
    return Naming(tuple(claims), tuple(unknown), search.threshold, best, reasons, tuple(candidates), state, folds, tallies)


def _null_best(
    candidates: Sequence[Candidate],
    nulls: Iterable[xr.Dataset],
    state: State,
    folds: xr.DataArray,
    rng: np.random.Generator,
    progress: Stage,
) -> tuple[Array, Tallies]:
    """Largest gain of any effect in each null record; and what the records say of counts."""
    expected = Expected()
    linear = [one for one in candidates if one.view != "marks"]
    marks = [one for one in candidates if one.view == "marks"]
    sums: list[dict[str, Array]] = []
    kept: list[xr.Dataset] = []
    records = 0
    for chunk in nulls:
        expected.add(chunk)
        sums.append(totals(gains(linear, chunk, state, folds, rng=rng)))
        kept.append(chunk[[name for name in expected.sums if name in chunk]])
        records += chunk.sizes["record"]
        progress("naming", 0, records)
    if records < _LEAST_NULLS:
        raise OptionError(f"{records} null records are too few to tell how often noise alone does as much; give nulls=400")
    tallies = Tallies.gathered(expected)
    best = []
    for total, chunk in zip(sums, kept, strict=True):
        counted = totals(gains(marks, chunk, state, folds, tallies=tallies))
        keys = {*total, *counted}
        nothing = np.zeros(chunk.sizes["record"])
        best.append(np.max([total.get(key, nothing) + counted.get(key, nothing) for key in keys], axis=0))
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
    return start + scale * math.log(_TAIL / level) if level < _TAIL else float(np.quantile(best, 1.0 - level))


@dataclass(frozen=True)
class _Search:
    """Forward selection over the candidates."""

    candidates: Sequence[Candidate]
    folds: xr.DataArray
    tallies: Tallies
    threshold: float

    def run(self, start: State) -> tuple[list[Claim], list[Unknown], State]:
        """Name one effect after the other, look again at each with the others in, and see what is left."""
        chosen: list[Claim | Unknown] = []
        state = start
        barred: set[str] = set()
        for _ in range(_ROUNDS):
            found = self._ranked(state, barred)
            pick = self._pick(found, state, chosen)
            if pick is None:
                break
            one, rejected = pick
            barred |= rejected
            if one is not None:
                chosen = _merged(chosen, one)
                barred |= self._counted(one)
                state = explain_away(state, list(one.parts))
        chosen = self._pruned(start, chosen)
        claims = [self._finished(start, one, chosen) for one in chosen if isinstance(one, Claim)]
        unknown = [one for one in chosen if isinstance(one, Unknown)]
        state = self._with(start, [*claims, *unknown])
        claims, withdrawn = self._complete(state, claims, unknown)
        return sorted(claims, key=lambda one: -one.gain), [*unknown, *withdrawn], state

    def _counted(self, one: Claim | Unknown) -> set[str]:
        """Keys that stand for counts which are explained now: there is nothing to take out of a count."""
        if any(part.candidate.effect in ("logger_filter", "~S(f)") for part in one.parts):
            return {"~outliers"}  # the kurtosis of a block is that of other noise
        if not any(part.candidate.view == "marks" for part in one.parts):
            return set()
        marks = {mark for part in one.parts for mark in part.candidate.marks} | {"kurtosis"}
        return {other.key for other in self.candidates if other.view == "marks" and marks & set(other.marks)}

    def _gains(self, state: State) -> list[Found]:
        return gains(self.candidates, state.reduced, state, self.folds, tallies=self.tallies)

    def _ranked(self, state: State, barred: set[str]) -> list[Found]:
        """Gains of all that is not barred, with weights that suit the best in the powers."""
        found = [one for one in self._gains(state) if one.candidate.key not in barred]
        for _ in range(2):
            powers = [one for one in found if one.candidate.view == "power"]
            strong = max(powers, key=lambda one: float(np.maximum(one.gain[0], 0.0).sum()), default=None)
            if strong is None or np.maximum(strong.gain[0], 0.0).sum() < 3.0 * self.threshold:
                break
            trial = explain_away(state, _parts(strong))
            again = gains([one.candidate for one in powers], state.reduced, replace(state, weight=trial.weight), self.folds)
            found = [one for one in found if one.candidate.view != "power"] + again
        return found

    def _pick(self, found: list[Found], state: State, chosen: Sequence[Claim | Unknown]) -> tuple[Claim | Unknown | None, set[str]] | None:
        """The next effect, or generic; None when nothing passes. Second: keys that are out of the race from now on."""
        parts = _by_key(found)
        need = {key: self.threshold + _form_error(several, chosen) for key, several in parts.items()}
        ranked = sorted(parts, key=lambda key: -_sum(parts[key]))
        passing = [key for key in ranked if _sum(parts[key]) > need[key]]
        odd = [key for key in passing if parts[key][0].candidate.view == "marks" and not key.startswith("~")]
        passing = odd or passing  # odd samples first: they raise powers and means too, and not the other way round
        if any(parts[key][0].candidate.view in _LOCKED for key in passing):
            passing = [key for key in passing if parts[key][0].candidate.view != "line"]  # what is locked to a channel makes lines
        if not passing:
            return None
        top = _sum(parts[passing[0]])
        rivals = [key for key in passing if not key.startswith("~") and _sum(parts[key]) >= top - AMBIGUOUS - FORM * top]
        rivals.sort(key=lambda key: -_sum(parts[key]) + AMBIGUOUS * self._lonely(parts[key]))
        rejected: set[str] = set()
        for key in rivals:
            effect = parts[key][0].candidate.effect
            if not allowed(effect, parts[key], state):
                rejected.add(key)
                continue
            passed, p_value = beats_slides(parts[key], state, self.folds)
            if not passed:
                rejected.add(key)
                continue
            close = [one for one in rivals if one != key and one not in rejected and _sum(parts[one]) >= _sum(parts[key]) - AMBIGUOUS]
            names = [parts[one][0].candidate.effect for one in close if allowed(parts[one][0].candidate.effect, parts[one], state)]
            return self._claim(parts[key], need[key], names, p_value), rejected
        if rejected:
            return None, rejected
        generic = passing[0]
        near = [parts[one][0].candidate.effect for one in passing if not one.startswith("~")][:3]
        return _unknown(generic, parts[generic], need[generic], near), set()

    def _lonely(self, parts: Sequence[Part]) -> bool:
        """An effect that should be one process on all axes, and shows on a single one."""
        key = parts[0].candidate.key
        coherent = any(one.key == key and one.view == "cross" for one in self.candidates)
        return coherent and len({axis for part in parts for axis in part.row}) == 1

    def _claim(self, parts: list[Part], threshold: float, names: Sequence[str], p_value: float) -> Claim:
        first = parts[0].candidate
        axes = _axes(parts, list(map(str, self.folds.attrs.get("axes", ()))))
        others = tuple(dict.fromkeys(name for name in names if name != first.effect))
        return Claim(first.effect, first.driver, axes, tuple(parts), _sum(parts), threshold, others, p_value)

    def _with(self, start: State, chosen: Sequence[Claim | Unknown], without: Claim | Unknown | None = None) -> State:
        state = start
        for one in chosen:
            if one is not without:
                state = explain_away(state, list(one.parts))
        return state

    def _pruned(self, start: State, chosen: list[Claim | Unknown]) -> list[Claim | Unknown]:
        """Without what no longer passes when the others are in, the weakest first."""
        for one in sorted(chosen, key=lambda one: one.gain):
            if len(chosen) < 2 or one is chosen[0]:
                continue
            state = self._with(start, chosen, one)
            again = _by_key(gains(_only(one.parts), state.reduced, state, self.folds, tallies=self.tallies))
            if max((_sum(parts) for parts in again.values()), default=0.0) < self.threshold:
                chosen = [other for other in chosen if other is not one]
        return chosen

    def _finished(self, start: State, claim: Claim, chosen: Sequence[Claim | Unknown]) -> Claim:
        """The claim with its gain and its rivals when all the others are in the model."""
        state = self._with(start, chosen, claim)
        weight = explain_away(state, list(claim.parts)).weight
        views = {part.candidate.view for part in claim.parts}
        near = [one for one in self.candidates if one.view in views]
        parts = _by_key(gains(near, state.reduced, replace(state, weight=weight), self.folds, tallies=self.tallies))
        axes = set(claim.axes)
        mine = {key: [one for one in several if set(one.row) & axes] for key, several in parts.items()}
        key = claim.parts[0].candidate.key
        gain = _sum(mine.get(key, [])) or claim.gain
        rivals = [
            several[0].candidate.effect
            for other, several in mine.items()
            if several
            and other != key
            and not other.startswith("~")
            and _sum(several) >= gain - AMBIGUOUS
            and allowed(several[0].candidate.effect, several, state)
        ]
        rivals += structural(claim.effect, claim.parts, state, {one.candidate.effect for several in parts.values() for one in several})
        others = tuple(dict.fromkeys(name for name in [*claim.alternatives, *rivals] if name != claim.effect))
        fresh = tuple(replace(part, gain=_gain_of(mine.get(key, []), part)) for part in claim.parts)
        return replace(claim, gain=gain, alternatives=others, parts=fresh)

    def _flexible(self, state: State, claims: Sequence[Claim], axis: str) -> State:
        """The state with the next points of the nuisance grids beside those named: a time constant lies between two of them."""
        row = state.axes.index(axis)
        for part in (part for one in claims for part in one.parts if part.candidate.view == "mean" and part.row == (axis,)):
            family = [one for one in part.candidate.variants if one.columns == part.variant.columns]
            place = next(number for number, one in enumerate(family) if one is part.variant)
            for other in family[max(place - 1, 0) : place] + family[place + 1 : place + 2]:
                state = state.with_columns("mean", axis, mean_columns(other, row))
        return state

    def _complete(self, state: State, claims: list[Claim], unknown: Sequence[Unknown]) -> tuple[list[Claim], list[Unknown]]:
        """Names are withdrawn where, with them in the model, the slow noise is still redder than calibrated."""
        kept, withdrawn = list(claims), []
        for axis in state.axes:
            named = [one for one in kept if any(part.candidate.view == "mean" and part.row == (axis,) for part in one.parts)]
            if any(one.generic in ("~bias(t)", "~S(f)", "~cov") and axis in one.axes for one in unknown):
                continue
            if any(part.candidate.effect in _SHAPES and axis in part.row for one in kept for part in one.parts):
                continue  # the white variance of the means is not what the calibration took it for
            red = redness(self._flexible(state, named, axis), axis, self.folds)
            strength = sum(one.gain for one in named)
            weak = [one for one in named if red > max(2.0 + FORM * strength, 0.1 * one.gain)]
            if not weak and red <= self.threshold + FORM * strength:
                continue
            names = tuple(one.effect for one in weak)
            kept = [one for one in kept if one not in weak]
            withdrawn.append(Unknown("~red", (axis,), red, self.threshold, names))
        return kept, withdrawn


def redness(state: State, axis: str, folds: xr.DataArray) -> float:
    """What free random walk and flicker gain over the calibrated ones, with all that is named in the model [nats].

    Zero where the noise is less red than calibrated: a calibration on blocks that an effect touches takes it for noise.
    """
    given = state.given.get(("mean", axis))
    beside = np.stack(given, axis=-1) if given else None
    columns = [np.linspace(-1.0, 1.0, state.reduced.sizes["block"])] if not given else []
    evidence, strength = [], []
    span = state.reduced.sizes["block"] * float(state.reduced.attrs["block_s"])
    slow = state.baseline["grid_K"].sel(axis=axis).values ** 2 * span / HOUR + state.baseline["grid_B"].sel(axis=axis).values ** 2
    for tier in ("free", "calibrated"):
        evidence.append(mean_factors(state.reduced, state.baseline, [], axis=axis, tier=tier, given=beside, folds=folds)[0, 0, 0])
        strength.append(float(mean_mixture(state, axis, columns, tier=tier).weights() @ slow))
    return float(evidence[0] - evidence[1]) if strength[0] > strength[1] else 0.0


# ------------------------------------------------------------------------------------------------------------------ parts


def _parts(found: Found) -> list[Part]:
    """Rows of a candidate that bring something."""
    gain = found.gain[0]
    rows = [number for number in range(gain.size) if gain[number] > _ROW]
    rows = rows or [int(gain.argmax())]
    return [
        Part(
            found.candidate,
            found.best[number],
            found.rows[number],
            float(gain[number]),
            int(found.place[0, number]) if found.place.size else -1,
        )
        for number in rows
    ]


def _by_key(found: Sequence[Found]) -> dict[str, list[Part]]:
    """Parts of every effect, those that bring something, the strongest first."""
    out: dict[str, list[Part]] = {}
    for one in found:
        out.setdefault(one.candidate.key, []).extend(_parts(one))
    for key, parts in out.items():
        good = [part for part in parts if part.gain > _ROW]
        out[key] = sorted(good or parts, key=lambda part: -part.gain)
    return out


def _sum(parts: Sequence[Part]) -> float:
    return float(together(np.array([part.gain for part in parts]))) if parts else 0.0


def _gain_of(parts: Sequence[Part], like: Part) -> float:
    return next((one.gain for one in parts if one.candidate.view == like.candidate.view and one.row == like.row), like.gain)


def _only(parts: Sequence[Part]) -> list[Candidate]:
    seen: dict[tuple[str, str, tuple[str, ...]], Candidate] = {}
    for part in parts:
        seen[part.candidate.key, part.candidate.view, part.candidate.witness] = part.candidate
    return list(seen.values())


def _axes(parts: Sequence[Part], order: Sequence[str]) -> tuple[str, ...]:
    named = {axis for part in parts for axis in part.row}
    return tuple(sorted(named, key=lambda axis: (order.index(axis) if axis in order else 0, axis)))


def _form_error(parts: Sequence[Part], chosen: Sequence[Claim | Unknown]) -> float:
    """What errors of the form of what is named already may leave in the views and axes of these parts [nats]."""
    left = 0.0
    for one in chosen:
        for part in one.parts:
            if any(part.candidate.view == other.candidate.view and set(part.row) & set(other.row) for other in parts):
                left += FORM * part.gain
    return left


def _unknown(key: str, parts: list[Part], threshold: float, near: Sequence[str]) -> Unknown:
    return Unknown(key, _axes(parts, ()), _sum(parts), threshold, tuple(dict.fromkeys(near)), tuple(parts))


def _merged(chosen: list[Claim | Unknown], one: Claim | Unknown) -> list[Claim | Unknown]:
    """The list with another claim; one of the same effect and channel becomes one with it."""
    for place, other in enumerate(chosen):
        if isinstance(one, Claim) and isinstance(other, Claim) and (other.effect, other.driver) == (one.effect, one.driver):
            axes = tuple(sorted({*other.axes, *one.axes}))
            alike = tuple(dict.fromkeys([*other.alternatives, *one.alternatives]))
            both = replace(other, axes=axes, parts=(*other.parts, *one.parts), gain=other.gain + one.gain, alternatives=alike)
            return [*chosen[:place], both, *chosen[place + 1 :]]
    return [*chosen, one]

"""Order the effects that pass the threshold: the first one that passes its tests is named."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identifiability import find_plainer_effect, keep_physical
from gyrostab.diagnose.identify.selections import Selection, ambiguous_evidence, make_selection
from gyrostab.diagnose.predict.candidates import Component, is_nuisance
from gyrostab.diagnose.predict.condition import condition_on, mean_columns
from gyrostab.diagnose.predict.linear_model import State


@dataclass(frozen=True)
class SearchRound:
    """What effects and nuisance alternatives explain, with all selections so far in the model."""

    examination: Examination
    state: State
    components: dict[str, list[Component]]  # by key of the candidate, the strongest first
    required: dict[str, float]  # evidence that each of them needs [nats]
    chosen: Sequence[Selection] = ()  # so far

    def nats(self, key: str) -> float:
        """Return the evidence of an effect or alternative [nats]."""
        return sum_evidence(self.components[key])

    def order_passing(self) -> list[str]:
        """Return the keys that are to be named next, in their order; all others wait.

        Anomalous samples come first, because they raise powers and means too, and not the other
        way round. Then motion that another sensor confirms, then a bias that switches within
        blocks: its spectrum, its tails and its changing noise level would be taken for others.
        """
        ranked = sorted(self.components, key=lambda key: -self.nats(key))
        passing = [key for key in ranked if self.nats(key) > self.required[key]]
        counts = [
            key
            for key in passing
            if self.components[key][0].statistic.is_count and not is_nuisance(key)
        ]
        confirmed = [key for key in passing if self._confirmed_nats(key) > self.required[key]]
        switching = self.identify_switching(passing)
        if counts and switching and passing.index(switching[0]) < passing.index(counts[0]):
            counts = []
        first = (
            counts or confirmed or switching or self._on_other_axes(self._without_slopes(passing))
        )
        return self.drop_switching_with_a_cause(first)

    def order_rivals(self, passing: Sequence[str]) -> list[str]:
        """Return the effects that come close to the best, simpler ones first."""
        settings = self.examination.settings
        best = self.nats(passing[0])
        rivals = [
            key
            for key in passing
            if not is_nuisance(key)
            and self.nats(key) >= ambiguous_evidence(self.components[key][:1], best, settings)
        ]
        effects = {self.components[key][0].candidate.effect for key in rivals}
        is_later = {
            key: self._is_on_single_axis(key)
            or find_plainer_effect(self.components[key], self.state) in effects
            for key in rivals
        }
        return sorted(
            rivals, key=lambda key: settings.ambiguous_nats * is_later[key] - self.nats(key)
        )

    def find_pair(self, passing: Sequence[str]) -> list[tuple[str, list[Component], State]]:
        """Find two effects that together explain more than the nuisance alternative.

        Two jumps are such a pair if the alternative is a course of levels. An alternative of any
        form explains more than each of them while the other is not in the model. The evidence of a
        pair is the lower one of both orders: an effect that is fitted alone to both may have a form
        that the second one has to undo.

        Returns the key of each, what it explains with the other in the model, and the state with
        that other one; nothing without such a pair.
        """
        statistic = self.components[passing[0]][0].statistic
        keys = [
            key
            for key in passing
            if not is_nuisance(key)
            and (
                (own := self.components[key][0].statistic) is statistic
                or (statistic.view == "mean" and own.is_linear_in_means)
            )
        ]
        companions = {key: self._find_companions(keys, key, self.components[key]) for key in keys}

        def add_evidence(first: str, second: str) -> float:
            with_first = companions[first][1]
            return (
                self.nats(first) + sum_evidence(with_first[second])
                if second in with_first
                else -math.inf
            )

        pairs = {
            (first, second): min(add_evidence(first, second), add_evidence(second, first))
            for first, second in combinations_with_replacement(keys, 2)
            if first != second or (statistic.is_switching and self.components[first][0].is_step)
        }
        best = max(pairs, key=lambda pair: pairs[pair], default=None)
        if best is None or pairs[best] <= self.nats(passing[0]):
            return []
        first, second = best
        state_with_second, with_second = companions[second]
        state_with_first, with_first = self._find_companions([second], first, with_second[first])
        if second not in with_first:
            return []
        return [
            (first, with_second[first], state_with_second),
            (second, with_first[second], state_with_first),
        ]

    def drop_switching_with_a_cause(self, passing: list[str]) -> list[str]:
        """Drop telegraph biases while a passing mean that follows a channel may be their cause.

        A channel that switches makes two levels as well, and because its form is not exact, what it
        leaves switches with it. Therefore the channel comes first where it explains more on the
        same axis, or half of the course of the switching.
        """
        limit = self.state.settings.majority_share
        driven_means = [
            component for component in self._means_of(passing) if any(component.candidate.driver)
        ]
        return [
            key
            for key in passing
            if not any(
                component.statistic.is_switching
                and other.row == component.row
                and (
                    other.evidence_nats >= component.evidence_nats
                    or _explained_share(component, other, self.state) > limit
                )
                for component in self.components[key]
                for other in driven_means
            )
        ]

    def identify_switching(self, passing: list[str]) -> list[str]:
        """Return the keys of biases that switch within blocks and have no possible cause.

        No other effect in the means of the same axis explains more. An axis has one of them: with
        it in the model, more switching does not explain powers and tails that the first has left,
        and may be a jump.
        """
        means = self._means_of(passing)
        return [
            key
            for key in self.drop_switching_with_a_cause(passing)
            if not is_nuisance(key)
            and any(
                component.variant.inside.size
                and not self.state.given.get(("sub_block", component.row[0]))
                and component.evidence_nats
                > max([0.0, *(mean.evidence_nats for mean in means if mean.row == component.row)])
                for component in self.components[key]
            )
        ]

    def _means_of(self, keys: Sequence[str]) -> list[Component]:
        """Return the components of effects that are linear in the means."""
        return [
            component
            for key in keys
            if not is_nuisance(key)
            for component in self.components[key]
            if component.statistic.is_linear_in_means
        ]

    def _confirmed_nats(self, key: str) -> float:
        """Return the evidence that a channel other than an axis of the gyro confirms [nats]."""
        return sum_evidence(
            [
                component
                for component in self.components[key]
                if component.statistic.is_transfer
                and component.candidate.reference[0] not in self.state.axes
            ]
        )

    def _on_other_axes(self, passing: list[str]) -> list[str]:
        """Return the effects on whose axes no nuisance alternative explains more; all without any.

        An axis that moves, for instance, has much that no effect explains. What another axis senses
        of it by its misalignment does not compete with that.
        """
        if not passing or not is_nuisance(passing[0]):
            return passing
        alternatives = [self.components[key] for key in passing if is_nuisance(key)]
        first = []
        for key in (key for key in passing if not is_nuisance(key)):
            axes = {axis for component in self.components[key] for axis in component.row}
            rivals = [
                sum_evidence([other for other in alternative if axes & {*other.row}])
                for alternative in alternatives
            ]
            if max(rivals) < self.nats(key):
                first.append(key)
        return first or passing

    def _without_slopes(self, passing: list[str]) -> list[str]:
        """Drop lines that a passing filter explains, or the filter if lines remain.

        A line is compared with its neighbours, so that the steep slope of a filter, or the lobes of
        an average, look like one. Lines that keep half of their evidence come before the filter:
        many of them together leave a broad form in the powers too. All that explains less than the
        filter then waits with it, because any other form would be named for the slope.
        """
        components = self.components
        lines = [key for key in passing if components[key][0].statistic.is_line]
        filters = [key for key in passing if any(part.is_filter for part in components[key])]
        if not lines or not filters:
            return passing
        trial = condition_on(self.state, components[filters[0]])
        after = self.examination.find_components(
            [components[key][0].candidate for key in lines], trial
        )
        share = self.state.settings.majority_share
        real = {key for key in lines if sum_evidence(after.get(key, [])) > share * self.nats(key)}
        if not real:
            return [key for key in passing if key not in lines]
        stronger = passing[: passing.index(filters[0])]
        return [key for key in passing if key in real or (key in stronger and key not in lines)]

    def _is_on_single_axis(self, key: str) -> bool:
        """Return whether an effect that should be one process on all axes shows on one only."""
        is_common = any(
            candidate.key == key and candidate.statistic.is_pairwise
            for candidate in self.examination.candidates
        )
        axes = {axis for component in self.components[key] for axis in component.row}
        return is_common and len(axes) == 1

    def _find_companions(
        self, keys: Sequence[str], key: str, components: list[Component]
    ) -> tuple[State, dict[str, list[Component]]]:
        """Return the state with these components of an effect, and what passes with them in it."""
        examination = self.examination
        chosen = [*self.chosen, make_selection(components, self.required[key])]
        with_first = condition_on(self.state, components)
        sought = [candidate for candidate in examination.candidates if candidate.key in keys]
        companions = {}
        for other, other_components in examination.find_components(sought, with_first).items():
            required = examination.required_nats(other_components, chosen)
            error = required - examination.threshold
            physical, _ = keep_physical(other_components, with_first, error=error)
            if sum_evidence(physical) > required:
                companions[other] = physical
        return with_first, companions


def _explained_share(component: Component, other: Component, state: State) -> float:
    """Return the share of the variance of a course that another component explains."""
    row = state.axes.index(component.row[0])
    course = mean_columns(component.variant, row)[0]
    columns = np.stack(mean_columns(other.variant, row), axis=1)
    good = (
        np.isfinite(state.blocks["mean"].values[row])
        & np.isfinite(columns).all(axis=1)
        & np.isfinite(course)
    )
    course, columns = course[good], columns[good]
    course, columns = course - course.mean(), columns - columns.mean(axis=0)
    size, *_ = np.linalg.lstsq(columns, course, rcond=None)
    left = float(np.square(course - columns @ size).sum())
    return 1.0 - left / max(float(np.square(course).sum()), 1e-300)

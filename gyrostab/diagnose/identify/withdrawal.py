"""Withdraw identified effects that leave structure in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import xarray as xr

from gyrostab.diagnose.identify.completeness import (
    excess_low_frequency_noise,
    variance_fluctuation,
    with_neighbouring_variants,
)
from gyrostab.diagnose.identify.components import group_components
from gyrostab.diagnose.identify.identification import (
    Identification,
    Unidentified,
    components_of,
    condition_on_selections,
    find_unidentified,
)
from gyrostab.diagnose.predict.candidates import Candidate
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.settings import DEFAULTS, Settings

__all__ = ["Withdrawal"]

#: Effects that change the white variance of the means, which the calibration then misjudges.
_SPECTRAL_SHAPES = ("logger_filter", "held_samples", "gauss_markov", "telegraph")
#: Arbitrary courses of the bias.
_DRIFTS = ("~bias(t)", "~levels")


@dataclass(frozen=True)
class Withdrawal:
    """Withdrawal of effects that explain too little for what they leave.

    Attributes
    ----------
    start : State
        With the expected effects in the model.
    candidates, folds, threshold, settings
        Those of `gyrostab.diagnose.identify.selection.Search`.
    """

    start: State
    candidates: Sequence[Candidate]
    folds: xr.DataArray
    threshold: float
    settings: Settings = DEFAULTS

    def run(
        self,
        state: State,
        identified: list[Identification],
        unidentified: Sequence[Unidentified],
    ) -> tuple[list[Identification], list[Unidentified]]:
        """Withdraw effects that leave structure in time, in the means or in the powers."""
        kept, withdrawn = list(identified), []
        for axis in state.axes:
            kept, unexplained = self._withdraw_in_means(state, kept, unidentified, axis)
            withdrawn += unexplained
        for axis in state.axes:
            on_axis = _identified_on(kept, axis, in_means=False)
            if not on_axis:
                continue
            weak, _ = self._find_weak(
                on_axis, variance_fluctuation(condition_on_selections(self.start, kept), axis)
            )
            if weak:
                kept = [one for one in kept if one not in weak]
                rest = condition_on_selections(self.start, [*kept, *unidentified])
                withdrawn += self._find_fluctuation(rest, axis, weak)
        return kept, withdrawn

    def _withdraw_in_means(
        self,
        state: State,
        kept: list[Identification],
        unidentified: Sequence[Unidentified],
        axis: str,
    ) -> tuple[list[Identification], list[Unidentified]]:
        """Withdraw effects on the means of an axis that leave more slow noise than calibrated."""
        on_axis = _identified_on(kept, axis, in_means=True)
        part_of_drift = _find_part_of_drift(on_axis, unidentified, axis)
        kept = [one for one in kept if one not in part_of_drift]
        has_alternative = any(
            one.generic in (*_DRIFTS, "~S(f)", "~cov") and axis in one.axes for one in unidentified
        )
        has_shape = any(
            component.candidate.effect in _SPECTRAL_SHAPES and axis in component.row
            for component in components_of(kept)
        )
        if has_alternative or has_shape:
            return kept, []
        left = excess_low_frequency_noise(
            with_neighbouring_variants(state, on_axis, axis), axis, self.folds
        )
        weak, strength = self._find_weak(on_axis, left)
        if not weak and left <= self.threshold + self.settings.form_error_share * strength:
            return kept, []
        names = tuple(one.effect for one in weak)
        unexplained = Unidentified("~red", (axis,), left, self.threshold, names)
        return [one for one in kept if one not in weak], [unexplained]

    def _find_weak(
        self, identified: Sequence[Identification], left: float
    ) -> tuple[list[Identification], float]:
        """Return the effects that explain too little for what they leave [nats], and their sum."""
        settings = self.settings
        strength = sum(one.evidence_nats for one in identified)
        most = settings.component_nats + settings.form_error_share * strength
        share = settings.spectrum_error_share
        return [one for one in identified if left > max(most, share * one.evidence_nats)], strength

    def _find_fluctuation(
        self, state: State, axis: str, weak: Sequence[Identification]
    ) -> list[Unidentified]:
        """Return what a free noise level explains on an axis, instead of withdrawn effects."""
        free = [one for one in self.candidates if one.effect == "~N(t)"]
        found = group_components(
            compute_evidence(free, state.blocks, state, self.folds), settings=self.settings
        )
        components = [
            component
            for component in found.get("~N(t)", [])
            if component.row == (axis,) and component.evidence_nats > self.threshold
        ]
        names = [one.effect for one in weak]
        return [find_unidentified("~N(t)", components, self.threshold, names)] if components else []


def _identified_on(
    identified: Sequence[Identification], axis: str, *, in_means: bool
) -> list[Identification]:
    """Return the identifications with a component in the means of an axis, or in its powers."""
    return [
        one
        for one in identified
        if any(
            (component.statistic.is_linear_in_means if in_means else component.statistic.is_power)
            and component.row == (axis,)
            for component in one.components
        )
    ]


def _find_part_of_drift(
    on_axis: Sequence[Identification], unidentified: Sequence[Unidentified], axis: str
) -> list[Identification]:
    """Return effects without a channel that explain less than an unidentified drift of the axis.

    They may be a piece of that drift.
    """
    drift = sum(
        one.evidence_nats for one in unidentified if one.generic in _DRIFTS and axis in one.axes
    )
    return [one for one in on_axis if not any(one.driver) and one.evidence_nats < drift]

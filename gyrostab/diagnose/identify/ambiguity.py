"""Find the effects that the data cannot separate from an effect: its alternatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.reduce.zero_bin import possibly_truncated_axes
from gyrostab.physics.registry import effects


def find_equivalent_effects(
    effect: str, components: Sequence[Component], state: State, *, lines: int = 0
) -> list[str]:
    """Return effects that the data cannot separate from this one; `lines` counts all lines."""
    out = list(effects()[effect].look_alikes("always"))
    blocks = state.blocks
    if (
        effect == "spectral_line"
        and "profile" not in blocks
        and lines >= state.settings.min_comb_lines
    ):
        out.append("feedback_reset")
    if (
        effect == "dead_zone" and len(state.axes) == 1
    ):  # no other axis shows whether the sample was lost
        out.append("held_samples")
    if effect == "dead_zone" and any(
        possibly_truncated_axes(blocks)[state.axes.index(component.row[0])]
        for component in components
    ):
        out.append("rate_quantization")  # truncation towards zero makes the zero bin twice as wide
    if effect == "bias_jump" and any(
        component.is_step
        and np.abs(component_mixture(component, state).moments()[0]).max()
        >= state.settings.min_fringe_step
        for component in components
    ):
        out.append("fringe_hop")
    if effect == "telegraph" and not any(
        component.statistic.is_switching for component in components
    ):
        out.append("gauss_markov")  # two levels show only in the means
    if effect == "vibration_rectification":
        vibration = blocks[f"channel_{components[0].candidate.driver[0]}"].values
        good = np.isfinite(vibration)
        if (
            np.corrcoef(vibration[good], vibration[good] ** 2)[0, 1]
            > state.settings.level_correlation
        ):
            out.append("g_sensitivity")
    return out


def find_spectral_alternatives(
    effect: str,
    components: Sequence[Component],
    state: State,
    examination: Examination,
) -> list[str]:
    """Return effects of the same channel, if a spectrum of another form explains clearly more.

    The forms that were tried then do not tell the effects apart: vibration through the resonance of
    a mount has a hump like an aliased band. `state` has all other effects in the model.
    """
    powers = [component for component in components if component.statistic.is_power]
    others = list(effects()[effect].look_alikes("any spectrum"))
    if not others or not powers:
        return []
    own_nats = sum(component.evidence_nats for component in powers)
    free = 0.0
    for component in powers:
        evidence = examination.compute_evidence([_any_spectrum(component, state)], state)[0]
        free += float(evidence.evidence_nats[0, evidence.rows.index(component.row)])
    allowed = state.settings.ambiguous_nats + state.settings.form_error_share * own_nats
    return others if free - own_nats > allowed else []


def _any_spectrum(component: Component, state: State) -> Candidate:
    """Return a power of any spectrum with the course of a component over time."""
    design = component.variant.design
    row = state.axes.index(component.row[0]) if design.shape[1] > 1 else 0
    course = design[0, row].mean(axis=-1)
    bands = np.eye(design.shape[-1])
    variant = Variant(
        {}, tuple(map(str, range(len(bands)))), course[None, None, :, None] * bands[:, None, None]
    )
    return Candidate("~S(f)", component.statistic, component.candidate.driver, (variant,))

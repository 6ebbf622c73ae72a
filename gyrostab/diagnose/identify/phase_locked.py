"""Separate components that are phase-locked to the rotation of the tool or to the feedback ramp."""

from __future__ import annotations

from dataclasses import replace

from gyrostab.diagnose.identify.identification import Identifications

__all__ = ["remove_phase_locked"]


def remove_phase_locked(identifications: Identifications) -> tuple[Identifications, float]:
    """Drop phase-locked components, and return their held-out evidence [nats].

    The band powers show how large such a component is, but not its phase. In them it would gain a
    small part of its evidence, and lose in every band that it leaves. Therefore its own statistic
    alone counts, and the powers of both models are without it.
    """
    evidence_nats, kept = 0.0, []
    for identification in identifications.identified:
        locked = [
            component
            for component in identification.components
            if component.statistic.is_phase_locked
        ]
        evidence_nats += sum(component.evidence_nats for component in locked)
        rest = (
            tuple(component for component in identification.components if component not in locked)
            if locked
            else identification.components
        )
        if rest:
            kept.append(replace(identification, components=rest) if locked else identification)
    return replace(identifications, identified=tuple(kept)), evidence_nats

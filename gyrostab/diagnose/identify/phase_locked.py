"""Waves whose course is known: locked to the rotation of the tool, or to the ramp of the loop."""

from __future__ import annotations

from dataclasses import replace

from gyrostab.diagnose.identify.identification import Identifications

__all__ = ["without_waves"]

_VIEWS = ("order", "phase_locked")


def without_waves(identifications: Identifications) -> tuple[Identifications, float]:
    """The naming without what is locked to rotation or ramp, and what that gains on time that was kept apart [nats].

    The powers of the bands know how large a wave is, but not its phase: with a wave in them they
    gain a small part of what the wave is worth, and lose by every band that it frees. So a wave is
    judged by its own view alone, and the powers of both models are without it.
    """
    evidence_nats, kept = 0.0, []
    for identification in identifications.identified:
        waves = [
            component
            for component in identification.components
            if component.candidate.statistic in _VIEWS
        ]
        evidence_nats += sum(component.evidence_nats for component in waves)
        rest = (
            tuple(component for component in identification.components if component not in waves)
            if waves
            else identification.components
        )
        if rest:
            kept.append(replace(identification, components=rest) if waves else identification)
    return replace(identifications, identified=tuple(kept)), evidence_nats

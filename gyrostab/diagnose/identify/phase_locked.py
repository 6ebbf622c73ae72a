"""Waves whose course is known: locked to the rotation of the tool, or to the ramp of the loop."""

from __future__ import annotations

from dataclasses import replace

from gyrostab.diagnose.identify.identification import Identifications

__all__ = ["without_waves"]

_VIEWS = ("order", "phase_locked")


def without_waves(naming: Identifications) -> tuple[Identifications, float]:
    """The naming without what is locked to rotation or ramp, and what that gains on time that was kept apart [nats].

    The powers of the bands know how large a wave is, but not its phase: with a wave in them they
    gain a small part of what the wave is worth, and lose by every band that it frees. So a wave is
    judged by its own view alone, and the powers of both models are without it.
    """
    gain, kept = 0.0, []
    for claim in naming.claims:
        waves = [part for part in claim.parts if part.candidate.view in _VIEWS]
        gain += sum(part.gain for part in waves)
        rest = tuple(part for part in claim.parts if part not in waves) if waves else claim.parts
        if rest:
            kept.append(replace(claim, parts=rest) if waves else claim)
    return replace(naming, claims=tuple(kept)), gain

"""Biases of two levels among the names: what follows a channel comes first, and the course is sought anew with all else in the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from gyrostab.diagnose.effects.explained import Part
from gyrostab.diagnose.naming.claims import Naming
from gyrostab.diagnose.naming.parts import gain_of

__all__ = ["followed_first", "hopping", "renewed", "without_levels"]

_VIEW = "levels"


def followed_first(passing: list[str], parts: Mapping[str, Sequence[Part]]) -> list[str]:
    """Keys without those of two levels, as long as a mean that follows a channel passes too.

    A channel that switches makes two levels as well, and what its mean leaves, since its form is not exact, hops where it hops.
    """
    follows = any(part.candidate.view == "mean" and any(part.candidate.driver) for key in passing for part in parts[key])
    return [key for key in passing if not follows or all(part.candidate.view != _VIEW for part in parts[key])]


def hopping(passing: list[str], parts: Mapping[str, Sequence[Part]]) -> list[str]:
    """Keys of biases that hop within blocks, unless a mean that follows a channel passes too."""
    return [key for key in followed_first(passing, parts) if any(part.variant.inside.size for part in parts[key])]


def renewed(parts: Sequence[Part], part: Part) -> Part:
    """A part with its gain among `parts`, which were found with all others in the model; and with the course that was found then."""
    fresh = replace(part, gain=gain_of(parts, part))
    if part.candidate.view != _VIEW:
        return fresh
    return next((replace(fresh, variant=one.variant) for one in parts if (one.candidate.view, one.row) == (_VIEW, part.row)), fresh)


def without_levels(naming: Naming) -> tuple[Naming, float]:
    """The naming without biases of two levels, whose course no other time tells; and what these gain [nats]."""
    those = [claim for claim in naming.claims if any(part.candidate.view == _VIEW for part in claim.parts)]
    kept = tuple(claim for claim in naming.claims if claim not in those)
    return replace(naming, claims=kept), sum(claim.gain for claim in those)

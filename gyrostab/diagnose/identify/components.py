"""Rows of views in which an effect shows, put together by effect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gyrostab.diagnose.predict.candidates import Candidate
from gyrostab.diagnose.predict.condition import Part
from gyrostab.diagnose.predict.search import Found, together

__all__ = ["LEAST", "PLAIN_LINE", "axes_of", "by_key", "gain_of", "gain_sum", "lines_only", "parts_of", "tried_again", "without_lines"]

#: What an axis must bring to be named with the others [nats].
LEAST = 2.0
#: The effect that says of a line no more than that it is there.
PLAIN_LINE = "spectral_line"


def parts_of(found: Found) -> list[Part]:
    """Rows of a candidate that bring something."""
    gain = found.gain[0]
    rows = [number for number in range(gain.size) if gain[number] > LEAST]
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


def by_key(found: Sequence[Found]) -> dict[str, list[Part]]:
    """Parts of every effect, those that bring something, the strongest first."""
    out: dict[str, list[Part]] = {}
    for one in found:
        out.setdefault(one.candidate.key, []).extend(parts_of(one))
    for key, parts in out.items():
        good = _once([part for part in parts if part.gain > LEAST])
        out[key] = sorted(good or parts, key=lambda part: -part.gain)
    return out


def _once(parts: Sequence[Part]) -> list[Part]:
    """Parts without the spectrum of an effect on axes whose course within blocks is known: that holds the same powers."""
    told = {part.row for part in parts if part.candidate.view == "levels" and part.variant.inside.size}
    return [part for part in parts if part.candidate.view != "power" or part.row not in told]


def without_lines(parts: dict[str, list[Part]]) -> dict[str, list[Part]]:
    """The same, where a line counts for the plainest name only.

    Any line has the form that a ripple of the supply or a sway would have, and nothing in the line itself tells of them; that they can be
    meant as well stands among the alternatives. What else such an effect does counts as before.
    """
    out = {}
    for key, several in parts.items():
        plain = several[0].candidate.effect == PLAIN_LINE
        kept = several if plain else [part for part in several if part.candidate.view != "line"]
        if kept:
            out[key] = kept
    return out


def lines_only(parts: Sequence[Part]) -> bool:
    """Whether all that these parts say is that lines are there."""
    return bool(parts) and all(part.candidate.view == "line" for part in parts)


def gain_sum(parts: Sequence[Part]) -> float:
    """Gain of an effect from its parts [nats]."""
    return float(together(np.array([part.gain for part in parts]))) if parts else 0.0


def gain_of(parts: Sequence[Part], like: Part) -> float:
    """Gain of the part in the same view and row, and beside the same witness."""
    wanted = like.candidate.view, like.row, like.candidate.witness
    return next((one.gain for one in parts if (one.candidate.view, one.row, one.candidate.witness) == wanted), like.gain)


def tried_again(parts: Sequence[Part]) -> list[Candidate]:
    """Candidates that parts come from, each once."""
    seen: dict[tuple[str, str, tuple[str, ...]], Candidate] = {}
    for part in parts:
        seen[part.candidate.key, part.candidate.view, part.candidate.witness] = part.candidate
    return list(seen.values())


def axes_of(parts: Sequence[Part], order: Sequence[str]) -> tuple[str, ...]:
    """Axes of parts, in order."""
    named = {axis for part in parts for axis in part.row}
    return tuple(sorted(named, key=lambda axis: (order.index(axis) if axis in order else 0, axis)))

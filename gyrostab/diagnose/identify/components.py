"""Rows of views in which an effect shows, put together by effect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gyrostab.diagnose.predict.candidates import Candidate
from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.search import Found, together

__all__ = [
    "LEAST",
    "PLAIN_LINE",
    "axes_of",
    "by_key",
    "evidence_of",
    "find_components",
    "lines_only",
    "sum_evidence",
    "tried_again",
    "without_lines",
]

#: What an axis must bring to be named with the others [nats].
LEAST = 2.0
#: The effect that says of a line no more than that it is there.
PLAIN_LINE = "spectral_line"


def find_components(found: Found) -> list[Component]:
    """Rows of a candidate that bring something."""
    gain = found.gain[0]
    rows = [number for number in range(gain.size) if gain[number] > LEAST]
    rows = rows or [int(gain.argmax())]
    return [
        Component(
            found.candidate,
            found.best[number],
            found.rows[number],
            float(gain[number]),
            int(found.place[0, number]) if found.place.size else -1,
        )
        for number in rows
    ]


def by_key(found: Sequence[Found]) -> dict[str, list[Component]]:
    """Parts of every effect, those that bring something, the strongest first."""
    out: dict[str, list[Component]] = {}
    for one in found:
        out.setdefault(one.candidate.key, []).extend(find_components(one))
    for key, parts in out.items():
        good = _once([part for part in parts if part.gain > LEAST])
        out[key] = sorted(good or parts, key=lambda part: -part.gain)
    return out


def _once(parts: Sequence[Component]) -> list[Component]:
    """Parts without the spectrum of an effect on axes whose course within blocks is known: that holds the same powers."""
    told = {
        part.row for part in parts if part.candidate.view == "levels" and part.variant.inside.size
    }
    return [part for part in parts if part.candidate.view != "power" or part.row not in told]


def without_lines(parts: dict[str, list[Component]]) -> dict[str, list[Component]]:
    """The same, where a line counts for the plainest name only.

    Any line has the form that a ripple of the supply or a sway would have, and nothing in the line
    itself tells of them; that they can be meant as well stands among the alternatives. What else
    such an effect does counts as before.
    """
    out = {}
    for key, several in parts.items():
        plain = several[0].candidate.effect == PLAIN_LINE
        kept = several if plain else [part for part in several if part.candidate.view != "line"]
        if kept:
            out[key] = kept
    return out


def lines_only(parts: Sequence[Component]) -> bool:
    """Whether all that these parts say is that lines are there."""
    return bool(parts) and all(part.candidate.view == "line" for part in parts)


def sum_evidence(parts: Sequence[Component]) -> float:
    """Gain of an effect from its parts [nats]."""
    return float(together(np.array([part.gain for part in parts]))) if parts else 0.0


def evidence_of(parts: Sequence[Component], like: Component) -> float:
    """Gain of the part in the same view and row, and beside the same witness."""
    wanted = like.candidate.view, like.row, like.candidate.witness
    return next(
        (
            one.gain
            for one in parts
            if (one.candidate.view, one.row, one.candidate.witness) == wanted
        ),
        like.gain,
    )


def tried_again(parts: Sequence[Component]) -> list[Candidate]:
    """Candidates that parts come from, each once."""
    seen: dict[tuple[str, str, tuple[str, ...]], Candidate] = {}
    for part in parts:
        seen[part.candidate.key, part.candidate.view, part.candidate.witness] = part.candidate
    return list(seen.values())


def axes_of(parts: Sequence[Component], order: Sequence[str]) -> tuple[str, ...]:
    """Axes of parts, in order."""
    named = {axis for part in parts for axis in part.row}
    return tuple(sorted(named, key=lambda axis: (order.index(axis) if axis in order else 0, axis)))

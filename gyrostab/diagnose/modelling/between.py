"""Values of a lag, a time or a play between those of the grid, where the record tells them better than the grid is fine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gyrostab.diagnose.effects.candidates import Variant, variants_of
from gyrostab.diagnose.effects.cells import State
from gyrostab.diagnose.effects.explained import Part
from gyrostab.diagnose.effects.sizes import Mixture, part_mixture
from gyrostab.physics.registry import effects

__all__ = ["Point", "refined"]

_SCALES, _INSTANT = ("s", "h", "degC"), "at"  # units of what has values between two others; but not an instant, whose grid is fine
_LIKELY, _STEEP, _MOVED = 6.0, 1.0, 0.5  # nats below the best; nats and standard errors from one value to the next
_ROUNDS, _MOST = 5, 40  # halvings of a step of the grid; points that are added at most


@dataclass(frozen=True)
class Point:
    """A variant, the sizes that it has, and the share of a step of the grid that it stands for."""

    variant: Variant
    sizes: Mixture
    share: float = 1.0

    @property
    def evidence(self) -> float:
        """Logarithm of its likelihood, but for a constant."""
        return float(np.logaddexp.reduce(self.sizes.log_weight))


def refined(part: Part, state: State, points: Sequence[Point]) -> list[Point]:
    """Points with others between them, wherever the likelihood or the size of an effect on means changes much from one to the next.

    A step of the grid is halved about the best point, and again while its ends are likely and differ, so that the likelihood is smooth from
    point to point. What a step stands for is shared by the points in it.

    Parameters
    ----------
    part : Part
    state : State
        With all else that is named.
    points : sequence of Point
        Of the grid.
    """
    name = _scale(part, points)
    if name is None:
        return list(points)
    found = [_Placed(point, *place) for point, place in zip(points, _places(points, name), strict=True)]
    for _ in range(_ROUNDS):
        steps = _wide(found)[: _MOST - len(found) + len(points)]
        new = [made for one, other in steps if (made := _middle(part, state, name, one, other)) is not None]
        if not new:
            break
        found += new
    return _shared(found)


@dataclass(frozen=True)
class _Placed:
    """A point with the line of the grid that it is on, and its place along that, in steps."""

    point: Point
    line: int
    place: float


def _scale(part: Part, points: Sequence[Point]) -> str | None:
    """The first parameter of the grid that is a scale and has several values."""
    if part.candidate.view != "mean":
        return None
    units = {item.name: item.unit for item in effects()[part.candidate.effect].parameters()}
    for name in points[0].variant.values:
        values = {point.variant.values.get(name) for point in points}
        if len(values) > 2 and units.get(name) in _SCALES and name != _INSTANT:
            return name
    return None


def _places(points: Sequence[Point], name: str) -> list[tuple[int, float]]:
    """Line (of like other values) and place of every point."""
    lines: dict[tuple[object, ...], list[int]] = {}
    for number, point in enumerate(points):
        lines.setdefault(tuple(value for key, value in point.variant.values.items() if key != name), []).append(number)
    out: dict[int, tuple[int, float]] = {}
    for line, members in enumerate(lines.values()):
        ordered = sorted(members, key=lambda number: _value(points[number], name))
        out |= {number: (line, float(place)) for place, number in enumerate(ordered)}
    return [out[number] for number in range(len(points))]


def _value(point: Point, name: str) -> float:
    return float(point.variant.values[name])


def _neighbours(found: Sequence[_Placed]) -> list[tuple[_Placed, _Placed]]:
    ordered = sorted(found, key=lambda one: (one.line, one.place))
    return [(one, other) for one, other in pairwise(ordered) if one.line == other.line]


def _wide(found: Sequence[_Placed]) -> list[tuple[_Placed, _Placed]]:
    """Steps to be halved, the likeliest first."""
    best = max(found, key=lambda one: one.point.evidence)
    top, first = best.point.evidence, not any(one.place % 1.0 for one in found)
    out = []
    for one, other in _neighbours(found):
        likely = max(one.point.evidence, other.point.evidence) > top - _LIKELY
        if (first and best in (one, other)) or (likely and _differ(one.point, other.point)):
            out.append((one, other))
    return sorted(out, key=lambda pair: -max(one.point.evidence for one in pair))


def _differ(one: Point, other: Point) -> bool:
    if abs(one.evidence - other.evidence) > _STEEP:
        return True
    (mean, covariance), (after, _) = one.sizes.moments(), other.sizes.moments()
    return bool((np.abs(mean - after) > _MOVED * np.sqrt(np.diagonal(covariance))).any())


def _middle(part: Part, state: State, name: str, one: _Placed, other: _Placed) -> _Placed | None:
    """The point in the middle of a step: of the logarithm, but from none on."""
    low, high = sorted((_value(one.point, name), _value(other.point, name)))
    value = math.sqrt(low * high) if low > high / 100.0 else 0.5 * (low + high)
    wanted = replace(one.point.variant, values={**one.point.variant.values, name: value})
    variant = variants_of(part.candidate, wanted, state.reduced, state.baseline["coefficient"])
    if variant is None or variant.values.get(name) != value:
        return None
    return _Placed(Point(variant, part_mixture(part, state, variant)), one.line, 0.5 * (one.place + other.place))


def _shared(found: Sequence[_Placed]) -> list[Point]:
    """Points with the share of the steps that each stands for: half of those on its sides, and half of one beyond the ends."""
    out = []
    for line in sorted({one.line for one in found}):
        ordered = sorted((one for one in found if one.line == line), key=lambda one: one.place)
        place = np.array([one.place for one in ordered])
        edge = np.concatenate([[place[0] - 0.5], 0.5 * (place[1:] + place[:-1]), [place[-1] + 0.5]])
        out += [replace(one.point, share=float(share)) for one, share in zip(ordered, np.diff(edge), strict=True)]
    return out

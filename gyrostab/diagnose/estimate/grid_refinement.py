"""Lags, times and plays between the values of the grid and beyond its ends, where the record tells them better than the grid does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gyrostab.diagnose.predict.candidates import Variant, rebuild_variant
from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import Mixture, component_mixture
from gyrostab.errors import OptionError
from gyrostab.physics.registry import effects
from gyrostab.units import HOUR

__all__ = ["Point", "refined"]
_SECONDS = {"s": 1.0, "h": HOUR}
_SCALES, _INSTANT = (
    (*_SECONDS, "degC"),
    "at",
)  # units of what has values between two others; but not an instant, whose grid is fine
_LIKELY, _STEEP, _MOVED = (
    6.0,
    1.0,
    1.0,
)  # nats below the best; nats and standard errors from one value to the next
_ROUNDS, _MOST = (
    5,
    40,
)  # halvings of a step of the grid, and steps beyond it; points that are added between them at most
_NONE = 100.0  # times smaller than the next value is as good as none


@dataclass(frozen=True)
class Point:
    """A variant, its sizes, the share of a step of the grid that it stands for, and by how much it is `unlikely` beforehand [nats]."""

    variant: Variant
    sizes: Mixture
    share: float = 1.0
    unlikely: float = 0.0

    @property
    def evidence(self) -> float:
        """Logarithm of its likelihood, but for a constant."""
        return float(np.logaddexp.reduce(self.sizes.log_weight)) - self.unlikely

    def weighed(self) -> Mixture:
        """The sizes, weighted by all of this."""
        return replace(
            self.sizes, log_weight=self.sizes.log_weight - self.unlikely + math.log(self.share)
        )


def _scaled(variant: Variant, sizes: Mixture) -> Point:
    """A point whose sizes are as likely beforehand as those of others of as many standard errors.

    One number is another effect where a time is longer: were all numbers alike, slow forms would
    be, which look like their beginning only.
    """
    mean = np.einsum("g,gij->ij", sizes.weights(), sizes.covariance)
    return Point(variant, sizes, unlikely=0.5 * float(np.linalg.slogdet(mean)[1]))


def refined(component: Component, state: State, points: Sequence[Point]) -> list[Point]:
    """Points with others between them, wherever the likelihood or the size of an effect on means changes much from one to the next.

    The grid goes on where the likelihood still rises at its end. A step is halved about the best
    point, and again while its ends are likely and differ, so that the likelihood is smooth from
    point to point. What a step stands for is shared by the points in it.

    Parameters
    ----------
    component : Part
    state : State
        With all else that is named.
    points : sequence of Point
        Of the grid.
    """
    name = _scale(component, points)
    if name is None:
        return list(points)
    found = [
        _Placed(_scaled(one.variant, one.sizes), *place)
        for one, place in zip(points, _places(points, name), strict=True)
    ]
    for line in sorted({one.line for one in found}):
        members = sorted((one for one in found if one.line == line), key=lambda one: one.place)
        for down in (True, False) if len(members) > 1 else ():
            found += _beyond(component, state, name, members, found, down)
    for _ in range(_ROUNDS):
        steps = _wide(found)[: max(_MOST - len(found) + len(points), 0)]
        new = [
            made
            for one, other in steps
            if (made := _middle(component, state, name, one, other)) is not None
        ]
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


def _scale(component: Component, points: Sequence[Point]) -> str | None:
    """The first parameter of the grid that is a scale and has several values."""
    if component.candidate.statistic != "mean":
        return None
    for name in points[0].variant.values:
        values = {point.variant.values.get(name) for point in points}
        if len(values) > 2 and _unit(component, name) in _SCALES and name != _INSTANT:
            return name
    return None


def _unit(component: Component, name: str) -> str:
    return next(
        (
            item.unit
            for item in effects()[component.candidate.effect].parameters()
            if item.name == name
        ),
        "",
    )


def _places(points: Sequence[Point], name: str) -> list[tuple[int, float]]:
    """Line (of like other values) and place of every point."""
    lines: dict[tuple[object, ...], list[int]] = {}
    for number, point in enumerate(points):
        lines.setdefault(
            tuple(value for key, value in point.variant.values.items() if key != name), []
        ).append(number)
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
        if (first and (best is one or best is other)) or (
            likely and _differ(one.point, other.point)
        ):
            out.append((one, other))
    return sorted(out, key=lambda pair: -max(one.point.evidence for one in pair))


def _differ(one: Point, other: Point) -> bool:
    if abs(one.evidence - other.evidence) > _STEEP:
        return True
    (mean, covariance), (after, _) = one.sizes.moments(), other.sizes.moments()
    return bool((np.abs(mean - after) > _MOVED * np.sqrt(np.diagonal(covariance))).any())


def _middle(
    component: Component, state: State, name: str, one: _Placed, other: _Placed
) -> _Placed | None:
    """The point in the middle of a step: of the logarithm, but from none on."""
    low, high = sorted((_value(one.point, name), _value(other.point, name)))
    value = math.sqrt(low * high) if low > high / _NONE else 0.5 * (low + high)
    return _made(component, state, name, one, value, 0.5 * (one.place + other.place))


def _beyond(
    component: Component,
    state: State,
    name: str,
    line: Sequence[_Placed],
    found: Sequence[_Placed],
    down: bool,
) -> list[_Placed]:
    """Points beyond an end of a line, by steps like the last one, as long as the likelihood rises and is the largest but for `_LIKELY`.

    A lag longer than the record is only another slope.
    """
    before, last = (line[1], line[0]) if down else (line[-2], line[-1])
    ratio = _value(last.point, name) / max(_value(before.point, name), 1e-300)
    top, out = max(one.point.evidence for one in found) - _LIKELY, list[_Placed]()
    longest = float(state.blocks["end"].values[-1]) / _SECONDS.get(_unit(component, name), math.nan)
    while (
        len(out) < _ROUNDS
        and 1.0 / _NONE < ratio < _NONE
        and last.point.evidence > max(before.point.evidence + _STEEP, top)
    ):
        value = ratio * _value(last.point, name)
        after = (
            None
            if value > longest
            else _made(component, state, name, last, value, last.place + (-1.0 if down else 1.0))
        )
        if after is None:
            break
        out.append(after)
        before, last = last, after
    return out


def _made(
    component: Component, state: State, name: str, like: _Placed, value: float, place: float
) -> _Placed | None:
    """A point of another value on the same line; None where the effect cannot have it."""
    wanted = replace(like.point.variant, values={**like.point.variant.values, name: value})
    try:
        variant = rebuild_variant(
            component.candidate, wanted, state.blocks, state.baseline["coefficient"]
        )
    except OptionError:
        return None
    if variant is None or variant.values.get(name) != value:
        return None
    return _Placed(_scaled(variant, component_mixture(component, state, variant)), like.line, place)


def _shared(found: Sequence[_Placed]) -> list[Point]:
    """Points with the share of the steps that each stands for: half of those on its sides, and half of one beyond the ends."""
    out = []
    for line in sorted({one.line for one in found}):
        ordered = sorted((one for one in found if one.line == line), key=lambda one: one.place)
        place = np.array([one.place for one in ordered])
        edge = np.concatenate([[place[0] - 0.5], 0.5 * (place[1:] + place[:-1]), [place[-1] + 0.5]])
        out += [
            replace(one.point, share=float(share))
            for one, share in zip(ordered, np.diff(edge), strict=True)
        ]
    return out

"""Refine the grid of lags, time constants and dead bands where the likelihood changes fast."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise

import numpy as np

from gyrostab.diagnose.evidence.mixture import Mixture
from gyrostab.diagnose.predict.candidates import Component, Variant
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.predict.windows import rebuild_variant
from gyrostab.errors import OptionError
from gyrostab.physics.registry import effects
from gyrostab.units import HOUR

_SECONDS = {"s": 1.0, "h": HOUR}
#: Units of parameters that have values between those of the grid.
_SCALES = (*_SECONDS, "degC")
_INSTANT = "at"  # a parameter in seconds whose grid is fine already
# Tolerances of the quadrature over the grid.
LIKELY_NATS = 6.0  # below the best, to which points count: a probability of 1 in 400
STEEP_NATS = 1.0  # from one point to the next, that the quadrature tolerates
MAX_STEP_SIGMA = 1.0  # change of a size from one point to the next, in its standard errors
MAX_ROUNDS = 5  # halvings of a step of the grid, and steps beyond its end
MAX_ADDED_POINTS = 40  # between the points of the grid
MAX_RATIO = 100.0  # of two neighbours, above which the smaller one counts as zero


@dataclass(frozen=True)
class Point:
    """A variant with its sizes and its weight in the average over the grid."""

    variant: Variant
    sizes: Mixture
    share: float = 1.0  # length of the part of the grid that it represents, in steps
    unlikely: float = 0.0  # prior penalty [nats]
    line: int = 0  # of the grid, that it is on
    place: float = 0.0  # along that line, in steps

    @property
    def evidence(self) -> float:
        """Return the log likelihood, up to a constant."""
        return self.sizes.evidence - self.unlikely

    def weighed(self) -> Mixture:
        """Return the sizes, weighted by likelihood, prior and share."""
        return replace(
            self.sizes, log_weight=self.sizes.log_weight - self.unlikely + math.log(self.share)
        )


def _make_point(variant: Variant, sizes: Mixture, line: int, place: float) -> Point:
    """Return a point with a prior that is uniform in size over standard error.

    The same size is another effect where a time constant is longer. With a prior uniform in size,
    slow forms would be preferred, of which the record shows only the beginning.
    """
    mean = np.einsum("g,gij->ij", sizes.weights(), sizes.covariance)
    unlikely = 0.5 * float(np.linalg.slogdet(mean)[1])
    return Point(variant, sizes, unlikely=unlikely, line=line, place=place)


def refine_grid(component: Component, state: State, points: Sequence[Point]) -> list[Point]:
    """Add points to a grid wherever likelihood or size of an effect on means change much.

    The grid is extended where the likelihood still rises at its end. A step is halved about the
    best point, and again while its ends are likely and differ, so that the likelihood is smooth
    from point to point. Points within a step share its weight.
    """
    name = _find_scale(component, points)
    if name is None:
        return list(points)
    grid = [
        _make_point(point.variant, point.sizes, *place)
        for point, place in zip(points, _place_points(points, name), strict=True)
    ]
    for members in _split_lines(grid):
        for down in (True, False) if len(members) > 1 else ():
            grid += _extend_line(component, state, name, members, grid, down)
    for _ in range(MAX_ROUNDS):
        room = max(MAX_ADDED_POINTS - len(grid) + len(points), 0)
        halved = [
            _halve_step(component, state, name, left, right)
            for left, right in _steps_to_halve(grid)[:room]
        ]
        new = [point for point in halved if point is not None]
        if not new:
            break
        grid += new
    return _share_steps(grid)


def _find_scale(component: Component, points: Sequence[Point]) -> str | None:
    """Return the first parameter of the grid that is a scale and has several values."""
    if not component.statistic.is_linear_in_means:
        return None
    for name in points[0].variant.values:
        values = {point.variant.values.get(name) for point in points}
        if len(values) > 2 and _unit_of(component, name) in _SCALES and name != _INSTANT:
            return name
    return None


def _unit_of(component: Component, name: str) -> str:
    return next(
        (
            item.unit
            for item in effects()[component.candidate.effect].parameters()
            if item.name == name
        ),
        "",
    )


def _place_points(points: Sequence[Point], name: str) -> list[tuple[int, float]]:
    """Return line (of the same other values) and place of every point."""
    lines: dict[tuple[object, ...], list[int]] = {}
    for number, point in enumerate(points):
        lines.setdefault(
            tuple(value for key, value in point.variant.values.items() if key != name), []
        ).append(number)
    out: dict[int, tuple[int, float]] = {}
    for line, members in enumerate(lines.values()):
        ordered = sorted(members, key=lambda number: _value_at(points[number], name))
        out |= {number: (line, float(place)) for place, number in enumerate(ordered)}
    return [out[number] for number in range(len(points))]


def _value_at(point: Point, name: str) -> float:
    return float(point.variant.values[name])


def _split_lines(grid: Sequence[Point]) -> list[list[Point]]:
    """Return the points of each line in order."""
    ordered = sorted(grid, key=lambda point: (point.line, point.place))
    return [list(line) for _, line in groupby(ordered, key=lambda point: point.line)]


def _steps_to_halve(grid: Sequence[Point]) -> list[tuple[Point, Point]]:
    """Return the steps to be halved, the likeliest first."""
    best = max(grid, key=lambda point: point.evidence)
    first = not any(point.place % 1.0 for point in grid)
    out = [
        (left, right)
        for line in _split_lines(grid)
        for left, right in pairwise(line)
        if (first and (best is left or best is right))
        or (
            max(left.evidence, right.evidence) > best.evidence - LIKELY_NATS
            and _are_different(left, right)
        )
    ]
    return sorted(out, key=lambda pair: -max(point.evidence for point in pair))


def _are_different(left: Point, right: Point) -> bool:
    if abs(left.evidence - right.evidence) > STEEP_NATS:
        return True
    (mean, covariance), (other_mean, _) = left.sizes.moments(), right.sizes.moments()
    return bool(
        (np.abs(mean - other_mean) > MAX_STEP_SIGMA * np.sqrt(np.diagonal(covariance))).any()
    )


def _halve_step(
    component: Component, state: State, name: str, left: Point, right: Point
) -> Point | None:
    """Return the point in the middle of a step, in the logarithm unless one end is near zero."""
    low, high = sorted((_value_at(left, name), _value_at(right, name)))
    value = math.sqrt(low * high) if low > high / MAX_RATIO else 0.5 * (low + high)
    return _add_point(component, state, name, left, value, 0.5 * (left.place + right.place))


def _extend_line(
    component: Component,
    state: State,
    name: str,
    line: Sequence[Point],
    grid: Sequence[Point],
    down: bool,
) -> list[Point]:
    """Return points beyond an end of a line, in steps like the last one.

    They continue while the likelihood rises and is within `LIKELY_NATS` of the largest. A lag
    longer than the record is only another slope.
    """
    previous, last = (line[1], line[0]) if down else (line[-2], line[-1])
    ratio = _value_at(last, name) / max(_value_at(previous, name), 1e-300)
    top = max(point.evidence for point in grid) - LIKELY_NATS
    unit = _SECONDS.get(_unit_of(component, name), math.nan)
    longest = float(state.blocks["end"].values[-1]) / unit
    out: list[Point] = []
    while (
        len(out) < MAX_ROUNDS
        and 1.0 / MAX_RATIO < ratio < MAX_RATIO
        and last.evidence > max(previous.evidence + STEEP_NATS, top)
    ):
        value = ratio * _value_at(last, name)
        if value > longest:
            break
        place = last.place + (-1.0 if down else 1.0)
        added = _add_point(component, state, name, last, value, place)
        if added is None:
            break
        out.append(added)
        previous, last = last, added
    return out


def _add_point(
    component: Component, state: State, name: str, like: Point, value: float, place: float
) -> Point | None:
    """Return a point of another value on the same line, or None where the effect cannot have it."""
    sought = replace(like.variant, values={**like.variant.values, name: value})
    try:
        variant = rebuild_variant(
            component.candidate, sought, state.blocks, state.baseline["coefficient"]
        )
    except OptionError:
        return None
    if variant is None or variant.values.get(name) != value:
        return None
    return _make_point(variant, component_mixture(component, state, variant), like.line, place)


def _share_steps(grid: Sequence[Point]) -> list[Point]:
    """Return the points with their shares: half of both steps next to them, or half a step."""
    out = []
    for line in _split_lines(grid):
        place = np.array([point.place for point in line])
        edge = np.concatenate([[place[0] - 0.5], 0.5 * (place[1:] + place[:-1]), [place[-1] + 0.5]])
        out += [
            replace(point, share=float(share))
            for point, share in zip(line, np.diff(edge), strict=True)
        ]
    return out

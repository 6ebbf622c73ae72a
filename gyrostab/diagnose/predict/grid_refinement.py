"""Refine the grid of lags, time constants and dead bands where the likelihood changes fast."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

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
    place: float = 0.0  # along its line of the grid, in steps

    @property
    def evidence(self) -> float:
        """Return the log likelihood, up to a constant."""
        return self.sizes.evidence - self.unlikely

    def weighed(self) -> Mixture:
        """Return the sizes, weighted by likelihood, prior and share."""
        return replace(
            self.sizes, log_weight=self.sizes.log_weight - self.unlikely + math.log(self.share)
        )


def _make_point(variant: Variant, sizes: Mixture, place: float) -> Point:
    """Return a point with a prior that is uniform in size over standard error.

    The same size is another effect where a time constant is longer. With a prior uniform in size,
    slow forms would be preferred, of which the record shows only the beginning.
    """
    mean = np.einsum("g,gij->ij", sizes.weights(), sizes.covariance)
    unlikely = 0.5 * float(np.linalg.slogdet(mean)[1])
    return Point(variant, sizes, unlikely=unlikely, place=place)


def refine_grid(component: Component, state: State, points: Sequence[Point]) -> list[Point]:
    """Add points to a grid wherever likelihood or size of an effect on means change much.

    The grid is extended where the likelihood still rises at its end. A step is halved about the
    best point, and again while its ends are likely and differ, so that the likelihood is smooth
    from point to point. Points within a step share its weight.
    """
    scale = _find_scale(component, points)
    if scale is None:
        return list(points)
    grid = _Grid(component, state, *scale, points)
    for line in grid.lines:
        for down in (True, False) if len(line) > 1 else ():
            grid.extend_line(line, down)
    for _ in range(MAX_ROUNDS):
        if not grid.halve_steps(max(MAX_ADDED_POINTS - len(grid.points) + len(points), 0)):
            break
    return [point for line in grid.lines for point in _share_steps(line)]


def _find_scale(component: Component, points: Sequence[Point]) -> tuple[str, str] | None:
    """Return the first parameter of the grid that is a scale of several values, and its unit."""
    if not component.statistic.is_linear_in_means:
        return None
    parameters = effects()[component.candidate.effect].parameters()
    units = {item.name: item.unit for item in parameters}
    for name in points[0].variant.values:
        values = {point.variant.values.get(name) for point in points}
        if len(values) > 2 and units.get(name) in _SCALES and name != _INSTANT:
            return name, units[name]
    return None


class _Grid:
    """Points in lines along which one parameter changes, each line in order."""

    def __init__(
        self, component: Component, state: State, name: str, unit: str, points: Sequence[Point]
    ):
        self.component, self.state, self.name, self.unit = component, state, name, unit
        lines: dict[tuple[object, ...], list[Point]] = {}
        for point in points:
            others = tuple(value for key, value in point.variant.values.items() if key != name)
            lines.setdefault(others, []).append(point)
        self.lines = [
            [
                _make_point(point.variant, point.sizes, place)
                for place, point in enumerate(sorted(line, key=self.value_at))
            ]
            for line in lines.values()
        ]

    @property
    def points(self) -> list[Point]:
        """All points."""
        return [point for line in self.lines for point in line]

    def value_at(self, point: Point) -> float:
        """Return the value of the parameter that changes along the lines."""
        return float(point.variant.values[self.name])

    def find_best(self) -> Point:
        """Return the likeliest point."""
        return max(self.points, key=lambda point: point.evidence)

    def halve_steps(self, most: int) -> bool:
        """Halve the steps that need it, the likeliest first; return whether there are any."""
        best = self.find_best()
        is_first = not any(point.place % 1.0 for point in self.points)
        steps = [
            (line, left, right)
            for line in self.lines
            for left, right in pairwise(line)
            if (is_first and (best is left or best is right))
            or (
                max(left.evidence, right.evidence) > best.evidence - LIKELY_NATS
                and _are_different(left, right)
            )
        ]
        steps.sort(key=lambda step: -max(point.evidence for point in step[1:]))
        added = []
        for line, left, right in steps[:most]:
            low, high = sorted(map(self.value_at, (left, right)))
            # in the logarithm unless one end is near zero
            middle = math.sqrt(low * high) if low > high / MAX_RATIO else 0.5 * (low + high)
            added.append(self._add_point(line, left, middle, 0.5 * (left.place + right.place)))
        return any(point is not None for point in added)

    def extend_line(self, line: list[Point], down: bool) -> None:
        """Add points beyond an end of a line, in steps like the last one.

        They continue while the likelihood rises and is within `LIKELY_NATS` of the largest. A lag
        longer than the record is only another slope.
        """
        previous, last = (line[1], line[0]) if down else (line[-2], line[-1])
        ratio = self.value_at(last) / max(self.value_at(previous), 1e-300)
        top = self.find_best().evidence - LIKELY_NATS
        longest = float(self.state.blocks["end"].values[-1]) / _SECONDS.get(self.unit, math.nan)
        for _ in range(MAX_ROUNDS if 1.0 / MAX_RATIO < ratio < MAX_RATIO else 0):
            value = ratio * self.value_at(last)
            is_rising = last.evidence > max(previous.evidence + STEEP_NATS, top)
            if not is_rising or value > longest:
                break
            added = self._add_point(line, last, value, last.place + (-1.0 if down else 1.0))
            if added is None:
                break
            previous, last = last, added

    def _add_point(
        self, line: list[Point], like: Point, value: float, place: float
    ) -> Point | None:
        """Add a point of another value to a line; None where the effect cannot have it."""
        sought = replace(like.variant, values={**like.variant.values, self.name: value})
        try:
            variant = rebuild_variant(
                self.component.candidate,
                sought,
                self.state.blocks,
                self.state.baseline["coefficient"],
            )
        except OptionError:
            return None
        if variant is None or variant.values.get(self.name) != value:
            return None
        added = _make_point(variant, component_mixture(self.component, self.state, variant), place)
        line.append(added)
        line.sort(key=lambda point: point.place)
        return added


def _are_different(left: Point, right: Point) -> bool:
    if abs(left.evidence - right.evidence) > STEEP_NATS:
        return True
    (mean, covariance), (other_mean, _) = left.sizes.moments(), right.sizes.moments()
    return bool(
        (np.abs(mean - other_mean) > MAX_STEP_SIGMA * np.sqrt(np.diagonal(covariance))).any()
    )


def _share_steps(line: Sequence[Point]) -> list[Point]:
    """Return points with their shares: half of both steps next to them, or half a step."""
    place = np.array([point.place for point in line])
    edge = np.concatenate([[place[0] - 0.5], 0.5 * (place[1:] + place[:-1]), [place[-1] + 0.5]])
    return [
        replace(point, share=share)
        for point, share in zip(line, np.diff(edge).tolist(), strict=True)
    ]

"""Average the sizes of an effect over its nuisance parameters: lags, exponents, instants.

Their grid is refined where the likelihood changes fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.diagnose.evidence.mixture import Mixture
from gyrostab.diagnose.predict.candidates import TIME_PARAMETER, Component, Variant
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.predict.windows import rebuild_variant
from gyrostab.diagnose.settings import INTERVAL_TAILS
from gyrostab.errors import OptionError
from gyrostab.noise import NORMAL_95
from gyrostab.physics.registry import effects
from gyrostab.units import HOUR

#: Value and standard error of a parameter, and the ends of its 95 % interval if it is asymmetric.
Size = tuple[float, ...]
MAX_ZERO_LAG_S = 1e-2  # a lag that counts as zero
#: Probability beyond the values that a grid supports. Design choice: a tenth of the tail of a 95 %
#: interval, so that the interval of a single normal law stays as it is.
SUPPORT_TAIL = 0.1 * INTERVAL_TAILS[0]
_SECONDS = {"s": 1.0, "h": HOUR}
#: Units of parameters that have values between those of the grid.
_SCALES = (*_SECONDS, "degC")
# Tolerances of the quadrature over the grid.
LIKELY_NATS = 6.0  # below the best, to which points count: a probability of 1 in 400
STEEP_NATS = 1.0  # from one point to the next, that the quadrature tolerates
MAX_STEP_SIGMA = 1.0  # change of a size from one point to the next, in its standard errors
MAX_ROUNDS = 5  # halvings of a step of the grid, and steps beyond its end
MAX_ADDED_POINTS = 40  # between the points of the grid
MAX_RATIO = 100.0  # of two neighbours, above which the smaller one counts as zero


class AveragedSizes(NamedTuple):
    """Sizes of a component, averaged over the noise and the nuisance parameters."""

    mean: Floats  # (column,)
    covariance: Floats  # (column, column)
    #: (2, column): ends of the 95 % intervals, those of a normal law, but not beyond the values
    #: that the grid supports. Sizes at neighbours on a coarse grid may differ by many standard
    #: errors, and the scatter of the mean then reaches zero although none of them does.
    ends: Floats
    #: Nuisance parameters; NaN as the standard error of one that is set but not measured.
    nuisance: dict[str, Size]
    #: Sizes at the likeliest point of the grid, and that point. These values belong together; sizes
    #: at some value of a nuisance parameter may be far from the effect with both averages.
    likeliest_sizes: Floats
    likeliest_variant: Variant


def average_sizes(component: Component, state: State) -> AveragedSizes:
    """Return the sizes of a component, averaged over the noise and the nuisance parameters.

    Exponents have their defaults and lags are zero unless other values are better by 3 nats and an
    error of the form. The scatter of the sizes includes all lags that the record allows, even when
    the lag is given as zero. Exponents are not averaged over, because each gives the size another
    unit. The state has all other effects in the model.
    """
    points = refine_grid(component, state, choose_grid(component, state))
    family = [point.variant for point in points]
    evidence = np.array([point.evidence for point in points])
    merged = _merge_points(points)
    mean, covariance = merged.moments()
    supported = [merged]
    at_once = _places_without_lag(family)
    without_lag = [
        place
        for place in at_once
        if evidence[place]
        > evidence.max()
        - state.settings.ambiguous_nats
        - state.settings.form_error_share * max(component.evidence_nats, 0.0)
    ]
    if without_lag:
        at_zero_lag = _merge_points([points[place] for place in without_lag])
        middle, _ = at_zero_lag.moments()
        mean, covariance = middle, covariance + np.outer(middle - mean, middle - mean)
        supported.append(at_zero_lag)
    ends = _size_interval(mean, covariance, supported)
    weighed = evidence + np.log([point.share for point in points])
    share = np.exp(weighed - np.logaddexp.reduce(weighed))
    nuisance = _average_nuisance(family, share, has_no_lag=bool(without_lag))
    at_best = max(without_lag or range(len(points)), key=lambda place: evidence[place])
    best, _ = points[at_best].sizes.moments()
    return AveragedSizes(mean, covariance, ends, nuisance, best, family[at_best])


def _average_nuisance(
    family: Sequence[Variant], share: Floats, *, has_no_lag: bool
) -> dict[str, Size]:
    """Average the nuisance parameters of variants with these probabilities (variant,)."""
    nuisance: dict[str, Size] = {}
    names = (
        key
        for variant in family
        for key, value in variant.values.items()
        if not isinstance(value, str)
    )
    for name in dict.fromkeys(names):
        tried = np.array([float(variant.values[name]) for variant in family])
        if not np.isfinite(tried).all():
            continue
        if np.ptp(tried) == 0.0:
            nuisance[name] = (float(tried[0]), math.nan)
            continue
        is_zero = has_no_lag and _is_lag(name)
        value = 0.0 if is_zero else float(share @ tried)
        stderr = max(
            math.sqrt(float(share @ (tried - value) ** 2)), 0.3 * _grid_spacing(tried, value)
        )
        ends = () if is_zero else _interval_ends(tried, share, value)
        nuisance[name] = (value, stderr, *ends)
    return nuisance


def choose_grid(component: Component, state: State) -> list[Point]:
    """Return the grid that the sizes of a component are averaged over.

    It has the plain variants alone (`plain_places`), unless others are clearly better.
    """
    family = component.candidate.family(component.variant)
    grid = [Point(variant, component_mixture(component, state, variant)) for variant in family]
    plain = [grid[place] for place in plain_places(component.candidate.effect, family)]
    top = max(point.evidence for point in grid)
    is_plain = any(point.evidence > top - state.settings.ambiguous_nats for point in plain)
    return plain if is_plain else grid


def _size_interval(mean: Floats, covariance: Floats, supported: Sequence[Mixture]) -> Floats:
    """Return the ends of the 95 % intervals, (2, column), within what any of the mixtures allows.

    Examples
    --------
    >>> grid = Mixture(np.log([0.9, 0.1]), np.array([[10.0], [40.0]]), np.ones((2, 1, 1)))
    >>> mean, covariance = grid.moments()
    >>> (mean - NORMAL_95 * np.sqrt(covariance[0])).round(1).tolist()
    [-4.7]
    >>> _size_interval(mean, covariance, [grid])[0].round(1).tolist()
    [7.2]
    """
    half = NORMAL_95 * np.sqrt(np.diagonal(covariance))
    low, high = (
        extreme.reduce(bounds)
        for extreme, bounds in zip(
            (np.fmin, np.fmax),
            np.stack([mixture.quantiles(SUPPORT_TAIL) for mixture in supported], axis=1),
            strict=True,
        )
    )
    return np.stack([np.fmax(mean - half, low), np.fmin(mean + half, high)])


def _merge_points(points: Sequence[Point]) -> Mixture:
    mixtures = [point.weighed() for point in points]
    return Mixture(
        *(
            np.concatenate([getattr(mixture, name) for mixture in mixtures])
            for name in ("log_weight", "mean", "covariance")
        )
    )


def plain_places(effect: str, family: Sequence[Variant]) -> list[int]:
    """Return the places of variants whose parameters, except lags, have their defaults.

    Their sizes have the same unit.
    """
    defaults = {item.name: item.default for item in effects()[effect].parameters()}
    tried = {
        name
        for name in defaults
        if not _is_lag(name)
        and any(variant.values.get(name) == defaults[name] for variant in family)
    }
    return [
        place
        for place, variant in enumerate(family)
        if all(variant.values.get(name, defaults[name]) == defaults[name] for name in tried)
    ]


def _places_without_lag(family: Sequence[Variant]) -> list[int]:
    """Return the places of the variants without a lag; empty where the effect has no lags."""
    lags = [
        [float(value) for name, value in variant.values.items() if _is_lag(name)]
        for variant in family
    ]
    return [place for place, values in enumerate(lags) if values and max(values) <= MAX_ZERO_LAG_S]


def _is_lag(name: str) -> bool:
    return name == "lag" or name.endswith("_lag")


def _interval_ends(tried: Floats, share: Floats, middle: float) -> tuple[float, float]:
    """Return the ends of the 95 % interval of a nuisance parameter on a grid.

    Each value represents all that are nearer to it than to its neighbours, and as much beyond the
    last. Lags, time constants and dead bands are known to a factor, so that the interval extends
    further up than down.
    """
    values, place = np.unique(tried, return_inverse=True)
    between = np.where(
        values[:-1] > values[1:] / 100.0,
        np.sqrt(values[:-1] * values[1:]),
        0.5 * (values[:-1] + values[1:]),
    )
    first, last = values[0] - (between[0] - values[0]), values[-1] + (values[-1] - between[-1])
    edge = np.concatenate([[max(first, 0.0)], between, [last]])
    below = np.append(0.0, np.cumsum(np.bincount(place, weights=share)))
    low, high = np.interp(INTERVAL_TAILS, below / below[-1], edge)
    return min(float(low), middle), max(float(high), middle)


def _grid_spacing(grid: Floats, place: float) -> float:
    """Return the distance of the grid's values about a place."""
    values = np.unique(grid)
    nearest = int(np.abs(values - place).argmin())
    return float(np.diff(values[max(nearest - 1, 0) : nearest + 2]).mean())


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
    from point to point. The grid has a line for each value of its other parameters. Steps about the
    best point of every line are halved as long as the peak between the points may be likely. Points
    within a step share its weight.
    """
    scale = _find_scale(component, points)
    if scale is None:
        return list(points)
    grid = _Grid(component, state, *scale, points)
    for line in grid.lines:
        for down in (True, False) if len(line) > 1 else ():
            grid.extend_line(line, down=down)
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
        # the grid of instants is fine already
        if len(values) > 2 and units.get(name) in _SCALES and name != TIME_PARAMETER:
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
        likely = self.find_best().evidence - LIKELY_NATS
        is_first = not any(point.place % 1.0 for point in self.points)
        steps = []
        for line in self.lines:
            peak, highest = _find_peak(line)
            for left, right in pairwise(line):
                is_at_peak = peak is left or peak is right
                top = highest if is_at_peak else max(left.evidence, right.evidence)
                if top > likely and ((is_first and is_at_peak) or _are_different(left, right)):
                    steps.append((line, left, right))
        steps.sort(key=lambda step: -max(point.evidence for point in step[1:]))
        added = []
        for line, left, right in steps[:most]:
            low, high = sorted(map(self.value_at, (left, right)))
            # in the logarithm unless one end is near zero
            middle = math.sqrt(low * high) if low > high / MAX_RATIO else 0.5 * (low + high)
            added.append(self._add_point(line, left, middle, 0.5 * (left.place + right.place)))
        return any(point is not None for point in added)

    def extend_line(self, line: list[Point], *, down: bool) -> None:
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
            variant = rebuild_variant(self.component.candidate, sought, self.state)
        except OptionError:
            return None
        if variant is None:
            return None
        added = _make_point(variant, component_mixture(self.component, self.state, variant), place)
        line.append(added)
        line.sort(key=lambda point: point.place)
        return added


def _find_peak(line: Sequence[Point]) -> tuple[Point, float]:
    """Return the best point of a line, and an upper bound of the evidence between points.

    A concave curve through three points at equal distances rises above the middle one by at most
    the larger of the differences to the other two.
    """
    place = max(range(len(line)), key=lambda place: line[place].evidence)
    lowest = min(point.evidence for point in line[max(place - 1, 0) : place + 2])
    return line[place], 2.0 * line[place].evidence - lowest


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

"""Average the sizes of an effect over its nuisance parameters: lags, exponents, instants."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.mixture import Mixture
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.grid_refinement import Point, refine_grid
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.settings import INTERVAL_TAILS
from gyrostab.noise import NORMAL_95
from gyrostab.physics.registry import effects

Array = NDArray[np.float64]
MAX_ZERO_LAG_S = 1e-2  # a lag that counts as zero
#: Probability beyond the values that a grid supports. Design choice: a tenth of the tail of a 95 %
#: interval, so that the interval of a single normal law stays as it is.
SUPPORT_TAIL = 0.1 * INTERVAL_TAILS[0]


def average_sizes(
    component: Component, state: State, candidates: Sequence[Candidate]
) -> tuple[Array, Array, Array, dict[str, tuple[float, ...]], tuple[Array, Variant]]:
    """Return the sizes of a component, averaged over the noise and the nuisance parameters.

    Exponents have their defaults and lags are zero unless other values are better by 3 nats and an
    error of the form. The scatter of the sizes includes all lags that the record allows, even when
    the lag is given as zero. Exponents are not averaged over, because each gives the size another
    unit. The state has all other effects in the model, and the candidates are all that were tried;
    they have the grid.

    Returns
    -------
    mean, covariance : ndarray, shape (column,) and (column, column)
    ends : ndarray, shape (2, column)
        Ends of the 95 % intervals: those of a normal law, but not beyond the values that the grid
        supports. Sizes at neighbours on a coarse grid may differ by many standard errors, and the
        scatter of the mean then reaches zero although none of them does.
    nuisance : dict of str to (float, float) or (float, float, float, float)
        Value and standard deviation of the nuisance parameters, with the ends of the 95 % interval
        if it is asymmetric; NaN as the standard deviation of one that is set but not measured.
    likeliest : (ndarray, Variant)
        Sizes at the likeliest point of the grid, and that point. These values belong together;
        sizes at some value of a nuisance parameter may be far from the effect with both averages.
    """
    points = refine_grid(component, state, choose_grid(component, state, candidates))
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
    nuisance: dict[str, tuple[float, ...]] = {}
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
        has_no_lag = bool(without_lag) and _is_lag(name)
        middle_of = 0.0 if has_no_lag else float(share @ tried)
        spread = max(
            math.sqrt(float(share @ (tried - middle_of) ** 2)),
            0.3 * _grid_spacing(tried, middle_of),
        )
        nuisance[name] = (
            (middle_of, spread)
            if has_no_lag
            else (middle_of, spread, *_interval_ends(tried, share, middle_of))
        )
    at_best = max(without_lag or range(len(points)), key=lambda place: evidence[place])
    best, _ = points[at_best].sizes.moments()
    return mean, covariance, ends, nuisance, (best, family[at_best])


def choose_grid(component: Component, state: State, candidates: Sequence[Candidate]) -> list[Point]:
    """Return the grid that the sizes of a component are averaged over.

    It has the plain variants alone (`plain_places`), unless others are clearly better.
    """
    grid = [
        Point(variant, component_mixture(component, state, variant))
        for variant in _variant_family(component, candidates)
    ]
    family = [point.variant for point in grid]
    plain = [grid[place] for place in plain_places(component.candidate.effect, family)]
    top = max(point.evidence for point in grid)
    is_plain = any(point.evidence > top - state.settings.ambiguous_nats for point in plain)
    return plain if is_plain else grid


def _size_interval(mean: Array, covariance: Array, supported: Sequence[Mixture]) -> Array:
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


def _variant_family(component: Component, candidates: Sequence[Candidate]) -> list[Variant]:
    """Return the variants of the component with the same columns and texts: the grid."""
    candidate = next(
        (
            candidate
            for candidate in candidates
            if candidate.key == component.candidate.key
            and candidate.statistic is component.statistic
        ),
        component.candidate,
    )
    return candidate.family(component.variant)


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


def _interval_ends(tried: Array, share: Array, middle: float) -> tuple[float, float]:
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


def _grid_spacing(grid: Array, place: float) -> float:
    """Return the distance of the grid's values about a place."""
    values = np.unique(grid)
    nearest = int(np.abs(values - place).argmin())
    return float(np.diff(values[max(nearest - 1, 0) : nearest + 2]).mean())

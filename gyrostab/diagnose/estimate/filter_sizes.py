"""Fit the cutoff or length of a filter of the logger to the spectrum."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from gyrostab.arrays import Floats
from gyrostab.diagnose.baseline.expected_statistics import band_columns, reduced_shape
from gyrostab.diagnose.baseline.posterior import (
    BandPowers,
    average_blocks,
    choose_filter,
    fit_behind,
)
from gyrostab.diagnose.predict.average_sizes import Size
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.filter_response import band_response
from gyrostab.diagnose.predict.linear_model import State, band_widths, stack_columns, unspread_share
from gyrostab.diagnose.settings import INTERVAL_TAILS
from gyrostab.noise import NORMAL_95
from gyrostab.physics.registry import effects

ZOOM_POINTS, ZOOM_STEPS = 21, 4  # of the refinement of a cutoff on its grid
_CUTOFF_STEP = 0.01  # relative, of the likeliest cutoff; limits resolution

GRID_REACH = 0.25  # distance in ln(cutoff) of one place on the grid of filters

MIN_ELSEWHERE_SHARE = 0.02  # of the probability, from which on other places widen the interval


def fit_filter_sizes(
    components: Sequence[Component], state: State
) -> tuple[dict[str, Size], dict[str, float]]:
    """Fit the cutoff or length of a filter to the powers of all its axes, with free noise.

    The parameter that is measured has its standard error, and the ends of its 95 % interval where
    several places of the grid fit. The other values are the order, and how the samples are made.
    """
    kind = effects()[components[0].candidate.effect]
    axis_powers = [_average_powers(component.row[0], state) for component in components]
    columns = band_columns(state.blocks)

    def fit_all(values: Mapping[str, Any]) -> list[tuple[float, float]]:
        response = state.recall(
            lambda: band_response(kind.example(**values), state.blocks),
            f"{kind.name} {sorted(values.items())}".encode(),
        )
        return [fit_behind(bands, mixing @ (columns * response)) for bands, mixing in axis_powers]

    def likelihood(values: Mapping[str, Any]) -> float:
        return sum(nats for nats, _ in fit_all(values))

    family = [
        variant.values
        for variant in components[0].candidate.variants
        if components[0].statistic.is_filter(variant)
    ]
    behind = [fit_all(values) for values in family]
    between = _best_sizes(family, np.array(behind).sum(axis=1)[:, 0], likelihood)
    family, behind = family + between, behind + [fit_all(values) for values in between]
    log, quantization = np.array(behind).sum(axis=1).T
    best = family[choose_filter(log, quantization, state.settings)]
    name = "cutoff" if best["cutoff"] else "length"
    other_values = {key: float(value) for key, value in best.items() if key != name}
    if name == "length" and best["instrument"] == 1.0:
        return {name: (float(best[name]), 0.0)}, other_values  # a count of samples
    grid = sorted(
        {
            float(values[name])
            for values in family
            if all(values[key] == best[key] for key in other_values)
        }
    )
    refined = _refine_on_grid(
        grid, float(best[name]), lambda value: likelihood({**best, name: value})
    )
    return {
        name: _widen_interval(
            refined,
            [
                (float(values[name]), log_likelihood)
                for values, log_likelihood in zip(family, log, strict=True)
                if values[name]
            ],
        )
    }, other_values


def _best_sizes(
    family: Sequence[Mapping[str, Any]],
    log: Floats,
    likelihood: Callable[[Mapping[str, Any]], float],
) -> list[Mapping[str, Any]]:
    """Return the likeliest cutoff of each kind of low-pass, between its neighbours on the grid.

    A strong filter has a narrower likelihood than the grid is fine. `log` has the log likelihoods
    of the family.
    """
    kinds: dict[tuple[Any, ...], list[int]] = {}
    for place, values in enumerate(family):
        if values["cutoff"]:
            kind = tuple(value for name, value in values.items() if name != "cutoff")
            kinds.setdefault(kind, []).append(place)
    likeliest: list[Mapping[str, Any]] = []
    for places in kinds.values():
        best = int(np.argmax(log[places]))
        values = family[places[best]]
        cutoffs = [float(family[place]["cutoff"]) for place in places]
        minimum = minimize_scalar(
            lambda cutoff: -likelihood({**values, "cutoff": cutoff}),  # noqa: B023
            bounds=(cutoffs[max(best - 1, 0)], cutoffs[min(best + 1, len(cutoffs) - 1)]),
            method="bounded",
            options={"xatol": _CUTOFF_STEP * cutoffs[best]},
        )
        likeliest.append({**values, "cutoff": float(minimum.x)})
    return likeliest


def _refine_on_grid(
    grid: Sequence[float], start: float, likelihood: Callable[[float], float]
) -> tuple[float, float]:
    """Return mean and standard deviation of a parameter about the best point of its grid."""
    place = grid.index(start)
    low, high = grid[max(place - 1, 0)], grid[min(place + 1, len(grid) - 1)]
    mean, sd = start, (high - low) / 4.0
    for _ in range(ZOOM_STEPS):
        values = np.linspace(low, high, ZOOM_POINTS)
        log = np.array([likelihood(value) for value in values])
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        mean = float(weight @ values)
        sd = max(float(np.sqrt(weight @ (values - mean) ** 2)), 0.3 * (values[1] - values[0]))
        low, high = max(mean - 5.0 * sd, low), min(mean + 5.0 * sd, high)
    return mean, sd


def _widen_interval(
    refined: tuple[float, float], tried: Sequence[tuple[float, float]]
) -> tuple[float, ...]:
    """Return a parameter with its error, and its 95 % interval if several filters fit.

    With free noise that rises with frequency, a low-pass at a low cutoff does what a weak one at a
    high cutoff does. Other orders, and samples that are picked, have other cutoffs.

    `refined` has mean and standard deviation about the best place, `tried` the values of all
    filters of the family, evenly spread in their logarithm, and their log likelihoods.
    """
    value, log = (np.array(column) for column in zip(*sorted(tried), strict=True))
    share = np.exp(log - np.logaddexp.reduce(log))
    mean, sd = refined
    is_near = np.abs(np.log(value / mean)) <= max(GRID_REACH, 2.0 * sd / mean)
    if share[~is_near].sum() < MIN_ELSEWHERE_SHARE:
        return refined
    below, above = share.cumsum(), share[::-1].cumsum()[::-1]
    low = min(float(value[below >= INTERVAL_TAILS[0]].min()), mean - NORMAL_95 * sd)
    high = max(float(value[above >= INTERVAL_TAILS[0]].max()), mean + NORMAL_95 * sd)
    return mean, (high - low) / (2.0 * NORMAL_95), low, high


def _average_powers(axis: str, state: State) -> tuple[BandPowers, Floats]:
    """Average the powers of an axis over the record, with free noise and effects.

    The second result is how gaps mix the bands of the noise.
    """
    blocks, row = state.blocks, state.axes.index(axis)
    power, shape = blocks["power"].values[row], reduced_shape(blocks)[row]
    effects_of_axis = state.power_columns(axis)
    columns = [unspread_share(blocks)[row, :, None], state.expected_power[row], *effects_of_axis]
    averaged = average_blocks(
        power,
        np.where(state.masked[row][:, None], np.nan, shape),
        np.nan_to_num(stack_columns(columns, shape.shape)),
    )
    unspread, start, free = np.split(averaged.columns, [1, 2], axis=1)
    width = band_widths(blocks)
    mixing = np.diag(unspread[:, 0]) + (1.0 - unspread) * (width / width.sum())
    return averaged._replace(
        columns=mixing @ band_columns(blocks),
        free_columns=free / np.maximum(np.abs(free).max(axis=0), 1e-300),
        start=start[:, 0],
    ), mixing

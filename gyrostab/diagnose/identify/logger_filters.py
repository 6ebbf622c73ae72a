"""Filters of the logger: their size from the shape of the spectrum, and lines that are nothing but its slope."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.expected_statistics import band_columns, common_variance
from gyrostab.diagnose.baseline.posterior import Fit, expected_powers
from gyrostab.diagnose.predict.candidates import Candidate
from gyrostab.diagnose.predict.condition import Component, condition_on
from gyrostab.diagnose.predict.filter_response import band_response, is_filter
from gyrostab.diagnose.predict.linear_model import State, unspread_share
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.predict.sizes import component_size
from gyrostab.noise import NORMAL_95
from gyrostab.physics.registry import effects

__all__ = ["filter_sizes", "on_all_axes", "without_slopes"]

Array = NDArray[np.float64]
_KEPT = 0.5  # of its gain, that a line must keep beside a filter
_FINE, _ZOOMS = 21, 4
_NEXT, _ELSEWHERE, _TAIL = (
    0.25,
    0.02,
    0.025,
)  # reach of a place on the grid; shares of what lies elsewhere
_APART, _FORM = (
    6.0,
    0.1,
)  # nats by which axes may disagree by chance; and of the gain, what an error of the spectrum may leave


def without_slopes(
    passing: list[str], components: Mapping[str, list[Component]], state: State, folds: xr.DataArray
) -> list[str]:
    """Keys without lines that are gone, or nearly so, when the spectrum is straightened by a filter that passes as well.

    A line is judged by its neighbours, so that the steep slope of a filter, or the lobes of an
    average, look like one. Lines that stay come before the filter: what they leave in their bands,
    many of them, has a broad form too.
    """
    lines = [key for key in passing if components[key][0].candidate.statistic == "line"]
    filters = [
        key
        for key in passing
        if any(
            is_filter(component.candidate.statistic, component.variant)
            for component in components[key]
        )
    ]
    if not lines or not filters:
        return passing
    trial = condition_on(state, list(components[filters[0]]))
    again = compute_evidence(_candidates(components, lines), trial.blocks, trial, folds)
    left = {one.candidate.key: float(np.maximum(one.evidence_nats[0], 0.0).sum()) for one in again}
    before = {
        key: sum(max(component.evidence_nats, 0.0) for component in components[key])
        for key in lines
    }
    real = {key for key in lines if left.get(key, 0.0) > _KEPT * before[key]}
    return [
        key for key in passing if (key in real if key in lines else key not in filters or not real)
    ]


def on_all_axes(components: Sequence[Component], state: State) -> bool:
    """Whether one filter suits all axes: they pass the same logger, so that it takes the same share of the noise of each.

    The share of the strongest part is fitted on every axis, also on those that do not show it, and
    once for all of them.
    """
    shown = [
        component
        for component in components
        if is_filter(component.candidate.statistic, component.variant)
    ]
    if not shown:
        return True
    first = max(shown, key=lambda component: component.evidence_nats)
    share, error = np.array(
        [component_size(replace(first, row=(axis,)), state) for axis in state.axes]
    ).T
    weight = error**-2.0
    apart = 0.5 * float((weight * (share - (weight * share).sum() / weight.sum()) ** 2).sum())
    return apart <= _APART + _FORM * sum(max(component.evidence_nats, 0.0) for component in shown)


def _candidates(components: Mapping[str, list[Component]], keys: Iterable[str]) -> list[Candidate]:
    return [components[key][0].candidate for key in keys]


def filter_sizes(
    components: Sequence[Component], state: State
) -> tuple[dict[str, tuple[float, ...]], dict[str, float]]:
    """Cutoff or length of a filter, and the words beside it, by the likelihood of the powers of all its axes with free noise.

    Returns
    -------
    sizes : dict of str to (float, float) or (float, float, float, float)
        The one parameter that is measured, with its error; and with the ends of its 95 % interval
        where several places suit.
    others : dict of str to float
        Order, and what the samples are.
    """
    kind = effects()[components[0].candidate.effect]
    fits = [_fit(component.row[0], state) for component in components]

    def likelihood(values: Mapping[str, Any]) -> float:
        filtered = (
            band_columns(state.blocks)
            * band_response(kind.example(**values), state.blocks)[:, None]
        )
        return sum(_likelihood(fit._replace(columns=seen @ filtered)) for fit, seen in fits)

    family = [one.values for one in components[0].candidate.variants if is_filter("power", one)]
    log = [likelihood(one) for one in family]
    best = family[int(np.argmax(log))]
    name = "cutoff" if best["cutoff"] else "length"
    others = {key: float(value) for key, value in best.items() if key != name}
    if name == "length" and best["instrument"] == 1.0:
        return {name: (float(best[name]), 0.0)}, others  # a count of samples
    alike = sorted(
        {float(one[name]) for one in family if all(one[key] == best[key] for key in others)}
    )
    sharp = _zoomed(alike, float(best[name]), lambda value: likelihood({**best, name: value}))
    return {
        name: _of_all(
            sharp,
            [(float(one[name]), each) for one, each in zip(family, log, strict=True) if one[name]],
        )
    }, others


def _zoomed(
    grid: Sequence[float], start: float, likelihood: Callable[[float], float]
) -> tuple[float, float]:
    """Mean and standard deviation of a parameter about the best point of its grid, by a likelihood."""
    place = grid.index(start)
    low, high = grid[max(place - 1, 0)], grid[min(place + 1, len(grid) - 1)]
    mean, sd = start, (high - low) / 4.0
    for _ in range(_ZOOMS):
        values = np.linspace(low, high, _FINE)
        log = np.array([likelihood(value) for value in values])
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        mean = float(weight @ values)
        sd = max(float(np.sqrt(weight @ (values - mean) ** 2)), 0.3 * (values[1] - values[0]))
        low, high = max(mean - 5.0 * sd, low), min(mean + 5.0 * sd, high)
    return mean, sd


def _of_all(sharp: tuple[float, float], tried: Sequence[tuple[float, float]]) -> tuple[float, ...]:
    """A parameter with its error; and with the ends of its 95 % interval where more of the grid than one place suits the record.

    With free noise that rises with frequency a low-pass far down does what a weak one far up does;
    and other orders, or samples that are picked, have cutoffs of their own.

    Parameters
    ----------
    sharp : (float, float)
        Mean and standard deviation about the best place.
    tried : sequence of (float, float)
        Values of all filters of the family, evenly spread in their logarithm, and logarithms of
        their likelihoods.
    """
    value, log = (np.array(one) for one in zip(*sorted(tried), strict=True))
    share = np.exp(log - np.logaddexp.reduce(log))
    mean, sd = sharp
    near = np.abs(np.log(value / mean)) <= max(_NEXT, 2.0 * sd / mean)
    if share[~near].sum() < _ELSEWHERE:
        return sharp
    below, above = share.cumsum(), share[::-1].cumsum()[::-1]
    low = min(float(value[below >= _TAIL].min()), mean - NORMAL_95 * sd)
    high = max(float(value[above >= _TAIL].max()), mean + NORMAL_95 * sd)
    return mean, (high - low) / (2.0 * NORMAL_95), low, high


def _fit(axis: str, state: State) -> tuple[Fit, Array]:
    """Powers of an axis averaged over the record, with the noise and what else is named free; and how gaps mix the bands of the noise."""
    blocks = state.blocks
    row = state.axes.index(axis)
    power, shape = (
        blocks[name].transpose("axis", "block", "band").values[row] for name in ("power", "shape")
    )
    use = np.where(
        np.isfinite(power) & np.isfinite(shape) & ~state.masked[row][:, None], shape, 0.0
    )
    total = np.maximum(use.sum(axis=0), 1e-300)
    common, alone = (one[row] for one in common_variance(blocks))
    each = np.nansum(alone, axis=1)
    share = min(1.0, float((each / (1.0 + common * each)).sum() / max(np.nansum(shape), 1e-300)))

    def mean(values: Array) -> Array:
        return np.asarray(
            (use * np.nan_to_num(np.broadcast_to(values, use.shape))).sum(axis=0) / total
        )

    whole = mean(unspread_share(blocks)[row, :, None])
    width = (blocks["band_high"] - blocks["band_low"]).values
    seen = np.diag(whole) + np.outer(1.0 - whole, width / width.sum())
    beside = [mean(one) for one in state.given.get(("power", axis), [])]
    free = (
        np.stack([one / max(np.abs(one).max(), 1e-300) for one in beside], axis=1)
        if beside
        else None
    )
    return Fit(
        mean(power),
        seen @ band_columns(blocks),
        total * share,
        free_columns=free,
        start=mean(state.weight[row]),
    ), seen


def _likelihood(fit: Fit) -> float:
    """Largest log likelihood of the powers, over the noise."""
    expected = expected_powers(fit)
    return float(-(fit.weight * (np.log(expected) + fit.power / expected)).sum())

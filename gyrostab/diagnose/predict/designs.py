"""Designs: columns of a linear model for the prediction of an effect, by statistic."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.noise import sampled_psd
from gyrostab.physics.prediction import Prediction

__all__ = ["BUILDERS", "Candidate", "Variant"]

Array = NDArray[Any]


@dataclass(frozen=True)
class Variant:
    """One point of the grid of nuisance parameters.

    Attributes
    ----------
    values : mapping
        Nonlinear parameters and their values.
    columns : tuple of str
        Linear parameters, one per column.
    design : ndarray
        By statistic. mean: (column, axis, block) [degree hour-1 per unit]; power: (column, axis,
        block, band), added density [degree2 hour-2 Hz-1 per unit], of the squared parameter if
        `squared`; cross: the same for the product of the factors of two axes; order: (1, axis,
        harmonic), complex; phase_locked: (column, phase); transfer: (column, band), complex; marks,
        line: empty; wander: (column, block); levels: (1, 1, block), empty before the means
        determine the course. The axis has the size 1 if all axes have the same design.
    squared : bool
        Whether the parameter enters by its square.
    time : float
        Correlation time of a random mean [s], inf for a random walk.
    weight : float
        Prior probability relative to the other variants of the candidate.
    inside : ndarray, shape (block, sub_block)
        For levels: share of the sub-blocks on the upper level; empty unless the bias switches
        within blocks.
    """

    values: Mapping[str, Any]
    columns: tuple[str, ...]
    design: Array
    squared: bool = False
    time: float = np.inf
    weight: float = 1.0
    inside: Array = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class Candidate:
    """An effect in one statistic.

    Attributes
    ----------
    effect : str
        Name in the registry; that of a nuisance alternative begins with "~".
    statistic : str
        One of `STATISTIC_NAMES`.
    driver : tuple of str
        Channels of the log that it follows, in the order of the effect's channels; an empty string
        for a missing one.
    variants : tuple of Variant
        Over the grid of nuisance parameters.
    marks : tuple of str
        Sample counts that it raises, for the statistic "marks".
    reference : tuple of str
        Reference channel or axis of each column, for the statistic "transfer".
    each : bool
        Whether every axis has its own size; otherwise one size holds for all.
    """

    effect: str
    statistic: str
    driver: tuple[str, ...]
    variants: tuple[Variant, ...]
    marks: tuple[str, ...] = ()
    reference: tuple[str, ...] = ()
    each: bool = True

    @property
    def key(self) -> str:
        """Name with the channels, which distinguishes candidates of the same effect."""
        named = ",".join(filter(None, (*self.driver, *self.reference)))
        return f"{self.effect}({named})" if named else self.effect


def _column_choices(columns: Sequence[str]) -> list[tuple[str, ...]]:
    """Return each parameter alone, and all together."""
    alone: list[tuple[str, ...]] = [(name,) for name in columns]
    return alone if len(alone) < 2 else [*alone, tuple(columns)]


# -------------------------------------------------------------------------------
# statistics


def _mean_designs(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    """Yield designs of the mean that are not constant; the constant is free."""
    columns = {}
    for name, design in seen.mean.items():
        moved = design - design.mean(axis=-1, keepdims=True)
        if np.isfinite(moved).all() and np.abs(moved).max() > 1e-9 * np.abs(design).max(
            initial=1e-300
        ):
            columns[name] = design
    for chosen in _column_choices(list(columns)):
        yield Variant(values, chosen, np.stack([columns[name] for name in chosen]))


def _power_designs(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    """Yield added densities; for a filter what it adds or removes at its full size.

    Constant coherent densities are left to the cross-spectra.
    """
    frequency, rate = blocks["frequency"].values, float(blocks.attrs["sampling_rate_hz"])
    level: dict[str, Array] = {}
    for (symbol, name), share in seen.level.items():
        square = (
            coefficient.sel(term=symbol).values ** 2
            if symbol in coefficient["term"].values
            else np.zeros(coefficient.sizes["axis"])
        )
        component = (
            np.atleast_2d(share)[..., None]
            * square[:, None, None]
            * sampled_psd(symbol, frequency, rate)
        )
        level[name] = level.get(name, 0.0) + component
    spectrum = {}
    if seen.line is None:
        spectrum = {
            name: _with_axis(density)
            for name, density in seen.spectrum.items()
            if _changes_over_time(density) or not seen.coherent
        }
    for columns, squared in ((level, False), (spectrum, True)):
        kept = {
            name: density
            for name, density in columns.items()
            if np.abs(density).max(initial=0.0) > 0 and not _is_white_and_constant(density)
        }
        for chosen in _column_choices(list(kept)):
            yield Variant(
                values, chosen, np.stack([kept[name] for name in chosen]), squared=squared
            )
    if seen.response is not None:
        yield Variant(values, (), _filter_change(seen.response, coefficient, frequency, rate)[None])


def _filter_change(
    response: Array, coefficient: xr.DataArray, frequency: Array, rate: float
) -> Array:
    """Return the change of the baseline spectrum by a response."""
    total = np.zeros((coefficient.sizes["axis"], 1, frequency.size))
    size, terms = coefficient.transpose("axis", "term").values, list(coefficient["term"].values)
    for symbol in (one for one in "QNBK" if one in terms):
        total += size[:, terms.index(symbol), None, None] ** 2 * sampled_psd(
            symbol, frequency, rate
        )
    return total * (response - 1.0)


def _with_axis(density: Array) -> Array:
    """Return a density with the axis first."""
    return np.asarray(density if np.ndim(density) == 3 else np.asarray(density)[None])


def _changes_over_time(density: Array) -> bool:
    """Return whether a density changes over time."""
    rows = _with_axis(density)
    return bool(np.abs(rows - rows[:, :1]).max(initial=0.0) > 1e-6 * np.abs(rows).max(initial=0.0))


def _is_white_and_constant(density: Array) -> bool:
    """Return whether a density is white and constant: a change of N, which is free."""
    return bool(np.ptp(_with_axis(density)) <= 1e-6 * np.abs(density).max(initial=0.0))


def _cross_designs(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    """Yield cross-densities per product of the factors of both axes."""
    if not seen.coherent or seen.line is not None or "cross" not in blocks:
        return
    for name, density in seen.spectrum.items():
        yield Variant(values, (name,), _with_axis(density)[None], squared=True)


def _order_designs(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    if "order" not in blocks:
        return
    count = blocks.sizes["harmonic"]
    for name, pattern in seen.order.items():
        yield Variant(values, (name,), pattern[None, :, :count])


def _profile_designs(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    if "profile" not in blocks:
        return
    kept = {
        name: design
        for name, design in seen.phase_locked.items()
        if np.isfinite(design).all() and np.ptp(design) > 0
    }
    for chosen in _column_choices(list(kept)):
        yield Variant(values, chosen, np.stack([kept[name] for name in chosen]))


def _sample_count_designs(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    if seen.marks:
        yield Variant(values, seen.marks, np.empty(0))


def _line_designs(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    """Yield a line of constant frequency; the spectrum itself determines the frequency."""
    if (
        seen.line is None
        or "line_power" not in blocks
        or not seen.coherent
        or np.ptp(seen.line) > 0
    ):
        return
    yield Variant({}, tuple(seen.spectrum), np.empty(0), squared=True)


def _random_process_designs(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    block = float(blocks.attrs["block_s"])
    for name, (time, variance) in seen.wander.items():
        if time >= block / 2.0:
            yield Variant(values, (name,), np.asarray(variance)[None], squared=True, time=time)


def _telegraph_designs(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    """Yield two levels; the means determine the course and its times."""
    if seen.levels:
        yield Variant({}, (seen.levels,), np.empty(0))


BUILDERS = {
    "marks": _sample_count_designs,
    "mean": _mean_designs,
    "power": _power_designs,
    "cross": _cross_designs,
    "order": _order_designs,
    "phase_locked": _profile_designs,
    "line": _line_designs,
    "wander": _random_process_designs,
    "levels": _telegraph_designs,
}

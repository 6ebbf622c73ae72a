"""Designs: what a prediction of an effect means for the columns of a linear model, view by view."""

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
    """One point of the nuisance grid.

    Attributes
    ----------
    values : mapping
        Parameters that are not linear -> their values.
    columns : tuple of str
        Linear parameters, one for each column.
    design : ndarray
        By view. mean: (column, axis, block) [degree hour-1 per unit]; power: (column, axis, block,
        band), added density [degree2 hour-2 Hz-1 per unit], of the squared parameter where
        `squared`; cross: the same for the product of the factors of two axes; order: (1, axis,
        harmonic), complex; phase_locked: (column, phase); transfer: (column, band), complex; marks,
        line: empty; wander: (column, block); levels: empty before the course is told by the means,
        then (1, 1, block). The axis has the size 1 where all axes have the same.
    squared : bool
        The parameter enters by its square.
    time : float
        Of a random mean: the time constant of its memory [s], inf for a walk.
    weight : float
        Chance of this point before the data are seen, against those of the other variants of the
        candidate.
    inside : ndarray, shape (block, piece)
        For levels: the share of pieces of the blocks on the upper level, where the bias hops within
        blocks; empty where it does not.
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
    """An effect in one view.

    Attributes
    ----------
    effect : str
        Name in the registry; a generic begins with "~".
    statistic : str
        One of `VIEWS`.
    driver : tuple of str
        Channels of the log that it follows, in the order of the effect's channels; empty string for
        one that is not there.
    variants : tuple of Variant
        Over the nuisance grid.
    marks : tuple of str
        Statistics of the distribution that it raises, for the view "marks".
    witness : tuple of str
        Channel or axis of each column, for the view "transfer".
    each : bool
        Every axis has a size of its own; else one size holds for all.
    """

    effect: str
    statistic: str
    driver: tuple[str, ...]
    variants: tuple[Variant, ...]
    marks: tuple[str, ...] = ()
    witness: tuple[str, ...] = ()
    each: bool = True

    @property
    def key(self) -> str:
        """Name with the channels, which tells two candidates of one effect apart."""
        named = ",".join(filter(None, (*self.driver, *self.witness)))
        return f"{self.effect}({named})" if named else self.effect


def _choices(columns: Sequence[str]) -> list[tuple[str, ...]]:
    """Each parameter by itself, and all together."""
    alone: list[tuple[str, ...]] = [(name,) for name in columns]
    return alone if len(alone) < 2 else [*alone, tuple(columns)]


# ------------------------------------------------------------------------------------------------------------------
# views


def _means(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    """Designs of the mean, each less its mean over time: the constant is free."""
    columns = {}
    for name, design in seen.mean.items():
        moved = design - design.mean(axis=-1, keepdims=True)
        if np.isfinite(moved).all() and np.abs(moved).max() > 1e-9 * np.abs(design).max(
            initial=1e-300
        ):
            columns[name] = design
    for chosen in _choices(list(columns)):
        yield Variant(values, chosen, np.stack([columns[name] for name in chosen]))


def _powers(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    """Added densities; a filter as what it adds or takes at its full size. What is constant and coherent is for the cross-spectra."""
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
            name: _rows(density)
            for name, density in seen.spectrum.items()
            if _moves(density) or not seen.coherent
        }
    for columns, squared in ((level, False), (spectrum, True)):
        kept = {
            name: density
            for name, density in columns.items()
            if np.abs(density).max(initial=0.0) > 0 and not _flat(density)
        }
        for chosen in _choices(list(kept)):
            yield Variant(
                values, chosen, np.stack([kept[name] for name in chosen]), squared=squared
            )
    if seen.response is not None:
        yield Variant(values, (), _filtered(seen.response, coefficient, frequency, rate)[None])


def _filtered(response: Array, coefficient: xr.DataArray, frequency: Array, rate: float) -> Array:
    total = np.zeros((coefficient.sizes["axis"], 1, frequency.size))
    size, terms = coefficient.transpose("axis", "term").values, list(coefficient["term"].values)
    for symbol in (one for one in "QNBK" if one in terms):
        total += size[:, terms.index(symbol), None, None] ** 2 * sampled_psd(
            symbol, frequency, rate
        )
    return total * (response - 1.0)


def _rows(density: Array) -> Array:
    """A density with the axis in front."""
    return np.asarray(density if np.ndim(density) == 3 else np.asarray(density)[None])


def _moves(density: Array) -> bool:
    """A density changes over the windows."""
    rows = _rows(density)
    return bool(np.abs(rows - rows[:, :1]).max(initial=0.0) > 1e-6 * np.abs(rows).max(initial=0.0))


def _flat(density: Array) -> bool:
    """A density is white and constant in time: a change of N, which is free."""
    return bool(np.ptp(_rows(density)) <= 1e-6 * np.abs(density).max(initial=0.0))


def _crosses(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    """Cross-densities per product of the factors of both axes."""
    if not seen.coherent or seen.line is not None or "cross" not in blocks:
        return
    for name, density in seen.spectrum.items():
        yield Variant(values, (name,), _rows(density)[None], squared=True)


def _orders(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    if "order" not in blocks:
        return
    count = blocks.sizes["harmonic"]
    for name, pattern in seen.order.items():
        yield Variant(values, (name,), pattern[None, :, :count])


def _profiles(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    if "profile" not in blocks:
        return
    kept = {
        name: design
        for name, design in seen.phase_locked.items()
        if np.isfinite(design).all() and np.ptp(design) > 0
    }
    for chosen in _choices(list(kept)):
        yield Variant(values, chosen, np.stack([kept[name] for name in chosen]))


def _marks(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    if seen.marks:
        yield Variant(values, seen.marks, np.empty(0))


def _lines(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    """A line that does not move, wherever it is; its frequency is found in the spectrum itself."""
    if (
        seen.line is None
        or "line_power" not in blocks
        or not seen.coherent
        or np.ptp(seen.line) > 0
    ):
        return
    yield Variant({}, tuple(seen.spectrum), np.empty(0), squared=True)


def _wanders(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    block = float(blocks.attrs["block_s"])
    for name, (time, variance) in seen.wander.items():
        if time >= block / 2.0:
            yield Variant(values, (name,), np.asarray(variance)[None], squared=True, time=time)


def _levels(
    values: dict[str, Any], seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Iterator[Variant]:
    """Two levels: the means themselves tell the course and its times."""
    if seen.levels:
        yield Variant({}, (seen.levels,), np.empty(0))


BUILDERS = {
    "marks": _marks,
    "mean": _means,
    "power": _powers,
    "cross": _crosses,
    "order": _orders,
    "phase_locked": _profiles,
    "line": _lines,
    "wander": _wanders,
    "levels": _levels,
}

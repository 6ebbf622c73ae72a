"""Candidates: what an effect predicts for a statistic, and where a record shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.physics.prediction import Prediction

if TYPE_CHECKING:
    from gyrostab.diagnose.statistics.base import Statistic

__all__ = ["Candidate", "CandidateEvidence", "Component", "Prospect", "Variant"]

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


class Prospect(NamedTuple):
    """An effect with given nuisance values, before a statistic makes variants of it.

    Attributes
    ----------
    values : dict
        Nuisance values.
    seen : Prediction
        From `gyrostab.physics.base.Effect.explain`.
    blocks : xarray.Dataset
        Block statistics.
    coefficient : xarray.DataArray
        ``(axis, term)``: noise of the baseline.
    """

    values: dict[str, Any]
    seen: Prediction
    blocks: xr.Dataset
    coefficient: xr.DataArray


@dataclass(frozen=True)
class Candidate:
    """An effect in one statistic.

    Attributes
    ----------
    effect : str
        Name in the registry; that of a nuisance alternative begins with "~".
    statistic : Statistic
        One of `gyrostab.diagnose.statistics.STATISTICS`.
    driver : tuple of str
        Channels of the log that it follows, in the order of the effect's channels; an empty string
        for a missing one.
    variants : tuple of Variant
        Over the grid of nuisance parameters.
    reference : tuple of str
        Reference channel or axis of each column, for a transfer.
    each : bool
        Whether every axis has its own size; otherwise one size holds for all.
    """

    effect: str
    statistic: Statistic
    driver: tuple[str, ...]
    variants: tuple[Variant, ...]
    reference: tuple[str, ...] = ()
    each: bool = True

    @property
    def key(self) -> str:
        """Name with the channels, which distinguishes candidates of the same effect."""
        named = ",".join(filter(None, (*self.driver, *self.reference)))
        return f"{self.effect}({named})" if named else self.effect

    @property
    def columns(self) -> set[str]:
        """Columns of all variants."""
        return {name for variant in self.variants for name in variant.columns}


@dataclass(frozen=True)
class Component:
    """One row of a statistic in which a named effect shows.

    Attributes
    ----------
    row : tuple of str
        Axes of the row.
    evidence_nats : float
        Held-out evidence [nats].
    place : int
        Index of the line, or of the set of harmonics; -1 if there is none.
    """

    candidate: Candidate
    variant: Variant
    row: tuple[str, ...]
    evidence_nats: float
    place: int = -1

    @property
    def statistic(self) -> Statistic:
        """The statistic in which the effect shows."""
        return self.candidate.statistic

    @property
    def is_filter(self) -> bool:
        """Whether the effect multiplies the spectrum rather than adds to it."""
        return self.candidate.statistic.is_filter(self.variant)


@dataclass(frozen=True)
class CandidateEvidence:
    """Evidence of one candidate.

    Attributes
    ----------
    rows : list of tuple of str
        Axes of each row.
    evidence_nats : ndarray, shape (record, row)
        Held-out evidence [nats].
    best : tuple of Variant
        Best variant of each row for the first record.
    place : ndarray, shape (record, row)
        Index of the line for lines; otherwise empty.
    """

    candidate: Candidate
    rows: list[tuple[str, ...]]
    evidence_nats: Array
    best: tuple[Variant, ...]
    place: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 0), np.int64))

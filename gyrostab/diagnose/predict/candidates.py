"""Candidates: what an effect predicts for a statistic, and where a record shows it.

Variants, candidates and components hold arrays: each is equal only to itself.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Ints
from gyrostab.physics.prediction import Prediction

if TYPE_CHECKING:
    from gyrostab.diagnose.statistics.base import Statistic


def content_digest(*items: Array | bytes | None) -> bytes:
    """Return a digest of arrays, with their types and shapes, and of bytes."""
    digest = hashlib.blake2b(digest_size=16)
    for item in items:
        if isinstance(item, np.ndarray):
            digest.update(f"{item.dtype.str}{item.shape}".encode())
            digest.update(np.ascontiguousarray(item).data)
        else:
            digest.update(b"none" if item is None else item)
    return digest.digest()


#: Nuisance parameter that is a time.
TIME_PARAMETER = "at"
#: Nuisance alternative -> description, in the order in which they are tried. Their names begin with
#: "~", those of effects do not.
NUISANCE_ALTERNATIVES = {
    "~bias(t)": "the bias wanders",
    "~levels": "the bias steps between several levels",
    "~N(t)": "the noise level changes",
    "~burst": "the noise level is higher for a while",
    "~S(f)": "the spectrum has another shape",
    "~outliers": "the distribution has heavy tails",
    "~cov": "the axes have noise in common",
    "~red": "the bias wanders far beyond its noise",
}


def is_nuisance(name: str) -> bool:
    """Return whether a name, or the key of a candidate, is that of a nuisance alternative."""
    return name.startswith("~")


@dataclass(frozen=True, eq=False)
class Variant:
    """One point of the grid of nuisance parameters."""

    values: Mapping[str, Any]  # nonlinear parameters and their values
    columns: tuple[str, ...]  # linear parameters, one per column
    #: By statistic. mean: (column, axis, block) [degree hour-1 per unit]; power: (column, axis,
    #: block, band), added density [degree2 hour-2 Hz-1 per unit], of the squared parameter if
    #: `squared`; cross: the same for the product of the factors of two axes; order: (1, axis,
    #: harmonic), complex; phase_locked: (column, phase); transfer: (column, band), complex; marks,
    #: line: empty; wander: (column, block); levels: (1, 1, block), empty before the means determine
    #: the course. The axis has the size 1 if all axes have the same design.
    design: Array
    squared: bool = False  # whether the parameter enters by its square
    time: float = np.inf  # correlation time of a random mean [s], inf for a random walk
    weight: float = 1.0  # prior probability relative to the other variants of the candidate
    #: (block, sub_block): for levels: share of the sub-blocks on the upper level; empty unless the
    #: bias switches within blocks.
    inside: Array = field(default_factory=lambda: np.empty(0))

    @property
    def texts(self) -> dict[str, str]:
        """Values that are texts."""
        return {name: value for name, value in self.values.items() if isinstance(value, str)}

    def has_columns_of(self, other: Variant) -> bool:
        """Return whether two variants have the same parameters, in the same power."""
        return self.columns == other.columns and self.squared == other.squared

    def with_columns(self, columns: tuple[str, ...]) -> Variant:
        """Return the variant with some of its columns."""
        if columns == self.columns:
            return self
        places = [self.columns.index(name) for name in columns]
        return replace(self, columns=columns, design=self.design[places])


class Prospect(NamedTuple):
    """An effect with given nuisance values, before a statistic makes variants of it."""

    values: dict[str, Any]
    prediction: Prediction  # from `gyrostab.physics.base.Effect.explain`
    blocks: xr.Dataset
    coefficient: xr.DataArray  # ``(axis, term)``: noise of the baseline


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect in one statistic."""

    effect: str  # name in the registry, or one of `NUISANCE_ALTERNATIVES`
    statistic: Statistic  # one of `gyrostab.diagnose.statistics.STATISTICS`
    #: Channels of the log that it follows, in the order of the effect's channels; an empty string
    #: for a missing one.
    driver: tuple[str, ...]
    variants: tuple[Variant, ...]  # over the grid of nuisance parameters
    reference: tuple[str, ...] = ()  # reference channel or axis of each column, for a transfer
    is_per_axis: bool = True  # whether every axis has its own size, instead of one for all

    @property
    def key(self) -> str:
        """Name with the channels, which distinguishes candidates of the same effect."""
        named = ",".join(filter(None, (*self.driver, *self.reference)))
        return f"{self.effect}({named})" if named else self.effect

    @cached_property
    def digest(self) -> bytes:
        """Digest of the statistic and of all designs."""
        return content_digest(
            f"{self.statistic.name}, per axis: {self.is_per_axis}".encode(),
            *(variant.design for variant in self.variants),
        )

    def family(self, variant: Variant) -> list[Variant]:
        """Return the variants with the columns and texts of a given one."""
        return [
            other
            for other in self.variants
            if other.has_columns_of(variant) and other.texts == variant.texts
        ]

    @property
    def columns(self) -> set[str]:
        """Columns of all variants."""
        return {name for variant in self.variants for name in variant.columns}


@dataclass(frozen=True, eq=False)
class Component:
    """One row of a statistic in which a named effect shows."""

    candidate: Candidate
    variant: Variant
    row: tuple[str, ...]  # axes of the row
    evidence_nats: float  # held-out evidence [nats]
    line_index: int = -1  # of the line, or of the set of harmonics; -1 if there is none
    note: str = ""  # sentence about terms that the record does not separate
    close: tuple[Variant, ...] = ()  # variants that explain the row about as well, the best first

    @property
    def statistic(self) -> Statistic:
        """The statistic in which the effect shows."""
        return self.candidate.statistic

    @property
    def is_step(self) -> bool:
        """Whether it is a step of the mean at a given time."""
        return self.statistic.is_linear_in_means and TIME_PARAMETER in self.variant.values

    @property
    def step_time(self) -> float:
        """Time of a step [s]."""
        return float(self.variant.values[TIME_PARAMETER])

    @property
    def is_filter(self) -> bool:
        """Whether the effect multiplies the spectrum rather than adds to it."""
        return self.candidate.statistic.is_filter(self.variant)


@dataclass(frozen=True)
class CandidateEvidence:
    """Evidence of one candidate."""

    candidate: Candidate
    rows: list[tuple[str, ...]]  # axes of each row
    evidence_nats: Array  # (record, row): held-out evidence [nats]
    best: tuple[Variant, ...]  # best variant of each row for the first record
    #: (record, row): index of the line, or of the set of harmonics; otherwise empty.
    line_index: Ints = field(default_factory=lambda: np.empty((0, 0), np.int64))
    #: (variant, row): log Bayes factors on the first record with their prior, or empty [nats].
    variant_nats: Array = field(default_factory=lambda: np.empty((0, 0)))


def numbered_columns(count: int) -> tuple[str, ...]:
    """Return column names for numbered columns."""
    return tuple(str(number) for number in range(count))

"""What the scores of every view do in null records: moments of each cell, and the law of the largest of all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.statistics import STATISTICS
from gyrostab.errors import OptionError

__all__ = ["NullScores", "StatisticNull", "Tail", "null_scores", "standardise"]

Array = NDArray[np.float64]
_BELOW = (
    1.4  # standard deviations below the largest of independent cells, from which on scores are kept
)
_AT_ONCE = 1_000_000  # band powers of the null records that are scored at once
_FIRST = 20  # null records that tell what a standard deviation is
_POOL = 100.0  # null records that the mean over like windows counts for
_SHARE = 0.25  # of the null records, the largest, to which the tail is fitted
_STEEPEST = (
    0.7  # scale of the tail of half a squared normal score, at least: that of a single cell is 1
)
_LEAST = 40
_LEAST_P = 1e-9  # a tail from hundreds of records says nothing of rarer things


@dataclass(frozen=True)
class Tail:
    """Law of the largest value of a record: the sample, and an exponential tail fitted to its upper quarter."""

    sample: Array
    start: float
    scale: float
    share: float

    def surprise(self, value: Array | float) -> Array:
        """``-log`` of the probability that the largest of a null record is `value` or more."""
        value = np.asarray(value, dtype=float)
        rank = (self.sample.size - np.searchsorted(self.sample, value) + 1.0) / (
            self.sample.size + 1.0
        )
        beyond = (value - self.start) / self.scale - np.log(self.share)
        return np.asarray(
            np.where(value > self.start, beyond, -np.log(np.clip(rank, self.share, 1.0)))
        )

    def level(self, p: float) -> float:
        """Value that the largest of a null record reaches with probability `p`."""
        return (
            float(self.start + self.scale * np.log(self.share / p))
            if p < self.share
            else float(np.quantile(self.sample, 1.0 - p))
        )


@dataclass(frozen=True)
class StatisticNull:
    """One view in the null records: moments of each cell, and the tail of half the square of the largest standardised score."""

    mean: Array
    spread: Array
    tail: Tail


@dataclass(frozen=True)
class NullScores:
    """All views in the null records.

    Attributes
    ----------
    statistics : mapping of str to ViewNull
        By the names of `gyrostab.diagnose.statistics.STATISTICS`.
    family : Tail
        Of the largest ``-log p`` over the views, p that of each view's largest score.
    records : int
        Null records.
    """

    statistics: Mapping[str, StatisticNull]
    family: Tail
    records: int

    def p_value(self, statistic: str, z: Array | float) -> Array:
        """Probability that a null record has so large a standardised score in any view, as this one has in this view."""
        own = self.statistics[statistic].tail.surprise(np.square(z) / 2.0)
        return np.asarray(np.clip(np.exp(-self.family.surprise(own)), _LEAST_P, 1.0))

    def critical(self, statistic: str, level: float) -> float:
        """Standardised score of a view at which the p-value is `level`."""
        t = self.statistics[statistic].tail.level(float(np.exp(-self.family.level(level))))
        return float(np.sqrt(2.0 * max(t, 0.0)))


def null_scores(baseline: xr.Dataset, nulls: Iterable[xr.Dataset]) -> NullScores:
    """Gather the scores of null records, chunk by chunk; of each only what lies far out is kept.

    Parameters
    ----------
    baseline : xarray.Dataset
        What the simulation expects.
    nulls : iterable of xarray.Dataset
        Null records, some with a leading dimension ``record`` at a time.

    Returns
    -------
    NullScores

    Raises
    ------
    OptionError
        When there are too few to tell.
    """
    gathered: dict[str, _Gathered] = {}
    records = 0
    for chunk in nulls:
        records += chunk.sizes["record"]
        size = max(1, _AT_ONCE * chunk.sizes["record"] // chunk["power"].size)
        for first in range(0, chunk.sizes["record"], size):
            component = chunk.isel(record=slice(first, first + size))
            for name, score in STATISTICS.items():
                found = score(component, baseline)
                if found is not None:
                    if name not in gathered:
                        gathered[name] = _Gathered(found)
                    gathered[name].add(found)
    if records < _LEAST:
        raise OptionError(
            f"{records} null records are too few to tell how often noise alone does as much; give nulls=400"
        )
    statistics = {}
    largest = {}
    for name, statistic in gathered.items():
        mean, spread, z = statistic.finish()
        half = z**2 / 2.0
        statistics[name] = StatisticNull(mean, spread, _tail(half))
        largest[name] = statistics[name].tail.surprise(half)
    return NullScores(statistics, _tail(np.max(list(largest.values()), axis=0)), records)


def standardise(scores: xr.Dataset, null: StatisticNull) -> Array:
    """Scores in standard deviations of the null records, below zero where one-sided."""
    z = (scores["z"].values - null.mean) / null.spread
    return np.asarray(np.maximum(z, 0.0) if scores.attrs["one_sided"] else z)


def _tail(largest: Array) -> Tail:
    sample = np.sort(largest)
    start = float(np.quantile(sample, 1.0 - _SHARE))
    above = sample[sample > start] - start
    share = max(above.size, 1) / (sample.size + 1.0)
    return Tail(sample, start, max(float(above.mean()) if above.size else 0.0, _STEEPEST), share)


class _Gathered:
    """Running sums of one view over the null records, and their scores far out."""

    def __init__(self, scores: xr.Dataset) -> None:
        self.shape = scores["z"].shape[1:]
        self.sums = np.zeros((3, int(np.prod(self.shape))))
        self.far: list[tuple[NDArray[np.int64], NDArray[np.int64], Array]] = []
        self.waiting: list[Array] = []
        self.records = 0
        self.one_sided = bool(scores.attrs["one_sided"])
        self.floor = np.broadcast_to(scores["floor"].values, self.shape).ravel()
        self.length = scores["stop"].values - scores["first"].values
        self.kept = np.sqrt(2.0 * np.log(max(np.isfinite(scores["z"].values[0]).sum(), 2))) - _BELOW

    def add(self, scores: xr.Dataset) -> None:
        z = scores["z"].values.reshape(scores.sizes["record"], -1)
        known = np.isfinite(z)
        filled = np.where(known, z, 0.0)
        self.sums += np.stack(
            [known.sum(axis=0), filled.sum(axis=0), np.square(filled).sum(axis=0)]
        )
        self.waiting.append(z)
        if self.records + sum(len(component) for component in self.waiting) >= _FIRST:
            self._keep()

    def _keep(self) -> None:
        """Keep what lies far out by the moments so far; they are good enough to leave out the rest."""
        mean, spread = _moments(self.sums, self._like(), self.floor)
        for z in self.waiting:
            with np.errstate(invalid="ignore"):
                away = (z - mean) / spread
                record, cell = np.nonzero((away if self.one_sided else np.abs(away)) > self.kept)
            self.far.append((record + self.records, cell, z[record, cell]))
            self.records += len(z)
        self.waiting = []

    def _like(self) -> Array:
        """Variance of each cell, averaged over the windows of the same length."""
        count, first, second = (component.reshape(self.shape) for component in self.sums)
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = np.maximum(second / count - (first / count) ** 2, 0.0)
        like = np.empty(self.shape)
        for length in np.unique(self.length):
            of = self.length == length
            there = count[:, of] > 1
            total = np.where(there, variance[:, of], 0.0).sum(axis=1, keepdims=True)
            like[:, of] = total / np.maximum(there.sum(axis=1, keepdims=True), 1)
        return like.ravel()

    def finish(self) -> tuple[Array, Array, Array]:
        """Mean and spread of every cell, and the largest standardised score of each record, judged by the other records."""
        self._keep()
        like = self._like()
        mean, spread = _moments(self.sums, like, self.floor)
        record, cell, z = (np.concatenate(component) for component in zip(*self.far, strict=True))
        others = self.sums[:, cell] - np.stack([np.ones(z.size), z, z**2])
        own_mean, own_spread = _moments(others, like[cell], self.floor[cell])
        away = (z - own_mean) / own_spread
        largest = np.full(self.records, self.kept)
        np.maximum.at(largest, record, np.nan_to_num(away if self.one_sided else np.abs(away)))
        return mean.reshape(self.shape), spread.reshape(self.shape), largest


def _moments(sums: Array, like: Array, floor: Array) -> tuple[Array, Array]:
    """Mean and standard deviation from running sums; the variance is drawn towards `like`."""
    count, first, second = sums
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = first / count
        variance = (np.maximum(second - count * mean**2, 0.0) + _POOL * like) / (count + _POOL)
    known = count > 1
    return np.where(known, mean, np.nan), np.where(
        known, np.maximum(np.sqrt(variance), floor), np.nan
    )

"""Distributions of scores in null records: moments of each cell, and that of the largest of all."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics import STATISTICS
from gyrostab.store.threads import map_in_order

_KEPT_BELOW_SIGMA = 1.4  # below the largest of independent cells, from which scores are kept
#: Powers of null records, in bands or at lines, that are scored at once; limits memory.
_POWERS_AT_ONCE = 1_000_000
_MIN_RECORDS_AT_ONCE = 20  # null records for the first estimate of a standard deviation
_MIN_TAIL_SCALE = 0.7  # of half a squared score; that of a single normal cell is 1
_MIN_EVIDENCE_SCALE = 0.1  # [nats]; keeps the tail from vanishing when null records score alike
MIN_P_VALUE = 1e-12  # floor of an extrapolated probability; decides nothing: no level is that low
_MIN_SCORE_P_VALUE = 1e-9  # a tail from hundreds of records is unreliable beyond


@dataclass(frozen=True)
class MaximumDistribution:
    """Distribution of the largest value of a record: sample, and exponential tail above 3/4."""

    sample: Floats
    start: float
    scale: float
    tail_share: float  # probability of the tail

    def surprise(self, value: Floats | float) -> Floats:
        """Return ``-log`` of the probability that a null record's largest is at least `value`."""
        value = np.asarray(value, dtype=float)
        rank = (self.sample.size - np.searchsorted(self.sample, value) + 1.0) / (
            self.sample.size + 1.0
        )
        beyond = (value - self.start) / self.scale - np.log(self.tail_share)
        return np.asarray(
            np.where(value > self.start, beyond, -np.log(np.clip(rank, self.tail_share, 1.0)))
        )

    def probability(self, value: Floats | float) -> Floats:
        """Return the probability that a null record's largest is at least `value`."""
        return np.asarray(np.clip(np.exp(-self.surprise(value)), MIN_P_VALUE, 1.0))

    def value_at(self, p: float) -> float:
        """Return the value that the largest of a null record reaches with probability `p`."""
        if p < self.tail_share:
            return float(self.start + self.scale * np.log(self.tail_share / p))
        return float(np.quantile(self.sample, 1.0 - p))


@dataclass(frozen=True)
class StatisticNull:
    """One statistic in null records: moments of cells, tail of half the squared largest score."""

    mean: Floats
    spread: Floats
    tail: MaximumDistribution


@dataclass(frozen=True)
class NullScores:
    """All statistics in null records."""

    #: By the names of `gyrostab.diagnose.statistics.STATISTICS`.
    statistics: Mapping[str, StatisticNull]
    #: Law of the largest ``-log p`` over the statistics, with p of each one's largest score.
    family: MaximumDistribution
    settings: Settings = DEFAULTS

    def p_value(self, statistic: str, z: Floats | float) -> Floats:
        """Return the probability that a null record is as extreme in any statistic as `z` here."""
        surprise = self.statistics[statistic].tail.surprise(np.square(z) / 2.0)
        return np.asarray(np.maximum(self.family.probability(surprise), _MIN_SCORE_P_VALUE))

    def critical(self, statistic: str, level: float) -> float:
        """Return the standardised score of a statistic at which the p-value is `level`."""
        t = self.statistics[statistic].tail.value_at(float(np.exp(-self.family.value_at(level))))
        return float(np.sqrt(2.0 * max(t, 0.0)))


def null_scores(
    baseline: xr.Dataset, nulls: Iterable[xr.Dataset], *, settings: Settings = DEFAULTS
) -> NullScores:
    """Collect the scores of null records chunk by chunk, keeping only extreme scores."""
    gathered: dict[str, _ScoreSums] = {}
    for part_scores in map_in_order(
        partial(_score_records, baseline=baseline), _split_records(nulls)
    ):
        for name, scores in part_scores.items():
            if name not in gathered:
                gathered[name] = _ScoreSums(scores, settings.pooled_records)
            gathered[name].add(scores)
    statistics = {}
    largest = {}
    for name, sums in gathered.items():
        mean, spread, z = sums.finish()
        half = z**2 / 2.0
        statistics[name] = StatisticNull(
            mean, spread, _fit_maximum(half, settings.tail_share, _MIN_TAIL_SCALE)
        )
        largest[name] = statistics[name].tail.surprise(half)
    family = _fit_maximum(
        np.max(list(largest.values()), axis=0), settings.tail_share, _MIN_TAIL_SCALE
    )
    return NullScores(statistics, family, settings)


def _split_records(nulls: Iterable[xr.Dataset]) -> Iterator[xr.Dataset]:
    """Yield null records, as many at a time as are scored at once."""
    for chunk in nulls:
        powers = max(chunk["power"].size, chunk["line_power"].size) // chunk.sizes["record"]
        size = max(_MIN_RECORDS_AT_ONCE, _POWERS_AT_ONCE // powers)
        for first in range(0, chunk.sizes["record"], size):
            yield chunk.isel(record=slice(first, first + size))


def _score_records(records: xr.Dataset, baseline: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return the scores of some null records in all statistics that they have, by name."""
    scores = {statistic.name: statistic.score(records, baseline) for statistic in STATISTICS}
    return {name: of_statistic for name, of_statistic in scores.items() if of_statistic is not None}


def standardise(scores: xr.Dataset, null: StatisticNull) -> Floats:
    """Return scores in standard deviations of the null records, at least 0 if one-sided."""
    z = (scores["z"].values - null.mean) / null.spread
    return np.asarray(np.maximum(z, 0.0) if scores.attrs["one_sided"] else z)


def fit_best_evidence(best: Floats, *, settings: Settings = DEFAULTS) -> MaximumDistribution:
    """Fit the distribution of the best evidence of a null record [nats].

    Examples
    --------
    >>> best = fit_best_evidence(np.random.default_rng(1).exponential(size=100_000))
    >>> abs(best.value_at(0.001) - np.log(1000)) < 0.1, abs(best.probability(5.0) - 0.007) < 0.001
    (np.True_, np.True_)
    """
    return _fit_maximum(best, settings.tail_share, _MIN_EVIDENCE_SCALE)


def _fit_maximum(largest: Floats, tail_share: float, min_scale: float) -> MaximumDistribution:
    """Fit the distribution of the largest values, with a tail of at least this scale."""
    sample = np.sort(largest)
    start = float(np.quantile(sample, 1.0 - tail_share))
    above = sample[sample > start] - start
    share = max(above.size, 1) / (sample.size + 1.0)
    return MaximumDistribution(
        sample, start, max(float(above.mean()) if above.size else 0.0, min_scale), share
    )


class _ScoreSums:
    """Running sums of one statistic over the null records, and its extreme scores."""

    def __init__(self, scores: xr.Dataset, pooled_records: float) -> None:
        self.pooled_records = pooled_records
        self.shape = scores["z"].shape[1:]
        self.sums = np.zeros((3, int(np.prod(self.shape))))
        self.extremes: list[tuple[Ints, Ints, Floats]] = []
        self.records = 0
        self.one_sided = bool(scores.attrs["one_sided"])
        self.floor = np.broadcast_to(scores["floor"].values, self.shape).ravel()
        self.length = scores["stop"].values - scores["first"].values
        self.kept = (
            np.sqrt(2.0 * np.log(max(np.isfinite(scores["z"].values[0]).sum(), 2)))
            - _KEPT_BELOW_SIGMA
        )

    def add(self, scores: xr.Dataset) -> None:
        """Add the scores of some null records."""
        z = scores["z"].values.reshape(scores.sizes["record"], -1)
        present = np.isfinite(z)
        filled = np.where(present, z, 0.0)
        self.sums += np.stack(
            [present.sum(axis=0), filled.sum(axis=0), np.square(filled).sum(axis=0)]
        )
        # the moments so far suffice to drop the scores that are not extreme
        mean, spread = self._pooled_moments(self.sums, self._pool_variance(), self.floor)
        with np.errstate(invalid="ignore"):
            deviation = (z - mean) / spread
            record, cell = np.nonzero(
                (deviation if self.one_sided else np.abs(deviation)) > self.kept
            )
        self.extremes.append((record + self.records, cell, z[record, cell]))
        self.records += len(z)

    def _pool_variance(self) -> Floats:
        """Return the variance of each cell, averaged over windows of equal length."""
        count, first, second = (part.reshape(self.shape) for part in self.sums)
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = np.maximum(second / count - (first / count) ** 2, 0.0)
        pooled_variance = np.empty(self.shape)
        for length in np.unique(self.length):
            same_length = self.length == length
            is_measured = count[:, same_length] > 1
            total = np.where(is_measured, variance[:, same_length], 0.0).sum(axis=1, keepdims=True)
            pooled_variance[:, same_length] = total / np.maximum(
                is_measured.sum(axis=1, keepdims=True), 1
            )
        return pooled_variance.ravel()

    def finish(self) -> tuple[Floats, Floats, Floats]:
        """Return mean and spread of every cell, and the largest scores by the other records."""
        pooled_variance = self._pool_variance()
        mean, spread = self._pooled_moments(self.sums, pooled_variance, self.floor)
        record, cell, z = (np.concatenate(part) for part in zip(*self.extremes, strict=True))
        other_sums = self.sums[:, cell] - np.stack([np.ones(z.size), z, z**2])
        own_mean, own_spread = self._pooled_moments(
            other_sums, pooled_variance[cell], self.floor[cell]
        )
        deviation = (z - own_mean) / own_spread
        largest = np.full(self.records, self.kept)
        np.maximum.at(
            largest, record, np.nan_to_num(deviation if self.one_sided else np.abs(deviation))
        )
        return mean.reshape(self.shape), spread.reshape(self.shape), largest

    def _pooled_moments(
        self, sums: Floats, pooled_variance: Floats, floor: Floats
    ) -> tuple[Floats, Floats]:
        """Return mean and standard deviation from running sums, with shrunk variance."""
        count, first, second = sums
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = first / count
            variance = (
                np.maximum(second - count * mean**2, 0.0) + self.pooled_records * pooled_variance
            ) / (count + self.pooled_records)
        is_measured = count > 1
        return np.where(is_measured, mean, np.nan), np.where(
            is_measured, np.maximum(np.sqrt(variance), floor), np.nan
        )

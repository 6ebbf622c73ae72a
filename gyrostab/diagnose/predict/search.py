"""Held-out gains of all candidates on a record or on many null records, view by view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.fast_switching import SwitchingEvidence, switching_evidence
from gyrostab.diagnose.evidence.folds import fold_subsets
from gyrostab.diagnose.evidence.held_out import linear_model_factors, mean_factors, score
from gyrostab.diagnose.evidence.sample_counts import (
    GRID_COUNTS,
    Expected,
    beyond_ends,
    expected_counts,
    has_coarse_grid,
    kurtosis_evidence,
    sample_count_evidence,
)
from gyrostab.diagnose.evidence.spectral_lines import expected_lines, line_evidence
from gyrostab.diagnose.evidence.telegraph import TelegraphCourses, telegraph_evidence
from gyrostab.diagnose.predict.candidates import Candidate, Variant
from gyrostab.diagnose.predict.linear_model import State, build_linear_model, drawn, statistic_rows

__all__ = [
    "CountEvidence",
    "Found",
    "compute_evidence",
    "fast_switching_evidence",
    "of_means",
    "together",
    "totals",
]

Array = NDArray[np.float64]
_OF_MEANS, _TAILS = (
    ("mean", "levels"),
    ("kurtosis", "outliers"),
)  # views of means; what the means do not hear of
_PRICE = 1.5  # nats that another axis or view must bring
_WITHIN = 2.0  # blocks that a bias stays on a level at most, where pieces of blocks know it better
_LONG = 3.0  # the same, where they can refute it
# standard deviations of a block's mean, above which four parts of a block are too few for its
# course
_STEP = 16.0
_MOST_BLOCKS = (
    20_000  # of null records that come together, in which two levels are sought on an axis
)


@dataclass(frozen=True)
class Found:
    """Gains of one candidate.

    Attributes
    ----------
    candidate : Candidate
    rows : list of tuple of str
        Axes that each row speaks about.
    evidence_nats : ndarray, shape (record, row)
        On held-out time [nats].
    best : tuple of Variant
        For each row the variant that the first record likes best.
    place : ndarray, shape (record, row)
        For the view "line" the number of the line; empty else.
    """

    candidate: Candidate
    rows: list[tuple[str, ...]]
    evidence_nats: Array
    best: tuple[Variant, ...]
    place: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 0), np.int64))


@dataclass(frozen=True)
class CountEvidence:
    """What null records say of counts: mean (axis, block) and spread (axis,) by name; of the kurtosis of a block both (axis,).

    And the axes whose rate was rounded to a lattice.
    """

    of: dict[str, tuple[Array, Array]]
    rounded: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))

    @classmethod
    def gathered(cls, expected: Expected, rounded: NDArray[np.bool_]) -> CountEvidence:
        """From all null records."""
        found = {}
        for name, components in expected.sums.items():
            if not components:
                continue
            values = expected.block_count(name)
            if name == "kurtosis":
                good = np.isfinite(values)
                clean = np.where(good, values, np.nan)
                found[name] = (np.nanmean(clean, axis=(0, 2)), np.nanstd(clean, axis=(0, 2)))
            else:
                found[name] = expected_counts(values)
        return cls(found, rounded)


def compute_evidence(
    candidates: Sequence[Candidate],
    data: xr.Dataset,
    state: State,
    folds: xr.DataArray,
    *,
    count_evidence: CountEvidence | None = None,
    rng: np.random.Generator | None = None,
) -> list[Found]:
    """Gains of candidates on data.

    Parameters
    ----------
    candidates : sequence of Candidate
    data : xarray.Dataset
        The recording, or null records.
    state : State
        What is in the model already.
    folds : xarray.DataArray
        From `fold_blocks`.
    count_evidence : Tallies, optional
        Without them the distribution is left out.
    rng : numpy.random.Generator, optional
        For null records: what they do not hold is drawn.
    """
    found: list[Found] = []
    groups: dict[tuple[object, ...], list[Candidate]] = {}
    for one in candidates:
        groups.setdefault(
            (one.statistic, one.witness, one.each if one.statistic == "order" else True), []
        ).append(one)
    for (statistic, *_), group in groups.items():
        if statistic == "mean":
            found += _means(group, data, state, folds)
        elif statistic == "marks":
            found += (
                [] if count_evidence is None else _marks(group, data, state, folds, count_evidence)
            )
        elif statistic == "line":
            found += _lines(group, data, state)
        elif statistic == "levels":
            found += _levels(group, data, state)
        elif statistic != "wander":
            found += _cells(group, data, state, folds, rng)
    return found


def of_means(found: Sequence[Found], before: State, now: State) -> list[Found]:
    """Those gains by means of blocks and of their pieces that still hold in another state; none where it knows more of the means.

    A line, say, changes nothing in them.
    """
    if before.baseline is not now.baseline or _of_means_given(before) != _of_means_given(now):
        return []
    left, right = (state.blocks.drop_vars(_TAILS, errors="ignore") for state in (before, now))
    return (
        [one for one in found if one.candidate.statistic in _OF_MEANS] if left.equals(right) else []
    )


def _of_means_given(state: State) -> dict[tuple[str, str], list[int]]:
    return {
        key: [id(column) for column in columns]
        for key, columns in state.given.items()
        if key[0] in ("mean", "inner") and columns
    }


def totals(found: Sequence[Found]) -> dict[str, Array]:
    """Gain of every effect by the key of its candidates, (record,), as `together` has it."""
    rows: dict[str, list[Array]] = {}
    for one in found:
        rows.setdefault(one.candidate.key, []).append(one.evidence_nats)
    return {key: together(np.concatenate(several, axis=1)) for key, several in rows.items()}


def together(evidence_nats: Array) -> Array:
    """Gain of an effect from its rows (..., row): that of the best, and what others bring beyond the price of naming them."""
    good = np.sort(np.nan_to_num(evidence_nats, neginf=-1e9), axis=-1)
    return np.asarray(good[..., -1] + np.maximum(good[..., :-1] - _PRICE, 0.0).sum(axis=-1))


def _collect(
    group: Sequence[Candidate], rows: list[tuple[str, ...]], factors: list[Array], spread: int = 1
) -> list[Found]:
    """From the factors of all variants of a group, row by row."""
    variants = [[one for one in each.variants for _ in range(spread)] for each in group]
    owner = np.repeat(np.arange(len(group)), [len(several) for several in variants])
    weight = [one.weight for several in variants for one in several]
    evidence_nats = np.stack(
        [score(one, owner, weight=weight) for one in factors], axis=-1
    )  # (candidate, record, row)
    first = (
        np.stack([one[0, :, 0] for one in factors], axis=-1) + np.log(weight)[:, None]
    )  # (design, row)
    out = []
    for number, each in enumerate(group):
        own = first[owner == number]
        best = tuple(variants[number][int(place)] for place in own.argmax(axis=0))
        out.append(
            Found(
                each,
                rows,
                evidence_nats[number],
                best,
                own.argmax(axis=0)[None] if spread > 1 else np.empty((0, 0), np.int64),
            )
        )
    return out


def _means(
    group: Sequence[Candidate], data: xr.Dataset, state: State, folds: xr.DataArray
) -> list[Found]:
    factors = []
    for row, axis in enumerate(state.axes):
        designs = [
            np.moveaxis(variant.design[:, row if variant.design.shape[1] > 1 else 0], 0, -1)
            for each in group
            for variant in each.variants
        ]
        given = state.given.get(("mean", axis))
        beside = np.stack(given, axis=-1) if given else None
        factors.append(
            mean_factors(data, state.baseline, designs, axis=axis, given=beside, folds=folds)[:, 1:]
        )
    return _collect(group, [(axis,) for axis in state.axes], factors)


def _cells(
    group: Sequence[Candidate],
    data: xr.Dataset,
    state: State,
    folds: xr.DataArray,
    rng: np.random.Generator | None,
) -> list[Found]:
    rows = statistic_rows(group[0], state)
    if not rows:  # pairs of a single axis
        return []
    factors = []
    spread = 1
    for row in range(len(rows)):
        there = rng is None or (
            group[0].statistic in ("power", "cross") and group[0].statistic in data
        )
        cells = build_linear_model(group, row, data if there else state.blocks, state)
        if not there and rng is not None:
            cells = drawn(cells, rng, data.sizes["record"])
        factors.append(linear_model_factors(cells, folds)[:, 1:])
        spread = factors[-1].shape[1] // sum(len(each.variants) for each in group)
    return _collect(group, rows, factors, spread)


def _marks(
    group: Sequence[Candidate],
    data: xr.Dataset,
    state: State,
    folds: xr.DataArray,
    count_evidence: CountEvidence,
) -> list[Found]:
    subsets = fold_subsets(folds)
    rows: list[tuple[str, ...]] = [(axis,) for axis in state.axes]
    coarse = has_coarse_grid(state.blocks)
    out = []
    for each in group:
        evidence_nats, best = [], []
        for variant in each.variants:
            components = [
                np.where(
                    coarse & (name in GRID_COUNTS),
                    0.0,
                    _mark(name, data, state, subsets, count_evidence),
                )
                for name in variant.columns
            ]
            evidence_nats.append(np.max(components, axis=0))
        place = np.argmax([one[0] for one in evidence_nats], axis=0)
        best = [each.variants[int(number)] for number in place]
        out.append(Found(each, rows, np.max(evidence_nats, axis=0), tuple(best)))
    return out


def _mark(
    name: str,
    data: xr.Dataset,
    state: State,
    subsets: NDArray[np.bool_],
    count_evidence: CountEvidence,
) -> Array:
    """Gain of a raised statistic, (record, axis)."""
    records = data.sizes.get("record", 1)
    if name == "lattice":
        return np.broadcast_to(
            _lattice(state, count_evidence) if "record" not in data.dims else 0.0,
            (records, len(state.axes)),
        )
    if name not in data or name not in count_evidence.of:
        return np.zeros((records, len(state.axes)))
    values = data[name].transpose(..., "axis", "block").values.astype(np.float64)
    values = values if values.ndim == 3 else values[None]
    values = beyond_ends(values) if name == "extremes" else values
    how = kurtosis_evidence if name == "kurtosis" else sample_count_evidence
    return how(values, *count_evidence.of[name], subsets)


def _lattice(state: State, count_evidence: CountEvidence) -> Array:
    """Samples of a rounded rate, one nat each: noise without a lattice never stands on it."""
    samples = state.blocks["samples"].transpose("axis", "block").values.sum(axis=1)
    return (
        np.where(count_evidence.rounded, samples, 0.0).astype(np.float64)
        if count_evidence.rounded.size
        else np.zeros(samples.size)
    )


def _lines(group: Sequence[Candidate], data: xr.Dataset, state: State) -> list[Found]:
    power = data["line_power"].transpose(..., "axis", "part", "line").values
    power = power if power.ndim == 4 else power[None]
    expected = expected_lines(state.baseline, state.blocks["line_frequency"].values)
    evidence_nats = line_evidence(
        power, state.blocks["line_weight"].transpose("axis", "part").values, expected
    )
    taken = state.given.get(("line", "all"), [])
    for mask in taken:
        evidence_nats = np.where(mask, -np.inf, evidence_nats)
    place = (
        np.maximum(evidence_nats, 0.0).sum(axis=1).argmax(axis=-1)
    )  # (record,), one line for all axes
    best = np.take_along_axis(evidence_nats, place[:, None, None], axis=2)[..., 0]
    best = np.where(np.isfinite(best), best, -np.log(power.shape[-1]))
    rows: list[tuple[str, ...]] = [(axis,) for axis in state.axes]
    places = np.repeat(place[:, None], len(rows), axis=1)
    return [
        Found(each, rows, best, tuple(each.variants[0] for _ in rows), places) for each in group
    ]


def _levels(group: Sequence[Candidate], data: xr.Dataset, state: State) -> list[Found]:
    """A bias of two levels, by axis.

    Its gain is below the logarithm of a Bayes factor, which chance lets pass x nats in exp(-x) of
    all records at most. So where records are long, some of the null records are enough.
    """
    records = data.sizes.get("record", 1)
    some = (
        data.isel(record=slice(max(1, _MOST_BLOCKS // data.sizes["block"])))
        if "record" in data.dims
        else data
    )
    rows: list[tuple[str, ...]] = [(axis,) for axis in state.axes]
    evidence_nats = np.full((records, len(rows)), -np.inf)
    courses: list[tuple[TelegraphCourses, SwitchingEvidence | None]] = []
    for row, axis in enumerate(state.axes):
        given = state.given.get(("mean", axis))
        found, course = telegraph_evidence(
            some, state.baseline, axis=axis, given=np.stack(given, axis=-1) if given else None
        )
        evidence_nats[: found.size, row] = found
        within, refuted = _within(some, state, axis, course, float(found[0]))
        if refuted:
            evidence_nats[0, row] = -np.inf
        if within is not None:
            evidence_nats[0, row] = max(within.evidence_nats, evidence_nats[0, row])
        courses.append((course, within))
    return [
        Found(
            each,
            rows,
            evidence_nats,
            tuple(_course(each.variants[0], *one, state) for one in courses),
        )
        for each in group
    ]


def _within(
    data: xr.Dataset, state: State, axis: str, course: TelegraphCourses, evidence_nats: float
) -> tuple[SwitchingEvidence | None, bool]:
    """Hops within blocks, where these tell more than the means of blocks do; and whether they say that there are not two levels."""
    found, block = _hops(data, state, axis), float(state.blocks.attrs["block_s"])
    if found is None:
        return None, False
    if not _resolved(found, block):
        return None, found.refuted and float(course.times[0].min()) < _LONG
    deviation = float(np.sqrt(np.nanmedian(state.baseline["mean_variance"].sel(axis=axis).values)))
    coarse = np.isfinite(evidence_nats) and float(course.step[0]) < _STEP * deviation
    return (None if coarse and found.times.min() > _WITHIN * block else found), False


def fast_switching_evidence(data: xr.Dataset, state: State, axis: str) -> SwitchingEvidence | None:
    """Two levels between which the bias hops within blocks; None where there are none."""
    found = _hops(data, state, axis)
    return (
        found
        if found is not None and _resolved(found, float(state.blocks.attrs["block_s"]))
        else None
    )


def _resolved(found: SwitchingEvidence, block: float) -> bool:
    """Whether pieces of blocks of so many seconds tell two levels; what is shorter than a piece is a spike."""
    return (
        bool(np.isfinite(found.evidence_nats))
        and float(found.times.min()) >= block / found.share.shape[1]
    )


def _hops(data: xr.Dataset, state: State, axis: str) -> SwitchingEvidence | None:
    """What pieces of blocks say; None where more is named in the means of blocks than is known of their pieces."""
    known, inner = (state.given.get((statistic, axis), []) for statistic in ("mean", "inner"))
    if len(inner) < len(known):
        return None
    return switching_evidence(
        data, state.baseline, axis=axis, given=np.stack(inner, axis=-1) if inner else None
    )


def _course(
    variant: Variant, found: TelegraphCourses, within: SwitchingEvidence | None, state: State
) -> Variant:
    """The variant with the course of the first record, and its mean times [s]."""
    if within is not None:
        low, high = within.times
        values = {"low": float(low), "high": float(high), "hops": within.hops}
        return replace(
            variant,
            values=values,
            design=within.share.mean(axis=1)[None, None],
            inside=within.share,
        )
    block = float(state.blocks.attrs["block_s"])
    low, high = found.times[0] * block
    values = {"low": float(low), "high": float(high), "hops": float(found.hops[0])}
    return replace(variant, values=values, design=found.share[0][None, None])

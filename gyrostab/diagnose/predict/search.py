"""Held-out evidence of all candidates on a recording or null records, by statistic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.fast_switching import SwitchingEvidence, switching_evidence
from gyrostab.diagnose.evidence.folds import fold_subsets
from gyrostab.diagnose.evidence.held_out import (
    held_out_evidence,
    linear_model_factors,
    mean_factors,
)
from gyrostab.diagnose.evidence.sample_counts import (
    GRID_COUNTS,
    ExpectedCounts,
    excess_extremes,
    expected_counts,
    has_coarse_grid,
    kurtosis_evidence,
    sample_count_evidence,
)
from gyrostab.diagnose.evidence.spectral_lines import expected_lines, line_evidence
from gyrostab.diagnose.evidence.telegraph import TelegraphCourses, telegraph_evidence
from gyrostab.diagnose.predict.candidates import Candidate, Variant
from gyrostab.diagnose.predict.linear_model import (
    State,
    build_linear_model,
    simulate_noise,
    statistic_rows,
)

__all__ = [
    "CandidateEvidence",
    "CountEvidence",
    "combine_rows",
    "compute_evidence",
    "evidence_by_effect",
    "fast_switching_evidence",
    "reusable_mean_evidence",
]

Array = NDArray[np.float64]
_MEAN_STATISTICS = ("mean", "levels")
_TAIL_VARIABLES = ("kurtosis", "outliers")  # not used by the evidence of means
_MIN_ROW_NATS = 1.5  # that another axis or statistic must add; design choice
_MAX_FAST_BLOCKS = 2.0  # mean time on a level, up to which sub-blocks are better; design choice
_MAX_REFUTED_BLOCKS = 3.0  # mean time on a level, up to which sub-blocks can refute it
#: Standard deviations of a block mean; for larger steps four parts of a block are too few for the
#: course. Design choice.
_MAX_COARSE_STEP_SIGMA = 16.0
_MAX_NULL_BLOCKS = 20_000  # of null records that are searched for two levels; limits time


@dataclass(frozen=True)
class CandidateEvidence:
    """Evidence of one candidate.

    Attributes
    ----------
    candidate : Candidate
    rows : list of tuple of str
        Axes of each row.
    evidence_nats : ndarray, shape (record, row)
        Held-out evidence [nats].
    best : tuple of Variant
        Best variant of each row for the first record.
    place : ndarray, shape (record, row)
        Index of the line for the statistic "line"; otherwise empty.
    """

    candidate: Candidate
    rows: list[tuple[str, ...]]
    evidence_nats: Array
    best: tuple[Variant, ...]
    place: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 0), np.int64))


@dataclass(frozen=True)
class CountEvidence:
    """Expected sample counts from null records, and the axes with a quantized rate.

    Mean (axis, block) and spread (axis,) by name; of the kurtosis of a block both (axis,).
    """

    of: dict[str, tuple[Array, Array]]
    rounded: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))

    @classmethod
    def gathered(cls, expected: ExpectedCounts, rounded: NDArray[np.bool_]) -> CountEvidence:
        """Compute the expected counts from all null records."""
        found = {}
        for name, counts in expected.sums.items():
            if not counts:
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
) -> list[CandidateEvidence]:
    """Compute the evidence of candidates on data.

    Parameters
    ----------
    candidates : sequence of Candidate
    data : xarray.Dataset
        The recording, or null records.
    state : State
        Current model.
    folds : xarray.DataArray
        From `fold_blocks`.
    count_evidence : CountEvidence, optional
        Without it, sample counts are left out.
    rng : numpy.random.Generator, optional
        For null records: generator of the statistics they do not have.
    """
    found: list[CandidateEvidence] = []
    groups: dict[tuple[object, ...], list[Candidate]] = {}
    for candidate in candidates:
        groups.setdefault(
            (
                candidate.statistic,
                candidate.reference,
                candidate.each if candidate.statistic == "order" else True,
            ),
            [],
        ).append(candidate)
    for (statistic, *_), group in groups.items():
        if statistic == "mean":
            found += _search_means(group, data, state, folds)
        elif statistic == "marks":
            found += (
                []
                if count_evidence is None
                else _search_sample_counts(group, data, state, folds, count_evidence)
            )
        elif statistic == "line":
            found += _search_lines(group, data, state)
        elif statistic == "levels":
            found += _search_telegraph(group, data, state)
        elif statistic != "wander":
            found += _search_linear_model(group, data, state, folds, rng)
    return found


def reusable_mean_evidence(
    found: Sequence[CandidateEvidence], before: State, now: State
) -> list[CandidateEvidence]:
    """Return the evidence from means that is still valid in another state, if its means are equal.

    A line, for example, changes nothing in them.
    """
    if before.baseline is not now.baseline or _given_mean_columns(before) != _given_mean_columns(
        now
    ):
        return []
    left, right = (
        state.blocks.drop_vars(_TAIL_VARIABLES, errors="ignore") for state in (before, now)
    )
    return (
        [evidence for evidence in found if evidence.candidate.statistic in _MEAN_STATISTICS]
        if left.equals(right)
        else []
    )


def _given_mean_columns(state: State) -> dict[tuple[str, str], list[int]]:
    """Return the identities of the columns given to the means."""
    return {
        key: [id(column) for column in columns]
        for key, columns in state.given.items()
        if key[0] in ("mean", "sub_block") and columns
    }


def evidence_by_effect(found: Sequence[CandidateEvidence]) -> dict[str, Array]:
    """Sum up the evidence (record,) of every effect by the key of its candidates."""
    rows: dict[str, list[Array]] = {}
    for evidence in found:
        rows.setdefault(evidence.candidate.key, []).append(evidence.evidence_nats)
    return {
        key: combine_rows(np.concatenate(row_evidence, axis=1))
        for key, row_evidence in rows.items()
    }


def combine_rows(evidence_nats: Array) -> Array:
    """Add up the evidence of an effect over its rows (..., row), minus the price of naming more."""
    good = np.sort(np.nan_to_num(evidence_nats, neginf=-1e9), axis=-1)
    return np.asarray(good[..., -1] + np.maximum(good[..., :-1] - _MIN_ROW_NATS, 0.0).sum(axis=-1))


def _collect_evidence(
    group: Sequence[Candidate], rows: list[tuple[str, ...]], factors: list[Array], spread: int = 1
) -> list[CandidateEvidence]:
    """Compute the held-out evidence of a group from the factors of all variants, by row."""
    variants = [
        [variant for variant in candidate.variants for _ in range(spread)] for candidate in group
    ]
    owner = np.repeat(np.arange(len(group)), [len(group_variants) for group_variants in variants])
    weight = [variant.weight for group_variants in variants for variant in group_variants]
    # (candidate, record, row)
    evidence_nats = np.stack(
        [held_out_evidence(row_factors, owner, weight=weight) for row_factors in factors], axis=-1
    )
    # (design, row)
    first = (
        np.stack([row_factors[0, :, 0] for row_factors in factors], axis=-1)
        + np.log(weight)[:, None]
    )
    out = []
    for number, candidate in enumerate(group):
        own = first[owner == number]
        best = tuple(variants[number][int(place)] for place in own.argmax(axis=0))
        out.append(
            CandidateEvidence(
                candidate,
                rows,
                evidence_nats[number],
                best,
                own.argmax(axis=0)[None] if spread > 1 else np.empty((0, 0), np.int64),
            )
        )
    return out


def _search_means(
    group: Sequence[Candidate], data: xr.Dataset, state: State, folds: xr.DataArray
) -> list[CandidateEvidence]:
    """Compute the evidence in block means."""
    factors = []
    for row, axis in enumerate(state.axes):
        designs = [
            np.moveaxis(variant.design[:, row if variant.design.shape[1] > 1 else 0], 0, -1)
            for candidate in group
            for variant in candidate.variants
        ]
        given = state.given.get(("mean", axis))
        given_columns = np.stack(given, axis=-1) if given else None
        factors.append(
            mean_factors(
                data, state.baseline, designs, axis=axis, given=given_columns, folds=folds
            )[:, 1:]
        )
    return _collect_evidence(group, [(axis,) for axis in state.axes], factors)


def _search_linear_model(
    group: Sequence[Candidate],
    data: xr.Dataset,
    state: State,
    folds: xr.DataArray,
    rng: np.random.Generator | None,
) -> list[CandidateEvidence]:
    """Compute the evidence in a statistic with independent cells."""
    rows = statistic_rows(group[0], state)
    if not rows:  # pairs of a single axis
        return []
    factors = []
    spread = 1
    for row in range(len(rows)):
        is_given = rng is None or (
            group[0].statistic in ("power", "cross") and group[0].statistic in data
        )
        model = build_linear_model(group, row, data if is_given else state.blocks, state)
        if not is_given and rng is not None:
            model = simulate_noise(model, rng, data.sizes["record"])
        factors.append(linear_model_factors(model, folds)[:, 1:])
        spread = factors[-1].shape[1] // sum(len(candidate.variants) for candidate in group)
    return _collect_evidence(group, rows, factors, spread)


def _search_sample_counts(
    group: Sequence[Candidate],
    data: xr.Dataset,
    state: State,
    folds: xr.DataArray,
    count_evidence: CountEvidence,
) -> list[CandidateEvidence]:
    """Compute the evidence in sample counts."""
    subsets = fold_subsets(folds)
    rows: list[tuple[str, ...]] = [(axis,) for axis in state.axes]
    coarse = has_coarse_grid(state.blocks)
    out = []
    for candidate in group:
        evidence_nats, best = [], []
        for variant in candidate.variants:
            by_name = [
                np.where(
                    coarse & (name in GRID_COUNTS),
                    0.0,
                    _count_evidence(name, data, state, subsets, count_evidence),
                )
                for name in variant.columns
            ]
            evidence_nats.append(np.max(by_name, axis=0))
        place = np.argmax([by_axis[0] for by_axis in evidence_nats], axis=0)
        best = [candidate.variants[int(number)] for number in place]
        out.append(CandidateEvidence(candidate, rows, np.max(evidence_nats, axis=0), tuple(best)))
    return out


def _count_evidence(
    name: str,
    data: xr.Dataset,
    state: State,
    subsets: NDArray[np.bool_],
    count_evidence: CountEvidence,
) -> Array:
    """Return the evidence of a raised count, (record, axis)."""
    records = data.sizes.get("record", 1)
    if name == "lattice":
        return np.broadcast_to(
            _grid_evidence(state, count_evidence) if "record" not in data.dims else 0.0,
            (records, len(state.axes)),
        )
    if name not in data or name not in count_evidence.of:
        return np.zeros((records, len(state.axes)))
    values = data[name].transpose(..., "axis", "block").values.astype(np.float64)
    values = values if values.ndim == 3 else values[None]
    values = excess_extremes(values) if name == "extremes" else values
    compute = kurtosis_evidence if name == "kurtosis" else sample_count_evidence
    return compute(values, *count_evidence.of[name], subsets)


def _grid_evidence(state: State, count_evidence: CountEvidence) -> Array:
    """Count samples of a rounded rate, one nat each: unrounded noise is never on the grid."""
    samples = state.blocks["samples"].transpose("axis", "block").values.sum(axis=1)
    return (
        np.where(count_evidence.rounded, samples, 0.0).astype(np.float64)
        if count_evidence.rounded.size
        else np.zeros(samples.size)
    )


def _search_lines(
    group: Sequence[Candidate], data: xr.Dataset, state: State
) -> list[CandidateEvidence]:
    """Compute the evidence of one steady line on all axes."""
    power = data["line_power"].transpose(..., "axis", "part", "line").values
    power = power if power.ndim == 4 else power[None]
    expected = expected_lines(state.baseline, state.blocks["line_frequency"].values)
    evidence_nats = line_evidence(
        power, state.blocks["line_weight"].transpose("axis", "part").values, expected
    )
    taken = state.given.get(("line", "all"), [])
    for mask in taken:
        evidence_nats = np.where(mask, -np.inf, evidence_nats)
    # (record,), one line for all axes
    place = np.maximum(evidence_nats, 0.0).sum(axis=1).argmax(axis=-1)
    best = np.take_along_axis(evidence_nats, place[:, None, None], axis=2)[..., 0]
    best = np.where(np.isfinite(best), best, -np.log(power.shape[-1]))
    rows: list[tuple[str, ...]] = [(axis,) for axis in state.axes]
    places = np.repeat(place[:, None], len(rows), axis=1)
    return [
        CandidateEvidence(candidate, rows, best, tuple(candidate.variants[0] for _ in rows), places)
        for candidate in group
    ]


def _search_telegraph(
    group: Sequence[Candidate], data: xr.Dataset, state: State
) -> list[CandidateEvidence]:
    """Compute the evidence of a bias of two levels, by axis.

    It is a lower bound of a log Bayes factor, which exceeds x nats by chance in at most exp(-x) of
    all records. Some of the null records are therefore enough if records are long.
    """
    records = data.sizes.get("record", 1)
    searched = (
        data.isel(record=slice(max(1, _MAX_NULL_BLOCKS // data.sizes["block"])))
        if "record" in data.dims
        else data
    )
    rows: list[tuple[str, ...]] = [(axis,) for axis in state.axes]
    evidence_nats = np.full((records, len(rows)), -np.inf)
    courses: list[tuple[TelegraphCourses, SwitchingEvidence | None]] = []
    for row, axis in enumerate(state.axes):
        given = state.given.get(("mean", axis))
        found, course = telegraph_evidence(
            searched, state.baseline, axis=axis, given=np.stack(given, axis=-1) if given else None
        )
        evidence_nats[: found.size, row] = found
        within, refuted = _search_fast_switching(searched, state, axis, course, float(found[0]))
        if refuted:
            evidence_nats[0, row] = -np.inf
        if within is not None:
            evidence_nats[0, row] = max(within.evidence_nats, evidence_nats[0, row])
        courses.append((course, within))
    return [
        CandidateEvidence(
            candidate,
            rows,
            evidence_nats,
            tuple(_variant_with_course(candidate.variants[0], *pair, state) for pair in courses),
        )
        for candidate in group
    ]


def _search_fast_switching(
    data: xr.Dataset, state: State, axis: str, course: TelegraphCourses, evidence_nats: float
) -> tuple[SwitchingEvidence | None, bool]:
    """Find switching within blocks, if better than in block means; and whether it refutes it."""
    found, block = _search_sub_blocks(data, state, axis), float(state.blocks.attrs["block_s"])
    if found is None:
        return None, False
    if not _is_resolved(found, block):
        return None, found.refuted and float(course.times[0].min()) < _MAX_REFUTED_BLOCKS
    deviation = float(np.sqrt(np.nanmedian(state.baseline["mean_variance"].sel(axis=axis).values)))
    coarse = (
        np.isfinite(evidence_nats) and float(course.step[0]) < _MAX_COARSE_STEP_SIGMA * deviation
    )
    return (None if coarse and found.times.min() > _MAX_FAST_BLOCKS * block else found), False


def fast_switching_evidence(data: xr.Dataset, state: State, axis: str) -> SwitchingEvidence | None:
    """Compute the evidence of a bias that switches within blocks; None if there is none."""
    found = _search_sub_blocks(data, state, axis)
    return (
        found
        if found is not None and _is_resolved(found, float(state.blocks.attrs["block_s"]))
        else None
    )


def _is_resolved(found: SwitchingEvidence, block: float) -> bool:
    """Return whether sub-blocks resolve two levels; anything shorter is a spike."""
    return (
        bool(np.isfinite(found.evidence_nats))
        and float(found.times.min()) >= block / found.share.shape[1]
    )


def _search_sub_blocks(data: xr.Dataset, state: State, axis: str) -> SwitchingEvidence | None:
    """Search sub-blocks; None if more is named in block means than is known in sub-blocks."""
    known, inner = (state.given.get((statistic, axis), []) for statistic in ("mean", "sub_block"))
    if len(inner) < len(known):
        return None
    return switching_evidence(
        data, state.baseline, axis=axis, given=np.stack(inner, axis=-1) if inner else None
    )


def _variant_with_course(
    variant: Variant, found: TelegraphCourses, within: SwitchingEvidence | None, state: State
) -> Variant:
    """Return the variant with the course of the first record, and its mean times [s]."""
    if within is not None:
        low, high = within.times
        values = {"low": float(low), "high": float(high), "switches": within.switch_count}
        return replace(
            variant,
            values=values,
            design=within.share.mean(axis=1)[None, None],
            inside=within.share,
        )
    block = float(state.blocks.attrs["block_s"])
    low, high = found.times[0] * block
    values = {"low": float(low), "high": float(high), "switches": float(found.switch_count[0])}
    return replace(variant, values=values, design=found.share[0][None, None])

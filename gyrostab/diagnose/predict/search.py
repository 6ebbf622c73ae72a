"""Held-out evidence of candidates on a recording or null records."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Floats, Ints
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.evidence.products import held_out_evidence
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.predict.candidates import Candidate, CandidateEvidence
from gyrostab.diagnose.predict.linear_model import Result, State
from gyrostab.store.threads import map_in_order

_COLUMNS_AT_ONCE = 300  # limits memory and time, which grow with the square
_MIN_ROW_NATS = 1.5  # that another axis or statistic must add; design choice


class Trial(NamedTuple):
    """What candidates are tried on, with the names and meanings of `compute_evidence`."""

    data: xr.Dataset
    state: State
    folds: xr.DataArray
    count_evidence: CountEvidence | None = None
    rng: np.random.Generator | None = None

    @property
    def is_null(self) -> bool:
        """Whether the data are null records."""
        return "record" in self.data.dims

    def recall(
        self, compute: Callable[[], Result], group: Sequence[Candidate], *inputs: Array | None
    ) -> Result:
        """Compute something for candidates; on the recording, recall it if nothing has changed."""
        if self.is_null:
            return compute()
        return self.state.recall(compute, *(candidate.digest for candidate in group), *inputs)


def compute_evidence(
    candidates: Sequence[Candidate],
    data: xr.Dataset,
    state: State,
    *,
    count_evidence: CountEvidence | None = None,
    rng: np.random.Generator | None = None,
) -> list[CandidateEvidence]:
    """Compute the evidence of candidates on the recording, or on null records.

    Without `count_evidence`, sample counts are left out. `rng` generates the statistics that null
    records do not have: each part of the candidates has a separate generator, so that the result
    does not depend on the threads that compute the parts.
    """
    trial = Trial(data, state, fold_blocks(state.blocks), count_evidence, rng)
    groups: dict[tuple[object, ...], list[Candidate]] = {}
    for candidate in candidates:
        group_key = (candidate.statistic, candidate.reference, candidate.is_per_axis)
        groups.setdefault(group_key, []).append(candidate)
    parts = [part for group in groups.values() for part in _split_group(group)]
    trials = (
        [trial] * len(parts)
        if rng is None
        else [trial._replace(rng=own) for own in rng.spawn(len(parts))]
    )
    by_part = map_in_order(
        lambda item: item[0][0].statistic.evidence(*item), zip(parts, trials, strict=True)
    )
    return list(chain.from_iterable(by_part))


def _split_group(group: Sequence[Candidate]) -> Iterator[list[Candidate]]:
    """Split candidates into parts of few columns, each with at least one candidate."""
    columns = [sum(len(variant.design) for variant in candidate.variants) for candidate in group]
    part = np.cumsum(columns) // _COLUMNS_AT_ONCE
    for number in np.unique(part):
        yield [candidate for candidate, own in zip(group, part, strict=True) if own == number]


def evidence_by_effect(all_evidence: Sequence[CandidateEvidence]) -> dict[str, Floats]:
    """Sum up the evidence (record,) of every effect by the key of its candidates."""
    rows: dict[str, list[Floats]] = {}
    for evidence in all_evidence:
        rows.setdefault(evidence.candidate.key, []).append(evidence.evidence_nats)
    return {
        key: combine_rows(np.concatenate(row_evidence, axis=1))
        for key, row_evidence in rows.items()
    }


def combine_rows(evidence_nats: Floats) -> Floats:
    """Add up the evidence of an effect over its rows (..., row), minus the price of naming more."""
    good = np.sort(np.nan_to_num(evidence_nats, neginf=-1e9), axis=-1)
    return np.asarray(good[..., -1] + np.maximum(good[..., :-1] - _MIN_ROW_NATS, 0.0).sum(axis=-1))


def collect_evidence(
    group: Sequence[Candidate],
    rows: list[tuple[str, ...]],
    factors: list[Floats],
    designs_per_variant: int = 1,
) -> list[CandidateEvidence]:
    """Compute the held-out evidence of a group from the factors of all variants, by row.

    A variant has several designs where each set of harmonics is one; the evidence then has the
    index of the best.
    """
    variants = [
        [variant for variant in candidate.variants for _ in range(designs_per_variant)]
        for candidate in group
    ]
    owner = np.repeat(np.arange(len(group)), [len(group_variants) for group_variants in variants])
    weight = np.array([variant.weight for group_variants in variants for variant in group_variants])
    weighted = list(zip(factors, _share_variants(factors, owner, weight), strict=True))
    # (candidate, record, row)
    evidence_nats = np.stack(
        [held_out_evidence(row, owner, weight=prior) for row, prior in weighted], axis=-1
    )
    # (design, row)
    first = np.stack([row[0, :, 0] + np.log(prior[:, 0]) for row, prior in weighted], axis=-1)
    out = []
    for number, candidate in enumerate(group):
        variant_nats = first[owner == number]
        place = variant_nats.argmax(axis=0)
        best = tuple(variants[number][at] for at in place.tolist())
        evidence = CandidateEvidence(candidate, rows, evidence_nats[number], best)
        out.append(
            replace(evidence, line_index=place[None])
            if designs_per_variant > 1
            else replace(evidence, variant_nats=variant_nats)
        )
    return out


def _share_variants(factors: Sequence[Floats], owner: Ints, weight: Floats) -> list[Floats]:
    """Return the probability of each variant for each row before its data, (design, record).

    Axes usually share an instant, a lag or a time constant. The row with the largest factor has the
    prior; all others have half of it, and half of what the first row leaves. The cost of a search
    over variants is thus paid once for all rows, and ln 2 for each other row.
    """
    starts = np.flatnonzero(np.diff(owner, prepend=-1))
    joint = [row[0] + np.log(weight)[:, None] for row in factors]
    total = [np.logaddexp.reduceat(row, starts, axis=0)[owner] for row in joint]
    variant_prior = np.exp(
        np.log(weight)[:, None] - np.log(np.add.reduceat(weight, starts))[owner, None]
    )
    best = np.argmax(total, axis=0)
    posterior = np.take_along_axis(
        np.stack([np.exp(row - row_total) for row, row_total in zip(joint, total, strict=True)]),
        best[None],
        axis=0,
    )[0]
    return [
        np.where(best == row, variant_prior, 0.5 * (variant_prior + posterior))
        for row in range(len(factors))
    ]

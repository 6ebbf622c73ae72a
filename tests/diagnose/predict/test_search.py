"""Evidence of candidates: axes that share an instant pay for its search once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from gyrostab.arrays import Floats
from gyrostab.diagnose.evidence.folds import FOLDS
from gyrostab.diagnose.predict.candidates import Candidate, Variant
from gyrostab.diagnose.predict.search import collect_evidence
from gyrostab.diagnose.statistics import find_statistic

VARIANTS = 100
AXES = [("x",), ("y",)]


def evidence_of_peaks(peaks: Sequence[tuple[int, float]]) -> tuple[Floats, list[int]]:
    """Evidence on each axis, and best variants; one variant of an axis has this log factor."""
    variants = tuple(
        Variant({"at": float(instant)}, ("step",), np.empty(0)) for instant in range(VARIANTS)
    )
    candidate = Candidate("bias_jump", find_statistic("mean"), (), variants)
    factors = []
    for variant, nats in peaks:
        row = np.full((1 + FOLDS, VARIANTS, 1), -2.0)
        row[:, variant] = nats
        factors.append(row)
    (evidence,) = collect_evidence([candidate], AXES, factors)
    return evidence.evidence_nats[0], [int(variant.values["at"]) for variant in evidence.best]


def test_axes_with_one_instant_pay_for_its_search_once():
    (first, second), best = evidence_of_peaks([(40, 12.0), (40, 8.0)])
    assert best == [40, 40]
    assert first == pytest.approx(12.0 - np.log(VARIANTS), abs=0.02)
    assert second == pytest.approx(8.0 - np.log(2.0), abs=0.05)


def test_another_instant_of_an_axis_is_still_found():
    (first, second), best = evidence_of_peaks([(40, 12.0), (70, 8.0)])
    assert best == [40, 70]
    assert first == pytest.approx(12.0 - np.log(VARIANTS), abs=0.02)
    assert second == pytest.approx(8.0 - np.log(2 * VARIANTS), abs=0.3)


def test_noise_on_one_axis_gains_nothing_from_the_others():
    (_, single), _ = evidence_of_peaks([(40, 2.0), (70, -2.0)])
    assert single <= 0.0

"""Products of whitened columns: those of unrelated columns may be left out."""

from __future__ import annotations

import numpy as np

from gyrostab.diagnose.evidence.products import (
    column_pairs,
    log_evidence,
    marginalise,
    mean_products,
)


def test_evidence_does_not_need_products_of_unrelated_columns():
    rng = np.random.default_rng(8)
    values, columns = rng.standard_normal((60, 3)), rng.standard_normal((60, 7))
    frame_of = {
        "variance": np.ones(60),
        "step": 20.0,
        "K": np.array([0.0, 3.0]),
        "B": np.array([0.0, 0.5]),
        "present": rng.random(60) > 0.1,
    }
    numbers = [np.array(chosen) for chosen in ([0], [1, 2], [3], [4, 5])]
    whole = mean_products(values, columns, **frame_of)
    selected = mean_products(values, columns, **frame_of, pairs=column_pairs(7, numbers, 1))
    assert selected.gram[0, 0, 1] == 0.0 != whole.gram[0, 0, 1]
    expected, got = (
        log_evidence(
            marginalise(products, 1, np.eye(1)), numbers, np.full(6, 0.2), np.array([-1.0, -2.0])
        )
        for products in (whole, selected)
    )
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    separate = log_evidence(
        marginalise(whole, 1, np.eye(1)), numbers[3:], np.full(6, 0.2), np.array([-1.0, -2.0])
    )
    np.testing.assert_allclose(separate[1], got[4], rtol=1e-12)

"""Products of whitened columns, and the evidence of designs from them."""

from __future__ import annotations

import numpy as np
from scipy.integrate import quad
from scipy.stats import norm

from gyrostab.diagnose.evidence.products import (
    WIDTHS,
    column_pairs,
    log_evidence,
    marginalise,
    mean_products,
    power_products,
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
            marginalise(products, 1, np.eye(1)),
            numbers,
            np.full(6, 0.2),
            np.array([-1.0, -2.0]),
            np.array(WIDTHS),
        )
        for products in (whole, selected)
    )
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    separate = log_evidence(
        marginalise(whole, 1, np.eye(1)),
        numbers[3:],
        np.full(6, 0.2),
        np.array([-1.0, -2.0]),
        np.array(WIDTHS),
    )
    np.testing.assert_allclose(separate[1], got[4], rtol=1e-12)


def test_evidence_of_a_size_that_cannot_be_negative_is_that_of_half_a_prior():
    rng = np.random.default_rng(9)
    column, weight = rng.standard_normal(40), np.ones(40)
    limits = np.array([1.0 / np.linalg.norm(column)])
    for size in (-1.0, -0.1, 0.0, 0.5):
        values = size * column + rng.standard_normal(40)
        products = power_products(values[:, None], weight, column[:, None])
        without, got = log_evidence(
            products, [np.arange(1)], limits, np.zeros(1), np.array(WIDTHS), [True]
        )[:, 0]

        def integrand(factor: float, sd: float, values=values) -> float:
            misfit = values @ values - np.square(values - factor * column).sum()
            return float(2.0 * norm.pdf(factor, scale=sd) * np.exp(0.5 * misfit))

        widths = limits[0] * np.array(WIDTHS)
        likely = max(size, 0.0) + np.linspace(0.0, 6.0, 30) * limits[0]
        ratio = np.mean(
            [
                quad(integrand, 0.0, likely[-1] + 5.0 * limits[0], (sd,), points=likely, limit=500)[
                    0
                ]
                for sd in widths
            ]
        )
        np.testing.assert_allclose(got - without, np.log(ratio), rtol=1e-6)


def test_evidence_of_two_sizes_that_cannot_be_negative_is_close_to_that_of_the_positive_one():
    """A negative second size adds nothing, however well it would fit."""
    rng = np.random.default_rng(10)
    columns = np.stack([np.ones(200), np.linspace(0.0, 2.0, 200)], axis=1)
    values = columns @ [3.0, -1.2] + rng.standard_normal(200)
    products = power_products(values[:, None], np.ones(200), columns)
    limits, widths = 1.0 / np.linalg.norm(columns, axis=0), np.array(WIDTHS)
    designs = [np.arange(2), np.arange(1)]
    any_sign = log_evidence(products, designs, limits, np.zeros(1), widths)[:, 0]
    positive = log_evidence(products, designs, limits, np.zeros(1), widths, [True, True])[:, 0]
    assert any_sign[1] > any_sign[2] + 20.0
    assert positive[1] < positive[2]
    assert positive[1] > positive[2] - 10.0

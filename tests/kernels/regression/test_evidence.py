"""Evidence of designs against the mixture summed with numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp

from gyrostab.kernels.regression.evidence import mixed_evidence


@pytest.mark.parametrize("records", [1, 7])
@pytest.mark.parametrize("p", [1, 3])
@pytest.mark.parametrize("spread", [1.0, 300.0])  # of the likelihoods of the grid points [nats]
def test_evidence_is_the_sum_over_widths_and_laws(records: int, p: int, spread: float) -> None:
    rng = np.random.default_rng(1)
    grid, designs = 6, 4
    base = spread * rng.standard_normal((grid, records))
    rotated = 3.0 * rng.standard_normal((grid, designs, p, records))
    eigenvalues = rng.uniform(0.0, 2.0, (grid, designs, p))
    widths = np.array([1.0, 100.0, 1e4])
    # (grid, design, width, p)
    scale = 1.0 + widths[:, None] * eigenvalues[:, :, None]
    gained = 0.5 * (widths[:, None] / scale)[..., None] * rotated[:, :, None] ** 2
    terms = base[:, None, None] + (gained - 0.5 * np.log(scale)[..., None]).sum(axis=3)
    expected = logsumexp(terms, axis=(0, 2)) - np.log(widths.size)
    found = mixed_evidence(base, rotated, eigenvalues, widths)
    assert found.shape == (designs, records)
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-12)

"""Low-passes of a shared source: the forms that are tried cover those that physics allows."""

import numpy as np
import pytest

from gyrostab.physics.optics import SharedSource
from gyrostab.physics.prediction import Windows

RATE = 10.0
FREQUENCY = (np.arange(400) + 0.5) / 400 * RATE / 2.0


def common_share(first: np.ndarray, second: np.ndarray) -> float:
    """Return the share of the evidence of a cross-spectrum that another form of it has."""
    return float((first @ second) ** 2 / (first @ first) / (second @ second))


@pytest.mark.parametrize("corner", [0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.76, 0.8, 0.9, 1.0])
def test_a_low_pass_of_any_corner_keeps_its_evidence(corner: float) -> None:
    """One of the one-pole low-passes of the grid has 94 % of the evidence of one of two poles."""
    true = 1.0 / (1.0 + (FREQUENCY / (corner * RATE / 2.0)) ** 4)
    windows = Windows(
        begin=np.zeros(1), end=np.ones(1), frequency=FREQUENCY, rate=RATE, axes=("x",)
    )
    best = max(
        common_share(
            true,
            SharedSource(N=(1.0,), bandwidth=float(bandwidth)).explain(windows).spectrum["N"][0],
        )
        for bandwidth in SharedSource(N=(1.0,)).nuisance(windows)["bandwidth"]
    )
    assert best > 0.94

"""Motion of one axis that shows in the spectrum of another."""

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np

from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics.transfer import _moving_share


def test_a_band_without_data_has_no_motion() -> None:
    spectrum = SimpleNamespace(values=np.ones((1, 40, 3)))
    state: Any = SimpleNamespace(axes=["x"], baseline={"spectrum": spectrum}, settings=DEFAULTS)
    power = np.ones((40, 3))
    power[30:, 1], power[:, 2] = 100.0, np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        share = _moving_share("x", power, state)
    assert (share[:, [0, 2]] == 0.0).all()
    np.testing.assert_allclose(share[:, 1], np.repeat([0.0, 0.99], [30, 10]))
    assert (_moving_share("rotation_rate", power, state) == 1.0).all()

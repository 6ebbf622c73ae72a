"""Powers that effects add are zero or more in the model of a record."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.predict.condition import fit_powers
from gyrostab.diagnose.predict.linear_model import State, initial_state
from tests.support.named import record

NOISE = {"N": 0.003}


@pytest.fixture(scope="module")
def state() -> State:
    """White noise that loses half of its power at high frequencies in half of the blocks."""
    blocks = record([])
    baseline = baseline_from_model(blocks, {"noise": NOISE})
    frequency = blocks["frequency"] / float(blocks["frequency"].max())
    is_quieter = blocks["block"] < blocks.sizes["block"] // 2
    factor = xr.where(is_quieter, 1.0 - 0.5 * frequency**2, 1.0)
    return initial_state(blocks.assign(power=baseline["spectrum"] * factor), baseline)


@pytest.mark.parametrize(("kind", "lowest"), [("power", 0.5), ("added_power", 1.0)])
def test_added_power_is_not_negative(state, kind, lowest):
    frequency = state.blocks["frequency"].values / state.blocks["frequency"].values.max()
    is_quieter = np.arange(state.blocks.sizes["block"]) < state.blocks.sizes["block"] // 2
    column = is_quieter[:, None] * frequency**2
    fitted = fit_powers(state.with_columns(kind, "x", [column]), "x")
    ratio = fitted[is_quieter] / fitted[~is_quieter][:1]
    assert ratio.min() == pytest.approx(lowest, abs=0.05)

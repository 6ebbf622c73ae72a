"""Powers that effects add are zero or more in the model of a record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.condition import fit_powers
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.statistics import find_statistic
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


def test_power_of_masked_blocks_alone_changes_no_other_size(state):
    """Its size is not determined, and was infinite next to a size at its bound."""
    frequency = state.blocks["frequency"].values / state.blocks["frequency"].values.max()
    block = np.arange(state.blocks.sizes["block"])[:, None]
    falls = (block < block.size // 2) * frequency**2
    masked = state.masked.copy()
    masked[0, -1] = True
    state = replace(state, masked=masked)
    hidden = (block == block.size - 1) * np.ones_like(frequency)
    without, fitted = (
        fit_powers(state.with_columns("added_power", "x", columns), "x")
        for columns in ([falls], [falls, hidden])
    )
    np.testing.assert_allclose(fitted[:-1], without[:-1], rtol=1e-6)


def two_terms(state: State, columns: tuple[str, ...]) -> Component:
    """White noise and noise that rises with the frequency, added in half of the blocks."""
    frequency = state.blocks["frequency"].values / state.blocks["frequency"].values.max()
    is_quieter = np.arange(state.blocks.sizes["block"]) < state.blocks.sizes["block"] // 2
    shapes = {"white": np.ones_like(frequency), "quantization": frequency**2}
    level = float(state.baseline["spectrum"].mean())
    design = np.stack([level * is_quieter[:, None] * shapes[name] for name in columns])[:, None]
    variant = Variant({}, columns, design, squared=True)
    candidate = Candidate("vibration_noise", find_statistic("power"), ("vibration",), (variant,))
    return Component(candidate, variant, ("x",), 100.0)


def test_size_next_to_a_negative_one_is_that_without_it(state):
    course = two_terms(state, ("white", "quantization")).variant.design[:, 0]
    changed = state.blocks.assign(power=state.baseline["spectrum"] + course[0] - 0.9 * course[1])
    state = replace(state, blocks=changed)
    both, alone = (
        component_mixture(two_terms(state, columns), state).mean[0]
        for columns in (("white", "quantization"), ("white",))
    )
    assert both[0] == pytest.approx(alone[0])
    assert both[1] < 0.0
    assert alone[0] < 0.95


def test_evidence_takes_added_powers_for_positive(state):
    component = two_terms(state, ("white",))
    model = component.statistic.model([component.candidate], 0, state.blocks, state)
    assert list(model.is_bounded) == [True]

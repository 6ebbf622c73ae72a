"""Biases that switch within blocks: their course in sub-blocks, and its evidence."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.fast_switching import SwitchingEvidence, switching_evidence
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State


def add_fast_switching(state: State, component: Component) -> State:
    """Add the course of a bias that switches within blocks to the block and sub-block means."""
    axis = component.row[0]
    return state.with_columns("mean", axis, mean_columns(component.variant, 0)).with_columns(
        "sub_block", axis, [component.variant.inside]
    )


def fast_switching_evidence(data: xr.Dataset, state: State, axis: str) -> SwitchingEvidence | None:
    """Compute the evidence of a bias that switches within blocks, None without one."""
    switching = search_sub_blocks(data, state, axis)
    return (
        switching
        if switching is not None and is_resolved(switching, float(state.blocks.attrs["block_s"]))
        else None
    )


def is_resolved(switching: SwitchingEvidence, block: float) -> bool:
    """Return whether sub-blocks resolve two levels; anything shorter is a spike."""
    return (
        bool(np.isfinite(switching.evidence_nats))
        and float(switching.times.min()) >= block / switching.share.shape[1]
    )


def search_sub_blocks(data: xr.Dataset, state: State, axis: str) -> SwitchingEvidence | None:
    """Search sub-blocks; None if more is named in block means than is known in sub-blocks."""
    if len(state.given.get(("sub_block", axis), [])) < len(state.given.get(("mean", axis), [])):
        return None
    return switching_evidence(
        data,
        state.baseline,
        axis=axis,
        given=state.given_to("sub_block", axis),
        settings=state.settings,
    )

"""Negative controls: the channel or axis that an effect follows, slid in time, must not explain as much as the channel itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Candidate, Variant, rebuild_variant
from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import compute_evidence

__all__ = ["TIME_SHIFTS", "passes_time_shift_test"]

#: Copies of the channel at most.
TIME_SHIFTS = 200
_ALIKE = 0.5  # correlation from which on a slid design is too much like the true one
_FEWEST = 20
_OF_AXES = ("misalignment",)  # effects that follow the means of other axes


def passes_time_shift_test(
    components: Sequence[Component], state: State, folds: xr.DataArray, *, share: float = 0.01
) -> tuple[bool, float]:
    """Whether an effect explains more than almost all slid copies of its channel do.

    Parameters
    ----------
    components : sequence of Part
        Where the effect shows.
    state : State
        What is in the model without it.
    folds : xarray.DataArray
        From `fold_blocks`.
    share : float
        Copies that may do as well.

    Returns
    -------
    beats : bool
        True too where no copy can be made.
    p_value : float
        Share of the copies that did as well; NaN where there are too few copies that differ.
    """
    own = [component for component in components if _follows(component, state)]
    if not own:
        return True, np.nan
    block_count = state.blocks.sizes["block"]
    shifts = np.unique(np.linspace(block_count * 0.05, block_count * 0.95, TIME_SHIFTS).astype(int))
    real, slid = 0.0, np.zeros(shifts.size)
    valid = np.ones(shifts.size, np.bool_)
    for component in own:
        copies = [_slid(component, state, int(shift)) for shift in shifts]
        row = state.axes.index(component.row[0])
        for number, copy in enumerate(copies):
            if copy is None or _alike(copy, component.variant, row) > _ALIKE:
                valid[number] = False
        chosen = [copy if copy is not None else component.variant for copy in copies]
        several = [
            replace(component.candidate, effect=f"slid {number}", variants=(one,))
            for number, one in enumerate(chosen)
        ]
        found = compute_evidence(
            [replace(component.candidate, variants=(component.variant,)), *several],
            state.blocks,
            state,
            folds,
        )
        values = np.array([one.evidence_nats[0, row] for one in found])
        real += float(values[0])
        slid += values[1:]
    if valid.sum() < _FEWEST:
        return True, np.nan
    p_value = float(np.mean(slid[valid] >= real))
    return p_value <= share, p_value


def _follows(component: Component, state: State) -> bool:
    """Whether a part follows a channel in means or powers, or the means of other axes."""
    if component.candidate.statistic not in ("mean", "power"):
        return False
    return any(component.candidate.driver) or (
        component.candidate.statistic == "mean" and component.candidate.effect in _OF_AXES
    )


def _slid(component: Component, state: State, shift: int) -> Variant | None:
    """The variant with its channels slid around the record."""
    candidate: Candidate = component.candidate
    blocks = state.blocks.copy()
    for name in filter(None, candidate.driver):
        for key in {f"channel_{name}", f"fine_{name}"} & set(map(str, blocks.data_vars)):
            blocks[key] = blocks[key].copy(data=np.roll(blocks[key].values, shift, axis=0))
    for key in (
        {"mean", "measured_mean"} & set(map(str, blocks.data_vars))
        if candidate.effect in _OF_AXES
        else ()
    ):
        blocks[key] = blocks[key].copy(
            data=np.roll(blocks[key].values, shift, axis=list(blocks[key].dims).index("block"))
        )
    made = rebuild_variant(candidate, component.variant, blocks, state.baseline["coefficient"])
    return made


def _alike(copy: Variant, true: Variant, row: int) -> float:
    """Largest correlation of the columns over time, of either sign: so has the size."""

    def flat(design: NDArray[Any]) -> NDArray[Any]:
        rows = design[:, row if design.shape[1] > 1 else 0]
        rows = rows.reshape(rows.shape[0], rows.shape[1], -1).mean(axis=-1)
        return np.asarray(rows - rows.mean(axis=1, keepdims=True))

    a, b = flat(copy.design), flat(true.design)
    size = np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
    return float(np.max(np.abs((a * b).sum(axis=1)) / np.where(size > 0, size, 1.0)))

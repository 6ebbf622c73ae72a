"""Negative controls: the channel or axis that an effect follows, slid in time, must not explain as much as the channel itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Candidate, Variant, variants_of
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
    parts: Sequence[Component], state: State, folds: xr.DataArray, *, share: float = 0.01
) -> tuple[bool, float]:
    """Whether an effect explains more than almost all slid copies of its channel do.

    Parameters
    ----------
    parts : sequence of Part
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
    own = [part for part in parts if _follows(part, state)]
    if not own:
        return True, np.nan
    blocks = state.reduced.sizes["block"]
    shifts = np.unique(np.linspace(blocks * 0.05, blocks * 0.95, TIME_SHIFTS).astype(int))
    real, slid = 0.0, np.zeros(shifts.size)
    valid = np.ones(shifts.size, np.bool_)
    for part in own:
        copies = [_slid(part, state, int(shift)) for shift in shifts]
        row = state.axes.index(part.row[0])
        for number, copy in enumerate(copies):
            if copy is None or _alike(copy, part.variant, row) > _ALIKE:
                valid[number] = False
        chosen = [copy if copy is not None else part.variant for copy in copies]
        several = [
            replace(part.candidate, effect=f"slid {number}", variants=(one,))
            for number, one in enumerate(chosen)
        ]
        found = compute_evidence(
            [replace(part.candidate, variants=(part.variant,)), *several],
            state.reduced,
            state,
            folds,
        )
        values = np.array([one.gain[0, row] for one in found])
        real += float(values[0])
        slid += values[1:]
    if valid.sum() < _FEWEST:
        return True, np.nan
    p_value = float(np.mean(slid[valid] >= real))
    return p_value <= share, p_value


def _follows(part: Component, state: State) -> bool:
    """Whether a part follows a channel in means or powers, or the means of other axes."""
    if part.candidate.view not in ("mean", "power"):
        return False
    return any(part.candidate.driver) or (
        part.candidate.view == "mean" and part.candidate.effect in _OF_AXES
    )


def _slid(part: Component, state: State, shift: int) -> Variant | None:
    """The variant with its channels slid around the record."""
    candidate: Candidate = part.candidate
    reduced = state.reduced.copy()
    for name in filter(None, candidate.driver):
        for key in {f"channel_{name}", f"fine_{name}"} & set(map(str, reduced.data_vars)):
            reduced[key] = reduced[key].copy(data=np.roll(reduced[key].values, shift, axis=0))
    for key in (
        {"mean", "measured_mean"} & set(map(str, reduced.data_vars))
        if candidate.effect in _OF_AXES
        else ()
    ):
        reduced[key] = reduced[key].copy(
            data=np.roll(reduced[key].values, shift, axis=list(reduced[key].dims).index("block"))
        )
    made = variants_of(candidate, part.variant, reduced, state.baseline["coefficient"])
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

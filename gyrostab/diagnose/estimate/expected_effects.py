"""What a simulation and a recording have in common, as the recording tells it: the start from which anything more is looked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.estimate.conditioned_baseline import predicted
from gyrostab.diagnose.estimate.joint_fit import Fitted, fit_identifications
from gyrostab.diagnose.identify.identification import Identification, Identifications
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import initial_state

__all__ = ["expected_baseline", "fit_expected", "without_expected"]


def expected_baseline(
    identifications: Identifications, baseline: xr.Dataset, known: NDArray[np.bool_] | None = None
) -> xr.Dataset:
    """The baseline with the effects that were expected, and no others, fitted to the blocks that are `known`.

    Parameters
    ----------
    identifications : Naming
    baseline : xarray.Dataset
        That the naming started from.
    known : ndarray of bool, shape (block,), optional
        Blocks that the sizes are fitted to; all by default.
    """
    return (
        predicted(replace(identifications, identified=(), unknown=()), baseline, known)
        if identifications.expected
        else baseline
    )


def fit_expected(identifications: Identifications, baseline: xr.Dataset) -> list[Fitted]:
    """The numbers that the recording gives to the effects that were expected, with all that was named in the model."""
    return fit_identifications(
        replace(
            identifications,
            identified=identifications.expected,
            expected=identifications.identified,
        ),
        baseline,
    )


def without_expected(
    blocks: xr.Dataset, baseline: xr.Dataset, expected: Sequence[Identification]
) -> xr.Dataset:
    """The record without the blocks in which effects that were expected leave odd samples, or move the rate too fast for its spectrum.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
    expected : sequence of Claim
    """
    if not expected:
        return blocks
    state = initial_state(blocks, baseline)
    for identification in expected:
        state = condition_on(state, list(identification.components))
    moved = xr.DataArray(state.masked, dims=("axis", "block"))
    return state.blocks.assign(power=state.blocks["power"].where(~moved))

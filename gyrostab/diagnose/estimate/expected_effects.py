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
from gyrostab.diagnose.predict.linear_model import begin_state

__all__ = ["expected_baseline", "fit_expected", "without_expected"]


def expected_baseline(
    naming: Identifications, baseline: xr.Dataset, known: NDArray[np.bool_] | None = None
) -> xr.Dataset:
    """The baseline with the effects that were expected, and no others, fitted to the blocks that are `known`.

    Parameters
    ----------
    naming : Naming
    baseline : xarray.Dataset
        That the naming started from.
    known : ndarray of bool, shape (block,), optional
        Blocks that the sizes are fitted to; all by default.
    """
    return (
        predicted(replace(naming, claims=(), unknown=()), baseline, known)
        if naming.expected
        else baseline
    )


def fit_expected(naming: Identifications, baseline: xr.Dataset) -> list[Fitted]:
    """The numbers that the recording gives to the effects that were expected, with all that was named in the model."""
    return fit_identifications(
        replace(naming, claims=naming.expected, expected=naming.claims), baseline
    )


def without_expected(
    reduced: xr.Dataset, baseline: xr.Dataset, expected: Sequence[Identification]
) -> xr.Dataset:
    """The record without the blocks in which effects that were expected leave odd samples, or move the rate too fast for its spectrum.

    Parameters
    ----------
    reduced, baseline : xarray.Dataset
    expected : sequence of Claim
    """
    if not expected:
        return reduced
    state = begin_state(reduced, baseline)
    for claim in expected:
        state = condition_on(state, list(claim.parts))
    moved = xr.DataArray(state.masked, dims=("axis", "block"))
    return state.reduced.assign(power=state.reduced["power"].where(~moved))

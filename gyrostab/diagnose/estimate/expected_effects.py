"""Put the effects that simulation and recording have in common into the baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.estimate.conditioned_baseline import predict_baseline
from gyrostab.diagnose.estimate.joint_fit import Fitted, fit_identifications
from gyrostab.diagnose.identify.identification import (
    Identification,
    Identifications,
    condition_on_selections,
)
from gyrostab.diagnose.predict.linear_model import initial_state

__all__ = ["expected_baseline", "fit_expected", "without_expected"]


def expected_baseline(
    identifications: Identifications, baseline: xr.Dataset, known: NDArray[np.bool_] | None = None
) -> xr.Dataset:
    """Return the baseline with the expected effects only, fitted to the `known` blocks."""
    return (
        predict_baseline(replace(identifications, identified=(), unknown=()), baseline, known)
        if identifications.expected
        else baseline
    )


def fit_expected(identifications: Identifications, baseline: xr.Dataset) -> list[Fitted]:
    """Fit the expected effects with all identified ones in the model."""
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
    """Drop the blocks in which expected effects leave anomalous samples or move the rate."""
    if not expected:
        return blocks
    state = condition_on_selections(initial_state(blocks, baseline), expected)
    moved = xr.DataArray(state.masked, dims=("axis", "block"))
    return state.blocks.assign(power=state.blocks["power"].where(~moved))

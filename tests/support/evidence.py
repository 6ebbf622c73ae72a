"""Held-out evidence of named designs in block means and band powers, one record or many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.evidence.held_out import (
    LinearModel,
    Tier,
    linear_model_factors,
    mean_factors,
    noise_columns,
    with_independent_cells,
)
from gyrostab.diagnose.evidence.products import held_out_evidence


def power_factors(
    data: xr.Dataset,
    baseline: xr.Dataset,
    designs: Sequence[Floats],
    *,
    axis: str,
    given: Floats | None = None,
    folds: xr.DataArray | None = None,
) -> Floats:
    """Compute factors of designs in the band powers, for changes small against the spectrum.

    Parameters
    ----------
    data : xarray.Dataset
        Block statistics, one record or many with equal gaps: ``power`` ((record,) axis block band).
    baseline : xarray.Dataset
        ``spectrum``, ``shape_alone``, ``common``, and the variables of `noise_columns`.
    designs : sequence of ndarray, shape (block, band) or (block, band, column)
        Relative change of the spectrum per unit of the factor.
    axis, given, folds
        As in `mean_factors`; `given` has the shape (block, band, column), and the level of the
        noise is always given.

    Returns
    -------
    ndarray, shape (subset, 1 + design, record)
        As in `mean_factors`.
    """
    shape = (data.sizes["block"], data.sizes["band"])
    excess = (data["power"] / baseline["spectrum"] - 1.0).sel(axis=axis)
    by_record = excess.transpose("block", "band", ...).values
    values = by_record.reshape(*shape, -1)
    weight = np.asarray(
        baseline["shape_alone"].sel(axis=axis).transpose("block", "band").values, dtype=np.float64
    )
    level, precision, _ = noise_columns(baseline, axis=axis)
    columns_given = (
        np.empty((*shape, 0))
        if given is None
        else np.asarray(given, dtype=np.float64).reshape(*shape, -1)
    )
    widest_limits = np.diag([*np.diagonal(precision), *[-1.0] * columns_given.shape[2]])
    model = LinearModel(
        values,
        weight,
        [np.asarray(design, dtype=np.float64).reshape(*shape, -1) for design in designs],
        np.concatenate([level, columns_given], axis=2),
        widest_limits,
    )
    return linear_model_factors(
        with_independent_cells(
            model, baseline["common"].sel(axis=axis).values, np.ones_like(model.weight)
        ),
        fold_blocks(data) if folds is None else folds,
    )


def _label_evidence(factors: Floats, candidates: Mapping[str, Sequence[Floats]]) -> xr.DataArray:
    """Label the held-out evidence of candidates."""
    owner = np.repeat(np.arange(len(candidates)), [len(designs) for designs in candidates.values()])
    return xr.DataArray(
        held_out_evidence(factors[:, 1:], owner),
        dims=("candidate", "record"),
        coords={"candidate": list(candidates)},
        name="gain",
        attrs={"units": "1", "long_name": "held-out evidence [nats]"},
    )


def mean_evidence(
    data: xr.Dataset,
    baseline: xr.Dataset,
    candidates: Mapping[str, Sequence[Floats]],
    *,
    axis: str,
    tier: Tier = "free",
    **more: Any,
) -> xr.DataArray:
    """Compute the held-out evidence of candidates in the block means.

    Parameters
    ----------
    data, baseline, axis, tier
        As in `mean_factors`, with `more` for its further options.
    candidates : mapping of str to sequence of ndarray
        Designs by name, one for every value of the nuisance parameters.

    Returns
    -------
    xarray.DataArray
        ``gain(candidate, record)`` [nats].
    """
    designs = [design for shapes in candidates.values() for design in shapes]
    return _label_evidence(
        mean_factors(data, baseline, designs, axis=axis, tier=tier, **more), candidates
    )


def power_evidence(
    data: xr.Dataset,
    baseline: xr.Dataset,
    candidates: Mapping[str, Sequence[Floats]],
    *,
    axis: str,
    **more: Any,
) -> xr.DataArray:
    """Compute the held-out evidence of candidates in the band powers, as `mean_evidence`."""
    designs = [design for shapes in candidates.values() for design in shapes]
    return _label_evidence(power_factors(data, baseline, designs, axis=axis, **more), candidates)

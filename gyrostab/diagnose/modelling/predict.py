"""The baseline with the named effects in it, fitted to some blocks or to all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.effects.cells import State, begin_state, cross_column, known_cross, pair_rows
from gyrostab.diagnose.effects.explained import Part, explain_away
from gyrostab.diagnose.effects.sizes import mean_mixture, part_mixture
from gyrostab.diagnose.naming.claims import Naming

__all__ = ["predicted"]


def predicted(naming: Naming, baseline: xr.Dataset, known: NDArray[np.bool_] | None = None) -> xr.Dataset:
    """The baseline with the named effects in it, fitted to the blocks that may be used.

    Parameters
    ----------
    naming : Naming
        The effects; their nuisance parameters are kept.
    baseline : xarray.Dataset
        That the naming started from.
    known : ndarray of bool, shape (block,), optional
        Blocks that the sizes are fitted to; all by default.

    Returns
    -------
    xarray.Dataset
        With ``spectrum`` and ``known_mean`` of the effects; for effects that axes share also ``cross`` (pair, block, band).
    """
    reduced = naming.state.reduced
    keep = np.ones(reduced.sizes["block"], np.bool_) if known is None else np.asarray(known, np.bool_)
    seen = reduced.copy()
    for name in ("mean", "power", "cross"):
        if name in seen:
            seen[name] = seen[name].where(xr.DataArray(keep, dims="block"))
    state = begin_state(seen, baseline)
    for claim in naming.claims:
        state = explain_away(state, list(claim.parts))
    state = replace(state, reduced=seen, masked=naming.state.masked)
    mean = baseline["known_mean"].transpose("axis", "block").values.copy()
    for row, axis in enumerate(state.axes):
        columns = state.given.get(("mean", axis))
        if columns:
            alone = replace(state, given={key: value for key, value in state.given.items() if key != ("mean", axis)})
            size, _ = mean_mixture(alone, axis, columns).moments()
            mean[row] += np.tensordot(size, np.stack(columns), axes=1)
    after = baseline.assign(
        spectrum=baseline["spectrum"].transpose("axis", "block", "band").copy(data=state.weight),
        known_mean=baseline["known_mean"].transpose("axis", "block").copy(data=mean),
    )
    shared = [part for claim in naming.claims for part in claim.parts if part.candidate.view == "cross"]
    if not shared:
        return after
    known = known_cross(baseline)
    cross = _shared(shared, state, naming)
    return after.assign(cross=(("pair", "block", "band"), cross if known is None else cross + known))


def _shared(parts: Sequence[Part], state: State, naming: Naming) -> NDArray[np.complex128]:
    shape = state.weight.shape[1:]
    pairs = pair_rows(state.reduced)
    total = np.zeros((len(pairs), *shape), np.complex128)
    for part in parts:
        row = pairs.index(part.row)
        alone = replace(state, given={key: value for key, value in state.given.items() if key[0] != "cross"})
        mean, _ = part_mixture(part, alone).moments()
        for size, design in zip(mean, part.variant.design, strict=True):
            total[row] += size * cross_column(design, row, state.reduced)
    return total

"""Test effects against time-shifted surrogates of the channel or axis that they follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.predict.windows import make_surrogates, max_correlation
from gyrostab.physics.registry import effects

#: Number of time-shifted surrogates: two of them make the allowed share of 1 %.
TIME_SHIFTS = 200
SHIFT_RANGE = (0.05, 0.95)  # of the record


def passes_time_shift_test(
    components: Sequence[Component],
    state: State,
    folds: xr.DataArray,
) -> tuple[bool, float, float]:
    """Test whether an effect explains more than time-shifted surrogates of its channel.

    Parameters
    ----------
    components : sequence of Component
        Components of the effect.
    state : State
        What is in the model without it.

    Returns
    -------
    passed : bool
        Also true where no surrogate can be made.
    p_value, nats : float
        Share of the surrogates that explain as much, and by how much the best of them explains more
        than the channel [nats]; NaN where too few of them differ from the channel.
    """
    following_components = [component for component in components if _follows_channel(component)]
    if not following_components:
        return True, np.nan, np.nan
    block_count = state.blocks.sizes["block"]
    shifts = np.unique(
        np.linspace(block_count * SHIFT_RANGE[0], block_count * SHIFT_RANGE[1], TIME_SHIFTS).astype(
            int
        )
    )
    real, shifted = 0.0, np.zeros(shifts.size)
    valid = np.ones(shifts.size, np.bool_)
    limit = state.settings.majority_share
    for component in following_components:
        surrogates = make_surrogates(component, state.blocks, state.baseline["coefficient"], shifts)
        row = state.axes.index(component.row[0])
        for number, surrogate in enumerate(surrogates):
            if surrogate is None or max_correlation(surrogate, component.variant, row) > limit:
                valid[number] = False
        chosen = [
            surrogate if surrogate is not None else component.variant for surrogate in surrogates
        ]
        shifted_candidates = [
            replace(component.candidate, effect=f"shifted {number}", variants=(variant,))
            for number, variant in enumerate(chosen)
        ]
        # all variants: the channel pays for the search of the best one, as no surrogate has to
        all_evidence = compute_evidence(
            [component.candidate, *shifted_candidates],
            state.blocks,
            state,
            folds,
        )
        values = np.array([evidence.evidence_nats[0, row] for evidence in all_evidence])
        real += float(values[0])
        shifted += values[1:]
    if valid.sum() < state.settings.min_surrogates:
        return True, np.nan, np.nan
    p_value = float(np.mean(shifted[valid] >= real))
    nats = float(shifted[valid].max() - real)
    return p_value <= state.settings.surrogate_share, p_value, nats


def _follows_channel(component: Component) -> bool:
    """Return whether a component follows a channel, or the means of other axes."""
    if not (component.statistic.is_linear_in_means or component.statistic.is_power):
        return False
    follows_axes = effects()[component.candidate.effect].follows_axes
    return any(component.candidate.driver) or (
        component.statistic.is_linear_in_means and follows_axes
    )

"""Add the mean power of anomalous samples to a baseline.

The identification leaves their blocks out; a surface of the simulation must include them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from gyrostab.diagnose.estimate.joint_fit import Fitted
from gyrostab.diagnose.predict.windows import make_windows
from gyrostab.noise import sampled_psd

__all__ = ["add_outlier_power"]

_EVERYWHERE = "lattice"  # rounding affects every sample, so that the calibrated noise includes it


def add_outlier_power(
    baseline: xr.Dataset, blocks: xr.Dataset, fitted: Sequence[Fitted]
) -> xr.Dataset:
    """Add the mean power of anomalous samples to a baseline, from their fitted sizes.

    Parameters
    ----------
    baseline : xarray.Dataset
        With the other effects, fitted to the blocks without anomalous samples.
    fitted : sequence of Fitted
        Effects of all kinds; those without anomalous samples are ignored.
    """
    axes = [str(axis) for axis in blocks["axis"].values]
    frequency, rate = blocks["frequency"].values, float(blocks.attrs["sampling_rate_hz"])
    spectrum = baseline["spectrum"]
    added = np.zeros(spectrum.shape)
    for effect_fit in fitted:
        if effect_fit.effect is None or not any(
            component.statistic.is_count for component in effect_fit.identification.components
        ):
            continue
        rows = [axes.index(axis) for axis in effect_fit.axes]
        prediction = effect_fit.effect.explain(
            replace(make_windows(blocks, {}), axes=tuple(effect_fit.axes))
        )
        if _EVERYWHERE in prediction.marks:
            continue
        for name, density in prediction.spectrum.items():
            added[rows] += getattr(effect_fit.effect, name) ** 2 * density
        for (term, name), share in prediction.level.items():
            square = baseline["coefficient"].sel(term=term, axis=list(effect_fit.axes)).values ** 2
            added_square = square[:, None] * getattr(effect_fit.effect, name) * share
            added[rows] += added_square[..., None] * sampled_psd(term, frequency, rate)
    return (
        baseline.assign(spectrum=spectrum.copy(data=spectrum.values + added))
        if added.any()
        else baseline
    )

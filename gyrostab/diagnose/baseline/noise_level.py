"""Calibration of the noise level of a simulation on quiescent blocks of the recording."""

from __future__ import annotations

import math
import warnings

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.expected_statistics import common_variance
from gyrostab.diagnose.baseline.posterior import Posterior
from gyrostab.errors import SchemaError

Array = NDArray[np.float64]
_ROUNDS = 20  # of Fisher scoring, which converges quadratically
_MIN_FACTOR_RATIO = 0.1  # of the factor before: no round may reach zero


def quiescent_level(
    blocks: xr.Dataset, noise: Array, added: Array, quiet: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Measure the noise level of the quiescent blocks relative to that of a simulation.

    Parameters
    ----------
    noise, added : ndarray, shape (axis, block, band)
        Expected power of the noise, and power that effects of the simulation add.
    quiet : ndarray of bool, shape (axis, block)
        Blocks to calibrate on.

    Returns
    -------
    factor, error : ndarray, shape (axis,)
        Factor of `noise` with the largest gamma likelihood; its standard error, relative to it.

    Raises
    ------
    SchemaError
        If an axis has no spectrum in its quiescent blocks.
    """
    power, shape = (blocks[name].values for name in ("power", "shape"))
    common, shape_alone = common_variance(blocks)
    factors = []
    for row, axis in enumerate(blocks["axis"].values):
        good = np.isfinite(power[row]) & np.isfinite(shape[row]) & quiet[row][:, None]
        good &= noise[row] > 0.0
        if not good.any():
            raise SchemaError(
                f"axis {axis}: the quiescent blocks hold no spectrum to calibrate the simulation "
                "on; give other stretches with --quiet, or none, to take the simulation as it is"
            )
        separate_shape = np.where(good, shape_alone[row], 0.0).sum(axis=1)
        # see `common_variance`
        reduction = 1.0 / (1.0 + np.where(quiet[row], common[row], 0.0) * separate_shape)
        weight = (shape[row] * np.broadcast_to(reduction[:, None], good.shape))[good]
        factors.append(_fit_factor(power[row][good], noise[row][good], added[row][good], weight))
    factor, error = np.array(factors).T
    return factor, error


def _fit_factor(power: Array, noise: Array, added: Array, weight: Array) -> tuple[float, float]:
    """Fit ``factor * noise + added`` to gamma-distributed powers; return also the error share."""
    factor = float((weight * power / (noise + added)).sum() / weight.sum())
    information = 0.0
    for _ in range(_ROUNDS):
        expected = factor * noise + added
        information = float((weight * (noise / expected) ** 2).sum())
        change = float((weight * noise * (power - expected) / expected**2).sum()) / information
        factor = max(factor + change, _MIN_FACTOR_RATIO * factor)
    return factor, 1.0 / (factor * math.sqrt(information))


def scale_axes(
    blocks: xr.Dataset, posteriors: list[Posterior], factor: Array, error: Array
) -> list[Posterior]:
    """Scale the noise of all axes, with the relative errors of the factors in the draws; say so."""
    sizes = ", ".join(
        f"{root:.3g} on axis {axis}"
        for axis, root in zip(blocks["axis"].values, np.sqrt(factor), strict=True)
    )
    warnings.warn(
        f"the noise of the simulation is multiplied by {sizes}: its level in the given quiescent "
        "stretches",
        stacklevel=2,
    )
    scaled = []
    for row, (noise, by, relative) in enumerate(zip(posteriors, factor, error, strict=True)):
        rng = np.random.default_rng(row)
        scatter = rng.gamma(relative**-2, relative**2, (len(noise.draws), 1))
        scaled.append(
            noise._replace(
                square=noise.square * by,
                error=np.hypot(noise.error, noise.square * relative) * by,
                K=noise.K * np.sqrt(by),
                B=noise.B * np.sqrt(by),
                draws=noise.draws * by * scatter,
                slow=noise.slow * by * scatter,
            )
        )
    return scaled

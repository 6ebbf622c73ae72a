"""The baseline of a model: its noise, and its known effects."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.calibrate import assemble_baseline
from gyrostab.diagnose.baseline.expected_statistics import NOISE, line_columns
from gyrostab.diagnose.baseline.known_effects import expect_known_effects
from gyrostab.diagnose.baseline.known_lines import independent_line_share
from gyrostab.diagnose.baseline.noise_level import quiescent_level, scale_axes
from gyrostab.diagnose.baseline.posterior import DRAWS, Posterior
from gyrostab.diagnose.baseline.quiescent import find_quiescent_spans, given_quiescent_blocks
from gyrostab.diagnose.reduce.schema import BASELINE, label_variables
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.errors import OptionError
from gyrostab.noise import TERMS
from gyrostab.simulate.model import Model, read_model
from gyrostab.units import HOUR


def baseline_from_model(
    blocks: xr.Dataset, model: Any, *, quiet: Any = None, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Take the noise of a model, and its effects as far as means and band powers show them.

    Parameters
    ----------
    quiet : (start, end) or several of these, optional
        Quiescent time of the recording. One factor for each axis then fits the noise of the model
        to it; the noise terms keep their proportions, and the effects their sizes. By default, and
        with a warning where `quiet` is too short, the noise is taken unchanged.

    Returns
    -------
    xarray.Dataset
        As from `calibrate_noise`; the noise has the error of that factor, or none. If axes share an
        effect of the model, with ``cross(pair, block, band)``, the expected cross-spectrum.
        ``attrs["left_out"]`` lists the effects that also show elsewhere (in distributions,
        transfers, rotation orders, random wander): that part of them is not included.

    Raises
    ------
    OptionError, FormatError
        If the model is invalid, or has no noise.
    SchemaError
        If the recording lacks the channel of an effect.
    """
    parsed = model if isinstance(model, Model) else read_model(model)
    axes = [str(axis) for axis in blocks["axis"].values]
    posteriors = []
    for axis in axes:
        coefficients = parsed.coefficients(axis)
        square = np.array([coefficients[term] ** 2 for term in NOISE])
        if not square.any():
            raise OptionError(
                f"{parsed.source}: axis {axis} has no noise to compare a recording with; "
                f"give N in [noise] or [noise.{axis}]"
            )
        draws = np.tile(square, (DRAWS, 1))
        K, B = np.array([coefficients["K"]]), np.array([coefficients["B"]])
        posteriors.append(
            Posterior(square, np.zeros(4), K, B, np.ones(1), draws, draws[:, 2:], True)
        )
    chosen = np.ones((len(axes), blocks.sizes["block"]), np.bool_)
    attrs: dict[str, Any] = {"source": "model", "calibrated_on": [], "model": parsed.source}
    given_blocks = given_quiescent_blocks(blocks, quiet, settings=settings)
    if given_blocks is not None:
        chosen = given_blocks
        attrs["calibrated_on"] = find_quiescent_spans(blocks, chosen)
        posteriors = _scale_to_quiescent(blocks, parsed, posteriors, chosen)
    effects = expect_known_effects(
        blocks, parsed, np.stack([posterior.square for posterior in posteriors])
    )
    attrs["left_out"] = effects.left_out
    hours = (blocks["begin"].values + blocks["end"].values) / (2.0 * HOUR)
    ramp = np.array([parsed.coefficients(axis)["R"] for axis in axes])
    out = assemble_baseline(
        blocks,
        posteriors,
        quiet=chosen,
        attrs=attrs,
        known_mean=effects.mean + ramp[:, None] * hours,
        spectrum=effects.spectrum,
        settings=settings,
    )
    out["mean_variance"] *= effects.white_share
    out = out.assign(label_variables(effects.variables, BASELINE))
    if "peaks" in out:
        noise = np.stack([line_columns(blocks) @ posterior.square for posterior in posteriors])
        out["shape_alone"] *= independent_line_share(noise + out["peaks"].values, blocks)[:, None]
    out["coefficient"].loc[{"term": "R"}] = ramp
    out["stderr"].loc[{"term": list(TERMS) if given_blocks is None else ["R"]}] = 0.0
    return out


def _scale_to_quiescent(
    blocks: xr.Dataset, model: Model, posteriors: list[Posterior], quiet: NDArray[np.bool_]
) -> list[Posterior]:
    """Scale the noise of a model to the quiescent blocks (axis, block), given its effects."""
    square = np.stack([posterior.square for posterior in posteriors])
    spectrum, added = (
        expect_known_effects(blocks, model, values).spectrum for values in (square, 0.0 * square)
    )
    return scale_axes(blocks, posteriors, *quiescent_level(blocks, spectrum - added, added, quiet))

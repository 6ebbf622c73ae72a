"""The baseline of a model: its noise, and its known effects."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.baseline.assemble import assemble_baseline
from gyrostab.diagnose.baseline.expected_statistics import NOISE, line_columns, reduced_shape
from gyrostab.diagnose.baseline.known_effects import expect_known_effects
from gyrostab.diagnose.baseline.known_lines import independent_line_share
from gyrostab.diagnose.baseline.posterior import DRAWS, Posterior
from gyrostab.diagnose.baseline.quiescent import find_quiescent_spans, given_quiescent_blocks
from gyrostab.diagnose.evidence.spectral_lines import interpolate_bands
from gyrostab.diagnose.predict.linear_model import average_in_bands
from gyrostab.diagnose.reduce.schema import BASELINE, label_variables
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.errors import OptionError, SchemaError
from gyrostab.noise import TERMS
from gyrostab.simulate.model import Model, read_model
from gyrostab.units import HOUR

_FACTOR_ROUNDS = 20  # of Fisher scoring, which converges quadratically
_MIN_FACTOR_RATIO = 0.1  # of the factor before: no round may reach zero


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
        ``attrs["shown_elsewhere"]`` lists the effects that also show elsewhere (in distributions,
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
    posteriors = [_given_posterior(parsed, axis) for axis in axes]
    chosen = np.ones((len(axes), blocks.sizes["block"]), np.bool_)
    attrs: dict[str, Any] = {"source": "model", "calibrated_on": [], "model": parsed.source}
    given_blocks = given_quiescent_blocks(blocks, quiet, settings=settings)
    if given_blocks is not None:
        chosen = given_blocks
        attrs["calibrated_on"] = find_quiescent_spans(blocks, chosen)
        squares = np.stack([posterior.square for posterior in posteriors])
        spectrum, added = (
            expect_known_effects(blocks, parsed, values).spectrum
            for values in (squares, 0.0 * squares)
        )
        posteriors, _ = scale_to_quiescent(blocks, posteriors, spectrum - added, added, chosen)
    squares = np.stack([posterior.square for posterior in posteriors])
    effects = expect_known_effects(blocks, parsed, squares)
    attrs["shown_elsewhere"] = effects.shown_elsewhere
    ramp = np.array([parsed.coefficients(axis)["R"] for axis in axes])
    out = assemble_baseline(
        blocks,
        posteriors,
        quiescent=chosen,
        attrs=attrs,
        known_mean=effects.mean + expect_ramp(blocks, ramp),
        spectrum=effects.spectrum,
        settings=settings,
    )
    out["mean_variance"] *= effects.white_share
    out = out.assign(label_variables(effects.variables, BASELINE))
    if "line_noise" in out or "broad_peaks" in out:
        _describe_lines(out, blocks, squares)
    out["coefficient"].loc[{"term": "R"}] = ramp
    out["stderr"].loc[{"term": list(TERMS) if given_blocks is None else ["R"]}] = 0.0
    return out


def _given_posterior(model: Model, axis: str) -> Posterior:
    """Return the noise of an axis of a model, known without error."""
    coefficients = model.coefficients(axis)
    square = np.array([coefficients[term] ** 2 for term in NOISE])
    if not square.any():
        raise OptionError(
            f"{model.source}: axis {axis} has no noise to compare a recording with; "
            f"give N in [noise] or [noise.{axis}]"
        )
    draws = np.tile(square, (DRAWS, 1))
    K, B = np.array([coefficients["K"]]), np.array([coefficients["B"]])
    return Posterior(
        square=square,
        error=np.zeros(4),
        K=K,
        B=B,
        weight=np.ones(1),
        draws=draws,
        slow=draws[:, 2:],
        joined=True,
    )


def expect_ramp(blocks: xr.Dataset, ramp: Floats) -> Floats:
    """Return what the ramp R t [degree hour-2] of each axis adds to its block means."""
    hours = (blocks["begin"].values + blocks["end"].values) / (2.0 * HOUR)
    return np.asarray(ramp[:, None] * hours)


def _describe_lines(baseline: xr.Dataset, blocks: xr.Dataset, square: Floats) -> None:
    """Add what filters and resonances do to the lines of a band to the baseline.

    Where the lines of a resonance dominate, the power of the band has fewer degrees of freedom.
    """
    columns = line_columns(blocks)
    density = np.stack([columns @ axis_square for axis_square in square])
    if "line_noise" in baseline:
        density = baseline["line_noise"].values
        smooth = interpolate_bands(
            average_in_bands(density, blocks),
            blocks["line_frequency"].values,
            blocks["frequency"].values,
        )
        baseline["line_shape"] = baseline["line_noise"].copy(data=density / smooth)
    if "broad_peaks" in baseline:
        share = independent_line_share(density + baseline["broad_peaks"].values, blocks)
        if "line_noise" in baseline:  # the blocks have the share of the filter
            share = share / independent_line_share(density, blocks)
        baseline["shape_alone"] *= share[:, None]


def scale_to_quiescent(
    blocks: xr.Dataset, posteriors: list[Posterior], noise: Floats, added: Floats, quiescent: Bools
) -> tuple[list[Posterior], Floats]:
    """Scale the noise of a simulation to its level in quiescent blocks of the recording; say so.

    Parameters
    ----------
    noise, added : ndarray, shape (axis, block, band)
        Expected power of the noise, and power that effects of the simulation add.
    quiescent : ndarray of bool, shape (axis, block)
        Blocks to calibrate on.

    Returns
    -------
    posteriors : list of Posterior
        The draws include the error of the factor.
    factor : ndarray, shape (axis,)
        Factor of `noise` with the largest gamma likelihood.

    Raises
    ------
    SchemaError
        If an axis has no spectrum in its quiescent blocks.
    """
    factors, scaled, sizes = [], [], []
    for row, (axis, posterior) in enumerate(zip(blocks["axis"].values, posteriors, strict=True)):
        fitted = fit_noise_factor(blocks.isel(axis=[row]), noise[row], added[row], quiescent[row])
        if fitted is None:
            raise SchemaError(
                f"axis {axis}: the quiescent blocks hold no spectrum to calibrate the simulation "
                "on; give other stretches with --quiet, or none, to take the simulation as it is"
            )
        factor, error = fitted
        factors.append(factor)
        sizes.append(f"{math.sqrt(factor):.3g} on axis {axis}")
        rng = np.random.default_rng(0)  # of any axis, so that their order does not matter
        scatter = rng.gamma(error**-2, error**2, (len(posterior.draws), 1))
        scaled.append(
            posterior._replace(
                square=posterior.square * factor,
                error=np.hypot(posterior.error, posterior.square * error) * factor,
                K=posterior.K * math.sqrt(factor),
                B=posterior.B * math.sqrt(factor),
                draws=posterior.draws * factor * scatter,
                slow=posterior.slow * factor * scatter,
                angle=posterior.angle * factor,
            )
        )
    warnings.warn(
        f"the noise of the simulation is multiplied by {', '.join(sizes)}: its level in the given "
        "quiescent stretches",
        stacklevel=2,
    )
    return scaled, np.array(factors)


def fit_noise_factor(
    blocks: xr.Dataset, noise: Floats, added: Floats, chosen: Bools
) -> tuple[float, float] | None:
    """Fit a factor of the noise (block, band) of a single axis to the powers of chosen blocks.

    `added` is the power that effects add. Return the factor with the largest gamma likelihood, and
    the share of its error; None without any spectrum.
    """
    power, shape = blocks["power"].values[0], reduced_shape(blocks)[0]
    good = np.isfinite(power) & np.isfinite(shape) & chosen[:, None] & (noise > 0.0)
    if not good.any():
        return None
    return _fit_factor(power[good], noise[good], added[good], shape[good])


def _fit_factor(power: Floats, noise: Floats, added: Floats, weight: Floats) -> tuple[float, float]:
    """Fit ``factor * noise + added`` to gamma-distributed powers; return also the error share."""
    factor = float((weight * power / (noise + added)).sum() / weight.sum())
    information = 0.0
    for _ in range(_FACTOR_ROUNDS):
        expected = factor * noise + added
        information = float((weight * (noise / expected) ** 2).sum())
        change = float((weight * noise * (power - expected) / expected**2).sum()) / information
        factor = max(factor + change, _MIN_FACTOR_RATIO * factor)
    return factor, 1.0 / (factor * math.sqrt(information))

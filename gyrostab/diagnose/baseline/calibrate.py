"""The stationary noise that a record is compared with: calibrated on its quiet time.

Band powers of the quiet blocks give Q, N and what they can of B and K; the block means give the
slow part of B and K. The posterior is kept as draws, so that null records carry the error of the
calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.expected_statistics import (
    NOISE,
    common_variance,
    line_columns,
    noise_powers,
    white_variance,
)
from gyrostab.diagnose.baseline.known_effects import evenness, expect_known_effects
from gyrostab.diagnose.baseline.noise_level import quiescent_level, scale_noise
from gyrostab.diagnose.baseline.posterior import (
    Fit,
    Posterior,
    fit_squares,
    floor_square,
    noise_posterior,
    scales,
    summed,
)
from gyrostab.diagnose.baseline.quiescent import (
    find_quiescent_blocks,
    find_quiescent_spans,
    loudness,
)
from gyrostab.diagnose.baseline.simulated import odd_band, shown_by, with_shown
from gyrostab.diagnose.baseline.wandering import with_wandering
from gyrostab.diagnose.evidence.products import mean_products
from gyrostab.errors import OptionError, SchemaError
from gyrostab.noise import HOUR, LAWS, TERMS
from gyrostab.simulate.model import Model, read_model

__all__ = [
    "DRAWS",
    "assemble_baseline",
    "baseline_from_model",
    "baseline_from_simulation",
    "calibrate_noise",
    "grid_values",
]

Array = NDArray[np.float64]
#: Draws from the posterior of the noise of an axis.
DRAWS = 512
#: Values of K and B that the noise may have instead, as multiples of the calibrated ones.
_FACTORS = {"K": (0.0, 1.0 / 3.0, 1.0, 3.0, 10.0, 30.0), "B": (0.0, 1.0, 3.0, 10.0)}
_LOW_SHAPE = 20.0  # of the lowest bands, which say how noisy the mean of a block is
_EXCESS = 4.0  # standard deviations from which on a block is noisier
_LEAST_BANDS = 6  # that five noise terms are fitted to, whatever the form of a simulated spectrum
_POWER = "degree2 hour-2 Hz-1"


def _noisier(power: Array, shape: Array, spectrum: Array) -> Array:
    """Factor by which the white variance of each block mean exceeds the expected one, from the lowest bands; inputs (block, band)."""
    count = np.nan_to_num(shape).sum(axis=0) / max(1, int(np.isfinite(shape).all(axis=1).sum()))
    low = max(2, int(np.searchsorted(np.cumsum(count), _LOW_SHAPE)) + 1)
    level, deviation = loudness(power[:, :low] / spectrum[:, :low] - 1.0, shape[:, :low])
    return np.asarray(np.where(deviation > _EXCESS, level, 1.0))


def grid_values(term: str, centre: float, scale: float) -> Array:
    """Values of K or B that the noise may have, from none to far above both the calibrated one and what is just seen."""
    return np.array(
        [factor * (max(centre, scale) if factor > 1.0 else centre) for factor in _FACTORS[term]]
    )


def _grid(posterior: Posterior, density: float, span: float) -> tuple[Array, Array, Array]:
    """K and B of the coarse grid, and log of the posterior around every point."""
    centres = np.sqrt(np.median(posterior.slow, axis=0))
    least = scales(density, span)
    K, B = (
        grid_values("K", float(centres[1]), least[0]),
        grid_values("B", float(centres[0]), least[1]),
    )
    place = []
    for fine, coarse in ((posterior.K, K), (posterior.B, B)):
        between = np.sqrt(coarse[1:-1] * coarse[2:])
        place.append(np.searchsorted(np.concatenate([[coarse[1] / np.sqrt(3.0)], between]), fine))
    mass = np.full((K.size, B.size), 1e-12)
    np.add.at(mass, tuple(place), posterior.weight)
    many = [component.ravel() for component in np.meshgrid(K, B, indexing="ij")]
    return many[0], many[1], np.log(mass.ravel() / mass.sum())


def calibrate_noise(blocks: xr.Dataset, *, quiet: Any = None) -> xr.Dataset:
    """Calibrate the noise of every axis on quiet blocks.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `reduce_log`.
    quiet : array_like of bool (block,), or (start, end) or several of these, optional
        What is known to be quiet: seconds since the start, or ISO times. Without it blocks with
        little vibration, steady temperature, no rotation, not soon after a restart, and not louder
        than most.

    Returns
    -------
    xarray.Dataset
        - ``coefficient``, ``stderr`` (axis, term) [units of the noise table]; a ramp is an effect, so R is 0, with the error that it has.
        - ``quiet(axis, block)``: what it was calibrated on.
        - ``spectrum(axis, block, band)``: expected power [degree2 hour-2 Hz-1]; its terms in ``columns(axis, block, band, noise)``,
          ``square`` and ``square_stderr`` (axis, noise).
        - ``common(axis, block)``, ``shape_alone(axis, block, band)``: scatter of the powers of a block, together and apart.
        - ``known_mean``, ``mean_variance`` (axis, block) [degree hour-1, degree2 hour-2].
        - ``grid_K``, ``grid_B``, ``grid_prior``, ``grid_calibrated`` (axis, grid): possible noise of the means, log weights.
        - ``posterior(axis, draw, noise)``, ``posterior_slow(axis, draw, slow)``: draws of the squares in powers and in means.

    Raises
    ------
    OptionError
        When `quiet` holds fewer than 100 samples in whole blocks.
    SchemaError
        When an axis has no spectra to calibrate on.

    Examples
    --------
    >>> from gyrostab.diagnose.reduce.block_statistics import reduce_log
    >>> from gyrostab.simulate import simulate
    >>> log = simulate({"log": {"axes": ["x"]}, "noise": {"N": 0.003}}, duration="1h", rate=10.0, seed=3)
    >>> baseline = calibrate(reduce_log(log))
    >>> error = (baseline.coefficient - 0.003).sel(axis="x", term="N") / baseline.stderr.sel(axis="x", term="N")
    >>> bool(abs(error) < 4.0), baseline.attrs["source"]
    (True, 'calibrated')
    """
    chosen, reason = find_quiescent_blocks(blocks, quiet)
    attrs = {
        "source": "calibrated",
        "calibrated_on": find_quiescent_spans(blocks, chosen),
        "quiet_by": reason,
    }
    return assemble_baseline(blocks, _posteriors(blocks, chosen), quiet=chosen, attrs=attrs)


def _posteriors(blocks: xr.Dataset, chosen: NDArray[np.bool_]) -> list[Posterior]:
    """Noise of every axis from the chosen blocks (axis, block)."""
    columns = noise_powers(blocks)
    common, rest = common_variance(blocks)
    power, shape = (
        blocks["power"].transpose("axis", "block", "band").values,
        blocks["shape"].transpose("axis", "block", "band").values,
    )
    mean = blocks["mean"].transpose("axis", "block").values
    step = float(blocks.attrs["block_s"])
    found = []
    for row, axis in enumerate(blocks["axis"].values):
        use = chosen[row]
        fit = summed(power[row][use], shape[row][use], columns[row][use])
        if fit.power.size < 4:
            raise SchemaError(
                f"axis {axis}: the quiet blocks hold spectra in {fit.power.size} bands, too few to calibrate on; "
                "name other quiet time, or diagnose a part of the record with fewer gaps"
            )
        fit = _with_common(fit, shape[row][use], rest[row][use], common[row][use])
        square = np.maximum(fit_squares(fit)[0], [0.0, floor_square(fit), 0.0, 0.0])
        variance = white_variance(blocks, np.tile(square, (len(mean), 1)))[row]
        present = use & np.isfinite(mean[row])
        found.append(
            noise_posterior(
                fit,
                mean[row],
                variance,
                present,
                step=step,
                draws=DRAWS,
                rng=np.random.default_rng(row),
            )
        )
    return found


def _with_common(fit: Fit, shape: Array, rest: Array, common: Array) -> Fit:
    """Fit whose weights are less by what the common part of the bands takes from them together."""
    each = np.nansum(rest, axis=1)
    known = (each / (1.0 + common * each)).sum()
    return fit._replace(weight=fit.weight * min(1.0, float(known / max(np.nansum(shape), 1e-300))))


def assemble_baseline(
    blocks: xr.Dataset,
    found: list[Posterior],
    *,
    quiet: NDArray[np.bool_],
    attrs: Mapping[str, Any],
    known_mean: Array | None = None,
    spectrum: Array | None = None,
) -> xr.Dataset:
    """Put the noise of all axes into the Dataset that `calibrate_noise` describes.

    Parameters
    ----------
    blocks : xarray.Dataset
    found : list of Posterior
        One for each axis.
    quiet : ndarray of bool, shape (axis, block)
    attrs : mapping
        ``source``, ``calibrated_on`` and what else there is to say.
    known_mean : ndarray, shape (axis, block), optional
        Effects that are taken as known [degree hour-1].
    spectrum : ndarray, shape (axis, block, band), optional
        Expected power with effects; that of the noise without it.
    """
    columns = noise_powers(blocks)
    square = np.stack([one.square for one in found])
    noise = np.einsum("abfn,an->abf", columns, square)
    expected = noise if spectrum is None else spectrum
    power, shape = (
        blocks["power"].transpose("axis", "block", "band").values,
        blocks["shape"].transpose("axis", "block", "band").values,
    )
    floor = np.array([1e-3 * one.min() / HOUR for one in expected])
    white = white_variance(
        blocks,
        np.stack(
            [square[:, 0], np.maximum(square[:, 1], floor), square[:, 2], square[:, 3]], axis=1
        ),
    )
    white = white * np.maximum(expected[..., 0] / noise[..., 0], 0.1)
    variance = white * np.stack(
        [_noisier(*components) for components in zip(power, shape, expected, strict=True)]
    )
    span = blocks.sizes["block"] * float(blocks.attrs["block_s"])
    grids = [
        _grid(one, max(one.square[1], least) * HOUR, span)
        for one, least in zip(found, floor, strict=True)
    ]
    draws = np.stack([one.draws for one in found])
    common, rest = common_variance(blocks)
    value, error = _coefficients(found)
    value[:, 4], error[:, 4] = 0.0, _ramp_error(blocks, white, value, quiet)
    plane, cube = ("axis", "block"), ("axis", "block", "band")
    told = ", ".join(f"{term} in {LAWS[term].label}" for term in TERMS)
    variables: dict[str, Any] = {
        "coefficient": (("axis", "term"), value, {"long_name": "noise coefficient", "units": told}),
        "stderr": (
            ("axis", "term"),
            error,
            {"long_name": "standard error of the coefficient", "units": told},
        ),
        "quiet": (plane, quiet, {"long_name": "block is calibrated on", "units": "1"}),
        "spectrum": (cube, expected, {"long_name": "expected power", "units": _POWER}),
        "known_mean": (
            plane,
            np.zeros(quiet.shape) if known_mean is None else known_mean,
            {"units": "degree hour-1"},
        ),
        "mean_variance": (
            plane,
            variance,
            {"long_name": "white variance of the block mean", "units": "degree2 hour-2"},
        ),
        "common": (
            plane,
            common,
            {
                "long_name": "relative variance that the powers of a block have in common",
                "units": "1",
            },
        ),
        "shape_alone": (
            cube,
            rest,
            {
                "long_name": "shape of the gamma distribution of a power beside the common part",
                "units": "1",
            },
        ),
        "columns": (
            (*cube, "noise"),
            columns,
            {"long_name": "expected power per squared coefficient", "units": _POWER},
        ),
        "square": (
            ("axis", "noise"),
            square,
            {"long_name": "squared coefficient that fits the powers", "units": f"square of {told}"},
        ),
        "square_stderr": (
            ("axis", "noise"),
            np.stack([one.error for one in found]),
            {"units": f"square of {told}"},
        ),
        "posterior": (
            ("axis", "draw", "noise"),
            draws,
            {"long_name": "draws of the squares in powers", "units": f"square of {told}"},
        ),
        "posterior_slow": (
            ("axis", "draw", "slow"),
            np.stack([one.slow for one in found]),
            {"units": f"square of {told}"},
        ),
        "grid_K": (("axis", "grid"), np.stack([grid[0] for grid in grids]), {"units": "deg/h^1.5"}),
        "grid_B": (("axis", "grid"), np.stack([grid[1] for grid in grids]), {"units": "deg/h"}),
        "grid_prior": (
            ("axis", "grid"),
            np.full((len(found), grids[0][0].size), -np.log(grids[0][0].size)),
            {"units": "1"},
        ),
        "grid_calibrated": (
            ("axis", "grid"),
            np.stack([grid[2] for grid in grids]),
            {"units": "1"},
        ),
    }
    coordinates = {
        name: blocks[name]
        for name in ("axis", "time", "begin", "end", "frequency", "band_low", "band_high")
        if name in blocks
    }
    joined = [
        str(axis) for axis, one in zip(blocks["axis"].values, found, strict=True) if not one.joined
    ]
    return xr.Dataset(
        variables,
        coords={**coordinates, "term": list(TERMS), "noise": list(NOISE), "slow": ["B", "K"]},
        attrs={**attrs, "slow_noise_apart": joined},
    )


def _coefficients(found: list[Posterior]) -> tuple[Array, Array]:
    """Values and errors (axis, term), R left to the caller; B and K are those of the block means."""
    value, error = np.zeros((len(found), 5)), np.zeros((len(found), 5))
    for row, one in enumerate(found):
        roots = np.sqrt(np.concatenate([one.draws[:, :2], one.slow], axis=1))
        value[row, :4], error[row, :4] = roots.mean(axis=0), roots.std(axis=0)
    return value, error


def _ramp_error(blocks: xr.Dataset, white: Array, value: Array, quiet: NDArray[np.bool_]) -> Array:
    """Error that a ramp would have in the quiet means [deg/h^2]."""
    hours = (blocks["begin"].values + blocks["end"].values)[:, None] / (2.0 * HOUR)
    present = quiet & np.isfinite(blocks["mean"].transpose("axis", "block").values)
    error = np.zeros(len(white))
    for row in range(len(white)):
        K, B = value[row, 3:4], value[row, 2:3]
        step = float(blocks.attrs["block_s"])
        seen = mean_products(
            hours[:, :0], hours, variance=white[row], step=step, K=K, B=B, present=present[row]
        ).gram[0, 0, 0]
        error[row] = 1.0 / np.sqrt(seen) if seen > 0.0 else np.inf
    return error


def baseline_from_model(blocks: xr.Dataset, model: Any, *, quiet: Any = None) -> xr.Dataset:
    """Take the noise of a model, and its effects as far as means and band powers show them.

    Parameters
    ----------
    blocks : xarray.Dataset
        The recording, from `reduce_log`.
    model : path, mapping or Model
        As `gyrostab.simulate` takes it.
    quiet : array_like of bool (block,), or (start, end) or several of these, optional
        Quiet stretches of the recording. One factor for each axis then fits the noise of the model
        to them; its noise terms keep their proportions, and its effects their sizes. Without it the
        noise is taken as it is.

    Returns
    -------
    xarray.Dataset
        As `calibrate_noise` has it; the noise has the error of that factor, or none. With
        ``cross(pair, block, band)``, the expected cross-spectrum, where axes share an effect of the
        model. ``attrs["left_out"]`` names the effects that show elsewhere too (in distributions,
        transfers, orders of the rotation, random wander): that part of them is not in it.

    Raises
    ------
    OptionError, FormatError
        When the model makes no sense, or has no noise.
    SchemaError
        When the recording lacks the channel of an effect.
    """
    made = model if isinstance(model, Model) else read_model(model)
    axes = [str(axis) for axis in blocks["axis"].values]
    found = []
    for axis in axes:
        coefficients = made.coefficients(axis)
        square = np.array([coefficients[term] ** 2 for term in NOISE])
        if not square.any():
            raise OptionError(
                f"{made.source}: axis {axis} has no noise to compare a recording with; give N in [noise] or [noise.{axis}]"
            )
        draws = np.tile(square, (DRAWS, 1))
        K, B = np.array([coefficients["K"]]), np.array([coefficients["B"]])
        found.append(Posterior(square, np.zeros(4), K, B, np.ones(1), draws, draws[:, 2:], True))
    chosen = np.ones((len(axes), blocks.sizes["block"]), np.bool_)
    attrs: dict[str, Any] = {"source": "model", "calibrated_on": [], "model": made.source}
    if quiet is not None:
        chosen, attrs["quiet_by"] = find_quiescent_blocks(blocks, quiet)
        attrs["calibrated_on"] = find_quiescent_spans(blocks, chosen)
        found = _levelled(blocks, made, found, chosen)
    known = expect_known_effects(blocks, made, np.stack([one.square for one in found]))
    attrs["left_out"] = known.left_out
    hours = (blocks["begin"].values + blocks["end"].values) / (2.0 * HOUR)
    ramp = np.array([made.coefficients(axis)["R"] for axis in axes])
    out = assemble_baseline(
        blocks,
        found,
        quiet=chosen,
        attrs=attrs,
        known_mean=known.mean + ramp[:, None] * hours,
        spectrum=known.spectrum,
    )
    out = with_wandering(out, known.wandering, known.spectrum)
    if known.cross is not None:
        out["cross"] = (
            ("pair", "block", "band"),
            known.cross,
            {"long_name": "expected cross-spectrum", "units": _POWER},
        )
    for name, values in known.lines.items():
        last = "band" if name == "line_spectrum" else "line"
        out[name] = (
            ("axis", last),
            values,
            {"long_name": "expected power of lines", "units": _POWER},
        )
    if known.lines:
        noise = np.stack([line_columns(blocks) @ one.square for one in found])
        out["shape_alone"] *= evenness(noise + known.lines["peaks"], blocks)[:, None]
    out["coefficient"].loc[{"term": "R"}] = ramp
    out["stderr"].loc[{"term": list(TERMS) if quiet is None else ["R"]}] = 0.0
    return out


def _levelled(
    blocks: xr.Dataset, model: Model, found: list[Posterior], quiet: NDArray[np.bool_]
) -> list[Posterior]:
    """Scale the noise of a model to the quiet blocks (axis, block) of the recording, beside its effects."""
    square = np.stack([one.square for one in found])
    whole, added = (
        expect_known_effects(blocks, model, component).spectrum
        for component in (square, 0.0 * square)
    )
    return _scaled(found, *quiescent_level(blocks, whole - added, added, quiet))


def _scaled(found: list[Posterior], factor: Array, error: Array) -> list[Posterior]:
    every = zip(found, factor.tolist(), error.tolist(), strict=True)
    return [
        scale_noise(one, by, doubt, np.random.default_rng(row))
        for row, (one, by, doubt) in enumerate(every)
    ]


def baseline_from_simulation(
    blocks: xr.Dataset, simulated: xr.Dataset, *, quiet: Any = None
) -> xr.Dataset:
    """Take the noise of a simulated log with the error of calibrating it, and its level over time where that changes.

    What it shows all the time beside the five noise terms is taken as measured: the form of its
    spectrum, what axes share, steady lines. What a simulation does to the means over time cannot be
    told from its random walk, so it is not taken as known; `baseline_from_model` takes it.

    Parameters
    ----------
    blocks, simulated : xarray.Dataset
        Recording and simulation, from `reduce_log`.
    quiet : array_like of bool (block,), or (start, end) or several of these, optional
        Quiet stretches of the recording: one factor for each axis fits the noise of the simulation
        to them.

    Raises
    ------
    SchemaError
        When the two differ in axes, sampling rate or length.
    """
    for name, wanted, got in (
        (
            "sampling rate [Hz]",
            blocks.attrs["sampling_rate_hz"],
            simulated.attrs["sampling_rate_hz"],
        ),
        (
            "blocks",
            (blocks.sizes["block"], blocks.attrs["block_samples"]),
            (simulated.sizes["block"], simulated.attrs["block_samples"]),
        ),
        ("axes", list(blocks["axis"].values), list(simulated["axis"].values)),
    ):
        if wanted != got:
            raise SchemaError(
                f"simulation: {name} {got}, but {wanted} in the recording; simulate with --like RECORDING"
            )
    chosen, reason = find_quiescent_blocks(simulated)
    found, level, odd = _explained(simulated, chosen)
    plain = (
        np.einsum("abfn,an->abf", noise_powers(simulated), np.stack([one.square for one in found]))
        * level[..., None]
    )
    shown = shown_by(simulated, plain, odd)
    noise = np.einsum("abfn,an->abf", noise_powers(blocks), np.stack([one.square for one in found]))
    attrs = {
        "source": "simulation",
        "calibrated_on": find_quiescent_spans(simulated, chosen),
        "quiet_by": reason,
    }
    spectrum = noise * level[..., None] * shown.form[:, None]
    if quiet is not None:
        chosen, attrs["quiet_by"] = find_quiescent_blocks(blocks, quiet)
        attrs["calibrated_on"] = find_quiescent_spans(blocks, chosen)
        factor, error = quiescent_level(blocks, spectrum, 0.0 * spectrum, chosen)
        found, spectrum = _scaled(found, factor, error), spectrum * factor[:, None, None]
    return with_shown(
        assemble_baseline(blocks, found, quiet=chosen, attrs=attrs, spectrum=spectrum),
        shown,
        blocks,
    )


def _explained(
    simulated: xr.Dataset, chosen: NDArray[np.bool_]
) -> tuple[list[Posterior], Array, NDArray[np.bool_]]:
    """Noise of every axis from the bands that it explains, its level over time (axis, block), and the other bands (axis, band)."""
    columns = noise_powers(simulated)
    odd = np.zeros((simulated.sizes["axis"], simulated.sizes["band"]), np.bool_)
    while True:
        there = simulated.assign(
            power=simulated["power"].where(~xr.DataArray(odd, dims=("axis", "band")))
        )
        found = _posteriors(there, chosen)
        plain = np.einsum("abfn,an->abf", columns, np.stack([one.square for one in found]))
        level = _level(there, plain)
        more = odd_band(there, plain * level[..., None]) & (
            odd.sum(axis=1, keepdims=True) < odd.shape[1] - _LEAST_BANDS
        )
        if not more.any():
            return found, level, odd
        odd |= more


def _level(simulated: xr.Dataset, plain: Array) -> Array:
    """Power of every block over that of the noise terms (axis, block, band), (axis, block); 1 where chance may do as much."""
    power, shape = (
        simulated[name].transpose("axis", "block", "band").values for name in ("power", "shape")
    )
    level = np.ones(plain.shape[:2])
    for row in range(len(plain)):
        risen, deviation = loudness(power[row] / plain[row] - 1.0, shape[row])
        level[row] = np.where(deviation > _EXCESS, risen, 1.0)
    return level

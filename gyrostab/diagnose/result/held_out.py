"""What the named effects are worth on time that they were not fitted to: likelihood, misfit of the Allan variance, forecast."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.folds import FOLDS, fold_blocks
from gyrostab.diagnose.evidence.products import mean_products
from gyrostab.diagnose.evidence.wandering import expected_processes
from gyrostab.diagnose.statistics.mean import window_means
from gyrostab.diagnose.statistics.power import allan_surface
from gyrostab.diagnose.statistics.scores import Array, Windows, cube_root_score, values_in_order
from gyrostab.errors import OptionError
from gyrostab.noise import NORMAL_95

__all__ = ["Trained", "forecast_from", "held_out", "log_likelihood", "stretches"]

#: A baseline, or what fits one to the blocks where its argument, a mask of blocks, is true.
Trained = xr.Dataset | Callable[[NDArray[np.bool_]], xr.Dataset]
_STRETCH_S, _FEWEST = (
    100.0,
    36,
)  # length of a stretch, and how many there must be: long ones would hide an event whole
_LEAST = 12
_KNOWN = 0.7  # share of the record that a forecast begins from
_SHORT = 5  # blocks


def held_out(
    blocks: xr.Dataset,
    before: Trained,
    after: Trained,
    *,
    more_gain: float = 0.0,
    shown: Trained | None = None,
    forecast: Trained | None = None,
) -> dict[str, float]:
    """Compare two models of a recording on time that they have not seen.

    The record is cut into stretches; every fourth is held out in turn, and the models are fitted to
    the rest. Where the models differ in their means, so it is done for stretches of all lengths of
    `gyrostab.diagnose.evidence.folds`, as for the names, and the length at which the gain is
    largest counts: over a short hole a random walk knows a slow drift from both sides, whether it
    has a model or not.

    Parameters
    ----------
    blocks : xarray.Dataset
        The recording.
    before, after : xarray.Dataset or callable
        Baselines, the second with the effects in its ``spectrum``, ``known_mean`` and, for what the
        axes share, ``cross`` (pair, block, band). A callable gets the mask of the blocks that may
        be used, and gives the baseline fitted to them; a Dataset is taken as it is, and what comes
        of it is held out only if it was fitted elsewhere.
    more_gain : float
        Held-out gain of what is in neither means nor powers nor cross-spectra, which is added
        [nats]: counts of odd samples, waves of known course, biases of two levels. Lines are in the
        powers of their bands already, and would count twice.
    shown : xarray.Dataset or callable, optional
        Baseline with all effects, those of `more_gain` too, where `after` is without them: what the
        Allan variance is compared with.
    forecast : xarray.Dataset or callable, optional
        Baseline with the effects that can be forecast; `after` by default.

    Returns
    -------
    dict
        ``block_count``, the stretches; ``log_likelihood_gain`` of `after` over `before` and its
        ``stderr`` by the noise of the recording [nats]; ``misfit_before``, ``misfit_after``, the
        mean square of the scores of the Allan variance, 1 for a model that fits, and
        ``coverage95_before``, ``coverage95_after``, the share of them inside the 95 % band;
        ``mean_misfit_before`` and ``mean_misfit_after``, the same of the means of the stretches;
        ``forecast_gain``, the gain on the last 30 % of models fitted to the first 70 % [nats].

    Raises
    ------
    OptionError
        When the record has too few blocks.

    Examples
    --------
    >>> found = held_out(blocks, baseline, lambda known: refit(blocks.isel(block=known)))           # doctest: +SKIP
    >>> found["log_likelihood_gain"], found["stderr"]                                                 # doctest: +SKIP
    (41.2, 6.0)
    """
    cut = stretches(blocks)
    fold = np.arange(cut.first.size) % FOLDS
    gains = _Gain(more_gain, 2.0 * abs(more_gain))
    squares: dict[str, list[Array]] = {
        name: [] for name in ("before", "after", "mean_before", "mean_after")
    }
    moves = False
    for number in range(FOLDS):
        held = Windows(cut.first[fold == number], cut.stop[fold == number])
        out = _inside(held, blocks.sizes["block"])
        models = {"before": _trained(before, ~out), "after": _trained(after, ~out)}
        gains = gains.plus(_gain(blocks, models["before"], models["after"], out))
        moves |= not models["after"]["known_mean"].equals(models["before"]["known_mean"])
        if shown is not None:
            models["after"] = _trained(shown, ~out)
        for name, baseline in models.items():
            squares[name].append(_allan_scores(blocks, baseline, held))
            squares[f"mean_{name}"].append(_mean_scores(blocks, baseline, held))
    evidence_nats, variance = max(
        [gains, *(_longer(blocks, before, after, more_gain) if moves else [])]
    )
    return {
        "blocks": cut.first.size,
        "log_likelihood_gain": float(evidence_nats),
        "stderr": float(np.sqrt(variance)),
        **_misfits(squares),
        "forecast_gain": _forecast(blocks, before, after if forecast is None else forecast),
    }


class _Gain(NamedTuple):
    """A gain [nats] and its variance."""

    nats: float
    variance: float

    def plus(self, other: _Gain) -> _Gain:
        return _Gain(self.nats + other.nats, self.variance + other.variance)


def _gain(
    blocks: xr.Dataset, before: xr.Dataset, after: xr.Dataset, held: NDArray[np.bool_]
) -> _Gain:
    """What one trained model gains over another on the blocks held out."""
    nats = log_likelihood(blocks, after, ~held, held) - log_likelihood(blocks, before, ~held, held)
    return _Gain(nats, _variance(blocks, before, after, held, nats))


def _longer(blocks: xr.Dataset, before: Trained, after: Trained, more_gain: float) -> list[_Gain]:
    """Gains on longer stretches."""
    found = []
    for fold in fold_blocks(blocks).transpose("length", "block").values[1:]:
        whole = _Gain(more_gain, 2.0 * abs(more_gain))
        for number in range(FOLDS):
            held = fold == number
            whole = whole.plus(_gain(blocks, _trained(before, ~held), _trained(after, ~held), held))
        found.append(whole)
    return found


def stretches(blocks: xr.Dataset) -> Windows:
    """The stretches that are held out: 100 s long, shorter in records of less than an hour.

    Raises
    ------
    OptionError
        When there are too few blocks.
    """
    block_count, span = (
        blocks.sizes["block"],
        blocks.sizes["block"] * float(blocks.attrs["block_s"]),
    )
    if block_count < _LEAST:
        raise OptionError(
            f"the record has {block_count} blocks, too few to hold any out: it needs {_LEAST}; give a longer record or shorter blocks"
        )
    edge = np.rint(
        np.linspace(0, block_count, min(block_count, max(_FEWEST, round(span / _STRETCH_S))) + 1)
    ).astype(np.int64)
    return Windows(edge[:-1], edge[1:])


def log_likelihood(
    blocks: xr.Dataset, baseline: xr.Dataset, known: NDArray[np.bool_], held: NDArray[np.bool_]
) -> float:
    """Log-likelihood of held-out blocks given the known blocks [nats], up to a constant of the data.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        The recording, and a model.
    known, held : ndarray of bool (block,)
        Blocks that are predicted from, and those that are predicted.
    """
    total = float((_power_terms(blocks, baseline) + _cross_terms(blocks, baseline))[held].sum())
    for axis in range(blocks.sizes["axis"]):
        total += _mean_evidence(blocks, baseline, axis, known | held) - _mean_evidence(
            blocks, baseline, axis, known
        )
    return total


def _trained(model: Trained, known: NDArray[np.bool_]) -> xr.Dataset:
    return model if isinstance(model, xr.Dataset) else model(known)


def _inside(windows: Windows, block_count: int) -> NDArray[np.bool_]:
    inside = np.zeros(block_count, dtype=bool)
    for first, stop in zip(windows.first, windows.stop, strict=True):
        inside[first:stop] = True
    return inside


def _variance(
    blocks: xr.Dataset,
    before: xr.Dataset,
    after: xr.Dataset,
    held: NDArray[np.bool_],
    evidence_nats: float,
) -> float:
    """Variance of a gain: that of the powers from the scatter of their cells about `after`; a normal law has twice its gain."""
    power, shape = (
        values_in_order(blocks, name, "axis", "block", "band") for name in ("power", "shape")
    )
    one, other = (
        values_in_order(baseline, "spectrum", "axis", "block", "band")
        for baseline in (after, before)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.square(shape * (1.0 / one - 1.0 / other) * (power - one))[:, held]
    by_power = float((_power_terms(blocks, after) - _power_terms(blocks, before))[held].sum())
    return float(terms[np.isfinite(terms)].sum()) + 2.0 * abs(evidence_nats - by_power)


def _power_terms(blocks: xr.Dataset, baseline: xr.Dataset) -> Array:
    """Log-likelihood of the band powers of every block, by gamma laws."""
    power, shape = (
        values_in_order(blocks, name, "axis", "block", "band") for name in ("power", "shape")
    )
    spectrum = values_in_order(baseline, "spectrum", "axis", "block", "band")
    there = np.isfinite(power) & np.isfinite(shape) & (spectrum > 0)
    safe = np.where(there, spectrum, 1.0)
    return np.asarray(np.where(there, -shape * (np.log(safe) + power / safe), 0.0).sum(axis=(0, 2)))


def _cross_terms(blocks: xr.Dataset, baseline: xr.Dataset) -> Array:
    """What the cross-spectra of the model add in every block, by complex Wishart laws; nothing where it has none."""
    block_count = blocks.sizes["block"]
    if "cross" not in baseline or "cross" not in blocks:
        return np.zeros(block_count)
    axes = [str(axis) for axis in blocks["axis"].values]
    left = [axes.index(str(axis)) for axis in blocks["first"].values]
    right = [axes.index(str(axis)) for axis in blocks["second"].values]
    power, shape = (
        np.moveaxis(values_in_order(blocks, name, "axis", "block", "band"), 0, -1)
        for name in ("power", "shape")
    )
    spectrum = np.moveaxis(values_in_order(baseline, "spectrum", "axis", "block", "band"), 0, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        both = np.sqrt(spectrum[..., left] * spectrum[..., right])
        seen = np.moveaxis(values_in_order(blocks, "cross", "pair", "block", "band"), 0, -1) / both
        model = (
            np.moveaxis(values_in_order(baseline, "cross", "pair", "block", "band"), 0, -1) / both
        )
        flat = power / spectrum
    there = (
        np.isfinite(seen).all(axis=-1)
        & np.isfinite(model).all(axis=-1)
        & np.isfinite(flat).all(axis=-1)
    )
    size = len(axes)
    expected = np.zeros((*there.shape, size, size), dtype=np.complex128)
    found = expected.copy()
    expected[..., range(size), range(size)] = 1.0
    found[..., range(size), range(size)] = np.where(there[..., None], flat, 1.0)
    for matrix, values in ((expected, model), (found, seen)):
        values = np.where(there[..., None], values, 0.0)
        matrix[..., left, right], matrix[..., right, left] = values, values.conj()
    trace = np.einsum("...ij,...ji->...", np.linalg.inv(expected) - np.eye(size), found).real
    weight = np.where(there, np.nan_to_num(shape.min(axis=-1)), 0.0)
    return np.asarray((-weight * (np.linalg.slogdet(expected)[1] + trace)).sum(axis=-1))


def _mean_evidence(
    blocks: xr.Dataset, baseline: xr.Dataset, axis: int, used: NDArray[np.bool_]
) -> float:
    """Log-likelihood of the block means that are used, with a free constant, averaged over the calibrated random walk and flicker."""
    residual = (
        values_in_order(blocks, "mean", "axis", "block")[axis]
        - values_in_order(baseline, "known_mean", "axis", "block")[axis]
    )
    variance = values_in_order(baseline, "mean_variance", "axis", "block")[axis]
    present = used & np.isfinite(residual) & np.isfinite(variance) & (variance > 0)
    if "grid_K" in baseline:
        walk, flicker = baseline["grid_K"].values[axis], baseline["grid_B"].values[axis]
        weight = baseline["grid_calibrated"].values[axis]
    else:
        terms = [str(term) for term in baseline["term"].values]
        walk, flicker = (
            np.nan_to_num(baseline["coefficient"].values[axis, [terms.index(term)]])
            for term in ("K", "B")
        )
        weight = np.zeros(1)
    found = mean_products(
        np.where(present, residual, 0.0)[:, None],
        np.empty((residual.size, 0)),
        variance=np.where(present, variance, 1.0),
        step=float(blocks.attrs["block_s"]),
        K=np.asarray(walk, dtype=float),
        B=np.asarray(flicker, dtype=float),
        present=present,
        wander=expected_processes(baseline, axis),
    )
    log = weight - np.logaddexp.reduce(weight) - 0.5 * (found.square[:, 0] + found.log_determinant)
    return float(np.logaddexp.reduce(log))


def _allan_scores(blocks: xr.Dataset, baseline: xr.Dataset, held: Windows) -> Array:
    """Squared scores of the Allan variance in windows that lie inside the held-out stretches, side by side."""
    first, stop = [held.first], [held.stop]
    for length in {1, min(_SHORT, int((held.stop - held.first).min()))}:
        inside = [
            np.arange(low, high - length + 1, length)
            for low, high in zip(held.first, held.stop, strict=True)
        ]
        start = np.concatenate(inside)
        first.append(start)
        stop.append(start + length)
    windows = Windows(np.concatenate(first), np.concatenate(stop))
    surface = allan_surface(blocks, baseline, windows)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = cube_root_score(surface["observed"] / surface["expected"], surface["shape"])[
            ..., surface["columns"]["what"] == "avar"
        ]
    return np.asarray(z[np.isfinite(z)] ** 2)


def _mean_scores(blocks: xr.Dataset, baseline: xr.Dataset, held: Windows) -> Array:
    amount, information = window_means(blocks, baseline, held)
    square = amount**2 / information
    return np.asarray(square[np.isfinite(square)])


def _misfits(squares: dict[str, list[Array]]) -> dict[str, float]:
    found: dict[str, float] = {}
    joined = {name: np.concatenate(components) for name, components in squares.items()}
    for name in ("before", "after"):
        cells = joined[name]
        found[f"misfit_{name}"] = float(cells.mean()) if cells.size else np.nan
        found[f"coverage95_{name}"] = float((cells < NORMAL_95**2).mean()) if cells.size else np.nan
        means = joined[f"mean_{name}"]
        found[f"mean_misfit_{name}"] = float(means.mean()) if means.size else np.nan
    return found


def forecast_from(blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Select the blocks that a forecast of the others begins from."""
    return np.asarray(np.arange(blocks.sizes["block"]) < round(_KNOWN * blocks.sizes["block"]))


def _forecast(blocks: xr.Dataset, before: Trained, after: Trained) -> float:
    known = forecast_from(blocks)
    late, early = (
        log_likelihood(blocks, _trained(model, known), known, ~known) for model in (after, before)
    )
    return late - early

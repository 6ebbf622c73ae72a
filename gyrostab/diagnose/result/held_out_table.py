"""Measure what the effects gain on held-out data: likelihood, misfit, coverage, and forecast."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import compress

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Bools, Floats, Ints
from gyrostab.diagnose.baseline.calibrate import calibrate_on_training_blocks
from gyrostab.diagnose.baseline.expected_statistics import reduced_shape
from gyrostab.diagnose.estimate.conditioned_baseline import expected_baseline, predict_baseline
from gyrostab.diagnose.estimate.joint_fit import Fitted
from gyrostab.diagnose.estimate.recalibrate import recalibrate, with_noise
from gyrostab.diagnose.evidence.folds import FOLDS, fold_blocks
from gyrostab.diagnose.evidence.held_out import mean_residual, noise_weight
from gyrostab.diagnose.evidence.mixture import products_mixture
from gyrostab.diagnose.evidence.products import axis_noise, mean_products
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import Selection, components_of
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.filter_response import logger_responses
from gyrostab.diagnose.reduce.schema import pair_indices
from gyrostab.diagnose.result.active_spans import active_blocks
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics.allan_surface import allan_surface
from gyrostab.diagnose.statistics.sample_counts import mask_anomalous_blocks
from gyrostab.diagnose.statistics.scores import BlockWindows, cube_root_score
from gyrostab.noise import NORMAL_95
from gyrostab.store.threads import map_in_order

#: Fits a baseline to the blocks where its argument, a mask, is true.
FitBaseline = Callable[[Bools], xr.Dataset]
STRETCH_S = 100.0  # length of a held-out stretch; longer ones would hide a whole event
MIN_STRETCHES = 36  # in records shorter than an hour the stretches are shorter instead
FORECAST_FROM_SHARE = 0.7  # share of the record that a forecast begins from
SHORT_WINDOW_BLOCKS = 5  # length of the middle one of the three windows of the Allan variance


def measure_held_out(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    identifications: Identifications,
    first_fit: Sequence[Fitted],
) -> dict[str, float]:
    """Measure what the effects gain on held-out data, with the noise fitted together with them.

    The likelihood of `held_out` is that of means, powers and cross-spectra. Sample counts,
    random biases and phase-locked components are in none of these: their evidence is added.
    """
    settings = identifications.state.settings
    with_course, random_nats = _remove_random_biases(identifications)
    first_fit = [
        fitted
        for fitted in first_fit
        if not any(component.statistic.is_random_bias for component in fitted.components)
    ]
    judged, phase_locked_nats = remove_phase_locked(with_course, blocks)
    identified = with_course.identified
    count_nats = sum(
        component.evidence_nats
        for component in components_of(identified)
        if component.statistic.is_count
    )
    anomalous = components_of([*identified, *with_course.expected])
    clean = mask_anomalous_blocks(blocks, anomalous, settings)
    responses = cache(partial(logger_responses, blocks))
    calibrate = _remember_fits(
        partial(
            calibrate_on_training_blocks, blocks, baseline, responses=responses, settings=settings
        )
    )

    @_remember_fits
    def before(training: Bools) -> xr.Dataset:
        return expected_baseline(with_course, calibrate(training), training)

    def train(
        chosen: Identifications, training: Bools, is_left_out: Sequence[bool] = ()
    ) -> xr.Dataset:
        noise = recalibrate(chosen, calibrate(training), first_fit, training)
        renewed = with_noise(chosen, noise)
        left_out = tuple(compress(renewed.identified, is_left_out))
        return predict_baseline(renewed, noise, training, left_out=left_out)

    after = _remember_fits(partial(train, judged)) if judged.identified else before
    training = select_forecast_start(blocks)
    begun, is_over = _list_begun(judged.identified, blocks, training, settings)
    has_forecast = not all(is_over)
    evidence = held_out(
        clean,
        before,
        after,
        added_nats=count_nats + random_nats + phase_locked_nats,
        shown=partial(train, with_course) if phase_locked_nats else after,
        forecast=partial(train, replace(judged, identified=begun), is_left_out=is_over)
        if has_forecast
        else before,
    )
    if not has_forecast:
        evidence["forecast_gain"] = np.nan  # no effect can be forecast
    return evidence


def _remember_fits(fit: FitBaseline) -> FitBaseline:
    """Return what fits a baseline once to each set of blocks."""
    fitted: dict[bytes, xr.Dataset] = {}

    def recall(training: Bools) -> xr.Dataset:
        place = training.tobytes()
        if place not in fitted:
            fitted[place] = fit(training)
        return fitted[place]

    return recall


def _list_begun(
    identified: Sequence[Selection], blocks: xr.Dataset, training: Bools, settings: Settings
) -> tuple[tuple[Selection, ...], list[bool]]:
    """List the effects that act in the training blocks, and which of them are not forecast.

    What is over later is not forecast, but is in the blocks that the noise is calibrated on.
    """
    begun = tuple(
        identification
        for identification in identified
        if active_blocks(identification, blocks, settings=settings)[training].any()
    )
    return begun, [
        not _can_be_forecast(identification, blocks, settings) for identification in begun
    ]


def _remove_random_biases(identifications: Identifications) -> tuple[Identifications, float]:
    """Drop biases that wander or switch at random, and return their evidence [nats].

    No held-out data show the course of one. Their Bayes factor is the sum of what they gain when
    every block is predicted from those before it.
    """
    identified, evidence_nats = [], 0.0
    for identification in identifications.identified:
        if any(component.statistic.is_random_bias for component in identification.components):
            evidence_nats += identification.evidence_nats
        else:
            identified.append(identification)
    return replace(identifications, identified=tuple(identified)), evidence_nats


def remove_phase_locked(
    identifications: Identifications, blocks: xr.Dataset
) -> tuple[Identifications, float]:
    """Drop phase-locked components and sines, and return their evidence [nats].

    The band powers show how large such a component is, but not its phase. In them it would gain a
    small part of its evidence, and lose in every band that it leaves. Therefore its own statistic
    alone counts, and the powers of both models are without it.
    """
    identified, evidence_nats = [], 0.0
    for identification in identifications.identified:
        locked: list[Component] = []
        rest: list[Component] = []
        for component in identification.components:
            is_locked = component.statistic.is_only_in_phase(component, blocks)
            (locked if is_locked else rest).append(component)
        evidence_nats += sum(component.evidence_nats for component in locked)
        if rest:
            identified.append(
                replace(identification, components=tuple(rest)) if locked else identification
            )
    return replace(identifications, identified=tuple(identified)), evidence_nats


def _can_be_forecast(identification: Selection, blocks: xr.Dataset, settings: Settings) -> bool:
    """Return whether an effect that acts before a forecast begins can be forecast.

    The size of an event in the last part is unknown before, also where it is one of several jumps,
    and an event that is over does not affect the last part. Sample counts are in neither means nor
    powers, which are forecast.
    """
    if all(component.statistic.is_count for component in identification.components):
        return False
    acts = active_blocks(identification, blocks, settings=settings)
    training = select_forecast_start(blocks)
    has_later_step = any(
        component.is_step
        and (np.ptp(component.variant.design[..., training], axis=-1) == 0.0).any()
        for component in identification.components
    )
    return bool(acts[~training].any() and not has_later_step)


def held_out(
    blocks: xr.Dataset,
    before: FitBaseline,
    after: FitBaseline,
    *,
    added_nats: float,
    shown: FitBaseline,
    forecast: FitBaseline,
) -> dict[str, float]:
    """Compare two models of a recording on data that they were not fitted to.

    The record is cut into stretches. Every fourth is held out in turn, and the models are fitted to
    the rest. Models that differ in their means are also compared on stretches of all lengths of
    `gyrostab.diagnose.evidence.folds`, as in the identification; the length with the most evidence
    counts. Over a short gap, a random walk follows a slow drift from both sides, so that a model of
    the drift gains little there.

    Parameters
    ----------
    before, after : callable
        Take the mask of the blocks that they may use, and return the baseline fitted to them, the
        second with the effects in its ``spectrum``, ``known_mean`` and, for noise in common,
        ``cross`` (pair, block, band).
    added_nats : float
        Held-out gain [nats] of what is in neither means nor powers nor cross-spectra, to be added:
        sample counts, phase-locked components, random biases. Lines whose phase wanders are in the
        powers of their bands already and would count twice.
    shown : callable
        The same with all effects, those of `added_nats` included, for the Allan variance.
    forecast : callable
        The same with the effects that can be forecast.

    Returns
    -------
    dict
        ``blocks``, the number of stretches; ``log_likelihood_gain`` of `after` over `before` and
        its ``stderr`` by the noise of the recording [nats]; ``misfit_before``, ``misfit_after``,
        the mean square of the scores of the Allan variance (1 for a model that fits), and
        ``coverage95_before``, ``coverage95_after``, the share of them inside the 95 % band;
        ``forecast_gain`` [nats] on the last 30 % of models fitted to the first 70 %.
    """
    windows = cut_held_out_stretches(blocks)
    stretches = np.repeat(np.arange(windows.first.size) % FOLDS, windows.length)
    gain, moves = _compare_on_folds(blocks, before, after, stretches, added_nats)
    gains = [gain]
    for fold in fold_blocks(blocks).values[1:] if moves else ():
        gains.append(_compare_on_folds(blocks, before, after, fold, added_nats)[0])
    evidence_nats, variance = max(of_length.tolist() for of_length in gains)
    training = select_forecast_start(blocks)
    late, early = (
        log_likelihood(blocks, model(training), training, ~training) for model in (forecast, before)
    )
    squares = {
        name: _allan_scores(blocks, fit, windows)
        for name, fit in (("before", before), ("after", shown))
    }
    return {
        "blocks": windows.first.size,
        "log_likelihood_gain": evidence_nats,
        "stderr": math.sqrt(variance),
        **{f"misfit_{name}": _average_cells(values) for name, values in squares.items()},
        **{
            f"coverage95_{name}": _average_cells(values < NORMAL_95**2)
            for name, values in squares.items()
        },
        "forecast_gain": late - early,
    }


def _compare_on_folds(
    blocks: xr.Dataset, before: FitBaseline, after: FitBaseline, fold: Ints, added_nats: float
) -> tuple[Floats, bool]:
    """Return the gain on all folds (block,) and its variance, and whether the means differ."""

    def compare(number: int) -> tuple[Floats, bool]:
        held = fold == number
        without, with_effects = before(~held), after(~held)
        gain = _compare_models(blocks, without, with_effects, held)
        return gain, not with_effects["known_mean"].equals(without["known_mean"])

    gains, moves = zip(*map_in_order(compare, range(FOLDS)), strict=True)
    return sum(gains, np.array([added_nats, 2.0 * abs(added_nats)])), any(moves)


def _compare_models(
    blocks: xr.Dataset, before: xr.Dataset, after: xr.Dataset, held: Bools
) -> Floats:
    """Return what one fitted model gains over another on held-out blocks [nats], and its variance.

    For the powers the variance follows from the scatter of their cells about `after`; for normal
    laws it is twice the gain.
    """
    nats = log_likelihood(blocks, after, ~held, held) - log_likelihood(blocks, before, ~held, held)
    power, shape = (blocks[name].values for name in ("power", "shape"))
    spectrum_after, spectrum_before = (baseline["spectrum"].values for baseline in (after, before))
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.square(
            shape * (1.0 / spectrum_after - 1.0 / spectrum_before) * (power - spectrum_after)
        )[:, held]
    by_power = float((_power_terms(blocks, after) - _power_terms(blocks, before))[held].sum())
    variance = float(terms[np.isfinite(terms)].sum()) + 2.0 * abs(nats - by_power)
    return np.array([nats, variance])


def cut_held_out_stretches(blocks: xr.Dataset) -> BlockWindows:
    """Cut a record into the stretches to hold out: 100 s long, shorter in records below an hour."""
    block_count = blocks.sizes["block"]
    span = block_count * float(blocks.attrs["block_s"])
    edge = np.rint(
        np.linspace(
            0, block_count, min(block_count, max(MIN_STRETCHES, round(span / STRETCH_S))) + 1
        )
    ).astype(np.int64)
    return BlockWindows(edge[:-1], edge[1:])


def log_likelihood(blocks: xr.Dataset, baseline: xr.Dataset, training: Bools, held: Bools) -> float:
    """Return the log-likelihood of held-out blocks given the training blocks [nats].

    It leaves out a constant that depends only on the data.

    Parameters
    ----------
    training, held : ndarray of bool (block,)
        Blocks to predict from, and blocks to predict.
    """
    total = float((_power_terms(blocks, baseline) + _cross_terms(blocks, baseline))[held].sum())
    for axis in map(str, blocks["axis"].values):
        total += _mean_evidence(blocks, baseline, axis, training | held) - _mean_evidence(
            blocks, baseline, axis, training
        )
    return total


def _power_terms(blocks: xr.Dataset, baseline: xr.Dataset) -> Floats:
    """Return the log-likelihood of the band powers of every block, by gamma laws."""
    power, shape = blocks["power"].values, reduced_shape(blocks)
    spectrum = baseline["spectrum"].values
    has_data = np.isfinite(power) & np.isfinite(shape) & (spectrum > 0)
    safe = np.where(has_data, spectrum, 1.0)
    return np.asarray(
        np.where(has_data, -shape * (np.log(safe) + power / safe), 0.0).sum(axis=(0, 2))
    )


def _cross_terms(blocks: xr.Dataset, baseline: xr.Dataset) -> Floats:
    """Return what the cross-spectra of a model add in every block, by complex Wishart laws.

    Without cross-spectra they add zero.
    """
    block_count = blocks.sizes["block"]
    if "cross" not in baseline or "cross" not in blocks:
        return np.zeros(block_count)
    left, right = pair_indices(blocks)
    power, shape = (np.moveaxis(blocks[name].values, 0, -1) for name in ("power", "shape"))
    spectrum = np.moveaxis(baseline["spectrum"].values, 0, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        geometric_mean = np.sqrt(spectrum[..., left] * spectrum[..., right])
        coherency = np.moveaxis(blocks["cross"].values, 0, -1) / geometric_mean
        model = np.moveaxis(baseline["cross"].values, 0, -1) / geometric_mean
        flat = power / spectrum
    has_data = (
        np.isfinite(coherency).all(axis=-1)
        & np.isfinite(model).all(axis=-1)
        & np.isfinite(flat).all(axis=-1)
    )
    size = blocks.sizes["axis"]
    expected = np.zeros((*has_data.shape, size, size), dtype=np.complex128)
    observed = expected.copy()
    expected[..., range(size), range(size)] = 1.0
    observed[..., range(size), range(size)] = np.where(has_data[..., None], flat, 1.0)
    for matrix, values in ((expected, model), (observed, coherency)):
        values = np.where(has_data[..., None], values, 0.0)
        matrix[..., left, right], matrix[..., right, left] = values, values.conj()
    trace = np.einsum("...ij,...ji->...", np.linalg.inv(expected) - np.eye(size), observed).real
    weight = np.where(has_data, np.nan_to_num(shape.min(axis=-1)), 0.0)
    return np.asarray((-weight * (np.linalg.slogdet(expected)[1] + trace)).sum(axis=-1))


def _mean_evidence(blocks: xr.Dataset, baseline: xr.Dataset, axis: str, used: Bools) -> float:
    """Return the log-likelihood of the used block means with a free constant.

    It is averaged over the calibrated random walk and flicker.
    """
    residual = mean_residual(blocks, baseline, axis)
    noise = axis_noise(baseline, axis)
    variance, weight = noise["variance"], noise_weight(baseline, axis, "calibrated")
    products = mean_products(
        residual,
        np.empty((used.size, 0)),
        **noise,
        step=float(blocks.attrs["block_s"]),
        present=used & np.isfinite(residual[:, 0]) & np.isfinite(variance) & (variance > 0),
    )
    return products_mixture(products, weight - np.logaddexp.reduce(weight)).evidence


def _allan_scores(blocks: xr.Dataset, fit: FitBaseline, stretches: BlockWindows) -> Floats:
    """Return squared scores of the Allan variance in disjoint windows of held-out stretches."""
    squares = []
    for number in range(FOLDS):
        is_held = np.arange(stretches.first.size) % FOLDS == number
        held = BlockWindows(stretches.first[is_held], stretches.stop[is_held])
        baseline = fit(~np.repeat(is_held, stretches.length))
        first, stop = [held.first], [held.stop]
        for length in {1, min(SHORT_WINDOW_BLOCKS, int(held.length.min()))}:
            inside = [
                np.arange(low, high - length + 1, length) for low, high in zip(*held, strict=True)
            ]
            start = np.concatenate(inside)
            first.append(start)
            stop.append(start + length)
        windows = BlockWindows(np.concatenate(first), np.concatenate(stop))
        surface = allan_surface(blocks, baseline, windows)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = cube_root_score(surface["observed"] / surface["expected"], surface["shape"])
        z = z[..., surface["columns"]["quantity"] == "avar"]
        squares.append(z[np.isfinite(z)] ** 2)
    return np.concatenate(squares)


def _average_cells(values: Array) -> float:
    return float(values.mean()) if values.size else np.nan


def select_forecast_start(blocks: xr.Dataset) -> Bools:
    """Select the blocks that a forecast of the others begins from."""
    return np.asarray(
        np.arange(blocks.sizes["block"]) < round(FORECAST_FROM_SHARE * blocks.sizes["block"])
    )

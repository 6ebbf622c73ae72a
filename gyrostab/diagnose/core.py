"""Compare a recording with a simulation: the steps of a diagnosis in their order."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import (
    baseline_from_model,
    baseline_from_simulation,
    calibrate_noise,
)
from gyrostab.diagnose.baseline.known_effects import expect_known_motion, remove_known_lines
from gyrostab.diagnose.estimate.expected_effects import expected_baseline, without_expected
from gyrostab.diagnose.estimate.recalibrate import remove_fast_switching
from gyrostab.diagnose.identify.forward_search import name_effects
from gyrostab.diagnose.identify.moving_axes import unexplained_motion, without_motion
from gyrostab.diagnose.inputs import check_options, read_simulation, varying_axes
from gyrostab.diagnose.locate.mismatches import locate_mismatches
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.nulls.scores import null_scores
from gyrostab.diagnose.reduce.aligned_channels import align_channels
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.attribution import drop_expected
from gyrostab.diagnose.result.diagnosis import Diagnosis
from gyrostab.diagnose.result.finish import finish_diagnosis
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.task import Comparison, Task, lines_without_motion
from gyrostab.errors import SchemaError
from gyrostab.ingest.convert import as_log
from gyrostab.physics.base import Effect
from gyrostab.progress import Stage, no_stage
from gyrostab.simulate.model import Model

__all__ = ["diagnose"]

#: Null records up to this size stay in memory; larger ones are drawn again on each pass.
MAX_KEPT_NULL_BYTES = 3e8
#: Band powers of the null records that are drawn and scored together; bounds the memory.
MAX_BATCH_POWER_BYTES = 6.4e7
#: Fewer records in a batch would spend the time on the loop around them.
MIN_BATCH_RECORDS = 25


def diagnose(
    log: xr.Dataset,
    *,
    simulation: str | os.PathLike[str] | Mapping[str, Any] | Model | xr.Dataset | None = None,
    quiet: Any = None,
    seed: int = 0,
    nulls: int = 400,
    false_alarm_level: float = 0.01,
    block: Any = None,
    restart_gap: Any = 5.0,
    progress: Stage = no_stage,
    settings: Settings = DEFAULTS,
) -> Diagnosis:
    """Find where a recording differs from a simulation, and which physics explains it.

    The recording is reduced to block statistics. Null records with the noise of the simulation
    give the thresholds: a larger deviation is a mismatch. Effects are identified by how much better
    they predict held-out data, fitted together, and added to the model.

    Parameters
    ----------
    log : xarray.Dataset
        The recording: a regular log with its channels, in memory or lazy.
    simulation : model, path of a model, or xarray.Dataset, optional
        What the recording is compared with: noise and effects of a model, or a simulated log on
        the same time stamps. By default, the five noise terms calibrated on quiescent stretches of
        the recording.
    quiet : (start, end) or list of these, optional
        Quiescent stretches, as seconds since the start or ISO times; detected automatically by
        default. With a `simulation` they calibrate the level of its noise: one factor per axis.
    seed : int
        Seed of the null records.
    nulls : int
        Number of null records.
    false_alarm_level : float
        Probability that a recording without any missing physics gives a mismatch or an effect.
    block : str or timedelta
    restart_gap : str or float
        As in `gyrostab.diagnose.reduce.block_statistics.reduce_log`.
    progress : Stage
        Callback for progress.
    settings : Settings
        Numbers that decide what is reported; docs/settings.md lists them with their sources.

    Returns
    -------
    Diagnosis
        Verdict, mismatches, effects with their sizes and alternatives, limits of effects that were
        not found, the model, and the surfaces.

    Raises
    ------
    SchemaError
        When `log` is not a regular log, or no axis varies.
    OptionError
        When the record is too short, an option is out of range, or recording and simulation do not
        match.

    Examples
    --------
    >>> found = gyrostab.diagnose(gyrostab.open_log("run7.nc"))  # doctest: +SKIP
    >>> found.verdict, [effect["name"] for effect in found.effects]  # doctest: +SKIP
    ('explained', ['vibration_noise'])
    """
    from threadpoolctl import threadpool_limits

    check_options(nulls, false_alarm_level, seed)
    log = as_log(log)
    # the matrices are many and small: more threads would only wait for each other
    with threadpool_limits(1, user_api="blas"):
        return _diagnose(
            log,
            simulation,
            quiet,
            seed,
            nulls,
            false_alarm_level,
            block,
            restart_gap,
            progress,
            settings,
        )


def _diagnose(
    log: xr.Dataset,
    simulation: Any,
    quiet: Any,
    seed: int,
    nulls: int,
    level: float,
    block: Any,
    restart_gap: Any,
    progress: Stage,
    settings: Settings,
) -> Diagnosis:
    """Run the steps in their order."""
    started = time.perf_counter()
    log = _align_channels(log)
    simulation = read_simulation(simulation, log)
    blocks = reduce_log(log, block=block, restart_gap=restart_gap, progress=progress)
    axes = varying_axes(blocks)
    if len(axes) < log.sizes["axis"]:
        log = log.sel(axis=axes)
        blocks = reduce_log(log, block=block, restart_gap=restart_gap, progress=progress)
        simulation = simulation.sel(axis=axes) if isinstance(simulation, xr.Dataset) else simulation
    task = Task(log, simulation, quiet, restart_gap, seed, nulls, level, progress, settings)
    comparison = _compare(task, *_calibrate(task, blocks))
    comparison = _compare_without_motion(task, comparison)
    comparison = _compare_without_fast_switching(task, comparison)
    progress("fitting", 0)
    return finish_diagnosis(task, comparison, started)


def _calibrate(task: Task, blocks: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the blocks in which the given model does not move the rate, and their baseline."""
    task.progress("calibrating", 0)
    baseline = _make_baseline(task, blocks)
    if isinstance(task.simulation, Model):
        moving = expect_known_motion(blocks, baseline)
        if moving.any():
            at_rest = without_motion(
                task.log, blocks, moving, restart_gap=task.restart_gap, progress=task.progress
            )
            blocks = at_rest.drop_vars("moving")  # the model accounts for this motion
            baseline = _make_baseline(task, blocks)
    return blocks, baseline


def _compare(task: Task, blocks: xr.Dataset, baseline: xr.Dataset) -> Comparison:
    """Draw null records, identify effects, and locate the mismatches.

    Identified effects and located mismatches have half of the false-alarm level each.
    """
    level = task.level / 2.0
    seen = remove_known_lines(blocks, baseline)
    records = _repeatable_null_records(seen, baseline, task.nulls, task.seed)
    task.progress("comparing", 0)
    null = null_scores(baseline, records(), settings=task.settings)
    task.progress("naming", 0)
    known = _effects_left_out(baseline, task.simulation)
    identifications = name_effects(
        seen,
        baseline,
        records(),
        level=level,
        seed=task.seed,
        known=known,
        progress=task.progress,
        settings=task.settings,
    )
    expected = identifications.expected
    before = expected_baseline(identifications, baseline)
    at_rest = lines_without_motion(task, seen, before) if expected else seen
    mismatches = locate_mismatches(
        without_expected(at_rest, baseline, expected),
        before,
        null,
        level=level,
        settings=task.settings,
    )
    mismatches = drop_expected(
        mismatches, expected, seen, before, null, level=level, settings=task.settings
    )
    return Comparison(blocks, baseline, mismatches, identifications, null)


def _compare_without_motion(task: Task, comparison: Comparison) -> Comparison:
    """Repeat the comparison without the blocks of unexplained motion, if there are any.

    The comparison with the motion stays when too few blocks are left.
    """
    if task.simulation is not None:
        return comparison
    moving = unexplained_motion(
        comparison.blocks, comparison.identifications.identified, settings=task.settings
    )
    if not moving.any():
        return comparison
    at_rest = without_motion(
        task.log, comparison.blocks, moving, restart_gap=task.restart_gap, progress=task.progress
    )
    try:
        return _compare(task, *_calibrate(task, at_rest))
    except SchemaError as error:
        warnings.warn(
            f"the diagnosis includes unexplained motion: without it too little is left ({error})",
            stacklevel=4,
        )
        return comparison


def _compare_without_fast_switching(task: Task, comparison: Comparison) -> Comparison:
    """Repeat the comparison with the noise calibrated free of switching within blocks."""
    baseline = remove_fast_switching(comparison.identifications, comparison.baseline)
    if baseline is comparison.baseline:
        return comparison
    return _compare(task, comparison.blocks, baseline)


def _align_channels(log: xr.Dataset) -> xr.Dataset:
    """Place the channels on the time grid of the gyro, and note those that cannot be used."""
    aligned = align_channels(log)
    for note in aligned.notes:
        warnings.warn(note, stacklevel=5)
    return aligned.log.assign_attrs(unused_channels=aligned.unused)


def _make_baseline(task: Task, blocks: xr.Dataset) -> xr.Dataset:
    """Return what the simulation predicts for the blocks."""
    if task.simulation is None:
        return calibrate_noise(blocks, quiet=task.quiet, settings=task.settings)
    if isinstance(task.simulation, Model):
        return baseline_from_model(
            blocks, task.simulation, quiet=task.quiet, settings=task.settings
        )
    same_block = f"{blocks.attrs['block_samples']}samples"
    simulated = reduce_log(
        task.simulation, block=same_block, restart_gap=task.restart_gap, progress=task.progress
    )
    return baseline_from_simulation(blocks, simulated, quiet=task.quiet, settings=task.settings)


def _repeatable_null_records(
    blocks: xr.Dataset, baseline: xr.Dataset, count: int, seed: int
) -> Callable[[], Iterable[xr.Dataset]]:
    """Return a function that gives the same null records on each call.

    Small ones are kept in memory; large ones are drawn again.
    """
    power_bytes = blocks["power"].size * 8
    batch = int(np.clip(MAX_BATCH_POWER_BYTES / power_bytes, MIN_BATCH_RECORDS, count))

    def draw() -> Iterable[xr.Dataset]:
        rng = np.random.default_rng(seed)
        return null_records(blocks, baseline, count=count, rng=rng, chunk=batch)

    # with lines and cross-spectra, a null record takes about three times as much as its powers
    if count * power_bytes * 3 > MAX_KEPT_NULL_BYTES:
        return draw
    kept: list[xr.Dataset] = []

    def recall() -> Iterable[xr.Dataset]:
        if not kept:
            kept.extend(draw())
        return kept

    return recall


def _effects_left_out(baseline: xr.Dataset, simulation: xr.Dataset | Model | None) -> list[Effect]:
    """Return the effects of the model that its baseline leaves out, in part or whole."""
    if not isinstance(simulation, Model):
        return []
    left_out = baseline.attrs["left_out"]
    return [effect for effect in simulation.effects if effect.name in left_out]

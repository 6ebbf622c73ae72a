"""Compare a recording with a simulation: the steps of a diagnosis in their order."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.baseline.from_simulation import baseline_from_simulation
from gyrostab.diagnose.baseline.known_effects import (
    find_blocks_with_known_motion,
    with_filtered_shapes,
)
from gyrostab.diagnose.baseline.known_lines import remove_known_lines
from gyrostab.diagnose.estimate.conditioned_baseline import expected_baseline, without_expected
from gyrostab.diagnose.estimate.recalibrate import remove_fast_switching
from gyrostab.diagnose.estimate.unexplained_motion import find_unexplained_motion
from gyrostab.diagnose.identify.examination import prepare_examination
from gyrostab.diagnose.identify.forms import choose_forms
from gyrostab.diagnose.identify.forward_search import identify_effects
from gyrostab.diagnose.identify.late_channels import find_late_channel
from gyrostab.diagnose.identify.selections import components_of
from gyrostab.diagnose.locate.mismatches import locate_mismatches
from gyrostab.diagnose.nulls.records import repeatable_null_records
from gyrostab.diagnose.nulls.scores import NullScores, null_scores
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.aligned_channels import align_channels
from gyrostab.diagnose.result.attribution import drop_expected
from gyrostab.diagnose.result.diagnosis import Diagnosis
from gyrostab.diagnose.result.finish import finish_diagnosis
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics.base import Region
from gyrostab.diagnose.task import (
    CALLER_LEVEL,
    NamedBlocks,
    Task,
    check_axis_names,
    check_diagnosis_options,
    lines_without_motion,
    read_simulation,
    take_lines_at_rest,
    varying_axes,
)
from gyrostab.errors import SchemaError
from gyrostab.ingest.convert import as_log
from gyrostab.progress import Stage, no_stage
from gyrostab.schema import log_channels
from gyrostab.schema.delays import move_channels
from gyrostab.simulate.model import Model


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
        What the recording is compared with: noise and effects of a model, or the noise of a
        simulated log on the same time stamps, without what effects do to its mean rate. By default,
        the five noise terms calibrated on quiescent stretches of the recording.
    quiet : (start, end) or list of these, optional
        Quiescent stretches, as durations after the start (``("0s", "30min")``; a number is in
        seconds) or ISO times; detected automatically by default. With a `simulation` they calibrate
        the level of its noise: one factor per axis.
    seed : int
        Seed of the null records.
    nulls : int
        Number of null records.
    false_alarm_level : float
        Probability that a recording without any missing physics gives a mismatch or an effect.
    block : str or timedelta, optional
        Length of a block; by default 20 s, less in short records, more in records above 5.6 h.
    restart_gap : str or float
        Shortest gap that counts as a power-off [s].
    progress : Stage
        Callback for progress.
    settings : gyrostab.diagnose.settings.Settings
        Numbers that decide what is reported, each with its source.

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

    check_diagnosis_options(nulls, false_alarm_level, seed)
    log = as_log(log)
    check_axis_names(log)
    task = Task(
        log,
        read_simulation(simulation, log),
        quiet,
        restart_gap,
        seed,
        nulls,
        false_alarm_level,
        progress,
        settings,
    )
    # the matrices are many and small: more threads would only wait for each other
    with threadpool_limits(1, user_api="blas"):
        return _run_steps(task, block)


def _run_steps(task: Task, block: Any) -> Diagnosis:
    """Run the seven steps in their order, the first four again where they find a reason to."""
    started = time.perf_counter()
    task, named = _identify_with_late_channels(task, block)
    mismatches, null = _locate_mismatches(task, named)
    task.progress("fitting", 0)
    return finish_diagnosis(task, named, mismatches, null, started)


def _identify_with_late_channels(task: Task, block: Any) -> tuple[Task, NamedBlocks]:
    """Steps 1 to 4; again with a channel moved in time if that explains more, each channel once."""
    model_delays = task.simulation.delay if isinstance(task.simulation, Model) else {}
    channels = log_channels(task.log)
    delays = {name: delay_s for name, delay_s in model_delays.items() if name in channels}
    aligned_task, named = _identify_with_delays(task, block, delays)
    while late := find_late_channel(
        named.identifications, named.baseline, aligned_task.log, delays
    ):
        channel, delay_s = late
        tried_delays = {**delays, channel: delay_s}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # given above
            tried_task, named_again = _identify_with_delays(task, block, tried_delays)
        identified = named_again.identifications.identified
        if not any(channel in identification.driver for identification in identified):
            break
        delays, aligned_task, named = tried_delays, tried_task, named_again
    return aligned_task, named


def _identify_with_delays(
    task: Task, block: Any, delays: Mapping[str, float]
) -> tuple[Task, NamedBlocks]:
    """Steps 1 to 4, with late channels moved by their delays [s]."""
    log = move_channels(task.log, delays).assign_attrs(channel_delays=dict(delays))
    task, blocks = _reduce_recording(replace(task, log=log), block)
    named = _identify_effects(task, *_prepare_comparison(task, blocks))
    for revise in (_leave_out_motion, _leave_motion_out_of_lines, _take_out_fast_switching):
        named = revise(task, named) or named
    return task, named


def _reduce_recording(task: Task, block: Any) -> tuple[Task, xr.Dataset]:
    """Step 1: reduce the axes that vary to block statistics."""
    aligned = align_channels(task.log)
    for note in aligned.notes:
        warnings.warn(note, stacklevel=CALLER_LEVEL)
    log = aligned.log.assign_attrs(unused_channels=aligned.unused)
    simulation = task.simulation
    blocks = task.reduce(log, block=block)
    axes = varying_axes(blocks)
    if len(axes) < log.sizes["axis"]:  # whether zeros are filled depends on all axes
        log = log.sel(axis=axes)
        blocks = task.reduce(log, block=block)
        simulation = simulation.sel(axis=axes) if isinstance(simulation, xr.Dataset) else simulation
    return replace(task, log=log, simulation=simulation), blocks


def _prepare_comparison(task: Task, blocks: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Step 2: return the blocks in which the model does not move the rate, and the baseline."""
    task.progress("calibrating", 0)
    if not isinstance(task.simulation, Model):
        return blocks, _make_baseline(task, blocks)
    blocks = with_filtered_shapes(blocks, task.simulation)
    baseline = _make_baseline(task, blocks)
    moving = find_blocks_with_known_motion(blocks, baseline, settings=task.settings)
    if moving.any():
        # the model has the motion
        blocks_at_rest = task.without_motion(blocks, moving).drop_vars("moving")
        blocks = with_filtered_shapes(blocks_at_rest, task.simulation)
        baseline = _make_baseline(task, blocks)
    return blocks, baseline


def _make_baseline(task: Task, blocks: xr.Dataset) -> xr.Dataset:
    """Return what the simulation predicts for the blocks."""
    if task.simulation is None:
        return calibrate_noise(blocks, quiet=task.quiet, settings=task.settings)
    if isinstance(task.simulation, Model):
        return baseline_from_model(
            blocks, task.simulation, quiet=task.quiet, settings=task.settings
        )
    simulated = task.reduce(task.simulation, block=f"{blocks.attrs['block_samples']}samples")
    return baseline_from_simulation(blocks, simulated, quiet=task.quiet, settings=task.settings)


def _identify_effects(task: Task, blocks: xr.Dataset, baseline: xr.Dataset) -> NamedBlocks:
    """Steps 3 and 4: draw null records, and identify effects with half of the false-alarm level."""
    blocks_without_lines, draw_null_records = _prepare_null_records(task, blocks, baseline)
    task.progress("naming", 0)
    known_effects = task.simulation.effects if isinstance(task.simulation, Model) else ()
    examination = prepare_examination(
        blocks_without_lines,
        baseline,
        draw_null_records(),
        level=task.level / 2.0,
        seed=task.seed,
        model_effects=[
            effect for effect in known_effects if effect.name in baseline.attrs["shown_elsewhere"]
        ],
        progress=task.progress,
        settings=task.settings,
    )
    identifications = choose_forms(identify_effects(examination), baseline)
    return NamedBlocks(blocks, baseline, draw_null_records, identifications)


def _prepare_null_records(
    task: Task, blocks: xr.Dataset, baseline: xr.Dataset
) -> tuple[xr.Dataset, Callable[[], Iterable[xr.Dataset]]]:
    """Return the blocks without the lines of the baseline, and what draws their null records."""
    blocks = remove_known_lines(blocks, baseline, settings=task.settings)
    return blocks, repeatable_null_records(blocks, baseline, task.nulls, task.seed)


def _locate_mismatches(task: Task, named: NamedBlocks) -> tuple[list[Region], NullScores]:
    """Step 5: locate the mismatches, with the other half of the false-alarm level."""
    level = task.level / 2.0
    blocks, baseline = named.identifications.state.blocks, named.baseline
    identifications, expected = named.identifications, named.identifications.expected
    task.progress("comparing", 0)
    null = null_scores(baseline, named.draw_null_records(), settings=task.settings)
    conditioned_baseline = expected_baseline(identifications, baseline)
    blocks_at_rest = (
        lines_without_motion(task, blocks, conditioned_baseline) if expected else blocks
    )
    mismatches = locate_mismatches(
        without_expected(blocks_at_rest, baseline, expected, task.settings),
        conditioned_baseline,
        null,
        level=level,
    )
    unexpected = drop_expected(
        mismatches, expected, blocks, conditioned_baseline, null, level=level
    )
    return unexpected, null


def _leave_out_motion(task: Task, named: NamedBlocks) -> NamedBlocks | None:
    """Identify without unexplained motion; None without any, or if too little is left."""
    if task.simulation is not None:
        return None
    blocks, identifications = named.blocks, named.identifications
    state = replace(
        identifications.state_without_effects(named.baseline),
        expected_power=identifications.state.expected_power,
    )
    moving = find_unexplained_motion(blocks, identifications.identified, state)
    if not moving.any():
        return None
    try:
        comparison = _prepare_comparison(task, task.without_motion(blocks, moving))
    except SchemaError as error:
        warnings.warn(
            f"the diagnosis includes unexplained motion: without it too little is left ({error})",
            stacklevel=CALLER_LEVEL,
        )
        return None
    return _identify_effects(task, *comparison)


def _leave_motion_out_of_lines(task: Task, named: NamedBlocks) -> NamedBlocks | None:
    """Identify with the lines of axes at rest; None if no effect moves an axis with lines."""
    identifications = named.identifications
    with_lines = [
        component.row[0]
        for component in components_of(identifications.identified)
        if component.statistic.is_line
    ]
    moving = (
        identifications.state.masked
        & np.isin(named.blocks["axis"].values.astype(str), with_lines)[:, None]
    )
    if not moving.any():
        return None
    blocks, baseline = take_lines_at_rest(task, named.blocks, moving), named.baseline
    blocks_without_lines, draw_null_records = _prepare_null_records(task, blocks, baseline)
    # with the threshold of the null records so far
    start = initial_state(blocks_without_lines, baseline, settings=task.settings)
    examination = replace(identifications.examination, start=start)
    identifications = choose_forms(identify_effects(examination), baseline)
    return NamedBlocks(blocks, baseline, draw_null_records, identifications)


def _take_out_fast_switching(task: Task, named: NamedBlocks) -> NamedBlocks | None:
    """Identify with a baseline calibrated free of switching within blocks; None without any."""
    baseline = remove_fast_switching(named.identifications, named.baseline)
    return None if baseline is named.baseline else _identify_effects(task, named.blocks, baseline)

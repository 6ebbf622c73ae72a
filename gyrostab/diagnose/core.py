"""A recording against a simulation: reduce, calibrate, locate, name, refit, prove."""

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
from gyrostab.diagnose.locate.mismatches import locate_mismatches
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.nulls.scores import null_scores
from gyrostab.diagnose.reduce.aligned_channels import align_channels
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.attribution import unexpected
from gyrostab.diagnose.result.diagnosis import Diagnosis
from gyrostab.diagnose.result.finish import finish_diagnosis
from gyrostab.diagnose.task import Compared, Task, still_lines
from gyrostab.errors import OptionError, SchemaError
from gyrostab.ingest.convert import as_log
from gyrostab.physics.base import Effect
from gyrostab.progress import Stage, no_stage
from gyrostab.simulate.model import Model, read_model
from gyrostab.time.durations import duration_seconds
from gyrostab.time.grid import first_stamp

__all__ = ["diagnose", "parse_quiescent_span"]

_KEPT = 3e8  # bytes of null records that are kept rather than drawn twice
_AT_ONCE = 6.4e7  # bytes of band powers of the null records that are scored together
_LEAST_NULLS = 100
_DEAD = 1e-20  # deg^2/h: a power that comes from rounding alone


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
) -> Diagnosis:
    """Find where a recording differs from a simulation, name the physics that is missing, and measure what it is worth.

    The recording is reduced to block statistics; null records with the noise of the simulation say
    how far chance goes; places that lie beyond become mismatches; effects are named by what they
    explain on time that was kept apart, fitted together, and added to the model.

    Parameters
    ----------
    log : xarray.Dataset
        The recording: a regular log with its channels, in memory or lazy.
    simulation : model, path of a model, or xarray.Dataset, optional
        What it is compared with: noise and effects of a model, or a simulated log on the same
        stamps. Without it the five noise terms, calibrated on quiet stretches of the recording.
    quiet : (start, end) or list of these, optional
        Quiet stretches, as seconds since the start or ISO times; detected automatically by default.
        With a `simulation` they calibrate the level of its noise: one factor for each axis.
    seed : int
        Of the null records.
    nulls : int
        Number of null records.
    false_alarm_level : float
        Share of records of the simulation itself in which anything may be found.
    block : str or timedelta
    restart_gap : str or float
        As for `gyrostab.diagnose.reduce.block_statistics.reduce_log`.
    progress : Stage
        Is told of the progress.

    Returns
    -------
    Diagnosis
        Verdict, mismatches, effects with their numbers and alternatives, what was not found, the
        model, the surfaces.

    Raises
    ------
    SchemaError
        When it is no regular log, or no axis ever changes.
    OptionError
        When the record is too short, an option makes no sense, or recording and simulation do not
        fit together.

    Examples
    --------
    >>> found = gyrostab.diagnose(gyrostab.open_log("run7.nc"))                                          # doctest: +SKIP
    >>> found.verdict, [effect["name"] for effect in found.effects]                                      # doctest: +SKIP
    ('explained', ['vibration_noise'])
    """
    from threadpoolctl import threadpool_limits

    _check_options(nulls, false_alarm_level, seed)
    log = as_log(log)
    with threadpool_limits(
        1, user_api="blas"
    ):  # the matrices are many and small: threads would only wait for each other
        return _diagnose(
            log, simulation, quiet, seed, nulls, false_alarm_level, block, restart_gap, progress
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
) -> Diagnosis:
    """One step after the other."""
    begun = time.perf_counter()
    log = _with_aligned_channels(log)
    given = (
        simulation
        if simulation is None or isinstance(simulation, xr.Dataset | Model)
        else read_model(simulation)
    )
    if isinstance(given, xr.Dataset):
        given = as_log(given)
        _check_alike(log, given)
    blocks = reduce_log(log, block=block, restart_gap=restart_gap, progress=progress)
    alive = _axes_alive(blocks)
    if len(alive) < log.sizes["axis"]:
        log = log.sel(axis=alive)
        blocks = reduce_log(log, block=block, restart_gap=restart_gap, progress=progress)
        given = given.sel(axis=alive) if isinstance(given, xr.Dataset) else given
    task = Task(log, given, quiet, restart_gap, seed, nulls, level, progress)
    compared = _beside_hops(task, _at_rest(task, _compare(task, *_calibrated(task, blocks))))
    progress("fitting", 0)
    return finish_diagnosis(task, compared, begun)


def _with_aligned_channels(log: xr.Dataset) -> xr.Dataset:
    """Lay the channels on the grid of the gyro; those of no use go to the attribute ``unused_channels``."""
    aligned = align_channels(log)
    for note in aligned.notes:
        warnings.warn(note, stacklevel=5)
    return aligned.log.assign_attrs(unused_channels=aligned.unused)


def _compare(task: Task, blocks: xr.Dataset, baseline: xr.Dataset) -> Compared:
    """Draw null records, name effects, locate what is beyond chance."""
    seen = remove_known_lines(blocks, baseline)
    records = _records(seen, baseline, task.nulls, task.seed)
    task.progress("comparing", 0)
    null = null_scores(baseline, records())
    task.progress("naming", 0)
    half = task.level / 2.0  # the names have one half, the places the other
    known = _known_apart(baseline, task.given)
    identifications = name_effects(
        seen, baseline, records(), level=half, seed=task.seed, known=known, progress=task.progress
    )
    before = expected_baseline(identifications, baseline)
    apart = without_expected(
        still_lines(task, seen, before) if identifications.expected else seen,
        baseline,
        identifications.expected,
    )
    found = unexpected(
        locate_mismatches(apart, before, null, level=half),
        identifications.expected,
        seen,
        before,
        null,
        level=half,
    )
    return Compared(blocks, baseline, found, identifications, null)


def _calibrated(task: Task, blocks: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """The record and its baseline; the record without the blocks in which a model that was given says that the rate moves."""
    task.progress("calibrating", 0)
    baseline = _baseline(task, blocks)
    if isinstance(task.given, Model) and (turning := expect_known_motion(blocks, baseline)).any():
        left = without_motion(
            task.log, blocks, turning, restart_gap=task.restart_gap, progress=task.progress
        )
        blocks = left.drop_vars("moving")  # it is accounted for
        baseline = _baseline(task, blocks)
    return blocks, baseline


def _at_rest(task: Task, compared: Compared) -> Compared:
    """The comparison once more without the blocks of a motion that has no name; the same where there are none, or too few are left."""
    moving = (
        unexplained_motion(compared.blocks, compared.identifications.identified)
        if task.given is None
        else np.zeros(1, np.bool_)
    )
    if not moving.any():
        return compared
    at_rest = without_motion(
        task.log, compared.blocks, moving, restart_gap=task.restart_gap, progress=task.progress
    )
    try:
        return _compare(task, *_calibrated(task, at_rest))
    except SchemaError as error:
        warnings.warn(
            f"compared with its motion in it, for what is at rest does not do: {error}",
            stacklevel=4,
        )
        return compared


def _beside_hops(task: Task, compared: Compared) -> Compared:
    """The comparison once more with the noise calibrated beside hops within blocks; the same where there are none."""
    baseline = remove_fast_switching(compared.identifications, compared.baseline)
    return compared if baseline is compared.baseline else _compare(task, compared.blocks, baseline)


def _check_options(nulls: int, level: float, seed: int) -> None:
    if not 0.0 < level < 0.5:
        raise OptionError(
            f"false_alarm_level={level!r}: give the share of false alarms, above 0 and below 0.5, for instance 0.01"
        )
    if nulls < _LEAST_NULLS:
        raise OptionError(
            f"nulls={nulls!r}: fewer than {_LEAST_NULLS} records do not tell how often chance does as much; give 400"
        )
    if seed < 0:
        raise OptionError(f"seed={seed!r}: give a whole number from 0 up")


def _axes_alive(blocks: xr.Dataset) -> list[str]:
    """Axes whose samples are not all the same; warns of the others, which have no noise that could be compared."""
    loudest = blocks["power"].max(["block", "band"]).values
    axes = [str(axis) for axis in blocks["axis"].values]
    alive = [axis for axis, power in zip(axes, loudest, strict=True) if not power <= _DEAD]
    dead = [axis for axis in axes if axis not in alive]
    if not alive:
        raise SchemaError(
            f"all samples are the same on axis {', '.join(dead)}: there is no noise to compare; is it the right column?"
        )
    if dead:
        warnings.warn(
            f"all samples are the same on axis {', '.join(dead)}: left out of the diagnosis",
            stacklevel=4,
        )
    return alive


def _check_alike(log: xr.Dataset, simulated: xr.Dataset) -> None:
    """Raise `OptionError` unless the two logs have the same stamps and axes."""
    for what, one, other in (
        (
            "sampling rate",
            *(f"{float(each.attrs['sampling_rate_hz']):.10g} Hz" for each in (simulated, log)),
        ),
        ("number of samples", *(str(each.sizes["time"]) for each in (simulated, log))),
        ("axes", *(", ".join(map(str, each["axis"].values)) for each in (simulated, log))),
        ("start", *(f"{np.datetime64(first_stamp(each), 'ns')}" for each in (simulated, log))),
    ):
        if one != other:
            raise OptionError(
                f"the simulated log has another {what} ({one}) than the recording ({other}); simulate it on the recording's stamps: "
                "gyrostab simulate MODEL.toml --like RECORDING, or give the model itself"
            )


def _baseline(task: Task, blocks: xr.Dataset) -> xr.Dataset:
    if task.given is None:
        return calibrate_noise(blocks, quiet=task.quiet)
    if isinstance(task.given, xr.Dataset):
        same = f"{blocks.attrs['block_samples']}samples"
        simulated = reduce_log(
            task.given, block=same, restart_gap=task.restart_gap, progress=task.progress
        )
        return baseline_from_simulation(blocks, simulated, quiet=task.quiet)
    return baseline_from_model(blocks, task.given, quiet=task.quiet)


def _records(
    blocks: xr.Dataset, baseline: xr.Dataset, count: int, seed: int
) -> Callable[[], Iterable[xr.Dataset]]:
    """The same null records as often as they are asked for: kept where they are small, drawn again where not."""
    together = int(np.clip(_AT_ONCE / (blocks["power"].size * 8), 25, count))

    def draw() -> Iterable[xr.Dataset]:
        return null_records(
            blocks, baseline, count=count, rng=np.random.default_rng(seed), chunk=together
        )

    if count * blocks["power"].size * 3 * 8 > _KEPT:
        return draw
    kept: list[xr.Dataset] = []

    def recall() -> Iterable[xr.Dataset]:
        if not kept:
            kept.extend(draw())
        return kept

    return recall


def _known_apart(baseline: xr.Dataset, given: xr.Dataset | Model | None) -> list[Effect]:
    """Effects of the model that its baseline leaves out, in part or whole."""
    return (
        [one for one in given.effects if one.name in baseline.attrs["left_out"]]
        if isinstance(given, Model)
        else []
    )


def parse_quiescent_span(text: str) -> tuple[float | str, float | str]:
    """Read a quiet stretch as it is given on the command line.

    Raises
    ------
    OptionError
        When it has not two ends, or one of them is neither a time nor a length of time.

    Examples
    --------
    >>> quiet_span("0s/30min"), quiet_span("2026-03-14T08:00/2026-03-14T08:30Z")
    ((0.0, 1800.0), ('2026-03-14T08:00', '2026-03-14T08:30'))
    """
    components = [component.strip() for component in text.split("/")]
    if len(components) != 2 or not all(components):
        raise OptionError(
            f"quiet {text!r}: write START/END, for instance 2026-03-14T08:00/2026-03-14T08:30 or 0s/30min after the start"
        )
    ends = [_end(component, text) for component in components]
    return ends[0], ends[1]


def _end(component: str, text: str) -> float | str:
    try:
        return (
            str(np.datetime64(component.removesuffix("Z")))
            if "-" in component
            else 0.0
            if component in ("0", "0s")
            else duration_seconds(component, "quiet")
        )
    except ValueError as error:
        raise OptionError(
            f"quiet {text!r}: {component!r} is neither a time (2026-03-14T08:00) nor a length of time since the start (30min)"
        ) from error

"""The inputs of a diagnosis, and what the comparison of a recording with them found."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.known_effects import expect_known_motion
from gyrostab.diagnose.baseline.known_lines import remove_known_lines
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identification import Identifications
from gyrostab.diagnose.locate.regions import Region
from gyrostab.diagnose.nulls.scores import NullScores
from gyrostab.diagnose.reduce.moving_blocks import without_motion
from gyrostab.diagnose.settings import Settings
from gyrostab.progress import Stage
from gyrostab.simulate.model import Model


@dataclass(frozen=True)
class Task:
    """A recording, and how it is to be compared."""

    log: xr.Dataset  # the recording, with the axes that vary
    #: What the recording is compared with; None when the noise is calibrated on the recording.
    simulation: Model | xr.Dataset | None
    #: The options of `gyrostab.diagnose`; `level` is its `false_alarm_level`.
    quiet: Any
    restart_gap: Any
    seed: int
    nulls: int
    level: float
    progress: Stage
    settings: Settings


class NamedBlocks(NamedTuple):
    """A recording with the effects that are identified in it."""

    blocks: xr.Dataset
    baseline: xr.Dataset  # what the simulation predicts for the blocks
    null_records: Callable[[], Iterable[xr.Dataset]]  # the same ones on each call
    examination: Examination  # of the blocks without the lines that the baseline contains
    identifications: Identifications  # the effects that explain the differences


class Comparison(NamedTuple):
    """What the comparison of a recording with its baseline found."""

    blocks: xr.Dataset
    baseline: xr.Dataset  # what the simulation predicts for them
    mismatches: list[Region]  # from `gyrostab.diagnose.locate.mismatches.locate_mismatches`
    identifications: Identifications  # the effects that explain the differences
    null: NullScores


def lines_without_motion(task: Task, blocks: xr.Dataset, known: xr.Dataset) -> xr.Dataset:
    """Return the blocks with line spectra from those in which no known effect moves the rate."""
    moving = expect_known_motion(blocks, known, settings=task.settings)
    at_rest = take_lines_at_rest(task, blocks, moving)
    return (
        blocks if at_rest is blocks else remove_known_lines(at_rest, known, settings=task.settings)
    )


def take_lines_at_rest(task: Task, blocks: xr.Dataset, moving: NDArray[np.bool_]) -> xr.Dataset:
    """Return the blocks with line spectra from those in which an axis does not move.

    A step within a block has a broad spectrum, and all blocks in a part of the record share one
    line spectrum. The log is read again when a block has to be left out. An axis that moves has no
    sines: they are sought in the record as a whole, where its levels have harmonics.

    Parameters
    ----------
    moving : ndarray of bool, shape (axis, block)
    """
    has_data = np.isfinite(blocks["power"].values).any(axis=-1)
    if not (moving & has_data).any():
        return blocks
    at_rest = without_motion(
        task.log, blocks, moving | ~has_data, restart_gap=task.restart_gap, progress=task.progress
    )
    lines = {name: at_rest[name] for name in ("line_power", "line_weight")}
    if "sine_nats" in blocks:
        stays = xr.DataArray(~moving.any(axis=1), dims="axis")
        lines["sine_nats"] = blocks["sine_nats"].where(stays, -np.inf)
    return blocks.assign(lines)

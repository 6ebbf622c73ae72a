"""What a recording is compared with and how, and what a comparison found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.diagnose.baseline.known_effects import expect_known_motion, remove_known_lines
from gyrostab.diagnose.identify.forward_search import Identifications
from gyrostab.diagnose.identify.moving_axes import without_motion
from gyrostab.diagnose.nulls.scores import NullScores
from gyrostab.progress import Stage
from gyrostab.simulate.model import Model

__all__ = ["Compared", "Task", "still_lines"]


@dataclass(frozen=True)
class Task:
    """A recording, and how it is to be compared.

    Attributes
    ----------
    log : xarray.Dataset
        With the axes that are alive.
    given : Model, xarray.Dataset or None
        The simulation; None where the noise is to be calibrated.
    quiet, restart_gap, seed, nulls, level, progress
        The options of `diagnose`; `level` is its `false_alarm_level`.
    """

    log: xr.Dataset
    given: Model | xr.Dataset | None
    quiet: Any
    restart_gap: Any
    seed: int
    nulls: int
    level: float
    progress: Stage


class Compared(NamedTuple):
    """What a comparison found.

    Attributes
    ----------
    blocks : xarray.Dataset
    baseline : xarray.Dataset
    found : xarray.Dataset
        Places of mismatches.
    identifications : Naming
    null : NullScores
    """

    blocks: xr.Dataset
    baseline: xr.Dataset
    found: xr.Dataset
    identifications: Identifications
    null: NullScores


def still_lines(task: Task, blocks: xr.Dataset, known: xr.Dataset) -> xr.Dataset:
    """The record with the line spectra of the blocks in which nothing that is known moves; the log is read once more where something does.

    A step within a block has the spectrum of a step, and a part of the record has only one for all
    its blocks.
    """
    there = np.isfinite(blocks["power"].transpose("axis", "block", "band").values).any(axis=-1)
    moving = expect_known_motion(blocks, known)
    if not (moving & there).any():
        return blocks
    calm = without_motion(
        task.log, blocks, moving | ~there, restart_gap=task.restart_gap, progress=task.progress
    )
    return remove_known_lines(
        blocks.assign({name: calm[name] for name in ("line_power", "line_weight")}), known
    )

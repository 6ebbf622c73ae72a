"""The inputs of a diagnosis with their checks, and what the comparison with them found."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools
from gyrostab.diagnose.baseline.known_effects import find_blocks_with_known_motion
from gyrostab.diagnose.baseline.known_lines import remove_known_lines
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.reduce.moving_blocks import without_motion
from gyrostab.diagnose.settings import Settings
from gyrostab.errors import GyrostabError, OptionError, SchemaError
from gyrostab.ingest.convert import as_log
from gyrostab.ingest.uniform.cut import parse_instant
from gyrostab.progress import Stage
from gyrostab.simulate.model import Model, read_model
from gyrostab.store.toml import parse_toml
from gyrostab.time.grid import first_stamp
from gyrostab.wording import join_words

#: Fewest null records: one of them is expected beyond the default level of 1 %.
MIN_NULL_RECORDS = 100
_SPAN_EXAMPLE = "2026-03-14T08:00/2026-03-14T08:30, or 0s/30min after the start"
#: Stack level of the caller of `gyrostab.diagnose` for a warning of a function in `core` that
#: `_identify_with_delays` calls.
CALLER_LEVEL = 6
#: Largest power [deg^2/h] that rounding alone gives a constant rate; noise of any gyro has more.
MAX_ROUNDING_POWER = 1e-20


def check_diagnosis_options(nulls: int, level: float, seed: int) -> None:
    """Raise `OptionError` unless these options of `gyrostab.diagnose` make sense."""
    for name, value in (("nulls", nulls), ("seed", seed)):
        if not isinstance(value, int | np.integer):
            raise OptionError(f"{name}={value!r}: give a whole number")
    if not (isinstance(level, int | float | np.number) and 0.0 < level < 0.5):
        raise OptionError(
            f"false_alarm_level={level!r}: give a false-alarm probability above 0 and below 0.5, "
            "for instance 0.01"
        )
    if nulls < MIN_NULL_RECORDS:
        raise OptionError(
            f"nulls={nulls!r}: fewer than {MIN_NULL_RECORDS} null records do not determine the "
            "false-alarm probability; give 400"
        )
    if seed < 0:
        raise OptionError(f"seed={seed!r}: give a whole number from 0 up")


def read_simulation(
    simulation: str | os.PathLike[str] | Mapping[str, Any] | Model | xr.Dataset | None,
    log: xr.Dataset,
) -> Model | xr.Dataset | None:
    """Return the simulation as a model, or as a log with the time stamps and axes of `log`.

    Raises
    ------
    OptionError
        When a simulated log has other time stamps or axes than the recording.
    """
    if isinstance(simulation, xr.Dataset):
        simulated = as_log(simulation)
        _check_same_stamps(log, simulated)
        _note_effects_on_means(simulated)
        return simulated
    if simulation is None or isinstance(simulation, Model):
        return simulation
    return read_model(simulation)


def _note_effects_on_means(simulated: xr.Dataset) -> None:
    """Warn that the mean rate of a log that was simulated with effects is not compared."""
    text = str(simulated.attrs.get("simulation_model", ""))  # TOML of a file, JSON of a mapping
    try:
        model = read_model(json.loads(text) if text.startswith("{") else parse_toml(text))
    except (GyrostabError, ValueError, RecursionError):  # not written by this version
        return
    names = sorted({effect.name for effect in model.effects if effect.stage in ("motion", "rate")})
    if names:
        warnings.warn(
            f"the simulated log has effects on the rate: {join_words(names)}; only noise and "
            "steady lines of a simulated log are compared, so the diagnosis may name such an "
            "effect again; to compare with the effects, give their model in place of the log",
            stacklevel=2,
        )


def _check_same_stamps(log: xr.Dataset, simulated: xr.Dataset) -> None:
    """Raise `OptionError` unless the two logs have the same time stamps and axes."""
    for (quantity, expected), value in zip(
        _describe_stamps(log).items(), _describe_stamps(simulated).values(), strict=True
    ):
        if value != expected:
            raise OptionError(
                f"the {quantity} of the simulated log is {value}, that of the recording "
                f"{expected}; simulate on the time stamps of the recording: "
                "gyrostab simulate MODEL.toml --like RECORDING, or give the model itself"
            )


def _describe_stamps(log: xr.Dataset) -> dict[str, str]:
    return {
        "sampling rate": f"{float(log.attrs['sampling_rate_hz']):.10g} Hz",
        "number of samples": str(log.sizes["time"]),
        "list of axes": ", ".join(map(str, log["axis"].values)),
        "start": f"{np.datetime64(first_stamp(log), 'ns')}",
    }


def check_axis_names(log: xr.Dataset) -> None:
    """Refuse names of axes with characters that separate them in the lists of a diagnosis."""
    for axis in map(str, log["axis"].values):
        if any(character in axis for character in ", "):
            raise SchemaError(
                f"axis {axis!r}: a diagnosis lists axes with blanks and commas between them; "
                "rename it, for instance with log.assign_coords(axis=['x', 'y', 'z'])"
            )


def varying_axes(blocks: xr.Dataset) -> list[str]:
    """Find the axes whose samples are present and not all the same, and warn of the others.

    Raises
    ------
    SchemaError
        When no axis varies.
    """
    largest_power = blocks["power"].max(["block", "band"]).values
    axes = [str(axis) for axis in blocks["axis"].values]
    varying = [
        axis for axis, power in zip(axes, largest_power, strict=True) if power > MAX_ROUNDING_POWER
    ]
    empty = ", ".join(compress(axes, np.isnan(largest_power)))
    constant = ", ".join(compress(axes, largest_power <= MAX_ROUNDING_POWER))
    reasons = [f"all samples are the same on axis {constant}"] * bool(constant)
    reasons += [f"too many samples are missing for a spectrum on axis {empty}"] * bool(empty)
    if not varying:
        raise SchemaError(
            f"{', and '.join(reasons)}: without noise there is nothing to compare; check that the "
            "right column was read"
        )
    for reason in reasons:
        warnings.warn(f"{reason}: left out of the diagnosis", stacklevel=CALLER_LEVEL + 1)
    return varying


def parse_quiescent_span(text: str) -> tuple[float | np.datetime64, ...]:
    """Read a quiescent stretch as written on the command line: times, or seconds after the start.

    Raises
    ------
    OptionError
        When it does not have two ends, or one of them is neither a time nor a duration.

    Examples
    --------
    >>> parse_quiescent_span("0min/30min")
    (0.0, 1800.0)
    """
    ends = text.split("/")
    if len(ends) != 2:
        raise OptionError(f"quiet {text!r}: write START/END, for instance {_SPAN_EXAMPLE}")
    parsed = (parse_instant(end, f"quiet {text!r}:", example=_SPAN_EXAMPLE) for end in ends)
    return tuple(np.datetime64(end, "ns") if isinstance(end, int) else end for end in parsed)


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

    def reduce(self, log: xr.Dataset, *, block: Any) -> xr.Dataset:
        """Reduce a log to block statistics."""
        return reduce_log(log, block=block, restart_gap=self.restart_gap, progress=self.progress)

    def without_motion(self, blocks: xr.Dataset, moving: Bools) -> xr.Dataset:
        """Return the block statistics of the recording without the moving blocks."""
        return without_motion(
            self.log, blocks, moving, restart_gap=self.restart_gap, progress=self.progress
        )


class NamedBlocks(NamedTuple):
    """A recording with the effects that are identified in it."""

    blocks: xr.Dataset
    baseline: xr.Dataset  # what the simulation predicts for the blocks
    draw_null_records: Callable[[], Iterable[xr.Dataset]]  # the same ones on each call
    #: Effects that explain the blocks without the lines of the baseline.
    identifications: Identifications


def lines_without_motion(task: Task, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset:
    """Return the blocks with line spectra from those in which no known effect moves the rate."""
    moving = find_blocks_with_known_motion(blocks, baseline, settings=task.settings)
    at_rest = take_lines_at_rest(task, blocks, moving)
    return (
        blocks
        if at_rest is blocks
        else remove_known_lines(at_rest, baseline, settings=task.settings)
    )


def take_lines_at_rest(task: Task, blocks: xr.Dataset, moving: Bools) -> xr.Dataset:
    """Return the blocks with line spectra from those in which an axis does not move.

    A step within a block has a broad spectrum, and all blocks in a part of the record share one
    line spectrum. The log is read again when a block has to be left out. An axis that moves has no
    sines: they are sought in the record as a whole, where its levels have harmonics. `moving` is by
    (axis, block).
    """
    has_data = np.isfinite(blocks["power"].values).any(axis=-1)
    if not (moving & has_data).any():
        return blocks
    at_rest = task.without_motion(blocks, moving | ~has_data)
    lines = {name: at_rest[name] for name in ("line_power", "line_weight")}
    stays = xr.DataArray(~moving.any(axis=1), dims="axis")
    lines["sine_nats"] = blocks["sine_nats"].where(stays, -np.inf)
    return blocks.assign(lines)

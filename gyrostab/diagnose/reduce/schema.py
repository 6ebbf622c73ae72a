"""Schema of the block statistics: dimensions, unit and meaning of every variable.

The order of the dimensions is fixed. Later steps may therefore compute on plain arrays, and look up
labels only where they read and write.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import xarray as xr

from gyrostab.errors import SchemaError
from gyrostab.units import INNER

__all__ = ["BLOCK_STATISTICS", "Variable", "check_block_statistics", "label_variables"]


class Variable(NamedTuple):
    """Dimensions, unit and meaning of a variable; `required` unless the log may lack its source."""

    dims: tuple[str, ...]
    units: str
    long_name: str
    required: bool = True


_RATE, _POWER = INNER["rate"], "degree2 hour-2 Hz-1"
_BLOCK, _BAND = ("axis", "block"), ("axis", "block", "band")
_PAIR, _PAIR_BAND = ("pair", "block"), ("pair", "block", "band")
_SUB_BLOCK, _HARMONIC = ("axis", "block", "sub_block"), ("axis", "block", "harmonic")
_PHASE = ("axis", "block", "phase")

#: Variables of the block statistics. Channels have ``channel_<name>(block)`` and
#: ``fine_<name>(block, block_part)`` in addition, and statistics measured before blocks were left
#: out ``measured_<name>``.
BLOCK_STATISTICS: dict[str, Variable] = {
    "mean": Variable(_BLOCK, _RATE, "mean rate of the block"),
    "variance": Variable(_BLOCK, "degree2 hour-2", "variance of the samples about it"),
    "samples": Variable(_BLOCK, "1", "samples present"),
    "power": Variable(_BAND, _POWER, "mean periodogram of the band, two-sided density"),
    "shape": Variable(_BAND, "1", "shape of the gamma distribution of the power in white noise"),
    "neighbours": Variable(_BLOCK, "1", "share of neighbouring pairs of samples, tapered"),
    "kurtosis": Variable(_BLOCK, "1", "excess kurtosis of the block"),
    "peaks": Variable(_BLOCK, "1", "isolated outliers"),
    "outliers": Variable(
        _BLOCK, "1", "isolated outliers, three times those beyond twice the limit"
    ),
    "adjacent": Variable(_BLOCK, "1", "samples with another one right before them in the block"),
    "repeats": Variable(
        _BLOCK, "1", "samples equal to the one before, except zeros and range ends"
    ),
    "repeat_runs": Variable(_BLOCK, "1", "runs of samples equal to the one before, except zeros"),
    "zero_runs": Variable(_BLOCK, "1", "runs of samples that are exactly 0"),
    "extremes": Variable(_BLOCK, "1", "samples equal to the smallest or largest of the record"),
    "zeros": Variable(_BLOCK, "1", "samples that are exactly 0"),
    "stuck": Variable(_BLOCK, "1", "zeros of one axis, within its range"),
    "filled": Variable(
        _BLOCK, "1", "simultaneous zeros of all axes; of a single axis, zeros in runs"
    ),
    "axes_at_once": Variable(("subset", "axis"), "1", "axes that have samples at once"),
    "at_once": Variable(("subset", "block"), "1", "samples that exactly these axes have at once"),
    "quantization_step": Variable(("axis",), _RATE, "quantization step of the values, 0 for none"),
    "line_power": Variable(
        ("axis", "part", "line"), _POWER, "mean periodogram at full resolution, two-sided density"
    ),
    "line_weight": Variable(
        ("axis", "part"), "1", "equivalent number of equal blocks in each mean"
    ),
    "bin_width": Variable(
        ("axis", "bin"), "1", "width of the zero bin and of its neighbours, in quantization steps"
    ),
    "bin_width_stderr": Variable(("axis", "bin"), "1", "standard error of it"),
    "sub_block_mean": Variable(_SUB_BLOCK, _RATE, "mean rate of a sub-block"),
    "sub_block_samples": Variable(_SUB_BLOCK, "1", "samples of a sub-block"),
    "cross": Variable(
        _PAIR_BAND,
        _POWER,
        "mean cross-periodogram of the samples that both axes have, two-sided density",
    ),
    "cross_shape": Variable(
        _PAIR_BAND,
        "1",
        "shape of the gamma distribution of powers over the samples that both axes have",
    ),
    "cross_neighbours": Variable(
        _PAIR, "1", "share of neighbouring pairs of the samples that both axes have, tapered"
    ),
    "cross_samples": Variable(_PAIR, "1", "samples that both axes have"),
    "reference_power": Variable(
        ("reference", "block", "band"),
        "square of the channel's unit per Hz",
        "mean periodogram of a channel, two-sided density",
        required=False,
    ),
    "reference_cross": Variable(
        ("axis", "reference", "block", "band"),
        "degree hour-1 Hz-1 times the channel's unit",
        "mean cross-periodogram of axis and channel, F_axis conj(F_channel)",
        required=False,
    ),
    "order": Variable(
        _HARMONIC,
        _RATE,
        "complex amplitude at multiples of the rotation, NaN below one turn per block",
        required=False,
    ),
    "order_level": Variable(
        _HARMONIC,
        _POWER,
        "density of what turns 1 to 4 times in the block more or less than that, two-sided",
        required=False,
    ),
    "profile": Variable(
        _PHASE, _RATE, "mean rate less the block's mean, by phase of the ramp", required=False
    ),
    "profile_samples": Variable(_PHASE, "1", "samples of each mean", required=False),
    "ramp_turns": Variable(
        ("block",), "Hz", "turns of the ramp in a second, negative where it falls", required=False
    ),
    "gap_begin": Variable(("gap",), "s", "first missing sample, since the start"),
    "gap_end": Variable(("gap",), "s", "first sample present again, since the start"),
    "restart_begin": Variable(("restart",), "s", "power lost, since the start"),
    "restart_end": Variable(("restart",), "s", "power back, since the start"),
}


def label_variables(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return arrays with the dimensions and attributes of the schema, as xarray takes them."""
    return {
        name: (
            BLOCK_STATISTICS[name].dims,
            array,
            {"long_name": BLOCK_STATISTICS[name].long_name, "units": BLOCK_STATISTICS[name].units},
        )
        for name, array in arrays.items()
    }


def check_block_statistics(blocks: xr.Dataset) -> xr.Dataset:
    """Check that all variables are there with their dimensions in order, and return the blocks.

    Raises
    ------
    SchemaError
        When one is missing or has other dimensions.
    """
    for name, variable in BLOCK_STATISTICS.items():
        if name not in blocks:
            if variable.required:
                raise SchemaError(f"the block statistics lack {name} {variable.dims}")
        elif blocks[name].dims != variable.dims:
            raise SchemaError(
                f"the block statistic {name} has the dimensions {blocks[name].dims}; "
                f"it must have {variable.dims}"
            )
    return blocks

"""Schema of block statistics and baseline: dimensions, unit and meaning of every variable.

The order of the dimensions is fixed. Later steps may therefore compute on plain arrays, and look up
labels only where they read and write. A log without the source of a variable has none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Floats, Ints
from gyrostab.noise import LAWS, TERMS
from gyrostab.units import INNER


class Variable(NamedTuple):
    """Dimensions, unit and meaning of a variable."""

    dims: tuple[str, ...]
    units: str
    long_name: str


_RATE, _POWER = INNER["rate"], "degree2 hour-2 Hz-1"
_BLOCK, _BAND = ("axis", "block"), ("axis", "block", "band")
_PAIR, _PAIR_BAND = ("pair", "block"), ("pair", "block", "band")
_SUB_BLOCK, _HARMONIC = ("axis", "block", "sub_block"), ("axis", "block", "harmonic")
_PHASE, _LINE = ("axis", "block", "phase"), ("axis", "line")

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
    "outlier_count": Variable(_BLOCK, "1", "isolated outliers"),
    "outliers": Variable(
        _BLOCK,
        "1",
        "isolated outliers; one beyond twice the limit counts three times, see `outlier_count`",
    ),
    "adjacent": Variable(_BLOCK, "1", "samples with another one right before them in the block"),
    "repeats": Variable(
        _BLOCK,
        "1",
        "samples equal to the one before, except zeros and range ends, or of a frame sent twice",
    ),
    "repeat_runs": Variable(
        _BLOCK, "1", "runs of samples equal to the one before, except zeros, and frames sent twice"
    ),
    "resent": Variable(_BLOCK, "1", "samples of frames sent twice"),
    "zero_runs": Variable(_BLOCK, "1", "runs of samples that are exactly 0"),
    "extremes": Variable(_BLOCK, "1", "samples equal to the smallest or largest of the record"),
    "range_end": Variable(("axis", "range"), _RATE, "smallest and largest value of the record"),
    "range_end_samples": Variable(("axis", "range"), "1", "samples of the record that equal it"),
    "zeros": Variable(_BLOCK, "1", "samples that are exactly 0"),
    "stuck": Variable(
        _BLOCK, "1", "zeros of one axis, within its range, or samples at `zone_centre`"
    ),
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
    "sine_nats": Variable(
        _LINE, "1", "evidence of the strongest sine nearest to a line, of constant phase"
    ),
    "sine_frequency": Variable(("line",), "Hz", "frequency of this sine"),
    "sine_resolution": Variable(("line",), "Hz", "resolution of the spectrum that shows it"),
    "sine_square": Variable(_LINE, "degree2 hour-2", "square of its amplitude"),
    "sine_square_stderr": Variable(_LINE, "degree2 hour-2", "standard error of it"),
    "bin_width": Variable(
        ("axis", "bin"), "1", "width of the zero bin and of its neighbours, in quantization steps"
    ),
    "bin_width_stderr": Variable(("axis", "bin"), "1", "standard error of it"),
    "zone_centre": Variable(
        ("axis",), _RATE, "value other than 0 at which the axis sticks, NaN for none"
    ),
    "zone_width": Variable(
        ("axis",), _RATE, "half width of a zone around zero that is empty but near zero"
    ),
    "zone_width_stderr": Variable(("axis",), _RATE, "standard error of it"),
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
    ),
    "reference_cross": Variable(
        ("axis", "reference", "block", "band"),
        "degree hour-1 Hz-1 times the channel's unit",
        "mean cross-periodogram of axis and channel, F_axis conj(F_channel)",
    ),
    "order": Variable(
        _HARMONIC,
        _RATE,
        "complex amplitude at multiples of the rotation, NaN below one turn per block",
    ),
    "order_samples": Variable(
        _HARMONIC, "1", "samples of an even rotation that determine the amplitude as well"
    ),
    "order_level": Variable(
        _HARMONIC,
        _POWER,
        "density of what turns 1 to 4 times in the block more or less than that, two-sided",
    ),
    "turn_mean": Variable(
        _HARMONIC,
        "1",
        "mean of exp(2 pi i h n) over the samples of the axis, after n turns since the start",
    ),
    "turn_power": Variable(
        ("harmonic", "block", "band"),
        "Hz-1",
        "mean periodogram of a wave of amplitude 1 at that multiple, two-sided density",
    ),
    "turn_line_power": Variable(
        ("harmonic", "line"), "Hz-1", "that of the record at full resolution"
    ),
    "profile": Variable(_PHASE, _RATE, "mean rate less the block's mean, by phase of the ramp"),
    "profile_samples": Variable(_PHASE, "1", "samples of each mean"),
    "ramp_turns": Variable(
        ("block",), "Hz", "turns of the ramp in a second, negative where it falls"
    ),
    "gap_begin": Variable(("gap",), "s", "first missing sample, since the start"),
    "gap_end": Variable(("gap",), "s", "first sample present again, since the start"),
    "restart_begin": Variable(("restart",), "s", "power lost, since the start"),
    "restart_end": Variable(("restart",), "s", "power back, since the start"),
}

#: Coordinates of the block statistics.
COORDINATES: dict[str, Variable] = {
    "bin": Variable(("bin",), "1", "zero bin, or both of its neighbours"),
    "axis": Variable(("axis",), "1", "axis of the gyro"),
    "first": Variable(("pair",), "1", "first axis of the pair"),
    "second": Variable(("pair",), "1", "second axis of the pair"),
    "time": Variable(("block",), "", "middle of the block"),
    "begin": Variable(("block",), "s", "start of the block, since the start"),
    "end": Variable(("block",), "s", "end of the block, since the start"),
    "frequency": Variable(("band",), "Hz", "centre of the band"),
    "band_low": Variable(("band",), "Hz", "lower edge of the band"),
    "band_high": Variable(("band",), "Hz", "upper edge of the band"),
    "line_frequency": Variable(("line",), "Hz", "frequency"),
    "reference": Variable(("reference",), "1", "channel on the time of the log"),
    "harmonic": Variable(("harmonic",), "1", "multiple of the rotation"),
    "phase": Variable(("phase",), "1", "phase of the ramp, as a share of its range"),
}

_NOISE_UNITS = ", ".join(f"{term} in {LAWS[term].label}" for term in TERMS)
_SQUARES = f"square of {_NOISE_UNITS}"
_TERM, _SQUARE, _GRID = ("axis", "term"), ("axis", "noise"), ("axis", "grid")

#: Variables of a baseline. Those from `cross` on are there only if model or simulation have them.
BASELINE: dict[str, Variable] = {
    "coefficient": Variable(_TERM, _NOISE_UNITS, "noise coefficient"),
    "stderr": Variable(_TERM, _NOISE_UNITS, "standard error of the coefficient"),
    "quiet": Variable(_BLOCK, "1", "block is calibrated on"),
    "spectrum": Variable(_BAND, _POWER, "expected power"),
    "known_mean": Variable(_BLOCK, _RATE, "mean rate of known effects"),
    "mean_variance": Variable(_BLOCK, "degree2 hour-2", "white variance of the block mean"),
    "angle_variance": Variable(("axis",), "arcsec2", "variance of the angle where blocks meet"),
    "common": Variable(_BLOCK, "1", "relative variance that the powers of a block have in common"),
    "shape_alone": Variable(_BAND, "1", "shape of the gamma distribution without the common part"),
    "columns": Variable((*_BAND, "noise"), _POWER, "expected power per squared coefficient"),
    "square": Variable(_SQUARE, _SQUARES, "squared coefficient that fits the powers"),
    "square_stderr": Variable(_SQUARE, _SQUARES, "standard error of it"),
    "posterior": Variable(("axis", "draw", "noise"), _SQUARES, "draws of the squares in powers"),
    "posterior_slow": Variable(("axis", "draw", "slow"), _SQUARES, "draws of those in the means"),
    "grid_K": Variable(_GRID, LAWS["K"].label, "random walk that the means may have"),
    "grid_B": Variable(_GRID, LAWS["B"].label, "flicker that the means may have"),
    "grid_prior": Variable(_GRID, "1", "log probability of it before the record"),
    "grid_calibrated": Variable(_GRID, "1", "log probability of it in the record"),
    "cross": Variable(_PAIR_BAND, _POWER, "expected cross-spectrum"),
    "cross_error": Variable(("pair", "band"), "1", "error of the coherency"),
    "form_shape": Variable(("axis", "band"), "1", "shape of the distribution of the form"),
    "lines": Variable(_LINE, _POWER, "expected power of steady lines without gaps"),
    "lines_most": Variable(_LINE, _POWER, "largest power of them at any offset of the frequency"),
    "broad_peaks": Variable(_LINE, _POWER, "expected power of broad peaks"),
    "line_noise": Variable(_LINE, _POWER, "expected power of noise behind a filter"),
    "line_shape": Variable(_LINE, "1", "ratio of line power to that interpolated from the bands"),
    "line_spectrum": Variable(("axis", "band"), _POWER, "expected power of lines in the bands"),
    "wander_square": Variable(("axis", "wander"), "degree2 hour-2", "variance of a process"),
    "wander_time": Variable(("wander",), "s", "correlation time of a process"),
    "wander_walk": Variable(_BLOCK, "degree2 hour-2 s-1", "variance rate of random walks"),
}


def label_variables(
    arrays: Mapping[str, Any], schema: Mapping[str, Variable] = BLOCK_STATISTICS
) -> dict[str, Any]:
    """Return arrays with the dimensions and attributes of the schema, as xarray takes them."""
    return {
        name: (
            schema[name].dims,
            array,
            {"long_name": schema[name].long_name}
            | ({"units": schema[name].units} if schema[name].units else {}),
        )
        for name, array in arrays.items()
    }


def axis_values(dataset: xr.Dataset, name: str, axis: str | int) -> Floats:
    """Return the values of a variable on an axis, by its name or index.

    A search asks for them ten thousands of times, where the selections of xarray take much longer.
    """
    row = axis if isinstance(axis, int) else dataset.variables["axis"].values.tolist().index(axis)
    variable = dataset.variables[name]
    return np.asarray(np.moveaxis(variable.values, variable.dims.index("axis"), 0)[row])


def pair_indices(blocks: xr.Dataset) -> Ints:
    """Return the indices of the first and of the second axes of all pairs, (2, pair)."""
    axes = blocks["axis"].values.tolist()
    sides = [[axes.index(axis) for axis in blocks[name].values] for name in ("first", "second")]
    return np.array(sides, np.int64)


def read_as_measured(blocks: xr.Dataset, name: str) -> xr.Variable:
    """Return a variable of the block statistics as measured, including what motion left out."""
    return blocks.variables.get(f"measured_{name}", blocks.variables[name])


def format_time(blocks: xr.Dataset, seconds: float) -> str:
    """Write a time [s since the start of the record] as ISO 8601."""
    start = np.datetime64(int(blocks.attrs["start_ns"]), "ns")
    return f"{(start + np.timedelta64(round(seconds * 1e9), 'ns')).astype('datetime64[ms]')}Z"


def weighted_mean(values: Array, weight: Floats, axis: int = 0) -> tuple[Array, Floats]:
    """Average over an axis where value and weight are known, with the sum of the weights.

    The mean is 0 where nothing is known.
    """
    good = np.isfinite(values) & np.isfinite(weight) & (weight > 0.0)
    used = np.where(good, weight, 0.0)
    total = used.sum(axis=axis)
    mean = (used * np.where(good, values, 0.0)).sum(axis=axis) / np.where(total > 0.0, total, 1.0)
    return mean, total

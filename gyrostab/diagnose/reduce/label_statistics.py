"""Assembly of the dataset of block statistics from the arrays that were filled."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Floats, Ints
from gyrostab.diagnose.reduce.accumulate import (
    CHANNEL_PARTS,
    LAGGED_CHANNEL_PREFIXES,
    RAMP_PHASE_BINS,
    RESENT_LENGTHS,
    Accumulator,
)
from gyrostab.diagnose.reduce.log_blocks import channel_means, is_rms_channel, numeric_channels
from gyrostab.diagnose.reduce.outliers import (
    NORMAL_MEDIAN_ABS,
    count_histogram_outliers,
    quantization_step,
    zeros_beyond_chance,
)
from gyrostab.diagnose.reduce.rotation_orders import HARMONICS
from gyrostab.diagnose.reduce.schema import COORDINATES, label_variables, weighted_mean
from gyrostab.diagnose.reduce.zero_bin import BINS, bin_widths, empty_zone, sticking_value
from gyrostab.kernels.regression.smooth import smooth_curve
from gyrostab.kernels.samples.moments import (
    FOURTH_MOMENT,
    HIGH_REPEATS,
    HIGHEST,
    HIGHS,
    LOW_REPEATS,
    LOWEST,
    LOWS,
    MEAN,
    PRESENT,
    REPEAT_RUNS,
    REPEATS,
    VARIANCE,
    ZERO_RUNS,
    ZEROS,
)
from gyrostab.schema import GAP_CAUSES, texts
from gyrostab.time.grid import grid_index, grid_times
from gyrostab.time.stamps import format_stamp, to_nanoseconds

_MAX_SMOOTHING_BLOCKS = 2.0  # longest time scale of the smoothing of a channel; design choice
_STEP_VALUES_PER_BLOCK = 256  # values from which the quantization step is found; limits time
#: Runs of samples in a record that chance may repeat: a tenth of its false-alarm probability, 1 %.
_MAX_CHANCE_RUNS = 1e-3
MIN_MEAN_SHARE = 0.1  # of a block that must be present for its mean; design choice
_MIN_GAP_S = 1.0  # shorter gaps are not listed; design choice
#: Variables that are taken unchanged from the batches.
_UNCHANGED = (
    "shape", "neighbours", "adjacent", "sub_block_mean", "sub_block_samples", "order",
    "order_samples", "order_level", "turn_mean", "turn_power", "profile", "profile_samples",
)  # fmt: skip


def label_statistics(work: Accumulator, log: xr.Dataset, *, restart_gap_s: float) -> xr.Dataset:
    """Assemble the dataset of block statistics."""
    by_name, axis_rows = work.collect(), slice(0, work.axis_count)
    counts, moments = by_name["counts"][axis_rows], by_name["moments"][axis_rows]
    present = counts[..., PRESENT]
    enough = present >= max(MIN_MEAN_SHARE * work.length, 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        kurtosis = moments[..., FOURTH_MOMENT] / moments[..., VARIANCE] ** 2 - 3.0
    arrays: dict[str, Any] = {
        "mean": np.where(enough, moments[..., MEAN], np.nan),
        "variance": np.where(enough, moments[..., VARIANCE], np.nan),
        "samples": present,
        "power": by_name["power"][axis_rows],
        "kurtosis": np.where(np.isnan(by_name["neighbours"]), np.nan, kurtosis),
        **_count_anomalous_samples(work, by_name),
        **_average_line_spectra(work, by_name["power"][axis_rows], by_name["shape"], present),
    }
    arrays |= {name: by_name[name] for name in _UNCHANGED if name in by_name}
    if work.rotation is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            arrays["turn_line_power"] = work.turn_line_sum / (work.turn_line_expected * work.rate)
    coordinates = _make_coordinates(work, log)
    frequencies = coordinates["line_frequency"][1]
    arrays |= work.sines.strongest(frequencies) | _gap_table(work, log, restart_gap_s)
    variables = (
        label_variables(arrays)
        | _cross_spectra(work, by_name, log)
        | _channel_means(work, by_name, log)
        | _channel_part_means(work, by_name, log)
    )
    if work.ramp is not None:
        variables |= label_variables({"ramp_turns": by_name["ramp_turns"][0]})
        variables["ramp_turns"][2].update(zip(("low", "high"), work.ramp_range, strict=True))
    attrs = _make_attributes(work, log, present) | {"restart_gap_s": restart_gap_s}
    return xr.Dataset(variables, coords=coordinates, attrs=attrs)


def _count_anomalous_samples(work: Accumulator, by_name: Mapping[str, Array]) -> dict[str, Any]:
    """Return the sample counts of every block, and quantization and zero bin of each axis."""
    axis_rows = slice(0, work.axis_count)
    counts, moments = by_name["counts"][axis_rows], by_name["moments"][axis_rows]
    zeros = counts[..., ZEROS]
    outlier_count, outliers = count_histogram_outliers(by_name["histogram"], work.peaks)
    subset, at_once = np.array(list(work.at_once), np.bool_), np.stack(list(work.at_once.values()))
    filled = zeros_beyond_chance(
        by_name["common_zeros"], zeros, counts[..., PRESENT], subset, at_once
    )
    samples = np.stack(work.kept_samples, axis=1)  # (axis, block, sample)
    steps = np.array(
        [quantization_step(first.ravel()) for first in samples[..., :_STEP_VALUES_PER_BLOCK]]
    )
    resent = np.stack(
        [
            _resent_samples(*of_axis, length=work.length)
            for of_axis in zip(by_name["resent"], samples, steps.tolist(), strict=True)
        ]
    )
    samples = samples.reshape(work.axis_count, -1)
    widths = np.array([*map(bin_widths, samples, steps)])
    centres, per_repeat = np.transpose([*map(sticking_value, samples, steps)])
    zones = np.array([*map(empty_zone, samples - np.nan_to_num(centres)[:, None])])
    lowest, highest = _record_range(moments)
    at_ends = _count_at_range_ends(moments, counts[..., [LOWS, HIGHS]])
    # held samples; those at zero or at an end of the range have another cause
    end_repeats = _count_at_range_ends(moments, counts[..., [LOW_REPEATS, HIGH_REPEATS]])
    repeats = counts[..., REPEATS] - end_repeats.sum(axis=-1)
    # zeros of one axis alone, unless zero is the end of its range
    stuck_at_zero = np.where((lowest < 0.0) & (highest > 0.0), zeros - filled, 0)
    stuck_at_centre = np.rint(repeats * per_repeat[:, None]).astype(np.int64)
    return {
        "outlier_count": outlier_count,
        "outliers": outliers,
        "repeats": repeats + resent[..., 0],
        "repeat_runs": counts[..., REPEAT_RUNS] + resent[..., 1],
        "resent": resent[..., 0],
        "zero_runs": counts[..., ZERO_RUNS],
        "extremes": at_ends.sum(axis=-1),
        "range_end": np.concatenate([lowest, highest], axis=1),
        "range_end_samples": at_ends.sum(axis=1),
        "zeros": zeros,
        "stuck": np.where(np.isfinite(centres)[:, None], stuck_at_centre, stuck_at_zero),
        "filled": filled,
        "axes_at_once": subset,
        "at_once": at_once,
        "quantization_step": steps,
        "bin_width": widths[:, 0],
        "bin_width_stderr": widths[:, 1],
        "zone_centre": centres,
        "zone_width": zones[:, 0],
        "zone_width_stderr": zones[:, 1],
    }


def _average_line_spectra(
    work: Accumulator, power: Floats, shape: Floats, present: Ints
) -> dict[str, Any]:
    """Return the mean periodogram of each part of the record, and how many equal ones it has."""
    total, square = np.moveaxis(work.line_weight_sums, -1, 0)
    weight: Floats = np.zeros(total.shape)
    np.divide(total**2, square, where=square > 0, out=weight)
    weight *= _equal_block_share(power, shape, present, weight.shape[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        lines = work.line_sum / (work.line_expected * work.rate)
    return {"line_power": lines, "line_weight": weight}


def _equal_block_share(power: Floats, shape: Floats, samples: Ints, part_count: int) -> Floats:
    """Return the equivalent share of equal-power blocks of each part, (axis, part).

    A few noisy blocks carry all the weight of a mean.
    """
    usual, _ = weighted_mean(power, shape, axis=1)
    ratio = power / np.where(usual > 0.0, usual, np.inf)[:, None]
    level, total = weighted_mean(ratio, shape, axis=2)
    out = np.ones((len(power), part_count))
    for part in range(part_count):
        in_part = np.arange(power.shape[1]) * part_count // power.shape[1] == part
        size, level_of_part = samples[:, in_part].astype(np.float64), level[:, in_part]
        square = size.sum(axis=1) * (
            size * level_of_part**2 * (1.0 - 1.0 / np.maximum(total[:, in_part], 2.0))
        ).sum(axis=1)  # minus the scatter of the levels
        out[:, part] = np.divide(
            (size * level_of_part).sum(axis=1) ** 2,
            square,
            out=np.ones(len(power)),
            where=square > 0.0,
        )
    return np.minimum(out, 1.0)


def _record_range(moments: Floats) -> tuple[Floats, Floats]:
    """Return the smallest and largest value of every axis, (axis, 1)."""
    lowest = np.fmin.reduce(moments[..., LOWEST], axis=1, keepdims=True)
    return lowest, np.fmax.reduce(moments[..., HIGHEST], axis=1, keepdims=True)


def _resent_samples(counts: Ints, samples: Floats, step: float, *, length: int) -> Ints:
    """Return samples and runs of each block (block, 2) that repeat earlier ones, not by chance.

    They are those of the first of `RESENT_LENGTHS` k of which chance makes hardly any in the
    record, with `counts` (block, length, 2). On a quantization grid, a sample is equal to one that
    is some distance before with a probability of at most ``p = step / (sqrt(2 pi) sd)``, sd being
    the standard deviation of the difference of neighbours, as farther samples differ by more. In n
    samples, in blocks of b, chance begins at most ``n b p`` runs and at most n, and continues a
    share ``p^(k - 1)`` of them.
    """
    difference = np.abs(np.diff(samples, axis=-1))
    difference = difference[np.isfinite(difference)]
    sd = float(np.median(difference)) / NORMAL_MEDIAN_ABS if difference.size else 0.0
    chance = step / (np.sqrt(2.0 * np.pi) * sd) if sd > 0.0 else 1.0
    samples_in_all = len(counts) * length
    begun = samples_in_all * min(length * chance, 1.0)
    is_rare = begun * chance ** (np.array(RESENT_LENGTHS) - 1.0) < _MAX_CHANCE_RUNS
    return counts[:, int(is_rare.argmax())] if is_rare.any() else np.zeros_like(counts[:, 0])


def _count_at_range_ends(moments: Floats, counts: Ints) -> Ints:
    """Keep counts at both ends (axis, block, 2) where those of a block are those of the record."""
    lowest, highest = _record_range(moments)
    at_top = (moments[..., HIGHEST] == highest) & (lowest < highest)
    return np.where(np.stack([moments[..., LOWEST] == lowest, at_top], axis=-1), counts, 0)


def _cross_spectra(
    work: Accumulator, by_name: Mapping[str, Array], log: xr.Dataset
) -> dict[str, Any]:
    """Return cross-spectra of the axes, and of each axis with the channels on the log's time."""
    axis_count = work.axis_count
    axis_pairs = [number for number, (_, other) in enumerate(work.pairs) if other < axis_count]
    names = ("cross", "cross_shape", "cross_neighbours", "cross_samples")
    variables = label_variables({name: by_name[name][axis_pairs] for name in names})
    if work.channels:
        shape = (axis_count, len(work.channels), *by_name["cross"].shape[1:])
        with_axes = np.full(shape, np.nan + 0j)
        for number, (a, b) in enumerate(work.pairs):
            if b >= axis_count:
                with_axes[a, b - axis_count] = by_name["cross"][number]
        unit_list = ", ".join(
            f"{name} in {log[name].attrs.get('units', '1')}" for name in work.channels
        )
        references = label_variables(
            {"reference_power": by_name["power"][axis_count:], "reference_cross": with_axes}
        )
        for _, _, attrs in references.values():
            attrs["units"] += f" ({unit_list})"
        variables |= references
    return variables


def _channel_means(
    work: Accumulator, by_name: Mapping[str, Array], log: xr.Dataset
) -> dict[str, Any]:
    """Return block means of the channels; the rms of vibration."""
    variables: dict[str, Any] = {}
    on_log_time, on_own_time = numeric_channels(log)
    edges = grid_times(work.start, work.rate, np.arange(work.block_count + 1) * work.length)
    for name in (*on_log_time, *on_own_time):
        rms = is_rms_channel(name)
        if name in on_log_time:
            moments = by_name["moments"][work.axis_count + on_log_time.index(name)]
            mean, variance = moments[:, MEAN], moments[:, VARIANCE]
            values = np.sqrt(mean**2 + variance) if rms else mean
        else:
            values = channel_means(log, name, edges, rms=rms)
        attrs = {
            "long_name": f"{'rms' if rms else 'mean'} of {name} over the block",
            "units": str(log[name].attrs.get("units", "1")),
        }
        if "band_hz" in log[name].attrs:
            attrs["band_hz"] = log[name].attrs["band_hz"]
        variables[f"channel_{name}"] = ("block", values, attrs)
    return variables


def _channel_part_means(
    work: Accumulator, by_name: Mapping[str, Array], log: xr.Dataset
) -> dict[str, Any]:
    """Return smoothed channels in parts of the blocks, if sampled often enough."""
    variables: dict[str, Any] = {}
    parts = {name: by_name[f"parts_{name}"][0] for name in work.lagged}
    edges = grid_times(
        work.start,
        work.rate,
        np.arange(work.block_count * CHANNEL_PARTS + 1) * work.length // CHANNEL_PARTS,
    )
    for name in numeric_channels(log)[1]:
        if not name.startswith(LAGGED_CHANNEL_PREFIXES):
            continue
        span = np.ptp(to_nanoseconds(log[f"time_{name}"].values)) / 1e9
        if log.sizes[f"time_{name}"] * work.length >= span * work.rate * CHANNEL_PARTS > 0.0:
            parts[name] = channel_means(log, name, edges, rms=False).reshape(-1, CHANNEL_PARTS)
    for name, values in parts.items():
        good = np.isfinite(values)
        if good.mean() > 1.0 / 2.0:
            place = np.arange(values.size)
            bridged = np.interp(place, place[good.ravel()], values[good])
            smooth = smooth_curve(bridged, longest=_MAX_SMOOTHING_BLOCKS * CHANNEL_PARTS)
            attrs = {
                "long_name": f"{name} in parts of the block, without noise",
                "units": str(log[name].attrs.get("units", "1")),
            }
            variables[f"fine_{name}"] = (
                ("block", "block_part"),
                smooth.reshape(values.shape),
                attrs,
            )
    return variables


def _gap_table(work: Accumulator, log: xr.Dataset, restart_gap_s: float) -> dict[str, Any]:
    """Return gaps, and those after which the tool restarted, in seconds since the start."""
    complete = work.gap_ends[: len(work.gap_ends) // 2 * 2]  # not that at the end of the record
    gaps = np.array(complete, dtype=np.float64).reshape(-1, 2)
    gaps = gaps[np.diff(gaps)[:, 0] >= _MIN_GAP_S * work.rate] / work.rate
    restart_spans = gaps[gaps[:, 1] - gaps[:, 0] >= restart_gap_s].tolist()
    if "gap_cause" in log.variables:
        is_restart = log["gap_cause"].values == GAP_CAUSES.index("restart")
        ends = [to_nanoseconds(log[name].values[is_restart]) for name in ("gap_start", "gap_end")]
        known_restarts = grid_index(work.start, work.rate, np.stack(ends, axis=-1)) / work.rate
        restart_spans += [
            span
            for span in known_restarts.tolist()
            if not any(low <= span[1] and span[0] <= high for low, high in restart_spans)
        ]
    restarts = np.array(sorted(restart_spans), dtype=np.float64).reshape(-1, 2)
    return {
        "gap_begin": gaps[:, 0],
        "gap_end": gaps[:, 1],
        "restart_begin": restarts[:, 0],
        "restart_end": restarts[:, 1],
    }


def _make_coordinates(work: Accumulator, log: xr.Dataset) -> dict[str, Any]:
    ends = np.arange(work.block_count + 1) * work.length
    stamps = grid_times(work.start, work.rate, ends)
    step = work.rate / work.length
    axis_names = np.array([str(name) for name in log["axis"].values], dtype=object)
    pairs = np.array([pair for pair in work.pairs if pair[1] < work.axis_count], np.int64).reshape(
        -1, 2
    )
    arrays: dict[str, Any] = {
        "bin": np.array(BINS, dtype=object),
        "axis": axis_names,
        "first": axis_names[pairs[:, 0]],
        "second": axis_names[pairs[:, 1]],
        "time": (stamps[:-1] + np.diff(stamps) // 2).view("datetime64[ns]"),
        "begin": ends[:-1] / work.rate,
        "end": ends[1:] / work.rate,
        "frequency": (work.edges[:-1] + work.edges[1:] - 1) / 2.0 * step,
        "band_low": (work.edges[:-1] - 0.5) * step,
        "band_high": (work.edges[1:] - 0.5) * step,
        "line_frequency": np.arange(1, work.line_sum.shape[-1] + 1) * step,
    }
    if work.channels:
        arrays["reference"] = np.array(work.channels, dtype=object)
    if work.rotation is not None:
        arrays["harmonic"] = np.array(HARMONICS)
    if work.ramp is not None:
        arrays["phase"] = (np.arange(RAMP_PHASE_BINS) + 0.5) / RAMP_PHASE_BINS
    return label_variables(arrays, COORDINATES)


def _make_attributes(work: Accumulator, log: xr.Dataset, present: Ints) -> dict[str, Any]:
    end = grid_times(work.start, work.rate, log.sizes["time"])
    return {
        "start": f"{format_stamp(work.start)}Z",
        "end": f"{format_stamp(int(end))}Z",
        "start_ns": work.start,
        "sampling_rate_hz": work.rate,
        "block_s": work.length / work.rate,
        "block_samples": work.length,
        "missing_share": 1.0 - float(present.sum()) / (present.size * work.length),
        "source_files": texts(log, "source_files"),
        "notes": texts(log, "notes"),
        "unused_channels": dict(log.attrs.get("unused_channels", {})),
        "channel_delays": dict(log.attrs.get("channel_delays", {})),
    }

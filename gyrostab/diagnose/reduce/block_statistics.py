"""A log to block statistics: the recording is read once, and everything that is asked of it later is asked of these."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.reduce.accumulate import (
    FINE,
    FOLLOWED,
    HARMONICS,
    PARTS,
    PHASES,
    Accumulator,
)
from gyrostab.diagnose.reduce.log_blocks import (
    channel_means,
    numeric_channels,
    read_stretches,
    row_count,
    sample_count,
)
from gyrostab.diagnose.reduce.outliers import beyond_chance, count_outliers, quantization_step
from gyrostab.diagnose.reduce.zero_bin import CELLS, cell_widths
from gyrostab.errors import OptionError
from gyrostab.kernels.regression.smooth import smooth_curve
from gyrostab.progress import Stage, no_stage
from gyrostab.schema import GAP_CAUSES, check_log, texts
from gyrostab.time.durations import duration_seconds, samples
from gyrostab.time.grid import grid_index, grid_times
from gyrostab.units import INNER

__all__ = [
    "HARMONICS",
    "PARTS",
    "PHASES",
    "block_samples",
    "measured",
    "noise_at_orders",
    "reduce_log",
]

Array = NDArray[np.float64]
_BLOCK_S, _FEWEST, _MOST, _LEAST_SAMPLES, _MUST = 20.0, 90, 6000, 100, 24
_SMOOTH = 2.0  # blocks over which the course of a channel is smoothed at most
_FOR_STEP = 256  # values of a block that tell the step of the lattice
_MEAN_SHARE = 0.1  # of a block that must be present for its mean
_POWER = "degree2 hour-2 Hz-1"
_RATE = INNER["rate"]
_LOUDER = (
    2.0  # times the expected density, beyond which what is measured beside an order is no chance
)


def block_samples(size: int, rate: float, block: Any = None) -> int:
    """Samples of a block: 20 s, less in short records and more beyond 33 h, a product of small primes.

    Parameters
    ----------
    size : int
        Samples of the record.
    rate : float
        Sampling rate [Hz].
    block : str or timedelta, optional
        Length that the user asks for: a duration, or a number of samples such as ``"2000samples"``.

    Raises
    ------
    OptionError
        When the record holds too few such blocks.

    Examples
    --------
    >>> block_samples(360_000, 100.0), block_samples(72_001, 200.0), block_samples(8_641, 100.0)
    (2000, 800, 100)
    """
    if block is None:
        wanted = max(min(_BLOCK_S * rate, size / _FEWEST), size / _MOST, _LEAST_SAMPLES)
        length = _smooth(int(wanted))
    else:
        length = samples(block, rate, "block")
        if length < 16:
            raise OptionError(
                f"block {block!r} holds {length} samples at {rate:g} Hz; a block needs 16 ({16 / rate:g} s) at least"
            )
    if size < _MUST * length:
        what = f"{_MUST} blocks of {length / rate:g} s"
        raise OptionError(
            f"the record of {size / rate:.4g} s ({size} samples at {rate:g} Hz) is too short to diagnose: "
            f"it must hold {what}, {_MUST * length / rate:g} s at least"
            + ("; give a shorter block" if block is not None else "")
        )
    return length


def _smooth(length: int) -> int:
    """Largest even product of 2, 3 and 5 up to `length`."""
    while True:
        rest = length
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1 and length % 2 == 0:
            return length
        length -= 1


def reduce_log(
    log: xr.Dataset,
    *,
    block: Any = None,
    restart_gap: Any = 5.0,
    left_out: NDArray[np.bool_] | None = None,
    progress: Stage = no_stage,
) -> xr.Dataset:
    """Reduce a log to what the diagnosis works on: means, band powers and counts of blocks of equal length.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log, in memory or lazy; it is read once, from front to back.
    block : str or timedelta, optional
        Length of a block; 20 s, or less in short records, by default.
    restart_gap : str or float
        Gap from which on the power is taken to have been off [s].
    left_out : ndarray of bool, shape (axis, block), optional
        Blocks that count as missing on an axis.
    progress : Stage
        Is told of the progress, in samples over all axes.

    Returns
    -------
    xarray.Dataset
        By ``(axis, block)``: ``mean`` [degree hour-1], ``variance`` [degree2 hour-2], ``samples``,
        ``neighbours``, ``adjacent``, ``kurtosis``, ``peaks``, ``outliers``, ``repeats`` and their
        ``repeat_runs``, ``extremes``, ``zeros`` and their ``zero_runs``, and of these ``stuck`` and
        ``filled``. By ``(axis, block, band)``: ``power`` [degree2 hour-2 Hz-1], two-sided, and the
        ``shape`` of its gamma distribution. ``cross``, ``cross_shape`` (pair, block, band),
        ``cross_neighbours``, ``cross_samples`` (pair, block), ``witness_power``, ``witness_cross``,
        ``line_power(axis, part, line)``, ``line_weight``, ``order`` and ``order_level`` (axis,
        block, harmonic), ``profile(axis, block, phase)``, ``piece_mean`` and ``piece_samples``
        (axis, block, inner), ``lattice(axis)``, ``cell_width(axis, cell)`` [steps of the lattice],
        ``axes_at_once(subset, axis)``, ``at_once(subset, block)``, ``channel_<name>(block)``,
        ``fine_<name>(block, piece)`` of what effects follow late, and the gaps and restarts in
        seconds. Coordinates ``time``, ``begin``, ``end`` [s] of the blocks, ``frequency`` [Hz] of
        the bands.

    Raises
    ------
    SchemaError
        When it is no regular log.
    OptionError
        When the record is too short.

    Notes
    -----
    Block means are taken off and samples that are missing count as zero; powers are unbiased for
    white noise with any gaps (see `gyrostab.kernels.spectra.periodogram`). Under random gaps a
    density S(f) is seen as ``neighbours * S + (1 - neighbours) * mean(S)``.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> noise = 0.18 * 10 * np.random.default_rng(1).standard_normal((1, 360_000))
    >>> blocks = reduce_log(make_log(noise, rate=100.0, unit="deg/h"))
    >>> blocks.sizes["block"], blocks.attrs["block_s"], float((blocks.power.mean() ** 0.5).round(2))
    (180, 20.0, 0.18)
    """
    check_log(log)
    rate, size = float(log.attrs["sampling_rate_hz"]), sample_count(log)
    length = block_samples(size, rate, block)
    work = Accumulator(log, length, size // length, rate)
    rows = row_count(log)
    progress("reducing", rows * work.block_count * length)
    for stretch in read_stretches(log, length):
        if left_out is not None:
            stretch.values[: work.axes][
                left_out[:, stretch.first : stretch.first + stretch.values.shape[1]]
            ] = np.nan
        work.add(stretch)
        progress(
            "reducing",
            rows * work.block_count * length,
            rows * (stretch.first + stretch.values.shape[1]) * length,
        )
    return _labelled(work, log, restart=duration_seconds(restart_gap, "restart_gap"))


def measured(blocks: xr.Dataset, name: str) -> xr.DataArray:
    """A variable of the reduced record as the axes measured it, with what of it is left out because they moved."""
    return blocks[f"measured_{name}"] if f"measured_{name}" in blocks else blocks[name]


def noise_at_orders(blocks: xr.Dataset, expected: Array) -> Array:
    """Density of the noise about the orders of the rotation: the expected one, or what turns almost as often where that is surely more.

    Waves in the recording that have nothing to do with the tool, as those of the ground, are as
    loud at an order as beside it.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `reduce_log`.
    expected : ndarray, shape (..., axis, block, harmonic)
        [degree2 hour-2 Hz-1]
    """
    if "order_level" not in blocks:
        return expected
    beside = blocks["order_level"].transpose("axis", "block", "harmonic").values
    return np.where(beside > _LOUDER * expected, beside, expected)


def _labelled(work: Accumulator, log: xr.Dataset, *, restart: float) -> xr.Dataset:
    axes = slice(0, work.axes)
    counts, moments = work.counts[axes], work.moments[axes]
    present = counts[..., 0]
    plane, cube = ("axis", "block"), ("axis", "block", "band")
    enough = present >= max(_MEAN_SHARE * work.length, 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        kurtosis = moments[..., 2] / moments[..., 1] ** 2 - 3.0
    peaks, outliers = count_outliers(work.histogram, work.peaks)
    subset, at_once = np.array(list(work.at_once), np.bool_), np.stack(list(work.at_once.values()))
    filled = beyond_chance(work.together, counts[..., 1], present, subset, at_once)
    lattice = np.array([quantization_step(_kept(work, row, _FOR_STEP)) for row in range(work.axes)])
    cells = np.array([cell_widths(_kept(work, row), step) for row, step in enumerate(lattice)])
    weight = np.divide(work.line_counts[..., 0] ** 2, work.line_counts[..., 1], where=work.line_counts[..., 1] > 0,
                       out=np.zeros(work.line_counts.shape[:2]))  # fmt: skip
    weight *= _evenness(work.power[axes], work.shape, present, weight.shape[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        lines = work.line_sum / (work.line_expected * work.rate)
    variables: dict[str, Any] = {
        "mean": (
            plane,
            np.where(enough, moments[..., 0], np.nan),
            _named("mean rate of the block", _RATE),
        ),
        "variance": (
            plane,
            np.where(enough, moments[..., 1], np.nan),
            _named("variance of the samples about it", "degree2 hour-2"),
        ),
        "samples": (plane, present, _named("samples present", "1")),
        "power": (
            cube,
            work.power[axes],
            _named("mean periodogram of the band, two-sided density", _POWER),
        ),
        "shape": (
            cube,
            work.shape,
            _named("shape of the gamma distribution of the power in white noise", "1"),
        ),
        "neighbours": (
            plane,
            work.neighbours,
            _named("share of neighbouring pairs of samples, tapered", "1"),
        ),
        "kurtosis": (
            plane,
            np.where(np.isnan(work.neighbours), np.nan, kurtosis),
            _named("excess kurtosis of the block", "1"),
        ),
        "peaks": (plane, peaks, _named("samples that jump out alone", "1")),
        "outliers": (
            plane,
            outliers,
            _named("samples that jump out alone, three times those beyond twice the limit", "1"),
        ),
        "adjacent": (
            plane,
            work.adjacent,
            _named("samples with another one right before them in the block", "1"),
        ),
        "repeats": (
            plane,
            _repeats(moments, counts),
            _named("samples equal to the one before, but for zeros and the ends", "1"),
        ),
        "repeat_runs": (
            plane,
            counts[..., 7],
            _named("runs of samples equal to the one before, but for zeros", "1"),
        ),
        "zero_runs": (plane, counts[..., 8], _named("runs of samples that are exactly 0", "1")),
        "extremes": (
            plane,
            _extremes(moments, counts),
            _named("samples equal to the smallest or largest of the record", "1"),
        ),
        "zeros": (plane, counts[..., 1], _named("samples that are exactly 0", "1")),
        "stuck": (
            plane,
            _stuck(moments, counts, filled),
            _named("zeros of one axis, within its range", "1"),
        ),
        "filled": (
            plane,
            filled,
            _named("zeros of all axes at once; of a single axis in runs", "1"),
        ),
        "axes_at_once": (("subset", "axis"), subset, _named("axes that have samples at once", "1")),
        "at_once": (
            ("subset", "block"),
            at_once,
            _named("samples that these axes have at once, and no other one", "1"),
        ),
        "lattice": ("axis", lattice, _named("step of the lattice of values, 0 for none", _RATE)),
        "line_power": (
            ("axis", "part", "line"),
            lines,
            _named("mean periodogram at full resolution, two-sided density", _POWER),
        ),
        "line_weight": (
            ("axis", "part"),
            weight,
            _named("blocks in each mean, as many as equal ones would do", "1"),
        ),
    }
    variables |= {
        "cell_width": (
            ("axis", "cell"),
            cells[:, 0],
            _named("width of the cell of 0 and of those beside it, in steps of the lattice", "1"),
        ),
        "cell_width_stderr": (("axis", "cell"), cells[:, 1], _named("standard error of it", "1")),
    }
    variables |= (
        _inner(work)
        | _beside(work, log)
        | _locked(work)
        | _channels(work, log)
        | _fine(work, log)
        | _spans(work, log, restart)
    )
    return xr.Dataset(
        variables, coords=_coordinates(work, log), attrs=_attributes(work, log, present)
    ).set_coords(["first", "second"])


def _kept(work: Accumulator, row: int, most: int | None = None) -> Array:
    """Values of an axis that were kept, so many of each block at most."""
    return np.concatenate([kept[row][:most] for kept in work.kept])


def _inner(work: Accumulator) -> dict[str, Any]:
    """Means over pieces of the blocks, in which a bias that hops within blocks can be seen."""
    total, count = work.pieces
    dims = ("axis", "block", "inner")
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / count
    return {
        "piece_mean": (dims, mean, _named("mean rate of a piece of the block", _RATE)),
        "piece_samples": (
            dims,
            count.astype(np.int64),
            _named("samples of a piece of the block", "1"),
        ),
    }


def _named(name: str, units: str) -> dict[str, Any]:
    return {"long_name": name, "units": units}


def _evenness(power: Array, shape: Array, samples: NDArray[np.int64], components: int) -> Array:
    """Share of the blocks of each part that as many blocks of equal power would be, (axis, part): a few loud ones have all the weight."""
    good = np.isfinite(power) & np.isfinite(shape) & (shape > 0.0)
    ordinates = np.where(good, shape, 0.0)
    known = np.where(good, power, 0.0)
    usual = (ordinates * known).sum(axis=1, keepdims=True) / np.maximum(
        ordinates.sum(axis=1, keepdims=True), 1e-300
    )
    total = np.maximum(ordinates.sum(axis=2), 1e-300)
    level = (ordinates * np.divide(known, usual, out=np.zeros_like(known), where=usual > 0.0)).sum(
        axis=2
    ) / total
    out = np.ones((len(power), components))
    for component in range(components):
        mine = np.arange(power.shape[1]) * components // power.shape[1] == component
        size, loud = samples[:, mine].astype(np.float64), level[:, mine]
        square = size.sum(axis=1) * (
            size * loud**2 * (1.0 - 1.0 / np.maximum(total[:, mine], 2.0))
        ).sum(axis=1)  # less its own scatter
        out[:, component] = np.divide(
            (size * loud).sum(axis=1) ** 2, square, out=np.ones(len(power)), where=square > 0.0
        )
    return np.minimum(out, 1.0)


def _ends(moments: Array) -> tuple[Array, Array]:
    """Smallest and largest value of every axis, (axis, 1)."""
    return np.fmin.reduce(moments[..., 3], axis=1, keepdims=True), np.fmax.reduce(
        moments[..., 4], axis=1, keepdims=True
    )


def _at_ends(moments: Array, low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.int64]:
    """Counts at the smallest and largest value of each block, where these are those of the record."""
    lowest, highest = _ends(moments)
    return np.asarray(
        np.where(moments[..., 3] == lowest, low, 0)
        + np.where((moments[..., 4] == highest) & (lowest < highest), high, 0)
    )


def _extremes(moments: Array, counts: NDArray[np.int64]) -> NDArray[np.int64]:
    return _at_ends(moments, counts[..., 3], counts[..., 4])


def _repeats(moments: Array, counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Held samples stand wherever the rate was: what stands at zero or at an end of the range is something else."""
    return counts[..., 2] - _at_ends(moments, counts[..., 5], counts[..., 6])


def _stuck(
    moments: Array, counts: NDArray[np.int64], filled: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Zeros of an axis by itself, unless zero is the end of its range."""
    lowest, highest = _ends(moments)
    return np.asarray(np.where((lowest < 0.0) & (highest > 0.0), counts[..., 1] - filled, 0))


def _beside(work: Accumulator, log: xr.Dataset) -> dict[str, Any]:
    """Cross-spectra of the axes, and spectra of the channels on the log's own time with each axis."""
    axes, names = work.axes, [str(name) for name in log["axis"].values]
    found: dict[str, Any] = {}
    own = [number for number, (_, other) in enumerate(work.pairs) if other < axes]
    attrs = _named(
        "mean cross-periodogram of the samples that both axes have, two-sided density", _POWER
    )
    found["cross"] = (("pair", "block", "band"), work.cross[own], attrs)
    attrs = _named(
        "shape of the gamma distribution of powers over the samples that both axes have", "1"
    )
    found["cross_shape"] = (("pair", "block", "band"), work.cross_shape[own], attrs)
    attrs = _named("share of neighbouring pairs of the samples that both axes have, tapered", "1")
    found["cross_neighbours"] = (("pair", "block"), work.cross_neighbours[own], attrs)
    found["cross_samples"] = (
        ("pair", "block"),
        work.cross_samples[own],
        _named("samples that both axes have", "1"),
    )
    found["first"] = (
        "pair",
        np.array([names[work.pairs[number][0]] for number in own], dtype=object),
    )
    found["second"] = (
        "pair",
        np.array([names[work.pairs[number][1]] for number in own], dtype=object),
    )
    if work.beside:
        shape = (axes, len(work.beside), *work.cross.shape[1:])
        with_axes = np.full(shape, np.nan + 0j)
        for number, (a, b) in enumerate(work.pairs):
            if b >= axes:
                with_axes[a, b - axes] = work.cross[number]
        units = [str(log[name].attrs.get("units", "1")) for name in work.beside]
        told = ", ".join(f"{name} in {unit}" for name, unit in zip(work.beside, units, strict=True))
        attrs = {
            "long_name": "mean periodogram of a channel, two-sided density",
            "units": f"square of the channel's unit per Hz ({told})",
        }
        found["witness_power"] = (("witness", "block", "band"), work.power[axes:], attrs)
        attrs = {"long_name": "mean cross-periodogram of axis and channel, F_axis conj(F_channel)",
                 "units": f"degree hour-1 Hz-1 times the channel's unit ({told})"}  # fmt: skip
        found["witness_cross"] = (("axis", "witness", "block", "band"), with_axes, attrs)
    return found


def _locked(work: Accumulator) -> dict[str, Any]:
    """What is locked to the rotation of the tool, and to the phase of the ramp."""
    found: dict[str, Any] = {}
    if work.order is not None:
        attrs = _named(
            "complex amplitude at multiples of the tool's rotation, NaN below one turn in the block",
            _RATE,
        )
        found["order"] = (("axis", "block", "harmonic"), work.order, attrs)
        level = _named(
            "density of what turns 1 to 4 times in the block more or less than that, two-sided",
            _POWER,
        )
        found["order_level"] = (("axis", "block", "harmonic"), work.order_level, level)
    if work.profile_sums is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            profile = work.profile_sums / work.profile_counts
        dims = ("axis", "block", "phase")
        found["profile"] = (
            dims,
            profile,
            _named("mean rate less the block's mean, by phase of the ramp", _RATE),
        )
        found["profile_samples"] = (dims, work.profile_counts, _named("samples of each mean", "1"))
        attrs = _named("turns of the ramp in a second, negative where it falls", "Hz") | dict(
            zip(("low", "high"), work.ramp_range, strict=True)
        )
        found["ramp_turns"] = ("block", work.ramp_turns, attrs)
    return found


def _channels(work: Accumulator, log: xr.Dataset) -> dict[str, Any]:
    found: dict[str, Any] = {}
    inside, own = numeric_channels(log)
    edges = grid_times(work.start, work.rate, np.arange(work.block_count + 1) * work.length)
    for name in (*inside, *own):
        rms = name.startswith("vibration")
        if name in inside:
            mean, spread = np.moveaxis(work.moments[work.axes + inside.index(name), :, :2], -1, 0)
            values = np.sqrt(mean**2 + spread) if rms else mean
        else:
            values = channel_means(log, name, edges, rms=rms)
        units = str(log[name].attrs.get("units", "1"))
        told = {"band_hz": log[name].attrs["band_hz"]} if "band_hz" in log[name].attrs else {}
        found[f"channel_{name}"] = (
            "block",
            values,
            _named(f"{'rms' if rms else 'mean'} of {name} over the block", units) | told,
        )
    return found


def _fine(work: Accumulator, log: xr.Dataset) -> dict[str, Any]:
    """Channels in parts of the blocks, less their noise, where each part has a value of its own: effects follow them with a lag."""
    found: dict[str, Any] = {}
    edges = grid_times(
        work.start, work.rate, np.arange(work.block_count * FINE + 1) * work.length // FINE
    )
    for name in numeric_channels(log)[1]:
        if not name.startswith(FOLLOWED):
            continue
        span = np.ptp(log[f"time_{name}"].values.astype("datetime64[ns]").astype(np.int64)) / 1e9
        if log.sizes[f"time_{name}"] * work.length >= span * work.rate * FINE > 0.0:
            work.fine[name] = channel_means(log, name, edges, rms=False).reshape(-1, FINE)
    for name, values in work.fine.items():
        good = np.isfinite(values)
        if good.mean() > 1.0 / 2.0:
            place = np.arange(values.size)
            bridged = np.interp(place, place[good.ravel()], values[good])
            units = str(log[name].attrs.get("units", "1"))
            smooth = smooth_curve(bridged, longest=_SMOOTH * FINE).reshape(values.shape)
            found[f"fine_{name}"] = (
                ("block", "piece"),
                smooth,
                _named(f"{name} in parts of the block, without noise", units),
            )
    return found


def _spans(work: Accumulator, log: xr.Dataset, restart: float) -> dict[str, Any]:
    """Gaps, and those after which the tool started anew, in seconds since the start."""
    gaps = np.array(work.gaps, dtype=np.float64).reshape(-1, 2) / work.rate
    starts = gaps[gaps[:, 1] - gaps[:, 0] >= restart].tolist()
    if "gap_cause" in log.variables:
        known = log["gap_cause"].values == GAP_CAUSES.index("restart")
        stamps = [
            log[name].values[known].astype("datetime64[ns]").astype(np.int64)
            for name in ("gap_start", "gap_end")
        ]
        told = (
            np.stack([grid_index(work.start, work.rate, stamp) for stamp in stamps], axis=-1)
            / work.rate
        )
        starts += [
            span
            for span in told.tolist()
            if not any(low <= span[1] and span[0] <= high for low, high in starts)
        ]
    restarts = np.array(sorted(starts), dtype=np.float64).reshape(-1, 2)
    return {
        "gap_begin": ("gap", gaps[:, 0], _named("first missing sample, since the start", "s")),
        "gap_end": ("gap", gaps[:, 1], _named("first sample present again, since the start", "s")),
        "restart_begin": ("restart", restarts[:, 0], _named("power lost, since the start", "s")),
        "restart_end": ("restart", restarts[:, 1], _named("power back, since the start", "s")),
    }


def _coordinates(work: Accumulator, log: xr.Dataset) -> dict[str, Any]:
    ends = np.arange(work.block_count + 1) * work.length
    stamps = grid_times(work.start, work.rate, ends)
    step = work.rate / work.length
    coordinates: dict[str, Any] = {
        "cell": ("cell", np.array(CELLS, dtype=object)),
        "axis": ("axis", np.array([str(name) for name in log["axis"].values], dtype=object)),
        "time": (
            "block",
            (stamps[:-1] + np.diff(stamps) // 2).view("datetime64[ns]"),
            {"long_name": "middle of the block"},
        ),
        "begin": (
            "block",
            ends[:-1] / work.rate,
            _named("start of the block, since the start", "s"),
        ),
        "end": ("block", ends[1:] / work.rate, _named("end of the block, since the start", "s")),
        "frequency": (
            "band",
            (work.edges[:-1] + work.edges[1:] - 1) / 2.0 * step,
            _named("centre of the band", "Hz"),
        ),
        "band_low": (
            "band",
            (work.edges[:-1] - 0.5) * step,
            _named("lower edge of the band", "Hz"),
        ),
        "band_high": (
            "band",
            (work.edges[1:] - 0.5) * step,
            _named("upper edge of the band", "Hz"),
        ),
        "line_frequency": (
            "line",
            np.arange(1, work.line_sum.shape[-1] + 1) * step,
            _named("frequency", "Hz"),
        ),
    }
    if work.beside:
        coordinates["witness"] = ("witness", np.array(work.beside, dtype=object))
    if work.order is not None:
        coordinates["harmonic"] = (
            "harmonic",
            np.array(HARMONICS),
            _named("multiple of the rotation", "1"),
        )
    if work.profile_sums is not None:
        low, high = work.ramp_range
        coordinates["phase"] = (
            "phase",
            (np.arange(PHASES) + 0.5) / PHASES,
            _named(f"phase of the ramp, {low:g} to {high:g}", "1"),
        )
    return coordinates


def _attributes(work: Accumulator, log: xr.Dataset, present: NDArray[np.int64]) -> dict[str, Any]:
    end = grid_times(work.start, work.rate, log.sizes["time"])
    return {
        "start": _iso(work.start),
        "end": _iso(int(end)),
        "start_ns": work.start,
        "sampling_rate_hz": work.rate,
        "block_s": work.length / work.rate,
        "block_samples": work.length,
        "missing_share": 1.0 - float(present.sum()) / (present.size * work.length),
        "source_files": texts(log, "source_files"),
        "notes": texts(log, "notes"),
        "unused_channels": dict(log.attrs.get("unused_channels", {})),
    }


def _iso(stamp: int) -> str:
    """Stamp [ns since 1970] as ISO 8601, to the millisecond."""
    return str(np.datetime64(stamp, "ns").astype("datetime64[ms]")) + "Z"

"""Linear models of the statistics whose noise is independent from cell to cell.

These are powers, cross-spectra, rotation orders, ramp profiles and transfers. The data may be a
recording or null records, with the dimension ``record`` first. Weights and given columns are those
of a `State`: the current model of the noise, and the effects named so far.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.held_out import LinearModel, noise_columns, with_independent_cells
from gyrostab.diagnose.predict.candidates import Candidate
from gyrostab.diagnose.reduce.block_statistics import measured, noise_at_orders
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.spectra.periodogram import taper

__all__ = [
    "State",
    "build_linear_model",
    "cross_column",
    "cross_without",
    "expected_cross",
    "initial_state",
    "pair_rows",
    "reference_channel_power",
    "simulate_noise",
    "spread_by_gaps",
    "statistic_rows",
    "unspread_share",
]

Array = NDArray[Any]
#: Power over noise beyond which the power of an axis is motion, three in amplitude. Design choice.
_MIN_MOTION_RATIO = 9.0
_QUIESCENT_QUANTILE = 0.25  # of the powers over blocks, taken as power at rest; design choice
#: Least share of the variance of a cross-spectrum in quadrature to shared noise. Design choice.
_MIN_QUADRATURE_SHARE = 0.05


@dataclass(frozen=True)
class State:
    """Model of a record in which a candidate is tried.

    Attributes
    ----------
    blocks : xarray.Dataset
        Block statistics of the recording.
    baseline : xarray.Dataset
        From `gyrostab.diagnose.baseline.calibrate`.
    weight : ndarray, shape (axis, block, band)
        Powers that define the weights of all cells [degree2 hour-2 Hz-1]: expected, plus those of
        the named effects.
    masked : ndarray of bool, shape (axis, block)
        Blocks whose powers and cross-spectra are left out.
    given : mapping of (str, str) to list of ndarray
        (statistic, row) -> columns in the model with and without a candidate; the row is an axis,
        or the two axes of a pair with a comma between them.
    settings : Settings
        What the diagnosis was started with.
    """

    blocks: xr.Dataset
    baseline: xr.Dataset
    weight: Array
    masked: NDArray[np.bool_]
    given: dict[tuple[str, str], list[Array]] = field(default_factory=dict)
    settings: Settings = DEFAULTS

    def with_columns(self, statistic: str, row: str, columns: Sequence[Array]) -> State:
        """Return the state with more given columns."""
        given = dict(self.given)
        given[statistic, row] = [*given.get((statistic, row), []), *columns]
        return replace(self, given=given)

    @property
    def axes(self) -> list[str]:
        """Names of the axes."""
        return [str(one) for one in self.blocks["axis"].values]


def initial_state(
    blocks: xr.Dataset, baseline: xr.Dataset, *, settings: Settings = DEFAULTS
) -> State:
    """Return the state in which no effect is named."""
    weight = baseline["spectrum"].transpose("axis", "block", "band").values
    return State(blocks, baseline, weight, np.zeros(weight.shape[:2], np.bool_), settings=settings)


def simulate_noise(model: LinearModel, rng: np.random.Generator, count: int) -> LinearModel:
    """Replace the values of a model by `count` records of noise alone."""
    spread = np.where(
        model.weight > 0.0, 1.0 / np.sqrt(np.where(model.weight > 0.0, model.weight, 1.0)), 0.0
    )
    return model._replace(values=spread[..., None] * rng.standard_normal((*spread.shape, count)))


def unspread_share(blocks: xr.Dataset, row: str = "axis") -> Array:
    """Return the share of a density that each block shows at its own frequencies, 1 without gaps.

    Shape (axis or pair, block). Random gaps spread the rest over all frequencies. The missing
    neighbours at the tapered ends of a block spread nothing.
    """
    near = (
        blocks["neighbours" if row == "axis" else "cross_neighbours"].transpose(row, "block").values
    )
    weights = taper(int(blocks.attrs["block_samples"]))
    whole = float((weights[1:] * weights[:-1]).sum() / (weights**2).sum())
    return np.minimum(np.where(np.isfinite(near), near, whole) / whole, 1.0)


def spread_by_gaps(density: Array, blocks: xr.Dataset, row: str = "axis") -> Array:
    """Mix a density with its mean over frequency, as gaps do; (axis, block, band).

    The density is (axis or 1, block or 1, band); the row may be a pair of axes instead of an axis.
    """
    return _mix_with_mean(density, unspread_share(blocks, row), band_widths(blocks))


def band_widths(blocks: xr.Dataset) -> Array:
    """Return the widths of the bands [Hz]."""
    return np.asarray(blocks["band_high"].values - blocks["band_low"].values)


def _mix_with_mean(density: Array, near: Array, width: Array) -> Array:
    """Spread a density (..., band) over all bands, except for its share `near` (...)."""
    level = (density * width).sum(axis=-1, keepdims=True) / width.sum()
    return np.asarray(near[..., None] * density + (1.0 - near[..., None]) * level)


def _select_row(density: Array, row: int) -> Array:
    """Return one row of a density that has all of them, or one for all."""
    return np.asarray(density[row if density.shape[0] > 1 else 0])


def pair_rows(blocks: xr.Dataset) -> list[tuple[str, ...]]:
    """Return the two axes of each pair."""
    return [
        (str(a), str(b))
        for a, b in zip(blocks["first"].values, blocks["second"].values, strict=True)
    ]


def cross_without(blocks: xr.Dataset, left_out: NDArray[np.bool_]) -> xr.DataArray:
    """Return cross-spectra of the pairs without blocks that are left out (axis, block)."""
    axes = [str(axis) for axis in blocks["axis"].values]
    pairs = np.array(
        [[axes.index(axis) for axis in pair] for pair in pair_rows(blocks)], np.int64
    ).reshape(-1, 2)
    return blocks["cross"].where(~xr.DataArray(left_out[pairs].any(axis=1), dims=("pair", "block")))


def statistic_rows(candidate: Candidate, state: State) -> list[tuple[str, ...]]:
    """Return the axes of each row of a statistic."""
    if candidate.statistic == "cross":
        return pair_rows(state.blocks)
    if candidate.statistic == "order" and not candidate.each:
        pattern = np.abs(candidate.variants[0].design[0]).max(axis=-1)
        return [tuple(axis for axis, size in zip(state.axes, pattern, strict=True) if size > 0)]
    return [(axis,) for axis in state.axes]


def build_linear_model(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    """Build the linear model of one row of a statistic, with the designs of all variants in order.

    The candidates belong to the same statistic and rows; those of "transfer" to the same reference
    channel.
    """
    return _BUILDERS[candidates[0].statistic](candidates, row, data, state)


# -------------------------------------------------------------------------------
# common parts


def _records_last(values: Array, plain: int) -> Array:
    """Return data with the record last."""
    return np.moveaxis(values, 0, -1) if values.ndim > plain else values[..., None]


def _real_and_imaginary(values: Array, axis: int = -1) -> Array:
    """Concatenate real and imaginary parts."""
    return np.concatenate([values.real, values.imag], axis=axis)


def _given_columns(
    state: State,
    statistic: str,
    row: tuple[str, ...],
    shape: tuple[int, ...],
    known: Sequence[Array] = (),
    precision: Any = (),
) -> Any:
    """Return given columns (block, cell, column), known ones and named effects, and precision."""
    named_columns = state.given.get((statistic, ",".join(row)), [])
    columns = [np.broadcast_to(one, shape) for one in [*known, *named_columns]]
    given = np.stack(columns, axis=-1) if columns else np.empty((*shape, 0))
    return given, np.diag([*precision, *[-1.0] * len(named_columns)])


def _stack_columns(columns: Sequence[Array], shape: tuple[int, ...]) -> Array:
    """Stack columns as (block, cell, column)."""
    return np.stack([np.broadcast_to(one, shape) for one in columns], axis=-1)


# -------------------------------------------------------------------------------
# powers


def power_column(density: Array, row: int, state: State) -> Array:
    """Return an added density (axis or 1, block or 1, band) of an axis with gaps, (block, band)."""
    seen = _mix_with_mean(
        _select_row(density, row), unspread_share(state.blocks)[row], band_widths(state.blocks)
    )
    return np.broadcast_to(seen, state.weight.shape[1:])


def _build_power(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    """Build the model of the band powers of an axis."""
    axis = state.axes[row]
    expected = state.baseline["spectrum"].sel(axis=axis).transpose("block", "band").values
    values = (
        _records_last(data["power"].transpose(..., "axis", "block", "band").values, 3)[row]
        - expected[..., None]
    )
    weight = (
        state.baseline["shape_alone"].sel(axis=axis).transpose("block", "band").values
        / state.weight[row] ** 2
    )
    weight = np.where(state.masked[row][:, None], 0.0, weight)
    level, precision = noise_columns(state.baseline, axis=axis)
    known = [level[..., number] * expected for number in range(level.shape[2])]
    given, whole = _given_columns(
        state, "power", (axis,), weight.shape, known, np.diagonal(precision)
    )
    near, width = unspread_share(state.blocks)[row], band_widths(state.blocks)
    designs = [
        _stack_columns(
            [_mix_with_mean(_select_row(one, row), near, width) for one in variant.design],
            weight.shape,
        )
        for candidate in candidates
        for variant in candidate.variants
    ]
    return with_independent_cells(
        LinearModel(values, weight, designs, given, whole),
        state.baseline["common"].sel(axis=axis).values,
        state.weight[row],
    )


# -------------------------------------------------------------------------------
# crosses


def cross_column(density: Array, row: int, blocks: xr.Dataset) -> Array:
    """Return a cross-density (1, block or 1, band) of a pair with gaps, complex (block, band)."""
    shape = blocks["cross"].transpose("pair", "block", "band").shape
    return np.asarray(np.broadcast_to(spread_by_gaps(density + 0j, blocks, "pair"), shape)[row])


def expected_cross(baseline: xr.Dataset) -> Array | None:
    """Return the cross-spectra of the baseline, (pair, block, band); None if it has none."""
    return (
        np.asarray(baseline["cross"].transpose("pair", "block", "band").values)
        if "cross" in baseline
        else None
    )


def _build_cross(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    """Build the model of the cross-spectrum of a pair of axes."""
    pair = pair_rows(state.blocks)[row]
    i, j = (state.axes.index(axis) for axis in pair)
    known = expected_cross(state.baseline)
    shared = known[row] if known is not None else np.zeros(1)
    values = (
        _records_last(data["cross"].transpose(..., "pair", "block", "band").values, 3)[row]
        - shared[..., None]
    )
    shape = state.blocks["cross_shape"].transpose("pair", "block", "band").values[row]
    # The scatter is larger in phase with shared noise, and smaller in quadrature.
    alone, apart = state.weight[i] * state.weight[j], (shared**2).real
    weight = np.concatenate(
        [
            2.0 * shape / (alone + apart),
            2.0 * shape / np.maximum(alone - apart, _MIN_QUADRATURE_SHARE * alone),
        ],
        axis=1,
    )
    weight = np.where((state.masked[i] | state.masked[j])[:, None], 0.0, weight)
    given, precision = _given_columns(state, "cross", pair, weight.shape)
    near, width = unspread_share(state.blocks, "pair")[row], band_widths(state.blocks)
    designs = [
        _stack_columns(
            [
                _real_and_imaginary(_mix_with_mean(_select_row(one, row) + 0j, near, width))
                for one in variant.design
            ],
            weight.shape,
        )
        for candidate in candidates
        for variant in candidate.variants
    ]
    return LinearModel(_real_and_imaginary(values, axis=1), weight, designs, given, precision)


# -------------------------------------------------------------------------------
# orders


def order_weight(state: State) -> Array:
    """Return (axis, block, harmonic): one over the variance of each part of an amplitude."""
    blocks = state.blocks
    rate, frequency = float(blocks.attrs["sampling_rate_hz"]), blocks["frequency"].values
    place = (
        np.abs(blocks["channel_rotation_rate"].values)[:, None] / 360.0 * blocks["harmonic"].values
    )
    good = (
        np.isfinite(blocks["order"].values)
        & (place * float(blocks.attrs["block_s"]) >= 2.0)
        & (place < rate / 2.0)
    )
    nearest = np.abs(np.log(np.maximum(place, frequency[0])[..., None] / frequency)).argmin(axis=-1)
    level = np.take_along_axis(
        state.weight, np.broadcast_to(nearest, (state.weight.shape[0], *nearest.shape)), axis=2
    )
    level = noise_at_orders(blocks, level)
    seconds = blocks["samples"].values[..., None] / rate
    return np.where(good, seconds / (2.0 * level), 0.0)


def harmonic_sets(count: int) -> list[tuple[int, ...]]:
    """Return each harmonic alone, and all together."""
    return [*((k,) for k in range(count)), *([tuple(range(count))] if count > 1 else [])]


def order_columns(pattern: Array, chosen: tuple[int, ...]) -> list[Array]:
    """Return columns (cell,) of a complex factor for each chosen harmonic.

    The cells are the real parts, then the imaginary parts of the harmonics.
    """
    columns = []
    for k in chosen:
        one = np.zeros_like(pattern)
        one[..., k] = pattern[..., k]
        columns += [_real_and_imaginary(one), _real_and_imaginary(1j * one)]
    return columns


def _build_order(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    """Build the model of the rotation orders of an axis, or of all axes together."""
    values = _records_last(data["order"].transpose(..., "axis", "block", "harmonic").values, 3)
    weight = order_weight(state)
    count = weight.shape[-1]
    if candidates[0].each:
        both = np.concatenate([weight[row], weight[row]], axis=1)
        designs = [
            _stack_columns(order_columns(np.ones(count, complex), chosen), both.shape)
            for chosen in harmonic_sets(count)
        ]
        given, precision = _given_columns(state, "order", (state.axes[row],), both.shape)
        return LinearModel(
            _real_and_imaginary(values[row], axis=1),
            both,
            designs * len(candidates),
            given,
            precision,
        )
    # The cells of all axes side by side.
    both = np.concatenate([np.concatenate([one, one], axis=1) for one in weight], axis=1)
    stacked = np.concatenate([_real_and_imaginary(one, axis=1) for one in values], axis=1)
    designs = []
    for candidate in candidates:
        for variant in candidate.variants:
            for pattern in (variant.design[0], np.conj(variant.design[0])):
                by_axis = [order_columns(one, (0,)) for one in pattern]
                designs.append(
                    _stack_columns(
                        [np.concatenate(columns) for columns in zip(*by_axis, strict=True)],
                        both.shape,
                    )
                )
    named_columns = [state.given.get(("order", axis), []) for axis in state.axes]
    given, precision = np.empty((*both.shape, 0)), np.empty((0, 0))
    for number, columns in enumerate(named_columns):
        for one in columns:
            wide = np.zeros((*both.shape, 1))
            wide[:, number * 2 * count : (number + 1) * 2 * count, 0] = one
            given = np.concatenate([given, wide], axis=2)
    if given.shape[2]:
        precision = -np.eye(given.shape[2])
    return LinearModel(stacked, both, designs, given, precision)


# -------------------------------------------------------------------------------
# profiles


def _build_profile(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    """Build the model of the ramp profile of an axis."""
    values = _records_last(data["profile"].transpose(..., "axis", "block", "phase").values, 3)[row]
    rate = float(state.blocks.attrs["sampling_rate_hz"])
    width = (state.blocks["band_high"] - state.blocks["band_low"]).values
    variance = rate * (state.weight[row] * width).sum(axis=-1) / width.sum()
    weight = state.blocks["profile_samples"].values[row] / variance[:, None]
    given, precision = _given_columns(
        state, "phase_locked", (state.axes[row],), weight.shape, [np.ones(weight.shape[1])], [-1.0]
    )
    designs = [
        _stack_columns(list(variant.design), weight.shape)
        for candidate in candidates
        for variant in candidate.variants
    ]
    return LinearModel(values, weight, designs, given, precision)


# -------------------------------------------------------------------------------
# transfers


def reference_channel_of(
    name: str, row: int, data: xr.Dataset, blocks: xr.Dataset, baseline: xr.Dataset
) -> tuple[Array, Array]:
    """Return the cross-power of an axis with a channel or other axis, and the power of that.

    Shapes (block, band, record) and (block, band). Expected cross-spectra are subtracted.
    """
    axes = [str(one) for one in blocks["axis"].values]
    if name in axes:
        cross = _records_last(
            measured(data, "cross").transpose(..., "pair", "block", "band").values, 3
        )
        has_power = np.isfinite(blocks["power"].values[row])[..., None]
        known = expected_cross(baseline)
        cross = cross if known is None else cross - known[..., None]
        cross_power = np.full(cross.shape[1:], np.nan + 0j)
        for number, pair in enumerate(pair_rows(blocks)):
            if set(pair) == {name, axes[row]} and name != axes[row]:
                cross_power = np.where(
                    has_power, np.conj(cross[number]) if pair[0] == name else cross[number], np.nan
                )
        return cross_power, reference_channel_power(name, blocks)
    place = [str(one) for one in blocks["reference"].values].index(name)
    cross = _records_last(
        data["reference_cross"].transpose(..., "axis", "reference", "block", "band").values, 4
    )
    return cross[row, place], reference_channel_power(name, blocks)


def reference_channel_power(name: str, blocks: xr.Dataset) -> Array:
    """Return the power of a channel on the log's time, or of an axis as measured, (block, band)."""
    if name in blocks["axis"].values:
        return np.asarray(
            measured(blocks, "power").sel(axis=name).transpose("block", "band").values
        )
    return np.asarray(
        blocks["reference_power"].sel(reference=name).transpose("block", "band").values
    )


def _build_transfer(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    """Build the model of the transfer from a reference channel to an axis."""
    cross, power = reference_channel_of(
        candidates[0].reference[0], row, data, state.blocks, state.baseline
    )
    root = np.sqrt(np.where(power > 0.0, power, np.nan))
    share = _moving_share(candidates[0].reference[0], power, state)
    weight = 2.0 * state.blocks["shape"].values[row] / state.weight[row]
    weight = np.where(
        np.isfinite(root) & np.isfinite(weight) & ~state.masked[row][:, None], weight, 0.0
    )
    weight = np.concatenate([weight, weight], axis=1)
    with np.errstate(invalid="ignore"):
        values = _real_and_imaginary(cross / root[..., None], axis=1)
    given, precision = _given_columns(state, "transfer", (state.axes[row],), weight.shape)
    designs = [
        _stack_columns(
            [_real_and_imaginary(one * root * share) for one in variant.design], weight.shape
        )
        for candidate in candidates
        for variant in candidate.variants
    ]
    return LinearModel(values, weight, designs, given, precision)


def _moving_share(name: str, power: Array, state: State) -> Array:
    """Return the share of another axis's power (block, band) that is motion; 1 for a channel.

    Only intermittent motion leaks: at rest the axes may have noise and lines in common, which are
    not a leak. Therefore the power of an axis in the quieter blocks of a band, and its expected
    noise, do not count as motion. The noise of a channel is unknown.
    """
    if name not in state.axes:
        return np.ones_like(power)
    row = state.axes.index(name)
    noise = state.baseline["spectrum"].transpose("axis", "block", "band").values[row]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a band without data has no motion
        noise = np.fmax(noise, np.nanquantile(power, _QUIESCENT_QUANTILE, axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(power > _MIN_MOTION_RATIO * noise, 1.0 - noise / power, 0.0)


_BUILDERS = {
    "power": _build_power,
    "cross": _build_cross,
    "order": _build_order,
    "phase_locked": _build_profile,
    "transfer": _build_transfer,
}

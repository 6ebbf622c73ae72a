"""Candidates: the predictions of every registered effect over its grid of nuisance parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.sample_counts import GRID_COUNTS, has_coarse_grid
from gyrostab.diagnose.predict.channel_use import MIN_BLOCK_SHARE, missing_channel_reason
from gyrostab.diagnose.predict.designs import BUILDERS, Candidate, Variant
from gyrostab.diagnose.predict.step_times import power_on_times, select_step_times
from gyrostab.diagnose.reduce.block_statistics import measured
from gyrostab.errors import OptionError
from gyrostab.noise import HOUR
from gyrostab.physics.base import Effect
from gyrostab.physics.prediction import Prediction, Windows
from gyrostab.physics.registry import effects

__all__ = [
    "LARGEST_SIZE",
    "STATISTIC_NAMES",
    "Candidate",
    "Variant",
    "channel_units",
    "effect_candidates",
    "make_windows",
    "rebuild_variant",
]

Array = NDArray[Any]
#: Statistics in which an effect can show, in the order of the search.
STATISTIC_NAMES = (
    "marks",
    "mean",
    "power",
    "cross",
    "order",
    "phase_locked",
    "transfer",
    "line",
    "wander",
    "levels",
)
_MAX_VALUES = 60  # of a nuisance parameter; limits time
_MAX_VARIANTS = 200  # of a candidate; limits time
#: Effect -> largest plausible size of each of its parameters. Design choice.
LARGEST_SIZE = {"misalignment": 20.0, "earth_rate": 20.0}
_MIN_SIZE_STDERRS = 3.0  # of an effect of the largest size, to be tried; design choice
_TIME_PARAMETER = "at"  # nuisance parameter that is a time
_SAME_DESIGN = {"fringe_hop": "bias_jump"}  # effects with the same design; the size decides
_MAX_DESIGN_DIFFERENCE = 1e-3  # of its size, up to which designs are equal; design choice


def channel_units(blocks: xr.Dataset) -> dict[str, str]:
    """Return the units of the channels of the log."""
    begin = "channel_"
    return {
        str(name)[len(begin) :]: str(blocks[name].attrs.get("units", ""))
        for name in blocks.data_vars
        if str(name).startswith(begin)
    }


def make_windows(blocks: xr.Dataset, drivers: Mapping[str, str]) -> Windows:
    """Return the record in the form that effects take for their predictions.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `reduce_log`.
    drivers : mapping of str to str
        Channels of the log by channel of the effect.
    """
    axes = tuple(str(axis) for axis in blocks["axis"].values)
    own = dict(
        zip(
            axes,
            map(_fill_linearly, measured(blocks, "mean").transpose("axis", "block").values),
            strict=True,
        )
    )

    def spans(name: str) -> Array:
        if f"{name}_begin" not in blocks:
            return np.empty((0, 2))
        return np.stack(
            [blocks[f"{name}_begin"].values, blocks[f"{name}_end"].values], axis=1
        ).astype(np.float64)

    return Windows(
        begin=blocks["begin"].values.astype(np.float64),
        end=blocks["end"].values.astype(np.float64),
        frequency=blocks["frequency"].values,
        rate=float(blocks.attrs["sampling_rate_hz"]),
        axes=axes,
        drivers={
            inner: _fill_linearly(blocks[f"channel_{name}"].values)
            for inner, name in drivers.items()
        },
        fine={
            inner: blocks[f"fine_{name}"].values
            for inner, name in drivers.items()
            if f"fine_{name}" in blocks
        },
        own=own,
        gaps=spans("gap"),
        restarts=spans("restart"),
        phase=(np.arange(blocks.sizes["phase"]) + 0.5) / blocks.sizes["phase"]
        if "profile" in blocks
        else np.empty(0),
        turns=blocks["ramp_turns"].values if "ramp_turns" in blocks else np.empty(0),
        bands={
            inner: band
            for inner, name in drivers.items()
            if (band := _rms_band(blocks[f"channel_{name}"])) is not None
        },
    )


def _rms_band(channel: xr.DataArray) -> tuple[float, float] | None:
    """Return the edges of the band of an rms channel [Hz]; None if it does not have any."""
    try:
        low, high = (float(edge) for edge in channel.attrs.get("band_hz", ()))
    except (TypeError, ValueError):
        return None
    return (low, high) if 0.0 <= low < high < np.inf else None


def _fill_linearly(values: Array) -> Array:
    """Interpolate missing values linearly."""
    good = np.isfinite(values)
    if good.all() or not good.any():
        return np.asarray(values, np.float64)
    place = np.arange(values.size)
    return np.interp(place, place[good], values[good])


def effect_candidates(
    blocks: xr.Dataset, coefficient: xr.DataArray
) -> tuple[list[Candidate], dict[str, str]]:
    """Build the candidates of all registered effects that this record can show.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `reduce_log`.
    coefficient : xarray.DataArray
        ``(axis, term)``: noise of the baseline, in units of the noise model.

    Returns
    -------
    candidates : list of Candidate
    reasons : dict of str to str
        Why an effect cannot be seen in this record.

    Examples
    --------
    >>> from gyrostab.diagnose.reduce.block_statistics import reduce_log
    >>> from gyrostab.ingest.make_log import make_log
    >>> noise = 1.8 * np.random.default_rng(1).standard_normal((1, 60_000))
    >>> blocks = reduce_log(make_log(noise, rate=100.0, unit="deg/h"))
    >>> coordinates = {"axis": ["axis_0"], "term": ["N", "B"]}
    >>> level = xr.DataArray([[0.003, 0.0]], coordinates, ("axis", "term"))
    >>> found, reasons = effect_candidates(blocks, level)
    >>> reasons["shupe"]
    'not identifiable: the recording has no channel temperature'
    >>> sorted({one.effect for one in found if one.statistic == "marks"})
    ['clipping', 'dead_zone', 'held_samples', 'rate_quantization', 'spikes']
    """
    units = channel_units(blocks)
    found: list[Candidate] = []
    reasons: dict[str, str] = {}
    for name, kind in effects().items():
        if name in _SAME_DESIGN:
            continue
        built: list[Candidate] = []
        reason = ""
        if _is_hidden_by_grid(kind, blocks):
            reasons[name] = "not identifiable: the quantization grid is too coarse"
            continue
        for drivers in _driver_assignments(kind, blocks, units):
            added, why = _candidates_of_effect(kind, blocks, drivers, coefficient)
            built += added
            reason = reason or why
        found += built
        if not built:
            why = reason or "it leaves no trace in means, spectra and distribution of this record"
            reasons[name] = f"not identifiable: {why}"
    return found, reasons


def _is_hidden_by_grid(kind: type[Effect], blocks: xr.Dataset) -> bool:
    """Return whether a coarse quantization grid hides every statistic of the effect on all axes."""
    if kind.channels or not has_coarse_grid(blocks).all():
        return False
    marks = kind.example().explain(make_windows(blocks, {})).marks
    return bool(marks) and set(marks) <= set(GRID_COUNTS)


# -------------------------------------------------------------------------------
# channels


def _driver_assignments(
    kind: type[Effect], blocks: xr.Dataset, units: Mapping[str, str]
) -> Iterator[dict[str, str]]:
    """Yield assignments of the log's channels to the effect's, in all sensible ways."""
    options = [
        _matching_channels(channel, unit, tuple(kind.channels), blocks, units) or [""]
        for channel, unit in kind.channels.items()
    ]
    assigned = set()
    for chosen in product(*options):
        named = [name for name in chosen if name]
        if len(set(named)) < len(named) or frozenset(named) in assigned:
            continue
        assigned.add(frozenset(named))
        yield {channel: name for channel, name in zip(kind.channels, chosen, strict=True) if name}
    if not assigned:
        yield {}


def _matching_channels(
    channel: str,
    unit: str,
    channels: tuple[str, ...],
    blocks: xr.Dataset,
    units: Mapping[str, str],
) -> list[str]:
    """Return channels of the log for one of the effect's: vectors by name, others by prefix."""
    if sum(other[:-1] == channel[:-1] for other in channels) > 1 and channel[-1] in "xyz":
        names = [channel]
    else:
        base = channel.rstrip("0123456789").rstrip("_")
        names = sorted(
            (name for name in units if name == base or name.startswith(base + "_")),
            key=lambda name: (name != channel, name),
        )
    return [
        name
        for name in names
        if units.get(name) == unit
        and np.isfinite(blocks[f"channel_{name}"].values).mean() >= MIN_BLOCK_SHARE
    ]


# -------------------------------------------------------------------------------
# variants


def _candidates_of_effect(
    kind: type[Effect], blocks: xr.Dataset, drivers: dict[str, str], coefficient: xr.DataArray
) -> tuple[list[Candidate], str]:
    """Build the candidates of an effect with its channels, by statistic; or say why not."""
    if kind.channels and not drivers:
        return _motion_candidates(kind, blocks), missing_channel_reason(
            tuple(kind.channels), blocks
        )
    windows = make_windows(blocks, drivers)
    predictions: list[tuple[dict[str, Any], Prediction]] = []
    why = ""
    for values in _nuisance_grid(kind, windows):
        try:
            effect = kind.example(**values)
            predictions.append(
                (
                    values,
                    _drop_hidden_means(
                        kind.name, _predict_exogenous(effect, windows), blocks, coefficient
                    ),
                )
            )
        except KeyError as error:
            why = missing_channel_reason((str(error.args[0]),), blocks)
        except OptionError as error:
            why = str(error)
    driver = tuple(drivers.get(channel, "") for channel in kind.channels) if drivers else ()
    constant_channels = [
        name
        for name in drivers.values()
        if np.ptp(windows.drivers[_effect_channel(drivers, name)]) == 0.0
    ]
    if constant_channels:
        verb = "does" if len(constant_channels) == 1 else "do"
        why = f"{' and '.join(constant_channels)} {verb} not change"
    many = {item.name for item in kind.parameters() if item.many}
    built = []
    for statistic, build in BUILDERS.items():
        variants = _distinct_variants(
            [
                one
                for values, prediction in predictions
                for one in build(values, prediction, blocks, coefficient)
            ]
        )
        variants = _weigh_by_time(variants, windows)
        if not variants:
            continue
        marks = (
            tuple(dict.fromkeys(mark for _, prediction in predictions for mark in prediction.marks))
            if statistic == "marks"
            else ()
        )
        each = statistic != "order" or bool(many & set(variants[0].columns))
        built.append(Candidate(kind.name, statistic, driver, variants, marks=marks, each=each))
    built += [
        replace(one, driver=driver)
        for one in _transfer_candidates(kind.name, predictions, windows, blocks)
    ]
    return built, why


def rebuild_variant(
    candidate: Candidate, variant: Variant, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Variant | None:
    """Rebuild a variant for other channels or parameter values; None if it vanishes."""
    kind = effects()[candidate.effect]
    drivers = {
        inner: name for inner, name in zip(kind.channels, candidate.driver, strict=False) if name
    }
    prediction = _predict_exogenous(kind.example(**variant.values), make_windows(blocks, drivers))
    built = BUILDERS[candidate.statistic](dict(variant.values), prediction, blocks, coefficient)
    return next(
        (one for one in built if one.columns == variant.columns and one.squared == variant.squared),
        None,
    )


def _effect_channel(drivers: Mapping[str, str], name: str) -> str:
    """Return the effect's name of a channel of the log."""
    return next(inner for inner, outer in drivers.items() if outer == name)


def _nuisance_grid(kind: type[Effect], windows: Windows) -> Iterator[dict[str, Any]]:
    """Yield values of the nuisance parameters and choices."""
    try:
        grid: dict[str, Sequence[Any]] = {
            name: select_step_times(values, windows)
            if name == _TIME_PARAMETER
            else _thin_out(values, _MAX_VALUES)
            for name, values in kind.example().nuisance(windows).items()
        }
    except KeyError:
        grid = {}
    grid |= {item.name: item.choices for item in kind.parameters() if item.choices}
    known = kind.example().points(windows)
    if known:
        yield from (dict(point) for point in known)
        return
    points = list(product(*grid.values()))
    most = max(_MAX_VARIANTS, len(grid.get(_TIME_PARAMETER, ())))
    for point in points[:: max(1, -(-len(points) // most))]:
        yield {
            name: value if isinstance(value, str) else float(value)
            for name, value in zip(grid, point, strict=True)
        }


def _thin_out(values: Array, most: int) -> list[Any]:
    """Select at most `most` values at equal steps."""
    every = max(1, -(-len(values) // most))
    return list(values[every // 2 :: every])


def _weigh_by_time(variants: tuple[Variant, ...], windows: Windows) -> tuple[Variant, ...]:
    """Weight variants by the prior probability of their time.

    Times at which power came back have the same total probability as all others, which have that of
    the interval they represent.
    """
    if not variants or not all(_TIME_PARAMETER in one.values for one in variants):
        return variants
    at = np.array([one.values[_TIME_PARAMETER] for one in variants])
    known = np.array([bool(np.isclose(power_on_times(windows), instant).any()) for instant in at])
    others, place = np.unique(at[~known], return_inverse=True)
    if others.size < 2:
        return variants
    weight = np.ones(at.size)
    span = np.gradient(others)[place]
    weight[~known] = span / span.mean()
    weight[known] = weight[~known].sum() / max(int(known.sum()), 1)
    return tuple(
        replace(one, weight=float(share)) for one, share in zip(variants, weight, strict=True)
    )


def _predict_exogenous(effect: Effect, windows: Windows) -> Prediction:
    """Predict an effect without those means of an axis that follow its own noisy reading."""
    full = effect.explain(windows)
    if not full.mean:
        return full
    shape = (len(windows.axes), windows.begin.size)
    mean = {
        name: np.array(np.broadcast_to(np.atleast_2d(values), shape))
        for name, values in full.mean.items()
    }
    nothing = np.full(windows.begin.size, np.nan)
    without_means = effect.explain(replace(windows, own=dict.fromkeys(windows.axes, nothing))).mean
    for name, values in mean.items():
        if name in without_means and np.isfinite(without_means[name]).all():
            continue
        for row, axis in enumerate(windows.axes):
            blind = replace(windows, own=dict(windows.own) | {axis: nothing})
            without_axis = np.broadcast_to(np.atleast_2d(effect.explain(blind).mean[name]), shape)[
                row
            ]
            if not np.array_equal(without_axis, values[row]):
                values[row] = 0.0
    return replace(full, mean=mean)


def _drop_hidden_means(
    name: str, prediction: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Prediction:
    """Drop predicted means that white noise hides on every axis even at the largest size.

    An axis at rest cannot leak into others: its noise, taken for motion, would only blur real
    motion.
    """
    if name not in LARGEST_SIZE or not prediction.mean:
        return prediction
    good = np.isfinite(blocks["mean"].transpose("axis", "block").values)
    white = coefficient.sel(term="N").values * np.sqrt(HOUR / float(blocks.attrs["block_s"]))
    mean = {}
    for column, design in prediction.mean.items():
        rows = np.where(good, np.broadcast_to(np.atleast_2d(design), good.shape), np.nan)
        moved = np.sqrt(np.nansum((rows - np.nanmean(rows, axis=1, keepdims=True)) ** 2, axis=1))
        if (LARGEST_SIZE[name] * moved > _MIN_SIZE_STDERRS * white).any():
            mean[column] = design
    return replace(prediction, mean=mean)


def _distinct_variants(variants: list[Variant]) -> tuple[Variant, ...]:
    """Drop variants with empty designs, or designs equal to others."""
    kept: list[Variant] = []
    known_designs: set[tuple[Any, ...]] = set()
    for one in variants:
        if one.design.size:
            size = np.abs(one.design).max(initial=0.0)
            if not (np.isfinite(size) and size > 0.0):
                continue
            mark: tuple[Any, ...] = (
                one.columns,
                one.time,
                np.round(one.design / size / _MAX_DESIGN_DIFFERENCE).tobytes(),
            )
        else:
            mark = (one.columns,)
        if mark not in known_designs:
            known_designs.add(mark)
            kept.append(one)
    return tuple(kept)


def _transfer_candidates(
    name: str,
    predictions: list[tuple[dict[str, Any], Prediction]],
    windows: Windows,
    blocks: xr.Dataset,
) -> list[Candidate]:
    """Build candidates of rates that follow another channel or axis at every frequency."""
    reference_channels = (
        {str(one) for one in blocks["reference"].values} if "reference" in blocks.dims else set()
    )
    axes = set(windows.axes) if "cross" in blocks else set()
    found: dict[str, list[Variant]] = {}
    for values, prediction in predictions:
        for (parameter, channel), transfer in prediction.transfer.items():
            if channel in reference_channels or channel in axes:
                found.setdefault(channel, []).append(
                    Variant(values, (parameter,), np.asarray(transfer)[None])
                )
    if found and effects()[name].stage == "motion":
        unknown_channels = [
            channel for channel in sorted(reference_channels) if not _is_known_channel(channel)
        ]
        for channel in [*found, *unknown_channels]:
            found[channel] = found.get(channel, []) + _any_transfer(windows.frequency.size)
    return [
        Candidate(name, "transfer", (), _distinct_variants(variants), reference=(channel,))
        for channel, variants in found.items()
    ]


def _motion_candidates(kind: type[Effect], blocks: xr.Dataset) -> list[Candidate]:
    """Build real motion that only channels of no known effect see, such as a seismometer."""
    if kind.name != "real_motion" or "reference" not in blocks.dims:
        return []
    variants = _distinct_variants(_any_transfer(blocks.sizes["band"]))
    unknown_channels = sorted(
        str(one) for one in blocks["reference"].values if not _is_known_channel(str(one))
    )
    return [
        Candidate(kind.name, "transfer", (), variants, reference=(channel,))
        for channel in unknown_channels
    ]


def _is_known_channel(channel: str) -> bool:
    """Return whether a channel drives a registered effect, or cannot show motion."""
    bases = {name for kind in effects().values() for name in kind.channels}
    return (
        any(
            channel == name or channel.startswith(name.rstrip("0123456789").rstrip("_") + "_")
            for name in bases
        )
        or channel == "pressure"
    )


def _any_transfer(bands: int) -> list[Variant]:
    """Return any factor in each band, and in all bands: a mounting may resonate."""
    alone = np.eye(bands, dtype=np.complex128)
    one = [Variant({}, ("any",) * 2, np.stack([row, 1j * row])) for row in alone]
    return [*one, Variant({}, ("any",) * (2 * bands), np.concatenate([alone, 1j * alone]))]

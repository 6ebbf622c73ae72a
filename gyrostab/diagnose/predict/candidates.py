"""What every effect of the registry predicts for a reduced record, over its nuisance grid: the designs that naming compares."""

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
from gyrostab.diagnose.predict.step_times import known_instants, tried_instants
from gyrostab.diagnose.reduce.block_statistics import measured
from gyrostab.errors import OptionError
from gyrostab.noise import HOUR
from gyrostab.physics.base import Effect
from gyrostab.physics.prediction import Prediction, Windows
from gyrostab.physics.registry import effects

__all__ = [
    "LARGEST",
    "STATISTIC_NAMES",
    "Candidate",
    "Variant",
    "channel_units",
    "effect_candidates",
    "variants_of",
    "windows_of",
]

Array = NDArray[Any]
#: Where an effect can show, in the order in which they are looked at.
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
_MOST_VALUES, _MOST_VARIANTS = 60, 200
#: Effect -> largest size that is plausible, of each of its parameters.
LARGEST = {"misalignment": 20.0, "earth_rate": 20.0}
_SEEN = 3.0  # standard errors that an effect of the largest size must have to be looked for
_INSTANT = "at"  # nuisance parameter that is an instant
_TWINS = {"fringe_hop": "bias_jump"}  # the same design: the size decides
_SAME = 1e-3  # designs that differ by less of their size are one


def channel_units(blocks: xr.Dataset) -> dict[str, str]:
    """Channel of the log -> its unit."""
    begin = "channel_"
    return {
        str(name)[len(begin) :]: str(blocks[name].attrs.get("units", ""))
        for name in blocks.data_vars
        if str(name).startswith(begin)
    }


def windows_of(blocks: xr.Dataset, drivers: Mapping[str, str]) -> Windows:
    """The reduced record as effects see it.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `reduce_log`.
    drivers : mapping of str to str
        Channel of the effect -> channel of the log.
    """
    axes = tuple(str(axis) for axis in blocks["axis"].values)
    own = dict(
        zip(
            axes,
            map(_bridged, measured(blocks, "mean").transpose("axis", "block").values),
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
            inner: _bridged(blocks[f"channel_{name}"].values) for inner, name in drivers.items()
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
            if (band := _band(blocks[f"channel_{name}"])) is not None
        },
    )


def _band(channel: xr.DataArray) -> tuple[float, float] | None:
    """Edges of the band [Hz] that a channel says it is the rms of; None where it says nothing that can be a band."""
    try:
        low, high = (float(edge) for edge in channel.attrs.get("band_hz", ()))
    except (TypeError, ValueError):
        return None
    return (low, high) if 0.0 <= low < high < np.inf else None


def _bridged(values: Array) -> Array:
    """Values with the missing ones on straight lines between their neighbours."""
    good = np.isfinite(values)
    if good.all() or not good.any():
        return np.asarray(values, np.float64)
    place = np.arange(values.size)
    return np.interp(place, place[good], values[good])


def effect_candidates(
    blocks: xr.Dataset, coefficient: xr.DataArray
) -> tuple[list[Candidate], dict[str, str]]:
    """All effects of the registry as far as this record can tell about them.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `reduce_log`.
    coefficient : xarray.DataArray
        ``(axis, term)``: noise of the baseline, in the units of the laws.

    Returns
    -------
    candidates : list of Candidate
    reasons : dict of str to str
        Effect -> why it cannot be seen in this record.

    Examples
    --------
    >>> from gyrostab.diagnose.reduce.block_statistics import reduce_log
    >>> from gyrostab.ingest.make_log import make_log
    >>> noise = 1.8 * np.random.default_rng(1).standard_normal((1, 60_000))
    >>> blocks = reduce_log(make_log(noise, rate=100.0, unit="deg/h"))
    >>> level = xr.DataArray([[0.003, 0.0]], {"axis": ["axis_0"], "term": ["N", "B"]}, ("axis", "term"))
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
        if name in _TWINS:
            continue
        made: list[Candidate] = []
        said = ""
        if _by_lattice(kind, blocks):
            reasons[name] = "not identifiable: the lattice of values is too coarse"
            continue
        for drivers in _drivers(kind, blocks, units):
            more, why = _of_kind(kind, blocks, drivers, coefficient)
            made += more
            said = said or why
        found += made
        if not made:
            reasons[name] = (
                f"not identifiable: {said or 'it leaves no trace in means, spectra and distribution of this record'}"
            )
    return found, reasons


def _by_lattice(kind: type[Effect], blocks: xr.Dataset) -> bool:
    """The effect is told by statistics that, on every axis of this record, are those of the lattice of values."""
    if kind.channels or not has_coarse_grid(blocks).all():
        return False
    marks = kind.example().explain(windows_of(blocks, {})).marks
    return bool(marks) and set(marks) <= set(GRID_COUNTS)


# -------------------------------------------------------------------------------------------------------------
# channels


def _drivers(
    kind: type[Effect], blocks: xr.Dataset, units: Mapping[str, str]
) -> Iterator[dict[str, str]]:
    """Channels of the effect -> channels of the log, in every way that makes sense."""
    options = [
        _matches(channel, unit, tuple(kind.channels), blocks, units) or [""]
        for channel, unit in kind.channels.items()
    ]
    seen = set()
    for chosen in product(*options):
        named = [name for name in chosen if name]
        if len(set(named)) < len(named) or frozenset(named) in seen:
            continue
        seen.add(frozenset(named))
        yield {channel: name for channel, name in zip(kind.channels, chosen, strict=True) if name}
    if not seen:
        yield {}


def _matches(
    channel: str,
    unit: str,
    channels: tuple[str, ...],
    blocks: xr.Dataset,
    units: Mapping[str, str],
) -> list[str]:
    """Channels of the log that can stand for one of the effect's: vectors by their name, others by the beginning of it."""
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


# --------------------------------------------------------------------------------------------------------------
# variants


def _of_kind(
    kind: type[Effect], blocks: xr.Dataset, drivers: dict[str, str], coefficient: xr.DataArray
) -> tuple[list[Candidate], str]:
    """Candidates of one effect with its channels, by view; and why there are none."""
    if kind.channels and not drivers:
        return _strangers(kind, blocks), missing_channel_reason(tuple(kind.channels), blocks)
    windows = windows_of(blocks, drivers)
    predictions: list[tuple[dict[str, Any], Prediction]] = []
    why = ""
    for values in _grid(kind, windows):
        try:
            effect = kind.example(**values)
            predictions.append(
                (values, _visible(kind.name, _exogenous(effect, windows), blocks, coefficient))
            )
        except KeyError as error:
            why = missing_channel_reason((str(error.args[0]),), blocks)
        except OptionError as error:
            why = str(error)
    driver = tuple(drivers.get(channel, "") for channel in kind.channels) if drivers else ()
    still = [
        name for name in drivers.values() if np.ptp(windows.drivers[_inner(drivers, name)]) == 0.0
    ]
    if still:
        why = f"{' and '.join(still)} {'does' if len(still) == 1 else 'do'} not change"
    many = {item.name for item in kind.parameters() if item.many}
    made = []
    for statistic, build in BUILDERS.items():
        variants = _distinct(
            [
                one
                for values, seen in predictions
                for one in build(values, seen, blocks, coefficient)
            ]
        )
        variants = _weighed(variants, windows)
        if not variants:
            continue
        marks = (
            tuple(dict.fromkeys(mark for _, seen in predictions for mark in seen.marks))
            if statistic == "marks"
            else ()
        )
        each = statistic != "order" or bool(many & set(variants[0].columns))
        made.append(Candidate(kind.name, statistic, driver, variants, marks=marks, each=each))
    made += [
        replace(one, driver=driver) for one in _transfers(kind.name, predictions, windows, blocks)
    ]
    return made, why


def variants_of(
    candidate: Candidate, variant: Variant, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Variant | None:
    """A variant of a candidate made anew, for other channels or other values of the same parameters; None where it is nothing."""
    kind = effects()[candidate.effect]
    drivers = {
        inner: name for inner, name in zip(kind.channels, candidate.driver, strict=False) if name
    }
    seen = _exogenous(kind.example(**variant.values), windows_of(blocks, drivers))
    made = BUILDERS[candidate.statistic](dict(variant.values), seen, blocks, coefficient)
    return next(
        (one for one in made if one.columns == variant.columns and one.squared == variant.squared),
        None,
    )


def _inner(drivers: Mapping[str, str], name: str) -> str:
    return next(inner for inner, outer in drivers.items() if outer == name)


def _grid(kind: type[Effect], windows: Windows) -> Iterator[dict[str, Any]]:
    """Values of the nuisance parameters, and of the words."""
    try:
        grid: dict[str, Sequence[Any]] = {
            name: tried_instants(values, windows)
            if name == _INSTANT
            else _thinned(values, _MOST_VALUES)
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
    most = max(_MOST_VARIANTS, len(grid.get(_INSTANT, ())))
    for point in points[:: max(1, -(-len(points) // most))]:
        yield {
            name: value if isinstance(value, str) else float(value)
            for name, value in zip(grid, point, strict=True)
        }


def _thinned(values: Array, most: int) -> list[Any]:
    """So many of the values at most."""
    every = max(1, -(-len(values) // most))
    return list(values[every // 2 :: every])


def _weighed(variants: tuple[Variant, ...], windows: Windows) -> tuple[Variant, ...]:
    """Variants with the chance of the instant at which something happens.

    It is as likely when power comes back as at all other times together, and at these as likely as
    the time that each stands for is long.
    """
    if not variants or not all(_INSTANT in one.values for one in variants):
        return variants
    at = np.array([one.values[_INSTANT] for one in variants])
    known = np.array([bool(np.isclose(known_instants(windows), instant).any()) for instant in at])
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


def _exogenous(effect: Effect, windows: Windows) -> Prediction:
    """What an effect predicts, without the means of an axis that come from the axis's own noisy reading."""
    whole = effect.explain(windows)
    if not whole.mean:
        return whole
    shape = (len(windows.axes), windows.begin.size)
    mean = {
        name: np.array(np.broadcast_to(np.atleast_2d(values), shape))
        for name, values in whole.mean.items()
    }
    nothing = np.full(windows.begin.size, np.nan)
    without_any = effect.explain(replace(windows, own=dict.fromkeys(windows.axes, nothing))).mean
    for name, values in mean.items():
        if name in without_any and np.isfinite(without_any[name]).all():
            continue
        for row, axis in enumerate(windows.axes):
            blind = replace(windows, own=dict(windows.own) | {axis: nothing})
            seen = np.broadcast_to(np.atleast_2d(effect.explain(blind).mean[name]), shape)[row]
            if not np.array_equal(seen, values[row]):
                values[row] = 0.0
    return replace(whole, mean=mean)


def _visible(
    name: str, seen: Prediction, blocks: xr.Dataset, coefficient: xr.DataArray
) -> Prediction:
    """What an effect predicts, without the means that white noise alone hides on every axis at the largest size there is.

    An axis at rest cannot leak into others: its noise, taken for a motion, would only blur what
    moves.
    """
    if name not in LARGEST or not seen.mean:
        return seen
    good = np.isfinite(blocks["mean"].transpose("axis", "block").values)
    white = coefficient.sel(term="N").values * np.sqrt(HOUR / float(blocks.attrs["block_s"]))
    mean = {}
    for column, design in seen.mean.items():
        rows = np.where(good, np.broadcast_to(np.atleast_2d(design), good.shape), np.nan)
        moved = np.sqrt(np.nansum((rows - np.nanmean(rows, axis=1, keepdims=True)) ** 2, axis=1))
        if (LARGEST[name] * moved > _SEEN * white).any():
            mean[column] = design
    return replace(seen, mean=mean)


def _distinct(variants: list[Variant]) -> tuple[Variant, ...]:
    """Variants without those whose designs another one has already, or are empty of anything."""
    kept: list[Variant] = []
    seen: set[tuple[Any, ...]] = set()
    for one in variants:
        if one.design.size:
            size = np.abs(one.design).max(initial=0.0)
            if not (np.isfinite(size) and size > 0.0):
                continue
            mark: tuple[Any, ...] = (
                one.columns,
                one.time,
                np.round(one.design / size / _SAME).tobytes(),
            )
        else:
            mark = (one.columns,)
        if mark not in seen:
            seen.add(mark)
            kept.append(one)
    return tuple(kept)


def _transfers(
    name: str,
    predictions: list[tuple[dict[str, Any], Prediction]],
    windows: Windows,
    blocks: xr.Dataset,
) -> list[Candidate]:
    """Rates that follow another channel, or another axis, at every frequency."""
    there = {str(one) for one in blocks["witness"].values} if "witness" in blocks.dims else set()
    axes = set(windows.axes) if "cross" in blocks else set()
    found: dict[str, list[Variant]] = {}
    for values, seen in predictions:
        for (parameter, channel), transfer in seen.transfer.items():
            if channel in there or channel in axes:
                found.setdefault(channel, []).append(
                    Variant(values, (parameter,), np.asarray(transfer)[None])
                )
    if found and effects()[name].stage == "motion":
        strange = [channel for channel in sorted(there) if not _known(channel)]
        for channel in [*found, *strange]:
            found[channel] = found.get(channel, []) + _any_transfer(windows.frequency.size)
    return [
        Candidate(name, "transfer", (), _distinct(variants), witness=(channel,))
        for channel, variants in found.items()
    ]


def _strangers(kind: type[Effect], blocks: xr.Dataset) -> list[Candidate]:
    """Real motion that only channels of no known effect see, a seismometer for instance."""
    if kind.name != "real_motion" or "witness" not in blocks.dims:
        return []
    variants = _distinct(_any_transfer(blocks.sizes["band"]))
    strange = sorted(str(one) for one in blocks["witness"].values if not _known(str(one)))
    return [
        Candidate(kind.name, "transfer", (), variants, witness=(channel,)) for channel in strange
    ]


def _known(channel: str) -> bool:
    """A channel drives some effect of the registry, or is known to be no motion."""
    bases = {name for kind in effects().values() for name in kind.channels}
    return (
        any(
            channel == name or channel.startswith(name.rstrip("0123456789").rstrip("_") + "_")
            for name in bases
        )
        or channel == "pressure"
    )


def _any_transfer(bands: int) -> list[Variant]:
    """Any factor in a band, and in every band: a mounting may resonate."""
    alone = np.eye(bands, dtype=np.complex128)
    one = [Variant({}, ("any",) * 2, np.stack([row, 1j * row])) for row in alone]
    return [*one, Variant({}, ("any",) * (2 * bands), np.concatenate([alone, 1j * alone]))]

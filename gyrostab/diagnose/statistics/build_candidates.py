"""Candidates: the predictions of every registered effect over its grid of nuisance parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.sample_counts import hidden_by_grid
from gyrostab.diagnose.predict.candidates import TIME_PARAMETER, Candidate, Prospect
from gyrostab.diagnose.predict.channel_use import MIN_BLOCK_SHARE, missing_channel_reason
from gyrostab.diagnose.predict.filter_response import with_band_response
from gyrostab.diagnose.predict.linear_model import with_correlated_powers
from gyrostab.diagnose.predict.windows import (
    channel_units,
    make_windows,
    predict_exogenous,
    select_step_times,
)
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics import STATISTICS
from gyrostab.errors import OptionError
from gyrostab.physics.base import Effect
from gyrostab.physics.prediction import Windows
from gyrostab.physics.registry import effects
from gyrostab.units import HOUR


def effect_candidates(
    blocks: xr.Dataset,
    coefficient: xr.DataArray,
    *,
    channel: str | None = None,
    settings: Settings = DEFAULTS,
) -> tuple[list[Candidate], dict[str, str]]:
    """Build the candidates of all registered effects that this record can show.

    The second result says why the others cannot be seen. The coefficients are the noise of the
    baseline ``(axis, term)``, in units of the noise model. With a `channel`, only candidates that
    follow this channel of the log are built.

    Examples
    --------
    >>> from gyrostab.diagnose.reduce.block_statistics import reduce_log
    >>> from gyrostab.ingest.make_log import make_log
    >>> noise = 1.8 * np.random.default_rng(1).standard_normal((1, 60_000))
    >>> blocks = reduce_log(make_log(noise, rate=100.0, unit="deg/h"))
    >>> coordinates = {"axis": ["axis_0"], "term": list("QNBKR")}
    >>> level = xr.DataArray([[0.0, 0.003, 0.0, 0.0, 0.0]], coordinates, ("axis", "term"))
    >>> candidates, reasons = effect_candidates(blocks, level)
    >>> reasons["shupe"]
    'not identifiable: the recording has no channel temperature'
    >>> sorted({candidate.effect for candidate in candidates if candidate.statistic.is_count})
    ['clipping', 'dead_zone', 'held_samples', 'rate_quantization', 'spikes']
    """
    units = channel_units(blocks)
    candidates: list[Candidate] = []
    reasons: dict[str, str] = {}
    for name, kind in effects().items():
        if channel is not None and not kind.channels:
            continue
        if other := kind.look_alikes("size"):
            form = effects()[other[0]].plain
            reasons[name] = f"not identifiable: it has the form of {form}; {kind.next_measurement}"
            continue
        built: list[Candidate] = []
        reason = ""
        if _is_hidden_by_grid(kind, blocks):
            reasons[name] = "not identifiable: the quantization grid is too coarse"
            continue
        for drivers in _driver_assignments(kind, blocks, units):
            if channel is not None and channel not in drivers.values():
                continue
            added, obstacle = _candidates_of_effect(kind, blocks, drivers, coefficient, settings)
            built += added
            reason = reason or obstacle
        candidates += built
        if not built:
            obstacle = (
                reason or "it leaves no trace in means, spectra and distribution of this record"
            )
            reasons[name] = f"not identifiable: {obstacle}"
    return candidates, reasons


def _is_hidden_by_grid(kind: type[Effect], blocks: xr.Dataset) -> bool:
    """Return whether a coarse quantization grid hides every statistic of the effect on all axes."""
    if kind.channels:
        return False
    marks = kind.example().explain(make_windows(blocks, {})).marks
    return bool(marks) and all(hidden_by_grid(blocks, mark).all() for mark in marks)


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
    channel: str, unit: str, channels: tuple[str, ...], blocks: xr.Dataset, units: Mapping[str, str]
) -> list[str]:
    """Return channels of the log for one of the effect's: vectors by name, others by prefix."""
    if sum(name[:-1] == channel[:-1] for name in channels) > 1 and channel[-1] in "xyz":
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
        and np.isfinite(blocks.variables[f"channel_{name}"].values).mean() >= MIN_BLOCK_SHARE
    ]


# -------------------------------------------------------------------------------
# variants


def _candidates_of_effect(
    kind: type[Effect],
    blocks: xr.Dataset,
    drivers: dict[str, str],
    coefficient: xr.DataArray,
    settings: Settings,
) -> tuple[list[Candidate], str]:
    """Build the candidates of an effect with its channels, by statistic; or say why not."""
    windows = make_windows(blocks, drivers)
    prospects: list[Prospect] = []
    is_missing = bool(kind.channels) and not drivers
    obstacle = missing_channel_reason(tuple(kind.channels), blocks) if is_missing else ""
    for values in [] if is_missing else list(_nuisance_grid(kind, windows)):
        try:
            effect = kind.example(**values)
            in_windows = with_correlated_powers(predict_exogenous(effect, windows), blocks)
            prospect = Prospect(
                values, with_band_response(in_windows, effect, blocks), blocks, coefficient
            )
            prospects.append(_drop_hidden_means(kind.name, prospect, settings))
        except KeyError as error:
            obstacle = missing_channel_reason((str(error.args[0]),), blocks)
        except OptionError as error:
            obstacle = str(error)
    driver = tuple(drivers.get(channel, "") for channel in kind.channels) if drivers else ()
    constant_channels = [
        name for channel, name in drivers.items() if np.ptp(windows.drivers[channel]) == 0.0
    ]
    if constant_channels:
        verb = "does" if len(constant_channels) == 1 else "do"
        obstacle = f"{' and '.join(constant_channels)} {verb} not change"
    built = [
        candidate
        for statistic in STATISTICS
        for candidate in statistic.candidates(kind, driver, prospects, windows, blocks)
    ]
    return built, obstacle


def _nuisance_grid(kind: type[Effect], windows: Windows) -> Iterator[dict[str, Any]]:
    """Yield values of the nuisance parameters and choices."""
    try:
        grid: dict[str, Sequence[Any]] = {
            name: select_step_times(values, windows) if name == TIME_PARAMETER else list(values)
            for name, values in kind.example().nuisance(windows).items()
        }
    except KeyError:
        grid = {}
    grid |= {item.name: item.choices for item in kind.parameters() if item.choices}
    known_points = kind.example().points(windows)
    if known_points:
        yield from (dict(point) for point in known_points)
        return
    for point in product(*grid.values()):
        yield {
            name: value if isinstance(value, str) else float(value)
            for name, value in zip(grid, point, strict=True)
        }


def largest_size(effect: str, settings: Settings) -> float:
    """Return the largest size that hides in noise or is plausible, infinite for most effects."""
    rates = (item.high for item in effects()["earth_rate"].parameters() if item.name == "rate")
    return {
        "misalignment": 1e3 * settings.max_misalignment_share,  # mrad
        "earth_rate": next(rates),
    }.get(effect, math.inf)


def _drop_hidden_means(name: str, prospect: Prospect, settings: Settings) -> Prospect:
    """Drop predicted means that white noise hides on every axis even at the largest size.

    An axis at rest cannot leak into others: its noise, taken for motion, would only blur real
    motion.
    """
    largest = largest_size(name, settings)
    if math.isinf(largest) or not prospect.prediction.mean:
        return prospect
    good = np.isfinite(prospect.blocks["mean"].values)
    block_s = float(prospect.blocks.attrs["block_s"])
    white = prospect.coefficient.sel(term="N").values * np.sqrt(HOUR / block_s)
    mean = {}
    for column, design in prospect.prediction.mean.items():
        rows = np.where(good, np.broadcast_to(np.atleast_2d(design), good.shape), np.nan)
        moved = np.sqrt(np.nansum((rows - np.nanmean(rows, axis=1, keepdims=True)) ** 2, axis=1))
        if (largest * moved > settings.clear_sigma * white).any():
            mean[column] = design
    return prospect._replace(prediction=replace(prospect.prediction, mean=mean))

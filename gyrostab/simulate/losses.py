"""Gap tables of a simulated log (lost telemetry, lost power), in seconds since the start."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.errors import OptionError
from gyrostab.ingest.gap_table import gap_variables
from gyrostab.schema import GAP_CAUSES
from gyrostab.simulate.channels import MAX_DURATION_S, Points, check_points
from gyrostab.simulate.noise import stream
from gyrostab.time.durations import duration_seconds
from gyrostab.time.stamps import stamp_ns
from gyrostab.units import HOUR

_MISSING, _RESTART = (GAP_CAUSES.index(name) for name in ("missing", "restart"))


def _make_table(spans: Floats, cause: int, duration: Any, start: Any) -> xr.Dataset:
    """Make gaps from seconds within the log; they are cut to samples when the log is made."""
    inside = np.clip(spans.reshape(-1, 2), 0.0, duration_seconds(duration, "duration"))
    edges = np.rint(inside * 1e9).astype(np.int64)
    unknown = np.zeros((len(edges), 2), np.int64)  # samples and rows
    table = np.column_stack([edges, unknown, np.full(len(edges), cause)])
    variables = gap_variables(table, stamp_ns(start), rate=1e9)
    return xr.Dataset({name: variables[name] for name in ("gap_start", "gap_end", "gap_cause")})


def gaps(spans: Points, *, duration: Any = MAX_DURATION_S, start: Any = "1970-01-01") -> xr.Dataset:
    """Make gaps at given times.

    Parameters
    ----------
    spans : list of (from, to)
        First missing instant and first one there again [s]; Wang et al. 2016: [[432, 450]].
    duration : str or float
        Length of the log, to which gaps are cut; by default the longest that a log may have.
    start : str
        Time of its first sample.

    Examples
    --------
    >>> gaps([[432, 450]]).gap_end.values
    array(['1970-01-01T00:07:30.000000000'], dtype='datetime64[ns]')
    """
    return _make_table(_check_spans(spans, "spans of gaps"), _MISSING, duration, start)


def _check_spans(spans: Points, where: str, *, optional: bool = False) -> Floats:
    table = check_points(spans, where, ("from [s]", "to [s]"), optional=optional)
    if np.any(table[:, 1] <= table[:, 0]):
        raise OptionError(f"{where}: {table.tolist()}: each must end after it begins")
    return table


def losses(
    *,
    duration: Any,
    start: Any = "1970-01-01",
    seed: int = 0,
    per_hour: float = 6.0,
    mean: Any = 2.0,
    bursts_per_hour: float = 0.5,
    burst: Any = 120.0,
    within: float = 20.0,
) -> xr.Dataset:
    """Draw data losses of mud-pulse telemetry: single frames, and bursts of frames.

    Parameters
    ----------
    duration : str or float
        Length of the log.
    start : str
        Time of its first sample.
    seed : int
        Seed of the places.
    per_hour : float
        Losses in an hour of good reception [h-1].
    mean : str or float
        Mean length of a loss, exponentially distributed [s].
    bursts_per_hour : float
        Spells of bad reception in an hour [h-1].
    burst : str or float
        Mean length of such a spell, exponentially distributed [s].
    within : float
        How many times as many losses there are in such a spell, at least 1 [1].

    Examples
    --------
    >>> lost = losses(duration="200h", per_hour=6.0, bursts_per_hour=0.0, seed=1)
    >>> bool(abs(lost.sizes["gap"] - 1200) < 120)
    True
    """
    seconds, length, spell = (duration_seconds(value, "time") for value in (duration, mean, burst))
    for name, value in {
        "per_hour": per_hour,
        "bursts_per_hour": bursts_per_hour,
        "within": within,
    }.items():
        least = 1 if name == "within" else 0
        if not value >= least:
            raise OptionError(f"losses: {name}={value!r} must not be below {least}")
    rng = stream(seed, "losses")
    good = _draw_poisson(rng, 0.0, seconds, per_hour)
    bad = [
        _draw_poisson(rng, begin, begin + rng.exponential(spell), per_hour * (within - 1.0))
        for begin in _draw_poisson(rng, 0.0, seconds, bursts_per_hour)
    ]
    begin = np.sort(np.concatenate([good, *bad]))
    spans = np.stack([begin, begin + rng.exponential(length, begin.size)], axis=1)
    return _make_table(spans, _MISSING, duration, start)


def _draw_poisson(rng: np.random.Generator, begin: float, end: float, per_hour: float) -> Floats:
    if not 0.0 <= per_hour * (end - begin) <= 1e8:
        raise OptionError(
            f"{per_hour:g} gaps in an hour: give a number from 0 up, for at most 1e8 gaps in all"
        )
    return np.sort(rng.uniform(begin, end, rng.poisson(per_hour * (end - begin) / HOUR)))


def power_cuts(
    cuts: Points = (),
    *,
    duration: Any,
    start: Any = "1970-01-01",
    seed: int = 0,
    per_day: float = 0.0,
    mean: Any = 60.0,
) -> xr.Dataset:
    """Draw losses of power, after which the gyro restarts (warm-up, bias jumps).

    Parameters
    ----------
    cuts : list of (from, to)
        Given times without power [s].
    per_day : float
        More of them at random, in a day [d-1].
    mean : str or float
        Mean length of those, exponentially distributed [s].
    duration, start, seed
        As for `losses`.

    Examples
    --------
    >>> power_cuts([[100, 160]], duration="1h").gap_cause.values
    array([6], dtype=int8)
    """
    table = _check_spans(cuts, "cuts of power_cuts", optional=True)
    rng = stream(seed, "power_cuts")
    begin = _draw_poisson(rng, 0.0, duration_seconds(duration, "duration"), per_day / 24.0)
    more = np.stack(
        [begin, begin + rng.exponential(duration_seconds(mean, "mean"), begin.size)], axis=1
    )
    return _make_table(np.concatenate([table, more]), _RESTART, duration, start)

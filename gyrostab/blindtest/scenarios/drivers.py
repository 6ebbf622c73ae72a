"""Take the driving channel away, or make it lie: withheld, replaced by a look-alike, late, noisy, clipped, or moving with another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import OptionError

__all__ = ["sever"]

Array = NDArray[np.float64]
Channels = dict[str, tuple[Array, float]]


def _late(values: Array, steps: int) -> Array:
    return np.concatenate([np.full(steps, values[0]), values[:-steps]]) if steps else values


def _stand_in(driver: str, values: Array, rng: np.random.Generator) -> tuple[str, Array]:
    """Another channel that has effects of its own and moves as `values` do, with some wander of its own."""
    own = np.cumsum(rng.standard_normal(values.size))
    parts = [(part - part.mean()) / (float(part.std()) or 1.0) for part in (values, own)]
    motion = parts[0] + 0.3 * parts[1]
    if driver == "supply_voltage":
        return "light_power", np.asarray(1e-5 * (1 + 0.01 * motion))
    return "supply_voltage", np.asarray(28.0 + 0.3 * motion)


def sever(channels: Channels, driver: str, *, how: str, rng: np.random.Generator) -> Channels:
    """Channels with the driver of an effect cut off.

    Parameters
    ----------
    channels : dict
        Name to values and rate [Hz].
    driver : str
        The channel that drives the effect.
    how : {"withheld", "decoy", "lagged", "confounded", "noisy", "clipped"}
        Left out; left out, with a channel of the same manner at other times; late by 30 to 180 s;
        joined by another channel that moves with it; noisy by its own standard deviation; clipped
        at the upper half of its range.
    rng : numpy.random.Generator

    Raises
    ------
    OptionError
        When `how` is none of these.

    Examples
    --------
    >>> channels = {"temperature": (np.arange(100.0), 1.0)}
    >>> sorted(sever(channels, "temperature", how="confounded", rng=np.random.default_rng(0)))
    ['supply_voltage', 'temperature']
    """
    left = dict(channels)
    values, rate = left.get(driver, (np.zeros(0), 1.0))
    if how == "withheld" or how == "decoy":
        left.pop(driver, None)
        if driver == "rotation_rate":
            left = {
                name: channel for name, channel in left.items() if not name.startswith("accel_")
            }
        if how == "decoy" and values.size:
            name, like = _stand_in(
                driver, np.roll(values[::-1], int(rng.integers(values.size))), rng
            )
            left[name] = (like, rate)
    elif how == "lagged":
        left[driver] = (
            _late(values, min(round(rng.uniform(30, 180) * rate), values.size // 4)),
            rate,
        )
    elif how == "confounded":
        name, like = _stand_in(driver, values, rng)
        left[name] = (like, rate)
    elif how == "noisy":
        left[driver] = (values + rng.normal(0.0, float(values.std()), values.size), rate)
    elif how == "clipped":
        left[driver] = (np.minimum(values, 0.5 * (values.min() + values.max())), rate)
    else:
        raise OptionError(
            f"how={how!r}: give 'withheld', 'decoy', 'lagged', 'confounded', 'noisy' or 'clipped'"
        )
    return left

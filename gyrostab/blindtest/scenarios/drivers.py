"""Degrade the driving channel of an effect: withhold, substitute, delay, confound or distort it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Channels = dict[str, tuple[Array, float]]


def _delay_values(values: Array, steps: int) -> Array:
    return np.concatenate([np.full(steps, values[0]), values[:-steps]]) if steps else values


def _make_substitute(driver: str, values: Array, rng: np.random.Generator) -> tuple[str, Array]:
    """Make a channel of another name that moves like `values`, with some independent wander."""
    wander = np.cumsum(rng.standard_normal(values.size))
    parts = [(part - part.mean()) / (float(part.std()) or 1.0) for part in (values, wander)]
    motion = parts[0] + 0.3 * parts[1]
    if driver == "supply_voltage":
        return "light_power", np.asarray(1e-5 * (1 + 0.01 * motion))
    return "supply_voltage", np.asarray(28.0 + 0.3 * motion)


def degrade_driver(
    channels: Channels, driver: str, *, how: str, rng: np.random.Generator
) -> Channels:
    """Degrade the channel that drives an effect.

    It is "withheld", "substituted" by a similar channel with other times, "lagged" by 30 to 180 s,
    "confounded" with another channel that moves with it, "noisy" by its standard deviation, or
    "clipped" at the middle of its range.

    Examples
    --------
    >>> channels = {"temperature": (np.arange(100.0), 1.0)}
    >>> rng = np.random.default_rng(0)
    >>> sorted(degrade_driver(channels, "temperature", how="confounded", rng=rng))
    ['supply_voltage', 'temperature']
    """
    remaining = dict(channels)
    values, rate = remaining.get(driver, (np.zeros(0), 1.0))
    if how == "withheld" or how == "substituted":
        remaining.pop(driver, None)
        if driver == "rotation_rate":
            remaining = {
                name: channel
                for name, channel in remaining.items()
                if not name.startswith("accel_")
            }
        if how == "substituted" and values.size:
            name, like = _make_substitute(
                driver, np.roll(values[::-1], int(rng.integers(values.size))), rng
            )
            remaining[name] = (like, rate)
    elif how == "lagged":
        remaining[driver] = (
            _delay_values(values, min(round(rng.uniform(30, 180) * rate), values.size // 4)),
            rate,
        )
    elif how == "confounded":
        name, like = _make_substitute(driver, values, rng)
        remaining[name] = (like, rate)
    elif how == "noisy":
        remaining[driver] = (values + rng.normal(0.0, float(values.std()), values.size), rate)
    else:  # clipped
        remaining[driver] = (np.minimum(values, 0.5 * (values.min() + values.max())), rate)
    return remaining

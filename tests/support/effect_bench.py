"""Run a single effect on plain arrays in arbitrary chunks, for the tests of the effects."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from gyrostab.allan.davar import davar
from gyrostab.arrays import Floats, Ints
from gyrostab.ingest.make_log import make_log
from gyrostab.physics.base import Chunk, Effect, Setup, Windows
from gyrostab.physics.registry import make_effect


def build_effect(name: str, **parameters: Any) -> Effect:
    """Make an effect as from its table in a model."""
    return make_effect({"name": name, **parameters})


def switch_off(effect: Effect) -> Effect:
    """Make the same effect with zero size."""
    many = {item.name for item in effect.parameters() if item.many}
    zeros = {
        name: (0.0,) * len(getattr(effect, name)) if name in many else 0.0
        for name in effect.size_parameters
    }
    return replace(effect, **zeros)


def run(
    effect: Effect,
    *,
    size: int,
    rate: float = 10.0,
    axes: Sequence[str] = ("x", "y", "z"),
    drivers: Mapping[str, Any] | None = None,
    true: Mapping[str, Any] | None = None,
    signal: Any = None,
    noise: Mapping[str, Any] | None = None,
    cuts: Sequence[int] = (),
    seed: int = 1,
    **setup: Any,
) -> Any:
    """What `effect` does to `size` samples, cut before the samples `cuts`.

    Returns
    -------
    ndarray, shape (axes, size)
        Contribution or signal; for the stage "noise" a dict of squared coefficients by symbol.
    """
    names = tuple(axis for axis in axes if not effect.axes or axis in effect.axes)
    coefficients = {
        symbol: np.broadcast_to(value, len(names)).astype(float)
        for symbol, value in (noise or {}).items()
    }
    frame = Setup(rate=rate, size=size, axes=names, noise=coefficients, **setup)
    state = effect.begin(frame, np.random.default_rng(seed))
    given = {
        name: np.broadcast_to(np.asarray(values, float), size)
        for name, values in (drivers or {}).items()
    }
    motion = {
        axis: np.broadcast_to(np.asarray((true or {}).get(axis, 0.0), float), size) for axis in axes
    }
    before = (
        np.zeros((len(names), size))
        if signal is None
        else np.broadcast_to(np.asarray(signal, float), (len(names), size))
    )
    parts = []
    edges = [0, *cuts, size]
    for first, end in itertools.pairwise(edges):
        span = slice(first, end)
        chunk = Chunk(
            setup=frame,
            first=first,
            size=end - first,
            drivers={name: values[span] for name, values in given.items()},
            true={axis: values[span] for axis, values in motion.items()},
            signal=before[:, span].copy(),
            level={
                symbol: np.repeat(value[:, None] ** 2, end - first, axis=1)
                for symbol, value in coefficients.items()
            },
        )
        values, state = effect.generate(chunk, copy.deepcopy(state))
        parts.append(
            values
            if effect.stage == "noise"
            else np.broadcast_to(values, (len(names), np.shape(values)[-1]))
        )
    if effect.stage == "noise":
        return {
            symbol: np.concatenate(
                [
                    np.broadcast_to(part[symbol], (len(names), np.shape(part[symbol])[-1]))
                    for part in parts
                ],
                axis=1,
            )
            for symbol in parts[0]
        }
    return np.concatenate(parts, axis=1)


def same_whatever_the_cuts(effect: Effect, cuts: Sequence[int], **options: Any) -> None:
    """Assert that cutting the time into chunks changes nothing, not even the last bit."""
    whole, cut = run(effect, **options), run(effect, cuts=sorted(cuts), **options)
    if isinstance(whole, dict):
        assert whole.keys() == cut.keys()
        for symbol in whole:
            np.testing.assert_array_equal(cut[symbol], whole[symbol])
    else:
        np.testing.assert_array_equal(cut, whole)


def random_cuts(seed: int, size: int, pieces: int = 5) -> list[int]:
    """Some places to cut, also single samples apart."""
    rng = np.random.default_rng(seed)
    places: Ints = np.unique(
        np.concatenate([rng.integers(1, size, pieces), [1, size // 2, size // 2 + 1]])
    )
    return [int(place) for place in places if 0 < place < size]


def avar(rates: Any, rate: float, taus: Sequence[float]) -> Floats:
    """Allan variance of every row over the whole record."""
    log = make_log(np.atleast_2d(rates), rate=rate, unit="deg/h")
    return (
        davar(
            log,
            window=f"{log.sizes['time']}samples",
            taus=[float(tau) for tau in taus],
            tau_max=float(max(taus)),
        )
        .avar.isel(time=0)
        .values
    )


def sigma(rates: Any, rate: float, taus: Sequence[float]) -> Floats:
    """Allan deviation of every row over the whole record."""
    return np.sqrt(avar(rates, rate, taus))


def markov_avar(tau: Any, rms: float, time: float) -> Floats:
    """Allan variance of a Gauss-Markov process, IEEE Std 952, annex C, with q^2 = 2 rms^2 / T_c."""
    x = np.asarray(tau, float) / time
    exact = 2.0 / x * (1.0 - (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)) / (2.0 * x))
    return rms**2 * np.where(x < 1e-3, 2.0 * x / 3.0 * (1.0 - 0.75 * x), exact)


def sinusoid_avar(tau: Any, amplitude: float, frequency: float) -> Floats:
    """Allan variance of a sinusoid, IEEE Std 952, annex C."""
    x = np.pi * frequency * np.asarray(tau, float)
    return amplitude**2 * np.sin(x) ** 4 / x**2


def allan_of_density(density: Callable[[Floats], Any], tau: float, top: float) -> float:
    """Integrate the Allan variance of a two-sided density (P16 Eq. 7) up to `top` [Hz]."""
    f = np.linspace(top / 400_000, top, 400_000)
    return float(
        4.0 * np.trapezoid(density(f) * np.sin(np.pi * f * tau) ** 4 / (np.pi * f * tau) ** 2, f)
    )


def allan_of_samples(density: Callable[[Floats], Any], k: int, rate: float) -> float:
    """Compute the Allan variance of samples with a two-sided density at k samples."""
    f = (np.arange(200_000) + 0.5) * (rate / 2) / 200_000
    x = np.pi * f / rate
    return float(
        4.0 * np.sum(density(f) * np.sin(k * x) ** 4 / (k * np.sin(x)) ** 2) * (f[1] - f[0])
    )


def steady(channel: str, unit: str, value: float) -> dict[str, Any]:
    """Environment of a model: a channel that never changes."""
    return {"profile": "steps", "channel": channel, "unit": unit, "points": [[0, value]]}


def windows_of(
    size: int, rate: float, length: float, frequency: Any = (1.0,), **more: Any
) -> Windows:
    """Windows of `length` [s] one after the other."""
    edges = np.arange(0.0, size / rate + 1e-9, length)
    return Windows(
        edges[:-1], edges[1:], np.asarray(frequency, float), rate, more.pop("axes", ("x",)), **more
    )


def means_and_prediction(
    effect: Effect,
    *,
    rate: float,
    length: int,
    drivers: Mapping[str, Any],
    own: Mapping[str, Any] | None = None,
    true: Mapping[str, Any] | None = None,
) -> tuple[Any, Any, Any]:
    """Means over windows of `length` samples: of what the effect adds, as predicted, per unit.

    `own` is the signal of the axes before the effect.
    """

    def reduce(channels: Mapping[str, Any]) -> dict[str, Any]:
        blocks = {name: np.reshape(values, (-1, length)) for name, values in channels.items()}
        return {
            name: np.sqrt((rows**2).mean(axis=1)) if name == "vibration" else rows.mean(axis=1)
            for name, rows in blocks.items()
        }

    own = own or {}
    size = len(next(iter(drivers.values())))
    signal = np.stack(list(own.values())) if own else 0.0
    added = run(effect, size=size, rate=rate, drivers=drivers, true=true, signal=signal)
    added = added - signal if effect.stage not in ("motion", "rate") else added
    windows = windows_of(
        size, rate, length / rate, axes=("x", "y", "z"), drivers=reduce(drivers), own=reduce(own)
    )
    means, design = added.reshape(3, -1, length).mean(axis=2), effect.explain(windows).mean
    predicted = sum(
        np.broadcast_to(values, means.shape) * np.reshape(getattr(effect, name), (-1, 1))
        for name, values in design.items()
    )
    return means, predicted, design


def band_powers(rates: Any, rate: float, edges: Any) -> Floats:
    """Mean two-sided density between edges [Hz], of the mean periodogram of the rows."""
    rows = np.atleast_2d(rates)
    power = (np.abs(np.fft.rfft(rows, axis=1)) ** 2 / rows.shape[1] / rate).mean(axis=0)
    f = np.fft.rfftfreq(rows.shape[1], 1 / rate)
    return np.array([power[(f > low) & (f < high)].mean() for low, high in pairwise(edges)])


def said_density(
    effect: Effect, rate: float, edges: Any, parameter: str, axes: Sequence[str] = ("x",)
) -> Floats:
    """The same as `band_powers` of the density that the effect says, by fine bands."""
    fine = [np.linspace(low, high, 60)[1:-1] for low, high in pairwise(edges)]
    return np.array(
        [
            effect.explain(windows_of(100, rate, 10.0 / rate, f, axes=axes))
            .spectrum[parameter][0]
            .mean()
            for f in fine
        ]
    )

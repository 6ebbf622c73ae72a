"""Noise of a gyro axis: Q, N, B, K, R of the noise table, and Gauss-Markov and sinusoidal parts.

Every term of every axis has a separate stream of random numbers, which depends on the seed, the
axis and the term and on nothing else. A term therefore stays the same whatever the other terms, the
effects, the length and the chunks are.
"""

from __future__ import annotations

import copy
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.errors import OptionError
from gyrostab.kernels.random.stochastic import (
    brownian_means,
    flicker_means,
    flicker_times,
    ornstein_uhlenbeck_means,
)
from gyrostab.noise import TERMS, URAD_PER_S
from gyrostab.physics.phase import turn_means
from gyrostab.units import HOUR

#: Lowest frequency of flicker noise [Hz] unless a model says otherwise: flat within 0.2 % to
#: averaging times of 20 h.
FLICKER_LOW = 5e-9
#: Lowest frequency that flicker noise may have [Hz], far below that of any log: at most 64
#: processes then make it, up to the highest sampling rates.
FLICKER_LOWEST = 1e-30
#: Samples of a block.
CHUNK = 2**18
_PIECE = 2**13


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Random numbers that belong to a seed and some names."""
    is_integer = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not (is_integer and 0 <= seed < 2**63):  # files hold it as an integer of 64 bits
        raise OptionError(f"seed={seed!r}: give a whole number from 0 to 2**63 - 1")
    return np.random.default_rng([seed, *(zlib.crc32(str(name).encode()) for name in names)])


@dataclass
class NoiseState:
    """Where the random numbers of one axis are."""

    rate: float
    streams: dict[str, np.random.Generator]
    times: Floats
    endless: bool
    flicker: Floats
    angle: float = 0.0
    walk: float = 0.0


@dataclass(frozen=True)
class Units:
    """Random numbers of unit strength for a span of samples, before scaling."""

    first: int
    size: int
    values: Mapping[str, Any] = field(default_factory=dict)


def begin_noise(
    seed: int,
    axis: str,
    *,
    rate: float,
    terms: str = "QNBK",
    flicker_band: tuple[float, float] = (FLICKER_LOW, math.inf),
) -> NoiseState:
    """Make the state of the noise of one axis before its first sample.

    Parameters
    ----------
    rate : float
        Sampling rate [Hz].
    terms : str
        Terms that will be asked for, of QNBK.
    flicker_band : tuple of float
        Lowest and highest frequency of B [Hz].
    """
    streams = {term: stream(seed, "noise", axis, term) for term in "QNBK" if term in terms}
    low, high = flicker_band
    if not FLICKER_LOWEST <= low < high:
        problem = "is empty" if low >= high else f"begins below {FLICKER_LOWEST:g} Hz"
        raise OptionError(
            f"the band of flicker noise {low:g} to {high:g} Hz {problem}; "
            f"give the lower frequency, from {FLICKER_LOWEST:g} Hz up, and the higher one"
        )
    times = flicker_times(rate, low=low, high=high)
    position = (
        streams["B"].standard_normal(64)[: times.size] if "B" in streams else np.zeros(times.size)
    )
    state = NoiseState(
        rate=rate, streams=streams, times=times, endless=math.isinf(high), flicker=position
    )
    if "Q" in streams:
        state.angle = float(_draw_uniform(streams["Q"], 1)[0])
    return state


def _draw_uniform(rng: np.random.Generator, size: int) -> Floats:
    """Rounding errors of unit variance."""
    return math.sqrt(12.0) * (rng.random(size) - 0.5)


def draw(state: NoiseState, first: int, size: int) -> tuple[Units, NoiseState]:
    """Draw the numbers of the next `size` samples; `state` is left as it was."""
    state = copy.deepcopy(state)
    values: dict[str, Any] = {}
    for term, rng in state.streams.items():
        if term == "Q":
            angle = np.concatenate([[state.angle], _draw_uniform(rng, size)])
            state.angle = float(angle[-1])
            values[term] = angle
        elif term == "N":
            values[term] = rng.standard_normal(size)
        elif term == "B":
            values[term] = _draw_flicker(state, rng, size)
        else:
            values[term] = rng.standard_normal((size, 2))
    return Units(first, size, values), state


def _draw_flicker(state: NoiseState, rng: np.random.Generator, size: int) -> Floats:
    """Flicker noise of unit strength, in pieces that stay in the processor's cache."""
    means = np.empty(size)
    for first in range(0, size, _PIECE):
        part = means[first : first + _PIECE]
        normal = rng.standard_normal((part.size, state.times.size + 1))
        part[:], state.flicker = flicker_means(
            normal, state.times, state.rate, state.flicker, endless=state.endless
        )
    return means


def shape(
    units: Units,
    level: Mapping[str, Any],
    rate: float,
    carry: Mapping[str, float],
    *,
    ramp: float = 0.0,
) -> tuple[Floats, dict[str, float]]:
    """Scale the random numbers to their level.

    Parameters
    ----------
    units : Units
        From `draw`.
    level : mapping of str to float or ndarray, shape (n,)
        Squared coefficients by symbol [unit of the noise table].
    rate : float
        Sampling rate [Hz].
    carry : mapping
        What the stretch before left behind; empty at the start.
    ramp : float
        R [deg/h^2]; zero at the first sample's start.

    Returns
    -------
    rate : ndarray, shape (n,)
        Rate [degree hour-1].
    carry : dict
        To be given to the next call.
    """
    total: Floats = np.asarray(
        ramp * (units.first + 0.5 + np.arange(units.size)) / (HOUR * rate), dtype=np.float64
    )
    new_carry = dict(carry)
    for term, values in units.values.items():
        strength = np.sqrt(np.broadcast_to(level[term], units.size))
        if term == "Q":
            angle = values * np.concatenate([[new_carry.get("Q", strength[0])], strength])
            new_carry["Q"] = float(strength[-1])
            total += np.diff(angle) * (URAD_PER_S * rate)
        elif term == "N":
            total += strength * math.sqrt(HOUR * rate) * values
        elif term == "B":
            total += strength * values
        else:
            steps, inner = values.T * (strength / math.sqrt(HOUR * rate))
            walk, new_carry["K"] = brownian_means(steps, inner, new_carry.get("K", 0.0))
            total += walk
    return total, new_carry


def make_noise(
    *,
    rate: float,
    size: int,
    seed: int = 0,
    axis: str = "x",
    Q: float = 0.0,
    N: float = 0.0,
    B: float = 0.0,
    K: float = 0.0,
    R: float = 0.0,
    gauss_markov: tuple[float, float] | None = None,
    sinusoid: tuple[float, float, float] | None = None,
    flicker_band: tuple[float, float] = (FLICKER_LOW, math.inf),
    chunk: int = CHUNK,
) -> Floats:
    """Make the noise of one gyro axis; each sample is the mean rate over its interval.

    The Allan variance is exactly that of the noise table at every averaging time: quantization
    noise is white in the angle, random walk and Gauss-Markov noise are continuous processes
    averaged over each sample, flicker noise is a sum of such processes.

    Parameters
    ----------
    rate : float
        Sampling rate [Hz].
    size : int
        Number of samples.
    seed : int
        The same seed gives the same noise, whatever the chunks; more samples go on where fewer end.
    axis : str
        Name of the axis; each has its own noise.
    Q, N, B, K, R : float
        Coefficients [urad, deg/sqrt(h), deg/h, deg/h^1.5, deg/h^2]. R is the ramp R t.
    gauss_markov : (float, float), optional
        Standard deviation [deg/h] and correlation time [s].
    sinusoid : (float, float, float), optional
        Amplitude [deg/h], frequency [Hz] and phase [rad].
    flicker_band : (float, float)
        Lowest and highest frequency of B [Hz].
    chunk : int
        Samples made at a time; the result does not depend on it.

    Returns
    -------
    ndarray, shape (size,)
        Rate [degree hour-1].

    Raises
    ------
    OptionError
        When a number makes no sense.

    Examples
    --------
    >>> noise = make_noise(rate=100.0, size=100_000, N=0.01, seed=4)
    >>> bool(abs(noise.std() - 60 * 0.01 * 10) < 0.1)  # 60 N sqrt(rate)
    True
    """
    coefficients = {"Q": Q, "N": N, "B": B, "K": K, "R": R}
    for name, value in {"rate": rate, "size": size, "chunk": chunk, **coefficients}.items():
        minimum = 0.0 if name in TERMS else 1e-9
        is_number = isinstance(value, int | float | np.number) and math.isfinite(value)
        if not (is_number and (value >= minimum or name == "R")):
            raise OptionError(
                f"{name}={value!r}: give a number {'from 0 up' if name in TERMS else 'above 0'}"
            )
    for name, value in {"size": size, "chunk": chunk}.items():
        if not isinstance(value, int | np.integer):
            raise OptionError(f"{name}={value!r}: give a whole number of samples")
    if np.size(flicker_band) != 2:
        raise OptionError(
            f"flicker_band={flicker_band!r}: give the lowest and the highest frequency in Hz"
        )
    if gauss_markov and not (
        len(gauss_markov) == 2
        and all(math.isfinite(value) for value in gauss_markov)
        and gauss_markov[1] > 0.0
    ):
        raise OptionError(
            f"gauss_markov={gauss_markov!r}: give the standard deviation in deg/h and the "
            "correlation time in s, above 0"
        )
    if sinusoid and not (len(sinusoid) == 3 and all(math.isfinite(value) for value in sinusoid)):
        raise OptionError(
            f"sinusoid={sinusoid!r}: give the amplitude in deg/h, the frequency in Hz and the "
            "phase in rad"
        )
    terms = "".join(term for term in "QNBK" if coefficients[term] > 0.0)
    noise = begin_noise(seed, axis, rate=rate, terms=terms, flicker_band=flicker_band)
    rng = stream(seed, "noise", axis, "gauss_markov")
    position, carry = float(rng.standard_normal()), dict[str, float]()
    level = {term: value**2 for term, value in coefficients.items()}
    rates = np.empty(size)
    for first in range(0, size, chunk):
        part = rates[first : first + chunk]
        units, noise = draw(noise, first, part.size)
        part[:], carry = shape(units, level, rate, carry, ramp=R)
        if gauss_markov:
            sigma, time = gauss_markov
            normal = rng.standard_normal((part.size, 2))
            means, position = ornstein_uhlenbeck_means(normal, time * rate, position)
            part += sigma * means
        if sinusoid:
            amplitude, frequency, phase = sinusoid
            cycles = frequency / rate
            middle = (np.arange(first, first + part.size, dtype=np.float64) + 0.5) * cycles
            part += amplitude * turn_means(middle, np.full(1, cycles), phase - math.pi / 2.0)
    return rates

"""Gaussian processes of continuous time, sampled or averaged without approximation.

A process is white noise filtered by second-order sections in series. The matrix exponential gives
its state from one sample to the next, and the joint distribution of the state and of the mean over
the interval between (Van Loan 1978). A process far above half of the sampling rate therefore folds
down as in a logger that samples it, without a finer time step.

References
----------
Van Loan 1978, IEEE Trans. Autom. Control 23, 395 (integrals of the matrix exponential).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import expm, solve_continuous_lyapunov

from gyrostab.arrays import Floats
from gyrostab.kernels.compiled import KERNEL

#: Order of the Butterworth low-pass from which a band is made: the band has twice as many poles.
ORDER = 6
#: Ratio of the edges above which the sections of a band are paired and scaled: one after the other
#: in the order of frequency, they attenuate the noise between them below the rounding error.
WIDE = 100.0
#: Change of the state in a sample below which differences of its moments lose their digits.
_SLOW = 1e-2


class Transition(NamedTuple):
    """Transition of a process from sample to sample, and its output."""

    step: Floats  # (d, d): state at the next sample from the state at this one
    read: Floats  # (d,): reading from the state at this sample
    # (d + 1, d + 1): lower triangle; from standard normal numbers to the fresh parts of state and
    # reading
    kick: Floats
    spread: Floats  # (d, d): from standard normal numbers to a state of the stationary process


class _Section(NamedTuple):
    """Second-order section: ``velocity`` is 1 at its resonance w, ``position`` at zero frequency.

    ``velocity: a s / (s^2 + a s + w^2)``; ``position: w^2 / (s^2 + a s + w^2)``.
    """

    omega: float
    damping: float
    velocity: bool


def _chain_sections(sections: Sequence[_Section]) -> tuple[Floats, Floats, Floats]:
    """Connect sections in series: state matrix, noise input, output; two states per section."""
    size = 2 * len(sections)
    a, b = np.zeros((size, size)), np.zeros(size)
    drive = np.zeros(size)
    for number, (omega, damping, velocity) in enumerate(sections):
        position, speed = 2 * number, 2 * number + 1
        a[position, speed] = omega
        a[speed, position] = -omega
        a[speed, speed] = -damping
        gain = damping if velocity else omega
        if number:
            a[speed] += drive * gain
        else:
            b[speed] = gain
        drive = np.zeros(size)
        drive[speed if velocity else position] = 1.0
    return a, b, drive


def _factor_covariance(covariance: Floats) -> Floats:
    """Factor a covariance, which may be singular, into a lower triangle.

    Its diagonal is not negative: the signs of a QR factor depend on the processor, and a process of
    one seed with them.
    """
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    factor = np.asarray(np.linalg.qr(root.T, mode="r")).T
    return np.ascontiguousarray(np.where(np.diagonal(factor) < 0.0, -factor, factor))


def _integrate_moments(a: Floats, b: Floats, c: Floats, rate: float) -> tuple[Floats, Floats]:
    """Integrate over a slow sample: mean of the output by state, covariance of the fresh parts.

    Nothing is subtracted, but the inverse of the transition must be of moderate size (Van Loan).
    """
    size = c.size
    change, drive = np.zeros((size + 1, size + 1)), np.append(b, 0.0)
    change[:size, :size], change[size, :size] = a / rate, c
    scale = b @ b / rate  # the exponential is exact to its norm only
    block = np.block(
        [[-change, np.outer(drive, drive) / (b @ b)], [np.zeros_like(change), change.T]]
    )
    exponential = expm(block)
    step = exponential[size + 1 :, size + 1 :].T
    return step[size, :size], scale * step @ exponential[: size + 1, size + 1 :]


def _make_transition(
    a: Floats, b: Floats, covariance: Floats, c: Floats, rate: float, *, average: bool
) -> Transition:
    """Sample a stationary process with state matrix `a` [s-1] and the output `c` at `rate` [Hz].

    `b` is the gain of the white noise, of density 1, that drives the state.
    """
    size = c.size
    step = expm(a / rate)
    total = np.zeros((size + 1, size + 1))
    total[:size, :size] = covariance - step @ covariance @ step.T
    read = c
    if average and np.linalg.norm(a) < _SLOW * rate:
        read, total = _integrate_moments(a, b, c, rate)
    elif average:
        once = np.linalg.solve(a, step - np.eye(size)) * rate
        twice = 2.0 * rate * np.linalg.solve(a, once - np.eye(size))
        read = c @ once
        crossed = once @ covariance @ c - step @ (covariance @ read)
        total[:size, size] = total[size, :size] = crossed
        total[size, size] = c @ twice @ covariance @ c - read @ covariance @ read
    return Transition(
        np.ascontiguousarray(step),
        np.ascontiguousarray(read),
        _factor_covariance(total),
        _factor_covariance(covariance),
    )


def oscillator(
    frequency: float, quality: float, rate: float, *, average: bool = True
) -> Transition:
    """Describe the velocity of a damped oscillator driven by white noise, with unit variance.

    Parameters
    ----------
    frequency : float
        Undamped frequency [Hz].
    quality : float
        Frequency over width of the line.
    rate : float
        Sampling rate [Hz].
    average : bool
        Read the mean over each sample instead of the value at its beginning.
    """
    omega = 2.0 * math.pi * frequency
    a, _, c = _chain_sections([_Section(omega, omega / quality, True)])
    b = np.array([0.0, math.sqrt(2.0 * omega / quality)])
    return _make_transition(a, b, np.eye(2), c, rate, average=average)


def mount(resonance: float, quality: float, rate: float, *, average: bool = True) -> Transition:
    """Describe white noise of density 1 Hz-1 behind a mass on a spring, whose gain is one at rest.

    Parameters
    ----------
    resonance : float
        Undamped frequency [Hz].
    quality : float
        Gain at that frequency.
    rate : float
        Sampling rate [Hz].
    average : bool
        Read the mean over each sample instead of the value at its beginning.
    """
    omega = 2.0 * math.pi * resonance
    a, b, c = _chain_sections([_Section(omega, omega / quality, False)])
    covariance: Floats = np.asarray(solve_continuous_lyapunov(a, -np.outer(b, b)), np.float64)
    return _make_transition(a, b, covariance, c, rate, average=average)


def _band_sections(low: float, high: float) -> list[_Section]:
    """Make a Butterworth band-pass with half power at `low` and `high` [Hz]."""
    width, centre = 2.0 * math.pi * (high - low), 2.0 * math.pi * math.sqrt(low * high)
    angles = math.pi * (2.0 * np.arange(ORDER) + ORDER + 1.0) / (2.0 * ORDER)
    half = np.exp(1j * angles) * width / 2.0
    root = np.sqrt(half**2 - centre**2 + 0j)
    poles = np.concatenate([half + root, half - root])
    poles = poles[poles.imag > 0.0]  # one of each pair, whose product is real
    poles = poles[np.argsort(np.abs(poles))]
    if high > WIDE * low:  # a low one and a high one by turns, which pass the band between them
        poles = poles.reshape(2, -1).T.ravel()
    return [_Section(float(abs(pole)), float(-2.0 * pole.real), True) for pole in poles]


def band(
    low: float,
    high: float,
    rate: float,
    resonance: float = 0.0,
    quality: float = 1.0,
    *,
    average: bool = False,
) -> Transition:
    """Describe noise of unit variance in a band, with an optional mount.

    Parameters
    ----------
    low, high : float
        Frequencies of half power [Hz], with ``0 < low < high``.
    rate : float
        Sampling rate [Hz].
    resonance, quality : float
        Frequency [Hz] and quality of a mass on a spring that filters the noise; its gain is one at
        low frequency. 0 Hz: no mount.
    average : bool
        Read the mean over each sample instead of the value at its beginning.
    """
    sections = _band_sections(low, high)
    size = 2 * len(sections)
    if resonance:
        omega = 2.0 * math.pi * resonance
        sections.append(_Section(omega, omega / quality, False))
    a, b, c = _chain_sections(sections)
    for end in range(2, size + 1, 2) if high > WIDE * low else ():
        # unit variance behind each section
        part = solve_continuous_lyapunov(a[:end, :end], -np.outer(b[:end], b[:end]))
        scale = math.sqrt(part[-1, -1])
        a[end - 1, : end - 2] /= scale
        b[end - 1] /= scale
    covariance = solve_continuous_lyapunov(a, -np.outer(b, b))
    power = covariance[size - 1, size - 1]  # of the band before the mount
    return _make_transition(a, b / math.sqrt(power), covariance / power, c, rate, average=average)


class Process(NamedTuple):
    """A process at one sample: its transition, random numbers, and state (d,)."""

    transition: Transition
    rng: np.random.Generator
    position: Floats


def begin_process(transition: Transition, rng: np.random.Generator) -> Process:
    """Draw a state of the stationary process."""
    return Process(transition, rng, transition.spread @ rng.standard_normal(transition.read.size))


def read_process(process: Process, size: int) -> tuple[Floats, Process]:
    """Read the process at the next `size` samples; return also what follows them."""
    transition, rng, position = process
    normal = rng.standard_normal((size, position.size + 1))
    values, position = _read_samples(
        transition.step, transition.read, transition.kick, normal, position
    )
    return values, process._replace(position=position)


@njit(**KERNEL)
def _read_samples(
    step: Floats, read: Floats, kick: Floats, normal: Floats, position: Floats
) -> tuple[Floats, Floats]:
    """Read the process at the samples: the values (n,), and the state (d,) after the last.

    `normal` holds standard normal numbers (n, d + 1).
    """
    n, d = normal.shape[0], position.size
    values = np.empty(n)
    state, next_state = position.copy(), np.empty(d)
    for i in range(n):
        value = 0.0
        for k in range(d):
            value += read[k] * state[k]
        for k in range(d + 1):
            value += kick[d, k] * normal[i, k]
        values[i] = value
        for j in range(d):
            x = 0.0
            for k in range(d):
                x += step[j, k] * state[k]
            for k in range(j + 1):
                x += kick[j, k] * normal[i, k]
            next_state[j] = x
        state, next_state = next_state, state
    return values, state


# --------------------------------------------------------------------------------------------------
# the same in frequency


def oscillator_psd(f: Floats, frequency: float, quality: float) -> Floats:
    """Compute the two-sided density [Hz-1] of `oscillator` in continuous time."""
    width = frequency / quality
    return np.asarray(width * f**2 / (math.pi * ((f**2 - frequency**2) ** 2 + (width * f) ** 2)))


def band_psd(
    f: Floats, low: float, high: float, resonance: float = 0.0, quality: float = 1.0
) -> Floats:
    """Compute the two-sided density [Hz-1] of `band` in continuous time."""
    x = (f**2 - low * high) / ((high - low) * np.maximum(np.abs(f), 1e-9 * low))
    share = math.pi / (2 * ORDER)
    density = 0.5 / ((high - low) * share / math.sin(share)) / (1.0 + x ** (2 * ORDER))
    if resonance:
        density = density * mount_psd(f, resonance, quality)
    return np.asarray(density)


def mount_psd(f: Floats, resonance: float, quality: float) -> Floats:
    """Compute the two-sided density [Hz-1] of `mount` in continuous time."""
    return np.asarray(resonance**4 / ((f**2 - resonance**2) ** 2 + (f * resonance / quality) ** 2))


def folded_psd(
    density: Callable[[Floats], Floats], f: Floats, rate: float, highest: float, *, average: bool
) -> Floats:
    """Fold the two-sided density of a process into that of its samples.

    Parameters
    ----------
    density : callable
        Two-sided density in continuous time.
    f : ndarray, shape (n,)
        Frequencies [Hz].
    rate : float
        Sampling rate [Hz].
    highest : float
        Frequency above which the process has no power [Hz].
    average : bool
        Every sample is the mean over its interval.
    """
    order = np.arange(-math.ceil(highest / rate) - 1, math.ceil(highest / rate) + 2)
    every = np.asarray(f, np.float64)[..., None] + order * rate
    response = np.sinc(every / rate) ** 2 if average else 1.0
    return np.asarray((density(every) * response).sum(axis=-1))

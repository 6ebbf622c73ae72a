"""Physics of the gyro and its tool: coil, light, feedback loop, vibration, logger, rotation."""

from __future__ import annotations

import math

import numpy as np
from scipy import signal
from scipy.constants import Boltzmann, elementary_charge

from gyrostab.arrays import Floats

# ------------------------------------------------------------------------------------------------
# heat conduction in a quadrupole-wound fiber coil on an insulated spool

#: Length of the fiber [m].
LENGTH = 500.0


def diffusion_time(thickness: float, diffusivity: float) -> float:
    """Compute the slowest time constant [s] of a slab of `thickness` [m] insulated on one face."""
    return 4.0 * thickness**2 / (math.pi**2 * diffusivity)


def _discretise_diffusion(
    layers: int, thickness: float, diffusivity: float, dt: float
) -> tuple[Floats, Floats]:
    """Compute P, q of ``T' = P T + q (u + u') / 2`` (Crank-Nicolson; face temperature u)."""
    h = thickness / layers
    a = diffusivity / h**2
    rate = np.diag(np.full(layers - 1, a), 1) + np.diag(np.full(layers - 1, a), -1)
    rate -= np.diag(rate.sum(axis=1))
    rate[0, 0] -= 2 * a  # half a cell from the face
    drive = np.zeros(layers)
    drive[0] = 2 * a
    inverse = np.linalg.inv(np.eye(layers) - dt / 2 * rate)
    return inverse @ (np.eye(layers) + dt / 2 * rate), inverse @ drive * dt


def layer_temperatures(
    face: Floats,
    *,
    dt: float,
    layers: int = 24,
    thickness: float = 0.012,
    diffusivity: float = 2.2e-7,
) -> Floats:
    """Compute the temperature (layer, time) from that of the outer face (time,) every `dt` [s].

    The coil starts in thermal equilibrium. Its layers lie between face and spool; `thickness` [m]
    and thermal `diffusivity` [m2/s] are those of the potted winding.
    """
    advance, drive = _discretise_diffusion(layers, thickness, diffusivity, dt)
    values, vectors = np.linalg.eigh(advance)  # symmetric because the cells are equal
    face = np.asarray(face, dtype=float)
    push = np.zeros_like(face)
    push[1:] = 0.5 * (face[1:] + face[:-1]) - face[0]
    modes = np.stack(
        [
            signal.lfilter([1.0], [1.0, -value], weight * push)
            for value, weight in zip(values, vectors.T @ drive, strict=True)
        ]
    )
    return np.asarray(vectors @ modes + face[0])


def layer_weights(layers: int, *, trim: float = 0.0, scatter: Floats | None = None) -> Floats:
    """Compute the weight ``integral of (L - 2 l) dl`` [m2] of each layer of a quadrupole winding.

    The fiber has the length `LENGTH`, and the winding a multiple of 4 layers. `trim` is the offset
    between the middles of fiber and winding, as a share of the length, and `scatter` (layer,) the
    relative error of the length of each layer.
    """
    half = LENGTH / layers
    lengths = np.full(layers, half) * (1.0 if scatter is None else 1.0 + scatter)
    side = np.where(np.isin(np.arange(layers) % 4, (0, 3)), 1.0, -1.0)
    weights = np.zeros(layers)
    for sign in (1.0, -1.0):
        # from the spool, where the middle of the fiber is, outwards
        mine = np.flatnonzero(side == sign)[::-1]
        ends = np.cumsum(lengths[mine])
        begins = ends - lengths[mine]
        weights[mine] = sign * (
            ends**2 - begins**2
        )  # (L - 2 l) integrated, l counted from the middle
    return weights + 2.0 * trim * LENGTH * lengths


# ------------------------------------------------------------------------------------------------
# light: shot, thermal and excess noise, and loss of light

#: Current of the detector per light power [A/W], and temperature of its load [K].
RESPONSIVITY, LOAD_TEMPERATURE = 0.9, 300.0


def detector_psd(power: Floats, *, load: float = 50e3, rin: float = 1e-12) -> dict[str, Floats]:
    """Compute the one-sided densities [A2/Hz] of the current of a detector under `power` [W].

    `load` is its resistance [ohm], and `rin` the relative intensity noise of the source [1/Hz],
    about its coherence time.
    """
    current = RESPONSIVITY * np.asarray(power, dtype=float)
    return {
        "shot": 2 * elementary_charge * current,
        "thermal": np.full_like(current, 4 * Boltzmann * LOAD_TEMPERATURE / load),
        "excess": rin * current**2,
    }


def relative_psd(power: Floats, *, depth: float = 0.75 * math.pi, **detector: float) -> Floats:
    """Compute the one-sided phase noise [rad2/Hz] of an interferometer biased at `depth` [rad].

    The signal is ``P (1 + cos(phase))``: its slope is ``P sin(depth)``, and the light at the
    detector ``P (1 + cos(depth))``.
    """
    detected_power = np.asarray(power, dtype=float) * (1 + math.cos(depth))
    total = sum(detector_psd(detected_power, **detector).values())
    slope = RESPONSIVITY * np.asarray(power) * math.sin(depth)
    return np.asarray(total / slope**2)


def loss_db(
    temperature: Floats,
    hours: Floats,
    *,
    per_kelvin: float,
    curvature: float = 0.0,
    per_hour: float = 0.0,
    power: float = 1.0,
) -> Floats:
    """Compute the loss of light [dB] from temperature [degC], relative to 40 degC, and age [h].

    Examples
    --------
    >>> float(loss_db(np.array(60.0), np.array(2.0), per_kelvin=0.01, per_hour=0.1))
    0.4
    """
    warm = np.asarray(temperature) - 40.0
    return np.asarray(
        per_kelvin * warm + curvature * warm**2 + per_hour * np.asarray(hours) ** power
    )


# ------------------------------------------------------------------------------------------------
# closed loop: serrodyne ramp, error of its 2 pi reset, and dead zone by crosstalk

#: Diameter of the coil [m], refractive index of its fiber, and wavelength of the light [m].
_DIAMETER, _INDEX, _WAVELENGTH = 0.04, 1.45, 1.55e-6


def reset_frequency(rate: Floats) -> Floats:
    """Compute the reset frequency [Hz] at a rotation rate [deg/h]: ``D w / (n lambda)``."""
    return np.asarray(_DIAMETER * np.radians(np.asarray(rate) / 3600.0) / (_INDEX * _WAVELENGTH))


def ramp_phase(rate: Floats, *, dt: float, first: float = 0.0) -> Floats:
    """Compute the phase of the ramp, 0 to 1 between resets, from rates [deg/h] every `dt` [s]."""
    turned = first + np.cumsum(reset_frequency(rate)) * dt
    return np.asarray(turned % 1.0)


def reset_error(phase: Floats, *, settle: float = 0.05) -> Floats:
    """Compute the normalised rate error after a reset that differs from 2 pi; its mean is zero.

    The loop removes the error over the share `settle` of the ramp.

    Examples
    --------
    >>> error = reset_error(np.linspace(0, 1, 100_000, endpoint=False))
    >>> bool(abs(error.mean()) < 1e-3), bool(error[0] > 0.9)
    (True, True)
    """
    mean = settle * (1 - math.exp(-1 / settle))
    return np.asarray(np.exp(-np.asarray(phase) / settle) - mean)


def apply_dead_zone(rate: Floats, *, width: float) -> Floats:
    """Apply a dead zone: crosstalk holds the output at zero below `width` [deg/h]."""
    rate = np.asarray(rate, dtype=float)
    above = np.sqrt(np.maximum(rate**2 - width**2, 0.0))
    return np.asarray(np.copysign(above, rate) + 0.0)


# ------------------------------------------------------------------------------------------------
# vibration through mount and decimator, which produces aliasing and rectification

#: Rate at which vibration is generated [Hz].
FAST_HZ = 4000.0


def _design_bandpass(low: float, high: float) -> Floats:
    return np.asarray(signal.butter(2, [low, high], btype="bandpass", fs=FAST_HZ, output="sos"))


def _filtered_variance(sos: Floats, low: float) -> float:
    """Compute the variance of filtered white noise of unit variance."""
    f = np.geomspace(low / 30, FAST_HZ / 2 - 1e-6, 4000)
    gain = np.abs(signal.freqz_sos(sos, worN=f, fs=FAST_HZ)[1]) ** 2
    return float(np.trapezoid(gain, f)) / (FAST_HZ / 2)


def band_noise(rng: np.random.Generator, size: int, *, low: float, high: float) -> Floats:
    """Draw acceleration of unit rms between two frequencies [Hz], `size` samples at `FAST_HZ`."""
    sos = _design_bandpass(low, high)
    settle = round(2 * FAST_HZ / low)
    x = signal.sosfilt(sos, rng.standard_normal(size + settle))[settle:]
    return np.asarray(x / math.sqrt(_filtered_variance(sos, low)))


def mount_filter(resonance: float, *, quality: float) -> tuple[Floats, Floats]:
    """Design the filter (b, a) at `FAST_HZ` of a damped mount with a `resonance` [Hz]."""
    w = 2 * math.pi * resonance
    warped = 2 * FAST_HZ * math.tan(w / (2 * FAST_HZ))
    damping = warped / quality
    b, a = signal.bilinear([damping, warped**2], [1.0, damping, warped**2], fs=FAST_HZ)
    return np.asarray(b), np.asarray(a)


def decimator_taps(rate: float, kind: str) -> Floats:
    """Compute the weights, of sum 1, of the decimator from `FAST_HZ` to its divisor `rate` [Hz].

    Kinds are "point" (every n-th value), "dump" (integrate and dump), "cic2" (two of these in
    series) and "fir" (a short windowed sinc).
    """
    factor = round(FAST_HZ / rate)
    box = np.full(factor, 1.0 / factor)
    if kind == "point":
        return np.ones(1)
    if kind == "fir":
        taps = np.asarray(signal.firwin(3 * factor + 1, 0.42 * rate, fs=FAST_HZ, window="hamming"))
        return np.asarray(taps / taps.sum())
    return box if kind == "dump" else np.convolve(box, box)


def decimate(x: Floats, *, rate: float, kind: str) -> Floats:
    """Decimate `x` from `FAST_HZ` to `rate` [Hz] like the logger."""
    factor = round(FAST_HZ / rate)
    smooth = signal.oaconvolve(x, decimator_taps(rate, kind))[: x.size]
    return np.asarray(smooth[factor - 1 :: factor])


def folded_psd(
    frequency: Floats,
    *,
    rate: float,
    kind: str,
    low: float,
    high: float,
    mount: tuple[Floats, Floats] | None = None,
) -> Floats:
    """Compute the aliased two-sided density [1/Hz] of unit-rms band noise after the decimator."""
    sos = _design_bandpass(low, high)
    level = 1.0 / (FAST_HZ * _filtered_variance(sos, low))
    taps = decimator_taps(rate, kind)
    alias = (
        np.asarray(frequency)[None, :] + rate * np.arange(round(FAST_HZ / rate))[:, None]
    ) % FAST_HZ
    flat = alias.ravel()
    gain = (
        np.abs(signal.freqz_sos(sos, worN=flat, fs=FAST_HZ)[1]) ** 2
        * np.abs(signal.freqz(taps, worN=flat, fs=FAST_HZ)[1]) ** 2
    )
    if mount is not None:
        gain = gain * np.abs(signal.freqz(*mount, worN=flat, fs=FAST_HZ)[1]) ** 2
    return np.asarray(level * gain.reshape(alias.shape).sum(axis=0))


def rectify(rms: Floats, *, exponent: float, saturation: float) -> Floats:
    """Compute the shift of the mean by vibration `rms` [g], with exponent and saturation [g]."""
    rms = np.asarray(rms, dtype=float)
    return np.asarray(rms**exponent / (1.0 + (rms / saturation) ** exponent))


# ------------------------------------------------------------------------------------------------
# rotation of a drilling tool with stick-slip, its toolface, and projections of fixed vectors

#: Rate of the earth [deg/h].
EARTH_RATE = 15.041


def rotation(
    rng: np.random.Generator, seconds: float, *, dt: float, fastest: float = 120.0
) -> Floats:
    """Draw the rotation rate [deg/s], every `dt` [s], of a tool that alternately drills and rests.

    In some intervals stick-slip makes the rate oscillate at 0.1-0.5 Hz. The highest speed `fastest`
    [revolutions per minute] must be resolved by `dt` and the rate of the log.

    Examples
    --------
    >>> w = rotation(np.random.default_rng(3), 900.0, dt=0.1)
    >>> bool(w.min() >= 0), bool(w.max() > 30), bool((w == 0).any())
    (True, True, True)
    """
    size = math.ceil(seconds / dt) + 1
    t = np.arange(size) * dt
    rate = np.zeros(size)
    begin = rng.uniform(0.05, 0.15) * seconds
    while begin < 0.9 * seconds:
        end = begin + rng.uniform(0.1, 0.35) * seconds
        mean = rng.uniform(0.4, 1.0) * fastest * 6.0
        inside = (t >= begin) & (t < end)
        swing = rng.uniform(0.3, 0.95) if rng.random() < 0.5 else 0.0
        beat = rng.uniform(0.1, 0.5)
        drift = 1 + 0.02 * np.sin(2 * math.pi * t / rng.uniform(40, 200))
        rate[inside] = (mean / (1 + swing) * drift * (1 + swing * np.sin(2 * math.pi * beat * t)))[
            inside
        ]
        begin = end + rng.uniform(0.08, 0.25) * seconds
    return rate


def toolface(rotation_rate: Floats, *, dt: float, first: float = 0.0) -> Floats:
    """Integrate rotation rates [deg/s] every `dt` [s] to the toolface [rad] by the trapezoid rule.

    Examples
    --------
    >>> round(float(toolface(np.full(11, 36.0), dt=1.0)[-1] / math.pi), 6)  # a turn in 10 s
    2.0
    """
    w = np.radians(rotation_rate)
    return np.asarray(first + np.concatenate([[0.0], np.cumsum(0.5 * (w[1:] + w[:-1]) * dt)]))


def cross_axis(angle: Floats, *, across: float) -> tuple[Floats, Floats]:
    """Project a fixed vector of size `across` on the rotating axes x and y."""
    return np.asarray(across * np.cos(angle)), np.asarray(-across * np.sin(angle))


def gravity(angle: Floats, *, inclination: float) -> tuple[Floats, Floats, Floats]:
    """Compute gravity [g] along x, y, z of a tool at an `inclination` [deg] from vertical."""
    x, y = cross_axis(angle, across=math.sin(math.radians(inclination)))
    return x, y, np.full(np.shape(angle), math.cos(math.radians(inclination)))

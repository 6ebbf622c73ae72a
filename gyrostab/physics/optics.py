"""Effects of the optics and of the loop that is closed around them: dead zone, resets of the ramp, light common to the axes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.errors import OptionError
from gyrostab.noise import sampled_psd
from gyrostab.physics.base import Array, Chunk, Effect, Prediction, Setup, Stage, Windows, parameter
from gyrostab.physics.lorentz import lorentz_density
from gyrostab.physics.phase import fold, line_density
from gyrostab.units import HOUR, INNER

__all__ = ["DeadZone", "FeedbackReset", "SharedSource"]

_NRAD_PER_S = math.degrees(1e-9) * HOUR  # deg/h
_HARMONICS = 40


@dataclass(frozen=True, kw_only=True)
class DeadZone(Effect):
    """Output that sticks near zero rate.

    ``out = 0`` where ``|w - c| < d``, else ``w - d sgn(w - c)`` (``edge = "offset"``) or w itself
    (``"jump"``), with ``0`` and w counted from the centre c. The loop sticks to what it follows: w
    is the signal below `bandwidth`, and what is faster rides on the output unchanged. Without a
    bandwidth every sample sticks by itself, and noise above d dithers the zone away.

    *DAVAR*: too small at all times that the loop follows, while the rate is inside. *Window mean*:
    flat at the centre, and lines of slope one left and right of it, off by d. *Spectrum*: odd
    harmonics of a rotation that goes through zero; less noise inside. *Axes*: each by its own rate,
    or that of the axis whose light leaks in.

    Confused with rate_quantization (steps everywhere), held_samples (also far from zero) and small
    noise: it depends on the rate, and a slow sweep through zero, or the tool turned by 180 degrees,
    shows it.

    References
    ----------
    Cao et al. 2025, Opt. Commun. 596, 132504 (0.2 deg/h with one source for several axes, below
    0.01 deg/h after suppression); US patent 6744519 (suppression).

    Examples
    --------
    >>> DeadZone(width=0.2, axes=["x"]).say()
    'The output sticks on axis x, while the rate is within 0.2 deg/h of 0 deg/h.'
    """

    name: ClassVar[str] = "dead_zone"
    short: ClassVar[str] = "output sticks near zero rate"
    stage: ClassVar[Stage] = "sensor"
    size_parameters: ClassVar[tuple[str, ...]] = ("width",)
    references: ClassVar[tuple[str, ...]] = ("Cao et al. 2025, Opt. Commun.", "US patent 6744519")

    width: float = parameter(
        "deg/h", "half of the zone", typical=0.2, low=0.0, high=1e6, source="Cao et al. 2025"
    )
    centre: float = parameter("deg/h", "rate that it sticks to", default=0.0, low=-1e6, high=1e6)
    bandwidth: float = parameter(
        "Hz", "what the loop follows; inf for every sample by itself", default=math.inf, low=1e-9
    )
    edge: str = parameter(
        "text",
        "rate outside: less the width, or untouched",
        default="offset",
        choices=("offset", "jump"),
    )

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        """The signal with the zone cut out [degree hour-1]."""
        if self.width == 0.0:
            return chunk.signal, state
        slow = chunk.signal
        if math.isfinite(self.bandwidth):
            from scipy.signal import lfilter

            keep = math.exp(-2.0 * math.pi * self.bandwidth / chunk.rate)
            if state is None:
                state = keep * chunk.signal[:, :1]
            slow, state = lfilter([1.0 - keep], [1.0, -keep], chunk.signal, zi=state)
        away = slow - self.centre
        inside = np.clip(away, -self.width, self.width)
        change = (
            -inside if self.edge == "offset" else np.where(np.abs(away) < self.width, -inside, 0.0)
        )
        return chunk.signal + change, state

    def explain(self, windows: Windows) -> Prediction:
        """Window means: less by the width on both sides; nothing is known inside."""
        away = np.stack([windows.own[axis] for axis in windows.axes]) - self.centre
        outside = np.sign(away) * (np.abs(away) > 0.05 * self.width)
        return Prediction(mean={"width": -outside * (self.edge == "offset")}, marks=("stuck",))

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        size, centre = self.quantity("width", errors), self.quantity("centre", errors)
        return f"The output sticks {self.on_axes()}, while the rate is within {size} of {centre}."


@dataclass(frozen=True, kw_only=True)
class FeedbackReset(Effect):
    """Error tied to the 2-pi ramp of the feedback: to its resets, and to its phase.

    The ramp turns once for every ``n lambda / D`` of rotation, so it resets at ``f_r = D w / (n
    lambda)``. Each reset adds an error of angle: `kick` at once and `tail` over the time `decay`,
    falling exponentially; with the sign of the rotation. Besides, the error ``A (1 - 2 phase)``
    goes along the ramp, A the `sawtooth`, phase from 0 to 1. All of it is averaged exactly over
    every sample, so resets that come faster than the samples fold as they do. The phase is that of
    the gyro's own rate, noise and all, or with ``phase = "channel"`` that of the channel `ramp`,
    read at the end of every sample.

    *DAVAR*: a comb at the multiples of 1 / f_r, a bump at 0.371 / f_r, moving to shorter times as
    the rate grows; at short times it hides N. *Window mean*: ``(kick + tail) f_r``, in proportion
    to the rate, like a scale factor of ``(kick + tail) D / (n lambda)``. *Spectrum*: a comb at the
    multiples of f_r, flat for the kick, f^-2 for tail and sawtooth, folded. *Axes*: each by its own
    rate.

    Confused with spectral_line (does not move), rotation_line (moves with the tool), vibration and
    Q: the frequency is proportional to the measured rate, and sorted by the phase of the ramp all
    of it stands at one place.

    References
    ----------
    Lefevre 2014, The Fiber-Optic Gyroscope, 2nd ed. (digital phase ramp, 2-pi reset). Sizes: a
    recording of a blueSeis-3A at rest shows 11.5 nrad at once and 18 nrad over 12 ms at every
    reset, one reset for 12.96 urad, and a sawtooth below 0.003 deg/h.

    Examples
    --------
    >>> FeedbackReset(kick=11.5, diameter=0.1734, axes=["z"]).say()
    'Every reset of the ramp leaves 11.5 nrad on axis z, one reset for 12.96 urad of rotation.'
    """

    name: ClassVar[str] = "feedback_reset"
    short: ClassVar[str] = "error tied to the phase or resets of the feedback ramp"
    stage: ClassVar[Stage] = "electronics"
    channels: ClassVar[Mapping[str, str]] = {"ramp": INNER["number"]}
    size_parameters: ClassVar[tuple[str, ...]] = ("kick", "tail", "sawtooth")
    references: ClassVar[tuple[str, ...]] = (
        "Lefevre 2014, The Fiber-Optic Gyroscope",
        "recording of a blueSeis-3A",
    )

    kick: float = parameter(
        "nrad",
        "angle lost at once at a reset",
        default=0.0,
        typical=11.5,
        low=-1e6,
        high=1e6,
        source="blueSeis-3A",
    )
    tail: float = parameter(
        "nrad",
        "angle lost slowly after it",
        default=0.0,
        typical=18.0,
        low=-1e6,
        high=1e6,
        source="blueSeis-3A",
    )
    decay: float = parameter(
        "s", "time constant of the tail", default=0.012, low=1e-9, high=1e3, source="blueSeis-3A"
    )
    sawtooth: float = parameter(
        "deg/h",
        "error at the foot of the ramp, the opposite at its top",
        default=0.0,
        typical=0.01,
        low=-1e6,
        high=1e6,
    )
    diameter: float = parameter(
        "m", "diameter of the coil", default=0.1734, low=1e-3, high=10.0, source="blueSeis-3A"
    )
    wavelength: float = parameter(
        "nm", "wavelength of the light", default=1550.0, low=100.0, high=1e4, source="Lefevre 2014"
    )
    index: float = parameter(
        "1", "refractive index of the fibre", default=1.45, low=1.0, high=3.0, source="Lefevre 2014"
    )
    phase: str = parameter(
        "text",
        "what moves the ramp: own rate, or the channel",
        default="rate",
        choices=("rate", "channel"),
    )
    full: float = parameter(
        "1", "channel's reading of a full ramp; negative if it falls at positive rate", default=1.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.full == 0.0:
            raise OptionError(
                f"effect {self.name!r}, parameter 'full': 0 is no ramp; give the channel's reading of a full one"
            )

    @property
    def turn(self) -> float:
        """Rotation between two resets [nrad]."""
        return self.index * self.wavelength / self.diameter

    def needs(self) -> tuple[str, ...]:
        """The ramp, if its phase is not that of the own rate."""
        return ("ramp",) if self.phase == "channel" else ()

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Turns of the ramp so far (of the channel: none yet), its last reading, and the tail of every axis [degree hour-1]."""
        rows = 1 if self.phase == "channel" else len(setup.axes)
        return np.zeros(rows), None, np.zeros((rows, 1))

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        """The signal with the errors of the ramp [degree hour-1]."""
        turns, reading, tail = state
        if self.phase == "channel":
            ramp = chunk.drivers["ramp"] / self.full
            before = np.concatenate([ramp[:1] if reading is None else [reading], ramp])
            moves = np.diff(before)
            moves = (moves - np.round(moves))[None]
            turns = np.array([ramp[0] % 1.0]) if reading is None else turns
            reading = ramp[-1]
        else:
            moves = chunk.signal / (self.turn * _NRAD_PER_S * chunk.rate)
        edges = np.cumsum(np.concatenate([turns[:, None], moves], axis=1), axis=1)
        error = self.sawtooth * _sawtooth_means(edges)
        resets, ages = _resets(edges, self.decay * chunk.rate)
        error = error + self.kick * _NRAD_PER_S * chunk.rate * resets
        if self.tail:
            added, tail = self._tail(resets, ages, tail, chunk.rate)
            error = error + added
        return chunk.signal + error, (edges[:, -1], reading, tail)

    def _tail(self, resets: Array, ages: Array, tail: Array, rate: float) -> tuple[Array, Array]:
        """Means of the tails over the samples, and what is left of them at the end; `ages` sums exp(-age / decay) over resets."""
        from scipy.signal import lfilter

        samples = self.decay * rate
        keep = math.exp(-1.0 / samples)
        size = self.tail * _NRAD_PER_S * rate
        left, _ = lfilter([1.0], [1.0, -keep], size / samples * ages, zi=keep * tail)
        before = np.concatenate([tail, left[:, :-1]], axis=1)
        return before * samples * -math.expm1(-1.0 / samples) + size * (resets - ages), left[:, -1:]

    def nuisance(self, windows: Windows) -> Mapping[str, Array]:
        """Times of the tail about the sampling interval; diameters of coils, or what a recorded ramp says of it and of its sign."""
        decay = np.array([0.5, 1.0, 2.0, 4.0, 8.0]) / windows.rate
        turns = float(np.nanmean(windows.turns)) if np.isfinite(windows.turns).any() else 0.0
        rates = np.array(
            [
                np.nanmean(windows.own[axis])
                for axis in windows.axes
                if np.isfinite(windows.own[axis]).any()
            ]
        )
        rates = rates[rates != 0.0]
        if turns == 0.0 or not rates.size:
            return {"diameter": np.geomspace(0.03, 0.3, 8), "decay": decay}
        diameter = self.index * self.wavelength * np.abs(turns * _NRAD_PER_S / rates)
        known = next(one for one in self.parameters() if one.name == "diameter")
        likely = diameter[(diameter >= known.low) & (diameter <= known.high)]
        full = np.unique(np.sign(turns * rates))
        return {
            "diameter": likely if likely.size else np.array([self.diameter]),
            "decay": decay,
            "full": full,
        }

    def explain(self, windows: Windows) -> Prediction:
        """Window means in proportion to the rate; the comb and where its lines show, at the rate of the first axis."""
        own = np.stack([windows.own[axis] for axis in windows.axes])
        resets = own / self.turn  # deg/h per nrad
        frequency = np.abs(resets[0]) / _NRAD_PER_S
        number = np.arange(1.0, _HARMONICS + 1)[:, None]
        cycles = number * frequency
        place = fold(cycles, windows.rate)
        seen = 2.0 * np.sinc(cycles / windows.rate) ** 2
        kick = seen * resets[0] ** 2
        tail = kick / (1.0 + (2.0 * np.pi * cycles * self.decay) ** 2)
        power = {"kick": kick, "tail": tail, "sawtooth": seen / (np.pi * number) ** 2}
        spectrum = {
            name: sum(
                (line_density(windows, *line) for line in zip(place, strength, strict=True)),
                np.zeros(()),
            )
            for name, strength in power.items()
        }
        return Prediction(
            mean={"kick": resets, "tail": resets},
            spectrum=spectrum,
            line=place,
            phase_locked=self._profiles(windows),
        )

    def _profiles(self, windows: Windows) -> dict[str, Array]:
        """Error by phase of the ramp at the end of the sample: that sample holds the kick which the ramp passed its foot in."""
        if not windows.phase.size:
            return {}
        own = np.stack([windows.own[axis] for axis in windows.axes])
        if not np.isfinite(own).any():
            return {}
        moved = np.nanmedian(own) / (self.turn * _NRAD_PER_S * windows.rate)
        step = max(abs(moved), 1.0 / windows.phase.size)
        since = windows.phase if moved * self.full >= 0 else 1.0 - windows.phase
        kick = (since < step) * (_NRAD_PER_S * windows.rate) * np.sign(moved)
        seconds = since / max(abs(moved), 1e-9) / windows.rate
        cycle = 1.0 / max(abs(moved), 1e-9) / windows.rate / self.decay
        tail = (
            np.exp(-seconds / self.decay)
            / self.decay
            / -np.expm1(-cycle)
            * _NRAD_PER_S
            * np.sign(moved)
        )
        return {"kick": kick, "tail": tail, "sawtooth": 1.0 - 2.0 * windows.phase}

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        parts = [self.quantity("kick", errors)] if self.kick else []
        parts += (
            [f"{self.quantity('tail', errors)} within {self.quantity('decay', errors)}"]
            if self.tail
            else []
        )
        also = (
            f", besides a sawtooth of {self.quantity('sawtooth', errors)}" if self.sawtooth else ""
        )
        size = " and ".join(parts) or "nothing"
        return f"Every reset of the ramp leaves {size} {self.on_axes()}{also}, one reset for {self.turn / 1e3:.4g} urad of rotation."


def _sawtooth_means(edges: Array) -> Array:
    """Mean of ``1 - 2 phase`` between successive turns of the ramp."""
    phase = edges - np.floor(edges)
    area = phase * (1.0 - phase)
    moved = np.diff(edges, axis=1)
    still = np.abs(moved) < 1e-6
    return np.where(
        still, 1.0 - 2.0 * phase[:, :-1], np.diff(area, axis=1) / np.where(still, 1.0, moved)
    )


def _resets(edges: Array, samples: float) -> tuple[Array, Array]:
    """Resets in every sample, counted with their sign; and the sum over them of exp(-age / samples), age counted to its end."""
    whole = np.floor(edges)
    resets = np.diff(whole, axis=1)
    moved = np.abs(np.diff(edges, axis=1))
    forward = resets >= 0
    last = np.where(
        forward, edges[:, 1:] - whole[:, 1:], whole[:, 1:] + 1.0 - edges[:, 1:]
    )  # turns since the last reset
    between = 1.0 / np.where(resets == 0, 1.0, moved) / samples
    many = -np.expm1(-np.abs(resets) * between) / -np.expm1(-between)
    return resets, np.sign(resets) * np.exp(-last * between) * many


@dataclass(frozen=True, kw_only=True)
class SharedSource(Effect):
    """White noise of the light source that all axes share.

    ``n_a = r_a n(t)``, one n for all axes and r_a the angle random walk that it makes on axis a,
    with the sign of the modulation there; behind a low-pass of one pole at `bandwidth`, if that is
    given. It comes on top of the model's own N.

    *DAVAR*: ``r_a^2 / tau`` more, which nobody can tell from N: it shows in the cross-axis Allan
    covariance alone, ``r_a r_b / tau`` at all times. *Window mean*: noise. *Spectrum*: flat, and so
    is the coherence of the axes. *Axes*: ``r_a r_b``, lag zero.

    Confused with misalignment and real_motion (coherent at some frequencies, and only in motion),
    common vibration (coherent with the accelerometers): broadband coherence without lag, at rest as
    well.

    References
    ----------
    Blin et al. 2007, IEEE Photon. Technol. Lett. 19, 1520 (excess noise of the source); Cao et al.
    2025, Opt. Commun. 596, 132504 (one source for several axes). Sizes are estimates: where the
    source limits, a correlation of tens of per cent.

    Examples
    --------
    >>> SharedSource(N=[0.001, 0.001, -0.0008], axes=["x", "y", "z"]).say()
    'The light source adds the same noise on axes x, y and z, 0.001, 0.001, -0.0008 deg/sqrt(h).'
    """

    name: ClassVar[str] = "shared_source"
    short: ClassVar[str] = "broadband noise common to axes"
    stage: ClassVar[Stage] = "rate"
    size_parameters: ClassVar[tuple[str, ...]] = ("N",)
    references: ClassVar[tuple[str, ...]] = (
        "Blin et al. 2007, IEEE Photon. Technol. Lett.",
        "Cao et al. 2025, Opt. Commun.",
    )

    N: tuple[float, ...] = parameter(
        "deg/sqrt(h)",
        "angle random walk in common, with sign",
        typical=(1e-3,),
        low=-1e4,
        high=1e4,
        many=True,
    )
    bandwidth: float = parameter(
        "Hz", "half power of its low-pass; inf for white noise", default=math.inf, low=1e-6
    )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Where the common noise stands."""
        return rng, (0.0 if math.isinf(self.bandwidth) else float(rng.standard_normal()))

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        """Rate contribution [degree hour-1] on every sample."""
        rng, position = state
        if math.isinf(self.bandwidth):
            common = math.sqrt(chunk.rate) * rng.standard_normal(chunk.size)
        else:
            from gyrostab.kernels.random.stochastic import ornstein_uhlenbeck_means

            time = self._time()
            common, position = ornstein_uhlenbeck_means(
                rng.standard_normal((chunk.size, 2)), time * chunk.rate, position
            )
            common = common / math.sqrt(2.0 * time)
        return 60.0 * self.each("N", chunk.setup.axes)[:, None] * common, (rng, position)

    def _time(self) -> float:
        return 1.0 / (2.0 * math.pi * self.bandwidth)

    def nuisance(self, windows: Windows) -> Mapping[str, Array]:
        """No low-pass; or one within the band."""
        return {"bandwidth": np.append(windows.rate / np.array([40.0, 20.0, 10.0, 5.0]), math.inf)}

    def explain(self, windows: Windows) -> Prediction:
        """A spectrum, the same process on all axes."""
        density = sampled_psd("N", windows.frequency, windows.rate)
        if math.isfinite(self.bandwidth):
            density = (
                density
                * lorentz_density(windows.frequency, self._time(), windows.rate)
                / (2.0 * self._time())
            )
        return Prediction(
            spectrum={"N": np.broadcast_to(density, (windows.begin.size, density.size))},
            coherent=True,
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        below = (
            f", below {self.quantity('bandwidth', errors)}" if math.isfinite(self.bandwidth) else ""
        )
        return f"The light source adds the same noise {self.on_axes()}, {self.quantity('N', errors)}{below}."

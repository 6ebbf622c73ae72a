"""Reset errors of a closed loop."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.errors import OptionError
from gyrostab.physics.base import Chunk, Effect, Prediction, Setup, Windows, parameter
from gyrostab.physics.phase import fold, line_density
from gyrostab.units import HOUR, INNER

_NRAD_PER_S = math.degrees(1e-9) * HOUR  # deg/h
_HARMONICS = 40
_PARTS_OF_BIN = 32  # of the phase of the ramp, over which a prediction is averaged


@dataclass(frozen=True, kw_only=True)
class FeedbackReset(Effect):
    """Error that is phase-locked to the 2-pi ramp of the feedback, or follows its resets.

    The ramp turns once for every ``n lambda / D`` of rotation, and resets at ``f_r = D w / (n
    lambda)``. Each reset adds an angle error with the sign of the rotation: `kick` immediately, and
    `tail` with the exponential time constant `decay`. In addition, the error ``A (1 - 2 phase)``
    follows the ramp, where A is the `sawtooth` and the phase goes from 0 to 1. All errors are
    averaged exactly over every sample, so fast resets are aliased correctly. The phase follows from
    the gyro's rate including noise, or with ``phase = "channel"`` from the channel `ramp`, read at
    the end of every sample; the model then has no oversampling.

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

    name = "feedback_reset"
    short = "error tied to the phase or resets of the feedback ramp"
    plain = "an error of the feedback ramp"
    next_measurement = (
        "log the phase of the feedback ramp, and repeat at another rotation rate: lines of the "
        "ramp move with it"
    )
    stage = "electronics"
    channels: ClassVar[Mapping[str, str]] = {"ramp": INNER["number"]}
    size_parameters = ("kick", "tail", "sawtooth")

    kick: float = parameter(
        "nrad",
        "angle lost at once at a reset",
        default=0.0,
        typical=11.5,
        limit=1e6,
        source="blueSeis-3A",
    )
    tail: float = parameter(
        "nrad",
        "angle lost slowly after it",
        default=0.0,
        typical=18.0,
        limit=1e6,
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
        limit=1e6,
    )
    diameter: float = parameter(
        "m", "diameter of the coil", default=0.1734, low=1e-3, high=10.0, source="blueSeis-3A"
    )
    wavelength: float = parameter(
        "nm", "wavelength of the light", default=1550.0, low=100.0, high=1e4, source="Lefevre 2014"
    )
    index: float = parameter(
        "1", "refractive index of the fiber", default=1.45, low=1.0, high=3.0, source="Lefevre 2014"
    )
    phase: str = parameter(
        "text",
        "source of the ramp's phase: the gyro's rate, or the channel",
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
                f"effect {self.name!r}, parameter 'full': 0 is not a ramp; "
                "give the channel's reading of a full one"
            )

    @property
    def turn(self) -> float:
        """Rotation between two resets [nrad]."""
        return self.index * self.wavelength / self.diameter

    def needs(self) -> tuple[str, ...]:
        return ("ramp",) if self.phase == "channel" else ()

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Start with zero turns, no reading of the channel, and no tail on any axis."""
        if self.phase == "channel" and setup.oversampling > 1:
            raise OptionError(
                f"effect {self.name!r}: a ramp that wraps cannot be interpolated to "
                f"{setup.oversampling} samples of the instrument; leave oversampling out of the "
                'model\'s [log], or set phase = "rate"'
            )
        rows = 1 if self.phase == "channel" else len(setup.axes)
        return np.zeros(rows), None, np.zeros((rows, 1))

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        turns, reading, tail = state
        if self.phase == "channel":
            ramp = chunk.drivers["ramp"] / self.full
            readings = np.concatenate([ramp[:1] if reading is None else [reading], ramp])
            moves = np.diff(readings)
            moves = (moves - np.round(moves))[None]
            turns = np.array([ramp[0] % 1.0]) if reading is None else turns
            reading = ramp[-1]
        else:
            moves = chunk.signal / (self.turn * _NRAD_PER_S * chunk.rate)
        edges = np.cumsum(np.concatenate([turns[:, None], moves], axis=1), axis=1)
        error = self.sawtooth * _sawtooth_means(edges)
        resets, ages = _count_resets(edges, self.decay * chunk.rate)
        error = error + self.kick * _NRAD_PER_S * chunk.rate * resets
        if self.tail:
            added, tail = self._average_tail(resets, ages, tail, chunk.rate)
            error = error + added
        return chunk.signal + error, (edges[:, -1].copy(), reading, tail)

    def _average_tail(
        self, resets: Floats, ages: Floats, tail: Floats, rate: float
    ) -> tuple[Floats, Floats]:
        """Average the tails over samples; return also the rest at the end.

        `ages` sums exp(-age / decay) over the resets in a sample.
        """
        from scipy.signal import lfilter

        samples = self.decay * rate
        keep = math.exp(-1.0 / samples)
        size = self.tail * _NRAD_PER_S * rate
        tail_at_end, _ = lfilter([1.0], [1.0, -keep], size / samples * ages, zi=keep * tail)
        tail_at_start = np.concatenate([tail, tail_at_end[:, :-1]], axis=1)
        return tail_at_start * samples * -math.expm1(-1.0 / samples) + size * (
            resets - ages
        ), tail_at_end[:, -1:].copy()

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List decay times from the sampling interval to half a turn, and diameters.

        Diameters follow from a recorded ramp, and so does a turn; without one, decays have at most
        8 samples.
        """
        turns = float(np.nanmean(windows.turns)) if np.isfinite(windows.turns).any() else 0.0
        longest = 0.5 / abs(turns) if turns else 0.0
        count = max(math.floor(math.log2(max(2.0 * longest * windows.rate, 1.0))) + 1, 5)
        decay: Floats = np.ldexp(0.5, np.arange(count)) / windows.rate
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
        definition = next(item for item in self.parameters() if item.name == "diameter")
        likely = diameter[(diameter >= definition.low) & (diameter <= definition.high)]
        full = np.unique(np.sign(turns * rates))
        return {
            "diameter": likely if likely.size else np.array([self.diameter]),
            "decay": decay,
            "full": full,
        }

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means proportional to the rate, and the comb at the first axis's rate."""
        rates = np.stack([windows.own[axis] for axis in windows.axes])
        resets = rates / self.turn  # deg/h per nrad
        frequency = np.abs(resets[0]) / _NRAD_PER_S
        number = np.arange(1.0, _HARMONICS + 1)[:, None]
        cycles = number * frequency
        place = fold(cycles, windows.rate)
        response = 2.0 * np.sinc(cycles / windows.rate) ** 2
        kick = response * resets[0] ** 2
        tail = kick / (1.0 + (2.0 * np.pi * cycles * self.decay) ** 2)
        power = {"kick": kick, "tail": tail, "sawtooth": response / (np.pi * number) ** 2}
        spectrum = {
            name: line_density(windows, place, strength) for name, strength in power.items()
        }
        return Prediction(
            mean={"kick": resets, "tail": resets},
            spectrum=spectrum,
            line=place,
            phase_locked=self._predict_profiles(windows),
        )

    def _predict_profiles(self, windows: Windows) -> dict[str, Floats]:
        """Predict the error by phase of the ramp at the end of the sample, averaged over the bins.

        The turns of the ramp in a sample are taken as constant.
        """
        if not (windows.phase.size and np.isfinite(windows.turns).any()):
            return {}
        moved = np.sign(self.full) * np.nanmean(windows.turns) / windows.rate
        step, direction = max(abs(moved), 1e-9), 1.0 if moved >= 0.0 else -1.0
        place = (np.arange(windows.phase.size * _PARTS_OF_BIN) + 0.5) / (
            windows.phase.size * _PARTS_OF_BIN
        )
        turns = place if self.full > 0.0 else 1.0 - place
        end = turns if direction > 0.0 else 1.0 - turns  # turns since the last reset
        begin, decay = end - step, step * self.decay * windows.rate

        def lost_slowly(at: Floats) -> Floats:
            whole_turns = np.floor(at)
            return np.asarray(
                whole_turns + np.expm1((whole_turns - at) / decay) / np.expm1(-1.0 / decay)
            )

        angle = direction * _NRAD_PER_S * windows.rate
        sawtooth = _sawtooth_means(np.stack([turns - direction * step, turns], axis=-1))[:, 0]
        fine = {
            "kick": angle * (np.floor(end) - np.floor(begin)),
            "tail": angle * (lost_slowly(end) - lost_slowly(begin)),
            "sawtooth": sawtooth,
        }
        return {
            name: values.reshape(windows.phase.size, -1).mean(axis=1)
            for name, values in fine.items()
        }

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        parts = [self.quantity("kick", errors)] if self.kick else []
        if self.tail:
            parts += [f"{self.quantity('tail', errors)} within {self.quantity('decay', errors)}"]
        also = f", and a sawtooth of {self.quantity('sawtooth', errors)}" if self.sawtooth else ""
        size = " and ".join(parts) or "nothing"
        turn = f"one reset for {self.turn / 1e3:.4g} urad of rotation"
        return f"Every reset of the ramp leaves {size} {self.on_axes()}{also}, {turn}."


def _sawtooth_means(edges: Floats) -> Floats:
    """Average ``1 - 2 phase`` between successive turns of the ramp."""
    phase = edges - np.floor(edges)
    area = phase * (1.0 - phase)
    moved = np.diff(edges, axis=1)
    still = np.abs(moved) < 1e-6
    return np.where(
        still, 1.0 - 2.0 * phase[:, :-1], np.diff(area, axis=1) / np.where(still, 1.0, moved)
    )


def _count_resets(edges: Floats, samples: float) -> tuple[Floats, Floats]:
    """Count the signed resets in every sample, and sum exp(-age / samples) at its end."""
    whole_turns = np.floor(edges)
    resets = np.diff(whole_turns, axis=1)
    moved = np.abs(np.diff(edges, axis=1))
    forward = resets >= 0
    ahead = edges[:, 1:] - whole_turns[:, 1:]
    last = np.where(forward, ahead, 1.0 - ahead)  # turns since the last reset
    between = 1.0 / np.where(resets == 0, 1.0, moved) / samples
    many = -np.expm1(-np.abs(resets) * between) / -np.expm1(-between)
    return resets, np.sign(resets) * np.exp(-last * between) * many

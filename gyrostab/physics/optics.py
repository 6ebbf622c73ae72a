"""Effects of the optics and the closed loop: dead zone and a shared light source."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.noise import sampled_psd
from gyrostab.physics.base import Chunk, Effect, Prediction, Setup, Windows, parameter
from gyrostab.physics.phase import lorentz_density


@dataclass(frozen=True, kw_only=True)
class DeadZone(Effect):
    """Output that sticks near zero rate.

    ``out = 0`` where ``|w - c| < d``, else ``w - d sgn(w - c)`` (``edge = "offset"``) or w
    (``"jump"``), with 0 and w relative to the centre c. w is the signal below the `bandwidth` of
    the loop; faster components pass unchanged. Without a bandwidth every sample sticks
    independently, and noise above d removes the zone (dither).

    References
    ----------
    Cao et al. 2025, Opt. Commun. 596, 132504 (0.2 deg/h with one source for several axes, below
    0.01 deg/h after suppression); US patent 6744519 (suppression).

    Examples
    --------
    >>> DeadZone(width=0.2, axes=["x"]).say()
    'The output sticks on axis x, while the rate is within 0.2 deg/h of 0 deg/h.'
    """

    name = "dead_zone"
    short = "output sticks near zero rate"
    plain = "a dead zone near zero rate"
    next_measurement = "add a slow known rotation that carries the rate through zero"
    stage = "sensor"
    size_parameters = ("width",)

    width: float = parameter(
        "deg/h", "half of the zone", typical=0.2, low=0.0, high=1e6, source="Cao et al. 2025"
    )
    centre: float = parameter("deg/h", "rate that it sticks to", default=0.0, limit=1e6)
    bandwidth: float = parameter(
        "Hz", "bandwidth of the loop; inf for independent samples", default=math.inf, low=1e-9
    )
    edge: str = parameter(
        "text",
        "rate outside: less the width, or untouched",
        default="offset",
        choices=("offset", "jump"),
    )

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        if self.width == 0.0:
            return chunk.signal, state
        slow = chunk.signal
        if math.isfinite(self.bandwidth):
            from scipy.signal import lfilter

            keep = math.exp(-2.0 * math.pi * self.bandwidth / chunk.rate)
            if state is None:
                state = keep * chunk.signal[:, :1]
            slow, state = lfilter([1.0 - keep], [1.0, -keep], chunk.signal, zi=state)
        return chunk.signal + self._zone_change(slow), state

    def _zone_change(self, rate: Floats) -> Floats:
        away = rate - self.centre
        inside = np.clip(away, -self.width, self.width)
        return (
            -inside if self.edge == "offset" else np.where(np.abs(away) < self.width, -inside, 0.0)
        )

    def transfer(self, rate: Floats) -> Floats | None:
        """Return the output at each rate, without a bandwidth."""
        return rate + self._zone_change(rate) if math.isinf(self.bandwidth) else None

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means reduced by the width on both sides of the zone."""
        away = np.stack([windows.own[axis] for axis in windows.axes]) - self.centre
        outside = np.sign(away) * (np.abs(away) > 0.05 * self.width)
        return Prediction(mean={"width": -outside * (self.edge == "offset")}, marks=("stuck",))

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        size, centre = self.quantity("width", errors), self.quantity("centre", errors)
        return f"The output sticks {self.on_axes()}, while the rate is within {size} of {centre}."


@dataclass(frozen=True, kw_only=True)
class SharedSource(Effect):
    """White noise of the light source that all axes share.

    ``n_a = r_a n(t)``, with one n for all axes and r_a the angle random walk on axis a, with the
    sign of the modulation there; after a one-pole low-pass at `bandwidth`, if given. It adds to the
    model's N.

    References
    ----------
    Blin et al. 2007, IEEE Photon. Technol. Lett. 19, 1520 (excess noise of the source); Cao et al.
    2025, Opt. Commun. 596, 132504 (one source for several axes). Sizes are estimates: where the
    source limits the noise, a correlation of tens of per cent.

    Examples
    --------
    >>> SharedSource(N=[0.002, 0.001, -0.001], axes=["x", "y", "z"]).say()
    'The light source adds the same noise on axes x, y and z, 0.002, 0.001 and -0.001 deg/sqrt(h).'
    """

    name = "shared_source"
    short = "broadband noise common to axes"
    plain = "noise common to the axes (shared light source)"
    next_measurement = "log the light power of the source, or run the axes on separate sources"
    size_parameters = ("N",)

    N: tuple[float, ...] = parameter(
        "deg/sqrt(h)",
        "angle random walk in common, with sign",
        typical=(1e-3,),
        limit=1e4,
        many=True,
    )
    bandwidth: float = parameter(
        "Hz", "half power of its low-pass; inf for white noise", default=math.inf, low=1e-6
    )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Draw the initial value of the common noise."""
        return rng, (0.0 if math.isinf(self.bandwidth) else float(rng.standard_normal()))

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        rng, position = state
        if math.isinf(self.bandwidth):
            common = math.sqrt(chunk.rate) * rng.standard_normal(chunk.size)
        else:
            from gyrostab.kernels.random.stochastic import ornstein_uhlenbeck_means

            time = self._time_constant()
            common, position = ornstein_uhlenbeck_means(
                rng.standard_normal((chunk.size, 2)), time * chunk.rate, position
            )
            common = common / math.sqrt(2.0 * time)
        return 60.0 * self.expand_to_axes("N", chunk.setup.axes)[:, None] * common, (rng, position)

    def _time_constant(self) -> float:
        return 1.0 / (2.0 * math.pi * self.bandwidth)

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List low-passes from the narrowest that the band resolves to its upper end, and none."""
        parts = np.array([80.0, 40.0, 20.0, 10.0, 5.0, 2.5, 1.5])
        return {"bandwidth": np.append(windows.rate / parts, math.inf)}

    def explain(self, windows: Windows) -> Prediction:
        """Predict a spectrum of one process on all axes."""
        density = sampled_psd("N", windows.frequency, windows.rate)
        if math.isfinite(self.bandwidth):
            density = (
                density
                * lorentz_density(windows.frequency, self._time_constant(), windows.rate)
                / (2.0 * self._time_constant())
            )
        return Prediction(
            spectrum={"N": np.broadcast_to(density, (windows.begin.size, density.size))},
            coherent=True,
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        below = (
            f", below {self.quantity('bandwidth', errors)}" if math.isfinite(self.bandwidth) else ""
        )
        size = self.quantity("N", errors)
        return f"The light source adds the same noise {self.on_axes()}, {size}{below}."

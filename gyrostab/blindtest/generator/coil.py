"""Heat conduction in a quadrupole-wound fiber coil on an insulated spool."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]

#: Length of the fiber [m].
LENGTH = 500.0


def diffusion_time(thickness: float, diffusivity: float) -> float:
    """Compute the slowest time constant [s] of a slab of `thickness` [m] insulated on one face."""
    return 4.0 * thickness**2 / (math.pi**2 * diffusivity)


def _discretise_diffusion(
    layers: int, thickness: float, diffusivity: float, dt: float
) -> tuple[Array, Array]:
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
    face: Array,
    *,
    dt: float,
    layers: int = 24,
    thickness: float = 0.012,
    diffusivity: float = 2.2e-7,
) -> Array:
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
            lfilter([1.0], [1.0, -value], weight * push)
            for value, weight in zip(values, vectors.T @ drive, strict=True)
        ]
    )
    return np.asarray(vectors @ modes + face[0])


def layer_weights(layers: int, *, trim: float = 0.0, scatter: Array | None = None) -> Array:
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
        mine = np.flatnonzero(side == sign)
        ends = np.cumsum(lengths[mine])
        begins = ends - lengths[mine]
        weights[mine] = sign * (
            ends**2 - begins**2
        )  # (L - 2 l) integrated, l counted from the middle
    return weights + 2.0 * trim * LENGTH * lengths

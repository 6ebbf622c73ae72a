"""The reduced data that *explain* speaks about, and what an effect predicts for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["Array", "Prediction", "Windows"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Windows:
    """The reduced data that *explain* speaks about: means over windows, and spectra in the same windows.

    Attributes
    ----------
    begin, end : ndarray, shape (window,)
        Edges of the windows since the start of the log [s].
    frequency : ndarray, shape (band,)
        Centres of the bands of the spectra [Hz].
    rate : float
        Sampling rate of the log [Hz].
    axes : tuple of str
        The axes looked at.
    drivers : mapping of str to ndarray, shape (window,)
        Channels averaged over each window, by the names of `Effect.channels`; vibration as the rms over the window.
    own : mapping of str to ndarray, shape (window,)
        Measured rate of every axis of the log, averaged over each window [degree hour-1].
    gaps, restarts : ndarray, shape (n, 2)
        As in `Setup`, in seconds.
    """

    begin: Array
    end: Array
    frequency: Array
    rate: float
    axes: tuple[str, ...]
    drivers: Mapping[str, Array] = field(default_factory=dict)
    own: Mapping[str, Array] = field(default_factory=dict)
    gaps: Array = field(default_factory=lambda: np.empty((0, 2)))
    restarts: Array = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def centre(self) -> Array:
        """Middle of every window since the start of the log [s]."""
        return (self.begin + self.end) / 2.0


@dataclass(frozen=True)
class Prediction:
    """What an effect predicts for `Windows`; each part that it leaves empty it does not touch.

    The parts are linear in the parameters named by their keys, so that a fit can solve for these; a parameter in which the effect
    is not linear is one of `Effect.nuisance`, and is held at the value of the effect that was asked.

    Attributes
    ----------
    mean : mapping of str to ndarray, shape (window,) or (axis, window)
        Parameter -> window mean per unit of it [degree hour-1 per unit].
    level : mapping of (str, str) to ndarray, shape (window,) or (axis, window)
        (symbol of the noise term, parameter) -> change of the term's squared coefficient per unit, as a share of it.
    spectrum : mapping of str to ndarray, shape (window, band) or (axis, window, band)
        Parameter -> added two-sided power spectral density per unit of its square [degree2 hour-2 Hz-1].
    response : ndarray, shape (band,), or None
        Squared magnitude by which the whole spectrum is multiplied (a filter).
    coherent : bool
        The added spectrum is one process on all axes: it fills the cross-spectra too, with one factor (and sign) per axis.
    line : ndarray, shape (window,) or (harmonic, window), or None
        Frequency of a line in every window [Hz], folded below half of the sampling rate.
    """

    mean: Mapping[str, Array] = field(default_factory=dict)
    level: Mapping[tuple[str, str], Array] = field(default_factory=dict)
    spectrum: Mapping[str, Array] = field(default_factory=dict)
    response: Array | None = None
    coherent: bool = False
    line: Array | None = None

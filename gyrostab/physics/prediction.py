"""Reduced data, and the prediction of an effect for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gyrostab.arrays import Complexes, Floats


@dataclass(frozen=True)
class Windows:
    """Reduced data for which *explain* predicts means and spectra."""

    begin: Floats  # (window,): edges of the windows since the start of the log [s]
    end: Floats
    frequency: Floats  # (band,): centres of the bands of the spectra [Hz]
    rate: float  # sampling rate of the log [Hz]
    axes: tuple[str, ...]  # axes to predict
    #: (window,): channels averaged over each window, by the names of `Effect.channels`; vibration
    #: as the rms over the window.
    drivers: Mapping[str, Floats] = field(default_factory=dict)
    #: (window, part): denoised channels averaged over equal parts of each window, where sampled
    #: often enough.
    fine: Mapping[str, Floats] = field(default_factory=dict)
    #: (window,): measured rate of every axis of the log, averaged over each window [degree hour-1].
    own: Mapping[str, Floats] = field(default_factory=dict)
    #: (n, 2): as in `Setup`, in seconds
    gaps: Floats = field(default_factory=lambda: np.empty((0, 2)))
    restarts: Floats = field(default_factory=lambda: np.empty((0, 2)))
    #: (phase,): centres of the bins of the ramp's phase, from 0 to 1; empty where no ramp was
    #: recorded.
    phase: Floats = field(default_factory=lambda: np.empty(0))
    #: (window,): turns of the ramp per second, negative where it falls [Hz]; empty where no ramp
    #: was recorded.
    turns: Floats = field(default_factory=lambda: np.empty(0))
    #: (window, harmonic): mean of exp(2 pi i h n) after n turns of the channel rotation_rate since
    #: the start, over the samples of every axis, for the harmonics 1, 2, ...; empty where unknown.
    turn_means: Mapping[str, Complexes] = field(default_factory=dict)
    #: Edges [Hz] of the band of which a channel is the rms, if the log states them.
    bands: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def centre(self) -> Floats:
        """Middle of every window since the start of the log [s]."""
        return (self.begin + self.end) / 2.0

    def course(self, *names: str) -> tuple[Floats, ...]:
        """Return times [s] and channel values at the finest common resolution."""
        if not all(name in self.fine for name in names) or (self.begin[1:] < self.end[:-1]).any():
            return self.centre, *(self.drivers[name] for name in names)
        parts = self.fine[names[0]].shape[1]
        share = (np.arange(parts) + 0.5) / parts
        at = self.begin[:, None] + (self.end - self.begin)[:, None] * share
        return at.ravel(), *(self.fine[name].ravel() for name in names)


@dataclass(frozen=True)
class Prediction:
    """Prediction of an effect for `Windows`; an empty field means no effect.

    The fields are linear in the parameters named by their keys, so that a fit can solve for these.
    Nonlinear parameters, see `Effect.nuisance`, are fixed at the values of the effect.
    """

    #: (window,) or (axis, window): parameter -> window mean per unit of it [degree hour-1 per
    #: unit].
    mean: Mapping[str, Floats] = field(default_factory=dict)
    #: (window,) or (axis, window): (symbol of the noise term, parameter) -> change of the term's
    #: squared coefficient per unit, as a share of it.
    level: Mapping[tuple[str, str], Floats] = field(default_factory=dict)
    #: (window, band) or (axis, window, band): parameter -> added two-sided power spectral density
    #: per unit of its square [degree2 hour-2 Hz-1].
    spectrum: Mapping[str, Floats] = field(default_factory=dict)
    #: (band,): noise term, in the order Q, N, B, K -> factor by which a filter multiplies its
    #: spectrum in the log. That of N applies to all that is not noise, too.
    response: Mapping[str, Floats] = field(default_factory=dict)
    #: Whether the added spectrum is one process on all axes, which then appears in the
    #: cross-spectra with one signed factor per axis.
    coherent: bool = False
    #: (window,) or (harmonic, window): frequency of a line in every window [Hz], folded below half
    #: of the sampling rate.
    line: Floats | None = None
    #: Kinds of anomalous samples that it causes: outliers, repeats (of any value but zero and the
    #: ends of the range), extremes, stuck (zeros of one axis alone), filled (zeros of all axes at
    #: once, or of a single axis in runs), lattice (a quantization grid).
    marks: tuple[str, ...] = ()
    #: (band,): (parameter, channel) -> transfer function from the channel to the rate, per unit
    #: [degree hour-1 per unit of the channel]. The channel can be an axis, whose rate is meant.
    transfer: Mapping[tuple[str, str], Complexes] = field(default_factory=dict)
    #: (axis, harmonic): parameter -> pattern of the harmonics of the rotation over axes, up to one
    #: complex factor (size and phase); where the parameter has one number per axis, every axis and
    #: harmonic has a separate factor.
    order: Mapping[str, Complexes] = field(default_factory=dict)
    #: (phase,): parameter -> mean by phase of the ramp, per unit [degree hour-1 per unit].
    phase_locked: Mapping[str, Floats] = field(default_factory=dict)
    #: (window,): parameter -> a random mean: time constant of its memory [s], inf for a walk; and
    #: per squared unit its variance [degree2 hour-2], for a walk the growth of its variance
    #: [degree2 hour-2 s-1], in every window.
    wander: Mapping[str, tuple[float, Floats]] = field(default_factory=dict)
    #: Parameter that is the step between two levels, where the mean switches between them at
    #: random.
    levels: str = ""

"""The five noise laws of a gyro: Allan variance, power spectral density and units, in one place.

===== ====================== ============================== ================= ==============
term  name                   Allan variance                 rate PSD          unit
===== ====================== ============================== ================= ==============
Q     quantization           3 Q^2 / tau^2                  (2 pi f)^2 Q^2 T  urad
N     angle random walk      N^2 / tau                      N^2               deg/sqrt(h)
B     bias instability       (2 ln 2 / pi) B^2              B^2 / (2 pi f)    deg/h
K     rate random walk       K^2 tau / 3                    (K / 2 pi f)^2    deg/h^1.5
R     rate ramp              R^2 tau^2 / 2                  (deterministic)   deg/h^2
===== ====================== ============================== ================= ==============

The PSDs are two-sided, as in IEEE Std 952; a one-sided PSD is twice as large. T is the sampling
interval. Nothing else in the package repeats these laws, except compiled kernels, which may not
import this module, and the generator of the blind test, which is independent on purpose.

References
----------
IEEE Std 952-1997, annex C; Wang et al., Sensors 16 (2016), Eq. 8-9 (there Q is labelled arcsec
although the factor 10^6 pi / (180 * 3600 sqrt 3) gives microradian, and Table 1 prints K^2 / (2 pi
f^2) for the rate random walk).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.units import HOUR

#: One microradian per second in degree per hour.
URAD_PER_S = 1e-6 * 180.0 / math.pi * HOUR
#: Standard errors on either side of an estimate that hold 95 % of a normal distribution.
NORMAL_95 = 1.959964


@dataclass(frozen=True)
class NoiseLaw:
    """One term of the Allan variance, ``avar = coefficient**2 * scale * tau**power``.

    Attributes
    ----------
    symbol, name : str
        Letter and name of IEEE Std 952.
    seconds_factor : float
        Factor from the squared coefficient to (deg/h)^2 and seconds: density of white noise
        [degree2 hour-2 Hz-1] for N, variance for B, growth of the variance [degree2 hour-2 s-1]
        for K.
    avar_factor : float
        Numerical factor of the law, such as 1/3 for K.
    power : int
        Exponent of tau [s] in the Allan variance.
    label : str
        Customary unit of the coefficient.
    units : str
        Unit of the stored number, as UDUNITS must read it.
    squared_units : str
        Exact dimension of the squared coefficient, as a UDUNITS string.
    tau_ref_hours : float or None
        Averaging time at which the Allan deviation of the term equals the stored number, where
        `units` says so.
    """

    symbol: str
    name: str
    seconds_factor: float
    avar_factor: float
    power: int
    label: str
    units: str
    squared_units: str
    tau_ref_hours: float | None = None

    @property
    def scale(self) -> float:
        """Allan variance of a unit coefficient at one second [degree2 hour-2]."""
        return self.seconds_factor * self.avar_factor

    def avar(self, tau: Any, coefficient: float = 1.0) -> Floats:
        """Allan variance of the term [degree2 hour-2] at `tau` [s] for `coefficient` [`label`]."""
        tau = np.asarray(tau, dtype=np.float64)
        return np.asarray(coefficient**2 * self.scale * tau**self.power)


# fmt: off
_LAW_ROWS = (
    NoiseLaw("Q", "quantization", URAD_PER_S**2, 3.0, -2, "urad", "microradian", "microradian2"),
    NoiseLaw("N", "angle random walk", HOUR, 1.0, -1, "deg/sqrt(h)", "degree hour-1",
             "degree2 hour-1", 1.0),
    NoiseLaw("B", "bias instability", 1.0, 2.0 * math.log(2.0) / math.pi, 0, "deg/h",
             "degree hour-1", "degree2 hour-2"),
    NoiseLaw("K", "rate random walk", 1.0 / HOUR, 1.0 / 3.0, 1, "deg/h^1.5", "degree hour-1",
             "degree2 hour-3", 3.0),
    NoiseLaw("R", "rate ramp", 1.0 / HOUR**2, 0.5, 2, "deg/h^2", "degree hour-2",
             "degree2 hour-4"),
)
# fmt: on
#: The laws by symbol, in the order of rising power of tau.
LAWS: dict[str, NoiseLaw] = {law.symbol: law for law in _LAW_ROWS}

#: Symbols in table order.
TERMS = tuple(LAWS)


def avar_columns(tau: Any) -> Floats:
    """Design matrix of the five-term model: Allan variance per squared coefficient.

    Parameters
    ----------
    tau : array_like, shape (n_tau,)
        Averaging times [s].

    Returns
    -------
    ndarray, shape (n_tau, 5)
        Columns in the order of `TERMS` [degree2 hour-2 per squared coefficient unit].

    Examples
    --------
    >>> avar_columns([3600.0])[0, 1]  # N = 1 deg/sqrt(h): 1 (deg/h)^2 at one hour
    np.float64(1.0)
    """
    return np.stack([law.avar(tau) for law in LAWS.values()], axis=-1)


def model_avar(tau: Any, coefficients: Mapping[str, float]) -> Floats:
    """Allan variance [degree2 hour-2] of a sum of terms.

    Parameters
    ----------
    tau : array_like
        Averaging times [s].
    coefficients : mapping of str to float
        Symbol to value in the unit of its law; absent terms are zero.

    Examples
    --------
    >>> float(model_avar(3600.0, {"N": 3.0, "B": 0.0}))
    9.0
    """
    return np.asarray(
        sum(
            (LAWS[symbol].avar(tau, value) for symbol, value in coefficients.items()),
            np.zeros(np.shape(tau)),
        )
    )


def sample_squares(rate: float) -> Floats:
    """Factors from squared coefficients to sample units (interval 1, angles in samples times rate).

    Parameters
    ----------
    rate : float
        Sampling rate [Hz].

    Returns
    -------
    ndarray, shape (5,)
        In the order of `TERMS`; times a squared coefficient it gives the term of ``3 q / k^2``, ``n
        / k``, ``(2 ln 2 / pi) b``, ``k w / 3`` or ``r k^2 / 2`` in degree2 hour-2 for an averaging
        factor k.
    """
    one_sample = np.array([law.avar_factor for law in LAWS.values()])
    return np.asarray(avar_columns(1.0 / rate) / one_sample)


def sampled_psd(symbol: str, frequency: Any, rate: float) -> Floats:
    """Two-sided PSD of one noise term in samples that are means over their intervals.

    Quantization and rate random walk are folded at the Nyquist frequency; flicker noise, whose
    folded part is small, is that of the table.

    Parameters
    ----------
    symbol : str
        Q, N, B or K; a ramp has no PSD.
    frequency : array_like
        Frequencies, above 0 up to half of the sampling rate [Hz].
    rate : float
        Sampling rate [Hz].

    Returns
    -------
    ndarray, shape of `frequency`
        [degree2 hour-2 Hz-1 per squared coefficient unit].

    Examples
    --------
    >>> sampled_psd("N", [1.0, 2.0], 100.0)
    array([3600., 3600.])
    """
    f = np.asarray(frequency, np.float64)
    chord = (2.0 * np.sin(math.pi * f / rate)) ** 2  # 2 - 2 cos, without losing digits
    if symbol == "Q":
        shape = chord * rate
    elif symbol == "N":
        shape = np.ones(f.shape)
    elif symbol == "B":
        shape = 1.0 / (2.0 * math.pi * f)
    elif symbol == "K":
        shape = (1.0 - chord / 6.0) / chord / rate**2
    else:
        raise ValueError(f"no density for the term {symbol!r}")
    return np.asarray(LAWS[symbol].seconds_factor * shape)

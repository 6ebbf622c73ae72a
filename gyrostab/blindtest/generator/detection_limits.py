"""Size of an effect in units of the detection limit, and the evidence expected for it.

A mean of known shape, in noise of known density S(f), changes the log-likelihood by
``1/2 sum |M(f)|^2 / S(f)``; the limit is where that equals `NATS`. In white noise, for a mean that
is present for T_on of T, this gives ``a_min = N_s sqrt(2 c / T_eff)``. A change of the log variance
by v in n samples is worth ``n v^2 / 4``, hence ``2 sqrt(c / n)``; noise common to the axes is worth
about ``n / 2 sum of rho^2``, and more if it is not white.

For a real recording (`Scenario.measured`) the measured noise takes the place of the known one: S(f)
is its spectrum, lines included; a change of level counts only in the share of white noise in each
band, and against the fluctuation of the level itself; and the coherence of two axes falls where
they have more than white noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from scipy import fft
from scipy.optimize import minimize

from gyrostab.arrays import Floats
from gyrostab.blindtest.generator.noise import BANDS, floor_psd, white_level
from gyrostab.blindtest.generator.scenario import HiddenEffect, Scenario, count_per_second
from gyrostab.errors import OptionError

#: Log-likelihood at the limit.
NATS = 5.7
#: Evidence of one sample that noise alone cannot produce [nats].
NATS_PER_SAMPLE = math.log(1e3)
_SPECTRUM_BANDS = 400  # of the spectrum
_MAX_WHITE_SHARE = 2.0  # of a level; above 1 only because both are estimates


def mean_size(scenario: Scenario, mean: Floats, *, white: bool = False) -> float:
    """Compute the size of a mean (axis, time) [deg/h] in units of the limit.

    It is the square root of the expected log-likelihood over `NATS`, and proportional to the
    amplitude. With `white`, only white noise counts: the limit in its simplest form.
    """
    nats = 0.0
    for axis, f, power in _mean_spectra(scenario, mean):
        noise = scenario.noise[axis]
        density = (
            floor_psd(f, noise={"N": noise["N"]}, rate=scenario.rate)
            if white
            else line_density_of(scenario, axis=axis)
        )
        nats += 0.5 * float((power / density).sum())
    return math.sqrt(nats / NATS)


def line_density_of(scenario: Scenario, *, axis: int) -> Floats:
    """Compute the two-sided noise density [(deg/h)2/Hz] of an axis at ``k rate / (2 size)``."""
    if scenario.measured is not None:
        return np.asarray(scenario.measured.lines[axis])
    f = np.arange(1, scenario.size) * scenario.rate / (2 * scenario.size)
    return floor_psd(f, noise=scenario.noise[axis], rate=scenario.rate)


def band_density(scenario: Scenario) -> Floats:
    """Compute the two-sided density [(deg/h)2/Hz] of N and Q in equal bands, shape (axis, band).

    For the noise of a real recording, return its typical density.
    """
    if scenario.measured is not None:
        return scenario.measured.level
    f = (np.arange(BANDS) + 0.5) * scenario.rate / 2 / BANDS
    return np.stack(
        [floor_psd(f, noise={k: n[k] for k in "NQ"}, rate=scenario.rate) for n in scenario.noise]
    )


def _mean_spectra(scenario: Scenario, mean: Floats) -> Iterator[tuple[int, Floats, Floats]]:
    """Yield axis number, frequencies [Hz] and recorded power [(deg/h)2/Hz] of each nonzero row."""
    present = ~scenario.missing
    for axis, values in enumerate(mean):
        total = float(((values - values.mean()) ** 2).sum())
        if total == 0:
            continue
        lines = fft.dct(values - values.mean(), norm="ortho")[1:]
        f = np.arange(1, scenario.size) * scenario.rate / (2 * scenario.size)
        recorded_share = float(((values[present] - values[present].mean()) ** 2).sum()) / total
        yield axis, f, recorded_share * lines**2 / scenario.rate


def learned_nats(scenario: Scenario, mean: Floats) -> float:
    """Compute the evidence [nats] expected for a mean (axis, time) over noise fitted without it.

    The fit without the mean attributes a slow mean to angle random walk, bias instability and rate
    random walk in part, which reduces the evidence compared with noise that is known beforehand.
    In measured noise the fit may scale the measured spectrum, and add bias instability and rate
    random walk.
    """
    return sum(
        _divergence_from_noise(scenario, axis, f, power)
        for axis, f, power in _mean_spectra(scenario, mean)
    )


def fitted_nats(scenario: Scenario, effect: HiddenEffect) -> float:
    """Return the evidence expected for an effect over noise fitted without it [nats]."""
    learned = effect.learned_nats
    if learned is None and effect.mean is not None:
        learned = learned_nats(scenario, effect.mean)
    return float(effect.nats if learned is None else min(effect.nats, learned))


def learned_random_nats(
    scenario: Scenario, shares: Floats, density: Callable[[Floats], Floats]
) -> float:
    """Compute the evidence expected for random noise over noise fitted without it [nats].

    `density` is the two-sided density [(deg/h)2/Hz] of a share (axis,) of 1 at frequencies [Hz].
    """
    f = np.arange(1, scenario.size) * scenario.rate / (2 * scenario.size)
    recorded_share = float((~scenario.missing).mean())
    return sum(
        _divergence_from_noise(
            scenario, axis, f, recorded_share * share**2 * density(f), random=True
        )
        for axis, share in enumerate(shares)
        if share
    )


def filtered_density(scenario: Scenario, gain: Floats) -> Floats:
    """Compute the density [(deg/h)2/Hz] (axis, frequency) of N behind a filter, and of Q.

    The angle is quantized after the filter. `gain` is the power gain at frequencies that divide
    (0, rate / 2) equally.
    """
    f = (np.arange(gain.size) + 0.5) / gain.size * scenario.rate / 2
    return np.stack(
        [
            floor_psd(f, noise={"N": noise["N"]}, rate=scenario.rate) * gain
            + floor_psd(f, noise={"Q": noise["Q"]}, rate=scenario.rate)
            for noise in scenario.noise
        ]
    )


def learned_filter_nats(scenario: Scenario, gain: Floats) -> float:
    """Compute the evidence expected for a filter over fitted white noise and Q [nats].

    To first order a short filter takes away what a smaller Q takes away. A filter of weight a is
    therefore seen only where Q has less than about 2 a of the variance of a sample. `gain` is that
    of `filtered_density`.
    """
    f = (np.arange(gain.size) + 0.5) / gain.size * scenario.rate / 2
    terms = np.stack([floor_psd(f, noise={term: 1.0}, rate=scenario.rate) for term in "NQ"])
    count = float((~scenario.missing).sum())
    return sum(
        _filter_divergence(density, terms) * count / 2
        for density in filtered_density(scenario, gain)
    )


def _filter_divergence(density: Floats, term_densities: Floats) -> float:
    """Return twice the least divergence, per sample, of two noise terms from a density [nats]."""

    def apart(logarithms: Floats) -> float:
        ratio = density / (np.exp(logarithms) @ term_densities)
        return float((ratio - 1 - np.log(ratio)).mean())

    level = np.log(density.mean() / term_densities.mean(axis=1))
    return min(
        float(
            minimize(
                apart,
                np.array([level[0], level[1] + share]),
                method="Nelder-Mead",
                options={"maxiter": 800, "xatol": 1e-6, "fatol": 1e-14},
            ).fun
        )
        for share in (-12.0, -4.0, -1.0)
    )


def _divergence_from_noise(
    scenario: Scenario, axis: int, f: Floats, power: Floats, *, random: bool = False
) -> float:
    """Compute the divergence [nats] of noise plus signal from the nearest N, B, K noise.

    `power` [(deg/h)2/Hz] is that of a known mean or, if `random`, a density.
    """
    noise, rate, measured = scenario.noise[axis], scenario.rate, scenario.measured
    first = np.unique(np.geomspace(1, f.size, _SPECTRUM_BANDS).astype(np.int64)) - 1
    count = np.diff(np.append(first, f.size))
    f, power = (np.add.reduceat(values, first) / count for values in (f, power))
    terms = {term: floor_psd(f, noise={term: 1.0}, rate=rate) for term in "NBK"}
    if measured is None:
        density = floor_psd(f, noise=noise, rate=rate)
        term_densities = np.stack(
            [floor_psd(f, noise={"Q": noise.get("Q", 0.0)}, rate=rate), *terms.values()]
        )
    else:
        density = np.add.reduceat(measured.lines[axis], first) / count
        term_densities = np.stack([np.zeros_like(density), density, terms["B"], terms["K"]])
    if random:
        density, power = density + power, np.zeros_like(power)

    def apart(logarithms: Floats) -> float:
        ratio = density / (term_densities[0] + np.exp(logarithms) @ term_densities[1:])
        return 0.5 * float((count * (ratio * (1 + power / density) - 1 - np.log(ratio))).sum())

    white = density[-1] / term_densities[1, -1]
    meets = [
        density[place] / term_densities[2:, place]
        for place in range(0, f.size, max(1, f.size // 4))
    ]  # levels at which either term equals the known density
    starts = [
        np.log([white, *np.where(chosen, level, level * 1e-3)])
        for level in meets
        for chosen in ([True, False], [False, True])
    ]
    divergences = [
        minimize(apart, start, method="Nelder-Mead", options={"maxiter": 400}).fun
        for start in starts
    ]
    return float(max(0.0, min(divergences)))


def _samples_per_second(scenario: Scenario, ratio: Floats) -> Floats:
    count = count_per_second(scenario).astype(float)
    weight = count.reshape(1, -1, *(1,) * (ratio.ndim - 2))
    return weight / (ratio.shape[2] if ratio.ndim == 3 else 1)


def variance_size(scenario: Scenario, ratio: Floats) -> float:
    """Compute the size of a change of the noise density in units of the limit.

    `ratio` (axis, second) or (axis, second, frequency) is the density with the effect over that
    without; the frequencies divide (0, rate / 2) equally. With length 1 along the second dimension
    the change is permanent, and compared with no change, otherwise with its mean over time.
    """
    if scenario.measured is not None:
        return math.sqrt(_measured_nats(scenario, ratio) / NATS)
    change = np.log(ratio)
    weight = _samples_per_second(scenario, ratio)
    if ratio.shape[1] > 1:
        change = change - (change * weight).sum(axis=1, keepdims=True) / weight.sum(
            axis=1, keepdims=True
        )
    else:
        weight = weight.sum(axis=1, keepdims=True)
    return math.sqrt(float((weight * change**2).sum()) / 4 / NATS)


def _measured_nats(scenario: Scenario, ratio: Floats) -> float:
    """Compute the evidence for a temporary change of level in measured noise [nats]."""
    assert scenario.measured is not None
    if ratio.shape[1] == 1:
        raise OptionError(
            "a permanent change of level cannot be sized in real noise, which may contain one "
            "already; inject an effect that varies in time"
        )
    if ratio.ndim == 2:  # only white noise can be added
        more = ratio / ratio.min(axis=1, keepdims=True) - 1
        ratio = 1 + more[:, :, None] * white_shares(scenario)[:, None, :]
    change = scenario.measured.blocks(np.log(ratio))
    return sum(scenario.measured.change_nats(rows, axis=axis) for axis, rows in enumerate(change))


def white_shares(scenario: Scenario) -> Floats:
    """Compute the share (axis, band) that white noise has of the measured level, at most 2.

    Behind the anti-alias filter of a logger there is less than white noise, and noise that is
    added to the recording passes through the same filter.
    """
    assert scenario.measured is not None
    white = np.array([white_level(noise["N"]) ** 2 for noise in scenario.noise])
    return np.minimum(white[:, None] / scenario.measured.level, _MAX_WHITE_SHARE)


def variance_nats(scenario: Scenario, ratio: Floats, *, quiescent: bool = True) -> float:
    """Compute the evidence expected for a change of density over unchanged noise [nats].

    `ratio` is that of `variance_size`. Without `quiescent` times, which would show the
    noise without the effect, the change is compared with the mean level instead.
    """
    if scenario.measured is not None:
        return _measured_nats(scenario, ratio)
    weight = _samples_per_second(scenario, ratio)
    if ratio.shape[1] == 1:
        weight = weight.sum(axis=1, keepdims=True)
    elif not quiescent:
        ratio = (
            ratio * weight.sum(axis=1, keepdims=True) / (ratio * weight).sum(axis=1, keepdims=True)
        )
    return float((weight * (ratio - 1 - np.log(ratio))).sum()) / 2


def shared_size(scenario: Scenario, shares: Floats, power: Floats) -> float:
    """Compute the size of noise of one source in the white noise of the axes, of unchanged level.

    In known noise this is the Gaussian divergence from independent white noise. In measured noise
    only the coherence of the axes counts, which falls where an axis has more than white noise.
    `shares` (axis,) are the correlations with the source, and `power` (frequency,) its density,
    with mean 1, at a multiple of `BANDS` frequencies that divide (0, rate / 2) equally.
    """
    square = shares**2
    if scenario.measured is None:
        joint = np.log1p(power * (square / (1 - square)).sum()).mean()
        worth = -float(np.log1p(-square).sum() + joint)
    else:
        part = white_shares(scenario)
        coherent = (power**2).reshape(BANDS, -1).mean(axis=1)
        worth = sum(
            float(square[i] * square[j] * (part[i] * part[j] * coherent).mean())
            for i, j in ((0, 1), (0, 2), (1, 2))
        )
    return math.sqrt(float((~scenario.missing).sum()) * max(worth, 0.0) / 2 / NATS)


def amplitude_for(
    size_of: Callable[[float], float], strength: float, *, first: float = 1.0
) -> float:
    """Find the amplitude at which the increasing `size_of` reaches `strength`, to 0.1 %."""
    low, high = 0.0, first
    for _ in range(60):
        if size_of(high) > strength:
            break
        low, high = high, 2 * high
    for _ in range(40):
        middle = 0.5 * (low + high)
        reached = size_of(middle)
        if abs(reached / strength - 1) < 1e-3:
            return middle
        low, high = (middle, high) if reached < strength else (low, middle)
    return 0.5 * (low + high)

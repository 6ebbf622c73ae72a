"""Periodograms of blocks with missing samples, averaged over bands.

A block of L samples y with the mask m (1 where present) and the taper w has the ordinates

    F_k = sum_i w_i m_i (y_i - mean) exp(-2 pi j k i / L),    k = 1 ... ceil(L / 2) - 1.

With a = w m, A = FFT(a), V = FFT(a^2) and n samples present, white noise of variance s has exactly

    E |F_k|^2 = s (V_0 - |A_k|^2 / n),    cov(F_k, F_l) = s (V_(k-l) - A_k conj(A_l) / n),

and E F_k F_l follows with -l for l. The power of a band, the sum of |F_k|^2 divided by the sum of
their expectations, is therefore unbiased with any gaps, and its variance gives the shape of its
gamma distribution.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gyrostab.arrays import Bools, Complexes, Floats, Ints
from gyrostab.kernels.compiled import INNER, KERNEL

_EXACT = 12  # ordinates of a band up to which the covariance of each pair is summed
_APART = 16  # ordinates that the taper still correlates


def taper(size: int, share: float = 0.2) -> Floats:
    """Make Tukey's taper: cosine slopes on `share` of the samples, half at either end.

    Examples
    --------
    >>> taper(10, 0.4).round(2)
    array([0.15, 0.85, 1.  , 1.  , 1.  , 1.  , 1.  , 1.  , 0.85, 0.15])
    """
    middle = (np.arange(size) + 0.5) / size
    inside = np.minimum(middle, 1.0 - middle) / (share / 2.0)
    return np.asarray(
        np.where(inside < 1.0, 0.5 - 0.5 * np.cos(math.pi * np.minimum(inside, 1.0)), 1.0)
    )


def ordinates(size: int) -> int:
    """Count the complex ordinates of a block of `size` samples, without 0 and Nyquist."""
    return (size + 1) // 2 - 1


def band_edges(size: int, bands: int = 16) -> Ints:
    """Divide the ordinates into about `bands` bands, evenly spaced in log frequency.

    Examples
    --------
    >>> band_edges(2000)
    array([   1,    2,    4,    6,    9,   13,   21,   32,   49,   75,  115,
            178,  274,  422,  649, 1000])
    """
    top = ordinates(size) + 1
    return np.unique(np.round(np.geomspace(1, top, bands + 1)).astype(np.int64))


def gap_spectra(present: Bools, weights: Floats) -> tuple[Floats, Complexes, Complexes]:
    """Compute the expected power of each ordinate in white noise, and the spectra of the mask.

    Parameters
    ----------
    present : ndarray of bool, shape (block, sample)
        True where a sample is present; at least one in each block.
    weights : ndarray, shape (sample,)
        The taper.

    Returns
    -------
    expected : ndarray, shape (block, ordinate)
        ``E |F_k|^2`` for unit variance.
    mask, squared : ndarray of complex, shape (block, size // 2 + 1)
        Spectra of ``w m`` and of ``(w m)^2``.
    """
    tapered = present * weights
    mask = np.fft.rfft(tapered, axis=-1)
    squared = np.fft.rfft(tapered**2, axis=-1)
    inside = mask[:, 1 : ordinates(weights.size) + 1]
    lost = (inside.real**2 + inside.imag**2) / present.sum(axis=-1)[:, None]
    return squared[:, :1].real - lost, mask, squared


@njit(**INNER)
def _squared_at(squared, b, place, size):  # type: ignore[no-untyped-def]
    """Look up the Hermitian spectrum of ``(w m)^2`` at any index."""
    place = abs(place)
    if place > size // 2:
        return np.conj(squared[b, size - place])
    return squared[b, place]


@njit(**KERNEL)
def shape_of_bands(mask, squared, expected, present, edges, size):  # type: ignore[no-untyped-def]
    """Compute the gamma shape of the band powers of each block in white noise, (block, band).

    Parameters
    ----------
    mask, squared, expected : ndarray
        From `gap_spectra`.
    present : ndarray of int64, shape (block,)
        Samples present.
    edges : ndarray of int64
        From `band_edges`.
    size : int
        Samples of a block.
    """
    out = np.empty((mask.shape[0], edges.size - 1))
    for b in range(mask.shape[0]):
        for band in range(edges.size - 1):
            first, stop = edges[band], edges[band + 1]
            mean, variance = 0.0, 0.0
            for k in range(first, stop):
                mean += expected[b, k - 1]
            if stop - first <= _EXACT:
                for k in range(first, stop):
                    for other in range(first, stop):
                        share = mask[b, k] / present[b]
                        back = np.conj(mask[b, other])
                        at = (
                            np.conj(_squared_at(squared, b, k - other, size))
                            if k < other
                            else _squared_at(squared, b, k - other, size)
                        )
                        difference_term = at - share * back
                        sum_term = _squared_at(squared, b, k + other, size) - share * mask[b, other]
                        variance += (
                            difference_term.real**2
                            + difference_term.imag**2
                            + sum_term.real**2
                            + sum_term.imag**2
                        )
            else:
                for apart in range(stop - first):
                    power = squared[b, apart].real ** 2 + squared[b, apart].imag ** 2
                    variance += (1.0 if apart == 0 else 2.0) * (stop - first - apart) * power
            out[b, band] = mean * mean / variance if variance > 0.0 else np.nan
    return out


def band_covariance(size: int) -> Floats:
    """Compute the relative covariance of band powers of a whole block in white noise (band, band).

    The taper spreads each ordinate over its neighbours, so that adjacent bands share a few percent
    of their scatter.

    Parameters
    ----------
    size : int
        Samples of a block.

    Examples
    --------
    >>> band_covariance(200)[2, :6].round(3)
    array([0.027, 0.026, 0.   , 0.019, 0.012, 0.004])
    """
    edges, n = band_edges(size), ordinates(size)
    expected, mask, squared = (
        part[0] for part in gap_spectra(np.ones((1, size), np.bool_), taper(size))
    )
    # of all frequencies
    squared = np.concatenate([squared, squared[1 : (size + 1) // 2][::-1].conj()])
    band = np.searchsorted(edges, np.arange(1, n + 1), side="right") - 1
    out = np.zeros((edges.size - 1, edges.size - 1))
    for apart in range(1, min(_APART, n)):
        k = np.arange(1, n + 1 - apart)
        share = mask[k] / size
        difference_term = squared[apart].conj() - share * mask[k + apart].conj()
        sum_term = squared[2 * k + apart] - share * mask[k + apart]
        np.add.at(
            out,
            (band[k - 1], band[k + apart - 1]),
            np.abs(difference_term) ** 2 + np.abs(sum_term) ** 2,
        )
    np.fill_diagonal(out, 0.0)
    total = np.add.reduceat(expected, edges[:-1] - 1)
    return np.asarray((out + out.T) / np.outer(total, total))


@njit(**KERNEL)
def band_powers(first, second, expected, place, edges, rate):  # type: ignore[no-untyped-def]
    """Average the cross-periodogram of each block and band, as a complex two-sided density.

    Parameters
    ----------
    first, second : ndarray of complex, shape (block, ordinate)
        Ordinates of two signals (or of one, twice) with the same mask.
    expected : ndarray, shape (mask, ordinate)
        Expected powers, from `gap_spectra`, of the masks that occur.
    place : ndarray of int64, shape (block,)
        Number of the mask of each block.
    edges : ndarray of int64
        From `band_edges`.
    rate : float
        Sampling rate [Hz].
    """
    out = np.empty((first.shape[0], edges.size - 1), np.complex128)
    for b in range(first.shape[0]):
        for band in range(edges.size - 1):
            total, norm = 0.0 + 0.0j, 0.0
            for k in range(edges[band] - 1, edges[band + 1] - 1):
                total += first[b, k] * np.conj(second[b, k])
                norm += expected[place[b], k]
            out[b, band] = total / (norm * rate)
    return out

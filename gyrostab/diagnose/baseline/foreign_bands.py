"""Find bands whose power the noise terms do not explain."""

from __future__ import annotations

import numpy as np

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.baseline.posterior import BandPowers, fit_squares
from gyrostab.diagnose.settings import Settings

#: Bands that the noise terms are fitted to, with any spectral shape.
MIN_BANDS = 6


def has_foreign_bands(bands: BandPowers, settings: Settings) -> bool:
    """Return whether the noise terms miss the larger part of the power of a band."""
    return bool(is_foreign(_power_ratio(bands), bands.weight, settings).any())


def is_foreign(ratio: Floats, weight: Floats, settings: Settings) -> Bools:
    """Return whether the larger part of a power, or of its expected value, is not in the other.

    `ratio` is power divided by expected power, with a gamma distribution of the shape `weight`.
    """
    off = np.abs(ratio - 1.0) * np.sqrt(weight) > settings.excess_sigma
    return np.asarray(
        off & ((ratio < settings.majority_share) | (ratio * settings.majority_share > 1.0))
    )


def keep_explained_bands(bands: BandPowers, settings: Settings) -> BandPowers:
    """Drop the bands that the noise terms do not explain, the worst first.

    Lines and humps would raise the noise of block means, to which they add nothing. A spectrum
    that the terms describe to a factor of two keeps all bands.
    """
    if not has_foreign_bands(bands, settings):
        return bands
    while bands.power.size > MIN_BANDS:
        off = np.abs(_power_ratio(bands) - 1.0) * np.sqrt(bands.weight)
        worst = int(off.argmax())
        if off[worst] <= settings.excess_sigma:
            break
        bands = BandPowers(
            *(np.delete(part, worst, axis=0) for part in (bands.power, bands.columns, bands.weight))
        )
    return bands


def _power_ratio(bands: BandPowers) -> Floats:
    """Return the powers divided by those of the noise terms that fit them best."""
    return np.asarray(bands.power / (bands.columns @ fit_squares(bands)[0]))

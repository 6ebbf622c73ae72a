"""The logger's filter behind which the noise of a record is calibrated.

A low-pass or an average removes most of the noise at high frequencies, and leaves that of the block
means. Noise terms alone do not describe such a spectrum: a fit without the filter would take the
steep slope for B and K, and the floor of the stopped bands for N.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.posterior import Fit, expected_powers
from gyrostab.diagnose.predict.filter_response import band_response
from gyrostab.diagnose.predict.windows import make_windows
from gyrostab.physics.logger import LoggerFilter

__all__ = ["fit_filter_response"]


def fit_filter_response(blocks: xr.Dataset, fits: Sequence[Fit]) -> NDArray[np.float64]:
    """Return the response (band,) of the filter that describes the powers of all axes best.

    All axes pass the one logger.

    Parameters
    ----------
    fits : sequence of Fit
        Powers of each axis in all bands.
    """
    kind = LoggerFilter
    responses = [
        band_response(kind(**values), blocks)
        for values in kind.example().points(make_windows(blocks, {}))
    ]
    return max(responses, key=lambda response: sum(_max_likelihood(fit, response) for fit in fits))


def _max_likelihood(fit: Fit, response: NDArray[np.float64]) -> float:
    """Return the largest gamma log likelihood of powers that a filter has passed."""
    expected = expected_powers(fit._replace(columns=fit.columns * response[:, None]))
    return -float((fit.weight * (np.log(expected) + fit.power / expected)).sum())

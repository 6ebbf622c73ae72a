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

from gyrostab.diagnose.baseline.posterior import Fit, fit_squares
from gyrostab.diagnose.predict.filter_response import band_response
from gyrostab.diagnose.predict.windows import make_windows
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.physics.logger import LoggerFilter

Array = NDArray[np.float64]


def fit_filter_response(
    blocks: xr.Dataset, fits: Sequence[Fit], *, settings: Settings = DEFAULTS
) -> Array | None:
    """Return the response (band,) of the filter that describes the powers of all axes best.

    All axes pass the one logger: None if the noise terms alone describe some axis better. If
    several filters fit about as well, the one that needs least angle quantization is taken: Q rises
    where a low-pass falls, so that one at too low a cutoff fits with much Q.
    """
    responses = [
        band_response(LoggerFilter.example(**values), blocks)
        for values in LoggerFilter.example().points(make_windows(blocks, {}))
    ]
    behind = np.array(  # (filter, axis, 2), the last without a filter
        [
            [_fit_behind(fit, response) for fit in fits]
            for response in [*responses, np.ones(blocks.sizes["band"])]
        ]
    )
    likelihood, quantization = behind[..., 0], behind[..., 1]
    total = likelihood[:-1].sum(axis=1)
    is_close = total > total.max() - settings.ambiguous_nats
    chosen = int(np.where(is_close, quantization[:-1].sum(axis=1), np.inf).argmin())
    return responses[chosen] if (likelihood[chosen] > likelihood[-1]).all() else None


def _fit_behind(fit: Fit, response: Array) -> tuple[float, float]:
    """Return the largest log likelihood of powers behind a filter, and the Q^2 that it needs."""
    filtered = fit._replace(columns=fit.columns * response[:, None])
    square = fit_squares(filtered)[0]
    expected = filtered.columns @ square
    likelihood = -float((fit.weight * (np.log(expected) + fit.power / expected)).sum())
    return likelihood, float(square[0])

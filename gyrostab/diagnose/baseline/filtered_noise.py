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
from gyrostab.physics.logger_filter import LoggerFilter

Array = NDArray[np.float64]


def fit_filter_response(
    blocks: xr.Dataset, fits: Sequence[Fit], *, settings: Settings = DEFAULTS
) -> Array | None:
    """Return the response (band, term) of the filter that describes the powers of all axes best.

    All axes pass the one logger: None if the noise terms alone describe some axis better.
    """
    responses = [
        band_response(LoggerFilter.example(**values), blocks)
        for values in LoggerFilter.example().points(make_windows(blocks, {}))
    ]
    behind = [[fit_behind(fit, fit.columns * response) for fit in fits] for response in responses]
    chosen = choose_filter(behind, settings)
    is_better = [
        nats > fit_behind(fit, fit.columns)[0]
        for fit, (nats, _) in zip(fits, behind[chosen], strict=True)
    ]
    return responses[chosen] if all(is_better) else None


def fit_behind(fit: Fit, columns: Array) -> tuple[float, float]:
    """Return the largest log likelihood of powers over noise of these columns, and its Q^2."""
    square, _, expected = fit_squares(fit._replace(columns=columns))
    likelihood = -float((fit.weight * (np.log(expected) + fit.power / expected)).sum())
    return likelihood, float(square[0])


def choose_filter(behind: Sequence[Sequence[tuple[float, float]]], settings: Settings) -> int:
    """Return the place of the filter with the least Q^2 among those that fit about as well.

    `behind` has the results of `fit_behind` for each filter and axis. Q rises where a low-pass
    falls, so that one at too low a cutoff fits with much Q.
    """
    likelihood, quantization = np.array(behind).sum(axis=1).T
    is_close = likelihood > likelihood.max() - settings.ambiguous_nats
    return int(np.where(is_close, quantization, np.inf).argmin())

"""Compile the kernels of `gyrostab.kernels.fit`: ``python -m gyrostab.allan.compile_fit``."""

from __future__ import annotations

import gc

import numpy as np

from gyrostab.allan.freedoms import estimate_freedoms, tabulate_noise
from gyrostab.allan.window_fit import fit_block, fit_tables
from gyrostab.kernels.allan.surface import Cells


def compile_fit() -> None:
    """Fit two windows of white noise, with the kernels that `davar` and `fit_noise` call.

    The kernels of `davar` come first, because it is the first to need them.
    """
    window, rate, factors = 1000, 1.0, tuple(2**power for power in range(9))
    ones, zero = np.ones((2, len(factors))), np.zeros(2)
    avar = ones / factors
    tables = tabulate_noise(window, factors, rate, "avar")
    estimate_freedoms(Cells(avar, *[ones] * 8), tables)
    fit_block(
        [avar, ones, ones, ones, ones],
        zero,
        np.ones((2, 4)),
        zero,
        fit_tables(factors, rate, window),
        white_error=zero,
        allowed=31,
        observed_only=True,
    )


if __name__ == "__main__":
    gc.disable()  # the collector takes a tenth of the time, and the process ends soon
    compile_fit()

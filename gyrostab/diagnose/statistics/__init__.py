"""Statistics in which a recording and a simulation are compared: near-normal scores of windows.

A statistic is a file with a function ``score(blocks, baseline)`` that gives a Dataset of
`scores.statistic_dataset`, or None when the recording has nothing that it uses. The table here is
the only other place that names it.
"""

from __future__ import annotations

from collections.abc import Callable

import xarray as xr

from gyrostab.diagnose.statistics import (
    common_mode,
    cross_spectrum,
    drifting_line,
    mean,
    phase_locked,
    power,
    restart,
    sample_counts,
    spectral_line,
    variance_stability,
)

__all__ = ["STATISTICS"]

#: Statistics by name. The attribute ``view`` of what they give is the name in diagnosis.json.
STATISTICS: dict[str, Callable[[xr.Dataset, xr.Dataset], xr.Dataset | None]] = {
    "power": power.score,
    "mean": mean.score,
    "cross_spectrum": cross_spectrum.score,
    "common_mode": common_mode.score,
    "spectral_line": spectral_line.score,
    "phase_locked": phase_locked.score,
    "sample_counts": sample_counts.score,
    "restart": restart.score,
    "variance_stability": variance_stability.score,
    "drifting_line": drifting_line.score,
}

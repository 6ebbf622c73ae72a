"""Statistics that compare a recording with a simulation: near-normal scores of windows of blocks.

A statistic is a module with a function ``score(blocks, baseline)``, which returns a Dataset from
`scores.statistic_dataset`, or None if the recording lacks its data. Only the table below names the
statistics.
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

#: Statistics by name. The attribute ``view`` of their result is the name in diagnosis.json.
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

"""Where recording and simulation are compared: each view gives near-normal scores of its cells.

A view is a file with a function ``score(reduced, baseline)`` that gives a Dataset of
`cells.view_dataset`, or None when the recording has nothing that it looks at; the tuple here is all
that must know of it.
"""

from __future__ import annotations

from collections.abc import Callable

import xarray as xr

from gyrostab.diagnose.statistics import common_mode as common
from gyrostab.diagnose.statistics import cross_spectrum as cross_axis
from gyrostab.diagnose.statistics import drifting_line as gliding
from gyrostab.diagnose.statistics import mean, restart
from gyrostab.diagnose.statistics import phase_locked as locked
from gyrostab.diagnose.statistics import power as davar
from gyrostab.diagnose.statistics import sample_counts as distribution
from gyrostab.diagnose.statistics import spectral_line as spectrum
from gyrostab.diagnose.statistics import variance_stability as restless

__all__ = ["STATISTICS"]

#: Every view by a name of its own; the name in the contract is the attribute ``view`` of what it
#: gives.
STATISTICS: dict[str, Callable[[xr.Dataset, xr.Dataset], xr.Dataset | None]] = {
    "davar": davar.score,
    "mean": mean.score,
    "cross_axis": cross_axis.score,
    "common": common.score,
    "spectrum": spectrum.score,
    "locked": locked.score,
    "distribution": distribution.score,
    "restart": restart.score,
    "restless": restless.score,
    "gliding": gliding.score,
}

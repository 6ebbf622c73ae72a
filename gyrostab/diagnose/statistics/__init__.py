"""Statistics that compare a recording with a simulation: one class each, and their registry.

To add a statistic, write its class in a module of this package and add one line to `STATISTICS`;
docs/architecture.md has an example. All steps of the diagnosis loop over the registry, or hold the
instance that a candidate belongs to. Modules that define no statistic: `base`, `build_candidates`,
`jump_forms`, `mismatch_wording`, `sample_sizes`, `scores` and `shared_factors`.
"""

from __future__ import annotations

from gyrostab.diagnose.statistics.base import Statistic
from gyrostab.diagnose.statistics.common_mode import CommonMode
from gyrostab.diagnose.statistics.cross_spectrum import CrossSpectrum
from gyrostab.diagnose.statistics.drifting_line import DriftingLine
from gyrostab.diagnose.statistics.mean import Mean
from gyrostab.diagnose.statistics.power import Power
from gyrostab.diagnose.statistics.ramp_phase import RampPhase
from gyrostab.diagnose.statistics.random_process import RandomProcess
from gyrostab.diagnose.statistics.restart import Restart
from gyrostab.diagnose.statistics.rotation_order import RotationOrder
from gyrostab.diagnose.statistics.sample_counts import SampleCounts
from gyrostab.diagnose.statistics.spectral_line import SpectralLineStatistic
from gyrostab.diagnose.statistics.telegraph import TelegraphStatistic
from gyrostab.diagnose.statistics.transfer import Transfer
from gyrostab.diagnose.statistics.variance_fluctuation import VarianceFluctuation
from gyrostab.diagnose.statistics.wandering_bias import WanderingBias

__all__ = ["STATISTICS", "Statistic", "find_statistic"]

#: All statistics, in the order in which effects are searched, and null records drawn.
STATISTICS: tuple[Statistic, ...] = (
    SampleCounts(),
    Mean(),
    Power(),
    CrossSpectrum(),
    Transfer(),
    RotationOrder(),
    RampPhase(),
    SpectralLineStatistic(),
    RandomProcess(),
    WanderingBias(),
    TelegraphStatistic(),
    CommonMode(),
    Restart(),
    VarianceFluctuation(),
    DriftingLine(),
)


def find_statistic(name: str) -> Statistic:
    """Return the statistic of this name.

    Examples
    --------
    >>> find_statistic("spectral_line").view
    'spectrum'
    """
    return next(statistic for statistic in STATISTICS if statistic.name == name)

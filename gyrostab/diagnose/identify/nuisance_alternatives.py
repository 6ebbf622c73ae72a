"""Nuisance alternatives: generic changes of noise and bias that compete with the effects.

If one of them wins, the answer is "unknown".
"""

from __future__ import annotations

import xarray as xr

from gyrostab.diagnose.predict.candidates import Candidate
from gyrostab.diagnose.statistics import STATISTICS

#: Name -> description, in the order in which they are tried.
NUISANCE_ALTERNATIVES = {
    "~bias(t)": "the bias wanders",
    "~levels": "the bias steps between levels that differ",
    "~N(t)": "the noise level changes",
    "~burst": "the noise level is higher for a while",
    "~S(f)": "the spectrum has another shape",
    "~outliers": "the distribution has heavy tails",
    "~cov": "the axes have noise in common",
    "~red": "slow noise is stronger than calibrated",
}


def nuisance_alternatives(blocks: xr.Dataset) -> list[Candidate]:
    """Build the nuisance alternatives in all statistics of the record."""
    by_name = {
        candidate.effect: candidate
        for statistic in STATISTICS
        for candidate in statistic.nuisance_alternatives(blocks)
    }
    return [by_name[name] for name in NUISANCE_ALTERNATIVES if name in by_name]

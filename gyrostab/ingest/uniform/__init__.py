"""Restore uniform time axes after xarray operations, and cut out parts of logs."""

from gyrostab.ingest.uniform.core import advise_dates as advise_dates
from gyrostab.ingest.uniform.core import as_uniform as as_uniform
from gyrostab.ingest.uniform.core import check_same_rate as check_same_rate
from gyrostab.ingest.uniform.cut import check_cut as check_cut
from gyrostab.ingest.uniform.cut import cut_log as cut_log
from gyrostab.ingest.uniform.cut import parse_instant as parse_instant

__all__ = ["advise_dates", "as_uniform", "check_cut", "check_same_rate", "cut_log", "parse_instant"]

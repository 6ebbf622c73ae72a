"""Names, dimensions and units of the datasets that pass between the stages, and one check for each.

raw log      what a reader returns: columns by ``row`` with the stamps as they were written
log          uniform time, NaN at every missing sample, a table of gaps
surface      dynamic Allan variance by ``(axis, time, tau)``
product      surface plus the coefficients Q, N, B, K, R by ``(axis, time)``

A recording and a simulation have the same schema.
"""

from gyrostab.schema.checks import (
    check_coefficients,
    check_log,
    check_product,
    check_raw,
    check_surface,
    is_rate_of_change,
    log_channels,
    require_dataset,
    signal_name,
    texts,
    with_axis,
)
from gyrostab.schema.variables import (
    ESTIMATORS,
    GAP_CAUSES,
    NOT_OBSERVABLE,
    OBSERVABLE,
    OBSERVED,
    RESERVED_NAMES,
    SIGNAL_LONG_NAMES,
    SIGNAL_UNITS,
    UPPER_LIMIT_ONLY,
    VARIABLES,
    attributes,
)

__all__ = [
    "ESTIMATORS",
    "GAP_CAUSES",
    "NOT_OBSERVABLE",
    "OBSERVABLE",
    "OBSERVED",
    "RESERVED_NAMES",
    "SIGNAL_LONG_NAMES",
    "SIGNAL_UNITS",
    "UPPER_LIMIT_ONLY",
    "VARIABLES",
    "attributes",
    "check_coefficients",
    "check_log",
    "check_product",
    "check_raw",
    "check_surface",
    "is_rate_of_change",
    "log_channels",
    "require_dataset",
    "signal_name",
    "texts",
    "with_axis",
]

"""Names, dimensions and units of the datasets that pass between the stages, and one check for each.

raw log      what a reader returns: columns by ``row`` with the stamps as they were written
log          uniform time, NaN at every missing sample, a table of gaps
surface      dynamic Allan variance by ``(axis, time, tau)``
product      surface plus the coefficients Q, N, B, K, R by ``(axis, time)``

A recording and a simulation have the same schema.
"""

from gyrostab.schema.checks import check_coefficients as check_coefficients
from gyrostab.schema.checks import check_log as check_log
from gyrostab.schema.checks import check_product as check_product
from gyrostab.schema.checks import check_raw as check_raw
from gyrostab.schema.checks import check_surface as check_surface
from gyrostab.schema.checks import describe_times as describe_times
from gyrostab.schema.checks import escape_text as escape_text
from gyrostab.schema.checks import find_unusable_channels as find_unusable_channels
from gyrostab.schema.checks import is_rate_of_change as is_rate_of_change
from gyrostab.schema.checks import log_channels as log_channels
from gyrostab.schema.checks import name_axes as name_axes
from gyrostab.schema.checks import refuse_multi_index as refuse_multi_index
from gyrostab.schema.checks import require_dataset as require_dataset
from gyrostab.schema.checks import signal_name as signal_name
from gyrostab.schema.checks import split_coefficient as split_coefficient
from gyrostab.schema.checks import texts as texts
from gyrostab.schema.checks import with_axis as with_axis
from gyrostab.schema.variables import ESTIMATORS as ESTIMATORS
from gyrostab.schema.variables import GAP_CAUSES as GAP_CAUSES
from gyrostab.schema.variables import NOT_OBSERVABLE as NOT_OBSERVABLE
from gyrostab.schema.variables import OBSERVABLE as OBSERVABLE
from gyrostab.schema.variables import OBSERVED as OBSERVED
from gyrostab.schema.variables import RESERVED_NAMES as RESERVED_NAMES
from gyrostab.schema.variables import SIGNAL_LONG_NAMES as SIGNAL_LONG_NAMES
from gyrostab.schema.variables import SIGNAL_UNITS as SIGNAL_UNITS
from gyrostab.schema.variables import UPPER_LIMIT_ONLY as UPPER_LIMIT_ONLY
from gyrostab.schema.variables import VARIABLES as VARIABLES
from gyrostab.schema.variables import attributes as attributes
from gyrostab.schema.variables import flag_attributes as flag_attributes

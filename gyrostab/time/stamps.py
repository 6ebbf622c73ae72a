"""Time stamps as integers, nanoseconds since 1970-01-01T00:00:00 UTC, and as text."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def to_nanoseconds(stamps: Any) -> NDArray[np.int64]:
    """Convert datetime64 of the years 1678 to 2262 to integers.

    Examples
    --------
    >>> to_nanoseconds(np.array(["1970-01-01T00:00:02"], dtype="datetime64[s]"))
    array([2000000000])
    """
    return np.asarray(stamps).astype("datetime64[ns]", copy=False).view(np.int64)


def format_stamp(stamp: int) -> str:
    """Format a stamp as ISO 8601, to the millisecond.

    Examples
    --------
    >>> format_stamp(2_000_000_000), format_stamp(np.iinfo(np.int64).min)
    ('1970-01-01T00:00:02.000', 'no stamp')
    """
    date = np.datetime64(int(stamp), "ns").astype("datetime64[ms]")
    return "no stamp" if np.isnat(date) else str(date)

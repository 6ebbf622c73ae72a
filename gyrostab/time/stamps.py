"""Time stamps as integers, nanoseconds since 1970-01-01T00:00:00 UTC, and as text."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import TimeError


def to_nanoseconds(stamps: Any, *, far_as_nat: bool = False) -> NDArray[np.int64]:
    """Convert datetime64 of any unit to integers; ``NaT`` becomes the lowest one.

    Dates before 1678 or after 2262 exceed 64 bits; numpy would wrap them around without an error.

    Parameters
    ----------
    far_as_nat : bool
        Treat such dates as ``NaT``.

    Raises
    ------
    TimeError
        When there are such dates.

    Examples
    --------
    >>> to_nanoseconds(np.array(["1970-01-01T00:00:02"], dtype="datetime64[s]"))
    array([2000000000])
    """
    dates = np.asarray(stamps)
    dates = dates.astype(dates.dtype.newbyteorder("="), copy=False)
    if dates.dtype.kind == "M" and dates.dtype != np.dtype("datetime64[ns]"):
        low, high = (
            np.datetime64(day, "D").astype(dates.dtype) for day in ("1677-09-22", "2262-04-11")
        )
        is_far = (dates <= low) | (dates > high)
        if is_far.any() and not far_as_nat:
            raise TimeError(
                f"the time {dates[is_far].flat[0]} is outside the years 1678 to 2262, which 64-bit "
                "nanoseconds hold; correct it"
            )
        dates = np.where(is_far, np.datetime64("NaT"), dates) if is_far.any() else dates
    return dates.astype("datetime64[ns]", copy=False).view(np.int64)


def format_stamp(stamp: int) -> str:
    """Format a stamp as ISO 8601, to the millisecond.

    Examples
    --------
    >>> format_stamp(2_000_000_000), format_stamp(np.iinfo(np.int64).min)
    ('1970-01-01T00:00:02.000', 'no stamp')
    """
    date = np.datetime64(int(stamp), "ns").astype("datetime64[ms]")
    return "no stamp" if np.isnat(date) else str(date)

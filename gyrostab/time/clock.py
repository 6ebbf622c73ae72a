"""The current time for histories, or the fixed time of a reproducible build."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from typing import Any

from gyrostab.errors import OptionError


def time_of_day() -> str:
    """Return the current time, UTC, as ISO 8601.

    The environment variable ``SOURCE_DATE_EPOCH`` [s since 1970] replaces the clock if it is set.

    With that variable, the same inputs, options and versions make the same file, byte for byte.

    Raises
    ------
    OptionError
        When the variable is not an integer number of seconds.

    References
    ----------
    https://reproducible-builds.org/specs/source-date-epoch/

    Examples
    --------
    >>> len(time_of_day())
    20
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        now = datetime.now(UTC) if not epoch else datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise OptionError(
            f"SOURCE_DATE_EPOCH={epoch!r} in the environment is not a whole number of seconds "
            "since 1970; unset it"
        ) from error
    return f"{now:%Y-%m-%dT%H:%M:%SZ}"


def extend_history(log: Any, done: str) -> str:
    """Return the history of a log with one more line: the current time, and what was done."""
    earlier = str(log.attrs.get("history") or "")
    return "\n".join(filter(None, [earlier, f"{time_of_day()} {done}"]))

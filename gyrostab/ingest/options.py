"""Reading options of the user, and the summary of a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gyrostab.errors import OptionError
from gyrostab.ingest.limits import check_limits
from gyrostab.time.grid import check_rate
from gyrostab.time.stamps import stamp_ns


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Options of a reader, checked once.

    Parameters
    ----------
    rate, start, epoch, map, unit, missing_value, kind, channel, strict, limits
        As for `gyrostab.read_log`.
    channels_only : bool
        Whether the file is read only for its channels, without gyro axes.
    growing : bool
        Whether the file is still written: the last line of a text file counts once it has its end.

    Examples
    --------
    >>> ReadOptions(rate=400.0, unit={"gyro": "deg/s"}).rate
    400.0
    """

    rate: float | None = None
    start: str | None = None
    epoch: str | None = None
    map: Mapping[str, str] = field(default_factory=dict)
    unit: Mapping[str, str] = field(default_factory=dict)
    missing_value: Any = ()  # a number or several, which become a tuple
    kind: str | None = None
    channel: str | Path | Sequence[str | Path] = ()
    channels_only: bool = False
    growing: bool = False
    strict: bool = False
    limits: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.rate is not None:
            check_rate(self.rate, "--rate")
        if self.kind not in (None, "rate", "angle"):
            raise OptionError(
                f"--kind {self.kind}: choose 'rate' (increment of each sample) or 'angle' "
                "(cumulative angle)"
            )
        for name in ("start", "epoch"):
            value = getattr(self, name)
            if value is not None:
                stamp_ns(value, f"--{name}")
        for name in ("map", "unit"):
            given = getattr(self, name) or {}
            if not isinstance(given, Mapping):
                example = {"wx": "gyro_x"} if name == "map" else {"gyro": "deg/s"}
                raise OptionError(f"{name}={given!r}: give a mapping, for instance {example}")
            given = {str(key): value for key, value in given.items()}
            for key, value in given.items():
                if not isinstance(value, str):
                    raise OptionError(f"--{name} {key}: {value!r} is not a text; give one")
            object.__setattr__(self, name, given)
        object.__setattr__(self, "missing_value", _check_codes(self.missing_value))
        object.__setattr__(self, "limits", check_limits(self.limits))
        object.__setattr__(self, "channel", self.channel or ())

    @property
    def epoch_ns(self) -> int:
        """Epoch of numeric time [ns since 1970]."""
        return 0 if self.epoch is None else stamp_ns(self.epoch, "--epoch")


def _check_codes(given: Any) -> tuple[float, ...]:
    """Return the numbers that mean a missing value."""
    codes = (given,) if np.ndim(given) == 0 else tuple(given)
    try:
        numbers = tuple(map(float, codes))
    except (TypeError, ValueError):
        numbers = (np.nan,)
    if not np.isfinite(numbers).all():
        raise OptionError(
            f"--missing-value {', '.join(map(str, codes))}: give a number such as -999.25; what is "
            "not a number is missing anyway"
        )
    return numbers


@dataclass(frozen=True)
class ColumnSummary:
    """One column of a file: its name there, its role and unit here."""

    header: str
    name: str
    role: str  # "time", "gyro", "channel" or "left out"
    unit: str | None
    key: str = ""  # name for --map


@dataclass(frozen=True)
class FileSummary:
    """Summary of a file; stamps and row count only if they do not cost a pass over the data."""

    path: Path
    format: str
    columns: tuple[ColumnSummary, ...] = ()
    axes: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    first: np.datetime64 | None = None
    last: np.datetime64 | None = None
    n_rows: int | None = None
    notes: tuple[str, ...] = ()

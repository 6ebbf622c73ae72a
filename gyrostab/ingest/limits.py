"""Limits of the readers, each with its reason and the option that raises it.

A reader knows rows, columns and bytes of a file before it reads values, and the regularisation
knows rows and samples before it allocates the grid. They compare these numbers with the limits, so
a damaged or absurd file ends in one message: with the numbers, and the option that raises the
limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gyrostab.errors import FormatError, OptionError

if TYPE_CHECKING:
    import xarray as xr

#: Name -> largest number and what it counts; ``--limit NAME=NUMBER`` raises it
#: (``limits={"NAME": NUMBER}`` in Python).
LIMITS: Mapping[str, tuple[float, str]] = {
    # A logger writes tens of columns, a bus recorder thousands. The header of this many is
    # understood in a few seconds; beyond it the separator is probably wrong, or the table is
    # transposed.
    "columns": (30_000, "columns"),
    # A channel takes 8 bytes a row in memory or in a temporary file, and xarray looks through all
    # variables for each of them. Channels with a known name, and those that --map or --unit names,
    # are kept beyond it.
    "channels": (200, "channels"),
    # The default --max-gap of 10 days at 1 kHz makes 8.6e8 samples. An axis of 1e9 samples takes
    # about ten seconds to analyse (10 ns a sample) even if the file has a hundred rows. Above it a
    # grid may have 100 samples for each row, which allows a recorder that runs for 1 % of the time.
    "grid_samples": (1e9, "samples of one axis"),
    # As for grid_samples. Above it a file may have 1000 samples for each of its bytes: deflate
    # never packs more than 1032 bytes into one, so a file below that ratio holds almost no written
    # values.
    "stored_samples": (1e9, "samples of all columns"),
    # A chunk is decoded as a whole in memory, and those of all columns that are read side by side
    # are held: 256 MiB keep a run near 1.5 GiB. Such a chunk holds 23 hours of one axis at 400 Hz
    # in doubles; usual chunks hold 1 to 128 MiB.
    "chunk_bytes": (2**28, "bytes"),
}

#: Largest plausible ratio of grid samples to rows, and of declared samples to bytes; see `LIMITS`.
GRID_SAMPLES_PER_ROW = 100
STORED_SAMPLES_PER_BYTE = 1000
#: Largest plausible ratio of the bytes of all arrays to those of their file: deflate reaches 1032
#: with equal values, 400 with a channel that is held for 400 samples, and 5 to 15 with rates that
#: are rounded to a few steps.
PACKED_RATIO = 100


def check_limits(given: Mapping[str, Any] | None) -> dict[str, float]:
    """Check the limits that a user set, and return them as numbers.

    Examples
    --------
    >>> check_limits({"columns": "5e4"})
    {'columns': 50000.0}
    """
    limits = {}
    for name, text in (given or {}).items():
        if name not in LIMITS:
            raise OptionError(f"--limit {name}: unknown limit; the limits are {', '.join(LIMITS)}")
        try:
            limits[name] = float(text)
        except (TypeError, ValueError) as error:
            unit = LIMITS[name][1]
            raise OptionError(f"--limit {name}={text}: give a number of {unit}") from error
        if not limits[name] > 0:
            raise OptionError(f"--limit {name}={text}: give a number above 0")
    return limits


def limit_value(name: str, given: Mapping[str, float] | None = None) -> float:
    """Return a limit, as set by the user or by default.

    Examples
    --------
    >>> limit_value("columns"), limit_value("columns", {"columns": 5e4})
    (30000, 50000.0)
    """
    return (given or {}).get(name, LIMITS[name][0])


def describe_limit(name: str, needed: float, given: Mapping[str, float] | None = None) -> str:
    """Return the end of a message: the limit, and the option that raises it.

    Examples
    --------
    >>> describe_limit("columns", 99_999)
    'the limit is 3e+04 columns, and --limit columns=1e+05 lifts it'
    """
    allowed = limit_value(name, given)
    return (
        f"the limit is {allowed:.4g} {LIMITS[name][1]}, and --limit "
        f"{name}={_round_up(needed)} lifts it"
    )


def _round_up(needed: float) -> str:
    """Round up to two digits.

    Examples
    --------
    >>> _round_up(1_010_000), _round_up(7)
    ('1.1e+06', '7')
    """
    needed = float(min(needed, 1e300))  # damaged files declare integers beyond any float
    digits = 10.0 ** (max(np.floor(np.log10(max(needed, 1.0))), 1.0) - 1.0)
    return f"{np.ceil(needed / digits) * digits:.2g}"


def is_absurd_grid(samples: int, rows: int, given: Mapping[str, float] | None = None) -> bool:
    """Return whether a grid has far more samples than rows; see ``grid_samples`` in `LIMITS`.

    Examples
    --------
    >>> is_absurd_grid(8 * 86400 * 400, 1000), is_absurd_grid(9 * 86400 * 10_000, 1000)
    (False, True)
    """
    return samples > max(limit_value("grid_samples", given), GRID_SAMPLES_PER_ROW * rows)


def check_stored(
    path: Path, rows: int, columns: int, given: Mapping[str, float] | None = None
) -> None:
    """Refuse a file that declares far more samples than its bytes can hold."""
    claimed = rows * columns
    if claimed <= limit_value("stored_samples", given):
        return
    files = path.rglob("*") if path.is_dir() else [path]
    present = sum(file.stat().st_size for file in files if file.is_file())
    if claimed > STORED_SAMPLES_PER_BYTE * present:
        raise FormatError(
            f"{path.name}: it declares {rows:.4g} samples in each of {columns} columns, but "
            f"holds {present:,} bytes: nearly all of them "
            "were never written. Copy it again, or cut it to what was recorded; "
            f"{describe_limit('stored_samples', claimed, given)}"
        )


def check_declared(
    path: Path, variables: Mapping[Any, xr.Variable], *, given: Mapping[str, float] | None = None
) -> None:
    """Refuse variables of which the largest is out of proportion to the bytes of its file."""
    shape = max((item.shape for item in variables.values()), key=math.prod, default=())
    rows = max(shape, default=0)
    check_stored(path, rows, math.prod(shape) // max(rows, 1), given)


def check_columns(path: Path, columns: int, given: Mapping[str, float] | None = None) -> None:
    """Refuse a table with too many columns."""
    if columns > limit_value("columns", given):
        raise FormatError(
            f"{path.name}: it has {columns:,} columns; is the separator another one, or is the "
            "table transposed? Write a file of the "
            f"columns that are needed; {describe_limit('columns', columns, given)}"
        )


def check_chunk(
    path: Path, name: str, chunk_bytes: int, given: Mapping[str, float] | None = None
) -> None:
    """Refuse a variable whose chunks are too large to decode in memory."""
    if chunk_bytes > limit_value("chunk_bytes", given):
        raise FormatError(
            f"{path.name}: a chunk of {name!r} has {chunk_bytes:.4g} bytes. If the file is "
            "damaged, copy it again, else store it in "
            f"smaller chunks; {describe_limit('chunk_bytes', chunk_bytes, given)}"
        )


def check_packed(
    path: Path, packed_bytes: int, unpacked_bytes: int, given: Mapping[str, float] | None = None
) -> None:
    """Refuse a compressed file whose arrays need far more memory than its bytes."""
    if unpacked_bytes > max(limit_value("chunk_bytes", given), PACKED_RATIO * packed_bytes):
        raise FormatError(
            f"{path.name}: arrays of {unpacked_bytes:.4g} bytes are packed into {packed_bytes:,} "
            "bytes, so that nearly all of their values are equal. If the file is damaged, copy it "
            f"again; {describe_limit('chunk_bytes', unpacked_bytes, given)}"
        )

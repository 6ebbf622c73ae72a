"""One channel of another file, on its own time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from gyrostab.errors import OptionError
from gyrostab.ingest.combine import attach_channels
from gyrostab.ingest.files import read_file
from gyrostab.ingest.options import ReadOptions


def read_channel(
    path: str | Path,
    name: str = "temperature",
    *,
    epoch: str | None = None,
    map: Mapping[str, str] | None = None,
    unit: Mapping[str, str] | None = None,
) -> xr.DataArray:
    r"""Read one channel from a file in any readable format; the file needs no gyro axes.

    Parameters
    ----------
    path : path
        File with a time column.
    name : str
        Name of the channel after `map` is applied.
    epoch, map, unit
        As for `gyrostab.read_log`.

    Returns
    -------
    xarray.DataArray
        Values on ``time_<name>``, with units of `gyrostab.units.INNER`.

    Raises
    ------
    FormatError, UnitError, OptionError, TimeError
        When the file cannot be read or does not contain the channel.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = Path(mkdtemp()) / "probe.csv"
    >>> _ = path.write_text("time [s],temperature [degC]\n0.0,20.5\n1.0,21.0\n")
    >>> read_channel(path).values
    array([20.5, 21. ])
    """
    chosen: dict[str, Any] = {"epoch": epoch, "map": dict(map or {}), "unit": dict(unit or {})}
    channels = attach_channels(
        xr.Dataset(), [read_file(Path(path), ReadOptions(channels_only=True, **chosen))]
    )
    if name not in channels.data_vars:
        available = ", ".join(sorted(str(key) for key in channels.data_vars))
        raise OptionError(
            f"{path}: no channel {name!r}; the channels are {available}: name one of these, or "
            "rename one with --map"
        )
    return channels[name]

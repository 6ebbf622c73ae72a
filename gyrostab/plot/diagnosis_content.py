"""What figures and interactive charts of a diagnosis both draw."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

Array = NDArray[np.float64]
MAX_CHANNELS = 3  # panels below the means
INSIDE_BAND_OPACITY = 0.3  # of cells inside the 95 % band


def find_regions(
    content: Mapping[str, Any], axis: str, *, over_tau: bool
) -> list[Mapping[str, Any]]:
    """Find the mismatches of an axis over averaging times, or those of its mean rate."""
    views = ("davar", "cross_axis") if over_tau else ("mean", "restart")
    regions = [region for region in content["mismatches"] if axis in region["axes"]]
    regions = [region for region in regions if region["view"] in views]
    return [region for region in regions if not over_tau or region["tau_min_s"]]


def find_change(surfaces: xr.Dataset, case: str) -> tuple[Array, Array]:
    """Divide the Allan deviation of the recording by that of a simulation, (axis, window, tau).

    The second array is the opacity of each cell, less inside the 95 % band of the simulation.
    """
    names = ["avar", "avar_low", "avar_high"]
    cells = surfaces[names].transpose("case", "axis", "window", "tau")
    recording = cells["avar"].sel(case="recording").values
    avar, low, high = (cells[name].sel(case=case).values for name in names)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sqrt(recording / avar)
        is_usual = (recording >= low) & (recording <= high)
    return ratio, np.where(is_usual, INSIDE_BAND_OPACITY, 1.0)


def select_channels(surfaces: xr.Dataset, content: Mapping[str, Any]) -> list[str]:
    """Return the channels to draw: first those that named effects follow."""
    available = [
        str(name).removeprefix("channel_")
        for name in surfaces.data_vars
        if str(name).startswith("channel_")
    ]
    available = [
        name for name in available if np.isfinite(surfaces[f"channel_{name}"].values).any()
    ]
    named = [
        name.strip()
        for effect in content["effects"]
        for name in str(effect["driver"] or "").split(",")
    ]
    usual = [name for name in ("temperature", "vibration", "rotation_rate") if name in available]
    first = [name for name in dict.fromkeys(named) if name in available]
    return list(dict.fromkeys([*first, *usual]))[:MAX_CHANNELS]

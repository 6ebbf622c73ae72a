"""Compute the surfaces of recording and simulation for `diagnosis.nc` and the report."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from scipy.special import gammaincinv

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.reduce.schema import Variable, label_variables
from gyrostab.diagnose.statistics.allan_surface import allan_surface
from gyrostab.diagnose.statistics.mean import window_means
from gyrostab.diagnose.statistics.scores import BlockWindows, sum_over_windows

#: The three cases side by side: the simulation without and with the effects.
CASES = ("recording", "before", "after")
WINDOW_BLOCKS = 15  # 5 min at 20 s: the length of the windows of the DAVAR in the report
MAX_WINDOWS = 240  # columns that a page can show
_ATTRIBUTES = ("start", "start_ns", "sampling_rate_hz", "block_s")
MAX_LINES = 4000  # bins of the line spectrum in `diagnosis.nc`: enough for a page, small on disk

_MEAN, _AVAR = ("case", "axis", "window"), ("case", "axis", "window", "tau")
_SQUARE, _POWER = "degree2 hour-2", "degree2 hour-2 s"
_SURFACES = {
    "avar": Variable(_AVAR, _SQUARE, "Allan variance"),
    "avar_low": Variable(_AVAR, _SQUARE, "lower end of the 95 % band"),
    "avar_high": Variable(_AVAR, _SQUARE, "upper end of the 95 % band"),
    "mean": Variable(_MEAN, "degree hour-1", "mean rate"),
    "mean_stderr": Variable(_MEAN, "degree hour-1", "standard deviation of the mean"),
    "time": Variable(("window",), "", "middle of the window"),
    "begin": Variable(("window",), "s", "start of the window, since the start"),
    "end": Variable(("window",), "s", "end of the window, since the start"),
    "tau": Variable(("tau",), "s", "averaging time"),
    "density": Variable(("case", "axis", "band"), _POWER, "two-sided power density of the record"),
    "line_density": Variable(("axis", "line"), _POWER, "two-sided power density of the recording"),
}


def make_surfaces(blocks: xr.Dataset, before: xr.Dataset, after: xr.Dataset) -> xr.Dataset:
    """Compute Allan variances and window means of the recording, and of both simulations.

    The baselines are those without and with the effects; ``case`` is one of `CASES`. The results
    have the variables of `_SURFACES`, with the 95 % bands and standard deviations of recordings of
    that simulation (NaN for the recording itself), and block means and channels for the report.
    """
    windows = _make_windows(blocks.sizes["block"])
    plain = before.assign(known_mean=before["known_mean"] * 0.0)
    recorded = allan_surface(blocks, plain, windows)
    keep = (recorded["columns"]["quantity"] == "avar") & np.isfinite(recorded["shape"]).any(
        axis=(0, 1)
    )
    avar = [recorded["observed"][..., keep]]
    low, high = ([np.full(avar[0].shape, np.nan)] for _ in range(2))
    mean = [_average_windows(blocks, blocks["mean"].values, windows)]
    error = [np.full(mean[0].shape, np.nan)]
    for baseline in (before, after):
        case = _simulate_case(blocks, baseline, windows, recorded["observed"], keep)
        for values, added in zip((avar, low, high, mean, error), case, strict=True):
            values.append(added)
    begin, end = blocks["begin"].values[windows.first], blocks["end"].values[windows.stop - 1]
    start = np.datetime64(int(blocks.attrs["start_ns"]), "ns")
    has_data = np.isfinite(blocks["power"])
    density = [
        case.where(has_data).mean("block").values
        for case in (blocks["power"], before["spectrum"], after["spectrum"])
    ]
    highest, resolution = _highest_lines(blocks)
    arrays: dict[str, Any] = {
        "avar": np.stack(np.broadcast_arrays(*avar)),
        "avar_low": np.stack(np.broadcast_arrays(*low)),
        "avar_high": np.stack(np.broadcast_arrays(*high)),
        "mean": np.stack(mean),
        "mean_stderr": np.stack(np.broadcast_arrays(*error)),
        "density": np.stack(density),
        "line_density": highest.values,
        "time": start + np.rint((begin + end) / 2.0 * 1e9).astype("timedelta64[ns]"),
        "begin": begin,
        "end": end,
        "tau": recorded["columns"]["tau_min_s"][keep],
    }
    names = [str(name) for name in blocks.data_vars if str(name).startswith("channel_")]
    out = xr.Dataset(
        label_variables(arrays, _SURFACES) | {name: blocks[name].variable for name in names},
        coords={
            "case": list(CASES),
            "axis": [str(axis) for axis in blocks["axis"].values],
            "block_begin": blocks["begin"].variable,
            "block_end": blocks["end"].variable,
            "frequency": blocks["frequency"].variable,
            "line_frequency": highest["line_frequency"].variable,
        },
        attrs={name: blocks.attrs[name] for name in _ATTRIBUTES if name in blocks.attrs},
    ).assign(block_mean=blocks["mean"].variable)
    out["line_density"].attrs["long_name"] += resolution
    return out.set_coords(["time", "begin", "end", "tau"])


def _simulate_case(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    windows: BlockWindows,
    observed: Floats,
    keep: Bools,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return the Allan variance of a simulation with its 95 % band, and means with their errors.

    `observed` is the surface of the recording, of which `keep` are the columns of Allan variances.
    """
    noise = allan_surface(blocks, baseline, windows)
    shape, expected = noise["shape"][..., keep], noise["expected"][..., keep]
    with np.errstate(invalid="ignore"):
        avar = expected + _known_avar(blocks, baseline, windows)[..., keep]
        # what the known mean adds to the Allan variance of this noise
        shift = (observed - noise["observed"])[..., keep]
        low = expected * gammaincinv(shape, 0.025) / shape + shift
        high = expected * gammaincinv(shape, 0.975) / shape + shift
        error = 1.0 / np.sqrt(window_means(blocks, baseline, windows)[1])
    return avar, low, high, _predicted_means(blocks, baseline, windows), error


def _highest_lines(blocks: xr.Dataset) -> tuple[xr.DataArray, str]:
    """Average the line spectra, and keep the highest of neighbouring lines where there are many.

    Also return of how many, for the label.
    """
    step = -(-blocks.sizes["line"] // MAX_LINES)
    lines = blocks["line_power"].weighted(blocks["line_weight"].fillna(0.0)).mean("part")
    highest = lines.coarsen(line=step, boundary="trim").max()
    return highest, f", highest of {step} lines" if step > 1 else " at full resolution"


def _make_windows(block_count: int) -> BlockWindows:
    length = min(WINDOW_BLOCKS, max(1, block_count // 2))
    step = max(1, block_count // MAX_WINDOWS)
    first = np.arange(0, block_count - length + 1, step)
    return BlockWindows(first, first + length)


def _known_avar(blocks: xr.Dataset, baseline: xr.Dataset, windows: BlockWindows) -> Floats:
    """Return the Allan variance of the known mean, which that of the noise does not include."""
    means = np.where(np.isfinite(blocks["mean"].values), baseline["known_mean"].values, np.nan)
    known_only = blocks.assign(mean=(("axis", "block"), means))
    surface = allan_surface(
        known_only, baseline.assign(known_mean=baseline["known_mean"] * 0.0), windows
    )
    return np.asarray(
        np.where(
            surface["columns"]["tau_min_s"] >= float(blocks.attrs["block_s"]),
            surface["observed"],
            0.0,
        )
    )


def _average_windows(blocks: xr.Dataset, values: Floats, windows: BlockWindows) -> Floats:
    """Average over windows, weighted with the samples present where the recording has a mean."""
    weight = np.where(np.isfinite(blocks["mean"].values), blocks["samples"].values, 0.0)
    sums = sum_over_windows(np.where(weight > 0, values, 0.0) * weight, windows, axis=-1)
    total = sum_over_windows(weight, windows, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(total > 0, sums / total, np.nan))


def _predicted_means(blocks: xr.Dataset, baseline: xr.Dataset, windows: BlockWindows) -> Floats:
    """Return the window means of the effects plus the constant that fits the recording."""
    known_mean, mean = baseline["known_mean"].values, blocks["mean"].values
    weight = np.where(np.isfinite(mean), 1.0 / baseline["mean_variance"].values, 0.0)
    weight = np.where(np.isfinite(weight), weight, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        level = (weight * np.nan_to_num(mean - known_mean)).sum(
            axis=-1, keepdims=True
        ) / weight.sum(axis=-1, keepdims=True)
    return _average_windows(blocks, known_mean + level, windows)

"""Compute the surfaces of recording and simulation for `diagnosis.nc` and the report."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import gammaincinv

from gyrostab.diagnose.statistics.mean import window_means
from gyrostab.diagnose.statistics.power import allan_surface
from gyrostab.diagnose.statistics.scores import Array, Windows, sum_over_windows

#: The three cases side by side: the simulation without and with the effects.
CASES = ("recording", "before", "after")
WINDOW_BLOCKS = 15  # 5 min at 20 s: the length of the windows of the DAVAR in the report
MAX_WINDOWS = 240  # columns that a page can show
MAX_LINES = 4000  # bins of the line spectrum in `diagnosis.nc`: enough for a page, small on disk


def make_surfaces(blocks: xr.Dataset, before: xr.Dataset, after: xr.Dataset) -> xr.Dataset:
    """Compute Allan variances and window means of the recording, and of both simulations.

    Parameters
    ----------
    before, after : xarray.Dataset
        Baselines without and with the effects.

    Returns
    -------
    xarray.Dataset
        ``avar`` (case, axis, window, tau) [degree2 hour-2], case one of `CASES`; ``avar_low``,
        ``avar_high``, the band of 95 % of recordings of that simulation (NaN for the recording
        itself); ``mean`` (case, axis, window) [degree hour-1] and ``mean_stderr``, the standard
        deviation of a recording of that simulation; coordinates ``begin``, ``end`` [s since the
        start], ``time``, ``tau`` [s].
    """
    windows = _make_windows(blocks.sizes["block"])
    plain = before.assign(known_mean=before["known_mean"] * 0.0)
    recorded = allan_surface(blocks, plain, windows)
    keep = (recorded["columns"]["what"] == "avar") & np.isfinite(recorded["shape"]).any(axis=(0, 1))
    avar = [recorded["observed"][..., keep]]
    low, high = ([np.full(avar[0].shape, np.nan)] for _ in range(2))
    mean = [_average_windows(blocks, blocks["mean"].values, windows)]
    error = [np.full(mean[0].shape, np.nan)]
    for baseline in (before, after):
        noise = allan_surface(blocks, baseline, windows)
        shape = noise["shape"][..., keep]
        expected = noise["expected"][..., keep]
        with np.errstate(invalid="ignore"):
            avar.append(expected + _known_avar(blocks, baseline, windows)[..., keep])
            # what the known mean adds to the Allan variance of this noise
            shift = (recorded["observed"] - noise["observed"])[..., keep]
            low.append(expected * gammaincinv(shape, 0.025) / shape + shift)
            high.append(expected * gammaincinv(shape, 0.975) / shape + shift)
            information = window_means(blocks, baseline, windows)[1]
            error.append(1.0 / np.sqrt(information))
        mean.append(_predicted_means(blocks, baseline, windows))
    return _attach_labels(
        blocks, windows, recorded["columns"]["tau_min_s"][keep], [avar, low, high], [mean, error]
    )


def _make_windows(block_count: int) -> Windows:
    length = min(WINDOW_BLOCKS, max(1, block_count // 2))
    step = max(1, block_count // MAX_WINDOWS)
    first = np.arange(0, block_count - length + 1, step)
    return Windows(first, first + length)


def _known_avar(blocks: xr.Dataset, baseline: xr.Dataset, windows: Windows) -> Array:
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


def _average_windows(blocks: xr.Dataset, values: Array, windows: Windows) -> Array:
    """Average over windows, weighted with the samples present where the recording has a mean."""
    weight = np.where(np.isfinite(blocks["mean"].values), blocks["samples"].values, 0.0)
    sums = sum_over_windows((np.where(weight > 0, values, 0.0) * weight)[..., None], windows)[
        ..., 0
    ]
    total = sum_over_windows(weight[..., None], windows)[..., 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(total > 0, sums / total, np.nan))


def _predicted_means(blocks: xr.Dataset, baseline: xr.Dataset, windows: Windows) -> Array:
    """Return the window means of the effects plus the constant that fits the recording."""
    known_mean, mean = baseline["known_mean"].values, blocks["mean"].values
    weight = np.where(np.isfinite(mean), 1.0 / baseline["mean_variance"].values, 0.0)
    weight = np.where(np.isfinite(weight), weight, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        level = (weight * np.nan_to_num(mean - known_mean)).sum(
            axis=-1, keepdims=True
        ) / weight.sum(axis=-1, keepdims=True)
    return _average_windows(blocks, known_mean + level, windows)


def _attach_labels(
    blocks: xr.Dataset, windows: Windows, tau: Array, squares: list[Any], means: list[Any]
) -> xr.Dataset:
    dims = ("case", "axis", "window", "tau")
    begin, end = blocks["begin"].values[windows.first], blocks["end"].values[windows.stop - 1]
    start = np.datetime64(int(blocks.attrs["start_ns"]), "ns")
    middle = start + np.rint((begin + end) / 2.0 * 1e9).astype("timedelta64[ns]")
    names = {
        "avar": ("degree2 hour-2", "Allan variance"),
        "avar_low": ("degree2 hour-2", "lower end of the 95 % band"),
        "avar_high": ("degree2 hour-2", "upper end of the 95 % band"),
        "mean": ("degree hour-1", "mean rate"),
        "mean_stderr": ("degree hour-1", "standard deviation of the mean"),
    }
    data: dict[str, Any] = {}
    for (name, (units, long_name)), cases in zip(names.items(), [*squares, *means], strict=True):
        values = np.stack(np.broadcast_arrays(*cases))
        data[name] = (dims[: values.ndim], values, {"units": units, "long_name": long_name})
    coordinates: dict[str, Any] = {
        "case": ("case", list(CASES)),
        "axis": ("axis", [str(axis) for axis in blocks["axis"].values]),
        "time": ("window", middle, {"long_name": "middle of the window"}),
        **{
            name: (dim, values, {"units": "s", "long_name": long_name})
            for name, dim, values, long_name in (
                ("begin", "window", begin, "start of the window, since the start"),
                ("end", "window", end, "end of the window, since the start"),
                ("tau", "tau", tau, "averaging time"),
            )
        },
    }
    attributes = {
        name: blocks.attrs[name]
        for name in ("start", "start_ns", "sampling_rate_hz", "block_s")
        if name in blocks.attrs
    }
    return xr.Dataset(data, coords=coordinates, attrs=attributes)


def surfaces_with_blocks(
    surfaces: xr.Dataset, blocks: xr.Dataset, before: xr.Dataset, after: xr.Dataset
) -> xr.Dataset:
    """Add block means, channels and spectra of the whole record to the surfaces, for the report."""
    power = "degree2 hour-2 s"
    channels = {
        str(name): blocks[name] for name in blocks.data_vars if str(name).startswith("channel_")
    }
    with np.errstate(invalid="ignore"):
        cases = [blocks["power"], before["spectrum"], after["spectrum"]]
        has_data = np.isfinite(blocks["power"].values)
        density = np.stack([_average_where(case.values, has_data) for case in cases])
        lines = blocks["line_power"].weighted(blocks["line_weight"].fillna(0.0)).mean("part")
    step = -(-lines.sizes["line"] // MAX_LINES)
    lines = lines.coarsen(line=step, boundary="trim").max()
    frequency = blocks["line_frequency"].coarsen(line=step, boundary="trim").mean()
    added = xr.Dataset(
        {
            "block_mean": (("axis", "block"), blocks["mean"].values, dict(blocks["mean"].attrs)),
            "density": (
                ("case", "axis", "band"),
                density,
                {"units": power, "long_name": "two-sided power density of the record"},
            ),
            "line_density": (
                ("axis", "line"),
                lines.values,
                {
                    "units": power,
                    "long_name": "two-sided power density of the recording"
                    + (f", highest of {step} lines" if step > 1 else " at full resolution"),
                },
            ),
            **{
                name: ("block", values.values, dict(values.attrs))
                for name, values in channels.items()
            },
        },
        coords={
            "block_begin": ("block", blocks["begin"].values, dict(blocks["begin"].attrs)),
            "block_end": ("block", blocks["end"].values, dict(blocks["end"].attrs)),
            "frequency": ("band", blocks["frequency"].values, dict(blocks["frequency"].attrs)),
            "line_frequency": ("line", frequency.values, dict(blocks["line_frequency"].attrs)),
        },
    )
    return surfaces.merge(added, compat="no_conflicts", join="exact")


def _average_where(values: Array, has_data: NDArray[np.bool_]) -> Array:
    count = has_data.sum(axis=1)
    return np.asarray(
        np.divide(
            np.where(has_data, values, 0.0).sum(axis=1),
            count,
            out=np.full(count.shape, np.nan),
            where=count > 0,
        )
    )

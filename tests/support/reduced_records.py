"""Block statistics drawn from their distributions in noise, and the baseline of this noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.nulls.scores import NullScores, standardise
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.noise import TERMS

RATE, BLOCK_S, PARTS = 100.0, 20.0, 16


def frame(
    *, block_count: int = 180, missing: float = 0.0, rate: float = RATE, block_s: float = BLOCK_S
) -> dict[str, Any]:
    """Return bands, shapes and edges common to all records."""
    half = int(block_s * rate / 2)
    edges = np.unique(np.round(np.geomspace(1, half, 15)).astype(int))
    edges[-1] += 1
    step = 1.0 / block_s
    return {
        "low": (edges[:-1] - 0.5) * step,
        "high": (edges[1:] - 0.5) * step,
        "shape": 0.86 * np.diff(edges) * (1.0 - missing),
        "lines": np.arange(1, half + 1) * step,
        "blocks": block_count,
        "rate": rate,
        "block_s": block_s,
        "samples": round(block_s * rate * (1.0 - missing)),
    }


def baseline(
    *,
    axes: str = "xyz",
    noise: float = 0.003,
    flicker: float = 0.0,
    walk: float = 0.0,
    **options: Any,
) -> xr.Dataset:
    """White noise [deg/sqrt(h)], flicker [deg/h] and random walk [deg/h^1.5] on every axis."""
    f = frame(**options)
    level = 3600.0 * noise**2
    coefficient = np.zeros((len(axes), len(TERMS)))
    for term, value in (("N", noise), ("B", flicker), ("K", walk)):
        coefficient[:, TERMS.index(term)] = value
    frequency = (f["low"] + f["high"]) / 2.0
    spectrum = (
        level + flicker**2 / (2 * np.pi * frequency) + (walk / 60.0 / (2 * np.pi * frequency)) ** 2
    )
    shape = (len(axes), f["blocks"])
    return xr.Dataset(
        {
            "spectrum": (
                ("axis", "block", "band"),
                np.broadcast_to(spectrum, (*shape, frequency.size)).copy(),
            ),
            "known_mean": (("axis", "block"), np.zeros(shape)),
            "mean_variance": (("axis", "block"), np.full(shape, level * f["rate"] / f["samples"])),
            "angle_variance": (("axis",), np.zeros(shape[0])),
            "coefficient": (("axis", "term"), coefficient),
            "grid_K": (("axis", "grid"), np.full((len(axes), 1), walk)),
            "grid_B": (("axis", "grid"), np.full((len(axes), 1), flicker)),
            "grid_calibrated": (("axis", "grid"), np.zeros((len(axes), 1))),
        },
        coords={"axis": list(axes), "term": list(TERMS), "frequency": ("band", frequency)},
    )


def records(base: xr.Dataset, count: int, rng: np.random.Generator, **options: Any) -> xr.Dataset:
    """Draw `count` records without any effect, by ``record``."""
    f = frame(**options)
    axes, block_count = base.sizes["axis"], f["blocks"]
    spectrum, shape = base["spectrum"].values, np.broadcast_to(f["shape"], base["spectrum"].shape)
    power = spectrum * rng.gamma(np.broadcast_to(shape, (count, *shape.shape))) / shape
    pairs = [(a, b) for a in range(axes) for b in range(a + 1, axes)]
    cross = [_draw_cross(power[:, a], power[:, b], shape[a], rng) for a, b in pairs]
    weight = np.full((axes, PARTS), block_count / PARTS)
    density = np.stack([np.interp(f["lines"], base["frequency"], row) for row in spectrum[:, 0]])
    lines = (
        density[:, None]
        * rng.gamma(weight[0, 0], size=(count, axes, PARTS, f["lines"].size))
        / weight[0, 0]
    )
    plane, cube = ("record", "axis", "block"), ("record", "axis", "block", "band")
    names = [str(axis) for axis in base["axis"].values]
    data: dict[str, Any] = {
        "mean": (plane, _draw_means(base, count, rng, f)),
        "samples": (("axis", "block"), np.full((axes, block_count), f["samples"])),
        "neighbours": (("axis", "block"), np.ones((axes, block_count))),  # gaps are apart
        "power": (cube, power),
        "shape": (("axis", "block", "band"), shape),
        "line_power": (("record", "axis", "part", "line"), lines),
        "line_weight": (("axis", "part"), weight),
        "kurtosis": (
            plane,
            rng.normal(0.0, np.sqrt(24.0 / f["samples"]), (count, axes, block_count)),
        ),
    }
    no_pairs = np.empty((count, 0, *shape.shape[1:]), np.complex128)
    data["cross"] = (
        ("record", "pair", "block", "band"),
        np.stack(cross, axis=1) if pairs else no_pairs,
    )
    data["quantization_step"] = ("axis", np.zeros(axes))
    data |= {name: ("restart", np.empty(0)) for name in ("restart_begin", "restart_end")}
    for name in ("outliers", "repeats", "extremes", "zeros"):
        data[name] = (plane, rng.poisson(1e-5, (count, axes, block_count)))
    edges = np.arange(block_count + 1) * f["block_s"]
    coords = {
        "axis": names,
        "begin": ("block", edges[:-1]),
        "end": ("block", edges[1:]),
        "frequency": base["frequency"],
        "band_low": ("band", f["low"]),
        "band_high": ("band", f["high"]),
        "line_frequency": ("line", f["lines"]),
        "first": ("pair", [names[a] for a, _ in pairs]),
        "second": ("pair", [names[b] for _, b in pairs]),
    }
    attrs = {
        "sampling_rate_hz": f["rate"],
        "block_s": f["block_s"],
        "block_samples": round(f["block_s"] * f["rate"]),
        "start_ns": 1_790_000_000_000_000_000,
    }
    return xr.Dataset(data, coords=coords, attrs=attrs)


def chunks(
    base: xr.Dataset, count: int, rng: np.random.Generator, *, size: int = 25, **options: Any
):
    """Yield null records, `size` at a time."""
    for _ in range(count // size):
        yield records(base, size, rng, **options)


def smallest_p(blocks: xr.Dataset, base: xr.Dataset, null: NullScores) -> np.ndarray:
    """Return by record the smallest p-value over all statistics."""
    p = []
    for name, statistic in null.statistics.items():
        scores = find_statistic(name).score(blocks, base)
        if scores is not None:
            z = np.abs(np.nan_to_num(standardise(scores, statistic))).max(axis=(-3, -2, -1))
            p.append(null.p_value(name, z))
    return np.asarray(np.min(p, axis=0))


def _draw_cross(
    first: np.ndarray, second: np.ndarray, shape: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Draw cross-periodograms of independent axes: squared coherency is Beta(1, n - 1)."""
    squared = rng.beta(1.0, np.maximum(shape - 1.0, 1e-9), first.shape)
    return np.sqrt(first * second * squared) * np.exp(2j * np.pi * rng.random(first.shape))


def _draw_means(
    base: xr.Dataset, count: int, rng: np.random.Generator, f: dict[str, Any]
) -> np.ndarray:
    """Draw white noise, a random walk, and flicker from relaxing processes over many octaves."""
    axes, block_count = base.sizes["axis"], f["blocks"]
    mean = rng.normal(size=(count, axes, block_count)) * np.sqrt(base["mean_variance"].values)
    walk, flicker = (float(base["coefficient"].sel(term=term)[0]) for term in ("K", "B"))
    mean += np.cumsum(rng.normal(0.0, walk * np.sqrt(f["block_s"] / 3600.0), mean.shape), axis=-1)
    if flicker:
        for time in 10.0 * 2.0 ** np.arange(14):
            keep = np.exp(-f["block_s"] / time)
            state = rng.normal(size=mean.shape[:-1])
            for block in range(block_count):
                mean[..., block] += flicker * np.sqrt(np.log(2.0) / np.pi) * state
                state = keep * state + np.sqrt(1 - keep**2) * rng.normal(size=state.shape)
    return mean

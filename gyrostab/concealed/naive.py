"""Two plain detectors to compare with, and the Allan deviation that they need: a whole-record Allan plot, and correlation with channels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from gyrostab.concealed import floor

__all__ = ["allan_band", "allan_detector", "allan_variance", "channel_detector", "octaves"]

Array = NDArray[np.float64]

#: Level of both detectors.
LEVEL = 0.01


def octaves(size: int) -> list[int]:
    """Averaging factors 1, 2, 4 ... up to a tenth of a record of `size` samples.

    Examples
    --------
    >>> octaves(100)
    [1, 2, 4, 8]
    """
    return [2**k for k in range(max(1, int(math.log2(max(2, size // 10))))) if 2**k <= size // 10] or [1]


def allan_variance(values: Array, factors: list[int]) -> Array:
    """Overlapping Allan variance of rates (time,) with NaN where lost; clusters count that are at least half full.

    Parameters
    ----------
    values : ndarray, shape (time,)
        Rates [deg/h].
    factors : list of int
        Averaging times, in samples.

    Returns
    -------
    ndarray, shape (factor,)
        Allan variance [(deg/h)2]; NaN where no pair of clusters is half full.

    Examples
    --------
    >>> allan_variance(np.tile([1.0, -1.0], 500), [1, 2]).tolist()
    [2.0, 0.0]
    """
    there = np.isfinite(values)
    filled = np.where(there, values - values[there].mean(), 0.0)
    total = np.concatenate([[0.0], np.cumsum(filled)])
    count = np.concatenate([[0], np.cumsum(there)])
    out = []
    for k in factors:
        number = (count[k:] - count[:-k]).astype(float)
        mean = (total[k:] - total[:-k]) / np.maximum(number, 1)
        good = 2 * number >= k
        both = good[k:] & good[:-k]
        step = mean[k:] - mean[:-k]
        out.append(0.5 * float((step[both] ** 2).mean()) if both.any() else math.nan)
    return np.asarray(out)


def allan_band(
    *,
    noise: dict[str, float],
    rate: float,
    missing: NDArray[np.bool_],
    rng: np.random.Generator,
    nulls: int = 60,
    flicker: str = "spectrum",
) -> dict[str, Any]:
    """What the Allan variance of noise alone looks like under these gaps, and how far its largest deviation goes.

    Parameters
    ----------
    noise : dict
        N, B, K, Q of the axis, known exactly.
    rate : float
        Rate [Hz].
    missing : ndarray of bool, shape (time,)
    rng : numpy.random.Generator
    nulls : int
        Records of noise.
    flicker : str
        Method, see `floor.flicker`.

    Returns
    -------
    dict
        ``factors``, ``mean`` and ``sd`` of the log variance, and ``limit``: what the largest of ``abs(z)`` stays under in 99 % of nulls.
    """
    size = missing.size
    factors = octaves(size)
    rows = []
    for _ in range(nulls):
        white = floor.white_level(noise["N"]) * math.sqrt(rate) * rng.standard_normal(size)
        slow = floor.flicker(rng, size, b=noise["B"], rate=rate, method="spectrum" if size > 200_000 else flicker)
        record = white + slow + floor.random_walk(rng, size, k=noise["K"], rate=rate)
        record = floor.quantize_angle(record + 7.0, q=noise.get("Q", 0.0), rate=rate)
        record[missing] = np.nan
        rows.append(np.log(allan_variance(record, factors)))
    logs = np.stack(rows)
    keep = np.isfinite(logs).all(axis=0)
    logs, factors = logs[:, keep], [k for k, good in zip(factors, keep, strict=True) if good]
    mean, sd = logs.mean(axis=0), logs.std(axis=0, ddof=1)
    tied = np.corrcoef(logs, rowvar=False).reshape(len(factors), len(factors))
    values, vectors = np.linalg.eigh(0.98 * tied + 0.02 * np.eye(len(factors)))
    normal = rng.standard_normal((20_000, len(factors))) @ (vectors * np.sqrt(np.maximum(values, 0))).T
    scatter = np.sqrt(rng.chisquare(nulls - 1, (20_000, 1)) / (nulls - 1))  # the moments come from a few records themselves
    spread = math.sqrt(1 + 1 / nulls)
    return {
        "factors": factors,
        "mean": mean,
        "sd": sd,
        "limit": float(np.quantile((np.abs(normal) / scatter).max(axis=1), 1 - LEVEL) * spread),
    }


def allan_detector(record: Array, truth: dict[str, Any], *, rng: np.random.Generator, nulls: int = 60) -> bool:
    """Whether the whole-record Allan deviation of any axis leaves its 99 % band, the noise being known exactly.

    Parameters
    ----------
    record : ndarray, shape (axis, time)
        Rates [deg/h], NaN where lost.
    truth : dict
        Of the case: its noise is used.
    rng : numpy.random.Generator
    nulls : int
        Records of noise for each axis.
    """
    axes = len(truth["noise"])
    for row, noise in zip(record, truth["noise"].values(), strict=True):
        band = allan_band(
            noise=noise, rate=truth["sampling_rate_hz"], missing=np.isnan(row), rng=rng, nulls=nulls, flicker=truth["flicker"]
        )
        z = (np.log(allan_variance(row, band["factors"])) - band["mean"]) / band["sd"]
        if float(np.abs(z).max()) > _shared_limit(band["limit"], axes):
            return True
    return False


def _shared_limit(limit: float, axes: int) -> float:
    """The limit for 1 % over all `axes` from that for 1 % on one, by the tail of a normal deviate."""
    tail = 2 * float(special.ndtr(-limit)) / axes
    return float(-special.ndtri(tail / 2))


def channel_detector(log: xr.Dataset, *, block: float = 10.0) -> bool:
    """Whether block means or block variances of any axis correlate with any channel, at 1 % over all pairs, blocks taken as independent.

    Parameters
    ----------
    log : xarray.Dataset
    block : float
        Length of the blocks [s].
    """
    rate = float(log.attrs["sampling_rate_hz"])
    record = np.asarray(log["rate"].values)
    length = round(block * rate)
    number = record.shape[1] // length
    cut = record[:, : number * length].reshape(record.shape[0], number, length)
    enough = np.isfinite(cut).sum(axis=2) > max(2, length // 4)
    with np.errstate(invalid="ignore", divide="ignore"):
        count = np.isfinite(cut).sum(axis=2)
        mean = np.nansum(cut, axis=2) / count
        spread = np.log(np.nansum((cut - mean[:, :, None]) ** 2, axis=2) / (count - 1))
    pairs = []
    for name in _channels(log):
        values = np.asarray(log[name].values, dtype=float)
        own = values.size / (record.shape[1] / rate)
        edges = np.minimum((np.arange(number) * block * own).astype(int), values.size - 1)
        driver = np.add.reduceat(values, edges) / np.diff(np.append(edges, values.size))
        for i in range(record.shape[0]):
            pairs += [_correlation_p(series[i][enough[i]], driver[enough[i]]) for series in (mean, spread)]
    found = [p for p in pairs if math.isfinite(p)]
    return bool(found) and min(found) < LEVEL / len(found)


def _channels(log: xr.Dataset) -> list[str]:
    return [str(name) for name, variable in log.data_vars.items() if variable.dims in (("time",), (f"time_{name}",))]


def _correlation_p(x: Array, y: Array) -> float:
    good = np.isfinite(x) & np.isfinite(y)
    n = int(good.sum())
    if n < 5 or np.ptp(x[good]) == 0 or np.ptp(y[good]) == 0:
        return math.nan
    r = float(np.corrcoef(x[good], y[good])[0, 1])
    return float(special.erfc(abs(math.atanh(min(abs(r), 1 - 1e-12))) * math.sqrt((n - 3) / 2)))

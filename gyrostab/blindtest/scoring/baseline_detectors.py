"""Two plain detectors to compare with, and the Allan deviation that they need: a whole-record Allan plot, and correlation with channels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from gyrostab.blindtest.generator import noise_floor as floor

__all__ = [
    "allan_band",
    "allan_detector",
    "allan_variance",
    "band_excess",
    "channel_detector",
    "log_allan",
    "octaves",
]

Array = NDArray[np.float64]

#: Level of both detectors.
LEVEL = 0.01

#: Samples from which on a record is long, samples of a mean in it, and of the part that nulls of
#: its short times are made of.
_LONG, _BLOCK, _PART = 50_000, 32, 20_000


def octaves(size: int) -> list[int]:
    """Averaging factors 1, 2, 4 ... up to a tenth of a record of `size` samples.

    Examples
    --------
    >>> octaves(100)
    [1, 2, 4, 8]
    """
    most = max(1, size // 10)
    return [2**k for k in range(most.bit_length())]


def allan_variance(
    values: Array, factors: list[int], *, counts: NDArray[np.int64] | None = None
) -> Array:
    """Overlapping Allan variance of rates (time,) with NaN where lost; clusters count that are at least half full.

    Parameters
    ----------
    values : ndarray, shape (time,)
        Rates [deg/h].
    factors : list of int
        Averaging times, in samples.
    counts : ndarray of int, shape (time,), optional
        Where the values are means themselves: of how many samples each.

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
    weight = there.astype(np.int64) if counts is None else counts * there
    full = 1 if counts is None else int(counts.max())
    filled = np.where(there, values - values[there].mean(), 0.0) * weight
    total = np.concatenate([[0.0], np.cumsum(filled)])
    count = np.concatenate([[0], np.cumsum(weight)])
    out = []
    for k in factors:
        number = (count[k:] - count[:-k]).astype(float)
        mean = (total[k:] - total[:-k]) / np.maximum(number, 1)
        good = 2 * number >= k * full
        both = good[k:] & good[:-k]
        step = mean[k:] - mean[:-k]
        out.append(0.5 * float((step[both] ** 2).mean()) if both.any() else math.nan)
    return np.asarray(out)


def _blocks(values: Array) -> tuple[Array, NDArray[np.int64]]:
    """Means of `_BLOCK` samples, and of how many each is."""
    cut = values[: values.size // _BLOCK * _BLOCK].reshape(-1, _BLOCK)
    counts = np.isfinite(cut).sum(axis=1)
    means = np.where(counts > 0, np.nansum(cut, axis=1) / np.maximum(counts, 1), np.nan)
    return means, counts


def log_allan(values: Array) -> Array:
    """Log of the Allan variance of rates (time,) at `octaves`; the long times of a long record from means of `_BLOCK` samples."""
    factors = octaves(values.size)
    if values.size <= _LONG:
        return np.asarray(np.log(allan_variance(values, factors)))
    means, counts = _blocks(values)
    fine = allan_variance(values, [k for k in factors if k <= _BLOCK])
    coarse = allan_variance(means, [k // _BLOCK for k in factors if k > _BLOCK], counts=counts)
    return np.asarray(np.log(np.concatenate([fine, coarse])))


def _null(
    rng: np.random.Generator,
    missing: NDArray[np.bool_],
    noise: dict[str, float],
    rate: float,
    flicker: str,
) -> Array:
    size = missing.size
    record = floor.white_level(noise["N"]) * math.sqrt(rate) * rng.standard_normal(size) + 7.0
    record += floor.flicker(rng, size, b=noise["B"], rate=rate, method=flicker) + floor.random_walk(
        rng, size, k=noise["K"], rate=rate
    )
    record = floor.quantize_angle(record, q=noise.get("Q", 0.0), rate=rate)
    record[missing] = np.nan
    return record


def _null_logs(
    rng: np.random.Generator,
    missing: NDArray[np.bool_],
    noise: dict[str, float],
    rate: float,
    flicker: str,
    nulls: int,
) -> tuple[Array, Array]:
    """Logs of the Allan variance of nulls (null, factor), and by how much each factor's scatter is that of the whole record.

    Of a long record the short times come from nulls of a part of it, the long ones from nulls of
    means.
    """
    factors = octaves(missing.size)
    if missing.size <= _LONG:
        rows = [log_allan(_null(rng, missing, noise, rate, flicker)) for _ in range(nulls)]
        return np.stack(rows), np.ones(len(factors))
    short = [k for k in factors if k <= _BLOCK]
    middle = (missing.size - _PART) // 2
    part = (
        missing[middle : middle + _PART]
        if not missing[middle : middle + _PART].all()
        else missing[:_PART]
    )
    _, counts = _blocks(np.where(missing, np.nan, 0.0))
    fewer = np.sqrt(_BLOCK / np.maximum(counts, 1)) - 1
    rows = []
    for _ in range(nulls):
        fine = np.log(allan_variance(_null(rng, part, noise, rate, flicker), short))
        means = _null(rng, counts == 0, noise | {"Q": 0.0}, rate / _BLOCK, "spectrum")
        means += (
            floor.white_level(noise["N"])
            * math.sqrt(rate / _BLOCK)
            * np.sqrt((1 + fewer) ** 2 - 1)
            * rng.standard_normal(counts.size)
        )
        coarse = np.log(
            allan_variance(means, [k // _BLOCK for k in factors if k > _BLOCK], counts=counts)
        )
        rows.append(np.concatenate([fine, coarse]))
    smaller = math.sqrt(float((~part).sum()) / float((~missing).sum()))
    return np.stack(rows), np.where(np.array(factors) <= _BLOCK, smaller, 1.0)


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
        ``keep`` (which of the `octaves` can be had), ``mean`` and ``sd`` of the log variance there,
        and ``limit``: what the largest of ``abs(z)`` stays under in 99 % of nulls.
    """
    logs, scatter_of_whole = _null_logs(rng, missing, noise, rate, flicker, nulls)
    keep = np.isfinite(logs).all(axis=0)
    logs = logs[:, keep]
    mean, sd = logs.mean(axis=0), logs.std(axis=0, ddof=1) * scatter_of_whole[keep]
    tied = np.corrcoef(logs, rowvar=False).reshape(mean.size, mean.size)
    values, vectors = np.linalg.eigh(0.98 * tied + 0.02 * np.eye(mean.size))
    normal = rng.standard_normal((20_000, mean.size)) @ (vectors * np.sqrt(np.maximum(values, 0))).T
    scatter = np.sqrt(
        rng.chisquare(nulls - 1, (20_000, 1)) / (nulls - 1)
    )  # the moments come from a few records themselves
    spread = math.sqrt(1 + 1 / nulls)
    return {
        "keep": keep,
        "mean": mean,
        "sd": sd,
        "limit": float(np.quantile((np.abs(normal) / scatter).max(axis=1), 1 - LEVEL) * spread),
    }


def band_excess(values: Array, band: dict[str, Any]) -> float:
    """The largest deviation of the Allan variance of rates (time,) from an `allan_band`, in standard deviations."""
    z = (log_allan(values)[band["keep"]] - band["mean"]) / band["sd"]
    return float(np.nanmax(np.abs(z)))


def allan_detector(
    record: Array, truth: dict[str, Any], *, rng: np.random.Generator, nulls: int = 60
) -> bool:
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
            noise=noise,
            rate=truth["sampling_rate_hz"],
            missing=np.isnan(row),
            rng=rng,
            nulls=nulls,
            flicker=truth["flicker"],
        )
        if band_excess(row, band) > _shared_limit(band["limit"], axes):
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
            pairs += [
                _correlation_p(series[i][enough[i]], driver[enough[i]]) for series in (mean, spread)
            ]
    found = [p for p in pairs if math.isfinite(p)]
    return bool(found) and min(found) < LEVEL / len(found)


def _channels(log: xr.Dataset) -> list[str]:
    return [
        str(name)
        for name, variable in log.data_vars.items()
        if variable.dims in (("time",), (f"time_{name}",))
    ]


def _correlation_p(x: Array, y: Array) -> float:
    good = np.isfinite(x) & np.isfinite(y)
    n = int(good.sum())
    if n < 5 or np.ptp(x[good]) == 0 or np.ptp(y[good]) == 0:
        return math.nan
    r = float(np.corrcoef(x[good], y[good])[0, 1])
    return float(special.erfc(abs(math.atanh(min(abs(r), 1 - 1e-12))) * math.sqrt((n - 3) / 2)))
